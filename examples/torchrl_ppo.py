"""TorchRL: PPO for both agents, on the AEC environment as it is.

Versions: torchrl 0.14, which needs tensordict < 0.15 and so an environment of its own:
    pip install ".[torchrl]" && python examples/torchrl_ppo.py --items 100000

Traps:
- Agents are grouped by the part of their name before the underscore: each is its own group here.
- Every agent has an entry at every turn; ``(group, "mask")`` says who acted. GAE has to run over
  all turns, then only the acting ones may go into the loss.
- The agent that does not act has a mask of all ones, and an action that is ignored.
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
from marl_pack.integrations.session import Session, run

EPOCHS, MINIBATCH, RATE = 4, 128, 1e-3


class Part(torch.nn.Module):
    """One of a network's two outputs, for any leading shape; TorchRL adds a dimension of agents."""

    def __init__(self, network: ActorCritic, part: int) -> None:
        super().__init__()
        self.network, self.part = network, part

    def forward(self, planes: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Logits, or values."""
        lead = planes.shape[:-3]
        out = self.network(planes.reshape(-1, *planes.shape[-3:]), mask.reshape(-1, mask.shape[-1]))
        return out[self.part].reshape(*lead, -1)


def train(session: Session) -> None:
    """Train both agents."""
    env = PettingZooWrapper(session.env(), use_mask=True, seed=session.seed)
    names = {group: members[0] for group, members in env.group_map.items()}
    networks, actors, losses, advantages, optimizers = {}, {}, {}, {}, {}
    for group, agent in names.items():
        networks[agent] = ActorCritic(agent.partition("_")[0])
        seen = [(group, "observation", "observation"), (group, "action_mask")]
        actors[group] = ProbabilisticActor(
            TensorDictModule(Part(networks[agent], 0), seen, [(group, "logits")]),
            in_keys={"logits": (group, "logits")}, out_keys=[(group, "action")],
            distribution_class=Categorical, return_log_prob=True,
            log_prob_key=(group, "log_prob"),
        )  # fmt: skip
        critic = TensorDictModule(
            Part(ActorCritic(agent.partition("_")[0]), 1), seen, [(group, "value")]
        )
        keys = {key: (group, key) for key in
                ("value", "advantage", "value_target", "reward", "done", "terminated")}  # fmt: skip
        advantages[group] = GAE(gamma=1.0, lmbda=0.95, value_network=critic, average_gae=False)
        advantages[group].set_keys(**keys)
        losses[group] = ClipPPOLoss(
            actors[group], critic, clip_epsilon=0.2, entropy_coeff=0.005, critic_coeff=0.5,
            normalize_advantage=True,
        )  # fmt: skip
        losses[group].set_keys(
            **keys, action=(group, "action"), sample_log_prob=(group, "log_prob")
        )
        optimizers[group] = torch.optim.Adam(losses[group].parameters(), RATE)
    session.watch(*(networks[agent] for agent in AGENTS))

    both = TensorDictSequential(*actors.values())  # the environment plays the acting one's action
    collector = Collector(env, both, frames_per_batch=session.turns, total_frames=-1)
    for data in collector:
        for group, agent in names.items():
            session.credit(agent, data["next", group, "reward"].sum())
            learn(data, group, advantages[group], losses[group], optimizers[group])
        reached = data["next", AGENTS[1], "info", "utilization"][data["next", "done"].flatten()]
        print(f"{session.placed:,} items, utilization {reached.mean():.3f}")
        if not session.go_on():
            break


def learn(
    data: TensorDict, group: str, advantage: GAE, loss: ClipPPOLoss, optimizer: torch.optim.Adam
) -> None:
    """PPO's epochs on the turns in which the agent acted."""
    with torch.no_grad():
        data = advantage(data)
    own = data[data[group, "mask"].flatten()]
    for _ in range(EPOCHS):
        for part in torch.randperm(len(own)).split(MINIBATCH):
            terms = loss(own[part])
            total = terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]
            optimizer.zero_grad()
            total.backward()
            torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
            optimizer.step()


if __name__ == "__main__":
    sys.exit(run("TorchRL", "torchrl", train, description=__doc__))
