"""List the placements of one box in a bin: candidates at box edges that fit and stand.

Candidates are *event points*: a side of the box lies at an edge of a placed box or at a wall, along
x and along y, in each allowed orientation. With a clearance the side may also lie this far from the
edge, and walls are kept at this distance. A candidate rests at its exact height, on the highest top
under its footprint. Orientations that make the same box are listed once.

A move is one whole number, :func:`encode`. The numbers of moves are in the order of z, x, y, then
orientation.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_pack.exact.limits import Limits
from marl_pack.exact.rules import NO, YES, Scratch, find_contacts, make_scratch, shared, verdict
from marl_pack.geometry import ORIENTATIONS
from marl_pack.installation import njit

BITS = 20
"""Bits of a coordinate: more than MOST_UNITS needs."""
MASK = (1 << BITS) - 1
AXES = np.array(ORIENTATIONS, np.int64)


@njit(cache=True, inline="always")
def encode(o: int, x: int, y: int, z: int) -> int:
    """Return the number of a move: orientation and low corner in units."""
    return ((((z << BITS) | x) << BITS) | y) << 3 | o


@njit(cache=True, inline="always")
def decode(move: int) -> tuple[int, int, int, int]:
    """Return the orientation and the low corner x, y, z of a move."""
    return move & 7, (move >> (3 + BITS)) & MASK, (move >> 3) & MASK, move >> (3 + 2 * BITS)


@njit(cache=True)
def _positions(
    boxes: Any, n: int, axis: int, length: int, side: int, clearance: int, out: Any
) -> int:
    """Write the sorted positions along an axis at which a side lies at an edge; return their count.

    Args:
        boxes: int32 [≥ n, 10].
        n: number of boxes.
        axis: 0 for x, 1 for y.
        length: length of the bin along the axis.
        side: length of the box along the axis.
        clearance: distance to walls, and further distance to edges.
        out: int64 [≥ 8n + 4], written.
    """
    k = 0
    last = length - side - clearance
    if last < clearance:
        return 0
    out[0], out[1] = clearance, last
    k = 2
    for j in range(n):
        for end in range(2):
            edge = boxes[j, axis] + end * boxes[j, 3 + axis]
            out[k], out[k + 1] = edge, edge - side
            k += 2
            if clearance > 0:
                out[k], out[k + 1] = edge + clearance, edge - side - clearance
                k += 2
    out[:k].sort()
    size = 0
    for i in range(k):
        if clearance <= out[i] <= last and (size == 0 or out[i] != out[size - 1]):
            out[size] = out[i]
            size += 1
    return size


@njit(cache=True)
def _faces(
    boxes: Any, n: int, axis: int, side: int, clearance: int, positions: Any, count: int, out: Any
) -> None:
    """Find at which positions along an axis a face may touch a box.

    Args:
        boxes, n, axis, side, clearance: as for :func:`_positions`.
        positions: int64 [≥ count].
        count: number of positions.
        out: uint8 [≥ count], written: 1 if the low face is at most the clearance from the edge of a
            box before it, plus 2 if the high face is from one behind it.
    """
    for i in range(count):
        low, high = positions[i], positions[i] + side
        flags = 0
        for j in range(n):
            start = boxes[j, axis]
            if 0 <= low - start - boxes[j, 3 + axis] <= clearance:
                flags |= 1
            if 0 <= start - high <= clearance:
                flags |= 2
        out[i] = flags


@njit(cache=True)
def resting_height(boxes: Any, n: int, x: int, y: int, w: int, d: int, clearance: int) -> int:
    """Return the height at which a footprint rests; -1 if a neighbour is within the clearance."""
    z, tallest = 0, 0
    for j in range(n):
        top = boxes[j, 2] + boxes[j, 5]
        if top > tallest or top > z:
            x0, y0, x1, y1 = shared(boxes, j, x, y, w, d)
            if x1 - x0 > -clearance and y1 - y0 > -clearance:
                tallest = max(tallest, top)
                if x0 < x1 and y0 < y1:
                    z = max(z, top)
    return z if tallest <= z else -1


@njit(cache=True)
def same_sides(item: Any, o: int, allowed: Any) -> bool:
    """Return whether an earlier allowed orientation places the item with the same sides."""
    for earlier in range(o):
        if allowed[earlier]:
            same = True
            for axis in range(3):
                same &= item[AXES[earlier, axis]] == item[AXES[o, axis]]
            if same:
                return True
    return False


@njit(cache=True)
def by_top(boxes: Any, n: int) -> Any:
    """Return the rows of n boxes, the highest top first, [n, 10]."""
    keys = np.empty(n, np.int64)
    for j in range(n):
        keys[j] = (np.int64(boxes[j, 2] + boxes[j, 5]) << BITS) | j
    keys.sort()
    rows = np.empty((n, boxes.shape[1]), boxes.dtype)
    for j in range(n):
        rows[j] = boxes[keys[n - 1 - j] & MASK]
    return rows


@njit(cache=True)
def candidates(
    limits: Limits, size: Any, boxes: Any, n: int, item: Any, allowed: Any, out: Any, faces: Any
) -> int:
    """List the event points at which a box fits into a bin, whether it stands there or not.

    Args:
        limits: clearance and level tolerance.
        size: int64 [3], W, D, H.
        boxes: int32 [≥ n, 10], the highest top first (:func:`by_top`).
        n: number of boxes.
        item: int64 [3], the item's own sides w, d, h.
        allowed: bool [6], orientations it may be placed in.
        out: int64 [M], written: the moves in no order, as many as there is room for.
        faces: uint8 [M], written: the faces of the box that may touch others, bits in the order of
            low x, high x, low y, high y; or an empty array.

    Returns:
        The number of moves; if it is larger than M, ``out`` is incomplete.
    """
    xs, ys = np.empty(8 * n + 4, np.int64), np.empty(8 * n + 4, np.int64)
    strip = np.empty((n, 4), np.int64)  # low y, high y, top, whether it shares x with the footprint
    faces_x, faces_y = np.zeros(8 * n + 4, np.uint8), np.zeros(8 * n + 4, np.uint8)
    gap = limits.clearance
    total = 0
    for o in range(6):
        w, d, h = item[AXES[o, 0]], item[AXES[o, 1]], item[AXES[o, 2]]
        if not allowed[o] or h > size[2] or same_sides(item, o, allowed):
            continue
        n_x = _positions(boxes, n, 0, size[0], w, gap, xs)
        n_y = _positions(boxes, n, 1, size[1], d, gap, ys)
        if faces.size:
            _faces(boxes, n, 0, w, gap, xs, n_x, faces_x)
            _faces(boxes, n, 1, d, gap, ys, n_y, faces_y)
        for i in range(n_x):
            x = xs[i]
            m = 0
            for j in range(n):
                low = boxes[j, 0]
                high = low + boxes[j, 3]
                if low < x + w + gap and high > x - gap:
                    strip[m, 0] = boxes[j, 1]
                    strip[m, 1] = boxes[j, 1] + boxes[j, 4]
                    strip[m, 2] = boxes[j, 2] + boxes[j, 5]
                    strip[m, 3] = low < x + w and high > x
                    m += 1
            for k in range(n_y):
                z = _rest(strip, m, ys[k], d, gap)
                if 0 <= z <= size[2] - h:
                    if total < out.size:
                        out[total] = encode(o, x, ys[k], z)
                        if faces.size:
                            faces[total] = faces_x[i] | faces_y[k] << 2
                    total += 1
    return total


@njit(cache=True, inline="always")
def _rest(strip: Any, m: int, y: int, d: int, gap: int) -> int:
    """Return where a footprint rests on the first m rows of a strip; -1 if a neighbour is too near.

    The rows are in the order of their tops, the highest first.
    """
    for k in range(m):
        if strip[k, 0] < y + d + gap and strip[k, 1] > y - gap:
            top = strip[k, 2]  # nothing is higher within the clearance: the box has to rest on it
            for i in range(k, m):
                if strip[i, 2] < top:
                    break
                if strip[i, 3] and strip[i, 0] < y + d and strip[i, 1] > y:
                    return int(top)
            return -1
    return 0


@njit(cache=True, inline="always")
def rests_on_blocked(
    limits: Limits, boxes: Any, n: int, blocked: Any, x: int, y: int, z: int, w: int, d: int
) -> bool:
    """Return whether a footprint at height ``z`` touches a box on which it may not rest.

    The space of rotated boxes counts, not the rectangle that carries.
    """
    if z == 0:
        return False
    for j in range(n):
        if blocked[j] and 0 <= z - boxes[j, 2] - boxes[j, 5] <= limits.tolerance:
            x0, y0, x1, y1 = shared(boxes, j, x, y, w, d)
            if x0 < x1 and y0 < y1:
                return True
    return False


@njit(cache=True, inline="always")
def stands(
    limits: Limits, boxes: Any, n: int, starts: Any, parts: Any, blocked: Any, item: Any,
    scratch: Scratch, move: int,
) -> int:  # fmt: skip
    """Return whether a box may stand at a move that fits: NO, YES or OPEN.

    Args:
        limits: what a placement has to satisfy.
        boxes: int32 [C, 10].
        n: number of boxes.
        starts, parts: the carrying parts (:func:`marl_pack.exact.rules.gather`).
        blocked: bool [C], boxes on which this item may not rest.
        item: int64 [3], the item's own sides.
        scratch: memory.
        move: the move.
    """
    o, x, y, z = decode(move)
    w, d = item[AXES[o, 0]], item[AXES[o, 1]]
    k = 0
    if z > 0:
        if rests_on_blocked(limits, boxes, n, blocked, x, y, z, w, d):
            return NO
        k = find_contacts(boxes, n, x, y, z, w, d, limits.tolerance, scratch.touching)
    return verdict(limits, boxes, starts, parts, scratch, k, x, y, z, w, d)


@njit(cache=True)
def list_moves(
    limits: Limits, size: Any, boxes: Any, n: int, starts: Any, parts: Any, blocked: Any,
    item: Any, allowed: Any, out: Any, verdicts: Any,
) -> int:  # fmt: skip
    """List the moves of one box in one bin: the candidates that stand, in order.

    Args:
        limits, size, boxes, n, item, allowed: as for :func:`candidates`.
        starts, parts, blocked: as for :func:`stands`.
        out: int64 [M], written: the moves.
        verdicts: uint8 [M], written: YES or OPEN for each move.

    Returns:
        The number of moves; or, if ``out`` has no room for the candidates, minus the room needed.
    """
    faces = np.empty(0, np.uint8)
    fitting = candidates(limits, size, by_top(boxes, n), n, item, allowed, out, faces)
    if fitting > out.size:
        return -fitting
    scratch = make_scratch(n, starts[n])
    total, all_sure = 0, True
    for m in range(fitting):
        answer = stands(limits, boxes, n, starts, parts, blocked, item, scratch, out[m])
        if answer != NO:
            out[total], verdicts[total] = out[m], answer
            all_sure &= answer == YES
            total += 1
    if all_sure:
        out[:total].sort()
    else:
        order = np.argsort(out[:total])
        out[:total], verdicts[:total] = out[:total][order], verdicts[:total][order]
    return total


@njit(cache=True)
def moves_at(
    limits: Limits, size: Any, boxes: Any, n: int, starts: Any, parts: Any, blocked: Any,
    item: Any, allowed: Any, corners: Any, out: Any, verdicts: Any,
) -> int:  # fmt: skip
    """List the moves of one box at given corners, whether they are event points or not.

    Args:
        limits, size, boxes, n, starts, parts, blocked, item, allowed: as for :func:`list_moves`.
        corners: int64 [K, 2], low corners x, y in units.
        out: int64 [≥ 6K], written: the moves, orientation by orientation.
        verdicts: uint8 [≥ 6K], written: YES or OPEN for each move.

    Returns:
        The number of moves.
    """
    scratch = make_scratch(n, starts[n])
    gap, total = limits.clearance, 0
    for o in range(6):
        w, d, h = item[AXES[o, 0]], item[AXES[o, 1]], item[AXES[o, 2]]
        if not allowed[o]:
            continue
        for k in range(corners.shape[0]):
            x, y = corners[k]
            if min(x, y) < gap or x + w > size[0] - gap or y + d > size[1] - gap:
                continue
            z = resting_height(boxes, n, x, y, w, d, gap)
            if z < 0 or z + h > size[2]:
                continue
            move = encode(o, x, y, z)
            answer = stands(limits, boxes, n, starts, parts, blocked, item, scratch, move)
            if answer != NO:
                out[total], verdicts[total] = move, answer
                total += 1
    return total
