"""Programs that judge packings in physics: Table 1, controls, saved packings, pictures and films.

The judge itself is :mod:`marl_pack.sapien_check`, which does not depend on how a stack was packed.
"""
