"""Boxes in a bin, in metres and kilograms, as the judge takes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

SLACK = 1e-6
"""Metres by which faces may miss one another and still count as touching, not overlapping."""

PAPER_BIN = 0.6
"""Edge of the paper's bin in metres (sec. IV-A)."""

DENSITY = 500.0
"""What the commands take for the density of a filled carton, kg/m³. Verdicts depend on the boxes'
masses relative to one another alone."""


@dataclass(frozen=True)
class Stack:
    """n boxes in order of placement; made by :meth:`of_cells`, which looks at what it is given."""

    size: Floats  # [3]      the bin's inner sides, m
    low: Floats  # [n, 3]    low corner of each box, m
    sides: Floats  # [n, 3]  m
    mass: Floats  # [n]      kg
    com: Floats  # [n, 3]    centre of mass from the box's middle, m

    @classmethod
    def of_cells(
        cls,
        size: Sequence[float],
        boxes: ArrayLike,
        *,
        cell: float | None = None,
        density: ArrayLike | None = None,
        mass: ArrayLike | None = None,
        com_offset: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Stack:
        """Boxes given in cells.

        Args:
            size: the bin's W, D, H in cells.
            boxes: [n, 6], rows x, y, z, w, d, h in cells, in order of placement; fractions of a
                cell are fine.
            cell: edge of a cell in metres; by default the bin's longest side is the paper's 0.6 m.
            density: kg/m³, one for all or [n]. Either this or ``mass``.
            mass: kg, one for all or [n].
            com_offset: centre of mass from the box's middle in fractions of w, d, h, one for all
                or [n, 3], each strictly between -0.5 and 0.5.

        Raises:
            ValueError: naming the box, if boxes overlap, float, reach out of the bin or have a side
                that is not positive; for a mass that is not positive, a centre of mass outside its
                box, or any number that is not finite.
        """
        given = np.asarray(boxes, np.float64)
        if given.size == 0:
            given = given.reshape(0, 6)
        if given.ndim != 2 or given.shape[1] != 6:
            raise ValueError(f"boxes: shape {given.shape}, needs [n, 6]: x, y, z, w, d, h")
        inner = np.asarray(size, np.float64)
        if inner.shape != (3,) or not (np.isfinite(inner) & (inner > 0)).all():
            raise ValueError(f"bin size {size!r}: needs three positive numbers of cells, W D H")
        if cell is None:
            cell = cell_size(size)
        if not (np.isfinite(cell) and cell > 0):
            raise ValueError(f"cell = {cell}: needs a positive length in metres")
        if (density is None) == (mass is None):
            raise ValueError("give either the density (kg/m³) or the mass (kg) of the boxes")
        low, sides = given[:, :3] * cell, given[:, 3:] * cell
        weights = _each(density if mass is None else mass, len(given), (), "density or mass")
        _refuse(~(np.isfinite(weights) & (weights > 0)), weights, "needs a positive mass")
        offset = _each(com_offset, len(given), (3,), "com_offset")
        inside = (np.abs(offset) < 0.5).all(1)  # false for NaN, too
        _refuse(~inside, offset, "needs a centre of mass inside the box")
        with np.errstate(over="ignore"):
            weights = weights * sides.prod(1) if mass is None else weights
        stack = cls(inner * cell, low, sides, weights, offset * sides)
        stack.check(given)
        _refuse(~(np.isfinite(weights) & (weights > 0)), given, "its mass is not a number > 0")
        return stack

    def __len__(self) -> int:
        return len(self.low)

    @property
    def high(self) -> Floats:
        """High corner of each box, [n, 3]."""
        return self.low + self.sides

    @property
    def middle(self) -> Floats:
        """Middle of each box, [n, 3]."""
        return self.low + self.sides / 2

    def scaled(self, scale: float) -> Stack:
        """The same stack with lengths times ``scale`` and a mean mass of 1 kg."""
        lengths = (self.size, self.low, self.sides, self.com)
        size, low, sides, com = (length * scale for length in lengths)
        return Stack(size, low, sides, self.mass / self.mass.mean(), com)

    def first(self, count: int) -> Stack:
        """The stack as it was when ``count`` boxes had been placed."""
        if not 0 <= count <= len(self):
            raise ValueError(f"count = {count}: needs 0 … {len(self)}")
        return self.only(slice(count))

    def only(self, which: slice | NDArray[np.intp]) -> Stack:
        """These boxes of the stack alone, in the order given."""
        arrays = {f.name: getattr(self, f.name)[which] for f in fields(self) if f.name != "size"}
        return replace(self, **arrays)

    def rests_on(self) -> NDArray[np.bool_]:
        """Bool [n, n]: whether box i touches box j from above, on more than an edge."""
        low, high = self.low, self.high
        meet = np.abs(low[:, None, 2] - high[None, :, 2]) < SLACK
        return meet & (overlaps(low, high)[..., :2] > SLACK).all(-1)

    def check(self, named: NDArray[np.floating[Any]] | None = None) -> None:
        """Refuse a stack that cannot be.

        Args:
            named: rows by which to name the boxes; metres by default.

        Raises:
            ValueError: naming the first box that overlaps an earlier one, floats or reaches out of
                the bin.
        """
        rows = np.hstack([self.low, self.sides]) if named is None else named
        _refuse(
            ~np.isfinite(np.hstack([self.low, self.sides])).all(1), rows, "needs finite numbers"
        )
        _refuse((self.sides <= 0).any(1), rows, "needs sides longer than 0")
        out = (self.low < -SLACK) | (self.high > self.size + SLACK)
        _refuse(out.any(1), rows, "reaches out of the bin")
        shared = np.tril((overlaps(self.low, self.high) > SLACK).all(-1), -1)
        for i, j in np.argwhere(shared)[:1]:
            raise ValueError(f"{_name(i, rows)} overlaps {_name(j, rows)}")
        held = np.tril(self.rests_on(), -1).any(1) | (self.low[:, 2] < SLACK)
        _refuse(~held, rows, "floats: it rests neither on the floor nor on an earlier box")


def cell_size(size: Sequence[float]) -> float:
    """Metres of a cell where the bin's longest side is the paper's 0.6 m."""
    return PAPER_BIN / float(max(size))


def overlaps(low: Floats, high: Floats) -> Floats:
    """Length that boxes i and j share along each axis, [n, n, 3]; negative for a gap."""
    return np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None])


def _each(value: ArrayLike | None, n: int, shape: tuple[int, ...], name: str) -> Floats:
    """One for all or one each, as float64 [n, …]."""
    given = np.asarray(value, np.float64)
    if given.shape not in (shape, (n, *shape)):
        raise ValueError(f"{name}: shape {given.shape}, needs {shape} or {(n, *shape)}")
    return np.broadcast_to(given, (n, *shape)).copy()


def _name(i: int, rows: NDArray[np.floating[Any]]) -> str:
    return f"box {i} ({', '.join(f'{value:g}' for value in np.atleast_1d(rows[i]))})"


def _refuse(wrong: Any, rows: NDArray[np.floating[Any]], why: str) -> None:
    """Raise ValueError with the first box for which ``wrong``, bool [n], is true."""
    for i in np.flatnonzero(wrong)[:1]:
        raise ValueError(f"{_name(i, rows)}: {why}")
