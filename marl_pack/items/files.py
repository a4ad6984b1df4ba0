"""Reading item sequences from ``.npz``, ``.json`` and ``.csv`` files.

What a file says is brought into one form here; whether its items can be is looked at by
:func:`marl_pack.items.sequences.check_items`.
"""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np


def read_fields(path: Path) -> dict[str, Any]:
    """What a file says, by its ending: ``items``; ``lengths``, ``weights`` and ``bin`` if given.

    Raises:
        ValueError: for another ending, an unreadable file, a missing field or column, or a row that
            is not three numbers, which is named.
    """
    readers = {".npz": _read_npz, ".json": _read_json, ".csv": _read_csv}
    suffix = path.suffix.lower()
    if suffix not in readers:
        raise ValueError(f"{path}: unknown ending {path.suffix!r}: one of {', '.join(readers)}")
    return readers[suffix](path)


def _read_npz(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            fields = {key: archive[key] for key in archive.files}
    except Exception as error:
        raise ValueError(f"{path}: not a readable .npz archive ({error})") from error
    if "items" not in fields:
        raise ValueError(f"{path}: has no array 'items', only {sorted(fields)}")
    if "bin" in fields:
        fields["bin"] = fields["bin"].ravel().tolist()
    return fields


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: not readable as JSON ({error})") from error
    fields = content if isinstance(content, dict) else {"items": content}
    if "items" not in fields:
        raise ValueError(f"{path}: has no key 'items', only {sorted(fields)}")
    sequences = fields["items"]
    if not isinstance(sequences, list) or not sequences:
        raise ValueError(f"{path}: 'items' needs a list of rows [w, d, h], or of such lists")
    one = all(_is_row(row) for row in sequences[:1])
    sequences = [sequences] if one else sequences
    for k, sequence in enumerate(sequences):
        name = "" if one else f"sequence {k}, "
        if not isinstance(sequence, list):
            raise ValueError(f"{path}: {name or 'items'} {sequence!r} is not a list of rows")
        for number, row in enumerate(sequence):
            if not _is_row(row):
                raise ValueError(f"{path}: {name}row {number} is {row!r}: needs numbers w, d, h")
    longest = max(map(len, sequences))
    fields["lengths"] = fields.get("lengths", [len(sequence) for sequence in sequences])
    fields["items"] = [s + [[0, 0, 0]] * (longest - len(s)) for s in sequences]
    if "weights" in fields:
        weights = [fields["weights"]] if one else fields["weights"]
        if not isinstance(weights, list) or list(map(_length, weights)) != list(
            map(len, sequences)
        ):
            raise ValueError(f"{path}: 'weights' needs one number an item, in the items' lists")
        fields["weights"] = [w + [0.0] * (longest - len(w)) for w in weights]
    return fields


def _is_row(row: object) -> bool:
    """Whether ``row`` is a list of three numbers (what numbers, is looked at later)."""
    return isinstance(row, list) and len(row) == 3 and all(type(v) in (int, float) for v in row)


def _length(values: object) -> int:
    return len(values) if isinstance(values, list) else -1


def _read_csv(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not readable as UTF-8 text ({error})") from None
    with io.StringIO(text, newline="") as file:
        reader = csv.DictReader(file, skipinitialspace=True)
        columns = [name.strip() for name in reader.fieldnames or []]
        missing = [name for name in ("w", "d", "h") if name not in columns]
        if missing or len(set(columns)) < len(columns):
            wrong = f"no column {', '.join(missing)}" if missing else "a column twice"
            raise ValueError(
                f"{path}: {wrong}; the first line must name w,d,h (weight and sequence if wanted), "
                f"it says {columns}"
            )
        reader.fieldnames = columns
        sequences: dict[str, list[list[float]]] = {}
        wanted = ["w", "d", "h"] + (["weight"] if "weight" in columns else [])
        for number, row in enumerate(reader):
            try:
                values = [float(row[name]) for name in wanted]
            except (TypeError, ValueError):
                values = []
            if not values or None in row or row.get("sequence", "0") in ("", None):
                raise ValueError(
                    f"{path}: row {number} (line {reader.line_num}) is {list(row.values())}: "
                    f"needs a value for each of {', '.join(columns)}, numbers for the sides"
                )
            sequences.setdefault(row.get("sequence") or "", []).append(values)
    if not sequences:
        raise ValueError(f"{path}: has no items")
    longest = max(map(len, sequences.values()))
    table = np.zeros((len(sequences), longest, len(wanted)))
    for k, rows in enumerate(sequences.values()):
        table[k, : len(rows)] = rows
    fields: dict[str, Any] = {
        "items": table[..., :3],
        "lengths": [len(rows) for rows in sequences.values()],
    }
    if "weight" in columns:
        fields["weights"] = table[..., 3]
    return fields
