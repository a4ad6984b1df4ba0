"""Measure how a box is supported: the share of its footprint, and its margin."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_pack.exact import balance
from marl_pack.exact.bins import ExactBins
from marl_pack.exact.limits import AREA_RATIO, CARRIES, EQUILIBRIUM, HULL_1, NONE, SCALE, Limits
from marl_pack.exact.moves import encode, rests_on_blocked
from marl_pack.exact.polygons import convex_hull
from marl_pack.exact.rules import (
    NO,
    OPEN,
    YES,
    carried_by,
    find_contacts,
    gather,
    make_scratch,
    verdict,
)
from marl_pack.installation import njit


class Support(NamedTuple):
    """How a box is supported from below."""

    share: float  # of its footprint that rests on the floor or on boxes, 0 … 1
    margin: float  # distance of the centre of mass from the edge of its support, units; < 0:
    # beyond it; NaN: nothing carries
    stands: bool  # whether the rule allows it there, with its margin


@njit(cache=True)
def _measure(
    limits: Limits, boxes: Any, n: int, starts: Any, parts: Any, blocked: Any, rule: int, row: Any
) -> tuple[float, float, int]:
    """Return share and margin (in lattice points) of a row that is not in the bin, and the verdict.

    The arguments are those of :func:`marl_pack.exact.rules.gather`; ``rule`` says whose support
    polygon is measured, ``blocked`` bool [C] on which boxes the row may not rest.
    """
    z, x, y = row[2], row[CARRIES], row[CARRIES + 1]
    w, d = row[CARRIES + 2] - x, row[CARRIES + 3] - y
    if w <= 0 or d <= 0:  # a thin box that was rotated
        return (1.0 if z == 0 else 0.0), np.nan, NO
    scratch = make_scratch(n, starts[n])
    k = 0
    if z > 0:
        k = find_contacts(boxes, n, x, y, z, w, d, limits.tolerance, scratch.touching)
    answer = verdict(limits, boxes, starts, parts, scratch, k, x, y, z, w, d)
    if z == 0:
        return 1.0, SCALE * min(w, d) / 2.0, answer
    area = 0.0
    for t in range(k):
        x0, y0, x1, y1 = carried_by(boxes, scratch.touching[t], x, y, w, d)
        area += float(x1 - x0) * (y1 - y0)
    if rests_on_blocked(limits, boxes, n, blocked, row[0], row[1], z, row[3], row[4]):
        answer = NO
    size, _ = gather(rule, boxes, starts, parts, scratch, k, x, y, w, d)
    corners = convex_hull(scratch.points, size, scratch.hull)
    if corners < 3:
        return area / (float(w) * d), np.nan, answer
    margin = np.inf
    middle_x, middle_y = SCALE * (x + w / 2.0), SCALE * (y + d / 2.0)
    for i in range(corners):
        ax, ay = scratch.hull[i]
        bx, by = scratch.hull[(i + 1) % corners]
        along_x, along_y = float(bx - ax), float(by - ay)
        cross = along_x * (middle_y - ay) - along_y * (middle_x - ax)
        margin = min(margin, cross / math.sqrt(along_x**2 + along_y**2))
    return area / (float(w) * d), margin, answer


def measure(
    bins: ExactBins, row: NDArray[np.int64], weight: float, blocked: NDArray[np.bool_]
) -> Support:
    """Measure the support of a box that is about to be placed in the only bin.

    The support polygon is that of the rule; for rules without one, and for ``equilibrium``, it is
    that of ``hull_1``.

    Args:
        bins: one bin.
        row: int64 [10], the box (:data:`marl_pack.exact.limits.ROW`).
        weight: its weight.
        blocked: bool [C], the boxes on which it may not rest.
    """
    state, limits = bins.state, bins.limits
    plain = limits.rule in (NONE, AREA_RATIO, EQUILIBRIUM)
    share, margin, answer = _measure(
        limits, state.boxes[0], int(state.count[0]), state.starts[0], state.parts[0], blocked,
        HULL_1 if plain else limits.rule, row,
    )  # fmt: skip
    stands = answer == YES
    if answer == OPEN:
        x, y, x1, y1 = (int(value) for value in row[CARRIES:])
        sides = np.array((x1 - x, y1 - y, row[5]), np.int64)
        move = encode(0, x, y, int(row[2]))
        stands = balance.in_balance(limits, state, 0, sides, weight, move)
    return Support(min(1.0, share), margin / SCALE, bool(stands))
