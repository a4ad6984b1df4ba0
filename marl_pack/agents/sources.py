"""Find the files of policies: published models, checkpoints, folders of runs, and user code."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from marl_pack import published, renamed

LATEST, BEST = "latest.pt", "best.pt"
"""Checkpoints in a run's folder: the latest, to resume the run, and the best in evaluation."""


OWN = re.compile(r"(.+\.py):([A-Za-z_]\w*)")
"""The form of a policy in the user's own code, such as ``my_agents.py:policy``."""


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
    except Exception as error:  # the user's code may raise anything
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
        names: the heuristics that are valid here.

    Raises:
        ValueError, FileNotFoundError: if there is no such policy; the message says what is valid.
    """
    if is_own(source):
        _own_parts(source)
    elif source not in names:
        resolve(path_of(source, names))


def path_of(source: str | Path, names: Sequence[str]) -> Path:
    """Return the path of the checkpoint or the run's folder that ``source`` names.

    Args:
        source: a published model's name, or a path.
        names: the heuristics that are also valid here; the message names them.

    Raises:
        ValueError: if ``source`` is neither a path nor the name of a published model.
    """
    renamed.refuse_old(str(source), renamed.POLICIES, "policy")
    return published.model(source, names)


def resolve(source: str | Path) -> Path:
    """Return the checkpoint file that ``source`` names.

    Args:
        source: a published model's name, or the path of a checkpoint or of a run's folder. In a
            folder it is ``best.pt``, or ``latest.pt`` if there is no ``best.pt``.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if no published model has this name.
    """
    path = published.model(source)
    if path.is_dir():
        for name in (BEST, LATEST):
            if (path / name).is_file():
                return path / name
        raise FileNotFoundError(f"{path}: not a run's folder: it has neither {BEST} nor {LATEST}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    return path
