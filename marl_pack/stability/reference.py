"""Define every stability rule in plain NumPy, for one window at a time.

These functions are slow. They define what a rule means, and tests compare the batched code with
them cell by cell. The arithmetic is exact: a float means the decimal that is printed for it, so 0.1
is one tenth. A cell is a unit square, not a point: a support polygon is the convex hull of the
corners of the contact squares, and a centre of mass must lie strictly inside it.
``docs/reproduce.md`` lists where this differs from the paper.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from marl_pack.checks import exact

Number = int | float | Fraction
Point = tuple[Number, Number]
Map = NDArray[np.integer]


def place_box(
    heightmap: Map, empty_map: Map, corner: tuple[int, int], sides: tuple[int, int, int]
) -> tuple[int, int]:
    """Place one box, update both maps (Algorithm 2); return resting height and wasted cells."""
    (x, y), (w, d, h) = corner, sides
    window = np.s_[x : x + w, y : y + d]
    z = int(heightmap[window].max())
    gap = z - heightmap[window]
    empty_map[window] += gap
    heightmap[window] = z + h
    return z, int(gap.sum())


def corners(cells: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the corners of the unit squares of ``cells`` [w, d], as points [P, 2]."""
    xy = np.argwhere(cells)
    return np.unique(np.concatenate([xy + o for o in ((0, 0), (0, 1), (1, 0), (1, 1))]), axis=0)


def convex_hull(points: NDArray[np.int64]) -> list[Point]:
    """Return the vertices of the convex hull, counter-clockwise (Andrew's monotone chain)."""

    def chain(ordered: list[Point]) -> list[Point]:
        out: list[Point] = []
        for p in ordered:
            while len(out) > 1 and cross(out[-2], out[-1], p) <= 0:
                out.pop()
            out.append(p)
        return out[:-1]

    ordered: list[Point] = sorted({(x, y) for x, y in points.tolist()})
    return chain(ordered) + chain(ordered[::-1])


