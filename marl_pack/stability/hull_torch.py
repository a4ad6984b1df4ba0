"""Convex-hull masks in batched tensor code, for any device.

The same rule as :mod:`marl_pack.stability.hull_cpu`, by the same quadrants: sliding maxima by
doubling, here as gathers since each candidate has its own window, and an exact test of the few
windows the quadrants leave undecided. Verdicts are equal cell by cell.
"""

from __future__ import annotations

import torch
from torch import Tensor

from marl_pack.bins import MAX_HEIGHT

PAIR_CELLS = 1 << 24  # elements of the exact test's [windows, points, points, points] at a time


def _shift(values: Tensor, steps: Tensor, dim: int) -> Tensor:
    """``values`` [B, W, D] read ``steps`` [B] further along ``dim`` (past the edge: the edge)."""
    length = values.shape[dim]
    index = torch.arange(length, device=values.device) + steps[:, None]
    index = index.clamp(0, length - 1)
    index = index[:, :, None] if dim == 1 else index[:, None, :]
    return values.gather(dim, index.expand_as(values))


def slide(values: Tensor, w: Tensor, d: Tensor) -> Tensor:
    """Maximum over the w × d window with its low corner at each cell.

    Args:
        values: [B, W, D]. w, d: int64 [B], ≥ 1.

    Returns:
        [B, W, D]; right wherever the window lies inside the map.
    """
    for extent, dim in ((d, 2), (w, 1)):
        longest = int(extent.max()) if extent.numel() else 0
        reach = 1
        while reach < longest:
            step = torch.clamp(extent - reach, min=0, max=reach)
            values = torch.maximum(values, _shift(values, step, dim))
            reach *= 2
    return values


def fits(sides: Tensor, width: int, depth: int) -> Tensor:
    """Bool [B, W, D]: where a window of ``sides`` [B, 3] lies inside the map and is not empty."""
    x = torch.arange(width, device=sides.device)
    y = torch.arange(depth, device=sides.device)
    in_x = x <= (width - sides[:, 0, None])
    in_y = y <= (depth - sides[:, 1, None])
    return in_x[:, :, None] & in_y[:, None, :] & (sides > 0).all(1)[:, None, None]


def resting_height(heightmap: Tensor, sides: Tensor) -> Tensor:
    """Highest column of every window, int16 [N, A, W, D]; right where the window fits.

    Args:
        heightmap: int16 [N, W, D]. sides: int16 [N, A, 3].
    """
    ways = sides.shape[1]
    flat = sides.flatten(0, 1).long().clamp(min=1)
    rest = slide(heightmap.repeat_interleave(ways, 0), flat[:, 0], flat[:, 1])
    return rest.view(-1, ways, *rest.shape[1:])


def _below_chain(points: Tensor, present: Tensor, com: Tensor, margin: float) -> Tensor:
    """Whether ``com`` lies strictly below the upper chain of each hull, by ``margin``.

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
    """Extreme corners of the contact squares over each x = 0 … w.

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
        v = torch.where(has, values, -d - 1)
        best = torch.maximum(torch.cat((absent, v), 1), torch.cat((v, absent), 1))
        return torch.where(present, best, 0)

    return present, extreme(last), extreme(-first)


