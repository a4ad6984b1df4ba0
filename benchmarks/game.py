"""Measure the speed of the game: ``python -m benchmarks.game``.

The games are random legal play with the masks of all six orientations at every step, including the
random choice. Measured are N games at once on every device, the cost for several sizes of the grid,
and one game through the PettingZoo view.
"""

from __future__ import annotations

import time

import numpy as np
import torch

from benchmarks.record import Measurements
from benchmarks.timing import devices
from marl_pack import env_aec
from marl_pack.agents.heuristics import make_policy
from marl_pack.backend import Backend
from marl_pack.game.packing import Packing


def steps_per_second(game: Packing, seconds: float = 1.0, repeats: int = 5) -> float:
    """Return items placed per second of CPU time (on CUDA wall time), the best of ``repeats``."""
    on_cpu = game.device.type == "cpu"
    clock = time.process_time if on_cpu else time.perf_counter
    policy = make_policy("random", 0, game.device)
    for _ in range(30):
        game.place(*policy(game))
    best = 0.0
    for _ in range(repeats):
        start, steps = clock(), 0
        while clock() - start < seconds:
            for _ in range(10):
                game.place(*policy(game))
            steps += 10 * game.n
            if not on_cpu:
                torch.cuda.synchronize()
        best = max(best, steps / (clock() - start))
    return best


def batched(measured: Measurements) -> None:
    """Measure steps per second for several numbers of games."""
    for device in devices():
        for n in (1, 64, 1024, 4096) if device == "cpu" else (1024, 4096, 16384, 65536):
            speed = steps_per_second(Packing(n, device=device))
            measured.keep(f"N = {n:,}, {device}", steps_per_second=speed)
    for n in (64, 1024):
        speed = steps_per_second(Packing(n, backend=Backend.TENSOR))
        measured.keep(f"N = {n:,}, cpu, tensor code", steps_per_second=speed)


def scaling(measured: Measurements) -> None:
    """Measure steps per second for several sizes of the grid; the items grow with the bin."""
    for side in (10, 20, 40, 80, 160):
        n = max(4, 1024 * 100 // side**2)
        game = Packing(n, (side, side, side), sides=(side // 5, side // 2))
        each = 1 / steps_per_second(game, 0.5, 3)
        measured.keep(f"grid: {side}³", n=n, us_step=1e6 * each, ns_step_cell=1e9 * each / side**2)


def through_pettingzoo(measured: Measurements, seconds: float = 1.0, repeats: int = 5) -> None:
    """Measure turns per CPU second of one game through the AEC view with all its wrappers."""
    env = env_aec.env()
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    best = 0.0
    for _ in range(repeats):
        start, turns = time.process_time(), 0
        while time.process_time() - start < seconds:
            for agent in env.agent_iter():
                observation, _, terminated, truncated, _ = env.last()
                if terminated or truncated:
                    env.step(None)
                    continue
                legal = np.flatnonzero(observation["action_mask"])
                env.step(legal[generator.integers(len(legal))])
                turns += 1
                del agent
            env.reset()
        best = max(best, turns / (time.process_time() - start))
    measured.keep("PettingZoo, one bin", turns_per_second=best)


def main() -> None:
    """Measure all figures of this benchmark."""
    measured = Measurements("game", __doc__, seed=0)
    measured.parse()
    torch.set_num_threads(1)
    batched(measured)
    scaling(measured)
    through_pettingzoo(measured)


if __name__ == "__main__":
    main()
