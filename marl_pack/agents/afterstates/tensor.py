"""Afterstates in tensor code, for any device; the same numbers as in compiled loops."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, reduce
from itertools import product

import torch
from torch import Tensor

from marl_pack.agents.afterstates.limits import SHARES, STEPS
from marl_pack.bins import Bins
from marl_pack.geometry.tensor import footprint, place_boxes
from marl_pack.stability import hull_tensor

CELLS_AT_ONCE = 1 << 20
"""Number of cells of the maps that are computed at once on the CPU."""
MOST_WINDOW_CELLS = 256
"""Largest window whose test is written out for all its rows."""


def compute_tensor(
    bins: Bins,
    sides: Tensor,
    mask: Tensor,
    lengths: tuple[int, ...],
    heights: Sequence[int] | None = None,
) -> tuple[Tensor, ...]:
    """Compute the tensors of :func:`marl_pack.agents.afterstates.afterstates.afterstates_of`.

    The program waits for the device once, for the number K of placements.
    """
    width, depth, height = bins.size
    boxes = lengths, tuple(heights or lengths)
    placements = mask.nonzero()
    index = (mask.flatten().cumsum(0) - 1).clamp(min=0).view(mask.shape)
    longest = [max((i for i in lengths if i <= side), default=0) for side in (width, depth)]
    small = longest[0] * longest[1] <= MOST_WINDOW_CELLS
    count_cells = _count_by_rows if small else _count_by_masks
    at_once = CELLS_AT_ONCE if bins.device.type == "cpu" else CELLS_AT_ONCE << 8
    at_once = max(1, at_once // (width * depth * (1 if small else len(lengths) ** 2)))
    counts, surface, waste = [], [], []
    for part in torch.split(placements, at_once):
        b, a = part[:, 0], part[:, 1]
        box, heightmap, empty_map = sides[b, a], bins.heightmap[b], bins.empty_map[b]
        under = footprint(width, depth, box, part[:, 2:])
        waste.append(place_boxes(heightmap, empty_map, under, box[:, 2])[1])
        counts.append(count_cells(heightmap, empty_map, boxes, height))
        surface.append(_surface(heightmap, height))
    volume = sides[placements[:, 0], placements[:, 1]].long().prod(1)
    joined = map(torch.cat, (counts, surface, waste))
    return index, *joined, volume, bins.filled[placements[:, 0]] + volume


Boxes = tuple[tuple[int, ...], tuple[int, ...]]
"""The lengths of boxes along x and y, and their heights: each combination is a box."""


def _count_by_masks(heightmap: Tensor, empty_map: Tensor, boxes: Boxes, height: int) -> Tensor:
    """Count the cells where each box could be placed on maps [K, W, D], int32 [K, L, L, L]."""
    lengths, heights = boxes
    sides = torch.tensor(list(product(lengths, lengths, heights)), dtype=torch.int16)
    sides = sides.to(heightmap.device).expand(len(heightmap), -1, -1)
    legal, _ = hull_tensor.support_mask(heightmap, empty_map, sides, height)
    return legal.sum((2, 3), dtype=torch.int32).view(-1, *[len(lengths)] * 3)


def _count_by_rows(heightmap: Tensor, empty_map: Tensor, boxes: Boxes, height: int) -> Tensor:
    """Count as :func:`_count_by_masks` does, but without reading a window cell by cell.

    A window's middle lies strictly inside the hull of its contact cells iff each of the sets in
    :func:`_blocking_sets` contains a contact cell: the largest K
    (:mod:`marl_pack.stability.hull_compiled`) of each set is that of the window.
    """
    lengths, heights = boxes
    kind = torch.uint8 if height <= 126 else torch.int16
    level = (2 * heightmap + (empty_map == 0)).to(kind).permute(1, 2, 0).contiguous()
    width, depth, count = level.shape  # the placements are last, so that loops run along them
    counts = torch.zeros([len(lengths)] * 3 + [count], dtype=torch.int32, device=level.device)
    runs = [level]  # the largest K of 1, 2, … cells along y
    for cells in range(1, max((d for d in lengths if d <= depth), default=1)):
        runs.append(torch.maximum(runs[-1][:, :-1], level[:, cells:]))
    for (i, w), (j, d) in product(enumerate(lengths), repeat=2):
        if w > width or d > depth:
            continue
        shape = width - w + 1, depth - d + 1
        best = _largest(runs, tuple((x, 0, d) for x in range(w)), shape)
        least = reduce(
            torch.minimum, (_largest(runs, rows, shape) for rows in _blocking_sets(w, d))
        )
        stands = (least == best) & (best & 1).bool()
        for k, tall in enumerate(heights):
            if tall <= height:  # a comparison of two tensors is faster than one with a number
                low = best.clamp(max=2 * (height - tall) + 1) == best
                counts[i, j, k] = _cells(stands & low)
    return counts.permute(3, 0, 1, 2).contiguous()


def _largest(
    runs: Sequence[Tensor], rows: Sequence[tuple[int, int, int]], shape: tuple[int, int]
) -> Tensor:
    """Compute the largest K of a set of cells in each window.

    Args:
        runs: the largest K of 1, 2, … cells along y, [W, ≤ D, K] each.
        rows: the set of cells: row, first cell and number of cells of each run.
        shape: number of windows along x and y.
    """
    parts = (runs[cells - 1][x : x + shape[0], y : y + shape[1]] for x, y, cells in rows)
    return reduce(torch.maximum, parts)


@cache
def _blocking_sets(w: int, d: int) -> tuple[tuple[tuple[int, int, int], ...], ...]:
    """Find the sets of cells of a w × d window without which its middle is not inside a hull.

    For a line through the middle, these are the cells that reach over it to one side. If no cell of
    such a set is in contact, all contact lies on the other side. It is enough to know the smallest
    sets; their lines go through corners of cells.

    Returns:
        The sets; each as rows of adjacent cells: row, first cell, number of cells.
    """
    corners = product(range(-w, w + 1, 2), range(-d, d + 1, 2))  # from the middle, in half cells
    sets = set()
    for x, y in corners:
        for a, b in ((-y, x), (y, -x)):  # a cell reaches to the side (a, b) by its last corner
            cells = [
                (i, j)
                for i, j in product(range(w), range(d))
                if a * (2 * i + 1 - w) + b * (2 * j + 1 - d) + abs(a) + abs(b) > 0
            ]
            sets.add(frozenset(cells))
    sets.discard(frozenset())
    smallest = [cells for cells in sets if not any(other < cells for other in sets)]
    runs = []
    for part in smallest:
        of_row = {i: [j for x, j in part if x == i] for i, _ in part}
        runs.append(tuple((i, min(js), len(js)) for i, js in sorted(of_row.items())))
    return tuple(sorted(runs))


def map_tensor(values: Tensor, index: Tensor, mask: Tensor, elsewhere: float) -> Tensor:
    """Compute :meth:`Afterstates.as_map` in tensor code."""
    if not len(values):
        return torch.full(mask.shape, elsewhere, dtype=values.dtype, device=values.device)
    return torch.where(mask, values[index], elsewhere)


def _surface(heights: Tensor, height: int) -> Tensor:
    """Compute :attr:`Afterstates.surface` of maps int16 [K, W, D]."""
    maps = heights.to(torch.uint8 if height <= 255 else torch.int16).permute(1, 2, 0).contiguous()
    pairs = (maps[1:], maps[:-1]), (maps[:, 1:], maps[:, :-1])
    steps = [torch.maximum(*pair) - torch.minimum(*pair) for pair in pairs]
    shares = []
    for values, classes in (([maps], SHARES + 1), (steps, STEPS)):
        cells = max(1, sum(part.shape[0] * part.shape[1] for part in values))
        lowest = [-(-k * height // SHARES) for k in range(classes)]  # of each class
        above = torch.zeros(len(heights), classes + 1, device=maps.device)  # in a higher class
        for k, low in enumerate(lowest):
            for part in values:
                above[:, k] += _cells(part.clamp(min=low) == part)
        shares.append((above[:, :-1] - above[:, 1:]) / cells)
    return torch.cat(shares, 1)


def _cells(which: Tensor) -> Tensor:
    """Count the true cells of maps [W, D, K], int32 [K]."""
    small = which.shape[0] * which.shape[1] <= 255  # bytes are added many times faster
    return which.view(torch.uint8).sum((0, 1), dtype=torch.uint8 if small else torch.int32).int()


def probability_tensor(counts: Tensor, axes: list[tuple[int, int, int]]) -> Tensor:
    """Compute the share of boxes with a feasible cell, float32 [K], in tensor code."""
    feasible = counts > 0
    inverse = [sorted(range(3), key=row.__getitem__) for row in axes]
    rotated = [feasible.permute(0, *(1 + axis for axis in row)) for row in inverse]
    return torch.stack(rotated).any(0).flatten(1).float().mean(1)
