"""Make games in the middle of random play under a rule, for timing masks."""

from __future__ import annotations

import torch

from marl_pack.agents.heuristics import make_policy
from marl_pack.game.packing import Packing

SMALL = ((10, 10, 10), (2, 5))
"""Bin and sides of the published data sets."""
LARGE = ((120, 120, 120), (6, 60))
"""The paper's Table 1: a 0.6 m bin in 5 mm cells, sides 0.03 to 0.3 m."""


def in_play(
    n: int,
    place: tuple[tuple[int, int, int], tuple[int, int]],
    rule: str = "hull_alpha",
    policy: str = "random",
    steps: int = 40,
    device: str = "cpu",
) -> Packing:
    """Return N games after some steps; their episodes are at different stages."""
    size, sides = place
    game = Packing(n, size, sides=sides, rule=rule, device=device, seed=1)
    player = make_policy(policy, 1, device)
    for _ in range(steps):
        game.place(*player(game))
    return game


def random_items(n: int, sides: tuple[int, int], device: str = "cpu") -> torch.Tensor:
    """Return random items, int16 [N, 3]."""
    generator = torch.Generator().manual_seed(2)
    return torch.randint(sides[0], sides[1] + 1, (n, 3), generator=generator).short().to(device)
