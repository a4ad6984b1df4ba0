"""Compute where the next boxes could be placed after each legal placement.

The visible item is placed hypothetically at every legal cell. Then ``hull_alpha`` gives the cells
where the next box could be placed. The next boxes are all boxes whose sides have certain lengths
(:func:`probe_lengths`), and each is equally probable. The numbers of cells give the mean number of
feasible cells, and the probability that the next item has a feasible cell at all.

Compiled loops use as many threads as torch uses; tensor code computes the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, reduce
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from marl_pack.agents.afterstates import bitboards
from marl_pack.agents.afterstates.limits import MOST_LENGTHS
from marl_pack.backend import Backend
from marl_pack.bins import Bins
from marl_pack.geometry import ORIENTATIONS
from marl_pack.geometry.compiled import place_box
from marl_pack.geometry.tensor import footprint, place_boxes
from marl_pack.installation import njit
from marl_pack.stability import hull_compiled, hull_tensor

SHARES = 10
"""Number of classes of heights: tenths of the bin's height."""
STEPS = 6
"""Number of classes of steps between neighbouring columns, in tenths of the bin's height."""
SURFACE = SHARES + 1 + STEPS
"""Number of entries of :attr:`Afterstates.surface` for each placement."""
AT_ONCE = 1 << 20
"""Number of cells of the masks that are computed at once."""
CELLS_AT_ONCE = 1 << 20
"""Number of cells of the maps that tensor code computes at once on the CPU."""
MOST_WINDOW_CELLS = 256
"""Largest window whose test tensor code writes out for all its rows."""
PER_THREAD = 256
"""Smallest number of placements for which several threads share the work."""


@cache
def probe_lengths(shortest: int, longest: int) -> tuple[int, ...]:
    """Return at most :data:`MOST_LENGTHS` evenly spaced lengths from shortest to longest."""
    count = min(MOST_LENGTHS, longest - shortest + 1)
    return tuple(round(x) for x in np.linspace(shortest, longest, count))


@dataclass(frozen=True)
class Afterstates:
    """The bins after K legal placements; equal placements may share a row."""

    index: Tensor  # int64 [N, A, W, D]   row of each legal placement; elsewhere any row
    counts: Tensor  # int32 [K, L, L, L]  cells where each box could be placed: w, d, h
    surface: Tensor  # float32 [K, 17]    share of columns in each class of heights, then share of
    # pairs of neighbouring columns in each class of steps (the last class: 5 tenths or more)
    volume: Tensor  # int64 [K]           of the placed box, in cells
    waste: Tensor  # int64 [K]            empty cells that it would enclose
    filled: Tensor  # int64 [K]           filled cells of the bin, this box included
    backend: Backend  # computes the numbers that are derived from these

    def select(self, which: Tensor) -> Afterstates:
        """Return the afterstates of the bins ``which`` (indices int64 [B]); the rows stay."""
        return replace(self, index=self.index[which])

    def feasible_cells(self) -> Tensor:
        """Compute the mean number of cells where a box that may come next could be placed.

        Returns:
            float32 [K].
        """
        boxes = self.counts[:1].numel() or 1
        total = self.counts.flatten(1).sum(1, dtype=torch.int32)  # much faster than int64
        return (total.double() / boxes).float()

    def feasible_probability(self, orientation_sets: Mapping[tuple[int, ...], float]) -> Tensor:
        """Compute the probability that the next item has a feasible cell.

        Args:
            orientation_sets: which orientations (indices into
                :data:`marl_pack.geometry.ORIENTATIONS`) the next item may take, with the share of
                items that may take exactly those; the shares sum to 1.

        Returns:
            float32 [K].
        """
        code = self.backend.pick(compiled=_probability_compiled, tensor=_probability_tensor)
        rows = [[ORIENTATIONS[o] for o in orientations] for orientations in orientation_sets]
        shares = zip(rows, orientation_sets.values(), strict=True)
        probability = torch.zeros(len(self.counts), dtype=torch.float64, device=self.counts.device)
        for axes, share in shares:
            probability += share * code(self.counts, axes)
        return probability.float()

    def as_map(self, values: Tensor, mask: Tensor, elsewhere: float = 0.0) -> Tensor:
        """Return numbers [K] as a map [N, A, W, D], with ``elsewhere`` where the mask is false."""
        code = self.backend.pick(compiled=_map_compiled, tensor=_map_tensor)
        return code(values, self.index, mask, elsewhere)


