"""Convex-hull masks in batched tensor code, for any device.

This is the rule of :mod:`marl_pack.stability.hull_compiled`, with the same quadrants: sliding
maxima by doubling, here as gathers because each oriented item has its own window, and an exact test
of the few windows that the quadrants leave undecided. The verdicts are equal cell by cell.
"""

from __future__ import annotations

import torch
from torch import Tensor

from marl_pack.geometry import MAX_HEIGHT
from marl_pack.geometry.tensor import cut_windows, shift, slide, windows_inside

PAIR_CELLS = 1 << 24
"""Largest number of elements of the exact test's [windows, points, points, points] at a time."""


def _below_chain(points: Tensor, present: Tensor, com: Tensor, margin: float) -> Tensor:
    """Return whether ``com`` lies strictly below the upper chain of each hull, by ``margin``.

    The chain at x is the highest of the lines between a point left and a point right of x, so
    without a margin one such line above ``com`` is enough. With one, ``com`` is measured against
    every edge: a pair of points that no other point lies above.

    Args:
        points: float64 [U, P], height of the hull's boundary points over x = 0 … P - 1.
        present: bool [U, P], which of them exist.
        com: float64 [U, 2].
        margin: in cells.
    """
    size = points.shape[1]
    x = torch.arange(size, dtype=torch.float64, device=points.device)
    ex = x[None, :] - x[:, None]  # [i, j]
    ey = points[:, None, :] - points[:, :, None]  # [U, i, j]
    pair = present[:, :, None] & present[:, None, :] & (ex > 0)
    # cross of (i → j) with (i → com): negative where com lies below the line
    run, rise = com[:, 0, None] - x, com[:, 1, None] - points
    cross = ex * rise[:, :, None] - ey * run[:, :, None]
    if margin == 0:
        around = (run >= 0)[:, :, None] & (run <= 0)[:, None, :]
        return (pair & around & (cross < 0)).flatten(1).any(1)
    # cross of (i → j) with (i → k): positive where k lies above the line
    above = (
        ex[None, :, :, None] * (points[:, None, None, :] - points[:, :, None, None])
        - ey[..., None] * (x - x[:, None])[None, :, None, :]
    )
    edge = pair & ~((above > 0) & present[:, None, None, :]).any(-1)
    clear = (cross < 0) & (-cross > margin * torch.sqrt(ex * ex + ey * ey))
    return (clear | ~edge).flatten(1).all(1)


