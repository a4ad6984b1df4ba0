"""The orientation agent π_o: sees the bin and the item as it comes, chooses one of six ways.

Its mask excludes the orientations without a legal cell (paper, sec. III-D).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from marl_pack.agents.trunk import Network, pooled_head
from marl_pack.bins import ORIENTATIONS, utilization
from marl_pack.packing import Packing
from marl_pack.stability.windows import rest_and_waste

WAYS = len(ORIENTATIONS)


def observe(game: Packing, planes: Sequence[str] = ()) -> dict[str, Tensor]:
    """What the agent sees of N bins.

    Args:
        game: the bins.
        planes: extra planes (:data:`marl_pack.agents.trunk.PLANES`), for all orientations.

    Returns:
        ``heightmap`` int16 [N, W, D] (a copy), ``item`` int16 [N, 3] (its own sides w, d, h),
        ``height`` int16 [N, 1], ``mask`` bool [N, 6], and what the planes need: ``cells`` bool,
        ``rest`` int16, ``waste`` int32, ``room`` and ``fits`` float32 [N, 6, W, D], ``best_room``
        float32 [N, 1], ``solid`` bool [N, W, D], ``filled`` float32 [N, 1].
    """
    seen = {
        "heightmap": game.bins.heightmap.clone(),
        "item": game.items,
        "height": game.bin_height,
        "mask": game.orientation_mask,
    }
    if "mask" in planes:
        seen["cells"] = game.mask
    sides = game.candidates(game.items, game.weights).sides
    return seen | under(game, sides, planes) | ahead(game, planes)


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
    game: Packing, planes: Sequence[str], orientation: Tensor | None = None
) -> dict[str, Tensor]:
    """What the planes ``room`` and ``fits`` need if asked for: all ways, or the one chosen [N]."""
    wanted = [name for name in ("room", "fits") if name in planes]
    if not wanted:
        return {}
    made = dict(zip(("room", "fits"), game.room(), strict=True))
    best = made["room"].flatten(1).amax(1, keepdim=True)
    if orientation is not None:
        rows = torch.arange(game.n, device=game.device)
        made = {name: values[rows, orientation][:, None] for name, values in made.items()}
    found = {name: made[name] for name in wanted}
    return found | {"best_room": best} if "room" in wanted else found


def make_head(network: Network) -> nn.Module:
    """Features [B, C, W, D] → logits of the orientations [B, 6]."""
    return pooled_head(network, WAYS, WAYS, 0.01)
