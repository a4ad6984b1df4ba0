"""CleanRL's style: PPO for both agents in one file, on the unchanged AEC environment.

It needs only marl_pack, which installs PettingZoo and torch:
    pip install -e . && python examples/cleanrl_ppo.py --items 1000000 --minutes 10

With ``--buffer 3`` three boxes are visible. A third agent, ``selection_0``, acts first in each
cycle and learns which box is next.

With ``--world mm`` both agents learn to pack cartons in millimetres; the placement agent then
chooses among listed moves, and its network scores each move.

In ten minutes on a busy core, training placed 110,476 items. Mean utilization rose from 52.3 % to
74.7 %.

Two rules for any trainer of your own:
- A turn is a sample for the agent that acted. The sample's reward is the sum of the rewards that
  the agent got until its next turn, or until the end. PettingZoo's ``env.last()`` returns this sum.
- Compute each agent's advantages over its own turns only.
"""

import sys
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Categorical

from marl_pack.env_aec import WORLDS
from marl_pack.env_turns import PLACEMENT
from marl_pack.integrations.network import ActorCritic, MovesActorCritic
from session import Counted, Session, run

Network = ActorCritic | MovesActorCritic
EPOCHS, MINIBATCH, RATE, CLIP, LAMBDA = 4, 128, 1e-3, 0.2, 0.95


@dataclass
class Turns:
    """Turns of one agent: observations, actions and rewards."""

    observations: list[Tensor] = field(default_factory=list)
    masks: list[Tensor] = field(default_factory=list)
    actions: list[int] = field(default_factory=list)
    log_probs: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    ends: list[bool] = field(default_factory=list)  # whether it was the agent's last turn

    def advantages(self) -> Tensor:
        """Compute GAE with γ = 1 over the agent's own turns; the last turn ends an episode."""
        advantages, advantage, value = [], 0.0, 0.0
        for k in reversed(range(len(self.actions))):
            if self.ends[k]:
                advantage, value = 0.0, 0.0
            delta = self.rewards[k] + value - self.values[k]
            advantage = delta + LAMBDA * advantage
            value = self.values[k]
            advantages.append(advantage)
        return torch.tensor(advantages[::-1])


def collect(env: Counted, networks: dict[str, Network], session: Session) -> dict[str, Turns]:
    """Play whole episodes until enough turns have been played."""
    turns = {agent: Turns() for agent in networks}
    target = env.items + session.turns // len(networks)
    while env.items < target:
        env.reset()
        for agent in env.agent_iter():
            observation, reward, terminated, truncated, _ = env.last()
            agent_turns = turns[agent]
            if agent_turns.actions and not agent_turns.ends[-1]:
                agent_turns.rewards[-1] = reward
                agent_turns.ends[-1] = terminated or truncated
                session.credit(agent, reward)
            seen = torch.from_numpy(observation["observation"])
            mask = torch.from_numpy(observation["action_mask"])
            with torch.no_grad():
                logits, value = networks[agent](seen[None], mask[None])
            if truncated and agent_turns.actions:  # add the critic's value of the steps cut off
                agent_turns.rewards[-1] += float(value)
            if terminated or truncated:
                env.step(None)
                continue
            distribution = Categorical(logits=logits)
            action = distribution.sample()
            agent_turns.observations.append(seen)
            agent_turns.masks.append(mask)
            agent_turns.actions.append(int(action))
            agent_turns.log_probs.append(float(distribution.log_prob(action)))
            agent_turns.values.append(float(value))
            agent_turns.rewards.append(0.0)
            agent_turns.ends.append(False)
            env.step(int(action))
    return turns


def learn(turns: Turns, network: Network, optimizer: torch.optim.Optimizer) -> None:
    """Run PPO's epochs over one agent's turns."""
    observations, masks = torch.stack(turns.observations), torch.stack(turns.masks)
    actions, old_log_probs = torch.tensor(turns.actions), torch.tensor(turns.log_probs)
    advantages = turns.advantages()
    returns = advantages + torch.tensor(turns.values)
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    for _ in range(EPOCHS):
        for batch in torch.randperm(len(actions)).split(MINIBATCH):
            logits, values = network(observations[batch], masks[batch])
            distribution = Categorical(logits=logits)
            ratio = (distribution.log_prob(actions[batch]) - old_log_probs[batch]).exp()
            objective = torch.minimum(
                ratio * advantages[batch], ratio.clamp(1 - CLIP, 1 + CLIP) * advantages[batch]
            )
            loss = -objective.mean() + 0.5 * (values - returns[batch]).pow(2).mean()
            loss -= 0.005 * distribution.entropy().mean()
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()


def train(session: Session) -> None:
    """Train all agents until the session ends."""
    env = session.env()
    env.reset(seed=session.seed)
    networks = {agent: session.network(agent) for agent in session.agents}
    optimizers = {a: torch.optim.Adam(n.parameters(), RATE) for a, n in networks.items()}
    # The report checks that the weights of these networks change.
    session.watch(*networks.values())
    while session.go_on():
        turns = collect(env, networks, session)
        for agent in session.agents:
            learn(turns[agent], networks[agent], optimizers[agent])
        last = turns[PLACEMENT]
        mean_return = np.sum(last.rewards) / np.sum(last.ends)
        print(f"{session.placed:,} items, return {mean_return:.3f}")


if __name__ == "__main__":
    sys.exit(
        run("CleanRL's style", "marl_pack", train, description=__doc__, worlds=WORLDS, selects=True)
    )
