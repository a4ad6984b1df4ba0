"""Load agents and policies by name, from runs' folders and from checkpoints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from marl_pack import renamed
from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.afterstates.lookahead import Lookahead, Memo
from marl_pack.agents.heuristics import (
    ORIENTATION_AGENTS,
    POLICIES,
    make_orientation_agent,
    make_placement_agent,
    make_policy,
)
from marl_pack.agents.learned import LearnedAgent
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.networks.actor_critic import Actor, Critic, make_actor, make_critic
from marl_pack.agents.networks.kinds import JOINT, ORIENTATION, PLACEMENT
from marl_pack.agents.policy import (
    OrientationAgent,
    PlacementAgent,
    Policy,
    in_turns,
)
from marl_pack.agents.search import Planner, SearchSettings
from marl_pack.game.spec import GameSpec
from marl_pack.items import Stream

NAMES = {ORIENTATION: ORIENTATION_AGENTS, PLACEMENT: POLICIES}
"""Heuristics that can play an agent, by the agent's name."""


class Loader:
    """A loader of agents that play together and share what is computed once a turn.

    Args:
        device: of the games.
        seed: of agents that play at random; None draws from torch's global generator.
        symmetric: whether learned agents are asked in all symmetries of the bin.
        memo: stores what is computed once a turn.
    """

    def __init__(
        self,
        device: torch.device | str = "cpu",
        seed: int | None = 0,
        symmetric: bool = False,
        memo: Memo | None = None,
    ) -> None:
        self.device, self.seed, self.symmetric = device, seed, symmetric
        self.memo = memo or Memo()
        self._lookaheads: list[tuple[Mapping[str, Tensor] | None, Lookahead]] = []

    # --- by name or path --------------------------------------------------------------------------

    def policy(self, source: str) -> Policy:
        """Return the policy that ``source`` names.

        Args:
            source: one of :data:`marl_pack.agents.heuristics.POLICIES`, a run's folder or a
                checkpoint.

        Raises:
            ValueError, FileNotFoundError: if it is none of these.
        """
        if source in POLICIES:
            return make_policy(source, self.seed, self.device)
        return self.policy_of(checkpoints.read(_path(source, POLICIES), self.device))

    def orientation_agent(self, source: str) -> OrientationAgent:
        """Return the orientation agent that ``source`` names; of a joint agent its orientations.

        Raises:
            ValueError, FileNotFoundError: if there is no such agent.
        """
        if source not in ORIENTATION_AGENTS:
            checkpoint = checkpoints.read(_path(source, ORIENTATION_AGENTS), self.device)
            if JOINT in checkpoint["agents"]:
                policy = self.policy_of(checkpoint)
                return lambda game: policy(game)[0]
        return self.orientation_agent_of(record_of(source, ORIENTATION))

    def placement_agent(self, source: str) -> PlacementAgent:
        """Return the placement agent that ``source`` names.

        Raises:
            ValueError, FileNotFoundError: if there is no such agent.
        """
        return self.placement_agent_of(record_of(source, PLACEMENT))

    # --- from records and checkpoints -------------------------------------------------------------

    def policy_of(self, checkpoint: Mapping[str, Any]) -> Policy:
        """Return the whole policy of a checkpoint, frozen agents included."""
        if JOINT in checkpoint["agents"]:
            agent = self.learned(checkpoints.agent_record(checkpoint, JOINT), JOINT)
            return lambda game: game.floor.split(agent(game))
        return in_turns(
            self.orientation_agent_of(checkpoints.agent_record(checkpoint, ORIENTATION)),
            self.placement_agent_of(checkpoints.agent_record(checkpoint, PLACEMENT)),
        )

    def orientation_agent_of(self, record: Mapping[str, Any]) -> OrientationAgent:
        """Return the orientation agent of a record."""
        if "name" in record:
            lookahead = self._lookahead(record)
            return make_orientation_agent(record["name"], self.seed, self.device, lookahead)
        return self.learned(record, ORIENTATION)

    def placement_agent_of(self, record: Mapping[str, Any]) -> PlacementAgent:
        """Return the placement agent of a record."""
        if "name" in record:
            lookahead = self._lookahead(record)
            return make_placement_agent(record["name"], self.seed, self.device, lookahead)
        return self.learned(record, PLACEMENT)

    def agent_of(self, record: Mapping[str, Any], name: str) -> Callable[..., Tensor]:
        """Return the orientation or placement agent of a record, by the agent's name."""
        makers: dict[str, Callable[[Mapping[str, Any]], Callable[..., Tensor]]] = {
            ORIENTATION: self.orientation_agent_of,
            PLACEMENT: self.placement_agent_of,
        }
        return makers[name](record)

    def learned(self, record: Mapping[str, Any], kind: str) -> LearnedAgent:
        """Return the learned agent of a record.

        Raises:
            ValueError: if the agent has no network, or its weights do not match it.
        """
        actor = load_actor(record, kind, self.device)
        return LearnedAgent(kind, actor, self._lookahead(record), self.symmetric)

    def _lookahead(self, record: Mapping[str, Any]) -> Lookahead:
        """Return the lookahead of an agent: agents with the same critic of afterstates share it."""
        weights = record.get("afterstate_critic")
        for own, lookahead in self._lookaheads:
            if own is weights:
                return lookahead
        lookahead = Lookahead(load_afterstate_critic(record, self.device), self.memo)
        self._lookaheads.append((weights, lookahead))
        return lookahead

    def planner(
        self, checkpoint: Mapping[str, Any], settings: SearchSettings, futures: Stream
    ) -> Planner:
        """Return a policy that searches with the agents of a checkpoint.

        Args:
            checkpoint: of a run.
            settings: how far to search.
            futures: the stream from which future items are drawn.

        Raises:
            ValueError: unless both agents are learned, and their critic can value a depth if asked.
        """
        first, second = (
            self.learned(checkpoints.agent_record(checkpoint, name), name)
            for name in (ORIENTATION, PLACEMENT)
        )
        critic = None
        if settings.depth is not None:
            config = checkpoint["config"]
            alpha, gamma = config["game"]["alpha"], config["ppo"]["gamma"]
            if (alpha, gamma) != (1, 1):
                raise ValueError(
                    f"plan: a depth needs agents trained with game.alpha = 1 and ppo.gamma = 1, "
                    f"whose critic estimates shares of the bin, not {alpha:g} and {gamma:g}"
                )
            critic = load_critic(checkpoint, ORIENTATION, self.device, first.actor)
        return Planner(first, second, critic, settings, futures, self.seed or 0)


