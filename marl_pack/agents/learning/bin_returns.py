"""The returns from which the critic of afterstates learns in games with several bins.

An episode there has rewards from several bins. The critic values one bin, so the return of a
placement counts only the later rewards of the same bin, until it is closed.
"""

from __future__ import annotations

import torch
from torch import Tensor


class BinReturns:
    """The rewards of a rollout, and the bins they belong to.

    Args:
        steps, games, bins: number of steps T, games G and open bins b.
        device: the device of the games.
    """

    def __init__(self, steps: int, games: int, bins: int, device: torch.device | str) -> None:
        self.step = 0  # recorded steps of the next rollout
        self.bin = torch.zeros(steps, games, dtype=torch.int64, device=device)
        self.reward = torch.zeros(steps, games, device=device)
        self.closed = torch.zeros(steps, games, bins, dtype=torch.bool, device=device)

    def record(self, bin: Tensor, reward: Tensor, closed: Tensor) -> None:
        """Record a step.

        Args:
            bin: int64 [G], the bin of each placement.
            reward: float32 [G].
            closed: bool [G, b], the bins that were closed after it.
        """
        self.bin[self.step], self.reward[self.step] = bin, reward
        self.closed[self.step] = closed
        self.step += 1

    def targets(self, values: Tensor, gamma: float) -> Tensor:
        """Return what is still to come from each placement's bin, float32 [T, G].

        Args:
            values: float32 [G, b], what is expected from the open bins after the rollout.
            gamma: discount of the reward, per step.

        Raises:
            ValueError: if the rollout has not been recorded completely.
        """
        if self.step != len(self.reward):
            raise ValueError(f"{self.step} steps recorded: a rollout needs {len(self.reward)}")
        self.step = 0
        targets, coming = torch.empty_like(self.reward), values.clone()
        for t in reversed(range(len(targets))):
            coming = gamma * coming.masked_fill(self.closed[t], 0.0)
            own = self.bin[t][:, None]
            targets[t] = coming.gather(1, own).squeeze(1)
            coming = coming.scatter_add(1, own, self.reward[t][:, None])
        return targets
