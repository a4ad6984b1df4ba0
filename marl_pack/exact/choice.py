"""Choose the best move by a score, and test the stability only of moves that may be the best."""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_pack.exact.features import (
    ALONG_X,
    ALONG_Y,
    BOTTOM,
    FEATURES,
    FOOTPRINT,
    GAP_X,
    GAP_Y,
    HEIGHT,
    LEVEL,
    REST,
    SIDES,
    TOP,
    WALLS,
    WASTE,
    describe,
    describe_contacts,
    describe_place,
    describe_waste,
    enclosed_below,
    make_columns,
)
from marl_pack.exact.limits import Limits
from marl_pack.exact.moves import AXES, by_top, candidates, decode, stands
from marl_pack.exact.rules import NO, make_scratch
from marl_pack.installation import njit

LINEAR, DBLF, HEIGHT_MIN, BEST_FIT, ANY = range(5)
"""Scores of moves: a weighted sum of features; keys as in :mod:`marl_pack.agents.keys`; or none, to
find any legal move."""
N_FEATURES = len(FEATURES)
FIRST = 4
"""Moves of the linear score that are evaluated in the order of their bounds."""
ROUNDING = 1e-9
"""More than a sum of features can be wrong by rounding."""


@njit(cache=True, inline="always")
def most(weights: Any, limits: Limits, size: Any, item: Any, move: int, faces: int) -> float:
    """Return a linear score that a move does not exceed, in a time that does not grow with n.

    Features of the place and of the walls are exact. A face touches at most with its whole area,
    and not at all if no edge is beside it.

    Args:
        weights: float64 [F].
        limits, size, item, move: as for :func:`marl_pack.exact.features.describe`.
        faces: the faces that may touch others (:func:`marl_pack.exact.moves.candidates`).
    """
    W, D, H = size[0], size[1], size[2]
    near = limits.clearance
    o, x, y, z = decode(move)
    w, d, h = item[AXES[o, 0]], item[AXES[o, 1]], item[AXES[o, 2]]
    total = weights[REST] * z / H + weights[TOP] * (z + h) / H
    total += weights[ALONG_X] * min(2 * x + w, 2 * (W - x) - w) / (2.0 * W)
    total += weights[ALONG_Y] * min(2 * y + d, 2 * (D - y) - d) / (2.0 * D)
    footprint = float(w) * d
    total += weights[FOOTPRINT] * footprint / (float(W) * D) + weights[HEIGHT] * h / H
    surface = 2.0 * (footprint + float(w) * h + float(d) * h)
    if z == 0:
        total += weights[BOTTOM] * footprint / surface
    else:
        total += max(0.0, weights[BOTTOM]) * footprint / surface
        total += max(0.0, weights[WASTE]) * z / H
    walls = float(d) * h * (int(x <= near) + int(x + w >= W - near))
    walls += float(w) * h * (int(y <= near) + int(y + d >= D - near))
    total += weights[WALLS] * walls / surface
    along_x, along_y = (faces & 1) + (faces >> 1 & 1), (faces >> 2 & 1) + (faces >> 3 & 1)
    length = float(along_x * d + along_y * w)
    total += max(0.0, weights[SIDES]) * length * h / surface
    total += max(0.0, weights[LEVEL]) * length / (2.0 * (w + d))
    return total + max(0.0, weights[GAP_X]) + max(0.0, weights[GAP_Y])


@njit(cache=True, inline="always")
def most_waste(limits: Limits, size: Any, item: Any, move: int, bottom: float) -> float:
    """Return the feature ``waste`` if nothing lay under the part of a box that touches nothing.

    Args:
        limits, size, item, move: as for :func:`marl_pack.exact.features.describe`.
        bottom: the feature ``bottom``.
    """
    o, _, _, z = decode(move)
    w, d, h = item[AXES[o, 0]], item[AXES[o, 1]], item[AXES[o, 2]]
    touching = bottom * 2.0 * (float(w) * d + float(w) * h + float(d) * h) / (float(w) * d)
    return ((1.0 - touching) * z + touching * min(z, limits.tolerance)) / size[2] + ROUNDING


@njit(cache=True)
def linear_score(
    weights: Any, limits: Limits, size: Any, boxes: Any, n: int, item: Any, move: int,
    columns: Any, features: Any, needed: float,
) -> float:  # fmt: skip
    """Return the weighted sum of a move's features; -inf as soon as it must be below ``needed``.

    The arguments are those of :func:`score`.
    """
    describe_place(size, item, move, features)
    describe_contacts(limits, size, boxes, n, item, move, features)
    features[WASTE] = 0.0
    if weights[WASTE] != 0.0:
        known = max(0.0, weights[WASTE]) * most_waste(limits, size, item, move, features[BOTTOM])
        for f in range(weights.size):
            known += weights[f] * features[f]
        if known < needed - ROUNDING:
            return -np.inf
        describe_waste(size, boxes, n, item, move, columns, features)
    total = 0.0
    for f in range(weights.size):
        total += weights[f] * features[f]
    return total


