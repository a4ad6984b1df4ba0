"""Rotated rectangles: the footprints of boxes that are not along the axes.

A rectangle is given by its middle x, y, its sides w, d and its rotation in degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence


def inner_sides(w: float, d: float, cos: float, sin: float) -> tuple[float, float]:
    """Return the sides of a large rectangle along the axes inside a rotated rectangle w × d.

    A rectangle p × q with the same middle is inside if p · cos + q · sin ≤ w and
    p · sin + q · cos ≤ d. Either both hold with equality, or the shorter side alone binds.
    """
    if sin == 0:
        return w, d
    short = min(w, d)
    thin = short / (2 * sin), short / (2 * cos)  # the largest if one side alone binds
    candidates = [thin, thin[::-1]]
    double = cos * cos - sin * sin
    if double > 0:
        candidates.append(((w * cos - d * sin) / double, (d * cos - w * sin) / double))
    inside = [
        (p, q)
        for p, q in candidates
        if p > 0 and q > 0
        and p * cos + q * sin <= w * (1 + 1e-12) and p * sin + q * cos <= d * (1 + 1e-12)
    ]  # fmt: skip
    return max(inside, key=lambda sides: sides[0] * sides[1])


def overlap(a: Sequence[float], b: Sequence[float]) -> float:
    """Return by how much two rotated rectangles overlap, seen from above; negative for a gap.

    It is the least overlap along a side of one of the two (separating axis theorem).

    Args:
        a, b: middle x, y, sides w, d, and the rotation in degrees.
    """
    least = math.inf
    for one, other in ((a, b), (b, a)):
        cos, sin = math.cos(math.radians(one[4])), math.sin(math.radians(one[4]))
        turn = math.radians(other[4] - one[4])
        c, s = abs(math.cos(turn)), abs(math.sin(turn))
        dx, dy = other[0] - one[0], other[1] - one[1]
        along = abs(dx * cos + dy * sin), abs(dy * cos - dx * sin)
        reach = (other[2] * c + other[3] * s) / 2, (other[2] * s + other[3] * c) / 2
        least = min(least, one[2] / 2 + reach[0] - along[0], one[3] / 2 + reach[1] - along[1])
    return least


def corners(rectangle: Sequence[float]) -> list[tuple[float, float]]:
    """Return the four corners of a rotated rectangle, counterclockwise."""
    x, y, w, d, yaw = rectangle
    cos, sin = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    return [
        (x + cos * i * w / 2 - sin * j * d / 2, y + sin * i * w / 2 + cos * j * d / 2)
        for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]


def overlap_area(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the area that two rotated rectangles share (Sutherland and Hodgman 1974)."""
    polygon = corners(a)
    window = corners(b)
    for k in range(4):
        (x0, y0), (x1, y1) = window[k], window[(k + 1) % 4]
        sides = [(x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) for x, y in polygon]
        clipped = []
        for i, (x, y) in enumerate(polygon):
            (u, v), side, before = polygon[i - 1], sides[i], sides[i - 1]
            if (side >= 0) != (before >= 0):
                share = before / (before - side)
                clipped.append((u + share * (x - u), v + share * (y - v)))
            if side >= 0:
                clipped.append((x, y))
        polygon = clipped
    return (
        sum(polygon[i - 1][0] * y - polygon[i - 1][1] * x for i, (x, y) in enumerate(polygon)) / 2
    )
