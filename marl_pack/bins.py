"""State of N bins: what stands in them, and what placing one box in each changes.

Lengths are whole cells. ``x`` runs along W, ``y`` along D, ``z`` upwards. Shapes use the
letters N (bins), W, D, H (a bin's sides), M (boxes a bin can hold) and A (candidate
orientations of an item).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from numbers import Real
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch.nn.functional import pad

Size = tuple[int, int, int]
"""A bin's sides (W, D, H) in cells."""

ORIENTATIONS: tuple[tuple[int, int, int], ...] = (
    (0, 1, 2),
    (1, 0, 2),
    (0, 2, 1),
    (2, 0, 1),
    (1, 2, 0),
    (2, 1, 0),
)
"""The six axis permutations of a box: row ``o`` names which of the item's own sides
(0 = w, 1 = d, 2 = h) lies along x, y and z. ``o // 2`` picks the side that stands upright
(h, d, w) and ``o ^ 1`` is the same box turned by 90° about the vertical, so 0 is the item as
it comes and {0, 1} are the two orientations that keep it upright."""

MAX_HEIGHT = 16383
"""Tallest bin in cells: masks compare ``2 · height + 1`` as 16-bit integers."""
MAX_SIDE = 32767
"""Widest and deepest bin in cells."""


@dataclass(frozen=True)
class Bins:
    """N bins of one size. The tensors are written in place by :func:`place` and :func:`clear`."""

    heightmap: Tensor  # int16 [N, W, D]   top of each column, in cells
    empty_map: Tensor  # int16 [N, W, D]   empty cells below the top of each column (Algorithm 2)
    boxes: Tensor  # int16 [N, M, 6]       x, y, z, w, d, h in order of placement
    loads: Tensor  # float64 [N, M, 3]     weight and the x, y of the centre of mass of each box
    count: Tensor  # int64 [N]             boxes placed; rows of boxes and loads past it are void
    filled: Tensor  # int64 [N]            cells filled by boxes
    height: int  # H

    @property
    def size(self) -> Size:
        """(W, D, H)."""
        return self.heightmap.shape[1], self.heightmap.shape[2], self.height

    @property
    def device(self) -> torch.device:
        """Where the tensors live."""
        return self.heightmap.device

    def __len__(self) -> int:
        return self.heightmap.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Bins:
        """The chosen bins (a copy when ``index`` is a tensor, a view when it is a slice)."""
        return self._each(lambda tensor: tensor[index])

    def to(self, device: torch.device | str) -> Bins:
        """The bins on ``device`` (themselves if they are there)."""
        return self._each(lambda tensor: tensor.to(device))

    def clone(self) -> Bins:
        """An independent copy."""
        return self._each(Tensor.clone)

    def for_boxes(self, most: int) -> Bins:
        """Bins that hold ``most`` boxes at least; everything else is shared."""
        more = most - self.boxes.shape[1]
        if more <= 0:
            return self
        boxes, loads = (pad(rows, (0, 0, 0, more)) for rows in (self.boxes, self.loads))
        return replace(self, boxes=boxes, loads=loads)

    def _each(self, change: Callable[[Tensor], Tensor]) -> Bins:
        heightmap, empty_map, boxes, loads, count, filled = map(change, self.tensors())
        return Bins(heightmap, empty_map, boxes, loads, count, filled, self.height)

    def tensors(self) -> tuple[Tensor, ...]:
        """All tensors, in the order of the fields."""
        return (
            self.heightmap, self.empty_map, self.boxes, self.loads, self.count, self.filled
        )  # fmt: skip


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, Real):
        return False
    return math.isfinite(float(value))


def check_size(size: Size) -> Size:
    """Return ``size`` as three ints.

    Raises:
        ValueError: unless it is three whole numbers from 1 to the largest allowed.
    """
    sides = tuple(size) if isinstance(size, Iterable) else ()
    if len(sides) != 3 or any(not _is_number(s) or int(s) != s or s < 1 for s in sides):
        raise ValueError(f"bin size {size!r}: needs three whole numbers of cells ≥ 1, W D H")
    if sides[2] > MAX_HEIGHT or max(sides) > MAX_SIDE:
        raise ValueError(
            f"bin size {size!r}: at most {MAX_SIDE} x {MAX_SIDE} x {MAX_HEIGHT}; use larger cells"
        )
    return int(sides[0]), int(sides[1]), int(sides[2])


