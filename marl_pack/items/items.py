"""The items to be packed, and the table of their attributes.

:class:`Items` is the record that streams, games and plans share. :data:`ATTRIBUTES` says how files,
arrays and mappings give the attributes: the readers loop over it, so another attribute is one more
row there and the code that uses it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from marl_pack.geometry import ORIENTATIONS

ALL_ORIENTATIONS = tuple(range(len(ORIENTATIONS)))
"""Numbers of the six orientations, :data:`marl_pack.geometry.ORIENTATIONS`."""
UPRIGHT = (0, 1)
"""Orientations in which the item's own height stays vertical: this side up."""


@dataclass(frozen=True)
class Items:
    """Items with their attributes, one tensor an attribute.

    Leading dimensions are free, e.g. [G] for the visible item of G games or [S, L] for S sequences.
    An attribute that is None has its default for every item, which costs nothing to carry.
    """

    sides: Tensor  # int16 [..., 3]              own sides w, d, h in cells; zeros: no item
    weights: Tensor  # float64 [...]             weight; volumes unless given
    orientations: Tensor | None = None  # bool [..., 6]  orientations it may be placed in; None: all
    ids: Tensor | None = None  # int64 [...]     number of the item; None: its place in the sequence

    def map(self, change: Callable[[Tensor], Tensor]) -> Items:
        """Return the items with ``change`` applied to every field that is not None."""
        return Items(**{name: change(value) for name, value in self.tensors().items()})

    def __getitem__(self, index: Any) -> Items:
        """Return the chosen items."""
        return self.map(lambda values: values[index])

    def to(self, device: torch.device | str) -> Items:
        """Return the items on ``device``."""
        return self.map(lambda values: values.to(device))

    def tensors(self) -> dict[str, Tensor]:
        """Return the fields that are not None, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def numbered(self, t: Tensor) -> Items:
        """Return the items with their places ``t`` as ids, unless they have ids."""
        return self if self.ids is not None else Items(**self.tensors() | {"ids": t})

    def ids_at(self, t: Tensor) -> Tensor:
        """Return the items' ids, or their places ``t`` if they have none."""
        return t if self.ids is None else self.ids

    @property
    def present(self) -> Tensor:
        """The entries that hold an item, bool [...]."""
        return self.sides[..., 0] > 0

    def orientation_sets(self) -> dict[tuple[int, ...], float]:
        """Return the sets of orientations that items may take, with the share of items of each."""
        if self.orientations is None:
            return {ALL_ORIENTATIONS: 1.0}
        masks = self.orientations[self.present].cpu().numpy()
        rows, counts = np.unique(masks, axis=0, return_counts=True)
        sets = [tuple(np.flatnonzero(row).tolist()) for row in rows]
        return dict(zip(sets, (counts / len(masks)).tolist(), strict=True))


def join(parts: Sequence[Items]) -> Items:
    """Return the items of all ``parts``, which have the same fields, in one record."""
    tensors = [part.tensors() for part in parts]
    return Items(**{name: torch.cat([part[name] for part in tensors]) for name in tensors[0]})


@dataclass(frozen=True)
class Attribute:
    """An attribute of goods, as files, arrays and mappings give it.

    Args:
        column: its column in a CSV file.
        key: its key in JSON, npz and mappings, and its argument of
            :func:`marl_pack.items.check_items`.
        needs: what a value must be, for error messages.
        shape: shape of one item's value.
        dtype: NumPy type of the values.
        kinds: kinds of NumPy arrays that are converted whole; other values are parsed one by one.
        parse: from one value (text of a CSV cell, JSON value, array element) to the value;
            raises ValueError, TypeError or KeyError.
        check: which of the values [R, *shape] are valid, bool [R].
    """

    column: str
    key: str
    needs: str
    shape: tuple[int, ...]
    dtype: type
    kinds: str
    parse: Callable[[Any], Any]
    check: Callable[[NDArray[Any]], NDArray[np.bool_]]

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
        """Return the values converted as one array, or None if each needs to be parsed.

        A list that becomes an array of texts may have had numbers in it, so it is parsed.
        """
        try:
            array = np.asarray(values)
            if array.dtype.kind == "U" and array is not values:
                return None
            if array.dtype.kind in self.kinds and array.shape == (len(values), *self.shape):
                return array.astype(self.dtype)
        except (ValueError, OverflowError):
            pass
        return None


TRUTH = {"true": True, "yes": True, "1": True, 1: True}
TRUTH |= {"false": False, "no": False, "0": False, 0: False}


def _truth(value: Any) -> bool:
    """Return the bool that a text, a number or a bool stands for."""
    return TRUTH[value.lower() if isinstance(value, str) else value]


def _number(value: Any) -> float:
    """Return the number that a text or a number stands for."""
    if isinstance(value, bool | np.bool_):
        raise TypeError(value)
    return float(value)


def _whole(value: Any) -> int:
    """Return the whole number that a text or a number stands for."""
    number = _number(value)
    if number != int(number):
        raise ValueError(value)
    return int(number)


def _orientation_mask(value: Any) -> NDArray[np.bool_]:
    """Return bool [6] from a list of numbers 0 … 5, or a text of them."""
    numbers = value.replace(",", " ").split() if isinstance(value, str) else list(value)
    if len({_whole(n) for n in numbers}) < len(numbers):  # such as flags 0 and 1
        raise ValueError(value)
    return np.isin(ALL_ORIENTATIONS, [ALL_ORIENTATIONS.index(_whole(n)) for n in numbers])


def _id(value: Any) -> str | int:
    """Return an id that is a text or a whole number."""
    return value if isinstance(value, str) else _whole(value)


ATTRIBUTES = (
    Attribute(
        "weight", "weights", "a positive number", (), np.float64, "iufU", _number,
        lambda values: np.array(np.isfinite(values) & (values > 0), bool),
    ),
    Attribute(
        "upright", "upright", "true or false (1 or 0, yes or no)", (), np.bool_, "b", _truth,
        lambda values: np.ones(len(values), bool),
    ),
    Attribute(
        "orientations", "orientations", "one or more of the numbers 0 … 5, each once", (6,),
        np.bool_, "b", _orientation_mask, lambda values: np.array(values.any(1), bool),
    ),
    Attribute(
        "id", "ids", "a text or a whole number", (), np.object_, "iuU", _id,
        lambda values: np.array(values != "", bool),
    ),
    Attribute(
        "quantity", "quantity", "a whole number ≥ 1", (), np.int64, "iuU", _whole,
        lambda values: np.array(values >= 1, bool),
    ),
)  # fmt: skip
"""The attributes that items may be given with."""

KEYS = tuple(attribute.key for attribute in ATTRIBUTES)
"""Keys of the attributes in files and mappings."""
