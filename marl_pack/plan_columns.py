"""What a plan says about each box: the keys in JSON, and the columns of CSV files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

UNIT = "unit_mm"  # key of the unit in JSON, CSV and .npz
BOX = (
    "id", "bin", "x", "y", "z", "w", "d", "h", "orientation", "weight", "centre_x", "centre_y"
)  # fmt: skip
"""Keys that every box has in JSON, and the first columns of a CSV file."""
COLUMNS = (*BOX, "bin_w", "bin_d", "bin_h", UNIT)
"""Columns of a CSV file: every line repeats the size of its bin and the unit."""
MOST_YAW = 45.0
"""Largest rotation of a box about the vertical, in degrees; more is another orientation."""


@dataclass(frozen=True)
class Extra:
    """A value that a plan has for each box, and that files leave out where it is the default.

    Args:
        key: its key in JSON, its column in CSV and its array in .npz.
        field: its field of :class:`marl_pack.plan.Plan`, an array [n].
        default: the value of most boxes.
        needs: what a value has to be, for messages.
        check: which of the values [n] are valid, bool [n].
    """

    key: str
    field: str
    default: float | bool
    needs: str
    check: Callable[[Array], Array]

    def array(self, values: Any, n: int) -> Array:
        """Return the values of n boxes as an array of the default's type; None: all defaults.

        Raises:
            ValueError: unless there is one number, or truth value, for each box.
        """
        kind = type(self.default)
        if values is None:
            return np.full(n, self.default, kind)
        given = np.asarray(values)
        kinds = "b" if kind is bool else "iuf"
        if given.shape != (n,) or (given.size and given.dtype.kind not in kinds):
            raise ValueError(f"{self.field}: needs {self.needs} for each of {n} boxes")
        return given.astype(kind)

    def is_default(self, value: Any) -> bool:
        """Return whether a value is the default; NaN is NaN."""
        return value == self.default or (value != value and self.default != self.default)

    def of_json(self, value: Any) -> Any:
        """Return a value from JSON, checked for its type.

        Raises:
            ValueError: saying what is needed.
        """
        numbers = isinstance(value, int | float) and not isinstance(value, bool)
        if not (isinstance(value, bool) if isinstance(self.default, bool) else numbers):
            raise ValueError(f"{self.key}: needs {self.needs}")
        return value

    def of_text(self, text: str) -> Any:
        """Return the value of a CSV cell; the default for an empty one."""
        if not text:
            return self.default
        if isinstance(self.default, bool):
            if text not in ("0", "1"):
                raise ValueError(f"{self.key}: needs 1 or 0")
            return text == "1"
        return float(text)

    def to_text(self, value: Any) -> Any:
        """Return a value for a CSV cell: empty for the default, 1 or 0 for truth values."""
        if self.is_default(value):
            return ""
        return int(value) if isinstance(self.default, bool) else value


def _any(values: Array) -> Array:
    return np.ones(len(values), np.bool_)


EXTRAS = (
    Extra("yaw", "yaws", 0.0, f"a number of degrees from -{MOST_YAW:g} to {MOST_YAW:g}",
          lambda values: np.abs(values) <= MOST_YAW),
    Extra("weight_assumed", "weights_assumed", False, "true or false", _any),
    Extra("stackable", "stackable", True, "true or false", _any),
    Extra("max_load", "max_loads", np.inf, "a number ≥ 0", lambda values: values >= 0),
    Extra("support", "supports", np.nan, "a share from 0 to 1",
          lambda values: np.isnan(values) | ((values >= 0) & (values <= 1))),
    Extra("margin", "margins", np.nan, "a number", lambda values: ~np.isinf(values)),
)  # fmt: skip
"""Values that a plan may have for each box:

- ``yaw``: rotation about the vertical through the middle, in degrees, counterclockwise from above;
- ``weight_assumed``: whether the weight was assumed, because it is unknown;
- ``stackable``: whether anything may rest on the box;
- ``max_load``: largest weight of all boxes above it, in the unit of weights;
- ``support``: share of the footprint that rests on the floor or on boxes;
- ``margin``: distance of the centre of mass from the edge of its support, in the unit of lengths.
"""
ALL_COLUMNS = (*COLUMNS, *(extra.key for extra in EXTRAS))
"""Columns of a CSV file of plans in which some box has such a value."""
