"""What commands that play games are told: who plays, and which game.

Every option on the game that is not given is that of the first checkpoint among the players, else
RS in a bin of 10 × 10 × 10 under ``hull_alpha``.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

from rich.console import Console

from marl_pack.agents.heuristics import ORIENTATION_AGENTS, POLICIES, make_policy
from marl_pack.agents.policy import Policy, in_turns
from marl_pack.bins import Size, check_device
from marl_pack.game.packing import ALL_ORIENTATIONS, Packing
from marl_pack.items import (
    DEFAULT_SIDES,
    GENERATED,
    Stream,
    choose_stream,
    independent,
    make_stream,
)
from marl_pack.stability import RULES
from marl_pack.stability.oriented_item import NO_OFFSET

EPILOG = (
    "The game is the one that the first checkpoint among the policies was trained on, else RS in a "
    "bin of 10 x 10 x 10 under hull_alpha; each option changes that."
)
DEFAULTS: dict[str, Any] = {
    "items": "rs", "bin": None, "sides": DEFAULT_SIDES, "rule": "hull_alpha", "margin": None,
    "thresholds": None, "orientations": list(ALL_ORIENTATIONS), "mask_orientations": True,
    "com_offset": NO_OFFSET,
}  # fmt: skip
"""The game's options where neither the command line nor a checkpoint says; ``bin`` None is the
file's own or 10 x 10 x 10."""


@dataclass(frozen=True)
class Setup:
    """Who plays, and which game."""

    policies: dict[str, Policy]  # by the name of each one's row
    stream: Stream
    size: Size  # W, D, H
    arguments: argparse.Namespace  # the options, those on the game filled in

    def game(self, n: int, first_episode: int) -> Packing:
        """A game of n bins without ``auto_reset``, from the episode ``first_episode`` on."""
        told = self.arguments
        return Packing(
            n, self.size, self.stream, rule=told.rule, rule_parameters=self.rule_parameters,
            orientations=told.orientations, mask_orientations=told.mask_orientations,
            com_offset=tuple(told.com_offset), device=told.device, seed=told.seed,
            first_episode=first_episode, auto_reset=False,
        )  # fmt: skip

    @property
    def rule_parameters(self) -> dict[str, Any]:
        """What the rule was given beside its name."""
        named = {name: getattr(self.arguments, name) for name in ("margin", "thresholds")}
        return {name: value for name, value in named.items() if value is not None}

    def __str__(self) -> str:
        told = self.arguments
        text = str(told.items)
        if told.items in GENERATED and tuple(told.sides) != DEFAULT_SIDES:
            text += f" {told.sides[0]}-{told.sides[1]}"
        text += f", bin {' x '.join(map(str, self.size))}, rule {told.rule}"
        if self.rule_parameters:
            text += f" ({', '.join(f'{k} {v}' for k, v in self.rule_parameters.items())})"
        if set(told.orientations) != set(ALL_ORIENTATIONS):
            text += f", orientations {sorted(set(told.orientations))}"
        if not told.mask_orientations:
            text += ", no mask of orientations"
        if any(told.com_offset):
            text += f", centre of mass off by {' '.join(f'{o:g}' for o in told.com_offset)}"
        if told.symmetric:
            text += "; learned agents asked in all symmetries"
        return text


def add_options(options: argparse.ArgumentParser) -> None:
    """Add the options of :func:`choose` to a command."""
    add = options.add_argument
    add("--policy", nargs="+", metavar="NAME",
        help=f"one or more of {', '.join(POLICIES)}, runs' folders or checkpoints "
             "(default: dblf)")  # fmt: skip
    add("--orientation", metavar="NAME",
        help=f"with --placement: the first agent alone, of {', '.join(ORIENTATION_AGENTS)}, a "
             "run's folder or a checkpoint")  # fmt: skip
    add("--placement", metavar="NAME",
        help=f"with --orientation: the second agent alone, of {', '.join(POLICIES)}, a run's "
             "folder or a checkpoint")  # fmt: skip
    add("--plan", metavar="rollouts=K,top=M",
        help="learned agents try their M best pairs in K imagined futures before each placement; "
             "depth=D ends each future after D items by the critic's word")  # fmt: skip
    add("--symmetric", action="store_true",
        help="ask learned agents in all symmetries of the bin and take what is most probable in "
             "the mean; with --plan which pairs to try, not in the imagined futures")  # fmt: skip
    add("--items", help=f"{', '.join(GENERATED)}, or a .npz, .json or .csv file")
    add("--bin", nargs=3, type=int, metavar=("W", "D", "H"),
        help="bin size in cells; a file brings its own")  # fmt: skip
    add("--sides", nargs=2, type=int, metavar=("SHORTEST", "LONGEST"),
        help="sides of generated items, in cells")  # fmt: skip
    add("--rule", choices=list(RULES), help="stability rule of the masks")
    add("--margin", type=float, help="cells by which the support polygon is shrunk")
    add("--thresholds", choices=["paper", "code"], help="of the rule area_ratio")
    add("--orientations", nargs="+", type=int, metavar="O",
        help="orientations that may be chosen, of 0 … 5")  # fmt: skip
    add("--orientation-mask", action=argparse.BooleanOptionalAction, dest="mask_orientations",
        help="whether orientations without a legal cell are excluded; else choosing one ends the "
             "episode")  # fmt: skip
    add("--com-offset", nargs=3, type=float, metavar=("X", "Y", "Z"),
        help="centre of mass of the items from their middle, in fractions of w, d, h")  # fmt: skip
    add("--seed", type=int, default=0,
        help="of generated items, random play, futures of --plan and drawn bodies "
             "(default: 0)")  # fmt: skip
    add("--device", default="cpu", help="cpu (default), cuda, cuda:1, …")
    add("--threads", type=int, default=1, help="on the CPU (default: 1)")


