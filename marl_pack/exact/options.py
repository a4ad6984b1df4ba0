"""The options of one decision: pairs of a visible box and an open bin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from marl_pack.exact.bins import ExactBins
from marl_pack.exact.goods import Goods, joined

ONLY = np.zeros((1, 2), np.int64)
"""The pair of the only box and the only bin."""


@dataclass(frozen=True, eq=False)
class Options:
    """G pairs of a visible box and an open bin, one of which is chosen.

    Policies see each option as a game of its own, with one box and one bin.

    Args:
        open: the open bins, b of them.
        known: the known boxes in the order in which they were shown: the visible ones, then those
            that may not be placed yet.
        buffer: number of visible boxes k; when one is placed, the next known box becomes visible.
        pairs: int64 [G, 2], box (a row of ``known``) and bin (a row of ``open``) of each option.
        before: the boxes that were shown before and are gone, one row each.
    """

    open: ExactBins
    known: Goods
    buffer: int = 1
    pairs: NDArray[np.int64] = field(default_factory=lambda: ONLY)
    before: Sequence[Goods] = ()

    @cached_property
    def bins(self) -> ExactBins:
        """The bin of each option, [G]; they may only be read."""
        alone = len(self.open) == 1 and len(self.pairs) == 1
        return self.open if alone else self.open.select(self.pairs[:, 1])

    @cached_property
    def items(self) -> Goods:
        """The box of each option, [G]."""
        return self.known[self.pairs[:, 0]]

    @property
    def episode(self) -> NDArray[np.int64]:
        """Number of the episode: always 0, int64 [G]."""
        return np.zeros(len(self.pairs), np.int64)

    def shown(self, g: int) -> Goods:
        """Return the boxes shown so far, in order; the known ones are the last. ``g`` is any."""
        return joined([*self.before, self.known], self.known.unit_mm)

    def values(self, weights: NDArray[np.float64], moves: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return how good the options are with these moves, float64 [G]; -inf for NOWHERE.

        The value is the linear score, with weights scaled to length 1, plus the relative size of
        the box: the cube root of its share of the bin's volume. So large boxes are placed first,
        unless a smaller one fits much better.

        Args:
            weights: float64 [F], of the linear score.
            moves: int64 [G], the best move of each option.
        """
        values = np.full(len(moves), -np.inf)
        sizes = np.cbrt(self.items.volumes / self.open.volume)
        scaled = weights / (float(np.linalg.norm(weights)) or 1.0)
        for g in np.flatnonzero(moves >= 0).tolist():
            features = self.bins.features(g, self.items.sides[g], moves[[g]])
            values[g] = float((features @ scaled)[0]) + sizes[g]
        return values
