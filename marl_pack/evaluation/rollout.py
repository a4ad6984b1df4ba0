"""Play episodes with a policy, many games at once."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from marl_pack.checks import whole_number
from marl_pack.explanation import Explanation
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


class Reasons:
    """Collects why each box of many games is where it is.

    Args:
        games: number of games, G.
    """

    def __init__(self, games: int) -> None:
        self._games: list[list[Explanation | None]] = [[] for _ in range(games)]

    def add(self, explanations: Sequence[Explanation | None] | None, counts: Sequence[int]) -> None:
        """Keep the explanations of the boxes that have just been placed.

        Args:
            explanations: one for each game, None for games that have ended; or None for nothing.
            counts: number of boxes in each game after the placement.
        """
        if explanations is None:
            return
        for own, explanation, count in zip(self._games, explanations, counts, strict=True):
            if explanation is not None and count > len(own):
                own += [None] * (count - 1 - len(own))  # boxes that were there at the beginning
                own.append(explanation)

    def of(self, plans: list[Plan]) -> list[Plan]:
        """Return the plans of the games, with their explanations."""
        if not any(self._games):
            return plans
        return [
            replace(plan, explanations=(*own, *[None] * (len(plan) - len(own))))
            for plan, own in zip(plans, self._games, strict=True)
        ]


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
    explained: bool = False,
) -> Iterator[Rollout]:
    """Play episodes 0 … episodes - 1 in batches, and yield each batch when it has ended.

    Args:
        policy: chooses orientation and cell.
        game: (n, first_episode) → n games without ``auto_reset``.
        episodes: number of episodes, E.
        progress: called with the number of episodes that have just ended.
        explained: whether the plans say why each box is where it is; the time to find out counts.

    Raises:
        ValueError: unless ``episodes`` is a whole number ≥ 1.
    """
    from marl_pack.agents.explaining import explain  # slow to import

    episodes = whole_number(episodes, "episodes", 1)
    one = game(1, 0)
    width, depth, _ = one.size
    cells = width * depth * getattr(one, "options", 1)  # a game with selection has more
    batch = max(1, min(BATCH, BATCH_CELLS // cells))
    for first in range(0, episodes, batch):
        games = game(min(batch, episodes - first), first)
        progress(int((~games.alive).sum()))
        start = time.perf_counter()
        reasons = Reasons(games.n)
        while bool(games.alive.any()):
            choice = policy(games)
            explanations = explain(policy, games, choice) if explained else None
            outcome = games.place(*choice)
            reasons.add(explanations, outcome.placed.tolist())
            progress(int(outcome.done.sum()))
        yield Rollout(reasons.of(games.plans()), time.perf_counter() - start)


def batches_mm(
    policy: ExactPolicy,
    game: Callable[[int, int], ExactPacking],
    episodes: int,
    progress: Callable[[int], object] = lambda done: None,
    explained: bool = False,
) -> Iterator[Rollout]:
    """Play episodes in millimetres in batches, like :func:`batches`.

    Args:
        policy: chooses the moves.
        game: (n, first_episode) → n games without ``auto_reset``.
        episodes: number of episodes, E.
        progress: called with the number of episodes that have just ended.
        explained: as for :func:`batches`.

    Raises:
        ValueError: unless ``episodes`` is a whole number ≥ 1.
    """
    from marl_pack.exact.explaining import explain  # slow to import

    episodes = whole_number(episodes, "episodes", 1)
    for first in range(0, episodes, BATCH_MM):
        games = game(min(BATCH_MM, episodes - first), first)
        progress(int((~games.alive).sum()))
        start = time.perf_counter()
        reasons = Reasons(games.n)
        while games.alive.any():
            moves = policy(games)
            explanations = None
            if explained:
                explanations = [
                    explain(policy, games, g, int(moves[g]), in_mm=False) if alive else None
                    for g, alive in enumerate(games.alive.tolist())
                ]
            outcome = games.place(moves)
            reasons.add(explanations, outcome.packed.tolist())
            progress(int(outcome.done.sum()))
        plans = reasons.of([games.plan(g) for g in range(games.n)])
        yield Rollout(plans, time.perf_counter() - start)
