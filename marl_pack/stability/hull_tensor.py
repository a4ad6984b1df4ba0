"""Convex-hull masks in batched tensor code, for any device.

The method is that of :mod:`marl_pack.stability.hull_compiled`: sliding maxima, and an exact test of
the windows that the quadrants leave undecided. On small floors this test is computed for all
windows, so that all shapes are fixed and the program never waits for the device. On large floors,
with a margin, and where no unit makes all numbers whole, only the undecided windows are tested, and
the program waits for their number. The masks are equal cell by cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from marl_pack.geometry import MAX_HEIGHT
from marl_pack.geometry.tensor import bins_last, cut_windows, divide, shift, slide
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


@dataclass(frozen=True)
class _Windows:
    """The footprints of A oriented items of N bins, and their parts around the centre of mass."""

    sides: Tensor  # int64 [2, A, N]     w, d, clamped to the map
    low: Tensor  # int64 [2, A, N]       cells of the parts that begin at the low corner
    start: Tensor  # int64 [2, A, N]     first cells of the parts that end at the high corner
    middle: Tensor  # float64 [2, A, N]  the centre of mass in units, from the low corner
    centres: CentreTable
    central: bool  # centres of mass in the middle and no margin
    x_fits: Tensor  # bool [W, 1, A, N]  where the box lies inside the bin along x, and has cells
    # with its height beyond the margin on each side
    y_fits: Tensor  # bool [D, A, N]     where it lies inside the bin along y


def _windows(sides: Tensor, size: tuple[int, int, int], centres: CentreTable | None) -> _Windows:
    """Return the footprints of oriented items, ``sides`` [N, A, 3], in a bin of ``size``."""
    width, depth, height = size
    w, d, h = boxes = sides.permute(2, 1, 0).contiguous().long()  # [A, N] each
    central = centres is None
    if centres is None:
        centres, low, start = CENTRAL, (boxes[:2] + 1) // 2, boxes[:2] // 2
        middle = boxes[:2].double()
    else:
        low, start, middle = (
            centres.look_up(table, sides).permute(2, 1, 0).contiguous()
            for table in ("low", "start", "at")
        )
    fits = (h > 0) & (h <= height) & ((low > 0) & (start < boxes[:2])).all(0)
    x, y = (torch.arange(side, device=w.device)[:, None, None] for side in (width, depth))
    clamped = torch.stack((w.clamp(1, width), d.clamp(1, depth)))
    x_fits = (fits & (x <= width - w))[:, None]
    return _Windows(clamped, low, start, middle, centres, central, x_fits, y <= depth - d)


def _number_type(centres: CentreTable, size: tuple[int, int, int]) -> torch.dtype | None:
    """Return the type of the numbers in :func:`_surrounded`; None: it cannot be used.

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


