"""Read JSON, CSV and npz files from users, up to a limit on the size.

Every error is a ValueError with a one-line message that begins with the file's name.
"""

from __future__ import annotations

import csv
import io
import json
import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numpy.lib import format as npy
from numpy.typing import NDArray

from marl_pack.checks import one_line

MAX_TEXT = 256 << 20
"""Bytes of the largest JSON or CSV file."""
MAX_ARRAYS = 512 << 20
"""Bytes that the arrays of an archive may unpack to, all together."""

NPY_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def read_text(path: Path) -> str:
    """Return the text of a UTF-8 file, which may begin with a byte order mark."""
    with path.open("rb") as file:
        content = file.read(MAX_TEXT + 1)
    if len(content) > MAX_TEXT:
        raise ValueError(f"{path}: too large: needs at most {MAX_TEXT >> 20} MiB of text")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not readable as UTF-8 text ({error})") from None
    if "\0" in text:
        raise ValueError(f"{path}: not readable as text: it has NUL bytes")
    return text


def read_json(path: Path) -> Any:
    """Return the content of a JSON file; refuse an object that has a key twice."""
    text = read_text(path)
    try:
        return json.loads(text, object_pairs_hook=unique_keys)
    except RecursionError:
        reason = "it is nested too deeply"
    except (json.JSONDecodeError, KeyError) as error:
        reason = one_line(str(error.args[0]), 200)
    except ValueError:  # Python's limit of digits
        reason = "it has a number of thousands of digits"
    raise ValueError(f"{path}: not readable as JSON ({reason})")


def unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; raise KeyError for a key that is given twice."""
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise KeyError(f"the key {key!r} is given twice")
        content[key] = value
    return content


def read_lines(path: Path, *, trim: bool = False) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the values of each line of a CSV file that is not empty.

    Args:
        path: the file to read.
        trim: whether to remove spaces after commas.
    """
    text = io.StringIO(read_text(path), newline="")
    reader = csv.reader(text, skipinitialspace=trim, strict=True)
    try:
        for row in reader:
            if row:
                yield reader.line_num, row
    except csv.Error as error:
        raise ValueError(f"{path}: line {reader.line_num}: not readable as CSV ({error})") from None


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an npz archive by name.

    Their sizes are checked in the archive's directory and in the arrays' headers, before anything
    is unpacked. Arrays of Python objects are refused.
    """
    with path.open("rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                members = archive.infolist()
                if sum(member.file_size for member in members) > MAX_ARRAYS:
                    raise ValueError(f"it needs to unpack to at most {MAX_ARRAYS >> 20} MiB")
                arrays = {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}
                if len(arrays) < len(members):
                    raise ValueError("it has two arrays of the same name")
                return arrays
        except Exception as error:  # a broken archive raises errors of a dozen types
            reason = one_line(str(error), 200) or type(error).__name__
            raise ValueError(f"{path}: not a readable .npz archive ({reason})") from None


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """Return the array of one member, whose header must agree with its size."""
    with archive.open(member) as file:
        version = npy.read_magic(file)
        if version not in NPY_HEADERS:
            raise ValueError(f"{member.filename} has an unknown version of header, {version}")
        shape, _, dtype = NPY_HEADERS[version](file)
        if dtype.hasobject or not dtype.itemsize:
            raise ValueError(f"{member.filename} needs plain numbers or texts, not {dtype}")
        if math.prod(shape) * dtype.itemsize != member.file_size - file.tell():
            raise ValueError(f"{member.filename} does not have the size in its header, {shape}")
    with archive.open(member) as file:
        array: NDArray[Any] = npy.read_array(file, allow_pickle=False)
    return array
