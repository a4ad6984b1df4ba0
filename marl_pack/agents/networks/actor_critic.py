"""Actors and critics as rsl_rl's PPO drives them: any agent's trunk, head and distribution."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import Any

import torch
from rsl_rl.models import MLPModel
from torch import Tensor, nn

from marl_pack.agents import joint, orientation, placement
from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.networks.distribution import MaskedCategorical
from marl_pack.agents.networks.trunk import Features, Network, Trunk, pooled_head
from marl_pack.game.packing import Packing

AGENTS: dict[str, ModuleType] = {
    "orientation": orientation,
    "placement": placement,
    "joint": joint,
}
"""Name -> the module with its ``observe``, its ``make_head`` and the orientations it judges."""


class Actor(MLPModel):
    """An agent's policy: trunk (``cnns``), head (``mlp``) and masked distribution.

    Args:
        obs: an observation of N bins; any Mapping of tensors does.
        obs_groups, obs_set, output_dim: as rsl_rl passes them; the network's own shape decides.
        agent: one of :data:`AGENTS`.
        network: fields of :class:`marl_pack.agents.networks.trunk.Network`.

    Attributes:
        afterstates: who says what placements are worth, if its network sees that, else None. Kept
            with the actor's weights; it learns by itself.
    """

    afterstates: AfterstateCritic | None

    def __init__(
        self,
        obs: Mapping[str, Tensor],
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        *,
        agent: str,
        network: Mapping[str, Any],
    ) -> None:
        nn.Module.__init__(self)  # MLPModel's own would build a perceptron for flat observations
        shape = Network(**network)
        self.obs_groups, self.obs_normalization = obs_groups[obs_set], False
        self.cnns = Trunk(AGENTS[agent].WAYS, shape)
        self.mlp = AGENTS[agent].make_head(shape)
        self.afterstates = AfterstateCritic() if "worth" in shape.planes else None
        self.distribution = MaskedCategorical(1)
        self._observe = AGENTS[agent].observe

    def see(self, game: Packing, *chosen: Tensor) -> dict[str, Tensor]:
        """What the agent sees of N bins; the placement agent once orientations [N] are chosen."""
        seen: dict[str, Tensor] = self._observe(
            game, self.cnns.planes, *chosen, afterstates=self.afterstates
        )
        return seen

    def get_latent(
        self, obs: Mapping[str, Tensor], masks: Tensor | None = None, hidden_state: None = None
    ) -> Features:
        """Features of the cells; hands the action mask to the distribution."""
        self.distribution.mask = obs["mask"]
        return self.cnns.keep(obs)

    def log_probs(self, obs: Mapping[str, Tensor]) -> Tensor:
        """Log-probabilities of all actions, float32 [B, K]; draws no random numbers."""
        return self.distribution.masked(self.mlp(self.get_latent(obs))).log_softmax(-1)


class Critic(MLPModel):
    """An agent's value of the state it sees at its turn, [B, 1].

    Args:
        obs, obs_groups, obs_set, output_dim, agent, network: as for :class:`Actor`.
        cnns: the actor's trunk, to look at its features instead of having a trunk.
    """

    def __init__(
        self,
        obs: Mapping[str, Tensor],
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        *,
        agent: str,
        network: Mapping[str, Any],
        cnns: Trunk | None = None,
    ) -> None:
        nn.Module.__init__(self)
        shape = Network(**network)
        self.obs_groups, self.obs_normalization = obs_groups[obs_set], False
        self.distribution = None
        if cnns is None:
            self.cnns = Trunk(AGENTS[agent].WAYS, shape)
            self._features = self.cnns.forward
        else:
            # Not registered as a part: its weights belong to the actor's state and parameters.
            self._features = cnns.take
        self.mlp = pooled_head(shape, AGENTS[agent].WAYS, output_dim, 1.0)

    def get_latent(
        self, obs: Mapping[str, Tensor], masks: Tensor | None = None, hidden_state: None = None
    ) -> Features:
        """Features of the cells."""
        return self._features(obs)


def make_actor(agent: str, network: Mapping[str, Any], device: torch.device | str) -> Actor:
    """An actor with fresh weights, to load a checkpoint into."""
    return Actor({}, {"actor": []}, "actor", 1, agent=agent, network=network).to(device)


def make_critic(
    agent: str, network: Mapping[str, Any], device: torch.device | str, actor: Actor | None = None
) -> Critic:
    """A critic with fresh weights; one that shares its actor's trunk needs that actor."""
    trunk = actor.cnns if actor is not None and Network(**network).share_trunk else None
    critic = Critic({}, {"critic": []}, "critic", 1, agent=agent, network=network, cnns=trunk)
    return critic.to(device)
