"""Poses that a robot reported, and the rectangles around and inside a rotated box."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marl_pack.checks import real_number, shown
from marl_pack.geometry.rotated import inner_sides
from marl_pack.plan_columns import MOST_YAW

ROUNDING = 1e-9
"""Units by which a float may be wrong."""
DECIMALS = 5
"""Decimals of a reported pose, in millimetres and degrees."""


@dataclass(frozen=True)
class Pose:
    """Where a robot really put a box.

    Args:
        x, y: the middle of the box in the bin, in millimetres.
        yaw: rotation about the vertical from the planned orientation, in degrees, counterclockwise
            seen from above.

    Raises:
        ValueError: unless these are numbers, and the yaw is from -45 to 45.
    """

    x: float
    y: float
    yaw: float = 0.0

    def __post_init__(self) -> None:
        for name in ("x", "y", "yaw"):
            number = real_number(getattr(self, name), f"pose: {name}")
            object.__setattr__(self, name, round(number, DECIMALS))
        if abs(self.yaw) > MOST_YAW:
            raise ValueError(
                f"pose: yaw = {self.yaw:g}: needs degrees from -{MOST_YAW:g} to {MOST_YAW:g}"
            )

    @classmethod
    def of(cls, value: Pose | Sequence[float]) -> Pose:
        """Return a pose, also from two or three numbers x, y, yaw.

        Raises:
            ValueError: for anything else.
        """
        if isinstance(value, Pose):
            return value
        if not isinstance(value, Sequence | np.ndarray) or len(value) not in (2, 3):
            raise ValueError(f"pose {shown(value)}: needs x, y in mm and yaw in degrees")
        return cls(*value)


def rectangles(
    x: float, y: float, w: float, d: float, yaw: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rectangles along the axes around and inside a rotated footprint, in whole units.

    Args:
        x, y: middle of the footprint, in units.
        w, d: its sides, in units.
        yaw: its rotation in degrees, at most 45.

    Returns:
        The smallest rectangle around it and a large one inside it, int64 [4] each, x0, y0, x1, y1.
        They are rounded outwards and inwards.
    """
    angle = math.radians(abs(yaw))
    cos, sin = math.cos(angle), math.sin(angle)
    outer = np.array((w * cos + d * sin, w * sin + d * cos)) / 2
    inner = np.array(inner_sides(w, d, cos, sin)) / 2
    middle = np.array((x, y))
    around = np.concatenate(
        (np.floor(middle - outer + ROUNDING), np.ceil(middle + outer - ROUNDING))
    )
    inside = np.concatenate(
        (np.ceil(middle - inner - ROUNDING), np.floor(middle + inner + ROUNDING))
    )
    inside[2:] = np.maximum(inside[2:], inside[:2])  # nothing carries if it is that thin
    return around.astype(np.int64), inside.astype(np.int64)
