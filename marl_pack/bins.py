"""The state of N bins: the boxes placed in them, and the maps derived from these boxes.

Lengths are whole cells. ``x`` runs along W, ``y`` along D, ``z`` upwards. Shapes use the
letters N (bins), W, D, H (a bin's sides), M (boxes a bin can hold) and A (orientations of an
item).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from operator import attrgetter
from typing import Any, NoReturn

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from marl_pack.backend import Backend, default_backend
from marl_pack.geometry import Size, check_size
from marl_pack.geometry.compiled import place_box
from marl_pack.geometry.tensor import divide, footprint, place_boxes
from marl_pack.installation import njit

UNKNOWN = -1
"""Label of a box whose item or orientation is not known."""

ROW_PER_BOX = {"row_per_box": True}
"""Marks the fields of :class:`Bins` that have one row for each box, [N, M, …]."""


@dataclass(frozen=True)
class Bins:
    """The state of N bins of one size.

    The table of boxes (``boxes``, ``loads``, ``labels`` and ``count``) defines the state.
    ``heightmap``, ``empty_map`` and ``filled`` are computed from it and stored for speed.
    :func:`place` and :func:`clear` change the tensors in place. Rows of the table from ``count`` on
    have no meaning.
    """

    heightmap: Tensor  # int16 [N, W, D]   top of each column, in cells
    empty_map: Tensor  # int16 [N, W, D]   empty cells below the top of each column (Algorithm 2)
    # int16 [N, M, 6]: x, y, z, w, d, h in order of placement
    boxes: Tensor = field(metadata=ROW_PER_BOX)
    # float64 [N, M, 3]: weight and the x, y of the centre of mass of each box
    loads: Tensor = field(metadata=ROW_PER_BOX)
    # int64 [N, M, 2]: id of each box's item and index of its orientation, -1 where unknown
    labels: Tensor = field(metadata=ROW_PER_BOX)
    count: Tensor  # int64 [N]             boxes placed
    filled: Tensor  # int64 [N]            cells filled by boxes
    height: int  # H
    backend: Backend  # computes placements, masks and afterstates
    untouched: bool = False  # the bins are empty and stay so: no code needs to read their maps

    @property
    def size(self) -> Size:
        """The sides of each bin (W, D, H)."""
        return self.heightmap.shape[1], self.heightmap.shape[2], self.height

    @property
    def device(self) -> torch.device:
        """The device of the tensors."""
        return self.heightmap.device

    def __len__(self) -> int:
        return self.heightmap.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Bins:
        """Return the chosen bins (a copy when ``index`` is a tensor, a view when it is a slice)."""
        return self.map(lambda tensor: tensor[index])

    def to(self, device: torch.device | str) -> Bins:
        """Return the bins on ``device``; another device brings its default backend."""
        moved = self.map(lambda tensor: tensor.to(device))
        if moved.device == self.device:
            return moved
        return replace(moved, backend=default_backend(device))

    def clone(self) -> Bins:
        """Return an independent copy of the bins."""
        return self.map(Tensor.clone)

    def for_boxes(self, most: int) -> Bins:
        """Return bins that can hold at least ``most`` boxes; the other tensors are shared."""
        more = most - self.boxes.shape[1]
        if more <= 0:
            return self
        padded: dict[str, Any] = {name: pad(getattr(self, name), (0, 0, 0, more)) for name in ROWS}
        return replace(self, **padded)

    def map(self, change: Callable[[Tensor], Tensor]) -> Bins:
        """Return the bins with ``change`` applied to every tensor."""
        # Arguments by position: dataclasses.replace would take as long as the changes.
        values: list[Any] = [*map(change, self.tensors()), self.height, self.backend]
        values.append(self.untouched)
        return Bins(*values)

    def tensors(self) -> tuple[Tensor, ...]:
        """Return all tensors, in the order of the fields."""
        return _tensors_of(self)

    @cached_property
    def arrays(self) -> tuple[NDArray[Any], ...]:
        """The tensors as NumPy arrays that share their memory; only on the CPU."""
        return tuple(tensor.numpy() for tensor in self.tensors())

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields for a copy or a pickle: arrays would not share memory there."""
        return {name: value for name, value in vars(self).items() if name != "arrays"}


