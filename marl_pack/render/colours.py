"""Colours of boxes: by item, order, bin, weight or margin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from marl_pack.plan import Plan
from marl_pack.render.choices import COLOURINGS as COLOURINGS

PALETTE: tuple[str, ...] = (
    "#4e79a7", "#f28e2b", "#59a14f", "#e15759", "#76b7b2", "#edc948", "#b07aa1", "#9c755f",
    "#ff9da7", "#a0cbe8", "#ffbe7d", "#8cd17d", "#d4a6c8", "#d7b5a6", "#499894", "#b6992d",
)  # fmt: skip
"""Colours of things that have no order; after the last colour the first one comes again."""
SCALE: tuple[str, ...] = tuple(to_hex(c) for c in colormaps["viridis"](np.linspace(0.2, 1, 9)))
"""Colours from the lowest number to the highest one."""
UNKNOWN = "#9aa1a9"
"""Colour of a box whose value is unknown."""


@dataclass(frozen=True)
class Colouring:
    """The colours of n boxes, and what they mean."""

    boxes: tuple[str, ...]  # [n]  "#rrggbb"
    names: tuple[str, ...] = ()  # what the colours of PALETTE stand for, in order
    range: tuple[float, float] | None = None  # numbers at the ends of SCALE


def on_scale(values: NDArray[np.float64]) -> Colouring:
    """Return colours of numbers, float64 [n]; NaN has the colour UNKNOWN."""
    known = values[~np.isnan(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    shares = (values - low) / (high - low) if high > low else np.where(values == low, 0.5, np.nan)
    ends = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in SCALE])
    at = np.linspace(0, 1, len(SCALE))
    colours = [
        UNKNOWN if share != share else
        "#" + "".join(f"{round(float(np.interp(share, at, part))):02x}" for part in ends.T)
        for share in shares.tolist()
    ]  # fmt: skip
    return Colouring(tuple(colours), range=(low, high))


def colour_plan(plan: Plan, by: str) -> Colouring | None:
    """Return the colours of a plan's boxes.

    Args:
        plan: the boxes.
        by: one of :data:`COLOURINGS`.

    Returns:
        The colours; None if the plan has no such values, or only one.
    """
    if by == "weight":
        return on_scale(plan.weights)
    if by == "margin":
        return None if np.isnan(plan.margins).all() else on_scale(plan.margins)
    numbers: Any = np.arange(len(plan))
    names: tuple[str, ...] = ()
    if by == "bin":
        numbers, names = plan.bins, tuple(f"bin {k}" for k in range(len(plan.bin_sizes)))
    elif by == "size":
        sizes, numbers = np.unique(np.sort(plan.sides, 1)[:, ::-1], axis=0, return_inverse=True)
        names = tuple(" × ".join(f"{side:g}" for side in size) for size in sizes.tolist())
    elif by == "order":
        names = tuple(dict.fromkeys(plan.orders))
        of_bins = np.array([names.index(order) for order in plan.orders], np.int64)
        numbers = of_bins[plan.bins] if len(of_bins) else numbers
    if by != "item" and len(names) < 2:
        return None
    return Colouring(tuple(PALETTE[k % len(PALETTE)] for k in numbers.tolist()), names)
