"""Compute masks of exact static equilibrium: cells where the whole stack stands with a new box.

Where ``hull_alpha`` is true, the stack stands: the new weight goes straight down through filled
columns. Where ``hull_1`` is false, the stack does not stand: the new box itself tips. For the other
cells, the reduced linear program of :mod:`marl_pack.stability.reduced_equilibrium` is solved. If
rounding errors could change its result (a tie), the same program is solved in whole numbers.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import torch
from torch import Tensor

from marl_pack.bins import Bins
from marl_pack.checks import exact
from marl_pack.installation import njit
from marl_pack.stability.exact_equilibrium import Load
from marl_pack.stability.oriented_item import OrientedItem
from marl_pack.stability.reduced_equilibrium import (
    UNSURE,
    YES,
    ground_points,
    mark_bearing,
    shifts_of,
    stands,
    stands_by_fractions,
    survey,
)
from marl_pack.stability.static_equilibrium import in_equilibrium


@njit(cache=True, nogil=True)
def _solve_band(
    heightmap: Any, empty_map: Any, boxes: Any, loads: Any, count: Any, sides: Any, com: Any,
    weight: Any, shifts: Any, whole: Any, band: Any, verdict: Any,
) -> None:  # fmt: skip
    """Write YES, NO or UNSURE to ``verdict`` [N, A, W, D] for every cell of ``band``.

    YES means that the stack stands for each of the ``shifts`` [S, 2] of the new box's centre of
    mass. ``whole`` [N] says whether the whole stack is solved, or only the boxes that the new box
    may disturb.
    """
    n, width, depth = heightmap.shape
    scratch = np.empty((3, 2 * width + 2, 2), np.int64)
    bearing = np.empty((width, depth), np.bool_)
    for b in range(n):
        if not band[b].any():
            continue
        k = count[b]
        stack = np.empty((k + 1, 6), np.int64)
        load = np.empty((k + 1, 3))
        stack[:k], load[:k] = boxes[b, :k], loads[b, :k]
        grounded, points, size = survey(stack, k, (width, depth), scratch)
        for a in range(sides.shape[1]):
            w, d, h = sides[b, a, 0], sides[b, a, 1], sides[b, a, 2]
            if w < 1 or d < 1 or h < 1:
                continue
            for x in range(width - w + 1):
                for y in range(depth - d + 1):
                    if not band[b, a, x, y]:
                        continue
                    z = heightmap[b, x : x + w, y : y + d].max()
                    cells = bearing[:w, :d]
                    mark_bearing(heightmap[b], empty_map[b], x, y, z, cells)
                    stack[k, 0], stack[k, 1], stack[k, 2] = x, y, z
                    stack[k, 3], stack[k, 4], stack[k, 5] = w, d, h
                    size[k] = ground_points(cells, scratch, points[k])
                    result = YES
                    load[k, 0] = weight[b]
                    for s in range(shifts.shape[0]):
                        load[k, 1] = x + com[b, a, 0] + shifts[s, 0]
                        load[k, 2] = y + com[b, a, 1] + shifts[s, 1]
                        if result == YES:
                            result = stands(stack, load, k, grounded, points, size, whole[b])
                    verdict[b, a, x, y] = result


def equilibrium_mask(
    bins: Bins,
    item: OrientedItem,
    surely: Tensor,
    possibly: Tensor,
    margin: float = 0.0,
    check_stack: bool = False,
) -> Tensor:
    """Compute where the whole stack with a new box is in strict equilibrium, bool [N, A, W, D].

    The linear programs are solved on the CPU, whatever device the bins are on.

    Args:
        bins: N bins, with their boxes in order of placement.
        item: the new boxes, in A orientations.
        surely: bool [N, A, W, D], the mask of ``hull_alpha``: cells known to be stable.
        possibly: bool [N, A, W, D], the mask of ``hull_1``: cells that may be stable.
        margin: distance in cells; the stack must stand wherever the new box's centre of mass lies
            within this distance of its position.
        check_stack: whether to check first that the stack is in equilibrium. If it is not, the
            whole stack is solved for every cell of ``possibly``.

    Returns:
        ``surely``, and the cells of ``possibly`` where the whole stack stands.
    """
    device = bins.device
    stack = bins.to("cpu")
    whole = np.zeros(len(bins), np.bool_)
    if check_stack:
        for b in range(len(bins)):
            k = int(stack.count[b])
            whole[b] = not in_equilibrium(stack.boxes[b, :k].numpy(), stack.loads[b, :k].numpy())
    sure = surely & ~torch.from_numpy(whole).to(device)[:, None, None, None]
    band = possibly & ~sure
    if not bool(band.any()):
        return sure
    exact_shifts = shifts_of(margin)
    shifts = np.array(exact_shifts, np.float64)
    verdict = np.zeros(tuple(band.shape), np.uint8)
    centres = item.centre_table(0.0, max(bins.size[:2]))
    inputs = (
        stack.heightmap, stack.empty_map, stack.boxes, stack.loads, stack.count,
        item.sides, centres.cells(item.sides), item.weights(),
        torch.from_numpy(shifts), torch.from_numpy(whole), band,
    )  # fmt: skip
    _solve_band(*(tensor.cpu().contiguous().numpy() for tensor in inputs), verdict)
    for b, a, x, y in np.argwhere(verdict == UNSURE).tolist():
        verdict[b, a, x, y] = _stands_exactly(stack, item, (b, a, x, y), exact_shifts, whole[b])
    return sure | torch.from_numpy(verdict == YES).to(device)


def _stands_exactly(
    stack: Bins,
    item: OrientedItem,
    cell: tuple[int, int, int, int],
    shifts: list[tuple[Fraction, Fraction]],
    whole: bool,
) -> bool:
    """Decide in exact arithmetic whether the stack stands with a box at the cell (b, a, x, y)."""
    b, a, x, y = cell
    k = int(stack.count[b])
    w, d, h = item.sides[b, a].tolist()
    z = int(stack.heightmap[b, x : x + w, y : y + d].max())
    boxes = np.vstack((stack.boxes[b, :k].numpy(), (x, y, z, w, d, h))).astype(np.int64)
    loads = stack.loads[b, :k].numpy()
    weight = exact(float(item.weights()[b]))
    com = item.exact_centre(a, w, d)
    return all(
        stands_by_fractions(
            boxes, loads, Load(weight, x + com[0] + dx, y + com[1] + dy), stack.size[:2], whole
        )
        for dx, dy in shifts
    )
