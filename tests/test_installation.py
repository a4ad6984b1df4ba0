"""The package where it may not write: read-only, without a home, in a new process."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from marl_pack.extras import missing
from marl_pack.installation import compiled_sources

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


def test_compiled_code_is_compiled_again_if_any_file_that_it_may_contain_changes(
    tmp_path: Path,
) -> None:
    def write(name: str, text: str) -> str:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        compiled_sources.cache_clear()
        return compiled_sources(tmp_path)

    write("program.py", "print(1)")
    write("root.py", "@njit()\ndef f(): pass")
    write("kernels/a.py", "@njit()\ndef g(): pass")
    first = write("kernels/constants.py", "SCALE = 256")
    assert write("program.py", "print(2)") == first
    assert write("plain/b.py", "x = 1") == first
    changed = [write("kernels/constants.py", "SCALE = 128"), write("root.py", "@njit()"),
               write("kernels/a.py", "@njit()")]  # fmt: skip
    assert len({first, *changed}) == 4


def test_a_function_is_not_loaded_from_the_cache_of_other_sources(tmp_path: Path) -> None:
    copy = shutil.copytree(
        PACKAGE, tmp_path / "marl_pack", ignore=lambda *_: ["__pycache__", "models"]
    )
    code = (
        "import numpy as np; from marl_pack.exact.bins import _waste_all\n"
        "from marl_pack.exact.spec import ExactSpec; from marl_pack.exact.bins import ExactBins\n"
        "bins = ExactBins(1, ExactSpec(bin_mm=(9, 9, 9), unit_mm=1))\n"
        "item = np.array([[2, 2, 2]]); move = np.array([(3 << 43)])\n"
        "print(_waste_all(bins.state, item, move)[0])\n"
    )
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "c")}

    def waste() -> float:
        output = subprocess.check_output(
            [sys.executable, "-c", code], cwd=tmp_path, env=environment, text=True
        )
        return float(output)

    assert waste() == 2 * 2 * 3
    changed = copy / "exact" / "features.py"  # its function is compiled into that of bins.py
    text = changed.read_text()
    changed.write_text(text.replace("    return volume\n", "    return volume + 1\n", 1))
    assert waste() == 2 * 2 * 3 + 1


def test_a_missing_package_is_named_with_the_command_for_the_source() -> None:
    error = missing(ModuleNotFoundError("No module named 'sapien'"), "judge", "physics")
    assert 'pip install -e ".[physics]"' in str(error)
    with pytest.raises(ModuleNotFoundError, match="No module named 'sapien': judge"):
        raise error
