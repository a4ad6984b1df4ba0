"""Windows and placements of boxes in batched tensor code, for any device.

:mod:`marl_pack.geometry.compiled` has the same operations as compiled loops. In a batch of B maps,
each map can have a window of another size.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

from marl_pack.geometry.boxes import ORIENTATIONS


@cache
def orientation_table(device: torch.device) -> Tensor:
    """Return :data:`ORIENTATIONS` as int64 [6, 3] on ``device``."""
    return torch.tensor(ORIENTATIONS, device=device)


def oriented(items: Tensor) -> Tensor:
    """Return the items' sides (w, d, h) [..., 3] in their six orientations [..., 6, 3]."""
    return items[..., orientation_table(items.device)]


def divide(values: Tensor, number: float) -> Tensor:
    """Divide each value by a number, rounded once on every device.

    On CUDA, torch multiplies by the reciprocal of a Python number, which rounds twice: 38 / 10
    becomes 3.8000000000000003.
    """
    return values / torch.full((), number, dtype=values.dtype, device=values.device)


def footprint(width: int, depth: int, sides: Tensor, corners: Tensor) -> Tensor:
    """Return which columns lie under each box, bool [N, W, D].

    Args:
        width: W.
        depth: D.
        sides: int [N, 3], the boxes' sides along x, y, z.
        corners: int64 [N, 2], the boxes' low corners (x, y).
    """
    far = corners + sides[:, :2]
    rows = torch.arange(width, device=sides.device)
    columns = torch.arange(depth, device=sides.device)
    in_x = (rows >= corners[:, :1]) & (rows < far[:, :1])
    in_y = (columns >= corners[:, 1:]) & (columns < far[:, 1:])
    return in_x[:, :, None] & in_y[:, None, :]


def place_boxes(
    heightmap: Tensor, empty_map: Tensor, under: Tensor, heights: Tensor
) -> tuple[Tensor, Tensor]:
    """Place one box on each map from above and update the maps (Algorithm 2 for the empty map).

    Each box comes to rest on the highest column below it.

    Args:
        heightmap: int16 [N, W, D], the top of each column; updated.
        empty_map: int16 [N, W, D], the empty cells below each top; updated.
        under: bool [N, W, D], the columns under each box (:func:`footprint`).
        heights: int [N], the boxes' sides along z.

    Returns:
        Resting heights int16 [N] and wasted cells int64 [N] (v_waste of Eq. 7): empty cells
        enclosed below each box.
    """
    resting_height = torch.where(under, heightmap, 0).flatten(1).amax(1)
    gap = torch.where(under, resting_height[:, None, None] - heightmap, 0)
    empty_map.add_(gap)
    top = (resting_height + heights).to(heightmap.dtype)
    heightmap.copy_(torch.where(under, top[:, None, None], heightmap))
    return resting_height, gap.flatten(1).sum(1)


def bins_last(maps: Tensor) -> Tensor:
    """Return maps [N, W, D] as [W, D, 1, N], so that every operation runs along many bins."""
    return maps.permute(1, 2, 0).contiguous()[:, :, None]


def _bit_masks(numbers: Tensor, count: int, dtype: torch.dtype) -> Tensor:
    """Return for each of the lowest bits of numbers [A, N] all ones where it is set, else 0."""
    bits = torch.arange(count, device=numbers.device)[:, None, None]
    return (numbers >> bits & 1).to(dtype).neg()


def _replace(values: Tensor, which: Tensor, new: Tensor) -> None:
    """Write ``new`` into ``values`` where the mask has all ones; faster than ``where``."""
    values ^= (new ^ values) & which


def shift(values: Tensor, steps: Tensor, dim: int, most: int) -> Tensor:
    """Shift maps: each entry becomes the entry ``steps`` further along ``dim``.

    Args:
        values: whole numbers [..., A or 1, N].
        steps: int64 [A, N].
        dim: the dimension.
        most: no map is shifted by more steps than this.

    Returns:
        The maps; entries that would come from past the edge have no meaning.
    """
    values = values.expand(*values.shape[:-2], *steps.shape).clone()
    for bit, which in enumerate(_bit_masks(steps, most.bit_length(), values.dtype)):
        length = values.shape[dim] - (1 << bit)
        if length > 0:
            _replace(values.narrow(dim, 0, length), which, values.narrow(dim, 1 << bit, length))
    return values


def slide(values: Tensor, extents: Tensor, dim: int, most: int) -> Tensor:
    """Compute the maximum over the window along ``dim`` that begins at each entry.

    The arguments are those of :func:`slide_all`, with one map.
    """
    return slide_all(lambda a, b: [torch.maximum(a[0], b[0])], [values], extents, dim, most)[0]


def slide_counts(
    values: Tensor, counts: Tensor, extents: Tensor, dim: int, most: int
) -> list[Tensor]:
    """Compute the maximum over each window, and the sum of the counts of the entries that reach it.

    The arguments are those of :func:`slide_all`, with two maps.
    """

    def join(one: list[Tensor], other: list[Tensor]) -> list[Tensor]:
        largest = torch.maximum(one[0], other[0])
        count = one[1] * (one[0] == largest)
        return [largest, count.addcmul_(other[1], (other[0] == largest).to(count.dtype))]

    return slide_all(join, [values, counts], extents, dim, most)


