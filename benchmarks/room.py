"""Time the afterstates of all legal placements: ``python -m benchmarks.room``.

The bins are partly filled by random play. For every legal placement of the visible items, the code
counts the cells in which each of the next boxes could be placed. Three codes are timed: sets of
cells as bits (floors of up to 128 cells), compiled masks, and tensor code. Then whole decisions are
timed on a large floor, where the agents see samples of the columns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

from benchmarks.record import Measurements
from benchmarks.timing import best_time, devices
from marl_pack.agents.afterstates.afterstates import afterstates_of, probe_lengths
from marl_pack.agents.afterstates.bitboards import fit_in_words
from marl_pack.agents.afterstates.compiled import compute_compiled, count_by_masks
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.player import load
from marl_pack.backend import Backend
from marl_pack.game.packing import Packing


def seconds(code: Callable[..., object], game: Packing, backend: Backend, device: str) -> float:
    """Return the seconds that one call takes for the visible items of a game."""
    bins = replace(game.bins.to(device), backend=backend)
    sides = game.orient_item(game.items).sides.to(device)
    mask, lengths = game.mask.to(device), probe_lengths(*game.stream.sides)
    return best_time(lambda: code(bins, sides, mask, lengths), 5, device)


def main() -> None:
    """Time the afterstates for two sizes of the bin, and decisions on a large floor."""
    measured = Measurements("room", __doc__, seed=1)
    measured.parse()
    torch.set_num_threads(1)
    for n, size, sides in ((64, (10, 10, 10), (2, 5)), (8, (20, 20, 20), (4, 10))):
        game = Packing(n, size, sides=sides, seed=1)
        policy = make_policy("random", seed=1)
        for _ in range(6):
            game.place(*policy(game))
        placements = len(Lookahead().afterstates(game).counts)
        by_masks = partial(compute_compiled, count_cells=count_by_masks)
        masks = seconds(by_masks, game, Backend.COMPILED, "cpu")
        timings = [("compiled masks", "cpu", masks)]
        if fit_in_words(*size[:2]):
            bits = seconds(afterstates_of, game, Backend.COMPILED, "cpu")
            timings.insert(0, ("sets of bits", "cpu", bits))
        for device in devices():
            time = seconds(afterstates_of, game, Backend.TENSOR, device)
            timings.append(("tensor code", device, time))
        for name, device, time in timings:
            measured.keep(
                f"{size[0]}³, sides {sides[0]}–{sides[1]}: {name}, {device}",
                us_placement=1e6 * time / placements,
                us_item=1e6 * time / n,
                times_compiled_masks=masks / time,
            )
    game = Packing(1, (120, 100, 100), sides=(20, 50), seed=1)
    for _ in range(5):
        game.place(*make_policy("dblf")(game))
    one = torch.tensor([0])
    for name in ("max_feasible", "rs"):
        player = load(name)
        time = best_time(lambda p=player: p(game.branch(one)), 5)  # type: ignore[misc]  # bound now
        measured.keep(f"a decision on 120 × 100 cells: {name}", ms=1e3 * time)


if __name__ == "__main__":
    main()
