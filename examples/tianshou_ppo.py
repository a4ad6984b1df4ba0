"""Tianshou: a PPO for each agent, on the AEC environment with padded spaces.

Versions: tianshou 2.0:
    pip install -e ".[tianshou]" && python examples/tianshou_ppo.py --items 1000000 --minutes 10
    Ten minutes on a busy core: 85,587 items, utilization 49.5 → 74.8 %

Traps:
- Its PettingZoo wrapper wants one space for all agents: `pad_actions=True`.
- Its multi-agent PPO takes every turn as a step of its own (its issue 399): the reward of a
  placement, which both agents get, would go to the placement agent alone, the orientation agent
  would see nothing but zeros and no end of an episode, and both would be valued by what the *other*
  one sees next. ``OwnTurns`` gives each agent its own turns in a row instead.
- The collector has to play whole episodes, so that every turn has what followed, and the buffer to
  hold them all: what no longer fits would be overwritten from the front.
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
    """Records in the session the rewards that the agents learn from."""

    def __init__(self, session: Session, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.session = session

    def _preprocess_batch(self, batch: Any, buffer: Any, indices: Any) -> Any:
        batches = super()._preprocess_batch(batch, buffer, indices)
        for agent in AGENTS:
            self.session.credit(agent, batches[agent].rew.sum())
        return batches


def train(session: Session) -> None:
    """Train both agents until the session has its items."""
    logging.getLogger("tianshou").setLevel(logging.ERROR)  # it warns of rewards for two agents
    games = DummyVectorEnv([lambda: PettingZooEnv(session.env(pad_actions=True))] * BINS)
    games.seed([session.seed * BINS + k for k in range(BINS)])
    shown = PettingZooEnv(session.env(pad_actions=True))
    networks = {agent: ActorCritic("both") for agent in AGENTS}
    learners = [
        PPO(
            policy=DiscreteActorPolicy(actor=Actor(network), action_space=shown.action_space),
            critic=Critic(network), optim=AdamOptimizerFactory(lr=RATE), gamma=1.0, gae_lambda=0.95,
            ent_coef=0.005, vf_coef=0.5, max_grad_norm=1.0,
        )
        for network in networks.values()
    ]  # fmt: skip
    both = Credited(session, algorithms=learners, env=shown)
    session.watch(*networks.values())
    width, depth, height = session.bin_size
    most = 2 * width * depth * height // min(session.sides) ** 3  # turns of an episode
    buffer = VectorReplayBuffer(BINS * (session.turns + most), BINS)
    collector = Collector(both, games, buffer)
    collector.reset()
    while session.go_on():
        with policy_within_training_step(both.policy):
            while len(buffer) < session.turns:
                played = collector.collect(n_episode=BINS)  # one episode a bin
            both.update(buffer, batch_size=MINIBATCH, repeat=EPOCHS)
        collector.reset_buffer()
        print(f"{session.placed:,} items, return {played.returns[:, 1].mean():.3f}")


if __name__ == "__main__":
    sys.exit(run("Tianshou", "tianshou", train, description=__doc__))
