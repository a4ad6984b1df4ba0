"""Judge packings of real goods in physics: ``python -m experiments.real_cell``.

``strict`` judges exact sizes after each placement. The other rows are trials of a real cell
(:mod:`marl_pack.sapien_check.trials`) on an open pallet: errors of place and size, a tilt and a
shake. The packings are those of :mod:`experiments.real_goods`. Packings on whole cells are built
with the true sizes: each box keeps its corner and rests on what is really under it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np

from benchmarks.record import record
from experiments.real_goods import BINS, play, play_cells
from experiments.rows import Rows, main_of
from marl_pack.evaluation.statistics import share_interval, strict_equilibrium
from marl_pack.plan import Plan
from marl_pack.sapien_check.bodies import Bodies
from marl_pack.sapien_check.judge import judge_all
from marl_pack.sapien_check.stack import DENSITY
from marl_pack.sapien_check.trials import Trial, TrialResult, run_trials

TRIALS = {
    "place 2 mm, size 1 %": Trial(place_error=0.002, yaw=0.3, drop=0.002, size_error=0.01),
    "place 2 mm": Trial(place_error=0.002, yaw=0.3, drop=0.002),
    "place 5 mm": Trial(place_error=0.005, yaw=0.7, drop=0.005),
    "tilt 3°": Trial(tilt=3.0),
    "shake 0.2 g": Trial(shake=0.2, frequency=2.0),
}
"""The trials by name; the yaw is in degrees."""
STRICT = "strict"
ALL = (STRICT, "place 2 mm, size 1 %")
"""By these all packings are judged; by the other trials at most :data:`MOST` of a stream."""
MOST = {"cases": 20, "mix": 100, "boards": 100}
SOUND = {
    "margin 0": "--rule lbcp",
    "margin 20 mm": "--rule lbcp --margin-mm 20",
    "margin 0, tolerance 5 mm": "--rule lbcp --level-tolerance-mm 5",
    "margin 20 mm, tolerance 5 mm": "--rule lbcp --margin-mm 20 --level-tolerance-mm 5",
}
"""Settings of packings that are also judged at their exact sizes."""
SETTINGS = {
    "cells of 5 mm": "cells of 5 mm",
    "cells of 60 mm": "cells of 60 mm",
    **SOUND,
    "margin 40 mm": "--rule lbcp --margin-mm 40",
    "margin 20 mm, clearance 5 mm": "--rule lbcp --margin-mm 20 --clearance-mm 5",
    "margin 40 mm, clearance 10 mm": "--rule lbcp --margin-mm 40 --clearance-mm 10",
}
"""Settings of the trials: options of exact games (``max_contact``), or cells (``dblf``)."""


def keys() -> Iterator[str]:
    """Yield the keys of all rows: stream / setting / trial."""
    for stream in BINS:
        for setting in SOUND:
            yield f"{stream} / {setting} / {STRICT}"
    for trial in TRIALS:
        for setting in SETTINGS:
            for stream in BINS:
                yield f"{stream} / {setting} / {trial}"


@cache
def plans_of(stream: str, setting: str) -> list[Plan]:
    """Return the packings of a stream."""
    options = SETTINGS[setting]
    if options.startswith("cells"):
        plans = play_cells(stream, "dblf", int(options.split()[2])).plans
        return [settled(plan) for plan in plans]
    return play(stream, "max_contact", options).plans


def settled(plan: Plan) -> Plan:
    """Return a plan in which each box rests on the highest true top under it."""
    from marl_pack.exact.reference import resting_height

    boxes = plan.boxes.astype(np.int64)
    for i in range(len(boxes)):
        x, y, _, w, d, _ = boxes[i].tolist()
        boxes[i, 2] = resting_height(boxes[:i].tolist(), x, y, w, d)
    return Plan.of_boxes(
        plan.bin_sizes[0].tolist(), boxes, orientations=plan.orientations, unit_mm=plan.unit_mm
    )


def bodies_of(stream: str) -> Bodies:
    """Return the masses: the weights of the picks, or equal densities."""
    return Bodies() if stream == "cases" else Bodies(density=(DENSITY, DENSITY))


def measure(key: str) -> dict[str, Any]:
    """Measure one row."""
    stream, setting, name = key.split(" / ")
    plans = plans_of(stream, setting)
    plans = plans if name in ALL else plans[: MOST[stream]]
    stacks = list(bodies_of(stream).stacks(plans, range(len(plans))))
    figures: dict[str, Any] = {
        "packings": len(plans),
        "planned": float(np.mean([plan.utilization for plan in plans])),
    }
    if name == STRICT:
        judged = list(judge_all(stacks))
        return figures | {
            "placements": sum(each.placements for each in judged),
            "falls": sum(each.fall is not None for each in judged),
            "no_verdict": sum(each.error is not None for each in judged),
            "in_equilibrium": float(np.mean([strict_equilibrium(plan) for plan in plans])),
            "seconds": sum(each.seconds for each in judged),
        }
    numbered = [(stack, episode, 0) for episode, stack in enumerate(stacks)]
    outcomes = list(run_trials(numbered, TRIALS[name]))
    results = [each for each in outcomes if isinstance(each, TrialResult)]
    collapses = sum(each.collapse is not None for each in results)
    low, high = share_interval(collapses, len(results))
    return figures | {
        "results": len(results),
        "no_result": len(outcomes) - len(results),
        "collapses": collapses,
        "low": low,
        "high": high,
        "boxes": sum(each.inserted + len(each.left_out) for each in results),
        "left_out": sum(len(each.left_out) for each in results),
        "in_physics": float(np.mean([each.in_physics for each in results])) if results else None,
        "seconds": sum(each.seconds for each in results),
    }


def main() -> int:
    """Measure the chosen rows."""
    rows = Rows("python -m experiments.real_cell", __doc__ or "")
    rows.parse()
    results = rows.results("real_cell")
    for key in rows.missing(results, keys()):
        figures = measure(key)
        results.put(key, figures, record(f"python -m experiments.real_cell # {key}"))
        print(f"{key}: {figures}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main_of(main))
