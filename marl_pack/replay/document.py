"""What the replay page shows of a plan, as plain values for JSON."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.plan import Plan
from marl_pack.render.colours import COLOURINGS, PALETTE, SCALE, UNKNOWN, colour_plan

ROUNDING = 1e-6
"""Share of a bin's height by which faces that touch may differ."""


def make_document(plan: Plan, title: str = "") -> dict[str, Any]:
    """Return what the replay page shows of a plan.

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
    content = plan.to_dict()
    supporters, shares = contacts(plan)
    for box, below, share in zip(content["boxes"], supporters, shares.tolist(), strict=True):
        box["rests_on"] = below
        box.setdefault("support", share)
    colourings = {by: colour_plan(plan, by) for by in COLOURINGS}
    colours = {by: asdict(of) for by, of in colourings.items() if of is not None}
    return {
        "title": title, "unit": unit_name(plan.unit_mm), "palette": PALETTE, "scale": SCALE,
        "unknown": UNKNOWN, "colours": colours, **content,
    }  # fmt: skip


def unit_name(unit_mm: float | None) -> str:
    """Return the name of a plan's unit of length: ``cells``, ``mm``, or ``× 10 mm``."""
    if unit_mm is None:
        return "cells"
    return "mm" if unit_mm == 1 else f"× {unit_mm:g} mm"


def contacts(plan: Plan) -> tuple[list[list[int]], NDArray[np.float64]]:
    """Find the boxes that each box rests on.

    Boxes with a yaw count as the rectangles that they were before it.

    Returns:
        For each box the numbers of the boxes that it touches from above, in order; and float64 [n],
        the share of its footprint that touches these boxes or the floor.
    """
    low, high = plan.positions, plan.positions + plan.sides
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
        supporters.append(np.flatnonzero(touching).tolist())
        footprint = float(plan.sides[i, 0]) * float(plan.sides[i, 1])
        shares[i] = min(1.0, float(area[touching].sum()) / footprint)
    return supporters, shares
