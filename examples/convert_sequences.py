"""Convert the sequences that Zhao et al. 2021 published to files that marl_pack reads.

Usage: ``python examples/convert_sequences.py dataset/rs.pt rs.npz``. A published file has a list of
sequences, each a list of boxes [w, d, h] in cells, saved by ``torch.save``. A box as large as the
bin marks the end of a sequence and is not converted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

SCALAR = np.int64(0).__reduce__()[0]
NUMPY_NUMBERS = [  # types that a file may contain; SCALAR's name depends on NumPy's version
    np.dtype, type(np.dtype(np.int64)),
    (SCALAR, "numpy.core.multiarray.scalar"), (SCALAR, "numpy._core.multiarray.scalar"),
]  # fmt: skip


def read(path: Path, size: Sequence[int]) -> list[NDArray[np.int64]]:
    """Return the boxes [L, 3] of each sequence in a published file.

    Args:
        path: the file to read.
        size: the bin's sides W, D, H in cells.

    Raises:
        ValueError: if the file contains something else; the message names the sequence.
    """
    try:
        with torch.serialization.safe_globals(NUMPY_NUMBERS):
            content = torch.load(path, weights_only=True)
    except OSError:
        raise
    except Exception:  # torch raises many kinds, with messages of many lines
        raise ValueError(f"{path}: needs a list of sequences, saved by torch.save") from None
    sequences = []
    for k, boxes in enumerate(content):
        sides = np.asarray(boxes)
        if sides.ndim != 2 or sides.shape[1] != 3 or sides.dtype.kind not in "iu":
            raise ValueError(f"{path}: sequence {k} needs boxes of three whole sides")
        while len(sides) and (sides[-1] == size).all():
            sides = sides[:-1]
        sequences.append(sides)
    return sequences


def write(sequences: Sequence[NDArray[np.int64]], size: Sequence[int], path: Path) -> None:
    """Write sequences as ``items`` [S, L, 3], padded with zeros, ``lengths`` [S] and ``bin``."""
    lengths = np.array([len(sides) for sides in sequences])
    items = np.zeros((len(sequences), lengths.max(), 3), np.int16)
    for row, sides in zip(items, sequences, strict=True):
        row[: len(sides)] = sides
    np.savez_compressed(path, items=items, lengths=lengths, bin=np.array(size))


def main() -> int:
    """Convert one file; return the exit status."""
    parser = argparse.ArgumentParser(description="Convert published sequences.")
    parser.add_argument("source", type=Path, help="the published file, such as dataset/rs.pt")
    parser.add_argument("target", type=Path, help="the file to write, such as rs.npz")
    parser.add_argument(
        "--bin", type=int, nargs=3, default=(10, 10, 10), metavar=("W", "D", "H"),
        help="the bin's sides in cells (default: 10 10 10)",
    )  # fmt: skip
    options = parser.parse_args()
    try:
        sequences = read(options.source, options.bin)
        write(sequences, options.bin, options.target)
    except (OSError, ValueError) as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    print(f"{options.target}: {len(sequences):,} sequences, {sum(map(len, sequences)):,} boxes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
