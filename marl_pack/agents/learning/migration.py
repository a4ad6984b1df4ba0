"""Migrate checkpoints that earlier versions wrote.

Format 1 had other names for planes, policies and settings, and stored the critic of afterstates in
each actor's weights. Its unfinished games cannot be resumed. Both formats may contain settings that
were removed later.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from marl_pack import renamed
from marl_pack.checks import shown

CRITIC = "afterstates."
"""Prefix of the critic's weights among the weights of an actor."""

UNRESUMABLE = (
    "an earlier version wrote it, and its games in play cannot be continued; begin a new run with "
    "--init and the settings of the old run"
)


BEFORE = {"shortcut": False, "context": False}
"""Fields that the shape of a network may lack in format 1: the first networks had neither."""


def without_removed(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return a checkpoint without the settings that were removed later.

    Raises:
        ValueError: if a removed setting has a value that is not supported any more.
    """
    current = dict(checkpoint)
    current["config"] = _without_removed(checkpoint["config"], "config")
    current["agents"] = {
        name: _record_without_removed(record, f"agents.{name}")
        for name, record in checkpoint["agents"].items()
    }
    return current


def _record_without_removed(record: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return an agent's record without removed settings, its teacher's record included."""
    current = dict(record)
    if "network" in record:
        current["network"] = _without_removed(record["network"], f"{where}.network")
    if "teacher" in record:
        current["teacher"] = _record_without_removed(record["teacher"], f"{where}.teacher")
    return current


def _without_removed(settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return settings without the removed ones, sections included."""
    current = {}
    for name, value in settings.items():
        key = f"{where}.{name}"
        removed = renamed.removed(key)
        if removed is None:
            inner = isinstance(value, Mapping)
            current[name] = _without_removed(value, key) if inner else value
        elif type(value) is not type(removed.value) or value != removed.value:
            raise ValueError(
                f"{key} = {shown(value)}: was removed; only {removed.value} can still be read: "
                f"{removed.now}"
            )
    return current


def from_format_1(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return a checkpoint of format 1 as one of format 2.

    ``state`` becomes a text that says why it cannot be resumed.
    """
    migrated = dict(checkpoint) | {"format": 2}
    migrated["config"] = _settings(checkpoint["config"])
    migrated["agents"] = {
        name: _agent(record, learns="optimizer_state_dict" in record)
        for name, record in checkpoint["agents"].items()
    }
    for record in checkpoint["agents"].values():
        critic = _critic(record.get("actor_state_dict", {}))
        if critic and "optimizer_state_dict" in record:  # the same in each agent
            migrated["afterstate_critic"] = critic
    if "afterstates" in migrated:
        migrated["afterstate_optimizer"] = migrated.pop("afterstates")
    if "state" in migrated:
        migrated["state"] = UNRESUMABLE
    return migrated


def _settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's settings with today's names."""
    settings = dict(config)
    for name in ("orientation", "placement"):
        if name not in settings:
            continue
        agent = {renamed.AGENT_KEYS.get(key, key): value for key, value in settings[name].items()}
        for key in agent.keys() & {"policy", "teacher"}:
            agent[key] = renamed.POLICIES.get(str(agent[key]), agent[key])
        if "network" in agent:
            agent["network"] = _network(agent["network"])
        settings[name] = agent
    return settings


def _network(network: Mapping[str, Any]) -> dict[str, Any]:
    """Return a network's shape with today's names of planes."""
    planes = [renamed.PLANES.get(plane, plane) for plane in network.get("planes", [])]
    return BEFORE | dict(network) | {"planes": planes}


def _critic(weights: Mapping[str, Any]) -> dict[str, Any]:
    """Return the weights of the critic of afterstates among the weights of an actor."""
    return {key.removeprefix(CRITIC): w for key, w in weights.items() if key.startswith(CRITIC)}


def _agent(record: Mapping[str, Any], learns: bool) -> dict[str, Any]:
    """Return an agent's record without the critic of afterstates among its weights."""
    agent = dict(record)
    if "name" in agent:
        agent["name"] = renamed.POLICIES.get(agent["name"], agent["name"])
    if "network" in agent:
        agent["network"] = _network(agent["network"])
    if "imitated" in agent:
        agent["teacher"] = _agent(agent.pop("imitated"), learns=False)
    weights = agent.get("actor_state_dict", {})
    critic = _critic(weights)
    if critic:
        agent["actor_state_dict"] = {k: w for k, w in weights.items() if not k.startswith(CRITIC)}
        if not learns:
            agent["afterstate_critic"] = critic
        if "optimizer_state_dict" in agent:
            actor = agent["actor_state_dict"]
            agent["optimizer_state_dict"] = _optimizer(
                agent["optimizer_state_dict"], len(actor), len(critic)
            )
    return agent


def _optimizer(state: Mapping[str, Any], first: int, count: int) -> dict[str, Any]:
    """Return an optimiser's state without ``count`` parameters from number ``first`` on.

    An optimiser numbers its parameters: first those of the actor, which ended with the critic of
    afterstates, then those of the critic.
    """

    def number(old: int) -> int:
        return old if old < first else old - count

    dropped = range(first, first + count)
    groups = [
        dict(group) | {"params": [number(p) for p in group["params"] if p not in dropped]}
        for group in state["param_groups"]
    ]
    moments = {number(p): value for p, value in state["state"].items() if p not in dropped}
    return {"state": moments, "param_groups": groups}
