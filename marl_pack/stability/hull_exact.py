"""Test exactly whether a point lies inside the convex hull of cells, in compiled loops.

A cell is a unit square, so the hull of a set of cells depends only on the first and the last cell
of each row. All tests are strict: a point on the hull's edge is not inside.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_pack.installation import njit

OUTSIDE, INSIDE, UNSURE = 0, 1, 2
"""Verdicts of the exact test. UNSURE: float64 cannot tell, so exact fractions must decide."""

ROUNDING = 2.0**-48
"""Relative error of the distance to an edge that float64 never exceeds."""


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
