"""Centres of mass and margins as exact numbers, in tables that fast code can use.

A decimal from a user means exactly this decimal: 0.1 is one tenth, although no float64 is exactly
one tenth. A centre of mass may lie exactly on the edge of its support, where the smallest rounding
error would change the result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from marl_pack.checks import exact
from marl_pack.geometry.tensor import divide

Offsets = tuple[tuple[float, float], ...]
"""For each of A orientations: x and y of the centre of mass minus those of the geometric centre, as
fractions of the sides w and d after the item is rotated."""

HALF = Fraction(1, 2)

LARGEST_WHOLE = 2.0**53
"""Whole numbers up to this limit are exact in float64."""


@dataclass(frozen=True)
class CentreTable:
    """Positions of centres of mass, for A orientations, both axes and every side from 0 to L.

    Coordinates are measured from the footprint's corner with the smallest x and y, in units of
    1 / ``unit`` cells.
    """

    at: NDArray[np.float64]  # [A, 2, L + 1]  the centre of mass
    # int64 [A, 2, L + 1]: number of cells that begin more than the margin below the centre of mass
    low: NDArray[np.int64]
    # int64 [A, 2, L + 1]: first cell that ends more than the margin above the centre of mass
    start: NDArray[np.int64]
    unit: float  # number of units in a cell
    margin: float  # in units; by so much the support polygon is shrunk
    whole: bool  # all coordinates and the margin are whole numbers: float64 is exact on them

    def cells(self, sides: Tensor) -> Tensor:
        """Return the centres in cells, float64 [N, A, 2], of items with ``sides`` [N, A, 3]."""
        return divide(self.units(sides), self.unit)

    def units(self, sides: Tensor) -> Tensor:
        """Return the centres in units, float64 [N, A, 2], of items with ``sides`` [N, A, 3]."""
        return self.look_up("at", sides)

    @cached_property
    def _copies(self) -> dict[tuple[str, torch.device], Tensor]:
        """The tables as tensors, by name and device; a copy to a GPU would wait in every step."""
        return {}

    def look_up(self, name: str, sides: Tensor) -> Tensor:
        """Return the entries of a table [A, 2, L + 1] for the sides w, d of ``sides`` [N, A, 3]."""
        key = name, sides.device
        if key not in self._copies:
            self._copies[key] = torch.from_numpy(getattr(self, name)).to(sides.device)
        entries = self._copies[key]
        index = sides[..., :2].long().clamp(max=entries.shape[2] - 1)
        return entries.expand(len(sides), -1, -1, -1).gather(3, index[..., None]).squeeze(3)


@lru_cache(maxsize=64)
def centre_table(offsets: Offsets, margin: float, longest: int) -> CentreTable:
    """Compute the table of centres of mass in exact arithmetic.

    Args:
        offsets: the offsets of the centre of mass; decimals are taken exactly.
        margin: cells by which the support polygon is shrunk; a decimal is taken exactly.
        longest: L, the longest side of a footprint, in cells.
    """
    shares = [[HALF + exact(offset) for offset in pair] for pair in offsets]
    exact_margin = exact(margin)
    denominators = [share.denominator for pair in shares for share in pair]
    unit = math.lcm(*denominators, exact_margin.denominator)
    # The stability tests multiply coordinates by differences of cells and add two such products.
    whole = 4 * unit * (longest + 1) ** 2 <= LARGEST_WHOLE
    unit = unit if whole else 1
    shape = (len(offsets), 2, longest + 1)
    at, low, start = np.empty(shape), np.empty(shape, np.int64), np.empty(shape, np.int64)
    for a, pair in enumerate(shares):
        for axis, share in enumerate(pair):
            for side in range(longest + 1):
                centre = side * share
                at[a, axis, side] = float(centre * unit)
                low[a, axis, side] = math.ceil(centre - exact_margin)
                start[a, axis, side] = math.floor(centre + exact_margin)
    return CentreTable(at, low, start, float(unit), float(exact_margin * unit), whole)
