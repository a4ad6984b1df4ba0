"""Make a stream from a name, a file, an array, a mapping or a record."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from numpy.typing import ArrayLike

from marl_pack.checks import whole_number
from marl_pack.geometry import Size, check_size
from marl_pack.items.checking import check_items
from marl_pack.items.cutting import check_sides, cut
from marl_pack.items.files import check_fields, read_fields
from marl_pack.items.generated import DEFAULT_SIDES, GENERATED, no_such_file
from marl_pack.items.items import Items
from marl_pack.items.sequences import Sequences
from marl_pack.items.streams import Cut, Stream, Uniform

MEMBERS = tuple(name for name in vars(Stream) if not name.startswith("_"))
"""Names of the members of a stream."""
METHODS = tuple(name for name in MEMBERS if callable(getattr(Stream, name)))
"""Names of the members that are methods."""


def load(
    path: str | Path, size: Size | None = None, otherwise: Size | None = None
) -> tuple[Sequences, Size]:
    """Read item sequences from a file; its ending says the format.

    - ``.npz``: ``items`` [S, L, 3] or [L, 3]; optionally attributes by key
      (:data:`marl_pack.items.ATTRIBUTES`), ``lengths`` [S] and ``bin`` [3].
    - ``.json``: an object with the same keys, where ``items`` may also be sequences of unequal
      length; or only the items.
    - ``.csv``: a header with the columns w, d, h and optionally attributes and sequence (a number
      or text; rows of one sequence keep their order); then one item a row.

    Args:
        path: the file.
        size: (W, D, H) of the bin; by default ``bin`` in the file.
        otherwise: the bin size if neither ``size`` nor the file gives one.

    Returns:
        The sequences and the bin size.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for another ending, a missing or unknown key or column, a missing bin size, a
            ``size`` that differs from the file's, or an impossible item; the message names its row.
    """
    path = Path(path)
    if not path.is_file():
        raise no_such_file(path)
    return _from_fields(read_fields(path), size, str(path), otherwise)


def _from_fields(
    fields: Mapping[str, Any], size: Size | None, source: str, otherwise: Size | None = None
) -> tuple[Sequences, Size]:
    """Return the sequences and the bin size from the fields of a file or a mapping."""
    given_size = fields.get("bin")
    try:
        given_size = None if given_size is None else check_size(given_size)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None
    bin_size = given_size or otherwise if size is None else check_size(size)
    if bin_size is None:
        raise ValueError(f"{source}: has no bin size; give one, W D H")
    if given_size not in (None, bin_size):
        raise ValueError(f"{source}: is for the bin {given_size}, not {bin_size}; give that size")
    attributes = {key: values for key, values in fields.items() if key not in ("items", "bin")}
    return check_items(fields["items"], bin_size, source=source, **attributes), bin_size


def make_stream(
    items: str | Path | ArrayLike | Items | Mapping[str, Any] | Stream,
    size: Size,
    sides: tuple[int, int] = DEFAULT_SIDES,
) -> Stream:
    """Return a stream of the items that ``items`` describes.

    Args:
        items: ``"rs"``, ``"cut1"``, ``"cut2"``; a file (:func:`load`); an array [L, 3] or
            [S, L, 3]; items with attributes, as a record [L] or [S, L] or as a mapping with the
            keys of a JSON file; or a stream.
        size: (W, D, H) of the bin.
        sides: shortest and longest side of generated items.

    Raises:
        ValueError: if an item does not fit into the bin in any of its orientations, the name is
            unknown, or a member of a stream is missing or impossible.
    """
    size = check_size(size)
    if isinstance(items, str) and items in GENERATED:
        return _generated(items, size, sides)
    if isinstance(items, str | Path):
        if isinstance(items, str) and not Path(items).suffix:
            names = ", ".join(GENERATED)
            raise ValueError(f"unknown items {items!r}: needs one of {names}, or a file")
        return load(items, size)[0]
    if isinstance(items, Items):
        attributes: dict[str, Any] = dict(items.to("cpu").tensors())
        return check_items(attributes.pop("sides"), size, **attributes)
    if isinstance(items, Mapping):
        check_fields(items, "items")
        return _from_fields(items, size, "items")[0]
    if isinstance(items, list | tuple) or hasattr(items, "__array__"):
        return check_items(cast(ArrayLike, items), size)
    return check_stream(items)


def check_stream(stream: Any) -> Stream:
    """Check that an object has the members of a stream with possible values, and return it.

    Raises:
        ValueError: naming the members that are missing, or the first with an impossible value.
    """
    name = f"items {type(stream).__name__}"
    missing = [member for member in MEMBERS if not hasattr(stream, member)]
    if missing:
        raise ValueError(
            f"{name}: needs to be an array or a stream; a stream also needs {', '.join(missing)}"
        )
    for member in METHODS:
        if not callable(getattr(stream, member)):
            raise ValueError(f"{name}: {member} needs to be a method")
    whole_number(stream.smallest, f"{name}: smallest", 1)
    for member in ("episodes", "longest"):
        if getattr(stream, member) is not None:
            whole_number(getattr(stream, member), f"{name}: {member}", 1)
    try:
        low, high = stream.sides
    except (TypeError, ValueError):
        raise ValueError(f"{name}: sides needs the shortest and the longest side") from None
    whole_number(low, f"{name}: shortest of sides", 1)
    whole_number(high, f"{name}: longest of sides", low)
    sets = stream.orientation_sets
    if not isinstance(sets, Mapping) or not sets:
        raise ValueError(f"{name}: orientation_sets needs a mapping from orientations to shares")
    result: Stream = stream
    return result


def _generated(name: str, size: Size, sides: tuple[int, int]) -> Stream:
    """Return a stream of :data:`GENERATED`; refuse it if its items cannot fit this bin."""
    low, high = check_sides(sides)
    if name == "rs":
        if high > min(size):
            raise ValueError(
                f"items 'rs' with sides {low}..{high}: the largest fits into the bin {size} "
                f"in no orientation; the longest side can be {min(size)}"
            )
        return Uniform(low, high)
    stream = Cut(size, 1 if name == "cut1" else 2, low, high)
    cut(size, stream.order, 0, torch.zeros(1, dtype=torch.int64), (low, high))
    return stream


def choose_stream(
    items: str,
    size: Size | None = None,
    sides: tuple[int, int] = DEFAULT_SIDES,
    otherwise: Size | None = None,
) -> tuple[Stream, Size]:
    """Return the stream and the bin size that a command's options describe.

    Args:
        items: a name in :data:`GENERATED` or a file.
        size: (W, D, H) of the bin; by default the size in the file.
        sides: shortest and longest side of generated items.
        otherwise: the bin size if neither ``size`` nor a file gives one; by default 10 × 10 × 10
            for generated items.
    """
    if items in GENERATED:
        size = check_size(size or otherwise or (10, 10, 10))
        return make_stream(items, size, sides), size
    return load(items, size, otherwise)
