"""Behaviour cloning: an agent begins by learning the choices of a teacher."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from marl_pack.agents.networks.kinds import AgentKind
from marl_pack.agents.policy import draw
from marl_pack.game.packing import Packing

RANDOM_SHARE = 0.1  # of a teacher's choices are replaced, so that the learner keeps exploring


@dataclass(frozen=True)
class Teacher:
    """The agent whose choices a learner clones, and for how many iterations.

    Args:
        kind: of the teacher and of the learner.
        agent: the teacher: the games and the choices before → actions int64 [G].
        iterations: how long the learner clones it.
    """

    kind: AgentKind
    agent: Callable[..., Tensor]
    iterations: int

    def __call__(self, game: Packing, *before: Tensor) -> Tensor:
        """Return the teacher's actions, int64 [G], a tenth of them replaced by random ones."""
        actions = self.agent(game, *before)
        replaced = torch.rand(len(actions), device=actions.device) < RANDOM_SHARE
        return torch.where(replaced, self._random(game, *before), actions)

    def _random(self, game: Packing, *before: Tensor) -> Tensor:
        """Draw uniformly among the actions that lead to a legal placement."""
        if self.kind.acts_on_cells:
            return draw(game.moves.of(*before).flatten(1))
        return draw(game.moves.orientations)
