"""Measure what planning gains and costs: ``python -m benchmarks.planning models/rs.pt``.

Plays the same generated sequences with each plan and prints mean utilization, the gain over the
agents without a plan episode by episode, each with its 95 % interval, and the time of a decision:
on average over the many bins that the evaluation plays at once, and for a single bin, as a robot
waits for it. These are wall times: run nothing else on the machine.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.timing import show
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.loading import Loader
from marl_pack.agents.policy import Policy
from marl_pack.agents.search import SearchSettings
from marl_pack.evaluation.rollout import play
from marl_pack.evaluation.statistics import interval
from marl_pack.game.packing import Packing
from marl_pack.items import make_stream

PLANS = (
    "rollouts=16,top=4,depth=1",
    "rollouts=32,top=4,depth=1",
    "rollouts=32,top=8,depth=1",
    "rollouts=16,top=4,depth=2",
)


def spread(values: NDArray[np.float64]) -> str:
    """Return the mean and half of its 95 % interval, in per cent of the bin."""
    low, high = interval(100 * values) or (np.nan, np.nan)
    return f"{100 * values.mean():+.2f} ± {(high - low) / 2:.2f}"


def main() -> None:
    """Play with each plan and print the table."""
    options = argparse.ArgumentParser(prog="python -m benchmarks.planning")
    options.add_argument("checkpoint", type=Path, help="trained on generated RS")
    options.add_argument("--plans", nargs="+", default=PLANS, metavar="rollouts=K,top=M,depth=D")
    options.add_argument("--episodes", type=int, default=500)
    options.add_argument("--seed", type=int, default=5, help="of the sequences")
    options.add_argument("--threads", type=int, default=2)
    options.add_argument("--symmetric", action="store_true",
                         help="ask the agents in all symmetries of the bin")  # fmt: skip
    chosen = options.parse_args()
    torch.set_num_threads(chosen.threads)
    checkpoint = checkpoints.read(chosen.checkpoint)
    loader = Loader(symmetric=chosen.symmetric)
    settings = checkpoint["config"]["game"]
    size = tuple(settings["bin"])
    stream = make_stream("rs", size, tuple(settings["sides"]))

    def game(n: int, first_episode: int) -> Packing:
        return Packing(
            n, size, stream, seed=chosen.seed, first_episode=first_episode, auto_reset=False
        )

    def alone(policy: Policy) -> float:
        """Return the seconds of a decision for a single bin: the median over two episodes."""
        decisions = []
        for episode in range(3):
            bin_ = game(1, episode)
            while bin_.alive.any():
                start = time.perf_counter()
                choice = policy(bin_)
                decisions.append((episode, time.perf_counter() - start))
                bin_.place(*choice)
        return float(np.median([seconds for episode, seconds in decisions if episode]))

    plain: NDArray[np.float64] | None = None
    table = []
    for text in ("", *chosen.plans):
        policy = (
            loader.planner(checkpoint, SearchSettings.parse(text), stream) if text
            else loader.policy_of(checkpoint)
        )  # fmt: skip
        rollout = play(policy, game, chosen.episodes)
        reached = rollout.utilization
        plain = reached if plain is None else plain
        table.append([
            text or "none", spread(reached).lstrip("+"), spread(reached - plain) if text else "",
            f"{1000 * rollout.seconds / rollout.packed.sum():.1f}", f"{1000 * alone(policy):.1f}",
        ])  # fmt: skip
        print(*table[-1], sep="  ", flush=True)
    show(
        f"planning, {chosen.episodes} episodes, {chosen.threads} threads"
        + (", all symmetries" if chosen.symmetric else ""),
        ["plan", "utilization %", "gain", "ms a decision", "ms, one bin alone"], table,
    )  # fmt: skip


if __name__ == "__main__":
    main()
