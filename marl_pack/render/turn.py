"""Pictures and text of one turn of a game: the bin, the item to come, and where it may go."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from marl_pack.geometry import ORIENTATIONS, Size


def turn_text(title: str, item: Sequence[int], heightmap: NDArray[np.integer], height: int) -> str:
    """Return the turn as text: the title, the item's sides, and the heights seen from above.

    Args:
        title: first line.
        item: sides along x, y, z in cells.
        heightmap: [W, D], in cells.
        height: H.
    """
    digits = len(str(height))
    rows = [" ".join(f"{h:{digits}d}" for h in column) for column in heightmap.T[::-1].tolist()]
    return "\n".join([title, f"item {' x '.join(map(str, item))}", *rows]) + "\n"


def turn_picture(
    title: str,
    size: Size,
    boxes: NDArray[np.integer],
    item: Sequence[int],
    masks: NDArray[np.bool_],
    orientation: int | None = None,
) -> NDArray[np.uint8]:
    """Draw the turn, uint8 [rows, columns, 3].

    Args:
        title: of the picture.
        size: (W, D, H) in cells.
        boxes: int [n, 6], rows x, y, z, w, d, h in order of placement.
        item: its own sides w, d, h in cells; zeros where there is none.
        masks: bool [6, W, D], where it may be placed in each orientation.
        orientation: the chosen one, once there is one; only its mask is drawn then.
    """
    from marl_pack.render.picture import draw  # matplotlib is slow to import

    shown = range(len(ORIENTATIONS)) if orientation is None else [orientation]
    labels = [" x ".join(str(item[axis]) for axis in ORIENTATIONS[o]) for o in shown]
    w, d, h = (item[axis] for axis in ORIENTATIONS[orientation or 0])
    sides = (int(w), int(d), int(h)) if any(item) else None
    return draw(size, boxes, sides, masks[list(shown)], labels, title)
