"""Measure the speed of the game: ``python -m benchmarks.game``.

Random feasible play with the masks of all six orientations at every step, choice included: N games
at once on every device, cost against the grid's size, and one game through the PettingZoo view.
"""

from __future__ import annotations

import time

import numpy as np
import torch

from benchmarks.timing import devices, show
from marl_pack import env_aec
from marl_pack.agents.heuristics import make_policy
from marl_pack.game.packing import Packing

OTHERS = (
    ("Zhao 2021 (1 orientation)", 1413),
    ("PCT, setting 1 (2 orientations)", 375),
    ("GOPT (2 orientations)", 318),
    ("LBCP's environment", 63),
)
"""Steps per CPU-second of other environments, each in its own code: one process, random feasible
play, 64 types, the feasibility mask at every step; measured side by side on one 2-core machine."""


def steps_per_second(game: Packing, seconds: float = 1.0, repeats: int = 5) -> float:
    """Return items placed per second of CPU time (on CUDA wall time): the best of ``repeats``."""
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


def batched() -> None:
    """Print steps per second against the number of games."""
    rows = []
    for device in devices():
        for n in (1, 64, 1024, 4096) if device == "cpu" else (1024, 4096, 16384, 65536):
            speed = steps_per_second(Packing(n, device=device))
            rows.append([f"marl_pack, N = {n:,}", device, f"{speed:,.0f}"])
    rows += [[name, "cpu, reported", f"{speed:,}"] for name, speed in OTHERS]
    show("steps a second, 10 × 10 × 10, 6 orientations", ["", "device", "steps/s"], rows)


def scaling() -> None:
    """Print steps per second against the grid's size; the items grow with the bin."""
    rows = []
    for side in (10, 20, 40, 80, 160):
        n = max(4, 1024 * 100 // side**2)
        game = Packing(n, (side, side, side), sides=(side // 5, side // 2))
        each = 1 / steps_per_second(game, 0.5, 3)
        rows.append([f"{side}³", f"{n}", f"{1e6 * each:,.2f}", f"{1e9 * each / side**2:.1f}"])
    columns = ["bin", "N", "µs a step", "ns a step and cell"]
    show("the game against the grid", columns, rows)


def through_pettingzoo(seconds: float = 1.0, repeats: int = 5) -> None:
    """Print turns per CPU-second of one game through the AEC view, in all its wrappers."""
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
    show("one bin, PettingZoo AEC", ["", "turns/s"], [["env()", f"{best:,.0f}"]])


def main() -> None:
    """Print all figures of this benchmark."""
    torch.set_num_threads(1)
    batched()
    scaling()
    through_pettingzoo()


if __name__ == "__main__":
    main()
