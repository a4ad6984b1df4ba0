"""The actor and the critic of an agent, as models of rsl_rl's PPO."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from rsl_rl.models import MLPModel
from torch import Tensor, nn

from marl_pack.agents.networks.distribution import MaskedCategorical
from marl_pack.agents.networks.heads import pooled_head
from marl_pack.agents.networks.kinds import AGENT_KINDS, SELECTION
from marl_pack.agents.networks.selection import SelectionActor, SelectionCritic
from marl_pack.agents.networks.shape import Network, SelectionNetwork
from marl_pack.agents.networks.sight import Observation
from marl_pack.agents.networks.trunk import Features, Trunk


class Actor(MLPModel):
    """An agent's policy: trunk (``cnns``), head (``mlp``) and masked distribution.

    Args:
        obs: an observation of G games, any mapping of tensors.
        obs_groups, obs_set: as rsl_rl passes them.
        output_dim: as rsl_rl passes it; not used, as ``agent`` decides the number of outputs.
        agent: name in :data:`marl_pack.agents.networks.kinds.AGENT_KINDS`.
        network: fields of :class:`marl_pack.agents.networks.shape.Network`.
        precision: name of the type of the numbers in the trunk, as for ``ppo.precision``.
    """

    def __init__(
        self,
        obs: Observation,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        *,
        agent: str,
        network: Mapping[str, Any],
        precision: str = "float32",
    ) -> None:
        nn.Module.__init__(self)  # MLPModel.__init__ builds a perceptron for flat observations
        shape, kind = Network(**network), AGENT_KINDS[agent]
        self.obs_groups, self.obs_normalization = obs_groups[obs_set], False
        self.cnns = Trunk(kind.orientations, shape, getattr(torch, precision))
        self.mlp = kind.head(shape)
        self.distribution = MaskedCategorical(1)

    def get_latent(
        self, obs: Observation, masks: Tensor | None = None, hidden_state: None = None
    ) -> Features:
        """Compute the features of the cells; give the action mask to the distribution."""
        self.distribution.mask = obs["mask"]
        return self.cnns.store(obs)

    def log_probs(self, obs: Observation) -> Tensor:
        """Compute log-probabilities of all actions, float32 [G, K]; draws no random numbers."""
        return self.distribution.masked(self.mlp(self.get_latent(obs))).log_softmax(-1)


class Critic(MLPModel):
    """An agent's critic: the value [G, 1] of the state that it observes at its turn.

    Args:
        obs, obs_groups, obs_set, output_dim, agent, network: as for :class:`Actor`.
        cnns: the actor's trunk, whose features the critic uses.
    """

    def __init__(
        self,
        obs: Observation,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        *,
        agent: str,
        network: Mapping[str, Any],
        cnns: Trunk,
    ) -> None:
        nn.Module.__init__(self)
        shape, kind = Network(**network), AGENT_KINDS[agent]
        self.obs_groups, self.obs_normalization = obs_groups[obs_set], False
        self.distribution = None
        # Not registered as a submodule: its weights belong to the actor's state and parameters.
        self._features = cnns.take
        self.mlp = pooled_head(shape, kind.orientations, output_dim, 1.0)

    def get_latent(
        self, obs: Observation, masks: Tensor | None = None, hidden_state: None = None
    ) -> Features:
        """Compute the features of the cells."""
        return self._features(obs)


def shape_of(agent: str, network: Mapping[str, Any]) -> Network | SelectionNetwork:
    """Return the shape of an agent's network.

    Args:
        agent: name in :data:`marl_pack.agents.networks.kinds.AGENT_NAMES`.
        network: the fields of its shape.

    Raises:
        ValueError, TypeError: if there is no such network.
    """
    return SelectionNetwork(**network) if agent == SELECTION else Network(**network)


def models_of(agent: str) -> tuple[Any, Any, dict[str, str]]:
    """Return the classes of an agent's actor and critic, and the arguments that name the agent."""
    if agent == SELECTION:
        return SelectionActor, SelectionCritic, {}
    return Actor, Critic, {"agent": agent}


def make_actor(agent: str, network: Mapping[str, Any], device: torch.device | str) -> Any:
    """Build an actor with new weights, to load a checkpoint into.

    Args:
        agent: name in :data:`marl_pack.agents.networks.kinds.AGENT_NAMES`.
        network: the fields of its shape.
        device: the device of its weights.
    """
    actor, _, named = models_of(agent)
    return actor({}, {"actor": []}, "actor", 1, **named, network=network).to(device)


def make_critic(
    agent: str, network: Mapping[str, Any], device: torch.device | str, actor: Any
) -> Any:
    """Build a critic with new weights.

    Args:
        agent, network, device: as for :func:`make_actor`.
        actor: the agent's actor, whose trunk the critic uses if it has one.
    """
    _, critic, named = models_of(agent)
    shared = {"cnns": actor.cnns} if agent != SELECTION else {}
    return critic({}, {"critic": []}, "critic", 1, **named, network=network, **shared).to(device)
