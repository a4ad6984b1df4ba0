"""Compute convex-hull masks in compiled loops (Numba), without reading any window twice.

Each column has a number K: 2 · height + 1 if its top counts as support, else 2 · height. The
largest K of a window gives its resting height and says whether a supporting cell lies at this
height. If this K is odd, the contact cells that count are the cells with this K. One sliding
maximum of K over quarter windows, by doubling on the flattened map, gives both for each quadrant of
every window around the centre of mass:

- a contact cell in all four quadrants: the centre of mass is strictly inside their hull;
- no contact cell in two adjacent quadrants: all contact lies beyond a line through the centre of
  mass, so it is not inside;
- only the other windows need a test on the first and last cells of the window's rows
  (:mod:`marl_pack.stability.hull_windows`).

Small maps are processed in runs of windows of the same footprint, so that the loops are long
enough for the CPU's vector units. Entries that wrap around a row's end are invalid positions and
are cleared. :mod:`marl_pack.stability.hull_tensor` has the same rule in batched tensor code.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor, from_numpy

from marl_pack.geometry.compiled import mark_valid, slide
from marl_pack.installation import njit
from marl_pack.stability.centres import CentreTable
from marl_pack.stability.hull_exact import OUTSIDE, UNSURE
from marl_pack.stability.hull_windows import UNDECIDED, YES, solve_middles, solve_undecided
from marl_pack.stability.mask_runs import earlier_equals, in_bin, runs_of_footprints

RUN_CELLS = 1024
"""Cells processed at a time: a few kB, well inside the first-level cache."""


@njit(cache=True)
def _decide(a: Any, b: Any, c: Any, d: Any, top: Any, code: Any) -> None:
    """Decide windows from the largest K of each of their four quadrants.

    The highest contact lies in every quadrant if the smallest of the four numbers equals the
    largest. It lies in every half if the smallest of the four halves' maxima equals the largest.

    Args:
        a: integers [P], largest K of the quadrant that is low in x and low in y.
        b: integers [P], largest K of the quadrant that is low in x and high in y.
        c: integers [P], largest K of the quadrant that is high in x and low in y.
        d: integers [P], largest K of the quadrant that is high in x and high in y.
        top: integers [P], the largest K at which the box fits; overwritten with the window's
            largest K.
        code: uint8 [P], YES | UNDECIDED at valid positions, else 0; overwritten with the verdict.
    """
    for i in range(code.size):
        low_x, high_x = max(a[i], b[i]), max(c[i], d[i])
        low_y, high_y = max(a[i], c[i]), max(b[i], d[i])
        best = max(low_x, high_x)
        quadrants = min(min(a[i], b[i]), min(c[i], d[i]))
        halves = min(min(low_x, high_x), min(low_y, high_y))
        verdict = ((quadrants == best) * 1 + (halves == best) * 1) & code[i]
        code[i] = verdict if best <= top[i] and best & 1 == 1 else 0
        top[i] = best


@njit(cache=True)
def fill_levels(heightmap: Any, empty_map: Any, levels: Any) -> None:
    """Write K of every column to ``levels``, from flat maps."""
    for i in range(levels.size):
        levels[i] = 2 * heightmap[i] + (1 if empty_map[i] == 0 else 0)


@njit(cache=True)
def _load(levels: Any, top: int, valid: Any, window: Any, tops: Any, codes: Any) -> None:
    """Copy one mask's map, height limit and valid positions into a run; slices would be slower."""
    for i in range(levels.size):
        window[i] = levels[i]
        tops[i] = top
        codes[i] = valid[i]


@njit(cache=True)
def _copy(values: Any, out: Any) -> None:
    """Copy a flat map; slices would be slower."""
    for i in range(out.size):
        out[i] = values[i]


@njit(cache=True)
def _write_mask(codes: Any, out: Any) -> bool:
    """Write 1 to ``out`` where a code is YES, else 0; return whether any code is UNDECIDED."""
    undecided = np.uint8(0)
    for i in range(out.size):
        undecided |= codes[i] & UNDECIDED
        out[i] = codes[i] >> 1
    return undecided != 0


@njit(cache=True, inline="always")
def _clear_unfit(sides: Any, width: int, depth: int, height: int, out: Any) -> None:
    """Empty the masks [N · A, W · D] of the oriented items that do not fit into the bin."""
    for i in range(sides.shape[0]):
        if not in_bin(sides[i, 0], sides[i, 1], sides[i, 2], width, depth, height):
            out[i] = 0


@njit(cache=True, inline="always")
def _copy_equals(equal: Any, out: Any, best_level: Any) -> None:
    """Copy the results of oriented items [N · A] to those with equal sides.

    Args:
        equal: int64 [N · A], see :func:`marl_pack.stability.mask_runs.earlier_equals`.
        out: [N · A, W · D].
        best_level: [N · A, W · D], or without entries.
    """
    for i in range(equal.size):
        if equal[i] >= 0:
            _copy(out[equal[i]], out[i])
            if best_level.size:
                _copy(best_level[equal[i]], best_level[i])


