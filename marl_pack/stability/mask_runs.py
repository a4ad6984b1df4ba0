"""Order masks for compiled loops so that masks with equal footprints form runs."""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_pack.installation import njit


@njit(cache=True, inline="always")
def in_bin(w: int, d: int, h: int, width: int, depth: int, height: int) -> bool:
    """Return whether a box fits into an empty bin; a box with a zero side does not."""
    return 0 < w <= width and 0 < d <= depth and 0 < h <= height


@njit(cache=True)
def earlier_equals(sides: Any) -> Any:
    """Find for each oriented item [N, A, 3] an earlier item of the same bin with equal sides.

    Returns:
        int64 [N · A], the index of the earlier item in N · A, or -1 where there is none.
    """
    n, count = sides.shape[:2]
    equal = np.full(n * count, -1, np.int64)
    for b in range(n):
        for a in range(1, count):
            for e in range(a):
                if (
                    sides[b, a, 0] == sides[b, e, 0]
                    and sides[b, a, 1] == sides[b, e, 1]
                    and sides[b, a, 2] == sides[b, e, 2]
                ):
                    equal[b * count + a] = b * count + e
                    break
    return equal


@njit(cache=True)
def _footprint_keys(sides: Any, equal: Any, shape: tuple[int, int], height: int) -> Any:
    """Number the footprints of oriented items [N · A, 3] that need a mask of their own.

    Returns:
        int64 [N · A], the key of each footprint (-1 where the item does not fit into the bin or has
        an earlier equal item), and the number of possible keys.
    """
    masks = sides.shape[0]
    key = np.empty(masks, np.int64)
    largest = 0
    for i in range(masks):
        w, d, h = sides[i, 0], sides[i, 1], sides[i, 2]
        needed = in_bin(w, d, h, shape[0], shape[1], height) and equal[i] < 0
        key[i] = w * (shape[1] + 1) + d if needed else -1
        largest = max(largest, key[i])
    return key, largest + 1


@njit(cache=True)
def runs_of_footprints(
    sides: Any, equal: Any, shape: tuple[int, int], height: int, size: int
) -> tuple[Any, Any]:
    """Order the masks so that equal footprints follow each other, and cut the order into runs.

    Returns:
        The order (indices into N · A, without the items that do not fit into the bin or have an
        earlier equal item), and the limits of the runs in this order. A run has at most ``size``
        masks, all with the same footprint.
    """
    masks = sides.shape[0]
    key, keys = _footprint_keys(sides, equal, shape, height)
    order = np.empty(masks, np.int64)
    ordered = 0
    if size == 1:
        for i in range(masks):
            if key[i] >= 0:
                order[ordered] = i
                ordered += 1
        return order[:ordered], np.arange(ordered + 1)
    start = np.zeros(keys + 1, np.int64)  # a counting sort by key
    for i in range(masks):
        if key[i] >= 0:
            start[key[i] + 1] += 1
    limits, runs = np.zeros(masks + 1, np.int64), 0
    for k in range(start.size - 1):
        for cut in range(start[k] + size, start[k] + start[k + 1], size):
            runs += 1
            limits[runs] = cut
        start[k + 1] += start[k]
        if start[k + 1] > limits[runs]:
            runs += 1
            limits[runs] = start[k + 1]
    for i in range(masks):
        if key[i] >= 0:
            order[start[key[i]]] = i
            start[key[i]] += 1
            ordered += 1
    return order[:ordered], limits[: runs + 1]
