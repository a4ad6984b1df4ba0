"""Ask a stability rule about plain NumPy arrays, without an environment."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from marl_pack.bins import Bins, check_size
from marl_pack.stability.oriented_item import NO_OFFSET, OrientedItem, Rule, check_com_offset
from marl_pack.stability.rules import equilibrium, lbcp, make_rule
from marl_pack.stability.static_equilibrium import uniform_loads


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
    """Where may one box be set down in one bin? For plain arrays, without an environment.

    Args:
        rule: a name in :data:`RULES`, or a rule from :func:`make_rule`.
        heightmap: whole numbers [W, D], top of each column in cells.
        empty_map: whole numbers [W, D], empty cells below each top (Algorithm 2).
        item: w, d, h as the box is turned, in cells.
        bin_height: H in cells.
        boxes: rows x, y, z, w, d, h of what stands in the bin; ``lbcp`` and ``equilibrium`` need
            them unless the bin is empty.
        weights: the boxes' weights [n] (``equilibrium``); their volumes by default. Their centres
            of mass are taken to be central.
        weight: the item's weight; its volume by default.
        com_offset: how far the item's centre of mass lies from its geometric centre, as fractions
            of w, d, h.
        **parameters: of the rule, e.g. ``margin=1.0`` or ``thresholds="code"``.

    Returns:
        Bool [W, D]: true at each low corner (x, y) where the box fits and stands.

    Raises:
        ValueError: if a map, the item, a box or a parameter cannot be; the message says which.
    """
    heights, gaps = _whole("heightmap", heightmap), _whole("empty_map", empty_map)
    if heights.ndim != 2 or heights.shape != gaps.shape:
        raise ValueError(
            f"heightmap {heights.shape} and empty_map {gaps.shape}: need the same shape [W, D]"
        )
    size = check_size((*heights.shape, bin_height))
    if heights.min() < 0 or heights.max() > bin_height:
        raise ValueError(f"heightmap: heights must lie in 0 … {bin_height}, the bin's height")
    if gaps.min() < 0 or (gaps > heights).any():
        raise ValueError("empty_map: must lie between 0 and the column's height")
    sides = _whole("item", item)
    if sides.shape != (3,) or sides.min() < 1:
        raise ValueError(f"item {item!r}: needs three whole sides w, d, h ≥ 1 in cells")
    chosen: Callable[..., torch.Tensor]
    if isinstance(rule, str):
        chosen = make_rule(rule, **parameters)
    elif parameters:
        raise ValueError(f"{sorted(parameters)} go with the name of a rule, not with a bound one")
    else:
        chosen = rule
    function = getattr(chosen, "func", chosen)
    if boxes is None and function in (lbcp, equilibrium) and heights.any():
        raise ValueError("the rule looks at the whole stack: give boxes, rows x y z w d h")
    if function is equilibrium:
        bound: dict[str, object] = getattr(chosen, "keywords", {})
        chosen = make_rule("equilibrium", **({"check_stack": True} | bound))
    stack, load = _stack(boxes, weights, heights, gaps)
    if weight is not None and not 0 < weight < float("inf"):
        raise ValueError(f"weight {weight!r}: needs a positive number")

    bins = Bins(
        heightmap=torch.from_numpy(heights.astype(np.int16))[None],
        empty_map=torch.from_numpy(gaps.astype(np.int16))[None],
        boxes=torch.from_numpy(stack.astype(np.int16))[None],
        loads=torch.from_numpy(load)[None],
        count=torch.tensor([len(stack)]),
        filled=torch.tensor([int(stack[:, 3:].prod(1).sum())]),
        height=size[2],
    )
    offset = check_com_offset(com_offset)
    com = (0.5 + torch.tensor(offset[:2], dtype=torch.float64)) * torch.from_numpy(sides[:2])
    clipped = np.minimum(sides, np.iinfo(np.int16).max).astype(np.int16)
    candidate = OrientedItem(
        torch.from_numpy(clipped)[None, None],
        com[None, None] if any(offset[:2]) else None,
        None if weight is None else torch.tensor([float(weight)]),
    )
    return chosen(bins, candidate)[0, 0].numpy()


def _whole(name: str, values: ArrayLike) -> NDArray[np.int64]:
    """``values`` as int64, refusing what is not a whole number."""
    array = np.asarray(values)
    if array.dtype.kind not in "iuf" or not np.isfinite(array).all() or (array % 1 != 0).any():
        raise ValueError(f"{name}: needs whole numbers of cells, got {array.dtype} values with a"
                         " fraction, NaN or another type")  # fmt: skip
    return array.astype(np.int64)


def _stack(
    boxes: ArrayLike | None,
    weights: ArrayLike | None,
    heights: NDArray[np.int64],
    gaps: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Boxes in an order in which they can be placed, and their loads, checked against the maps."""
    if boxes is None:
        if weights is not None:
            raise ValueError("weights: given without boxes")
        return np.zeros((0, 6), np.int64), np.zeros((0, 3))
    stack = _whole("boxes", boxes).reshape(-1, 6) if np.size(boxes) else np.zeros((0, 6), np.int64)
    order = np.argsort(stack[:, 2], kind="stable")
    stack = stack[order]
    top, empty = np.zeros_like(heights), np.zeros_like(heights)
    for original, (x, y, z, w, d, h) in zip(order, stack, strict=True):
        window = np.s_[x : x + w, y : y + d]
        name = f"boxes: row {original} (x={x} y={y} z={z} w={w} d={d} h={h})"
        if min(x, y, z) < 0 or min(w, d, h) < 1 or top[window].shape != (w, d):
            raise ValueError(f"{name} lies outside the bin or has no volume")
        if top[window].max() != z:
            raise ValueError(f"{name} rests at {top[window].max()}: it floats or overlaps another")
        empty[window] += z - top[window]
        top[window] = z + h
    if (top != heights).any() or (empty != gaps).any():
        raise ValueError("boxes: they do not make this heightmap and empty_map")
    load = uniform_loads(stack)
    if weights is not None:
        given = np.asarray(weights, np.float64)
        if given.shape != (len(stack),) or not (np.isfinite(given) & (given > 0)).all():
            raise ValueError(f"weights: needs one positive number a box, {len(stack)}")
        load[:, 0] = given[order]
    return stack, load
