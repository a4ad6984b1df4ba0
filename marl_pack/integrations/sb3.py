"""Adapt the environment and the actor-critic to Stable-Baselines3 (sb3-contrib).

One agent plays both turns, so that MaskablePPO can train it.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from sb3_contrib.common.maskable.policies import MaskableMultiInputActorCriticPolicy
from torch import Tensor

from marl_pack.env_aec import AGENTS
from marl_pack.game.state import Copied
from marl_pack.integrations.network import ActorCritic


class Turns(Copied, gymnasium.Env[Any, Any]):
    """A Gymnasium environment whose single agent plays the turns of both agents.

    The orientation agent's turn and the placement agent's turn are two steps; the reward is the one
    that both agents share.

    Args:
        env: an AEC environment with ``pad_actions=True``.
        seed: seed of the items; the first call of :meth:`reset` uses it.
    """

    def __init__(self, env: Any, seed: int) -> None:
        self.env = env
        self.seed: int | None = seed
        self.observation_space = env.observation_space(AGENTS[0])
        self.action_space = env.action_space(AGENTS[0])

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin the next episode of the stream of items; return its observation and an empty info.

        The arguments are ignored: the environment has its seed already.
        """
        self.env.reset(seed=self.seed)
        self.seed = None
        return self.env.observe(self.env.agent_selection), {}

    def step(self, action: Any) -> Any:
        """Play one turn; return the same five values as ``step`` of Gymnasium."""
        agent = self.env.agent_selection
        self.env.step(action)
        ends = self.env.terminations[agent], self.env.truncations[agent]
        observation = self.env.observe(self.env.agent_selection)
        return observation, self.env.rewards[agent], *ends, dict(self.env.infos[agent])

    def action_masks(self) -> NDArray[np.bool_]:
        """Return the mask that MaskablePPO asks for before each step, bool [n]."""
        mask: NDArray[np.int8] = self.env.observe(self.env.agent_selection)["action_mask"]
        return mask.astype(bool)


class MaskedPolicy(MaskableMultiInputActorCriticPolicy):
    """A policy with one :class:`ActorCritic` for both turns.

    MaskablePPO passes no mask when it asks for the values of states, so the policy reads the mask
    from the observation.
    """

    def _build(self, lr_schedule: Any) -> None:
        """Make the network and its optimizer."""
        self.network = ActorCritic("both")
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr_schedule(1))

    def _outputs(self, obs: Any, action_masks: Any = None) -> tuple[Any, Tensor]:
        """Return the distribution of actions, and the values [B, 1]."""
        logits, values = self.network(obs["observation"].float(), obs["action_mask"])
        distribution = self.action_dist.proba_distribution(action_logits=logits)
        if action_masks is not None:
            distribution.apply_masking(action_masks)
        return distribution, values[:, None]

    def forward(self, obs: Any, deterministic: bool = False, action_masks: Any = None) -> Any:
        """Return actions, values and log-probabilities."""
        distribution, values = self._outputs(obs, action_masks)
        actions = distribution.get_actions(deterministic=deterministic)
        return actions, values, distribution.log_prob(actions)

    def evaluate_actions(self, obs: Any, actions: Tensor, action_masks: Any = None) -> Any:
        """Return values, log-probabilities and entropies of actions."""
        distribution, values = self._outputs(obs, action_masks)
        return values, distribution.log_prob(actions), distribution.entropy()

    def get_distribution(self, obs: Any, action_masks: Any = None) -> Any:
        """Return the distribution of actions."""
        return self._outputs(obs, action_masks)[0]

    def predict_values(self, obs: Any) -> Tensor:
        """Return the values of states, [B, 1]."""
        return self._outputs(obs)[1]
