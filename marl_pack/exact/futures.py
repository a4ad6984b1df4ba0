"""Imagined futures: which boxes may come next."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from marl_pack.exact.goods import Goods


class Futures(Protocol):
    """Draws the boxes that may come after the visible one."""

    def draw(
        self, generator: np.random.Generator, visible: Goods, shown: Goods, length: int
    ) -> tuple[Goods, NDArray[np.int64]]:
        """Draw one future.

        Args:
            generator: of random numbers.
            visible: the visible box, one row.
            shown: all boxes that the conveyor has shown so far, in order; the visible one is the
                last.
            length: number of boxes to draw.

        Returns:
            Goods, and the rows of them that come, in order, int64 [length].
        """


@dataclass(frozen=True)
class Catalogue:
    """Futures drawn from goods that the user names, each box independent of the others.

    Args:
        goods: the goods.
        probabilities: float64 [R]; None for equal ones.
    """

    goods: Goods
    probabilities: NDArray[np.float64] | None = None

    def draw(
        self, generator: np.random.Generator, visible: Goods, shown: Goods, length: int
    ) -> tuple[Goods, NDArray[np.int64]]:
        """Draw rows of the catalogue."""
        return self.goods, generator.choice(len(self.goods), length, p=self.probabilities)


@dataclass(frozen=True)
class History:
    """Futures that follow the order of earlier deliveries.

    After each box comes the one that followed it in the history; where the history has several
    equal boxes, one of them is drawn. So runs of equal boxes, and boxes that belong together, come
    in futures, too. With the probability ``jump``, or after a box that the history does not have, a
    box of the history is drawn at random.

    Args:
        goods: boxes in the order in which they came.
        jump: probability that the next box is any one.
    """

    goods: Goods
    jump: float = 0.1

    @cached_property
    def _kinds(self) -> NDArray[np.int64]:
        """The kind of each box, int64 [R]: boxes of equal sides are of one kind."""
        _, kinds = np.unique(self.goods.sides, axis=0, return_inverse=True)
        return kinds.ravel()

    @cached_property
    def _equal(self) -> list[NDArray[np.int64]]:
        """The rows of the boxes of each kind."""
        rows = np.argsort(self._kinds, kind="stable")
        counts = np.bincount(self._kinds)
        return np.split(rows, counts.cumsum()[:-1])

    def draw(
        self, generator: np.random.Generator, visible: Goods, shown: Goods, length: int
    ) -> tuple[Goods, NDArray[np.int64]]:
        """Draw rows of the history."""
        kinds, equal = self._kinds, self._equal
        count = len(self.goods)
        points, jumps = generator.random(length), generator.random(length) < self.jump
        known = np.flatnonzero((self.goods.sides == visible.sides[0]).all(1))
        same = known
        rows = np.empty(length, np.int64)
        for t in range(length):
            row = int(same[int(points[t] * len(same))]) + 1 if len(same) else count
            if jumps[t] or row >= count:
                row = int(points[t] * count)
            rows[t] = row
            same = equal[kinds[row]]
        return self.goods, rows


@dataclass(frozen=True)
class Shown:
    """Futures like the boxes that this conveyor has shown so far, in their order.

    Args:
        jump: as in :class:`History`.
    """

    jump: float = 0.3

    def draw(
        self, generator: np.random.Generator, visible: Goods, shown: Goods, length: int
    ) -> tuple[Goods, NDArray[np.int64]]:
        """Draw rows of the boxes that were shown."""
        return History(shown, self.jump).draw(generator, visible, shown, length)
