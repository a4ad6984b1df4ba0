"""Pictures and text of one turn of a game: the bin, the next item, and where it may be placed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from marl_pack.geometry import ORIENTATIONS, Size


def turn_text(title: str, item: Sequence[int], heightmap: NDArray[np.integer], height: int) -> str:
    """Return the turn as text: the title, the item's sides, and the heights seen from above.

    Args:
        title: the first line.
        item: the item's sides along x, y, z in cells.
        heightmap: the height of each column, [W, D], in cells.
        height: the bin's height H in cells.
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
        title: the title of the picture.
        size: the bin's sides (W, D, H) in cells.
        boxes: int [n, 6], rows x, y, z, w, d, h in order of placement.
        item: the item's sides w, d, h as it comes, in cells; zeros if there is no item.
        masks: bool [6, W, D], where the item may be placed in each orientation.
        orientation: the chosen orientation, whose mask alone is drawn; None before the choice.
    """
    from marl_pack.render.picture import draw  # matplotlib is slow to import

    shown = range(len(ORIENTATIONS)) if orientation is None else [orientation]
    labels = [" x ".join(str(item[axis]) for axis in ORIENTATIONS[o]) for o in shown]
    w, d, h = (item[axis] for axis in ORIENTATIONS[orientation or 0])
    sides = (int(w), int(d), int(h)) if any(item) else None
    return draw(size, boxes, sides, masks[list(shown)], labels, title)
