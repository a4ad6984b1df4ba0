"""Read CSV files of items: one item in each row, one attribute in each column."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from marl_pack.checks import number_in, shown
from marl_pack.inputs import read_lines
from marl_pack.items.names import check_names


def read_table(
    path: Path,
    names: Sequence[str],
    required: Sequence[str],
    blanks: bool = False,
    numbers: list[int] | None = None,
) -> dict[str, list[str]]:
    """Read a CSV file; return the texts of each column by the column's name.

    Args:
        path: the file.
        names: the columns that it may have.
        required: the columns that it needs.
        blanks: whether a row may have no value in a column that is not required.
        numbers: gets the number of each row's line in the file.

    Raises:
        ValueError: for a column that is missing, unknown or given twice, or a row with too few
            or too many values; the message names the column or the row.
    """
    lines = read_lines(path, trim=True)
    columns = [name.strip() for name in next(lines, (0, []))[1]]
    while columns and not columns[-1]:  # spreadsheets write a comma after the last column
        columns.pop()
    if len(columns) == 1 and ";" in columns[0]:
        raise ValueError(f"{path}: values are separated by ';'; needs commas (and decimal points)")
    check_names(columns, names, required, str(path), "column")
    if len(set(columns)) < len(columns):
        raise ValueError(f"{path}: a column is given twice; the first line is {columns}")
    # One list for all rows, row by row: a list for each row is three times slower.
    values: list[str] = []
    needed = set(required)
    for line, row in lines:
        if len(row) > len(columns) and not any(row[len(columns) :]):
            del row[len(columns) :]
        missing = [name for name, text in zip(columns, row, strict=False) if not text]
        if len(row) != len(columns) or (missing and not (blanks and needed.isdisjoint(missing))):
            raise ValueError(
                f"{path}: row {len(values) // len(columns)} (line {line}) is {shown(row)}: needs a "
                f"value for each of {', '.join(columns)}"
            )
        values += row
        if numbers is not None:
            numbers.append(line)
    if not values:
        raise ValueError(f"{path}: has no items")
    return {name: list(map(str.strip, values[i :: len(columns)])) for i, name in enumerate(columns)}


def read_sides(
    path: Path, columns: dict[str, list[str]], sides: Sequence[str], needs: str
) -> NDArray[np.float64]:
    """Return the three columns of the items' sides as numbers, float64 [R, 3].

    Args:
        path: the file, for messages.
        columns: the texts of each column.
        sides: names of the three columns.
        needs: what a side needs to be, for messages.

    Raises:
        ValueError: if a text is not a number; the message names the row.
    """
    return np.column_stack([_numbers(path, columns, name, sides, needs) for name in sides])


def _numbers(
    path: Path, columns: dict[str, list[str]], name: str, sides: Sequence[str], needs: str
) -> NDArray[np.float64]:
    """Return a column of numbers; refuse the first row whose text is not a number."""
    numbers: list[float] = []
    try:
        for text in columns[name]:
            numbers.append(number_in(text))
    except ValueError as error:
        row = [columns[side][len(numbers)] for side in sides]
        raise ValueError(
            f"{path}: row {len(numbers)} is {shown(row)}: {name} {error}; needs {needs}"
        ) from None
    return np.array(numbers, np.float64)


def sequence_order(names: Sequence[str]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Group rows into sequences, in the order of the sequences' first rows.

    Args:
        names: the name of each row's sequence.

    Returns:
        The order of the rows in which each sequence is in one piece, int64 [R], and the number of
        rows in each sequence, int64 [S].
    """
    ranks: dict[str, int] = {}
    rank = np.array([ranks.setdefault(name, len(ranks)) for name in names])
    return rank.argsort(kind="stable"), np.bincount(rank)
