"""Run a packer's code once, so that the first box does not wait while it is compiled or loaded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from marl_pack.exact.lengths import to_mm
from marl_pack.packer.calls import goods_of
from marl_pack.packer.packer import Packer
from marl_pack.packer.reasons import why_not


def warm_up(arguments: Mapping[str, Any]) -> None:
    """Place boxes in a packer with these arguments, which is then forgotten; a search is short.

    Args:
        arguments: those of :class:`marl_pack.packer.packer.Packer`.
    """
    searches = arguments.get("plan") is not None or arguments.get("policy") == "search"
    packer = Packer(**{**arguments, **({"plan": "budget=1ms"} if searches else {})})
    side = float(to_mm(max(1, min(packer.spec.size) // 3), packer.spec.unit_mm))
    for _ in range(3):
        packer.show((side, side, side), weight=1.0)
        packer.place_next()
    why_not(packer.bin, goods_of((side, side, side), {}, packer.spec))
    packer.state, packer.plan  # noqa: B018  # read for what they compile
