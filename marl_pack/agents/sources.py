"""Find the files of policies: published models, checkpoints, runs' folders, and code of users."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from marl_pack import published, renamed

LATEST, BEST = "latest.pt", "best.pt"
"""Checkpoints in a run's folder: to resume from, and the best of all evaluations."""


OWN = re.compile(r"(.+\.py):([A-Za-z_]\w*)")
"""A policy in code of the user's own, such as ``my_agents.py:policy``."""


def is_own(source: object) -> bool:
    """Return whether ``source`` names a policy in a Python file, as ``FILE.py:NAME``."""
    return isinstance(source, str) and OWN.fullmatch(source) is not None


def own_policy(source: str) -> Any:
    """Run a Python file and return the function in it that ``source`` names.

    Args:
        source: ``FILE.py:NAME``.

    Raises:
        ValueError: if there is no such file or function, or the file cannot be run.
    """
    file, name = _own_parts(source)
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever the code of the user raises
        raise ValueError(f"{file}: cannot be run: {type(error).__name__}: {error}") from error
    function = getattr(module, name, None)
    if not callable(function):
        raise ValueError(f"{source}: {file} has no function {name}")
    return function


def _own_parts(source: str) -> tuple[Path, str]:
    """Return the file and the name in ``FILE.py:NAME``.

    Raises:
        FileNotFoundError: if there is no such file.
    """
    parts = OWN.fullmatch(source)
    assert parts is not None
    if not Path(parts[1]).is_file():
        raise FileNotFoundError(f"{parts[1]}: no such file")
    return Path(parts[1]), parts[2]


def check_source(source: str, names: Sequence[str]) -> None:
    """Refuse a policy that does not exist, without loading it.

    Args:
        source: a heuristic, a published model, a path, or ``FILE.py:NAME``.
        names: the heuristics that may be given.

    Raises:
        ValueError, FileNotFoundError: naming what would be right.
    """
    if is_own(source):
        _own_parts(source)
    elif source not in names:
        resolve(path_of(source, names))


def path_of(source: str | Path, names: Sequence[str]) -> Path:
    """Return the path of the checkpoint or the run's folder that ``source`` names.

    Args:
        source: a published model's name, or a path.
        names: heuristics that may be given in its place, for the message.

    Raises:
        ValueError: if it is no path and no published model's name; says what would be right.
    """
    renamed.refuse_old(str(source), renamed.POLICIES, "policy")
    return published.model(source, names)


def resolve(source: str | Path) -> Path:
    """Return the checkpoint file that ``source`` names.

    Args:
        source: a published model's name, or the path of a checkpoint or of a run's folder: there
            its best, else its latest.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: for a name that is none of a published model.
    """
    path = published.model(source)
    if path.is_dir():
        for name in (BEST, LATEST):
            if (path / name).is_file():
                return path / name
        raise FileNotFoundError(f"{path}: needs {BEST} or {LATEST}, as a run's folder has")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    return path
