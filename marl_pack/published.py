"""Find the trained models and the settings that come with the package by their names.

A model has a name such as ``rs``. Settings have a name such as ``quick`` or ``ablations/joint``.
Any other text with a folder or a suffix, such as ``./NAME``, is a path.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from marl_pack import renamed
from marl_pack.checks import shown

PACKAGE = Path(__file__).parent
ROOT = PACKAGE if (PACKAGE / "models").is_dir() else PACKAGE.parent
"""The folder with ``models`` and ``configs``: the installed package, or the clone."""
MODELS, CONFIGS = ROOT / "models", ROOT / "configs"


def models() -> list[str]:
    """Return the names of the published models."""
    return sorted(path.stem for path in MODELS.glob("*.pt"))


def configs() -> list[str]:
    """Return the names of the published settings, such as ``quick`` and ``ablations/joint``."""
    paths = (path.relative_to(CONFIGS).with_suffix("") for path in CONFIGS.rglob("*.yaml"))
    return sorted(path.as_posix() for path in paths)


def is_path(source: str) -> bool:
    """Return whether a text is a path and not a name: it has a folder or a suffix."""
    return os.path.basename(source) != source or "." in source or not source


def model(source: str | Path, others: Sequence[str] = ()) -> Path:
    """Return the path of a model.

    Args:
        source: a published model's name, or the path of a run's folder or a checkpoint.
        others: other names that the caller accepts, for the message.

    Raises:
        ValueError: if no published model has this name.
    """
    if not isinstance(source, str) or is_path(source):
        return Path(source)
    if source in models():
        return MODELS / f"{source}.pt"
    raise _unknown(source, [*others, *models()], "a checkpoint or a run's folder")


def config(source: str) -> Path:
    """Return the path of a YAML file of settings.

    Args:
        source: the name of published settings, or a path.

    Raises:
        ValueError: if no published settings have this name.
    """
    if source in configs():
        return CONFIGS / f"{source}.yaml"
    if is_path(source):
        return Path(source)
    raise _unknown(source, configs(), "a file of settings")


def _unknown(name: str, names: Sequence[str], path: str) -> ValueError:
    """Return the error that lists the valid names and suggests the nearest one."""
    near = f"./{name}" if os.path.exists(name) else renamed.nearest(name, names)
    guess = renamed.did_you_mean(near) if near else ""
    return ValueError(f"{shown(name)}: needs one of {', '.join(names)}, or a path to {path}{guess}")
