"""Play one game, turn by turn, and draw the packed bin.

``marl-pack play --policy rs --picture play.png`` prints each item, its orientation and its
position. Then it writes a picture of the packed bin, or, if the file ends in ``.gif``, an animation
of how it was packed. ``--save`` writes the plan of the bin.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from marl_pack.evaluation.statistics import strict_equilibrium
from marl_pack.files import check_writable
from marl_pack.game.spec import SelectionSpec
from marl_pack.geometry import ORIENTATIONS
from marl_pack.options import GAME_NOTE, add_explain, add_options, check_explain, check_names
from marl_pack.plan_archive import check_ending, save_plan
from marl_pack.render.choices import ENDINGS
from marl_pack.terminal import Parser, make_console, make_status

PROGRAM = "python -m marl_pack.play"


def parser(program: str = PROGRAM) -> Parser:
    """Return the parser of the command's options."""
    options = Parser(
        prog=program, usage=f"{program} [OPTIONS]",
        description=__doc__.split("\n\n")[0], notes=[GAME_NOTE],
        examples=(
            "--policy rs --picture bin.gif",
            "--policy runs/NAME --items boxes.csv --episode 3 --save plan.json",
        ),
    )  # fmt: skip
    add_options(options, SelectionSpec)
    options.add_argument_group("episode").add_argument(
        "--episode", type=int, default=0, help="number of the sequence (default: 0)"
    )
    group = options.add_argument_group("output")
    add = group.add_argument
    add("--picture", type=Path, default=Path("play.png"),
        help="file for a picture of the packed bin (.png), or an animation of how it was packed "
             "(.gif, .mp4) (default: play.png)")  # fmt: skip
    add("--save", type=Path, metavar="FILE",
        help="write the packed boxes to this file (.json, .csv or .npz)")  # fmt: skip
    add_explain(group, "--save")
    return options


def run(chosen: argparse.Namespace, console: Console) -> None:
    """Play the game that the options choose, print its turns and draw the packed bin.

    Raises:
        ValueError, FileNotFoundError: if an option is impossible; says what would be right.
    """
    if chosen.picture.suffix.lower() not in ENDINGS:
        raise ValueError(f"--picture {chosen.picture}: needs the ending {', '.join(ENDINGS)}")
    check_writable(chosen.picture)
    if chosen.save is not None:
        check_ending(chosen.save, "--save")
        check_writable(chosen.save)
    if chosen.explain:
        check_explain(chosen.save, "--save")
    check_names(chosen)
    with make_status(console, "loading the player"):
        import torch  # slow to import, as are these

        from marl_pack.agents.explaining import explain
        from marl_pack.evaluation.rollout import Reasons
        from marl_pack.players import choose, set_threads

        set_threads(chosen.threads)
        setup = choose(chosen, console)
    if len(setup.policies) > 1:
        raise ValueError("--policy: needs one policy; the command evaluate compares several")
    ((name, policy),) = setup.policies.items()
    episodes = setup.stream.episodes
    if chosen.episode < 0 or (episodes and chosen.episode >= episodes):
        most = f" … {episodes - 1}" if episodes else " or more"
        raise ValueError(f"--episode {chosen.episode}: needs 0{most}")
    if chosen.explain and setup.spec.selects:
        raise ValueError("--explain: goes with games of one visible box and one bin")
    game = setup.game(1, chosen.episode)
    first = torch.zeros(1, dtype=torch.int64)
    title = f"{name} plays {setup}, episode {chosen.episode}"
    table = Table()
    several = ("bin",) if setup.spec.bins > 1 else ()
    for column in ("item", *several, "w d h", "orientation", "x y z", "reward", "utilization"):
        table.add_column(column, justify="right")
    reasons = Reasons(1)
    with make_status(console, "playing") as status:
        while bool(game.alive):
            status.update(f"playing: item {len(table.rows) + 1}")
            choice = policy(game)
            explained = explain(policy, game, choice) if chosen.explain else None
            *option, orientation, cell = choice
            # The chosen box and bin, in a copy: a bin may be closed by the placement.
            alone = game.view(game.rows(option[0])) if option else game.branch(first)
            count, item = int(alone.bins.count), alone.items.sides[0].tolist()
            alone.place(orientation, cell)
            outcome = game.place(*choice)
            reasons.add(explained, outcome.placed.tolist())
            # Without a mask of orientations the choice may have no legal cell; this ends the game.
            placed = int(alone.bins.count) > count
            axes = "".join("wdh"[axis] for axis in ORIENTATIONS[int(orientation)])
            position = alone.bins.boxes[0, count, :3].tolist() if placed else ["nowhere"]
            table.add_row(
                str(len(table.rows) + 1),
                *(str(int(option[0]) % setup.spec.bins) for _ in several),
                " ".join(map(str, item)),
                axes,
                " ".join(map(str, position)),
                f"{float(outcome.reward):+.3f}",
                f"{float(outcome.utilization):.1%}",
            )
    console.print(title, soft_wrap=True)
    console.print(table)

    from marl_pack.render.animation import Film, save_film

    (plan,) = reasons.of(game.plans())
    balance = "in strict equilibrium" if strict_equilibrium(plan) else "NOT in equilibrium"
    ending = f"{len(plan)} boxes, utilization {plan.utilization:.1%}, {balance}"
    console.print(ending)
    with make_status(console, "drawing the bin"):
        save_film(chosen.picture, Film(plan, name))
    console.print(f"picture: {chosen.picture}", soft_wrap=True)
    if chosen.save is not None:
        save_plan(chosen.save, plan)
        console.print(f"plan: {chosen.save}", soft_wrap=True)


def main(arguments: Sequence[str] | None = None, program: str = PROGRAM) -> int:
    """Run the command ``marl-pack play``; return its exit status."""
    options = parser(program)
    chosen = options.parse_args(arguments)
    try:
        run(chosen, make_console())
    except KeyboardInterrupt:
        options.exit(130, f"{options.prog}: interrupted")
    except (ValueError, OSError, ModuleNotFoundError) as error:
        options.exit(2, f"{options.prog}: {error}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
