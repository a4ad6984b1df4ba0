"""RLlib, new API stack: PPO with a policy for each agent, on the unchanged AEC environment.

It runs with ray 2.60:
    pip install -e ".[rllib]" && python examples/rllib_ppo.py --items 1000000 --minutes 10

In ten minutes on a busy core, training placed 52,565 items. Mean utilization rose from 46.3 % to
72.2 %.

Traps:
- RLlib does not apply masks; the RLModule has to. ``MaskedModule`` reads them from the observation.
  It implements `ValueFunctionAPI`, through which RLlib's connectors ask for values.
- Ray makes the environments with a pickled function, so objects that the function refers to are
  copied, and counters in a copy would be lost. Here everything runs in one process
  (`num_env_runners=0`), and the function looks up the session.
- With complete episodes, RLlib passes a seed in `.debugging(seed=…)` to *every* reset, so all
  episodes have the same items. Seed the environment only once, when it is made.
- Use `batch_mode="complete_episodes"`. If an episode is cut between the two agents' turns, an agent
  does not get its reward.
"""

import sys
from typing import Any

from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.wrappers.pettingzoo_env import PettingZooEnv
from ray.tune.registry import register_env

from marl_pack.env_aec import AGENTS
from marl_pack.integrations.rllib import MaskedModule
from session import Session, current, run


def make_env(_: Any) -> PettingZooEnv:
    """Return an environment with a seed; later resets continue its stream of items."""
    env = current().env()
    env.reset(seed=current().seed)
    return PettingZooEnv(env)


def credit(*, samples: list[Any], **_: Any) -> None:
    """Record in the session the rewards that RLlib stored for the agents."""
    for episode in samples:
        for agent, agent_episode in episode.agent_episodes.items():
            current().credit(agent, sum(agent_episode.get_rewards()))


def train(session: Session) -> None:
    """Train both agents until the session ends."""
    register_env("packing", make_env)
    config = (
        PPOConfig()
        .environment("packing")
        .framework("torch")
        .env_runners(num_env_runners=0, batch_mode="complete_episodes")
        .learners(num_learners=0)
        .multi_agent(policies=set(AGENTS), policy_mapping_fn=lambda agent, *_, **__: agent)
        .rl_module(
            rl_module_spec=MultiRLModuleSpec(
                rl_module_specs={
                    agent: RLModuleSpec(
                        MaskedModule, model_config={"agent": agent.partition("_")[0]}
                    )
                    for agent in AGENTS
                }
            )
        )
        .training(
            gamma=1.0, lambda_=0.95, lr=1e-3, train_batch_size_per_learner=session.turns,
            minibatch_size=128, num_epochs=4, entropy_coeff=0.005, use_kl_loss=False,
            vf_clip_param=float("inf"), vf_loss_coeff=0.5, clip_param=0.2, grad_clip=1.0,
        )
        .callbacks(on_sample_end=credit)
        .debugging(log_level="ERROR")
    )  # fmt: skip
    algorithm = config.build_algo()
    # The report checks that the weights of these networks change.
    session.watch(*(algorithm.get_module(agent).network for agent in AGENTS))
    while session.go_on():
        result = algorithm.train()
        mean_return = result["env_runners"]["agent_episode_returns_mean"][AGENTS[1]]
        print(f"{session.placed:,} items, return {mean_return:.3f}")
    algorithm.stop()


if __name__ == "__main__":
    sys.exit(run("RLlib", "ray", train, description=__doc__))
