"""The selection agent: what it observes, and its networks.

The selection agent chooses a box and a bin. It observes each option (a pair of a visible box and an
open bin) by a few numbers (:data:`OPTION_NUMBERS`). The most important one is what the best
placement of this option gains, by the critic of afterstates. The networks treat all options alike,
so they play with any number of boxes and bins.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from rsl_rl.models import MLPModel
from torch import Tensor, nn

from marl_pack.agents.afterstates.gains import gains, values_before
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.layers import initialized
from marl_pack.agents.networks.distribution import MaskedCategorical
from marl_pack.agents.networks.shape import SelectionNetwork
from marl_pack.agents.networks.sight import Observation
from marl_pack.game.selection import SelectionPacking
from marl_pack.geometry import ORIENTATIONS

OPTION_NUMBERS = (
    "longest", "middle", "shortest", "volume", "gain", "behind", "expected", "filled", "cells",
    "legal",
)  # fmt: skip
"""What an option's numbers are: the box's sides as shares of the bin's longest side, its volume as
a share of the bin's (times 8); the gain of the option's best placement (times 10), and how far that
is behind the best option; the return that is still expected from the bin; the bin's filled share;
the share of cells and orientations where the box has a place; 1 if it has one."""
BEHIND = OPTION_NUMBERS.index("behind")
SHARPNESS = 200.0
"""How strongly a new agent prefers the option that gains most: it is nearly greedy at first."""


def observe_options(game: SelectionPacking, lookahead: Lookahead) -> dict[str, Tensor]:
    """Return what the selection agent observes of G games with K = k · b options.

    Args:
        game: the games.
        lookahead: computes the gains of placements; it needs a critic of afterstates.

    Returns:
        ``options`` float32 [G, K, F] (:data:`OPTION_NUMBERS`), ``present`` bool [G, K] (false for
        an empty slot), ``previews`` float32 [G, p, 3] (sides in falling order; 0 for none),
        ``expected`` float32 [G, 1] (the return by the best placement and the values of all bins)
        and ``mask`` bool [G, K], the legal options.

    Raises:
        ValueError: if there is no critic of afterstates.
    """
    view, mask = game.view(), game.selection_mask
    sides = _sorted_sides(view.items.sides, game)
    present = view.items.sides.any(1)
    before = values_before(game, lookahead)
    gain = gains(game, lookahead).flatten(2).amax(2).where(mask, 0.0)
    best = gain.where(mask, -math.inf).amax(1, keepdim=True).where(mask.any(1, keepdim=True), 0.0)
    volume = view.items.sides.float().prod(1) / game.volume
    filled = (game.bins.filled.float() / game.volume)[game.bin_of]
    places = view.mask.flatten(1).sum(1) / (len(ORIENTATIONS) * game.floor.cells)
    shape = game.n, game.options
    numbers = [
        *sides.unbind(1), 8 * volume, 10 * gain.flatten(), (gain - best).where(mask, 0.0).flatten(),
        before.flatten(), filled, places, mask.flatten().float(),
    ]  # fmt: skip
    first_slot = before[:, : game.b]  # the bins of one box
    return {
        "options": torch.stack([n.float() for n in numbers], 1).view(*shape, len(OPTION_NUMBERS)),
        "present": present.view(shape),
        "previews": _sorted_sides(game.previews().sides, game).view(game.n, game.preview, 3),
        "expected": first_slot.sum(1, keepdim=True) + best,
        "mask": mask,
    }


def _sorted_sides(sides: Tensor, game: SelectionPacking) -> Tensor:
    """Return sides in falling order, as shares of the bin's longest side, float32 [N, 3]."""
    return sides.float().sort(1, descending=True).values / max(game.size)


