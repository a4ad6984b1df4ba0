"""Write files so that they are complete or do not exist.

A file is first written in the same folder under a unique temporary name, and is renamed when it is
complete. Links are followed. A device, a pipe or the program's own output is written directly.
"""

from __future__ import annotations

import csv
import io
import json
import os
import secrets
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

T = TypeVar("T")

DESCRIPTORS = "/dev/fd", "/proc/self/fd"  # folders of the files that a program has open
PART = ".part-"  # the names of unfinished files begin with this
WRITING = 0.05  # largest share of the time that is spent on writing a growing file


def _status(path: Path) -> os.stat_result | None:
    """Return the status of the file that a path leads to; None if it does not exist."""
    try:
        return path.stat()
    except FileNotFoundError:
        return None


def _stream(path: Path, status: os.stat_result) -> int | None:
    """Return the descriptor of the program's own output if the file is this output, or None."""
    named = [int(path.name)] if str(path.parent) in DESCRIPTORS and path.name.isdecimal() else []
    for descriptor in (1, 2, *named):
        with suppress(OSError):  # it may be closed
            if os.path.samestat(os.fstat(descriptor), status):
                return descriptor
    return None


def _written_through(path: Path, status: os.stat_result | None) -> bool:
    """Return whether a file exists but is not a plain file, so that it cannot be replaced."""
    return status is not None and not (
        stat.S_ISREG(status.st_mode) and _stream(path, status) is None
    )


def check_writable(path: Path) -> None:
    """Raise ValueError if no file can be written at ``path``."""
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; needs the name of a file")
    try:
        status = _status(path)
    except OSError as error:  # such as a link to itself
        raise ValueError(f"{path}: {error.strerror}") from None
    if status is not None and not os.access(path, os.W_OK):
        raise ValueError(f"{path}: is not writable")
    if _written_through(path, status):
        return
    folder = Path(os.path.realpath(path)).parent
    if not folder.is_dir():
        raise ValueError(f"{path}: the folder {folder} does not exist")
    if not os.access(folder, os.W_OK):
        raise ValueError(f"{path}: the folder {folder} is not writable")


def same_plain_file(a: Path, b: Path) -> bool:
    """Return whether two paths lead to one plain file, which may not exist yet."""
    same = os.path.realpath(a) == os.path.realpath(b)
    return same and not _written_through(a, _status(a))


@contextmanager
def moved_into_place(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file with the same suffix; move the file into place at the end.

    An existing file keeps its mode and, if permitted, its owner. If ``path`` is not a plain file,
    the content is copied into it instead.

    Raises:
        OSError: if the file cannot be written; the message names ``path``. An existing file does
            not change then.
    """
    try:
        status = _status(path)
        if _written_through(path, status):
            with tempfile.TemporaryDirectory() as folder:
                part = Path(folder, f"part{path.suffix}")
                yield part
                _write_through(path, part)
        else:
            with _replacing(Path(os.path.realpath(path)), status) as part:
                yield part
    except OSError as error:
        if error.errno is None:  # the error of a library, whose message may be a whole log
            raise OSError(f"{path}: {str(error).splitlines()[0]}") from None
        raise OSError(error.errno, error.strerror, str(path)) from None


@contextmanager
def _replacing(target: Path, status: os.stat_result | None) -> Iterator[Path]:
    """Yield a temporary file in the folder of ``target``, and replace ``target`` at the end."""
    part = target.with_name(f"{PART}{secrets.token_hex(8)}{target.suffix}")
    mode = 0o666 if status is None else 0o600  # minus the bits that the umask clears
    os.close(os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode))
    try:
        yield part
        with part.open("r+b") as file:
            os.fsync(file.fileno())
        if status is not None:
            with suppress(PermissionError):  # the file of another user
                shutil.chown(part, status.st_uid, status.st_gid)
            part.chmod(stat.S_IMODE(status.st_mode))
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def _write_through(path: Path, part: Path) -> None:
    """Copy a finished file into a device, a pipe or the program's own output."""
    descriptor = _stream(path, path.stat())
    for output in (sys.stdout, sys.stderr):
        output.flush()
    with part.open("rb") as file, open(
        path if descriptor is None else os.dup(descriptor), "wb"
    ) as out:  # fmt: skip
        shutil.copyfileobj(file, out)


def remove_unfinished(folder: Path) -> None:
    """Remove unfinished files of killed programs; no other program may be writing there."""
    for part in folder.glob(f"{PART}*"):
        part.unlink(missing_ok=True)


def write_atomically(path: Path, write: Callable[[Any], None]) -> None:
    """Write a file under another name and move it into place once it is complete.

    Args:
        path: the file to write.
        write: a function that writes the content to a binary file in memory. So an OSError comes
            from the disk, not from this function.
    """
    content = io.BytesIO()
    write(content)
    with moved_into_place(path) as part, part.open("wb") as file:
        file.write(content.getbuffer())


def write_json(path: Path, report: Any) -> None:
    """Write a report as JSON: values of unknown types become texts, NaN raises ValueError."""
    text = json.dumps(report, indent=2, default=str, allow_nan=False) + "\n"
    write_atomically(path, lambda file: file.write(text.encode()))


def write_csv(path: Path, lines: Iterable[Sequence[Any]]) -> None:
    """Write lines of values as CSV."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(lines)
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))


class Growing(Generic[T]):
    """A file that is rewritten while its content grows, so that a stopped program leaves a file.

    Args:
        path: the file to write; None writes nothing. If it is not a plain file, it is written only
            once, at the end.
        write: a function (path, content) that writes the file.
    """

    def __init__(self, path: Path | None, write: Callable[[Path, T], None]) -> None:
        self.path, self.write = path, write
        self.at_end = path is not None and _written_through(path, _status(path))
        self.content: T | None = None  # content that is not yet written
        self.next = 0.0  # earliest time at which the file is written again

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def update(self, content: T) -> None:
        """Take the new content; write it now, or later if the file has just been written."""
        self.content = content
        if not self.at_end and time.monotonic() >= self.next:
            self.close()

    def close(self) -> None:
        """Write the content that is not yet written."""
        if self.path is not None and self.content is not None:
            start = time.monotonic()
            self.write(self.path, self.content)
            end = time.monotonic()
            self.content, self.next = None, end + (end - start) / WRITING
