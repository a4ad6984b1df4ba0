"""Learning to pack boxes online, safely.

The rules of G games at once are in :class:`Packing`; its PettingZoo view is :func:`env`; the
stability rules are in :data:`RULES`. The names of :data:`__all__` are the public interface; each is
imported from its module at its first use.
"""

import lazy_loader
import pettingzoo

__version__ = "0.2.0.dev0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

if hasattr(pettingzoo, "register"):  # PettingZoo 1.27 and later keep a registry
    pettingzoo.register("aec", "marl_pack/Packing-v0", "marl_pack.env_aec:env")
    pettingzoo.register("parallel", "marl_pack/Packing-v0", "marl_pack.env_aec:parallel_env")
