"""Boxes that are in a bin before the first one is placed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.exact.goods import KEYS, Goods, check_goods, number_rows
from marl_pack.exact.lengths import to_units
from marl_pack.exact.spec import ExactSpec
from marl_pack.items.names import check_names
from marl_pack.plan import Plan

NAME = "boxes already there"


@dataclass(frozen=True)
class Present:
    """Boxes in a bin, from the lowest to the highest; :func:`check_present` checks them."""

    rows: NDArray[np.int64]  # [k, 6]  x, y, z, w, d, h in units, as placed
    goods: Goods  # [k]  their weights and limits

    def same(self, other: Present) -> bool:
        """Return whether the boxes are the same."""
        return np.array_equal(self.rows, other.rows) and self.goods.same(other.goods)


def check_present(
    boxes: Any, spec: ExactSpec, attributes: Mapping[str, Any] | None = None
) -> Present:
    """Check boxes that are in a bin, and return them in units.

    Args:
        boxes: numbers [k, 6], rows x, y, z, w, d, h in millimetres; or a plan of one bin with a
            unit, whose weights are in kilograms; or a mapping with ``boxes`` (one of these) and
            attributes by key, such as ``weights``, ``stackable`` and ``max_load``
            (:data:`marl_pack.exact.goods.GOODS_ATTRIBUTES`).
        spec: the game. The boxes need not satisfy its rule, margin or clearance.
        attributes: attributes of the boxes, as in a mapping.

    Raises:
        ValueError: if a box reaches out of the bin, overlaps another one or floats, or a value is
            impossible; the message names the box.
    """
    if isinstance(boxes, Mapping):
        attributes = {key: value for key, value in boxes.items() if key != "boxes"}
        check_names(boxes, ("boxes", *KEYS), ("boxes",), NAME, "key")
        boxes = boxes["boxes"]
    if isinstance(boxes, Plan):
        if boxes.unit_mm is None or len(boxes.bin_sizes) != 1:
            raise ValueError(f"{NAME}: needs a plan of one bin with unit_mm, not {boxes}")
        if boxes.yaws.any():
            raise ValueError(
                f"{NAME}: box {int((boxes.yaws != 0).argmax())} has a yaw; needs boxes along the "
                "axes (a saved Packer keeps rotated boxes)"
            )
        attributes = _attributes(boxes) | dict(attributes or {})
        boxes = boxes.boxes_mm
    rows = number_rows(boxes, 6, NAME, "x y z w d h in mm")
    if not (attributes is None or isinstance(attributes, Mapping)):
        raise ValueError(f"attributes of {NAME}: need a mapping, such as {{'weights': [1, 2]}}")
    if "quantity" in (attributes or {}):
        raise ValueError(f"attributes of {NAME}: 'quantity' has no meaning; give each box a row")
    if len(rows) > spec.max_boxes:
        raise ValueError(f"{len(rows)} {NAME}: needs at most max_boxes = {spec.max_boxes}")
    units, wrong = to_units(rows, spec.unit_mm)
    wrong |= units < np.array([0, 0, 0, 1, 1, 1])
    for i in np.flatnonzero(wrong.any(1))[:1].tolist():
        raise ValueError(
            f"{NAME}: box {i} {rows[i].tolist()} needs x y z ≥ 0 and w d h > 0 in whole units of "
            f"{spec.unit_mm:g} mm"
        )
    goods = check_goods(rows[:, 3:], spec, attributes, source=NAME, fit=False)
    if spec.max_weight_kg is not None and np.isnan(goods.weights).any():
        raise ValueError(f"{NAME}: need weights, because max_weight_kg is set")
    order = np.argsort(units[:, 2], kind="stable")
    tolerance = spec.limits().tolerance
    for k, i in enumerate(order.tolist()):
        _check_box(i, units, order[:k].tolist(), spec.size, tolerance, rows[i].tolist())
    return Present(units[order], goods[order])


def _attributes(plan: Plan) -> dict[str, list[Any]]:
    """Return what a plan says of its boxes; weights that were assumed are unknown."""
    weights = zip(plan.weights.tolist(), plan.weights_assumed.tolist(), strict=True)
    return {
        "weights": [None if assumed else weight for weight, assumed in weights],
        "stackable": plan.stackable.tolist(),
        "max_load": [None if np.isinf(load) else load for load in plan.max_loads.tolist()],
    }


def _check_box(
    i: int, units: NDArray[np.int64], below: Sequence[int], size: tuple[int, int, int],
    tolerance: int, shown: list[float],
) -> None:  # fmt: skip
    """Refuse box i if it reaches out of the bin, overlaps a box that begins lower, or floats."""
    name = f"{NAME}: box {i} {shown}"
    low, high = units[i, :3], units[i, :3] + units[i, 3:]
    if (high > np.array(size)).any():
        raise ValueError(f"{name} reaches out of the bin")
    supported = low[2] == 0
    for k in below:
        other_low, other_high = units[k, :3], units[k, :3] + units[k, 3:]
        shares = np.minimum(high, other_high) - np.maximum(low, other_low)
        if (shares > 0).all():
            raise ValueError(f"{name} overlaps box {k}")
        rests = 0 <= low[2] - other_high[2] <= tolerance
        supported |= bool((shares[:2] > 0).all() and rests)
    if not supported:
        raise ValueError(f"{name} floats: it rests neither on the floor nor on a box")
