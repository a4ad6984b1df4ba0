"""The turn of a packer, as policies of the exact world see it."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from marl_pack.exact.bins import ListedMoves
from marl_pack.exact.options import Options
from marl_pack.exact.spec import ExactSpec


class Turn(Options):
    """The options of a packer's decision; it has what policies read of ``ExactPacking``.

    With one visible box and one open bin there is one option, ``Turn(bins, items)``.
    """

    @property
    def spec(self) -> ExactSpec:
        """The options of the game."""
        return self.open.spec

    @cached_property
    def alive(self) -> NDArray[np.bool_]:
        """Whether each option's bin has memory for the box, bool [G]."""
        alive: NDArray[np.bool_] = self.bins.state.count < self.spec.max_boxes
        return alive

    @cached_property
    def moves(self) -> ListedMoves:
        """The legal moves of each option."""
        return self.bins.moves(self.items, self.alive)

    @property
    def number(self) -> int:
        """Number of the decision, from 1."""
        return len(self.before) + 1
