"""Convex-hull masks on the CPU: no window is read twice (Numba).

With K = 2 · height + bearing, the largest K of a window tells its resting height, and whether a
bearing cell lies at that height, in one small integer; the contact cells that count are those with
K equal to that maximum when it is odd. One sliding maximum of K over quarter windows, taken by
doubling on the flattened map, answers both questions for each quadrant of every window around the
centre of mass:

- a contact cell in all four quadrants: the centre of mass is strictly inside their hull;
- none in two adjacent ones: all contact lies beyond a line through it, so it is not;
- only what lies between gets the exact test on the extremes of the window's rows.

Small maps are processed in runs of windows of the same footprint, so that the loops are long
enough for the CPU's vector units; entries that wrap around a row's end are invalid positions and
are cleared. :mod:`marl_pack.stability.hull_torch` is the same rule in batched tensor code.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

RUN_CELLS = 1024  # cells processed at a time: a few kB, well inside the first-level cache

YES, UNDECIDED = 2, 1  # every YES also passes the weaker test: 1 + 1


@njit(cache=True, inline="always")
def _pairwise_max(a: Any, b: Any, out: Any) -> None:
    for i in range(out.size):
        out[i] = a[i] if a[i] > b[i] else b[i]


@njit(cache=True)
def slide(values: Any, spare: Any, out: Any, depth: int, w: int, d: int) -> Any:
    """Maximum over the w × d window whose low corner is each entry of the flat map ``values``.

    Returns the buffer that holds it (``values``, ``spare`` or ``out``); O(log w + log d) passes.
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
def _decide(a: Any, b: Any, c: Any, d: Any, top: Any, code: Any) -> None:
    """Decide windows from the largest K of their quadrants: ``a b`` low in x, ``a c`` low in y.

    The best contact is in every quadrant if the least of the four equals their maximum, and in
    every half if the least of the four halves' maxima does. ``code`` holds YES | UNDECIDED at the
    positions that are valid, else 0, and gets the verdict; ``top`` holds the largest K at which the
    box fits, and gets the window's own.
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
def mark_valid(code: Any, width: int, depth: int, w: int, d: int) -> None:
    """Set the positions at which a w × d window lies inside the map to 3, the others to 0."""
    code[:] = 0
    for x in range(width - w + 1):
        code[x * depth : x * depth + depth - d + 1] = YES | UNDECIDED


@njit(cache=True)
def envelope(lo: Any, hi: Any, upper: Any, lower: Any) -> tuple[int, int]:
    """Upper and lower chain of the hull of the squares of row extremes.

    Args:
        lo, hi: int64 [w], first and last cell of each row (``hi < lo``: the row has none).
        upper, lower: int64 [2w + 2, 2], filled with the chains' vertices (x, y), x ascending.

    Returns:
        The number of vertices of the upper and of the lower chain; 0, 0 where no row has a cell.
    """
    sizes = [0, 0]
    for side in range(2):
        chain, size = (upper, 0) if side == 0 else (lower, 0)
        sign = 1 if side == 0 else -1
        for row in range(lo.size):
            if hi[row] < lo[row]:
                continue
            y = hi[row] + 1 if side == 0 else lo[row]
            for x in (row, row + 1):
                if size and chain[size - 1, 0] == x:
                    if sign * (y - chain[size - 1, 1]) <= 0:
                        continue
                    size -= 1
                while size > 1:
                    ax, ay = chain[size - 2, 0], chain[size - 2, 1]
                    bx, by = chain[size - 1, 0], chain[size - 1, 1]
                    if sign * ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) < 0:
                        break
                    size -= 1
                chain[size, 0], chain[size, 1] = x, y
                size += 1
        sizes[side] = size
    return sizes[0], sizes[1]


@njit(cache=True)
def _beyond_chain(chain: Any, size: int, sign: int, x: float, y: float, margin: float) -> bool:
    """Whether (x, y) lies more than ``margin`` on the inner side of every edge of the chain."""
    for i in range(size - 1):
        ax, ay = chain[i, 0], chain[i, 1]
        ex, ey = chain[i + 1, 0] - ax, chain[i + 1, 1] - ay
        cross = sign * (ex * (y - ay) - ey * (x - ax))  # exact in whole and half cells
        if cross >= 0 or -cross <= margin * np.sqrt(float(ex * ex + ey * ey)):
            return False
    return True


@njit(cache=True)
def inside(lo: Any, hi: Any, upper: Any, lower: Any, x: float, y: float, margin: float) -> bool:
    """Whether (x, y) lies strictly inside the hull of the rows' squares, by ``margin``."""
    n_upper, n_lower = envelope(lo, hi, upper, lower)
    if n_upper == 0:
        return False
    first, last = upper[0, 0], upper[n_upper - 1, 0]
    if x - first <= margin or last - x <= margin:
        return False
    return _beyond_chain(upper, n_upper, 1, x, y, margin) and _beyond_chain(
        lower, n_lower, -1, x, y, margin
    )


