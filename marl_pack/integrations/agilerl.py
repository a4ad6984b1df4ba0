"""Adapt the actor-critic and the observations to AgileRL.

AgileRL reads masks from ``info["action_mask"]`` and does not use them when it learns. So here the
observation contains the mask, under the name ``legal`` (AgileRL refuses the name ``action_mask``
there), and the networks apply it in play and in learning.
"""

from __future__ import annotations

from typing import Any

import torch
from agilerl.modules import EvolvableModule
from gymnasium import spaces
from torch.distributions import Categorical

from marl_pack.integrations.network import ActorCritic


class Masked(EvolvableModule):
    """An :class:`ActorCritic` with AgileRL's interface.

    Args:
        agent: name of the agent, ``"orientation_0"`` or ``"placement_0"``.
        device: the device of the weights.
    """

    def __init__(self, agent: str, device: str = "cpu") -> None:
        super().__init__(device)
        self.agent = agent
        self.network = ActorCritic(agent.partition("_")[0])
        self.distribution: Any = None  # distribution of actions for the last observation

    def outputs(self, observation: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """Return masked logits [B, n] and values [B]."""
        logits, values = self.network(observation["observation"], observation["legal"])
        return logits, values


class Actor(Masked):
    """The network that chooses actions."""

    def forward(self, observation: Any, action_mask: Any = None) -> tuple[torch.Tensor, ...]:
        """Return actions, their log-probabilities and entropies; each [B]."""
        self.distribution = Categorical(logits=self.outputs(observation)[0])
        action = self.distribution.sample()
        return action, self.distribution.log_prob(action), self.distribution.entropy()

    def action_log_prob(self, action: torch.Tensor) -> torch.Tensor:
        """Return the log-probabilities [B] of actions for the last observation."""
        log_prob: torch.Tensor = self.distribution.log_prob(action)
        return log_prob


class Critic(Masked):
    """The network that estimates the values of states."""

    def forward(self, observation: Any) -> torch.Tensor:
        """Return the values of states, [B, 1]."""
        return self.outputs(observation)[1][:, None]


def legal_space(space: Any) -> spaces.Dict:
    """Return an agent's observation space with the mask under the name ``legal``."""
    return spaces.Dict({"observation": space["observation"], "legal": space["action_mask"]})


def renamed(observations: dict[str, Any]) -> dict[str, Any]:
    """Return observations as batches of size 1, with the mask under the name ``legal``."""
    return {
        agent: {"observation": entry["observation"][None], "legal": entry["action_mask"][None]}
        for agent, entry in observations.items()
    }
