"""Stability rules: where a box may be placed so that nothing falls.

Every rule has one signature, :data:`Rule`, and a name in :data:`RULES`; :func:`make_rule` binds its
parameters. From the strictest to the loosest, ``hull_alpha`` ⊂ ``lbcp`` ⊂ ``equilibrium`` ⊂
``hull_1``; ``area_ratio`` and ``none`` are outside this order and not sound.
:mod:`marl_pack.stability.reference` defines each rule, one window at a time.

:func:`stable_mask` computes the mask of plain NumPy arrays, without an environment.
"""

from marl_pack.stability.arrays import stable_mask
from marl_pack.stability.oriented_item import OrientedItem, Rule, orient_item
from marl_pack.stability.rules import (
    RULES,
    area_ratio,
    equilibrium,
    hull_1,
    hull_alpha,
    lbcp,
    make_rule,
    none,
)
from marl_pack.stability.static_equilibrium import in_equilibrium

__all__ = [
    "RULES",
    "OrientedItem",
    "Rule",
    "area_ratio",
    "equilibrium",
    "hull_1",
    "hull_alpha",
    "in_equilibrium",
    "lbcp",
    "make_rule",
    "none",
    "orient_item",
    "stable_mask",
]
