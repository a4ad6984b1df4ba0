"""What each placement would leave for what may come next.

For every legal window of the visible item, the item is set down there in thought and ``hull_alpha``
asked where the boxes that may come next could then stand: every box whose sides are of given
lengths. From how many cells each of them has comes in how many it may be set down in the mean, and
how probable it is that the next item finds a place at all, each box as probable as the other.

On the CPU compiled loops in as many threads as torch has, elsewhere tensor code; both give the same
numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from marl_pack.agents.afterstates import bitboards
from marl_pack.bins import ORIENTATIONS, Bins, compiled, footprint
from marl_pack.stability import hull_cpu, hull_torch

MOST_LENGTHS = 5
"""Of so many lengths of a side boxes are made at most."""
SHARES = 10
"""Heights are told apart by tenths of the bin's."""
STEPS = 6
"""So many kinds of steps between neighbouring columns are told apart."""
SURFACE = SHARES + 1 + STEPS
"""Numbers that :attr:`Afterstates.surface` has for each placement."""
AT_ONCE = 1 << 20  # cells of masks made at once
WORTH_A_THREAD = 256  # placements


def probe_lengths(shortest: int, longest: int) -> tuple[int, ...]:
    """At most :data:`MOST_LENGTHS` lengths from ``shortest`` to ``longest``, evenly spread."""
    count = min(MOST_LENGTHS, longest - shortest + 1)
    return tuple(round(x) for x in np.linspace(shortest, longest, count))


@dataclass(frozen=True)
class Afterstates:
    """What K legal placements would leave. Placements that are the same may share a row."""

    index: Tensor  # int64 [N, A, W, D]   row of each legal placement; elsewhere of any
    counts: Tensor  # int32 [K, L, L, L]  cells where each box could be set down: w, d, h
    surface: Tensor  # float32 [K, 17]    share of the columns on each tenth of the bin's height,
    # and of the neighbours that differ by so many tenths of it, the last by so many or more
    volume: Tensor  # int64 [K]           of the box set down, in cells
    waste: Tensor  # int64 [K]            cells that it would enclose
    filled: Tensor  # int64 [K]           cells filled in the bin with it

    def of(self, which: Tensor) -> Afterstates:
        """The same of the bins ``which``, int64 [B]; their placements' rows stay where they are."""
        return replace(self, index=self.index[which])

    def room(self) -> Tensor:
        """The mean number of cells where a box that may come could be set down, float32 [K]."""
        boxes = self.counts[:1].numel() or 1
        return (self.counts.flatten(1).sum(1).double() / boxes).float()

    def chance(self, orientations: Sequence[int]) -> Tensor:
        """The probability that the next item finds a place, float32 [K].

        Args:
            orientations: indices into :data:`marl_pack.bins.ORIENTATIONS` in which it may be set
                down.
        """
        if compiled(self.counts.device):
            chance = np.empty(len(self.counts), np.float32)
            ways = np.array([ORIENTATIONS[o] for o in orientations])
            _chance(self.counts.numpy(), ways, chance)
            return torch.from_numpy(chance)
        found = self.counts > 0
        inverse = [sorted(range(3), key=ORIENTATIONS[o].__getitem__) for o in orientations]
        turned = [found.permute(0, *(1 + axis for axis in axes)) for axes in inverse]
        return torch.stack(turned).any(0).flatten(1).float().mean(1)

    def spread(self, values: Tensor, mask: Tensor, elsewhere: float = 0.0) -> Tensor:
        """Numbers [K] as a map [N, A, W, D]: where the mask is false, ``elsewhere``."""
        if not len(values):
            return torch.full(mask.shape, elsewhere, dtype=values.dtype, device=values.device)
        return torch.where(mask, values[self.index], elsewhere)


def afterstates_of(bins: Bins, sides: Tensor, mask: Tensor, lengths: Sequence[int]) -> Afterstates:
    """What each legal placement would leave.

    Args:
        bins: N bins.
        sides: int16 [N, A, 3], the item's sides along x, y, z in A orientations.
        mask: bool [N, A, W, D], where it may be set down.
        lengths: ascending; what may come next has sides of these L lengths.
    """
    code = _left_cpu if compiled(bins.device) else _left_torch
    return code(bins, sides, mask, tuple(lengths))


# --- compiled -------------------------------------------------------------------------------------


@njit(cache=True, inline="always")
def _same(sides: Any, b: int, a: int, e: int) -> bool:
    return bool(
        sides[b, a, 0] == sides[b, e, 0]
        and sides[b, a, 1] == sides[b, e, 1]
        and sides[b, a, 2] == sides[b, e, 2]
    )


