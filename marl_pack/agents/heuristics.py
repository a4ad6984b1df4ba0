"""Heuristics: each scores every legal (orientation, cell) and takes the least.

All play on the same masks as the learned agents, so their packings are as stable. What is still
equal after a heuristic's own keys goes to the first orientation, then to the first cell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from marl_pack.agents.policy import Policy, draw
from marl_pack.packing import Packing
from marl_pack.stability.hull_torch import resting_height


def _window_sum(heightmap: Tensor, w: Tensor, d: Tensor) -> Tensor:
    """Sum of the heights under every w × d window, int64 [N, A, W, D], by a summed-area table.

    Args:
        heightmap: int16 [N, W, D].
        w: int64 [N, A, 1, 1].
        d: int64 [N, A, 1, 1].
    """
    n, width, depth = heightmap.shape
    table = torch.zeros(n, width + 1, depth + 1, dtype=torch.int64, device=heightmap.device)
    table[:, 1:, 1:] = heightmap.long().cumsum(1).cumsum(2)
    x = torch.arange(width, device=heightmap.device)
    y = torch.arange(depth, device=heightmap.device)
    x, y = x[:, None], y[None, :]
    far_x, far_y = (x + w).clamp(max=width), (y + d).clamp(max=depth)  # [N, A, W, 1], [N, A, 1, D]
    b = torch.arange(n, device=heightmap.device)[:, None, None, None]
    return table[b, far_x, far_y] - table[b, x, far_y] - table[b, far_x, y] + table[b, x, y]


@dataclass(frozen=True)
class View:
    """Every way to set each item down, whether legal or not; broadcastable to [N, 6, W, D]."""

    w: Tensor  # int64 [N, 6, 1, 1]   sides along x, y, z
    d: Tensor
    h: Tensor
    x: Tensor  # int64 [W, 1]         low corner
    y: Tensor  # int64 [1, D]
    z: Tensor  # int64 [N, 6, W, D]   resting height
    size: tuple[int, int, int]


def _view(game: Packing) -> View:
    sides = game.candidates(game.items, game.weights).sides
    w, d, h = (sides[..., k, None, None].long() for k in range(3))
    z = resting_height(game.bins.heightmap, sides).long()
    x = torch.arange(game.size[0], device=game.device)[:, None]
    y = torch.arange(game.size[1], device=game.device)[None, :]
    return View(w, d, h, x, y, z, game.size)


def _waste(game: Packing, v: View) -> Tensor:
    """Empty cells enclosed below the item, int64 [N, 6, W, D]; 0 where it does not fit."""
    below = _window_sum(game.bins.heightmap, v.w, v.d)
    return (v.w * v.d * v.z - below).clamp(min=0)


def _least(game: Packing, *keys: tuple[Tensor, int]) -> tuple[Tensor, Tensor]:
    """The legal (orientation, cell) that is least in the first key, then in the next ones.

    Args:
        game: N bins.
        *keys: whole numbers broadcastable to [N, 6, W, D], each with a bound it stays below.
    """
    rank = torch.zeros_like(game.mask, dtype=torch.int64)
    for value, bound in keys:
        rank = rank * bound + value
    rank = torch.where(game.mask, rank, torch.iinfo(torch.int64).max)
    best = rank.flatten(1).argmin(1)  # the first of equals
    cells = game.size[0] * game.size[1]
    return best // cells, best % cells


def dblf(game: Packing) -> tuple[Tensor, Tensor]:
    """Deepest, bottom, left (Karabulut & İnceoğlu 2004): lowest z, then x, then y."""
    v = _view(game)
    return _least(game, (v.z, v.size[2] + 1), (v.x, v.size[0]), (v.y, v.size[1]))


def height_min(game: Packing) -> tuple[Tensor, Tensor]:
    """Heightmap minimisation (Wang & Hauser 2021): least c · (x + y) + sum of the new heightmap.

    With c small, as they have it: the sum decides, x + y breaks ties. Since the item's volume is
    given, the sum is least where least space is enclosed.
    """
    v = _view(game)
    width, depth, height = v.size
    return _least(game, (_waste(game, v), width * depth * height), (v.x + v.y, width + depth))


def best_fit(game: Packing) -> tuple[Tensor, Tensor]:
    """Best fit by wasted space: fewest empty cells enclosed, then the lowest top, then x + y."""
    v = _view(game)
    width, depth, height = v.size
    return _least(
        game,
        (_waste(game, v), width * depth * height),
        ((v.z + v.h).clamp(max=height), height + 1),
        (v.x + v.y, width + depth),
    )


def random_policy(seed: int, device: torch.device | str = "cpu") -> Policy:
    """Uniform among the legal orientations, then uniform among the cells of the chosen one."""
    generator = torch.Generator(device).manual_seed(seed % 2**63)

    def play(game: Packing) -> tuple[Tensor, Tensor]:
        orientation = draw(game.orientation_mask, generator)
        return orientation, draw(game.orient(orientation).mask.flatten(1), generator)

    return play


HEURISTICS: dict[str, Callable[[int, torch.device | str], Policy]] = {
    "dblf": lambda seed, device: dblf,
    "height_min": lambda seed, device: height_min,
    "best_fit": lambda seed, device: best_fit,
    "random": random_policy,
}
"""Name -> function of a seed and a device that makes the policy (only ``random`` uses them)."""


def make_policy(name: str, seed: int = 0, device: torch.device | str = "cpu") -> Policy:
    """The policy called ``name``, for games on ``device``.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in HEURISTICS:
        raise ValueError(f"unknown policy {name!r}: one of {', '.join(HEURISTICS)}")
    return HEURISTICS[name](seed, device)
