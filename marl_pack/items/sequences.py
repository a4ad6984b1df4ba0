"""Given sequences, checked at the door."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from marl_pack.bins import Size


@dataclass(frozen=True)
class Sequences:
    """Given sequences, played in their order: episode k is sequence k, round and round."""

    items: Tensor  # int16 [S, L, 3]     sides, zeros after each sequence's end
    weights: Tensor  # float64 [S, L]

    @property
    def smallest(self) -> int:
        """Volume of the smallest item."""
        volume = self.items.long().prod(2)
        return int(volume[volume > 0].min())

    @property
    def sides(self) -> tuple[int, int]:
        """Shortest and longest side of any item."""
        return int(self.items[self.items > 0].min()), int(self.items.max())

    @property
    def episodes(self) -> int:
        """The number of sequences."""
        return len(self.items)

    @property
    def longest(self) -> int:
        """Length of the longest sequence."""
        return self.items.shape[1]

    def start(self, seed: int, episodes: Tensor) -> Tensor:
        """Indices of the sequences, int64 [K]; the seed plays no part."""
        return episodes % len(self.items)

    def item(self, state: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Sides int16 [N, 3] and weights float64 [N]."""
        last = self.items.shape[1] - 1
        held, step = t <= last, t.clamp(max=last)
        sides = self.items[state, step] * held[:, None].to(self.items.dtype)
        return sides, self.weights[state, step] * held

    def to(self, device: torch.device | str) -> Sequences:
        """The same sequences on ``device``."""
        return Sequences(self.items.to(device), self.weights.to(device))


def _numbers(values: ArrayLike, source: str) -> NDArray[np.float64]:
    """``values`` as float64, refused with the first row named that is not of numbers."""
    try:
        array = np.asarray(values)
        if array.dtype.kind in "iuf":
            return array.astype(np.float64)
    except ValueError as error:
        if not isinstance(values, Iterable):
            raise ValueError(f"{source}: needs numbers ({error})") from None
    rows = values if isinstance(values, Iterable) else [values]
    for number, row in enumerate(rows):
        if np.shape(row) != (3,) or np.asarray(row).dtype.kind not in "iuf":
            raise ValueError(f"{source}: row {number} is {row!r}: needs three numbers w, d, h")
    raise ValueError(f"{source}: needs numbers")


def check_items(
    items: ArrayLike,
    size: Size,
    weights: ArrayLike | None = None,
    lengths: ArrayLike | None = None,
    source: str = "items",
) -> Sequences:
    """Sequences from arrays, refused with the row named if an item cannot be.

    Args:
        items: whole numbers [L, 3] (one sequence) or [S, L, 3], rows w, d, h. Rows of zeros may
            only fill the end of a sequence.
        size: (W, D, H) of the bin they must fit into, in at least one orientation.
        weights: positive [L] or [S, L]; volumes by default.
        lengths: whole numbers [S]; by default a sequence ends at its first row of zeros.
        source: what to call the items in an error.

    Raises:
        ValueError: naming the sequence and row.
    """
    array = _numbers(items, source)
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
        raise ValueError(f"{source}: shape {array.shape}, needs [L, 3] or [S, L, 3] (w, d, h)")
    count, length, _ = array.shape

    blank = (array == 0).all(2)
    ends = np.where(blank.any(1), blank.argmax(1), length)
    if lengths is not None:
        given = np.asarray(lengths)
        if given.shape != (count,) or given.dtype.kind not in "iu" or not (
            (given >= 1) & (given <= length)
        ).all():  # fmt: skip
            raise ValueError(f"{source}: lengths need {count} whole numbers in 1 … {length}")
        ends = given.astype(np.int64)
    inside = np.arange(length) < ends[:, None]

    def refuse(wrong: NDArray[np.bool_], why: str) -> None:
        if wrong.any():
            s, row = np.argwhere(wrong)[0]
            where = f"row {row}" if count == 1 else f"sequence {s}, row {row}"
            raise ValueError(f"{source}: {where} is {array[s, row].tolist()}: {why}")

    if not inside[:, 0].all():
        s = int(np.flatnonzero(~inside[:, 0])[0])
        raise ValueError(f"{source}: sequence {s} has no items")
    rows = inside[..., None]
    refuse((rows & ~np.isfinite(array)).any(2), "not a number; needs whole cells ≥ 1")
    refuse((rows & (array % 1 != 0)).any(2), "a fraction of a cell; needs whole cells ≥ 1")
    refuse((rows & (array < 1)).any(2), "zero or negative; needs whole cells ≥ 1")
    refuse(~inside & ~blank, "after the end of its sequence; needs zeros there")
    fits = np.sort(array, axis=2) <= np.sort(np.array(size))
    refuse(inside & ~fits.all(2), f"fits into the bin {tuple(size)} in no orientation")

    mass = array.prod(2)
    if weights is not None:
        mass = _numbers(weights, f"{source}: weights")
        mass = mass[None] if mass.ndim == 1 else mass
        if mass.shape != (count, length):
            raise ValueError(f"{source}: weights {mass.shape}, need one an item {(count, length)}")
        refuse(inside & ~(np.isfinite(mass) & (mass > 0)), "has a weight that is not positive")
    longest = int(ends.max())
    sides = np.where(rows, array, 0)[:, :longest].astype(np.int16)
    return Sequences(
        torch.from_numpy(sides), torch.from_numpy(np.where(inside, mass, 0)[:, :longest])
    )
