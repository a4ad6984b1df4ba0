"""Play episodes with a policy, many games at once."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from marl_pack.checks import whole_number
from marl_pack.plan import Plan

if TYPE_CHECKING:
    from marl_pack.agents.policy import Policy
    from marl_pack.exact.packing import ExactPacking
    from marl_pack.exact.policies import ExactPolicy
    from marl_pack.game.packing import Packing

BATCH = 1024  # games played at once, at most
BATCH_CELLS = 1 << 20  # cells in the maps of their bins, at most
BATCH_MM = 256  # games in millimetres played at once, at most


@dataclass(frozen=True)
class Rollout:
    """The packings of E episodes, and the time it took to play them."""

    plans: list[Plan]  # E plans in the order of episodes
    seconds: float  # spent in the game and the policy

    @property
    def utilization(self) -> NDArray[np.float64]:
        """Share of the volume of the bins that is filled in each episode, [E]."""
        return np.array([plan.utilization for plan in self.plans])

    @property
    def packed(self) -> NDArray[np.int64]:
        """Number of boxes packed in each episode, [E]."""
        return np.array([len(plan) for plan in self.plans], np.int64)


def play(
    policy: Policy,
    game: Callable[[int, int], Packing],
    episodes: int,
    progress: Callable[[int], object] = lambda done: None,
) -> Rollout:
    """Play episodes 0 … episodes - 1 to their end.

    The arguments are those of :func:`batches`.
    """
    parts = list(batches(policy, game, episodes, progress))
    return Rollout([plan for part in parts for plan in part.plans], sum(p.seconds for p in parts))


def batches(
    policy: Policy,
    game: Callable[[int, int], Packing],
    episodes: int,
    progress: Callable[[int], object] = lambda done: None,
) -> Iterator[Rollout]:
    """Play episodes 0 … episodes - 1 in batches, and yield each batch when it has ended.

    Args:
        policy: chooses orientation and cell.
        game: (n, first_episode) → n games without ``auto_reset``.
        episodes: number of episodes, E.
        progress: called with the number of episodes that have just ended.

    Raises:
        ValueError: unless ``episodes`` is a whole number ≥ 1.
    """
    episodes = whole_number(episodes, "episodes", 1)
    width, depth, _ = game(1, 0).size
    batch = max(1, min(BATCH, BATCH_CELLS // (width * depth)))
    for first in range(0, episodes, batch):
        games = game(min(batch, episodes - first), first)
        progress(int((~games.alive).sum()))
        start = time.perf_counter()
        while bool(games.alive.any()):
            outcome = games.place(*policy(games))
            progress(int(outcome.done.sum()))
        yield Rollout(games.plans(), time.perf_counter() - start)


def batches_mm(
    policy: ExactPolicy,
    game: Callable[[int, int], ExactPacking],
    episodes: int,
    progress: Callable[[int], object] = lambda done: None,
) -> Iterator[Rollout]:
    """Play episodes in millimetres in batches, like :func:`batches`.

    Args:
        policy: chooses the moves.
        game: (n, first_episode) → n games without ``auto_reset``.
        episodes: number of episodes, E.
        progress: called with the number of episodes that have just ended.

    Raises:
        ValueError: unless ``episodes`` is a whole number ≥ 1.
    """
    episodes = whole_number(episodes, "episodes", 1)
    for first in range(0, episodes, BATCH_MM):
        games = game(min(BATCH_MM, episodes - first), first)
        progress(int((~games.alive).sum()))
        start = time.perf_counter()
        while games.alive.any():
            outcome = games.place(policy(games))
            progress(int(outcome.done.sum()))
        yield Rollout([games.plan(g) for g in range(games.n)], time.perf_counter() - start)
