"""Convex-hull masks in batched tensor code, for any device.

The method is that of :mod:`marl_pack.stability.hull_compiled`: sliding maxima, and an exact test of
the windows that the quadrants leave undecided. On small floors this test is computed for all
windows, so that all shapes are fixed and the program never waits for the device. On large floors,
with a margin, and where no unit makes all numbers whole, only the undecided windows are tested, and
the program waits for their number. The masks are equal cell by cell.
"""

from __future__ import annotations

import torch
from torch import Tensor

from marl_pack.geometry import MAX_HEIGHT
from marl_pack.geometry.tensor import bins_last, cut_windows, shift, slide
from marl_pack.stability.centres import CentreTable, centre_table
from marl_pack.stability.hull_exact import ROUNDING

CENTRAL = centre_table(((0.0, 0.0),), 0.0, 0)
"""Table for centres of mass in the middle and no margin; its unit is half a cell."""
PAIR_CELLS = 1 << 24
"""Largest number of elements of a tensor [windows, points, points, points] in the exact test."""

LARGEST_SIDE = 24
"""Longest side of a floor on which the exact test is computed for all windows."""
CELLS_AT_ONCE = 1 << 17
"""Number of windows that the exact test takes at once."""
STEEP = 2.0**60
"""A rise that is larger than all others: to a corner right above the centre of mass."""


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


def _float_of(centres: CentreTable, size: tuple[int, int, int]) -> torch.dtype | None:
    """Return the type of the numbers in :func:`_surrounded`, None if it cannot be used.

    Two sums of rises differ by at least 1 / gap of their size. The type needs four bits more.
    """
    if not centres.whole or centres.margin > 0 or max(size[:2]) > LARGEST_SIDE:
        return None
    largest = (2 * size[2] + 2) * _gap(centres.unit, *size[:2])
    if largest <= 1 << 22:
        return torch.float32
    return torch.float64 if largest <= 1 << 50 else None


def _gap(unit: float, width: int, depth: int) -> int:
    """Return a distance in units that makes a corner so much lower that it does not count."""
    return int(unit) * (depth + 1) + int(unit) ** 2 * width * depth


def _surrounded(
    levels: Tensor,
    best: Tensor,
    extents: tuple[Tensor, Tensor],
    centre: tuple[Tensor, Tensor],
    height: int,
    centres: CentreTable,
    reach: int,
) -> Tensor:
    """Decide for all windows whether the centre of mass lies strictly inside the hull of contact.

    Seen from the centre of mass, the hull passes above it iff the steepest rise to a corner on the
    left and the steepest rise to a corner on the right add up to more than 0, or a corner lies
    right above; the same holds below. A row of cells has its highest corners at its last cell of
    the largest level. If this level is not that of the window, the corners are so low that they do
    not count.

    Args:
        levels: [W, D, 1, N], K of every column.
        best: [W, D, A, N], the windows' largest K.
        extents: int64 [A, N] each, the windows' sides w, d, inside the map.
        centre: float64 [A, N] each, x and y of the centre of mass in units.
        height: H.
        centres: the table with the unit.
        reach: the largest number of corners on one side of a centre of mass, less the window's own.

    Returns:
        Bool [W, D, A, N]; it has a meaning for windows with contact in each half.
    """
    width, depth = best.shape[:2]
    (w, d), (cx, cy) = extents, centre
    dtype, unit = _float_of(centres, (width, depth, height)), int(centres.unit)
    assert dtype is not None
    gap, whole = _gap(unit, width, depth), torch.int32 if dtype == torch.float32 else torch.int64
    y = unit * torch.arange(depth, device=w.device)
    high = torch.stack((y + unit, unit * depth - y))[:, None, :, None, None]  # upwards, downwards
    rows = slide(levels.to(whole) * gap + high.to(whole), d, 2, depth)
    corners = torch.maximum(rows[:, :-1], rows[:, 1:])  # at x = 1 … W - 1
    own = torch.stack((y[:, None, None] + cy, (unit * depth - y)[:, None, None] - cy))
    own = best.to(dtype) * gap + own[:, None].to(dtype)
    after = (cx / unit).floor().long() + 1  # first corner on the right
    right_of = shift(corners, after - 1, 1, width - 1).to(dtype)
    end = shift(rows, w - 1, 1, width - 1).to(dtype)
    rows, corners = rows.to(dtype), corners.to(dtype)
    x = torch.arange(reach + 1, device=w.device)[:, None, None]
    left = _steepest(own, [rows, *(corners[:, i:] for i in range(reach))], cx - unit * x)
    run = torch.where(after + x < w, unit * (after + x) - cx, -1)
    run[-1] = w * unit - cx
    right = _steepest(own, [*(right_of[:, i:] for i in range(reach)), end], run)
    error = 2.0**-21 if dtype == torch.float32 else 2.0**-50
    return (left + right > error * (left.abs() + right.abs())).all(0)


