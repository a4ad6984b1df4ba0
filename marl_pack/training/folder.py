"""The folder of a training run: its files, and resuming a run from it."""

from __future__ import annotations

import csv
import datetime
import io
import json
import os
import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
import yaml

import marl_pack
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.learning.resuming import check_progress
from marl_pack.agents.loading import trained_game
from marl_pack.config import Config, ConfigError, from_dict, parse
from marl_pack.files import write_atomically

PACKAGES = ("torch", "rsl-rl-lib", "tensordict", "numpy", "numba", "scipy", "pettingzoo")
MAY_CHANGE = ("output.", "evaluation.", "ppo.max_iterations")  # beside --resume


def write_history(path: Path, history: Sequence[Mapping[str, Any]]) -> None:
    """Write the history of evaluations as CSV."""
    text = io.StringIO()
    # An earlier version may have written other columns.
    writer = csv.DictWriter(text, list(history[-1]), extrasaction="ignore")
    writer.writeheader()
    writer.writerows(history)
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))


def write_record(folder: Path, config: Config, arguments: Sequence[str]) -> None:
    """Write the settings, the command and the packages' versions beside the checkpoints."""
    text = yaml.safe_dump(config.to_dict(), sort_keys=False)
    write_atomically(folder / "config.yaml", lambda file: file.write(text.encode()))
    versions = {"python": platform.python_version(), "marl_pack": marl_pack.__version__}
    versions |= {name: metadata.version(name) for name in PACKAGES}
    path = folder / "run.json"
    before = json.loads(path.read_text()) if path.is_file() else None
    record: dict[str, Any] = {
        "arguments": list(arguments),
        "seed": config.seed,
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "processes": int(os.environ.get("WORLD_SIZE", "1")),
        "versions": versions,
    }
    if before is not None:  # the run is resumed: keep the record of its start
        before.setdefault("resumed", []).append(record)
        record = before
    record_text = json.dumps(record, indent=2) + "\n"
    write_atomically(path, lambda file: file.write(record_text.encode()))


def new_folder(config: Config) -> Path:
    """Make the folder of a new run and return it; no two runs share one.

    Raises:
        ConfigError: if the folder exists or cannot be made.
    """
    name = config.output.name
    if name is None:
        name = f"{datetime.datetime.now():%Y-%m-%d_%H-%M-%S}_seed{config.seed}"
    folder = Path(config.output.folder) / name
    if (folder / checkpoints.LATEST).exists():
        raise ConfigError(
            f"output.name: {folder} holds a run; --resume {folder} continues it; or name another"
        )
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise ConfigError(f"output.name: {folder} exists already; name another") from None
    except OSError as error:
        raise ConfigError(f"output.folder: {error}") from None
    return folder


def resumed(run: str, arguments: Sequence[str]) -> tuple[Config, dict[str, Any]]:
    """Return the settings and the latest checkpoint of a run to resume.

    Raises:
        ConfigError, FileNotFoundError: if the run cannot be resumed with these arguments.
    """
    folder = Path(run)
    try:
        checkpoint = checkpoints.read(folder / checkpoints.LATEST if folder.is_dir() else folder)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    own = from_dict(checkpoint["config"])
    config, options = parse(["--config", yaml.safe_dump(own.to_dict()), *arguments])
    if len(options.config or []) > 1:
        raise ConfigError("--resume: needs no --config, as the run has its own settings")
    before, after = _flat(own.to_dict()), _flat(config.to_dict())
    for key, value in after.items():
        if value != before[key] and not key.startswith(MAY_CHANGE):
            raise ConfigError(
                f"--resume: the run has {key} = {before[key]}, not {value}; beside --resume only "
                "output.*, evaluation.* and ppo.max_iterations may change"
            )
    _check_size(own, checkpoint)
    done = checkpoint["iter"] + 1
    if config.ppo.max_iterations < min(done, own.ppo.max_iterations):
        raise ConfigError(
            f"ppo.max_iterations = {config.ppo.max_iterations}: the run has done {done} already"
        )
    return config, checkpoint


def _check_size(config: Config, checkpoint: Mapping[str, Any]) -> None:
    """Refuse settings that are not those of the games in a checkpoint, before these are made.

    Raises:
        ConfigError: naming what is wrong.
    """
    states = checkpoint.get("state")
    if not isinstance(states, list):  # the runner says why that is not enough
        return
    ppo = config.ppo
    try:
        trained_game(checkpoint)
        check_progress(checkpoint, len(states) * ppo.num_envs * ppo.num_steps_per_env)
    except ValueError as error:
        raise ConfigError(f"--resume: {error}") from None
    for state in states:
        if state.get("game", {}).get("t", torch.empty(0)).numel() != ppo.num_envs:
            raise ConfigError(f"--resume: ppo.num_envs = {ppo.num_envs}: the state has others")


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings in one dict with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat
