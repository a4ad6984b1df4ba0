"""The trained models and the settings that are published with the package, by name.

A model's name is a word such as ``rs``; that of settings is ``quick`` or ``ablations/joint``. What
has a folder or a suffix is a path, as ``./NAME`` is.
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
    """Return whether a text is a path and no name: it has a folder or a suffix."""
    return os.path.basename(source) != source or "." in source or not source


def model(source: str | Path, others: Sequence[str] = ()) -> Path:
    """Return the path of a model.

    Args:
        source: a published model's name, or the path of a run's folder or a checkpoint.
        others: names that are valid where it was given, for the message.

    Raises:
        ValueError: for a name that is none of a published model.
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
        ValueError: for a name that is none of theirs.
    """
    if source in configs():
        return CONFIGS / f"{source}.yaml"
    if is_path(source):
        return Path(source)
    raise _unknown(source, configs(), "a file of settings")


def _unknown(name: str, names: Sequence[str], path: str) -> ValueError:
    """Return the error that lists the valid names, and says which one was probably meant."""
    near = f"./{name}" if os.path.exists(name) else renamed.nearest(name, names)
    guess = renamed.did_you_mean(near) if near else ""
    return ValueError(f"{shown(name)}: needs one of {', '.join(names)}, or a path to {path}{guess}")
