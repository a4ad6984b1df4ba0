"""Adapt the actor-critic to Tianshou, and train each agent on its own turns only."""

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
    """The learners of both agents, each of which learns from its own turns only.

    Tianshou treats every turn as a step. Here an agent's reward is the sum of its rewards until
    its next turn, and its next observation is its observation in that turn.
    """

    def _preprocess_batch(self, batch: Any, buffer: Any, indices: Any) -> Any:
        """Return a batch for the learner of each agent, by the agent's name."""
        batches = {}
        for column, agent in enumerate(AGENTS):
            own_turns = np.flatnonzero(batch.obs.agent_id == agent)
            # The other agent's turn is next, unless the batch ends.
            next_turns = np.minimum(own_turns + 1, len(batch.done) - 1)
            goes_on = ~batch.done[own_turns] & (next_turns > own_turns)
            turns = ReplayBuffer.from_data(
                obs=batch.obs[own_turns], act=batch.act[own_turns],
                rew=batch.rew[own_turns, column]
                + np.where(goes_on, batch.rew[next_turns, column], 0),
                terminated=batch.terminated[own_turns] | (goes_on & batch.terminated[next_turns]),
                truncated=batch.truncated[own_turns] | (goes_on & batch.truncated[next_turns]),
                done=batch.done[own_turns] | (goes_on & batch.done[next_turns]),
                obs_next=batch.obs_next[np.where(goes_on, next_turns, own_turns)],
            )  # fmt: skip
            indices = np.arange(len(own_turns))
            learner = self.get_algorithm(agent)
            batches[agent] = learner._preprocess_batch(turns[indices], turns, indices)
        return Batch(batches)
