"""Adapt the environment and the actor-critic to BenchMARL, as a task and a model."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from typing import Any

import torch
from benchmarl.environments.pettingzoo.common import PettingZooClass
from benchmarl.models.common import Model, ModelConfig
from torchrl.envs.libs.pettingzoo import PettingZooWrapper

from marl_pack import env_aec
from marl_pack.integrations.network import ActorCritic


class PackingTask(PettingZooClass):
    """The AEC environment as a task with exact masks, in which each agent is a group.

    Example: ``PackingTask("PACKING", {"bin_size": (10, 10, 10)})``. The settings are the arguments
    of :func:`marl_pack.env_aec.env`.
    """

    def make_env(self) -> Any:
        """Return one new AEC environment."""
        return env_aec.env(**self.config)

    def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: Any, device: Any) -> Any:
        """Return a function that makes environments, each with its own items.

        BenchMARL gives all environments of a task the same seed, so here each gets a new seed.
        """
        seeds = count(1000 * (seed or 0))
        return lambda: PettingZooWrapper(
            self.make_env(), use_mask=True, seed=next(seeds), categorical_actions=True,
            device=device,
        )  # fmt: skip

    def supports_discrete_actions(self) -> bool:
        """Return True: both agents' actions are discrete."""
        return True

    def max_steps(self, env: Any) -> int:
        """Return a limit that no evaluation reaches: every episode ends before it."""
        return 10**6

    def observation_spec(self, env: Any) -> Any:
        """Return the spec of the model's inputs: planes, mask, and whether the agent acts."""
        spec = env.observation_spec.clone()
        for group in self.group_map(env):
            del spec[group]["info"]
        return spec


class MaskedModel(Model):
    """An :class:`ActorCritic` with BenchMARL's interface; as a critic it returns values.

    BenchMARL's losses also include the turns of the other agent. In these turns the logits are
    constant, so that no gradient reaches the policy. The critic learns the values of these turns.
    """

    def __init__(self, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.network = ActorCritic(self.agent_group.partition("_")[0])

    def _forward(self, tensordict: Any) -> Any:
        """Write logits [..., n] or values [..., 1] into the TensorDict."""
        group = tensordict[self.agent_group]
        planes, mask = group["observation", "observation"], group["action_mask"]
        lead = planes.shape[:-3]
        logits, values = self.network(
            planes.reshape(-1, *planes.shape[-3:]), mask.reshape(-1, mask.shape[-1])
        )
        if self.is_critic:
            tensordict[self.out_key] = values.reshape(*lead, 1)
        else:
            acts = group["mask"].reshape(*lead, 1)
            tensordict[self.out_key] = torch.where(acts, logits.reshape(*lead, -1), 0)
        return tensordict


@dataclass
class MaskedModelConfig(ModelConfig):
    """The settings of :class:`MaskedModel`: there are none, but BenchMARL needs the class."""

    @staticmethod
    def associated_class() -> type[Model]:
        """Return the class of these settings."""
        return MaskedModel
