"""The interface of all players: a function from G games to an orientation and a cell for each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from marl_pack.game.packing import Packing

Placement = tuple[Tensor, Tensor]
"""(orientation int64 [G], cell int64 [G])."""

Policy = Callable[[Packing], Placement]
"""``game -> (orientation, cell)``, legal wherever ``game.alive``.

Networks, heuristics and random play all have this form, so one loop plays them all."""

OrientationAgent = Callable[[Packing], Tensor]
"""``game -> orientation int64 [G]``: the choice of the orientation agent."""

PlacementAgent = Callable[[Packing, Tensor], Tensor]
"""``(game, orientation int64 [G]) -> cell int64 [G]``: the choice of the placement agent."""


@dataclass(frozen=True)
class InTurns:
    """A policy of two agents: first the orientation agent acts, then the placement agent.

    Args:
        orientation_agent, placement_agent: the agents.
    """

    orientation_agent: OrientationAgent
    placement_agent: PlacementAgent

    def __call__(self, game: Packing) -> Placement:
        """Return orientation and cell of each game, int64 [G] each."""
        orientation = self.orientation_agent(game)
        return orientation, self.placement_agent(game, orientation)


def draw(mask: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Draw one index uniformly from the true entries of each row; 0 if a row has none.

    Args:
        mask: bool [G, K].
        generator: of random numbers on the mask's device; torch's global generator by default.

    Returns:
        int64 [G].
    """
    # The inverse of the cumulative counts is several times faster than torch.multinomial.
    count = mask.cumsum(1, dtype=torch.int32)
    point = torch.rand(len(mask), 1, generator=generator, device=mask.device)
    rank = (point * count[:, -1:]).to(torch.int32)
    return torch.searchsorted(count, rank, right=True).squeeze(1) * (count[:, -1] > 0)
