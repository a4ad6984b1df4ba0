"""Draw utilization against items and time of learning: ``python -m experiments.learning_curve``.

The program reads the evaluations of runs (a run's folder, or a file such as models/rs.csv). It
draws two panels, with a line and its 95 % interval for each run. Without runs, it draws both
pictures of the docs, and stores each run's first, best and last evaluation, and when ``rs`` was
clearly above other policies.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from benchmarks.record import ROOT, Results, record, reported
from experiments.packing import SETS
from experiments.rows import main_of
from marl_pack.files import moved_into_place

MODELS = ROOT / "models"
OTHERS = ("cut_1", "cut_2", "types125", "rs_upright", "types125_upright")

CPUS = {"rs": "Intel Xeon with AVX-512"}
"""The CPU of each run that was not trained on ``CPU``."""
CPU = "AMD EPYC"


def history(run: Path) -> Any:
    """Return the rows of a run's evaluations, as a structured array."""
    path = run if run.is_file() else run / "evaluations.csv"
    return np.atleast_1d(np.genfromtxt(path, delimiter=",", names=True, dtype=float))


def name_of(run: Path) -> str:
    """Return the name of a run's row."""
    return run.stem if run.is_file() else run.name


def levels() -> dict[str, float]:
    """Return the utilization of other policies on the published RS sequences, in per cent.

    Raises:
        ValueError: if a policy has not been measured; names the command.
    """
    results = Results("packing")
    ours = {
        name: 100 * results.row(f"--policy {name} {SETS['RS']}")["utilization"]
        for name in ("max_feasible", "dblf", "random")
    }
    return {"Zhou et al. 2024": reported()["packing"][0]["RS"], **ours}


def draw(runs: Iterable[Path], path: Path, others: Mapping[str, float]) -> None:
    """Draw a line with its 95 % interval for each run, over items and over minutes."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(10, 4), sharey=True, layout="constrained")
    for run in runs:
        rows = history(run)
        for panel, x in zip(panels, (rows["items"] / 1e6, rows["seconds"] / 60), strict=True):
            panel.plot(x, 100 * rows["utilization"], label=name_of(run))
            panel.fill_between(x, 100 * rows["low"], 100 * rows["high"], alpha=0.2)
    for panel, label in zip(panels, ("million items", "minutes on one core"), strict=True):
        for name, level in others.items():
            panel.axhline(level, color="grey", linewidth=0.8, linestyle="--")
            panel.annotate(f"{name} {level:.1f}", (1, level), xycoords=("axes fraction", "data"),
                           ha="right", va="bottom", fontsize=8, color="grey")  # fmt: skip
        panel.set_xlabel(label)
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("utilization, %")
    panels[0].legend(loc="lower right", bbox_to_anchor=(1, 0.1))
    with moved_into_place(path) as part:
        figure.savefig(part, dpi=120)


def figures(run: Path, others: Mapping[str, float]) -> dict[str, Any]:
    """Return a run's first, best and last evaluation, and when it was clearly above others."""
    rows = history(run)

    def point(row: Any) -> dict[str, float]:
        half = float(row["high"] - row["low"]) / 2
        return {"items": int(row["items"]), "minutes": float(row["seconds"]) / 60,
                "utilization": float(row["utilization"]), "half": half}  # fmt: skip

    above = {}
    for name, level in others.items():
        passed = rows[100 * rows["low"] > level]
        above[name] = point(passed[0]) if len(passed) else None
    best = rows[np.argmax(rows["utilization"])]
    return {"episodes": int(rows["episodes"][0]), "above": above, "first": point(rows[0]),
            "best": point(best), "end": point(rows[-1])}  # fmt: skip


def main() -> int:
    """Draw the pictures and store the figures; return the exit status."""
    options = argparse.ArgumentParser(prog="python -m experiments.learning_curve")
    options.add_argument("runs", nargs="*", type=Path, help="folders of runs, or CSV files")
    options.add_argument("--picture", type=Path, default=Path("learning_curve.png"),
                         help="picture of the runs")  # fmt: skip
    chosen = options.parse_args()
    if chosen.runs:
        draw(chosen.runs, chosen.picture, {})
        for run in chosen.runs:
            print(run, figures(run, {}))
        return 0
    others = levels()
    on_rs = [MODELS / "rs.csv", MODELS / "plain.csv"]
    draw(on_rs, ROOT / "docs" / "learning_curve.png", others)
    rest = [MODELS / f"{name}.csv" for name in OTHERS]
    draw(rest, ROOT / "docs" / "learning_curve_others.png", {})
    results = Results("learning_curve")
    for run in (*on_rs, *rest):
        own = figures(run, others if run in on_rs else {})
        made = record("python -m experiments.learning_curve", cpu=CPUS.get(run.stem, CPU))
        results.put(run.stem, own, made)
    return 0


if __name__ == "__main__":
    sys.exit(main_of(main))