@njit(cache=True)
def score(
    kind: int, weights: Any, limits: Limits, size: Any, boxes: Any, n: int, item: Any, move: int,
    columns: Any, features: Any, needed: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the score of a move as three keys; the highest first key is the best.

    Args:
        kind: LINEAR, DBLF, HEIGHT_MIN, BEST_FIT; ANY only for :func:`best_move`.
        weights: float64 [F], of the features; only for LINEAR.
        limits, size, boxes, n, item, move, columns: as for
            :func:`marl_pack.exact.features.describe`.
        features: float64 [F], memory.
        needed: the first key that a better move needs; a lower key may be returned as -inf.
    """
    if kind == LINEAR:
        total = linear_score(
            weights, limits, size, boxes, n, item, move, columns, features, needed
        )  # fmt: skip
        return total, 0.0, 0.0
    if kind == DBLF:
        return 0.0, 0.0, 0.0  # the order of the moves
    o, x, y, z = decode(move)
    w, d, h = item[AXES[o, 0]], item[AXES[o, 1]], item[AXES[o, 2]]
    waste = enclosed_below(boxes, n, x, y, z, w, d, columns)
    if kind == HEIGHT_MIN:
        return -waste, -float(x + y), 0.0
    return -waste, -float(z + h), -float(x + y)


@njit(cache=True)
def describe_all(limits: Limits, size: Any, boxes: Any, n: int, item: Any, moves: Any) -> Any:
    """Return the features of listed moves, int64 [M], as float64 [M, F]."""
    columns, features = make_columns(n), np.empty((moves.size, N_FEATURES))
    high_first = by_top(boxes, n)
    for m in range(moves.size):
        describe(limits, size, high_first, n, item, moves[m], columns, features[m])
    return features


@njit(cache=True)
def waste_of(boxes: Any, n: int, item: Any, move: int) -> float:
    """Return the space that an item newly encloses below itself at a move, in cubic units."""
    o, x, y, z = decode(move)
    columns = make_columns(n)
    return enclosed_below(boxes, n, x, y, z, item[AXES[o, 0]], item[AXES[o, 1]], columns)


@njit(cache=True, inline="always")
def better(
    new: tuple[float, float, float], move: int, keys: tuple[float, float, float], best: int
) -> bool:
    """Return whether a move with the keys ``new`` is better than the best, or as good and first."""
    if best < 0:
        return True
    for k in range(3):
        if new[k] != keys[k]:
            return new[k] > keys[k]
    return move < best


@njit(cache=True)
def best_move(
    kind: int, weights: Any, limits: Limits, size: Any, boxes: Any, n: int, starts: Any, parts: Any,
    blocked: Any, item: Any, allowed: Any, out: Any,
) -> tuple[int, int]:  # fmt: skip
    """Choose the best move of one box in one bin; of equal moves the first one.

    Args:
        kind, weights: as for :func:`score`.
        limits, size, boxes, n, starts, parts, blocked, item, allowed: as for
            :func:`marl_pack.exact.moves.list_moves`.
        out: int64 [M], memory for the candidates.

    Returns:
        The number of candidates, and the best move; -1 if no candidate stands. If ``out`` has no
        room, minus the room needed.
    """
    faces = np.empty(out.size if kind == LINEAR else 0, np.uint8)
    high_first = by_top(boxes, n)
    fitting = candidates(limits, size, high_first, n, item, allowed, out, faces)
    if fitting > out.size:
        return -fitting, -1
    scratch = make_scratch(n, starts[n])
    columns, features = make_columns(n), np.empty(N_FEATURES)
    best, keys = -1, (-np.inf, -np.inf, -np.inf)
    bounds = np.empty(fitting if kind == LINEAR else 0)
    for m in range(bounds.size):
        bounds[m] = most(weights, limits, size, item, out[m], faces[m])
    # The most promising moves first: a good score spares the evaluation of many others.
    first = min(FIRST, bounds.size)
    for k in range(first + fitting):
        m = int(bounds.argmax()) if k < first else k - first
        if kind == ANY and best >= 0:
            break
        if kind == LINEAR:
            if bounds[m] < keys[0] - ROUNDING:
                continue
            bounds[m] = -np.inf  # evaluated
        new = keys
        if kind != ANY:
            new = score(
                kind, weights, limits, size, high_first, n, item, out[m], columns, features,
                keys[0],
            )  # fmt: skip
        if better(new, out[m], keys, best) and (
            stands(limits, boxes, n, starts, parts, blocked, item, scratch, out[m]) != NO
        ):
            best, keys = out[m], new
    return fitting, best


@njit(cache=True)
def best_of(
    kind: int, weights: Any, limits: Limits, size: Any, boxes: Any, n: int, item: Any, moves: Any
) -> int:
    """Choose the best of listed moves, int64 [M], like :func:`best_move`; -1 if there is none."""
    columns, features = make_columns(n), np.empty(N_FEATURES)
    high_first = by_top(boxes, n)
    best, keys = -1, (-np.inf, -np.inf, -np.inf)
    for m in range(moves.size):
        new = score(
            kind, weights, limits, size, high_first, n, item, moves[m], columns, features, keys[0]
        )  # fmt: skip
        if better(new, moves[m], keys, best):
            best, keys = moves[m], new
    return best
