"""Test exactly whether a point lies inside the convex hull of cells, in compiled loops.

A cell is a unit square, so the hull of a set of cells depends only on the first and the last cell
of each row. All tests are strict: a point on the hull's edge is not inside.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_pack.installation import njit

YES, UNDECIDED = 2, 1
"""Codes of a window: its centre of mass is inside the hull (YES), or the exact test must decide
(UNDECIDED). A code is the number of tests that the window passes: a window with YES also passes the
weaker test that an UNDECIDED window passes."""

OUTSIDE, INSIDE, UNSURE = 0, 1, 2
"""Verdicts of the exact test. UNSURE: float64 cannot tell, so exact fractions must decide."""

ROUNDING = 2.0**-48
"""Relative error of the distance to an edge that float64 never exceeds."""

LOOKUP_CELLS = 64
"""For windows of more cells than this, tables of the whole map give the extremes of their rows."""


@njit(cache=True, inline="always")
def row_extremes(cells: Any, lo: Any, hi: Any) -> None:
    """Find the first and the last cell of each row.

    Args:
        cells: bool [w, d].
        lo: int64 [≥ w], written: the first true cell of each row, d where there is none.
        hi: int64 [≥ w], written: the last true cell of each row, -1 where there is none.
    """
    w, d = cells.shape
    for i in range(w):
        lo[i], hi[i] = d, -1
        for j in range(d):
            if cells[i, j]:
                lo[i], hi[i] = min(lo[i], j), j


@njit(cache=True)
def envelope(lo: Any, hi: Any, upper: Any, lower: Any) -> tuple[int, int]:
    """Compute the upper and the lower chain of the hull of cells, given the extremes of each row.

    Args:
        lo: int64 [w], first cell of each row.
        hi: int64 [w], last cell of each row (``hi < lo``: the row has none).
        upper: int64 [2w + 2, 2], filled with the upper chain's vertices (x, y), x ascending.
        lower: int64 [2w + 2, 2], filled with the lower chain's vertices (x, y), x ascending.

    Returns:
        The number of vertices of the upper and of the lower chain; 0, 0 where no row has a cell.
    """
    sizes = [0, 0]
    for side in range(2):
        chain, size = (upper, 0) if side == 0 else (lower, 0)
        sign = 1 if side == 0 else -1
        for row in range(lo.size):
            if hi[row] < lo[row]:
                continue
            y = hi[row] + 1 if side == 0 else lo[row]
            for x in (row, row + 1):
                if size and chain[size - 1, 0] == x:
                    if sign * (y - chain[size - 1, 1]) <= 0:
                        continue
                    size -= 1
                while size > 1:
                    ax, ay = chain[size - 2, 0], chain[size - 2, 1]
                    bx, by = chain[size - 1, 0], chain[size - 1, 1]
                    if sign * ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) < 0:
                        break
                    size -= 1
                chain[size, 0], chain[size, 1] = x, y
                size += 1
        sizes[side] = size
    return sizes[0], sizes[1]


@njit(cache=True)
def _beyond_chain(
    chain: Any, size: int, sign: int, x: float, y: float, unit: float, margin: float, whole: bool
) -> int:
    """Decide whether (x, y) is more than ``margin`` on the inner side of every edge of a chain."""
    verdict = INSIDE
    for i in range(size - 1):
        ax, ay = chain[i, 0] * unit, chain[i, 1] * unit
        ex, ey = chain[i + 1, 0] - chain[i, 0], chain[i + 1, 1] - chain[i, 1]
        length = np.sqrt(float(ex * ex + ey * ey))
        distance = sign * (ey * (x - ax) - ex * (y - ay)) - margin * length
        error = 0.0
        if not whole or (margin > 0.0 and length != np.floor(length)):
            error = ROUNDING * (abs(ex) * (abs(y) + ay) + abs(ey) * (abs(x) + ax) + margin * length)
        if distance <= -error:
            return OUTSIDE
        if distance <= error:
            verdict = UNSURE
    return verdict


@njit(cache=True)
def inside(
    lo: Any, hi: Any, upper: Any, lower: Any, x: float, y: float, unit: float, margin: float,
    whole: bool,
) -> int:  # fmt: skip
    """Decide whether (x, y) lies more than ``margin`` inside the hull of the rows' cells.

    Args:
        lo: int64 [w], first cell of each row.
        hi: int64 [w], last cell of each row (``hi < lo``: the row has none).
        upper: int64 [2w + 2, 2], scratch.
        lower: int64 [2w + 2, 2], scratch.
        x: the point's x, in units.
        y: the point's y, in units.
        unit: units in a cell.
        margin: least distance from the hull's edge in units, ≥ 0.
        whole: whether float64 is exact on x, y and margin (:class:`CentreTable`).

    Returns:
        OUTSIDE, INSIDE or UNSURE.
    """
    n_upper, n_lower = envelope(lo, hi, upper, lower)
    if n_upper == 0:
        return OUTSIDE
    first, last = upper[0, 0] * unit, upper[n_upper - 1, 0] * unit
    distance = min(x - first, last - x) - margin
    error = 0.0 if whole else ROUNDING * (abs(x) + last + margin)
    if distance <= -error:
        return OUTSIDE
    verdict = UNSURE if distance <= error else INSIDE
    for side in range(2):
        chain, size, sign = (upper, n_upper, 1) if side == 0 else (lower, n_lower, -1)
        beyond = _beyond_chain(chain, size, sign, x, y, unit, margin, whole)
        if beyond == OUTSIDE:
            return OUTSIDE
        verdict = max(verdict, beyond)
    return verdict


@njit(cache=True)
def middle_inside(lo: Any, hi: Any, d: int) -> bool:
    """Return whether the window's middle lies inside the hull, without computing the hull.

    This is :func:`inside` without a margin. Seen from the middle, the hull passes above it iff the
    steepest rise to a corner on the left and the steepest rise to a corner on the right add up to
    more than 0, or a corner lies directly above; the same holds below. In half cells all numbers
    are whole, so fractions are compared exactly.
    """
    w = lo.size
    for side in range(2):
        left_rise, left_run, right_rise, right_run = 0, 0, 0, 0
        passes = False
        for row in range(w):
            if hi[row] < lo[row]:
                continue
            rise = 2 * hi[row] + 2 - d if side == 0 else d - 2 * lo[row]
            for x in (2 * row - w, 2 * row + 2 - w):
                if x < 0:
                    if left_run == 0 or rise * left_run > left_rise * -x:
                        left_rise, left_run = rise, -x
                elif x > 0:
                    if right_run == 0 or rise * right_run > right_rise * x:
                        right_rise, right_run = rise, x
                elif rise > 0:
                    passes = True
        if left_run == 0 or right_run == 0:
            return False
        if not passes and left_rise * right_run + right_rise * left_run <= 0:
            return False
    return True


@njit(cache=True)
def _mark_neighbours(levels: Any, top: int, next_y: Any, previous_y: Any) -> None:
    """Find the nearest cell of level ``top`` in the same row, for each cell [W, D] and direction.

    If the cell itself has level ``top``, it is the nearest cell in both directions.

    Args:
        levels: integers [W, D], K of every column.
        top: the level.
        next_y: int16 [W, D], written: y of the nearest cell with the same or a larger y, or D.
        previous_y: int16 [W, D], written: y of the nearest cell with the same or a smaller y, or
            -1.
    """
    depth = levels.shape[1]
    for x in range(levels.shape[0]):
        last = -1
        for y in range(depth):
            if levels[x, y] == top:
                last = y
            previous_y[x, y] = last
        last = depth
        for y in range(depth - 1, -1, -1):
            if levels[x, y] == top:
                last = y
            next_y[x, y] = last


@njit(cache=True, inline="always")
def _level_extremes(
    levels: Any, x: int, y: int, w: int, d: int, top: int, lo: Any, hi: Any
) -> None:
    """Find the first and the last cell of level ``top`` in each row of the window at (x, y)."""
    for i in range(w):
        first, last = d, -1
        for j in range(d):
            if levels[x + i, y + j] == top:
                first = min(first, j)
                last = j
        lo[i], hi[i] = first, last


@njit(cache=True)
def solve_undecided(
    codes: Any, best: Any, levels: Any, w: int, d: int, x: float, y: float, unit: float,
    margin: float, whole: bool, scratch: Any, out: Any,
) -> int:  # fmt: skip
    """Write the verdict on every UNDECIDED window of a map: OUTSIDE, INSIDE or UNSURE.

    Args:
        codes: uint8 [W · D], the windows' codes.
        best: integers [W · D], the windows' largest K.
        levels: integers [W, D], K of every column.
        w: the windows' cells along x.
        d: the windows' cells along y.
        x: the centre of mass along x, from the window's low corner, in units.
        y: the centre of mass along y, from the window's low corner, in units.
        unit: units in a cell.
        margin: units by which the support polygon is shrunk.
        whole: whether float64 is exact on x, y and margin.
        scratch: int64 [3, 2W + 2, 2].
        out: uint8 [W, D], written at the undecided positions.

    Returns:
        The number of windows that are UNSURE.
    """
    width, depth = levels.shape
    lo, hi = scratch[0, :w, 0], scratch[0, :w, 1]
    upper, lower = scratch[1], scratch[2]
    middle = whole and margin == 0.0 and 2 * x == w * unit and 2 * y == d * unit
    unsure = 0
    # Large windows come in clusters with the same level: mark its cells once, then look them up.
    marks = np.empty((2, width, depth) if w * d > LOOKUP_CELLS else (2, 0, 0), np.int16)
    next_y, previous_y = marks[0], marks[1]
    marked = -1
    for position in range((width - w) * depth + depth - d + 1):
        if codes[position] != UNDECIDED:
            continue
        cx, cy = position // depth, position % depth
        top = best[position]
        if w * d > LOOKUP_CELLS:
            if marked != top:
                _mark_neighbours(levels, top, next_y, previous_y)
                marked = top
            for i in range(w):
                lo[i] = next_y[cx + i, cy] - cy
                hi[i] = previous_y[cx + i, cy + d - 1] - cy
        else:
            _level_extremes(levels, cx, cy, w, d, top, lo, hi)
        if middle:
            out[cx, cy] = middle_inside(lo, hi, d)
        else:
            out[cx, cy] = inside(lo, hi, upper, lower, x, y, unit, margin, whole)
            unsure += out[cx, cy] == UNSURE
    return unsure