def empty(
    n: int,
    size: Size,
    max_boxes: int | None = None,
    device: torch.device | str = "cpu",
) -> Bins:
    """N empty bins.

    Args:
        n: number of bins.
        size: (W, D, H) in cells.
        max_boxes: M, the most boxes a bin may ever hold; the bin's volume in cells by default.
        device: where the tensors live.
    """
    w, d, h = check_size(size)
    m = w * d * h if max_boxes is None else max_boxes

    def zeros(*shape: int, dtype: torch.dtype = torch.int16) -> Tensor:
        return torch.zeros(shape, dtype=dtype, device=device)

    return Bins(
        heightmap=zeros(n, w, d),
        empty_map=zeros(n, w, d),
        boxes=zeros(n, m, 6),
        loads=zeros(n, m, 3, dtype=torch.float64),
        count=zeros(n, dtype=torch.int64),
        filled=zeros(n, dtype=torch.int64),
        height=h,
    )


def clear(bins: Bins, which: Tensor | slice) -> None:
    """Empty the bins chosen by ``which`` (bool [N], indices or a slice), in place."""
    for tensor in (bins.heightmap, bins.empty_map, bins.count, bins.filled):
        tensor[which] = 0


def check_device(device: torch.device | str) -> torch.device:
    """Return ``device`` as torch's.

    Raises:
        ValueError: unless it is the CPU or a CUDA device that is there.
    """
    try:
        found = torch.device(device)
        if found.type not in ("cpu", "cuda"):
            raise ValueError("needs cpu, cuda or cuda:N")
        torch.empty(0, device=found)
    except (RuntimeError, AssertionError, ValueError) as error:
        first = str(error).strip().splitlines()[0]
        raise ValueError(f"device {str(device)!r}: {first}") from None
    return found


def compiled(device: torch.device) -> bool:
    """Whether tensors on ``device`` are handed to compiled loops; elsewhere tensor code does it.

    The one switch between the two codes. Both give the same results.
    """
    return device.type == "cpu"


@cache
def orientation_table(device: torch.device) -> Tensor:
    """:data:`ORIENTATIONS` as int64 [6, 3] on ``device``."""
    return torch.tensor(ORIENTATIONS, device=device)


def oriented(items: Tensor) -> Tensor:
    """The item's sides (w, d, h) [..., 3] in its six orientations [..., 6, 3]."""
    return items[..., orientation_table(items.device)]


def footprint(w: int, d: int, sides: Tensor, cells: Tensor) -> Tensor:
    """Bool [N, w, d]: the columns under boxes of ``sides`` [N, 3] placed at ``cells`` [N]."""
    x, y = cells // d, cells % d
    rows = torch.arange(w, device=sides.device)
    columns = torch.arange(d, device=sides.device)
    in_x = (rows >= x[:, None]) & (rows < (x + sides[:, 0])[:, None])
    in_y = (columns >= y[:, None]) & (columns < (y + sides[:, 1])[:, None])
    return in_x[:, :, None] & in_y[:, None, :]


