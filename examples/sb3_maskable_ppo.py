"""sb3-contrib: MaskablePPO plays both agents' turns with one padded policy.

It runs with sb3-contrib 2.9:
    pip install -e ".[sb3]" && python examples/sb3_maskable_ppo.py --items 1000000 --minutes 10

In ten minutes on a busy core, training placed 79,872 items. Mean utilization rose from 45.6 % to
74.6 %.

Traps:
- Stable-Baselines3 supports one agent with one action space. ``pad_actions=True`` gives both turns
  the same spaces, and the observation a fifth plane that says whose turn it is. ``Turns`` presents
  the turns of both agents as the turns of one.
- MaskablePPO asks for a state's value without a mask, so ``MaskedPolicy`` reads the mask from the
  observation.
"""

import sys

from sb3_contrib import MaskablePPO

from marl_pack.env_aec import AGENTS
from marl_pack.integrations.sb3 import MaskedPolicy, Turns
from session import Session, run


def train(session: Session) -> None:
    """Train one policy for both agents."""
    env = Turns(session.env(pad_actions=True), session.seed)
    model = MaskablePPO(
        MaskedPolicy, env, learning_rate=1e-3, n_steps=session.turns, batch_size=128, n_epochs=4,
        gamma=1.0, gae_lambda=0.975, ent_coef=0.005, max_grad_norm=1.0, seed=session.seed,
        verbose=1, device="cpu",
    )  # fmt: skip
    # The report checks that the weights of this network change. It plays both agents' turns.
    session.watch(model.policy.network, model.policy.network)
    while session.go_on():  # each call of learn is one rollout and one update
        model.learn(session.turns, reset_num_timesteps=False)
        for agent in AGENTS:
            session.credit(agent, model.rollout_buffer.rewards.sum())


if __name__ == "__main__":
    sys.exit(run("sb3-contrib", "sb3-contrib", train, description=__doc__))
