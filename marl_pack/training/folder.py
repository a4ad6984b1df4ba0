"""The folder of a training run: its files, and resuming a run from it."""

from __future__ import annotations

import contextlib
import csv
import datetime
import io
import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
import yaml
from filelock import FileLock, Timeout

import marl_pack
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.learning.resuming import check_progress
from marl_pack.agents.loading import trained_game
from marl_pack.config import Config, ConfigError, from_dict, parse
from marl_pack.files import PART, remove_unfinished, write_atomically, write_json

PACKAGES = ("torch", "rsl-rl-lib", "tensordict", "numpy", "numba", "scipy", "pettingzoo")
SETTINGS, RECORD, LOCK = "config.yaml", "run.json", ".lock"
BEFORE_THE_RUN = {SETTINGS, RECORD, LOCK}  # files that a run writes before its first checkpoint
MAY_CHANGE = ("output.", "evaluation.", "ppo.max_iterations")  # settings that --resume may change


def write_history(path: Path, history: Sequence[Mapping[str, Any]]) -> None:
    """Write the history of evaluations as CSV."""
    text = io.StringIO()
    # In a run of an earlier version, the first rows may have other columns: leave these out.
    writer = csv.DictWriter(text, list(history[-1]), extrasaction="ignore")
    writer.writeheader()
    writer.writerows(history)
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))


def write_record(folder: Path, config: Config, arguments: Sequence[str]) -> None:
    """Write the settings, the command and the packages' versions into the run's folder.

    If the run is resumed, the new record is added to the record in the folder.
    """
    text = yaml.safe_dump(config.to_dict(), sort_keys=False)
    write_atomically(folder / SETTINGS, lambda file: file.write(text.encode()))
    versions = {"python": platform.python_version(), "marl_pack": marl_pack.__version__}
    versions |= {name: metadata.version(name) for name in PACKAGES}
    first_record = read_record(folder)
    record: dict[str, Any] = {
        "arguments": list(arguments),
        "seed": config.seed,
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "processes": int(os.environ.get("WORLD_SIZE", "1")),
        "versions": versions,
    }
    if first_record is not None:  # the run is resumed: keep its first record
        first_record.setdefault("resumed", []).append(record)
        record = first_record
    write_json(folder / RECORD, record)


def read_record(folder: Path) -> dict[str, Any] | None:
    """Read the record of a run; return None if there is no file.

    Raises:
        ConfigError: if the file is not the record of a run.
    """
    path = folder / RECORD
    if not path.exists():
        return None
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        json.dumps(record, allow_nan=False)  # refuse NaN, which could not be written again
        if isinstance(record["arguments"], list) and isinstance(record.get("resumed", []), list):
            return dict(record)
    except (ValueError, TypeError, KeyError, RecursionError):
        pass
    raise ConfigError(
        f"{path}: not the record of a run; move it away; resuming needs only {checkpoints.LATEST}"
    )


def _check_free(folder: Path) -> None:
    """Refuse a folder with files other than those that a run writes before its first checkpoint.

    Raises:
        ConfigError: if the folder has other files; the message says what to do.
    """
    if (folder / checkpoints.LATEST).exists():
        raise ConfigError(
            f"output.name: {folder} contains a run; continue it with --resume "
            f"{folder}, or choose another output.name"
        )
    if folder.exists() and (not folder.is_dir() or _has_other_files(folder)):
        raise ConfigError(f"output.name: {folder} exists already; choose another name")


def _has_other_files(folder: Path) -> bool:
    """Return whether a folder has files that no run writes before its first checkpoint."""
    names = (path.name for path in folder.iterdir())
    return any(name not in BEFORE_THE_RUN and not name.startswith(PART) for name in names)


@contextlib.contextmanager
def _claimed(folder: Path) -> Iterator[None]:
    """Keep other processes from training in a folder.

    At the end, the folder is removed if no settings were written there.

    Raises:
        ConfigError: if another process already trains there.
    """
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise ConfigError(f"{folder}: another process trains this run; wait for its end") from None
    try:
        remove_unfinished(folder)
        yield
    finally:
        with contextlib.suppress(OSError):  # the folder is gone, or contains other files
            if not (folder / SETTINGS).exists():
                (folder / LOCK).unlink()
                folder.rmdir()
        lock.release()


