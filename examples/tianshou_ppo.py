"""Tianshou: a PPO for each agent, on the AEC environment with padded spaces.

It runs with tianshou 2.0:
    pip install -e ".[tianshou]" && python examples/tianshou_ppo.py --items 1000000 --minutes 10

In ten minutes on a busy core, training placed 85,587 items. Mean utilization rose from 49.5 % to
74.8 %.

Traps:
- Tianshou's PettingZoo wrapper needs the same spaces for all agents: use `pad_actions=True`.
- Tianshou's multi-agent PPO treats every turn as a step of both agents (Tianshou's issue 399). Then
  the reward of a placement, which both agents should get, goes only to the placement agent. The
  orientation agent gets zeros and no end of an episode. The next state of both agents is what the
  *other* agent sees next. So ``OwnTurns`` gives each agent only its own turns.
- The collector has to play whole episodes, so that each turn is followed by the agent's next turn.
  The buffer has to hold all these episodes: if it is full, its first turns are overwritten.
"""

import logging
import sys
from typing import Any

from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import DiscreteActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv, PettingZooEnv
from tianshou.utils.torch_utils import policy_within_training_step

from marl_pack.env_aec import AGENTS
from marl_pack.integrations.network import ActorCritic
from marl_pack.integrations.tianshou import Actor, Critic, OwnTurns
from session import Session, run

BINS, EPOCHS, MINIBATCH, RATE = 8, 4, 128, 1e-3


class Credited(OwnTurns):
    """An algorithm that records in the session the rewards from which the agents learn."""

    def __init__(self, session: Session, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.session = session

    def _preprocess_batch(self, batch: Any, buffer: Any, indices: Any) -> Any:
        batches = super()._preprocess_batch(batch, buffer, indices)
        for agent in AGENTS:
            self.session.credit(agent, batches[agent].rew.sum())
        return batches


def train(session: Session) -> None:
    """Train both agents until the session ends."""
    logging.getLogger("tianshou").setLevel(logging.ERROR)  # it warns about rewards for two agents
    games = DummyVectorEnv([lambda: PettingZooEnv(session.env(pad_actions=True))] * BINS)
    games.seed([session.seed * BINS + k for k in range(BINS)])
    example_env = PettingZooEnv(session.env(pad_actions=True))
    networks = {agent: ActorCritic("both") for agent in AGENTS}
    learners = [
        PPO(
            policy=DiscreteActorPolicy(actor=Actor(network), action_space=example_env.action_space),
            critic=Critic(network), optim=AdamOptimizerFactory(lr=RATE), gamma=1.0, gae_lambda=0.95,
            ent_coef=0.005, vf_coef=0.5, max_grad_norm=1.0,
        )
        for network in networks.values()
    ]  # fmt: skip
    both = Credited(session, algorithms=learners, env=example_env)
    # The report checks that the weights of these networks change.
    session.watch(*networks.values())
    width, depth, height = session.bin_size
    most_turns = 2 * width * depth * height // min(session.sides) ** 3  # upper bound for an episode
    buffer = VectorReplayBuffer(BINS * (session.turns + most_turns), BINS)
    collector = Collector(both, games, buffer)
    collector.reset()
    while session.go_on():
        with policy_within_training_step(both.policy):
            while len(buffer) < session.turns:
                collected = collector.collect(n_episode=BINS)  # one for each bin
            both.update(buffer, batch_size=MINIBATCH, repeat=EPOCHS)
        collector.reset_buffer()
        print(f"{session.placed:,} items, return {collected.returns[:, 1].mean():.3f}")


if __name__ == "__main__":
    sys.exit(run("Tianshou", "tianshou", train, description=__doc__))
