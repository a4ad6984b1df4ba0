"""Boxes in a bin, and the row of a box whose pose a robot reported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marl_pack.exact.goods import Goods
from marl_pack.explanation import Explanation
from marl_pack.geometry.rotated import overlap
from marl_pack.packer.answers import Placement
from marl_pack.packer.poses import Pose, rectangles

TOUCHING = 0.5
"""Units by which reported poses may overlap: they are rounded to whole units."""


@dataclass(frozen=True)
class Packed:
    """A box in a bin."""

    item: Goods  # one row
    placement: Placement
    planned: Placement  # before a pose was reported
    row: NDArray[np.int64]  # [10]  its row in the bin's state
    middle: tuple[float, float]  # x, y in units
    explanation: Explanation | None = None

    def shape(self, unit_mm: float) -> tuple[float, float, float, float, float]:
        """Return middle, sides and yaw of the box seen from above, in units and degrees."""
        placed = self.placement
        return (*self.middle, placed.w / unit_mm, placed.d / unit_mm, placed.yaw)


def row_at(
    pose: Pose,
    planned: Placement,
    others: Sequence[Packed],
    size: NDArray[np.int64],
    unit_mm: float,
) -> NDArray[np.int64]:
    """Return the row of a box at a reported pose (:data:`marl_pack.exact.limits.ROW`), int64 [10].

    It rests on the highest top under it that is not above its planned height.

    Args:
        pose: where the box is.
        planned: where it was planned.
        others: the boxes in the bin.
        size: int64 [3], W, D, H in units.
        unit_mm: millimetres of a unit.

    Raises:
        ValueError: if the box would overlap another one or reach out of the bin.
    """
    name = f"box {planned.id!r}" if planned.id else "the box"
    w, d, h = (round(side / unit_mm) for side in (planned.w, planned.d, planned.h))
    shape = pose.x / unit_mm, pose.y / unit_mm, w, d, pose.yaw
    around, inside = rectangles(*shape)
    if (around[:2] < 0).any() or (around[2:] > size[:2]).any():
        beyond = float(max(*-around[:2], *(around[2:] - size[:2]))) * unit_mm
        raise ValueError(f"actual: {name} would reach out of the bin by {beyond:.1f} mm at {pose}")
    depths = [overlap(shape, box.shape(unit_mm)) for box in others]
    z = 0
    for box, depth in zip(others, depths, strict=True):
        top = int(box.row[2] + box.row[5])
        if top <= round(planned.z / unit_mm) and depth > TOUCHING:
            z = max(z, top)
    for box, depth in zip(others, depths, strict=True):
        low, high = int(box.row[2]), int(box.row[2] + box.row[5])
        if low < z + h and high > z and depth > TOUCHING:
            raise ValueError(
                f"actual: {name} would overlap box {box.placement.id!r} by "
                f"{depth * unit_mm:.1f} mm at {pose}"
            )
    return np.array((*around[:2], z, *(around[2:] - around[:2]), h, *inside), np.int64)
