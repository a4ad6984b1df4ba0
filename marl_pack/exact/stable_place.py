"""Where may a box be placed on a stack in millimetres? One function, without any environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Sized
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_pack.checks import shown
from marl_pack.exact.bins import ExactBins, placements
from marl_pack.exact.goods import AXES, goods_of, number_rows
from marl_pack.exact.lengths import to_mm, to_units
from marl_pack.exact.present import check_present
from marl_pack.exact.spec import ExactSpec
from marl_pack.option_record import document


@document(ExactSpec, " " * 8)
def stable_place(
    item: ArrayLike | Mapping[str, Any],
    boxes: ArrayLike = (),
    *,
    at: Sequence[float] | None = None,
    attributes: Mapping[str, Any] | None = None,
    **options: Any,
) -> NDArray[np.float64]:
    """Return where a box may be placed in a bin with boxes in it, by a stability rule.

    Args:
        item: the box's own sides w, d, h in millimetres; or a mapping with ``items`` (one such row)
            and attributes (:func:`marl_pack.exact.goods.check_goods`).
        boxes: numbers [k, 6], rows x, y, z, w, d, h in millimetres, the boxes in the bin; or a plan
            of one bin.
        at: x, y of the box's low corner; by default all candidate positions at edges are tried.
        attributes: attributes of the boxes in the bin by key, such as ``weights``.
        **options: options of the game:
        {options}

    Returns:
        Rows orientation, x, y, z in millimetres, float64 [M, 4], in the order of z, x, y; no rows
        if the box has no place.

    Raises:
        ValueError: if a box reaches out of the bin, overlaps another one or floats, or a number is
            impossible; the message says what would be right.
        TypeError: for an unknown option.
    """
    spec = ExactSpec().with_options(options)
    if isinstance(boxes, Sized):
        spec = spec.with_options({"max_boxes": max(spec.max_boxes, len(boxes) + 1)})
    bins = ExactBins(1, spec, check_present(boxes, spec, attributes))
    goods = goods_of(item if isinstance(item, Mapping) else [item], spec, "item")
    if len(goods) != 1:
        raise ValueError(f"item: needs one box, not {len(goods)}")
    if at is None:
        moves = bins.moves(goods).numbers
    else:
        (corner,) = number_rows([at], 2, "at", "x y in mm")
        units, wrong = to_units(corner, spec.unit_mm)
        if wrong.any() or (units < 0).any():
            raise ValueError(
                f"at = {shown(at)}: needs x, y ≥ 0 in whole units of {spec.unit_mm:g} mm"
            )
        moves = np.sort(bins.moves_at(0, goods, units[None]))
        _, first = np.unique(goods.sides[0][AXES[moves & 7]], axis=0, return_index=True)
        moves = moves[np.sort(first)]  # orientations that make the same box count once
    where = placements(moves).reshape(-1, 4)
    return np.column_stack((where[:, 0], to_mm(where[:, 1:], spec.unit_mm)))
