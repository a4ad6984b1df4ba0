"""The records that the two turns of a step return."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Oriented:
    """The visible item in the chosen orientation, and its legal cells, for the placement turn."""

    sides: Tensor  # int16 [G, 3]    the item's sides along x, y, z
    mask: Tensor  # bool [G, W, D]   the cells where it may be placed


@dataclass(frozen=True)
class Outcome:
    """The result of placing an item in each game."""

    reward: Tensor  # float32 [G]   Eq. 5
    done: Tensor  # bool [G]        whether the episode ended with this placement
    filled: Tensor  # int64 [G]     cells filled in the bin after the placement, before any reset
    placed: Tensor  # int64 [G]     boxes in the bin after the placement, before any reset
    volume: int  # volume of a bin, in cells

    @property
    def utilization(self) -> Tensor:
        """Share of each bin's volume filled right after the placement, float64 [G]."""
        return self.filled.double() / self.volume
