"""The definition of every rule, one window at a time, in plain NumPy.

Nothing here is fast. The batched code is tested cell by cell against these functions, which define
what a rule means. A cell is a unit square, not a point:
a support polygon is the convex hull of the corners of the contact squares, and a centre of mass
must lie strictly inside it. ``docs/environment.md`` lists where this departs from the paper.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Map = NDArray[np.integer]


def place_box(
    heightmap: Map, empty_map: Map, corner: tuple[int, int], sides: tuple[int, int, int]
) -> tuple[int, int]:
    """Place one box from above, in place (Algorithm 2); return resting height and wasted cells."""
    (x, y), (w, d, h) = corner, sides
    window = np.s_[x : x + w, y : y + d]
    z = int(heightmap[window].max())
    gap = z - heightmap[window]
    empty_map[window] += gap
    heightmap[window] = z + h
    return z, int(gap.sum())


def corners(cells: NDArray[np.bool_]) -> Points:
    """Return the corners of the unit squares of ``cells`` [w, d], as points [P, 2]."""
    xy = np.argwhere(cells)
    return np.unique(np.concatenate([xy + o for o in ((0, 0), (0, 1), (1, 0), (1, 1))]), axis=0)


def convex_hull(points: Points) -> Points:
    """Return the vertices of the convex hull, counter-clockwise (Andrew's monotone chain)."""

    def chain(ordered: list[tuple[float, float]]) -> list[tuple[float, float]]:
        out: list[tuple[float, float]] = []
        for p in ordered:
            while len(out) > 1 and cross(out[-2], out[-1], p) <= 0:
                out.pop()
            out.append(p)
        return out[:-1]

    ordered = sorted({(float(x), float(y)) for x, y in points})
    return np.array(chain(ordered) + chain(ordered[::-1]))


def cross(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Return twice the signed area of the triangle a, b, c; positive if c lies left of a → b."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def clearance(polygon: Points, point: tuple[float, float]) -> float:
    """Return the distance of ``point`` to the polygon's boundary lines; ≤ 0 on it or outside."""
    edges = zip(polygon, np.roll(polygon, -1, axis=0), strict=True)
    return min(
        cross(tuple(a), tuple(b), point) / float(np.hypot(*(b - a))) for a, b in edges
    )  # exact in sign: coordinates are whole or half cells


def supported(cells: NDArray[np.bool_], com: tuple[float, float], margin: float) -> bool:
    """Return whether ``com`` lies more than ``margin`` inside the hull of ``cells``' squares."""
    return bool(cells.any()) and clearance(convex_hull(corners(cells)), com) > margin


def hull(
    heights: Map, bearing: NDArray[np.bool_], com: tuple[float, float], margin: float = 0.0
) -> bool:
    """Return the verdict of ``hull_1``, ``hull_alpha`` and ``lbcp`` on one window.

    Only contact cells in ``bearing`` count. It is all true for hull_1 (the paper's p_f),
    ``empty_map == 0`` for hull_alpha (p_f', Algorithm 1) and :func:`lbcp_bearing` for lbcp.
    """
    return supported((heights == heights.max()) & bearing, com, margin)


def area_ratio(heights: Map, thresholds: tuple[tuple[float, int], ...]) -> bool:
    """Return the verdict of Zhao et al. 2021 by the supported share and corners of the bottom."""
    contact = heights == heights.max()
    count = int(contact[[0, 0, -1, -1], [0, -1, 0, -1]].sum())
    return any(
        contact.sum() > share * contact.size and count >= corners for share, corners in thresholds
    )


def lbcp_bearing(size: tuple[int, int], boxes: Map) -> NDArray[np.bool_]:
    """Return the cells [W, D] whose top carries any load, by load-bearable convex polygons.

    The floor carries everywhere. A box carries on those cells of its top whose whole square lies
    in the hull of the bearing squares it rests on (Gao et al. 2025, arXiv 2507.09123; testing only
    one corner of the square instead of all four would be unsound).
    """
    heightmap, empty_map = np.zeros(size, np.int64), np.zeros(size, np.int64)
    bearing = np.ones(size, dtype=np.bool_)
    for x, y, z, w, d, h in boxes:
        window = np.s_[x : x + w, y : y + d]
        cells = (heightmap[window] == z) & bearing[window]
        if cells.any():
            polygon = convex_hull(corners(cells))
            for i in range(w):
                for j in range(d):
                    square = [(i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)]
                    cells[i, j] = all(clearance(polygon, p) >= 0 for p in square)
        bearing[window] = cells
        place_box(heightmap, empty_map, (x, y), (w, d, h))
    return bearing


def window_mask(
    stands: Callable[[int, int], bool], heightmap: Map, item: tuple[int, int, int], bin_height: int
) -> NDArray[np.bool_]:
    """Return ``stands(x, y)`` where the window fits into the bin, bool [W, D] (Algorithm 1)."""
    (w, d, h), (width, depth) = item, heightmap.shape
    mask = np.zeros((width, depth), dtype=np.bool_)
    for x in range(width - w + 1):
        for y in range(depth - d + 1):
            window = heightmap[x : x + w, y : y + d]
            mask[x, y] = window.max() + h <= bin_height and stands(x, y)
    return mask
