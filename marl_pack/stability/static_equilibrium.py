r"""Exact static equilibrium of a whole stack (Wang & Hauser, T-RO 2021).

A stack of boxes stands if vertical forces :math:`f \ge 0` at the corners of every contact rectangle
(box on box, box on floor) balance force and moment of every box, :math:`A f = w`. Each row of
:math:`A` balances the vertical force or one moment of a box; :math:`w` holds the weights. The stack
stands *strictly* if it also stands after any small shift of the weights, that is if :math:`w` is in
the interior of the cone :math:`\{A f : f \ge 0\}`. Every box rests on contact of nonzero area, so
:math:`A` has full row rank and the interior is :math:`\{A f : f > 0\}`. So the stack stands
strictly iff the linear program :math:`\max t,\ A f = w,\ f \ge t` has a positive optimum.

:func:`in_equilibrium` decides this for a whole stack: with SciPy's HiGHS or, if the optimum is
close to 0 (a tie), in exact arithmetic. It is the reference for
:mod:`marl_pack.stability.equilibrium_masks`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linprog
from scipy.sparse import csc_array, csr_array
from scipy.sparse.csgraph import connected_components

from marl_pack.checks import decimals, exact, shown
from marl_pack.stability.exact_equilibrium import GROUND, Force, Load, stands_exactly

NEAR = 1e-5
"""HiGHS is trusted if its least force, in mean weights of the stack, is above this number; its
forces balance up to 1e-7. Otherwise exact arithmetic decides
(:mod:`marl_pack.stability.exact_equilibrium`)."""
MAX_LENGTH = 1 << 31
"""All coordinates of boxes are less than this number."""


def contacts(boxes: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find the contact rectangles of a stack.

    Args:
        boxes: int [n, 6], rows x, y, z, w, d, h.

    Returns:
        The indices of the upper and the lower box of each contact, int64 [C, 2] (-1: the floor),
        and the rectangles x0, y0, x1, y1, int64 [C, 4].
    """
    pairs, rectangles = [], []
    rows = boxes.astype(np.int64)
    low, high = rows[:, :3], rows[:, :3] + rows[:, 3:]
    for i in range(len(boxes)):
        if low[i, 2] == 0:
            pairs.append((i, GROUND))
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
    return np.hstack((weight, boxes[:, :2].astype(np.float64) + boxes[:, 3:5] / 2))


def least_force(boxes: NDArray[np.integer], loads: NDArray[np.float64] | None = None) -> float:
    """Compute the optimum of ``max t, A f = w, f ≥ t``, as a multiple of the stack's mean weight.

    Args:
        boxes: int [n, 6], rows x, y, z, w, d, h.
        loads: float [n, 3], weight and x, y of each centre of mass; uniform density by default.

    Returns:
        The optimum minus the largest possible effect of the solver's errors; infinity if there are
        no boxes, -inf if no ``f ≥ 0`` balances the stack.
    """
    n = len(boxes)
    if n == 0:
        return np.inf
    loads = uniform_loads(boxes) if loads is None else loads
    pairs, rectangles = contacts(boxes)
    points = rectangles[:, [0, 1, 0, 3, 2, 1, 2, 3]].reshape(-1, 2)  # four corners per contact
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
    if result.status != 0:
        return -np.inf
    # HiGHS balances forces up to an absolute error. The forces that balance this error are at most
    # the error times the longest arm in cells, since a contact is at least one cell wide.
    error = float(np.abs(spread @ result.x - weight).sum()) * float(np.abs(arm).max(initial=1.0))
    return float(-result.fun) - error


def in_equilibrium(boxes: ArrayLike, loads: ArrayLike | None = None) -> bool:
    """Return whether a whole stack is in strict static equilibrium.

    The result is exact: decimals in ``loads`` are taken exactly. The function takes about 2 ms for
    20 boxes, and longer near a tie, where a small shift of the weights changes the result.

    Args:
        boxes: whole numbers [n, 6], rows x, y, z, w, d, h in cells. A box falls if it rests neither
            on another box nor on the floor z = 0.
        loads: float [n, 3], weight and x, y of each centre of mass; uniform density by default.

    Raises:
        ValueError: if a box has no volume, two boxes overlap, or a load is not finite or has no
            positive weight; the message names it.
    """
    stack = check_boxes(boxes)
    if not len(stack):
        return True
    load = uniform_loads(stack) if loads is None else _check_loads(loads, len(stack))
    return stands(stack, [Load(*map(exact, row)) for row in load.tolist()])


