"""Cut the bin itself into items (Zhao et al. 2021, sec. 5), so that a perfect packing is known."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from marl_pack.checks import shown, whole_number
from marl_pack.geometry import Size, check_size
from marl_pack.geometry.compiled import place_box
from marl_pack.installation import njit
from marl_pack.items.random_numbers import draw, episode_keys


def check_sides(sides: tuple[int, int]) -> tuple[int, int]:
    """Return (shortest, longest) side as ints.

    Raises:
        ValueError: unless they are whole numbers with 1 ≤ shortest ≤ longest.
    """
    try:
        low, high = sides
        low = whole_number(low, "shortest", 1)
        return low, whole_number(high, "longest", low)
    except (TypeError, ValueError):
        raise ValueError(
            f"sides {shown(sides)}: need two whole numbers, 1 ≤ shortest ≤ longest"
        ) from None


@njit(cache=True)
def _cut_bin(size: Any, low: int, high: int, state: Any, waiting: Any, pieces: Any) -> int:
    """Cut the bin until every edge is in low … high, and return the number of pieces.

    Rows of ``pieces`` are x, y, z, w, d, h, in the order in which the pieces are finished.
    """
    waiting[0, :3] = 0
    waiting[0, 3:] = size
    left, n = int(size.max() > high), 0
    if left == 0:
        pieces[0] = waiting[0]
        n = 1
    parts = np.empty((2, 6), np.int64)
    while left > 0:
        chosen = draw(state, left)
        parts[:] = waiting[chosen]
        left -= 1
        waiting[chosen] = waiting[left]
        edges = parts[0, 3:].copy()
        cuts = 0  # places where an edge can be cut into two parts of at least low
        for axis in range(3):
            if edges[axis] > high:
                cuts += edges[axis] - 2 * low + 1
        pick = draw(state, cuts)
        for axis in range(3):
            if edges[axis] > high:
                places = edges[axis] - 2 * low + 1
                if 0 <= pick < places:
                    parts[0, 3 + axis] = low + pick
                    parts[1, axis] += low + pick
                    parts[1, 3 + axis] = edges[axis] - low - pick
                pick -= places
        for part in parts:
            if part[3:].max() > high:
                waiting[left] = part
                left += 1
            else:
                pieces[n] = part
                n += 1
    return n


@njit(cache=True)
def _stacking_order(pieces: Any, n: int, shape: tuple[int, int], state: Any, out: Any) -> None:
    """Order the pieces as CUT-2 does: repeatedly draw a piece whose whole floor is complete."""
    height = np.zeros(shape, np.int64)
    left = np.arange(n)
    ready = np.empty(n, np.int64)
    for k in range(n):
        count = 0
        for i in range(n - k):
            x, y, z, w, d, _ = pieces[left[i]]
            if (height[x : x + w, y : y + d] == z).all():
                ready[count] = i
                count += 1
        i = ready[draw(state, count)]
        out[k] = pieces[left[i]]
        x, y, z, w, d, h = out[k]
        place_box(height, None, x, y, w, d, h)  # it rests at z, on its finished floor
        left[i : n - k - 1] = left[i + 1 : n - k].copy()


@njit(cache=True, nogil=True)
def _cut_all(keys: Any, size: Any, low: int, high: int, order: int, out: Any) -> None:
    """Cut the bin once for each key, into rows of ``out`` [K, L, 6] in the order of arrival."""
    most = out.shape[1]
    pieces, waiting = np.empty((most, 6), np.int64), np.empty((most, 6), np.int64)
    state = np.empty(1, np.uint64)
    for b in range(keys.size):
        state[0] = np.uint64(keys[b])
        n = _cut_bin(size, low, high, state, waiting, pieces)
        if order == 2:
            _stacking_order(pieces, n, (size[0], size[1]), state, out[b])
        else:
            out[b, :n] = pieces[:n][np.argsort(pieces[:n, 2], kind="mergesort")]


def cut(
    size: Size, order: Literal[1, 2], seed: int, episodes: Tensor, sides: tuple[int, int]
) -> Tensor:
    """Cut the bin into sequences of items whose perfect packing is known.

    Start with the whole bin. While a piece has an edge longer than ``high``, choose uniformly one
    of these pieces and one of its possible cuts: across such an edge, at a position in
    [low, edge - low]. Replace the piece by the two parts. Pieces are listed in the order in which
    they are finished, so that neighbours in a sequence are equal as often as in the published
    CUT-1.

    Args:
        size: (W, D, H) of the bin.
        order: 1 sorts the pieces by the height of their bottom face; 2 repeatedly draws a piece
            whose whole floor is complete.
        seed: seed of the sequences.
        episodes: int64 [K], numbers of the episodes.
        sides: (low, high), shortest and longest edge; ``high ≥ 2 · low - 1`` and the bin's sides
            at least ``low``.

    Returns:
        int16 [K, L, 6] on the CPU, rows x, y, z, w, d, h in the order of arrival, then zeros. The
        boxes fill the bin exactly, and in this order each box has a complete floor.

    Raises:
        ValueError: if the bin cannot be cut into such pieces.
    """
    low, high = check_sides(sides)
    size = check_size(size)
    if high < 2 * low - 1 or min(size) < low:
        raise ValueError(
            f"cutting {size} into edges {low}..{high}: needs a longest edge of at least "
            f"{2 * low - 1} (twice the shortest, less one) and bin sides of at least {low}"
        )
    keys = episode_keys(seed, episodes.cpu()).numpy()
    most = int(np.prod([s // low for s in size]))
    out = np.zeros((len(keys), most, 6), np.int64)
    _cut_all(keys, np.array(size), low, high, order, out)
    longest = int((out[..., 3] > 0).sum(1).max(initial=1))
    return torch.from_numpy(out[:, :longest].astype(np.int16))
