"""Measure the speed of training: ``python -m benchmarks.training``.

The program measures items per second of whole PPO iterations with rollout and update (the best of
several, as disturbances only slow them down), and the share of each part: the game with its masks,
networks (forward, backward, optimiser), rsl_rl's own code (storage, minibatches, advantages, loss),
and the rest.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from benchmarks.record import Measurements
from benchmarks.timing import devices
from marl_pack.agents.learning.runner import Runner
from marl_pack.config import parse
from marl_pack.training.assembly import fast_precision, make_runner

CONFIGS = Path(__file__).parent.parent / "configs"
TRAINED = ("paper", "plain")
"""Names of the configs whose training is measured with many bins."""
PARTS = ("game", "networks", "rsl_rl", "rest")


class Split:
    """The time spent in each part of a program, without the calls to other parts.

    Args:
        clock: returns seconds.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self.clock = clock
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.part, self.since = "rest", clock()

    def enter(self, part: str) -> str:
        """Count the time from now on for ``part``; return the previous part."""
        now = self.clock()
        self.seconds[self.part] += now - self.since
        before, self.part, self.since = self.part, part, now
        return before

    def watch(self, owner: Any, name: str, part: str) -> None:
        """Count the time in the method ``owner.name`` for ``part``."""
        method = getattr(owner, name)

        def watched(*args: Any, **named: Any) -> Any:
            before = self.enter(part)
            try:
                return method(*args, **named)
            finally:
                self.enter(before)

        setattr(owner, name, watched)


def watched(runner: Runner, split: Split) -> None:
    """Count the time in each part of a runner's iterations."""
    for name in ("step", "get_observations"):
        split.watch(runner.env, name, "game")
    split.watch(runner.alg, "_observation", "game")  # of the second turn
    for ppo in runner.alg.learners.values():
        for name in ("act", "process_env_step", "compute_returns", "update"):
            split.watch(ppo, name, "rsl_rl")
        for model in (ppo.actor, ppo.critic):
            split.watch(model, "forward", "networks")
        split.watch(ppo.actor.distribution, "log_prob", "networks")
        split.watch(ppo.optimizer, "step", "networks")
        split.watch(ppo.optimizer, "zero_grad", "networks")
    split.watch(runner.logger, "process_env_step", "rsl_rl")


def measure(
    config_name: str, device: str, seconds: float, *options: str
) -> tuple[float, dict[str, float]]:
    """Return items per second of CPU time (on CUDA of wall time), and the share of each part."""
    config, _ = parse([
        f"--config={CONFIGS / config_name}.yaml", f"--device={device}", "--evaluation.every=0",
        *options,
    ])  # fmt: skip
    on_cpu = device == "cpu"

    def clock() -> float:
        if on_cpu:
            return time.process_time()
        torch.cuda.synchronize()
        return time.perf_counter()

    runner = make_runner(config, None)
    runner.train(1)
    items = config.ppo.num_envs * config.ppo.num_steps_per_env
    best, done, start = 0.0, 1, clock()
    while clock() - start < seconds or done < 4:
        begun = clock()
        done += 1
        runner.train(done)
        best = max(best, items / (clock() - begun))
    # The shares are measured separately, as this costs time (on CUDA it waits at every call).
    split = Split(clock)
    watched(runner, split)
    backward, clip = torch.Tensor.backward, torch.nn.utils.clip_grad_norm_
    split.watch(torch.Tensor, "backward", "networks")
    split.watch(torch.nn.utils, "clip_grad_norm_", "networks")
    try:
        split.enter("rest")
        split.seconds.clear()
        runner.train(done + 2)
        split.enter("rest")
    finally:
        torch.Tensor.backward = backward  # type: ignore[method-assign]  # as it was
        torch.nn.utils.clip_grad_norm_ = clip
    total = sum(split.seconds.values())
    return best, {part: split.seconds[part] / total for part in PARTS}


def main() -> None:
    """Measure the training of each config."""
    measured = Measurements("training", __doc__, seed=0)
    add = measured.options.add_argument
    add("--seconds", type=float, default=20.0,
        help="shortest time of each measurement (default: 20)")  # fmt: skip
    chosen = measured.parse()
    torch.set_num_threads(1)
    for device in devices():
        rows = [
            (f"{config}, N = {bins:,}", config, [f"--ppo.num_envs={bins}"])
            for config in TRAINED
            for bins in ((256, 1024) if device == "cpu" else (4096, 16384))
        ]
        many = [] if device == "cpu" else ["--ppo.num_envs=4096"]
        default = "default, N = 4,096" if many else "default"
        rows.append((default, "default", ["--ppo.precision=float32", *many]))
        if fast_precision("bfloat16", device):
            rows.append((f"{default}, bfloat16", "default", ["--ppo.precision=bfloat16", *many]))
        for name, config, options in rows:
            rate, shares = measure(config, device, chosen.seconds, *options)
            measured.keep(f"{name}, {device}", items_per_second=rate, **shares)


if __name__ == "__main__":
    main()
