"""Options of the commands that play games: the policies, and the game."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path

from marl_pack import published
from marl_pack.agents.keys import ORIENTATION_AGENTS, POLICIES
from marl_pack.agents.search_settings import SearchSettings
from marl_pack.agents.selection.beam_settings import BeamSettings
from marl_pack.agents.selection.budget_settings import BudgetSettings
from marl_pack.agents.sources import check_source, path_of, resolve
from marl_pack.exact.spec import ORDERS, ExactSpec
from marl_pack.game.spec import GameSpec
from marl_pack.items import GENERATED
from marl_pack.items.generated import no_such_file
from marl_pack.option_record import add_arguments

WORLDS = ("cells", "mm")
NEXT_BIN, SKIP, STOP = "next-bin", "skip", "stop"
NO_PLACE = (NEXT_BIN, SKIP, STOP)
"""What ``pack`` does with a box that has no place in the open bin."""
COMMON = frozenset(each.name for each in fields(GameSpec)) & {
    each.name for each in fields(ExactSpec)
}
"""Options that games on cells have, too."""
SELECTION = ("buffer", "preview", "bins", "closings")
"""Options of games on cells in which a box and a bin are selected first."""
ONLY_CELLS = ("sides", "bin", "margin", "mask_orientations", "com_offset", "max_items",
              "orientation", "placement", "plan", *SELECTION)  # fmt: skip
MM_POLICIES = ("max_contact", "linear", "dblf", "height_min", "best_fit", "random")
"""Heuristics of games in millimetres (:data:`marl_pack.exact.policies.NAMES`)."""
IN_MM = {"margin": "margin_mm", "bin": "bin_mm", "max_items": "max_boxes"}
"""Options of games on cells, and what they are called in millimetres."""
ONLY_MM = (
    *(each.name for each in fields(ExactSpec) if each.name not in COMMON),
    "order",
    "length",
    "present",
)
MOST_AT_ONCE = 1024
"""The largest number of threads, and of processes that judge."""
GAME_NOTE = """\
The game on cells is the one that the first learned policy was trained on; without a learned
policy it is RS in a bin of 10 x 10 x 10 under hull_alpha. Options of the game change this. A
learned policy is a published model, a run's folder or a checkpoint."""


def add_options(options: argparse.ArgumentParser, spec: type[GameSpec] = GameSpec) -> None:
    """Add the options of :func:`marl_pack.players.choose` to a command.

    Args:
        options: the parser of the command.
        spec: the record of the options of its games.
    """
    beam = "" if spec is GameSpec else (
        "; with a buffer, a preview or several bins width=W,depth=D: a beam over the known boxes"
    )  # fmt: skip
    models, learned = ", ".join(published.models()), "a run's folder or a checkpoint"
    add = options.add_argument_group("players").add_argument
    add("--policy", nargs="+", metavar="NAME",
        help=f"one or more of the heuristics {', '.join(POLICIES)}, of the published models "
             f"{models}, {learned}, or your own function, FILE.py:NAME "
             "(default: dblf)")  # fmt: skip
    add("--orientation", metavar="NAME",
        help=f"with --placement: the orientation agent: {', '.join(ORIENTATION_AGENTS)}, "
             f"{models}, or {learned}")  # fmt: skip
    add("--placement", metavar="NAME",
        help=f"with --orientation: the placement agent: {', '.join(POLICIES)}, {models}, "
             f"or {learned}")  # fmt: skip
    add("--plan", metavar="budget=T",
        help="budget=100ms: before each placement a search with the critic of learned agents draws "
             "boxes that may come, for this time; draws=N limits their number. rollouts=K,top=M: "
             "learned agents try their M best pairs in K imagined futures; "
             f"depth=D ends each future after D items by the critic's value{beam}")  # fmt: skip
    add("--symmetric", action="store_true",
        help="ask learned agents in all symmetries of the bin and take the action that is most "
             "probable on average; with --plan only to choose the pairs to try")  # fmt: skip
    game = options.add_argument_group("game")
    add = game.add_argument
    add("--items", help=f"{', '.join(GENERATED)}, or a .npz, .json or .csv file")
    add("--sides", nargs=2, type=int, metavar=("SHORTEST", "LONGEST"),
        help="sides of generated items, in cells")  # fmt: skip
    add_arguments(game, spec)
    add("--seed", type=int, default=0,
        help="seed of generated items, random play, futures of --plan and drawn bodies "
             "(default: 0)")  # fmt: skip
    add = options.add_argument_group("computation").add_argument
    add("--device", default="cpu", help="cpu (default), cuda, cuda:1, …")
    add("--threads", type=int, default=1, help="threads on the CPU (default: 1)")