def _surrounded(levels: Tensor, best: Tensor, windows: _Windows, height: int) -> Tensor:
    """Decide for all windows whether the centre of mass lies strictly inside the hull of contact.

    Seen from the centre of mass, the hull passes above it iff the steepest rise to a corner on the
    left and the steepest rise to a corner on the right add up to more than 0, or a corner lies
    right above; the same holds below. A row of cells has its outermost corners at its last cell of
    the largest level. If this level is not that of the window, the corners are so low that they do
    not count.

    Args:
        levels: [W, D, 1, N], K of every column.
        best: [W, D, A, N], the windows' largest K.
        windows: the windows.
        height: H.

    Returns:
        Bool [W, D, A, N]; it has a meaning for windows with contact in each half.
    """
    width, depth, count, n = best.shape
    at_once = CELLS_AT_ONCE if best.device.type == "cpu" else CELLS_AT_ONCE << 8
    at_once = max(1, at_once // (width * depth * count))
    unit = int(windows.centres.unit)
    gap, dtype = _gap(unit, width, depth), _number_type(windows.centres, (width, depth, height))
    assert dtype is not None
    whole = torch.int32 if dtype == torch.float32 else torch.int64
    error = 2.0**-21 if dtype == torch.float32 else 2.0**-50
    y = unit * torch.arange(depth, device=best.device)
    high = torch.stack((y + unit, unit * depth - y))[:, None, :, None, None]  # upwards, downwards
    own = torch.stack((y, unit * depth - y))[:, None, :, None, None]
    reach = width // 2 if windows.central else width - 1  # corners that a side has beside its last
    x = torch.arange(reach + 1, device=best.device)[:, None, None]
    verdicts = []
    for first in range(0, max(1, n), at_once):
        part = slice(first, first + at_once)
        (w, d), (cx, cy) = windows.sides[..., part], windows.middle[..., part]
        rows = slide((levels[..., part].to(whole) * gap + high).to(whole), d, 2, depth)
        corners = torch.maximum(rows[:, :-1], rows[:, 1:])  # at x = 1 … W - 1
        begin = divide(cx, unit).floor().long()  # the row of the first corner on the right
        right_of = shift(corners, begin, 1, width - 1).to(dtype)
        last = shift(rows, w - 1, 1, width - 1).to(dtype)
        rows, corners = rows.to(dtype), corners.to(dtype)
        centre = torch.stack((cy, -cy))[:, None, None] + own
        centre = best[..., part].to(dtype) * gap + centre.to(dtype)
        run = cx - unit * x
        left = _steepest(centre, [rows, *(corners[:, i:] for i in range(reach))], run)
        run = torch.where(begin + 1 + x < w, unit * (begin + 1 + x) - cx, -1)
        run[-1] = w * unit - cx
        right = _steepest(centre, [*(right_of[:, i:] for i in range(reach)), last], run)
        needed = right.neg_()
        passes = left > needed.add(needed.abs(), alpha=error)
        verdicts.append(passes[0] & passes[1])
    return torch.cat(verdicts, 3)


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


def _parts(values: Tensor, axis: int, windows: _Windows) -> tuple[Tensor, Tensor]:
    """Compute the largest K along an axis in the low part and in the high part of each window.

    Args:
        values: [..., W, D, A or 1, N].
        axis: 0 for x, 1 for y.
        windows: the windows.

    Returns:
        [..., W, D, A, N] each.
    """
    dim = axis - 4
    length, low = values.shape[dim], windows.low[axis].clamp(min=1)
    high = (windows.sides[axis] - windows.start[axis]).clamp(min=1)
    first = slide(values, low, dim, (length + 1) // 2 if windows.central else length)
    last = first if windows.central else slide(values, high, dim, length)
    return first, shift(last, windows.sides[axis] - high, dim, length - 1)


def flat_mask(
    heightmap: Tensor,
    empty_map: Tensor,
    sides: Tensor,
    height: int,
    centres: CentreTable | None = None,
) -> tuple[Tensor, None]:
    """Compute :func:`support_mask` in empty bins: contact is everywhere, so no map is read."""
    windows = _windows(sides, (heightmap.shape[1], heightmap.shape[2], height), centres)
    return _bins_first(windows.x_fits & windows.y_fits), None


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
    width, depth = heightmap.shape[1:]
    windows = _windows(sides, (width, depth, height), centres)
    kind = torch.uint8 if height <= 126 else torch.int16
    levels = bins_last((2 * heightmap + (empty_map == 0)).to(kind))  # [W, D, 1, N]
    front, back = _parts(levels, 1, windows)
    (a, b), (c, e) = _parts(torch.stack((front, back)), 0, windows)  # low, high in x
    if windows.centres.margin == 0:  # the quadrants cover the window
        halves = [torch.maximum(*pair) for pair in ((a, b), (c, e), (a, c), (b, e))]
        best = torch.maximum(halves[0], halves[1])
    else:
        rows = slide(levels, windows.sides[1], 1, depth)
        halves = [slide(values, windows.sides[0], 0, width) for values in (front, back)]
        halves += _parts(rows, 0, windows)
        best = slide(rows, windows.sides[0], 0, width)
    top = 2 * (height - sides[..., 2].T.long()) + 1
    possible = best <= top.contiguous().clamp(min=0).to(kind)
    possible &= (best & 1).bool() & windows.y_fits
    possible &= windows.x_fits
    quadrants = torch.minimum(torch.minimum(a, b), torch.minimum(c, e)) == best
    for half in halves:
        possible &= half == best
    if _number_type(windows.centres, (width, depth, height)) is not None:
        verdict = _surrounded(levels, best, windows, height)
        return _bins_first(possible & (quadrants | verdict)), None
    mask = _bins_first(possible & quadrants)
    undecided = (_bins_first(possible) & ~mask).nonzero()
    if not len(undecided):
        return mask, None
    n, i, x, y = undecided.T
    boxes = sides[n, i].long()
    most = int(boxes[:, 0].max()), int(boxes[:, 1].max())
    window, member = cut_windows(levels[:, :, 0].permute(2, 0, 1), n, x, y, boxes, most)
    contact = member & (window == best[x, y, i, n][:, None, None])
    sure, maybe = inside(contact, windows.middle[:, i, n].T, windows.centres)
    mask[n, i, x, y] = sure
    unsure = undecided[maybe & ~sure]
    return mask, unsure if len(unsure) else None


def _bins_first(maps: Tensor) -> Tensor:
    """Return maps [W, D, A, N] as [N, A, W, D]."""
    return maps.permute(3, 2, 0, 1).contiguous()
