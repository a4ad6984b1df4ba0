"""Geometry of boxes on cells: orientations, windows of maps, and the placement of one box.

Lengths are whole cells. ``x`` runs along W, ``y`` along D, ``z`` upwards. A heightmap [W, D] holds
the top of each column, an empty map [W, D] the empty cells below that top. The window of a box at
(x, y) is the w × d cells from that low corner on.

:mod:`marl_pack.geometry.compiled` and :mod:`marl_pack.geometry.tensor` hold the same operations as
compiled loops and as batched tensor code.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
