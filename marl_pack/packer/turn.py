"""One visible box and one bin, as policies of the exact world see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from marl_pack.exact.bins import ExactBins, ListedMoves
from marl_pack.exact.goods import Goods, joined
from marl_pack.exact.spec import ExactSpec


@dataclass(frozen=True)
class Turn:
    """The turn of a game with one bin; it has what policies read of ``ExactPacking``."""

    bins: ExactBins  # one bin
    items: Goods  # the visible box, one row
    before: Sequence[Goods] = ()  # the boxes that came before it, one row each

    @property
    def spec(self) -> ExactSpec:
        """The options of the game."""
        return self.bins.spec

    @property
    def alive(self) -> NDArray[np.bool_]:
        """Whether the bin has memory for the box, bool [1]."""
        return self.bins.state.count < self.spec.max_boxes

    @property
    def episode(self) -> NDArray[np.int64]:
        """Number of the episode: always 0, int64 [1]."""
        return np.zeros(1, np.int64)

    @cached_property
    def moves(self) -> ListedMoves:
        """The legal moves of the visible box."""
        return self.bins.moves(self.items, self.alive)

    @property
    def number(self) -> int:
        """Number of boxes shown so far, the visible one included."""
        return len(self.before) + 1

    def shown(self, g: int) -> Goods:
        """Return the boxes shown so far, in order; the visible one is the last. ``g`` is 0."""
        return joined([*self.before, self.items], self.spec.unit_mm)