def afterstates_of(
    bins: Bins,
    sides: Tensor,
    mask: Tensor,
    lengths: Sequence[int],
    heights: Sequence[int] | None = None,
) -> Afterstates:
    """Compute the afterstate of each legal placement.

    Args:
        bins: N bins.
        sides: int16 [N, A, 3], the item's sides along x, y, z in A orientations.
        mask: bool [N, A, W, D], where the item may be placed.
        lengths: the L lengths of the next boxes' sides, ascending.
        heights: their L heights, ascending; by default the same.
    """
    code = bins.backend.pick(compiled=afterstates_by_compiled_loops, tensor=_tensor)
    return code(bins, sides, mask, tuple(lengths), heights)


# --- compiled -------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _placements(mask: Any, sides: Any, heightmap: Any, index: Any) -> tuple[Any, Any]:
    """List the legal placements; equal placements are listed once.

    Args:
        mask: bool [N, A, W, D].
        sides: int16 [N, A, 3].
        heightmap: int16 [N, W, D].
        index: int64 [N, A, W, D], written where the mask is true: each placement's row.

    Returns:
        The placements int64 [K, 7], each as bin, x, y, w, d, h and resting height, and the empty
        cells int64 [K] that each box would enclose.
    """
    n, count, width, depth = mask.shape
    placements, waste = np.empty((mask.size, 7), np.int64), np.empty(mask.size, np.int64)
    k = 0
    for b in range(n):
        for a in range(count):
            equal = a
            for e in range(a - 1, -1, -1):
                if (
                    sides[b, a, 0] == sides[b, e, 0]
                    and sides[b, a, 1] == sides[b, e, 1]
                    and sides[b, a, 2] == sides[b, e, 2]
                ):
                    equal = e
            w, d, h = np.int64(sides[b, a, 0]), np.int64(sides[b, a, 1]), np.int64(sides[b, a, 2])
            for x in range(width):
                for y in range(depth):
                    if not mask[b, a, x, y]:
                        continue
                    if equal < a and mask[b, equal, x, y]:
                        index[b, a, x, y] = index[b, equal, x, y]
                        continue
                    z, below = np.int64(0), np.int64(0)
                    for i in range(x, x + w):
                        for j in range(y, y + d):
                            z = max(z, np.int64(heightmap[b, i, j]))
                            below += heightmap[b, i, j]
                    row = placements[k]
                    row[0], row[1], row[2], row[3], row[4], row[5], row[6] = b, x, y, w, d, h, z
                    waste[k] = w * d * z - below
                    index[b, a, x, y] = k
                    k += 1
    return placements[:k], waste[:k]


@njit(cache=True, inline="always")
def _step(tenths: Any, one: int, other: int) -> Any:
    """Return the entry of :attr:`Afterstates.surface` for the step between two heights."""
    return SHARES + 1 + min(tenths[abs(one - other)], STEPS - 1)


