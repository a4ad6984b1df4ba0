"""The sizes of bins, and the six orientations of a box."""

from __future__ import annotations

from marl_pack.checks import real_number, shown

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
"""The six axis permutations of a box. Row ``o`` names which of the item's own sides
(0 = w, 1 = d, 2 = h) lies along x, y and z. ``o // 2`` picks the side that stands upright
(h, d, w), and ``o ^ 1`` is the same box rotated by 90° about the vertical. So orientation 0 is the
item as it arrives, and the orientations 0 and 1 keep it upright."""

ALL_ORIENTATIONS = tuple(range(len(ORIENTATIONS)))
"""The numbers of the six orientations, 0 … 5."""

MAX_HEIGHT = 16383
"""Height of the tallest bin in cells: masks compare ``2 · height + 1`` as 16-bit integers."""
MAX_SIDE = 32767
"""Width and depth of the largest bin in cells."""


def check_size(size: Size) -> Size:
    """Return a bin's ``size`` as three ints.

    Raises:
        ValueError: unless it is three whole numbers from 1 to the largest size allowed.
    """
    try:
        sides = [real_number(side, "side") for side in size]
    except (TypeError, ValueError):
        sides = []
    if len(sides) != 3 or any(not side.is_integer() or side < 1 for side in sides):
        raise ValueError(f"bin size {shown(size)}: needs three whole numbers of cells ≥ 1, W D H")
    if sides[2] > MAX_HEIGHT or max(sides) > MAX_SIDE:
        raise ValueError(
            f"bin size {shown(size)}: at most {MAX_SIDE} x {MAX_SIDE} x {MAX_HEIGHT}; use larger "
            "cells"
        )
    return int(sides[0]), int(sides[1]), int(sides[2])