def _steepest(own: Tensor, points: list[Tensor], runs: Tensor) -> Tensor:
    """Compute the steepest rise from each window's centre of mass to one of some points.

    Args:
        own: float [2, W, D, A, N], height of the centre of mass.
        points: float [2, ≤ W, D, A, N] each, heights of the points.
        runs: float64 [P, A, N], horizontal distance of each point; the point does not count where
            it is negative.
    """
    slopes = torch.where(runs > 0, 1 / runs, STEEP).where(runs >= 0, 0).to(own.dtype)
    least = torch.where(runs > 0, 0, -STEEP / 2).where(runs >= 0, -torch.inf).to(own.dtype)
    steepest, scratch = torch.full_like(own, -torch.inf), torch.empty_like(own)
    for height, slope, smallest in zip(points, slopes, least, strict=True):
        best, rise, middle = (t[:, : height.shape[1]] for t in (steepest, scratch, own))
        torch.sub(height, middle, out=rise)
        torch.addcmul(smallest, rise, slope, out=rise)
        torch.maximum(best, rise, out=best)
    return steepest


def _parts(
    values: Tensor, axis: int, extent: Tensor, low: Tensor, start: Tensor, equal: bool
) -> tuple[Tensor, Tensor]:
    """Compute the largest K along an axis in the low part and in the high part of each window.

    Args:
        values: [W, D, A or 1, N].
        axis: 0 or 1.
        extent: int64 [A, N], the windows' cells along the axis.
        low: int64 [A, N], cells of the low part, which begins at the window's low corner.
        start: int64 [A, N], first cell of the high part, which ends at the window's high corner.
        equal: whether both parts have the same size: centre of mass in the middle and no margin.

    Returns:
        [W, D, A, N] each.
    """
    length, low, high = values.shape[axis], low.clamp(min=1), (extent - start).clamp(min=1)
    first = slide(values, low, axis, (length + 1) // 2 if equal else length)
    last = first if equal else slide(values, high, axis, length)
    return first, shift(last, extent - high, axis, length - 1)


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
    w, d, h = sides.permute(2, 1, 0).contiguous().long()  # [A, N] each
    equal = centres is None
    if centres is None:
        centres, low, start = CENTRAL, ((w + 1) // 2, (d + 1) // 2), (w // 2, d // 2)
        middle = torch.stack((w, d)).double()
    else:
        tables = centres.low, centres.start, centres.at
        low, start, middle = (
            centres.look_up(table, sides).permute(2, 1, 0).contiguous() for table in tables
        )
    within = (h > 0) & (h <= height)
    for side, first, last in zip((w, d), low, start, strict=True):
        within &= (first > 0) & (last < side)
    within_x = within & (torch.arange(width, device=w.device)[:, None, None] <= width - w)
    within_y = torch.arange(depth, device=w.device)[:, None, None] <= depth - d
    w, d = w.clamp(1, width), d.clamp(1, depth)
    kind = torch.uint8 if height <= 126 else torch.int16
    levels = bins_last((2 * heightmap + (empty_map == 0)).to(kind))  # [W, D, 1, N]
    front, back = _parts(levels, 1, d, low[1], start[1], equal)
    (a, c), (b, e) = (_parts(values, 0, w, low[0], start[0], equal) for values in (front, back))
    if centres.margin == 0:  # the quadrants cover the window
        halves = [torch.maximum(*pair) for pair in ((a, b), (c, e), (a, c), (b, e))]
        best = torch.maximum(halves[0], halves[1])
    else:
        rows = slide(levels, d, 1, depth)
        halves = [slide(values, w, 0, width) for values in (front, back)]
        halves += _parts(rows, 0, w, low[0], start[0], equal)
        best = slide(rows, w, 0, width)
    possible = best <= (2 * (height - h) + 1).clamp(min=0).to(kind)
    possible &= (best & 1).bool() & within_y
    possible &= within_x[:, None]
    quadrants = torch.minimum(torch.minimum(a, b), torch.minimum(c, e)) == best
    for half in halves:
        possible &= half == best
    if _float_of(centres, (width, depth, height)) is not None:
        reach = width // 2 if equal else width - 1
        at_once = CELLS_AT_ONCE if heightmap.device.type == "cpu" else CELLS_AT_ONCE << 8
        at_once = max(1, at_once // (width * depth * len(w)))
        verdict = torch.cat(
            [
                _surrounded(
                    levels[..., part], best[..., part], (w[:, part], d[:, part]),
                    (middle[0, :, part], middle[1, :, part]), height, centres, reach,
                )
                for part in (slice(i, i + at_once) for i in range(0, max(1, n), at_once))
            ],
            3,
        )
        return _bins_first(possible & (quadrants | verdict)), None
    mask, undecided = _bins_first(possible & quadrants), _bins_first(possible & ~quadrants)
    if not bool(undecided.any()):
        return mask, None
    b, a, x, y = rows = undecided.nonzero(as_tuple=True)
    window, member = cut_windows(levels[:, :, 0].permute(2, 0, 1), b, x, y, sides[b, a].long())
    contact = member & (window == best[x, y, a, b][:, None, None])
    sure, maybe = inside(contact, middle[:, a, b].T, centres)
    mask[rows] = sure
    unsure = torch.stack(rows, 1)[maybe & ~sure]
    return mask, unsure if len(unsure) else None


def _bins_first(maps: Tensor) -> Tensor:
    """Return maps [W, D, A, N] as [N, A, W, D]."""
    return maps.permute(3, 2, 0, 1).contiguous()
