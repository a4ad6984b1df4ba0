"""The table of the attributes that users may give with items.

:data:`ATTRIBUTES` says how files, arrays and mappings give the attributes, and what values may be.
The readers loop over this table, so a new attribute needs one more row and the code that uses it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.checks import decimals, number_in, real_number
from marl_pack.geometry import ALL_ORIENTATIONS

UPRIGHT = (0, 1)
"""Orientations in which the item's own height stays vertical: this side up."""

LONGEST_ID = 200
"""Largest number of characters in an id."""


@dataclass(frozen=True)
class Attribute:
    """How files, arrays and mappings give one attribute of items.

    Args:
        column: its column in a CSV file.
        key: its key in JSON, npz and mappings, and its argument of
            :func:`marl_pack.items.check_items`.
        needs: what a value must be, for error messages.
        shape: shape of one item's value.
        dtype: NumPy type of the values.
        kinds: kinds of NumPy arrays that are converted as a whole; other values are parsed one by
            one.
        of_text: function from the text of a CSV cell to a value as in JSON; raises ValueError.
        parse: function from one value in JSON, a mapping or an array to the checked value; raises
            ValueError, TypeError or KeyError.
        check: which of the values [R, *shape] are valid, bool [R].
    """

    column: str
    key: str
    needs: str
    shape: tuple[int, ...]
    dtype: type
    kinds: str
    of_text: Callable[[str], Any]
    parse: Callable[[Any], Any]
    check: Callable[[NDArray[Any]], NDArray[np.bool_]]

    def of_cells(self, cells: Sequence[str]) -> list[Any]:
        """Return the values of CSV cells as in JSON; a text that is not a value stays a text."""
        values: list[Any] = []
        for cell in cells:
            try:
                values.append(self.of_text(cell))
            except ValueError:
                values.append(cell)
        return values

    def read(self, values: Sequence[Any] | NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return the values of R items, [R, *shape], and which of them are invalid, bool [R]."""
        array, invalid = self._convert(values), np.zeros(len(values), bool)
        if array is None:
            array = np.zeros((len(values), *self.shape), self.dtype)
            for row, value in enumerate(values):
                try:
                    array[row] = self.parse(value)
                except (ValueError, TypeError, KeyError, OverflowError):
                    invalid[row] = True
        return array, invalid | ~self.check(array)

    def _convert(self, values: Sequence[Any] | NDArray[Any]) -> NDArray[Any] | None:
        """Return the values converted as one array, or None if each needs to be parsed."""
        try:
            if isinstance(values, np.ndarray) or only_numbers(values):
                array = np.asarray(values)
                if array.dtype.kind in self.kinds and array.shape == (len(values), *self.shape):
                    return decimals(array) if self.dtype is np.float64 else array.astype(self.dtype)
        except OverflowError:
            pass
        return None


def only_numbers(values: Iterable[Any]) -> bool:
    """Return whether all the values are numbers, or all are truth values."""
    types = set(map(type, values))
    truths = types & {bool, np.bool_}
    return truths == types or (not truths and all(issubclass(t, Real) for t in types))


TRUTH = {"true": True, "yes": True, "1": True, 1: True}
TRUTH |= {"false": False, "no": False, "0": False, 0: False}


def _truth(value: Any) -> bool:
    """Return the bool that a text, a number or a bool stands for."""
    return TRUTH[value.lower() if isinstance(value, str) else value]


def _weight(value: Any) -> float:
    """Return a weight as a number; ``check`` says later whether it is positive."""
    return real_number(value, "weight")


def _whole(value: Any) -> int:
    """Return a whole number, which may be written as a float."""
    if not isinstance(value, bool) and isinstance(value, Integral):
        return int(value)
    number = real_number(value, "value")
    if not number.is_integer():
        raise ValueError(value)
    return int(number)


def _orientations_in(text: str) -> list[int]:
    """Return the numbers of orientations that a text lists."""
    return [tuple("012345").index(number) for number in text.replace(",", " ").split()]


def _orientation_mask(value: Any) -> NDArray[np.bool_]:
    """Return bool [6] from a list of numbers 0 … 5, or of six truth values."""
    if len(value) == len(ALL_ORIENTATIONS) and all(isinstance(flag, bool) for flag in value):
        return np.array(value)
    numbers = [ALL_ORIENTATIONS.index(_whole(number)) for number in value]
    if len(set(numbers)) < len(numbers):  # a number twice, e.g. six flags written as 0 and 1
        raise ValueError(value)
    return np.array([number in numbers for number in ALL_ORIENTATIONS])


def _is_text(text: str) -> bool:
    """Return whether a text can be an id: not empty or too long, no control characters, UTF-8."""
    wrong = any("\ud800" <= c <= "\udfff" or c < " " or c == "\x7f" for c in text)
    return 0 < len(text) <= LONGEST_ID and not wrong


def _id(value: Any) -> str | int:
    """Return an id that is a text or a whole number."""
    number = value if isinstance(value, str) else _whole(value)
    if not isinstance(number, str) and abs(number) >= 10**LONGEST_ID:
        raise ValueError(value)
    return number


def _short(ids: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which ids are whole numbers or allowed texts, bool [R]."""
    return np.array([not isinstance(i, str) or _is_text(i) for i in ids], bool)


ATTRIBUTES = (
    Attribute(
        "weight", "weights", "a positive number", (), np.float64, "iuf", number_in, _weight,
        lambda values: np.array(np.isfinite(values) & (values > 0), bool),
    ),
    Attribute(
        "upright", "upright", "true or false (1 or 0, yes or no)", (), np.bool_, "b", str, _truth,
        lambda values: np.ones(len(values), bool),
    ),
    Attribute(
        "orientations", "orientations", "one or more of the numbers 0 … 5, each once", (6,),
        np.bool_, "b", _orientations_in, _orientation_mask,
        lambda values: np.array(values.any(1), bool),
    ),
    Attribute(
        "id", "ids", f"a text or a whole number of at most {LONGEST_ID} characters", (), np.object_,
        "iuU", str, _id, _short,
    ),
    Attribute(
        "quantity", "quantity", "a whole number ≥ 1", (), np.int64, "iu", number_in, _whole,
        lambda values: np.array(values >= 1, bool),
    ),
)  # fmt: skip
"""The attributes that users may give with items."""

KEYS = tuple(attribute.key for attribute in ATTRIBUTES)
"""Keys of the attributes in files and mappings."""
