"""The view of a turn of the game, from which observations are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from marl_pack import bins as bin_state
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.game.moves import Moves
from marl_pack.game.packing import Packing
from marl_pack.geometry import resting_heights_and_waste

Observation = Mapping[str, Tensor]
"""The tensors that an agent observes, by name."""


@dataclass(frozen=True)
class Sight:
    """One agent's view of a turn of G games.

    Args:
        game: the games.
        lookahead: computes afterstates and their values.
        planes: names of the planes to compute.
        orientation: int64 [G], the chosen orientations; None if they are not chosen yet.
    """

    game: Packing
    lookahead: Lookahead
    planes: Sequence[str]
    orientation: Tensor | None = None

    @cached_property
    def item(self) -> Tensor:
        """Sides of the item int16 [G, 3]: as it comes, or along x, y, z once it is oriented."""
        if self.orientation is None:
            return self.game.items.sides
        return self.game.orient(self.orientation, check=False).sides

    def judged(self, values: Tensor) -> Tensor:
        """Select the values [G, 6, …] of the A orientations that the agent judges, [G, A, …]."""
        if self.orientation is None:
            return values
        return Moves.gather(values, self.orientation)[:, None]

    @cached_property
    def mask(self) -> Tensor:
        """The cells where the item may be placed in the judged orientations, bool [G, A, W, D]."""
        return self.judged(self.game.mask)

    @cached_property
    def windows(self) -> tuple[Tensor, Tensor]:
        """Resting heights int16 and wasted cells int32 [G, A, W, D]; no waste if not needed."""
        if self.orientation is None:
            sides = self.game.orient_item(self.game.items).sides
        else:
            sides = self.item[:, None]
        bins = self.game.bins
        return resting_heights_and_waste(
            bins.heightmap, sides, bins.height, waste="waste" in self.planes, backend=bins.backend
        )

    @property
    def following(self) -> Tensor:
        """Sides of the first box of the preview in falling order, int16 [G, 3]; 0 for none."""
        sides = self.game.following
        if sides is None:
            return torch.zeros_like(self.game.items.sides)
        return sides.sort(1, descending=True).values

    @property
    def utilization(self) -> Tensor:
        """The filled share of each bin, float64 [G]."""
        return bin_state.utilization(self.game.bins)