class _Options(nn.Module):
    """Layers that turn an observation into features of options and of the whole turn.

    Args:
        network: the shape of the network.
    """

    def __init__(self, network: SelectionNetwork) -> None:
        super().__init__()
        self.option = initialized(nn.Linear(len(OPTION_NUMBERS), network.hidden))
        self.preview = initialized(nn.Linear(3, network.hidden))

    def forward(self, obs: Observation) -> tuple[Tensor, Tensor]:
        """Return features [G, K, C] of options, and [G, 3 C] of the turn.

        The turn has the mean and the maximum over the boxes that are there, and the mean over the
        preview.
        """
        options = torch.relu(self.option(obs["options"]))
        present = obs["present"][..., None]
        seen = obs["previews"].any(2, keepdim=True)
        previews = torch.relu(self.preview(obs["previews"])) * seen
        turn = [
            (options * present).sum(1) / present.sum(1).clamp(min=1),
            (options * present).amax(1),
            previews.sum(1) / seen.sum(1).clamp(min=1),
        ]
        return options, torch.cat(turn, 1)


class OptionScores(nn.Module):
    """The selection agent's network: observation → logits of options, float32 [G, K].

    Args:
        network: the shape of the network.
    """

    def __init__(self, network: SelectionNetwork) -> None:
        super().__init__()
        hidden = network.hidden
        self.options = _Options(network)
        self.mixed = initialized(nn.Linear(4 * hidden, hidden))
        self.score = initialized(nn.Linear(hidden, 1), 0.01)
        self.sharpness = nn.Parameter(torch.tensor(math.log(SHARPNESS)))

    def forward(self, obs: Observation) -> Tensor:
        """Return the logits: a learned score plus the sharpened gain of the best placement."""
        options, turn = self.options(obs)
        turns = turn[:, None].expand(-1, options.shape[1], -1)
        mixed = torch.relu(self.mixed(torch.cat((options, turns), 2)))
        behind = obs["options"][..., BEHIND]
        score: Tensor = self.score(mixed).squeeze(2) + self.sharpness.exp() * behind
        return score


class TurnValue(nn.Module):
    """The selection agent's critic: observation → value, float32 [G, 1].

    Args:
        network: the shape of the network.
    """

    def __init__(self, network: SelectionNetwork) -> None:
        super().__init__()
        hidden = network.hidden
        self.options = _Options(network)
        self.mixed = initialized(nn.Linear(3 * hidden, hidden))
        self.value = initialized(nn.Linear(hidden, 1), 0.01)

    def forward(self, obs: Observation) -> Tensor:
        """Return the value: what the critic of afterstates expects, plus a learned correction."""
        _, turn = self.options(obs)
        correction: Tensor = self.value(torch.relu(self.mixed(turn)))
        return obs["expected"] + correction


class SelectionActor(MLPModel):
    """The selection agent's policy as a model of rsl_rl's PPO.

    Args:
        obs, obs_groups, obs_set, output_dim: as rsl_rl passes them.
        network: fields of :class:`marl_pack.agents.networks.shape.SelectionNetwork`.
    """

    def __init__(
        self,
        obs: Observation,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        *,
        network: Mapping[str, Any],
    ) -> None:
        nn.Module.__init__(self)  # MLPModel.__init__ builds a perceptron for flat observations
        self.obs_groups, self.obs_normalization = obs_groups[obs_set], False
        self.mlp = OptionScores(SelectionNetwork(**network))
        self.distribution = MaskedCategorical(1)

    def get_latent(
        self, obs: Observation, masks: Tensor | None = None, hidden_state: None = None
    ) -> Observation:
        """Return the observation; give the action mask to the distribution."""
        self.distribution.mask = obs["mask"]
        return obs

    def log_probs(self, obs: Observation) -> Tensor:
        """Compute log-probabilities of all options, float32 [G, K]; draws no random numbers."""
        return self.distribution.masked(self.mlp(self.get_latent(obs))).log_softmax(-1)


class SelectionCritic(MLPModel):
    """The selection agent's critic as a model of rsl_rl's PPO.

    Args:
        obs, obs_groups, obs_set, output_dim, network: as for :class:`SelectionActor`.
    """

    def __init__(
        self,
        obs: Observation,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        *,
        network: Mapping[str, Any],
    ) -> None:
        nn.Module.__init__(self)
        self.obs_groups, self.obs_normalization = obs_groups[obs_set], False
        self.distribution = None
        self.mlp = TurnValue(SelectionNetwork(**network))

    def get_latent(
        self, obs: Observation, masks: Tensor | None = None, hidden_state: None = None
    ) -> Observation:
        """Return the observation as it is, for the network."""
        return obs
