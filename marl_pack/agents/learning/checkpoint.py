"""Checkpoints: files that hold their run's settings and rebuild their own policy.

A checkpoint is a dict of tensors and plain values (``torch.load(weights_only=True)`` reads it):

- ``format``: 2; ``marl_pack``: the version that wrote it;
- ``config``: the run's resolved settings;
- ``agents``: a record for each agent. A learned one has its ``network`` (fields of
  :class:`marl_pack.agents.networks.trunk.Network`) and weights as rsl_rl's ``PPO.save()`` gives
  them (``actor_state_dict``, ``critic_state_dict``, ``optimizer_state_dict``), and the record of
  its ``teacher`` while it clones one. A frozen one has its network and the actor's weights, with
  an ``afterstate_critic`` of its own if it sees values, or the ``name`` of the heuristic that plays
  it;
- ``afterstate_critic``: weights of the critic of afterstates that the run owns, if agents see its
  values, and ``afterstate_optimizer``;
- ``schedule_iteration``, ``iter``, ``items``, ``seconds``, ``evaluations``: the run's progress and
  its evaluations;
- ``state``: in a run's latest checkpoint only, what resuming needs.

Files of format 1 are migrated (:mod:`marl_pack.agents.learning.migration`).
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from marl_pack.agents.learning import migration
from marl_pack.agents.networks.planes import need_critic
from marl_pack.files import write_atomically

FORMAT = 2
LATEST, BEST = "latest.pt", "best.pt"


def write(path: Path, checkpoint: Mapping[str, Any]) -> None:
    """Write a checkpoint; if that fails, the file that was there stays."""
    write_atomically(path, lambda file: torch.save(dict(checkpoint), file))


def resolve(source: str | Path) -> Path:
    """Return the checkpoint file that ``source`` names: a file, or a run's best, else its latest.

    Raises:
        FileNotFoundError: if there is none.
    """
    path = Path(source)
    if path.is_dir():
        for name in (BEST, LATEST):
            if (path / name).is_file():
                return path / name
        raise FileNotFoundError(f"{path}: needs {BEST} or {LATEST}, as a run's folder has")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    return path


def read(source: str | Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint, from a file or a run's folder, in the format of this version.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if the file is truncated, of another program or of a newer format.
    """
    path = resolve(source)
    path.open("rb").close()  # raises the system's error if it may not be read
    if not zipfile.is_zipfile(path):
        raise ValueError(
            f"{path}: not a checkpoint, or cut short ({path.stat().st_size:,} bytes); "
            "use another of the run's files"
        )
    try:
        with zipfile.ZipFile(path) as archive:  # torch does not look at the checksums
            if archive.testzip() is not None:
                raise ValueError("damaged")
        checkpoint = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:
        first = str(error).strip().splitlines()[:1]
        raise ValueError(f"{path}: not a checkpoint that can be read ({first})") from None
    parts = ("format", "agents", "config", "iter", "items")
    if (
        not isinstance(checkpoint, dict)
        or any(part not in checkpoint for part in parts)
        or not isinstance(checkpoint["agents"], dict)
    ):
        raise ValueError(f"{path}: not a checkpoint of marl_pack.train")
    if checkpoint["format"] == 1:
        checkpoint = migration.from_format_1(checkpoint)
    if checkpoint["format"] != FORMAT:
        raise ValueError(
            f"{path}: has checkpoint format {checkpoint['format']}, this version reads up to "
            f"{FORMAT}"
        )
    return checkpoint


def agent_record(checkpoint: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return what one agent needs to play in another run: its network, or a heuristic's name.

    Args:
        checkpoint: as :func:`read` returns it.
        name: of the agent.

    Raises:
        ValueError: if there is no such agent.
    """
    agent = checkpoint["agents"].get(name)
    if agent is None:
        agents = ", ".join(checkpoint["agents"]) or "none"
        raise ValueError(f"the checkpoint has no {name} agent; it has: {agents}")
    parts = ("name", "network", "actor_state_dict", "afterstate_critic")
    record = {key: value for key, value in agent.items() if key in parts}
    if need_critic(record.get("network", {}).get("planes", ())):
        record.setdefault("afterstate_critic", checkpoint.get("afterstate_critic"))
    return record
