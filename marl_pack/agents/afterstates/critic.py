"""The critic of afterstates and its learning.

An afterstate is the bin after a placement, before the next item is seen (Sutton & Barto 2018, sec.
6.8). The critic estimates the return that is still to come from an afterstate's features
(:mod:`marl_pack.agents.afterstates.features`). It learns from the agents' returns, less the reward
of the placement itself, once in each PPO update.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from marl_pack.agents.afterstates.features import FEATURES, features
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.layers import initialized, linear_relu
from marl_pack.checks import whole_number
from marl_pack.game.moves import Moves
from marl_pack.game.packing import Packing

HIDDEN = 64
REMEMBERED = 1 << 16
"""Number of afterstates, from the last rollouts, that the critic learns from."""
PASSES, MINIBATCH = 16, 512
"""How often the critic learns from each afterstate, on average, and the minibatch size."""


class AfterstateCritic(nn.Module):
    """A network that estimates the return still to come from features of afterstates."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            initialized(nn.Linear(FEATURES, HIDDEN)), nn.ReLU(),
            initialized(nn.Linear(HIDDEN, HIDDEN)), nn.ReLU(),
            initialized(nn.Linear(HIDDEN, 1), 0.01),
        )  # fmt: skip

    def forward(self, inputs: Tensor) -> Tensor:
        """Estimate the values, float32 [K], from features [K, :data:`FEATURES`]."""
        value: Tensor = self.layers(inputs).squeeze(1)
        return value

    @torch.no_grad()
    def estimate(self, inputs: Tensor) -> Tensor:
        """Estimate the values as :meth:`forward` does, but without gradients."""
        first, _, second, _, last = self.layers
        value: Tensor = last(linear_relu(second, linear_relu(first, inputs))).squeeze(1)
        return value


class AfterstateLearner:
    """The learner that fits the critic to the returns of recent placements.

    A placement's return is mostly chance, so the critic learns from many placements: about
    :data:`REMEMBERED` from the last rollouts. The agents have changed little since then.

    Args:
        critic: the critic.
        lookahead: computes the afterstates.
        steps, games: number of steps T and games G in a rollout.
    """

    def __init__(
        self, critic: AfterstateCritic, lookahead: Lookahead, steps: int, games: int
    ) -> None:
        self.critic, self.lookahead = critic, lookahead
        self.optimizer = torch.optim.Adam(critic.parameters(), fused=True)
        device = next(critic.parameters()).device
        self.capacity = max(1, REMEMBERED // (steps * games))  # rollouts
        shape = self.capacity, steps, games
        self.inputs = torch.zeros(*shape, FEATURES, dtype=torch.float16, device=device)
        self.targets = torch.zeros(shape, device=device)
        self.legal = torch.zeros(shape, dtype=torch.bool, device=device)
        self.rollouts, self.step = 0, 0  # recorded rollouts; recorded steps of the next rollout

    def record(self, game: Packing, orientation: Tensor, cell: Tensor) -> None:
        """Store the afterstates of the chosen placements, int64 [G] each; call before placing."""
        afterstates = self.lookahead.afterstates(game)
        rows = Moves.gather(afterstates.index, orientation, cell)
        position = self.rollouts % self.capacity, self.step
        self.inputs[position] = features(afterstates, game.volume, rows).half()
        self.legal[position] = Moves.gather(game.mask, orientation, cell)  # false: no box
        self.step += 1

    def learn(self, targets: Tensor, learning_rate: float, processes: int = 1) -> float:
        """Fit the critic to the recorded rollouts; call this at the end of each rollout.

        Args:
            targets: float32 [T, G], the return that was still to come after each placement.
            learning_rate: the learning rate in this update.
            processes: number of processes that learn together and average their gradients.

        Returns:
            The mean squared error.

        Raises:
            ValueError: if the rollout has not been recorded completely.
        """
        if self.step != self.inputs.shape[1]:
            raise ValueError(f"{self.step} steps recorded: a rollout needs {self.inputs.shape[1]}")
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate
        self.targets[self.rollouts % self.capacity] = targets
        self.rollouts, self.step = self.rollouts + 1, 0
        stored = min(self.rollouts, self.capacity)
        inputs, targets = self.inputs[:stored].flatten(0, 2), self.targets[:stored].flatten()
        legal = self.legal[:stored].flatten().float()
        total = torch.zeros((), device=inputs.device)
        updates = -(-PASSES * self.inputs.shape[1] * self.inputs.shape[2] // MINIBATCH)
        for _ in range(updates):
            sample = torch.randint(len(inputs), (MINIBATCH,), device=inputs.device)
            error = (self.critic(inputs[sample].float()) - targets[sample]).square()
            loss = (error * legal[sample]).sum() / legal[sample].sum().clamp(min=1)
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
        self.lookahead.forget_values()
        return float(total) / updates

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the recorded rollouts, to resume from."""
        stored = min(self.rollouts, self.capacity)
        names = ("inputs", "targets", "legal")
        recorded = {name: getattr(self, name)[:stored].clone() for name in names}
        return recorded | {"rollouts": self.rollouts}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the rollouts that :meth:`state_dict` returned.

        Raises:
            ValueError: if they do not match this run; then nothing is changed.
        """
        names = ("inputs", "targets", "legal")
        rollouts = whole_number(state.get("rollouts"), "afterstates.rollouts", 0)
        stored = min(rollouts, self.capacity)
        for name in names:
            memory, values = getattr(self, name)[:stored], state.get(name)
            if not isinstance(values, Tensor) or (values.dtype, values.shape) != (
                memory.dtype,
                memory.shape,
            ):
                raise ValueError(f"afterstates.{name}: needs {memory.dtype} {list(memory.shape)}")
        for name in names:
            getattr(self, name)[:stored] = state[name]
        self.rollouts = rollouts
