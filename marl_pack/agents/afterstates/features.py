"""The features of afterstates that the critic observes."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_pack.agents.afterstates.afterstates import SURFACE, Afterstates
from marl_pack.agents.afterstates.limits import MOST_LENGTHS

PAIRS = MOST_LENGTHS * (MOST_LENGTHS + 1) // 2
FEATURES = 2 + PAIRS * MOST_LENGTHS + SURFACE
"""Number of features of an afterstate."""


def features(afterstates: Afterstates, volume: int, rows: Tensor | None = None) -> Tensor:
    """Compute the features of afterstates, float32 [K, :data:`FEATURES`].

    The features are the filled share of the bin and its square; for each box that may come next,
    the logarithm of the number of cells where it could be placed (a footprint and the same
    footprint rotated by 90° share a feature); and the surface. Mirroring or rotating the bin does
    not change them. If boxes have fewer than :data:`MOST_LENGTHS` lengths, these use the places of
    the longest, and the other places are 0.

    Args:
        afterstates: the afterstates of the placements.
        volume: W · D · H.
        rows: int64 [K], the placements to describe; all by default.
    """
    counts, surface, filled = afterstates.counts, afterstates.surface, afterstates.filled
    if rows is not None:
        counts, surface, filled = counts[rows], surface[rows], filled[rows]
    lengths = counts.shape[1]
    first = MOST_LENGTHS - lengths
    both = counts + counts.transpose(1, 2)  # as it comes and rotated by 90°
    i, j = torch.triu_indices(lengths, lengths, device=counts.device)
    values = torch.zeros(len(counts), FEATURES, device=counts.device)
    boxes = values[:, 2 : 2 + PAIRS * MOST_LENGTHS].view(-1, PAIRS, MOST_LENGTHS)
    boxes[:, PAIRS - i.numel() :, first:] = both[:, i, j].float().log1p() / 2
    share = filled.float() / volume
    values[:, 0], values[:, 1] = share, share.square()
    values[:, 2 + PAIRS * MOST_LENGTHS :] = 2 * surface
    return values