def slide_all(
    join: Callable[[list[Tensor], list[Tensor]], list[Tensor]],
    maps: list[Tensor],
    extents: Tensor,
    dim: int,
    most: int,
) -> list[Tensor]:
    """Join the entries of the window along ``dim`` that begins at each entry.

    A window is cut into parts whose lengths are different powers of two.

    Args:
        join: joins the results of two parts; zeros are the result of an empty part.
        maps: whole numbers ≥ 0 [..., A or 1, N] each.
        extents: int64 [A, N], the windows' lengths, ≥ 1.
        dim: the dimension.
        most: no window is longer than this.

    Returns:
        [..., A, N] each; correct wherever the window lies inside the map.
    """
    length, shape = maps[0].shape[dim], [*maps[0].shape[:-2], *extents.shape]
    shape[dim] += 1  # windows that begin past the edge are empty
    joined = [values.new_zeros(shape) for values in maps]
    bits = min(most, length).bit_length()
    masks = [_bit_masks(extents, bits, values.dtype) for values in maps]
    for bit in range(bits):
        rest = length + 1 - (1 << bit)
        if bit:
            half = 1 << bit >> 1
            maps = join(*([m.narrow(dim, at, rest) for m in maps] for at in (0, half)))
        longer = join(maps, [values.narrow(dim, 1 << bit, rest) for values in joined])
        for values, which, new in zip(joined, masks, longer, strict=True):
            _replace(values.narrow(dim, 0, rest), which[bit], new)
    return [values.narrow(dim, 0, length) for values in joined]


def windows_inside(sides: Tensor, width: int, depth: int) -> Tensor:
    """Return where a window of ``sides`` [B, 3] lies inside the map, bool [B, W, D].

    A box with a zero side fits nowhere.
    """
    x = torch.arange(width, device=sides.device)
    y = torch.arange(depth, device=sides.device)
    in_x = x <= (width - sides[:, 0, None])
    in_y = y <= (depth - sides[:, 1, None])
    return in_x[:, :, None] & in_y[:, None, :] & (sides > 0).all(1)[:, None, None]


def resting_heights(heightmap: Tensor, sides: Tensor) -> Tensor:
    """Compute the highest column of every window, int16 [N, A, W, D].

    Args:
        heightmap: int16 [N, W, D].
        sides: int16 [N, A, 3].

    Returns:
        int16 [N, A, W, D]; correct wherever the window lies inside the map.
    """
    w, d, _ = sides.permute(2, 1, 0).contiguous().long().clamp(min=1)
    rows = slide(bins_last(heightmap), d, 1, heightmap.shape[2])
    return slide(rows, w, 0, heightmap.shape[1]).permute(3, 2, 0, 1).contiguous()


def window_sum(values: Tensor, w: Tensor, d: Tensor) -> Tensor:
    """Compute the sum over every window of a map by a summed-area table.

    Args:
        values: int or bool [N, W, D].
        w: int64 [N, A, 1, 1], the windows' cells along x.
        d: int64 [N, A, 1, 1], the windows' cells along y.

    Returns:
        int64 [N, A, W, D].
    """
    n, width, depth = values.shape
    table = torch.zeros(n, width + 1, depth + 1, dtype=torch.int64, device=values.device)
    table[:, 1:, 1:] = values.long().cumsum(1).cumsum(2)
    x = torch.arange(width, device=values.device)[:, None]
    y = torch.arange(depth, device=values.device)[None, :]
    far_x, far_y = (x + w).clamp(max=width), (y + d).clamp(max=depth)
    b = torch.arange(n, device=values.device)[:, None, None, None]
    return table[b, far_x, far_y] - table[b, x, far_y] - table[b, far_x, y] + table[b, x, y]


def wasted_cells(heightmap: Tensor, sides: Tensor, resting_heights: Tensor) -> Tensor:
    """Compute the empty cells that a box would enclose below it at every cell.

    Args:
        heightmap: int16 [N, W, D].
        sides: int16 [N, A, 3].
        resting_heights: int16 [N, A, W, D].

    Returns:
        int64 [N, A, W, D]; correct wherever the window lies inside the map.
    """
    w, d = sides[..., 0, None, None].long(), sides[..., 1, None, None].long()
    return w * d * resting_heights - window_sum(heightmap, w, d)


def cut_windows(
    values: Tensor, index: Tensor, x: Tensor, y: Tensor, sides: Tensor, most: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Cut windows of different sizes out of maps.

    Args:
        values: [B, W, D].
        index: int64 [U], the index of each window's map.
        x: int64 [U], each window's low corner along W.
        y: int64 [U], each window's low corner along D.
        sides: int [U, ≥ 2], each window's sides w, d.
        most: the largest w and d.

    Returns:
        [U, w, d] for the largest w and d, and bool [U, w, d]: which cells belong to the window.
    """
    i, j = (torch.arange(cells, device=values.device) for cells in most)
    rows = (x[:, None] + i).clamp(max=values.shape[1] - 1)
    columns = (y[:, None] + j).clamp(max=values.shape[2] - 1)
    member = (i < sides[:, :1])[:, :, None] & (j < sides[:, 1:2])[:, None, :]
    return values[index[:, None, None], rows[:, :, None], columns[:, None, :]], member
