"""The placement agent π_p: sees the bin and the turned item, scores the cells.

A score map of the heightmap's size, intersected with the stable cells of the chosen orientation
(paper, sec. III-D). Fully convolutional: it runs on any bin size.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.networks.trunk import Network, ScoreMap
from marl_pack.agents.orientation import ahead, under
from marl_pack.game.packing import Packing

WAYS = 1


def observe(
    game: Packing,
    planes: Sequence[str],
    orientation: Tensor,
    heightmap: Tensor | None = None,
    afterstates: AfterstateCritic | None = None,
) -> dict[str, Tensor]:
    """What the agent sees of N bins once the orientations are chosen.

    Args:
        game: the bins.
        planes: extra planes (:data:`marl_pack.agents.networks.trunk.PLANES`).
        orientation: int64 [N].
        heightmap: a copy of the game's that is at hand, to save making another.
        afterstates: who says what placements are worth, for the plane ``worth``.

    Returns:
        ``heightmap`` int16 [N, W, D] (a copy), ``item`` int16 [N, 3] (its sides along x, y, z),
        ``height`` int16 [N, 1], ``mask`` bool [N, W · D], and what the planes need: ``cells``
        bool, ``rest`` int16, ``waste`` int32, ``room``, ``fits`` and ``worth`` float32
        [N, 1, W, D], ``best_room`` and ``best_worth`` float32 [N, 1], ``solid`` bool [N, W, D],
        ``filled`` float32 [N, 1].
    """
    oriented = game.orient(orientation)
    seen = {
        "heightmap": game.bins.heightmap.clone() if heightmap is None else heightmap,
        "item": oriented.sides,
        "height": game.bin_height,
        "mask": oriented.mask.flatten(1),
    }
    if "mask" in planes:
        seen["cells"] = oriented.mask[:, None]
    found = under(game, oriented.sides[:, None], planes)
    return seen | found | ahead(game, planes, afterstates, orientation)


def make_head(network: Network) -> nn.Module:
    """Features [B, C, W, D] → logits of the cells ``x · D + y``, [B, W · D]."""
    return ScoreMap(WAYS, network)