@contextlib.contextmanager
def new_run(config: Config) -> Iterator[Path]:
    """Make and yield the folder of a new run; other processes cannot use it until the block ends.

    The folder of a run that was killed before its first checkpoint may be used again.

    Raises:
        ConfigError: if the folder contains something else or cannot be made.
    """
    name = config.output.name
    if name is None:
        name = f"{datetime.datetime.now():%Y-%m-%d_%H-%M-%S}_seed{config.seed}"
    folder = Path(config.output.folder) / name
    _check_free(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"output.folder: {error}") from None
    with _claimed(folder):
        _check_free(folder)  # another process may have trained there meanwhile
        for file in (SETTINGS, RECORD):
            (folder / file).unlink(missing_ok=True)
        yield folder


@contextlib.contextmanager
def run_to_resume(run: str) -> Iterator[Path]:
    """Yield the folder of a run to resume; other processes cannot use it until the block ends.

    Args:
        run: the run's folder, or its checkpoint.

    Raises:
        ConfigError: if there is no run to resume.
    """
    path = Path(run)
    if not path.is_dir() and not path.is_file():
        raise ConfigError(f"{run}: no such folder or checkpoint")
    folder = path if path.is_dir() else path.parent
    if path == folder and not (path / checkpoints.LATEST).exists():
        if _has_other_files(folder):
            raise ConfigError(f"{run}: not the folder of a run: it has no {checkpoints.LATEST}")
        if not (folder / SETTINGS).exists():
            raise ConfigError(f"{run}: no run has begun there; begin one without --resume")
    with _claimed(folder):
        yield folder


def settings_to_resume(run: str, arguments: Sequence[str]) -> tuple[Config, dict[str, Any] | None]:
    """Return the settings and the latest checkpoint of a run to resume.

    A run that was killed before its first checkpoint has no checkpoint: it begins again.

    Args:
        run: the run's folder, or its checkpoint.
        arguments: the words of the command line without --resume.

    Raises:
        ConfigError, FileNotFoundError: if the run cannot be resumed with these arguments.
    """
    path, checkpoint = Path(run), None
    if path.is_dir():
        read_record(path)
        path = path / checkpoints.LATEST
    if path.exists():
        try:
            checkpoint = checkpoints.read(path)
        except ValueError as error:
            raise ConfigError(str(error)) from None
        settings = from_dict(checkpoint["config"])
    else:
        settings, _ = parse([f"--config={path.with_name(SETTINGS)}"])
    config, options = parse(["--config", yaml.safe_dump(settings.to_dict()), *arguments])
    if len(options.config or []) > 1:
        raise ConfigError("--config: not allowed with --resume, which uses the settings of the run")
    stored = settings.flat()
    for key, value in config.flat().items():
        if value != stored[key] and not key.startswith(MAY_CHANGE):
            raise ConfigError(
                f"--resume: the run has {key} = {stored[key]}, not {value}; with --resume only "
                "output.*, evaluation.* and ppo.max_iterations may change"
            )
    done = 0
    if checkpoint is not None:
        _check_size(settings, checkpoint)
        done = checkpoint["iter"] + 1
    if config.ppo.max_iterations < min(done, settings.ppo.max_iterations):
        raise ConfigError(
            f"ppo.max_iterations = {config.ppo.max_iterations}: the run has already finished "
            f"{done} iterations"
        )
    return config, checkpoint


def _check_size(config: Config, checkpoint: Mapping[str, Any]) -> None:
    """Refuse settings that do not match the games in a checkpoint, before games are made.

    Raises:
        ConfigError: if they do not match; the message names the setting.
    """
    states = checkpoint.get("state")
    if not isinstance(states, list):  # the runner refuses this checkpoint and says why
        return
    ppo = config.ppo
    try:
        trained_game(checkpoint)
        check_progress(checkpoint, len(states) * ppo.num_envs * ppo.num_steps_per_env)
    except ValueError as error:
        raise ConfigError(f"--resume: {error}") from None
    for state in states:
        games = state.get("game", {}).get("t", torch.empty(0)).numel()
        if games != ppo.num_envs:
            raise ConfigError(
                f"--resume: ppo.num_envs = {ppo.num_envs}, but the checkpoint has {games} games"
            )
