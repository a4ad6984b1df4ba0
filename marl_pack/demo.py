"""Pack a pallet of realistic cases, and open the replay in the browser.

``marl-pack demo`` draws an order of carton cases, packs it box by box onto a EUR pallet, and writes
the plan and the replay page.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from marl_pack.checks import LARGEST_SEED, whole_number
from marl_pack.files import check_writable
from marl_pack.options import MM_POLICIES
from marl_pack.replay.command import open_page, write_page
from marl_pack.terminal import Parser, announce_compiling, make_console, make_progress

PROGRAM = "python -m marl_pack.demo"
BIN_MM = (1200, 800, 1500)
"""A EUR pallet, and 1.5 m of height."""
MARGIN_MM = 20.0
BUDGET = "budget=100ms"
FLOORS = ((600, 400), (400, 300), (400, 200), (300, 200), (300, 200), (200, 200))
"""Nominal lengths and widths of cases in millimetres: parts of a EUR pallet (ISO 3394)."""
HEIGHTS = (120, 160, 200, 240, 280)
"""Heights of cases in millimetres."""
GAP_MM = 5
"""How much shorter and narrower than nominal a case is, in millimetres."""
DENSITY = (120.0, 320.0)
"""Lowest and highest weight of a case for its volume, in kg/m³."""
LINES, MOST_BOXES = 9, 1000
"""Products in an order, and the largest number of boxes."""


def draw_cases(count: int, seed: int = 0) -> list[dict[str, Any]]:
    """Draw an order of cases, in the order in which a conveyor brings them.

    A product is one size of case. Its cases come one after the other, in a few groups, and stay
    upright.

    Args:
        count: number of cases.
        seed: seed of the draw.

    Returns:
        For each case the arguments of :meth:`marl_pack.packer.packer.Packer.place`.
    """
    generator = np.random.default_rng(seed)
    products = []
    for line in range(LINES):
        length, width = FLOORS[generator.integers(len(FLOORS))]
        sides = (length - GAP_MM, width - GAP_MM, int(generator.choice(HEIGHTS)))
        volume = float(np.prod(sides)) * 1e-9
        weight = round(volume * float(generator.uniform(*DENSITY)), 1)
        products.append((f"P{line + 1}", sides, weight))
    cases: list[dict[str, Any]] = []
    while len(cases) < count:
        name, sides, weight = products[generator.integers(LINES)]
        for _ in range(min(int(generator.integers(2, 7)), count - len(cases))):
            number = f"{name}-{sum(case['id'].startswith(f'{name}-') for case in cases) + 1}"
            cases.append({"sides": sides, "id": number, "weight": weight, "upright": True})
    return cases


def parser(program: str = PROGRAM) -> Parser:
    """Return the parser of the command's options."""
    options = Parser(
        prog=program, usage=f"{program} [OPTIONS]", description=__doc__.split("\n\n")[0],
        examples=("", "--boxes 100 --seed 3", "--policy search --no-open"),
    )  # fmt: skip
    add = options.add_argument
    add("--boxes", type=int, default=60, metavar="N", help="number of cases (default: 60)")
    add("--policy", choices=(*MM_POLICIES, "search"), default="linear",
        help="what chooses the places; search takes 0.1 s a box (default: linear)")  # fmt: skip
    add("--seed", type=int, default=0, help="seed of the cases (default: 0)")
    add("--out", type=Path, default=Path("demo.html"), metavar="FILE",
        help="the page (.html); the plan is written beside it, with the ending .json; files that "
             "are there already are replaced (default: demo.html)")  # fmt: skip
    add("--no-open", action="store_true", help="do not open the page in the browser")
    return options


def run(chosen: argparse.Namespace, console: Console) -> None:
    """Pack the cases, and write and open the page.

    Raises:
        ValueError, OSError: if an option is wrong; says what would be right.
    """
    whole_number(chosen.boxes, "--boxes", 1, MOST_BOXES)
    whole_number(chosen.seed, "--seed", 0, LARGEST_SEED)
    if chosen.out.suffix.lower() != ".html":
        raise ValueError(f"--out {chosen.out}: needs the ending .html")
    plan_path = chosen.out.with_suffix(".json")
    for path in (chosen.out, plan_path):
        check_writable(path)
    announce_compiling(console)
    from marl_pack.packer.packer import Packer  # slow to import

    packer = Packer(
        BIN_MM, chosen.policy, margin_mm=MARGIN_MM, bins=None, explain=True, seed=chosen.seed,
        plan=BUDGET if chosen.policy == "search" else None,
    )  # fmt: skip
    cases = draw_cases(chosen.boxes, chosen.seed)
    with make_progress(console) as bar:
        task = bar.add_task("cases", total=len(cases))
        for case in cases:
            packer.place(**case)
            bar.advance(task)
    plan = packer.plan
    plan.to_json(plan_path)
    write_page(chosen.out, plan, f"{len(plan)} cases, packed by {chosen.policy}")
    filled = ", ".join(f"{share:.0%}" for share in packer.state.utilization)
    console.print(f"{len(plan)} cases; filled share of each pallet: {filled}")
    console.print(f"plan: {plan_path}\npage: {chosen.out}", soft_wrap=True)
    if not chosen.no_open:
        open_page(chosen.out, console)


def main(arguments: Sequence[str] | None = None, program: str = PROGRAM) -> int:
    """Run the command ``marl-pack demo``; return its exit status."""
    options = parser(program)
    chosen = options.parse_args(arguments)
    try:
        run(chosen, make_console())
    except KeyboardInterrupt:
        options.exit(130, f"{options.prog}: interrupted")
    except (ValueError, OSError) as error:
        options.exit(2, f"{options.prog}: {error}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
