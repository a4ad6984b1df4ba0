"""Compute the resting height and the wasted cells of every window, with either backend."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from marl_pack.backend import Backend, default_backend
from marl_pack.geometry import compiled, tensor


def resting_heights_and_waste(
    heightmap: Tensor,
    sides: Tensor,
    height: int,
    *,
    waste: bool = True,
    backend: Backend | None = None,
) -> tuple[Tensor, Tensor]:
    """Compute the resting height and the wasted cells of each box at every cell.

    Args:
        heightmap: int16 [N, W, D], the top of each column.
        sides: int16 [N, A, 3], the boxes' sides along x, y, z; a box with a zero side fits nowhere.
        height: the bin's height H.
        waste: whether to compute the wasted cells; if not, the second result has no entries.
        backend: the implementation to use; by default the faster one on the device.

    Returns:
        Resting heights int16 [N, A, W, D], which are H where the window does not lie inside the
        map, and wasted cells v_waste (Eq. 7) int32 [N, A, W, D], which are 0 there.
    """
    chosen = default_backend(heightmap.device) if backend is None else backend
    return chosen.pick(compiled=_compiled, tensor=_tensor)(heightmap, sides, height, waste)


def _compiled(heightmap: Tensor, sides: Tensor, height: int, waste: bool) -> tuple[Tensor, Tensor]:
    """Compute resting heights and wasted cells in compiled loops."""
    shape = (*sides.shape[:2], *heightmap.shape[1:])
    resting_heights = torch.empty(shape, dtype=torch.int16)
    wasted = torch.empty(shape if waste else (0, 0, 0, 0), dtype=torch.int32)
    compiled.resting_heights_and_waste(
        np.ascontiguousarray(heightmap.numpy()), np.ascontiguousarray(sides.numpy()), height,
        resting_heights.numpy(), wasted.numpy(),
    )  # fmt: skip
    return resting_heights, wasted


def _tensor(heightmap: Tensor, sides: Tensor, height: int, waste: bool) -> tuple[Tensor, Tensor]:
    """Compute resting heights and wasted cells in tensor code."""
    n, count = sides.shape[:2]
    width, depth = heightmap.shape[1:]
    inside = tensor.windows_inside(sides.flatten(0, 1), width, depth).view(n, count, width, depth)
    resting_heights = tensor.resting_heights(heightmap, sides)
    wasted = torch.empty((0, 0, 0, 0), dtype=torch.int32, device=heightmap.device)
    if waste:
        cells = tensor.wasted_cells(heightmap, sides, resting_heights)
        wasted = cells.masked_fill(~inside, 0).int()
    return resting_heights.masked_fill(~inside, height), wasted
