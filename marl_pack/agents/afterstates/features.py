"""The features of afterstates that the critic observes."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from marl_pack.agents.afterstates.afterstates import Afterstates
from marl_pack.agents.afterstates.limits import MOST_LENGTHS, SURFACE
from marl_pack.installation import njit

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
    code = afterstates.backend.pick(compiled=_features_compiled, tensor=_features_tensor)
    return code(afterstates, volume, rows)


@lru_cache(maxsize=8)
def _logarithms(most: int) -> NDArray[np.float32]:
    """Return half of log(1 + n) for the numbers n = 0 … ``most``, float32."""
    values: NDArray[np.float32] = (torch.arange(most + 1).float().log1p() / 2).numpy()
    return values


@njit(cache=True, nogil=True)
def _write_features(
    counts: Any, surface: Any, filled: Any, volume: int, rows: Any, logarithms: Any, values: Any
) -> None:
    """Write the features of the afterstates ``rows`` int64 [K] to ``values`` float32 [K, F]."""
    lengths = counts.shape[1]
    first = MOST_LENGTHS - lengths
    values[:] = 0
    for k in range(rows.size):
        row, own = rows[k], values[k]
        share = np.float32(filled[row]) / np.float32(volume)
        own[0], own[1] = share, share * share
        for i in range(lengths):
            for j in range(i, lengths):
                a, b = first + i, j - i
                pair = a * MOST_LENGTHS - a * (a - 1) // 2 + b  # pairs by their first length
                entry = 2 + pair * MOST_LENGTHS + first
                for tall in range(lengths):
                    both = counts[row, i, j, tall] + counts[row, j, i, tall]
                    own[entry + tall] = logarithms[both]
        for entry in range(SURFACE):
            own[2 + PAIRS * MOST_LENGTHS + entry] = 2 * surface[row, entry]


def _features_compiled(afterstates: Afterstates, volume: int, rows: Tensor | None) -> Tensor:
    """Compute :func:`features` in a compiled loop."""
    rows = torch.arange(len(afterstates.filled)) if rows is None else rows
    most = 2 * afterstates.index[0, 0].numel()  # cells where a box and its like could be placed
    values = torch.empty(len(rows), FEATURES)
    parts = afterstates.counts, afterstates.surface, afterstates.filled
    arrays = (part.numpy() for part in parts)
    _write_features(*arrays, volume, rows.numpy(), _logarithms(most), values.numpy())
    return values


def _features_tensor(afterstates: Afterstates, volume: int, rows: Tensor | None) -> Tensor:
    """Compute :func:`features` in tensor code."""
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
