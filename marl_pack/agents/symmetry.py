"""The bin's symmetries, as augmentation of what PPO learns from.

Mirroring the bin along x or y and, where W = D, exchanging x and y change nothing in the game: a
box set down in the mirrored bin stands as it did. Masks and planes lie at the window's low corner,
which moves with the item's sides; exchanging x and y also exchanges orientations o and o ^ 1.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.algorithms import PPO
from torch import Tensor

from marl_pack.bins import oriented

MAPS = (
    "cells",
    "rest",
    "waste",
    "room",
    "fits",
)  # observations [B, A, W, D] that lie at low corners


def see_through_symmetries(ppo: PPO, agent: str) -> None:
    """Show a rollout to its update through a symmetry of the bin drawn for each sample.

    Rewards and returns are as they were. The old log-probabilities, distributions and values become
    those of what is seen now, so that the update begins from ratios of 1.

    Args:
        ppo: whose storage is full.
        agent: ``orientation``, ``placement`` or ``joint``.
    """
    storage = ppo.storage
    with torch.inference_mode():
        for step in range(storage.num_transitions_per_env):
            seen = storage.observations[step]
            width, depth = seen["heightmap"].shape[1:]
            kinds = 8 if width == depth else 4
            symmetry = torch.randint(kinds, (storage.num_envs,), device=storage.device)
            moved, actions = transform(seen, storage.actions[step], agent, symmetry)
            seen.copy_(moved)
            storage.actions[step].copy_(actions)
            ppo.actor(seen, stochastic_output=True)
            storage.values[step].copy_(ppo.critic(seen))
            log_prob = ppo.actor.get_output_log_prob(actions)
            storage.actions_log_prob[step].copy_(log_prob[:, None])
            new = ppo.actor.output_distribution_params
            for kept, parameter in zip(storage.distribution_params, new, strict=True):
                kept[step].copy_(parameter)


def transform(
    observation: dict[str, Tensor], actions: Tensor, agent: str, symmetry: Tensor
) -> tuple[dict[str, Tensor], Tensor]:
    """Observations and actions of B bins after each one's symmetry.

    Args:
        observation: of the agent, as its ``observe`` gives it.
        actions: float or int [B, 1], the agent's actions.
        agent: ``orientation``, ``placement`` or ``joint``.
        symmetry: int64 [B], bits: 1 mirrors x, 2 mirrors y, then 4 exchanges x and y (W = D).

    Returns:
        The same groups and the actions that set the items down in the same, now mirrored, places.
    """
    flip_x, flip_y, swap = ((symmetry >> bit & 1).bool() for bit in range(3))
    heightmap, item = observation["heightmap"], observation["item"]
    size, (width, depth) = len(heightmap), heightmap.shape[1:]
    device = heightmap.device
    b = torch.arange(size, device=device)
    x, y = torch.arange(width, device=device), torch.arange(depth, device=device)
    ways = 1 if agent == "placement" else 6
    sides = item[:, None] if agent == "placement" else oriented(item)  # [B, A, 3]

    def mirrored(low: Tensor, side: Tensor, length: int, flip: Tensor) -> Tensor:
        """Where low corners lie in a mirrored bin; positions that never fit stay in range."""
        return torch.where(flip, (length - side - low) % length, low)

    def exchanged(a: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """(a, c), or (c, a) in the bins that are exchanged."""
        wide = swap.view(-1, *[1] * (a.dim() - 1))
        return torch.where(wide, c, a), torch.where(wide, a, c)

    # The maps are read backwards: the new map's cell (x, y) shows an old one's. Undo the exchange
    # first, then the mirrors.
    seen = dict(observation.items())
    from_x, from_y = exchanged(
        x[None, :, None].expand(size, width, depth), y[None, None, :].expand(size, width, depth)
    )
    one = torch.ones((), dtype=torch.int64, device=device)
    old_cell = (
        b[:, None, None],
        mirrored(from_x, one, width, flip_x[:, None, None]),
        mirrored(from_y, one, depth, flip_y[:, None, None]),
    )
    for name in ("heightmap", "solid"):
        if name in seen:
            seen[name] = seen[name][old_cell]
    way = torch.arange(ways, device=device).expand(size, ways)
    if ways > 1:
        way = torch.where(swap[:, None], way ^ 1, way)
    side = sides.long().gather(1, way[..., None].expand(-1, -1, 3))  # of the old orientation
    old_x = mirrored(from_x[:, None], side[..., 0, None, None], width, flip_x[:, None, None, None])
    old_y = mirrored(from_y[:, None], side[..., 1, None, None], depth, flip_y[:, None, None, None])

    def maps(values: Tensor) -> Tensor:
        return values[b[:, None, None, None], way[..., None, None], old_x, old_y]

    for name in MAPS:
        if name in seen:
            seen[name] = maps(seen[name])
    if agent == "orientation":
        seen["mask"] = seen["mask"].gather(1, way)
    else:
        seen["mask"] = maps(seen["mask"].view(size, ways, width, depth)).flatten(1)
    if agent == "placement":
        turned = torch.stack((item[:, 1], item[:, 0], item[:, 2]), 1)
        seen["item"] = torch.where(swap[:, None], turned, item)

    # The actions are carried forwards: mirrors first, then the exchange.
    action = actions.long().squeeze(-1)
    cells = width * depth
    if agent == "orientation":
        moved = torch.where(swap, action ^ 1, action)
    else:
        chosen, cell = action // cells, action % cells
        own = sides.long()[b, chosen]
        new_x, new_y = exchanged(
            mirrored(cell // depth, own[:, 0], width, flip_x),
            mirrored(cell % depth, own[:, 1], depth, flip_y),
        )
        chosen = torch.where(swap, chosen ^ 1, chosen) if agent == "joint" else chosen
        moved = chosen * cells + new_x * depth + new_y
    return _like(observation, seen), moved[:, None].to(actions.dtype)


def _like(original: Any, seen: dict[str, Tensor]) -> Any:
    """The groups in the container they came in, a TensorDict or a dict."""
    return seen if isinstance(original, dict) else type(original)(seen, original.batch_size)
