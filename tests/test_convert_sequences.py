"""Published sequences become a file that the package reads."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from marl_pack.items import load

SCRIPT = Path(__file__).parent.parent / "examples" / "convert_sequences.py"


def convert(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("zipped", [False, True])
def test_a_published_file_is_converted(tmp_path: Path, zipped: bool) -> None:
    numbers = list(np.array([4, 2, 3]))  # of NumPy, as some generators make them
    sequences = [[[2, 3, 4], (5, 5, 2), [10, 10, 10]], [numbers]]
    torch.save(sequences, tmp_path / "rs.pt", _use_new_zipfile_serialization=zipped)
    done = convert(tmp_path / "rs.pt", tmp_path / "rs.npz")
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("rs.npz: 2 sequences, 3 boxes\n")
    stream, size = load(tmp_path / "rs.npz")
    assert size == (10, 10, 10)
    assert stream.items.sides.tolist() == [[[2, 3, 4], [5, 5, 2]], [[4, 2, 3], [0, 0, 0]]]


def test_another_file_is_refused_in_one_line(tmp_path: Path) -> None:
    torch.save([[2, 3, 4]], tmp_path / "flat.pt")
    torch.save([Path("a")], tmp_path / "objects.pt")
    for name, why in (
        ("flat.pt", "sequence 0 needs boxes of three whole sides"),
        ("objects.pt", "needs a list of sequences, saved by torch.save"),
    ):
        done = convert(tmp_path / name, tmp_path / "items.npz")
        assert done.returncode == 2
        assert done.stderr == f"convert_sequences.py: {tmp_path / name}: {why}\n"
