"""Convex polygons whose corners lie on a fine lattice, in whole numbers only.

A unit of length has :data:`marl_pack.exact.limits.SCALE` lattice points. A polygon that is cut by a
rectangle is rounded inward to the lattice, so it is never larger than the exact polygon, and every
test on it is exact. Coordinates are int64 and below 2²⁸, so the products of two differences fit
into int64.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

from marl_pack.installation import njit

FAR = 1 << 62
ROUNDING = 1e-12
"""Bound on the relative error of a product with a square root in float64."""


@njit(cache=True)
def convex_hull(points: Any, n: int, hull: Any) -> int:
    """Find the convex hull of points, counter-clockwise (Andrew's monotone chain).

    Args:
        points: int64 [≥ n, 2]; the first n are sorted in place.
        n: number of points.
        hull: int64 [≥ 2n + 1, 2], written.

    Returns:
        The number of corners of the hull; fewer than 3 if it has no area.
    """
    for i in range(1, n):
        px, py = points[i, 0], points[i, 1]
        k = i - 1
        while k >= 0 and (points[k, 0] > px or (points[k, 0] == px and points[k, 1] > py)):
            points[k + 1, 0], points[k + 1, 1] = points[k, 0], points[k, 1]
            k -= 1
        points[k + 1, 0], points[k + 1, 1] = px, py
    size = 0
    for chain in range(2):  # from the first point to the last one, and back
        base = size
        for step in range(n):
            i = step if chain == 0 else n - 1 - step
            px, py = points[i, 0], points[i, 1]
            while size - base >= 2:
                ax, ay = hull[size - 2, 0], hull[size - 2, 1]
                bx, by = hull[size - 1, 0], hull[size - 1, 1]
                if (bx - ax) * (py - ay) - (by - ay) * (px - ax) > 0:
                    break
                size -= 1
            hull[size, 0], hull[size, 1] = px, py
            size += 1
        size -= 1  # the last point of a chain is the first one of the next
    return size


@njit(cache=True)
def deeper(hull: Any, size: int, x: int, y: int, margin: int) -> bool:
    """Return whether a point lies more than ``margin`` inside every edge of a polygon.

    If rounding errors could change the answer for a slanted edge, it is False.

    Args:
        hull: int64 [≥ size, 2], corners counter-clockwise.
        size: number of corners; with fewer than 3 the polygon has no inside.
        x: the point's x.
        y: the point's y.
        margin: lattice points, ≥ 0.
    """
    if size < 3:
        return False
    ax, ay = hull[size - 1, 0], hull[size - 1, 1]
    for i in range(size):
        bx, by = hull[i, 0], hull[i, 1]
        ex, ey = bx - ax, by - ay
        area = ex * (y - ay) - ey * (x - ax)
        if area <= 0:
            return False
        if margin > 0:
            if ex == 0 or ey == 0:
                if area <= margin * (abs(ex) + abs(ey)):
                    return False
            elif area <= margin * sqrt(float(ex) * ex + float(ey) * ey) * (1 + ROUNDING):
                return False
        ax, ay = bx, by
    return True


@njit(cache=True)
def _chord(polygon: Any, size: int, axis: int, at: int) -> tuple[int, int]:
    """Return the lattice points that a polygon shares with a line, as first and last coordinate.

    Args:
        polygon: whole numbers [≥ size, 2], a convex polygon.
        size: number of corners.
        axis: 0 for the line x = ``at``, 1 for y = ``at``.
        at: position of the line.

    Returns:
        The coordinates along the line, rounded inward; first > last if there is no such point.
    """
    low, high = FAR, -FAR
    ax, ay = polygon[size - 1, axis], polygon[size - 1, 1 - axis]
    for i in range(size):
        bx, by = polygon[i, axis], polygon[i, 1 - axis]
        if min(ax, bx) <= at <= max(ax, bx):
            if ax == bx:
                low, high = min(low, ay, by), max(high, ay, by)
            else:
                run, rise = (bx - ax, (by - ay) * (at - ax))
                if run < 0:
                    run, rise = -run, -rise
                below = rise // run
                low = min(low, ay + below + (below * run != rise))
                high = max(high, ay + below)
        ax, ay = bx, by
    return low, high


@njit(cache=True)
def clip(polygon: Any, size: int, x0: int, y0: int, x1: int, y1: int, points: Any, n: int) -> int:
    """Append lattice points whose hull is the part of a polygon inside a rectangle.

    Corners of the part that do not lie on the lattice are rounded inward along the rectangle's
    side, so the hull lies inside the exact part.

    Args:
        polygon: whole numbers [≥ size, 2], a convex polygon; with fewer than 3 corners it is empty.
        size: number of corners.
        x0, y0, x1, y1: the rectangle.
        points: int64 [≥ n + size + 8, 2], written from row n on.
        n: number of points so far.

    Returns:
        The number of points.
    """
    if size < 3:
        return n
    for i in range(size):
        px, py = polygon[i, 0], polygon[i, 1]
        if x0 <= px <= x1 and y0 <= py <= y1:
            points[n, 0], points[n, 1] = px, py
            n += 1
    for axis in range(2):
        first, last = (y0, y1) if axis == 0 else (x0, x1)
        for at in (x0, x1) if axis == 0 else (y0, y1):
            low, high = _chord(polygon, size, axis, at)
            low, high = max(low, first), min(high, last)
            if low <= high:
                points[n, axis], points[n, 1 - axis] = at, low
                points[n + 1, axis], points[n + 1, 1 - axis] = at, high
                n += 2
    return n


@njit(cache=True, inline="always")
def add_rectangle(x0: int, y0: int, x1: int, y1: int, points: Any, n: int) -> int:
    """Append the corners of a rectangle; return the number of points."""
    points[n, 0], points[n, 1] = x0, y0
    points[n + 1, 0], points[n + 1, 1] = x1, y0
    points[n + 2, 0], points[n + 2, 1] = x1, y1
    points[n + 3, 0], points[n + 3, 1] = x0, y1
    return n + 4


@njit(cache=True, inline="always")
def is_rectangle(polygon: Any) -> bool:
    """Return whether a polygon of four corners is a rectangle along the axes.

    The corners are counter-clockwise and begin with the lowest x, then y, as in a convex hull.
    """
    return bool(
        polygon[1, 1] == polygon[0, 1]
        and polygon[2, 0] == polygon[1, 0]
        and polygon[3, 0] == polygon[0, 0]
        and polygon[3, 1] == polygon[2, 1]
    )


@njit(cache=True, inline="always")
def has_area(points: Any, first: int, last: int) -> bool:
    """Return whether the part that :func:`clip` appended has an area.

    The common part of a convex polygon and a rectangle that has none is a point, or a segment along
    a side of the rectangle. It cannot carry a load: the smallest shift would leave it.

    Args:
        points: int64 [≥ last, 2].
        first, last: the rows of the part.
    """
    if first == last:
        return False
    low_x = high_x = points[first, 0]
    low_y = high_y = points[first, 1]
    for i in range(first + 1, last):
        low_x, high_x = min(low_x, points[i, 0]), max(high_x, points[i, 0])
        low_y, high_y = min(low_y, points[i, 1]), max(high_y, points[i, 1])
    return low_x < high_x and low_y < high_y
