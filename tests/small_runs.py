"""Small training runs, their weights, and small disks, for the tests of several modules."""

import resource
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from marl_pack.agents.learning.runner import Runner
from marl_pack.agents.networks.planes import ENCODED
from marl_pack.config import Config, parse

PLAIN = f"--config={Path(__file__).parent.parent / 'configs' / 'plain.yaml'}"
"""Settings whose agents see no afterstates, which take most of a small run's time."""

PLAIN_NETWORK = {
    "channels": 8, "layers": 2, "shortcut": False, "context": False,
    "planes": ["mask", "resting_height", "waste"],
}  # fmt: skip
"""The shape of a small network of such agents."""

TINY = (
    PLAIN,
    "--game.bin=[4,4,4]", "--game.sides=[1,3]", "--ppo.num_envs=16", "--ppo.num_steps_per_env=4",
    "--ppo.num_mini_batches=2", "--evaluation.every=0", "--output.latest_every=1",
    "--orientation.network.channels=8", "--orientation.network.layers=2",
    "--placement.network.channels=8", "--placement.network.layers=2",
)  # fmt: skip


def tiny(*options: str) -> Config:
    """Return the settings of a run that takes a few seconds."""
    return parse([*TINY, *options])[0]


def weights(runner: Runner, name: str) -> dict[str, Tensor]:
    """Return copies of the weights of a learner's actor and critic."""
    ppo = runner.alg.learners[name]
    parts = {"actor": ppo.actor.state_dict(), "critic": ppo.critic.state_dict()}
    return {f"{k}.{n}": v.clone() for k, s in parts.items() for n, v in s.items()}


def rollout(runner: Runner) -> TensorDict:
    """Play and record a rollout of four steps; return the observation after it."""
    obs = runner.env.get_observations()
    with torch.inference_mode():
        for _ in range(4):
            actions = runner.alg.act(obs)
            obs, *rest = runner.env.step(actions)
            runner.alg.process_env_step(obs, *rest)
    return obs


def recorded_game(observations: TensorDict, size: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """Return the heightmaps and the items' sides, int16 in cells, in encoded observations."""
    channels = observations[ENCODED]
    sides = channels[..., 0, 0, 1:4] * torch.tensor(size)
    return (channels[..., 0] * size[2]).round().short(), sides.round().short()


def same(a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> bool:
    """Return whether two dicts hold the same tensors."""
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@contextmanager
def small_disk(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond so many bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
