"""The trunk of the networks: input channels of cells in, features of cells out.

Everything is convolutional or pooled over the cells, so one network runs on any bin size.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import torch
from torch import Tensor, nn

from marl_pack import renamed
from marl_pack.agents.layers import initialized
from marl_pack.agents.networks.planes import PLANES, Observation, channel_names, input_channels
from marl_pack.checks import shown, truth_value, whole_number
from marl_pack.geometry import MAX_SIDE

MOST = {"channels": 4096, "layers": 128, "dilation": MAX_SIDE, "hidden": 65536}
"""The largest value of each size of a network."""


@dataclass
class Network:
    """The shape of an agent's network.

    Args:
        channels: feature channels of the convolutional trunk.
        layers: number of its 3 × 3 convolutions.
        residual: whether each convolution after the first adds to its input.
        dilation: cells between the taps of each convolution after the first; with 2, three layers
            reach 5 cells far in place of 3.
        shortcut: whether the heads see the input channels themselves beside the features.
        context: whether features pooled over the whole bin are added to every cell's.
        planes: input planes beside the paper's four channels: any of {planes}.
        hidden: units of the hidden layer in the heads that follow pooling.
        share_trunk: whether the critic sees the actor's features or has a trunk of its own.
    """

    channels: int = 32
    layers: int = 3
    residual: bool = True
    dilation: int = 1
    shortcut: bool = False
    context: bool = False
    planes: list[str] = field(default_factory=lambda: ["mask", "resting_height", "waste"])
    hidden: int = 64
    share_trunk: bool = True

    def __post_init__(self) -> None:
        for name, most in MOST.items():
            value = getattr(self, name)
            whole_number(value, f"network: {name} = {shown(value)}", 1, most)
        for name in ("residual", "shortcut", "context", "share_trunk"):
            truth_value(getattr(self, name), f"network: {name}")
        if not isinstance(self.planes, list | tuple) or not all(
            isinstance(plane, str) for plane in self.planes
        ):
            raise ValueError(f"network: planes = {shown(self.planes)}: needs a list of names")
        for plane in self.planes:
            renamed.refuse_old(plane, renamed.PLANES, "network: plane")
        unknown = [plane for plane in self.planes if plane not in PLANES]
        if unknown or len(set(self.planes)) < len(self.planes):
            raise ValueError(
                f"network: planes {shown(self.planes)}: any of {', '.join(PLANES)}, once"
            )


Network.__doc__ = (Network.__doc__ or "").replace("{planes}", ", ".join(PLANES))


def count_features(network: Network, orientations: int) -> int:
    """Count the channels that a trunk gives its heads for A orientations."""
    inputs = len(channel_names(network.planes, orientations))
    return network.channels + (inputs if network.shortcut else 0)


def pool(features: Tensor) -> Tensor:
    """Return mean and maximum over the cells, [B, 2C] of [B, C, W, D]."""
    # adaptive_max_pool2d is amax with a backward pass that costs a quarter.
    most = nn.functional.adaptive_max_pool2d(features, 1).flatten(1)
    return torch.cat((features.mean((2, 3)), most), 1)


class Features:
    """The output of a trunk: features of every cell, and the input channels themselves.

    Args:
        cells: features, float32 [B, C, W, D].
        inputs: input channels that the heads see too, float32 [B, P, W, D]; None if they do not.
    """

    def __init__(self, cells: Tensor, inputs: Tensor | None) -> None:
        self.cells, self.inputs = cells, inputs

    @property
    def whole(self) -> Tensor:
        """Features and inputs, in one tensor [B, C + P, W, D]."""
        return self.cells if self.inputs is None else torch.cat((self.cells, self.inputs), 1)

    @cached_property
    def pooled(self) -> Tensor:
        """The pooled :attr:`whole` (:func:`pool`), computed once for actor and critic."""
        if self.inputs is None:
            return pool(self.cells)
        # Pooled apart: the inputs need no gradient, and a backward pass through them is costly.
        parts = (pool(values).chunk(2, 1) for values in (self.cells, self.inputs))
        return torch.cat([part for both in zip(*parts, strict=True) for part in both], 1)


class Trunk(nn.Module):
    """The convolutional layers of a network, from an observation to :class:`Features`.

    Args:
        orientations: A, how many orientations the agent judges.
        network: the shape of the network.
    """

    def __init__(self, orientations: int, network: Network) -> None:
        super().__init__()
        self.planes, self.residual = list(network.planes), network.residual
        self.shortcut = network.shortcut
        channels = network.channels
        inputs = len(channel_names(self.planes, orientations))
        widths = [inputs] + [channels] * network.layers
        dilations = [1] + [network.dilation] * (network.layers - 1)
        self.convolutions = nn.ModuleList(
            initialized(nn.Conv2d(a, b, 3, padding=d, dilation=d))
            for (a, b), d in zip(pairwise(widths), dilations, strict=True)
        )
        self.context = initialized(nn.Linear(2 * channels, channels)) if network.context else None
        # (observation, its features), stored by the actor for the critic that shares this trunk.
        self._stored: tuple[object, Features] | None = None

    def forward(self, observation: Observation) -> Features:
        """Compute the features of every cell."""
        x = inputs = input_channels(observation, self.planes)
        for k, convolution in enumerate(self.convolutions):
            y = torch.relu(convolution(x))
            x = x + y if self.residual and k else y
            if k == 0 and self.context is not None:
                x = x + self.context(pool(x))[:, :, None, None]
        return Features(x, inputs if self.shortcut else None)

    def store(self, observation: Observation) -> Features:
        """Compute the features, and store them for one :meth:`take` of the same observation."""
        features: Features = self(observation)
        self._stored = (observation, features)
        return features

    def take(self, observation: Observation) -> Features:
        """Return the features that :meth:`store` computed of the same object, else new ones."""
        stored, self._stored = self._stored, None
        if stored is not None and stored[0] is observation:
            return stored[1]
        features: Features = self(observation)
        return features


def widen(
    weights: Mapping[str, Tensor], old: Network, new: Network, orientations: int
) -> dict[str, Tensor]:
    """Return an actor's or critic's weights for a network with more planes, whose weights are 0.

    Args:
        weights: a state_dict of the network ``old``.
        old: its shape.
        new: the same shape with every plane of ``old`` among its own.
        orientations: A, how many orientations the agent judges.

    Returns:
        A state_dict of ``new``, which computes what ``old`` does.
    """
    old_names, names = (channel_names(network.planes, orientations) for network in (old, new))
    inputs = torch.tensor([names.index(channel) for channel in old_names])
    features = torch.arange(new.channels)
    if new.shortcut:
        features = torch.cat((features, new.channels + inputs))
    count = count_features(new, orientations)
    places = {  # of each old input among the new ones, in each layer that sees planes
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
