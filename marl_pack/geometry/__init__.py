"""Geometry of boxes on cells: orientations, windows of maps, and the placement of one box.

Lengths are whole cells. ``x`` runs along W, ``y`` along D, ``z`` upwards. A heightmap [W, D] stores
the height of each column's top. An empty map [W, D] stores the number of empty cells below each
top. The window of a box at (x, y) is the w × d cells that start at this low corner.

:mod:`marl_pack.geometry.compiled` and :mod:`marl_pack.geometry.tensor` contain the same operations,
once as compiled loops and once as batched tensor code.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
