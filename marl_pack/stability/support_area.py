"""Zhao et al. 2021: a box stands if enough of its bottom face, and enough corners, are supported.

Not sound: it knows no centre of mass and nothing of what lies below the box it looks at.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from marl_pack.stability.hull_cpu import mark_valid, slide
from marl_pack.stability.hull_torch import fits, resting_height

Thresholds = tuple[tuple[float, int], ...]

PAPER: Thresholds = ((0.60, 4), (0.80, 3), (0.95, 0))
"""(share of the bottom face, corners): more than the share and at least so many corners."""
CODE: Thresholds = ((0.50, 4), (0.85, 3), (0.95, 0))
"""The thresholds of the authors' released code."""


@njit(cache=True, nogil=True)
def _mask_cpu(heightmap: Any, sides: Any, height: int, share: Any, corners: Any, out: Any) -> None:
    n, width, depth = heightmap.shape
    cells = width * depth
    buffers = np.empty((2, cells), heightmap.dtype)
    for b in range(n):
        for a in range(sides.shape[1]):
            w, d, h = sides[b, a, 0], sides[b, a, 1], sides[b, a, 2]
            codes = out[b, a].reshape(cells)
            if not (0 < w <= width and 0 < d <= depth and 0 < h <= height):
                codes[:] = 0
                continue
            mark_valid(codes, width, depth, w, d)
            rest = slide(heightmap[b].reshape(cells), buffers[0], buffers[1], depth, w, d)
            for i in range(cells):
                if codes[i] == 0:
                    continue
                z = rest[i]
                codes[i] = 0
                if z + h > height:
                    continue
                window = heightmap[b, i // depth : i // depth + w, i % depth : i % depth + d]
                held = (
                    int(window[0, 0] == z) + int(window[0, d - 1] == z)
                    + int(window[w - 1, 0] == z) + int(window[w - 1, d - 1] == z)
                )  # fmt: skip
                needed = 2.0
                for k in range(share.size):
                    if held >= corners[k]:
                        needed = min(needed, share[k])
                spare = w * d - needed * (w * d)  # stands if fewer cells than this are missing
                missing = 0
                for x in range(w):
                    row = 0
                    for y in range(d):
                        row += window[x, y] != z
                    missing += row
                    if missing >= spare:
                        break
                codes[i] = w * d - missing > needed * (w * d)


def mask_cpu(
    heightmap: NDArray[np.int16], sides: NDArray[np.int16], height: int, thresholds: Thresholds
) -> NDArray[np.bool_]:
    """Bool [N, A, W, D] for ``heightmap`` int16 [N, W, D] and ``sides`` int16 [N, A, 3]."""
    out = np.empty((*sides.shape[:2], *heightmap.shape[1:]), np.uint8)
    share = np.array([t[0] for t in thresholds])
    corners = np.array([t[1] for t in thresholds])
    heights, sides = np.ascontiguousarray(heightmap), np.ascontiguousarray(sides)
    _mask_cpu(heights, sides, height, share, corners, out)
    return out.view(np.bool_)


def mask_torch(heightmap: Tensor, sides: Tensor, height: int, thresholds: Thresholds) -> Tensor:
    """The same in tensor code: the cells at each level are counted by a summed-area table."""
    n, width, depth = heightmap.shape
    ways = sides.shape[1]
    flat = sides.flatten(0, 1).long()
    rest = resting_height(heightmap, sides).flatten(0, 1)
    possible = fits(flat, width, depth) & (rest + flat[:, 2, None, None] <= height)
    w, d = flat[:, 0].clamp(1, width), flat[:, 1].clamp(1, depth)
    x = torch.arange(width, device=flat.device)
    y = torch.arange(depth, device=flat.device)
    far_x = (x + w[:, None]).clamp(max=width)[:, :, None].expand(-1, -1, depth)
    far_y = (y + d[:, None]).clamp(max=depth)[:, None, :].expand(-1, width, -1)
    rows = torch.arange(len(flat), device=flat.device)[:, None, None]
    x, y = x[:, None], y[None, :]

    area = torch.zeros_like(rest, dtype=torch.int64)
    for level in torch.unique(heightmap).tolist():
        table = torch.zeros(n, width + 1, depth + 1, dtype=torch.int64, device=flat.device)
        table[:, 1:, 1:] = (heightmap == level).long().cumsum(1).cumsum(2)
        table = table.repeat_interleave(ways, 0)
        count = (
            table[rows, far_x, far_y] - table[rows, x, far_y]
            - table[rows, far_x, y] + table[rows, x, y]
        )  # fmt: skip
        area = torch.where(rest == level, count, area)

    high = heightmap.repeat_interleave(ways, 0)
    last_x, last_y = far_x - 1, far_y - 1
    held = sum(
        (high[rows, cx, cy] == rest).long()
        for cx, cy in ((x, y), (x, last_y), (last_x, y), (last_x, last_y))
    )
    face = (w * d)[:, None, None].double()
    stands = torch.zeros_like(possible)
    for share, corners in thresholds:
        stands |= (area > share * face) & (held >= corners)
    return (possible & stands).view(n, ways, width, depth)


def check_thresholds(thresholds: Thresholds | str) -> Thresholds:
    """Return the thresholds by name (``"paper"``, ``"code"``) or as given.

    Raises:
        ValueError: for an unknown name, a share outside [0, 1] or corners outside 0 … 4.
    """
    if isinstance(thresholds, str):
        named = {"paper": PAPER, "code": CODE}
        if thresholds not in named:
            raise ValueError(f"area_ratio thresholds {thresholds!r}: one of {sorted(named)}")
        return named[thresholds]
    pairs = tuple((float(share), int(corners)) for share, corners in thresholds)
    if not pairs or not all(0 <= s <= 1 and 0 <= c <= 4 for s, c in pairs):
        raise ValueError(
            f"area_ratio thresholds {thresholds!r}: need pairs (share in [0, 1], corners in 0 … 4)"
        )
    return pairs
