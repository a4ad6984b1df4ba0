"""Pack boxes of true sizes, from a file or from a conveyor, and write the plan.

``marl-pack pack boxes.csv --bin-mm 1200 800 1500 --out plan.json`` packs a file.
``marl-pack pack -`` reads one box a line from standard input, and answers each line before it reads
the next one. With ``--buffer`` or ``--preview`` it first says that the box waits; the placements
follow as soon as they can be decided, and those of the last boxes at the end of the input.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from marl_pack import published
from marl_pack.checks import LARGEST_SEED, whole_number
from marl_pack.exact.spec import ExactSpec
from marl_pack.files import check_writable
from marl_pack.option_record import add_arguments
from marl_pack.options import MM_POLICIES, NEXT_BIN, NO_PLACE, add_explain, check_explain
from marl_pack.plan_archive import check_ending
from marl_pack.render.choices import ENDINGS
from marl_pack.terminal import Parser, announce_compiling, make_console

PROGRAM = "python -m marl_pack.pack"
NOTE = """\
columns of a file, keys of a line: w_mm, d_mm, h_mm; and, if you like, id, quantity, weight_kg,
upright, orientations, stackable, max_load_kg, order. Each order begins in a new bin. Orders in the
JSON format of BED-BPP are read as they are. docs/packer.md has all of it."""


def parser(program: str = PROGRAM) -> Parser:
    """Return the parser of the command's options."""
    options = Parser(
        prog=program, usage=f"{program} FILE [OPTIONS]", description=__doc__.split("\n\n")[0],
        notes=[NOTE],
        examples=(
            "boxes.csv --bin-mm 1200 800 1500 --margin-mm 20 --out plan.json",
            "boxes.csv --policy search --plan budget=200ms --out plan.json",
            "- --bin-mm 1200 800 1500 --out plan.json < boxes.jsonl",
            "boxes.csv --buffer 5 --open-bins 2 --out plan.json",
        ),
    )  # fmt: skip
    options.add_argument("boxes", metavar="FILE", help=".csv or .json file; - for standard input")
    add = options.add_argument_group("policy").add_argument
    add("--policy", default=MM_POLICIES[0], metavar="NAME",
        help=f"{', '.join(MM_POLICIES)}, search, a .json file of marl-pack tune, agents trained on "
             f"cells ({', '.join(published.models())}, a run's folder or a checkpoint), or "
             f"FILE.py:NAME (default: {MM_POLICIES[0]})")  # fmt: skip
    add("--plan", metavar="budget=T,top=M",
        help="search before each placement: T is a time such as 500ms, M the number of moves to "
             "try (default: budget=500ms,top=6)")  # fmt: skip
    add("--catalogue", type=Path, metavar="FILE",
        help="a file of goods from which the search draws the boxes to come (default: those shown "
             "so far)")  # fmt: skip
    add(
        "--grid-mm",
        type=float,
        metavar="MM",
        help="edge of the cells on which agents see the bin (default: a tenth of its longer side)",
    )
    add("--seed", type=int, default=0, help="seed of random and search (default: 0)")
    add = options.add_argument_group("bins").add_argument
    add(
        "--bins",
        type=int,
        metavar="N",
        help="largest number of bins (default: as many as are needed)",
    )
    add("--open-bins", type=int, default=1, metavar="B",
        help="number of bins that are open at once; where no visible box has a place, the fullest "
             "one is closed (default: 1)")  # fmt: skip
    add("--no-place", choices=NO_PLACE, default=NEXT_BIN,
        help="what to do with a box that has no place in the open bin: open the next one "
             "(default), leave the box out, or stop")  # fmt: skip
    add(
        "--present",
        type=Path,
        metavar="FILE",
        help="a plan of one bin (.json or .csv): boxes that are in the first bin already",
    )
    add = options.add_argument_group("boxes that are known").add_argument
    add("--buffer", type=int, default=1, metavar="K",
        help="number of visible boxes, any of which may be placed next (default: 1)")  # fmt: skip
    add("--preview", type=int, default=0, metavar="P",
        help="number of boxes after these that are known, but not placed yet; a search plays them "
             "(default: 0)")  # fmt: skip
    add_arguments(
        options.add_argument_group("game in millimetres"), ExactSpec, leave_out=("alpha", "beta")
    )
    group = options.add_argument_group("output")
    add = group.add_argument
    add(
        "--out",
        type=Path,
        metavar="FILE",
        help="write the plan to this .json, .csv or .npz file while boxes are packed",
    )
    add("--picture", type=Path, metavar="FILE",
        help="draw the packed bins (.png), or how they were packed (.gif, .mp4)")  # fmt: skip
    add_explain(group, "--out")
    add("--state", type=Path, metavar="FILE",
        help="with -: save the packer to this .json file before each answer; if the file exists, "
             "go on from there")  # fmt: skip
    return options


def run(chosen: argparse.Namespace) -> int:
    """Pack the boxes that the options name; return the number of lines that were refused.

    Raises:
        ValueError, OSError: if an option or a file is wrong; says what would be right.
    """
    conveyor = chosen.boxes == "-"
    console = make_console(stderr=conveyor)
    whole_number(chosen.seed, "--seed", 0, LARGEST_SEED)
    if chosen.state is not None and not conveyor:
        raise ValueError("--state: only with -, for a conveyor")
    if chosen.out is not None:
        check_ending(chosen.out, "--out")
    if chosen.explain:
        check_explain(chosen.out, "--out")
    if chosen.picture is not None and chosen.picture.suffix.lower() not in ENDINGS:
        raise ValueError(f"--picture {chosen.picture}: needs the ending {', '.join(ENDINGS)}")
    for path in (chosen.out, chosen.state, chosen.picture):
        if path is not None:
            check_writable(path)
    announce_compiling(console)
    from marl_pack import feed  # slow to import

    feeding, refused = feed.Feed(chosen), 0
    try:
        if conveyor:
            refused = feed.pack_conveyor(feeding, sys.stdin, sys.stdout)
        else:
            feed.pack_file(feeding, console)
    finally:
        if feeding.times:
            feed.show(feeding, console)
    if chosen.picture is not None:
        feed.save_picture(feeding, console)
    return refused


def main(arguments: Sequence[str] | None = None, program: str = PROGRAM) -> int:
    """Run the command ``marl-pack pack``; return its exit status."""
    options = parser(program)
    chosen = options.parse_args(arguments)
    try:
        refused = run(chosen)
    except KeyboardInterrupt:
        options.exit(130, f"{options.prog}: interrupted")
    except (ValueError, OSError, ModuleNotFoundError) as error:
        options.exit(2, f"{options.prog}: {error}")
    if refused:
        options.exit(2, f"{options.prog}: {refused} lines were refused; the answers say why")
    return 0


if __name__ == "__main__":
    sys.exit(main())
