"""The judge's form of a stack: boxes in a bin, in metres and kilograms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_pack.plan import Plan

Floats = NDArray[np.float64]

SLACK = 1e-6 / 0.3
"""Largest distance between faces that count as touching, and largest overlap that is ignored, as a
share of the boxes' longest side: 1e-6 m for the paper's longest box."""

MOST_BOXES = 3000
"""Largest number of boxes in a stack; there is a limit because all pairs of boxes are compared."""

PAPER_BIN = 0.6
"""Edge of the paper's bin in metres (sec. IV-A)."""

DENSITY = 500.0
"""Density of a filled carton in kg/m³, which the commands assume. Verdicts depend only on the
ratios of the boxes' masses."""


@dataclass(frozen=True)
class Stack:
    """A stack of n boxes in order of placement; :meth:`of_plan` and :meth:`of_cells` check it."""

    size: Floats  # [3]      the bin's inner sides, m
    low: Floats  # [n, 3]    low corner of each box, m
    sides: Floats  # [n, 3]  m
    mass: Floats  # [n]      kg
    com: Floats  # [n, 3]    centre of mass from the box's middle, m, along its own sides
    yaw: Floats  # [n]       rotation about the vertical through the middle, radians

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
        yaw: ArrayLike = 0.0,
    ) -> Stack:
        """Return the stack of boxes given in cells.

        Args:
            size: the bin's W, D, H in cells.
            boxes: [n, 6], rows x, y, z, w, d, h in cells, in order of placement; fractions of a
                cell are fine.
            cell: edge of a cell in metres; by default the bin's longest side is the paper's 0.6 m.
            density: density in kg/m³, one for all boxes or [n]. Either this or ``mass``.
            mass: mass in kg, one for all boxes or [n].
            com_offset: centre of mass from the box's middle in fractions of w, d, h, one for all
                boxes or [n, 3], each strictly between -0.5 and 0.5.
            yaw: rotation about the vertical through the middle in degrees, one for all boxes or
                [n]; the rows are then those of the boxes before they are rotated.

        Raises:
            ValueError: if boxes overlap, float, reach out of the bin or have a side that is not
                positive; for a mass that is not positive, a centre of mass outside its box, or any
                number that is not finite. The message names the box.
        """
        rows = np.asarray(boxes, np.float64)
        if rows.size == 0:
            rows = rows.reshape(0, 6)
        if rows.ndim != 2 or rows.shape[1] != 6:
            raise ValueError(f"boxes: shape {rows.shape}, needs [n, 6]: x, y, z, w, d, h")
        inner = np.asarray(size, np.float64)
        if inner.shape != (3,) or not (np.isfinite(inner) & (inner > 0)).all():
            raise ValueError(f"bin size {size!r}: needs three positive numbers of cells, W D H")
        if cell is None:
            cell = cell_size(size)
        if not (np.isfinite(cell) and cell > 0):
            raise ValueError(f"cell = {cell}: needs a positive length in metres")
        if (density is None) == (mass is None):
            raise ValueError("needs either the density (kg/m³) or the mass (kg) of the boxes")
        low, sides = rows[:, :3] * cell, rows[:, 3:] * cell
        weights = _each(density if mass is None else mass, len(rows), (), "density or mass")
        _refuse(~(np.isfinite(weights) & (weights > 0)), weights, "needs a positive mass")
        offset = _each(com_offset, len(rows), (3,), "com_offset")
        inside = (np.abs(offset) < 0.5).all(1)  # false for NaN, too
        _refuse(~inside, offset, "needs a centre of mass inside the box")
        with np.errstate(over="ignore"):
            weights = weights * sides.prod(1) if mass is None else weights
        yaws = np.radians(_each(yaw, len(rows), (), "yaw"))
        _refuse(~np.isfinite(yaws), rows, "needs a finite yaw")
        stack = cls(inner * cell, low, sides, weights, offset * sides, yaws)
        stack.check(rows)
        _refuse(~(np.isfinite(weights) & (weights > 0)), rows, "its mass is not a number > 0")
        return stack

    @classmethod
    def of_plan(
        cls,
        plan: Plan,
        *,
        cell: float | None = None,
        density: ArrayLike | None = None,
        mass: ArrayLike | None = None,
        com_offset: ArrayLike | None = None,
    ) -> Stack:
        """Return the stack of a plan's boxes.

        Args:
            plan: boxes in one bin; for a plan of several bins use ``plan.in_bin(k)``.
            cell: length of the plan's unit in metres; by default :func:`cell_of`.
            density: density in kg/m³, one for all boxes or [n], instead of the plan's weights.
            mass: mass in kg, one for all boxes or [n], instead of the plan's weights.
            com_offset: centres of mass as in :meth:`of_cells`; by default the plan's, in the middle
                of the height.

        Raises:
            ValueError: for the reasons of :meth:`of_cells`, or for a plan of several bins.
        """
        if len(plan.bin_sizes) != 1:
            raise ValueError(f"a plan of {len(plan.bin_sizes)} bins: needs one, plan.in_bin(k)")
        if density is None and mass is None:
            mass = plan.weights
        return cls.of_cells(
            plan.bin_sizes[0].tolist(), plan.boxes, cell=cell_of(plan) if cell is None else cell,
            density=density, mass=mass,
            com_offset=offsets_of(plan) if com_offset is None else com_offset, yaw=plan.yaws,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.low)

    @property
    def high(self) -> Floats:
        """High corner of each box in metres, [n, 3]."""
        return self.low + self.sides

    @property
    def middle(self) -> Floats:
        """Middle of each box in metres, [n, 3]."""
        return self.low + self.sides / 2

    def scaled(self, scale: float) -> Stack:
        """Return the stack with lengths times ``scale`` and a mean mass of 1 kg."""
        lengths = (self.size, self.low, self.sides, self.com)
        size, low, sides, com = (length * scale for length in lengths)
        return Stack(size, low, sides, self.mass / self.mass.mean(), com, self.yaw)

    def first(self, count: int) -> Stack:
        """Return the stack as it was when ``count`` boxes had been placed."""
        if not 0 <= count <= len(self):
            raise ValueError(f"count = {count}: needs 0 … {len(self)}")
        return self.only(slice(count))

    def only(self, which: slice | NDArray[np.intp]) -> Stack:
        """Return the stack with only the boxes ``which``, in this order."""
        arrays = {f.name: getattr(self, f.name)[which] for f in fields(self) if f.name != "size"}
        return replace(self, **arrays)

    @property
    def slack(self) -> float:
        """Largest distance in metres between faces that count as touching."""
        return SLACK * float(self.sides.max(initial=0.0))

    def rests_on(self) -> NDArray[np.bool_]:
        """Return, bool [n, n], whether box i touches box j from above on more than an edge."""
        low, high = self.low, self.high
        meet = np.abs(low[:, None, 2] - high[None, :, 2]) < self.slack
        return meet & (self.overlaps()[0] > self.slack)

    def overlaps(self) -> tuple[Floats, Floats]:
        """Return how far boxes i and j overlap, seen from above and vertically, [n, n] each.

        A negative number is a gap. Seen from above it is the least overlap along a side of one of
        the two (separating axis theorem).
        """
        low, high = self.low, self.high
        along = np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None])
        if not self.yaw.any():
            return along[..., :2].min(-1), along[..., 2]
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        axes = np.stack((np.stack((cos, sin), -1), np.stack((-sin, cos), -1)), 1)  # [n, 2, 2]
        half, middle = self.sides[:, :2] / 2, self.middle[:, :2]
        apart = middle[None] - middle[:, None]  # [i, j]
        # Along the sides of box i: both half lengths minus the distance of the middles.
        reach = np.einsum("iax,jbx->ijab", axes, axes)
        other = (np.abs(reach) * half[None, :, None]).sum(-1)
        depth = half[:, None] + other - np.abs(np.einsum("iax,ijx->ija", axes, apart))
        least = depth.min(-1)
        return np.minimum(least, least.T), along[..., 2]

    def check(self, named: NDArray[np.floating[Any]] | None = None) -> None:
        """Refuse a stack that cannot exist.

        Args:
            named: the rows that messages show for the boxes; by default in metres.

        Raises:
            ValueError: if a box overlaps an earlier one, floats or reaches out of the bin; names
                the first such box.
        """
        if len(self) > MOST_BOXES:
            raise ValueError(f"{len(self)} boxes: needs at most {MOST_BOXES}")
        rows = np.hstack([self.low, self.sides]) if named is None else named
        _refuse(
            ~np.isfinite(np.hstack([self.low, self.sides])).all(1), rows, "needs finite numbers"
        )
        _refuse((self.sides <= 0).any(1), rows, "needs sides longer than 0")
        cos, sin = np.abs(np.cos(self.yaw)), np.abs(np.sin(self.yaw))
        w, d = self.sides[:, 0], self.sides[:, 1]
        wide = np.column_stack((w * cos + d * sin, w * sin + d * cos, self.sides[:, 2]))
        out = (self.middle - wide / 2 < -self.slack) | (
            self.middle + wide / 2 > self.size + self.slack
        )
        _refuse(out.any(1), rows, "reaches out of the bin")
        beside, above = self.overlaps()
        shared = np.tril((beside > self.slack) & (above > self.slack), -1)
        for i, j in np.argwhere(shared)[:1]:
            raise ValueError(f"{_name(i, rows)} overlaps {_name(j, rows)}")
        resting = np.tril(self.rests_on(), -1).any(1) | (self.low[:, 2] < self.slack)
        _refuse(~resting, rows, "floats: it rests neither on the floor nor on an earlier box")


