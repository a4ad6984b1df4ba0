"""The state of bins in whole units of length: the table of boxes, and what follows from it.

Shapes use the letters B (bins), C (boxes that a bin has memory for) and R (rows of carrying parts).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from marl_pack.exact.limits import CARRIES, EQUILIBRIUM, HULL_ALPHA, LBCP, ROW, Limits
from marl_pack.exact.rules import carrying_part, find_contacts, make_scratch, shared
from marl_pack.installation import njit

ROUNDING = 1e-12
"""By this share a sum of weights may exceed a limit: 0.1 + 0.2 is not above 0.3."""
PART_ROWS = 6
"""Rows of carrying parts for each box that bins begin with; they get more when they need it."""


class State(NamedTuple):
    """Arrays of B bins, as compiled code reads them."""

    boxes: Any  # int32 [B, C, 10]    rows in order of placement (marl_pack.exact.limits.ROW)
    count: Any  # int64 [B]           number of boxes
    weights: Any  # float64 [B, C]    weight of each box; an assumed one where it is unknown
    known: Any  # bool [B, C]         whether the weight is known
    stackable: Any  # bool [B, C]     whether anything may rest on the box
    max_load: Any  # float64 [B, C]   largest weight of all boxes above it
    carried: Any  # float64 [B, C]    weights of all boxes above it; inf if one is unknown
    below: Any  # uint64 [B, C, ⌈C / 64⌉]  bits of all boxes that carry a box, through every contact
    grounded: (
        Any  # bool [B, C]      everything under it is filled, and what it rests on is grounded
    )
    starts: Any  # int64 [B, C + 1]   first row of each box's carrying part
    parts: Any  # int32 [B, R, 4]     carrying parts (marl_pack.exact.rules.gather)

    def at(self, index: Any) -> State:
        """Return copies of the arrays of the bins ``index``: numbers, a slice or bool [B]."""
        return State(*(np.array(array[index]) for array in self))


def empty_state(bins: int, capacity: int, keeps_parts: bool) -> State:
    """Return the state of empty bins.

    Args:
        bins: B.
        capacity: C.
        keeps_parts: whether the rule needs carrying parts.
    """
    b, c = bins, capacity
    rows = PART_ROWS * c if keeps_parts else 0
    return State(
        np.zeros((b, c, ROW), np.int32), np.zeros(b, np.int64), np.zeros((b, c)),
        np.zeros((b, c), np.bool_), np.ones((b, c), np.bool_), np.full((b, c), np.inf),
        np.zeros((b, c)), np.zeros((b, c, (c + 63) // 64), np.uint64), np.zeros((b, c), np.bool_),
        np.zeros((b, c + 1), np.int64), np.zeros((b, rows, 4), np.int32),
    )  # fmt: skip


def keeps_parts(rule: int) -> bool:
    """Return whether a rule needs the carrying parts of the boxes' tops."""
    return rule in (HULL_ALPHA, LBCP, EQUILIBRIUM)


@njit(cache=True)
def add_box(
    limits: Limits, state: State, b: int, new: Any, weight: float, known: bool, stackable: bool,
    max_load: float,
) -> int:  # fmt: skip
    """Place one box in bin ``b``; the bin needs memory for it.

    Args:
        limits: the rule, and its level tolerance.
        state: the bins, changed in place.
        b: number of the bin.
        new: whole numbers [10], the row of the box.
        weight, known, stackable, max_load: as in :class:`State`.

    Returns:
        0; or, with nothing changed, the number of rows of carrying parts that the bin needs.
    """
    boxes, n, starts, parts = state.boxes[b], state.count[b], state.starts[b], state.parts[b]
    scratch = make_scratch(n, starts[n])
    z, x, y = new[2], new[CARRIES], new[CARRIES + 1]
    w, d = new[CARRIES + 2] - x, new[CARRIES + 3] - y
    k = find_contacts(boxes, n, x, y, z, w, d, limits.tolerance, scratch.touching)
    rows = np.empty((scratch.points.shape[0], 4), np.int64)
    size = carrying_part(limits.rule, boxes, starts, parts, scratch, k, new, rows)
    needed = starts[n] + size
    if needed > parts.shape[0]:
        return needed
    width = 2 if limits.rule == LBCP else 4
    parts[starts[n] : needed, :width] = rows[:size, :width]
    starts[n + 1] = needed
    for i in range(ROW):
        boxes[n, i] = new[i]
    grounded = limits.rule in (HULL_ALPHA, EQUILIBRIUM) and size == 1 and (
        rows[0, 2] - rows[0, 0]) * (rows[0, 3] - rows[0, 1]) == w * d  # fmt: skip
    below = state.below[b]
    below[n] = 0
    for t in range(k):
        grounded &= state.grounded[b, scratch.touching[t]]
    for j in range(n):  # in the space of rotated boxes, not only where they carry
        x0, y0, x1, y1 = shared(boxes, j, new[0], new[1], new[3], new[4])
        touches = x0 < x1 and y0 < y1 and 0 <= z - boxes[j, 2] - boxes[j, 5] <= limits.tolerance
        if touches:
            below[n] |= below[j]
            below[n, j // 64] |= np.uint64(1) << np.uint64(j % 64)
    for j in range(n):
        if (below[n, j // 64] >> np.uint64(j % 64)) & np.uint64(1):
            state.carried[b, j] += weight if known else np.inf
    state.weights[b, n], state.known[b, n] = weight, known
    state.stackable[b, n], state.max_load[b, n] = stackable, max_load
    state.carried[b, n], state.grounded[b, n] = 0.0, grounded
    state.count[b] = n + 1
    return 0


@njit(cache=True)
def blocked_boxes(state: State, b: int, weight: float, known: bool, blocked: Any) -> None:
    """Find the boxes of bin ``b`` on which an item may not rest, by the limits of goods.

    An item may not rest on a box that is not stackable. It may not rest where it would add to the
    load of a box that cannot carry it, however far below. An item of unknown weight may not add to
    the load of any box that has a limit.

    Args:
        state: the bins.
        b: number of the bin.
        weight: the item's weight.
        known: whether the weight is known.
        blocked: bool [C], written.
    """
    n = state.count[b]
    for j in range(n):
        blocked[j] = not state.stackable[b, j] or overloaded(
            state.carried[b, j], weight, known, state.max_load[b, j]
        )
        for i in range(j):  # the limits of all boxes below j hold for whatever rests on j
            carries = (state.below[b, j, i // 64] >> np.uint64(i % 64)) & np.uint64(1)
            if carries and overloaded(state.carried[b, i], weight, known, state.max_load[b, i]):
                blocked[j] = True


@njit(cache=True, inline="always")
def overloaded(carried: float, weight: float, known: bool, limit: float) -> bool:
    """Return whether a box that carries a weight may not carry one more."""
    return limit < np.inf and (not known or carried + weight > limit * (1 + ROUNDING))
