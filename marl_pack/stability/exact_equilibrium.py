r"""Decide strict static equilibrium exactly, where float64 is not accurate enough.

The linear program is the one in :mod:`marl_pack.stability.static_equilibrium`: forces
:math:`f \ge 0` at the corners of the contacts balance every box, :math:`A f = w`. Each row of
:math:`A` balances the vertical force or one moment of a box; :math:`w` holds the weights. The stack
stands strictly if :math:`A f = w, f \ge t` has a solution with :math:`t > 0`. All numbers are
fractions, so each equation can be multiplied until all its numbers are whole.

1. The simplex method in float64 finds the largest :math:`t`. It decides, unless this :math:`t` is
   too close to 0 (a tie).
2. At a tie, the dual solution may be a motion of the boxes that no contact resists and no weight
   opposes: :math:`y \ne 0, y^T A \ge 0, y^T w \le 0`. It is rounded to fractions with small
   denominators and checked in whole numbers. If it passes the check, it proves that the stack does
   not stand strictly (Farkas' lemma).
3. If it fails the check, a simplex method in whole numbers solves the linear program. It uses
   integer pivoting: the stored table is always the true table times the last pivot, and no division
   leaves a remainder (Edmonds 1967; Bareiss 1968).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import count
from math import lcm

import numpy as np
from numpy.typing import NDArray

from marl_pack.stability.simplex import NEAR, max_least_force, nearly_a_tie

Whole = NDArray[np.object_]
"""Array of Python integers, which can be arbitrarily large."""
DENOMINATORS = 10**6
"""Largest denominator of the fractions to which a dual solution is rounded."""
GROUND = -1
"""Index of everything that never moves: the floor, and boxes that are known to stand."""


@dataclass(frozen=True)
class Load:
    """The weight of a box and its centre of mass seen from above, as exact numbers."""

    weight: Fraction
    x: Fraction  # of the centre of mass, in cells
    y: Fraction


@dataclass(frozen=True)
class Force:
    """A force at a corner of a contact: it lifts one box and presses on another."""

    x: int  # of the corner, in cells
    y: int
    upper: int  # index of the box it lifts
    lower: int  # index of the box it presses on, or GROUND


def stands_exactly(loads: Sequence[Load], forces: Iterable[Force]) -> bool:
    """Return whether boxes are in strict static equilibrium.

    The answer is exact: float64 decides only where its answer is certain.

    Args:
        loads: the weight and the centre of mass of each box.
        forces: the forces that may act between the boxes, and between boxes and ground.
    """
    columns = list(forces)
    if not columns:
        return False
    a, weights = _equations(loads, columns)
    try:
        rounded = a.astype(np.float64)
        total = float(weights.sum())
        relative = weights.astype(np.float64) * (len(loads) / total)
    except OverflowError:  # numbers with hundreds of digits
        return _strictly_feasible(a, weights)
    largest = np.abs(rounded).max(1, initial=1.0)
    rounded /= largest[:, None]
    least_force, reliable, basis = max_least_force(rounded, relative, 10 * NEAR)
    positions = [position for column in columns for position in (column.x, column.y)]
    if reliable and not nearly_a_tie(least_force, max(positions) - min(positions)):
        return bool(least_force > 0)
    motion = _motion(rounded, basis) / largest
    return not _moves_freely(a, weights, motion) and _strictly_feasible(a, weights)


def _motion(a: NDArray[np.float64], basis: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the dual solution [R] of a basis of ``max t, a f = w, f ≥ t``; NaN if there is none.

    Args:
        a: the equations [R, F].
        basis: the basis that :func:`marl_pack.stability.simplex.max_least_force` returns.
    """
    columns = np.hstack((a, a.sum(1, keepdims=True), np.eye(len(a))))[:, basis]
    try:
        return np.linalg.solve(columns.T, (basis == a.shape[1]).astype(np.float64))
    except np.linalg.LinAlgError:
        return np.full(len(a), np.nan)


def _moves_freely(a: Whole, weights: Whole, motion: NDArray[np.float64]) -> bool:
    """Return whether a motion, rounded to fractions, proves that boxes do not stand strictly.

    Args:
        a: the equations [R, F] in whole numbers.
        weights: their right-hand side [R].
        motion: float64 [R]. It need not solve anything: the check in whole numbers proves it.
    """
    largest = np.abs(motion).max(initial=0.0)
    if not 0 < largest < np.inf:
        return False
    moving = np.flatnonzero(np.abs(motion) > largest / DENOMINATORS)
    relative = (motion[moving] / largest).tolist()
    fractions = [Fraction(value).limit_denominator(DENOMINATORS) for value in relative]
    denominator = lcm(*(fraction.denominator for fraction in fractions))
    y = np.array([int(fraction * denominator) for fraction in fractions], object)
    return bool((y @ a[moving] >= 0).all() and y @ weights[moving] <= 0)