@njit(cache=True, nogil=True)
def _placements(mask: Any, sides: Any, index: Any) -> Any:
    """Bin, orientation and cell of every legal placement, int64 [K, 4], once if alike.

    Args:
        index: int64 [N, A, W, D], written where the mask is true: each placement's row.
    """
    n, ways, width, depth = mask.shape
    found = np.empty((mask.size, 4), np.int64)
    k = 0
    for b in range(n):
        for a in range(ways):
            twin = a
            for e in range(a - 1, -1, -1):
                if _same(sides, b, a, e):
                    twin = e
            for x in range(width):
                for y in range(depth):
                    if not mask[b, a, x, y]:
                        continue
                    if twin < a and mask[b, twin, x, y]:
                        index[b, a, x, y] = index[b, twin, x, y]
                        continue
                    found[k, 0], found[k, 1], found[k, 2], found[k, 3] = b, a, x, y
                    index[b, a, x, y] = k
                    k += 1
    return found[:k]


@njit(cache=True, nogil=True)
def _set_down(
    heightmap: Any, empty_map: Any, sides: Any, placements: Any, heights: Any, hollow: Any
) -> None:
    """The maps after each placement [K, W, D]."""
    width, depth = heightmap.shape[1:]
    for k in range(placements.shape[0]):
        b, a, x, y = placements[k, 0], placements[k, 1], placements[k, 2], placements[k, 3]
        w, d, h = sides[b, a, 0], sides[b, a, 1], sides[b, a, 2]
        z = 0
        for i in range(x, x + w):
            for j in range(y, y + d):
                z = max(z, heightmap[b, i, j])
        for i in range(width):
            for j in range(depth):
                heights[k, i, j], hollow[k, i, j] = heightmap[b, i, j], empty_map[b, i, j]
        for i in range(x, x + w):
            for j in range(y, y + d):
                hollow[k, i, j] += z - heightmap[b, i, j]
                heights[k, i, j] = z + h


