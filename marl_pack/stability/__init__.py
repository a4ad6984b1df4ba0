"""Stability rules: where a box may be placed so that nothing falls.

Every rule has the same signature, :data:`Rule`, and a name in :data:`RULES`. :func:`make_rule`
binds its parameters. From the strictest to the loosest, ``hull_alpha`` ⊂ ``lbcp`` ⊂ ``equilibrium``
⊂ ``hull_1``; ``area_ratio`` and ``none`` are outside this order and are not sound.
:mod:`marl_pack.stability.reference` defines each rule, one window at a time.

:func:`stable_mask` computes the mask from NumPy arrays, without an environment.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
