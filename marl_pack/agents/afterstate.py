"""What a bin is worth after a placement: a small critic of afterstates, whose word agents see.

An afterstate is the bin with the item set down and the next one not yet seen (Sutton & Barto 2018,
sec. 6.8). The critic tells the return that is still to come from what the placement leaves
(:class:`marl_pack.stability.room.Left`): in how many cells each box that may come could be set
down, how high the columns are and how rough the surface. None of it changes when the bin is
mirrored or turned. It learns the agents' own returns, each placement's less its reward, beside
their PPOs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from marl_pack.agents.trunk import initialized
from marl_pack.packing import Packing
from marl_pack.stability.room import MOST_LENGTHS, SURFACE, Left

PAIRS = MOST_LENGTHS * (MOST_LENGTHS + 1) // 2
FEATURES = 2 + PAIRS * MOST_LENGTHS + SURFACE
"""Numbers that the critic sees of an afterstate."""
HIDDEN = 64
REMEMBERED = 64
"""Rollouts that it learns from, the last ones."""
UPDATES, MINIBATCH = 32, 512
"""Steps of its optimiser after each rollout, and afterstates in each."""
ILLEGAL = -1.0
"""What a placement that is not legal counts as worth: less than any that is."""


def features(left: Left, volume: int, rows: Tensor | None = None) -> Tensor:
    """What the critic sees, float32 [K, :data:`FEATURES`].

    Counts come as logarithms, those of a footprint and of the same turned by 90° as one; boxes of
    fewer than :data:`MOST_LENGTHS` lengths take the places of the longest.

    Args:
        left: what placements would leave.
        volume: W · D · H.
        rows: int64 [K], of these placements alone.
    """
    counts, surface, filled = left.counts, left.surface, left.filled
    if rows is not None:
        counts, surface, filled = counts[rows], surface[rows], filled[rows]
    lengths = counts.shape[1]
    first = MOST_LENGTHS - lengths
    both = counts + counts.transpose(1, 2)
    i, j = torch.triu_indices(lengths, lengths, device=counts.device)
    w, _ = torch.triu_indices(MOST_LENGTHS, MOST_LENGTHS, device=counts.device)
    seen = torch.zeros(len(counts), FEATURES, device=counts.device)
    boxes = seen[:, 2 : 2 + PAIRS * MOST_LENGTHS].view(-1, PAIRS, MOST_LENGTHS)
    known = (w >= first).nonzero().squeeze(1)  # in the order of i, j
    boxes[:, known, first:] = both[:, i, j].float().log1p() / 2
    share = filled.float() / volume
    seen[:, 0], seen[:, 1] = share, share.square()
    seen[:, 2 + PAIRS * MOST_LENGTHS :] = 2 * surface
    return seen


class AfterstateCritic(nn.Module):
    """Features of afterstates [K, :data:`FEATURES`] → the return still to come [K]."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            initialized(nn.Linear(FEATURES, HIDDEN)), nn.ReLU(),
            initialized(nn.Linear(HIDDEN, HIDDEN)), nn.ReLU(),
            initialized(nn.Linear(HIDDEN, 1), 0.01),
        )  # fmt: skip

    def forward(self, seen: Tensor) -> Tensor:
        """Values, float32 [K]."""
        value: Tensor = self.layers(seen).squeeze(1)
        return value

    def worth(self, game: Packing) -> Tensor:
        """Reward (Eq. 5) and value of each placement, float32 [N, 6, W, D].

        Where none is legal, :data:`ILLEGAL`. Made once a turn; after the weights have changed,
        ``game.forget(critic)``.
        """
        return game.once(self, lambda: self._worth(game))

    def _worth(self, game: Packing) -> Tensor:
        left = game.left()
        with torch.no_grad():
            value = self(features(left, game.volume))
        reward = (game.alpha * left.volume - game.beta * left.waste) / game.volume
        return left.spread((reward + value).float(), game.mask, ILLEGAL)


class AfterstateLearner:
    """Fits the critic to what the placements of the last rollouts have brought.

    A placement's outcome is mostly luck, so the critic learns from many: from the last
    :data:`REMEMBERED` rollouts, which agents played that were nearly those of now.

    Args:
        critic: the critic.
        steps, bins: T and N of a rollout.
        learning_rate: of Adam, unless :meth:`learn` is told another.
    """

    def __init__(
        self, critic: AfterstateCritic, steps: int, bins: int, learning_rate: float
    ) -> None:
        self.critic = critic
        self.optimizer = torch.optim.Adam(critic.parameters(), learning_rate)
        device = next(critic.parameters()).device
        shape = REMEMBERED, steps, bins
        self.seen = torch.zeros(*shape, FEATURES, dtype=torch.float16, device=device)
        self.wanted = torch.zeros(shape, device=device)
        self.rollouts, self.step = 0, 0  # recorded so far, and steps of the next one

    def record(self, game: Packing, orientation: Tensor, cell: Tensor) -> None:
        """Keep the afterstates of what is now set down, int64 [N] each."""
        left = game.left()
        x, y = cell // game.size[1], cell % game.size[1]
        rows = left.index[torch.arange(game.n, device=cell.device), orientation, x, y]
        self.seen[self.rollouts % REMEMBERED, self.step] = features(left, game.volume, rows).half()
        self.step += 1

    def learn(
        self, returns: Tensor, rewards: Tensor, learning_rate: float, processes: int = 1
    ) -> float:
        """Learn once the rollout that was recorded has ended.

        Args:
            returns: float32 [T, N, 1], of each placement, its reward included.
            rewards: float32 [T, N, 1].
            learning_rate: of this update.
            processes: that learn together, whose gradients are averaged.

        Returns:
            The mean squared error.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate
        self.wanted[self.rollouts % REMEMBERED] = (returns - rewards).squeeze(-1)
        self.rollouts, self.step = self.rollouts + 1, 0
        known = min(self.rollouts, REMEMBERED)
        seen, wanted = self.seen[:known].flatten(0, 2), self.wanted[:known].flatten()
        total = torch.zeros((), device=seen.device)
        for _ in range(UPDATES):
            some = torch.randint(len(seen), (MINIBATCH,), device=seen.device)
            loss = (self.critic(seen[some].float()) - wanted[some]).square().mean()
            self.optimizer.zero_grad()
            loss.backward()
            if processes > 1:
                for weight in self.critic.parameters():
                    assert weight.grad is not None
                    torch.distributed.all_reduce(weight.grad)
                    weight.grad /= processes
            self.optimizer.step()
            total += loss.detach()
        self.optimizer.zero_grad()
        return float(total) / UPDATES

    def state_dict(self) -> dict[str, Any]:
        """What is remembered, to go on from."""
        known = min(self.rollouts, REMEMBERED)
        return {
            "seen": self.seen[:known].clone(),
            "wanted": self.wanted[:known].clone(),
            "rollouts": self.rollouts,
        }

    def load_state_dict(self, kept: Mapping[str, Any]) -> None:
        """Go on from what :meth:`state_dict` gave."""
        known = len(kept["seen"])
        self.seen[:known], self.wanted[:known] = kept["seen"], kept["wanted"]
        self.rollouts = kept["rollouts"]
