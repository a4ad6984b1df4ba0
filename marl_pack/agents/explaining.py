"""Explain the placements of a policy on cells: what was legal, and what its agents computed."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from marl_pack.agents.policy import Explained, Placement, Policy, Reasons
from marl_pack.explanation import Explanation
from marl_pack.game.packing import Packing
from marl_pack.geometry import resting_heights_and_waste


@torch.inference_mode()
def explain(policy: Policy, game: Packing, choice: Placement) -> list[Explanation | None]:
    """Explain the choice of a policy in each of G games.

    Args:
        policy: the policy; a policy without a method ``reasons`` gets the legal placements alone.
        game: the games, before the placement.
        choice: orientation and cell, int64 [G] each.

    Returns:
        One explanation for each game; None for games that have ended.
    """
    orientation, cell = (part.cpu() for part in choice)
    reasons = policy.reasons(game, choice[0]) if isinstance(policy, Explained) else Reasons()
    sides = game.orient_item(game.items).sides
    heights = resting_heights_and_waste(game.bins.heightmap, sides, game.size[2], waste=False)[0]
    heights, masks = heights.cpu(), game.mask.cpu()
    depth = game.size[1]
    return [
        _of_game(g, masks[g], heights[g], int(orientation[g]), int(cell[g]), depth, reasons)
        if alive
        else None
        for g, alive in enumerate(game.alive.tolist())
    ]


def _of_game(
    g: int, mask: Tensor, heights: Tensor, orientation: int, cell: int, depth: int, reasons: Reasons
) -> Explanation:
    """Return the explanation of one game.

    Args:
        g: number of the game.
        mask: bool [6, W, D], its legal placements.
        heights: int16 [6, W, D], the height at which the item would rest.
        orientation, cell: its choice.
        depth: D.
        reasons: what the policy computed.
    """
    legal = mask.nonzero().numpy()  # [M, 3]: orientation, x, y
    at = tuple(legal.T)
    chosen = np.flatnonzero((legal == (orientation, *divmod(cell, depth))).all(1))
    probabilities = None
    if reasons.probabilities is not None:
        of_cell = reasons.probabilities[g].double().cpu().numpy()
        own = of_cell[legal[:, 1] * depth + legal[:, 2]]
        probabilities = np.where(legal[:, 0] == orientation, own, np.nan)
    first, values = reasons.orientation_probabilities, reasons.values
    return Explanation(
        len(legal),
        int(chosen[0]) if len(chosen) else -1,
        legal[:, 0],
        np.column_stack((legal[:, 1:], heights.numpy()[at])).astype(np.float64),
        None if first is None else first[g].double().cpu().numpy(),
        probabilities,
        None if values is None else values[g].double().cpu().numpy()[at],
        reasons.value_of,
        None if reasons.tries is None else reasons.tries[g].cpu().numpy()[at],
    ).shortened()