@njit(cache=True, nogil=True)
def central_masks(
    heightmap: Any, empty_map: Any, sides: Any, height: int, levels: Any, out: Any, best_level: Any
) -> None:
    """Compute masks of boxes with the centre of mass in the middle and no margin.

    :func:`general_masks` computes all other masks.

    Args:
        heightmap: int16 [N, W, D].
        empty_map: int16 [N, W, D]; only columns where it is 0 count as support.
        sides: int16 [N, A, 3]; a zero side gets an empty mask.
        height: H, at most 16383 cells (126 where ``levels`` is uint8).
        levels: uint8 or int16 [N, W, D], scratch.
        out: uint8 [N, A, W, D], written: 1 where the box fits and is supported.
        best_level: same type as ``levels``, [N, A, W, D], written: the largest K under the box
            where ``out`` is 1. Not written if it has no entries.
    """
    (n, width, depth), count = heightmap.shape, sides.shape[1]
    cells = width * depth
    flat_sides = sides.reshape(n * count, 3)
    flat_out, flat_levels = out.reshape(n * count, cells), levels.reshape(n, cells)
    flat_best = best_level.reshape(n * count if best_level.size else 0, cells)
    fill_levels(heightmap.reshape(-1), empty_map.reshape(-1), levels.reshape(-1))
    size = max(1, RUN_CELLS // cells)
    equal = earlier_equals(sides)
    order, limits = runs_of_footprints(flat_sides, equal, (width, depth), height, size)
    gathered = np.empty((3, size * cells), levels.dtype)
    tops = np.empty(size * cells, levels.dtype)
    codes, valid = np.empty((size, cells), np.uint8), np.empty(cells, np.uint8)
    flat_codes = codes.reshape(size * cells)
    scratch = np.empty((3, 2 * width + 2, 2), np.int64)
    _clear_unfit(flat_sides, width, depth, height, flat_out)
    marked = 0, 0
    for run in range(limits.size - 1):
        batch = order[limits[run] : limits[run + 1]]
        w, d = flat_sides[batch[0], 0], flat_sides[batch[0], 1]
        total = batch.size * cells
        if size == 1:
            window = flat_levels[batch[0] // count]
            tops[:] = 2 * (height - flat_sides[batch[0], 2]) + 1
            mark_valid(codes[0], width, depth, w, d, YES | UNDECIDED)
        else:
            window = gathered[0, :total]
            if marked != (w, d):
                mark_valid(valid, width, depth, w, d, YES | UNDECIDED)
                marked = (w, d)
            for j in range(batch.size):
                part = slice(j * cells, (j + 1) * cells)
                top = 2 * (height - flat_sides[batch[j], 2]) + 1
                _load(
                    flat_levels[batch[j] // count], top, valid, window[part], tops[part], codes[j]
                )
        half_w, half_d = (w + 1) // 2, (d + 1) // 2
        best = slide(window, gathered[1], gathered[2], depth, half_w, half_d)
        m = total - (w - 1) * depth - (d - 1)
        sx, sy = (w - half_w) * depth, d - half_d
        _decide(
            best[:m], best[sy : sy + m], best[sx : sx + m], best[sx + sy : sx + sy + m], tops[:m],
            flat_codes[:m],
        )  # fmt: skip
        flat_codes[m:total] = 0
        _write_run(batch, w, d, codes, tops, levels, scratch, out, flat_out, flat_best)
    _copy_equals(equal, flat_out, flat_best)


@njit(cache=True, inline="always")
def _write_run(
    batch: Any, w: int, d: int, codes: Any, tops: Any, levels: Any, scratch: Any, out: Any,
    flat_out: Any, flat_best: Any,
) -> None:  # fmt: skip
    """Write the masks of a run of boxes with the same footprint; solve undecided cells first."""
    count, cells = out.shape[1], codes.shape[1]
    for j in range(batch.size):
        i = batch[j]
        if _write_mask(codes[j], flat_out[i]):
            solve_middles(
                codes[j], tops[j * cells : (j + 1) * cells], levels[i // count], w, d, scratch,
                out[i // count, i % count],
            )  # fmt: skip
        if flat_best.size:
            _copy(tops[j * cells : (j + 1) * cells], flat_best[i])


@njit(cache=True)
def _keep_supported(
    plane: Any, buffers: Any, depth: int, w: int, d: int, low: Any, high: Any, whole: Any,
    codes: Any,
) -> None:  # fmt: skip
    """Clear the codes of windows that do not have their highest contact in each half and quadrant.

    A window with contact in all four halves stays UNDECIDED. A window with contact in all four
    quadrants becomes YES.

    Args:
        plane: [W · D], K of every column.
        buffers: [2, W · D], scratch.
        depth: D.
        w: the window's cells along x.
        d: the window's cells along y.
        low: (x, y), cells of the halves that begin at the window's low corner.
        high: (x, y), cells of the halves that end at its high corner.
        whole: [P], largest K of each window.
        codes: uint8 [P], overwritten.
    """
    for part in range(8):
        left, right = part in (0, 4, 5), part in (1, 6, 7)
        front, back = part in (2, 4, 6), part in (3, 5, 7)
        pw = low[0] if left else (high[0] if right else w)
        pd = low[1] if front else (high[1] if back else d)
        shift = (w - pw if right else 0) * depth + (d - pd if back else 0)
        best = slide(plane, buffers[0], buffers[1], depth, pw, pd)[shift:]
        remaining = 0 if part < 4 else UNDECIDED
        for i in range(whole.size):
            if best[i] != whole[i]:
                codes[i] &= remaining
    for i in range(whole.size):
        codes[i] = YES if codes[i] & YES else codes[i]


@njit(cache=True, nogil=True)
def general_masks(
    heightmap: Any, empty_map: Any, sides: Any, at: Any, low: Any, start: Any, unit: float,
    margin: float, whole: bool, height: int, levels: Any, out: Any,
) -> int:  # fmt: skip
    """Compute masks for any centre of mass and safety margin.

    Halves and quadrants begin ``margin`` away from the centre of mass here. If contact reaches into
    all four quadrants, the hull contains the square of half-width ``margin`` around the centre of
    mass, and so the disc of this radius. If one of the four halves has no contact, a side of the
    hull lies within ``margin`` of the centre of mass.

    Args:
        at, low, start, unit, margin, whole: the fields of a
            :class:`marl_pack.stability.centres.CentreTable` for windows as long as the map.
        heightmap, empty_map, sides, height, levels: see :func:`central_masks`.
        out: uint8 [N, A, W, D], written: OUTSIDE, INSIDE or UNSURE.

    Returns:
        The number of windows that are UNSURE.
    """
    n, width, depth = heightmap.shape
    cells = width * depth
    fill_levels(heightmap.reshape(-1), empty_map.reshape(-1), levels.reshape(-1))
    buffers = np.empty((2, cells), levels.dtype)
    largest = np.empty(cells, levels.dtype)
    unsure = 0
    codes = np.empty(cells, np.uint8)
    scratch = np.empty((3, 2 * width + 2, 2), np.int64)
    for b in range(n):
        plane = levels[b].reshape(cells)
        for a in range(sides.shape[1]):
            w, d, h = sides[b, a, 0], sides[b, a, 1], sides[b, a, 2]
            plane_out = out[b, a].reshape(cells)
            if not in_bin(w, d, h, width, depth, height):
                plane_out[:] = OUTSIDE
                continue
            below = low[a, 0, w], low[a, 1, d]
            above = w - start[a, 0, w], d - start[a, 1, d]
            if min(min(below), min(above)) <= 0:
                plane_out[:] = OUTSIDE
                continue
            mark_valid(codes, width, depth, w, d, YES | UNDECIDED)
            m = (width - w) * depth + depth - d + 1
            best = slide(plane, buffers[0], buffers[1], depth, w, d)
            largest[:m] = best[:m]
            for i in range(m):
                if largest[i] & 1 == 0 or largest[i] > 2 * (height - h) + 1:
                    codes[i] = 0
            _keep_supported(plane, buffers, depth, w, d, below, above, largest[:m], codes)
            if _write_mask(codes, plane_out):
                x, y = at[a, 0, w], at[a, 1, d]
                unsure += solve_undecided(
                    codes, largest, levels[b], w, d, x, y, unit, margin, whole, scratch, out[b, a]
                )
    return unsure


def level_dtype(height: int) -> type[np.generic]:
    """Return the smallest integer type that holds 2 · height + 1."""
    return np.uint8 if height <= 126 else np.int16


def support_mask(
    heightmap: Tensor,
    empty_map: Tensor,
    sides: Tensor,
    height: int,
    centres: CentreTable | None = None,
) -> tuple[Tensor, Tensor | None]:
    """Compute where each box fits and its centre of mass is supported.

    Args:
        heightmap: int16 [N, W, D].
        empty_map: int16 or bool [N, W, D]; only columns where it is 0 count as support.
        sides: int16 [N, A, 3].
        height: H.
        centres: table of the centres of mass with the margin; None: centres of mass in the middle
            and no margin.

    Returns:
        The mask, bool [N, A, W, D], and the windows int64 [U, 4] (rows n, a, x, y) that exact
        fractions must decide; None if there are none.
    """
    n, width, depth = heightmap.shape
    maps = [np.ascontiguousarray(values.numpy()) for values in (heightmap, empty_map)]
    boxes = np.ascontiguousarray(sides.numpy())
    out = np.empty((n, boxes.shape[1], width, depth), np.uint8)
    levels = np.empty(maps[0].shape, level_dtype(height))
    unsure = None
    if centres is None:
        central_masks(*maps, boxes, height, levels, out, np.empty((0, 0, 0, 0), levels.dtype))
    elif general_masks(
        *maps, boxes, centres.at, centres.low, centres.start, centres.unit, centres.margin,
        centres.whole, height, levels, out,
    ):  # fmt: skip
        unsure = from_numpy(np.argwhere(out == UNSURE))
        out[out == UNSURE] = OUTSIDE
    return from_numpy(out.view(np.bool_)), unsure
