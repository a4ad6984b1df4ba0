"""The turns of a game in compiled loops (Numba): one call in place of many tensor operations.

:mod:`marl_pack.game.packing` and :mod:`marl_pack.game.moves` use these loops with the compiled
backend, and have the same rules in tensor code.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_pack.bins import place_row
from marl_pack.geometry import ORIENTATIONS
from marl_pack.installation import njit

TABLE = np.array(ORIENTATIONS)
POSSIBLE, ILLEGAL, WRONG_ORIENTATION, FULL, OUTSIDE = range(5)
"""Answers of :func:`find_fault`: the choices can be played, or why not."""


@njit(cache=True, inline="always")
def _any(cells: Any) -> bool:
    """Return whether any cell is true; ``cells.any()`` takes longer to compile."""
    result = False
    for i in range(cells.size):
        result |= cells[i]
    return result


@njit(cache=True, inline="always")
def _legal(masks: Any, orientation_mask: Any, g: int, o: int, cell: int, masked: bool) -> bool:
    """Return whether a choice is legal; ``masked`` is false if orientations are not masked."""
    if not (0 <= o < masks.shape[1] and 0 <= cell < masks.shape[2]):
        return False
    return masks[g, o, cell] or (not masked and orientation_mask[g, o] and not _any(masks[g, o]))


@njit(cache=True, inline="always")
def _has_cell(masks: Any, g: int, o: int, masked: bool) -> bool:
    """Return whether a chosen orientation has a legal cell; where it is masked, it has one."""
    return masked or _any(masks[g, o])


@njit(cache=True, nogil=True)
def find_fault(
    masks: Any, orientation_mask: Any, alive: Any, sides: Any, count: Any, most: int, depth: int,
    orientation: Any, cell: Any, masked: bool, check: bool,
) -> tuple[int, int]:  # fmt: skip
    """Find the first choice that cannot be played.

    Args:
        masks: bool [G, 6, W · D], the legal cells.
        orientation_mask: bool [G, 6], the orientations that may be chosen.
        alive: bool [G], the games that have not ended.
        sides: int16 [G, 3], the items' sides.
        count: int64 [G], number of boxes in each bin.
        most: the most boxes that a bin can hold.
        depth: D.
        orientation, cell: int64 [G], the choices.
        masked: whether orientations without a legal cell are masked.
        check: whether to check that the choices are legal.

    Returns:
        POSSIBLE or the reason, and the number of the game.
    """
    width = masks.shape[2] // depth
    for g in range(alive.size if check else 0):
        if alive[g] and not _legal(masks, orientation_mask, g, orientation[g], cell[g], masked):
            return ILLEGAL, g
    for g in range(alive.size):
        if not 0 <= orientation[g] < len(TABLE):
            return WRONG_ORIENTATION, g
    for g in range(alive.size):
        if not (alive[g] and _has_cell(masks, g, orientation[g], masked)):
            continue
        if count[g] >= most:
            return FULL, g
        w, d = sides[g, TABLE[orientation[g], 0]], sides[g, TABLE[orientation[g], 1]]
        x, y = cell[g] // depth, cell[g] % depth
        if not (0 <= x <= width - w and y <= depth - d):
            return OUTSIDE, g
    return POSSIBLE, 0


@njit(cache=True, nogil=True)
def place_items(
    heightmap: Any, empty_map: Any, boxes: Any, loads: Any, labels: Any, count: Any, filled: Any,
    masks: Any, alive: Any, sides: Any, weights: Any, ids: Any, orientation: Any, cell: Any,
    com: Any, unit: float, masked: bool, gain: float, loss: float, lost: Any, t: Any, reward: Any,
    after: Any,
) -> None:  # fmt: skip
    """Place each item as chosen; :func:`find_fault` must have found the choices possible.

    Args:
        heightmap, empty_map, boxes, loads, labels, count, filled: the tensors of the bins; updated.
        masks, alive, sides, orientation, cell, masked: see :func:`find_fault`.
        weights: float64 [G], the items' weights.
        ids: int64 [G], the items' ids.
        com: float64 [G, 2], each centre of mass, measured from the box's low corner in units of
            1 / ``unit`` cells; without entries, it is above the footprint's middle.
        unit: number of units in a cell.
        gain, loss: the reward of a cell filled, and its cost if it is wasted (Eq. 5).
        lost: bool [G], set where a game ends because the orientation has no legal cell.
        t: int64 [G], items that each episode has had; increased where an item is placed.
        reward: float32 [G], written.
        after: int64 [2, G], written: filled cells and number of boxes after the placement.
    """
    depth = heightmap.shape[2]
    for g in range(alive.size):
        o = orientation[g]
        reward[g] = 0
        if alive[g] and not _has_cell(masks, g, o, masked):
            lost[g] = True
        elif alive[g]:
            w, d, h = sides[g, TABLE[o, 0]], sides[g, TABLE[o, 1]], sides[g, TABLE[o, 2]]
            x, y = cell[g] // depth, cell[g] % depth
            centre = x + w / 2, y + d / 2
            if com.size:
                centre = (x * unit + com[g, 0]) / unit, (y * unit + com[g, 1]) / unit
            _, waste = place_row(
                heightmap, empty_map, boxes, loads, labels, count, filled, g, x, y, w, d, h,
                weights[g], centre, (ids[g], o),
            )  # fmt: skip
            # R = α · w d h / (W D H) - β · v_waste / (W D H)
            reward[g] = np.float32(gain * (np.int64(w) * d * h) - loss * waste)
            t[g] += 1
        after[0, g], after[1, g] = filled[g], count[g]


@njit(cache=True, nogil=True)
def rotate_items(sides: Any, orientation: Any, chosen: Any) -> bool:
    """Write items' sides [G, 3] along x, y, z in the chosen orientations, int64 [G].

    Returns:
        Whether all orientations are rows of :data:`ORIENTATIONS`.
    """
    for g in range(orientation.size):
        o = orientation[g]
        if not 0 <= o < len(TABLE):
            return False
        for axis in range(3):
            chosen[g, axis] = sides[g, TABLE[o, axis]]
    return True


@njit(cache=True, nogil=True)
def orient_items(sides: Any, allowed: Any, own: Any, oriented: Any) -> None:
    """Write items' sides in six orientations; zeros where an orientation is not allowed.

    Args:
        sides: int16 [G, 3], the items' own sides.
        allowed: bool [6], the orientations that the game allows.
        own: bool [G, 6], the orientations that each item allows; without entries, all.
        oriented: int16 [G, 6, 3], written.
    """
    for g in range(sides.shape[0]):
        for o in range(len(TABLE)):
            possible = allowed[o] and (own.size == 0 or own[g, o])
            for axis in range(3):
                oriented[g, o, axis] = sides[g, TABLE[o, axis]] if possible else 0


@njit(cache=True, nogil=True)
def find_choices(
    masks: Any, allowed: Any, own: Any, masked: bool, orientation_mask: Any, alive: Any
) -> None:
    """Write the orientations that may be chosen, bool [G, 6], and whether each game goes on.

    Args:
        masks: bool [G, 6, W · D], the legal cells.
        allowed, own: see :func:`orient_items`.
        masked: whether orientations without a legal cell are masked.
        orientation_mask: bool [G, 6], written.
        alive: bool [G], written.
    """
    for g in range(alive.size):
        alive[g] = False
        for o in range(masks.shape[1]):
            orientation_mask[g, o] = _any(masks[g, o])
            alive[g] |= orientation_mask[g, o]
        if not masked:
            for o in range(masks.shape[1]):
                orientation_mask[g, o] = alive[g] and allowed[o] and (own.size == 0 or own[g, o])
