"""TorchRL: PPO for both agents, on the unchanged AEC environment.

It runs with torchrl 0.14, which needs tensordict < 0.15 and therefore its own virtual environment:
    pip install -e ".[torchrl]" && python examples/torchrl_ppo.py --items 1000000 --minutes 10

In ten minutes on a busy core, training placed 25,600 items. Mean utilization rose from 58.9 % to
69.7 %.

Traps:
- In the other agent's turn TorchRL's mask allows all actions. ``Part`` replaces it by an empty
  mask, so that logits are constant and no gradient reaches the policy. The critic learns the value
  of that turn, because GAE runs over the turns of both agents.
- `PettingZooWrapper(use_mask=True)` makes a separate group for each agent of an AEC environment, so
  the keys of all tensors begin with the agent's name.
"""

import sys

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from marl_pack.env_aec import AGENTS
from marl_pack.integrations.network import ActorCritic
from marl_pack.integrations.torchrl import Part
from session import Session, run

EPOCHS, MINIBATCH, RATE = 4, 256, 1e-3  # an agent acts in every second turn


def train(session: Session) -> None:
    """Train both agents until the session ends."""
    env = PettingZooWrapper(session.env(), use_mask=True, seed=session.seed)
    actor_networks, actors, losses, advantages, optimizers = {}, {}, {}, {}, {}
    for agent in AGENTS:
        actor_networks[agent] = ActorCritic(agent.partition("_")[0])
        keys_in = [(agent, "observation", "observation"), (agent, "action_mask"), (agent, "mask")]
        actors[agent] = ProbabilisticActor(
            TensorDictModule(  # Part: 0 returns the logits, 1 returns the value
                Part(actor_networks[agent], 0), keys_in, [(agent, "logits")]
            ),
            in_keys={"logits": (agent, "logits")}, out_keys=[(agent, "action")],
            distribution_class=Categorical, return_log_prob=True,
            log_prob_key=(agent, "log_prob"),
        )  # fmt: skip
        critic = TensorDictModule(
            Part(ActorCritic(agent.partition("_")[0]), 1), keys_in, [(agent, "value")]
        )
        keys = {key: (agent, key) for key in
                ("value", "advantage", "value_target", "reward", "done", "terminated")}  # fmt: skip
        advantages[agent] = GAE(gamma=1.0, lmbda=0.975, value_network=critic, average_gae=False)
        advantages[agent].set_keys(**keys)
        losses[agent] = ClipPPOLoss(
            actors[agent], critic, clip_epsilon=0.2, entropy_coeff=0.005, critic_coeff=0.5,
            normalize_advantage=True,
        )  # fmt: skip
        losses[agent].set_keys(
            **keys, action=(agent, "action"), sample_log_prob=(agent, "log_prob")
        )
        optimizers[agent] = torch.optim.Adam(losses[agent].parameters(), RATE)
    # The report checks that the weights of these networks change.
    session.watch(*(actor_networks[agent] for agent in AGENTS))

    both = TensorDictSequential(*actors.values())  # the environment plays the acting agent's action
    collector = Collector(env, both, frames_per_batch=session.turns, total_frames=-1)
    for data in collector:
        for agent in AGENTS:
            session.credit(agent, data["next", agent, "reward"].sum())
            learn(data, advantages[agent], losses[agent], optimizers[agent])
        ends = data["next", "done"].flatten()
        final_utilization = data["next", AGENTS[1], "info", "utilization"][ends]
        print(f"{session.placed:,} items, utilization {final_utilization.mean():.3f}")
        if not session.go_on():
            break


def learn(data: TensorDict, advantage: GAE, loss: ClipPPOLoss, optimizer: torch.optim.Adam) -> None:
    """Run PPO's epochs for one agent."""
    with torch.no_grad():
        data = advantage(data)
    for _ in range(EPOCHS):
        for batch in torch.randperm(len(data)).split(MINIBATCH):
            terms = loss(data[batch])
            total = terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]
            optimizer.zero_grad()
            total.backward()
            torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
            optimizer.step()


if __name__ == "__main__":
    sys.exit(run("TorchRL", "torchrl", train, description=__doc__))
