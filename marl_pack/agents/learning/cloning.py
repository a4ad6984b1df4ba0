"""Behaviour cloning: in its first iterations an agent learns the choices of a teacher."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from marl_pack.agents.networks.kinds import AgentKind
from marl_pack.agents.policy import draw


@dataclass(frozen=True)
class Teacher:
    """The agent whose choices a learner clones, and for how many iterations.

    Args:
        kind: the kind of teacher and learner; None for the selection agent.
        agent: the teacher: games and earlier choices of the turn → actions int64 [G].
        iterations: number of iterations in which the learner clones it.
        random_share: share of its choices that are random instead, so that the learner explores.
    """

    kind: AgentKind | None
    agent: Callable[..., Tensor]
    iterations: int
    random_share: float

    def __call__(self, game: Any, *before: Tensor) -> Tensor:
        """Return the teacher's actions, int64 [G], some of them replaced by random ones."""
        actions = self.agent(game, *before)
        replaced = torch.rand(len(actions), device=actions.device) < self.random_share
        return torch.where(replaced, self._random(game, *before), actions)

    def _random(self, game: Any, *before: Tensor) -> Tensor:
        """Draw uniformly among the actions that lead to a legal placement."""
        if self.kind is None:
            return draw(game.selection_mask)
        if self.kind.acts_on_cells:
            return draw(game.mask, None, *before)
        return draw(game.moves.orientations)
