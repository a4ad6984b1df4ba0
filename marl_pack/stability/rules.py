"""The stability rules and the table that names them."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from functools import partial
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from marl_pack import bins as state
from marl_pack.bins import Bins
from marl_pack.stability import hull_cpu, hull_torch, support_area
from marl_pack.stability.load_bearing import lbcp_bearing
from marl_pack.stability.oriented_item import OrientedItem, Rule
from marl_pack.stability.static_equilibrium import equilibrium_mask


def _supported(bins: Bins, item: OrientedItem, hollow: Tensor, margin: float) -> Tensor:
    if not state.compiled(bins.device):
        return hull_torch.support_mask(
            bins.heightmap, hollow, item.sides, bins.height, item.com, margin
        )
    com = None if item.com is None else item.com.numpy()
    mask = hull_cpu.support_mask(
        bins.heightmap.numpy(), hollow.numpy(), item.sides.numpy(), bins.height, com, margin
    )
    return torch.from_numpy(mask)


def hull_1(bins: Bins, item: OrientedItem, margin: float = 0.0) -> Tensor:
    """convexHull-1: the centre of mass strictly inside the hull of all contact squares.

    Args:
        bins: N bins.
        item: their items in A orientations.
        margin: cells by which the support polygon is shrunk.

    Returns:
        Bool [N, A, W, D].
    """
    return _supported(bins, item, torch.zeros_like(bins.heightmap), margin)


def hull_alpha(bins: Bins, item: OrientedItem, margin: float = 0.0) -> Tensor:
    """convexHull-α (Algorithm 1): only contact squares over filled columns count.

    Sound for any masses and for whatever the rule places later: each weight goes straight down
    through solid columns. Arguments as :func:`hull_1`.
    """
    return _supported(bins, item, bins.empty_map, margin)


def lbcp(bins: Bins, item: OrientedItem, margin: float = 0.0) -> Tensor:
    """Load-bearable convex polygons: gap cells inside a box's support polygon count as well.

    Arguments as :func:`hull_1`. The polygons are replayed from ``bins.boxes``.
    """
    return _supported(bins, item, (~lbcp_bearing(bins)).to(torch.int16), margin)


def area_ratio(
    bins: Bins, item: OrientedItem, thresholds: support_area.Thresholds | str = "paper"
) -> Tensor:
    """Zhao et al. 2021: share of the bottom face supported, and number of its corners.

    Args:
        bins: N bins.
        item: their items; the centre of mass plays no part.
        thresholds: ``"paper"`` (60 % and 4 corners, 80 % and 3, 95 %), ``"code"`` (50 / 85 / 95, as
            the authors' code has it), or pairs (share, corners); shares must be exceeded.
    """
    pairs = support_area.check_thresholds(thresholds)
    if not state.compiled(bins.device):
        return support_area.mask_torch(bins.heightmap, item.sides, bins.height, pairs)
    mask = support_area.mask_cpu(bins.heightmap.numpy(), item.sides.numpy(), bins.height, pairs)
    return torch.from_numpy(mask)


def equilibrium(
    bins: Bins, item: OrientedItem, margin: float = 0.0, check_stack: bool = False
) -> Tensor:
    """Exact strict equilibrium of the whole stack (:mod:`marl_pack.stability.static_equilibrium`).

    It relies on the weights: a stack built on wrong ones may break.

    Args:
        bins: N bins whose stacks stand (or give ``check_stack``).
        item: their items in A orientations.
        margin: the centre of mass may lie anywhere within so many cells of its place.
        check_stack: do not take for granted that what is there stands.
    """
    surely, possibly = hull_alpha(bins, item, margin), hull_1(bins, item, margin)
    return equilibrium_mask(bins, item, surely, possibly, margin, check_stack)


def none(bins: Bins, item: OrientedItem) -> Tensor:
    """No stability rule: wherever the item fits into the bin, set down from above.

    To compare with, and for the judge to have something to say no to.
    """
    return area_ratio(bins, item, ((0.0, 0),))


RULES: dict[str, Callable[..., Tensor]] = {
    "hull_1": hull_1,
    "hull_alpha": hull_alpha,
    "area_ratio": area_ratio,
    "lbcp": lbcp,
    "equilibrium": equilibrium,
    "none": none,
}


def make_rule(name: str, **parameters: object) -> Rule:
    """The rule called ``name`` with its parameters bound.

    Raises:
        ValueError: for an unknown rule, an unknown parameter or a negative margin.
    """
    if name not in RULES:
        raise ValueError(f"unknown stability rule {name!r}: one of {', '.join(RULES)}")
    known = list(inspect.signature(RULES[name]).parameters)[2:]
    for key in parameters:
        if key not in known:
            raise ValueError(f"rule {name!r} has no parameter {key!r}: it takes {known}")
    margin: Any = parameters.get("margin", 0.0)
    number = not isinstance(margin, bool) and isinstance(margin, Real)
    if not number or not 0 <= margin < math.inf:
        raise ValueError(f"margin {margin!r}: needs a number of cells ≥ 0")
    if name == "area_ratio":
        thresholds: Any = parameters.get("thresholds", "paper")
        parameters["thresholds"] = support_area.check_thresholds(thresholds)
    return partial(RULES[name], **parameters)
