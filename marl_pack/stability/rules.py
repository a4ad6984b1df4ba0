"""Define the stability rules and the table of their names.

The code that computes masks is imported when the first mask is computed, so that the names and
parameters of the rules can be used without it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_pack import renamed
from marl_pack.checks import real_number, shown
from marl_pack.geometry import MAX_SIDE
from marl_pack.stability.parameters import Thresholds, check_thresholds

if TYPE_CHECKING:
    from torch import Tensor

    from marl_pack.backend import Backend
    from marl_pack.bins import Bins
    from marl_pack.stability.oriented_item import OrientedItem

Rule = Callable[["Bins", "OrientedItem"], "Tensor"]
"""``(bins, item) -> bool [N, A, W, D]``: the cells (low corners) where the item fits into the bin
in each orientation and is stable by the rule. The rule's parameters are bound already
(:func:`functools.partial`)."""


@cache  # an import statement takes a tenth of the time of a mask
def _hull_mask(backend: Backend, untouched: bool) -> Callable[..., Any]:
    """Return the function that computes convex-hull masks; ``untouched`` as in ``Bins``."""
    from marl_pack.stability import hull_compiled, hull_tensor

    tensor_code = hull_tensor.flat_mask if untouched else hull_tensor.support_mask
    return backend.pick(compiled=hull_compiled.support_mask, tensor=tensor_code)


@cache
def _area_mask(backend: Backend) -> Callable[..., Any]:
    """Return the function that computes masks by supported area."""
    from marl_pack.stability import support_area

    return backend.pick(compiled=support_area.mask_compiled, tensor=support_area.mask_tensor)


def _supported(bins: Bins, item: OrientedItem, empty_map: Tensor, margin: float) -> Tensor:
    """Return the convex-hull mask in which only columns with ``empty_map`` 0 count as support."""
    centres = None
    if item.offsets is not None or margin > 0:
        centres = item.centre_table(margin, max(bins.size[:2]))
    code = _hull_mask(bins.backend, bins.untouched)
    mask, unsure = code(bins.heightmap, empty_map, item.sides, bins.height, centres)
    for n, a, x, y in [] if unsure is None else unsure.tolist():
        from marl_pack.stability import reference

        w, d, _ = item.sides[n, a].tolist()
        window = np.s_[n, x : x + w, y : y + d]
        heights, bearing = bins.heightmap[window].cpu().numpy(), empty_map[window].cpu() == 0
        com = item.exact_centre(a, w, d)
        mask[n, a, x, y] = reference.hull(heights, bearing.numpy(), com, margin)
    return mask


def hull_1(bins: Bins, item: OrientedItem, margin: float = 0.0) -> Tensor:
    """Return the mask of convexHull-1.

    The centre of mass must lie strictly inside the convex hull of all contact squares.

    Args:
        bins: N bins.
        item: the bins' items in A orientations.
        margin: cells by which the support polygon is shrunk.

    Returns:
        Bool [N, A, W, D].
    """
    return _supported(bins, item, bins.heightmap.new_zeros(bins.heightmap.shape), margin)


def hull_alpha(bins: Bins, item: OrientedItem, margin: float = 0.0) -> Tensor:
    """Return the mask of convexHull-α (Algorithm 1): only contact over filled columns counts.

    The rule is sound for any masses and for all boxes that it places later, because each weight
    goes straight down through filled columns. The arguments are those of :func:`hull_1`.
    """
    return _supported(bins, item, bins.empty_map, margin)


def lbcp(bins: Bins, item: OrientedItem, margin: float = 0.0) -> Tensor:
    """Return the mask of load-bearable convex polygons (Gao et al. 2025, arXiv 2507.09123).

    Cells above a gap also count if they lie inside a box's support polygon. The polygons are
    computed from ``bins.boxes``. The arguments are those of :func:`hull_1`.
    """
    from marl_pack.stability.load_bearing import lbcp_bearing

    return _supported(bins, item, ~lbcp_bearing(bins), margin)


def area_ratio(bins: Bins, item: OrientedItem, thresholds: Thresholds | str = "paper") -> Tensor:
    """Return the mask of Zhao et al. 2021, by the supported area and corners of the bottom face.

    Args:
        bins: N bins.
        item: the bins' items; their centres of mass are ignored.
        thresholds: ``"paper"`` (60 % and 4 corners, 80 % and 3, 95 %), ``"code"`` (50 / 85 / 95, as
            in the authors' code), or pairs (share, corners). The supported area must be larger
            than the share.
    """
    pairs = check_thresholds(thresholds)
    mask: Tensor = _area_mask(bins.backend)(bins.heightmap, item.sides, bins.height, pairs)
    return mask


def equilibrium(
    bins: Bins, item: OrientedItem, margin: float = 0.0, check_stack: bool = False
) -> Tensor:
    """Return the mask of exact strict equilibrium of the whole stack.

    See :mod:`marl_pack.stability.equilibrium_masks`. The rule relies on the weights: if they are
    wrong, a stack may fall.

    Args:
        bins: N bins whose stacks stand; with ``check_stack`` any bins.
        item: the bins' items in A orientations.
        margin: distance in cells; the stack must stand wherever the item's centre of mass lies
            within this distance of its position.
        check_stack: whether to check that the stacks stand instead of assuming it.
    """
    from marl_pack.stability.equilibrium_masks import equilibrium_mask

    surely, possibly = hull_alpha(bins, item, margin), hull_1(bins, item, margin)
    return equilibrium_mask(bins, item, surely, possibly, margin, check_stack)


def none(bins: Bins, item: OrientedItem) -> Tensor:
    """Return the mask without a stability rule: where the item fits, placed from above.

    It is a baseline for comparisons and for tests of the physics simulation.
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
"""Every stability rule by its name."""


def unknown_rule(name: object) -> ValueError:
    """Return the error for an unknown rule; it suggests the most similar name."""
    guess = renamed.guess(name, RULES) if isinstance(name, str) else ""
    names = ", ".join(RULES)
    return ValueError(f"unknown stability rule {shown(name)}: needs one of {names}{guess}")


def make_rule(name: str, **parameters: object) -> Rule:
    """Return the rule called ``name`` with its parameters bound.

    Raises:
        ValueError: for an unknown rule, an unknown parameter or a negative margin.
    """
    if not isinstance(name, str) or name not in RULES:
        raise unknown_rule(name)
    accepted = list(inspect.signature(RULES[name]).parameters)[2:]
    for key in parameters:
        if key not in accepted:
            raise ValueError(f"rule {name!r} has no parameter {key!r}: needs one of {accepted}")
    margin = real_number(parameters.get("margin", 0.0), "margin")
    if not 0 <= margin <= MAX_SIDE:
        raise ValueError(f"margin {margin!r}: needs a number of cells from 0 to {MAX_SIDE}")
    if not isinstance(parameters.get("check_stack", False), bool):
        raise ValueError(f"check_stack {shown(parameters['check_stack'])}: needs true or false")
    if name == "area_ratio":
        thresholds: Any = parameters.get("thresholds", "paper")
        parameters["thresholds"] = check_thresholds(thresholds)
    return partial(RULES[name], **parameters)
