"""Find the weights of the linear score for a user's goods, by CMA-ES (Hansen & Ostermeier 2001).

All weight vectors of a generation pack the same episodes, and every generation has new ones. The
episodes on which the result is measured at the end are used for nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from marl_pack.exact.choice import LINEAR
from marl_pack.exact.packing import ExactPacking
from marl_pack.exact.policies import Scored
from marl_pack.exact.spec import ExactSpec
from marl_pack.exact.streams import GoodsStream
from marl_pack.extras import missing

T = TypeVar("T")

SPREAD = 0.3
"""Standard deviation of the weights in the first generation."""
POPULATION = 14
"""Weight vectors in a generation, by default."""
MEASURED = 1 << 40
"""Number of the first episode on which the result is measured, for streams without end."""
HELD_BACK = 5
"""Of a stream with an end, every fifth episode is used only to measure the result."""


@dataclass(frozen=True)
class Generation:
    """The state of the search after one generation."""

    number: int
    weights: NDArray[np.float64]  # [F]  mean of the search distribution
    share: float  # mean over all weight vectors of the generation


class Episodes:
    """Which episodes of a stream are used to tune and which to measure.

    Args:
        stream: the goods.
        seed: seed of the choice of episodes.

    Raises:
        ValueError: if the stream has fewer than two episodes.
    """

    def __init__(self, stream: GoodsStream, seed: int) -> None:
        if stream.episodes is not None and stream.episodes < 2:
            raise ValueError(
                "tuning needs two or more sequences, or boxes drawn at random (order 'draw')"
            )
        self.stream = stream
        self.generator = np.random.default_rng(seed)
        numbers = np.arange(stream.episodes or 0)
        held = numbers % min(HELD_BACK, max(2, len(numbers))) == 1
        self.own, self.held_back = numbers[~held], numbers[held]

    def tuning(self, count: int) -> list[int]:
        """Return the episodes of the next generation."""
        if self.stream.episodes is None:
            return self.generator.integers(0, MEASURED, count).tolist()
        count = min(count, len(self.own))
        return self.generator.choice(self.own, count, replace=False).tolist()

    def measuring(self, count: int) -> list[int]:
        """Return the episodes on which the result is measured."""
        if self.stream.episodes is None:
            return list(range(MEASURED, MEASURED + count))
        return self.held_back[:count].tolist()


@dataclass(frozen=True)
class Chosen:
    """A stream with some episodes of another one."""

    stream: GoodsStream
    numbers: list[int]

    @property
    def goods(self) -> Any:
        """The goods of the other stream."""
        return self.stream.goods

    @property
    def episodes(self) -> int | None:
        """Number of chosen episodes."""
        return len(self.numbers)

    def sequence(self, episode: int) -> NDArray[np.int64]:
        """Return the sequence of one of the chosen episodes."""
        return self.stream.sequence(self.numbers[episode % len(self.numbers)])

    def seeded(self, seed: int) -> Chosen:
        """Return the stream with another seed."""
        return replace(self, stream=self.stream.seeded(seed))


def utilizations(
    weights: NDArray[np.float64], stream: GoodsStream, spec: ExactSpec, numbers: list[int]
) -> NDArray[np.float64]:
    """Pack episodes with weights of the linear score; return the utilization of each, float64 [E].

    Args:
        weights: float64 [F].
        stream: the goods.
        spec: the game.
        numbers: the episodes.
    """
    game = ExactPacking(len(numbers), Chosen(stream, numbers), spec=spec, auto_reset=False)
    policy = Scored(LINEAR, weights)
    while game.alive.any():
        game.place(policy(game))
    return game.bins.utilization


def tune(
    share: Callable[[NDArray[np.float64], T], float],
    draw: Callable[[], T],
    *,
    start: NDArray[np.float64],
    population: int = POPULATION,
    seed: int = 0,
) -> Iterator[Generation]:
    """Improve the weights of the linear score; yield after each generation, without end.

    Args:
        share: (weights, episodes) → what is to be made as large as possible, such as the mean
            utilization.
        draw: returns the episodes of the next generation.
        start: float64 [F], the first mean.
        population: weight vectors in a generation.
        seed: seed of the search.

    Raises:
        ModuleNotFoundError: if the package cmaes is not installed.
    """
    try:
        from cmaes import CMA
    except ModuleNotFoundError as error:
        raise missing(error, "tuning needs cmaes", "tune") from None
    search = CMA(mean=start.copy(), sigma=SPREAD, seed=seed % 2**32, population_size=population)
    for number in count(1):
        episodes = draw()
        vectors = [search.ask() for _ in range(population)]
        shares = [share(weights, episodes) for weights in vectors]
        search.tell([(weights, -value) for weights, value in zip(vectors, shares, strict=True)])
        yield Generation(number, search.mean.copy(), float(np.mean(shares)))