def load_actor(record: Mapping[str, Any], kind: str, device: torch.device | str) -> Actor:
    """Return the network of a learned agent.

    Args:
        record: of the agent (:mod:`marl_pack.agents.learning.checkpoint`).
        kind: name in :data:`marl_pack.agents.networks.kinds.AGENT_KINDS`.
        device: of the games.

    Raises:
        ValueError: if the agent has no network, or its weights do not match it.
    """
    if "network" not in record:
        raise ValueError(f"the {kind} agent is played by {record.get('name')}: it has no network")
    try:
        with torch.random.fork_rng(devices=[]):  # a run's random numbers must stay
            actor = make_actor(kind, record["network"], device)
        actor.load_state_dict(record["actor_state_dict"])
    except (RuntimeError, TypeError, KeyError) as error:
        raise ValueError(f"the {kind} agent's weights do not match its network: {error}") from None
    return actor.eval()


def load_critic(
    checkpoint: Mapping[str, Any], kind: str, device: torch.device | str, actor: Actor
) -> Critic:
    """Return the critic of one agent of a run.

    Args:
        checkpoint: of the run.
        kind, device: as for :func:`load_actor`.
        actor: the agent's, whose trunk the critic may share.

    Raises:
        ValueError: if the agent has no critic, or its weights do not match its network.
    """
    agent = checkpoint["agents"][kind]
    try:
        with torch.random.fork_rng(devices=[]):
            critic = make_critic(kind, agent["network"], device, actor)
        critic.load_state_dict(agent["critic_state_dict"])
    except (RuntimeError, KeyError) as error:
        raise ValueError(f"the {kind} agent has no matching critic: {error}") from None
    return critic.eval()


def load_afterstate_critic(
    record: Mapping[str, Any], device: torch.device | str
) -> AfterstateCritic | None:
    """Return the critic of afterstates of a record or a checkpoint, None if it has none.

    Raises:
        ValueError: if the weights do not match the network.
    """
    weights = record.get("afterstate_critic")
    if weights is None:
        return None
    with torch.random.fork_rng(devices=[]):
        critic = AfterstateCritic().to(device)
    try:
        critic.load_state_dict(weights)
    except RuntimeError as error:
        raise ValueError(f"the critic of afterstates does not match: {error}") from None
    return critic.eval()


def record_of(source: str, name: str) -> dict[str, Any]:
    """Return the record of an agent of another run, or of a heuristic.

    Args:
        source: a heuristic's name, a run's folder or a checkpoint.
        name: ``orientation`` or ``placement``.

    Raises:
        ValueError, FileNotFoundError: if it is none of these.
    """
    if source in NAMES[name]:
        return {"name": source}
    checkpoint = checkpoints.read(_path(source, NAMES[name]))
    try:
        return checkpoints.agent_record(checkpoint, name)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


def trained_on(checkpoint: Mapping[str, Any]) -> str:
    """Describe the game that a checkpoint's agents were trained on, and for how many items."""
    config = checkpoint["config"]
    game = config["game"]
    sides = "" if "." in game["items"] else f" {game['sides'][0]}-{game['sides'][1]}"
    return (
        f"{game['items']}{sides}, {GameSpec.of(game)}, {checkpoint['items']:,} items, "
        f"seed {config['seed']}"
    )


def _path(source: str, names: Sequence[str]) -> Path:
    """Return ``source`` as a path.

    Raises:
        ValueError, FileNotFoundError: if it does not exist; names what would be right.
    """
    renamed.refuse_old(source, renamed.POLICIES, "policy")
    if not Path(source).exists():
        raise FileNotFoundError(
            f"{source!r}: needs one of {', '.join(names)}, a checkpoint or a run's folder"
        )
    return Path(source)
