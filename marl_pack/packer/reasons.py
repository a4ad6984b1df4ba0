"""Find out why a box has no place in a bin."""

from __future__ import annotations

import numpy as np

from marl_pack.exact.bins import ExactBins
from marl_pack.exact.goods import Goods
from marl_pack.exact.limits import NONE, RULES
from marl_pack.exact.state import ROUNDING
from marl_pack.packer.answers import NoPlace

EVERY = np.ones(1, np.bool_)


def why_not(bins: ExactBins, item: Goods) -> NoPlace:
    """Return why an item, one row, got no place in the only bin.

    The conditions are lifted one after another, until the item has a place.
    """
    spec, state = bins.spec, bins.state
    name = str(item.ids[0])
    count = int(state.count[0])

    def no(code: str, reason: str) -> NoPlace:
        return NoPlace(name, code, reason)

    if count >= spec.max_boxes:
        return no("full", f"the bin holds {count} boxes, as many as it may (max_boxes)")
    if spec.max_weight_kg is not None:
        if np.isnan(item.weights[0]) or (~state.known[0, :count]).any():
            whose = "the box's" if np.isnan(item.weights[0]) else "another box's"
            return no("unknown_weight", f"max_weight_kg is set, and {whose} weight is unknown")
        total = float(bins.weight[0] + item.weights[0])
        if total > spec.max_weight_kg * (1 + ROUNDING):
            return no(
                "too_heavy",
                f"the bin would weigh {total:g} kg, more than max_weight_kg = "
                f"{spec.max_weight_kg:g}",
            )
    if bins.any_move(item, EVERY)[0]:
        return no("policy", "the policy chose no place, though there is one")
    lifted = bins.select([0])
    lifted.state.stackable[:] = True
    lifted.state.max_load[:] = np.inf
    if lifted.any_move(item, EVERY)[0]:
        return no("load", "it would have to rest on boxes that may not carry it")
    lifted.limits = lifted.limits._replace(rule=NONE, overhang=(1, 1))
    if lifted.any_move(item, EVERY)[0]:
        margin = f" and a margin of {spec.margin_mm:g} mm" if spec.margin_mm else ""
        rule = next(rule for rule, number in RULES.items() if number == bins.limits.rule)
        return no("no_support", f"nowhere would it stand by the rule {rule}{margin}")
    # On the highest box it would fit if the bin were taller.
    return no("too_tall", "wherever it fits between the boxes, it would reach above the bin")
