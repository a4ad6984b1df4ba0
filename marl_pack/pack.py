"""Pack boxes of true sizes, from a file or from a conveyor, and write the plan.

``marl-pack pack boxes.csv --bin-mm 1200 800 1500 --out plan.json`` packs a file. ``marl-pack pack -``
reads one box a line from standard input, and answers each line before it reads the next one.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from rich.console import Console
from rich.table import Table

from marl_pack import published
from marl_pack.checks import LARGEST_SEED, whole_number
from marl_pack.exact.spec import ExactSpec
from marl_pack.exact.streams import read_orders
from marl_pack.files import Growing, check_writable
from marl_pack.items.generated import no_such_file
from marl_pack.option_record import add_arguments, given_options
from marl_pack.options import MM_POLICIES
from marl_pack.packer.answers import NoPlace, Placement
from marl_pack.packer.calls import goods_of
from marl_pack.packer.conveyor import Arrival, Refused, of_line, of_orders
from marl_pack.packer.reasons import why_not
from marl_pack.plan import Plan
from marl_pack.plan_archive import check_ending, save_plan
from marl_pack.terminal import Parser, announce_compiling, make_console, make_progress

PROGRAM = "python -m marl_pack.pack"
NEXT_BIN, SKIP, STOP = "next-bin", "skip", "stop"
NO_PLACE = (NEXT_BIN, SKIP, STOP)
SHOWN = 20  # boxes without a place that are listed
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
             "try (default: budget=500ms,top=16)")  # fmt: skip
    add("--catalogue", type=Path, metavar="FILE",
        help="a file of goods from which the search draws the boxes to come (default: those shown "
             "so far)")  # fmt: skip
    add("--grid-mm", type=float, metavar="MM",
        help="edge of the cells on which agents see the bin (default: a tenth of its longer side)")
    add("--seed", type=int, default=0, help="seed of random and search (default: 0)")
    add = options.add_argument_group("bins").add_argument
    add("--bins", type=int, metavar="N",
        help="largest number of bins (default: as many as are needed)")
    add("--no-place", choices=NO_PLACE, default=NEXT_BIN,
        help="what to do with a box that has no place in the open bin: open the next one "
             "(default), leave the box out, or stop")  # fmt: skip
    add("--present", type=Path, metavar="FILE",
        help="a plan of one bin (.json or .csv): boxes that are in the first bin already")
    add_arguments(
        options.add_argument_group("game in millimetres"), ExactSpec, leave_out=("alpha", "beta")
    )
    add = options.add_argument_group("output").add_argument
    add("--out", type=Path, metavar="FILE",
        help="write the plan to this .json, .csv or .npz file while boxes are packed")
    add("--state", type=Path, metavar="FILE",
        help="with -: save the packer to this .json file before each answer; if the file exists, "
             "go on from there")  # fmt: skip
    return options


class Run:
    """A packer that is fed box after box, and the files that it keeps.

    Args:
        chosen: the parsed options.
    """

    def __init__(self, chosen: argparse.Namespace) -> None:
        from marl_pack.packer.packer import Packer  # slow to import

        self.chosen = chosen
        spec = ExactSpec.of(given_options(chosen, ExactSpec))
        arguments: dict[str, Any] = {
            "spec": spec, "policy": chosen.policy, "plan": chosen.plan,
            "catalogue": chosen.catalogue, "grid_mm": chosen.grid_mm, "seed": chosen.seed,
            "bins": chosen.bins, "open_next": chosen.no_place == NEXT_BIN,
        }  # fmt: skip
        if chosen.present is not None:
            if not chosen.present.is_file():
                raise FileNotFoundError(f"--present {chosen.present}: no such file")
            read = Plan.from_csv if chosen.present.suffix == ".csv" else Plan.from_json
            arguments["present"] = read(chosen.present)
        self.packer = Packer(**arguments)
        if chosen.state is not None and chosen.state.exists():
            saved = Packer.restore(chosen.state)
            if saved.spec != spec or saved.arguments != self.packer.arguments:
                raise ValueError(f"--state {chosen.state}: was saved with other options")
            self.packer = saved
        self.times: list[float] = []  # seconds of each answer
        self.stopped = False
        _warm_up(arguments)

    def step(self, arrival: Arrival) -> Placement | NoPlace:
        """Place a box, or do what the options ask for if it has no place."""
        start = time.perf_counter()
        box = {"order": arrival.order, **arrival.attributes}
        answer = self.packer.place(arrival.sides, **box)
        if not answer:
            self.stopped = self.chosen.no_place == STOP
            if not self.stopped:
                self.packer.skip(arrival.sides, **box)
        self.times.append(time.perf_counter() - start)
        return answer


def _warm_up(arguments: dict[str, Any]) -> None:
    """Run all code once, so that the first box does not wait while it is compiled or loaded."""
    from marl_pack.packer.packer import Packer

    plan = {"plan": "budget=1ms"} if arguments["plan"] or arguments["policy"] == "search" else {}
    packer = Packer(**{**arguments, **plan})
    side = min(packer.spec.bin_mm) // 3 or min(packer.spec.bin_mm)
    for _ in range(3):
        packer.place((side, side, side), weight=1.0)
    why_not(packer.bin, goods_of((side, side, side), {}, packer.spec))
    packer.state, packer.plan  # noqa: B018  # read for what they compile


def pack_file(run: Run, console: Console) -> None:
    """Pack the boxes of a file, with a progress bar."""
    path = Path(run.chosen.boxes)
    if not path.is_file():
        raise no_such_file(str(path))
    boxes = list(of_orders(read_orders(path, run.packer.spec)))
    growing = Growing(run.chosen.out, save_plan)
    with growing, make_progress(console) as bar:
        task = bar.add_task("boxes", total=len(boxes))
        growing.update(run.packer.plan)
        for arrival in boxes:
            run.step(arrival)
            if run.stopped:
                break
            growing.update(run.packer.plan)
            bar.advance(task)


def pack_conveyor(run: Run, lines: Iterable[str], output: TextIO) -> int:
    """Answer each line of a conveyor before the next one is read.

    The plan and the state are written before the answer, so a program that is killed has forgotten
    no answer.

    Args:
        run: the packer.
        lines: one box a line.
        output: gets one answer a line.

    Returns:
        The number of lines that were refused.
    """
    refused = 0
    out, state = run.chosen.out, run.chosen.state
    if out is not None:
        save_plan(out, run.packer.plan)
    for number, text in enumerate(lines, 1):
        start = time.perf_counter()
        arrival = of_line(text, number, run.packer.spec)
        if arrival is None:
            continue
        if isinstance(arrival, Refused):
            refused += 1
            answer: dict[str, Any] = {"line": number, "error": arrival.reason}
        else:
            answer = {"line": number, **run.step(arrival).to_dict()}
            if out is not None:
                save_plan(out, run.packer.plan)
            if state is not None:
                run.packer.save(state)
            run.times[-1] = time.perf_counter() - start
            answer["ms"] = round(1000 * run.times[-1], 3)
        output.write(json.dumps(answer) + "\n")
        output.flush()
        if run.stopped:
            break
    return refused


def show(run: Run, console: Console) -> None:
    """Print what was packed, and what had no place and why."""
    state, orders = run.packer.state, run.packer.orders
    table = Table()
    columns = ["bin", "boxes", "utilization", "fill to the top", "weight", "height"]
    for column in [*columns[:1], *(["order"] if any(orders) else []), *columns[1:]]:
        table.add_column(column, justify="right")
    area = run.packer.spec.bin_mm[0] * run.packer.spec.bin_mm[1]
    volume = area * run.packer.spec.bin_mm[2]
    for k, boxes in enumerate(run.packer.packed):
        top = max((box.placement.z + box.placement.h for box in boxes), default=0.0)
        fill = state.utilization[k] * volume / (area * top) if top else 0.0
        row = [
            str(state.boxes[k]), f"{state.utilization[k]:.1%}", f"{fill:.1%}",
            f"{state.weight[k]:.1f} kg", f"{top:g} mm",
        ]  # fmt: skip
        table.add_row(str(k), *([orders[k]] if any(orders) else []), *row)
    console.print(f"{run.chosen.policy}, {run.packer.spec}", soft_wrap=True)
    console.print(table)
    words = [f"{sum(state.boxes)} boxes in {state.bins} bins"]
    if state.least_margin is not None:
        words.append(f"least margin {state.least_margin:g} mm")
    if run.times:
        times = np.array(run.times) * 1000
        words.append(f"{np.median(times):.2f} ms a box, at most {times.max():.1f} ms")
    console.print(", ".join(words), soft_wrap=True)
    left_out = state.left_out
    for box in left_out[:SHOWN]:
        sides = " x ".join(f"{side:g}" for side in box.sides)
        name = f" {box.id!r}" if box.id else ""
        console.print(f"no place: box{name} of {sides} mm: {box.reason}", soft_wrap=True)
    if len(left_out) > SHOWN:
        console.print(f"… and {len(left_out) - SHOWN} more without a place")
    if run.stopped:
        console.print("stopped at the first box without a place")
    if run.chosen.out is not None:
        console.print(f"plan: {run.chosen.out}", soft_wrap=True)


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
    for path in (chosen.out, chosen.state):
        if path is not None:
            check_writable(path)
    announce_compiling(console)
    packing, refused = Run(chosen), 0
    try:
        if conveyor:
            refused = pack_conveyor(packing, sys.stdin, sys.stdout)
        else:
            pack_file(packing, console)
    finally:
        if packing.times:
            show(packing, console)
    return refused


def main(arguments: Sequence[str] | None = None, program: str = PROGRAM) -> int:
    """Run the command ``marl-pack pack``; return its exit status."""
    options = parser(program)
    chosen = options.parse_args(arguments)
    try:
        refused = run(chosen)
    except KeyboardInterrupt:
        options.exit(130, f"{options.prog}: interrupted")
    except (ValueError, OSError) as error:
        options.exit(2, f"{options.prog}: {error}")
    if refused:
        options.exit(2, f"{options.prog}: {refused} lines were refused; the answers say why")
    return 0


if __name__ == "__main__":
    sys.exit(main())
