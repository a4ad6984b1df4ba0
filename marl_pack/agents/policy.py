"""The interface of all players: a function from G games to an orientation and a cell for each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from marl_pack.backend import default_backend
from marl_pack.game.moves import Moves
from marl_pack.game.packing import Packing
from marl_pack.installation import njit

Placement = tuple[Tensor, Tensor]
"""(orientation int64 [G], cell int64 [G])."""

Policy = Callable[[Packing], Placement]
"""``game -> (orientation, cell)``, legal wherever ``game.alive``.

Networks, heuristics and random play all have this form, so one loop plays them all."""

OrientationAgent = Callable[[Packing], Tensor]
"""``game -> orientation int64 [G]``: the choice of the orientation agent."""

PlacementAgent = Callable[[Packing, Tensor], Tensor]
"""``(game, orientation int64 [G]) -> cell int64 [G]``: the choice of the placement agent."""


AFTERSTATE_VALUE = "afterstate value"
"""Name of the values that learned agents observe: reward (Eq. 5) plus the return still to come."""
OF_FIRST_AGENT = "afterstate value, seen by the orientation agent"
"""Their name if the placement agent does not observe them."""


@dataclass(frozen=True)
class Reasons:
    """What a policy computed for the legal placements of G games; None where it did not."""

    orientation_probabilities: Tensor | None = None  # [G, 6]
    probabilities: Tensor | None = None  # [G, W · D]  of the cells in the chosen orientation
    values: Tensor | None = None  # [G, 6, W, D]  the highest is the best; NaN: not computed
    value_of: str = ""  # what the values are
    tries: Tensor | None = None  # int64 [G, 6, W, D]  number of futures behind each value


@runtime_checkable
class Explained(Protocol):
    """A policy that says what it computed."""

    def reasons(self, game: Packing, orientation: Tensor) -> Reasons:
        """Return what it computed, given the chosen orientations, int64 [G]."""


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

    def reasons(self, game: Packing, orientation: Tensor) -> Reasons:
        """Return what learned agents computed (:class:`Explained`)."""
        first, second = self.orientation_agent, self.placement_agent
        values, value_of = None, ""
        for agent, name in ((second, AFTERSTATE_VALUE), (first, OF_FIRST_AGENT)):
            if values is None and hasattr(agent, "values"):
                values = agent.values(game)
                value_of = "" if values is None else name
        return Reasons(
            first.chances(game) if hasattr(first, "chances") else None,
            second.chances(game, orientation) if hasattr(second, "chances") else None,
            values,
            value_of,
        )


def draw(
    mask: Tensor, generator: torch.Generator | None = None, row: Tensor | None = None
) -> Tensor:
    """Draw one index uniformly from the true entries of each game's mask; 0 if it has none.

    Args:
        mask: bool [G, K, …]; the entries of a game are numbered in their order. With ``row``,
            bool [G, A, K, …].
        generator: of random numbers on the mask's device; torch's global generator by default.
        row: int64 [G], the row of each game's mask to draw from.

    Returns:
        int64 [G].
    """
    point = torch.rand(mask.shape[0], 1, generator=generator, device=mask.device)
    code = default_backend(mask.device).pick(compiled=_draw_compiled, tensor=_draw_tensor)
    return code(mask, point, row)


def draw_placement(
    game: Packing, generator: torch.Generator | None = None, points: Tensor | None = None
) -> Placement:
    """Draw one of the orientations that may be chosen, then one of its legal cells, uniformly.

    Args:
        game: the games.
        generator: as for :func:`draw`.
        points: float32 [2, G, 1], random numbers in [0, 1) for the orientations and the cells;
            drawn from the generator by default.

    Returns:
        Orientation and cell, int64 [G] each.
    """
    device = game.mask.device
    if points is None:
        points = torch.rand(2, game.n, 1, generator=generator, device=device)
    code = default_backend(device).pick(compiled=_draw_pair_compiled, tensor=_draw_pair_tensor)
    return code(game.orientation_mask, game.mask, points)


def _draw_pair_compiled(orientations: Tensor, mask: Tensor, points: Tensor) -> Placement:
    games, count = orientations.shape
    point, drawn = points.numpy(), np.zeros((2, games), np.int64)
    _draw_each(orientations.numpy().reshape(games, 1, count), point[0], drawn[0], drawn[0])
    _draw_each(mask.numpy().reshape(games, count, -1), point[1], drawn[0], drawn[1])
    return torch.from_numpy(drawn[0]), torch.from_numpy(drawn[1])


def _draw_pair_tensor(orientations: Tensor, mask: Tensor, points: Tensor) -> Placement:
    orientation = _draw_tensor(orientations, points[0], None)
    return orientation, _draw_tensor(mask, points[1], orientation)


def _draw_compiled(mask: Tensor, point: Tensor, row: Tensor | None) -> Tensor:
    """Return the entries at ``point``, float32 [G, 1], of the true entries, by compiled loops."""
    games, rows = mask.shape[0], 1 if row is None else mask.shape[1]
    entries = mask.numpy().reshape(games, rows, -1)
    drawn = np.zeros(games, np.int64)
    _draw_each(entries, point.numpy(), drawn if row is None else row.numpy(), drawn)
    return torch.from_numpy(drawn)


@njit(cache=True, nogil=True)
def _draw_each(entries: Any, point: Any, row: Any, drawn: Any) -> None:
    """Write the entry drawn from ``entries[g, row[g]]`` to ``drawn[g]``; it may be ``row``."""
    for g in range(drawn.size):
        chosen = entries[g, row[g]]
        count = 0
        for k in range(chosen.size):
            count += chosen[k]
        rank = int(point[g, 0] * np.float32(count))
        drawn[g] = 0
        for k in range(chosen.size if count else 0):
            rank -= chosen[k]
            if rank < 0:
                drawn[g] = k
                break


def _draw_tensor(mask: Tensor, point: Tensor, row: Tensor | None) -> Tensor:
    """Return the same as :func:`_draw_compiled`, in tensor code."""
    chosen = (mask if row is None else Moves.gather(mask, row)).flatten(1)
    # The inverse of the cumulative counts is several times faster than torch.multinomial.
    count = chosen.cumsum(1, dtype=torch.int32)
    rank = (point * count[:, -1:]).to(torch.int32)
    return torch.searchsorted(count, rank, right=True).squeeze(1) * (count[:, -1] > 0)
