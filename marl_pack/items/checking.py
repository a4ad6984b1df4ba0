"""Check sequences of items that the user gives, in arrays, lists and columns of files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, compress
from numbers import Real
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from marl_pack.checks import shown
from marl_pack.geometry import ALL_ORIENTATIONS, ORIENTATIONS, Size
from marl_pack.items.attributes import ATTRIBUTES, KEYS, UPRIGHT, Attribute, only_numbers
from marl_pack.items.items import Items
from marl_pack.items.names import check_names
from marl_pack.items.sequences import Sequences

MOST_ITEMS = 10_000_000
"""The most items that sequences may have, all together."""


@dataclass(frozen=True)
class Ragged:
    """Values of sequences of unequal length, one sequence after the other."""

    values: list[Any] | NDArray[Any]  # [R, …]
    counts: NDArray[np.int64]  # [S]  number of values in each sequence


@dataclass(frozen=True)
class Rows:
    """The rows of all sequences, one after the other."""

    sides: NDArray[Any]  # [R, 3]
    counts: NDArray[np.int64]  # [S]  number of rows in each sequence
    source: str
    single: bool  # whether the user gave one sequence [L, 3]

    def refuse(self, wrong: NDArray[np.bool_], why: str) -> None:
        """Raise ValueError about the first row where ``wrong`` [R] is true, if there is one."""
        if wrong.any():
            i = int(wrong.argmax())
            ends = self.counts.cumsum()
            sequence = int(ends.searchsorted(i, side="right"))
            place = f"row {i - ends[sequence] + self.counts[sequence]}"
            if len(ends) > 1:
                place = f"sequence {sequence}, {place}"
            raise ValueError(f"{self.source}: {place} is {self.sides[i].tolist()}: {why}")


def check_items(
    items: ArrayLike | Ragged,
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
        lengths: whole numbers [S], the number of items in each sequence; by default a sequence
            ends at its first row of zeros.
        source: name of the items in error messages.
        attributes: values of :data:`marl_pack.items.ATTRIBUTES` by key, one for each item, in the
            same shape or nested lists as the items: ``weights``, positive, volumes by default;
            ``upright``, true for only the orientations 0 and 1; ``orientations``, lists of numbers
            0 … 5 or bool [..., 6]; ``ids``, texts or whole numbers; ``quantity``, how often the row
            is repeated.

    Raises:
        ValueError: naming the sequence and row, or an unknown attribute.
    """
    check_names(attributes, KEYS, (), source, "attribute")
    rows = _read_rows(items, source)
    if lengths is None and isinstance(items, Ragged):
        lengths = rows.counts
    ends = _ends(rows, lengths)
    inside = _before(ends, rows.counts)
    rows.refuse(~inside & rows.sides.any(1), "after the end of its sequence; needs zeros there")
    flat = {a: _flatten(attributes[a.key], rows) for a in ATTRIBUTES
            if attributes.get(a.key) is not None}  # fmt: skip
    rows = replace(rows, sides=rows.sides[inside].astype(np.float64), counts=ends)
    _check_sides(rows)
    values = {
        attribute.key: _read_attribute(attribute, column, inside, rows)
        for attribute, column in flat.items()
    }
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
    total = len(rows.sides) if quantity is None else quantity.sum(dtype=np.float64)
    if total > MOST_ITEMS:
        raise ValueError(f"{source}: {total:.0f} items: needs at most {MOST_ITEMS}")
    if quantity is not None:
        columns = {name: column.repeat(quantity, axis=0) for name, column in columns.items()}
        ends = np.add.reduceat(quantity, ends.cumsum() - ends)
    last = ends.cumsum()
    spans = torch.from_numpy(np.stack((last - ends, last), 1))
    tensors = {name: torch.from_numpy(column) for name, column in columns.items()}
    return Sequences(Items(**tensors), spans, id_names)


def split_sequences(items: Any, source: str) -> tuple[Sequence[Any] | NDArray[Any], bool]:
    """Return the S sequences of rows, and whether ``items`` are a single sequence [L, 3].

    Raises:
        ValueError: if ``items`` are neither [L, 3] nor [S, L, 3] nor a list.
    """
    if hasattr(items, "__array__"):
        array = _array(items, source)
        if array.ndim not in (2, 3) or array.shape[-1] != 3 or 0 in array.shape:
            raise ValueError(f"{source}: shape {array.shape}, needs [L, 3] or [S, L, 3] (w, d, h)")
        return array if array.ndim == 3 else array[None], array.ndim == 2
    if not _is_list(items) or not len(items):
        raise ValueError(f"{source}: needs a list of rows [w, d, h], or of such lists")
    first = items[0]
    single = not (_is_list(first) and len(first) and _is_list(first[0]))
    for part in items:
        if isinstance(part, np.ma.MaskedArray):
            _array(part, source)
    return [items] if single else list(items), single


