"""Algorithms 1 and 2 of Zhou et al. 2024 with OpenCV, step by step as in the paper.

Readers can compare this module with the paper line by line. The package itself uses
:mod:`marl_pack.stability.reference` and its fast versions. They differ from the paper where it
would let boxes fall or forbid stable placements:

- *Squares, not points.* The paper takes the hull of the highest points of a heightmap in pixels. In
  the package a cell is a square. With points, the centre is off by half a cell, which matters
  little for pixels of 5 mm, but much on a 10 × 10 grid.
- *Strictly inside.* ``center.within(hull)`` does not say whether the hull's edge counts. A box that
  is balanced on an edge does not stand, so in the package the edge never counts.
- *One rule everywhere.* Algorithm 1 accepts every box on the floor. The package tests the floor
  like any other contact, so a margin or an offset of the centre of mass counts on the floor too.
- *Any centre of mass.* Algorithm 1 tests the window's centre. The package tests any known centre of
  mass.

All lengths are cells. OpenCV comes with ``pip install -e ".[reference]"``.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from marl_pack.extras import missing
from marl_pack.stability.reference import corners

Map = NDArray[np.integer[Any]]

Reading = Literal["points", "squares"]
"""How a cell of p_f becomes points of a polygon, and whether the polygon's edge counts.

``points``: a cell gives one point, its indices, and the edge counts; this is one way to read the
paper. ``squares``: a cell gives the four corners of its square, and the edge does not count; this
is how the package reads it.
"""


def convex_hull_alpha(
    heightmap: Map,
    empty_map: Map,
    item: tuple[int, int, int],
    bin_height: int,
    reading: Reading = "points",
) -> NDArray[np.bool_]:
    """Return the stable action map A of Algorithm 1 (convexHull-α) of Zhou et al. 2024.

    Args:
        heightmap: B, the height of each column, whole numbers [W, D].
        empty_map: E, the empty cells below the top of each column, whole numbers [W, D].
        item: sides w, d, h of the object.
        bin_height: height H of the bin.
        reading: how a cell becomes points of the hull.

    Returns:
        Bool [W, D]: whether the object is stable with its low corner at (x, y).

    Raises:
        ModuleNotFoundError: if OpenCV is missing; the message names the extra that installs it.
    """
    (w, d, h), (width, depth) = item, heightmap.shape
    action_map = np.zeros((width, depth), np.bool_)
    for x in range(width - w + 1):  # elsewhere the window is out of boundary
        for y in range(depth - d + 1):
            window = heightmap[x : x + w, y : y + d]
            if window.max() + h > bin_height:
                continue
            if window.max() == 0:
                action_map[x, y] = True
                continue
            highest = window == window.max()  # p_f
            grounded = highest & (empty_map[x : x + w, y : y + d] == 0)  # p_f′
            action_map[x, y] = _centre_within_hull(grounded, reading)
    return action_map


def convex_hull_1(
    heightmap: Map, item: tuple[int, int, int], bin_height: int, reading: Reading = "points"
) -> NDArray[np.bool_]:
    """Return the stable action map of convexHull-1 (Zhou et al. 2024, section III-A), bool [W, D].

    It is Algorithm 1 without the empty map: all the highest points p_f count, even above a gap.
    """
    return convex_hull_alpha(heightmap, np.zeros_like(heightmap), item, bin_height, reading)


def update_empty_map(
    heightmap: Map, empty_map: Map, action_point: tuple[int, int], item: tuple[int, int, int]
) -> Map:
    """Return the empty map after a placement: Algorithm 2 of Zhou et al. 2024.

    Args:
        heightmap: B before the placement, whole numbers [W, D].
        empty_map: E before the placement, whole numbers [W, D].
        action_point: X, Y, the low corner of the object.
        item: its sides w, d, h.

    Returns:
        The updated E, a new array [W, D].
    """
    (x, y), (w, d, _) = action_point, item
    updated = empty_map.copy()
    window = heightmap[x : x + w, y : y + d]
    updated[x : x + w, y : y + d] += window.max() - window
    return updated


def _centre_within_hull(cells: NDArray[np.bool_], reading: Reading) -> bool:
    """Return whether the centre (w/2, d/2) of a window lies in the convex hull of its ``cells``.

    Args:
        cells: the points of support, bool [w, d].
        reading: how a cell becomes points of the hull.
    """
    try:
        import cv2
    except ModuleNotFoundError as error:
        raise missing(error, "the paper's algorithms need OpenCV", "reference") from None
    if not cells.any():
        return False
    w, d = cells.shape
    if reading == "points":
        hull = cv2.convexHull(np.argwhere(cells).astype(np.int32))
        return bool(cv2.pointPolygonTest(hull, (w / 2, d / 2), False) >= 0)
    # In half cells, so that the centre has whole coordinates: OpenCV's test is exact on these.
    hull = cv2.convexHull((2 * corners(cells)).astype(np.int32))
    return bool(cv2.pointPolygonTest(hull, (float(w), float(d)), False) > 0)