def add_explain(group: argparse._ArgumentGroup, file: str) -> None:
    """Add ``--explain`` to a command that writes plans.

    Args:
        group: the group of options.
        file: the option that names the file of plans.
    """
    group.add_argument(
        "--explain", action="store_true",
        help=f"write into the .json file of {file} why each box is where it is: the legal "
             "placements, probabilities and values (docs/replay.md)",
    )  # fmt: skip


def check_explain(path: Path | None, option: str) -> None:
    """Refuse ``--explain`` without a JSON file of plans.

    Raises:
        ValueError: naming the option that names the file.
    """
    if path is None or path.suffix.lower() != ".json":
        raise ValueError(f"--explain: needs {option} with a .json file")


def add_mm_options(options: argparse.ArgumentParser) -> None:
    """Add ``--world`` and the options of games in millimetres to a command."""
    group = options.add_argument_group("game in millimetres (--world mm)")
    group.add_argument(
        "--world", choices=WORLDS, default=WORLDS[0],
        help="cells: whole cells (default); mm: true sizes in millimetres, from --items FILE, by "
             f"--policy {', '.join(MM_POLICIES)} (default: {MM_POLICIES[0]}), a .json file of "
             "marl-pack tune, or FILE.py:NAME",
    )  # fmt: skip
    group.add_argument(
        "--order", choices=ORDERS,
        help="file: the sequences of the file (default); draw: boxes drawn at random",
    )  # fmt: skip
    group.add_argument(
        "--present", type=Path, metavar="FILE",
        help="a plan of one bin (.json or .csv): boxes that are in every bin at first",
    )  # fmt: skip
    group.add_argument(
        "--length", type=int, metavar="N",
        help="boxes in an episode: of a file, its disjoint windows; needed with --order draw",
    )  # fmt: skip
    add_arguments(group, ExactSpec, leave_out=COMMON)


def check_names(arguments: argparse.Namespace) -> None:
    """Refuse policies and items that do not exist, and settings of ``--plan`` that are not valid.

    The code of policies is slow to import, so commands call this first.

    Raises:
        ValueError, FileNotFoundError: if a name is wrong; says what would be right.
    """
    for name in arguments.policy or ():
        check_source(name, POLICIES)
    for name, names in (
        (arguments.orientation, ORIENTATION_AGENTS),
        (arguments.placement, POLICIES),
    ):
        if name is not None and name not in names:
            resolve(path_of(name, names))
    if arguments.plan is not None and BudgetSettings.are_in(arguments.plan):
        BudgetSettings.parse(arguments.plan)
    elif arguments.plan is not None and any(
        getattr(arguments, name, None) is not None for name in SELECTION
    ):
        BeamSettings.parse(arguments.plan)
    elif arguments.plan is not None:
        if "width" in arguments.plan and hasattr(arguments, "buffer"):
            raise ValueError(
                f"--plan {arguments.plan}: width goes with --buffer, --preview, --bins or "
                "--closings"
            )
        SearchSettings.parse(arguments.plan)
    items = arguments.items
    if items is not None and items not in GENERATED and not Path(items).is_file():
        raise no_such_file(items)
