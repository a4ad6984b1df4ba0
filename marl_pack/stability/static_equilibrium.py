r"""Exact static equilibrium of the whole stack (Wang & Hauser, T-RO 2021).

A stack of boxes stands if vertical forces :math:`f \ge 0` at the corners of every contact
rectangle (box on box, box on floor) balance force and moment of every box, :math:`A f = w`. It
stands *strictly* if it still does after any small shift of the weights, that is if :math:`w` is in
the interior of the cone :math:`\{A f : f \ge 0\}`. Every box rests on contact of nonzero area, so
:math:`A` has full row rank and the interior is :math:`\{A f : f > 0\}`: the linear program
:math:`\max t,\ A f = w,\ f \ge t` decides, strictly standing iff its optimum is positive.

:func:`in_equilibrium` solves that program for a whole stack with SciPy's HiGHS and is the
reference. A mask asks thousands of such questions, so :func:`equilibrium_mask` reduces them:

- ``hull_alpha`` true is a yes (the new weight goes straight down through solid columns) and
  ``hull_1`` false a no (the box itself tips); only the cells between are solved.
- *Solid cells.* Where the column below a contact cell is filled to the floor, a force there can be
  handed straight down through the column without disturbing any box in it. Letting the ground push
  at the corners of those cells adds no wrench that the contacts could not already produce, so the
  cone is unchanged.
- *Grounded boxes.* Call a box grounded if all columns below it are filled and all boxes it rests on
  are grounded or the floor. Let :math:`C` be the cone, :math:`C_g` the cone of the grounded boxes'
  own ground forces and :math:`C'` the cone left when grounded boxes are replaced by ground. A
  grounded box touches others only from below, at solid cells, so deleting its rows from :math:`A`
  turns each such contact into a ground contact: the projection of :math:`C` is :math:`C'`, and
  :math:`C \supseteq C_g \times C'`. Each grounded weight is interior to :math:`C_g`. Hence
  :math:`w \in \operatorname{int} C \iff w' \in \operatorname{int} C'`.
- *Components.* Boxes that no chain of contacts through ungrounded boxes joins to the new one keep
  the balance they had: the cone is a product.

What remains (a handful of boxes) goes to a small dense simplex, whose forces are put back into the
equations; where they do not bear its verdict out, HiGHS decides.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.sparse import csc_array
from torch import Tensor

from marl_pack.bins import Bins
from marl_pack.stability.hull_cpu import envelope
from marl_pack.stability.oriented_item import OrientedItem
from marl_pack.stability.simplex import max_least_force

STRICT = 1e-9
"""Least force, in mean weights of the stack, that counts as positive. Sizes are small integers, so
true optima are either 0 up to rounding or larger by orders of magnitude; ``tests`` hold the gap.
HiGHS balances to 1e-7: weights that differ by more than ten million times are beyond it."""

NO, YES, UNSURE = 0, 1, 2

DIRECTIONS = 16
"""Corners of the polygon drawn around the disc of radius ``margin`` (2 % on the safe side)."""


# --- the whole stack, by a library's solver -------------------------------------------------------


def contacts(boxes: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Contact rectangles of a stack.

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
    """Weight and centre of mass of boxes [n, 6] of uniform density, float64 [n, 3]."""
    weight = np.prod(boxes[:, 3:].astype(np.float64), axis=1, keepdims=True)
    return np.hstack((weight, boxes[:, :2] + boxes[:, 3:5] / 2))


def least_force(boxes: NDArray[np.integer], loads: NDArray[np.float64] | None = None) -> float:
    """The optimum of ``max t, A f = w, f ≥ t`` in mean weights; -inf if no ``f ≥ 0`` balances.

    Args:
        boxes: int [n, 6], rows x, y, z, w, d, h.
        loads: float [n, 3], weight and x, y of each centre of mass; uniform density by default.
    """
    n = len(boxes)
    if n == 0:
        return np.inf
    loads = uniform_loads(boxes) if loads is None else loads
    pairs, rectangles = contacts(boxes)
    points = rectangles[:, [0, 1, 0, 3, 2, 1, 2, 3]].reshape(-1, 2)  # four corners of each
    upper, lower = np.repeat(pairs, 4, axis=0).T
    force = np.arange(len(points))
    on, sign = np.concatenate((upper, lower)), np.repeat((1.0, -1.0), len(points))
    force, points = np.concatenate((force, force)), np.concatenate((points, points))
    real = on >= 0
    on, sign, force, points = on[real], sign[real], force[real], points[real]
    arm = points - loads[on, 1:]
    columns = len(upper)
    a = csc_array(
        (
            np.concatenate((sign, sign * arm[:, 0], sign * arm[:, 1])),
            (np.concatenate((3 * on, 3 * on + 1, 3 * on + 2)), np.tile(force, 3)),
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
    """Whether a whole stack is in strict static equilibrium (HiGHS; about 2 ms for 20 boxes).

    Args:
        boxes: int [n, 6], rows x, y, z, w, d, h in cells, resting on each other or on z = 0.
        loads: float [n, 3], weight and x, y of each centre of mass; uniform density by default.
    """
    return least_force(np.asarray(boxes), loads) > STRICT


# --- the same, reduced, for masks -----------------------------------------------------------------


@njit(cache=True)
def _ground_points(solid: Any, lo: Any, hi: Any, upper: Any, lower: Any, points: Any) -> int:
    """Vertices of the hull of the squares of ``solid`` [w, d], written to ``points`` [V, 2]."""
    for i in range(solid.shape[0]):
        lo[i], hi[i] = solid.shape[1], -1
        for j in range(solid.shape[1]):
            if solid[i, j]:
                lo[i], hi[i] = min(lo[i], j), j
    w = solid.shape[0]
    n_upper, n_lower = envelope(lo[:w], hi[:w], upper, lower)
    for i in range(n_upper):
        points[i, 0], points[i, 1] = upper[i, 0], upper[i, 1]
    for i in range(n_lower):
        points[n_upper + i, 0], points[n_upper + i, 1] = lower[i, 0], lower[i, 1]
    return n_upper + n_lower


@njit(cache=True)
def _overlap(a: Any, b: Any) -> tuple[int, int, int, int]:
    """The rectangle x0, y0, x1, y1 that two boxes share seen from above (empty if x1 <= x0 …)."""
    return (
        max(a[0], b[0]),
        max(a[1], b[1]),
        min(a[0] + a[3], b[0] + b[3]),
        min(a[1] + a[4], b[1] + b[4]),
    )


@njit(cache=True)
def _touches(a: Any, b: Any) -> bool:
    """Whether box ``a`` rests on box ``b``."""
    if a[2] != b[2] + b[5]:
        return False
    x0, y0, x1, y1 = _overlap(a, b)
    return x0 < x1 and y0 < y1


@njit(cache=True)
def _survey(boxes: Any, n: int, shape: tuple[int, int], scratch: Any) -> tuple[Any, Any, Any]:
    """Replay a stack: which boxes are grounded, and where the ground pushes at the others."""
    height = np.zeros(shape, np.int64)
    gaps = np.zeros(shape, np.int64)
    grounded = np.zeros(n + 1, np.bool_)
    points = np.zeros((n + 1, 4 * shape[0] + 4, 2))
    count = np.zeros(n + 1, np.int64)
    solid = np.empty(shape, np.bool_)
    for k in range(n):
        x, y, z, w, d, h = boxes[k]
        whole = True
        for i in range(w):
            for j in range(d):
                solid[i, j] = height[x + i, y + j] == z and gaps[x + i, y + j] == 0
                whole &= solid[i, j]
                gaps[x + i, y + j] += z - height[x + i, y + j]
                height[x + i, y + j] = z + h
        for j in range(k):
            if whole and not grounded[j] and _touches(boxes[k], boxes[j]):
                whole = False
        grounded[k] = whole
        if not whole:
            count[k] = _ground_points(
                solid[:w, :d], scratch[0, :, 0], scratch[0, :, 1], scratch[1], scratch[2], points[k]
            )
    return grounded, points, count


@njit(cache=True)
def _stands(
    boxes: Any, loads: Any, n: int, grounded: Any, points: Any, count: Any, whole: bool
) -> int:
    """Whether box ``n``, set on the boxes before it, leaves its component in strict equilibrium.

    NO, YES or UNSURE, where the simplex could not be trusted.
    """
    member = np.full(n + 1, -1, np.int64)  # row of each box in the system
    queue = np.empty(n + 1, np.int64)
    size, head = 1, 0
    queue[0], member[n] = n, 0
    if whole:
        for j in range(n):
            if not grounded[j]:
                queue[size], member[j] = j, size
                size += 1
    columns = 0
    while head < size:
        i = queue[head]
        head += 1
        columns += count[i]
        for j in range(n + 1):
            if j == i or grounded[j]:
                continue
            below = _touches(boxes[i], boxes[j])
            if below:
                columns += 4
            if member[j] < 0 and (below or _touches(boxes[j], boxes[i])):
                queue[size], member[j] = j, size
                size += 1
    a = np.zeros((3 * size, columns))
    weight = np.zeros(3 * size)
    mean = 0.0
    for k in range(size):
        mean += loads[queue[k], 0] / size
    c = 0
    for k in range(size):
        i = queue[k]
        reach = float(max(boxes[i, 3], boxes[i, 4]))
        weight[3 * k] = loads[i, 0] / mean
        for p in range(count[i]):
            a[3 * k, c] = 1.0
            a[3 * k + 1, c] = (boxes[i, 0] + points[i, p, 0] - loads[i, 1]) / reach
            a[3 * k + 2, c] = (boxes[i, 1] + points[i, p, 1] - loads[i, 2]) / reach
            c += 1
        for j in range(n + 1):
            if j == i or grounded[j] or not _touches(boxes[i], boxes[j]):
                continue
            m = member[j]
            other = float(max(boxes[j, 3], boxes[j, 4]))
            x0, y0, x1, y1 = _overlap(boxes[i], boxes[j])
            for px, py in ((x0, y0), (x0, y1), (x1, y0), (x1, y1)):
                a[3 * k, c] = 1.0
                a[3 * k + 1, c] = (px - loads[i, 1]) / reach
                a[3 * k + 2, c] = (py - loads[i, 2]) / reach
                a[3 * m, c] = -1.0
                a[3 * m + 1, c] = -(px - loads[j, 1]) / other
                a[3 * m + 2, c] = -(py - loads[j, 2]) / other
                c += 1
    force, sound = max_least_force(a, weight, 1e3 * STRICT)
    if not sound:
        return UNSURE
    return YES if force > STRICT else NO


@njit(cache=True, nogil=True)
def _solve_band(
    heightmap: Any, empty_map: Any, boxes: Any, loads: Any, count: Any, sides: Any, com: Any,
    weight: Any, shifts: Any, whole: Any, band: Any, verdict: Any,
) -> None:  # fmt: skip
    """Write YES, NO or UNSURE to ``verdict`` [N, A, W, D] for every cell of ``band``.

    YES: the stack stands with every one of the ``shifts`` [S, 2] of the new box's centre of mass.
    """
    n, width, depth = heightmap.shape
    scratch = np.empty((3, 2 * width + 2, 2), np.int64)
    solid = np.empty((width, depth), np.bool_)
    for b in range(n):
        if not band[b].any():
            continue
        k = count[b]
        stack = np.empty((k + 1, 6), np.int64)
        load = np.empty((k + 1, 3))
        stack[:k], load[:k] = boxes[b, :k], loads[b, :k]
        grounded, points, size = _survey(stack, k, (width, depth), scratch)
        for a in range(sides.shape[1]):
            w, d, h = sides[b, a, 0], sides[b, a, 1], sides[b, a, 2]
            if w < 1 or d < 1 or h < 1:
                continue
            for x in range(width - w + 1):
                for y in range(depth - d + 1):
                    if not band[b, a, x, y]:
                        continue
                    z = 0
                    for i in range(w):
                        for j in range(d):
                            z = max(z, heightmap[b, x + i, y + j])
                    for i in range(w):
                        for j in range(d):
                            top = heightmap[b, x + i, y + j] == z
                            solid[i, j] = top and empty_map[b, x + i, y + j] == 0
                    stack[k, 0], stack[k, 1], stack[k, 2] = x, y, z
                    stack[k, 3], stack[k, 4], stack[k, 5] = w, d, h
                    size[k] = _ground_points(
                        solid[:w, :d], scratch[0, :, 0], scratch[0, :, 1], scratch[1], scratch[2],
                        points[k],
                    )  # fmt: skip
                    stands = YES
                    load[k, 0] = weight[b]
                    for s in range(shifts.shape[0]):
                        load[k, 1] = x + com[b, a, 0] + shifts[s, 0]
                        load[k, 2] = y + com[b, a, 1] + shifts[s, 1]
                        if stands == YES:
                            stands = _stands(stack, load, k, grounded, points, size, whole[b])
                    verdict[b, a, x, y] = stands


def equilibrium_mask(
    bins: Bins,
    candidates: OrientedItem,
    surely: Tensor,
    possibly: Tensor,
    margin: float = 0.0,
    check_stack: bool = False,
) -> Tensor:
    """Bool [N, A, W, D]: ``surely``, and what of ``possibly`` leaves the whole stack standing.

    The linear programs are solved on the CPU, whatever device the bins are on.

    Args:
        bins: with their boxes in order of placement.
        candidates: as for every rule.
        surely: bool [N, A, W, D], the mask of ``hull_alpha``.
        possibly: bool [N, A, W, D], the mask of ``hull_1``.
        margin: the new box's centre of mass may lie anywhere within so many cells of its place.
        check_stack: look first whether what stands is in equilibrium. Where it is not, nothing is
            taken for granted and the whole stack is solved for every cell of ``possibly``.
    """
    device = bins.device
    stack = bins.to("cpu")
    whole = np.zeros(len(bins), np.bool_)
    if check_stack:
        for b in range(len(bins)):
            k = int(stack.count[b])
            whole[b] = not in_equilibrium(stack.boxes[b, :k].numpy(), stack.loads[b, :k].numpy())
    sure = surely & ~torch.from_numpy(whole).to(device)[:, None, None, None]
    band = possibly & ~sure
    if not bool(band.any()):
        return sure
    shifts = np.zeros((1, 2))
    if margin > 0:
        angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
        shifts = margin / np.cos(np.pi / DIRECTIONS) * np.stack((np.cos(angle), np.sin(angle)), 1)
    verdict = np.zeros(tuple(band.shape), np.uint8)
    inputs = (
        stack.heightmap, stack.empty_map, stack.boxes, stack.loads, stack.count,
        candidates.sides, candidates.centres(), candidates.weights(),
        torch.from_numpy(shifts), torch.from_numpy(whole), band,
    )  # fmt: skip
    _solve_band(*(tensor.cpu().contiguous().numpy() for tensor in inputs), verdict)
    for b, a, x, y in np.argwhere(verdict == UNSURE).tolist():
        verdict[b, a, x, y] = _stands_by_highs(stack, candidates, b, a, x, y, shifts)
    return sure | torch.from_numpy(verdict == YES).to(device)


def _stands_by_highs(
    stack: Bins,
    candidates: OrientedItem,
    b: int,
    a: int,
    x: int,
    y: int,
    shifts: NDArray[np.float64],
) -> bool:
    """The verdict on one cell by the whole stack's linear program."""
    k = int(stack.count[b])
    w, d, h = candidates.sides[b, a].tolist()
    z = int(stack.heightmap[b, x : x + w, y : y + d].max())
    boxes = np.vstack((stack.boxes[b, :k].numpy(), (x, y, z, w, d, h)))
    corner = np.array((x, y))
    centre = corner + candidates.centres()[b, a].cpu().numpy()
    weight = float(candidates.weights()[b])
    loads = [
        np.vstack((stack.loads[b, :k].numpy(), (weight, *(centre + shift)))) for shift in shifts
    ]
    return all(in_equilibrium(boxes, load) for load in loads)