@njit(cache=True)
def _middle_inside(lo: Any, hi: Any, d: int) -> bool:
    """:func:`inside` for the window's middle and no margin, without building the hull.

    Seen from the middle, the hull passes above it iff the steepest rise to a corner on its left
    and the steepest to one on its right add up to more than 0 (or a corner stands right above);
    likewise below. In half cells all numbers are whole, so fractions are compared exactly.
    """
    w = lo.size
    for side in range(2):
        left_rise, left_run, right_rise, right_run = 0, 0, 0, 0
        passes = False
        for row in range(w):
            if hi[row] < lo[row]:
                continue
            rise = 2 * hi[row] + 2 - d if side == 0 else d - 2 * lo[row]
            for x in (2 * row - w, 2 * row + 2 - w):
                if x < 0:
                    if left_run == 0 or rise * left_run > left_rise * -x:
                        left_rise, left_run = rise, -x
                elif x > 0:
                    if right_run == 0 or rise * right_run > right_rise * x:
                        right_rise, right_run = rise, x
                elif rise > 0:
                    passes = True
        if left_run == 0 or right_run == 0:
            return False
        if not passes and left_rise * right_run + right_rise * left_run <= 0:
            return False
    return True


@njit(cache=True)
def _mark_neighbours(levels: Any, top: int, following: Any, preceding: Any) -> None:
    """For every cell of [W, D] the nearest one of level ``top`` from it on, and up to it."""
    depth = levels.shape[1]
    for x in range(levels.shape[0]):
        last = -1
        for y in range(depth):
            if levels[x, y] == top:
                last = y
            preceding[x, y] = last
        last = depth
        for y in range(depth - 1, -1, -1):
            if levels[x, y] == top:
                last = y
            following[x, y] = last


@njit(cache=True)
def _solve_undecided(
    codes: Any, best: Any, levels: Any, w: int, d: int, x: float, y: float, margin: float,
    scratch: Any, out: Any,
) -> None:  # fmt: skip
    """Write the verdict of every UNDECIDED window of a map.

    Args:
        codes, best: [W · D], the windows' codes and largest K. levels: [W, D], K.
        w, d: the windows' size. x, y: the centre of mass in them. scratch: int64 [3, 2W + 2, 2].
        out: uint8 [W, D], written at the undecided positions.
    """
    width, depth = levels.shape
    lo, hi = scratch[0, :w, 0], scratch[0, :w, 1]
    upper, lower = scratch[1], scratch[2]
    middle = margin == 0.0 and 2 * x == w and 2 * y == d
    # Large windows come in clusters over the same level: mark its cells once, then look up.
    marks = np.empty((2, width, depth) if w * d > 64 else (2, 0, 0), np.int16)
    following, preceding = marks[0], marks[1]
    marked = -1
    for position in range((width - w) * depth + depth - d + 1):
        if codes[position] != UNDECIDED:
            continue
        cx, cy = position // depth, position % depth
        top = best[position]
        if w * d > 64:
            if marked != top:
                _mark_neighbours(levels, top, following, preceding)
                marked = top
            for i in range(w):
                lo[i] = following[cx + i, cy] - cy
                hi[i] = preceding[cx + i, cy + d - 1] - cy
        else:
            for i in range(w):
                row = levels[cx + i, cy : cy + d]
                first, last = d, -1
                for j in range(d):
                    if row[j] == top:
                        first = min(first, j)
                        last = j
                lo[i], hi[i] = first, last
        if middle:
            out[cx, cy] = _middle_inside(lo, hi, d)
        else:
            out[cx, cy] = inside(lo, hi, upper, lower, x, y, margin)


