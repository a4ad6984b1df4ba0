"""Convex-hull masks in batched tensor code, for any device.

The method is that of :mod:`marl_pack.stability.hull_compiled`: sliding maxima by doubling, and an
exact test of the few windows that the quadrants leave undecided. Here gathers compute the maxima,
because the windows of oriented items have different sizes. The masks are equal cell by cell.
"""

from __future__ import annotations

import torch
from torch import Tensor

from marl_pack.geometry import MAX_HEIGHT
from marl_pack.geometry.tensor import cut_windows, shift, slide, windows_inside
from marl_pack.stability.centres import CentreTable, centre_table
from marl_pack.stability.hull_exact import ROUNDING

CENTRAL = centre_table(((0.0, 0.0),), 0.0, 0)
"""Table for centres of mass in the middle and no margin; its unit is half a cell."""
PAIR_CELLS = 1 << 24
"""Largest number of elements of a tensor [windows, points, points, points] in the exact test."""


def _below_chain(
    points: Tensor, present: Tensor, com: Tensor, centres: CentreTable
) -> tuple[Tensor, Tensor]:
    """Decide whether ``com`` lies more than the margin below the upper chain of each hull.

    The chain at x is the highest of the lines between a point left and a point right of x. So
    without a margin, one such line above ``com`` is enough. With a margin, the distance of ``com``
    from every edge is compared; an edge is a pair of points such that no point lies above its line.

    Args:
        points: float64 [U, P], height of the hull's boundary points over x = 0 … P - 1, in cells.
        present: bool [U, P], which of these points exist.
        com: float64 [U, 2], in units of ``centres``.
        centres: the table with the margin and the unit.

    Returns:
        Two answers, bool [U] each: whether ``com`` surely lies below, and whether it may.
        They are equal where float64 is exact.
    """
    size = points.shape[1]
    unit, margin = centres.unit, centres.margin
    x = torch.arange(size, dtype=torch.float64, device=points.device)
    ex = x[None, :] - x[:, None]  # [i, j]
    ey = points[:, None, :] - points[:, :, None]  # [U, i, j]
    pair = present[:, :, None] & present[:, None, :] & (ex > 0)
    # cross of (i → com) with (i → j): positive where com lies below the line
    run, rise = com[:, 0, None] - x * unit, com[:, 1, None] - points * unit
    cross = ey * run[:, :, None] - ex * rise[:, :, None]
    reach = com.abs()[:, :, None] + unit * torch.stack((x.expand_as(points), points.abs()), 1)
    reach = ey.abs() * reach[:, 0, :, None] + ex.abs() * reach[:, 1, :, None]
    if margin == 0:
        error = 0.0 if centres.whole else ROUNDING * reach
        slack = 0.0 if centres.whole else ROUNDING * unit * size
        sure, possible = pair & (cross > error), pair & (cross >= -error)
        if centres.whole:
            possible = sure
        sure &= (run >= 0)[:, :, None] & (run <= 0)[:, None, :]
        possible &= (run >= -slack)[:, :, None] & (run <= slack)[:, None, :]
        return sure.flatten(1).any(1), possible.flatten(1).any(1)
    # cross of (i → j) with (i → k): positive where k lies above the line
    above = (
        ex[None, :, :, None] * (points[:, None, None, :] - points[:, :, None, None])
        - ey[..., None] * (x - x[:, None])[None, :, None, :]
    )
    edge = pair & ~((above > 0) & present[:, None, None, :]).any(-1)
    length = torch.sqrt(ex * ex + ey * ey)
    distance = cross - margin * length
    inexact = (length != length.floor()) | (not centres.whole)
    error = torch.where(inexact, ROUNDING * (reach + margin * length), 0.0)
    sure, possible = distance > error, (distance > error) | (distance.abs() <= error) & inexact
    return (sure | ~edge).flatten(1).all(1), (possible | ~edge).flatten(1).all(1)


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
    first = contact.byte().argmax(2)  # lower edge of the row's first cell
    none = torch.zeros(count, 1, dtype=torch.bool, device=contact.device)
    present = torch.cat((none, has), 1) | torch.cat((has, none), 1)
    absent = torch.full((count, 1), -d - 1, dtype=torch.int64, device=contact.device)

    def extreme(values: Tensor) -> Tensor:
        corners = torch.where(has, values, -d - 1)
        best = torch.maximum(torch.cat((absent, corners), 1), torch.cat((corners, absent), 1))
        return torch.where(present, best, 0)

    return present, extreme(last), extreme(-first)


