"""Sequences of items that the user gives: their checks, and the stream that plays them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain
from numbers import Real
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from marl_pack.backend import Backend
from marl_pack.geometry import ORIENTATIONS, Size
from marl_pack.items.items import ALL_ORIENTATIONS, ATTRIBUTES, KEYS, UPRIGHT, Attribute, Items
from marl_pack.items.names import check_names

# --- the stream -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sequences:
    """The stream of given sequences: episode k is sequence k modulo their number."""

    items: Items  # [S, L]          zeros after each sequence's end
    id_names: tuple[str, ...] | None = None  # texts that ``items.ids`` index

    @property
    def smallest(self) -> int:
        """Volume of the smallest item, in cells."""
        return int(self.items.sides[self.items.present].long().prod(1).min())

    @property
    def sides(self) -> tuple[int, int]:
        """Shortest and longest side of any item, in cells."""
        sides = self.items.sides
        return int(sides[sides > 0].min()), int(sides.max())

    @property
    def orientation_sets(self) -> dict[tuple[int, ...], float]:
        """Sets of orientations that items may take, with the share of items that have each."""
        return self.items.orientation_sets()

    @property
    def episodes(self) -> int:
        """Number of sequences S."""
        return len(self.items.sides)

    @property
    def longest(self) -> int:
        """Length L of the longest sequence."""
        return self.items.sides.shape[1]

    def start(self, seed: int, episodes: Tensor) -> Tensor:
        """Return the indices of the sequences, int64 [K]; the seed has no effect."""
        return episodes % self.episodes

    def restart(self, state: Tensor, seed: int, episodes: Tensor, ended: Tensor) -> Tensor:
        """Return the state in which the games ``ended`` begin the sequences ``episodes``."""
        return torch.where(ended, self.start(seed, episodes), state)

    def item(self, state: Tensor, t: Tensor) -> Items:
        """Return the items [N] at step ``t`` of each sequence; zeros after its end."""
        last = self.longest - 1
        past, step = t > last, t.clamp(max=last)
        beyond = past[:, None]
        return self.items.map(
            lambda table: table[state, step].masked_fill_(past if table.ndim == 2 else beyond, 0)
        ).numbered(t)

    def to(self, device: torch.device | str, backend: Backend | None = None) -> Sequences:
        """Return the same sequences on ``device``; every backend looks items up alike."""
        return replace(self, items=self.items.to(device))


# --- the checks -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rows:
    """The rows of all sequences, one after the other, with their numbers for error messages."""

    sides: NDArray[np.float64]  # [R, 3]
    sequence: NDArray[np.int64]  # [R]   number of the sequence
    number: NDArray[np.int64]  # [R]     number of the row in its sequence
    source: str
    single: bool  # whether the items were given as one sequence [L, 3]

    def __getitem__(self, chosen: NDArray[np.bool_]) -> Rows:
        """Return the chosen rows."""
        return replace(
            self,
            sides=self.sides[chosen],
            sequence=self.sequence[chosen],
            number=self.number[chosen],
        )

    @property
    def counts(self) -> NDArray[np.int64]:
        """Number of rows in each sequence, int64 [S]."""
        return np.bincount(self.sequence)

    def refuse(self, wrong: NDArray[np.bool_], why: str) -> None:
        """Raise ValueError with the first row where ``wrong`` is true, if there is one."""
        if wrong.any():
            i = int(wrong.argmax())
            place = f"row {self.number[i]}"
            if self.sequence[-1] > 0:
                place = f"sequence {self.sequence[i]}, {place}"
            sides = self.sides[i].tolist()
            raise ValueError(f"{self.source}: {place} is {sides}: {why}")


def check_items(
    items: ArrayLike,
    size: Size,
    *,
    lengths: ArrayLike | None = None,
    source: str = "items",
    **attributes: Any,
) -> Sequences:
    """Check items in arrays or lists, and return them as sequences; refuse impossible ones.

    Args:
        items: whole numbers [L, 3] (one sequence) or [S, L, 3], rows w, d, h in cells; or a list of
            sequences of unequal length. Rows of zeros may only fill the end of a sequence.
        size: (W, D, H) of the bin that items must fit into, in one of their orientations.
        lengths: whole numbers [S]; by default a sequence ends at its first row of zeros.
        source: what to call the items in an error.
        attributes: values of :data:`marl_pack.items.ATTRIBUTES` by key, one for each item, shaped
            or listed as the items: ``weights``, positive, volumes by default; ``upright``, true for
            orientations 0 and 1 only; ``orientations``, lists of numbers 0 … 5 or bool [..., 6];
            ``ids``, texts or whole numbers; ``quantity``, how often the row is repeated in place.

    Raises:
        ValueError: naming the sequence and row, or an unknown attribute.
    """
    check_names(attributes, KEYS, (), source, "attribute")
    rows = _read_rows(items, source)
    inside = _before_ends(rows, lengths)
    _check_sides(rows, inside)
    values = {
        attribute.key: _read_attribute(attribute, attributes[attribute.key], rows, inside)
        for attribute in ATTRIBUTES
        if attributes.get(attribute.key) is not None
    }
    rows = rows[inside]
    quantity, upright = values.pop("quantity", None), values.pop("upright", None)
    allowed = _allowed(values.pop("orientations", None), upright, rows)
    _check_fit(rows, allowed, size)
    # The other attributes are fields of the record as they are.
    columns = {"sides": rows.sides.astype(np.int16), "weights": rows.sides.prod(1)} | values
    id_names = None
    if "ids" in columns:
        columns["ids"], id_names = number_ids(columns["ids"])
    if not allowed.all():
        columns["orientations"] = allowed
    sequence = rows.sequence
    if quantity is not None:
        sequence = sequence.repeat(quantity)
        columns = {name: column.repeat(quantity, axis=0) for name, column in columns.items()}
    tensors = {name: torch.from_numpy(_padded(c, sequence)) for name, c in columns.items()}
    return Sequences(Items(**tensors), id_names)


def split_sequences(items: Any, source: str) -> tuple[list[Any], bool]:
    """Return the S sequences of rows, and whether they were given as one [L, 3].

    Raises:
        ValueError: if ``items`` are neither [L, 3] nor [S, L, 3] nor a list.
    """
    if hasattr(items, "__array__"):
        array = np.asarray(items)
        if array.ndim not in (2, 3) or array.shape[-1] != 3 or 0 in array.shape:
            raise ValueError(f"{source}: shape {array.shape}, needs [L, 3] or [S, L, 3] (w, d, h)")
        return list(array if array.ndim == 3 else array[None]), array.ndim == 2
    if not _is_list(items) or not len(items):
        raise ValueError(f"{source}: needs a list of rows [w, d, h], or of such lists")
    first = items[0]
    single = not (_is_list(first) and len(first) and _is_list(first[0]))
    return [items] if single else list(items), single


def _is_list(values: object) -> bool:
    """Return whether ``values`` is a list, a tuple or an array of one or more dimensions."""
    return isinstance(values, list | tuple) or (isinstance(values, np.ndarray) and values.ndim > 0)


def _read_rows(items: Any, source: str) -> Rows:
    """Return the rows of all sequences, with zeros after their ends if they are given."""
    sequences, single = split_sequences(items, source)
    blocks = []
    for k, sequence in enumerate(sequences):
        name = f"{source}: " if len(sequences) == 1 else f"{source}: sequence {k}, "
        blocks.append(_read_block(sequence, name))
    counts = np.array([len(block) for block in blocks])
    number = np.arange(counts.sum()) - np.repeat(counts.cumsum() - counts, counts)
    indices = np.repeat(np.arange(len(counts)), counts)
    return Rows(np.concatenate(blocks), indices, number, source, single)


def _read_block(rows: Any, name: str) -> NDArray[np.float64]:
    """Return the rows of one sequence, float64 [L, 3]; ``name`` begins an error message."""
    if not _is_list(rows):
        raise ValueError(f"{name}{rows!r} is not a list of rows w, d, h")
    if not len(rows):
        raise ValueError(f"{name}has no items")
    try:
        array = np.asarray(rows)
        numeric = array.shape == (len(rows), 3) and array.dtype.kind in "iuf"
        if numeric and (array is rows or bool not in set(map(type, chain.from_iterable(rows)))):
            return array.astype(np.float64)
    except ValueError:
        pass
    for number, row in enumerate(rows):
        if not _is_row(row):
            raise ValueError(f"{name}row {number} is {row!r}: needs three numbers w, d, h")
    return np.array(rows, np.float64)


def _is_row(row: Any) -> bool:
    """Return whether ``row`` is three numbers of any value."""
    if not _is_list(row) or len(row) != 3:
        return False
    return all(isinstance(value, Real) and not isinstance(value, bool) for value in row)


def _before_ends(rows: Rows, lengths: ArrayLike | None) -> NDArray[np.bool_]:
    """Return which rows stand before the end of their sequence, bool [R]."""
    ends, count = rows.counts, len(rows.counts)
    if lengths is None:
        blank = (rows.sides == 0).all(1)
        np.minimum.at(ends, rows.sequence[blank], rows.number[blank])
    else:
        numbers = np.asarray(lengths)
        whole = numbers.shape == (count,) and numbers.dtype.kind in "iu"
        if not whole or not ((numbers >= 1) & (numbers <= ends)).all():
            raise ValueError(
                f"{rows.source}: lengths need {count} whole numbers in 1 … {ends.max()}"
            )
        ends = numbers.astype(np.int64)
    if not ends.all():
        raise ValueError(f"{rows.source}: sequence {ends.argmin()} has no items")
    return rows.number < ends[rows.sequence]


def _check_sides(rows: Rows, inside: NDArray[np.bool_]) -> None:
    """Refuse sides that are no whole numbers of cells, and rows after the end of a sequence."""
    sides = rows.sides
    problems = {
        "not a number": ~np.isfinite(sides),
        "a fraction of a cell": sides != np.floor(sides),
        "zero or negative": sides < 1,
    }
    for problem, wrong in problems.items():
        rows.refuse(inside & wrong.any(1), f"{problem}; needs whole cells ≥ 1")
    rows.refuse(~inside & (sides != 0).any(1), "after the end of its sequence; needs zeros there")


def _read_attribute(
    attribute: Attribute, values: Any, rows: Rows, inside: NDArray[np.bool_]
) -> NDArray[Any]:
    """Return an attribute of the items ``inside``, [R', *shape]."""
    column = _flatten(values, rows)
    if column is None:
        raise ValueError(
            f"{rows.source}: {attribute.key!r} needs one value an item, shaped or listed as items"
        )
    if isinstance(column, np.ndarray):
        column = column[inside]
    else:
        column = [value for value, wanted in zip(column, inside, strict=True) if wanted]
    array, wrong = attribute.read(column)
    value = column[int(wrong.argmax())]
    text = repr(value.item() if isinstance(value, np.generic) else value)
    rows[inside].refuse(wrong, f"{attribute.column} {text}; needs {attribute.needs}")
    return array


def _flatten(values: Any, rows: Rows) -> list[Any] | NDArray[Any] | None:
    """Return the values of all rows, one after the other; None if their number is another.

    A single sequence may have them as [L] or [1, L].
    """
    values = np.asarray(values) if hasattr(values, "__array__") else values
    counts = rows.counts.tolist()
    options = ([values], values) if rows.single else (values, [values])
    for nested in options if len(counts) == 1 else (values,):
        if _is_list(nested) and [len(v) if _is_list(v) else -1 for v in nested] == counts:
            if all(isinstance(part, np.ndarray) for part in nested):
                return np.concatenate(list(nested))
            return list(chain.from_iterable(nested))
    return None


def _allowed(
    orientations: NDArray[np.bool_] | None, upright: NDArray[np.bool_] | None, rows: Rows
) -> NDArray[np.bool_]:
    """Return the orientations that the items may take by both attributes, bool [R, 6]."""
    stays_upright = np.isin(ALL_ORIENTATIONS, UPRIGHT)
    everything = np.ones((len(rows.sequence), len(ALL_ORIENTATIONS)), bool)
    if upright is None:
        return everything if orientations is None else orientations
    if orientations is not None:
        tips = (orientations & ~stays_upright).any(1)
        rows.refuse(upright & tips, "upright, so its orientations may only be 0 and 1")
        return orientations
    return np.where(upright[:, None], stays_upright, everything)


def _check_fit(rows: Rows, allowed: NDArray[np.bool_], size: Size) -> None:
    """Refuse an item that fits into the bin in none of its orientations."""
    short = rows.sides[:, :, None] <= np.array(size)  # [R, 3, 3]: side i along axis j
    in_bin = short[:, np.array(ORIENTATIONS), np.arange(3)].all(2)  # [R, 6]
    wrong = np.logical_not((in_bin & allowed).any(1))
    own = np.flatnonzero(allowed[wrong.argmax()]).tolist()
    which = "no orientation" if len(own) == 6 else f"none of its orientations {own}"
    rows.refuse(wrong, f"fits into the bin {tuple(size)} in {which}")


def number_ids(ids: NDArray[Any]) -> tuple[NDArray[np.int64], tuple[str, ...] | None]:
    """Return ids as whole numbers: the ids themselves, or indices into texts, returned as well.

    Args:
        ids: texts and whole numbers [R]. Texts such as "007" are not numbers, and negative numbers
            are texts: a label below 0 says that an id is unknown.
    """
    texts = ids.astype(str)
    try:
        numbers = ids.astype(np.int64)
        if (numbers >= 0).all() and (numbers.astype(str) == texts).all():
            return numbers, None
    except (ValueError, OverflowError):
        pass
    names, indices = np.unique(texts, return_inverse=True)
    return indices.astype(np.int64), tuple(names.tolist())


def _padded(values: NDArray[Any], sequence: NDArray[np.int64]) -> NDArray[Any]:
    """Return values [R, …] of the sequences [R] as [S, L, …], with zeros after their ends."""
    counts = np.bincount(sequence)
    place = np.arange(len(sequence)) - np.repeat(counts.cumsum() - counts, counts)
    table = np.zeros((len(counts), counts.max(), *values.shape[1:]), values.dtype)
    table[sequence, place] = values
    return table
