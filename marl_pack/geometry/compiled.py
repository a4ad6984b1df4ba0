"""Windows and placements of boxes in compiled loops (Numba).

:mod:`marl_pack.geometry.tensor` has the same operations in batched tensor code.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_pack.installation import njit


@njit(cache=True, inline="always")
def place_box(
    heightmap: Any, empty_map: Any, x: int, y: int, w: int, d: int, h: int
) -> tuple[int, int]:
    """Place one box from above and update both maps (Algorithm 2 for the empty map).

    The box comes to rest on the highest column of its window. The window must lie inside the map;
    this is not checked.

    Args:
        heightmap: integers [W, D], the top of each column; updated.
        empty_map: integers [W, D], the empty cells below each top; updated. None if not needed.
        x: the window's low corner along W.
        y: the window's low corner along D.
        w: the box's side along x, ≥ 1.
        d: the box's side along y, ≥ 1.
        h: the box's side along z, ≥ 1.

    Returns:
        The resting height and the wasted cells (v_waste of Eq. 7): empty cells enclosed below the
        box.
    """
    z = 0
    for i in range(x, x + w):
        for j in range(y, y + d):
            z = max(z, heightmap[i, j])
    waste = 0
    for i in range(x, x + w):
        for j in range(y, y + d):
            gap = z - heightmap[i, j]
            if empty_map is not None:
                empty_map[i, j] += gap
            heightmap[i, j] = z + h
            waste += gap
    return z, waste


@njit(cache=True, inline="always")
def _pairwise_max(a: Any, b: Any, out: Any) -> None:
    """Write the larger of ``a[i]`` and ``b[i]`` to ``out[i]``."""
    for i in range(out.size):
        out[i] = a[i] if a[i] > b[i] else b[i]


@njit(cache=True)
def slide(values: Any, spare: Any, out: Any, depth: int, w: int, d: int) -> Any:
    """Compute the maximum over the w × d window whose low corner is each entry of a flat map.

    The window is doubled step by step, which takes O(log w + log d) passes. Entries whose window
    leaves the map are undefined.

    Args:
        values: the map [W · D], or several maps one after the other.
        spare: scratch array of the same size and type.
        out: scratch array of the same size and type.
        depth: D.
        w: the window's cells along x, ≥ 1.
        d: the window's cells along y, ≥ 1.

    Returns:
        The buffer that holds the result: ``values``, ``spare`` or ``out``.
    """
    current, flip = values, True
    n = values.size
    for extent, stride in ((d, 1), (w, depth)):
        reach = 1
        while reach < extent:
            step = min(reach, extent - reach)
            n -= step * stride
            target = out if flip else spare
            _pairwise_max(current[:n], current[step * stride : step * stride + n], target[:n])
            current, flip = target, not flip
            reach += step
    return current


@njit(cache=True)
def mark_valid(valid: Any, width: int, depth: int, w: int, d: int, mark: int) -> None:
    """Mark the positions at which a w × d window lies inside the map.

    Args:
        valid: integers [W · D], written: ``mark`` at those positions, 0 at the others.
        width: W.
        depth: D.
        w: the window's cells along x, ≤ W.
        d: the window's cells along y, ≤ D.
        mark: the number to write.
    """
    valid[:] = 0
    for x in range(width - w + 1):
        valid[x * depth : x * depth + depth - d + 1] = mark


@njit(cache=True, nogil=True)
def resting_heights_and_waste(
    heightmap: Any, sides: Any, height: int, resting_heights: Any, waste: Any
) -> None:
    """Compute the resting height and the wasted cells of every window.

    Args:
        heightmap: int16 [N, W, D].
        sides: int16 [N, A, 3].
        height: H, written as the resting height where the window does not lie inside the map.
        resting_heights: int16 [N, A, W, D], written.
        waste: int32 [N, A, W, D], written unless it has no entries.
    """
    n, width, depth = heightmap.shape
    cells = width * depth
    spare, out = np.empty(cells, np.int16), np.empty(cells, np.int16)
    below = np.zeros((width + 1, depth + 1), np.int32)
    with_waste = waste.size > 0
    for b in range(n):
        flat = heightmap[b].reshape(cells)
        if with_waste:
            for x in range(width):
                row = 0
                for y in range(depth):
                    row += heightmap[b, x, y]
                    below[x + 1, y + 1] = below[x, y + 1] + row
        for a in range(sides.shape[1]):
            w, d, h = sides[b, a, 0], sides[b, a, 1], sides[b, a, 2]
            resting_heights[b, a] = height
            if with_waste:
                waste[b, a] = 0
            if not (0 < w <= width and 0 < d <= depth and h > 0):
                continue
            top = slide(flat, spare, out, depth, w, d)
            for x in range(width - w + 1):
                for y in range(depth - d + 1):
                    z = top[x * depth + y]
                    resting_heights[b, a, x, y] = z
                    if with_waste:
                        under = (
                            below[x + w, y + d] - below[x, y + d] - below[x + w, y] + below[x, y]
                        )
                        waste[b, a, x, y] = np.int32(w) * d * z - under
