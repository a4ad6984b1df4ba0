"""Find the files of trained agents: published models, checkpoints, and those in runs' folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from marl_pack import published, renamed

LATEST, BEST = "latest.pt", "best.pt"
"""Checkpoints in a run's folder: to resume from, and the best of all evaluations."""


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
