"""The trunk of the networks: it turns the input channels of cells into features of cells.

Everything is convolutional or pooled over the cells, so one network runs on any bin size.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from itertools import pairwise

import torch
from torch import Tensor, nn

from marl_pack.agents.layers import initialized
from marl_pack.agents.networks.planes import channel_names, input_channels
from marl_pack.agents.networks.shape import Network
from marl_pack.agents.networks.sight import Observation


def count_features(network: Network, orientations: int) -> int:
    """Count the channels that a trunk gives its heads for A orientations."""
    inputs = len(channel_names(network.planes, orientations))
    return network.channels + (inputs if network.shortcut else 0)


def by_cell(features: Tensor) -> Tensor:
    """Return features [B, C, W, D] as one row for each cell, [B, W · D, C]."""
    return features.movedim(1, 3).flatten(1, 2)


def pool(features: Tensor) -> Tensor:
    """Pool features [B, C, W, D] to their mean and maximum over the cells, float32 [B, 2C]."""
    # The backward pass of mean((2, 3)) is not channels last. amax computes what adaptive_max_pool2d
    # does, forwards in a third of the time if the channels fill vectors, backwards in four times.
    cells = by_cell(features)
    if features.requires_grad or features.shape[1] % 16:
        most = nn.functional.adaptive_max_pool2d(features, 1).flatten(1)
    else:
        most = cells.amax(1)
    return torch.cat((cells.mean(1, dtype=torch.float32), most.float()), 1)


class Features:
    """The output of a trunk: features of every cell, and the input channels themselves.

    Args:
        cells: features [B, C, W, D], in the precision of the convolutions.
        inputs: input channels, float32 [B, P, W, D]; None if the heads do not see them.
    """

    def __init__(self, cells: Tensor, inputs: Tensor | None) -> None:
        self.cells, self.inputs = cells, inputs

    @cached_property
    def pooled(self) -> Tensor:
        """Features and inputs pooled (:func:`pool`), computed once for actor and critic."""
        if self.inputs is None:
            return pool(self.cells)
        # Pooled separately: the inputs need no gradient, and their backward pass would be costly.
        parts = (pool(values).chunk(2, 1) for values in (self.cells, self.inputs))
        return torch.cat([part for both in zip(*parts, strict=True) for part in both], 1)


class Trunk(nn.Module):
    """The convolutional layers of a network, from an observation to :class:`Features`.

    Args:
        orientations: A, how many orientations the agent judges.
        network: the shape of the network.
        precision: the type of the numbers in convolutions and features, float32 or bfloat16.
            Weights, inputs and heads are float32.
    """

    def __init__(
        self, orientations: int, network: Network, precision: torch.dtype = torch.float32
    ) -> None:
        super().__init__()
        self.precision = precision
        self.planes, self.residual = list(network.planes), network.residual
        self.shortcut = network.shortcut
        channels = network.channels
        inputs = len(channel_names(self.planes, orientations))
        widths = [inputs] + [channels] * network.layers
        self.convolutions = nn.ModuleList(
            initialized(nn.Conv2d(a, b, 3, padding=1)) for a, b in pairwise(widths)
        )
        self.context = initialized(nn.Linear(2 * channels, channels)) if network.context else None
        # (observation, its features), stored by the actor for the critic that shares this trunk.
        self._stored: tuple[object, Features] | None = None

    def forward(self, observation: Observation) -> Features:
        """Compute the features of every cell."""
        inputs = input_channels(observation, self.planes)
        x = inputs.to(self.precision)
        for k, convolution in enumerate(self.convolutions):
            weight, bias = (values.to(x.dtype) for values in convolution.parameters())
            y = torch.relu_(nn.functional.conv2d(x, weight, bias, padding=1))
            x = x + y if self.residual and k else y
            if k == 0 and self.context is not None:
                x = x + self.context(pool(x)).to(x.dtype)[:, :, None, None]
        return Features(x, inputs if self.shortcut else None)

    def store(self, observation: Observation) -> Features:
        """Compute the features, and store them for one :meth:`take` of the same observation."""
        features: Features = self(observation)
        self._stored = (observation, features)
        return features

    def take(self, observation: Observation) -> Features:
        """Return the features that :meth:`store` computed of this object, or compute them."""
        stored, self._stored = self._stored, None
        if stored is not None and stored[0] is observation:
            return stored[1]
        features: Features = self(observation)
        return features


def widen(
    weights: Mapping[str, Tensor], old: Network, new: Network, orientations: int
) -> dict[str, Tensor]:
    """Extend the weights of an actor or a critic to a network with more planes; new weights are 0.

    Args:
        weights: a state_dict of the network ``old``.
        old: the shape of this network.
        new: the same shape with more planes, those of ``old`` included.
        orientations: A, how many orientations the agent judges.

    Returns:
        A state_dict for ``new``, with which it computes the same as ``old``.
    """
    old_names, names = (channel_names(network.planes, orientations) for network in (old, new))
    inputs = torch.tensor([names.index(channel) for channel in old_names])
    features = torch.arange(new.channels)
    if new.shortcut:
        features = torch.cat((features, new.channels + inputs))
    count = count_features(new, orientations)
    places = {  # position of each old input among the new inputs, in the layers that see planes
        "cnns.convolutions.0.weight": (inputs, len(names)),
        "mlp.scores.weight": (features, count),
        "mlp.1.weight": (torch.cat((features, count + features)), 2 * count),
    }
    widened = dict(weights)
    for name in widened.keys() & places.keys():
        (place, size), weight = places[name], weights[name]
        widened[name] = weight.new_zeros(weight.shape[0], size, *weight.shape[2:])
        widened[name][:, place.to(weight.device)] = weight
    return widened
