"""Compute the mask of a stability rule from NumPy arrays, without an environment."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from marl_pack.backend import default_backend
from marl_pack.bins import UNKNOWN, Bins
from marl_pack.checks import real_number, shown
from marl_pack.geometry import check_size
from marl_pack.geometry.compiled import place_box
from marl_pack.installation import njit
from marl_pack.stability.oriented_item import OrientedItem
from marl_pack.stability.parameters import NO_OFFSET, check_com_offset
from marl_pack.stability.rules import Rule, equilibrium, lbcp, make_rule
from marl_pack.stability.static_equilibrium import check_boxes, uniform_loads, whole_cells


def stable_mask(
    rule: str | Rule,
    heightmap: ArrayLike,
    empty_map: ArrayLike,
    item: ArrayLike,
    bin_height: int,
    boxes: ArrayLike | None = None,
    *,
    weights: ArrayLike | None = None,
    weight: float | None = None,
    com_offset: tuple[float, float, float] = NO_OFFSET,
    **parameters: object,
) -> NDArray[np.bool_]:
    """Return where one box may be placed in one bin, without an environment.

    Args:
        rule: a name in :data:`RULES`, or a rule from :func:`make_rule`.
        heightmap: whole numbers [W, D], top of each column in cells.
        empty_map: whole numbers [W, D], empty cells below the top of each column (Algorithm 2); 0
            where the column is filled down to the floor. The heightmap does not show these cells.
        item: w, d, h along x, y, z, in cells.
        bin_height: the bin's height H in cells.
        boxes: whole numbers [n, 6], rows x, y, z, w, d, h of the boxes in the bin; ``lbcp`` and
            ``equilibrium`` need them unless the bin is empty.
        weights: the boxes' weights [n], for ``equilibrium``; by default their volumes. Each centre
            of mass is in the middle of the box.
        weight: the item's weight; by default its volume.
        com_offset: x, y, z of the item's centre of mass minus those of its geometric centre, as
            fractions of w, d, h.
        **parameters: parameters of the rule, e.g. ``margin=1.0`` or ``thresholds="code"``.

    Returns:
        Bool [W, D]: true at (x, y) if the box fits and is stable with its low corner there.

    Raises:
        ValueError: if a map, the item, a box or a parameter is impossible; the message names it.
    """
    maps = _check_maps(heightmap, empty_map, bin_height)
    sides = _check_item(item)
    bound = _bind(rule, parameters)
    if boxes is None and _needs_stack(bound) and maps[0].any():
        raise ValueError("boxes: the rule needs the whole stack; give boxes, rows x y z w d h")
    table = NO_BOXES if boxes is None and weights is None else _table(boxes, weights, *maps)
    offset = check_com_offset(com_offset)[:2]
    item_weight = None
    if weight is not None:
        item_weight = torch.tensor([_check_weight(weight)], dtype=torch.float64)
    width, depth = maps.shape[1:]
    if sides[0] > width or sides[1] > depth or sides[2] > bin_height:
        return np.zeros((width, depth), np.bool_)
    heights, empty = torch.from_numpy(maps[:1]), torch.from_numpy(maps[1:])
    rows, loads, labels, count, filled = table
    bins = Bins(
        heights, empty, rows, loads, labels, count, filled, int(bin_height), default_backend("cpu")
    )
    oriented = OrientedItem(
        torch.from_numpy(np.array([[sides]], np.int16)), (offset,) if any(offset) else None,
        item_weight,
    )  # fmt: skip
    return bound(bins, oriented).numpy()[0, 0]


def _check_weight(weight: float) -> float:
    """Check a weight and return it as a float.

    Raises:
        ValueError: unless it is a finite number above 0.
    """
    number = real_number(weight, "weight")
    if number <= 0:
        raise ValueError(f"weight: needs a number above 0, not {shown(weight)}")
    return number


def _check_item(item: ArrayLike) -> list[int]:
    """Check the item's sides and return them as three ints.

    Raises:
        ValueError: unless they are three whole numbers of cells ≥ 1.
    """
    sides: Any = item
    if not isinstance(item, tuple | list) or any(type(side) is not int for side in item):
        sides = whole_cells("item", item).tolist()
    if not (isinstance(sides, tuple | list) and len(sides) == 3 and min(sides) >= 1):
        raise ValueError(f"item {item!r}: needs three whole sides w, d, h ≥ 1 in cells")
    return list(sides)


def _check_maps(heightmap: ArrayLike, empty_map: ArrayLike, bin_height: int) -> NDArray[np.int16]:
    """Check the heightmap and the empty map and return both, int16 [2, W, D].

    Raises:
        ValueError: if their shapes differ, or a number in them or the bin's size is impossible.
    """
    if empty_map is None:
        raise ValueError(
            "empty_map: needs whole numbers [W, D], the empty cells below the top of each column; "
            "zeros if every column is filled down to the floor"
        )
    heights, empty = _cells("heightmap", heightmap), _cells("empty_map", empty_map)
    if heights.ndim != 2 or heights.shape != empty.shape:
        raise ValueError(
            f"heightmap {heights.shape} and empty_map {empty.shape}: need the same shape [W, D]"
        )
    check_size((*heights.shape, bin_height))
    maps = np.empty((2, *heights.shape), np.int16)
    high, gaps = _copy_maps(heights, empty, int(bin_height), maps)
    if high:
        raise ValueError(f"heightmap: heights must lie in 0 … {bin_height}, the bin's height")
    if gaps:
        raise ValueError("empty_map: must lie between 0 and the column's height less its top cell")
    return maps


def _cells(name: str, values: ArrayLike) -> NDArray[np.int64]:
    """Check a map as :func:`whole_cells` does, and return it as a contiguous array."""
    if type(values) is not np.ndarray or values.dtype.kind != "i":
        values = whole_cells(name, values)
    return np.ascontiguousarray(values, np.int64)


@njit(cache=True)
def _copy_maps(heights: Any, empty: Any, bin_height: int, maps: Any) -> tuple[bool, bool]:
    """Copy both maps [W, D] to ``maps``; return whether a height or an empty cell is impossible."""
    high, gaps = False, False
    for x in range(heights.shape[0]):
        for y in range(heights.shape[1]):
            height, below = heights[x, y], empty[x, y]
            high |= height < 0 or height > bin_height
            gaps |= below < 0 or below > max(height - 1, 0)
            maps[0, x, y], maps[1, x, y] = height, below
    return high, gaps


def _bind(rule: str | Rule, parameters: dict[str, object]) -> Callable[..., torch.Tensor]:
    """Return the rule with its parameters bound; ``equilibrium`` checks the stack itself.

    Args:
        rule: a name or a bound rule.
        parameters: parameters to bind; allowed only if ``rule`` is a name.

    Raises:
        ValueError: if there are parameters for a bound rule.
    """
    bound: Callable[..., torch.Tensor]
    if isinstance(rule, str):
        bound = make_rule(rule, **parameters) if parameters else _rule_called(rule)
    elif not callable(rule):
        raise ValueError(f"rule {shown(rule)}: needs a name in RULES or a rule from make_rule")
    elif parameters:
        raise ValueError(f"{sorted(parameters)}: need the name of a rule, not a bound one")
    else:
        bound = rule
    if getattr(bound, "func", bound) is equilibrium:
        keywords: dict[str, object] = getattr(bound, "keywords", {})
        bound = make_rule("equilibrium", **({"check_stack": True} | keywords))
    return bound


@cache
def _rule_called(name: str) -> Rule:
    """Return the rule called ``name`` with the defaults of its parameters."""
    return make_rule(name)


def _needs_stack(bound: Callable[..., torch.Tensor]) -> bool:
    """Return whether a rule needs the boxes of the bin."""
    return getattr(bound, "func", bound) in (lbcp, equilibrium)


def _table(
    boxes: ArrayLike | None,
    weights: ArrayLike | None,
    heights: NDArray[np.int16],
    empty: NDArray[np.int16],
) -> tuple[torch.Tensor, ...]:
    """Return the table of boxes of one bin: the fields of :class:`Bins` after the maps.

    The arguments and the errors are those of :func:`_stack`.
    """
    stack, load = _stack(boxes, weights, heights, empty)
    return (
        torch.from_numpy(stack.astype(np.int16))[None],
        torch.from_numpy(load)[None],
        torch.full((1, len(stack), 2), UNKNOWN),
        torch.tensor([len(stack)]),
        torch.tensor([int(stack[:, 3:].prod(1).sum())]),
    )


def _stack(
    boxes: ArrayLike | None,
    weights: ArrayLike | None,
    heights: NDArray[np.int16],
    empty: NDArray[np.int16],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the boxes, sorted so that they can be placed one by one, and their loads.

    Raises:
        ValueError: if a box cannot be placed, or the placed boxes do not give the maps.
    """
    if boxes is None:
        if weights is not None:
            raise ValueError("weights: need boxes")
        return np.zeros((0, 6), np.int64), np.zeros((0, 3))
    stack = check_boxes(boxes)
    order = np.argsort(stack[:, 2], kind="stable")
    stack = stack[order]
    heightmap, empty_map = np.zeros_like(heights), np.zeros_like(heights)
    for original, (x, y, z, w, d, h) in zip(order, stack.tolist(), strict=True):
        name = f"boxes: row {original} (x={x} y={y} z={z} w={w} d={d} h={h})"
        shape = heightmap.shape
        if min(x, y, z) < 0 or min(w, d, h) < 1 or x + w > shape[0] or y + d > shape[1]:
            raise ValueError(f"{name} lies outside the bin or has no volume")
        resting_height, _ = place_box(heightmap, empty_map, x, y, w, d, h)
        if resting_height != z:
            raise ValueError(f"{name} rests at {resting_height}: it floats or overlaps another")
    if (heightmap != heights).any() or (empty_map != empty).any():
        raise ValueError("boxes: do not lead to this heightmap and empty_map")
    load = uniform_loads(stack)
    if weights is not None:
        own_weights = np.asarray(weights)
        if own_weights.shape != (len(stack),) or np.ma.is_masked(weights):
            raise ValueError(f"weights: needs one number for each of {len(stack)} boxes")
        load[:, 0] = [_check_weight(own_weights[row]) for row in order]
    return stack, load


NO_BOXES = _table(None, None, np.zeros((0, 0), np.int16), np.zeros((0, 0), np.int16))
"""The table of an empty bin, or of one whose boxes are not known."""