def place(
    bins: Bins,
    sides: Tensor,
    cells: Tensor,
    weights: Tensor | None = None,
    com: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Set one box into each bin from above, in place (Algorithm 2 for the empty map).

    The box comes to rest on the highest column of its footprint. No rule is asked: the caller
    chooses among the cells a mask allows. A box with a zero side leaves its bin as it is.

    Args:
        bins: written in place.
        sides: int [N, 3], the boxes' sides along x, y, z.
        cells: int64 [N], the low corners, ``x · D + y``.
        weights: float [N]; the boxes' volumes by default.
        com: float [N, 2], centre of mass from the low corner; the footprint's centre by default.

    Returns:
        Resting heights int16 [N], wasted cells int64 [N] (empty cells enclosed below the box) and
        volumes int64 [N]; 0 where nothing was placed.

    Raises:
        ValueError: if a bin holds as many boxes as it may, or a box reaches out of the map; nothing
            has changed then.
    """
    if bool(((bins.count >= bins.boxes.shape[1]) & (sides > 0).all(1)).any()):
        raise ValueError(f"a bin that can hold {bins.boxes.shape[1]} boxes is full: see max_boxes")
    if compiled(bins.device):
        return _place_cpu(bins, sides, cells, weights, com)
    return _place_torch(bins, sides, cells, weights, com)


@njit(cache=True, nogil=True)
def _place_each(
    heightmap: Any, empty_map: Any, boxes: Any, loads: Any, count: Any, filled: Any, sides: Any,
    cells: Any, weights: Any, com: Any, rest: Any, waste: Any, volume: Any,
) -> None:  # fmt: skip
    width, depth = heightmap.shape[1:]
    for b in range(heightmap.shape[0]):
        w, d = sides[b, 0], sides[b, 1]
        inside = 0 <= cells[b] <= (width - w) * depth + depth - d and cells[b] % depth <= depth - d
        if w > 0 and d > 0 and sides[b, 2] > 0 and not inside:
            raise ValueError("a box reaches out of the map")
    for b in range(heightmap.shape[0]):
        w, d, h = sides[b, 0], sides[b, 1], sides[b, 2]
        rest[b], waste[b], volume[b] = 0, 0, 0
        if w < 1 or d < 1 or h < 1:
            continue
        x, y = cells[b] // depth, cells[b] % depth
        z = 0
        for i in range(x, x + w):
            for j in range(y, y + d):
                z = max(z, heightmap[b, i, j])
        for i in range(x, x + w):
            for j in range(y, y + d):
                gap = z - heightmap[b, i, j]
                empty_map[b, i, j] += gap
                heightmap[b, i, j] = z + h
                waste[b] += gap
        rest[b] = z
        k = count[b]
        box, load = boxes[b, k], loads[b, k]
        box[0], box[1], box[2], box[3], box[4], box[5] = x, y, z, w, d, h
        load[0] = weights[b] if weights.size else float(w) * d * h
        load[1] = x + (com[b, 0] if com.size else w / 2)
        load[2] = y + (com[b, 1] if com.size else d / 2)
        count[b] += 1
        volume[b] = np.int64(w) * d * h
        filled[b] += volume[b]


def _place_cpu(
    bins: Bins, sides: Tensor, cells: Tensor, weights: Tensor | None, com: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    rest = torch.empty(len(bins), dtype=torch.int16)
    waste, volume = torch.empty(2, len(bins), dtype=torch.int64)
    _place_each(
        *(tensor.numpy() for tensor in bins.tensors()),
        sides.numpy(),
        cells.numpy(),
        np.empty(0) if weights is None else weights.double().numpy(),
        np.empty((0, 2)) if com is None else com.double().numpy(),
        rest.numpy(),
        waste.numpy(),
        volume.numpy(),
    )
    return rest, waste, volume


def _place_torch(
    bins: Bins, sides: Tensor, cells: Tensor, weights: Tensor | None, com: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    volume = sides.long().prod(1)
    real = volume > 0
    sides = torch.where(real[:, None], sides, 0)
    window = footprint(*bins.size[:2], sides, cells)
    heights = bins.heightmap
    rest = torch.where(window, heights, 0).flatten(1).amax(1)
    gap = torch.where(window, rest[:, None, None] - heights, 0)
    bins.empty_map.add_(gap)
    top = (rest + sides[:, 2]).to(heights.dtype)
    bins.heightmap.copy_(torch.where(window, top[:, None, None], heights))

    depth = bins.size[1]
    corner = torch.stack((cells // depth, cells % depth), 1)
    box = torch.cat((corner, rest[:, None], sides), 1).to(bins.boxes.dtype)
    centre = sides[:, :2].double() / 2 if com is None else com.double()
    weight = volume.double() if weights is None else weights.double()
    load = torch.cat((weight[:, None], corner + centre), 1)
    index = torch.arange(len(bins), device=bins.device)
    slot = bins.count.clamp(max=bins.boxes.shape[1] - 1)
    for table, row in ((bins.boxes, box), (bins.loads, load)):
        table[index, slot] = torch.where(real[:, None], row, table[index, slot])
    bins.count.add_(real)
    bins.filled.add_(volume)
    return rest, gap.flatten(1).sum(1), volume


def utilization(bins: Bins) -> Tensor:
    """Share of each bin's volume that is filled by boxes, float64 [N] in [0, 1]."""
    w, d, h = bins.size
    return bins.filled.double() / (w * d * h)
