"""The stability rules on true contact rectangles, for one box at a time.

A box rests on the highest tops under its footprint. Its *contacts* are the rectangles that it
shares with these tops, seen from above. The rules differ in what part of a top can carry a load:

- ``hull_1``: every part;
- ``hull_alpha``: the parts under which everything is filled down to the floor, kept as rectangles;
- ``lbcp``: the load-bearable convex polygon of the box below (Gao et al. 2025, arXiv 2507.09123):
  the convex hull of the load-bearing parts on which that box rests.

The centre of mass has to lie strictly inside the convex hull of the carrying parts, and more than
the margin away from its edge. ``equilibrium`` is decided in :mod:`marl_pack.exact.balance`, where
``hull_alpha`` is not sure and ``hull_1`` does not refuse. Names and meaning of the rules are those
of :mod:`marl_pack.stability`; on whole cells the verdicts are the same, but for ``lbcp``, where
cells round the polygons inward further.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from marl_pack.exact.limits import (
    AREA_RATIO,
    CARRIES,
    EQUILIBRIUM,
    HULL_1,
    HULL_ALPHA,
    LBCP,
    NONE,
    SCALE,
    Limits,
)
from marl_pack.exact.polygons import (
    add_rectangle,
    clip,
    convex_hull,
    deeper,
    has_area,
    is_rectangle,
)
from marl_pack.installation import njit

NO, YES, OPEN = 0, 1, 2
"""Verdicts; OPEN: the linear program of ``equilibrium`` decides."""


class Scratch(NamedTuple):
    """Memory for the tests of one stack."""

    touching: Any  # int64 [C]      the boxes on which a placement rests
    points: Any  # int64 [P, 2]
    hull: Any  # int64 [2P + 1, 2]


@njit(cache=True)
def make_scratch(count: int, rows: int) -> Scratch:
    """Return memory for a stack of ``count`` boxes whose carrying parts have ``rows`` rows."""
    p = 4 * rows + 12 * count + 16
    return Scratch(
        np.empty(count + 1, np.int64),
        np.empty((p, 2), np.int64),
        np.empty((2 * p + 1, 2), np.int64),
    )


@njit(cache=True, inline="always")
def shared(boxes: Any, j: int, x: int, y: int, w: int, d: int) -> tuple[int, int, int, int]:
    """Return the rectangle x0, y0, x1, y1 that box j shares with a footprint, seen from above.

    It is empty if x1 <= x0 or y1 <= y0.
    """
    return (
        max(boxes[j, 0], x),
        max(boxes[j, 1], y),
        min(boxes[j, 0] + boxes[j, 3], x + w),
        min(boxes[j, 1] + boxes[j, 4], y + d),
    )


@njit(cache=True, inline="always")
def carried_by(boxes: Any, j: int, x: int, y: int, w: int, d: int) -> tuple[int, int, int, int]:
    """Return the rectangle in which the top of box j can carry a footprint, as :func:`shared`."""
    return (
        max(boxes[j, CARRIES], x),
        max(boxes[j, CARRIES + 1], y),
        min(boxes[j, CARRIES + 2], x + w),
        min(boxes[j, CARRIES + 3], y + d),
    )


@njit(cache=True, inline="always")
def find_contacts(
    boxes: Any, n: int, x: int, y: int, z: int, w: int, d: int, tolerance: int, touching: Any
) -> int:
    """Find the boxes whose tops support a footprint at height ``z``; return their number.

    Args:
        boxes: int32 [≥ n, 10], rows of :class:`marl_pack.exact.state.State`.
        n: number of boxes.
        x, y, z: low corner of the placed box.
        w, d: sides of its footprint.
        tolerance: units by which a supporting top may lie below z.
        touching: int64 [≥ n], written.
    """
    k = 0
    for j in range(n):
        gap = z - boxes[j, 2] - boxes[j, 5]
        if 0 <= gap <= tolerance:
            x0, y0, x1, y1 = carried_by(boxes, j, x, y, w, d)
            if x0 < x1 and y0 < y1:
                touching[k] = j
                k += 1
    return k


@njit(cache=True, inline="always")
def gather(
    rule: int, boxes: Any, starts: Any, parts: Any, scratch: Scratch, k: int,
    x: int, y: int, w: int, d: int,
) -> tuple[int, bool]:  # fmt: skip
    """Collect points whose convex hull is that of the carrying parts under a footprint.

    Args:
        rule: HULL_1, HULL_ALPHA or LBCP.
        boxes: int32 [C, 10].
        starts: int64 [C + 1], first row of each box in ``parts``.
        parts: int32 [R, 4], of hull_alpha and equilibrium: rectangles x0, y0, x1, y1 in units; of
            lbcp: corners x, y of polygons in lattice points.
        scratch: ``touching`` holds the k supporting boxes; ``points`` is written.
        k: number of supporting boxes.
        x, y, w, d: the footprint.

    Returns:
        The number of points, and whether they are the corners of one rectangle.
    """
    n, pieces = 0, 0
    points = scratch.points
    for t in range(k):
        j = scratch.touching[t]
        x0, y0, x1, y1 = carried_by(boxes, j, x, y, w, d)
        if rule == HULL_1:
            n = add_rectangle(x0 * SCALE, y0 * SCALE, x1 * SCALE, y1 * SCALE, points, n)
            pieces += 1
        elif rule == HULL_ALPHA:
            for r in range(starts[j], starts[j + 1]):
                a0, b0 = max(x0, parts[r, 0]), max(y0, parts[r, 1])
                a1, b1 = min(x1, parts[r, 2]), min(y1, parts[r, 3])
                if a0 < a1 and b0 < b1:
                    n = add_rectangle(a0 * SCALE, b0 * SCALE, a1 * SCALE, b1 * SCALE, points, n)
                    pieces += 1
        else:
            first, size = starts[j], starts[j + 1] - starts[j]
            polygon = parts[first : first + size]
            if size == 4 and is_rectangle(polygon):
                a0, b0 = max(x0 * SCALE, polygon[0, 0]), max(y0 * SCALE, polygon[0, 1])
                a1, b1 = min(x1 * SCALE, polygon[2, 0]), min(y1 * SCALE, polygon[2, 1])
                if a0 < a1 and b0 < b1:
                    n = add_rectangle(a0, b0, a1, b1, points, n)
                    pieces += 1
            else:
                more = clip(
                    polygon, size, x0 * SCALE, y0 * SCALE, x1 * SCALE, y1 * SCALE, points, n
                )  # fmt: skip
                if has_area(points, n, more):
                    n = more
                    pieces += 2
    return n, pieces == 1


@njit(cache=True, inline="always")
def margin_of(limits: Limits, w: int, d: int) -> int:
    """Return the margin for a footprint in lattice points, rounded up."""
    top, bottom = limits.margin_share
    return min(limits.margin, -(-top * min(w, d) * SCALE // bottom))


@njit(cache=True, inline="always")
def inside(scratch: Scratch, n: int, rectangle: bool, x: int, y: int, margin: int) -> bool:
    """Return whether a point lies more than ``margin`` inside the hull of the first n points."""
    points = scratch.points
    if n < 3:
        return False
    low_x = high_x = points[0, 0]
    low_y = high_y = points[0, 1]
    for i in range(1, n):
        low_x, high_x = min(low_x, points[i, 0]), max(high_x, points[i, 0])
        low_y, high_y = min(low_y, points[i, 1]), max(high_y, points[i, 1])
    if min(x - low_x, high_x - x, y - low_y, high_y - y) <= margin:
        return False
    return rectangle or deeper(scratch.hull, convex_hull(points, n, scratch.hull), x, y, margin)


@njit(cache=True, inline="always")
def _area_ratio(
    limits: Limits, boxes: Any, touching: Any, k: int, x: int, y: int, w: int, d: int
) -> bool:
    """Return whether enough area and corners of a footprint are supported (Zhao et al. 2021)."""
    area, corners = 0, 0
    for t in range(k):
        x0, y0, x1, y1 = carried_by(boxes, touching[t], x, y, w, d)
        area += (x1 - x0) * (y1 - y0)
        corners += (int(x0 == x) + int(x1 == x + w)) * (int(y0 == y) + int(y1 == y + d))
    for top, bottom, least in limits.thresholds:
        if area * bottom > top * w * d and corners >= least:
            return True
    return False


@njit(cache=True, inline="always")
def _within_overhang(
    limits: Limits, boxes: Any, touching: Any, k: int, x: int, y: int, w: int, d: int
) -> bool:
    """Return whether at most the allowed share of each side lies beyond the supporting boxes."""
    top, bottom = limits.overhang
    if top >= bottom:
        return True
    low_x, low_y, high_x, high_y = x + w, y + d, x, y
    for t in range(k):
        x0, y0, x1, y1 = carried_by(boxes, touching[t], x, y, w, d)
        low_x, low_y = min(low_x, x0), min(low_y, y0)
        high_x, high_y = max(high_x, x1), max(high_y, y1)
    beyond_x, beyond_y = max(low_x - x, x + w - high_x), max(low_y - y, y + d - high_y)
    return beyond_x * bottom <= top * w and beyond_y * bottom <= top * d


@njit(cache=True, inline="always")
def verdict(
    limits: Limits, boxes: Any, starts: Any, parts: Any, scratch: Scratch, k: int,
    x: int, y: int, z: int, w: int, d: int,
) -> int:  # fmt: skip
    """Decide whether a box may rest on its k supporting boxes.

    The arguments are those of :func:`gather`.

    Returns:
        NO or YES; OPEN if the linear program of ``equilibrium`` has to decide.
    """
    margin = margin_of(limits, w, d)
    x2, y2 = x * SCALE + w * (SCALE // 2), y * SCALE + d * (SCALE // 2)  # the centre of mass
    if z == 0:
        on_floor = limits.rule >= HULL_1 and limits.margin_on_floor
        return YES if not on_floor or 2 * margin < min(w, d) * SCALE else NO
    if k == 0:  # only corners of rotated boxes are under it
        return NO
    if not _within_overhang(limits, boxes, scratch.touching, k, x, y, w, d):
        return NO
    if limits.rule == NONE:
        return YES
    if limits.rule == AREA_RATIO:
        stable = _area_ratio(limits, boxes, scratch.touching, k, x, y, w, d)
        return YES if stable else NO
    first = HULL_1 if limits.rule == EQUILIBRIUM else limits.rule
    n, rectangle = gather(first, boxes, starts, parts, scratch, k, x, y, w, d)
    if not inside(scratch, n, rectangle, x2, y2, margin):
        return NO
    if limits.rule == EQUILIBRIUM:
        n, rectangle = gather(HULL_ALPHA, boxes, starts, parts, scratch, k, x, y, w, d)
        return YES if inside(scratch, n, rectangle, x2, y2, margin) else OPEN
    return YES


@njit(cache=True)
def carrying_part(
    rule: int, boxes: Any, starts: Any, parts: Any, scratch: Scratch, k: int, new: Any, rows: Any
) -> int:
    """Compute the part of a new box's top that can carry a load.

    Args:
        rule, boxes, starts, parts, scratch, k: the arguments of :func:`gather`, for the stack
            without the new box.
        new: whole numbers [10], the row of the new box.
        rows: int64 [≥ P, 4], written: the rows of the new box in ``parts``.

    Returns:
        The number of rows; 0 if nothing can rest on the box, or the rule keeps no parts.
    """
    z, x, y = new[2], new[CARRIES], new[CARRIES + 1]
    w, d = new[CARRIES + 2] - x, new[CARRIES + 3] - y
    if rule == LBCP:
        if z == 0:
            n = add_rectangle(0, 0, w * SCALE, d * SCALE, scratch.points, 0)
            for i in range(n):
                scratch.points[i, 0] += x * SCALE
                scratch.points[i, 1] += y * SCALE
        else:
            n, _ = gather(rule, boxes, starts, parts, scratch, k, x, y, w, d)
        size = convex_hull(scratch.points, n, scratch.hull)
        if size < 3:
            return 0
        for i in range(size):
            rows[i, 0], rows[i, 1] = scratch.hull[i, 0], scratch.hull[i, 1]
        return size
    if rule != HULL_ALPHA and rule != EQUILIBRIUM:
        return 0
    m, area = 0, 0
    for t in range(k):
        j = scratch.touching[t]
        x0, y0, x1, y1 = carried_by(boxes, j, x, y, w, d)
        for r in range(starts[j], starts[j + 1]):
            a0, b0 = max(x0, parts[r, 0]), max(y0, parts[r, 1])
            a1, b1 = min(x1, parts[r, 2]), min(y1, parts[r, 3])
            if a0 < a1 and b0 < b1:
                rows[m, 0], rows[m, 1], rows[m, 2], rows[m, 3] = a0, b0, a1, b1
                area += (a1 - a0) * (b1 - b0)
                m += 1
    if z == 0 or area == w * d:
        rows[0, 0], rows[0, 1], rows[0, 2], rows[0, 3] = x, y, x + w, y + d
        m = 1
    return m
