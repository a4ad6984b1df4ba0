"""Checkpoints: files with the settings of a run and the networks of its agents.

A checkpoint is a dict of tensors and plain values (``torch.load(weights_only=True)`` reads it):

- ``format``: 2; ``marl_pack``: the version that wrote it;
- ``config``: the run's resolved settings;
- ``agents``: a record for each agent. A learned one has its ``network`` (fields of
  :class:`marl_pack.agents.networks.shape.Network`) and weights as rsl_rl's ``PPO.save()`` gives
  them (``actor_state_dict``, ``critic_state_dict``, ``optimizer_state_dict``), and the record of
  its ``teacher`` while it clones one. A frozen one has its network and the actor's weights, with
  an ``afterstate_critic`` of its own if it observes values, or the ``name`` of the heuristic that
  plays it;
- ``afterstate_critic`` and ``afterstate_optimizer``: weights of the run's critic of afterstates and
  the state of its optimiser, if agents observe its values;
- ``schedule_iteration``, ``iter``, ``items``, ``seconds``, ``evaluations``: the run's progress and
  its evaluations;
- ``state``: all else that resuming needs; only in a run's latest checkpoint.

A published checkpoint has only the parts that :func:`without_training` keeps.

Files of earlier versions are migrated (:mod:`marl_pack.agents.learning.migration`).
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from marl_pack.agents.afterstates.lookahead import value_share_at
from marl_pack.agents.keys import (
    GREEDY_VALUE,
    ORIENTATION_AGENTS,
    POLICIES,
    SELECTION_AGENTS,
)
from marl_pack.agents.learning import migration
from marl_pack.agents.learning.form import (
    Plain,
    check_alike,
    check_form,
    check_no_tensors,
)
from marl_pack.agents.networks.actor_critic import make_actor, make_critic, shape_of
from marl_pack.agents.networks.kinds import AGENT_NAMES, ORIENTATION, PLACEMENT, SELECTION
from marl_pack.agents.networks.planes import need_critic
from marl_pack.agents.networks.shape import Network, SelectionNetwork
from marl_pack.agents.sources import BEST as BEST
from marl_pack.agents.sources import LATEST as LATEST
from marl_pack.agents.sources import resolve as resolve
from marl_pack.checks import described, shown, whole_number
from marl_pack.files import write_atomically

FORMAT = 2
MOST_SHARED = 4
"""How often a checkpoint may contain the same tensor, on average."""

HEURISTICS = {
    SELECTION: SELECTION_AGENTS, ORIENTATION: ORIENTATION_AGENTS, PLACEMENT: POLICIES,
}  # fmt: skip
"""Heuristics that can play an agent, by the agent's name."""

NOTHING = type(None)
_WEIGHTS = {str: Tensor}
_NETWORK = {"planes": [str]}
_OPTIMIZER = {"state": {int: {str: (Tensor, NOTHING)}}, "param_groups": [{"params": [int]}]}
_AGENT: dict[str, Any] = {
    "name": str, "network": _NETWORK, "actor_state_dict": _WEIGHTS, "critic_state_dict": _WEIGHTS,
    "optimizer_state_dict": _OPTIMIZER, "afterstate_critic": _WEIGHTS, "value_share": float,
}  # fmt: skip
_AGENT |= {"teacher": _AGENT, "imitated": _AGENT}
_SETTINGS = dict.fromkeys(("policy", "teacher", "imitate"), (str, NOTHING)) | {"network": _NETWORK}
FORM = {
    "marl_pack": str,
    "config": {
        "seed": int,
        "game": {"bin": [int, int, int], "items": str, "sides": [int, int]},
        "ppo": {"gamma": float, "afterstate_ramp": [int, int]},
        "selection": _SETTINGS, "orientation": _SETTINGS, "placement": _SETTINGS,
    },
    "agents": dict.fromkeys(AGENT_NAMES, _AGENT),
    "afterstate_critic": _WEIGHTS, "afterstate_optimizer": _OPTIMIZER, "afterstates": _OPTIMIZER,
    "iter": int, "items": int, "seconds": float, "schedule_iteration": int,
    "evaluations": [{str: (float, NOTHING)}],
    "state": [{
        "game": _WEIGHTS, "random": _WEIGHTS, "afterstates": {"rollouts": int},
        "logger": {"tot_timesteps": int, "tot_time": float},
    }],
}  # fmt: skip
"""The form of a checkpoint in all formats (:func:`marl_pack.agents.learning.form.check_form`).

The classes of settings and networks check the values of their fields.
"""


