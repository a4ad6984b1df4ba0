"""``marl-pack compile`` compiles what other commands need, and nothing is left to them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

COUNTED = """
import sys
from numba.core import event

class Compiled(event.Listener):
    def on_start(self, event): pass
    def on_end(self, event): names.add(event.data["dispatcher"].py_func.__qualname__)

names = set()
event.register("numba:compile", Compiled())
from marl_pack.cli import main
main(sys.argv[1:])
print("compiled:", *sorted(names))
"""


def compiled(cache: Path, *words: str) -> list[str]:
    """Run the command ``marl-pack`` with a cache; return the functions that it compiled."""
    run = subprocess.run(
        [sys.executable, "-c", COUNTED, *words], check=False, capture_output=True, text=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(cache)}, cwd=cache,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    return run.stdout.splitlines()[-1].split()[1:]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a cache of compiled code that the command ``compile`` has filled."""
    folder = tmp_path_factory.mktemp("cache")
    assert "central_masks" in compiled(folder, "compile")
    return folder


@pytest.mark.parametrize(
    "words",
    [
        "evaluate --policy rs --items rs --episodes 2",
        "evaluate --policy rs --plan rollouts=2,top=2,depth=1 --items rs --episodes 1",
        "evaluate --policy dblf max_feasible --items cut2 --rule lbcp --episodes 2",
        "evaluate --policy random --items rs --rule equilibrium --margin 0.3 --episodes 2",
        "evaluate --policy max_feasible --bin 30 20 40 --items rs --sides 4 12 --episodes 1",
        "train --config quick --ppo.max_iterations 1 --evaluation.episodes 4",
        "play --policy rs --items rs",
    ],
)
def test_nothing_is_left_to_compile(cache: Path, words: str) -> None:
    assert compiled(cache, *words.split()) == []