def inside(contact: Tensor, com: Tensor, centres: CentreTable) -> tuple[Tensor, Tensor]:
    """Decide whether each ``com`` lies more than the margin inside the hull of its contact.

    Args:
        contact: bool [U, w, d], the contact cells that count.
        com: float64 [U, 2], measured from the window's low corner, in units of ``centres``.
        centres: the table with the margin and the unit.

    Returns:
        Two answers, bool [U] each: whether ``com`` surely lies inside, and whether it may.
    """
    count, w, _ = contact.shape
    present, upper, lower = boundary(contact)
    x = torch.arange(w + 1, dtype=torch.float64, device=contact.device)
    left = torch.where(present, x, torch.inf).amin(1) * centres.unit
    right = torch.where(present, x, -torch.inf).amax(1) * centres.unit
    distance = torch.minimum(com[:, 0] - left, right - com[:, 0]) - centres.margin
    error = 0.0 if centres.whole else ROUNDING * (w * centres.unit + centres.margin)
    sure = distance > error
    possible = sure if centres.whole else distance >= -error
    sure, possible = sure.clone(), possible.clone()
    mirrored = com * torch.tensor([1.0, -1.0], dtype=torch.float64, device=com.device)
    chunk = max(1, PAIR_CELLS // (w + 1) ** (2 if centres.margin == 0 else 3))
    for start in range(0, count, chunk):
        part = slice(start, start + chunk)
        for points, point in ((upper, com), (lower, mirrored)):
            below = _below_chain(points[part].double(), present[part], point[part], centres)
            sure[part] &= below[0]
            possible[part] &= below[1]
    return sure, possible


def _largest_levels(
    level: Tensor, sides: Tensor, low: Tensor, start: Tensor, equal: bool, cover: bool
) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    """Compute the largest K of each window, and of its quadrants and halves.

    Args:
        level: int16 [B, W, D], K of every column (:mod:`marl_pack.stability.hull_compiled`).
        sides: int64 [B, 2], the windows' sides w, d.
        low: int64 [B, 2], cells of the parts that begin at the window's low corner.
        start: int64 [B, 2], first cells of the parts that end at the window's high corner.
        equal: whether the four quadrants have the same size: centre of mass in the middle and no
            margin.
        cover: whether the quadrants cover the window: no margin.

    Returns:
        int16 [B, W, D] for the windows, four such tensors for the quadrants, and four for the
        halves.
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
    windows = torch.maximum(halves[0], halves[1]) if cover else slide(level, w, d)
    return windows, quadrants, halves


def support_mask(
    heightmap: Tensor,
    empty_map: Tensor,
    sides: Tensor,
    height: int,
    centres: CentreTable | None = None,
) -> tuple[Tensor, Tensor | None]:
    """Compute where each box fits and its centre of mass is supported.

    Args:
        heightmap: int16 [N, W, D].
        empty_map: int or bool [N, W, D]; only columns where it is 0 count as support.
        sides: int16 [N, A, 3].
        height: the bin's height H, at most 16383 cells.
        centres: table of the centres of mass with the margin; None: centres of mass in the middle
            and no margin.

    Returns:
        The mask, bool [N, A, W, D], and the windows int64 [U, 4] (rows n, a, x, y) that exact
        fractions must decide; None if there are none.
    """
    assert height <= MAX_HEIGHT
    n, width, depth = heightmap.shape
    count = sides.shape[1]
    flat = sides.flatten(0, 1).long()
    central = centres is None
    if centres is None:
        centres, footprint = CENTRAL, flat[:, :2]
        low, start, middle = (footprint + 1) // 2, footprint // 2, footprint.double()
    else:
        tables = centres.low, centres.start, centres.at
        low, start, middle = (centres.look_up(table, sides).flatten(0, 1) for table in tables)
    level = (2 * heightmap + (empty_map == 0).to(heightmap.dtype)).repeat_interleave(count, 0)
    inner = torch.stack((flat[:, 0].clamp(1, width), flat[:, 1].clamp(1, depth)), 1)
    best, (a, b, c, e), halves = _largest_levels(
        level, inner, low, start, equal=central, cover=centres.margin == 0
    )
    limit = 2 * (height - flat[:, 2, None, None]) + 1
    within = (low > 0).all(1) & (start < flat[:, :2]).all(1)
    possible = windows_inside(flat, width, depth) & within[:, None, None]
    possible &= (best % 2 == 1) & (best <= limit)
    mask = possible & (torch.minimum(torch.minimum(a, b), torch.minimum(c, e)) == best)
    for half in halves:
        possible &= half == best
    index, x, y = torch.nonzero(possible & ~mask, as_tuple=True)
    unsure = None
    if index.numel():
        window, member = cut_windows(level, index, x, y, flat[index])
        contact = member & (window == best[index, x, y][:, None, None])
        sure, maybe = inside(contact, middle[index], centres)
        mask[index, x, y] = sure
        if not centres.whole or centres.margin > 0:
            rows = torch.stack((index // count, index % count, x, y), 1)[maybe & ~sure]
            unsure = rows if len(rows) else None
    return mask.view(n, count, width, depth), unsure