def cell_size(size: Sequence[float]) -> float:
    """Return the edge of a cell in metres so that the bin's longest side is the paper's 0.6 m."""
    return PAPER_BIN / float(max(size))


def cell_of(plan: Plan) -> float:
    """Return the length of a plan's unit in metres; for a plan without unit, :func:`cell_size`."""
    return cell_size(plan.bin_sizes[0]) if plan.unit_mm is None else plan.unit_mm / 1000


def offsets_of(plan: Plan) -> Floats:
    """Return each centre of mass from its box's middle in fractions of w, d, h, [n, 3].

    A plan does not say the height of a centre of mass, so it is in the middle.
    """
    offset = np.zeros((len(plan), 3))
    offset[:, :2] = (plan.centres - plan.positions[:, :2]) / plan.sides[:, :2] - 0.5
    return offset


def _each(value: ArrayLike | None, n: int, shape: tuple[int, ...], name: str) -> Floats:
    """Return a value for each box as float64 [n, …], from one value for all or one for each."""
    values = np.asarray(value, np.float64)
    if values.shape not in (shape, (n, *shape)):
        raise ValueError(f"{name}: shape {values.shape}, needs {shape} or {(n, *shape)}")
    return np.broadcast_to(values, (n, *shape)).copy()


def _name(i: int, rows: NDArray[np.floating[Any]]) -> str:
    """Return the text by which messages name a box: its number and row."""
    return f"box {i} ({', '.join(f'{value:g}' for value in np.atleast_1d(rows[i]))})"


def _refuse(wrong: Any, rows: NDArray[np.floating[Any]], why: str) -> None:
    """Raise ValueError with the first box for which ``wrong``, bool [n], is true."""
    for i in np.flatnonzero(wrong)[:1]:
        raise ValueError(f"{_name(i, rows)}: {why}")
