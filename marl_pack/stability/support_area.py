"""Compute masks by the supported area and corners of a box's bottom face (Zhao et al. 2021).

The rule is not sound: it ignores the centre of mass, and whether the boxes below are supported.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from marl_pack.checks import exact
from marl_pack.geometry.compiled import mark_valid, slide
from marl_pack.geometry.tensor import bins_last, shift, slide_counts
from marl_pack.installation import njit
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

    Each window is joined from parts: of each, the highest level and its cells are known.
    """
    width, depth = heightmap.shape[1:]
    w, d, h = sides.permute(2, 1, 0).contiguous().long()  # [A, N] each
    x, y = (torch.arange(side, device=w.device)[:, None, None] for side in (width, depth))
    x_fits, y_fits = (w > 0) & (h > 0) & (x <= width - w), (d > 0) & (y <= depth - d)
    w, d = w.clamp(1, width), d.clamp(1, depth)
    heights = bins_last(heightmap.to(torch.uint8 if height <= 255 else torch.int16))
    rows = slide_counts(heights, torch.ones_like(heights, dtype=torch.int32), d, 1, depth)
    z, area = slide_counts(rows[0], rows[1], w, 0, width)
    far = shift(heights, w - 1, 0, width - 1)
    supported = sum(
        (side == z).to(torch.uint8) + (shift(side, d - 1, 1, depth - 1) == z)
        for side in (heights, far)
    )
    fewest = _fewest_cells(sides, thresholds).permute(2, 1, 0).contiguous().int()
    stands = torch.zeros_like(z, dtype=torch.bool)
    for (_, corners), cells in zip(thresholds, fewest, strict=True):
        stands |= (area >= cells) & (supported >= corners)
    stands &= x_fits[:, None] & y_fits & (z <= height - h)
    return stands.permute(3, 2, 0, 1).contiguous()
