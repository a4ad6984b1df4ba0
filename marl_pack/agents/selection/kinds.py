"""The kinds of boxes that a stream may bring next, and how probable each is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from marl_pack.game.spec import GameSpec
from marl_pack.geometry import ALL_ORIENTATIONS
from marl_pack.items import Items, Stream

DRAWN = 1 << 14
"""Number of boxes that are drawn to find the kinds and how probable they are."""


@dataclass(frozen=True)
class Kinds:
    """Boxes that may come next; boxes that are equal up to a rotation are one kind."""

    items: Items  # T boxes, the most probable first
    reached: NDArray[np.float64]  # [T], the chance of a kind or of one before it

    def at(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the kinds at points in [0, 1), of which each kind has as much as its chance."""
        return np.searchsorted(self.reached, points, side="right").clip(max=len(self.reached) - 1)


def kinds_of(stream: Stream, spec: GameSpec, seed: int) -> Kinds:
    """Find the kinds of boxes of a stream of independent boxes.

    Args:
        stream: the stream.
        spec: the options of the game, which say how boxes may be rotated.
        seed: seed of the boxes that are drawn; games have seeds ≥ 0, so it is negative.
    """
    episodes = torch.arange(DRAWN)
    items = stream.item(stream.start(seed, episodes), torch.zeros_like(episodes))
    items = replace(items, ids=None)
    sides = items.sides.double()
    if spec.orientations == ALL_ORIENTATIONS and items.orientations is None:
        sides = sides.sort(1).values
    columns = [sides, items.weights[:, None]]
    if items.orientations is not None:
        columns.append(items.orientations.double())
    _, kind, counts = torch.unique(
        torch.cat(columns, 1), dim=0, return_inverse=True, return_counts=True
    )
    first = torch.full((len(counts),), DRAWN).scatter_reduce_(0, kind, episodes, "amin")
    order = counts.argsort(descending=True, stable=True)
    return Kinds(items[first[order]], (counts[order].cumsum(0) / DRAWN).double().numpy())
