"""Draw how well boxes are packed if more is seen: ``python -m experiments.selection_plots``.

The figures are those of the table ``selection`` (:mod:`experiments.packing`) and, for one visible
box and one bin, of the table ``packing``. ``docs/buffer.png`` has a panel for the buffer, the
preview and the open bins, and one for the time of a decision.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.ticker import MaxNLocator

from benchmarks.record import ROOT, Results
from experiments import packing
from experiments.rows import expanded, main_of
from marl_pack import evaluate
from marl_pack.files import moved_into_place

mpl.use("Agg")
from matplotlib import pyplot as plt  # after the choice of a backend without windows

PICTURE = ROOT / "docs" / "buffer.png"


@dataclass(frozen=True)
class Point:
    """A measured row: the options of its game, and what it reached."""

    policy: str
    plan: str | None
    buffer: int
    preview: int
    bins: int
    closings: int | None
    utilization: float  # %
    half: float  # half of the 95 % interval, %
    ms: float  # CPU time of a decision

    @property
    def searched(self) -> str:
        """The policy's name, with a note if it searches."""
        return self.policy if self.plan is None else f"{self.policy}, search"


def points(tables: Mapping[str, Results]) -> Iterator[Point]:
    """Yield the rows of both tables that have one bin or no policy for other items."""
    keys = [key for key in packing.TABLES["selection"] if tables["selection"].rows().get(key)]
    own = [(tables["selection"], key) for key in keys]
    one_box = [f"--policy {name} {packing.SETS['RS']}" for name in ("rs", "dblf")]
    one_box.append(f"--policy types125 {packing.SETS['125 types']}")
    for table, key in [*own, *((tables["packing"], key) for key in one_box)]:
        options = evaluate.parser().parse_args(expanded(key))
        row: dict[str, Any] = table.row(key)
        low, high = row["interval"]
        yield Point(
            options.policy[0], options.plan, options.buffer or 1, options.preview or 0,
            options.bins or 1, options.closings, 100 * row["utilization"], 50 * (high - low),
            1000 * row["cpu_seconds"] / (row["episodes"] * row["packed"]),
        )  # fmt: skip


def draw(measured: list[Point], picture: Path) -> None:
    """Draw the four panels.

    Args:
        measured: the rows.
        picture: the .png file to write.
    """
    figure, panels = plt.subplots(2, 2, figsize=(10, 7.5), layout="constrained")
    one_bin = [p for p in measured if p.closings is None]
    lines(panels[0, 0], [p for p in one_bin if p.preview == 0], "buffer", "visible boxes")
    seen = [
        p for p in one_bin
        if p.buffer == 1 and p.policy == "rs" and (p.plan or not p.preview)  # greedy: no preview
    ]  # fmt: skip
    lines(panels[0, 1], seen, "preview", "boxes of the preview, order fixed")
    lines(panels[1, 0], [p for p in measured if p.closings], "bins", "open bins")
    time = panels[1, 1]
    for name, chosen in (
        ("one visible box", [p for p in seen if p.preview == 0]),
        ("preview", [p for p in seen if p.preview]),
        ("buffer", [p for p in one_bin if p.buffer > 1 and p.policy == "rs"]),
    ):
        time.plot([p.ms for p in chosen], [p.utilization for p in chosen], "o", label=name)
        for p in chosen:
            seen_boxes = p.preview or p.buffer
            time.annotate(f" {seen_boxes}", (p.ms, p.utilization), fontsize="small")
    time.set_xscale("log")
    time.set_xlabel("ms of CPU time a decision, by rs; the numbers are k and p")
    time.legend(loc="lower center")
    for panel in panels.flat:
        panel.set_ylabel("utilization, %")
        panel.grid(alpha=0.3)
    with moved_into_place(picture) as part:
        figure.savefig(part, dpi=110)
    plt.close(figure)


def lines(panel: Any, chosen: list[Point], option: str, title: str) -> None:
    """Draw utilization against an option, the best row of each policy for each value."""
    for name in dict.fromkeys(p.searched for p in chosen):
        best: dict[int, Point] = {}
        for point in chosen:
            value = getattr(point, option)
            if point.searched == name and point.utilization > getattr(
                best.get(value), "utilization", 0.0
            ):
                best[value] = point
        values = sorted(best)
        panel.errorbar(
            values, [best[v].utilization for v in values], [best[v].half for v in values],
            marker="o", markersize=4, capsize=2, label=name,
        )  # fmt: skip
    panel.set_xlabel(title)
    panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    panel.legend()


def main() -> int:
    """Draw the picture; return the exit status."""
    options = argparse.ArgumentParser(
        prog="python -m experiments.selection_plots", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    options.add_argument("--picture", type=Path, default=PICTURE)
    chosen = options.parse_args()
    draw(list(points({name: Results(name) for name in ("selection", "packing")})), chosen.picture)
    print(chosen.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main_of(main))
