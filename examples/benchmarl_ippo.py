"""BenchMARL: IPPO for both agents, on the environment as a BenchMARL task.

It runs with benchmarl 1.5, which needs an older TorchRL and therefore its own virtual environment:
    pip install -e ".[benchmarl]" && python examples/benchmarl_ippo.py --items 1000000 --minutes 10

In ten minutes on a busy core, training placed 29,696 items. Mean utilization rose from 58.9 % to
71.6 %.

Traps:
- BenchMARL's losses also include the turns of the *other* agent. ``MaskedModel`` returns constant
  logits in these turns, so that no gradient reaches the policy. The critic learns their values.
- BenchMARL gives all environments of a task the same seed, so all would play the same items.
  ``PackingTask`` gives each environment the next seed.
- BenchMARL's PPO does not normalise advantages. They are small here, so the weight of the entropy
  has to be small too.
- By default a task hides the mask from the model. The `observation_spec` of ``PackingTask``
  includes it.
"""

import sys
import tempfile
from contextlib import suppress
from typing import Any

from benchmarl.algorithms import IppoConfig
from benchmarl.experiment import Callback, Experiment, ExperimentConfig

from marl_pack.env_aec import AGENTS
from marl_pack.integrations.benchmarl import MaskedModelConfig, PackingTask
from marl_pack.integrations.network import ActorCritic
from session import Session, current, run


class Counted(PackingTask):
    """The task with environments that the session counts."""

    def make_env(self) -> Any:
        """Return one new environment of the session."""
        return current().env()


class Enough(KeyboardInterrupt):
    """Raised to end an experiment early: BenchMARL closes it and passes this exception on."""


class Credit(Callback):
    """A callback that records in the session the rewards that BenchMARL stored for the agents."""

    def on_batch_collected(self, batch: Any) -> None:
        """Record the rewards of a batch; end training when enough items have been played."""
        for agent in AGENTS:
            current().credit(agent, batch["next", agent, "reward"].sum())
        print(f"{current().placed:,} items")
        if not current().go_on():
            raise Enough


def train(session: Session) -> None:
    """Train both agents until the session ends."""
    settings = ExperimentConfig.get_from_yaml()
    settings.gamma, settings.lr, settings.clip_grad_val = 1.0, 1e-3, 1.0
    settings.on_policy_collected_frames_per_batch = session.turns
    settings.on_policy_n_envs_per_worker = 8
    settings.on_policy_n_minibatch_iters = 4
    settings.on_policy_minibatch_size = min(256, session.turns)  # half are the other agent's
    settings.evaluation, settings.create_json, settings.loggers = False, False, []
    settings.max_n_frames = 10**9
    algorithm = IppoConfig.get_from_yaml()
    algorithm.entropy_coef, algorithm.lmbda, algorithm.critic_coef = 0.0005, 0.975, 0.5
    with tempfile.TemporaryDirectory() as folder:
        settings.save_folder = folder
        experiment = Experiment(
            Counted("PACKING", {}), algorithm, MaskedModelConfig(), session.seed, settings,
            callbacks=[Credit()],
        )  # fmt: skip
        # The report checks that the weights of these networks change.
        session.watch(*(
            next(m for m in experiment.group_policies[a].modules() if isinstance(m, ActorCritic))
            for a in AGENTS
        ))  # fmt: skip
        with suppress(Enough):
            experiment.run()


if __name__ == "__main__":
    sys.exit(run("BenchMARL", "benchmarl", train, description=__doc__))
