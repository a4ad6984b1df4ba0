"""Draw utilization against items and against time: ``python -m benchmarks.learning_curve RUN …``.

Reads the runs' ``evaluations.csv`` (a run's folder, or such a file, as models/ has them) and writes
a picture; prints when each run passed the levels of others.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from benchmarks.timing import show
from marl_pack.files import moved_into_place

LEVELS = (
    ("Zhou et al. 2024", 61.2),
    ("DBLF on the same masks", 69.0),
    ("the heuristic max_feasible", 75.9),
    ("random", 45.3),
)
"""Utilization on RS in per cent: the paper's, and that of other policies in docs/results.md."""


def history(run: Path) -> Any:
    """Return the rows of a run's evaluations, as a structured array."""
    path = run if run.is_file() else run / "evaluations.csv"
    return np.atleast_1d(np.genfromtxt(path, delimiter=",", names=True, dtype=float))


def name_of(run: Path) -> str:
    """Return the name of a run's row."""
    return run.stem if run.is_file() else run.name


def draw(runs: list[Path], path: Path, levels: Sequence[tuple[str, float]]) -> None:
    """Draw two panels, over items and over minutes, a line a run with its 95 % interval."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(10, 4), sharey=True, layout="constrained")
    for run in runs:
        rows = history(run)
        for panel, x in zip(panels, (rows["items"] / 1e6, rows["seconds"] / 60), strict=True):
            panel.plot(x, 100 * rows["utilization"], label=name_of(run))
            panel.fill_between(x, 100 * rows["low"], 100 * rows["high"], alpha=0.2)
    for panel, label in zip(panels, ("million items", "minutes on one core"), strict=True):
        for name, level in levels:
            panel.axhline(level, color="grey", linewidth=0.8, linestyle="--")
            panel.annotate(f"{name} {level}", (1, level), xycoords=("axes fraction", "data"),
                           ha="right", va="bottom", fontsize=8, color="grey")  # fmt: skip
        panel.set_xlabel(label)
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("utilization, %")
    panels[0].legend(loc="lower right", bbox_to_anchor=(1, 0.1))
    with moved_into_place(path) as part:
        figure.savefig(part, dpi=120)


def main() -> None:
    """Draw the picture and print the table."""
    options = argparse.ArgumentParser(prog="python -m benchmarks.learning_curve")
    options.add_argument("runs", nargs="+", type=Path, help="runs' folders, or evaluations' files")
    options.add_argument("--picture", type=Path, default=Path("docs/learning_curve.png"))
    options.add_argument("--levels", action=argparse.BooleanOptionalAction, default=True,
                         help="show the levels of other policies on RS")  # fmt: skip
    chosen = options.parse_args()
    levels = LEVELS if chosen.levels else ()
    draw(chosen.runs, chosen.picture, levels)
    table = []
    for run in chosen.runs:
        rows = history(run)
        for name, level in levels[:-1]:
            passed = rows[100 * rows["low"] > level]
            when = ["not reached", ""]
            if len(passed):
                when = [f"{passed[0]['items']:,.0f}", f"{passed[0]['seconds'] / 60:.1f}"]
            table.append([name_of(run), f"{name}, {level} %", *when])
        last = rows[-1]
        half = 50 * (last["high"] - last["low"])
        table.append(
            [name_of(run), f"end: {100 * last['utilization']:.2f} ± {half:.2f} %",
             f"{last['items']:,.0f}", f"{last['seconds'] / 60:.1f}"]
        )  # fmt: skip
    show(
        "first evaluations clearly above levels, and the end",
        ["run", "level", "items", "minutes"],
        table,
    )


if __name__ == "__main__":
    main()