def cross(a: Point, b: Point, c: Point) -> Number:
    """Return twice the signed area of the triangle a, b, c; positive if c lies left of a → b."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def edges(polygon: list[Point]) -> Iterator[tuple[Point, Point]]:
    """Yield the edges of a polygon, counter-clockwise."""
    return zip(polygon, polygon[1:] + polygon[:1], strict=True)


def deeper(polygon: list[Point], point: Point, margin: Number) -> bool:
    """Return whether ``point`` lies more than ``margin`` inside every edge of the polygon."""
    for a, b in edges(polygon):
        area = cross(a, b, point)
        squared_length = (b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2
        if area <= 0 or area**2 <= margin**2 * squared_length:
            return False
    return True


def supported(cells: NDArray[np.bool_], com: Point, margin: Number = 0) -> bool:
    """Return whether ``com`` lies more than ``margin`` inside the hull of ``cells``' squares.

    The arithmetic uses Python's whole numbers and fractions, so it is exact.

    Args:
        cells: bool [w, d], the supporting cells.
        com: the centre of mass, measured from the low corner of ``cells``; a float is taken as a
            decimal.
        margin: number of cells, ≥ 0; a float is taken as a decimal.
    """
    if not cells.any():
        return False
    point = exact(com[0]), exact(com[1])
    return deeper(convex_hull(corners(cells)), point, exact(margin))


def hull(heights: Map, bearing: NDArray[np.bool_], com: Point, margin: Number = 0) -> bool:
    """Return whether one window is stable by ``hull_1``, ``hull_alpha`` or ``lbcp``.

    Only contact cells in ``bearing`` count. ``bearing`` is true everywhere for hull_1 (the paper's
    p_f), ``empty_map == 0`` for hull_alpha (p_f', Algorithm 1) and :func:`lbcp_bearing` for lbcp.
    """
    return supported((heights == heights.max()) & bearing, com, margin)


def area_ratio(heights: Map, thresholds: tuple[tuple[Number, int], ...]) -> bool:
    """Return whether enough of the bottom face and its corners is supported (Zhao et al. 2021)."""
    contact = heights == heights.max()
    count = int(contact[[0, 0, -1, -1], [0, -1, 0, -1]].sum())
    return any(
        int(contact.sum()) > exact(share) * contact.size and count >= corners
        for share, corners in thresholds
    )


def lbcp_bearing(size: tuple[int, int], boxes: Map) -> NDArray[np.bool_]:
    """Return the cells [W, D] whose top can carry any load, by load-bearable convex polygons.

    The floor can carry any load everywhere. A box can carry it on those cells of its top whose
    whole square lies in the hull of the load-bearing squares on which the box rests (Gao et al.
    2025, arXiv 2507.09123). It would be unsound to test only one corner of the square.
    """
    heightmap, empty_map = np.zeros(size, np.int64), np.zeros(size, np.int64)
    bearing = np.ones(size, dtype=np.bool_)
    for x, y, z, w, d, h in boxes:
        window = np.s_[x : x + w, y : y + d]
        cells = (heightmap[window] == z) & bearing[window]
        if cells.any():
            sides = list(edges(convex_hull(corners(cells))))
            for i in range(w):
                for j in range(d):
                    square = [(i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)]
                    cells[i, j] = all(cross(*edge, p) >= 0 for edge in sides for p in square)
        bearing[window] = cells
        place_box(heightmap, empty_map, (x, y), (w, d, h))
    return bearing


def window_mask(
    stands: Callable[[int, int], bool], heightmap: Map, item: tuple[int, int, int], bin_height: int
) -> NDArray[np.bool_]:
    """Return ``stands(x, y)`` where the window fits into the bin, bool [W, D] (Algorithm 1)."""
    (w, d, h), (width, depth) = item, heightmap.shape
    mask = np.zeros((width, depth), dtype=np.bool_)
    for x in range(width - w + 1):
        for y in range(depth - d + 1):
            window = heightmap[x : x + w, y : y + d]
            mask[x, y] = window.max() + h <= bin_height and stands(x, y)
    return mask


def equilibrium(boxes: Map, loads: Sequence[tuple[Number, Number, Number]]) -> bool:
    """Return whether a whole stack is in strict static equilibrium (Wang & Hauser 2021).

    It is iff positive forces at the corners of all contacts can balance its weights. The textbook
    simplex method computes, in fractions, the largest value that the smallest force can have. It is
    slow: use it for a few boxes.

    Args:
        boxes: whole numbers [n, 6], rows x, y, z, w, d, h.
        loads: weight and x, y of the centre of mass of each box; floats are taken as decimals.
    """
    rows = [[int(value) for value in row] for row in boxes]
    centres = [tuple(map(exact, load)) for load in loads]
    columns: list[dict[int, Fraction]] = []  # one for each force: equation → coefficient
    for i, (x, y, z, w, d, _) in enumerate(rows):
        supports = [(j, *rows[j]) for j in range(len(rows)) if rows[j][2] + rows[j][5] == z]
        floor = [(-1, x, y, 0, w, d, 0)] if z == 0 else []
        for j, bx, by, _, bw, bd, _ in supports + floor:
            xs, ys = (max(x, bx), min(x + w, bx + bw)), (max(y, by), min(y + d, by + bd))
            if xs[0] >= xs[1] or ys[0] >= ys[1]:
                continue
            for px, py in itertools.product(xs, ys):
                column: dict[int, Fraction] = {}
                for box, sign in ((i, 1), (j, -1)):
                    if box >= 0:
                        arms = Fraction(1), px - centres[box][1], py - centres[box][2]
                        column |= {3 * box + k: sign * arm for k, arm in enumerate(arms)}
                columns.append(column)
    equations = range(3 * len(rows))
    a = [[column.get(r, Fraction(0)) for column in columns] for r in equations]
    weights = [centres[r // 3][0] if r % 3 == 0 else Fraction(0) for r in equations]
    return _largest_least_force(a, weights) > 0


def _largest_least_force(a: list[list[Fraction]], weights: list[Fraction]) -> Fraction:
    """Solve ``max t, a f = weights, f ≥ t``; return 0 where no ``f ≥ 0`` solves it.

    This is the two-phase simplex method with Bland's rule. The variables are f - t, t, and an error
    for each equation.
    """
    m, n = len(a), len(a[0]) if a else 0
    errors = [[Fraction(int(i == r)) for i in range(m)] for r in range(m)]
    table = [[*a[r], sum(a[r], Fraction(0)), *errors[r], weights[r]] for r in range(m)]
    basis = [n + 1 + r for r in range(m)]
    _minimise(table, basis, [0] * (n + 1) + [1] * m)
    if any(table[r][-1] != 0 for r in range(m) if basis[r] > n):
        return Fraction(0)
    for r in range(m):
        if basis[r] > n:
            entering = next((j for j in range(n + 1) if table[r][j] != 0), None)
            if entering is None:
                return Fraction(0)  # some small shift of the weights cannot be balanced
            _eliminate(table, basis, r, entering)
    _minimise(table, basis, [0] * n + [-1])
    return next((table[r][-1] for r in range(m) if basis[r] == n), Fraction(0))


def _minimise(table: list[list[Fraction]], basis: list[int], costs: list[int]) -> None:
    """Minimise the costs of the first variables from a feasible basis, in place."""
    rows = range(len(basis))
    while True:
        basic = [costs[j] if j < len(costs) else 0 for j in basis]
        reduced = (
            costs[j] - sum(basic[r] * table[r][j] for r in rows if basic[r])
            for j in range(len(costs))
        )
        entering = next((j for j, cost in enumerate(reduced) if cost < 0), None)
        if entering is None:
            return
        ratios = [
            (table[r][-1] / table[r][entering], basis[r], r) for r in rows if table[r][entering] > 0
        ]
        _eliminate(table, basis, min(ratios)[2], entering)


def _eliminate(table: list[list[Fraction]], basis: list[int], row: int, column: int) -> None:
    """Bring a column into the basis: make it a unit vector with its one in ``row``."""
    basis[row] = column
    pivot = table[row][column]
    table[row] = [value / pivot for value in table[row]]
    for r, other in enumerate(table):
        factor = other[column]
        if r != row and factor != 0:
            table[r] = [x - factor * y for x, y in zip(other, table[row], strict=True)]
