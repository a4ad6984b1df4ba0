"""The stream that a name, a file or an array stands for."""

from __future__ import annotations

from pathlib import Path

import torch
from numpy.typing import ArrayLike

from marl_pack.bins import Size, check_size
from marl_pack.items.cutting import check_sides, cut
from marl_pack.items.files import read_fields
from marl_pack.items.sequences import Sequences, check_items
from marl_pack.items.streams import Cut, Stream, Uniform

GENERATED = ("rs", "cut1", "cut2")
"""Names of the streams that need no file."""

DEFAULT_SIDES = (2, 5)
"""Shortest and longest side of a generated item: the 64 types {2..5}³ of RS and CUT."""


def load(path: str | Path, size: Size | None = None) -> tuple[Sequences, Size]:
    """Read item sequences from a file, by its ending.

    - ``.npz``: ``items`` [S, L, 3] or [L, 3], with ``lengths`` [S], ``weights`` and ``bin`` [3] if
      present.
    - ``.json``: an object with the same keys, ``items`` also as sequences of unequal length; or
      just the items.
    - ``.csv``: a header naming the columns w, d, h and, if wanted, weight (one weight a row) and
      sequence (a number; rows of one sequence stand together); one item a row.

    Args:
        path: the file.
        size: (W, D, H); by default the file's own ``bin``.

    Returns:
        The sequences and the bin size.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for another ending, a missing key or column, no bin size or another one than
            the file's, or an item that cannot be, with its row.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; items are {', '.join(GENERATED)} or a file")
    fields = read_fields(path)
    told = fields.get("bin")
    try:
        told = None if told is None else check_size(told)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    bin_size = told if size is None else check_size(size)
    if bin_size is None:
        raise ValueError(f"{path}: says no bin size; give one")
    if told not in (None, bin_size):
        raise ValueError(f"{path}: is for the bin {told}, not {bin_size}; give that size")
    sequences = check_items(
        fields["items"], bin_size, fields.get("weights"), fields.get("lengths"), str(path)
    )
    return sequences, bin_size


def make_stream(
    items: str | Path | ArrayLike | Stream,
    size: Size,
    sides: tuple[int, int] = DEFAULT_SIDES,
) -> Stream:
    """The stream that ``items`` names.

    Args:
        items: ``"rs"``, ``"cut1"``, ``"cut2"``, a file (:func:`load`), an array [L, 3] or
            [S, L, 3], or a stream.
        size: (W, D, H) of the bin.
        sides: shortest and longest side of generated items.

    Raises:
        ValueError: if an item fits into the bin in no orientation, or the name is unknown.
    """
    size = check_size(size)
    if isinstance(items, str) and items in GENERATED:
        low, high = check_sides(sides)
        if items == "rs":
            if high > min(size):
                raise ValueError(
                    f"items 'rs' with sides {low}..{high}: the largest fits into the bin {size} "
                    f"in no orientation; the longest side can be {min(size)}"
                )
            return Uniform(low, high)
        stream = Cut(size, 1 if items == "cut1" else 2, low, high)
        cut(size, stream.order, 0, torch.zeros(1, dtype=torch.int64), (low, high))
        return stream
    if isinstance(items, str | Path):
        if isinstance(items, str) and not Path(items).suffix:
            raise ValueError(f"unknown items {items!r}: one of {', '.join(GENERATED)}, or a file")
        return load(items, size)[0]
    if all(hasattr(items, name) for name in ("start", "item", "to", "smallest", "longest")):
        return items  # type: ignore[return-value]  # a Stream, by its two functions
    return check_items(items, size)  # type: ignore[arg-type]  # not a stream, so an array


def choose_stream(
    items: str, size: Size | None = None, sides: tuple[int, int] = DEFAULT_SIDES
) -> tuple[Stream, Size]:
    """The stream and bin size that a command's options name.

    Args:
        items: a name in :data:`GENERATED` or a file.
        size: (W, D, H); by default the file's own, else 10 × 10 × 10.
        sides: shortest and longest side of generated items.
    """
    if items in GENERATED:
        size = (10, 10, 10) if size is None else check_size(size)
        return make_stream(items, size, sides), size
    return load(items, size)
