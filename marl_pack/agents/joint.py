"""One agent in place of two: it chooses the pair (orientation, cell) at once, for comparison.

The placement agent's network with a score map for each orientation; the actions are the pairs, in
the order ``(orientation · W + x) · D + y``, masked by all six masks.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from marl_pack.agents import orientation
from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.networks.trunk import Network, ScoreMap
from marl_pack.game.packing import Packing

WAYS = orientation.WAYS


def observe(
    game: Packing, planes: Sequence[str] = (), afterstates: AfterstateCritic | None = None
) -> dict[str, Tensor]:
    """What the orientation agent sees, with ``mask`` bool [N, 6 · W · D]."""
    seen = orientation.observe(game, planes, afterstates)
    return seen | {"mask": game.mask.flatten(1)}


def make_head(network: Network) -> nn.Module:
    """Features [B, C, W, D] → logits of the pairs, [B, 6 · W · D]."""
    return ScoreMap(WAYS, network)


def split(action: Tensor, cells: int) -> tuple[Tensor, Tensor]:
    """Orientation and cell of each pair, int64 [N] each.

    Args:
        action: int64 [N].
        cells: W · D.
    """
    return action // cells, action % cells
