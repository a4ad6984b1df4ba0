"""The package where it may not write: read-only, without a home, in a new process."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from marl_pack.extras import missing

PACKAGE = Path(__file__).parent.parent / "marl_pack"

DRAW = "print(draw(numpy.array([1], numpy.uint64), 10))"
PLAY = """
import marl_pack.env_aec
from marl_pack.items.random_numbers import draw
import numpy
print(draw(numpy.array([1], numpy.uint64), 10), marl_pack.__file__)
"""


def test_a_package_that_may_not_be_written_to_is_imported_with_one_warning(tmp_path: Path) -> None:
    copy = shutil.copytree(PACKAGE, tmp_path / "marl_pack", ignore=lambda *_: ["__pycache__"])
    for folder in [copy, *(path for path in copy.rglob("*") if path.is_dir())]:
        (folder / "__pycache__").touch()  # no folder can be made there, not even by root
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    environment |= {
        "HOME": "/dev/null/home",
        "PYTHONPATH": str(tmp_path),
        "XDG_CACHE_HOME": "/dev/null/cache",
    }
    result = subprocess.run(
        [sys.executable, "-c", PLAY], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    assert str(copy) in result.stdout
    assert result.stderr.count("compiled code cannot be cached") == 1
    assert "set NUMBA_CACHE_DIR to a writable folder" in result.stderr


def test_a_damaged_cache_is_compiled_around(tmp_path: Path) -> None:
    def play() -> str:
        code = "from marl_pack.items.random_numbers import draw; import numpy; " + DRAW
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
        return subprocess.check_output(
            [sys.executable, "-c", code], cwd=PACKAGE.parent, env=environment, text=True,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip

    expected = play()
    for ending, size in (("nbc", 20), ("nbi", 20), ("nbi", 0)):
        (file,) = tmp_path.rglob(f"*.{ending}")
        file.write_bytes(file.read_bytes()[:size])
        assert play() == expected


def test_a_missing_package_is_named_with_the_command_for_the_source() -> None:
    error = missing(ModuleNotFoundError("No module named 'sapien'"), "judge", "physics")
    assert 'pip install -e ".[physics]"' in str(error)
    with pytest.raises(ModuleNotFoundError, match="No module named 'sapien': judge"):
        raise error
