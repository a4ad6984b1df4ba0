r"""Exact static equilibrium of a whole stack (Wang & Hauser, T-RO 2021).

A stack of boxes stands if vertical forces :math:`f \ge 0` at the corners of every contact
rectangle (box on box, box on floor) balance force and moment of every box, :math:`A f = w`. It
stands *strictly* if it still does after any small shift of the weights, that is if :math:`w` is in
the interior of the cone :math:`\{A f : f \ge 0\}`. Every box rests on contact of nonzero area, so
:math:`A` has full row rank and the interior is :math:`\{A f : f > 0\}`: the linear program
:math:`\max t,\ A f = w,\ f \ge t` decides, strictly standing iff its optimum is positive.

:func:`in_equilibrium` solves that program for a whole stack with SciPy's HiGHS and is the
reference for :mod:`marl_pack.stability.equilibrium_masks`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.sparse import csc_array

STRICT = 1e-9
"""Least force, in mean weights of the stack, that counts as positive. Sizes are small integers, so
true optima are either 0 up to rounding or larger by orders of magnitude; the tests check this gap.
HiGHS balances to 1e-7: weights that differ by more than ten million times are beyond it."""


def contacts(boxes: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find the contact rectangles of a stack.

    Args:
        boxes: int [n, 6], rows x, y, z, w, d, h.

    Returns:
        Pairs int64 [C, 2] of upper and lower box (-1: the floor), and rectangles int64 [C, 4] as
        x0, y0, x1, y1.
    """
    pairs, rectangles = [], []
    low, high = boxes[:, :3].astype(np.int64), (boxes[:, :3] + boxes[:, 3:]).astype(np.int64)
    for i in range(len(boxes)):
        if low[i, 2] == 0:
            pairs.append((i, -1))
            rectangles.append((*low[i, :2], *high[i, :2]))
        touching = np.flatnonzero(high[:, 2] == low[i, 2])
        for j in touching.tolist():
            x0, y0 = np.maximum(low[i, :2], low[j, :2])
            x1, y1 = np.minimum(high[i, :2], high[j, :2])
            if x0 < x1 and y0 < y1:
                pairs.append((i, j))
                rectangles.append((x0, y0, x1, y1))
    return (
        np.array(pairs, np.int64).reshape(-1, 2),
        np.array(rectangles, np.int64).reshape(-1, 4),
    )


def uniform_loads(boxes: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return weight and centre of mass of boxes [n, 6] of uniform density, float64 [n, 3]."""
    weight = np.prod(boxes[:, 3:].astype(np.float64), axis=1, keepdims=True)
    return np.hstack((weight, boxes[:, :2] + boxes[:, 3:5] / 2))


def least_force(boxes: NDArray[np.integer], loads: NDArray[np.float64] | None = None) -> float:
    """Compute the optimum of ``max t, A f = w, f ≥ t`` in mean weights of the stack.

    Args:
        boxes: int [n, 6], rows x, y, z, w, d, h.
        loads: float [n, 3], weight and x, y of each centre of mass; uniform density by default.

    Returns:
        The optimum; infinity for no boxes, -inf if no ``f ≥ 0`` balances the stack.
    """
    n = len(boxes)
    if n == 0:
        return np.inf
    loads = uniform_loads(boxes) if loads is None else loads
    pairs, rectangles = contacts(boxes)
    points = rectangles[:, [0, 1, 0, 3, 2, 1, 2, 3]].reshape(-1, 2)  # four corners of each
    upper, lower = np.repeat(pairs, 4, axis=0).T
    force = np.arange(len(points))
    box, sign = np.concatenate((upper, lower)), np.repeat((1.0, -1.0), len(points))
    force, points = np.concatenate((force, force)), np.concatenate((points, points))
    real = box >= 0
    box, sign, force, points = box[real], sign[real], force[real], points[real]
    arm = points - loads[box, 1:]
    columns = len(upper)
    a = csc_array(
        (
            np.concatenate((sign, sign * arm[:, 0], sign * arm[:, 1])),
            (np.concatenate((3 * box, 3 * box + 1, 3 * box + 2)), np.tile(force, 3)),
        ),
        shape=(3 * n, columns),
    )
    weight = np.zeros(3 * n)
    weight[::3] = loads[:, 0] / loads[:, 0].mean()
    # f = g + t with g ≥ 0:  A g + (A 1) t = w
    spread = csc_array(np.hstack((a.toarray(), a.sum(axis=1).reshape(-1, 1))))
    cost = np.zeros(columns + 1)
    cost[-1] = -1.0
    result = linprog(cost, A_eq=spread, b_eq=weight, bounds=(0, None), method="highs")
    return float(-result.fun) if result.status == 0 else -np.inf


def in_equilibrium(boxes: NDArray[np.integer], loads: NDArray[np.float64] | None = None) -> bool:
    """Return whether a whole stack is in strict static equilibrium.

    Solved by HiGHS; takes about 2 ms for 20 boxes.

    Args:
        boxes: int [n, 6], rows x, y, z, w, d, h in cells, resting on each other or on z = 0.
        loads: float [n, 3], weight and x, y of each centre of mass; uniform density by default.
    """
    return least_force(np.asarray(boxes), loads) > STRICT
