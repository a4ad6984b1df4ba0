"""Policies for games with a buffer or several bins: heuristics, random play and greedy value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, overload

import torch
from torch import Tensor

from marl_pack.agents.afterstates.gains import gains
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.heuristics import Heuristic
from marl_pack.agents.policy import Explained, Placement, Policy, Reasons, draw
from marl_pack.game.packing import Packing
from marl_pack.game.selection import SelectionPacking

SelectionPlacement = tuple[Tensor, Tensor, Tensor]
"""(option int64 [G], orientation int64 [G], cell int64 [G])."""

SelectionPolicy = Callable[[SelectionPacking], SelectionPlacement]
"""``game -> (option, orientation, cell)``, legal wherever ``game.alive``."""

SelectionAgent = Callable[[SelectionPacking], Tensor]
"""``game -> option int64 [G]``: the choice of the selection agent."""


def split(game: SelectionPacking, number: Tensor) -> SelectionPlacement:
    """Return option, orientation and cell of placements numbered [k · b, 6, W, D], int64 [G]."""
    option, pair = number // game.floor.pairs, number % game.floor.pairs
    return option, *game.floor.split(pair)


@dataclass(frozen=True)
class SelectFirst:
    """A policy in turns: an agent selects the option, another policy places its box.

    It also plays games of one visible box and one bin, in which there is nothing to select.

    Args:
        selection_agent: selects the option.
        policy: the policy for one box and one bin, which sees the chosen option.
    """

    selection_agent: SelectionAgent
    policy: Policy

    @overload
    def __call__(self, game: Packing) -> Placement: ...

    @overload
    def __call__(self, game: SelectionPacking) -> SelectionPlacement: ...

    def __call__(self, game: Packing | SelectionPacking) -> Placement | SelectionPlacement:
        """Return option, orientation and cell of each game, int64 [G] each."""
        if isinstance(game, Packing):
            return self.policy(game)
        option = self.selection_agent(game)
        return option, *self.policy(game.view(game.rows(option)))

    def reasons(self, game: Packing, orientation: Tensor) -> Reasons:
        """Return what the other policy computed (:class:`marl_pack.agents.policy.Explained`)."""
        policy: Any = self.policy
        return policy.reasons(game, orientation) if isinstance(policy, Explained) else Reasons()


def first_option(game: SelectionPacking) -> Tensor:
    """Return the first legal option of each game, int64 [G] (:data:`SelectionAgent`)."""
    return game.selection_mask.int().argmax(1)


@dataclass(frozen=True)
class SelectAs:
    """The selection agent that takes the option of another policy's placement.

    Args:
        policy: a policy for games with selection.
    """

    policy: SelectionPolicy

    def __call__(self, game: SelectionPacking) -> Tensor:
        """Return the option, int64 [G] (:data:`SelectionAgent`)."""
        return self.policy(game)[0]


@dataclass(frozen=True)
class RankedSelection:
    """A heuristic over all options: the placement with the lowest keys in any option.

    Of equal placements the one of the first option counts.

    Args:
        heuristic: the heuristic for one box and one bin.
    """

    heuristic: Heuristic

    def __call__(self, game: SelectionPacking) -> SelectionPlacement:
        """Return option, orientation and cell of each game, int64 [G] each."""
        rank = self.heuristic.rank(game.view())
        worst = torch.iinfo(rank.dtype).max
        rank = torch.where(game.state.mask.flatten(0, 1), rank, worst)
        return split(game, rank.view(game.n, -1).argmin(1))


@dataclass(frozen=True)
class RandomSelection:
    """Random play: one of the legal options, of its orientations, and of its cells, each uniformly.

    Args:
        policy: random play for one box and one bin.
        generator: of random numbers; torch's global generator by default.
    """

    policy: Policy
    generator: torch.Generator | None = None

    def __call__(self, game: SelectionPacking) -> SelectionPlacement:
        """Return option, orientation and cell of each game, int64 [G] each."""
        option = draw(game.selection_mask, self.generator)
        return option, *self.policy(game.view(game.rows(option)))


@dataclass(frozen=True)
class GreedyValue:
    """The placement that gains most: its reward plus the change of the value of its bin.

    The value of a bin is the return that a critic of afterstates expects from it, whatever comes.

    Args:
        lookahead: computes the values.
    """

    lookahead: Lookahead

    @torch.inference_mode()
    def __call__(self, game: SelectionPacking) -> SelectionPlacement:
        """Return option, orientation and cell of each game, int64 [G] each."""
        return split(game, gains(game, self.lookahead).flatten(1).argmax(1))
