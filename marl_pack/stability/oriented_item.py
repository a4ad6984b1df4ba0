"""The oriented item that a stability rule judges: one item per bin in several orientations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

from torch import Tensor

from marl_pack.bins import Bins
from marl_pack.checks import real_number, shown
from marl_pack.geometry import ORIENTATIONS, oriented
from marl_pack.stability.centres import HALF, CentreTable, Offsets, centre_table, exact


@dataclass(frozen=True)
class OrientedItem:
    """One item per bin in A orientations; without offsets or weight, mass is uniform."""

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
    try:
        values = tuple(real_number(f, "com_offset") for f in offset)
    except TypeError:  # not a sequence
        values = ()
    if len(values) != 3 or not all(-0.5 < f < 0.5 for f in values):
        raise ValueError(
            f"com_offset {shown(offset)}: needs three fractions of the item's own sides w, d, h, "
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
    offsets = None
    if any(com_offset):
        offsets = tuple((com_offset[x], com_offset[y]) for x, y, _ in ORIENTATIONS)
    return OrientedItem(oriented(items), offsets, weight)
