"""The oriented item that a stability rule judges: one item per bin in several orientations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from marl_pack.bins import Bins
from marl_pack.geometry import ORIENTATIONS, oriented


@dataclass(frozen=True)
class OrientedItem:
    """One item per bin in A orientations; without centre or weight, mass is uniform."""

    sides: Tensor  # int16 [N, A, 3]  w, d, h along x, y, z; a zero side: orientation not allowed
    com: Tensor | None = None  # float64 [N, A, 2]  centre of mass from the window's low corner
    weight: Tensor | None = None  # float64 [N]

    def __getitem__(self, index: Tensor | slice) -> OrientedItem:
        """Return the oriented items of the chosen bins."""
        return OrientedItem(
            self.sides[index],
            None if self.com is None else self.com[index],
            None if self.weight is None else self.weight[index],
        )

    def centres(self) -> Tensor:
        """Return the centres of mass from the window's low corner, float64 [N, A, 2]."""
        return self.sides[..., :2].double() / 2 if self.com is None else self.com

    def weights(self) -> Tensor:
        """Return the weight of each bin's item, float64 [N]."""
        if self.weight is not None:
            return self.weight.double()
        return self.sides.double().prod(-1).amax(1)


Rule = Callable[[Bins, OrientedItem], Tensor]
"""``(bins, item) -> bool [N, A, W, D]``: the cells (low corners) where the item fits into the bin
in each orientation and is stable by the rule. Parameters are bound beforehand
(:func:`functools.partial`)."""

NO_OFFSET = (0.0, 0.0, 0.0)


def check_com_offset(offset: tuple[float, ...]) -> tuple[float, float, float]:
    """Return the offset of the centre of mass as three floats.

    Raises:
        ValueError: unless there are three numbers, each strictly between -0.5 and 0.5.
    """
    values = tuple(float(f) for f in offset)
    if len(values) != 3 or not all(-0.5 < f < 0.5 for f in values):
        raise ValueError(
            f"com_offset {offset!r}: needs three fractions of the item's own sides w, d, h, "
            "each strictly between -0.5 and 0.5 (0 is the geometric centre)"
        )
    return values[0], values[1], values[2]


def orient_item(
    items: Tensor,
    weight: Tensor | None = None,
    com_offset: tuple[float, float, float] = NO_OFFSET,
) -> OrientedItem:
    """Return one item per bin in all six orientations.

    Args:
        items: int [N, 3], each item's own sides w, d, h; zeros where there is no item.
        weight: float [N], volume by default.
        com_offset: how far the centre of mass lies from the geometric centre, as fractions of the
            item's own sides; it rotates with the item.
    """
    sides = oriented(items)
    if not any(com_offset):
        return OrientedItem(sides, None, weight)
    offsets = torch.tensor(
        [[com_offset[axis] for axis in permutation[:2]] for permutation in ORIENTATIONS],
        dtype=torch.float64,
        device=items.device,
    )
    return OrientedItem(sides, (0.5 + offsets) * sides[..., :2], weight)
