"""Checkpoints: files that hold their run's settings and rebuild their own policy.

A checkpoint is a dict of tensors and plain values (``torch.load(weights_only=True)`` reads it):

- ``format``: 1; ``marl_pack``: the version that wrote it;
- ``config``: the run's resolved settings;
- ``agents``: for each agent its ``network`` (fields of
  :class:`marl_pack.agents.networks.trunk.Network`) and weights as rsl_rl's ``PPO.save()`` gives
  them (``actor_state_dict``, ``critic_state_dict``, ``optimizer_state_dict``), or the ``name`` of
  the rule that plays a frozen one; while it imitates, ``imitated`` too: whom, as is kept of a
  frozen agent;
- ``iter``, ``items``, ``seconds``, ``evaluations``: how far the run was and what it had reached;
- ``state``: in a run's latest checkpoint only, what resuming needs.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from marl_pack.agents import joint
from marl_pack.agents.heuristics import (
    ORIENTATION_AGENTS,
    POLICIES,
    make_orientation_agent,
    make_placement_agent,
    make_policy,
)
from marl_pack.agents.learning.symmetry import mean_probabilities
from marl_pack.agents.networks.actor_critic import Actor, Critic, make_actor, make_critic
from marl_pack.agents.policy import (
    Choice,
    OrientationAgent,
    PlacementAgent,
    Policy,
    in_turns,
)
from marl_pack.bins import ORIENTATIONS
from marl_pack.files import write_atomically
from marl_pack.game.packing import Packing

FORMAT = 1
LATEST, BEST = "latest.pt", "best.pt"


def write(path: Path, checkpoint: Mapping[str, Any]) -> None:
    """Write a checkpoint, so that the file is whole or the one before."""
    write_atomically(path, lambda file: torch.save(dict(checkpoint), file))


def resolve(source: str | Path) -> Path:
    """The checkpoint file that ``source`` names: a file, or a run's best, else its latest.

    Raises:
        FileNotFoundError: if there is none.
    """
    path = Path(source)
    if path.is_dir():
        for name in (BEST, LATEST):
            if (path / name).is_file():
                return path / name
        raise FileNotFoundError(f"{path}: holds neither {BEST} nor {LATEST}; is it a run's folder?")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    return path


def read(source: str | Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint, from a file or a run's folder.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if the file is truncated, of another program or of a newer format.
    """
    path = resolve(source)
    path.open("rb").close()  # where it may not be read, that is what to say
    if not zipfile.is_zipfile(path):
        raise ValueError(
            f"{path}: not a checkpoint, or cut short ({path.stat().st_size:,} bytes); "
            "use another of the run's files"
        )
    try:
        with zipfile.ZipFile(path) as archive:  # torch does not look at the checksums
            if archive.testzip() is not None:
                raise ValueError("damaged")
        found = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:
        first = str(error).strip().splitlines()[:1]
        raise ValueError(f"{path}: not a checkpoint that can be read ({first})") from None
    parts = ("format", "agents", "config", "iter", "items")
    if (
        not isinstance(found, dict)
        or any(part not in found for part in parts)
        or not isinstance(found["agents"], dict)
    ):
        raise ValueError(f"{path}: not a checkpoint of marl_pack.train")
    if found["format"] != FORMAT:
        raise ValueError(
            f"{path}: has checkpoint format {found['format']}, this version reads {FORMAT}"
        )
    return found


def load_actor(found: Mapping[str, Any], name: str, device: torch.device | str) -> Actor:
    """The network of one agent.

    Args:
        found: what :func:`read` gave.
        name: ``orientation``, ``placement`` or ``joint``.
        device: where it shall play.

    Raises:
        ValueError: if the checkpoint has no such agent, or its weights do not fit its network.
    """
    agent = found["agents"].get(name)
    if agent is None or "network" not in agent:
        has = ", ".join(k for k, v in found["agents"].items() if "network" in v) or "none"
        raise ValueError(f"the checkpoint has no learned {name} agent; it has: {has}")
    try:
        with torch.random.fork_rng(devices=[]):  # fresh weights draw numbers that a run needs
            actor = make_actor(name, agent["network"], device)
        actor.load_state_dict(agent["actor_state_dict"])
    except (RuntimeError, TypeError, KeyError) as error:
        raise ValueError(f"the {name} agent's weights do not fit its network: {error}") from None
    return actor.eval()


