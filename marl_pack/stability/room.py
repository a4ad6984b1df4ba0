"""How much room each placement would leave for what may come next.

For every legal window of the visible item, the item is set down there in thought and ``hull_alpha``
asked where the boxes that may come next could then stand. Two numbers come of it: in how many cells
such a box may be set down in the mean, and how probable it is that the next item finds a place at
all. What may come is every box whose sides are of given lengths, each as probable as the other.

On the CPU compiled loops in as many threads as torch has, elsewhere tensor code; both give the same
numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from marl_pack.bins import ORIENTATIONS, Bins, compiled, footprint
from marl_pack.stability import bitboards, hull_cpu, hull_torch

MOST_LENGTHS = 5
"""Of so many lengths of a side boxes are made at most."""
AT_ONCE = 1 << 20  # cells of masks made at once
WORTH_A_THREAD = 256  # placements


def probe_lengths(shortest: int, longest: int) -> tuple[int, ...]:
    """At most :data:`MOST_LENGTHS` lengths from ``shortest`` to ``longest``, evenly spread."""
    count = min(MOST_LENGTHS, longest - shortest + 1)
    return tuple(round(x) for x in np.linspace(shortest, longest, count))


def room_left(
    bins: Bins,
    sides: Tensor,
    mask: Tensor,
    lengths: Sequence[int],
    orientations: Sequence[int] = tuple(range(len(ORIENTATIONS))),
) -> tuple[Tensor, Tensor]:
    """What each legal placement would leave.

    Args:
        bins: N bins.
        sides: int16 [N, A, 3], the item's sides along x, y, z in A orientations.
        mask: bool [N, A, W, D], where it may be set down.
        lengths: ascending; what may come next has sides of these lengths.
        orientations: indices into :data:`marl_pack.bins.ORIENTATIONS` in which the next item may be
            set down.

    Returns:
        float32 [N, A, W, D], the mean number of cells where a box that may come could be set down
        after this placement; and float32 [N, A, W, D], the probability that the next item finds a
        place. 0 where the mask is false.
    """
    code = _room_cpu if compiled(bins.device) else _room_torch
    return code(bins, sides, mask, tuple(lengths), tuple(orientations))


# --- compiled -------------------------------------------------------------------------------------


@njit(cache=True, inline="always")
def _same(sides: Any, b: int, a: int, e: int) -> bool:
    return bool(
        sides[b, a, 0] == sides[b, e, 0]
        and sides[b, a, 1] == sides[b, e, 1]
        and sides[b, a, 2] == sides[b, e, 2]
    )


@njit(cache=True, nogil=True)
def _placements(mask: Any, sides: Any) -> Any:
    """Bin, orientation and cell of every legal placement, int64 [K, 4], once if alike."""
    n, ways, width, depth = mask.shape
    found = np.empty((mask.size, 4), np.int64)
    k = 0
    for b in range(n):
        for a in range(ways):
            for x in range(width):
                for y in range(depth):
                    wanted = mask[b, a, x, y]
                    for e in range(a):
                        wanted &= not (mask[b, e, x, y] and _same(sides, b, a, e))
                    if wanted:
                        found[k, 0], found[k, 1], found[k, 2], found[k, 3] = b, a, x, y
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
def _judge(
    masks: Any, best_level: Any, lengths: Any, fitting: Any, cells: Any, tallest: Any
) -> None:
    """What :func:`marl_pack.stability.bitboards.judge` says, from masks.

    Args:
        masks, best_level: [K, L · L, W · D], of boxes of the least height on each footprint.
        lengths, fitting, cells, tallest: as there.
    """
    for k in range(masks.shape[0]):
        total = 0
        for p in range(masks.shape[1]):
            most = 0
            for c in range(masks.shape[2]):
                if masks[k, p, c]:
                    fit = fitting[best_level[k, p, c] >> 1]
                    total += fit
                    most = max(most, fit)
            tallest[k, p // lengths.size, p % lengths.size] = most
        cells[k] = total


@njit(cache=True, nogil=True)
def _chance(tallest: Any, ways: Any, chance: Any) -> None:
    """The share of the boxes that may come which have a place in an orientation they may have.

    Args:
        tallest: int64 [K, L, L], of how many lengths a box on each footprint fits somewhere.
        ways: int64 [A, 3], the orientations.
        chance: float32 [K], written.
    """
    lengths = tallest.shape[1]
    item = np.empty(3, np.int64)
    items = lengths**3
    for k in range(tallest.shape[0]):
        found = 0
        for i in range(items):
            item[0], item[1], item[2] = i // lengths**2, i // lengths % lengths, i % lengths
            for a in range(ways.shape[0]):
                if tallest[k, item[ways[a, 0]], item[ways[a, 1]]] > item[ways[a, 2]]:
                    found += 1
                    break
        chance[k] = found / items


@njit(cache=True, nogil=True)
def _write(
    mask: Any, sides: Any, placements: Any, cells: Any, chance: Any, room: Any, fits: Any
) -> None:
    """Put the numbers where they belong, in all placements that are the same."""
    for k in range(placements.shape[0]):
        b, a, x, y = placements[k, 0], placements[k, 1], placements[k, 2], placements[k, 3]
        for e in range(a, sides.shape[1]):
            if mask[b, e, x, y] and _same(sides, b, a, e):
                room[b, e, x, y], fits[b, e, x, y] = cells[k], chance[k]


@cache
def _workers(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "room")


def _room_cpu(
    bins: Bins, sides: Tensor, mask: Tensor, lengths: tuple[int, ...], orientations: tuple[int, ...]
) -> tuple[Tensor, Tensor]:
    own, legal = np.ascontiguousarray(sides.numpy()), np.ascontiguousarray(mask.numpy())
    placements = _placements(legal, own)
    count, reach = len(placements), np.array(lengths)
    free = bins.height - np.arange(bins.height + 1)
    fitting = (reach <= free[:, None]).sum(1)
    ways = np.array([ORIENTATIONS[o] for o in orientations])
    cells, chance = np.empty(count, np.int64), np.empty(count, np.float32)
    heightmap, empty_map = bins.heightmap.numpy(), bins.empty_map.numpy()
    small = bitboards.hold(*bins.size[:2])
    threads = torch.get_num_threads() if count >= WORTH_A_THREAD else 1
    at_once = count if small else AT_ONCE // (len(lengths) ** 2 * heightmap[0].size)
    most = max(1, min(-(-count // threads), at_once))

    def judge(start: int) -> None:
        part = slice(start, start + most)
        some = placements[part]
        tallest = np.empty((len(some), len(lengths), len(lengths)), np.int64)
        if small:
            bitboards.judge(
                heightmap, empty_map, own, some, reach, fitting, cells[part], tallest
            )
        else:
            _judge_masks(bins, own, some, reach, fitting, cells[part], tallest)
        _chance(tallest, ways, chance[part])

    if threads == 1:
        for start in range(0, count, most):
            judge(start)
    else:
        list(_workers(threads).map(judge, range(0, count, most)))
    room, fits = np.zeros((2, *mask.shape), np.float32)
    mean = (cells / len(lengths) ** 3).astype(np.float32)
    _write(legal, own, placements, mean, chance, room, fits)
    return torch.from_numpy(room), torch.from_numpy(fits)


def _judge_masks(
    bins: Bins, sides: Any, placements: Any, lengths: Any, fitting: Any, cells: Any, tallest: Any
) -> None:
    """:func:`marl_pack.stability.bitboards.judge` for floors of any size."""
    n, shape = len(placements), bins.size[:2]
    maps = np.empty((2, n, *shape), np.int16)
    _set_down(bins.heightmap.numpy(), bins.empty_map.numpy(), sides, placements, maps[0], maps[1])
    footprints = [(w, d, lengths[0]) for w, d in product(lengths, repeat=2)]
    boxes = np.tile(np.array(footprints, np.int16), (n, 1, 1))
    masks = np.empty((n, len(footprints), *shape), np.uint8)
    levels = np.empty((n, *shape), hull_cpu.level_dtype(bins.height))
    best_level = np.empty(masks.shape, levels.dtype)
    hull_cpu.hull_mask(maps[0], maps[1], boxes, bins.height, levels, masks, best_level)
    _judge(
        masks.reshape(*masks.shape[:2], -1), best_level.reshape(*masks.shape[:2], -1),
        lengths, fitting, cells, tallest,
    )  # fmt: skip


# --- tensor code ----------------------------------------------------------------------------------


def _room_torch(
    bins: Bins, sides: Tensor, mask: Tensor, lengths: tuple[int, ...], orientations: tuple[int, ...]
) -> tuple[Tensor, Tensor]:
    width, depth, height = bins.size
    device = bins.device
    room = torch.zeros(mask.shape, device=device)
    fits = torch.zeros(mask.shape, device=device)
    boxes = torch.tensor(list(product(lengths, repeat=3)), dtype=torch.int16, device=device)
    index = torch.arange(len(boxes), device=device).view([len(lengths)] * 3)
    inverse = [sorted(range(3), key=ORIENTATIONS[o].__getitem__) for o in orientations]
    turned = torch.stack([index.permute(axes).flatten() for axes in inverse], 1)
    placements = mask.nonzero()
    at_once = AT_ONCE if device.type == "cpu" else AT_ONCE << 6
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
        ).sum((2, 3))  # fmt: skip
        room[b, a, x, y] = legal.float().mean(1)
        fits[b, a, x, y] = (legal > 0)[:, turned].any(2).float().mean(1)
    return room, fits
