"""Measure what planning gains and costs: ``python -m experiments.planning``.

The program plays the same generated RS sequences with each plan. The gain over the agents without a
plan is computed for each episode. A decision is timed twice: on average over many bins that are
played at once, and for a single bin, as a robot waits for it. These are wall times: run nothing
else on the machine.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.record import record
from experiments.rows import Rows, main_of, mean
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.loading import Loader
from marl_pack.agents.policy import Policy
from marl_pack.agents.search_settings import SearchSettings
from marl_pack.evaluation.rollout import play
from marl_pack.game.packing import Packing
from marl_pack.items import make_stream

PLANS = ("rollouts=16,top=4,depth=2",)
NONE = "none"


def main() -> int:
    """Play with each plan that is missing; return the exit status."""
    rows = Rows("python -m experiments.planning", __doc__)
    add = rows.options.add_argument
    add("--checkpoint", default="rs", help="checkpoint to play with (default: rs)")
    add("--plans", nargs="+", default=PLANS, metavar="rollouts=K,top=M,depth=D")
    add("--episodes", type=int, default=400, help="number of sequences (default: 400)")
    add("--seed", type=int, default=5, help="seed of the sequences (default: 5)")
    add("--threads", type=int, default=2, help="threads on the CPU (default: 2)")
    chosen = rows.parse()
    torch.set_num_threads(chosen.threads)
    checkpoint = checkpoints.read(chosen.checkpoint)
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

    def measured(policy: Policy) -> tuple[NDArray[np.float64], dict[str, float]]:
        """Return the utilization of each episode, and the milliseconds of a decision."""
        rollout = play(policy, game, chosen.episodes)
        return rollout.utilization, {
            "ms_decision": 1000 * rollout.seconds / float(rollout.packed.sum()),
            "ms_one_bin": 1000 * alone(policy),
        }

    results, loader = rows.results("planning"), Loader()
    plain = None
    keys = {f"{chosen.checkpoint}, {plan}": plan for plan in (NONE, *chosen.plans)}
    for key in rows.missing(results, keys):
        own = record(
            f"python -m experiments.planning --checkpoint {chosen.checkpoint} "
            f"--episodes {chosen.episodes}", [chosen.seed], chosen.threads,
        )  # fmt: skip
        if plain is None:
            plain, times = measured(loader.policy_of(checkpoint))
        if keys[key] != NONE:
            search = SearchSettings.parse(keys[key])
            utilization, times = measured(loader.planner(checkpoint, search, stream))
            gain = {"gain": mean(utilization - plain)}
        else:
            utilization, gain = plain, {}
        figures = {"episodes": chosen.episodes, "utilization": mean(utilization), **gain, **times}
        results.put(key, figures, own)
    return 0


if __name__ == "__main__":
    sys.exit(main_of(main))
