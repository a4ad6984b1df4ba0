"""Decide windows that contact in halves and quadrants leaves undecided, in compiled loops.

A few windows are read by themselves and tested exactly (:mod:`marl_pack.stability.hull_exact`).
Many are decided together: the steepest lines from the contact's corners over the centre of mass, or
over a disc around it whose radius is the margin, say whether the hull passes there.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_pack.geometry.compiled import slide
from marl_pack.installation import njit
from marl_pack.stability.hull_exact import INSIDE, OUTSIDE, UNSURE, inside, middle_inside

YES, UNDECIDED = 2, 1
"""Codes of a window: its centre of mass is inside the hull (YES), or the exact test must decide
(UNDECIDED). A code is the number of tests that the window passes: a window with YES also passes the
weaker test that an UNDECIDED window passes."""

READ_CELLS = 4
"""If windows have more cells than this for each cell of the map, none is read by itself."""

AT_ONCE = 128
"""Number of neighbouring windows that are solved together."""

BAND = 0.5
"""Corners at most so many half cells beyond a disc, along x, are left to the exact test."""

TOLERANCE = np.float32(1e-4)
"""Relative error of sums of rises that float32 never exceeds."""

STEEPEST = 1e6
"""The rise to a corner right above the middle: larger than all other rises."""

FLOAT32_CELLS = 1 << 20
"""In windows of more cells than this, float32 does not tell all rises apart."""


@njit(cache=True)
def _pack(levels: Any, start: Any, depth: int, sign: int, first: int, keys: Any) -> None:
    """Write K and the place in its row, ``first + sign · y``, of each column as one number."""
    for y in range(np.uint64(depth)):
        place = first + sign * np.int64(y)
        keys[start + y] = np.int32(levels[start + y]) << 16 | place


@njit(cache=True)
def _unpack(
    keys: Any, start: Any, depth: int, sign: int, beyond: int, rows: Any, rises: Any
) -> None:
    """Write K of each key, and twice the distance from y to its place, plus ``beyond``."""
    for y in range(np.uint64(depth)):
        place = keys[start + y] & 0xFFFF
        rows[start + y] = keys[start + y] >> 16
        rises[start + y] = np.float32(np.int32(2 * (place - sign * np.int64(y)) + beyond))


@njit(cache=True)
def _row_windows(levels: Any, depth: int, d: int, keys: Any, rows: Any, rises: Any) -> None:
    """Find the highest columns of every window of 1 × d cells, and the first and last of them.

    A key is a column's K and its place in the row, so the largest key of a window gives both.

    Args:
        levels: integers [W · D], K of every column.
        depth: D.
        d: the windows' cells along y.
        keys: int32 [3, W · D], scratch.
        rows: int32 [W · D], written: the largest K of each window.
        rises: float32 [2, W · D], written: in half cells, how far the last cell with this K reaches
            beyond the window's middle towards larger y, and the first towards smaller y.
    """
    for side in range(2):
        sign, first = (1, 0) if side == 0 else (-1, depth - 1)
        beyond = 2 - d if side == 0 else d + 2 - 2 * depth
        for x in range(levels.size // depth):
            _pack(levels, np.uint64(x * depth), depth, sign, first, keys[0])
        best = slide(keys[0], keys[1], keys[2], depth, np.int64(1), np.int64(d))
        for x in range(levels.size // depth):
            _unpack(best, np.uint64(x * depth), depth, sign, beyond, rows, rises[side])


@njit(cache=True)
def _in_contact(rows: Any, tops: Any, row: Any, start: Any, n: int) -> bool:
    """Return whether any of n neighbouring windows has contact in a row of its cells."""
    contacts: Any = 0
    for i in range(np.uint64(n)):
        contacts += np.int32(rows[row + i] == tops[start + i])
    return contacts > 0


@njit(cache=True)
def _any_undecided(tops: Any, start: int, n: int) -> bool:
    """Return whether any of n neighbouring windows is undecided."""
    highest: Any = np.int32(-1)
    for i in range(start, start + n):
        highest = max(highest, tops[i])
    return bool(highest >= 0)


@njit(cache=True)
def _steepen(
    rows: Any, rises: Any, tops: Any, row: Any, start: Any, n: int, near: Any, far: Any,
    steepest: Any,
) -> None:  # fmt: skip
    """Raise the steepest rises of n neighbouring windows by those to a row of their cells.

    Args:
        rows: int32 [W · D], see :func:`_row_windows`.
        rises: float32 [W · D], one side of those of :func:`_row_windows`.
        tops: int32 [P], see :func:`_middles_inside`.
        row: uint64, position of the first window's row.
        start: uint64, position of the first window.
        n: number of windows.
        near: float32, 1 / distance from the middle to the row's nearer corners along x.
        far: float32, 1 / distance to its farther corners.
        steepest: float32 [≥ n], raised.
    """
    none = np.float32(-np.inf)
    for i in range(np.uint64(n)):
        rise = max(rises[row + i] * near, rises[row + i] * far)
        rise = rise if rows[row + i] == tops[start + i] else none
        steepest[i] = max(steepest[i], rise)


@njit(cache=True, inline="always")
def _inverse(distance: int) -> Any:
    """Return 1 / distance as float32; a corner right above the middle is the steepest of all."""
    return np.float32(1 / distance) if distance > 0 else np.float32(STEEPEST)


@njit(cache=True)
def _middles_inside(tops: Any, rows: Any, rises: Any, depth: int, w: int, d: int, out: Any) -> None:
    """Write for each undecided window whether its middle lies inside the hull of its contact.

    This is :func:`middle_inside` for many windows at a time, in loops that become vector code:
    unsigned positions need no check for negative ones. Rises are fractions of whole numbers. Two
    that do not cancel differ by more than the tolerance, so float32 decides exactly.

    Args:
        tops: int32 [P], K of each window's contact; -1 for windows that are decided.
        rows: int32 [W · D], see :func:`_row_windows`.
        rises: float32 [2, W · D], see :func:`_row_windows`.
        depth: D.
        w: the windows' cells along x.
        d: the windows' cells along y.
        out: uint8 [W · D], written at the undecided positions: OUTSIDE or INSIDE.
    """
    tolerance = np.float32(1 / (4 * np.int64(w) * d))
    steepest = np.empty((2, 2, AT_ONCE), np.float32)  # in each direction, left and right
    for start in range(0, tops.size, AT_ONCE):
        n = min(AT_ONCE, tops.size - start)
        if not _any_undecided(tops, start, n):
            continue
        steepest[:] = np.float32(-np.inf)
        for x in range(w):
            row, first = np.uint64(start + x * depth), np.uint64(start)
            if not _in_contact(rows, tops, row, first, n):
                continue
            for half in range(2):  # in half cells, the corners lie at 2x - w and 2x + 2 - w
                far = w - 2 * x if half == 0 else 2 * x + 2 - w
                if far > 0:
                    near = far - 2 if far > 1 else 1
                    for side in range(2):
                        _steepen(
                            rows, rises[side], tops, row, first, n, _inverse(near), _inverse(far),
                            steepest[side, half],
                        )  # fmt: skip
        for i in range(n):
            if tops[start + i] >= 0:
                out[start + i] = INSIDE
                for side in range(2):
                    left, right = steepest[side, 0, i], steepest[side, 1, i]
                    if not left + right > tolerance * (abs(left) + abs(right)):
                        out[start + i] = OUTSIDE


@njit(cache=True)
def _steepen_over_disc(
    rows: Any, rises: Any, tops: Any, row: Any, start: Any, n: int, distance: Any, offset: Any,
    radius: Any, steepest: Any,
) -> None:  # fmt: skip
    """Raise the steepest rises of n neighbouring windows by those of tangents to a disc.

    A tangent goes from a corner over the disc around the point. With y the corner's height above
    the point, it rises by (distance · y - radius · √(distance² + y² - radius²)) / (distance² -
    radius²) towards the corner.

    Args:
        distance: float32, along x from the point to the corners, more than ``radius``.
        offset: float32, how far the window's middle lies above the point, in half cells.
        radius: float32, of the disc, in half cells: the margin.
        rows, rises, tops, row, start, n, steepest: as for :func:`_steepen`.
    """
    none, rest = np.float32(-np.inf), distance * distance - radius * radius
    along, over = distance / rest, radius / rest
    for i in range(np.uint64(n)):
        y = rises[row + i] + offset
        rise = along * y - over * np.sqrt(y * y + rest)
        rise = rise if rows[row + i] == tops[start + i] else none
        steepest[i] = max(steepest[i], rise)


@njit(cache=True)
def _mark_high(
    rows: Any, rises: Any, tops: Any, row: Any, start: Any, n: int, offset: Any, low: Any,
    marks: Any,
) -> None:  # fmt: skip
    """Mark each of n neighbouring windows that has contact above ``low`` in a row of its cells.

    Args:
        offset: float32, how far the window's middle lies above the point, in half cells.
        low: float32, height above the point, in half cells.
        marks: uint8 [≥ n], marked.
        rows, rises, tops, row, start, n: as for :func:`_steepen`.
    """
    for i in range(np.uint64(n)):
        high = rises[row + i] + offset > low
        marks[i] |= np.uint8(high & (rows[row + i] == tops[start + i]))


@njit(cache=True)
def _discs_inside(
    tops: Any, rows: Any, rises: Any, depth: int, w: int, point: Any, radius: float, out: Any
) -> None:
    """Write for each undecided window whether a disc lies inside the hull of its contact.

    This is :func:`inside` for many windows at a time, as in :func:`_middles_inside`. Seen from the
    disc's centre, the hull passes above the disc iff the steepest tangents from corners on the left
    and on the right add up to more than 0; the same holds below. Corners close to the centre along
    x can only make it pass, if they are above it. Windows that float32 cannot decide are UNSURE.

    Args:
        tops, rows, rises, depth, w: as for :func:`_middles_inside`.
        point: the disc's centre: x from the window's low corner, and its distance beyond the
            window's middle along y, in half cells.
        radius: of the disc, in half cells.
        out: uint8 [W · D], written at the undecided positions: OUTSIDE, INSIDE or UNSURE.
    """
    steepest = np.empty((2, 2, AT_ONCE), np.float32)  # in each direction, left and right
    close, band = np.empty((2, AT_ONCE), np.uint8), radius + BAND
    for start in range(0, tops.size, AT_ONCE):
        n = min(AT_ONCE, tops.size - start)
        if not _any_undecided(tops, start, n):
            continue
        steepest[:] = np.float32(-np.inf)
        close[:] = 0
        for x in range(w):
            row, first = np.uint64(start + x * depth), np.uint64(start)
            if not _in_contact(rows, tops, row, first, n):
                continue
            for corner in (2 * x - point[0], 2 * x + 2 - point[0]):
                for side in range(2):
                    offset = np.float32(point[1] if side else -point[1])
                    if abs(corner) <= band:
                        low = np.float32(0 if abs(corner) <= radius else -np.inf)
                        _mark_high(rows, rises[side], tops, row, first, n, offset, low, close[side])
                        continue
                    _steepen_over_disc(
                        rows, rises[side], tops, row, first, n, np.float32(abs(corner)), offset,
                        np.float32(radius), steepest[side, int(corner > 0)],
                    )  # fmt: skip
        for i in range(n):
            if tops[start + i] < 0:
                continue
            verdict = INSIDE
            for side in range(2):
                left, right = steepest[side, 0, i], steepest[side, 1, i]
                error = TOLERANCE * (1 + abs(left) + abs(right))
                if left + right < -error and not close[side, i]:
                    verdict = OUTSIDE
                elif not left + right > error and verdict == INSIDE:
                    verdict = UNSURE
            out[start + i] = verdict


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
def _is_much(codes: Any, positions: int, window: int, cells: int) -> bool:
    """Return whether the undecided windows have many more cells together than the map.

    Args:
        codes: uint8 [W · D], the windows' codes.
        positions: number of codes to count.
        window: cells of a window.
        cells: cells of the map.
    """
    undecided = 0
    for position in range(positions):
        undecided += codes[position] == UNDECIDED
    return undecided * window > READ_CELLS * cells


@njit(cache=True)
def _undecided_levels(codes: Any, best: Any, tops: Any) -> None:
    """Write the largest K of each undecided window to ``tops`` int32 [P], -1 for the others."""
    for position in range(tops.size):
        tops[position] = best[position] if codes[position] == UNDECIDED else -1


@njit(cache=True)
def solve_middles(
    codes: Any, best: Any, levels: Any, w: int, d: int, scratch: Any, out: Any
) -> None:
    """Write whether the middle of each UNDECIDED window lies inside the hull: OUTSIDE or INSIDE.

    The arguments are those of :func:`solve_undecided`.
    """
    width, depth = levels.shape
    cells, positions = width * depth, (width - w) * depth + depth - d + 1
    exact = np.int64(w) * d <= FLOAT32_CELLS
    if exact and _is_much(codes, positions, np.int64(w) * d, cells):
        numbers, rises = np.empty((5, cells), np.int32), np.empty((2, cells), np.float32)
        tops = numbers[4, :positions]
        _undecided_levels(codes, best, tops)
        _row_windows(levels.reshape(cells), depth, d, numbers[:3], numbers[3], rises)
        _middles_inside(tops, numbers[3], rises, depth, w, d, out.reshape(cells))
        return
    lo, hi = scratch[0, :w, 0], scratch[0, :w, 1]
    for position in range(positions):
        if codes[position] == UNDECIDED:
            x, y = position // depth, position % depth
            _level_extremes(levels, x, y, w, d, best[position], lo, hi)
            out[x, y] = middle_inside(lo, hi, d)


@njit(cache=True)
def _solve_together(
    codes: Any, best: Any, levels: Any, depth: int, w: int, d: int, x: float, y: float, unit: float,
    margin: float, whole: bool, scratch: Any, out: Any,
) -> int:  # fmt: skip
    """Do the work of :func:`solve_undecided`, for many windows at a time unless one is near a tie.

    ``levels`` and ``out`` are flat here.
    """
    numbers, rises = np.empty((5, levels.size), np.int32), np.empty((2, levels.size), np.float32)
    rows, tops = numbers[3], numbers[4, : codes.size]
    _undecided_levels(codes, best, tops)
    _row_windows(levels, depth, d, numbers[:3], rows, rises)
    if np.int64(w) * d <= FLOAT32_CELLS:
        half = 2 / unit
        point = x * half, y * half - d
        _discs_inside(tops, rows, rises, depth, w, point, margin * half, out)
        for position in range(codes.size):
            tops[position] = tops[position] if out[position] == UNSURE else -1
    lo, hi = scratch[0, :w, 0], scratch[0, :w, 1]
    unsure = 0
    for position in range(codes.size):
        if tops[position] < 0:
            continue
        for i in range(w):
            cell = position + i * depth
            contact = rows[cell] == tops[position]
            lo[i] = (d - np.int64(rises[1, cell])) // 2 if contact else d
            hi[i] = (d + np.int64(rises[0, cell])) // 2 - 1 if contact else -1
        out[position] = inside(lo, hi, scratch[1], scratch[2], x, y, unit, margin, whole)
        unsure += out[position] == UNSURE
    return unsure


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
    middle = whole and 2 * x == w * unit and 2 * y == d * unit
    if middle and margin == 0.0:
        solve_middles(codes, best, levels, w, d, scratch, out)
        return 0
    positions = (width - w) * depth + depth - d + 1
    if _is_much(codes, positions, np.int64(w) * d, width * depth):
        return _solve_together(
            codes[:positions], best, levels.reshape(width * depth), depth, w, d, x, y, unit, margin,
            whole, scratch, out.reshape(width * depth),
        )  # fmt: skip
    lo, hi = scratch[0, :w, 0], scratch[0, :w, 1]
    unsure = 0
    for position in range(positions):
        if codes[position] != UNDECIDED:
            continue
        cx, cy = position // depth, position % depth
        _level_extremes(levels, cx, cy, w, d, best[position], lo, hi)
        out[cx, cy] = inside(lo, hi, scratch[1], scratch[2], x, y, unit, margin, whole)
        unsure += out[cx, cy] == UNSURE
    return unsure
