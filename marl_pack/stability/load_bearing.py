"""Compute load-bearable convex polygons (Gao et al. 2025, arXiv 2507.09123) in whole cells.

A box whose centre of mass lies in a polygon of load-bearing contact can itself carry any load
inside that polygon. So cells of its top above a gap may support the next box. A cell counts only if
its whole square lies in the polygon; it would be unsound to test only one corner of the square.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from marl_pack.bins import Bins
from marl_pack.geometry.compiled import place_box
from marl_pack.geometry.tensor import cut_windows, footprint, place_boxes
from marl_pack.installation import njit
from marl_pack.stability.hull_exact import envelope, row_extremes
from marl_pack.stability.hull_tensor import PAIR_CELLS, boundary


def lbcp_bearing(bins: Bins) -> Tensor:
    """Return which columns have a top that can carry any load, bool [N, W, D].

    The floor can carry any load everywhere. A box can carry it on those cells of its top whose
    whole square lies in the hull of the load-bearing squares on which the box rests.
    """
    return bins.backend.pick(compiled=_bearing_compiled, tensor=_bearing_tensor)(bins)


# --- compiled -------------------------------------------------------------------------------------


@njit(cache=True)
def _chain_at(chain: Any, size: int, x: int, sign: int) -> int:
    """Return a chain's y at ``x``, rounded towards the inside of the hull.

    The sign is 1 for the upper chain (rounded down) and -1 for the lower chain (rounded up).
    """
    for i in range(size - 1):
        ax, ay, bx, by = chain[i, 0], chain[i, 1], chain[i + 1, 0], chain[i + 1, 1]
        if ax <= x <= bx:
            return sign * ((sign * (ay * (bx - ax) + (by - ay) * (x - ax))) // (bx - ax))
    return 0


@njit(cache=True, inline="always")
def _fill_hull(cells: Any, lo: Any, hi: Any, upper: Any, lower: Any) -> None:
    """Set all ``cells`` [w, d] whose whole square lies in the hull of the true squares."""
    w, d = cells.shape
    if cells[0, 0] and cells[0, d - 1] and cells[w - 1, 0] and cells[w - 1, d - 1]:
        cells[:] = True
        return
    row_extremes(cells, lo, hi)
    n_upper, n_lower = envelope(lo[:w], hi[:w], upper, lower)
    if n_upper == 0:
        return
    for i in range(upper[0, 0], upper[n_upper - 1, 0]):
        top = min(_chain_at(upper, n_upper, i, 1), _chain_at(upper, n_upper, i + 1, 1))
        bottom = max(_chain_at(lower, n_lower, i, -1), _chain_at(lower, n_lower, i + 1, -1))
        for j in range(bottom, top):
            cells[i, j] = True


@njit(cache=True, nogil=True)
def _replay(boxes: Any, count: Any, out: Any) -> None:
    """Place the boxes [N, M, 6] one after another and write the bearing columns [N, W, D]."""
    n, width, depth = out.shape
    heightmap = np.empty((width, depth), np.int64)
    lo, hi = np.empty(width, np.int64), np.empty(width, np.int64)
    upper, lower = np.empty((2 * width + 2, 2), np.int64), np.empty((2 * width + 2, 2), np.int64)
    for b in range(n):
        heightmap[:] = 0
        out[b] = True
        for k in range(count[b]):
            x, y, z, w, d, h = boxes[b, k]
            cells = out[b, x : x + w, y : y + d]
            for i in range(w):
                for j in range(d):
                    cells[i, j] &= heightmap[x + i, y + j] == z
            place_box(heightmap, None, x, y, w, d, h)
            _fill_hull(cells, lo, hi, upper, lower)


def _bearing_compiled(bins: Bins) -> Tensor:
    """Compute :func:`lbcp_bearing` in compiled loops."""
    out = np.empty(tuple(bins.heightmap.shape), np.bool_)
    _replay(bins.boxes.contiguous().numpy(), bins.count.numpy(), out)
    return torch.from_numpy(out)


# --- tensor code ----------------------------------------------------------------------------------


def _bearing_tensor(bins: Bins) -> Tensor:
    """Compute :func:`lbcp_bearing` in tensor code, box by box and for all bins at once.

    The program waits for the device once, to read the largest number of boxes and their sides.
    """
    n, (width, depth, _) = len(bins), bins.size
    heightmap = torch.zeros_like(bins.heightmap)
    bearing = torch.ones_like(heightmap, dtype=torch.bool)
    if not bins.boxes.numel():
        return bearing
    real = torch.arange(bins.boxes.shape[1], device=bins.device) < bins.count[:, None]
    boxes = torch.where(real[..., None], bins.boxes, 0).long()
    w, d, count = torch.stack((*boxes[..., 3:5].amax((0, 1)), bins.count.amax())).tolist()
    index = torch.arange(n, device=bins.device)
    for k in range(count):
        corner, z, sides = boxes[:, k].tensor_split((2, 3), 1)
        under = footprint(width, depth, sides, corner)
        x, y = corner.T
        contact = bearing & (heightmap == z[:, None]) & under
        window, member = cut_windows(contact, index, x, y, sides, (w, d))
        present, upper, lower = boundary(window & member)
        top, bottom = _rounded(upper, present), _rounded(lower, present)
        top = torch.minimum(top[:, :-1], top[:, 1:])  # over each row of cells
        bottom = torch.minimum(bottom[:, :-1], bottom[:, 1:])
        i = torch.arange(width, device=bins.device) - x[:, None]
        j = torch.arange(depth, device=bins.device) - y[:, None]
        i = i.clamp(0, top.shape[1] - 1)
        above_lower = j[:, None, :] >= -bottom.gather(1, i)[:, :, None]
        below_upper = j[:, None, :] + 1 <= top.gather(1, i)[:, :, None]
        bearing = torch.where(under, above_lower & below_upper, bearing)
        place_boxes(heightmap, torch.zeros_like(heightmap), under, sides[:, 2])
    return bearing


def _rounded(points: Tensor, present: Tensor) -> Tensor:
    """Return the upper chain of the hull over x = 0 … P - 1, rounded down, int64 [U, P].

    A maximum rounded down is the maximum of the numbers rounded down, so all pairs of points are
    rounded first.

    Args:
        points: int64 [U, P], height of the hull's boundary points.
        present: bool [U, P], which of them exist.
    """
    size = points.shape[1]
    x = torch.arange(size, device=points.device)
    ex = (x[None, :] - x[:, None]).clamp(min=1)  # [i, j]
    between = (x[:, None, None] <= x) & (x <= x[None, :, None])  # [i, j, x]
    run = x[None, None, :] - x[:, None, None]
    out = torch.empty_like(points)
    chunk = max(1, PAIR_CELLS // size**3)
    low = torch.iinfo(points.dtype).min
    for start in range(0, len(points), chunk):
        p, real = points[start : start + chunk], present[start : start + chunk]
        ey = p[:, None, :] - p[:, :, None]
        rise = torch.div(ey[..., None] * run, ex[:, :, None], rounding_mode="floor")
        ok = between & real[:, :, None, None] & real[:, None, :, None]
        out[start : start + chunk] = (
            torch.where(ok, p[:, :, None, None] + rise, low).flatten(1, 2).amax(1)
        )
    return out.clamp(min=-(1 << 30))
