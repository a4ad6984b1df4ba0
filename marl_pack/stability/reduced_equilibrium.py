r"""Solve the linear program of one new box on a stack in equilibrium, reduced to a few boxes.

:mod:`marl_pack.stability.static_equilibrium` solves the linear program of a whole stack. A mask
needs thousands of such solutions, for stacks that are known to stand, so the program is reduced:

- *Bearing cells.* If the column below a contact cell is filled to the floor, a force there can be
  passed straight down through the column without disturbing any box in it. Letting the ground push
  at the corners of those cells adds no wrench that the contacts could not already produce, so the
  cone is unchanged.
- *Grounded boxes.* Call a box grounded if all columns below it are filled and all boxes it rests on
  are grounded or the floor. Let :math:`C` be the cone, :math:`C_g` the cone of the grounded boxes'
  own ground forces and :math:`C'` the cone left when grounded boxes are replaced by ground. A
  grounded box touches others only from below, at bearing cells, so deleting its rows from :math:`A`
  makes each such contact a ground contact: the projection of :math:`C` is :math:`C'`, and
  :math:`C \supseteq C_g \times C'`. Each grounded weight is interior to :math:`C_g`. Hence
  :math:`w \in \operatorname{int} C \iff w' \in \operatorname{int} C'`.
- *Components.* Boxes that are not joined to the new box by a chain of contacts through ungrounded
  boxes keep their balance: the cone is a product.

A small dense simplex method solves the program of the few boxes that remain. The forces that it
finds are put back into the equations. If they do not confirm the result, or the result is so close
to a tie that rounding errors could change it, the result is UNSURE. Then the same program is solved
in whole numbers (:func:`stands_by_fractions`).
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.checks import exact
from marl_pack.geometry.compiled import place_box
from marl_pack.installation import njit
from marl_pack.stability.exact_equilibrium import GROUND, Force, Load, stands_exactly
from marl_pack.stability.hull_exact import envelope, row_extremes
from marl_pack.stability.simplex import NEAR, max_least_force, nearly_a_tie

NO, YES, UNSURE = 0, 1, 2

CORNERS = ((1020, 0), (942, 391), (721, 721), (391, 942))
"""Corners of a polygon around the disc whose radius is the margin, in thousandths of the margin.
The other corners are these corners rotated by 90°, 180° and 270°. The polygon reaches at most 2 %
beyond the disc, so it is never less strict than the disc."""


@njit(cache=True, inline="always")
def _overlap(a: Any, b: Any) -> tuple[int, int, int, int]:
    """Return the rectangle x0, y0, x1, y1 that two boxes share seen from above.

    It is empty if x1 <= x0 or y1 <= y0.
    """
    return (
        max(a[0], b[0]),
        max(a[1], b[1]),
        min(a[0] + a[3], b[0] + b[3]),
        min(a[1] + a[4], b[1] + b[4]),
    )


@njit(cache=True, inline="always")
def _touches(a: Any, b: Any, tolerance: int) -> bool:
    """Return whether box ``a`` rests on box ``b``, or ends at most ``tolerance`` above it."""
    if not 0 <= a[2] - b[2] - b[5] <= tolerance:
        return False
    x0, y0, x1, y1 = _overlap(a, b)
    return x0 < x1 and y0 < y1


@njit(cache=True, inline="always")
def ground_points(bearing: Any, scratch: Any, points: Any) -> int:
    """Find the points where the ground pushes a box: the vertices of the hull of its bearing cells.

    Args:
        bearing: bool [w, d], contact cells over columns that are filled to the floor.
        scratch: int64 [3, ≥ 2w + 2, 2].
        points: float64 [≥ 4w + 4, 2], written: the vertices (x, y) from the box's low corner.

    Returns:
        The number of vertices.
    """
    w = bearing.shape[0]
    lo, hi, upper, lower = scratch[0, :, 0], scratch[0, :, 1], scratch[1], scratch[2]
    row_extremes(bearing, lo, hi)
    n_upper, n_lower = envelope(lo[:w], hi[:w], upper, lower)
    for i in range(n_upper):
        points[i, 0], points[i, 1] = upper[i, 0], upper[i, 1]
    for i in range(n_lower):
        points[n_upper + i, 0], points[n_upper + i, 1] = lower[i, 0], lower[i, 1]
    return n_upper + n_lower


@njit(cache=True, inline="always")
def mark_bearing(heightmap: Any, empty_map: Any, x: int, y: int, z: int, bearing: Any) -> bool:
    """Mark the bearing cells of a window: they touch a box at ``z``, and their columns are filled.

    Args:
        heightmap: integers [W, D].
        empty_map: integers [W, D].
        x: the window's low corner along W.
        y: the window's low corner along D.
        z: the resting height.
        bearing: bool [w, d], written.

    Returns:
        Whether all cells of the window are bearing cells.
    """
    full = True
    for i in range(bearing.shape[0]):
        for j in range(bearing.shape[1]):
            bearing[i, j] = heightmap[x + i, y + j] == z and empty_map[x + i, y + j] == 0
            full &= bearing[i, j]
    return full


@njit(cache=True)
def survey(boxes: Any, n: int, shape: tuple[int, int], scratch: Any) -> tuple[Any, Any, Any]:
    """Find the grounded boxes of a stack, and the points where the ground pushes the other boxes.

    Args:
        boxes: int64 [≥ n, 6], rows x, y, z, w, d, h in order of placement.
        n: number of boxes.
        shape: (W, D).
        scratch: int64 [3, 2W + 2, 2].

    Returns:
        Whether each box is grounded, bool [n + 1]; the points where the ground pushes it,
        float64 [n + 1, 4W + 4, 2]; and their number, int64 [n + 1]. The last row of each array is
        free for a new box.
    """
    heightmap = np.zeros(shape, np.int64)
    empty_map = np.zeros(shape, np.int64)
    grounded = np.zeros(n + 1, np.bool_)
    points = np.zeros((n + 1, 4 * shape[0] + 4, 2))
    count = np.zeros(n + 1, np.int64)
    bearing = np.empty(shape, np.bool_)
    for k in range(n):
        x, y, z, w, d, h = boxes[k]
        cells = bearing[:w, :d]
        whole = mark_bearing(heightmap, empty_map, x, y, z, cells)
        place_box(heightmap, empty_map, x, y, w, d, h)
        for j in range(k):
            if whole and not grounded[j] and _touches(boxes[k], boxes[j], 0):
                whole = False
        grounded[k] = whole
        if not whole:
            count[k] = ground_points(cells, scratch, points[k])
    return grounded, points, count


@njit(cache=True, inline="always")
def _component(
    boxes: Any, n: int, grounded: Any, count: Any, whole: bool, tolerance: int
) -> tuple[Any, Any, int]:
    """Find the boxes that the new box ``n`` may disturb.

    Returns:
        The indices of these boxes in the order of the system of equations, int64 [S]; the place of
        each box in this order, int64 [n + 1] (-1: not in it); and the number of forces that act on
        them.
    """
    row = np.full(n + 1, -1, np.int64)
    queue = np.empty(n + 1, np.int64)
    size, head = 1, 0
    queue[0], row[n] = n, 0
    if whole:
        for j in range(n):
            if not grounded[j]:
                queue[size], row[j] = j, size
                size += 1
    forces = 0
    while head < size:
        i = queue[head]
        head += 1
        forces += count[i]
        for j in range(n + 1):
            if j == i or grounded[j]:
                continue
            below = _touches(boxes[i], boxes[j], tolerance)
            if below:
                forces += 4
            if row[j] < 0 and (below or _touches(boxes[j], boxes[i], tolerance)):
                queue[size], row[j] = j, size
                size += 1
    return queue[:size], row, forces


@njit(cache=True, inline="always")
def _system(
    boxes: Any, loads: Any, grounded: Any, points: Any, count: Any, members: Any, row: Any,
    forces: int, tolerance: int,
) -> tuple[Any, Any]:  # fmt: skip
    """Build the equations ``a f = weight`` that balance forces and moments of the members.

    Weights are divided by the members' mean weight, moments by each box's longer side.
    """
    size, n = members.size, grounded.size
    a = np.zeros((3 * size, forces))
    weight = np.zeros(3 * size)
    mean = 0.0
    for k in range(size):
        mean += loads[members[k], 0] / size
    c = 0
    for k in range(size):
        i = members[k]
        reach = float(max(boxes[i, 3], boxes[i, 4]))
        weight[3 * k] = loads[i, 0] / mean
        for p in range(count[i]):
            a[3 * k, c] = 1.0
            a[3 * k + 1, c] = (boxes[i, 0] + points[i, p, 0] - loads[i, 1]) / reach
            a[3 * k + 2, c] = (boxes[i, 1] + points[i, p, 1] - loads[i, 2]) / reach
            c += 1
        for j in range(n):
            if j == i or grounded[j] or not _touches(boxes[i], boxes[j], tolerance):
                continue
            m = row[j]
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
    return a, weight


@njit(cache=True)
def stands(
    boxes: Any, loads: Any, n: int, grounded: Any, points: Any, count: Any, whole: bool,
    tolerance: int = 0,
) -> int:  # fmt: skip
    """Decide whether box ``n`` and the boxes placed before it are in strict equilibrium.

    Args:
        boxes: int64 [n + 1, 6], rows x, y, z, w, d, h.
        loads: float64 [n + 1, 3], weight and x, y of each centre of mass.
        n: index of the new box.
        grounded: bool [n + 1], the grounded boxes, from :func:`survey`.
        points: float64 [n + 1, V, 2], ground points of each box.
        count: int64 [n + 1], number of ground points of each box.
        whole: whether to solve all ungrounded boxes, or only those that the new box may disturb.
        tolerance: how far a supporting top may lie below a box.

    Returns:
        YES or NO; UNSURE if rounding errors could change the result.
    """
    members, row, forces = _component(boxes, n, grounded, count, whole, tolerance)
    a, weight = _system(
        boxes, loads, grounded, points, count, members, row, forces, tolerance
    )  # fmt: skip
    force, reliable, _ = max_least_force(a, weight, 10 * NEAR)
    reach = 0
    for i in members:
        reach = max(reach, boxes[i, 3], boxes[i, 4])
    if not reliable or nearly_a_tie(force, reach):
        return UNSURE
    return YES if force > 0 else NO


def stands_by_fractions(
    boxes: NDArray[np.int64],
    loads: NDArray[np.float64],
    new: Load,
    shape: tuple[int, int],
    whole: bool,
) -> bool:
    """Decide in exact arithmetic whether a new box leaves the stack in strict equilibrium.

    :func:`stands` decides the same in float64.

    Args:
        boxes: int64 [n + 1, 6], rows x, y, z, w, d, h in order of placement; the last box is new.
        loads: float64 [n, 3], loads of the other boxes; decimals are taken exactly.
        new: the load of the new box.
        shape: (W, D).
        whole: see :func:`stands`.
    """
    n = len(boxes) - 1
    scratch = np.empty((3, 2 * shape[0] + 2, 2), np.int64)
    grounded, points, count = survey(boxes, n + 1, shape, scratch)
    if grounded[n]:  # its centre of mass lies inside its own footprint, all of which bears
        grounded[n], count[n] = False, 4
        w, d = boxes[n, 3:5]
        points[n, :4] = (0, 0), (0, d), (w, 0), (w, d)
    return solve_exactly(boxes, loads, new, grounded[: n + 1], points, count[: n + 1], whole)


def solve_exactly(
    boxes: NDArray[np.int64],
    loads: NDArray[np.float64],
    new: Load,
    grounded: NDArray[np.bool_],
    points: NDArray[np.float64],
    count: NDArray[np.int64],
    whole: bool,
    tolerance: int = 0,
) -> bool:
    """Decide in exact arithmetic what :func:`stands` decides in float64; see its arguments.

    Args:
        boxes: int64 [n + 1, 6]; the last box is new.
        loads: float64 [n, 3], loads of the other boxes; decimals are taken exactly.
        new: the load of the new box.
        grounded, points, count, whole, tolerance: as for :func:`stands`.
    """
    n = len(boxes) - 1
    members, row, _ = _component(boxes, n, grounded, count, whole, tolerance)
    forces = []
    for i in members.tolist():
        for x, y in (boxes[i, :2] + points[i, : count[i]]).astype(np.int64).tolist():
            forces.append(Force(x, y, int(row[i]), GROUND))
        for j in np.flatnonzero(~grounded).tolist():
            if j != i and _touches(boxes[i], boxes[j], tolerance):
                x0, y0, x1, y1 = map(int, _overlap(boxes[i], boxes[j]))
                for x, y in ((x0, y0), (x0, y1), (x1, y0), (x1, y1)):
                    forces.append(Force(x, y, int(row[i]), int(row[j])))
    exact_loads = [
        new if i == n else Load(*map(exact, loads[i].tolist())) for i in members.tolist()
    ]
    return stands_exactly(exact_loads, forces)


def shifts_of(margin: float | Fraction) -> list[tuple[Fraction, Fraction]]:
    """Return the shifts (x, y) of a centre of mass with which the stack must stand, in cells."""
    if margin == 0:
        return [(Fraction(0), Fraction(0))]
    scale = exact(margin) / 1000
    shifts = []
    for x, y in CORNERS:
        for corner in ((x, y), (-y, x), (-x, -y), (y, -x)):
            shifts.append((scale * corner[0], scale * corner[1]))
    return shifts