def choose(arguments: argparse.Namespace, console: Console) -> Setup:
    """The players and the game that the options name.

    Args:
        arguments: the options, changed in place: those on the game that were not given are filled.
        console: is told what checkpoints were trained on.

    Raises:
        ValueError, FileNotFoundError: if an option cannot be, naming what would be right.
    """
    check_device(arguments.device)
    if arguments.seed < 0:
        raise ValueError(f"--seed {arguments.seed}: needs 0 or more")
    policies, learned = choose_policies(arguments, console)
    choose_game(arguments, learned)
    stream, size = choose_stream(
        arguments.items, tuple(arguments.bin) if arguments.bin else None, tuple(arguments.sides)
    )
    if arguments.plan is not None:
        policies = with_plans(policies, arguments, stream, size)
    return Setup(policies, stream, size, arguments)


def choose_policies(
    arguments: argparse.Namespace, console: Console
) -> tuple[dict[str, Policy], dict[str, Any]]:
    """The policies that the options name, by the name of their row, and the game they are for.

    The game is that of the first checkpoint among them (the keys of
    :class:`marl_pack.config.Game`), empty if there is none.

    Raises:
        ValueError, FileNotFoundError: if there is none of that name.
    """
    pair = arguments.orientation, arguments.placement
    if (pair[0] is None) != (pair[1] is None):
        raise ValueError("--orientation and --placement go together: name both agents")
    names = arguments.policy or ([] if pair[0] else ["dblf"])
    sources = [name for name in dict.fromkeys((*names, *pair)) if name is not None]
    if arguments.symmetric and all(name in ORIENTATION_AGENTS for name in sources):
        raise ValueError("--symmetric goes with a run's folder or checkpoint")
    if all(name in POLICIES for name in names) and pair == (None, None):
        return {n: make_policy(n, arguments.seed, arguments.device) for n in names}, {}
    # Only learned agents need rsl_rl.
    from marl_pack.agents.learning import checkpoint

    how = arguments.device, arguments.seed, arguments.symmetric
    policies = {name: checkpoint.find_policy(name, *how) for name in names}
    if pair[0] is not None:
        policies[f"{pair[0]} + {pair[1]}"] = in_turns(
            checkpoint.find_orientation_agent(pair[0], *how),
            checkpoint.find_placement_agent(pair[1], *how),
        )
    learned: dict[str, Any] = {}
    for source in sources:
        if source not in ORIENTATION_AGENTS:
            found = checkpoint.read(source)
            learned = learned or found["config"]["game"]
            console.print(f"{source}: trained on {checkpoint.trained_on(found)}", soft_wrap=True)
    return policies, learned


def with_plans(
    policies: dict[str, Policy], arguments: argparse.Namespace, stream: Stream, size: Size
) -> dict[str, Policy]:
    """The learned policies, planning as ``--plan`` says; heuristics stay as they are.

    What they imagine to come is what they were trained on; if that was a file, the rows of
    ``stream``.

    Raises:
        ValueError: if the plan cannot be read, or there is no checkpoint to plan with.
    """
    from marl_pack.agents.learning import checkpoint
    from marl_pack.agents.search import Plan, make_planner

    plan = Plan.parse(arguments.plan)
    if all(name in POLICIES for name in policies) or arguments.orientation is not None:
        raise ValueError("--plan goes with --policy and a run's folder or checkpoint")
    planned: dict[str, Policy] = {}
    for name, policy in policies.items():
        if name in POLICIES:
            planned[name] = policy
        else:
            found = checkpoint.read(name, arguments.device)
            game = found["config"]["game"]
            if game["items"] in GENERATED:
                try:
                    learned = make_stream(game["items"], size, tuple(game["sides"]))
                except ValueError as error:
                    raise ValueError(f"--plan: what the agents were trained on: {error}") from None
            else:
                learned = stream
            futures = independent(learned).to(arguments.device)
            planned[f"{name}, {plan}"] = make_planner(
                found, plan, futures, arguments.device, arguments.seed, arguments.symmetric
            )
    return planned


def choose_game(arguments: argparse.Namespace, learned: dict[str, Any]) -> None:
    """Fill the options on the game that were not given.

    Args:
        arguments: the options, changed in place.
        learned: the game that the policies were trained on, empty if there is none.
    """
    settings = DEFAULTS | learned
    if arguments.rule is not None:  # these belong to the rule
        settings |= {"margin": None, "thresholds": None}
    if arguments.items is not None and arguments.items not in GENERATED:
        settings["bin"] = None
    for key in DEFAULTS:
        if getattr(arguments, key) is None:
            setattr(arguments, key, settings[key])
