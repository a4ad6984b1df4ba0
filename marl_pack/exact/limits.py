"""Numbers that compiled code reads, and what a placement has to satisfy in such numbers.

This module does not import Numba, so that options can be checked quickly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

MOST_UNITS = 1_000_000
"""Largest side of a bin in units: three coordinates and an orientation fit into one int64."""
SCALE = 256
"""Lattice points of polygons in a unit of length. It is even: the middle of a box lies on the
lattice."""

ROW = 10
"""Columns of a box: x, y, z, w, d, h; then x0, y0, x1, y1 of the rectangle of its top that carries.

The first six are the space that others may not enter. The rectangle is the whole top, but for a box
that a robot placed with a rotation: there it is a rectangle inside the rotated top."""
CARRIES = 6
"""First of the columns of the rectangle that carries."""

NONE, AREA_RATIO, HULL_1, HULL_ALPHA, LBCP, EQUILIBRIUM = range(6)
RULES = {
    "hull_1": HULL_1, "hull_alpha": HULL_ALPHA, "area_ratio": AREA_RATIO, "lbcp": LBCP,
    "equilibrium": EQUILIBRIUM, "none": NONE,
}  # fmt: skip
"""Every stability rule by its name, with its number in compiled code."""


class Limits(NamedTuple):
    """What a placement has to satisfy, in whole numbers that compiled code reads.

    A share is given as two numbers, numerator and denominator.
    """

    rule: int
    margin: int  # lattice points (SCALE)
    margin_share: tuple[int, int]  # the margin is at most this share of the shorter side
    margin_on_floor: bool
    tolerance: int  # units that a supporting top may lie below the resting height
    clearance: int  # units to neighbours and walls
    overhang: tuple[int, int]  # largest share of a side beyond the supporting boxes
    thresholds: Any  # int64 [T, 3], of area_ratio: share (two numbers) and corners
