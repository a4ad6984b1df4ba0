"""Measure the game in millimetres: ``python -m benchmarks.exact``.

Decisions per CPU second of random play and of heuristics, for one game and for 64 at once;
milliseconds of one decision; the share of the time that rules take; memory of 1,000 bins. The goods
are made-up cartons, and the three lists of real goods if ``MARL_PACK_DATA`` names their folder.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator

from benchmarks.record import Measurements
from marl_pack.exact.bins import ExactBins
from marl_pack.exact.packing import ExactPacking
from marl_pack.exact.policies import make_exact_policy
from marl_pack.exact.spec import ExactSpec
from marl_pack.exact.streams import Draws, GoodsStream, make_goods_stream

SEED = 7
REPEATS = 3
CARTONS = [
    [600, 400, 300], [600, 400, 200], [400, 300, 250], [400, 300, 150], [300, 200, 200],
    [300, 200, 120], [395, 295, 285], [585, 385, 245], [350, 250, 220], [500, 310, 180],
]  # fmt: skip
RULES = ("none", "hull_1", "hull_alpha", "lbcp")


def streams() -> Iterator[tuple[str, ExactSpec, GoodsStream, int]]:
    """Yield the name, the game, the boxes and the number of episodes of each stream."""
    spec = ExactSpec(
        bin_mm=(1200, 800, 1500), orientations=(0, 1), level_tolerance_mm=5.0, max_boxes=96
    )
    goods = make_goods_stream(CARTONS, spec).goods
    yield "cartons", spec, Draws(goods, 80, SEED), 64
    if os.environ.get("MARL_PACK_DATA"):
        from experiments.real_goods import BINS, make_stream, spec_of

        for name in BINS:
            real = spec_of(name, "--rule lbcp --level-tolerance-mm 5")
            yield name, real, *make_stream(name, real)


def rate(policy: str, spec: ExactSpec, stream: GoodsStream, games: int, episodes: int) -> float:
    """Return the decisions per CPU second while episodes are played to their end."""
    chosen = make_exact_policy(policy, SEED)
    decisions, start = 0, time.process_time()
    for first in range(0, episodes, games):
        game = ExactPacking(games, stream, spec=spec, auto_reset=False, first_episode=first)
        while game.alive.any():
            decisions += int(game.alive.sum())
            game.place(chosen(game))
    return decisions / (time.process_time() - start)


def memory(bins: int, boxes: int) -> float:
    """Return the MiB of bins with memory for so many boxes."""
    arrays = ExactBins(bins, ExactSpec(max_boxes=boxes)).state
    return sum(array.nbytes for array in arrays) / 2**20


def main() -> None:
    """Measure everything; each rate is the best of several."""
    measured = Measurements("exact", __doc__, seed=SEED)
    measured.parse()
    for name, spec, stream, episodes in streams():
        for policy in ("random", "max_contact", "linear", "dblf"):
            for games in (1, 64):
                count = min(episodes, 16 if games == 1 else 64)
                count = max(games, count - count % games)
                best = max(rate(policy, spec, stream, games, count) for _ in range(REPEATS))
                measured.keep(
                    f"{name}, {policy}, N = {games}", decisions_per_second=best,
                    ms_decision=1000 / best,
                )  # fmt: skip
        if name == "cartons":
            base = 0.0
            for rule in RULES:
                other = spec.with_options({"rule": rule})
                best = max(rate("random", other, stream, 64, 64) for _ in range(REPEATS))
                base = base or best
                measured.keep(f"{name}, random, {rule}, N = 64", decisions_per_second=best,
                              ratio_to_none=best / base)  # fmt: skip
    for boxes in (64, 96, 256):
        measured.keep(f"1,000 bins of {boxes} boxes", mib=memory(1000, boxes))


if __name__ == "__main__":
    main()
