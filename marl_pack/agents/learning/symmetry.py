"""The bin's symmetries: augmentation of what PPO learns from, and agents asked in all of them.

Mirroring the bin along x or y and, where W = D, exchanging x and y change nothing in the game: a
box set down in the mirrored bin stands as it did. Masks and planes lie at the window's low corner,
which moves with the item's sides; exchanging x and y also exchanges orientations o and o ^ 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from torch import Tensor

from marl_pack.agents.networks.actor_critic import Actor
from marl_pack.bins import oriented

MAPS = (
    "cells",
    "rest",
    "waste",
    "room",
    "fits",
    "worth",
)  # observations [B, A, W, D] that lie at low corners


def count(width: int, depth: int) -> int:
    """How many symmetries a W × D bin has, the one that changes nothing included."""
    return 8 if width == depth else 4


def mean_probabilities(actor: Actor, observation: Mapping[str, Tensor], agent: str) -> Tensor:
    """How probable each action is in the mean over the bin's symmetries, float32 [N, K].

    The actor judges the same decision as often as the bin has symmetries. Where items have their
    centre of mass off centre, or o may be chosen but not o ^ 1, a mirrored state is only nearly one
    of the game; what is legal stays what the game says.

    Args:
        actor: the agent's network.
        observation: of the agent, as its ``observe`` gives it.
        agent: ``orientation``, ``placement`` or ``joint``.
    """
    mask, item = observation["mask"], observation["item"]
    shape = observation["heightmap"].shape[1:]
    actions = torch.arange(mask.shape[1], device=mask.device).expand(len(mask), -1)
    total = torch.zeros(mask.shape, device=mask.device)
    kinds = count(*shape)
    for kind in range(kinds):
        symmetry = torch.full((len(mask),), kind, device=mask.device)
        log_probs = actor.log_probs(see(observation, agent, symmetry))
        total += log_probs.exp().gather(1, carry(actions, item, shape, agent, symmetry))
    return total / kinds


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
            symmetry = torch.randint(
                count(width, depth), (storage.num_envs,), device=storage.device
            )
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
    observation: Mapping[str, Tensor], actions: Tensor, agent: str, symmetry: Tensor
) -> tuple[Any, Tensor]:
    """Observations and actions of B bins after each one's symmetry.

    Args:
        observation: of the agent, as its ``observe`` gives it.
        actions: float or int [B, 1], the agent's actions.
        agent: ``orientation``, ``placement`` or ``joint``.
        symmetry: int64 [B], bits: 1 mirrors x, 2 mirrors y, then 4 exchanges x and y (W = D).

    Returns:
        The same groups and the actions that set the items down in the same, now mirrored, places.
    """
    shape = observation["heightmap"].shape[1:]
    moved = carry(actions.long(), observation["item"], shape, agent, symmetry)
    return see(observation, agent, symmetry), moved.to(actions.dtype)


def _exchanged(swap: Tensor, a: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """(a, c), or (c, a) in the bins that are exchanged."""
    wide = swap.view(-1, *[1] * (a.dim() - 1))
    return torch.where(wide, c, a), torch.where(wide, a, c)


def _mirrored(low: Tensor, side: Tensor | int, length: int, flip: Tensor) -> Tensor:
    """Where low corners lie in a mirrored bin; positions that never fit stay in range."""
    return torch.where(flip, (length - side - low) % length, low)


def _bits(symmetry: Tensor) -> Iterator[Tensor]:
    return ((symmetry >> bit & 1).bool() for bit in range(3))


def see(observation: Mapping[str, Tensor], agent: str, symmetry: Tensor) -> Any:
    """The observations of :func:`transform`."""
    flip_x, flip_y, swap = _bits(symmetry)
    heightmap, item = observation["heightmap"], observation["item"]
    size, (width, depth) = len(heightmap), heightmap.shape[1:]
    device = heightmap.device
    b = torch.arange(size, device=device)
    x, y = torch.arange(width, device=device), torch.arange(depth, device=device)
    ways = 1 if agent == "placement" else 6
    sides = item[:, None] if agent == "placement" else oriented(item)  # [B, A, 3]

    # The maps are read backwards: the new map's cell (x, y) shows an old one's. Undo the exchange
    # first, then the mirrors.
    seen = dict(observation.items())
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
    for name in ("heightmap", "solid"):
        if name in seen:
            seen[name] = seen[name][old_cell]
    way = torch.arange(ways, device=device).expand(size, ways)
    if ways > 1:
        way = torch.where(swap[:, None], way ^ 1, way)
    side = sides.long().gather(1, way[..., None].expand(-1, -1, 3))  # of the old orientation
    wide_x, wide_y = (flip[:, None, None, None] for flip in (flip_x, flip_y))
    old_x = _mirrored(from_x[:, None], side[..., 0, None, None], width, wide_x)
    old_y = _mirrored(from_y[:, None], side[..., 1, None, None], depth, wide_y)

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
    return _like(observation, seen)


def carry(
    actions: Tensor, item: Tensor, shape: Sequence[int], agent: str, symmetry: Tensor
) -> Tensor:
    """The actions of :func:`transform`, any number of each bin's, int64 [B, K]."""
    # Actions are carried forwards: mirrors first, then the exchange.
    flip_x, flip_y, swap = (bit[:, None] for bit in _bits(symmetry))
    if agent == "orientation":
        return torch.where(swap, actions ^ 1, actions)
    width, depth = shape
    chosen, cell = actions // (width * depth), actions % (width * depth)
    sides = item[:, None] if agent == "placement" else oriented(item)  # [B, A, 3]
    own = sides.long().gather(1, chosen[..., None].expand(-1, -1, 3))
    new_x, new_y = _exchanged(
        swap.squeeze(1),
        _mirrored(cell // depth, own[..., 0], width, flip_x),
        _mirrored(cell % depth, own[..., 1], depth, flip_y),
    )
    chosen = torch.where(swap, chosen ^ 1, chosen) if agent == "joint" else chosen
    return chosen * width * depth + new_x * depth + new_y


def _like(original: Any, seen: dict[str, Tensor]) -> Any:
    """The groups in the container they came in, a TensorDict or a dict."""
    return seen if isinstance(original, dict) else type(original)(seen, original.batch_size)
