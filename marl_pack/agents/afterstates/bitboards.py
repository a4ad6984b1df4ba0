"""Count feasible cells on floors of at most 128 cells; two 64-bit words hold a set of cells.

Cell (x, y) is bit x · D + y. So the cells of a window are its low corner's bit, shifted by whole
numbers. The low corners of all windows that contain a cell of a set are the union of shifts of this
set. The quadrant test of ``hull_alpha`` (:mod:`marl_pack.stability.hull_compiled`) is computed here
on sets, level by level. A window without a higher cell is feasible if each quadrant around its
middle contains a bearing cell of the level. If only each half contains a bearing cell, the exact
test decides. Corners whose windows reach over the end of a row are left out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import uint64

from marl_pack.installation import njit

MOST_CELLS = 128
"""Number of bits of two words."""
STEEPEST = 1e6
"""The rise to a corner right above the middle: larger than all other rises."""


def fit_in_words(width: int, depth: int) -> bool:
    """Return whether a floor's cells fit in two words, and the cells of a row in one word."""
    return width * depth <= MOST_CELLS and depth <= MOST_CELLS // 2


@njit(cache=True, inline="always")
def _shift(low: Any, high: Any, bits: int) -> tuple[Any, Any]:
    """Shift a set right by 0 … 127 bits: bit i of the result is bit i + ``bits`` of the set."""
    if bits >= 64:
        return high >> uint64(bits - 64), uint64(0)
    if bits == 0:
        return low, high
    return (low >> uint64(bits)) | (high << uint64(64 - bits)), high >> uint64(bits)


@njit(cache=True, inline="always")
def _count_bits(word: Any) -> int:
    """Return how many bits of a word are 1."""
    word = word - ((word >> uint64(1)) & uint64(0x5555555555555555))
    word = (word & uint64(0x3333333333333333)) + ((word >> uint64(2)) & uint64(0x3333333333333333))
    word = (word + (word >> uint64(4))) & uint64(0x0F0F0F0F0F0F0F0F)
    return int((word * uint64(0x0101010101010101)) >> uint64(56))


@njit(cache=True)
def _window(depth: int, x: int, y: int, w: int, d: int) -> tuple[Any, Any]:
    """Return the set of the cells from (x, y) to (x + w - 1, y + d - 1)."""
    low, high = uint64(0), uint64(0)
    for i in range(x, x + w):
        for j in range(y, y + d):
            bit = i * depth + j
            if bit < 64:
                low |= uint64(1) << uint64(bit)
            else:
                high |= uint64(1) << uint64(bit - 64)
    return low, high


@njit(cache=True, inline="always")
def _grow(source: Any, first: int, end: int, stride: int, grown: Any) -> None:
    """Unite ``grown`` [2] with ``source`` [2] shifted by ``first`` … ``end`` - 1 strides."""
    for step in range(first, end):
        low, high = _shift(source[0], source[1], step * stride)
        grown[0] |= low
        grown[1] |= high


@njit(cache=True)
def _corners(cells: Any, depth: int, spare: Any, boards: Any) -> None:
    """Find the low corners of windows of each size up to R × S that contain one of ``cells``.

    Args:
        cells: uint64 [2], a set.
        depth: D.
        spare: uint64 [2], scratch.
        boards: uint64 [R + 1, S + 1, 2], written from [1, 1] on: the corners for each size.
    """
    spare[0], spare[1] = cells[0], cells[1]
    for d in range(1, boards.shape[1]):
        _grow(cells, d - 1, d, 1, spare)
        boards[1, d, 0], boards[1, d, 1] = spare[0], spare[1]
    for w in range(2, boards.shape[0]):
        for d in range(1, boards.shape[1]):
            boards[w, d, 0], boards[w, d, 1] = boards[w - 1, d, 0], boards[w - 1, d, 1]
            _grow(boards[1, d], w - 1, w, depth, boards[w, d])


@njit(cache=True, inline="always")
def _lowest_bit(word: Any) -> int:
    """Return the index of the lowest bit that is 1."""
    return _count_bits((word & (~word + uint64(1))) - uint64(1))


