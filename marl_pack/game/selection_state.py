"""The state of games with selection, and the outcome of a step.

The rules are in :mod:`marl_pack.game.selection`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from marl_pack.bins import Bins
from marl_pack.items import Items, Stream

NOTHING = -1
"""Position of a slot that holds no box."""
EVERYTHING = 2**62
"""Larger than the position of any box."""


@dataclass
class SelectionState:
    """The state of G games with k slots and b bins; selecting derives from the fields."""

    bins: Bins  # [G · b], bin j of game g has the number g · b + j
    slots: Tensor  # int64 [G, k]   position in the sequence of each visible box, or NOTHING
    t: Tensor  # int64 [G]          position of the conveyor's next box
    known: Tensor  # int64 [G]      boxes from this position on are unknown; only a search sets it
    episode: Tensor  # int64 [G]    number of the episode
    stream: Tensor  # [G, …]        state of the item stream in each episode
    closed: Tensor  # int64 [G]     bins closed so far
    opened: Tensor  # int64 [G]     bins opened so far
    packed: Tensor  # int64 [G]     cells filled in all bins, closed ones included
    placed: Tensor  # int64 [G]     boxes in all bins, closed ones included
    ended: Tensor  # bool [G]       whether the episode has ended
    mask: Tensor  # bool [G, k · b, 6, W, D]  legal placements of each option

    def select(self, games: Tensor) -> SelectionState:
        """Return copies of games, int64 [K]."""
        b = len(self.bins) // len(self.t)
        rows = (games[:, None] * b + torch.arange(b, device=games.device)).flatten()
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return SelectionState(**{
            name: value[rows if name == "bins" else games] for name, value in values.items()
        })  # fmt: skip


@dataclass(frozen=True)
class SelectionOutcome:
    """The result of placing a box in each game; before any reset."""

    reward: Tensor  # float32 [G]   Eq. 5, relative to the volume of one bin
    done: Tensor  # bool [G]        whether the episode ended with this placement
    packed: Tensor  # int64 [G]     cells filled in all bins of the episode
    placed: Tensor  # int64 [G]     boxes in all bins of the episode
    opened: Tensor  # int64 [G]     bins opened in the episode
    emptied: Tensor  # bool [G, b]  whether each open bin was closed after this placement
    volume: int  # volume of a bin, in cells

    @property
    def utilization(self) -> Tensor:
        """Share of the volume of all opened bins that is filled, float64 [G]."""
        return self.packed.double() / (self.opened * self.volume)


class NothingMore:
    """A stream that describes the boxes of another stream, and brings none.

    Args:
        stream: the other stream.
    """

    def __init__(self, stream: Stream) -> None:
        self.stream = stream

    def __getattr__(self, name: str) -> Any:
        if name == "stream":  # a copy that is still empty
            raise AttributeError(name)
        return getattr(self.stream, name)

    def item(self, state: Tensor, t: Tensor) -> Items:
        """Return no items: zero sides [N]."""
        items = self.stream.item(state, t)
        return replace(items, sides=torch.zeros_like(items.sides))