def boundary(contact: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Find the extreme corners of the contact squares over each x = 0 … w.

    Args:
        contact: bool [U, w, d].

    Returns:
        ``present`` bool [U, w + 1], whether a square has a corner there; ``upper`` and ``lower``
        int64 [U, w + 1], the largest y and the largest -y of those corners (0 where absent).
    """
    count, _, d = contact.shape
    has = contact.any(2)
    last = d - contact.flip(2).byte().argmax(2)  # upper edge of the row's last cell
    first = contact.byte().argmax(2)  # lower edge of its first
    none = torch.zeros(count, 1, dtype=torch.bool, device=contact.device)
    present = torch.cat((none, has), 1) | torch.cat((has, none), 1)
    absent = torch.full((count, 1), -d - 1, dtype=torch.int64, device=contact.device)

    def extreme(values: Tensor) -> Tensor:
        corners = torch.where(has, values, -d - 1)
        best = torch.maximum(torch.cat((absent, corners), 1), torch.cat((corners, absent), 1))
        return torch.where(present, best, 0)

    return present, extreme(last), extreme(-first)


def inside(contact: Tensor, com: Tensor, margin: float) -> Tensor:
    """Return whether each ``com`` lies more than ``margin`` inside the hull of its contact.

    Args:
        contact: bool [U, w, d], the contact cells that count.
        com: float64 [U, 2], from the window's low corner.
        margin: in cells, ≥ 0.

    Returns:
        Bool [U].
    """
    count, w, _ = contact.shape
    present, upper, lower = boundary(contact)
    x = torch.arange(w + 1, dtype=torch.float64, device=contact.device)
    left = torch.where(present, x, torch.inf).amin(1)
    right = torch.where(present, x, -torch.inf).amax(1)
    result = (com[:, 0] - left > margin) & (right - com[:, 0] > margin)
    mirrored = com * torch.tensor([1.0, -1.0], dtype=torch.float64, device=com.device)
    chunk = max(1, PAIR_CELLS // (w + 1) ** (2 if margin == 0 else 3))
    for start in range(0, count, chunk):
        part = slice(start, start + chunk)
        for points, point in ((upper, com), (lower, mirrored)):
            result[part] &= _below_chain(points[part].double(), present[part], point[part], margin)
    return result


def _largest_levels(
    level: Tensor, sides: Tensor, low: Tensor, start: Tensor, equal: bool, cover: bool
) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    """Compute the largest K of each window, of its quadrants and of its halves.

    Args:
        level: int16 [B, W, D], K of every column.
        sides: int64 [B, 2], the windows' sides w, d.
        low: int64 [B, 2], cells of the parts that begin at the window's low corner.
        start: int64 [B, 2], where the parts begin that end at its high corner.
        equal: whether the four quadrants have one size: central mass and no margin.
        cover: whether the quadrants cover the window: no margin.

    Returns:
        int16 [B, W, D] of the windows, four of these of the quadrants, and four of the halves.
    """
    w, d = sides[:, 0], sides[:, 1]
    low, high = low.clamp(min=1), (sides - start).clamp(min=1)
    quarter = slide(level, low[:, 0], low[:, 1]) if equal else None

    def largest(
        x_part: tuple[Tensor, Tensor | None], y_part: tuple[Tensor, Tensor | None]
    ) -> Tensor:
        """Compute the largest K in a part of each window, given as extent and offset."""
        (pw, sx), (pd, sy) = x_part, y_part
        part = slide(level, pw, pd) if quarter is None else quarter
        part = part if sx is None else shift(part, sx, 1)
        return part if sy is None else shift(part, sy, 2)

    x_parts = (low[:, 0], None), (high[:, 0], w - high[:, 0])
    y_parts = (low[:, 1], None), (high[:, 1], d - high[:, 1])
    quadrants = [largest(x_part, y_part) for x_part in x_parts for y_part in y_parts]
    halves = (
        [torch.maximum(quadrants[i], quadrants[j]) for i, j in ((0, 1), (2, 3), (0, 2), (1, 3))]
        if cover
        else [largest(x_part, (d, None)) for x_part in x_parts]
        + [largest((w, None), y_part) for y_part in y_parts]
    )
    whole = torch.maximum(halves[0], halves[1]) if cover else slide(level, w, d)
    return whole, quadrants, halves


def support_mask(
    heightmap: Tensor,
    empty_map: Tensor,
    sides: Tensor,
    height: int,
    com: Tensor | None = None,
    margin: float = 0.0,
) -> Tensor:
    """Compute where each box fits and its centre of mass is supported, bool [N, A, W, D].

    Args:
        heightmap: int16 [N, W, D].
        empty_map: int or bool [N, W, D]; only columns where it is 0 count as support.
        sides: int16 [N, A, 3].
        height: H, at most 16383 cells.
        com: float64 [N, A, 2] from the window's low corner; the middle by default.
        margin: cells by which the support polygon is shrunk.
    """
    assert height <= MAX_HEIGHT
    n, width, depth = heightmap.shape
    count = sides.shape[1]
    flat = sides.flatten(0, 1).long()
    middle = flat[:, :2].double() / 2 if com is None else com.flatten(0, 1)
    level = (2 * heightmap + (empty_map == 0).to(heightmap.dtype)).repeat_interleave(count, 0)
    inner = torch.stack((flat[:, 0].clamp(1, width), flat[:, 1].clamp(1, depth)), 1)
    low, start = torch.ceil(middle - margin).long(), torch.floor(middle + margin).long()
    best, (a, b, c, e), halves = _largest_levels(
        level, inner, low, start, equal=com is None and margin == 0, cover=margin == 0
    )
    limit = 2 * (height - flat[:, 2, None, None]) + 1
    within = (low > 0).all(1) & (start < flat[:, :2]).all(1)
    possible = windows_inside(flat, width, depth) & within[:, None, None]
    possible &= (best % 2 == 1) & (best <= limit)
    mask = possible & (torch.minimum(torch.minimum(a, b), torch.minimum(c, e)) == best)
    for half in halves:
        possible &= half == best
    index, x, y = torch.nonzero(possible & ~mask, as_tuple=True)
    if index.numel():
        window, member = cut_windows(level, index, x, y, flat[index])
        contact = member & (window == best[index, x, y][:, None, None])
        mask[index, x, y] = inside(contact, middle[index], margin)
    return mask.view(n, count, width, depth)
