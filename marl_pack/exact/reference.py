"""Define the rules on true rectangles in plain Python, for one box at a time.

These functions are slow. They define what a rule means, and tests compare the compiled code with
them. All numbers are whole or fractions, so nothing is rounded; compiled polygons are rounded
inward (:mod:`marl_pack.exact.polygons`).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from marl_pack.checks import exact
from marl_pack.stability.reference import Number, Point, convex_hull, cross, deeper, edges
from marl_pack.stability.static_equilibrium import in_equilibrium

Box = Sequence[int]
"""x, y, z, w, d, h in units."""
Polygon = list[Point]
Rectangle = tuple[int, int, int, int]
"""x0, y0, x1, y1."""


def resting_height(boxes: Sequence[Box], x: int, y: int, w: int, d: int) -> int:
    """Return the highest top under a footprint."""
    return max((b[2] + b[5] for b in boxes if shared(b, (x, y, 0, w, d, 0))), default=0)


def shared(a: Box, b: Box) -> Rectangle | None:
    """Return the rectangle that two boxes share seen from above; None if it has no area."""
    x0, y0 = max(a[0], b[0]), max(a[1], b[1])
    x1, y1 = min(a[0] + a[3], b[0] + b[3]), min(a[1] + a[4], b[1] + b[4])
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


def contacts(boxes: Sequence[Box], new: Box, tolerance: int = 0) -> list[tuple[int, Rectangle]]:
    """Return the boxes on which a box rests, each with the contact rectangle."""
    found = []
    for j, box in enumerate(boxes):
        rectangle = shared(box, new)
        if rectangle and 0 <= new[2] - box[2] - box[5] <= tolerance:
            found.append((j, rectangle))
    return found


def corners(rectangle: Rectangle) -> Polygon:
    """Return the corners of a rectangle, counter-clockwise."""
    x0, y0, x1, y1 = rectangle
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def clip(polygon: Polygon, rectangle: Rectangle) -> Polygon:
    """Return the part of a convex polygon inside a rectangle (Sutherland & Hodgman 1974).

    A part without an area is no part: it cannot carry a load, as the smallest shift would leave it.
    """
    for a, b in edges(corners(rectangle)):
        kept: Polygon = []
        for p, q in edges(polygon) if polygon else ():
            side_p, side_q = cross(a, b, p), cross(a, b, q)
            if side_p >= 0:
                kept.append(p)
            if side_p * side_q < 0:
                t = Fraction(side_p) / (side_p - side_q)
                kept.append((p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])))
        polygon = kept
    area = sum(p[0] * q[1] - p[1] * q[0] for p, q in edges(polygon)) if polygon else 0
    return polygon if area else []


def hull_of(points: Sequence[Point]) -> Polygon:
    """Return the convex hull of points, counter-clockwise."""
    return convex_hull(np.array(points, object).reshape(-1, 2))


def solid_parts(boxes: Sequence[Box], tolerance: int = 0) -> list[list[Rectangle]]:
    """Return for each box the parts of its top under which everything is filled (hull_alpha).

    The plane is cut along all edges of boxes; in each piece the boxes are walked from the floor up.
    """
    xs = sorted({value for b in boxes for value in (b[0], b[0] + b[3])})
    ys = sorted({value for b in boxes for value in (b[1], b[1] + b[4])})
    parts: list[list[Rectangle]] = [[] for _ in boxes]
    for (x0, x1), (y0, y1) in itertools.product(itertools.pairwise(xs), itertools.pairwise(ys)):
        piece = (x0, y0, 0, x1 - x0, y1 - y0, 0)
        height = 0
        over = [j for j, box in enumerate(boxes) if shared(box, piece)]
        for j in sorted(over, key=lambda j: boxes[j][2]):
            if boxes[j][2] - height > (tolerance if height else 0):
                break
            height = boxes[j][2] + boxes[j][5]
            parts[j].append((x0, y0, x1, y1))
    return parts


def load_bearing_polygons(boxes: Sequence[Box], tolerance: int = 0) -> list[Polygon]:
    """Return the load-bearable convex polygon of each box's top (Gao et al. 2025)."""
    polygons: list[Polygon] = []
    for i, box in enumerate(boxes):
        if box[2] == 0:
            polygons.append(corners((box[0], box[1], box[0] + box[3], box[1] + box[4])))
            continue
        points = [
            p
            for j, rectangle in contacts(boxes[:i], box, tolerance)
            for p in clip(polygons[j], rectangle)
        ]
        hull = hull_of(points) if points else []
        polygons.append(hull if len(hull) > 2 else [])
    return polygons


def stable(
    rule: str, boxes: Sequence[Box], new: Box, *, margin: Number = 0, tolerance: int = 0,
    thresholds: Sequence[tuple[float, int]] = (), loads: NDArray[np.float64] | None = None,
) -> bool:  # fmt: skip
    """Return whether a box may be placed by a rule.

    Args:
        rule: ``hull_1``, ``hull_alpha``, ``lbcp``, ``area_ratio`` or ``equilibrium``.
        boxes: the stack, in order of placement.
        new: the box; it rests on the stack or on the floor.
        margin: distance in units that the centre of mass keeps from the edge of its support.
        tolerance: units by which a supporting top may lie below the box.
        thresholds: pairs (share, corners) of area_ratio.
        loads: float64 [n + 1, 3], weight and centre of mass of each box, for ``equilibrium``; only
            without margin and tolerance. By default all densities are equal.
    """
    x, y, z, w, d, _ = new
    if z == 0:
        return True
    rectangles = contacts(boxes, new, tolerance)
    if rule == "equilibrium":
        return in_equilibrium([*map(list, boxes), list(new)], loads)
    if rule == "area_ratio":
        area = sum((r[2] - r[0]) * (r[3] - r[1]) for _, r in rectangles)
        four = [(x, y), (x + w, y), (x, y + d), (x + w, y + d)]
        count = sum(
            any(r[0] <= px <= r[2] and r[1] <= py <= r[3] for _, r in rectangles) for px, py in four
        )
        return any(area > exact(share) * w * d and count >= least for share, least in thresholds)
    points: Polygon = []
    if rule == "hull_1":
        points = [p for _, rectangle in rectangles for p in corners(rectangle)]
    elif rule == "hull_alpha":
        solid = solid_parts(boxes, tolerance)
        for j, _ in rectangles:
            for part in solid[j]:
                piece = (part[0], part[1], 0, part[2] - part[0], part[3] - part[1], 0)
                cut = shared(piece, new)
                points += corners(cut) if cut else []
    else:
        polygons = load_bearing_polygons(boxes, tolerance)
        points = [p for j, rectangle in rectangles for p in clip(polygons[j], rectangle)]
    hull = hull_of(points) if points else []
    centre = x + Fraction(w, 2), y + Fraction(d, 2)
    return len(hull) > 2 and deeper(hull, centre, exact(margin))
