"""Read item sequences from ``.npz``, ``.json`` and ``.csv`` files.

The readers bring what a file contains into the arguments of
:func:`marl_pack.items.sequences.check_items`, which checks it.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from marl_pack.items.items import ATTRIBUTES, KEYS
from marl_pack.items.names import check_names
from marl_pack.items.sequences import split_sequences

SIDES = ("w", "d", "h")
COLUMNS = (*SIDES, *(attribute.column for attribute in ATTRIBUTES), "sequence")
"""Columns that a CSV file may have."""
FIELDS = ("items", *KEYS, "lengths", "bin")
"""Keys of a JSON object or a mapping, and arrays of an npz archive."""


def read_fields(path: Path) -> dict[str, Any]:
    """Return the fields of a file by key, some of :data:`FIELDS`; its ending names the format.

    Raises:
        ValueError: for another ending, an unreadable file, a missing or unknown column, key or
            array, or a row that is not three numbers, which is named.
    """
    readers = {".npz": _read_npz, ".json": _read_json, ".csv": _read_csv}
    suffix = path.suffix.lower()
    if suffix not in readers:
        raise ValueError(f"{path}: unknown ending {path.suffix!r}: one of {', '.join(readers)}")
    return readers[suffix](path)


def check_fields(fields: Mapping[str, Any], source: str, what: str = "key") -> None:
    """Refuse unknown keys and missing items; ``what`` is a key or an array.

    Raises:
        ValueError: naming the nearest valid key.
    """
    check_names(fields, FIELDS, ("items",), source, what)


def _read_npz(path: Path) -> dict[str, Any]:
    """Return the arrays of an archive."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            fields = {key: archive[key] for key in archive.files}
    except Exception as error:
        raise ValueError(f"{path}: not a readable .npz archive ({error})") from error
    check_fields(fields, str(path), "array")
    if "bin" in fields:
        fields["bin"] = fields["bin"].ravel().tolist()
    return fields


def _read_json(path: Path) -> dict[str, Any]:
    """Return the keys of an object, or the items that a list gives."""
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: not readable as JSON ({error})") from error
    fields = content if isinstance(content, dict) else {"items": content}
    check_fields(fields, str(path))
    sequences, _ = split_sequences(fields["items"], str(path))
    if all(isinstance(sequence, list) for sequence in sequences):  # none is padded with zeros
        fields.setdefault("lengths", [len(sequence) for sequence in sequences])
    return fields


def _read_csv(path: Path) -> dict[str, Any]:
    """Return the columns of a table with one item a row, split into sequences."""
    cells = _read_table(path)
    fields = {"items": np.stack([np.array(cells[name], np.float64) for name in SIDES], 1)}
    fields |= {a.key: np.array(cells[a.column]) for a in ATTRIBUTES if a.column in cells}
    count = len(fields["items"])
    order, ends = np.arange(count), np.array([count])
    if "sequence" in cells:  # sequences in the order of their first rows
        ranks: dict[str, int] = {}
        rank = np.array([ranks.setdefault(name, len(ranks)) for name in cells["sequence"]])
        order, ends = rank.argsort(kind="stable"), np.bincount(rank).cumsum()
    split = {key: np.split(values[order], ends[:-1]) for key, values in fields.items()}
    return {**split, "lengths": np.diff(ends, prepend=0)}


def _read_table(path: Path) -> dict[str, list[str]]:
    """Return the texts of each column by its name; those of w, d and h are numbers.

    Raises:
        ValueError: for a column that is missing, unknown or given twice, or a row with too few
            or too many values or a side that is no number, which is named.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not readable as UTF-8 text ({error})") from None
    reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
    columns = [name.strip() for name in next(reader, [])]
    while columns and not columns[-1]:  # spreadsheets write a comma after the last column
        columns.pop()
    check_names(columns, COLUMNS, SIDES, str(path), "column")
    if len(set(columns)) < len(columns):
        raise ValueError(f"{path}: a column is given twice; the first line is {columns}")
    places = [columns.index(name) for name in SIDES]
    cells: list[str] = []  # row by row in one list: a list for each row is three times slower
    for row in filter(None, reader):
        if len(row) > len(columns) and not any(row[len(columns) :]):
            del row[len(columns) :]
        try:
            for place in places:
                float(row[place])
            complete = len(row) == len(columns) and "" not in row
        except (ValueError, IndexError):
            complete = False
        if not complete:
            number = len(cells) // len(columns)
            raise ValueError(
                f"{path}: row {number} (line {reader.line_num}) is {row}: needs a value for "
                f"each of {', '.join(columns)}, numbers for the sides"
            )
        cells += row
    if not cells:
        raise ValueError(f"{path}: has no items")
    return {name: list(map(str.strip, cells[i :: len(columns)])) for i, name in enumerate(columns)}
