"""skrl: IPPO for both agents, on the environment's parallel view, turn by turn.

It runs with skrl 2.1:
    pip install -e ".[skrl]" && python examples/skrl_ippo.py --items 1000000 --minutes 10

In ten minutes on a busy core, training placed 34,816 items. Mean utilization rose from 52.3 % to
69.6 %.

Traps:
- skrl supports only PettingZoo's parallel API. In `env_aec.parallel_env()` a step is one agent's
  turn, so its masks are exact. If both agents acted at once, the placement agent would see an
  outdated mask.
- skrl has no masks: the model has to apply them, as ``MaskedModel`` does.
- skrl records every turn for both agents. In the other agent's turn no action is legal. The logits
  are constant there, so no gradient reaches the policy from that turn. The critic learns its value.
- skrl 2.1 refuses empty dictionaries in its settings: each dictionary has to name the agents.
- skrl's wrapper calls `state()` after each step, so the environment needs this method.
"""

import sys
from typing import Any

from skrl import config
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.multi_agents.torch.ippo import IPPO, IPPO_CFG
from skrl.trainers.torch import SequentialTrainer, SequentialTrainerCfg

from marl_pack.env_aec import AGENTS
from marl_pack.integrations.skrl import MaskedModel
from session import Session, run


class Credited(IPPO):
    """An IPPO that records in the session the rewards that skrl stores for the agents."""

    session: Session

    def record_transition(self, **transition: Any) -> None:
        """Record a turn and its rewards."""
        for agent, reward in transition["rewards"].items():
            self.session.credit(agent, reward)
        super().record_transition(**transition)


def train(session: Session) -> None:
    """Train both agents until the session ends."""
    config.torch.device = "cpu"
    config.torch.key = session.seed  # seed of the items, which the wrapper's first reset uses
    env = wrap_env(session.parallel_env(), wrapper="pettingzoo")
    spaces = {
        agent: {
            "observation_space": env.observation_space(agent),
            "state_space": env.state_space(agent),
            "action_space": env.action_space(agent),
        }
        for agent in AGENTS
    }
    models = {agent: MaskedModel(agent, **spaces[agent]) for agent in AGENTS}
    no_options: dict[str, Any] = {agent: {} for agent in AGENTS}
    both = Credited(
        possible_agents=AGENTS,
        models={agent: {"policy": model, "value": model} for agent, model in models.items()},
        memories={agent: RandomMemory(memory_size=session.turns) for agent in AGENTS},
        observation_spaces=env.observation_spaces,
        state_spaces=env.state_spaces,
        action_spaces=env.action_spaces,
        cfg=IPPO_CFG(
            rollouts=session.turns, learning_epochs=4, mini_batches=max(1, session.turns // 128),
            discount_factor=1.0, gae_lambda=0.975, learning_rate=1e-3, grad_norm_clip=1.0,
            value_clip=0.0, value_loss_scale=0.5, entropy_loss_scale=0.005,
            time_limit_bootstrap=True,
            experiment={"write_interval": 0, "checkpoint_interval": 0},
            learning_rate_scheduler_kwargs=no_options, observation_preprocessor_kwargs=no_options,
            state_preprocessor_kwargs=no_options, value_preprocessor_kwargs=no_options,
        ),
    )  # fmt: skip
    both.session = session
    # The report checks that the weights of these networks change.
    session.watch(*(models[agent].network for agent in AGENTS))
    # A call of train() is one rollout and one update; it begins with a new episode.
    settings = SequentialTrainerCfg(
        timesteps=session.turns,
        headless=True,
        disable_progressbar=True,
        close_environment_at_exit=False,
    )
    trainer = SequentialTrainer(env=env, agents=both, cfg=settings)
    while session.go_on():
        trainer.train()
        rewards = both.memories[AGENTS[1]].get_tensor_by_name("rewards")
        print(f"{session.placed:,} items, reward per item {2 * rewards.mean():.4f}")


if __name__ == "__main__":
    sys.exit(run("skrl", "skrl", train, description=__doc__))
