"""Small masked actor-critics for the PettingZoo environments, in plain PyTorch.

:class:`ActorCritic` reads the observations of :mod:`marl_pack.env_aec` and works for any bin size;
:class:`MovesActorCritic` reads those of :mod:`marl_pack.env_mm`. You may copy and change them. The
agents of ``marl-pack train`` are larger and observe more.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

FORBIDDEN = -1e9
"""Logit of an action that is not legal. It is finite, so that no entropy or KL becomes NaN."""

SCORES = {
    "selection": (True, False), "orientation": (True, False), "placement": (False, True),
    "both": (True, True),
}  # fmt: skip
"""For each agent: whether its network scores the whole turn's few choices, and whether cells."""


class ActorCritic(nn.Module):
    """A network that computes logits and the state's value from one agent's planes and mask.

    Args:
        agent: ``"selection"`` scores pairs of a box and a bin, ``"orientation"`` six orientations,
            ``"placement"`` every cell; ``"both"`` is for ``pad_actions=True``, where one network
            plays the turns of the orientation agent and of the placement agent.
        channels: number of feature channels.
        planes: number of planes in the observation, without the one that says who acts.
        options: number of pairs that the selection agent scores.
    """

    def __init__(
        self, agent: str, channels: int = 24, planes: int = 4, options: int = 1
    ) -> None:  # fmt: skip
        super().__init__()
        if agent not in SCORES:
            raise ValueError(f"agent {agent!r}: one of {', '.join(SCORES)}")
        self.agent = agent
        self.scores_orientations, self.scores_cells = SCORES[agent]
        planes += self.scores_cells + (self.scores_cells and self.scores_orientations)
        self.trunk = nn.Sequential(
            nn.Conv2d(planes, channels, 3, padding=1), nn.ReLU(),
            nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU(),
            nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU(),
        )  # fmt: skip
        self.orientations = nn.Linear(2 * channels, options if agent == "selection" else 6)
        self.cells = nn.Conv2d(channels, 1, 1)
        self.critic = nn.Sequential(
            nn.Linear(2 * channels, 64), nn.ReLU(), nn.Linear(64, 1)
        )  # fmt: skip

    @property
    def device(self) -> torch.device:
        """The device of the network's weights."""
        return self.cells.weight.device

    def forward(self, planes: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return masked logits [B, n] and values [B].

        Args:
            planes: float [B, 4, W, D], or [B, 5, W, D] with ``pad_actions=True``.
            mask: [B, n], nonzero where an action is legal.
        """
        legal = mask.bool()
        batch, _, width, depth = planes.shape
        both = self.scores_orientations and self.scores_cells
        if self.scores_cells:  # the legal cells are the most useful plane
            cells = legal[:, : width * depth].reshape(batch, 1, width, depth).to(planes.dtype)
            if both:
                cells = cells * planes[:, 4:]  # in the orientation's turn the mask has no cells
            planes = torch.cat((planes, cells), 1)
        features = self.trunk(planes)
        pooled = torch.cat((features.mean((2, 3)), features.amax((2, 3))), 1)
        if not self.scores_cells:
            logits = self.orientations(pooled)
        else:
            logits = self.cells(features).flatten(1)
            if both:
                logits = nn.functional.pad(logits, (0, mask.shape[1] - width * depth))
                orientations = nn.functional.pad(self.orientations(pooled), (0, mask.shape[1] - 6))
                logits = torch.where(planes[:, 4, 0, 0, None] > 0, logits, orientations)
        return logits.masked_fill(~legal, FORBIDDEN), self.critic(pooled).squeeze(1)


class MovesActorCritic(nn.Module):
    """A network that computes logits and the state's value from one agent's list of moves and mask.

    Every move is encoded alone; means and maxima over all moves describe the state.

    Args:
        agent: ``"orientation"`` scores six orientations, ``"placement"`` scores every move.
        columns: numbers in a row, ``len(marl_pack.env_mm.COLUMNS)``.
        channels: number of feature channels.
    """

    def __init__(self, agent: str, columns: int, channels: int = 64) -> None:
        super().__init__()
        if agent not in ("orientation", "placement"):
            raise ValueError(f"agent {agent!r}: one of orientation, placement")
        self.agent = agent
        self.encoder = nn.Sequential(
            nn.Linear(columns, channels), nn.ReLU(), nn.Linear(channels, channels), nn.ReLU()
        )
        self.orientations = nn.Linear(2 * channels, 6)
        self.context = nn.Linear(2 * channels, channels)
        self.cells = nn.Linear(channels, 1)  # the score of a move
        self.critic = nn.Sequential(nn.Linear(2 * channels, 64), nn.ReLU(), nn.Linear(64, 1))

    @property
    def device(self) -> torch.device:
        """The device of the network's weights."""
        return self.cells.weight.device

    def forward(self, moves: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return masked logits [B, n] and values [B].

        Args:
            moves: float [B, K, F], a row for each move; the first number of a row is 1 for a move.
            mask: [B, n], nonzero where an action is legal.
        """
        features = self.encoder(moves) * moves[..., :1]
        count = moves[..., 0].sum(1, keepdim=True).clamp(min=1)
        pooled = torch.cat((features.sum(1) / count, features.amax(1)), 1)
        if self.agent == "orientation":
            logits = self.orientations(pooled)
        else:
            context = self.context(pooled)[:, None]
            logits = self.cells(torch.relu(features + context)).squeeze(2)
        return logits.masked_fill(~mask.bool(), FORBIDDEN), self.critic(pooled).squeeze(1)
