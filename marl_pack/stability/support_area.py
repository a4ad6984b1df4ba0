"""Compute masks by the supported area and corners of a box's bottom face (Zhao et al. 2021).

The rule is not sound: it ignores the centre of mass, and whether the boxes below are supported.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from marl_pack.geometry.compiled import mark_valid, slide
from marl_pack.geometry.tensor import resting_heights, window_sum, windows_inside
from marl_pack.installation import njit
from marl_pack.stability.centres import exact
from marl_pack.stability.parameters import Thresholds


@njit(cache=True, nogil=True)
def _fill_masks(
    heightmap: Any, sides: Any, height: int, fewest: Any, corners: Any, out: Any
) -> None:
    """Write the masks uint8 [N, A, W, D] to ``out``.

    ``fewest`` int64 [N, A, T] is the number of supported cells that each of T thresholds needs;
    ``corners`` int64 [T] is the number of supported corners that it needs.
    """
    n, width, depth = heightmap.shape
    cells = width * depth
    buffers = np.empty((2, cells), heightmap.dtype)
    for b in range(n):
        for a in range(sides.shape[1]):
            w, d, h = sides[b, a, 0], sides[b, a, 1], sides[b, a, 2]
            mask = out[b, a].reshape(cells)
            if not (0 < w <= width and 0 < d <= depth and 0 < h <= height):
                mask[:] = 0
                continue
            mark_valid(mask, width, depth, w, d, 1)
            top = slide(heightmap[b].reshape(cells), buffers[0], buffers[1], depth, w, d)
            for i in range(cells):
                if mask[i] == 0:
                    continue
                z = top[i]
                mask[i] = 0
                if z + h > height:
                    continue
                window = heightmap[b, i // depth : i // depth + w, i % depth : i % depth + d]
                supported = (
                    int(window[0, 0] == z) + int(window[0, d - 1] == z)
                    + int(window[w - 1, 0] == z) + int(window[w - 1, d - 1] == z)
                )  # fmt: skip
                needed = np.int64(w) * d + 1
                for k in range(corners.size):
                    if supported >= corners[k]:
                        needed = min(needed, fewest[b, a, k])
                spare = w * d - needed  # cells that may be missing
                missing = 0
                for x in range(w):
                    row = 0
                    for y in range(d):
                        row += window[x, y] != z
                    missing += row
                    if missing > spare:
                        break
                mask[i] = missing <= spare


def _fewest_cells(sides: Tensor, thresholds: Thresholds) -> Tensor:
    """Compute the least number of supported cells above each threshold's share, int64 [N, A, T].

    The arithmetic is exact: 60 % of 5 cells are 3 cells, so 4 cells exceed this share.
    """
    faces = sides[..., 0].long() * sides[..., 1].long()
    columns = []
    for share, _ in thresholds:
        part = exact(share)
        if max(part.numerator, part.denominator) < 1 << 32:  # a face has less than 2^30 cells
            columns.append(faces * part.numerator // part.denominator + 1)
        else:
            cells = [
                face * part.numerator // part.denominator + 1 for face in faces.view(-1).tolist()
            ]
            columns.append(torch.tensor(cells, device=faces.device).view(faces.shape))
    return torch.stack(columns, -1)


def mask_compiled(heightmap: Tensor, sides: Tensor, height: int, thresholds: Thresholds) -> Tensor:
    """Compute the masks of the rule in compiled loops.

    Args:
        heightmap: int16 [N, W, D].
        sides: int16 [N, A, 3], the boxes' sides along x, y, z.
        height: the bin's height H.
        thresholds: pairs (share, corners).

    Returns:
        Bool [N, A, W, D].
    """
    out = np.empty((*sides.shape[:2], *heightmap.shape[1:]), np.uint8)
    corners = np.array([t[1] for t in thresholds])
    heights, boxes = (np.ascontiguousarray(values.numpy()) for values in (heightmap, sides))
    _fill_masks(heights, boxes, height, _fewest_cells(sides, thresholds).numpy(), corners, out)
    return torch.from_numpy(out.view(np.bool_))


def mask_tensor(heightmap: Tensor, sides: Tensor, height: int, thresholds: Thresholds) -> Tensor:
    """Compute the masks of the rule in tensor code; the arguments are those of mask_compiled.

    A summed-area table counts the cells at each level.
    """
    n, width, depth = heightmap.shape
    count = sides.shape[1]
    flat = sides.flatten(0, 1).long()
    z = resting_heights(heightmap, sides)
    top = z + sides[..., 2, None, None].long()
    possible = windows_inside(flat, width, depth).view(z.shape) & (top <= height)
    w, d = flat[:, 0].clamp(1, width), flat[:, 1].clamp(1, depth)
    w, d = (side.view(n, count, 1, 1) for side in (w, d))
    area = torch.zeros_like(z, dtype=torch.int64)
    for level in torch.unique(heightmap).tolist():
        area = torch.where(z == level, window_sum(heightmap == level, w, d), area)

    b = torch.arange(n, device=z.device)[:, None, None, None]
    x = torch.arange(width, device=z.device)[:, None]
    y = torch.arange(depth, device=z.device)[None, :]
    last_x, last_y = (x + w).clamp(max=width) - 1, (y + d).clamp(max=depth) - 1
    supported = sum(
        (heightmap[b, cx, cy] == z).long()
        for cx, cy in ((x, y), (x, last_y), (last_x, y), (last_x, last_y))
    )
    fewest = _fewest_cells(sides, thresholds)[:, :, None, None]
    stands = torch.zeros_like(possible)
    for k, (_, corners) in enumerate(thresholds):
        stands |= (area >= fewest[..., k]) & (supported >= corners)
    return possible & stands
