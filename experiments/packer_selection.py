"""Measure what a buffer, a preview and several open bins gain in millimetres.

``python -m experiments.packer_selection``. The goods, the rule and the bins are those of
:mod:`experiments.packer`. ``buffer`` rows pack one bin until no visible box has a place.
``preview`` rows do the same with one visible box and a search, whose futures begin with the boxes
of the preview; a fixed number of futures makes it independent of the speed of the machine.
``bins`` rows pack bins until so many are closed, as many for each open bin.

No weights are tuned here. Milliseconds are CPU time.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.record import record
from experiments.packer import futures_of
from experiments.real_goods import BINS, HALF, LENGTH, TUNED_FOR, make_stream, spec_of
from experiments.rows import Rows, main_of
from marl_pack.evaluation.statistics import interval
from marl_pack.exact.lengths import to_mm
from marl_pack.exact.streams import Draws
from marl_pack.packer.packer import Packer

POLICIES = ("max_contact", "linear")
BUFFERS = (1, 2, 3, 5, 10)
PREVIEWS = (0, 1, 3, 5)
OPEN_BINS = (1, 2, 3)
DRAWN_STREAMS = ("mix", "boards")
"""Goods that are drawn: any number of boxes may come."""
CLOSINGS = 5
"""Bins that are closed in an episode, for each open bin."""
MOST_BOXES = 4000
"""Boxes that come in an episode of several bins, at most."""
EPISODES = {"buffer": 60, "preview": 16, "bins": 8}
"""Episodes of a row at most, the first ones of a stream."""
FIRST = {"buffer": BUFFERS[0], "preview": PREVIEWS[0], "bins": OPEN_BINS[0]}
"""The value that others are compared with."""
PLAN = "budget=1000s,top=4,futures=4"


def pack(option: str, stream: str, policy: str, number: int, episode: int) -> tuple[Packer, float]:
    """Pack one episode.

    Args:
        option: ``buffer``, ``preview`` or ``bins``.
        stream: the goods.
        policy: a heuristic.
        number: value of the option.
        episode: number of the episode.

    Returns:
        The packer, and the seconds of CPU time.
    """
    spec = spec_of(stream, TUNED_FOR)
    source, _ = make_stream(stream, spec)
    options: dict[str, Any] = {"buffer": number}
    if option == "preview":
        futures = futures_of(stream, episode >= HALF // LENGTH)
        options = {"preview": number, "plan": PLAN, "catalogue": futures}
    elif option == "bins":
        assert isinstance(source, Draws)
        source = replace(source, length=MOST_BOXES)
        options = {"open_bins": number, "bins": number * (CLOSINGS + 1) - 1}
    packer = Packer(spec=spec, policy=policy, seed=episode, **options)
    coming = iter(source.sequence(episode).tolist())
    start = time.process_time()
    while True:
        while packer.needs_box and (row := next(coming, None)) is not None:
            weight = float(source.goods.weights[row])
            sides = to_mm(source.goods.sides[row], spec.unit_mm).tolist()
            packer.show(sides, weight=None if np.isnan(weight) else weight)
        if not packer.waiting or not packer.place_next():
            return packer, time.process_time() - start


def measure(key: str) -> dict[str, Any]:
    """Measure a row such as ``buffer mix linear 3``."""
    option, stream, policy, number = key.split()
    spec = spec_of(stream, TUNED_FOR)
    count = min(make_stream(stream, spec)[1], EPISODES[option])
    pack(option, stream, policy, int(number), 0)  # compiles the code
    shares, boxes, seconds = [], [], 0.0
    for episode in range(count):
        packer, spent = pack(option, stream, policy, int(number), episode)
        shares.append(packer.plan.utilization)
        boxes.append(len(packer.placements))
        seconds += spent
    utilization = np.array(shares)
    return {
        "episodes": count, "utilization": float(utilization.mean()),
        "interval": interval(utilization), "packed": float(np.mean(boxes)),
        "opened": packer.state.bins, "mean_ms": 1000 * seconds / sum(boxes),
        "each": [round(share, 5) for share in shares],
    }  # fmt: skip


def keys() -> Iterator[str]:
    """Yield the keys of all rows."""
    for stream in BINS:
        for policy in POLICIES:
            for k in BUFFERS:
                yield f"buffer {stream} {policy} {k}"
    for stream in DRAWN_STREAMS:
        for policy in POLICIES:
            for b in OPEN_BINS:
                yield f"bins {stream} {policy} {b}"
    for p in PREVIEWS:
        yield f"preview mix linear {p}"


def main() -> int:
    """Measure the chosen rows."""
    rows = Rows("python -m experiments.packer_selection", __doc__ or "")
    rows.parse()
    results = rows.results("packer_selection")
    for key in rows.missing(results, keys()):
        figures = measure(key)
        results.put(key, figures, record(f"python -m experiments.packer_selection --only {key}"))
        print(f"{key}: {figures['utilization']:.4f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main_of(main))
