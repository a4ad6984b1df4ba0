"""Solve the linear programs of static equilibrium by a small dense simplex method.

These programs have a dozen rows and a few dozen columns, and are degenerate. A mask needs thousands
of them, and the call of a library would take a hundred times as long as the pivots.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_pack.installation import njit

NEAR = 1e-6
"""Float64 decides if the least force (or, without a solution, the least error of the equations) is
above this number, in mean weights."""
RESIDUAL = 1e-9
"""A larger sum of the equations' errors cannot come from rounding."""

SMALLEST_PIVOT = 1e-6
"""A division by a smaller number may magnify rounding errors; then float64 is not trusted."""


@njit(cache=True, inline="always")
def nearly_a_tie(force: float, reach: float) -> bool:
    """Return whether rounding errors might change the sign of a least force.

    A contact is at least one cell wide, so the forces that balance an error are at most ``reach``
    times as large as the error.

    Args:
        force: the least force, from :func:`max_least_force`.
        reach: largest distance between two ends of the boxes along an axis, in cells.
    """
    return abs(force) <= max(NEAR, 2 * RESIDUAL * reach)


@njit(cache=True)
def _pivot(table: Any, basis: Any, row: int, column: int) -> None:
    """Bring ``column`` into the basis in place of the variable of ``row``."""
    table[row] /= table[row, column]
    for i in range(table.shape[0]):
        factor = table[i, column]
        if i != row and factor != 0.0:
            for j in range(table.shape[1]):
                table[i, j] -= factor * table[row, j]
    basis[row] = column


@njit(cache=True)
def _optimise(table: Any, basis: Any, columns: int, enough: float) -> bool:
    """Minimise the last row's objective by the simplex method, until it is below ``-enough``.

    The column with the most negative coefficient enters the basis. Among rows with equal ratios
    (the right-hand sides of moments are all 0), the row with the largest pivot leaves the basis,
    which keeps the numbers accurate. After many iterations, which may be a cycle, Bland's rule is
    used.

    Returns:
        Whether the method ended by its rules, before the limit on iterations.
    """
    rows = basis.size
    for iteration in range(200 * rows + 1000):
        if -table[rows, -1] < -enough:
            return True
        bland = iteration > 5 * rows + 50
        column, least = -1, -1e-10
        for j in range(columns):
            if table[rows, j] < least:
                column = j
                if bland:
                    break
                least = table[rows, j]
        if column < 0:
            return True
        row, best = -1, np.inf
        for i in range(rows):
            pivot = table[i, column]
            if pivot > 1e-9:
                ratio = max(table[i, -1], 0.0) / pivot
                tied = row >= 0 and ratio <= best + 1e-13
                if bland:
                    better = tied and basis[i] < basis[row]
                else:
                    better = tied and pivot > table[row, column]
                if ratio < best - 1e-13 or better:
                    row, best = i, ratio
        if row < 0 or table[row, column] < SMALLEST_PIVOT:
            return False  # rounding errors: the weights bound the forces, so a row exists
        _pivot(table, basis, row, column)
    return False


@njit(cache=True)
def _solution(table: Any, basis: Any, a: Any, weight: Any) -> tuple[float, float, float]:
    """Read the solution from a simplex table, and check it in the equations.

    Returns:
        t, the sum of the equations' absolute errors, and the least force.
    """
    rows, columns = a.shape
    force, t = np.zeros(columns), 0.0
    for i in range(rows):
        if basis[i] < columns:
            force[basis[i]] += table[i, columns + 1]
        elif basis[i] == columns:
            t = table[i, columns + 1]
    force += t
    lacking = 0.0
    for i in range(rows):
        error = weight[i]
        for j in range(columns):
            error -= a[i, j] * force[j]
        lacking += abs(error)
    return t, lacking, force.min()


@njit(cache=True)
def max_least_force(a: Any, weight: Any, enough: float) -> tuple[float, bool, Any]:
    """Solve the linear program ``max t, a f = weight, f ≥ t``.

    Args:
        a: float64 [R, m], of full row rank.
        weight: float64 [R], ≥ 0.
        enough: a value of t at which the search may stop.

    Returns:
        The optimum, or the first value above ``enough``; if no ``f ≥ 0`` solves the equations,
        minus the smallest possible sum of their errors. Whether the forces, put back into the
        equations, confirm this value: false if rounding errors have corrupted the table. The
        basis int64 [R]: columns of a, m for t, or m + 1 + r for the error of equation r.
    """
    rows, columns = a.shape
    table = np.zeros((rows + 1, columns + 2))  # g, t, right-hand side; objective in the last row
    basis = np.empty(rows, np.int64)
    for i in range(rows):
        for j in range(columns):
            table[i, j] = a[i, j]
            table[i, columns] += a[i, j]
        table[i, columns + 1] = weight[i]
        basis[i] = columns + 1 + i  # an artificial variable, never stored
        table[rows] -= table[i]
    reliable = _optimise(table, basis, columns + 1, np.inf)
    missing = -table[rows, columns + 1]
    feasible = missing <= 1e-9
    if feasible:
        for i in range(rows):  # drive artificial variables, now zero, out of the basis
            if basis[i] > columns:
                best = 0
                for j in range(columns + 1):
                    if abs(table[i, j]) > abs(table[i, best]):
                        best = j
                if abs(table[i, best]) > 1e-9:
                    _pivot(table, basis, i, best)
                else:
                    reliable = False
        table[rows] = 0.0
        table[rows, columns] = -1.0
        for i in range(rows):
            if basis[i] == columns:
                table[rows] += table[i]
        reliable = _optimise(table, basis, columns + 1, enough) and reliable
        missing = 0.0

    t, lacking, least = _solution(table, basis, a, weight)
    reliable = reliable and abs(lacking - missing) < RESIDUAL and least > -1e-9
    return (t if feasible else -missing), reliable, basis
