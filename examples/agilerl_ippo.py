"""AgileRL: IPPO for both agents, on the environment's parallel view, turn by turn.

It runs with agilerl 2.58, which needs pettingzoo < 1.27 and therefore its own virtual environment:
    pip install -e ".[agilerl]" && python examples/agilerl_ippo.py --items 1000000 --minutes 10

In ten minutes on a busy core, training placed 37,888 items. Mean utilization rose from 52.3 % to
72.5 %.

Traps:
- AgileRL reads masks from `info["action_mask"]`, but does not use them when it learns. PPO's ratios
  then compare masked with unmasked probabilities. Also, after an automatic reset AgileRL's
  `PzDummyVecEnv` still shows the old mask. So here the mask is in the observation, under another
  name (AgileRL refuses `action_mask` there). The networks of :mod:`marl_pack.integrations.agilerl`
  apply it, also when learning.
- If all agents end at once, AgileRL's training loop clears `done` before it stores it, so
  advantages would continue into the next episode. So this file has its own loop.
- In the other agent's turn no action is legal. The logits are constant there, so no gradient
  reaches the policy from that turn.
"""

import sys
from typing import Any

import numpy as np
from agilerl.algorithms import IPPO
from gymnasium import spaces

from marl_pack.env_aec import AGENTS
from marl_pack.integrations.agilerl import Actor, Critic, legal_space, renamed
from session import Session, run


def train(session: Session) -> None:
    """Train both agents until the session ends."""
    env = session.parallel_env()
    spaces_with_mask = {agent: legal_space(env.observation_space(agent)) for agent in AGENTS}
    both = IPPO(
        spaces.Dict(spaces_with_mask),
        spaces.Dict({agent: env.action_space(agent) for agent in AGENTS}),
        agent_ids=AGENTS, batch_size=256, lr=1e-3, learn_step=session.turns, gamma=1.0,
        gae_lambda=0.975, ent_coef=0.005, max_grad_norm=1.0, update_epochs=4,
        normalize_images=False,
        actor_networks=[Actor(agent) for agent in AGENTS],
        critic_networks=[Critic(agent) for agent in AGENTS],
    )  # fmt: skip
    # The report checks that the weights of these networks change.
    session.watch(*(both.actors[agent].network for agent in AGENTS))
    observations = renamed(env.reset(seed=session.seed)[0])
    done = dict.fromkeys(AGENTS, np.zeros(1))
    while session.go_on():
        turns: list[dict[str, list[Any]]] = [{agent: [] for agent in AGENTS} for _ in range(6)]
        for _ in range(session.turns):
            actions, log_probs, _, values = both.get_action(observations)
            next_observations, rewards, terminated, truncated, _ = env.step(
                {agent: int(action[0]) for agent, action in actions.items()}
            )
            for agent in AGENTS:
                reward = {agent: np.array([rewards[agent]])}
                step = (observations, actions, log_probs, reward, done, values)
                for column, value in zip(turns, step, strict=True):
                    column[agent].append(value[agent])
            done = {a: np.array([float(terminated[a] or truncated[a])]) for a in AGENTS}
            observations = renamed(next_observations if env.agents else env.reset()[0])
        for agent in AGENTS:
            session.credit(agent, np.sum(turns[3][agent]))
        both.learn((*turns, observations, done))
        print(f"{session.placed:,} items, reward per item {2 * np.mean(turns[3][AGENTS[1]]):.4f}")


if __name__ == "__main__":
    sys.exit(run("AgileRL", "agilerl", train, description=__doc__))