@njit(cache=True)
def _twins(sides: Any) -> Any:
    """For each candidate [N, A, 3] an earlier one of its bin with its sides, or -1; [N · A]."""
    n, ways = sides.shape[:2]
    twin = np.full(n * ways, -1, np.int64)
    for b in range(n):
        for a in range(1, ways):
            for e in range(a):
                if (
                    sides[b, a, 0] == sides[b, e, 0]
                    and sides[b, a, 1] == sides[b, e, 1]
                    and sides[b, a, 2] == sides[b, e, 2]
                ):
                    twin[b * ways + a] = b * ways + e
                    break
    return twin


@njit(cache=True)
def _runs(sides: Any, twin: Any, shape: tuple[int, int], height: int, size: int) -> tuple[Any, Any]:
    """Order the masks so that equal footprints follow each other, and cut the order into runs.

    Returns:
        The order (indices into N · A, those that do not fit into the bin or have a twin left out)
        and the limits of the runs in it: at most ``size`` masks each, one footprint a run.
    """
    masks = sides.shape[0]
    key = np.empty(masks, np.int64)
    widest, deepest = 0, 0
    for i in range(masks):
        w, d, h = sides[i, 0], sides[i, 1], sides[i, 2]
        fits = 0 < w <= shape[0] and 0 < d <= shape[1] and 0 < h <= height
        fits = fits and twin[i] < 0
        key[i] = w * (shape[1] + 1) + d if fits else -1
        if fits:
            widest, deepest = max(widest, w), max(deepest, d)
    order = np.empty(masks, np.int64)
    kept = 0
    if size == 1:
        for i in range(masks):
            if key[i] >= 0:
                order[kept] = i
                kept += 1
        return order[:kept], np.arange(kept + 1)
    start = np.zeros(widest * (shape[1] + 1) + deepest + 2, np.int64)
    for i in range(masks):
        if key[i] >= 0:
            start[key[i] + 1] += 1
    limits = [0]
    for k in range(start.size - 1):
        for cut in range(start[k] + size, start[k] + start[k + 1], size):
            limits.append(cut)
        start[k + 1] += start[k]
        if start[k + 1] > limits[-1]:
            limits.append(start[k + 1])
    for i in range(masks):
        if key[i] >= 0:
            order[start[key[i]]] = i
            start[key[i]] += 1
            kept += 1
    return order[:kept], np.array(limits)


@njit(cache=True)
def fill_levels(heights: Any, hollow: Any, levels: Any) -> None:
    """K of every column, from flat maps."""
    for i in range(levels.size):
        levels[i] = 2 * heights[i] + (1 if hollow[i] == 0 else 0)


@njit(cache=True)
def _load(levels: Any, top: int, valid: Any, window: Any, tops: Any, codes: Any) -> None:
    """Put one mask's map, height limit and valid positions into a run (slices copy slowly)."""
    for i in range(levels.size):
        window[i] = levels[i]
        tops[i] = top
        codes[i] = valid[i]


@njit(cache=True)
def _copy(values: Any, out: Any) -> None:
    for i in range(out.size):
        out[i] = values[i]


@njit(cache=True)
def _write_mask(codes: Any, out: Any) -> bool:
    """Write the YES of ``codes`` to ``out``; tell whether any is UNDECIDED."""
    seen = np.uint8(0)
    for i in range(out.size):
        seen |= codes[i] & UNDECIDED
        out[i] = codes[i] >> 1
    return seen != 0


