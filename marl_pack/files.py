"""Write files so that they are complete or do not exist."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def check_writable(path: Path) -> None:
    """Raise ValueError if no file can be written at ``path``."""
    if not path.parent.is_dir():
        raise ValueError(f"{path}: the folder {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK):
        raise ValueError(f"{path}: the folder {path.parent} may not be written to")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; needs the name of a file")


@contextmanager
def moved_into_place(path: Path) -> Iterator[Path]:
    """Yield a temporary path with the same ending; move its file into place at the end."""
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_atomically(path: Path, write: Callable[[Any], None]) -> None:
    """Write a file under another name and move it into place once it is complete.

    Args:
        path: of the file.
        write: is called with the open binary file.
    """
    with moved_into_place(path) as part, part.open("wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())


def write_json(path: Path, report: Any) -> None:
    """Write figures as JSON: unknown types as text, NaN refused with ValueError."""
    text = json.dumps(report, indent=2, default=str, allow_nan=False) + "\n"
    write_atomically(path, lambda file: file.write(text.encode()))