def load_critic(
    found: Mapping[str, Any], name: str, device: torch.device | str, actor: Actor
) -> Critic:
    """The critic of one agent, beside its ``actor``. Else as :func:`load_actor`."""
    agent = found["agents"][name]
    try:
        with torch.random.fork_rng(devices=[]):
            critic = make_critic(name, agent["network"], device, actor)
        critic.load_state_dict(agent["critic_state_dict"])
    except (RuntimeError, KeyError) as error:
        raise ValueError(f"the {name} agent has no critic that fits: {error}") from None
    return critic.eval()


def _best(actor: Actor, agent: str, seen: Mapping[str, Tensor], symmetric: bool) -> Tensor:
    """The most probable action, int64 [N]."""
    with torch.inference_mode():
        if symmetric:
            return mean_probabilities(actor, seen, agent).argmax(1)
        return actor(seen).squeeze(1).long()


def learned_orientation_agent(actor: Actor, symmetric: bool = False) -> OrientationAgent:
    """A network as the first agent; takes the most probable orientation.

    Args:
        actor: the network.
        symmetric: whether it is asked in all symmetries of the bin
            (:func:`marl_pack.agents.learning.symmetry.mean_probabilities`).
    """
    return lambda game: _best(actor, "orientation", actor.see(game), symmetric)


def learned_placement_agent(actor: Actor, symmetric: bool = False) -> PlacementAgent:
    """A network as the second agent; takes the most probable cell. Arguments as above."""
    return lambda game, chosen: _best(actor, "placement", actor.see(game, chosen), symmetric)


def learned_joint_policy(actor: Actor, symmetric: bool = False) -> Policy:
    """The joint agent's network; takes the most probable pair. Arguments as above."""

    def play(game: Packing) -> Choice:
        cells = game.size[0] * game.size[1]
        return joint.split(_best(actor, "joint", actor.see(game), symmetric), cells)

    return play


def load_policy(
    found: Mapping[str, Any],
    device: torch.device | str = "cpu",
    seed: int | None = 0,
    symmetric: bool = False,
) -> Policy:
    """The whole policy of a checkpoint, frozen agents included.

    Args:
        found: what :func:`read` gave.
        device: of the games.
        seed: of a frozen agent that plays at random; None draws from torch's global generator.
        symmetric: whether learned agents are asked in all symmetries of the bin.
    """
    how = device, seed, symmetric
    if "joint" in found["agents"]:
        return learned_joint_policy(load_actor(found, "joint", device), symmetric)
    return in_turns(orientation_agent(found, *how), placement_agent(found, *how))


def orientation_agent(
    found: Mapping[str, Any],
    device: torch.device | str,
    seed: int | None = 0,
    symmetric: bool = False,
) -> OrientationAgent:
    """The first agent of a checkpoint (of its ``agents`` alone, too). Arguments as above."""
    if "joint" in found["agents"]:
        policy = learned_joint_policy(load_actor(found, "joint", device), symmetric)
        return lambda game: policy(game)[0]
    rule = found["agents"].get("orientation", {}).get("name")
    if rule is not None:
        return make_orientation_agent(rule, seed, device)
    return learned_orientation_agent(load_actor(found, "orientation", device), symmetric)


