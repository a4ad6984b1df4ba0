"""What lies under every position of a box: resting height and wasted volume of each window.

Compiled loops on the CPU, tensor code elsewhere; both give the same numbers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from marl_pack.bins import Bins, compiled
from marl_pack.stability.hull_cpu import slide
from marl_pack.stability.hull_torch import fits
from marl_pack.stability.hull_torch import resting_height as slide_torch


@njit(cache=True, nogil=True)
def _rest_and_waste(heightmap: Any, sides: Any, height: int, rest: Any, waste: Any) -> None:
    """Fill ``rest`` and, unless it is empty, ``waste`` (int16 and int32 [N, A, W, D])."""
    n, width, depth = heightmap.shape
    cells = width * depth
    spare, out = np.empty(cells, np.int16), np.empty(cells, np.int16)
    below = np.zeros((width + 1, depth + 1), np.int32)
    wanted = waste.size > 0
    for b in range(n):
        flat = heightmap[b].reshape(cells)
        if wanted:
            for x in range(width):
                row = 0
                for y in range(depth):
                    row += heightmap[b, x, y]
                    below[x + 1, y + 1] = below[x, y + 1] + row
        for a in range(sides.shape[1]):
            w, d, h = sides[b, a, 0], sides[b, a, 1], sides[b, a, 2]
            rest[b, a] = height
            if wanted:
                waste[b, a] = 0
            if not (0 < w <= width and 0 < d <= depth and h > 0):
                continue
            top = slide(flat, spare, out, depth, w, d)
            for x in range(width - w + 1):
                for y in range(depth - d + 1):
                    z = top[x * depth + y]
                    rest[b, a, x, y] = z
                    if wanted:
                        under = (
                            below[x + w, y + d] - below[x, y + d] - below[x + w, y] + below[x, y]
                        )
                        waste[b, a, x, y] = np.int32(w) * d * z - under


def _window_sum(heightmap: Tensor, w: Tensor, d: Tensor) -> Tensor:
    """Sum of the heights under every w × d window, int64 [N, A, W, D], by a summed-area table.

    Args:
        heightmap: int16 [N, W, D]. w, d: int64 [N, A, 1, 1].
    """
    n, width, depth = heightmap.shape
    table = torch.zeros(n, width + 1, depth + 1, dtype=torch.int64, device=heightmap.device)
    table[:, 1:, 1:] = heightmap.long().cumsum(1).cumsum(2)
    x = torch.arange(width, device=heightmap.device)[:, None]
    y = torch.arange(depth, device=heightmap.device)[None, :]
    far_x, far_y = (x + w).clamp(max=width), (y + d).clamp(max=depth)
    b = torch.arange(n, device=heightmap.device)[:, None, None, None]
    return table[b, far_x, far_y] - table[b, x, far_y] - table[b, far_x, y] + table[b, x, y]


def rest_and_waste(bins: Bins, sides: Tensor, *, waste: bool = True) -> tuple[Tensor, Tensor]:
    """Where each box would come to rest at every cell, and the empty cells it would enclose.

    Args:
        bins: N bins.
        sides: int16 [N, A, 3], the boxes' sides along x, y, z; a zero side fits nowhere.
        waste: whether to reckon the second (else it has no entries).

    Returns:
        int16 [N, A, W, D], resting heights, H where the window does not lie inside the map; and
        int32 [N, A, W, D], cells of v_waste (Eq. 7), 0 there.
    """
    n, ways = sides.shape[:2]
    width, depth, height = bins.size
    if compiled(bins.device):
        rest = torch.empty((n, ways, width, depth), dtype=torch.int16)
        wasted = torch.empty((n, ways, width, depth) if waste else (0, 0, 0, 0), dtype=torch.int32)
        _rest_and_waste(
            np.ascontiguousarray(bins.heightmap.numpy()), np.ascontiguousarray(sides.numpy()),
            height, rest.numpy(), wasted.numpy(),
        )  # fmt: skip
        return rest, wasted
    inside = fits(sides.flatten(0, 1), width, depth).view(n, ways, width, depth)
    rest = slide_torch(bins.heightmap, sides)
    if not waste:
        wasted = torch.empty((0, 0, 0, 0), dtype=torch.int32, device=bins.device)
    else:
        w, d = sides[..., 0, None, None].long(), sides[..., 1, None, None].long()
        full = w * d * rest
        wasted = (full - _window_sum(bins.heightmap, w, d)).masked_fill(~inside, 0).int()
    return rest.masked_fill(~inside, height), wasted
