"""AgileRL: IPPO for both agents, on the environment's parallel view, turn by turn.

Versions: agilerl 2.58, which needs pettingzoo < 1.27 and so an environment of its own:
    pip install ".[agilerl]" && python examples/agilerl_ippo.py --items 1000000 --minutes 10
    Ten minutes on a busy core: 37,888 items, utilization 52.3 → 72.5 %

Traps:
- AgileRL looks for masks in `info["action_mask"]`, forgets them when it learns (its ratios then
  compare masked with unmasked probabilities), and its `PzDummyVecEnv` shows the mask from before an
  automatic reset. So the mask travels in the observation here, under another name (it
  refuses `action_mask` there), and the networks of :class:`Masked` apply it, when learning too.
- Its training loop clears `done` before it is stored when all agents end at once, so advantages
  would run on into the next episode: the loop here is our own.
- In the other's turn nothing is legal: constant logits, from which no gradient reaches the policy.
"""

import sys
from typing import Any

import numpy as np
import torch
from agilerl.algorithms import IPPO
from agilerl.modules import EvolvableModule
from gymnasium import spaces
from torch.distributions import Categorical

from marl_pack.env_aec import AGENTS
from marl_pack.integrations.network import ActorCritic
from marl_pack.integrations.session import Session, run


class Masked(EvolvableModule):
    """An :class:`ActorCritic` as AgileRL wants it."""

    def __init__(self, agent: str, device: str = "cpu") -> None:
        super().__init__(device)
        self.agent = agent
        self.network = ActorCritic(agent.partition("_")[0])

    def look(self, seen: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """Logits [B, n] and values [B]."""
        return self.network(seen["observation"], seen["legal"])


class Actor(Masked):
    """Chooses actions."""

    def forward(self, seen: Any, action_mask: Any = None) -> tuple[torch.Tensor, ...]:
        """Actions, their log-probabilities, entropies; each [B]."""
        self.choice = Categorical(logits=self.look(seen)[0])
        action = self.choice.sample()
        return action, self.choice.log_prob(action), self.choice.entropy()

    def action_log_prob(self, action: torch.Tensor) -> torch.Tensor:
        """Log-probabilities [B] of actions, by what was last seen."""
        return self.choice.log_prob(action)


class Critic(Masked):
    """Values states."""

    def forward(self, seen: Any) -> torch.Tensor:
        """Values [B, 1]."""
        return self.look(seen)[1][:, None]


def renamed(seen: dict[str, Any]) -> dict[str, Any]:
    """Observations of a batch of one, with the mask under a name that AgileRL lets pass."""
    return {
        agent: {"observation": own["observation"][None], "legal": own["action_mask"][None]}
        for agent, own in seen.items()
    }


def train(session: Session) -> None:
    """Train both agents."""
    env = session.parallel_env()
    shown = {
        agent: spaces.Dict(
            {
                "observation": env.observation_space(agent)["observation"],
                "legal": env.observation_space(agent)["action_mask"],
            }
        )
        for agent in AGENTS
    }
    both = IPPO(
        spaces.Dict(shown), spaces.Dict({agent: env.action_space(agent) for agent in AGENTS}),
        agent_ids=AGENTS, batch_size=256, lr=1e-3, learn_step=session.turns, gamma=1.0,
        gae_lambda=0.975, ent_coef=0.005, max_grad_norm=1.0, update_epochs=4,
        normalize_images=False,
        actor_networks=[Actor(agent) for agent in AGENTS],
        critic_networks=[Critic(agent) for agent in AGENTS],
    )  # fmt: skip
    session.watch(*(both.actors[agent].network for agent in AGENTS))
    seen = renamed(env.reset(seed=session.seed)[0])
    done = dict.fromkeys(AGENTS, np.zeros(1))
    while session.go_on():
        turns: list[dict[str, list[Any]]] = [{agent: [] for agent in AGENTS} for _ in range(6)]
        for _ in range(session.turns):
            actions, log_probs, _, values = both.get_action(seen)
            after, rewards, terminated, truncated, _ = env.step(
                {agent: int(action[0]) for agent, action in actions.items()}
            )
            for agent in AGENTS:
                step = (seen, actions, log_probs, None, done, values)
                for kept, now in zip(turns, step, strict=True):
                    kept[agent].append(np.array([rewards[agent]]) if now is None else now[agent])
            done = {a: np.array([float(terminated[a] or truncated[a])]) for a in AGENTS}
            seen = renamed(after if env.agents else env.reset()[0])
        for agent in AGENTS:
            session.credit(agent, np.sum(turns[3][agent]))
        both.learn((*turns, seen, done))
        print(f"{session.placed:,} items, reward an item {2 * np.mean(turns[3][AGENTS[1]]):.4f}")


if __name__ == "__main__":
    sys.exit(run("AgileRL", "agilerl", train, description=__doc__))
