"""Heuristics: each scores every legal (orientation, cell) and takes the least.

All play on the same masks as the learned agents, so their packings are as stable. What is still
equal after a heuristic's own keys goes to the first orientation, then to the first cell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from marl_pack.agents.afterstates.afterstates import MOST_LENGTHS
from marl_pack.agents.policy import (
    Choice,
    OrientationAgent,
    PlacementAgent,
    Policy,
    draw,
    in_turns,
)
from marl_pack.bins import ORIENTATIONS
from marl_pack.game.packing import Packing
from marl_pack.stability.windows import rest_and_waste


@dataclass(frozen=True)
class View:
    """Every way to set each item down, whether legal or not; broadcastable to [N, 6, W, D]."""

    w: Tensor  # int64 [N, 6, 1, 1]   sides along x, y, z
    d: Tensor
    h: Tensor
    x: Tensor  # int64 [W, 1]         low corner
    y: Tensor  # int64 [1, D]
    z: Tensor  # int64 [N, 6, W, D]   resting height
    waste: Tensor  # int64 [N, 6, W, D]   empty cells enclosed below; none unless asked for
    size: tuple[int, int, int]


def _view(game: Packing, waste: bool = False) -> View:
    sides = game.orient_item(game.items, game.weights).sides
    w, d, h = (sides[..., k, None, None].long() for k in range(3))
    z, wasted = rest_and_waste(game.bins, sides, waste=waste)
    x = torch.arange(game.size[0], device=game.device)[:, None]
    y = torch.arange(game.size[1], device=game.device)[None, :]
    return View(w, d, h, x, y, z.long(), wasted.long(), game.size)


def _least(game: Packing, mask: Tensor | None, *keys: tuple[Tensor, int]) -> Choice:
    """The legal (orientation, cell) that is least in the first key, then in the next ones.

    Args:
        game: N bins.
        mask: bool [N, 6, W, D], what may be chosen; all that is legal by default.
        *keys: whole numbers broadcastable to [N, 6, W, D], each with a bound it stays below.
    """
    rank = torch.zeros_like(game.mask, dtype=torch.int64)
    for value, bound in keys:
        rank = rank * bound + value
    legal = game.mask if mask is None else mask
    rank = torch.where(legal, rank, torch.iinfo(torch.int64).max)
    best = rank.flatten(1).argmin(1)  # the first of equals
    cells = game.size[0] * game.size[1]
    return best // cells, best % cells


def dblf(game: Packing, mask: Tensor | None = None) -> Choice:
    """Deepest, bottom, left (Karabulut & İnceoğlu 2004): lowest z, then x, then y."""
    v = _view(game)
    return _least(game, mask, (v.z, v.size[2] + 1), (v.x, v.size[0]), (v.y, v.size[1]))


def height_min(game: Packing, mask: Tensor | None = None) -> Choice:
    """Heightmap minimisation (Wang & Hauser 2021): least c · (x + y) + sum of the new heightmap.

    With c small, as they have it: the sum decides, x + y breaks ties. Since the item's volume is
    given, the sum is least where least space is enclosed.
    """
    v = _view(game, waste=True)
    width, depth, height = v.size
    return _least(game, mask, (v.waste, width * depth * height), (v.x + v.y, width + depth))


def best_fit(game: Packing, mask: Tensor | None = None) -> Choice:
    """Best fit by wasted space: fewest empty cells enclosed, then the lowest top, then x + y."""
    v = _view(game, waste=True)
    width, depth, height = v.size
    return _least(
        game,
        mask,
        (v.waste, width * depth * height),
        ((v.z + v.h).clamp(max=height), height + 1),
        (v.x + v.y, width + depth),
    )


def most_room(game: Packing, mask: Tensor | None = None) -> Choice:
    """The placement that leaves the next item most: see :meth:`Packing.room`.

    Greatest mean number of cells where a box that may come next could be set down, then the lowest
    top, then x + y.
    """
    v = _view(game)
    width, depth, height = v.size
    most = width * depth * MOST_LENGTHS**3
    room = (game.room()[0].double() * MOST_LENGTHS**3).round().long()
    return _least(
        game,
        mask,
        (most - room, most + 1),
        ((v.z + v.h).clamp(max=height), height + 1),
        (v.x + v.y, width + depth),
    )


HEURISTICS: dict[str, Callable[[Packing, Tensor | None], Choice]] = {
    "dblf": dblf,
    "height_min": height_min,
    "best_fit": best_fit,
    "most_room": most_room,
}
"""Name -> function of the game and of what may be chosen, all that is legal if None."""

POLICIES = (*HEURISTICS, "random")
"""Names of :func:`make_policy`, and of :func:`make_placement_agent`."""

ORIENTATION_AGENTS = (*POLICIES, "first")
"""Names of :func:`make_orientation_agent`."""


def make_policy(name: str, seed: int | None = 0, device: torch.device | str = "cpu") -> Policy:
    """The policy called ``name``, for games on ``device``.

    Args:
        name: a heuristic, or ``random``: uniform among the legal orientations, then uniform among
            the cells of the chosen one.
        seed: of random play; None draws from torch's global generator.
        device: of the games.

    Raises:
        ValueError: for an unknown name.
    """
    if name in HEURISTICS:
        heuristic = HEURISTICS[name]
        return lambda game: heuristic(game, None)
    if name != "random":
        raise ValueError(f"unknown policy {name!r}: one of {', '.join(POLICIES)}")
    generator = _generator(seed, device)
    return in_turns(
        lambda game: draw(game.orientation_mask, generator),
        lambda game, orientation: draw(game.orient(orientation).mask.flatten(1), generator),
    )


def make_orientation_agent(
    name: str, seed: int | None = 0, device: torch.device | str = "cpu"
) -> OrientationAgent:
    """The first agent alone: ``random``, ``first`` or what a heuristic would choose.

    ``first`` leaves the item as it comes (orientation 0), or takes the first orientation that may
    be chosen where it could not stand so. Arguments as :func:`make_policy`.

    Raises:
        ValueError: for an unknown name.
    """
    if name == "first":
        return lambda game: game.orientation_mask.int().argmax(1)
    if name == "random":
        generator = _generator(seed, device)
        return lambda game: draw(game.orientation_mask, generator)
    if name in HEURISTICS:
        heuristic = HEURISTICS[name]
        return lambda game: heuristic(game, None)[0]
    raise ValueError(f"unknown orientation agent {name!r}: one of {', '.join(ORIENTATION_AGENTS)}")


def make_placement_agent(
    name: str, seed: int | None = 0, device: torch.device | str = "cpu"
) -> PlacementAgent:
    """The second agent alone: ``random``, or a heuristic among the cells of the orientation.

    Arguments as :func:`make_policy`.

    Raises:
        ValueError: for an unknown name.
    """
    if name == "random":
        generator = _generator(seed, device)
        return lambda game, orientation: draw(game.orient(orientation).mask.flatten(1), generator)
    if name in HEURISTICS:
        heuristic = HEURISTICS[name]
        return lambda game, orientation: heuristic(game, _only(game, orientation))[1]
    raise ValueError(f"unknown placement agent {name!r}: one of {', '.join(POLICIES)}")


def _generator(seed: int | None, device: torch.device | str) -> torch.Generator | None:
    return None if seed is None else torch.Generator(device).manual_seed(seed % 2**63)


def _only(game: Packing, orientation: Tensor) -> Tensor:
    """The mask [N, 6, W, D] with the cells of ``orientation`` [N] alone."""
    chosen = nn.functional.one_hot(orientation, len(ORIENTATIONS)).bool()
    return game.mask & chosen[:, :, None, None]
