"""The orientation agent π_o: sees the bin and the item as it comes, chooses one of six ways.

Its mask excludes the orientations without a legal cell (paper, sec. III-D).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from marl_pack.agents.afterstates.critic import ILLEGAL, AfterstateCritic
from marl_pack.agents.networks.trunk import Network, pooled_head
from marl_pack.bins import ORIENTATIONS, utilization
from marl_pack.game.packing import Packing
from marl_pack.stability.windows import rest_and_waste

WAYS = len(ORIENTATIONS)


def observe(
    game: Packing, planes: Sequence[str] = (), afterstates: AfterstateCritic | None = None
) -> dict[str, Tensor]:
    """What the agent sees of N bins.

    Args:
        game: the bins.
        planes: extra planes (:data:`marl_pack.agents.networks.trunk.PLANES`), for all orientations.
        afterstates: who says what placements are worth, for the plane ``worth``.

    Returns:
        ``heightmap`` int16 [N, W, D] (a copy), ``item`` int16 [N, 3] (its own sides w, d, h),
        ``height`` int16 [N, 1], ``mask`` bool [N, 6], and what the planes need: ``cells`` bool,
        ``rest`` int16, ``waste`` int32, ``room``, ``fits`` and ``worth`` float32 [N, 6, W, D],
        ``best_room`` and ``best_worth`` float32 [N, 1], ``solid`` bool [N, W, D], ``filled``
        float32 [N, 1].
    """
    seen = {
        "heightmap": game.bins.heightmap.clone(),
        "item": game.items,
        "height": game.bin_height,
        "mask": game.orientation_mask,
    }
    if "mask" in planes:
        seen["cells"] = game.mask
    sides = game.orient_item(game.items, game.weights).sides
    return seen | under(game, sides, planes) | ahead(game, planes, afterstates)


def under(game: Packing, sides: Tensor, planes: Sequence[str]) -> dict[str, Tensor]:
    """What those planes need that show the bin, or look under boxes of ``sides`` [N, A, 3]."""
    made: dict[str, Tensor] = {}
    if "rest" in planes or "waste" in planes:
        made["rest"], made["waste"] = rest_and_waste(game.bins, sides, waste="waste" in planes)
    if "solid" in planes:
        made["solid"] = game.bins.empty_map == 0
    if "filled" in planes:
        made["filled"] = utilization(game.bins)[:, None].float()
    return {name: made[name] for name in planes if name in made}


def ahead(
    game: Packing,
    planes: Sequence[str],
    afterstates: AfterstateCritic | None,
    orientation: Tensor | None = None,
) -> dict[str, Tensor]:
    """What the planes need that show what placements leave: of all ways, or the one chosen [N].

    Raises:
        ValueError: if ``worth`` is asked for and nobody can say it.
    """
    made: dict[str, Tensor] = {}
    if "room" in planes or "fits" in planes:
        made = dict(zip(("room", "fits"), game.room(), strict=True))
        made["best_room"] = made["room"].flatten(1).amax(1, keepdim=True)
    if "worth" in planes:
        if afterstates is None:
            raise ValueError("the plane worth needs a critic of afterstates")
        made["worth"] = afterstates.worth(game)
    if orientation is not None:
        rows = torch.arange(game.n, device=game.device)
        for name in made.keys() & {"room", "fits", "worth"}:
            made[name] = made[name][rows, orientation][:, None]
    if "worth" in planes:
        best = made["worth"].flatten(1).amax(1, keepdim=True)
        made["best_worth"] = torch.where(best > ILLEGAL, best, 0)
    return {name: made[name] for name in made if name.removeprefix("best_") in planes}


def make_head(network: Network) -> nn.Module:
    """Features [B, C, W, D] → logits of the orientations [B, 6]."""
    return pooled_head(network, WAYS, WAYS, 0.01)
