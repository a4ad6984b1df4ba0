"""Read item sequences from ``.npz``, ``.json`` and ``.csv`` files.

The readers turn the content of a file into arguments of
:func:`marl_pack.items.checking.check_items`, which checks them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.inputs import read_arrays, read_json
from marl_pack.items.attributes import ATTRIBUTES, KEYS
from marl_pack.items.checking import Ragged, split_sequences
from marl_pack.items.names import check_names
from marl_pack.items.tables import read_sides, read_table, sequence_order

SIDES = ("w", "d", "h")
COLUMNS = (*SIDES, *(attribute.column for attribute in ATTRIBUTES), "sequence")
"""Columns that a CSV file may have."""
FIELDS = ("items", *KEYS, "lengths", "bin")
"""Keys of a JSON object or a mapping, and arrays of an npz archive."""


def read_fields(path: Path) -> dict[str, Any]:
    """Read a file and return its fields by key.

    The keys are some of :data:`FIELDS`. The ending of the file's name decides its format.

    Raises:
        ValueError: if the ending is unknown, the file cannot be read, a column, key or array is
            missing or unknown, or a row is not three numbers (the message names the row).
    """
    readers = {".npz": _read_npz, ".json": _read_json, ".csv": _read_csv}
    suffix = path.suffix.lower()
    if suffix not in readers:
        endings = ", ".join(readers)
        raise ValueError(f"{path}: unknown ending {path.suffix!r}: needs one of {endings}")
    return readers[suffix](path)


def check_fields(fields: Mapping[str, Any], source: str, what: str = "key") -> None:
    """Refuse unknown keys and missing items.

    Args:
        fields: the fields by key.
        source: the name of the file, for messages.
        what: the word for a key in messages.

    Raises:
        ValueError: if a key is unknown or missing; the message names the most similar valid key.
    """
    check_names(fields, FIELDS, ("items",), source, what)


def _read_npz(path: Path) -> dict[str, Any]:
    """Return the arrays of an npz archive by name."""
    fields: dict[str, Any] = dict(read_arrays(path))
    check_fields(fields, str(path), "array")
    if "bin" in fields:
        fields["bin"] = fields["bin"].ravel().tolist()
    return fields


def _read_json(path: Path) -> dict[str, Any]:
    """Return the fields of a JSON file; a file that holds a list has only the field ``items``."""
    content = read_json(path)
    fields = content if isinstance(content, dict) else {"items": content}
    check_fields(fields, str(path))
    for key, value in fields.items():
        if value is None:
            raise ValueError(f"{path}: key {key!r} is null; needs values, or to be left out")
    sequences, _ = split_sequences(fields["items"], str(path))
    if all(isinstance(sequence, list) for sequence in sequences):  # lists are never padded
        fields.setdefault("lengths", [len(sequence) for sequence in sequences])
    return fields


def _read_csv(path: Path) -> dict[str, Any]:
    """Return the fields of a CSV file, which has one item per row, split into sequences."""
    columns = read_table(path, COLUMNS, SIDES)
    sides = read_sides(path, columns, SIDES, "whole cells ≥ 1")
    fields = {"items": sides} | {
        attribute.key: attribute.of_cells(columns[attribute.column])
        for attribute in ATTRIBUTES
        if attribute.column in columns
    }
    if "sequence" not in columns:
        return fields | {"lengths": [len(sides)]}
    order, counts = sequence_order(columns["sequence"])
    return {key: Ragged(_reordered(values, order), counts) for key, values in fields.items()}


def _reordered(values: list[Any] | NDArray[Any], order: NDArray[np.int64]) -> Any:
    """Return the values in a new order.

    Args:
        values: the values.
        order: int64 [n], the old index of each value.
    """
    if isinstance(values, np.ndarray):
        return values[order]
    return [values[i] for i in order.tolist()]
