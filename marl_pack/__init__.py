"""Learning to pack boxes online, safely.

The rules of G games at once are in :class:`marl_pack.game.packing.Packing`; its PettingZoo view is
:mod:`marl_pack.env_aec`; the stability rules are in :mod:`marl_pack.stability`.
"""

import pettingzoo

__version__ = "0.1.0"

if hasattr(pettingzoo, "register"):  # PettingZoo 1.27 and later keep a registry
    pettingzoo.register("aec", "marl_pack/Packing-v0", "marl_pack.env_aec:env")
    pettingzoo.register("parallel", "marl_pack/Packing-v0", "marl_pack.env_aec:parallel_env")
