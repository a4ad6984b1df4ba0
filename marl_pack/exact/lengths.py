"""Convert millimetres to whole units of length, exactly."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_pack.checks import decimals, exact, real_number, shown
from marl_pack.exact.limits import MOST_UNITS


def check_unit(unit_mm: Any) -> float:
    """Check the unit of length in millimetres and return it.

    Raises:
        ValueError: unless it is a number from 0.001 to 1000.
    """
    unit = real_number(unit_mm, "unit_mm")
    if not 0.001 <= unit <= 1000:
        raise ValueError(f"unit_mm {shown(unit_mm)}: needs a number of millimetres, 0.001 to 1000")
    return unit


def in_units(value_mm: float, unit_mm: float) -> Fraction:
    """Return a length in units; a float means the decimal that it is printed as."""
    return exact(value_mm) / exact(unit_mm)


def units_up(value_mm: float, unit_mm: float) -> int:
    """Return a length in whole units, rounded up."""
    return math.ceil(in_units(value_mm, unit_mm))


def to_units(lengths_mm: ArrayLike, unit_mm: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Convert lengths to whole units.

    Args:
        lengths_mm: finite numbers of any shape; each means the decimal that it is printed as.
        unit_mm: the unit in millimetres.

    Returns:
        The lengths in units, int64, and which of them are not a whole number of units that a bin
        may have (these are 0), bool.
    """
    values = decimals(np.asarray(lengths_mm))
    distinct, index = np.unique(values, return_inverse=True)
    whole = np.zeros(distinct.shape, np.int64)
    wrong = np.ones(distinct.shape, np.bool_)
    for k, value in enumerate(distinct.tolist()):
        units = in_units(value, unit_mm) if math.isfinite(value) else Fraction(1, 2)
        if units.denominator == 1 and abs(units) <= MOST_UNITS:
            whole[k], wrong[k] = int(units), False
    return whole[index].reshape(values.shape), wrong[index].reshape(values.shape)


def to_mm(lengths: Any, unit_mm: float) -> Any:
    """Return lengths in whole units as millimetres, float64; 3 units of 0.1 mm are 0.3."""
    unit = exact(unit_mm)
    return np.asarray(lengths, np.float64) * unit.numerator / unit.denominator
