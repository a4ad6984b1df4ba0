"""Decide the rule ``equilibrium``: does the whole stack stand, exactly, with one more box?

The linear program is that of :mod:`marl_pack.stability.reduced_equilibrium`, with forces at the
corners of true contact rectangles. Boxes on solid ground are left out. If rounding errors could
change the answer, whole numbers decide.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.checks import exact
from marl_pack.exact.limits import SCALE, Limits
from marl_pack.exact.moves import AXES, decode
from marl_pack.exact.rules import carried_by, find_contacts, make_scratch, margin_of
from marl_pack.exact.state import State
from marl_pack.installation import njit
from marl_pack.stability.exact_equilibrium import Load
from marl_pack.stability.reduced_equilibrium import UNSURE, YES, shifts_of, solve_exactly, stands


@njit(cache=True)
def _ground_points(state: State, b: int, boxes: Any, new_parts: Any) -> tuple[Any, Any, Any]:
    """Return the grounded boxes, and the points where the ground pushes the other boxes.

    Args:
        state: the bins.
        b: number of the bin.
        boxes: int64 [n + 1, 6], the bin's boxes and a new one, which is not grounded.
        new_parts: int64 [m, 4], rectangles of the new box's footprint that rest on filled ground.

    Returns:
        bool [n + 1]; float64 [n + 1, V, 2], from each box's low corner; int64 [n + 1], the numbers
        of points.
    """
    n = state.count[b]
    starts, parts = state.starts[b], state.parts[b]
    most = new_parts.shape[0]
    for i in range(n):
        if not state.grounded[b, i]:
            most = max(most, starts[i + 1] - starts[i])
    grounded = np.zeros(n + 1, np.bool_)
    points, count = np.zeros((n + 1, 4 * most, 2)), np.zeros(n + 1, np.int64)
    for i in range(n + 1):
        grounded[i] = i < n and state.grounded[b, i]
        if grounded[i]:
            continue
        rows = new_parts if i == n else parts[starts[i] : starts[i + 1]].astype(np.int64)
        for r in range(rows.shape[0]):
            for c in range(4):
                points[i, count[i], 0] = rows[r, 2 * (c % 2)] - boxes[i, 0]
                points[i, count[i], 1] = rows[r, 1 + 2 * (c // 2)] - boxes[i, 1]
                count[i] += 1
    return grounded, points, count


@njit(cache=True)
def _new_parts(limits: Limits, state: State, b: int, x: int, y: int, z: int, w: int, d: int) -> Any:
    """Return the parts of a footprint that rest on filled ground, int64 [m, 4]."""
    n, starts, parts = state.count[b], state.starts[b], state.parts[b]
    scratch = make_scratch(n, starts[n])
    boxes = state.boxes[b]
    k = find_contacts(boxes, n, x, y, z, w, d, limits.tolerance, scratch.touching)
    out, m = np.empty((starts[n], 4), np.int64), 0
    for t in range(k):
        j = scratch.touching[t]
        x0, y0, x1, y1 = carried_by(boxes, j, x, y, w, d)
        for r in range(starts[j], starts[j + 1]):
            a0, b0 = max(x0, parts[r, 0]), max(y0, parts[r, 1])
            a1, b1 = min(x1, parts[r, 2]), min(y1, parts[r, 3])
            if a0 < a1 and b0 < b1:
                out[m, 0], out[m, 1], out[m, 2], out[m, 3] = a0, b0, a1, b1
                m += 1
    return out[:m]


def in_balance(
    limits: Limits, state: State, b: int, item: NDArray[np.int64], weight: float, move: int
) -> bool:
    """Return whether bin ``b`` stands with one more box, in strict static equilibrium.

    With a margin, it has to stand wherever the new box's centre of mass lies within the margin.

    Args:
        limits: margin and level tolerance.
        state: the bins; they stand.
        b: number of the bin.
        item: int64 [3], the new box's own sides.
        weight: its weight.
        move: where it is placed.
    """
    o, x, y, z = decode(move)
    w, d, h = (int(item[axis]) for axis in AXES[o])
    n = int(state.count[b])
    boxes = np.vstack((state.boxes[b, :n, :6], (x, y, z, w, d, h))).astype(np.int64)
    loads = np.empty((n + 1, 3))
    loads[:, 0] = (*state.weights[b, :n], weight)
    loads[:, 1:] = boxes[:, :2] + boxes[:, 3:5] / 2
    parts = _new_parts(limits, state, b, x, y, z, w, d)
    grounded, points, count = _ground_points(state, b, boxes, parts)
    margin = exact(margin_of(limits, w, d)) / SCALE
    for shift in shifts_of(margin):
        moved = loads.copy()
        moved[n, 1:] += [float(s) for s in shift]
        answer = stands(boxes, moved, n, grounded, points, count, False, limits.tolerance)
        if answer == UNSURE:
            centre = [exact(float(c)) + s for c, s in zip(loads[n, 1:], shift, strict=True)]
            load = Load(exact(weight), *centre)
            standing = solve_exactly(
                boxes, loads[:n], load, grounded, points, count, False, limits.tolerance
            )
        else:
            standing = answer == YES
        if not standing:
            return False
    return True
