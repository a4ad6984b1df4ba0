"""What the replay page shows of a plan, as plain values for JSON."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.geometry.rotated import overlap_area
from marl_pack.plan import Plan
from marl_pack.render.colours import COLOURINGS, PALETTE, SCALE, UNKNOWN, colour_plan

ROUNDING = 1e-6
"""Share of a bin's height by which faces that touch may differ."""


def make_document(plan: Plan, title: str = "") -> dict[str, Any]:
    """Return what the replay page shows of a plan.

    Lengths are in millimetres, or in cells if the plan does not say how long its unit is.

    Args:
        plan: the boxes, in order.
        title: the title of the page.

    Returns:
        The keys of :meth:`marl_pack.plan.Plan.to_dict`, and ``title``, ``unit`` (name of the unit
        of lengths) and in each box ``rests_on`` (numbers of the boxes that it touches from above)
        and ``support`` (share of its footprint that touches what is below). The margin is only
        there if the plan has it, since it depends on the stability rule. ``colours`` has the
        colours of the boxes, by what they show (:mod:`marl_pack.render.colours`).
    """
    plan = in_mm(plan)
    content = plan.to_dict()
    supporters, shares = contacts(plan)
    for box, below, share in zip(content["boxes"], supporters, shares.tolist(), strict=True):
        box["rests_on"] = below
        box.setdefault("support", share)
    colourings = {by: colour_plan(plan, by) for by in COLOURINGS}
    colours = {by: asdict(of) for by, of in colourings.items() if of is not None}
    return {
        "title": title, "unit": "cells" if plan.unit_mm is None else "mm", "palette": PALETTE,
        "scale": SCALE, "unknown": UNKNOWN, "colours": colours, **content,
    }  # fmt: skip


def in_mm(plan: Plan) -> Plan:
    """Return a plan with all lengths in millimetres; one in abstract cells stays as it is."""
    unit = plan.unit_mm
    if unit is None or unit == 1:
        return plan
    left_out = [
        replace(box, sides=(box.sides[0] * unit, box.sides[1] * unit, box.sides[2] * unit))
        for box in plan.left_out
    ]
    return replace(
        plan,
        unit_mm=1.0,
        bin_sizes=plan.bin_sizes * unit,
        positions=plan.positions * unit,
        sides=plan.sides * unit,
        centres=plan.centres * unit,
        margins=plan.margins * unit,
        left_out=tuple(left_out),
        explanations=tuple(
            None if why is None else replace(why, positions=why.positions * unit)
            for why in plan.explanations
        ),
    )


def contacts(plan: Plan) -> tuple[list[list[int]], NDArray[np.float64]]:
    """Find the boxes that each box rests on.

    Returns:
        For each box the numbers of the boxes that it touches from above, in order; and float64 [n],
        the share of its footprint that touches these boxes or the floor.
    """
    low, high = plan.extents
    slack = ROUNDING * plan.bin_sizes[plan.bins, 2]
    supporters: list[list[int]] = []
    shares = np.ones(len(plan))
    for i in range(len(plan)):
        if low[i, 2] <= slack[i]:
            supporters.append([])
            continue
        overlap = np.minimum(high[:, :2], high[i, :2]) - np.maximum(low[:, :2], low[i, :2])
        area = np.clip(overlap, 0, None).astype(np.float64).prod(1)
        touching = (
            (np.abs(high[:, 2] - low[i, 2]) <= slack[i])
            & (area > 0)
            & (plan.bins == plan.bins[i])
            & (np.arange(len(plan)) != i)
        )
        for j in np.flatnonzero(touching & ((plan.yaws != 0) | (plan.yaws[i] != 0))).tolist():
            area[j] = overlap_area(_footprint(plan, i), _footprint(plan, j))
            touching[j] = area[j] > 0
        supporters.append(np.flatnonzero(touching).tolist())
        footprint = float(plan.sides[i, 0]) * float(plan.sides[i, 1])
        shares[i] = min(1.0, float(area[touching].sum()) / footprint)
    return supporters, shares


def _footprint(plan: Plan, i: int) -> tuple[float, float, float, float, float]:
    """Return middle, sides and yaw of a box seen from above."""
    w, d = plan.sides[i, :2].tolist()
    x, y = plan.positions[i, :2].tolist()
    return x + w / 2, y + d / 2, w, d, float(plan.yaws[i])
