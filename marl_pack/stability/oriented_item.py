"""The items to place, one per bin in several orientations, as input of the stability rules."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from torch import Tensor

from marl_pack.checks import exact
from marl_pack.geometry import ORIENTATIONS, oriented
from marl_pack.stability.centres import HALF, CentreTable, Offsets, centre_table
from marl_pack.stability.parameters import NO_OFFSET


@dataclass(frozen=True)
class OrientedItem:
    """One item for each of N bins, in several orientations (their number is A)."""

    # int16 [N, A, 3]: w, d, h along x, y, z; all 0 if the orientation is not allowed
    sides: Tensor
    # For each orientation: x and y of the centre of mass minus those of the geometric centre, as
    # fractions of w and d; None: no offset.
    offsets: Offsets | None = None
    weight: Tensor | None = None  # float64 [N]; None: the volume

    def __getitem__(self, index: Tensor | slice) -> OrientedItem:
        """Return the oriented items of the chosen bins."""
        weight = None if self.weight is None else self.weight[index]
        return OrientedItem(self.sides[index], self.offsets, weight)

    def centre_table(self, margin: float, longest: int) -> CentreTable:
        """Return the table of the centres of mass for sides up to ``longest`` cells.

        Args:
            margin: cells by which the support polygon is shrunk.
            longest: the longest side in cells.
        """
        offsets = ((0.0, 0.0),) * self.sides.shape[1] if self.offsets is None else self.offsets
        return centre_table(offsets, margin, longest)

    def exact_centre(self, orientation: int, w: int, d: int) -> tuple[Fraction, Fraction]:
        """Return x and y of the centre of mass, for a footprint of w x d.

        They are measured from the footprint's corner with the smallest x and y.
        """
        offset_x, offset_y = (0.0, 0.0) if self.offsets is None else self.offsets[orientation]
        return w * (HALF + exact(offset_x)), d * (HALF + exact(offset_y))

    def weights(self) -> Tensor:
        """Return the weight of each bin's item, float64 [N]."""
        if self.weight is not None:
            return self.weight.double()
        # An orientation that is not allowed has sides and volume 0, so take the largest volume.
        return self.sides.double().prod(-1).amax(1)


def orient_item(
    items: Tensor,
    weight: Tensor | None = None,
    com_offset: tuple[float, float, float] = NO_OFFSET,
) -> OrientedItem:
    """Return one item per bin in all six orientations.

    Args:
        items: int [N, 3], the sides w, d, h of each item before it is rotated; zeros where there
            is no item.
        weight: float [N], the volume by default.
        com_offset: x, y, z of the centre of mass minus those of the geometric centre, as fractions
            of w, d, h before the item is rotated; it rotates with the item.
    """
    return OrientedItem(oriented(items), rotated_offsets(com_offset), weight)


def rotated_offsets(com_offset: tuple[float, float, float]) -> Offsets | None:
    """Return the offset x, y of the centre of mass in the six orientations; None if it is 0.

    The argument is that of :func:`orient_item`.
    """
    if not any(com_offset):
        return None
    return tuple((com_offset[x], com_offset[y]) for x, y, _ in ORIENTATIONS)