@njit(cache=True, inline="always")
def _highest_bit(word: Any) -> int:
    """Return the index of the highest bit that is 1."""
    for step in (1, 2, 4, 8, 16, 32):
        word |= word >> uint64(step)
    return _count_bits(word) - 1


@njit(cache=True)
def _rises(w: int, d: int, rises: Any) -> None:
    """Compute how steeply the hull rises from a window's middle to each of its cells.

    Add the steepest rise to a corner on the left of the middle and the steepest rise to a corner on
    its right. The middle is inside the hull of cells if this sum is greater than 0 upwards, and
    also downwards. A corner right above the middle has the rise :data:`STEEPEST`, on the side of
    its cell.

    Args:
        w, d: size of the window.
        rises: float64 [w, d, 2], written: the rise to the upper corners of cell (x, y), on the left
            and on the right of the middle; -inf where there is none. To get the rises downwards,
            count y from the other end.
    """
    for x in range(w):
        for y in range(d):
            rises[x, y] = -np.inf
            side = 0 if 2 * x + 1 < w else 1
            for corner in (x, x + 1):
                run, rise = 2 * corner - w, 2 * y + 2 - d
                if run:
                    which = 0 if run < 0 else 1
                    rises[x, y, which] = max(rises[x, y, which], rise / abs(run))
                elif rise > 0:
                    rises[x, y, side] = STEEPEST


@njit(cache=True)
def _exact(cells: Any, corners: Any, depth: int, w: int, d: int, rises: Any) -> tuple[Any, Any]:
    """Return the ``corners`` [2] of windows whose middle is inside the hull of ``cells``."""
    inside_low, inside_high = uint64(0), uint64(0)
    row = ~uint64(0) >> uint64(64 - d)
    for word in range(2):
        remaining = corners[word]
        while remaining:
            lowest = remaining & (~remaining + uint64(1))
            remaining ^= lowest
            corner = 64 * word + _count_bits(lowest - uint64(1))
            up_left, up_right, down_left, down_right = -np.inf, -np.inf, -np.inf, -np.inf
            for x in range(w):
                bits = _shift(cells[0], cells[1], corner + x * depth)[0] & row
                if bits:
                    top, bottom = _highest_bit(bits), d - 1 - _lowest_bit(bits)
                    up_left = max(up_left, rises[x, top, 0])
                    up_right = max(up_right, rises[x, top, 1])
                    down_left = max(down_left, rises[x, bottom, 0])
                    down_right = max(down_right, rises[x, bottom, 1])
            # Rises are fractions of whole numbers up to 128: a sum that is not 0 is far from 0.
            if up_left + up_right > 1e-6 and down_left + down_right > 1e-6:
                if word == 0:
                    inside_low |= lowest
                else:
                    inside_high |= lowest
    return inside_low, inside_high


@njit(cache=True)
def _window_tables(lengths: Any, width: int, depth: int) -> tuple[Any, Any]:
    """Build the tables that depend only on a window's size, for lengths up to the floor's sides.

    Returns:
        The corners of the windows that lie on the floor, uint64 [I, J, 2], and the rises in them
        (:func:`_rises`), float64 [I, J, W, D, 2].
    """
    fit_w, fit_d = int((lengths <= width).sum()), int((lengths <= depth).sum())
    valid = np.zeros((fit_w, fit_d, 2), np.uint64)
    rises = np.empty((fit_w, fit_d, width, depth, 2))
    for i in range(fit_w):
        for j in range(fit_d):
            across, along = width - lengths[i] + 1, depth - lengths[j] + 1
            valid[i, j, 0], valid[i, j, 1] = _window(depth, 0, 0, across, along)
            _rises(lengths[i], lengths[j], rises[i, j])
    return valid, rises


@njit(cache=True)
def _levels(heightmap: Any, empty_map: Any, levels: Any) -> None:
    """Write the bearing cells and all cells of each level, uint64 [H + 1, 2, 2], of maps [W, D]."""
    depth = heightmap.shape[1]
    levels[:] = uint64(0)
    for i in range(heightmap.shape[0]):
        for j in range(depth):
            bit, level = i * depth + j, heightmap[i, j]
            one = uint64(1) << uint64(bit & 63)
            levels[level, 1, bit >> 6] |= one
            if empty_map[i, j] == 0:
                levels[level, 0, bit >> 6] |= one