@njit(cache=True)
def _tally(
    heightmap: Any, x: int, y: int, w: int, d: int, tenths: Any, change: int, tally: Any
) -> None:
    """Add ``change`` to the entry of every column in a window and of every step at such a column.

    Args:
        heightmap: int16 [W, D].
        x, y, w, d: low corner and size of the window.
        tenths: int64 [H + 1], the class of each height.
        change: the number to add.
        tally: int64 [17], changed: how often each entry of :attr:`Afterstates.surface` occurs.
    """
    width, depth = heightmap.shape
    for i in range(x, min(x + w + 1, width)):
        for j in range(y, min(y + d + 1, depth)):
            level = heightmap[i, j]
            if i < x + w and j < y + d:
                tally[tenths[level]] += change
            if i and j < y + d:
                tally[_step(tenths, level, heightmap[i - 1, j])] += change
            if j and i < x + w:
                tally[_step(tenths, level, heightmap[i, j - 1])] += change


@njit(cache=True, nogil=True)
def _write_surfaces(heightmap: Any, placements: Any, height: int, surface: Any) -> None:
    """Write the surface after each placement as in :class:`Afterstates`.

    Args:
        heightmap: int16 [N, W, D].
        placements: int64 [K, 7], see :func:`_placements`.
        height: H.
        surface: float32 [K, 17], written.
    """
    width, depth = heightmap.shape[1:]
    columns = np.float32(width * depth)
    pairs = np.float32(max(1, (width - 1) * depth + width * (depth - 1)))
    tenths = np.arange(height + 1) * SHARES // height
    bare, tally = np.empty(SURFACE, np.int64), np.empty(SURFACE, np.int64)
    last = -1
    for k in range(len(placements)):
        b, x, y, w, d, h, z = placements[k]
        if b != last:
            last = b
            bare[:] = 0
            _tally(heightmap[b], 0, 0, width, depth, tenths, 1, bare)
        for entry in range(SURFACE):  # an assignment of arrays takes seconds to compile
            tally[entry] = bare[entry]
        # The box replaces the columns of its window, and levels the steps between them.
        _tally(heightmap[b], x, y, w, d, tenths, -1, tally)
        tally[tenths[z + h]] += w * d
        tally[SHARES + 1] += (w - 1) * d + w * (d - 1)
        for i in range(x, x + w):
            if y:
                tally[_step(tenths, z + h, heightmap[b, i, y - 1])] += 1
            if y + d < depth:
                tally[_step(tenths, z + h, heightmap[b, i, y + d])] += 1
        for j in range(y, y + d):
            if x:
                tally[_step(tenths, z + h, heightmap[b, x - 1, j])] += 1
            if x + w < width:
                tally[_step(tenths, z + h, heightmap[b, x + w, j])] += 1
        for entry in range(SURFACE):
            total = columns if entry <= SHARES else pairs
            surface[k, entry] = np.float32(tally[entry]) / total


