"""The oriented item, an input of the stability rules: one item per bin in several orientations."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from torch import Tensor

from marl_pack.geometry import ORIENTATIONS, oriented
from marl_pack.stability.centres import HALF, CentreTable, Offsets, centre_table, exact
from marl_pack.stability.parameters import NO_OFFSET


@dataclass(frozen=True)
class OrientedItem:
    """One item per bin in A orientations; by default its mass is central and equals its volume."""

    sides: Tensor  # int16 [N, A, 3]  w, d, h along x, y, z; a zero side: orientation not allowed
    # for each orientation, the centre of mass from the geometric centre in fractions of w and d
    offsets: Offsets | None = None
    weight: Tensor | None = None  # float64 [N]

    def __getitem__(self, index: Tensor | slice) -> OrientedItem:
        """Return the oriented items of the chosen bins."""
        weight = None if self.weight is None else self.weight[index]
        return OrientedItem(self.sides[index], self.offsets, weight)

    def centre_table(self, margin: float, longest: int) -> CentreTable:
        """Return the table of the centres of mass for sides up to ``longest`` cells."""
        offsets = ((0.0, 0.0),) * self.sides.shape[1] if self.offsets is None else self.offsets
        return centre_table(offsets, margin, longest)

    def exact_centre(self, orientation: int, w: int, d: int) -> tuple[Fraction, Fraction]:
        """Return the centre of mass from the window's low corner, for a footprint of w x d."""
        x, y = (0.0, 0.0) if self.offsets is None else self.offsets[orientation]
        return w * (HALF + exact(x)), d * (HALF + exact(y))

    def weights(self) -> Tensor:
        """Return the weight of each bin's item, float64 [N]."""
        if self.weight is not None:
            return self.weight.double()
        return self.sides.double().prod(-1).amax(1)


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
    offsets = None
    if any(com_offset):
        offsets = tuple((com_offset[x], com_offset[y]) for x, y, _ in ORIENTATIONS)
    return OrientedItem(oriented(items), offsets, weight)