def _equations(loads: Sequence[Load], forces: Sequence[Force]) -> tuple[Whole, Whole]:
    """Return the equations of balance in whole numbers: A [R, F] and the right-hand side [R]."""
    a = np.zeros((3 * len(loads), len(forces)), object)
    for column, force in enumerate(forces):
        for box, sign in ((force.upper, 1), (force.lower, -1)):
            if box == GROUND:
                continue
            load = loads[box]
            a[3 * box, column] = sign
            a[3 * box + 1, column] = sign * (force.x * load.x.denominator - load.x.numerator)
            a[3 * box + 2, column] = sign * (force.y * load.y.denominator - load.y.numerator)
    denominator = lcm(*(load.weight.denominator for load in loads))
    weights = np.zeros(3 * len(loads), object)
    for box, load in enumerate(loads):
        weights[3 * box] = int(load.weight * denominator)
    return a, weights


def _strictly_feasible(a: Whole, weights: Whole) -> bool:
    """Return whether ``a f = weights`` has a solution in which all f are positive."""
    rows, columns = a.shape
    # Columns: f - t of each force, t itself, the right-hand side. The last row is the objective.
    table = np.zeros((rows + 1, columns + 2), object)
    table[:rows, :columns] = a
    table[:rows, columns] = a.sum(1)
    table[:rows, -1] = weights
    basis = np.arange(columns + 1, columns + 1 + rows)  # artificial variables, never stored
    table[rows] = -table[:rows].sum(0)
    scale = _optimise(table, basis, 1, columns)
    if table[rows, -1] != 0:
        return False
    for row in np.flatnonzero(basis > columns):
        candidates = np.flatnonzero(table[row, : columns + 1])
        if candidates.size == 0:
            return False  # for some small shift of the weights, no forces balance
        if table[row, candidates[0]] < 0:
            table[row] = -table[row]
        scale = _pivot(table, basis, scale, int(row), int(candidates[0]))
    table[rows] = 0
    table[rows, columns] = -scale
    for row in np.flatnonzero(basis == columns):
        table[rows] += table[row]
    _optimise(table, basis, scale, columns)
    return any(table[row, -1] > 0 for row in np.flatnonzero(basis == columns))


def _pivot(table: Whole, basis: NDArray[np.int64], scale: int, row: int, column: int) -> int:
    """Bring ``column`` into the basis in place of the variable of ``row``; return the new scale."""
    pivot = table[row, column]
    others = np.arange(len(table)) != row
    factors = table[others, column]
    table[others] = (table[others] * pivot - factors[:, None] * table[row]) // scale
    basis[row] = column
    return int(pivot)


def _optimise(table: Whole, basis: NDArray[np.int64], scale: int, t_column: int) -> int:
    """Minimise the last row's objective by the simplex method; return the table's scale.

    The column with the most negative coefficient enters the basis. After many iterations, which may
    be a cycle, Bland's rule is used, so that the method ends. The search for a positive t stops at
    the first positive value.

    Args:
        table: whole numbers [R + 1, F + 2], the true table times ``scale``.
        basis: the variable of each row [R].
        scale: the last pivot.
        t_column: the column of t.
    """
    rows = len(basis)
    first_phase = bool((basis > t_column).any())
    for iteration in count():
        objective = table[rows, : t_column + 1]
        negative = np.flatnonzero(objective < 0)
        if negative.size == 0:
            break
        bland = iteration > 5 * rows + 50
        column = int(negative[0] if bland else np.argmin(objective))
        best = -1
        for row in range(rows):
            if table[row, column] <= 0:
                continue
            if best >= 0:
                # Compare the ratios right-hand side : column of the two rows, without division.
                product = table[row, -1] * table[best, column]
                least = table[best, -1] * table[row, column]
                if product > least or (product == least and basis[row] > basis[best]):
                    continue
            best = row
        if best < 0:
            break
        scale = _pivot(table, basis, scale, best, column)
        if not first_phase and any(table[row, -1] > 0 for row in np.flatnonzero(basis == t_column)):
            break
    return scale
