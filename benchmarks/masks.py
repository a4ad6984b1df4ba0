"""Time the masks of the stability rules: ``python -m benchmarks.masks``.

1. One mask at 120 × 120, compared with the paper's Algorithm 1 as it is printed
   (:mod:`marl_pack.stability.paper`). Its cheapest reading is timed, with a point for each cell.
   The masks are checked against the reading of marl_pack, with a square for each cell.
2. Batched masks at 10 × 10, on every device.
3. The cost for several sizes of the grid.
4. One mask from NumPy arrays by :func:`marl_pack.stable_mask`, its checks included.
5. The cost on rough maps, compared with a flat floor: single columns stand one cell higher, so most
   windows rest on a few of them and need the exact test.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from benchmarks.record import Measurements
from benchmarks.states import LARGE, SMALL, in_play, random_items
from benchmarks.timing import best_time, devices
from marl_pack.bins import empty
from marl_pack.stability import (
    RULES,
    OrientedItem,
    hull_alpha,
    hull_compiled,
    make_rule,
    orient_item,
    stable_mask,
)
from marl_pack.stability.paper import convex_hull_alpha


def against_the_literal_reading(measured: Measurements, states: int = 32) -> None:
    """Measure figure 1: one mask, compared with the literal reading of the paper."""
    size, sides = LARGE
    game = in_play(states, LARGE, steps=12)
    items = random_items(states, sides)
    heights, empty_maps = game.bins.heightmap.numpy(), game.bins.empty_map.numpy()
    seconds = dict.fromkeys(("literal", "mask", "kernel", "levels"), 0.0)
    for b in range(states):
        one = torch.tensor([b])
        bins, item = game.bins[one], OrientedItem(items[one][:, None])
        sides_b = tuple(items[b].tolist())
        inputs = (heights[b], empty_maps[b], sides_b, size[2])
        exact = convex_hull_alpha(*inputs, reading="squares")
        assert (hull_alpha(bins, item)[0, 0].numpy() == exact).all()
        seconds["literal"] += best_time(lambda i=inputs: convex_hull_alpha(*i), 2)  # type: ignore[misc]  # bound now
        seconds["mask"] += best_time(lambda b=bins, i=item: hull_alpha(b, i))  # type: ignore[misc]  # bound now
        levels = np.empty((1, *size[:2]), hull_compiled.level_dtype(size[2]))
        out = np.empty((1, 1, *size[:2]), np.uint8)
        maps = bins.heightmap.numpy(), bins.empty_map.numpy()
        arguments = (*maps, item.sides.numpy(), size[2], levels, out, levels[:0, None])
        seconds["kernel"] += best_time(lambda a=arguments: hull_compiled.central_masks(*a))  # type: ignore[misc]  # bound now
        flat = (*(m.ravel() for m in maps), levels.ravel())
        seconds["levels"] += best_time(lambda a=flat: hull_compiled.fill_levels(*a))  # type: ignore[misc]  # bound now
    mean = {name: value / states for name, value in seconds.items()}
    mean["alone"] = mean["kernel"] - mean["levels"]
    for what, name in (
        ("literal Algorithm 1 with OpenCV", "literal"),
        ("hull_alpha, prepared once a placement", "alone"),
        ("hull_alpha, preparation included", "kernel"),
        ("hull_alpha, preparation and Python call included", "mask"),
    ):
        measured.keep(
            f"one mask: {what}", us=1e6 * mean[name], times_faster=mean["literal"] / mean[name]
        )


def batched(measured: Measurements, n: int = 1024) -> None:
    """Measure figure 2: the batched masks of every rule."""
    for device in devices():
        game = in_play(n, SMALL, device=device)
        item = game.orient_item(game.items)
        for name in RULES:
            rule = make_rule(name)
            seconds = best_time(
                lambda r=rule, g=game, i=item: r(g.bins, i),  # type: ignore[misc]  # bound now
                5,
                device,
            )
            measured.keep(f"batched: {name}, {device}", masks_per_second=6 * n / seconds)


def scaling(measured: Measurements) -> None:
    """Measure figure 3: the cost of masks for several sizes of the grid.

    The items grow with the bin: their sides are from a fifth to a half of its side.
    """
    for side in (10, 20, 40, 80, 160):
        place = ((side, side, side), (side // 5, side // 2))
        n = max(8, 4096 * 100 // side**2)
        game = in_play(n, place, steps=20)
        item = orient_item(game.items.sides)
        seconds = best_time(lambda g=game, i=item: hull_alpha(g.bins, i), 5)  # type: ignore[misc]  # bound now
        each = seconds / (6 * n)
        measured.keep(f"grid: {side} × {side}", us=1e6 * each, ns_cell=1e9 * each / side**2)


def from_arrays(measured: Measurements, states: int = 16) -> None:
    """Measure figure 4: one mask from NumPy arrays."""
    for place in (SMALL, LARGE):
        (width, depth, height), sides = place
        game, items = in_play(states, place, steps=12), random_items(states, sides).tolist()
        maps = [values.numpy().astype(int) for values in (game.bins.heightmap, game.bins.empty_map)]
        seconds = 0.0
        for b in range(states):
            inputs = (maps[0][b], maps[1][b], items[b], height)
            seconds += best_time(lambda i=inputs: stable_mask("hull_alpha", *i))  # type: ignore[misc]  # bound now
        measured.keep(f"stable_mask: {width} × {depth}", us=1e6 * seconds / states)


def rough(measured: Measurements) -> None:
    """Measure figure 5: one mask of a rough map, compared with that of a flat floor."""
    for side in (10, 40, 120):
        n = max(4, (1 << 14) // side**2)
        length = 3 * side // 10
        generator = torch.Generator().manual_seed(1)
        high = torch.rand((n, side, side), generator=generator) < 5 / length**2
        flat = empty(n, (side, side, side), 1)
        item = OrientedItem(torch.tensor([[[length, length, 1]]]).short().expand(n, 1, 3))
        for margin in (0.0, 0.5):
            easy, hard = (
                best_time(lambda b=bins, m=margin, i=item: hull_alpha(b, i, m))  # type: ignore[misc]  # bound now
                for bins in (flat, replace(flat, heightmap=high.short()))
            )
            measured.keep(
                f"rough map: {side} × {side}, margin {margin}",
                us=1e6 * hard / n,
                times_flat_floor=hard / easy,
            )


def main() -> None:
    """Measure all figures of this benchmark."""
    measured = Measurements("masks", __doc__, seed=1)
    measured.parse()
    torch.set_num_threads(1)
    against_the_literal_reading(measured)
    batched(measured)
    scaling(measured)
    from_arrays(measured)
    rough(measured)


if __name__ == "__main__":
    main()