def _array(values: Any, source: str) -> NDArray[Any]:
    """Return an array; refuse one that hides values behind a mask."""
    if np.ma.is_masked(values):
        raise ValueError(f"{source}: has masked values; needs them left out")
    return np.asarray(values)


def _is_list(values: object) -> bool:
    """Return whether ``values`` is a list, a tuple or an array of one or more dimensions."""
    return isinstance(values, list | tuple) or (isinstance(values, np.ndarray) and values.ndim > 0)


def _read_rows(items: Any, source: str) -> Rows:
    """Return the rows of all sequences, including any rows of zeros after their ends."""
    if isinstance(items, Ragged):
        return Rows(np.asarray(items.values), items.counts, source, single=False)
    sequences, single = split_sequences(items, source)
    if isinstance(sequences, np.ndarray) and sequences.dtype.kind in "iuf":
        count, length, _ = sequences.shape
        return Rows(sequences.reshape(-1, 3), np.full(count, length), source, single)
    if all(isinstance(sequence, list) and sequence for sequence in sequences):
        sides = _numbers(list(chain.from_iterable(sequences)))
        if sides is not None:
            return Rows(sides, np.array(list(map(len, sequences))), source, single)
    blocks = []
    for k, sequence in enumerate(sequences):
        name = f"{source}: " if len(sequences) == 1 else f"{source}: sequence {k}, "
        blocks.append(_read_block(sequence, name))
    return Rows(np.concatenate(blocks), np.array(list(map(len, blocks))), source, single)


def _numbers(rows: Any) -> NDArray[Any] | None:
    """Return rows of three numbers as an array [L, 3]; None if they are anything else."""
    if not isinstance(rows, np.ndarray):
        if not (all(map(_is_list, rows)) and only_numbers(chain.from_iterable(rows))):
            return None
        try:
            rows = np.asarray(rows)
        except ValueError:  # rows of different lengths
            return None
    return rows if rows.shape[1:] == (3,) and rows.dtype.kind in "iuf" else None


def _read_block(rows: Any, name: str) -> NDArray[np.float64]:
    """Return the rows of one sequence, float64 [L, 3]; ``name`` begins an error message."""
    if not _is_list(rows):
        raise ValueError(f"{name}{shown(rows)} is not a list of rows w, d, h")
    if not len(rows):
        raise ValueError(f"{name}has no items")
    sides = _numbers(rows)
    if sides is not None:
        return sides
    for number, row in enumerate(rows):
        if not _is_row(row):
            raise ValueError(f"{name}row {number} is {shown(row)}: needs three numbers w, d, h")
    return np.array([[_float(value) for value in row] for row in rows])


def _is_row(row: Any) -> bool:
    """Return whether ``row`` is a list of three numbers of any value."""
    if not _is_list(row) or len(row) != 3:
        return False
    return all(isinstance(value, Real) and not isinstance(value, bool) for value in row)


def _float(number: Real) -> float:
    """Return a number as a float, infinite if it is too large."""
    try:
        return float(number)
    except OverflowError:
        return math.inf


def _ends(rows: Rows, lengths: Any) -> NDArray[np.int64]:
    """Return the number of rows before the end of each sequence, int64 [S]."""
    counts = rows.counts
    if lengths is not None:
        plain = isinstance(lengths, np.ndarray) or (_is_list(lengths) and only_numbers(lengths))
        numbers = _array(lengths, rows.source) if plain else np.zeros(0)
        whole = numbers.shape == counts.shape and numbers.dtype.kind in "iu"
        if not whole or not ((numbers >= 1) & (numbers <= counts)).all():
            raise ValueError(
                f"{rows.source}: lengths need {len(counts)} whole numbers in 1 … {counts.max()}"
            )
        return numbers.astype(np.int64)
    blank = ~rows.sides.any(1)
    if (counts == counts[0]).all():  # equal lengths; the rows may be mostly zeros
        grid = blank.reshape(-1, counts[0])
        ends = np.where(grid.any(1), grid.argmax(1), counts)
    else:
        last = counts.cumsum()
        blanks = np.append(np.flatnonzero(blank), last[-1])
        first = last - counts
        ends = np.minimum(blanks[blanks.searchsorted(first)] - first, counts)
    if not ends.all():
        raise ValueError(f"{rows.source}: sequence {ends.argmin()} has no items")
    return ends


