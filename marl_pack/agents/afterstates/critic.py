"""What a bin is worth after a placement: a small critic of afterstates, whose word agents see.

An afterstate is the bin with the item set down and the next one not yet seen (Sutton & Barto 2018,
sec. 6.8). The critic tells the return that is still to come from what the placement leaves
(:class:`marl_pack.agents.afterstates.afterstates.Afterstates`): in how many cells each box that may
come could be set down, how high the columns are and how rough the surface. None of it changes when
the bin is mirrored or turned. It learns the agents' own returns, each placement's less its reward,
beside their PPOs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from marl_pack.agents.afterstates.afterstates import MOST_LENGTHS, SURFACE, Afterstates
from marl_pack.agents.networks.trunk import initialized
from marl_pack.game.packing import Packing

PAIRS = MOST_LENGTHS * (MOST_LENGTHS + 1) // 2
FEATURES = 2 + PAIRS * MOST_LENGTHS + SURFACE
"""Numbers that the critic sees of an afterstate."""
HIDDEN = 64
REMEMBERED = 1 << 16
"""Afterstates that it learns from, of the last rollouts."""
PASSES, MINIBATCH = 16, 512
"""How often it learns from an afterstate, in the mean, and from how many at once."""
AT_ONCE = 1 << 15
"""Afterstates judged at once, at most."""
ILLEGAL = -1e6
"""What a placement that is not legal counts as worth: less than any that is."""


def features(left: Afterstates, volume: int, rows: Tensor | None = None) -> Tensor:
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
        rows = torch.arange(len(left.volume), device=game.device)
        with torch.no_grad():
            value = [self(features(left, game.volume, some)) for some in torch.split(rows, AT_ONCE)]
        reward = (game.alpha * left.volume - game.beta * left.waste) / game.volume
        return left.spread((reward + torch.cat(value)).float(), game.mask, ILLEGAL)


class AfterstateLearner:
    """Fits the critic to what the placements of the last rollouts have brought.

    A placement's outcome is mostly luck, so the critic learns from many: from about
    :data:`REMEMBERED`, which agents played that were nearly those of now.

    Args:
        critic: the critic.
        steps, bins: T and N of a rollout.
    """

    def __init__(self, critic: AfterstateCritic, steps: int, bins: int) -> None:
        self.critic = critic
        self.optimizer = torch.optim.Adam(critic.parameters())
        device = next(critic.parameters()).device
        self.kept = max(1, REMEMBERED // (steps * bins))  # rollouts
        shape = self.kept, steps, bins
        self.seen = torch.zeros(*shape, FEATURES, dtype=torch.float16, device=device)
        self.wanted = torch.zeros(shape, device=device)
        self.legal = torch.zeros(shape, dtype=torch.bool, device=device)
        self.rollouts, self.step = 0, 0  # recorded so far, and steps of the next one

    def record(self, game: Packing, orientation: Tensor, cell: Tensor) -> None:
        """Keep the afterstates of what is now set down, int64 [N] each."""
        left = game.left()
        b = torch.arange(game.n, device=cell.device)
        where = b, orientation, cell // game.size[1], cell % game.size[1]
        place = self.rollouts % self.kept, self.step
        self.seen[place] = features(left, game.volume, left.index[where]).half()
        self.legal[place] = game.mask[where]  # else nothing is set down
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

        Raises:
            ValueError: unless a whole rollout has been recorded.
        """
        if self.step != self.seen.shape[1]:
            raise ValueError(f"{self.step} steps recorded, a rollout has {self.seen.shape[1]}")
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate
        self.wanted[self.rollouts % self.kept] = (returns - rewards).squeeze(-1)
        self.rollouts, self.step = self.rollouts + 1, 0
        known = min(self.rollouts, self.kept)
        seen, wanted = self.seen[:known].flatten(0, 2), self.wanted[:known].flatten()
        legal = self.legal[:known].flatten().float()
        total = torch.zeros((), device=seen.device)
        updates = -(-PASSES * returns.numel() // MINIBATCH)
        for _ in range(updates):
            some = torch.randint(len(seen), (MINIBATCH,), device=seen.device)
            error = (self.critic(seen[some].float()) - wanted[some]).square()
            loss = (error * legal[some]).sum() / legal[some].sum().clamp(min=1)
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
        return float(total) / updates

    def state_dict(self) -> dict[str, Any]:
        """What is remembered, to go on from."""
        known = min(self.rollouts, self.kept)
        kept = {name: getattr(self, name)[:known].clone() for name in ("seen", "wanted", "legal")}
        return kept | {"rollouts": self.rollouts}

    def load_state_dict(self, kept: Mapping[str, Any]) -> None:
        """Go on from what :meth:`state_dict` gave."""
        for name in ("seen", "wanted", "legal"):
            getattr(self, name)[: len(kept[name])] = kept[name]
        self.rollouts = kept["rollouts"]