def stands(boxes: NDArray[np.int64], loads: Sequence[Load]) -> bool:
    """Return whether boxes [n ≥ 1, 6] with exact loads are in strict static equilibrium."""
    rounded = np.array([(float(load.weight), float(load.x), float(load.y)) for load in loads])
    if least_force(boxes, rounded) > NEAR:
        return True
    pairs, rectangles = contacts(boxes)
    for members in _components(len(boxes), pairs):
        number = {box: index for index, box in enumerate(members)} | {GROUND: GROUND}
        forces = [
            Force(x, y, number[upper], number[lower])
            for (upper, lower), (x0, y0, x1, y1) in zip(
                pairs.tolist(), rectangles.tolist(), strict=True
            )
            if upper in number
            for x, y in ((x0, y0), (x0, y1), (x1, y0), (x1, y1))
        ]
        if not stands_exactly([loads[box] for box in members], forces):
            return False
    return True


def _components(n: int, pairs: NDArray[np.int64]) -> list[list[int]]:
    """Group boxes that contacts connect; return the indices of each group, the smallest first."""
    touching = pairs[pairs[:, 1] != GROUND]
    graph = csr_array((np.ones(len(touching)), touching.T), shape=(n, n))
    _, labels = connected_components(graph, directed=False)
    parts = [np.flatnonzero(labels == label).tolist() for label in np.unique(labels)]
    return sorted(parts, key=len)


def check_boxes(boxes: ArrayLike) -> NDArray[np.int64]:
    """Check boxes and return them as int64 [n, 6].

    Raises:
        ValueError: unless they are rows of whole numbers with a volume, and no two overlap.
    """
    rows = whole_cells("boxes", boxes)
    rows = rows.reshape(-1, 6) if rows.size == 0 else rows
    if rows.ndim != 2 or rows.shape[1] != 6:
        raise ValueError(f"boxes: need rows x y z w d h, [n, 6], not {list(rows.shape)}")
    for i in np.flatnonzero((rows[:, 3:] < 1).any(1) | (rows[:, 2] < 0)):
        raise ValueError(f"boxes: row {i} {rows[i].tolist()} has no volume or lies below the floor")
    low, high = rows[:, :3], rows[:, :3] + rows[:, 3:]
    for row in range(len(rows)):
        overlapping = np.flatnonzero(((low[:row] < high[row]) & (low[row] < high[:row])).all(1))
        if overlapping.size:
            raise ValueError(f"boxes: rows {overlapping[0]} and {row} overlap")
    return rows


def _check_loads(loads: ArrayLike, n: int) -> NDArray[np.float64]:
    """Check loads and return them as float64 [n, 3].

    Raises:
        ValueError: unless there is a finite row for each of n boxes, with a positive weight.
    """
    try:
        rows = np.asarray(loads)
    except ValueError:  # rows of different lengths
        rows = np.empty(0, object)
    if rows.dtype.kind not in "iuf" or np.ma.is_masked(loads):
        raise ValueError(f"loads: need rows weight, x, y of numbers, not {shown(loads)}")
    rows = decimals(rows)
    if rows.shape != (n, 3) or not np.isfinite(rows).all() or not (rows[:, 0] > 0).all():
        raise ValueError(f"loads: need rows weight > 0, x, y of finite numbers, [{n}, 3]")
    return rows


def whole_cells(name: str, values: ArrayLike) -> NDArray[np.int64]:
    """Check ``values`` and return them as whole numbers of cells, int64.

    Args:
        name: name of the values, for messages.
        values: whole numbers of any type; floats without a fraction are allowed.

    Raises:
        ValueError: if a value is not a whole number or is too large.
    """
    try:
        array = np.asarray(values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: needs an array of whole numbers ({error})") from None
    if array.size == 0:
        return array.astype(np.int64)
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        raise ValueError(f"{name}: needs all its values, but some are masked")
    if not isinstance(values, np.ndarray) and any(
        isinstance(value, bool) for value in np.asarray(values, object).flat
    ):
        raise ValueError(f"{name}: needs whole numbers of cells, not true or false")
    whole = array.dtype.kind in "iu" or (
        array.dtype.kind == "f" and np.isfinite(array).all() and not (array % 1).any()
    )
    if not whole:
        raise ValueError(f"{name}: needs whole numbers of cells, got {array.dtype} values with a"
                         " fraction, NaN or another type")  # fmt: skip
    if array.max() >= MAX_LENGTH or array.min() <= -MAX_LENGTH:
        raise ValueError(f"{name}: needs numbers of cells below {MAX_LENGTH}")
    return array.astype(np.int64)
