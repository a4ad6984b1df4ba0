"""Play one game, turn by turn, and draw the packed bin.

``python -m marl_pack.play --policy dblf --picture play.png`` prints each item, how it was turned
and where it went, then writes a picture of the bin at the end.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from marl_pack.agents.heuristics import POLICIES, make_policy
from marl_pack.bins import ORIENTATIONS
from marl_pack.files import check_writable, write_atomically
from marl_pack.items import GENERATED, choose_stream
from marl_pack.packing import Packing
from marl_pack.stability import RULES, in_equilibrium


def parser() -> argparse.ArgumentParser:
    """The command's options."""
    options = argparse.ArgumentParser(
        prog="python -m marl_pack.play",
        description=__doc__.split("\n\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = options.add_argument
    add("--policy", default="dblf", choices=list(POLICIES), help="who plays both agents")
    add("--items", default="rs", help=f"{', '.join(GENERATED)}, or a .npz, .json or .csv file")
    add("--bin", nargs=3, type=int, metavar=("W", "D", "H"),
        help="bin size in cells (default: the file's own, else 10 10 10)")  # fmt: skip
    add("--rule", default="hull_alpha", choices=list(RULES), help="stability rule of the masks")
    add("--seed", type=int, default=0, help="of generated items and of random play")
    add("--episode", type=int, default=0, help="number of the sequence")
    add("--picture", type=Path, default=Path("play.png"), help="where to draw the bin (.png)")
    return options


def run(chosen: argparse.Namespace, console: Console) -> None:
    """Play the game the options ask for.

    Raises:
        ValueError, FileNotFoundError: if an option cannot be, naming what would be right.
    """
    if chosen.picture.suffix.lower() != ".png":
        raise ValueError(f"--picture {chosen.picture}: needs the ending .png")
    check_writable(chosen.picture)
    stream, size = choose_stream(chosen.items, tuple(chosen.bin) if chosen.bin else None)
    policy = make_policy(chosen.policy, chosen.seed)
    game = Packing(
        1, size, stream, rule=chosen.rule, seed=chosen.seed,
        first_episode=chosen.episode, auto_reset=False,
    )  # fmt: skip
    table = Table(title=f"{chosen.policy} plays {chosen.items}, episode {chosen.episode}")
    for column in ("item", "w d h", "orientation", "x y z", "reward", "utilization"):
        table.add_column(column, justify="right")
    while bool(game.alive):
        item = game.items[0].tolist()
        orientation, cell = policy(game)
        outcome = game.place(orientation, cell)
        x, y, z = game.bins.boxes[0, int(outcome.placed) - 1, :3].tolist()
        turned = "".join("wdh"[axis] for axis in ORIENTATIONS[int(orientation)])
        table.add_row(
            str(int(outcome.placed)),
            " ".join(map(str, item)),
            turned,
            f"{x} {y} {z}",
            f"{float(outcome.reward):+.3f}",
            f"{float(outcome.utilization):.1%}",
        )
    console.print(table)

    from matplotlib.image import imsave

    from marl_pack.render import draw

    count = int(game.bins.count)
    boxes, loads = game.bins.boxes[0, :count].numpy(), game.bins.loads[0, :count].numpy()
    filled = int(game.bins.filled) / game.volume
    stands = "in strict equilibrium" if in_equilibrium(boxes, loads) else "NOT in equilibrium"
    ending = f"{count} boxes, utilization {filled:.1%}, {stands}"
    console.print(ending)
    image = draw(game.size, boxes, title=f"{chosen.policy}: {ending}")
    write_atomically(chosen.picture, lambda file: imsave(file, image, format="png"))
    console.print(f"picture: {chosen.picture}")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command ``python -m marl_pack.play``."""
    options = parser()
    chosen = options.parse_args(arguments)
    try:
        run(chosen, Console())
    except (ValueError, FileNotFoundError) as error:
        options.exit(2, f"{options.prog}: {error}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