def _before(ends: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which rows lie before the end of their sequence, bool [R]."""
    if (counts == counts[0]).all():
        return (np.arange(counts[0]) < ends[:, None]).ravel()
    number = np.arange(counts.sum()) - (counts.cumsum() - counts).repeat(counts)
    return number < ends.repeat(counts)


def _check_sides(rows: Rows) -> None:
    """Refuse sides that are not whole numbers of cells."""
    problems = {
        "not a number": ~np.isfinite(rows.sides),
        "a fraction of a cell": rows.sides != np.floor(rows.sides),
        "zero or negative": rows.sides < 1,
    }
    for problem, wrong in problems.items():
        rows.refuse(wrong.any(1), f"{problem}; needs whole cells ≥ 1")


def _read_attribute(
    attribute: Attribute, column: Any, inside: NDArray[np.bool_], rows: Rows
) -> NDArray[Any]:
    """Return the values of one attribute of the items, [R', *shape].

    Args:
        attribute: the attribute.
        column: its values for all R rows; None if the number of values is wrong.
        inside: which rows lie before the end of their sequence, bool [R].
        rows: the R' rows before the ends, for messages.
    """
    if column is None:
        raise ValueError(
            f"{rows.source}: {attribute.key!r} needs one value for each item, nested like the items"
        )
    if isinstance(column, np.ndarray):
        column = column[inside]
    else:
        column = list(compress(column, inside.tolist()))
    array, wrong = attribute.read(column)
    text = shown(column[int(wrong.argmax())])
    rows.refuse(wrong, f"{attribute.column} {text}; needs {attribute.needs}")
    return array


def _flatten(values: Any, rows: Rows) -> list[Any] | NDArray[Any] | None:
    """Return the values of all rows, one after the other; None if their number is wrong.

    The values of a single sequence may have the shape [L] or [1, L].
    """
    if isinstance(values, Ragged):
        return values.values
    values = _array(values, rows.source) if hasattr(values, "__array__") else values
    counts = rows.counts.tolist()
    if isinstance(values, np.ndarray) and values.shape[:2] == (len(counts), counts[0]) != (1, 1):
        return values.reshape(-1, *values.shape[2:]) if len(set(counts)) == 1 else None
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
    """Return the orientations that both attributes allow for each item, bool [R, 6]."""
    stays_upright = np.isin(ALL_ORIENTATIONS, UPRIGHT)
    everything = np.ones((len(rows.sides), len(ALL_ORIENTATIONS)), bool)
    if upright is None:
        return everything if orientations is None else orientations
    if orientations is not None:
        tips = (orientations & ~stays_upright).any(1)
        rows.refuse(upright & tips, "upright, so its orientations may only be 0 and 1")
        return orientations
    return np.where(upright[:, None], stays_upright, everything)


def _check_fit(rows: Rows, allowed: NDArray[np.bool_], size: Size) -> None:
    """Refuse an item that does not fit into the bin in any of its orientations."""
    short = rows.sides[:, :, None] <= np.array(size)  # [R, 3, 3]: side i along axis j
    in_bin = short[:, np.array(ORIENTATIONS), np.arange(3)].all(2)  # [R, 6]
    wrong = np.logical_not((in_bin & allowed).any(1))
    numbers = np.flatnonzero(allowed[wrong.argmax()]).tolist()
    which = "no orientation" if len(numbers) == 6 else f"none of its orientations {numbers}"
    rows.refuse(wrong, f"fits into the bin {tuple(size)} in {which}")


def number_ids(ids: NDArray[Any]) -> tuple[NDArray[np.int64], tuple[str, ...] | None]:
    """Return ids as whole numbers and None, or as indices into texts and these texts.

    Args:
        ids: texts and whole numbers [R]. A text such as "007" stays a text. A negative number
            becomes a text, because a label below 0 means that the id is unknown.
    """
    texts = [str(name) for name in ids]
    whole = [name.isascii() and name.isdigit() and len(name) < 20 for name in texts]
    if all(whole):
        numbers = np.array(list(map(int, texts)), np.uint64)
        if numbers.max() < 2**63 and list(map(str, numbers.tolist())) == texts:
            return numbers.astype(np.int64), None
    names = sorted(set(texts))
    index = {name: i for i, name in enumerate(names)}
    return np.array([index[name] for name in texts]), tuple(names)
