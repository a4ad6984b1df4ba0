"""The symmetries of the bin: mirrored observations and actions, and averages over symmetries.

Mirroring the bin along x or y and, if W = D, exchanging x and y change nothing in the game: a box
in the mirrored bin is as stable as before. The entry of a placement is at the low corner of its
window, so where it moves depends on the item's sides. Exchanging x and y also exchanges
orientations o and o ^ 1. How a tensor of an observation moves follows from its shape
(:mod:`marl_pack.agents.networks.planes`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from marl_pack.agents.networks.actor_critic import Actor
from marl_pack.agents.networks.kinds import AGENT_KINDS, AgentKind
from marl_pack.agents.networks.sight import Observation
from marl_pack.game.moves import Floor
from marl_pack.geometry import oriented


def count(width: int, depth: int) -> int:
    """Count the symmetries of a W × D bin, the identity included."""
    return 8 if width == depth else 4


def mean_probabilities(actor: Actor, observation: Observation, agent: str) -> Tensor:
    """Average the probability of each action over the bin's symmetries, float32 [G, K].

    The actor judges the same decision once for each symmetry of the bin. If centres of mass are off
    centre, or an item may take orientation o but not o ^ 1, the mirrored state is only nearly a
    state of the game. The mask is always the game's mask.

    Args:
        actor: the agent's network.
        observation: the agent's observation.
        agent: name in :data:`marl_pack.agents.networks.kinds.AGENT_KINDS`.
    """
    mask, item = observation["mask"], observation["item"]
    shape = observation["heightmap"].shape[1:]
    actions = torch.arange(mask.shape[1], device=mask.device).expand(len(mask), -1)
    total = torch.zeros(mask.shape, device=mask.device)
    symmetries = count(*shape)
    for number in range(symmetries):
        symmetry = torch.full((len(mask),), number, device=mask.device)
        log_probs = actor.log_probs(mirror_observation(observation, agent, symmetry))
        total += log_probs.exp().gather(1, mirror_actions(actions, item, shape, agent, symmetry))
    return total / symmetries


def _exchanged(swap: Tensor, a: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Return (a, c), or (c, a) in the games that are exchanged."""
    wide = swap.view(-1, *[1] * (a.dim() - 1))
    return torch.where(wide, c, a), torch.where(wide, a, c)


def _mirrored(low: Tensor, side: Tensor | int, length: int, flip: Tensor) -> Tensor:
    """Return the low corners in a mirrored bin; positions that are never legal stay in range."""
    return torch.where(flip, (length - side - low) % length, low)


def _bits(symmetry: Tensor) -> Iterator[Tensor]:
    return ((symmetry >> bit & 1).bool() for bit in range(3))


def _judged_sides(item: Tensor, kind: AgentKind) -> Tensor:
    """Return the sides of the item in the A orientations that the agent judges, [B, A, 3]."""
    return item[:, None] if kind.orientations == 1 else oriented(item)


def mirror_observation(observation: Observation, agent: str, symmetry: Tensor) -> dict[str, Tensor]:
    """Apply a symmetry of the bin to the observation of each of B games.

    Args:
        observation: the agent's observation.
        agent: name in :data:`marl_pack.agents.networks.kinds.AGENT_KINDS`.
        symmetry: int64 [B], bits: 1 mirrors x, 2 mirrors y, then 4 exchanges x and y (W = D).
    """
    kind = AGENT_KINDS[agent]
    flip_x, flip_y, swap = _bits(symmetry)
    heightmap, item = observation["heightmap"], observation["item"]
    size, (width, depth) = len(heightmap), heightmap.shape[1:]
    device = heightmap.device
    b = torch.arange(size, device=device)
    x, y = torch.arange(width, device=device), torch.arange(depth, device=device)
    sides = _judged_sides(item, kind)

    # Each cell (x, y) of a new map takes its value from a cell of the old map. To find that cell,
    # undo the exchange first, then the mirrors.
    from_x, from_y = _exchanged(
        swap,
        x[None, :, None].expand(size, width, depth),
        y[None, None, :].expand(size, width, depth),
    )
    old_cell = (
        b[:, None, None],
        _mirrored(from_x, 1, width, flip_x[:, None, None]),
        _mirrored(from_y, 1, depth, flip_y[:, None, None]),
    )
    orientation = torch.arange(kind.orientations, device=device).expand(size, -1)
    if kind.orientations > 1:
        orientation = torch.where(swap[:, None], orientation ^ 1, orientation)
    side = sides.long().gather(1, orientation[..., None].expand(-1, -1, 3))  # in the old bin
    wide_x, wide_y = (flip[:, None, None, None] for flip in (flip_x, flip_y))
    old_x = _mirrored(from_x[:, None], side[..., 0, None, None], width, wide_x)
    old_y = _mirrored(from_y[:, None], side[..., 1, None, None], depth, wide_y)

    def placements(values: Tensor) -> Tensor:
        return values[b[:, None, None, None], orientation[..., None, None], old_x, old_y]

    mirrored = dict(observation.items())
    for name, values in mirrored.items():
        if values.dim() == 4:
            mirrored[name] = placements(values)
        elif values.dim() == 3:
            mirrored[name] = values[old_cell]
    mask = mirrored["mask"]
    if kind.acts_on_cells:
        by_cell = mask.view(size, kind.orientations, width, depth)
        mirrored["mask"] = placements(by_cell).flatten(1)
    else:
        mirrored["mask"] = mask.gather(1, orientation)
    if kind.orientations == 1:
        exchanged = torch.stack((item[:, 1], item[:, 0], item[:, 2]), 1)
        mirrored["item"] = torch.where(swap[:, None], exchanged, item)
    return mirrored


def mirror_actions(
    actions: Tensor, item: Tensor, shape: Sequence[int], agent: str, symmetry: Tensor
) -> Tensor:
    """Return the actions that place the items at the mirrored places, int64 [B, K].

    Args:
        actions: int64 [B, K], any number of actions for each game.
        item: the sides of the items, as the agent observes them.
        shape: W and D of the bin that is mirrored.
        agent, symmetry: as for :func:`mirror_observation`.
    """
    # Actions move from the old bin to the new one: first the mirrors, then the exchange.
    kind = AGENT_KINDS[agent]
    flip_x, flip_y, swap = (bit[:, None] for bit in _bits(symmetry))
    if not kind.acts_on_cells:
        return torch.where(swap, actions ^ 1, actions)
    width, depth = shape
    floor = Floor(width, depth)
    orientation, cell = floor.split(actions)
    x, y = floor.corner(cell)
    sides = _judged_sides(item, kind)
    side = sides.long().gather(1, orientation[..., None].expand(-1, -1, 3))
    new_x, new_y = _exchanged(
        swap.squeeze(1),
        _mirrored(x, side[..., 0], width, flip_x),
        _mirrored(y, side[..., 1], depth, flip_y),
    )
    if kind.orientations > 1:
        orientation = torch.where(swap, orientation ^ 1, orientation)
    return floor.pair(orientation, floor.cell(new_x, new_y))
