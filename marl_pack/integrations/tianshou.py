"""Tianshou: the masked actor-critic as two networks, and PPO on each agent's own turns."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tianshou.algorithm.multiagent.marl import MultiAgentOnPolicyAlgorithm
from tianshou.data import Batch, ReplayBuffer
from tianshou.utils.net.common import ActionReprNet
from torch import nn

from marl_pack.env_aec import AGENTS
from marl_pack.integrations.network import ActorCritic


def outputs(network: ActorCritic, batch: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Return masked logits [B, n] and values [B] of a batch of observations."""
    logits, values = network(torch.as_tensor(batch.obs), torch.as_tensor(batch.mask))
    return logits, values


class Actor(ActionReprNet):
    """A module with Tianshou's interface that returns the network's logits."""

    def __init__(self, network: ActorCritic) -> None:
        super().__init__()
        self.network = network

    def forward(self, obs: Any, state: Any = None, info: Any = None) -> tuple[torch.Tensor, Any]:
        """Return masked logits [B, n], and the state unchanged."""
        return outputs(self.network, obs)[0], state


class Critic(nn.Module):
    """A module with Tianshou's interface that returns the network's values."""

    def __init__(self, network: ActorCritic) -> None:
        super().__init__()
        self.network = network

    def forward(self, obs: Any) -> torch.Tensor:
        """Return the values of states, [B]."""
        return outputs(self.network, obs)[1]


class OwnTurns(MultiAgentOnPolicyAlgorithm):
    """The learners of several agents, each of which learns from its own turns only.

    Tianshou treats every turn as a step. Here an agent's reward is the sum of its rewards until
    its next turn, and its next observation is the observation at its next turn.
    """

    def _preprocess_batch(self, batch: Any, buffer: Any, indices: Any) -> Any:
        """Return the batch for each agent's learner, by the agent's name."""
        batches = {}
        for column, agent in enumerate(AGENTS):
            own = np.flatnonzero(batch.obs.agent_id == agent)
            other = np.minimum(own + 1, len(batch.done) - 1)  # the turn after it, if there is one
            goes_on = ~batch.done[own] & (other > own)
            turns = ReplayBuffer.from_data(
                obs=batch.obs[own], act=batch.act[own],
                rew=batch.rew[own, column] + np.where(goes_on, batch.rew[other, column], 0),
                terminated=batch.terminated[own] | (goes_on & batch.terminated[other]),
                truncated=batch.truncated[own] | (goes_on & batch.truncated[other]),
                done=batch.done[own] | (goes_on & batch.done[other]),
                obs_next=batch.obs_next[np.where(goes_on, other, own)],
            )  # fmt: skip
            every = np.arange(len(own))
            learner = self.get_algorithm(agent)
            batches[agent] = learner._preprocess_batch(turns[every], turns, every)
        return Batch(batches)
