"""Compute afterstates on large floors from samples of the columns.

The time of exact afterstates grows with the square of the number of cells. On a floor of more than
:data:`EXACT_CELLS` cells, the bin is therefore seen at every s-th column along x and y. The samples
are at most 128 columns, so that sets of them fit in two words
(:mod:`marl_pack.agents.afterstates.bitboards`). A box covers the samples in its window, and the
footprints of the next boxes are rounded up to whole steps of s cells. Heights are not rounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from marl_pack.agents.afterstates.afterstates import Afterstates, afterstates_of
from marl_pack.agents.afterstates.bitboards import fit_in_words
from marl_pack.bins import Bins
from marl_pack.geometry import resting_heights_and_waste

EXACT_CELLS = 225
"""Largest number of cells of a floor whose afterstates are computed from all columns."""


def samples(width: int, depth: int) -> tuple[range, range]:
    """Return the x and the y of the sampled columns of a floor of W × D cells."""
    step = 1
    while True:
        steps = min(step, width), min(step, depth)
        x, y = (range(s // 2, side, s) for s, side in zip(steps, (width, depth), strict=True))
        if fit_in_words(len(x), len(y)):
            return x, y
        step += 1


def _covered(cells: range, sides: Tensor, length: int) -> tuple[Tensor, Tensor]:
    """Find the samples that windows at each cell cover, along one axis.

    Args:
        cells: the sampled cells.
        sides: int64 [N, A], the windows' side.
        length: W or D, here L.

    Returns:
        The number of the first covered sample, int64 [N, A, L], and how many samples are covered
        beyond ``sides // cells.step``: 0 or 1, int64 [N, A, L].
    """
    corner = torch.arange(length, device=sides.device)
    first, end = (
        ((cell - cells.start + cells.step - 1) // cells.step).clamp(max=len(cells))
        for cell in (corner.expand(*sides.shape, -1), corner + sides[..., None])
    )
    more = end - first - (sides // cells.step)[..., None]
    return first.clamp(max=len(cells) - 1), more.clamp(0, 1)


def sampled_afterstates(
    bins: Bins, sides: Tensor, mask: Tensor, lengths: Sequence[int]
) -> Afterstates:
    """Compute the afterstate of each legal placement at the sampled columns.

    Placements that cover the same samples share a row. The arguments are those of
    :func:`marl_pack.agents.afterstates.afterstates.afterstates_of`. Counts of cells are numbers of
    samples. Volumes are exact. Of the placements that share a row, the least wasted cells count.
    """
    width, depth, _ = bins.size
    n, count = mask.shape[:2]
    xs, ys = samples(width, depth)
    maps = (
        m[:, xs.start :: xs.step, ys.start :: ys.step] for m in (bins.heightmap, bins.empty_map)
    )
    heightmap, empty_map = (values.contiguous() for values in maps)
    # An item covers a number of samples that depends on its cell: four items for each orientation.
    long = sides.long()
    (x, more_x), (y, more_y) = (
        _covered(cells, long[..., axis], length)
        for axis, (cells, length) in enumerate(((xs, width), (ys, depth)))
    )
    items = long[:, :, None].repeat(1, 1, 4, 1)
    extra = torch.arange(4, device=mask.device)
    items[..., 0] = items[..., 0] // xs.step + extra // 2
    items[..., 1] = items[..., 1] // ys.step + extra % 2
    # An item that covers no sample changes none, as a box of height 0 on one sample does.
    items[(items[..., :2] == 0).any(3)] = torch.tensor([1, 1, 0], device=mask.device)
    item = 4 * torch.arange(count, device=mask.device)[:, None] + 2 * more_x
    row = (item * len(xs) + x) * len(ys)  # [N, A, W]
    cell = (more_y * len(xs)) * len(ys) + y  # [N, A, D]
    position = (row[..., None] + cell[..., None, :]).flatten(1)
    legal = torch.zeros(n, 4 * count * len(xs) * len(ys), dtype=torch.uint8, device=mask.device)
    legal.scatter_reduce_(1, position, mask.flatten(1).byte(), "amax")
    legal = legal.bool().view(n, 4 * count, len(xs), len(ys))
    afterstates = afterstates_of(
        replace(bins, heightmap=heightmap, empty_map=empty_map),
        items.flatten(1, 2).short(),
        legal,
        [-(-length // max(xs.step, ys.step)) for length in lengths],
        lengths,
    )
    index = afterstates.index.flatten(1).gather(1, position).view(mask.shape)
    rows = index[mask]
    volume, waste = torch.empty_like(afterstates.volume), torch.empty_like(afterstates.waste)
    volume[rows] = long.prod(2)[:, :, None, None].expand(mask.shape)[mask]
    _, wasted = resting_heights_and_waste(
        bins.heightmap, sides, bins.height, waste=True, backend=bins.backend
    )
    waste.scatter_reduce_(0, rows, wasted[mask].long(), "amin", include_self=False)
    return replace(
        afterstates,
        index=index,
        volume=volume,
        waste=waste,
        filled=afterstates.filled - afterstates.volume + volume,
    )