def inside(contact: Tensor, com: Tensor, margin: float) -> Tensor:
    """Bool [U]: ``com`` strictly inside the hull of the squares of ``contact``, by ``margin``.

    Args:
        contact: bool [U, w, d], the contact cells that count. com: float64 [U, 2].
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


def support_mask(
    heightmap: Tensor,
    hollow: Tensor,
    sides: Tensor,
    height: int,
    com: Tensor | None = None,
    margin: float = 0.0,
) -> Tensor:
    """Bool [N, A, W, D]: where each candidate fits and its centre of mass is supported.

    Args:
        heightmap: int16 [N, W, D].
        hollow: int [N, W, D]; only columns where it is 0 count as support.
        sides: int16 [N, A, 3].
        height: H, at most 16383 cells.
        com: float64 [N, A, 2] from the window's low corner; the middle by default.
        margin: cells by which the support polygon is shrunk.
    """
    assert height <= MAX_HEIGHT
    n, width, depth = heightmap.shape
    ways = sides.shape[1]
    flat = sides.flatten(0, 1).long()
    middle = flat[:, :2].double() / 2 if com is None else com.flatten(0, 1)
    possible = fits(flat, width, depth)
    level = (2 * heightmap + (hollow == 0).to(heightmap.dtype)).repeat_interleave(ways, 0)

    w, d = flat[:, 0].clamp(1, width), flat[:, 1].clamp(1, depth)
    low = torch.ceil(middle - margin).long()
    start = torch.floor(middle + margin).long()
    lows_w, lows_d = low[:, 0].clamp(min=1), low[:, 1].clamp(min=1)
    high_w, high_d = (w - start[:, 0]).clamp(min=1), (d - start[:, 1]).clamp(min=1)
    room = (low > 0).all(1) & (start < flat[:, :2]).all(1)

    # With a central mass and no margin all four quadrants have one size.
    quarter = slide(level, lows_w, lows_d) if com is None and margin == 0 else None

    def largest(
        x_part: tuple[Tensor, Tensor | None], y_part: tuple[Tensor, Tensor | None]
    ) -> Tensor:
        """The largest K in a part of each window, given as its extent and offset in x and y."""
        (pw, sx), (pd, sy) = x_part, y_part
        part = slide(level, pw, pd) if quarter is None else quarter
        part = part if sx is None else _shift(part, sx, 1)
        return part if sy is None else _shift(part, sy, 2)

    x_parts = (lows_w, None), (high_w, w - high_w)
    y_parts = (lows_d, None), (high_d, d - high_d)
    a, b, c, e = (largest(x_part, y_part) for x_part in x_parts for y_part in y_parts)
    if margin == 0:  # the quadrants cover the window
        halves = torch.maximum(a, b), torch.maximum(c, e), torch.maximum(a, c), torch.maximum(b, e)
        best = torch.maximum(halves[0], halves[1])
    else:
        best = slide(level, w, d)
        halves = (
            largest(x_parts[0], (d, None)), largest(x_parts[1], (d, None)),
            largest((w, None), y_parts[0]), largest((w, None), y_parts[1]),
        )  # fmt: skip
    limit = 2 * (height - flat[:, 2, None, None]) + 1
    possible &= room[:, None, None] & (best % 2 == 1) & (best <= limit)
    mask = possible & (torch.minimum(torch.minimum(a, b), torch.minimum(c, e)) == best)
    for half in halves:
        possible &= half == best
    index, x, y = torch.nonzero(possible & ~mask, as_tuple=True)
    if index.numel():
        window, member = windows(level, index, x, y, flat[index])
        contact = member & (window == best[index, x, y][:, None, None])
        mask[index, x, y] = inside(contact, middle[index], margin)
    return mask.view(n, ways, width, depth)


def windows(
    values: Tensor, index: Tensor, x: Tensor, y: Tensor, sides: Tensor
) -> tuple[Tensor, Tensor]:
    """Cut windows of different sizes out of maps.

    Args:
        values: [B, W, D]. index, x, y: int64 [U], map and low corner. sides: int [U, ≥ 2].

    Returns:
        [U, w, d] for the largest w and d, and bool [U, w, d]: which cells belong to the window.
    """
    i = torch.arange(int(sides[:, 0].max()), device=values.device)
    j = torch.arange(int(sides[:, 1].max()), device=values.device)
    rows = (x[:, None] + i).clamp(max=values.shape[1] - 1)
    columns = (y[:, None] + j).clamp(max=values.shape[2] - 1)
    member = (i < sides[:, :1])[:, :, None] & (j < sides[:, 1:2])[:, None, :]
    return values[index[:, None, None], rows[:, :, None], columns[:, None, :]], member
