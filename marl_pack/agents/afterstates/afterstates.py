"""Compute where the next boxes could be placed after each legal placement.

The visible item is placed hypothetically at every legal cell. Then ``hull_alpha`` gives the cells
where the next box could be placed. The next boxes are all boxes whose sides have certain lengths
(:func:`probe_lengths`), and each is equally probable. The numbers of cells give the mean number of
feasible cells, and the probability that the next item has a feasible cell at all.

Compiled loops use as many threads as torch uses; tensor code computes the same numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from marl_pack.agents.afterstates.compiled import (
    compute_compiled,
    map_compiled,
    probability_compiled,
)
from marl_pack.agents.afterstates.limits import MOST_LENGTHS
from marl_pack.agents.afterstates.tensor import compute_tensor, map_tensor, probability_tensor
from marl_pack.backend import Backend
from marl_pack.bins import Bins
from marl_pack.geometry import ORIENTATIONS


@cache
def probe_lengths(shortest: int, longest: int) -> tuple[int, ...]:
    """Return at most :data:`MOST_LENGTHS` evenly spaced lengths from shortest to longest."""
    count = min(MOST_LENGTHS, longest - shortest + 1)
    return tuple(round(x) for x in np.linspace(shortest, longest, count))


@dataclass(frozen=True)
class Afterstates:
    """The bins after K legal placements; equal placements may share a row."""

    backend: Backend  # computes the numbers that are derived from the tensors
    index: Tensor  # int64 [N, A, W, D]   row of each legal placement; elsewhere any row
    counts: Tensor  # int32 [K, L, L, L]  cells where each box could be placed: w, d, h
    surface: Tensor  # float32 [K, 17]    share of columns in each class of heights, then share of
    # pairs of neighbouring columns in each class of steps (the last class: 5 tenths or more)
    waste: Tensor  # int64 [K]            empty cells that the placed box would enclose
    volume: Tensor  # int64 [K]           of the placed box, in cells
    filled: Tensor  # int64 [K]           filled cells of the bin, the placed box included

    def select(self, which: Tensor) -> Afterstates:
        """Return the afterstates of the bins ``which`` (indices int64 [B]); the rows stay."""
        return replace(self, index=self.index[which])

    def feasible_cells(self) -> Tensor:
        """Compute the mean number of cells where a box that may come next could be placed.

        Returns:
            float32 [K].
        """
        boxes = self.counts[:1].numel() or 1
        total = self.counts.flatten(1).sum(1, dtype=torch.int32)  # much faster than int64
        return (total.double() / boxes).float()

    def feasible_probability(self, orientation_sets: Mapping[tuple[int, ...], float]) -> Tensor:
        """Compute the probability that the next item has a feasible cell.

        Args:
            orientation_sets: which orientations (indices into
                :data:`marl_pack.geometry.ORIENTATIONS`) the next item may take, with the share of
                items that may take exactly those; the shares sum to 1.

        Returns:
            float32 [K].
        """
        code = self.backend.pick(compiled=probability_compiled, tensor=probability_tensor)
        rows = [[ORIENTATIONS[o] for o in orientations] for orientations in orientation_sets]
        shares = zip(rows, orientation_sets.values(), strict=True)
        probability = torch.zeros(len(self.counts), dtype=torch.float64, device=self.counts.device)
        for axes, share in shares:
            probability += share * code(self.counts, axes)
        return probability.float()

    def as_map(self, values: Tensor, mask: Tensor, elsewhere: float = 0.0) -> Tensor:
        """Return numbers [K] as a map [N, A, W, D], with ``elsewhere`` where the mask is false."""
        code = self.backend.pick(compiled=map_compiled, tensor=map_tensor)
        return code(values, self.index, mask, elsewhere)


def afterstates_of(
    bins: Bins,
    sides: Tensor,
    mask: Tensor,
    lengths: Sequence[int],
    heights: Sequence[int] | None = None,
) -> Afterstates:
    """Compute the afterstate of each legal placement.

    Args:
        bins: N bins.
        sides: int16 [N, A, 3], the item's sides along x, y, z in A orientations.
        mask: bool [N, A, W, D], where the item may be placed.
        lengths: the L lengths of the next boxes' sides, ascending.
        heights: their L heights, ascending; by default the same.
    """
    compute = bins.backend.pick(compiled=compute_compiled, tensor=compute_tensor)
    return Afterstates(bins.backend, *compute(bins, sides, mask, tuple(lengths), heights))