def write(path: Path, checkpoint: Mapping[str, Any]) -> None:
    """Write a checkpoint; if writing fails, an earlier file stays as it was."""
    write_atomically(path, lambda file: torch.save(dict(checkpoint), file))


def read(source: str | Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint in the format of this version.

    Args:
        source: as for :func:`resolve`.
        device: the device of its tensors.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is truncated, of another program or of a newer format, or a value in
            it does not have the form of a checkpoint (:data:`FORM`).
    """
    path = resolve(source)
    path.open("rb").close()  # raises the system's error if it cannot be read
    if not zipfile.is_zipfile(path):
        raise ValueError(
            f"{path}: not a checkpoint, or cut short ({path.stat().st_size:,} bytes); "
            "use another file of the run"
        )
    unreadable = f"{path}: not a checkpoint that can be read"
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            # torch compresses nothing, so a file's members are not larger than the file.
            compressed = any(member.compress_type != zipfile.ZIP_STORED for member in members)
            if compressed or sum(member.file_size for member in members) > path.stat().st_size:
                raise ValueError(f"{unreadable}: its members are larger than the file")
            if archive.testzip() is not None:  # torch does not look at the checksums
                raise ValueError(f"{unreadable}: damaged")
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError):
        raise ValueError(f"{unreadable}: damaged") from None
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except Exception:  # many types; their messages advise to trust the file
        raise ValueError(f"{unreadable}: holds more than tensors and plain values") from None
    try:
        return _checked(content, path.stat().st_size)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _checked(content: Any, size: int) -> dict[str, Any]:
    """Return the content of a file of ``size`` bytes as a checkpoint of this version's format.

    Raises:
        ValueError: if it is not a checkpoint.
    """
    parts = ("format", "agents", "config", "iter", "items")
    if not isinstance(content, Mapping) or any(part not in content for part in parts):
        raise ValueError("not a checkpoint of marl_pack.train")
    if type(content["format"]) is not int or not 1 <= content["format"] <= FORMAT:
        raise ValueError(
            f"has checkpoint format {shown(content['format'])}, this version reads up to {FORMAT}"
        )
    checkpoint: dict[str, Any] = Plain(MOST_SHARED * size).copy(content)
    unresumable = isinstance(checkpoint.get("state"), str)  # the reason why
    check_form({k: v for k, v in checkpoint.items() if k != "state" or not unresumable}, FORM, "")
    check_no_tensors(checkpoint["config"], "config")
    for key, low in (("iter", -1), ("items", 0)):
        whole_number(checkpoint[key], key, low)
    unknown = [name for name in checkpoint["agents"] if name not in AGENT_NAMES]
    if unknown:
        raise ValueError(f"agents: {shown(unknown[0])} is none of {', '.join(AGENT_NAMES)}")
    if checkpoint["format"] == 1:
        checkpoint = migration.from_format_1(checkpoint)
    checkpoint = migration.without_removed(checkpoint)
    for name, agent in checkpoint["agents"].items():
        _check_player(agent, name, f"agents.{name}")
        if "teacher" in agent:
            _check_player(agent["teacher"], name, f"agents.{name}.teacher")
    return checkpoint


def _check_player(record: Mapping[str, Any], agent: str, where: str) -> None:
    """Refuse the record of an agent that has neither a heuristic's name nor a network."""
    if "name" in record:
        names = HEURISTICS.get(agent, ())
        by_value = agent == SELECTION and record["name"] == GREEDY_VALUE
        if by_value and "afterstate_critic" not in record:
            raise ValueError(f"{where}.afterstate_critic is missing")
        if record["name"] not in names and not by_value:
            raise ValueError(f"{where}.name: {shown(record['name'])} is none of {', '.join(names)}")
        return
    for part in ("network", "actor_state_dict"):
        if part not in record:
            raise ValueError(f"{where}.{part} is missing")


def without_training(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return a checkpoint to be published: without the parts that only resuming needs.

    It can still play, search, be exported and begin other runs (``--init``). The section ``output``
    of its settings is left out too, because it names folders of the run.
    """
    fields = ("format", "marl_pack", "config", "afterstate_critic", "iter", "items", "seconds")
    parts = ("name", "network", "actor_state_dict", "critic_state_dict", "afterstate_critic",
             "value_share")  # fmt: skip
    agents = {
        name: {part: agent[part] for part in parts if part in agent}
        for name, agent in checkpoint["agents"].items()
    }
    settings = {key: value for key, value in checkpoint["config"].items() if key != "output"}
    slim = {field: checkpoint[field] for field in fields if field in checkpoint}
    return slim | {"config": settings, "agents": agents}


def agent_of(checkpoint: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the record of one agent of a checkpoint.

    Raises:
        ValueError: if there is no such agent.
    """
    agent: dict[str, Any] | None = checkpoint["agents"].get(name)
    if agent is None:
        agents = ", ".join(checkpoint["agents"]) or "none"
        raise ValueError(f"the checkpoint has no {name} agent; it has: {agents}")
    return agent


def agent_record(checkpoint: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the record that one agent needs to play: its network, or a heuristic's name.

    Args:
        checkpoint: as :func:`read` returns it.
        name: the agent's name.

    Raises:
        ValueError: if there is no such agent, or the critic whose values it observes is missing.
    """
    agent = agent_of(checkpoint, name)
    parts = ("name", "network", "actor_state_dict", "afterstate_critic", "value_share")
    record = {key: value for key, value in agent.items() if key in parts}
    network = record.get("network", {})
    sees_values = need_critic(network.get("planes", ())) or (name == SELECTION and network)
    if sees_values and "afterstate_critic" not in record:
        record |= critic_record(checkpoint, name)
    return record


def critic_record(checkpoint: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the critic of afterstates of a checkpoint, as it stands in the record of an agent.

    Args:
        checkpoint: as :func:`read` returns it.
        name: the agent's name, for messages.

    Raises:
        ValueError: if there is none.
    """
    if "afterstate_critic" not in checkpoint:
        raise ValueError(f"the {name} agent observes values: afterstate_critic is missing")
    share = value_share(checkpoint)
    return {"afterstate_critic": checkpoint["afterstate_critic"], "value_share": share}


def value_share(checkpoint: Mapping[str, Any]) -> float:
    """Return the share of the values of afterstates that the agents observed last in training."""
    ramp = checkpoint["config"].get("ppo", {}).get("afterstate_ramp", (0, 0))
    done = checkpoint.get("schedule_iteration", checkpoint["iter"] + 1)  # published without it
    return value_share_at(ramp, done)


def check_weights(record: Mapping[str, Any], name: str) -> Network | SelectionNetwork:
    """Return the shape of an agent's network; refuse weights that do not fit it.

    The check takes no memory for the network, because a damaged file may give it any shape.

    Args:
        record: the record of a learned agent, with or without the states of critic and optimiser.
        name: the agent's name.

    Raises:
        ValueError: the message names the first tensor that is missing, unknown or of another shape
            or type.
    """
    try:
        network = shape_of(name, record["network"])
        weights = record["actor_state_dict"]
        if isinstance(network, Network) and network.layers > len(weights):
            raise ValueError(f"{network.layers} layers need more than {len(weights)} tensors")
        with torch.device("meta"):
            actor = make_actor(name, record["network"], "meta")
            check_alike(weights, actor.state_dict(), "actor_state_dict")
            if "critic_state_dict" in record:
                critic = make_critic(name, record["network"], "meta", actor)
                check_alike(record["critic_state_dict"], critic.state_dict(), "critic_state_dict")
                parameters = [*actor.parameters(), *critic.parameters()]
                _check_moments(record.get("optimizer_state_dict", {}), parameters)
    except KeyError as error:
        raise ValueError(f"the {name} agent: {error.args[0]} is missing") from None
    except (ValueError, TypeError, RuntimeError) as error:
        raise ValueError(f"the {name} agent's weights do not match its network: {error}") from None
    return network


def _check_moments(state: Mapping[str, Any], parameters: Sequence[Tensor]) -> None:
    """Refuse an optimiser's state that does not match the parameters, numbered in order."""
    for k, values in state.get("state", {}).items():
        for key, value in values.items():
            shape = parameters[k].shape if k in range(len(parameters)) else "none"
            if isinstance(value, Tensor) and value.dim() and value.shape != shape:
                where = f"optimizer_state_dict.state.{k}.{key}"
                raise ValueError(f"{where}: is {described(value)}, its weight is {shape}")