def placement_agent(
    found: Mapping[str, Any],
    device: torch.device | str,
    seed: int | None = 0,
    symmetric: bool = False,
) -> PlacementAgent:
    """The second agent of a checkpoint (of its ``agents`` alone, too). Arguments as above."""
    rule = found["agents"].get("placement", {}).get("name")
    if rule is not None:
        return make_placement_agent(rule, seed, device)
    return learned_placement_agent(load_actor(found, "placement", device), symmetric)


def find_policy(
    source: str,
    device: torch.device | str = "cpu",
    seed: int | None = 0,
    symmetric: bool = False,
) -> Policy:
    """The policy that ``source`` names: one of :data:`POLICIES`, a run's folder or a checkpoint.

    Raises:
        ValueError, FileNotFoundError: if it is none of these.
    """
    if source in POLICIES:
        return make_policy(source, seed, device)
    return load_policy(read(_path(source, POLICIES), device), device, seed, symmetric)


def find_orientation_agent(
    source: str,
    device: torch.device | str = "cpu",
    seed: int | None = 0,
    symmetric: bool = False,
) -> OrientationAgent:
    """The first agent: one of :data:`ORIENTATION_AGENTS`, or a checkpoint's."""
    if source in ORIENTATION_AGENTS:
        return make_orientation_agent(source, seed, device)
    found = read(_path(source, ORIENTATION_AGENTS), device)
    return orientation_agent(found, device, seed, symmetric)


def find_placement_agent(
    source: str,
    device: torch.device | str = "cpu",
    seed: int | None = 0,
    symmetric: bool = False,
) -> PlacementAgent:
    """The second agent: one of :data:`POLICIES`, or a checkpoint's."""
    if source in POLICIES:
        return make_placement_agent(source, seed, device)
    return placement_agent(read(_path(source, POLICIES), device), device, seed, symmetric)


def trained_on(found: Mapping[str, Any]) -> str:
    """The game that a checkpoint's agents learned, and how long, in words.

    Args:
        found: what :func:`read` gave.
    """
    game = found["config"]["game"]
    size = " x ".join(map(str, game["bin"]))
    sides = "" if "." in game["items"] else f" {game['sides'][0]}-{game['sides'][1]}"
    rule = game["rule"]
    if game["margin"] is not None:
        rule += f" (margin {game['margin']:g})"
    if game["thresholds"] is not None:
        rule += f" (thresholds {game['thresholds']})"
    if len(game["orientations"]) < len(ORIENTATIONS):
        rule += f", orientations {' '.join(map(str, game['orientations']))}"
    if not game["mask_orientations"]:
        rule += ", no mask of orientations"
    if any(game["com_offset"]):
        rule += f", centre of mass off by {' '.join(f'{o:g}' for o in game['com_offset'])}"
    return (
        f"{game['items']}{sides}, bin {size}, rule {rule}, "
        f"{found['items']:,} items, seed {found['config']['seed']}"
    )


def frozen_agent(source: str, name: str) -> dict[str, Any]:
    """What a checkpoint keeps of a frozen agent: its rule's name, or its network and weights.

    Args:
        source: a rule's name, a run's folder or a checkpoint.
        name: ``orientation`` or ``placement``.

    Raises:
        ValueError, FileNotFoundError: if it is none of these.
    """
    rules = ORIENTATION_AGENTS if name == "orientation" else POLICIES
    if source in rules:
        return {"name": source}
    found = read(_path(source, rules))
    agent = found["agents"].get(name)
    if agent is None:
        raise ValueError(f"{source}: has no {name} agent; it has: {', '.join(found['agents'])}")
    kept = ("name", "network", "actor_state_dict")
    return {key: value for key, value in agent.items() if key in kept}


def _path(source: str, names: tuple[str, ...]) -> Path:
    """``source`` as a path.

    Raises:
        FileNotFoundError: if there is nothing there, naming what else it could be.
    """
    if not Path(source).exists():
        raise FileNotFoundError(
            f"{source!r} is neither one of {', '.join(names)} nor a checkpoint or a run's folder"
        )
    return Path(source)