@njit(cache=True, nogil=True)
def _describe(
    heights: Any, hollow: Any, before: Any, height: int, surface: Any, waste: Any
) -> None:
    """Surface and waste of each placement.

    Args:
        heights, hollow: int16 [K, W, D], after it.
        before: int64 [K], cells of ``hollow`` before it, over the whole floor.
        height: H.
        surface, waste: as in :class:`Afterstates`, written.
    """
    width, depth = heights.shape[1:]
    columns = np.float32(width * depth)
    pairs = np.float32(max(1, (width - 1) * depth + width * (depth - 1)))
    for k in range(heights.shape[0]):
        surface[k] = 0
        empty = 0
        for i in range(width):
            for j in range(depth):
                level = heights[k, i, j]
                empty += hollow[k, i, j]
                surface[k, level * SHARES // height] += 1
                if i:
                    step = abs(level - heights[k, i - 1, j]) * SHARES // height
                    surface[k, SHARES + 1 + min(step, STEPS - 1)] += 1
                if j:
                    step = abs(level - heights[k, i, j - 1]) * SHARES // height
                    surface[k, SHARES + 1 + min(step, STEPS - 1)] += 1
        surface[k, : SHARES + 1] /= columns
        surface[k, SHARES + 1 :] /= pairs
        waste[k] = empty - before[k]


@njit(cache=True, nogil=True)
def _count(masks: Any, best_level: Any, lengths: Any, fitting: Any, counts: Any) -> None:
    """What :func:`marl_pack.agents.afterstates.bitboards.judge` says, from masks.

    Args:
        masks, best_level: [K, L · L, W · D], of boxes of the least height on each footprint.
        lengths, fitting, counts: as there.
    """
    for k in range(masks.shape[0]):
        counts[k] = 0
        for p in range(masks.shape[1]):
            for c in range(masks.shape[2]):
                if masks[k, p, c]:
                    for tall in range(fitting[best_level[k, p, c] >> 1]):
                        counts[k, p // lengths.size, p % lengths.size, tall] += 1


@njit(cache=True, nogil=True)
def _chance(counts: Any, ways: Any, chance: Any) -> None:
    """:meth:`Afterstates.chance` with ``ways`` int64 [O, 3], the orientations' rows."""
    lengths = counts.shape[1]
    item = np.empty(3, np.int64)
    items = lengths**3
    for k in range(counts.shape[0]):
        found = 0
        for i in range(items):
            item[0], item[1], item[2] = i // lengths**2, i // lengths % lengths, i % lengths
            for a in range(ways.shape[0]):
                if counts[k, item[ways[a, 0]], item[ways[a, 1]], item[ways[a, 2]]]:
                    found += 1
                    break
        chance[k] = found / items


@cache
def _workers(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "room")


def _left_cpu(bins: Bins, sides: Tensor, mask: Tensor, lengths: tuple[int, ...]) -> Afterstates:
    own, legal = np.ascontiguousarray(sides.numpy()), np.ascontiguousarray(mask.numpy())
    index = np.zeros(mask.shape, np.int64)
    placements = _placements(legal, own, index)
    count, reach, shape = len(placements), np.array(lengths), bins.size[:2]
    free = bins.height - np.arange(bins.height + 1)
    fitting = (reach <= free[:, None]).sum(1)
    heightmap, empty_map = bins.heightmap.numpy(), bins.empty_map.numpy()
    counts = np.empty((count, *[len(lengths)] * 3), np.int32)
    surface, waste = np.empty((count, SURFACE), np.float32), np.empty(count, np.int64)
    empty = empty_map.sum((1, 2), dtype=np.int64)[placements[:, 0]]
    footprints = np.array([(w, d, lengths[0]) for w, d in product(lengths, repeat=2)], np.int16)
    threads = torch.get_num_threads() if count >= WORTH_A_THREAD else 1
    small = bitboards.hold(*shape)
    fit_at_once = AT_ONCE // (shape[0] * shape[1] * (1 if small else len(footprints)))
    most = max(1, min(-(-count // threads), fit_at_once))

    def judge(start: int) -> None:
        part = slice(start, start + most)
        some = placements[part]
        maps = np.empty((2, len(some), *shape), np.int16)
        _set_down(heightmap, empty_map, own, some, maps[0], maps[1])
        _describe(maps[0], maps[1], empty[part], bins.height, surface[part], waste[part])
        if small:
            bitboards.judge(heightmap, empty_map, own, some, reach, fitting, counts[part])
        else:
            _count(*_masks(maps, footprints, bins.height), reach, fitting, counts[part])

    if threads == 1:
        for start in range(0, count, most):
            judge(start)
    else:
        list(_workers(threads).map(judge, range(0, count, most)))
    volume = torch.from_numpy(own[placements[:, 0], placements[:, 1]].prod(1, dtype=np.int64))
    return Afterstates(
        torch.from_numpy(index), torch.from_numpy(counts), torch.from_numpy(surface), volume,
        torch.from_numpy(waste), bins.filled[placements[:, 0]] + volume,
    )  # fmt: skip


def _masks(maps: Any, footprints: Any, height: int) -> tuple[Any, Any]:
    """Masks uint8 [K, F, W · D] of boxes on the footprints, and the K under them, of maps after."""
    n, *shape = maps[0].shape
    masks = np.empty((n, len(footprints), *shape), np.uint8)
    levels = np.empty((n, *shape), hull_cpu.level_dtype(height))
    best_level = np.empty(masks.shape, levels.dtype)
    boxes = np.tile(footprints, (n, 1, 1))
    hull_cpu.hull_mask(maps[0], maps[1], boxes, height, levels, masks, best_level)
    return masks.reshape(n, len(footprints), -1), best_level.reshape(n, len(footprints), -1)


# --- tensor code ----------------------------------------------------------------------------------


def _left_torch(bins: Bins, sides: Tensor, mask: Tensor, lengths: tuple[int, ...]) -> Afterstates:
    width, depth, height = bins.size
    device = bins.device
    boxes = torch.tensor(list(product(lengths, repeat=3)), dtype=torch.int16, device=device)
    placements = mask.nonzero()
    index = (mask.flatten().cumsum(0) - 1).clamp(min=0).view(mask.shape)
    at_once = AT_ONCE if device.type == "cpu" else AT_ONCE << 6
    counts, surface, waste = [], [], []
    for some in torch.split(placements, max(1, at_once // (len(boxes) * width * depth))):
        b, a, x, y = some.T
        box = sides[b, a]
        window = footprint(width, depth, box, x * depth + y)
        heights = bins.heightmap[b]
        rest = torch.where(window, heights, 0).flatten(1).amax(1)
        gap = torch.where(window, rest[:, None, None] - heights, 0)
        top = (rest + box[:, 2]).to(heights.dtype)
        after = torch.where(window, top[:, None, None], heights)
        legal = hull_torch.support_mask(
            after, (bins.empty_map[b] + gap).to(torch.int16),
            boxes.expand(len(some), -1, -1).contiguous(), height, None, 0.0,
        )  # fmt: skip
        counts.append(legal.sum((2, 3), dtype=torch.int32))
        surface.append(_surface(after.long(), height))
        waste.append(gap.sum((1, 2), dtype=torch.int64))
    volume = sides[placements[:, 0], placements[:, 1]].long().prod(1)
    return Afterstates(
        index, torch.cat(counts).view(-1, *[len(lengths)] * 3), torch.cat(surface), volume,
        torch.cat(waste), bins.filled[placements[:, 0]] + volume,
    )  # fmt: skip


def _surface(heights: Tensor, height: int) -> Tensor:
    """:attr:`Afterstates.surface` of maps int64 [K, W, D]."""
    steps = [heights.diff(dim=axis).abs().flatten(1) for axis in (1, 2)]
    step = (torch.cat(steps, 1) * SHARES // height).clamp(max=STEPS - 1)
    share = (heights * SHARES // height).flatten(1)
    kinds = torch.arange(max(SHARES + 1, STEPS), device=heights.device)[:, None, None]
    shares = (share == kinds[: SHARES + 1]).sum(2).T / share.shape[1]
    return torch.cat((shares, (step == kinds[:STEPS]).sum(2).T / max(1, step.shape[1])), 1)
