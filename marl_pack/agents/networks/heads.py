"""The heads of the networks: features of cells in, logits or values out."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn.functional import linear

from marl_pack.agents.layers import initialized
from marl_pack.agents.networks.shape import Network
from marl_pack.agents.networks.trunk import Features, by_cell, count_features


class Pool(nn.Module):
    """A layer that returns the pooled features (:attr:`.trunk.Features.pooled`)."""

    def forward(self, features: Features) -> Tensor:
        """Return mean and maximum over the cells, [B, 2C]."""
        return features.pooled


def pooled_head(network: Network, orientations: int, outputs: int, gain: float) -> nn.Sequential:
    """Build a head of one hidden layer, from the pooled features to ``outputs`` numbers."""
    return nn.Sequential(
        Pool(),
        initialized(nn.Linear(2 * count_features(network, orientations), network.hidden)),
        nn.ReLU(),
        initialized(nn.Linear(network.hidden, outputs), gain),
    )


class ScoreMap(nn.Module):
    """A head that scores each cell in A orientations, [B, A · W · D].

    Args:
        network: shape of the network.
        orientations: number of orientations, A.
    """

    def __init__(self, network: Network, orientations: int) -> None:
        super().__init__()
        inputs = count_features(network, orientations)
        self.scores = initialized(nn.Conv2d(inputs, orientations, 1), 0.01)

    def forward(self, features: Features) -> Tensor:
        """Return scores in the order of the actions: orientation, x, y."""
        # Matrix products are several times faster than a convolution of so few outputs.
        filters, bias = self.scores.parameters()
        weight, channels = filters.flatten(1), features.cells.shape[1]
        scores = linear(by_cell(features.cells).float(), weight[:, :channels], bias)
        if features.inputs is not None:
            scores = scores + linear(by_cell(features.inputs), weight[:, channels:])
        return scores.transpose(1, 2).flatten(1)
