"""Describe listed moves by numbers: what a placed box would touch, waste and leave.

A face touches another face, or a wall, that is at most the clearance away. All features are shares
or lengths relative to the bin or the box, so they do not depend on the unit.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_pack.exact.limits import Limits
from marl_pack.exact.moves import AXES, decode
from marl_pack.exact.rules import shared
from marl_pack.installation import njit

FEATURES = {
    "rest": "height of the bottom, as a share of the bin's height",
    "top": "height of the top, as a share of the bin's height",
    "bottom": "share of the box's surface that touches from below",
    "sides": "share of the surface that touches boxes at the sides",
    "walls": "share of the surface that touches walls",
    "waste": "space newly enclosed below the box, as a share of the column above its footprint",
    "level": "share of the four sides along which a touching box has the same top",
    "gap_x": "how far the next face along x is too close: 0 at no or a wide gap, 1 at a narrow one",
    "gap_y": "the same along y",
    "along_x": "distance of the middle from the nearest wall along x, as a share of W",
    "along_y": "the same along y, as a share of D",
    "footprint": "share of the bin's floor",
    "height": "own height as a share of the bin's",
}
"""The features in their order, each with what it is."""
(
    REST, TOP, BOTTOM, SIDES, WALLS, WASTE, LEVEL, GAP_X, GAP_Y, ALONG_X, ALONG_Y, FOOTPRINT, HEIGHT
) = range(len(FEATURES))  # fmt: skip


@njit(cache=True)
def make_columns(n: int) -> Any:
    """Return memory for :func:`enclosed_below` with n boxes, int64 [2n + 2, 5]."""
    return np.empty((2 * n + 2, 5), np.int64)


@njit(cache=True)
def enclosed_below(
    boxes: Any, n: int, x: int, y: int, z: int, w: int, d: int, columns: Any
) -> float:
    """Return the volume between a footprint at height ``z`` and the tops visible from above.

    The footprint is cut into strips along all edges in x. In each strip the boxes are visited from
    the highest to the lowest top, and each covers a part of what is still uncovered along y.

    Args:
        boxes: int32 [C, 10].
        n: number of boxes.
        x, y, z: low corner of the placed box.
        w, d: sides of its footprint.
        columns: memory (:func:`make_columns`).
    """
    tops, numbers, edges = columns[:, 0], columns[:, 1], columns[:, 2]
    low, high = columns[:, 3], columns[:, 4]  # the uncovered intervals along y
    edges[0], edges[1] = x, x + w
    below, cuts = 0, 2
    for j in range(n):
        x0, y0, x1, y1 = shared(boxes, j, x, y, w, d)
        if x0 < x1 and y0 < y1:
            top = boxes[j, 2] + boxes[j, 5]
            k = below  # keep the highest top first
            while k > 0 and tops[k - 1] < top:
                tops[k], numbers[k] = tops[k - 1], numbers[k - 1]
                k -= 1
            tops[k], numbers[k] = top, j
            below += 1
            edges[cuts], edges[cuts + 1] = x0, x1
            cuts += 2
    edges[:cuts].sort()
    volume = 0.0
    for strip in range(cuts - 1):
        left, right = edges[strip], edges[strip + 1]
        if left == right:
            continue
        low[0], high[0], uncovered = y, y + d, 1
        area = 0.0  # seen from the side
        for k in range(below):
            j = numbers[k]
            if boxes[j, 0] > left or boxes[j, 0] + boxes[j, 3] < right:
                continue
            first, last = boxes[j, 1], boxes[j, 1] + boxes[j, 4]
            i = 0
            while i < uncovered:
                a, b = max(low[i], first), min(high[i], last)
                if a >= b:
                    i += 1
                    continue
                area += float(b - a) * (z - tops[k])
                if high[i] > b:
                    if low[i] < a:  # the rest has two parts
                        low[uncovered], high[uncovered] = b, high[i]
                        uncovered += 1
                        high[i] = a
                    else:
                        low[i] = b
                elif low[i] < a:
                    high[i] = a
                else:
                    uncovered -= 1
                    low[i], high[i] = low[uncovered], high[uncovered]
                    continue
                i += 1
            if uncovered == 0:
                break
        for i in range(uncovered):
            area += float(high[i] - low[i]) * z
        volume += area * (right - left)
    return volume


@njit(cache=True)
def describe_place(size: Any, item: Any, move: int, out: Any) -> None:
    """Write the features that depend on the place alone; the arguments are as for ``describe``."""
    W, D, H = size[0], size[1], size[2]
    o, x, y, z = decode(move)
    w, d, h = item[AXES[o, 0]], item[AXES[o, 1]], item[AXES[o, 2]]
    out[REST], out[TOP] = z / H, (z + h) / H
    out[ALONG_X] = min(2 * x + w, 2 * (W - x) - w) / (2.0 * W)
    out[ALONG_Y] = min(2 * y + d, 2 * (D - y) - d) / (2.0 * D)
    out[FOOTPRINT] = float(w) * d / (float(W) * D)
    out[HEIGHT] = h / H


@njit(cache=True)
def describe_waste(
    size: Any, boxes: Any, n: int, item: Any, move: int, columns: Any, out: Any
) -> None:
    """Write the feature ``waste``; the arguments are as for ``describe``."""
    o, x, y, z = decode(move)
    w, d = item[AXES[o, 0]], item[AXES[o, 1]]
    out[WASTE] = 0.0
    if z > 0:
        volume = enclosed_below(boxes, n, x, y, z, w, d, columns)
        out[WASTE] = volume / (float(w) * d * size[2])


@njit(cache=True)
def describe_contacts(
    limits: Limits, size: Any, boxes: Any, n: int, item: Any, move: int, out: Any
) -> None:
    """Write the features of faces and gaps; the arguments are as for ``describe``."""
    W, D = size[0], size[1]
    near = limits.clearance
    o, x, y, z = decode(move)
    w, d, h = item[AXES[o, 0]], item[AXES[o, 1]], item[AXES[o, 2]]
    surface = 2.0 * (float(w) * d + float(w) * h + float(d) * h)
    bottom = float(w) * d if z == 0 else 0.0
    sides, level = 0.0, 0
    walls = float(d) * h * (int(x <= near) + int(x + w >= W - near))
    walls += float(w) * h * (int(y <= near) + int(y + d >= D - near))
    low_x, high_x, low_y, high_y = x, W - x - w, y, D - y - d  # distances to the nearest faces
    for j in range(n):
        low, high = boxes[j, 2], boxes[j, 2] + boxes[j, 5]
        if high < z - limits.tolerance:  # all others are lower still
            break
        x0, y0, x1, y1 = shared(boxes, j, x, y, w, d)
        along_x, along_y = x1 - x0, y1 - y0
        if along_x <= 0 and along_y <= 0:
            continue
        if along_x > 0 and along_y > 0:
            if high <= z and z - high <= limits.tolerance:
                bottom += float(along_x) * along_y
            continue
        tall = min(high, z + h) - max(low, z)
        if tall <= 0:
            continue
        if along_y > 0:
            gap, along, length = -along_x, along_y, float(along_y)
            if boxes[j, 0] >= x + w:
                high_x = min(high_x, gap)
            else:
                low_x = min(low_x, gap)
        else:
            gap, along, length = -along_y, along_x, float(along_x)
            if boxes[j, 1] >= y + d:
                high_y = min(high_y, gap)
            else:
                low_y = min(low_y, gap)
        if gap <= near:
            sides += length * tall
            if abs(high - z - h) <= limits.tolerance:
                level += along
    out[BOTTOM], out[SIDES], out[WALLS] = bottom / surface, sides / surface, walls / surface
    out[LEVEL] = level / (2.0 * (w + d))
    out[GAP_X] = _narrow(low_x, w, near) + _narrow(high_x, w, near)
    out[GAP_Y] = _narrow(low_y, d, near) + _narrow(high_y, d, near)


@njit(cache=True)
def describe(
    limits: Limits, size: Any, boxes: Any, n: int, item: Any, move: int, columns: Any, out: Any
) -> None:
    """Compute all features of one move.

    Args:
        limits: clearance and level tolerance.
        size: int64 [3], W, D, H.
        boxes: int32 [C, 10], the highest top first (:func:`marl_pack.exact.moves.by_top`).
        n: number of boxes.
        item: int64 [3], the item's own sides.
        move: the move.
        columns: memory (:func:`make_columns`).
        out: float64 [F], written.
    """
    describe_place(size, item, move, out)
    describe_contacts(limits, size, boxes, n, item, move, out)
    describe_waste(size, boxes, n, item, move, columns, out)


@njit(cache=True, inline="always")
def _narrow(gap: int, side: int, near: int) -> float:
    """Return how much too narrow a gap is for another box of this side: 0 … 0.5."""
    return 0.5 * (1.0 - gap / side) if near < gap < side else 0.0
