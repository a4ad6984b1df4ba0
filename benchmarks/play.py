"""Measure the speed of learned agents: ``python -m benchmarks.play``.

The published model ``rs`` plays generated sequences in the bin of its training: many games at once
without a plan, as in an evaluation, and a single game with a plan, as a robot waits for it.
"""

from __future__ import annotations

import statistics
import time

import torch

from benchmarks.record import Measurements
from benchmarks.states import SMALL
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.loading import Loader
from marl_pack.agents.policy import Policy
from marl_pack.agents.search_settings import SearchSettings
from marl_pack.game.packing import Packing
from marl_pack.items import make_stream

GAMES = 500
"""Games that are played at once."""
PLAN = "rollouts=4,top=16,depth=2"
SIZE, SIDES = SMALL


def evaluation(policy: Policy, episodes: int = GAMES) -> float:
    """Return the decisions per CPU second while all games are played to their end."""
    game = Packing(episodes, SIZE, sides=SIDES, seed=7, auto_reset=False)
    decisions, start = 0, time.process_time()
    while bool(game.alive.any()):
        decisions += int(game.alive.sum())
        game.place(*policy(game))
    return decisions / (time.process_time() - start)


def one_bin(policy: Policy, episodes: int = 3) -> float:
    """Return the CPU seconds of a decision for a single bin: the median over some episodes."""
    seconds = []
    for episode in range(episodes):
        game = Packing(1, SIZE, sides=SIDES, seed=7, first_episode=episode, auto_reset=False)
        while bool(game.alive.any()):
            start = time.process_time()
            choice = policy(game)
            seconds.append(time.process_time() - start)
            game.place(*choice)
    return statistics.median(seconds)


def main() -> None:
    """Measure both; each is the best of several, as disturbances only slow them down."""
    measured = Measurements("play", __doc__, seed=7)
    measured.parse()
    torch.set_num_threads(1)
    checkpoint, loader = checkpoints.read("rs"), Loader()
    agents = loader.policy_of(checkpoint)
    futures = make_stream("rs", SIZE, SIDES)
    planner = loader.planner(checkpoint, SearchSettings.parse(PLAN), futures)
    rate = max(evaluation(agents) for _ in range(3))
    measured.keep(f"rs, N = {GAMES}, cpu", decisions_per_second=rate)
    for name, policy in (("no plan", agents), (f"plan {PLAN}", planner)):
        seconds = min(one_bin(policy) for _ in range(3))
        measured.keep(f"rs, one bin, {name}, cpu", ms_decision=1000 * seconds)


if __name__ == "__main__":
    main()
