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
from marl_pack.exact.moves import AXES, candidates, decode, stands
from marl_pack.exact.rules import NO, make_scratch
from marl_pack.installation import njit

LINEAR, DBLF, HEIGHT_MIN, BEST_FIT, ANY = range(5)
"""Scores of moves: a weighted sum of features; keys as in :mod:`marl_pack.agents.keys`; or none, to
find any legal move."""
N_FEATURES = len(FEATURES)
ROUNDING = 1e-9
"""More than a sum of features can be wrong by rounding."""


@njit(cache=True)
def most_of_the_rest(weights: Any) -> float:
    """Return the most that features of faces and gaps, and of waste, can add to a linear score.

    The shares of the surface add up to at most 1; every other feature is from 0 to 1.
    """
    most = max(0.0, weights[BOTTOM], weights[SIDES], weights[WALLS])
    most += max(0.0, weights[LEVEL]) + max(0.0, weights[GAP_X]) + max(0.0, weights[GAP_Y])
    return most + max(0.0, weights[WASTE])


@njit(cache=True)
def linear_score(
    weights: Any, limits: Limits, size: Any, boxes: Any, n: int, item: Any, move: int,
    columns: Any, features: Any, needed: float,
) -> float:  # fmt: skip
    """Return the weighted sum of a move's features; -inf as soon as it must be below ``needed``.

    The arguments are those of :func:`score`.
    """
    describe_place(size, item, move, features)
    known = weights[REST] * features[REST] + weights[TOP] * features[TOP]
    known += weights[ALONG_X] * features[ALONG_X] + weights[ALONG_Y] * features[ALONG_Y]
    known += weights[FOOTPRINT] * features[FOOTPRINT] + weights[HEIGHT] * features[HEIGHT]
    if known + most_of_the_rest(weights) < needed - ROUNDING:
        return -np.inf
    describe_contacts(limits, size, boxes, n, item, move, features)
    features[WASTE] = 0.0
    if weights[WASTE] != 0.0:
        known = max(0.0, weights[WASTE])
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
    for m in range(moves.size):
        describe(limits, size, boxes, n, item, moves[m], columns, features[m])
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
    fitting = candidates(limits, size, boxes, n, item, allowed, out)
    if fitting > out.size:
        return -fitting, -1
    scratch = make_scratch(n, starts[n])
    columns, features = make_columns(n), np.empty(N_FEATURES)
    best, keys = -1, (-np.inf, -np.inf, -np.inf)
    for m in range(fitting):
        if kind == ANY and best >= 0:
            break
        new = keys
        if kind != ANY:
            new = score(
                kind, weights, limits, size, boxes, n, item, out[m], columns, features, keys[0]
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
    best, keys = -1, (-np.inf, -np.inf, -np.inf)
    for m in range(moves.size):
        new = score(
            kind, weights, limits, size, boxes, n, item, moves[m], columns, features, keys[0]
        )  # fmt: skip
        if better(new, moves[m], keys, best):
            best, keys = moves[m], new
    return best