TENSORS = tuple(f.name for f in fields(Bins) if f.type == "Tensor")
"""Names of the fields of :class:`Bins` that are tensors; they come first."""
HEIGHTMAP, COUNT, FILLED = map(TENSORS.index, ("heightmap", "count", "filled"))
"""Positions of some tensors in :meth:`Bins.tensors` and :attr:`Bins.arrays`."""
ROWS = tuple(f.name for f in fields(Bins) if f.metadata == ROW_PER_BOX)
"""Names of the fields of :class:`Bins` that have one row for each box."""
_tensors_of: Callable[[Bins], tuple[Tensor, ...]] = attrgetter(*TENSORS)


def empty(
    n: int,
    size: Size,
    max_boxes: int | None = None,
    device: torch.device | str = "cpu",
    backend: Backend | None = None,
) -> Bins:
    """Return N empty bins of one size.

    Args:
        n: number of bins.
        size: (W, D, H) in cells.
        max_boxes: M, the most boxes a bin may ever hold; the bin's volume in cells by default.
        device: the device of the tensors.
        backend: the implementation to use for these bins; by default the faster one on the device.

    Raises:
        ValueError: if the size is impossible.
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
        labels=zeros(n, m, 2, dtype=torch.int64),
        count=zeros(n, dtype=torch.int64),
        filled=zeros(n, dtype=torch.int64),
        height=h,
        backend=default_backend(device) if backend is None else backend,
    )


def clear(bins: Bins, which: Tensor | slice) -> None:
    """Empty the bins chosen by ``which`` (bool [N], indices or a slice), in place.

    A bool mask is applied without waiting for the device.
    """
    for tensor in (bins.heightmap, bins.empty_map, bins.count, bins.filled):
        if isinstance(which, Tensor) and which.dtype == torch.bool:
            tensor.masked_fill_(which.view(-1, *[1] * (tensor.dim() - 1)), 0)
        else:
            tensor[which] = 0


def check_device(device: torch.device | str) -> torch.device:
    """Return ``device`` as a ``torch.device``.

    Raises:
        ValueError: unless it is the CPU or a CUDA device that exists.
    """
    try:
        checked = torch.device(device)
    except (RuntimeError, TypeError):  # PyTorch's message lists two dozen kinds of devices
        checked = torch.device("meta")
    try:
        if checked.type not in ("cpu", "cuda"):
            raise ValueError("needs cpu, cuda or cuda:N")
        torch.empty(0, device=checked)
    except (RuntimeError, AssertionError, ValueError) as error:
        first = str(error).strip().splitlines()[0]
        raise ValueError(f"device {str(device)!r}: {first}") from None
    return checked


def place(
    bins: Bins,
    sides: Tensor,
    corners: Tensor,
    weights: Tensor | None = None,
    com: Tensor | None = None,
    labels: tuple[Tensor, Tensor] | None = None,
    unit: float = 1.0,
    check: bool = True,
) -> tuple[Tensor, Tensor, Tensor]:
    """Place one box in each bin from above and update the bins (Algorithm 2 for the empty map).

    The box comes to rest on the highest column of its footprint. No stability rule is applied: the
    caller must choose a cell that a mask allows. A box with a zero side does not change its bin.

    Args:
        bins: the N bins; updated.
        sides: int [N, 3], the boxes' sides along x, y, z.
        corners: int64 [N, 2], the boxes' low corners (x, y).
        weights: float [N], the boxes' weights; by default their volumes.
        com: float [N, 2], each centre of mass, measured from the low corner in units of
            1 / ``unit`` cells; by default the footprint's centre.
        labels: ids and orientations of the boxes' items, int64 [N] each; unknown (-1) by default.
        unit: number of units in a cell. If ``com`` contains whole numbers, each stored centre is
            rounded only once, so it is the float64 that is nearest to the exact centre.
        check: whether tensor code checks that the boxes fit; the program waits for this check.
            In compiled code the check costs nothing and is always made.

    Returns:
        Resting heights int16 [N], wasted cells int64 [N] (empty cells enclosed below the box) and
        volumes int64 [N]; 0 where nothing was placed.

    Raises:
        ValueError: if a bin is full, or a box reaches out of the map. The bins have not changed
            then.
    """
    if bins.backend.pick(compiled=False, tensor=check):
        _check_boxes(bins, sides, corners)
    code = bins.backend.pick(compiled=_place_compiled, tensor=_place_tensor)
    return code(bins, sides, corners, weights, com, labels, unit)


def refuse(bins: Bins, *, full: bool) -> NoReturn:
    """Raise ValueError for an impossible placement: a bin is full, or a box is outside the map."""
    if full:
        most = bins.boxes.shape[1]
        raise ValueError(f"a bin that can hold {most} boxes is full: see max_boxes")
    raise ValueError("a box reaches out of the map")


# --- compiled -------------------------------------------------------------------------------------

FULL, OUTSIDE = 1, 2
NO_LABELS = np.empty(0, np.int64), np.empty(0, np.int64)


@njit(cache=True, nogil=True)
def _obstacle(most: int, shape: tuple[int, int], count: Any, sides: Any, corners: Any) -> int:
    """Return why a placement is impossible: FULL, OUTSIDE or 0 if it is possible."""
    width, depth = shape
    obstacle = 0
    for b in range(count.size):
        w, d, x, y = sides[b, 0], sides[b, 1], corners[b, 0], corners[b, 1]
        if w < 1 or d < 1 or sides[b, 2] < 1:
            continue
        if count[b] >= most:
            return FULL
        if not (0 <= x <= width - w and 0 <= y <= depth - d):
            obstacle = OUTSIDE
    return obstacle


@njit(cache=True, inline="always")
def place_row(
    heightmap: Any, empty_map: Any, boxes: Any, loads: Any, labels: Any, count: Any, filled: Any,
    b: int, x: int, y: int, w: int, d: int, h: int, weight: float, centre: tuple[float, float],
    label: tuple[int, int],
) -> tuple[int, int]:  # fmt: skip
    """Place one box in bin ``b`` and add its row to the table of boxes.

    Args:
        heightmap, empty_map, boxes, loads, labels, count, filled: the tensors of the bins; updated.
        b: the bin.
        x, y: the box's low corner.
        w, d, h: its sides along x, y, z, ≥ 1.
        weight: its weight.
        centre: x and y of its centre of mass, in cells of the bin.
        label: its item's id and orientation.

    Returns:
        The resting height and the wasted cells.
    """
    z, waste = place_box(heightmap[b], empty_map[b], x, y, w, d, h)
    k = count[b]
    box, load, own_label = boxes[b, k], loads[b, k], labels[b, k]
    box[0], box[1], box[2], box[3], box[4], box[5] = x, y, z, w, d, h
    load[0], load[1], load[2] = weight, centre[0], centre[1]
    own_label[0], own_label[1] = label
    count[b] += 1
    filled[b] += np.int64(w) * d * h
    return z, waste


@njit(cache=True, nogil=True)
def _place_each(
    heightmap: Any, empty_map: Any, boxes: Any, loads: Any, labels: Any, count: Any, filled: Any,
    sides: Any, corners: Any, weights: Any, com: Any, ids: Any, orientations: Any, unit: float,
    resting_height: Any, waste: Any, volume: Any,
) -> None:  # fmt: skip
    """Place one box in each bin; empty arrays stand for the defaults of optional arguments."""
    for b in range(heightmap.shape[0]):
        w, d, h = sides[b, 0], sides[b, 1], sides[b, 2]
        x, y = corners[b, 0], corners[b, 1]
        resting_height[b], waste[b], volume[b] = 0, 0, 0
        if w < 1 or d < 1 or h < 1:
            continue
        volume[b] = np.int64(w) * d * h
        centre = x + w / 2, y + d / 2
        if com.size:
            centre = (x * unit + com[b, 0]) / unit, (y * unit + com[b, 1]) / unit
        label = ids[b] if ids.size else UNKNOWN, orientations[b] if orientations.size else UNKNOWN
        resting_height[b], waste[b] = place_row(
            heightmap, empty_map, boxes, loads, labels, count, filled, b, x, y, w, d, h,
            weights[b] if weights.size else float(volume[b]), centre, label,
        )  # fmt: skip


def _place_compiled(
    bins: Bins,
    sides: Tensor,
    corners: Tensor,
    weights: Tensor | None,
    com: Tensor | None,
    labels: tuple[Tensor, Tensor] | None,
    unit: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Place one box in each bin in compiled loops; the arguments are those of :func:`place`."""
    state = bins.arrays
    box = sides.numpy(), corners.numpy()
    obstacle = _obstacle(bins.boxes.shape[1], bins.size[:2], state[COUNT], *box)
    if obstacle:
        refuse(bins, full=obstacle == FULL)
    resting_height = torch.empty(len(bins), dtype=torch.int16)
    waste, volume = torch.empty(2, len(bins), dtype=torch.int64)
    _place_each(
        *state,
        *box,
        np.empty(0) if weights is None else weights.double().numpy(),
        np.empty((0, 2)) if com is None else com.double().numpy(),
        *(NO_LABELS if labels is None else (label.numpy() for label in labels)),
        unit,
        resting_height.numpy(),
        waste.numpy(),
        volume.numpy(),
    )
    return resting_height, waste, volume


