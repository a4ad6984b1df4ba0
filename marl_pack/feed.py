"""Feed boxes to a packer from a file or a conveyor, and print what was packed."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from rich.console import Console
from rich.table import Table

from marl_pack.agents.sources import is_own
from marl_pack.exact.spec import ExactSpec
from marl_pack.exact.streams import read_orders
from marl_pack.files import Growing
from marl_pack.items.generated import no_such_file
from marl_pack.option_record import given_options
from marl_pack.options import NEXT_BIN, STOP
from marl_pack.packer.answers import NoPlace, Placement, Waiting
from marl_pack.packer.conveyor import Arrival, Refused, of_line, of_orders
from marl_pack.packer.packed import Packed
from marl_pack.packer.packer import Packer
from marl_pack.packer.warming import warm_up
from marl_pack.plan import Plan
from marl_pack.plan_archive import save_plan
from marl_pack.terminal import make_progress

SHOWN = 20  # boxes without a place that are listed
TINY = 10  # times that the longest side of all boxes goes into the bin's shortest: a wrong unit?


class Feed:
    """A packer that is fed box after box, and the files that it keeps.

    Args:
        chosen: the parsed options.
    """

    def __init__(self, chosen: argparse.Namespace) -> None:
        self.chosen = chosen
        spec = ExactSpec.of(given_options(chosen, ExactSpec))
        arguments: dict[str, Any] = {
            "spec": spec, "policy": chosen.policy, "plan": chosen.plan,
            "catalogue": None if chosen.catalogue is None else str(chosen.catalogue),
            "grid_mm": chosen.grid_mm, "seed": chosen.seed,
            "bins": chosen.bins, "open_next": chosen.no_place == NEXT_BIN,
            "buffer": chosen.buffer, "preview": chosen.preview, "open_bins": chosen.open_bins,
            "explain": chosen.explain,
        }  # fmt: skip
        if chosen.present is not None:
            if not chosen.present.is_file():
                raise FileNotFoundError(f"--present {chosen.present}: no such file")
            read = Plan.from_csv if chosen.present.suffix == ".csv" else Plan.from_json
            arguments["present"] = read(chosen.present)
        self.packer = Packer(**arguments)
        if chosen.state is not None and chosen.state.exists():
            own = {"policy": chosen.policy} if is_own(chosen.policy) else {}
            saved = Packer.restore(chosen.state, **own)
            same = saved.spec == spec and saved.arguments == self.packer.arguments
            if not (same and saved.present.same(self.packer.present)):
                raise ValueError(f"--state {chosen.state}: was saved with other options")
            self.packer = saved
        self.times: list[float] = []  # seconds of each decision
        self.lines: dict[int, int] = {}  # the line of each box that was shown
        self.stopped = False
        warm_up(arguments)

    def take(self, arrival: Arrival, line: int = 0) -> Iterator[Waiting | Placement | NoPlace]:
        """Yield the answers that become possible with a box; each is done when it is yielded.

        With a buffer or a preview the first answer says that the box waits, or why it never has a
        place.

        Args:
            arrival: the box.
            line: its line.
        """
        box = {"order": arrival.order, **arrival.attributes}
        if self.chosen.buffer == 1 and not self.chosen.preview:
            yield self._timed(
                lambda: self.packer.place(arrival.sides, **box),
                lambda: self.packer.skip(arrival.sides, **box),
            )
            return
        yield from self._possible()  # a run that was killed may have left some
        if self.stopped:
            return
        answer = self.packer.show(arrival.sides, **box)
        if isinstance(answer, Waiting):
            self.lines[answer.number] = line
            yield answer
        else:
            yield self._timed(lambda: answer, lambda: self.packer.skip(arrival.sides, **box))
        yield from self._possible()

    def _possible(self) -> Iterator[Placement | NoPlace]:
        """Yield the answers that need no further box."""
        while not self.stopped and not self.packer.needs_box:
            yield self._next()

    def rest(self) -> Iterator[Placement | NoPlace]:
        """Yield the answers for the boxes that still wait; no more boxes come."""
        while not self.stopped and self.packer.waiting:
            yield self._next()

    def _next(self) -> Placement | NoPlace:
        return self._timed(self.packer.place_next, self.packer.skip_next)

    def _timed(
        self, place: Callable[[], Placement | NoPlace], skip: Callable[[], NoPlace]
    ) -> Placement | NoPlace:
        """Place a box, or do what the options ask for if it has no place; keep the time."""
        start = time.perf_counter()
        answer = place()
        if not answer:
            self.stopped = self.chosen.no_place == STOP
            if not self.stopped:
                skip()
        self.times.append(time.perf_counter() - start)
        return answer


def pack_file(feed: Feed, console: Console) -> None:
    """Pack the boxes of a file, with a progress bar."""
    path = Path(feed.chosen.boxes)
    if not path.is_file():
        raise no_such_file(str(path), in_mm=True)
    boxes = list(of_orders(read_orders(path, feed.packer.spec)))
    growing = Growing(feed.chosen.out, save_plan)
    with growing, make_progress(console) as bar:
        task = bar.add_task("boxes", total=len(boxes))
        growing.update(feed.packer.plan)
        for arrival in boxes:
            for _ in feed.take(arrival):
                growing.update(feed.packer.plan)
            if feed.stopped:
                break
            bar.advance(task)
        for _ in feed.rest():
            growing.update(feed.packer.plan)


def pack_conveyor(feed: Feed, lines: Iterable[str], output: TextIO) -> int:
    """Answer each line of a conveyor before the next one is read.

    The plan and the state are written before each answer, so a program that is killed has forgotten
    no answer, and no box that waits.

    Args:
        feed: the packer.
        lines: one box a line.
        output: gets one answer a line.

    Returns:
        The number of lines that were refused.
    """
    refused = 0
    if feed.chosen.out is not None:
        save_plan(feed.chosen.out, feed.packer.plan)
    for number, text in enumerate(lines, 1):
        start = time.perf_counter()
        arrival = of_line(text, number, feed.packer.spec)
        if arrival is None:
            continue
        if isinstance(arrival, Refused):
            refused += 1
            _write(output, {"line": number, "error": arrival.reason})
        else:
            _answer(feed, feed.take(arrival, number), number, start, output)
        if feed.stopped:
            break
    _answer(feed, feed.rest(), None, time.perf_counter(), output)
    return refused


def _answer(
    feed: Feed, answers: Iterable[Waiting | Placement | NoPlace], line: int | None, start: float,
    output: TextIO,
) -> None:  # fmt: skip
    """Write answers, each after the plan and the state.

    Args:
        feed: the packer.
        answers: what it answers.
        line: the line that was read; None: the input has ended.
        start: the time at which the first answer was begun.
        output: gets the answers. The line of an answer is that of its box; null if an earlier run
            read it.
    """
    out, state = feed.chosen.out, feed.chosen.state
    for answer in answers:
        content = answer.to_dict()
        of_box = line if answer.number is None else feed.lines.get(answer.number)
        if out is not None:
            save_plan(out, feed.packer.plan)
        if state is not None:
            feed.packer.save(state)
        if not isinstance(answer, Waiting):
            feed.times[-1] = time.perf_counter() - start
            content["ms"] = round(1000 * feed.times[-1], 3)
        _write(output, {"line": of_box, **content})
        start = time.perf_counter()


def _write(output: TextIO, content: dict[str, Any]) -> None:
    """Write one answer as a line of JSON."""
    output.write(json.dumps(content) + "\n")
    output.flush()


def save_picture(feed: Feed, console: Console) -> None:
    """Draw the bins, or how they were packed."""
    from marl_pack.render.animation import Film, save_film

    path = feed.chosen.picture
    film = Film(feed.packer.plan, feed.chosen.policy)
    with make_progress(console) as bar:
        task = bar.add_task("pictures", total=1 if path.suffix.lower() == ".png" else len(film))
        save_film(path, film, progress=lambda: bar.advance(task))
    console.print(f"picture: {path}", soft_wrap=True)


def _count(number: int, one: str, many: str) -> str:
    """Return a number with its noun."""
    return f"{number} {one if number == 1 else many}"


def _weight(kilograms: float, boxes: Sequence[Packed]) -> str:
    """Return the known weight of a bin, and how many weights are unknown."""
    unknown = sum(bool(np.isnan(box.item.weights[0])) for box in boxes)
    return f"{kilograms:.1f} kg" + (f", {unknown} unknown" if unknown else "")


def show(feed: Feed, console: Console) -> None:
    """Print what was packed, and what had no place and why."""
    state, orders = feed.packer.state, feed.packer.orders
    table = Table()
    columns = ["bin", "boxes", "utilization", "fill to the top", "weight", "height"]
    for column in [*columns[:1], *(["order"] if any(orders) else []), *columns[1:]]:
        table.add_column(column, justify="right")
    area = feed.packer.spec.bin_mm[0] * feed.packer.spec.bin_mm[1]
    volume = area * feed.packer.spec.bin_mm[2]
    for k, boxes in enumerate(feed.packer.packed):
        top = max((box.placement.z + box.placement.h for box in boxes), default=0.0)
        fill = state.utilization[k] * volume / (area * top) if top else 0.0
        row = [
            str(state.boxes[k]), f"{state.utilization[k]:.1%}", f"{fill:.1%}",
            _weight(state.weight[k], boxes), f"{top:g} mm",
        ]  # fmt: skip
        table.add_row(str(k), *([orders[k]] if any(orders) else []), *row)
    console.print(f"{feed.chosen.policy}, {feed.packer.spec}", soft_wrap=True)
    console.print(table)
    words = [f"{_count(sum(state.boxes), 'box', 'boxes')} in {_count(state.bins, 'bin', 'bins')}"]
    if state.least_margin is not None:
        words.append(f"least margin {state.least_margin:g} mm")
    if feed.times:
        times = np.array(feed.times) * 1000
        words.append(f"{np.median(times):.2f} ms a box, at most {times.max():.1f} ms")
    console.print(", ".join(words), soft_wrap=True)
    longest = [max(p.w, p.d, p.h) for p in feed.packer.placements]
    if longest and max(longest) * TINY < min(feed.packer.spec.bin_mm):
        console.print(f"all boxes are shorter than {max(longest):g} mm: are their sizes in mm?")
    left_out = state.left_out
    for box in left_out[:SHOWN]:
        sides = " x ".join(f"{side:g}" for side in box.sides)
        name = f" {box.id!r}" if box.id else ""
        console.print(f"no place: box{name} of {sides} mm: {box.reason}", soft_wrap=True)
    if len(left_out) > SHOWN:
        console.print(f"… and {len(left_out) - SHOWN} more without a place")
    if feed.stopped:
        console.print("stopped at the first box without a place")
    if feed.chosen.out is not None:
        console.print(f"plan: {feed.chosen.out}", soft_wrap=True)
