"""The item streams that need no file: their names, and the sides of their items."""

from __future__ import annotations

from pathlib import Path

from marl_pack import renamed

GENERATED = ("rs", "cut1", "cut2")
"""Names of the streams that need no file."""

DEFAULT_SIDES = (2, 5)
"""Shortest and longest side of a generated item: the 64 types {2..5}³ of RS and CUT."""


def no_such_file(items: str | Path, in_mm: bool = False) -> FileNotFoundError:
    """Return the error for items that are neither a stream's name nor a file, with a guess.

    Args:
        items: what was given.
        in_mm: whether boxes in millimetres are needed, which only files have.
    """
    if in_mm:
        return FileNotFoundError(f"{items}: no such file; needs a .csv or .json file of boxes")
    guess = renamed.guess(str(items), GENERATED)
    return FileNotFoundError(
        f"{items}: no such file; items are {', '.join(GENERATED)} or a file{guess}"
    )