# --- tensor code ----------------------------------------------------------------------------------


def _check_boxes(bins: Bins, sides: Tensor, corners: Tensor) -> None:
    """Raise ValueError if a bin is full, or a box reaches out of the map."""
    real, far = (sides > 0).all(1), corners + sides[:, :2]
    outside = (corners < 0).any(1) | (far[:, 0] > bins.size[0]) | (far[:, 1] > bins.size[1])
    full = bins.count >= bins.boxes.shape[1]
    if bool((real & (full | outside)).any()):
        refuse(bins, full=bool((real & full).any()))


def _place_tensor(
    bins: Bins,
    sides: Tensor,
    corners: Tensor,
    weights: Tensor | None,
    com: Tensor | None,
    labels: tuple[Tensor, Tensor] | None,
    unit: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Place one box in each bin in tensor code; the arguments are those of :func:`place`."""
    volume = sides.long().prod(1)
    real = volume > 0
    sides = torch.where(real[:, None], sides, 0)
    under = footprint(*bins.size[:2], sides, corners)
    resting_height, waste = place_boxes(bins.heightmap, bins.empty_map, under, sides[:, 2])

    box = torch.cat((corners, resting_height[:, None], sides), 1).to(bins.boxes.dtype)
    centre = corners + sides[:, :2].double() / 2
    if com is not None:
        centre = divide(corners * unit + com.double(), unit)
    weight = volume.double() if weights is None else weights.double()
    load = torch.cat((weight[:, None], centre), 1)
    label = torch.full_like(corners, UNKNOWN) if labels is None else torch.stack(labels, 1)
    index = torch.arange(len(bins), device=bins.device)
    slot = bins.count.clamp(max=bins.boxes.shape[1] - 1)
    for table, row in ((bins.boxes, box), (bins.loads, load), (bins.labels, label)):
        table[index, slot] = torch.where(real[:, None], row, table[index, slot])
    bins.count.add_(real)
    bins.filled.add_(volume)
    return resting_height, waste, volume


def utilization(bins: Bins) -> Tensor:
    """Return the share of each bin's volume that is filled by boxes, float64 [N] in [0, 1]."""
    w, d, h = bins.size
    return bins.filled.double() / (w * d * h)