@njit(cache=True, nogil=True)
def _count(masks: Any, best_level: Any, lengths: Any, fitting: Any, counts: Any) -> None:
    """Count the feasible cells of each box from masks of the lowest box on each footprint.

    Args:
        masks: uint8 [K, L · L, W · D].
        best_level: integers [K, L · L, W · D]; where the mask is 1, half of it (rounded down) is
            the resting height.
        lengths: int64 [L].
        fitting: int64 [H + 1], see :func:`count_by_masks`.
        counts: int32 [K, L, L, L], written.
    """
    for k in range(masks.shape[0]):
        counts[k] = 0
        for p in range(masks.shape[1]):
            for c in range(masks.shape[2]):
                if masks[k, p, c]:
                    for tall in range(fitting[best_level[k, p, c] >> 1]):
                        counts[k, p // lengths.size, p % lengths.size, tall] += 1


@njit(cache=True, nogil=True)
def _place_each(
    heightmap: Any, empty_map: Any, placements: Any, heightmaps: Any, empty_maps: Any
) -> None:
    """Write the maps after each placement.

    Args:
        heightmap: int16 [N, W, D].
        empty_map: int16 [N, W, D].
        placements: int64 [K, 7], see :func:`_placements`.
        heightmaps: int16 [K, W, D], written.
        empty_maps: int16 [K, W, D], written.
    """
    for k in range(len(placements)):
        b, x, y, w, d, h, _ = placements[k]
        heightmaps[k], empty_maps[k] = heightmap[b], empty_map[b]
        place_box(heightmaps[k], empty_maps[k], x, y, w, d, h)


def count_by_masks(
    heightmap: Any, empty_map: Any, placements: Any, lengths: Any, fitting: Any, counts: Any
) -> None:
    """Count the cells where each box could be placed after each placement, from masks.

    Args:
        heightmap: int16 [N, W, D].
        empty_map: int16 [N, W, D].
        placements: int64 [K, 7], see :func:`_placements`.
        lengths: int64 [L], ascending.
        fitting: int64 [H + 1], how many of the heights fit between each level and the bin's top.
        counts: int32 [K, L, L, L], written, for boxes lengths[i] × lengths[j] × lengths[k].
    """
    n, shape = len(placements), heightmap.shape[1:]
    height = fitting.size - 1
    maps = np.empty((2, n, *shape), np.int16)
    _place_each(heightmap, empty_map, placements, *maps)
    footprints = [(w, d, lengths[0]) for w, d in product(lengths.tolist(), repeat=2)]
    masks = np.empty((n, len(footprints), *shape), np.uint8)
    levels = np.empty((n, *shape), hull_compiled.level_dtype(height))
    best_level = np.empty(masks.shape, levels.dtype)
    boxes = np.tile(np.array(footprints, np.int16), (n, 1, 1))
    hull_compiled.central_masks(*maps, boxes, height, levels, masks, best_level)
    flat = n, len(footprints), -1
    _count(masks.reshape(flat), best_level.reshape(flat), lengths, fitting, counts)


@cache
def _workers(threads: int) -> ThreadPoolExecutor:
    """Return a pool of worker threads, one pool for each number of threads."""
    return ThreadPoolExecutor(threads, "afterstates")


def afterstates_by_compiled_loops(
    bins: Bins,
    sides: Tensor,
    mask: Tensor,
    lengths: tuple[int, ...],
    heights: Sequence[int] | None = None,
    count_cells: Callable[..., None] | None = None,
) -> Afterstates:
    """Compute :func:`afterstates_of` in compiled loops.

    Args:
        bins, sides, mask, lengths, heights: as for :func:`afterstates_of`.
        count_cells: :func:`marl_pack.agents.afterstates.bitboards.count_by_bits` or
            :func:`count_by_masks`; by default the faster function that works on the floor.
    """
    boxes, legal = np.ascontiguousarray(sides.numpy()), np.ascontiguousarray(mask.numpy())
    heightmap, empty_map = bins.heightmap.numpy(), bins.empty_map.numpy()
    index = np.zeros(mask.shape, np.int64)
    placements, waste = _placements(legal, boxes, heightmap, index)
    count, probes, shape = len(placements), np.array(lengths), bins.size[:2]
    fitting = (
        np.array(heights or lengths) <= bins.height - np.arange(bins.height + 1)[:, None]
    ).sum(1)
    counts = np.empty((count, *[len(lengths)] * 3), np.int32)
    surface = np.empty((count, SURFACE), np.float32)
    by_bits = bitboards.fit_in_words(*shape)
    if count_cells is None:
        count_cells = bitboards.count_by_bits if by_bits else count_by_masks
    threads = torch.get_num_threads() if count >= PER_THREAD else 1
    masks = 1 if count_cells is bitboards.count_by_bits else len(lengths) ** 2
    most = max(1, min(-(-count // threads), AT_ONCE // (shape[0] * shape[1] * masks)))

    def compute(start: int) -> None:
        part = slice(start, start + most)
        _write_surfaces(heightmap, placements[part], bins.height, surface[part])
        count_cells(heightmap, empty_map, placements[part], probes, fitting, counts[part])

    starts = range(0, count, most)
    list(map(compute, starts) if threads == 1 else _workers(threads).map(compute, starts))
    volume = torch.from_numpy(placements[:, 3:6].prod(1))
    return Afterstates(
        torch.from_numpy(index), torch.from_numpy(counts), torch.from_numpy(surface), volume,
        torch.from_numpy(waste), bins.filled[placements[:, 0]] + volume, bins.backend,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _write_map(values: Any, index: Any, mask: Any, chosen: Any) -> None:
    """Write ``values[index]`` to the flat array ``chosen`` where the flat mask is true."""
    for k in range(chosen.size):
        if mask[k]:
            chosen[k] = values[index[k]]


def _map_compiled(values: Tensor, index: Tensor, mask: Tensor, elsewhere: float) -> Tensor:
    """Compute :meth:`Afterstates.as_map` in a compiled loop."""
    chosen = torch.full(mask.shape, elsewhere, dtype=values.dtype)
    flat = (tensor.reshape(-1).numpy() for tensor in (index, mask, chosen))
    _write_map(values.numpy(), *flat)
    return chosen


@cache
def _groups(lengths: int, axes: tuple[tuple[int, int, int], ...]) -> tuple[Any, Any]:
    """List the boxes that an item becomes in some orientations, once for all equal lists.

    Args:
        lengths: L.
        axes: the orientations, rows of :data:`marl_pack.geometry.ORIENTATIONS`.

    Returns:
        The boxes int64 [I, O] as numbers of entries of a row of :attr:`Afterstates.counts`, and the
        number of items int64 [I] with each list.
    """
    boxes = np.arange(lengths**3).reshape(lengths, lengths, lengths)
    items = product(range(lengths), repeat=3)
    lists = [sorted(boxes[tuple(item[a] for a in row)] for row in axes) for item in items]
    return np.unique(np.array(lists, np.int64), axis=0, return_counts=True)


@njit(cache=True, nogil=True)
def _share_feasible(counts: Any, boxes: Any, items: Any, share: Any) -> None:
    """Write the share of items that have a feasible cell in at least one orientation.

    Args:
        counts: int32 [K, L³].
        boxes: int64 [I, O], see :func:`_groups`.
        items: int64 [I], how many items become these boxes.
        share: float64 [K], written.
    """
    for k in range(len(counts)):
        feasible = 0
        for i in range(len(boxes)):
            cells = 0
            for box in boxes[i]:
                cells |= counts[k, box]
            feasible += items[i] if cells else 0
        share[k] = feasible / counts.shape[1]


def _probability_compiled(counts: Tensor, axes: list[tuple[int, int, int]]) -> Tensor:
    """Compute the share of boxes with a feasible cell, float64 [K], in compiled loops."""
    share = np.empty(len(counts))
    _share_feasible(counts.flatten(1).numpy(), *_groups(counts.shape[1], tuple(axes)), share)
    return torch.from_numpy(share)


# --- tensor code ----------------------------------------------------------------------------------


def _tensor(
    bins: Bins,
    sides: Tensor,
    mask: Tensor,
    lengths: tuple[int, ...],
    heights: Sequence[int] | None = None,
) -> Afterstates:
    """Compute :func:`afterstates_of` in tensor code; the program waits for the number K once."""
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
    return Afterstates(
        index, torch.cat(counts), torch.cat(surface), volume,
        torch.cat(waste), bins.filled[placements[:, 0]] + volume, bins.backend,
    )  # fmt: skip


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


def _map_tensor(values: Tensor, index: Tensor, mask: Tensor, elsewhere: float) -> Tensor:
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


def _probability_tensor(counts: Tensor, axes: list[tuple[int, int, int]]) -> Tensor:
    """Compute the share of boxes with a feasible cell, float32 [K], in tensor code."""
    feasible = counts > 0
    inverse = [sorted(range(3), key=row.__getitem__) for row in axes]
    rotated = [feasible.permute(0, *(1 + axis for axis in row)) for row in inverse]
    return torch.stack(rotated).any(0).flatten(1).float().mean(1)