@njit(cache=True, inline="always")
def _decide_word(free: Any, a: Any, b: Any, c: Any, d: Any) -> tuple[Any, Any]:
    """Decide windows from their quadrants: ``a`` and ``b`` low in x, ``a`` and ``c`` low in y.

    Returns:
        The free corners with a cell in all four quadrants, and the free corners that the exact test
        must decide: those with a cell in each half, but not in each quadrant.
    """
    yes = free & a & b & c & d
    return yes, free & ~yes & (a | b) & (c | d) & (a | c) & (b | d)


@njit(cache=True, nogil=True)
def count_by_bits(
    heightmaps: Any, empty_maps: Any, lengths: Any, fitting: Any, counts: Any
) -> None:
    """Count feasible cells as ``count_by_masks`` does, where :func:`fit_in_words` is true."""
    (width, depth), most = heightmaps.shape[1:], fitting.size
    valid, rises = _window_tables(lengths, width, depth)
    fit_w, fit_d = valid.shape[:2]
    reach_w = (lengths[fit_w - 1] + 1) // 2 if fit_w else 0
    reach_d = (lengths[fit_d - 1] + 1) // 2 if fit_d else 0
    levels = np.empty((most, 2, 2), np.uint64)  # of each level: bearing cells, all cells
    quarters = np.empty((reach_w + 1, reach_d + 1, 2), np.uint64)
    above, undecided = np.empty(2, np.uint64), np.empty(2, np.uint64)
    deep = np.empty((fit_d, 2), np.uint64)  # corners of windows whose first row has a higher cell
    blocked = np.empty((fit_d, 2), np.uint64)  # corners of windows with a higher cell
    for k in range(heightmaps.shape[0]):
        _levels(heightmaps[k], empty_maps[k], levels)
        counts[k] = 0
        above[:] = uint64(0)
        for level in range(most - 1, -1, -1):
            fit = fitting[level]
            if fit and fit_w and fit_d and (levels[level, 0, 0] | levels[level, 0, 1]):
                _corners(levels[level, 0], depth, undecided, quarters)
                deep[0] = above
                for j in range(fit_d):
                    if j:
                        deep[j] = deep[j - 1]
                    _grow(above, lengths[j - 1] if j else 1, lengths[j], 1, deep[j])
                    blocked[j] = deep[j]
                last = fit_d
                for i in range(fit_w):
                    half_w = (lengths[i] + 1) // 2
                    across = (lengths[i] - half_w) * depth
                    for j in range(last):
                        _grow(deep[j], lengths[i - 1] if i else 1, lengths[i], depth, blocked[j])
                        free_low = valid[i, j, 0] & ~blocked[j, 0]
                        free_high = valid[i, j, 1] & ~blocked[j, 1]
                        if not (free_low | free_high):
                            last = j  # longer windows are not free on this level either
                            break
                        half_d = (lengths[j] + 1) // 2
                        along = lengths[j] - half_d
                        a_low, a_high = quarters[half_w, half_d]
                        b_low, b_high = _shift(a_low, a_high, along)
                        c_low, c_high = _shift(a_low, a_high, across)
                        d_low, d_high = _shift(a_low, a_high, across + along)
                        low, undecided[0] = _decide_word(free_low, a_low, b_low, c_low, d_low)
                        high, undecided[1] = _decide_word(free_high, a_high, b_high, c_high, d_high)
                        if undecided[0] | undecided[1]:
                            more_low, more_high = _exact(
                                levels[level, 0], undecided, depth, lengths[i], lengths[j],
                                rises[i, j],
                            )  # fmt: skip
                            low, high = low | more_low, high | more_high
                        feasible = _count_bits(low) + _count_bits(high)
                        for tall in range(fit if feasible else 0):
                            counts[k, i, j, tall] += feasible
            above[0] |= levels[level, 1, 0]
            above[1] |= levels[level, 1, 1]
