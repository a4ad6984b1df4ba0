"""Augment the samples of PPO by the symmetries of the bin."""

from __future__ import annotations

import torch
from rsl_rl.algorithms import PPO

from marl_pack.agents.networks.symmetry import count, transform


def mirror_rollout(ppo: PPO, agent: str) -> None:
    """Replace each sample of a rollout by its image under a random symmetry of the bin.

    Rewards and returns are as they were. The old log-probabilities, distributions and values become
    those of the mirrored observations, so that the update begins from ratios of 1.

    Args:
        ppo: a learner's, with a full storage.
        agent: name in :data:`marl_pack.agents.networks.kinds.AGENT_KINDS`.
    """
    storage = ppo.storage
    with torch.inference_mode():
        for step in range(storage.num_transitions_per_env):
            observation = storage.observations[step]
            width, depth = observation["heightmap"].shape[1:]
            symmetry = torch.randint(
                count(width, depth), (storage.num_envs,), device=storage.device
            )
            mirrored, actions = transform(observation, storage.actions[step], agent, symmetry)
            observation.copy_(mirrored)
            storage.actions[step].copy_(actions)
            ppo.actor(observation, stochastic_output=True)
            storage.values[step].copy_(ppo.critic(observation))
            log_prob = ppo.actor.get_output_log_prob(actions)
            storage.actions_log_prob[step].copy_(log_prob[:, None])
            parameters = ppo.actor.output_distribution_params
            for stored, parameter in zip(storage.distribution_params, parameters, strict=True):
                stored[step].copy_(parameter)
