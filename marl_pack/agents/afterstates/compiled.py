"""Afterstates in compiled loops, in as many threads as torch uses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from marl_pack.agents.afterstates import bitboards
from marl_pack.agents.afterstates.limits import SHARES, STEPS, SURFACE
from marl_pack.bins import Bins
from marl_pack.geometry.compiled import place_box
from marl_pack.installation import njit
from marl_pack.stability import hull_compiled

AT_ONCE = 1 << 20
"""Number of cells of the masks that are computed at once."""
PER_THREAD = 256
"""Smallest number of placements for which several threads share the work."""
WORD = 64
"""Number of bits of a word in a set of boxes; a set has two words."""


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


def compute_compiled(
    bins: Bins,
    sides: Tensor,
    mask: Tensor,
    lengths: tuple[int, ...],
    heights: Sequence[int] | None = None,
    count_cells: Callable[..., None] | None = None,
) -> tuple[Tensor, ...]:
    """Compute the tensors of :func:`marl_pack.agents.afterstates.afterstates.afterstates_of`.

    Args:
        bins, sides, mask, lengths, heights: as for that function.
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
    tensors = (torch.from_numpy(array) for array in (index, counts, surface, waste))
    return *tensors, volume, bins.filled[placements[:, 0]] + volume


@njit(cache=True, nogil=True)
def _write_map(values: Any, index: Any, mask: Any, chosen: Any) -> None:
    """Write ``values[index]`` to the flat array ``chosen`` where the flat mask is true."""
    for k in range(chosen.size):
        if mask[k]:
            chosen[k] = values[index[k]]


def map_compiled(values: Tensor, index: Tensor, mask: Tensor, elsewhere: float) -> Tensor:
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
        The boxes as sets of bits, uint64 [I, 2]: bit b of word a is entry 64 · a + b of a row of
        the counts. And the number of items int64 [I] with each set.
    """
    boxes = np.arange(lengths**3).reshape(lengths, lengths, lengths)
    sets = Counter(
        sum({1 << int(boxes[tuple(item[a] for a in row)]) for row in axes})
        for item in product(range(lengths), repeat=3)
    )
    words = [[bits & (1 << WORD) - 1, bits >> WORD] for bits in sets]
    return np.array(words, np.uint64), np.array([*sets.values()])


@njit(cache=True, nogil=True)
def _share_feasible(counts: Any, boxes: Any, items: Any, share: Any) -> None:
    """Write the share of items that have a feasible cell in at least one orientation.

    Args:
        counts: int32 [K, L³].
        boxes: uint64 [I, 2], see :func:`_groups`.
        items: int64 [I], how many items become these boxes.
        share: float64 [K], written.
    """
    entries = counts.shape[1]
    for k in range(counts.shape[0]):
        low, high = np.uint64(0), np.uint64(0)
        for box in range(min(entries, WORD)):
            low |= np.uint64(counts[k, box] != 0) << np.uint64(box)
        for box in range(WORD, entries):
            high |= np.uint64(counts[k, box] != 0) << np.uint64(box - WORD)
        feasible = 0
        for i in range(boxes.shape[0]):
            feasible += items[i] if boxes[i, 0] & low | boxes[i, 1] & high else 0
        share[k] = feasible / entries


def probability_compiled(counts: Tensor, axes: list[tuple[int, int, int]]) -> Tensor:
    """Compute the share of boxes with a feasible cell, float64 [K], in compiled loops."""
    share = np.empty(len(counts))
    _share_feasible(counts.flatten(1).numpy(), *_groups(counts.shape[1], tuple(axes)), share)
    return torch.from_numpy(share)
