"""Count feasible cells on floors of at most 128 cells; two 64-bit words hold a set of cells.

Cell (x, y) is bit x · D + y. So the cells of a window are its low corner's bit, shifted by whole
numbers. The low corners of all windows that contain a cell of a set are the union of shifts of this
set. The quadrant test of ``hull_alpha`` (:mod:`marl_pack.stability.hull_compiled`) is computed here
on sets, level by level. A window without a higher cell is feasible if each quadrant around its
middle contains a bearing cell of the level. If only each half contains a bearing cell, the exact
test decides. Corners whose windows reach over the end of a row are left out.

The feasible windows of a bin are found once. A box whose top is at level T then changes little:

- windows on levels above T stay as they are: the box is below them;
- windows on levels below T stay feasible unless they contain a cell of the box;
- windows on level T stay feasible too, and those that contain a cell of the box are tested again.
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


@njit(cache=True, inline="always")
def _widen(low: Any, high: Any, size: int, wanted: int, stride: int) -> tuple[Any, Any]:
    """Unite a set shifted by 0 … ``size`` - 1 strides with its shifts by up to ``wanted`` - 1."""
    while size < wanted:
        step = min(size, wanted - size)
        more_low, more_high = _shift(low, high, step * stride)
        low, high = low | more_low, high | more_high
        size += step
    return low, high


@njit(cache=True)
def _corners(low: Any, high: Any, widths: Any, depths: Any, depth: int, corners: Any) -> None:
    """Find the low corners of windows of each size that contain one of the cells of a set.

    Args:
        low, high: the set.
        widths, depths: int64 [I] and int64 [J], ascending: the sides of the windows.
        depth: D.
        corners: uint64 [2, I · J], written.
    """
    size = 1
    for j in range(depths.size):
        low, high = _widen(low, high, size, depths[j], 1)
        size = depths[j]
        corners[0, j], corners[1, j] = low, high
    for i in range(widths.size):
        size = widths[i - 1] if i else 1
        for j in range(depths.size):
            p, before = i * depths.size + j, max(0, i - 1) * depths.size + j
            corners[0, p], corners[1, p] = _widen(
                corners[0, before], corners[1, before], size, widths[i], depth
            )


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
def _exact(
    low: Any, high: Any, open_low: Any, open_high: Any, depth: int, w: int, d: int, rises: Any
) -> tuple[Any, Any]:
    """Return the open corners of windows whose middle is inside the hull of their cells.

    Args:
        low, high: the cells.
        open_low, open_high: the corners of the windows to test.
        depth: D.
        w, d: size of the windows.
        rises: float64 [w, d, 2], see :func:`_rises`.
    """
    inside_low, inside_high = uint64(0), uint64(0)
    row = ~uint64(0) >> uint64(64 - d)
    while open_low | open_high:
        word = 0 if open_low else 64
        remaining = open_low if open_low else open_high
        corner, lowest = word + _lowest_bit(remaining), remaining & (~remaining + uint64(1))
        up_left, up_right, down_left, down_right = -np.inf, -np.inf, -np.inf, -np.inf
        for x in range(w):
            bits = _shift(low, high, corner + x * depth)[0] & row
            if bits:
                top, bottom = _highest_bit(bits), d - 1 - _lowest_bit(bits)
                up_left = max(up_left, rises[x, top, 0])
                up_right = max(up_right, rises[x, top, 1])
                down_left = max(down_left, rises[x, bottom, 0])
                down_right = max(down_right, rises[x, bottom, 1])
        # Rises are fractions of whole numbers up to 128: a sum that is not 0 is far from 0.
        inside = up_left + up_right > 1e-6 and down_left + down_right > 1e-6
        if open_low:
            open_low ^= lowest
            inside_low |= lowest if inside else uint64(0)
        else:
            open_high ^= lowest
            inside_high |= lowest if inside else uint64(0)
    return inside_low, inside_high


@njit(cache=True)
def _strips(width: int, depth: int) -> tuple[Any, Any]:
    """Return the sets of the cells from row a to row b - 1, and from column a to column b - 1.

    Returns:
        uint64 [W + 1, W + 1, 2] and uint64 [D + 1, D + 1, 2], by a and b.
    """
    rows = np.zeros((width + 1, width + 1, 2), np.uint64)
    columns = np.zeros((depth + 1, depth + 1, 2), np.uint64)
    for cell in range(width * depth):
        x, y, one = cell // depth, cell % depth, uint64(1) << uint64(cell & 63)
        for a in range(x + 1):
            for b in range(x + 1, width + 1):
                rows[a, b, cell >> 6] |= one
        for a in range(y + 1):
            for b in range(y + 1, depth + 1):
                columns[a, b, cell >> 6] |= one
    return rows, columns


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


@njit(cache=True)
def _test(
    candidates: Any, low: Any, high: Any, widths: Any, depths: Any, halves: Any, depth: int,
    rises: Any, quarters: Any, feasible: Any,
) -> None:  # fmt: skip
    """Find the feasible windows of each size on one level.

    Args:
        candidates: uint64 [2, I · J], the corners of the windows to test, without higher cells.
        low, high: the bearing cells of the level.
        widths, depths: int64 [I] and int64 [J], ascending: the sides of the windows.
        halves: int64 [L], half of each length, rounded up.
        depth: D.
        rises: float64 [I, J, W, D, 2], see :func:`_rises`.
        quarters: uint64 [2, I · J], scratch.
        feasible: uint64 [2, I · J], written: those of ``candidates`` that are feasible.
    """
    _corners(low, high, halves[: widths.size], halves[: depths.size], depth, quarters)
    for i in range(widths.size):
        across = widths[i] // 2 * depth
        for j in range(depths.size):
            p, along = i * depths.size + j, depths[j] // 2
            feasible[0, p], feasible[1, p] = uint64(0), uint64(0)
            if not (candidates[0, p] | candidates[1, p]):
                continue
            a_low, a_high = quarters[0, p], quarters[1, p]
            b_low, b_high = _shift(a_low, a_high, along)
            c_low, c_high = _shift(a_low, a_high, across)
            d_low, d_high = _shift(a_low, a_high, across + along)
            yes_low, open_low = _decide_word(candidates[0, p], a_low, b_low, c_low, d_low)
            yes_high, open_high = _decide_word(candidates[1, p], a_high, b_high, c_high, d_high)
            if open_low | open_high:
                more_low, more_high = _exact(
                    low, high, open_low, open_high, depth, widths[i], depths[j], rises[i, j]
                )
                yes_low, yes_high = yes_low | more_low, yes_high | more_high
            feasible[0, p], feasible[1, p] = yes_low, yes_high


@njit(cache=True)
def _survey(
    levels: Any, fitting: Any, inside: Any, widths: Any, depths: Any, halves: Any, depth: int,
    rises: Any, quarters: Any, heights: Any, free: Any, feasible: Any, number: Any,
) -> int:  # fmt: skip
    """Find the feasible windows of a bin on each level that has cells, from the highest level on.

    Args:
        levels: uint64 [H + 1, 2, 2], see :func:`_levels`.
        fitting: int64 [H + 1], how many of the lengths fit between each level and the bin's top.
        inside: uint64 [2, I · J], the corners of the windows that lie on the floor.
        widths, depths, halves, depth, rises, quarters: as for :func:`_test`.
        heights: int64 [S], written: the levels.
        free: uint64 [S, 2, I · J], written: the corners of the windows without a higher cell.
        feasible: uint64 [S, 2, I · J], written: those that are feasible.
        number: int64 [S, I · J], written: how many are feasible.

    Returns:
        The number of levels.
    """
    above_low, above_high, s = uint64(0), uint64(0), 0
    for level in range(len(levels) - 1, -1, -1):
        if not (levels[level, 1, 0] | levels[level, 1, 1]):
            continue
        heights[s] = level
        _corners(above_low, above_high, widths, depths, depth, quarters)
        for word in range(2):
            for p in range(inside.shape[1]):
                free[s, word, p] = inside[word, p] & ~quarters[word, p]
        if fitting[level]:
            _test(
                free[s], levels[level, 0, 0], levels[level, 0, 1], widths, depths, halves, depth,
                rises, quarters, feasible[s],
            )  # fmt: skip
        else:
            feasible[s] = uint64(0)
        for p in range(inside.shape[1]):
            number[s, p] = _count_bits(feasible[s, 0, p]) + _count_bits(feasible[s, 1, p])
        above_low, above_high = above_low | levels[level, 1, 0], above_high | levels[level, 1, 1]
        s += 1
    return s


@njit(cache=True, nogil=True)
def count_by_bits(
    heightmap: Any, empty_map: Any, placements: Any, lengths: Any, fitting: Any, counts: Any
) -> None:
    """Count feasible cells as ``count_by_masks`` does, where :func:`fit_in_words` is true."""
    (width, depth), most = heightmap.shape[1:], min(fitting.size, heightmap[0].size)
    widths, depths = lengths[lengths <= width], lengths[lengths <= depth]
    halves = (lengths + 1) // 2
    sizes = widths.size * depths.size
    rows, columns = _strips(width, depth)
    inside = np.empty((2, sizes), np.uint64)
    rises = np.empty((widths.size, depths.size, width, depth, 2))
    for i in range(widths.size):
        for j in range(depths.size):
            wide, deep = rows[0, width - widths[i] + 1], columns[0, depth - depths[j] + 1]
            inside[0, i * depths.size + j] = wide[0] & deep[0]
            inside[1, i * depths.size + j] = wide[1] & deep[1]
            _rises(widths[i], depths[j], rises[i, j])
    levels = np.empty((fitting.size, 2, 2), np.uint64)
    heights = np.empty(most, np.int64)
    free, feasible = np.empty((most, 2, sizes), np.uint64), np.empty((most, 2, sizes), np.uint64)
    number = np.empty((most, sizes), np.int64)
    quarters, touched = np.empty((2, sizes), np.uint64), np.empty((2, sizes), np.uint64)
    candidates, tested = np.empty((2, sizes), np.uint64), np.empty((2, sizes), np.uint64)
    nothing = np.zeros((2, sizes), np.uint64)
    by_fit = np.empty((lengths.size + 1, sizes), np.int64)  # by how many lengths fit above them
    last, levels_used = -1, 0
    counts[:] = 0
    for k in range(len(placements)):
        b, x, y, w, d, h, z = placements[k]
        if b != last:
            last = b
            _levels(heightmap[b], empty_map[b], levels)
            levels_used = _survey(
                levels, fitting, inside, widths, depths, halves, depth, rises, quarters, heights,
                free, feasible, number,
            )  # fmt: skip
        for i in range(widths.size):
            across = rows[max(0, x - widths[i] + 1), x + w]
            for j in range(depths.size):
                along = columns[max(0, y - depths[j] + 1), y + d]
                touched[0, i * depths.size + j] = across[0] & along[0]
                touched[1, i * depths.size + j] = across[1] & along[1]
        by_fit[:] = 0
        top, place = z + h, 0
        while heights[place] > top:
            place += 1
        for s in range(levels_used):
            fit = by_fit[fitting[heights[s]]]
            if heights[s] >= top:
                for p in range(sizes):
                    fit[p] += number[s, p]
            else:
                for p in range(sizes):
                    low, high = (
                        feasible[s, 0, p] & ~touched[0, p],
                        feasible[s, 1, p] & ~touched[1, p],
                    )
                    fit[p] += _count_bits(low) + _count_bits(high)
        if fitting[top]:
            known = feasible[place] if heights[place] == top else nothing
            low = levels[top, 0, 0] | (levels[z, 0, 0] & rows[x, x + w, 0] & columns[y, y + d, 0])
            high = levels[top, 0, 1] | (levels[z, 0, 1] & rows[x, x + w, 1] & columns[y, y + d, 1])
            for word in range(2):
                for p in range(sizes):
                    candidates[word, p] = free[place, word, p] & touched[word, p] & ~known[word, p]
            _test(
                candidates, low, high, widths, depths, halves, depth, rises, quarters, tested
            )  # fmt: skip
            for p in range(sizes):
                by_fit[fitting[top], p] += _count_bits(tested[0, p]) + _count_bits(tested[1, p])
        for i in range(widths.size):
            for j in range(depths.size):
                feasible_windows = 0
                for tall in range(lengths.size - 1, -1, -1):
                    feasible_windows += by_fit[tall + 1, i * depths.size + j]
                    counts[k, i, j, tall] = feasible_windows
