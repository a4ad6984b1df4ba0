"""BenchMARL: IPPO for both agents, through a task of our own.

Versions: benchmarl 1.5, which needs an older TorchRL, and so an environment of its own:
    pip install ".[benchmarl]" && python examples/benchmarl_ippo.py --items 1000000 --minutes 10
    Ten minutes on a busy core: 29,696 items, utilization 58.9 → 71.6 %

Traps:
- BenchMARL's losses also run over the turns of the *other* agent. :class:`MaskedModel` gives
  constant logits there, so that no gradient reaches the policy; the critic learns their values.
- BenchMARL gives all environments of a task the same seed: :class:`Packing` counts instead.
- Its PPO does not normalise advantages, which are small here: so is the entropy's weight.
- A task keeps the mask from the model; here `observation_spec` shows it.
"""

import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from typing import Any

import torch
from benchmarl.algorithms import IppoConfig
from benchmarl.environments.pettingzoo.common import PettingZooClass
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.common import Model, ModelConfig
from torchrl.envs.libs.pettingzoo import PettingZooWrapper

from marl_pack.env_aec import AGENTS
from marl_pack.integrations.network import ActorCritic
from marl_pack.integrations.session import Session, current, run


class Packing(PettingZooClass):
    """The AEC environment as a task: every agent is a group, with exact masks."""

    def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: Any, device: Any) -> Any:
        """A function that makes one environment; each has its own items."""
        seeds = count(1000 * (seed or 0))
        return lambda: PettingZooWrapper(
            current().env(), use_mask=True, seed=next(seeds), categorical_actions=True,
            device=device,
        )  # fmt: skip

    def supports_discrete_actions(self) -> bool:
        """Both agents' actions are discrete."""
        return True

    def max_steps(self, env: Any) -> int:
        """In an evaluation; an episode ends by itself."""
        return 10**6

    def observation_spec(self, env: Any) -> Any:
        """What the model reads: the planes, the mask of actions, and whether the agent acts."""
        spec = env.observation_spec.clone()
        for group in self.group_map(env):
            del spec[group]["info"]
        return spec


class MaskedModel(Model):
    """An :class:`ActorCritic` as BenchMARL wants it; as a critic it gives values."""

    def __init__(self, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.network = ActorCritic(self.agent_group.partition("_")[0])

    def _forward(self, tensordict: Any) -> Any:
        seen = tensordict[self.agent_group]
        planes, mask = seen["observation", "observation"], seen["action_mask"]
        lead = planes.shape[:-3]
        logits, values = self.network(
            planes.reshape(-1, *planes.shape[-3:]), mask.reshape(-1, mask.shape[-1])
        )
        if self.is_critic:
            tensordict[self.out_key] = values.reshape(*lead, 1)
        else:
            acts = seen["mask"].reshape(*lead, 1)
            tensordict[self.out_key] = torch.where(acts, logits.reshape(*lead, -1), 0)
        return tensordict


@dataclass
class MaskedModelConfig(ModelConfig):
    """Settings of :class:`MaskedModel`: none."""

    @staticmethod
    def associated_class() -> type[Model]:
        """Whose settings these are."""
        return MaskedModel


class Enough(KeyboardInterrupt):
    """Ends an experiment before its time: BenchMARL closes it and lets this through."""


class Account(Callback):
    """Tells the session what BenchMARL has put down for the agents."""

    def on_batch_collected(self, batch: Any) -> None:
        """Take the rewards down."""
        for agent in AGENTS:
            current().credit(agent, batch["next", agent, "reward"].sum())
        print(f"{current().placed:,} items")
        if not current().go_on():
            raise Enough


def train(session: Session) -> None:
    """Train both agents."""
    settings = ExperimentConfig.get_from_yaml()
    settings.gamma, settings.lr, settings.clip_grad_val = 1.0, 1e-3, 1.0
    settings.on_policy_collected_frames_per_batch = session.turns
    settings.on_policy_n_envs_per_worker = 8
    settings.on_policy_n_minibatch_iters = 4
    settings.on_policy_minibatch_size = min(256, session.turns)  # every second turn is the other's
    settings.evaluation, settings.create_json, settings.loggers = False, False, []
    settings.max_n_frames = 10**9
    algorithm = IppoConfig.get_from_yaml()
    algorithm.entropy_coef, algorithm.lmbda, algorithm.critic_coef = 0.0005, 0.975, 0.5
    with tempfile.TemporaryDirectory() as folder:
        settings.save_folder = folder
        experiment = Experiment(
            Packing("PACKING", {}), algorithm, MaskedModelConfig(), session.seed, settings,
            callbacks=[Account()],
        )  # fmt: skip
        session.watch(*(
            next(m for m in experiment.group_policies[a].modules() if isinstance(m, ActorCritic))
            for a in AGENTS
        ))  # fmt: skip
        with suppress(Enough):
            experiment.run()


if __name__ == "__main__":
    sys.exit(run("BenchMARL", "benchmarl", train, description=__doc__))