@njit(cache=True, nogil=True)
def hull_mask(
    heightmap: Any, hollow: Any, sides: Any, height: int, levels: Any, out: Any, best_level: Any
) -> None:
    """Masks of boxes with central mass and no margin; see :func:`hull_mask_general`.

    Args:
        heightmap: int16 [N, W, D].
        hollow: int16 [N, W, D]; only columns where it is 0 count as support.
        sides: int16 [N, A, 3]; a candidate with a zero side gets an empty mask.
        height: H, at most 16383 cells (126 where ``levels`` is uint8).
        levels: uint8 or int16 [N, W, D], scratch.
        out: uint8 [N, A, W, D], written: 1 where the candidate fits and stands.
        best_level: as ``levels`` [N, A, W, D], written where ``out`` is 1: K under the candidate;
            without entries if nobody wants to know.
    """
    n, width, depth = heightmap.shape
    ways = sides.shape[1]
    cells = width * depth
    flat_sides = sides.reshape(n * ways, 3)
    flat_out = out.reshape(n * ways, cells)
    flat_levels = levels.reshape(n, cells)
    fill_levels(heightmap.reshape(n * cells), hollow.reshape(n * cells), levels.reshape(n * cells))

    size = max(1, RUN_CELLS // cells)
    twin = _twins(sides)
    order, limits = _runs(flat_sides, twin, (width, depth), height, size)
    gathered = np.empty((3, size * cells), levels.dtype)
    tops = np.empty(size * cells, levels.dtype)
    codes = np.empty((size, cells), np.uint8)
    valid = np.empty(cells, np.uint8)
    scratch = np.empty((3, 2 * width + 2, 2), np.int64)
    for i in range(n * ways):
        if not (0 < flat_sides[i, 0] <= width and 0 < flat_sides[i, 1] <= depth
                and 0 < flat_sides[i, 2] <= height):  # fmt: skip
            flat_out[i] = 0
    marked = (0, 0)
    for run in range(limits.size - 1):
        batch = order[limits[run] : limits[run + 1]]
        w, d = flat_sides[batch[0], 0], flat_sides[batch[0], 1]
        total = batch.size * cells
        if size == 1:
            window = flat_levels[batch[0] // ways]
            tops[:] = 2 * (height - flat_sides[batch[0], 2]) + 1
            mark_valid(codes[0], width, depth, w, d)
        else:
            window = gathered[0, :total]
            if marked != (w, d):
                mark_valid(valid, width, depth, w, d)
                marked = (w, d)
            for j in range(batch.size):
                part = slice(j * cells, (j + 1) * cells)
                top = 2 * (height - flat_sides[batch[j], 2]) + 1
                _load(flat_levels[batch[j] // ways], top, valid, window[part], tops[part], codes[j])
        half_w, half_d = (w + 1) // 2, (d + 1) // 2
        best = slide(window, gathered[1], gathered[2], depth, half_w, half_d)
        m = total - (w - 1) * depth - (d - 1)
        sx, sy = (w - half_w) * depth, d - half_d
        flat_codes = codes.reshape(size * cells)
        _decide(
            best[:m], best[sy : sy + m], best[sx : sx + m], best[sx + sy : sx + sy + m],
            tops[:m], flat_codes[:m],
        )  # fmt: skip
        flat_codes[m:total] = 0
        for j in range(batch.size):
            i = batch[j]
            if _write_mask(codes[j], flat_out[i]):
                _solve_undecided(
                    codes[j], tops[j * cells : (j + 1) * cells], levels[i // ways], w, d, w / 2,
                    d / 2, 0.0, scratch, out[i // ways, i % ways],
                )  # fmt: skip
            if best_level.size:
                own = tops[j * cells : (j + 1) * cells]
                _copy(own, best_level[i // ways, i % ways].reshape(cells))
    for i in range(n * ways):
        if twin[i] >= 0:
            _copy(flat_out[twin[i]], flat_out[i])
            if best_level.size:
                own = best_level[twin[i] // ways, twin[i] % ways].reshape(cells)
                _copy(own, best_level[i // ways, i % ways].reshape(cells))


@njit(cache=True, nogil=True)
def hull_mask_general(
    heightmap: Any, hollow: Any, sides: Any, com: Any, margin: float, height: int, levels: Any,
    out: Any,
) -> None:  # fmt: skip
    """Masks for any centre of mass and safety margin.

    Halves and quadrants now begin ``margin`` away from the centre of mass. Contact reaching into
    all four quadrants puts the square of half-width ``margin`` around it, and so the disc, inside
    the hull; none in one of the four halves leaves a side of the hull within ``margin`` of it.

    Args:
        com: float64 [N, A, 2], centre of mass from the window's low corner.
        margin: cells by which the support polygon is shrunk, ≥ 0.
        heightmap, hollow, sides, height, levels, out: as in :func:`hull_mask`.
    """
    n, width, depth = heightmap.shape
    cells = width * depth
    fill_levels(heightmap.reshape(n * cells), hollow.reshape(n * cells), levels.reshape(n * cells))
    buffers = np.empty((2, cells), levels.dtype)
    whole = np.empty(cells, levels.dtype)
    codes = np.empty(cells, np.uint8)
    scratch = np.empty((3, 2 * width + 2, 2), np.int64)
    for b in range(n):
        plane = levels[b].reshape(cells)
        for a in range(sides.shape[1]):
            w, d, h = sides[b, a, 0], sides[b, a, 1], sides[b, a, 2]
            x, y = com[b, a, 0], com[b, a, 1]
            low_w, low_d = int(np.ceil(x - margin)), int(np.ceil(y - margin))
            high_w, high_d = w - int(np.floor(x + margin)), d - int(np.floor(y + margin))
            plane_out = out[b, a].reshape(cells)
            fits = 0 < w <= width and 0 < d <= depth and 0 < h <= height
            if not fits or min(low_w, low_d, high_w, high_d) <= 0:
                plane_out[:] = 0
                continue
            mark_valid(codes, width, depth, w, d)
            m = (width - w) * depth + depth - d + 1
            best = slide(plane, buffers[0], buffers[1], depth, w, d)
            whole[:m] = best[:m]
            for i in range(m):
                if whole[i] & 1 == 0 or whole[i] > 2 * (height - h) + 1:
                    codes[i] = 0
            for part in range(8):
                # Four halves of the window keep it UNDECIDED, its four quadrants make it a YES.
                left, right = part in (0, 4, 5), part in (1, 6, 7)
                front, back = part in (2, 4, 6), part in (3, 5, 7)
                pw = low_w if left else (high_w if right else w)
                pd = low_d if front else (high_d if back else d)
                shift = (w - pw if right else 0) * depth + (d - pd if back else 0)
                best = slide(plane, buffers[0], buffers[1], depth, pw, pd)[shift:]
                lost = 0 if part < 4 else UNDECIDED
                for i in range(m):
                    if best[i] != whole[i]:
                        codes[i] &= lost
            for i in range(m):
                codes[i] = YES if codes[i] & YES else codes[i]
            if _write_mask(codes, plane_out):
                _solve_undecided(codes, whole, levels[b], w, d, x, y, margin, scratch, out[b, a])


def level_dtype(height: int) -> type[np.generic]:
    """The smallest type that holds 2 · height + 1."""
    return np.uint8 if height <= 126 else np.int16


def support_mask(
    heightmap: NDArray[np.int16],
    hollow: NDArray[np.int16],
    sides: NDArray[np.int16],
    height: int,
    com: NDArray[np.float64] | None = None,
    margin: float = 0.0,
) -> NDArray[np.bool_]:
    """Bool [N, A, W, D]: where each candidate fits and its centre of mass is supported.

    Args:
        heightmap: int16 [N, W, D].
        hollow: int16 [N, W, D]; only columns where it is 0 count as support.
        sides: int16 [N, A, 3].
        height: H.
        com: float64 [N, A, 2] from the window's low corner; the middle by default.
        margin: cells by which the support polygon is shrunk.
    """
    n, width, depth = heightmap.shape
    heightmap, hollow = np.ascontiguousarray(heightmap), np.ascontiguousarray(hollow)
    sides = np.ascontiguousarray(sides)
    out = np.empty((n, sides.shape[1], width, depth), np.uint8)
    levels = np.empty(heightmap.shape, level_dtype(height))
    if com is None and margin == 0:
        nobody = np.empty((0, 0, 0, 0), levels.dtype)
        hull_mask(heightmap, hollow, sides, height, levels, out, nobody)
    else:
        middle = np.ascontiguousarray(sides[..., :2] / 2 if com is None else com)
        hull_mask_general(heightmap, hollow, sides, middle, margin, height, levels, out)
    return out.view(np.bool_)
