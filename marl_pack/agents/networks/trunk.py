"""What both agents' networks are made of: planes of cells in, features of cells out.

Everything is convolutional or pooled over the cells, so one network runs on any bin size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import torch
from torch import Tensor, nn

PLANES = ("mask", "rest", "waste", "room", "fits", "worth", "solid", "filled")
"""Extra planes a network may see. For each orientation its agent has to judge: the cells where the
item may be set down, its resting height at every cell, the space it would enclose there, and what
each placement would leave: in how many cells the next item may be set down in the mean, and how
probable it is that it finds a place (:mod:`marl_pack.agents.afterstates.afterstates`), and what a
critic of what is left thinks it worth (:mod:`marl_pack.agents.afterstates.critic`). Once: the
columns that are filled to the floor, which is what ``hull_alpha`` rests on; and how much of the bin
is filled, which
where the items were cut from it says how much is still to come."""


@dataclass
class Network:
    """Shape of an agent's network.

    Args:
        channels: feature planes of the convolutional trunk.
        layers: number of its 3 × 3 convolutions.
        residual: whether each convolution after the first adds to its input.
        dilation: cells between the taps of each convolution after the first; with 2, three layers
            look 5 cells far in place of 3.
        shortcut: whether the heads see the planes themselves beside the features.
        context: whether features pooled over the whole bin are added to every cell's.
        planes: what is seen beside the paper's four channels: any of mask, rest, waste, room,
            fits, worth, solid, filled.
        hidden: units of the hidden layer in the heads that follow pooling.
        share_trunk: whether the critic looks at the actor's features or has a trunk of its own.
    """

    channels: int = 32
    layers: int = 3
    residual: bool = True
    dilation: int = 1
    shortcut: bool = False
    context: bool = False
    planes: list[str] = field(default_factory=lambda: ["mask", "rest", "waste"])
    hidden: int = 64
    share_trunk: bool = True

    def __post_init__(self) -> None:
        for name in ("channels", "layers", "dilation", "hidden"):
            if getattr(self, name) < 1:
                raise ValueError(f"network: {name} = {getattr(self, name)}, needs 1 or more")
        unknown = [plane for plane in self.planes if plane not in PLANES]
        if unknown or len(set(self.planes)) < len(self.planes):
            raise ValueError(f"network: planes {self.planes}: any of {', '.join(PLANES)}, once")


def input_planes(observation: Mapping[str, Tensor], planes: list[str]) -> Tensor:
    """The paper's four channels and the extra planes, float32 [B, :func:`count_planes`, W, D].

    Args:
        observation: ``heightmap`` int [B, W, D], ``item`` int [B, 3], ``height`` int [B, 1] (H),
            and for the extra planes ``cells`` bool, ``rest`` int, ``waste`` int, ``room``, ``fits``
            or ``worth`` float [B, A, W, D], ``best_room`` and ``best_worth`` float [B, 1],
            ``solid`` bool [B, W, D], ``filled`` float [B, 1].
        planes: which of :data:`PLANES`.

    Heights are shares of H, the item's sides shares of W, D and H, and what would be wasted is a
    share of the item's own volume, so that the planes mean the same in every bin. Room is seen
    beside the most that any placement of the item would leave: 1 for that, 0 from a fifth less on.
    How much the most is comes as one more channel. Likewise what placements are worth, twice: 1
    for the best of those seen, 0 from a twentieth of the bin less on, and from a two hundredth
    (of the reward of filling it, Eq. 5 with α = 1).
    """
    heightmap, item = observation["heightmap"], observation["item"].float()
    width, depth = heightmap.shape[1:]
    height = observation["height"].float()  # [B, 1]
    scale = torch.cat((torch.full_like(height, width), torch.full_like(height, depth), height), 1)
    seen = [heightmap.float()[:, None] / height[:, :, None, None]]
    seen.append((item / scale)[:, :, None, None].expand(-1, -1, width, depth))
    for plane in planes:
        if plane == "mask":
            seen.append(observation["cells"].float())
        elif plane == "rest":
            seen.append(observation["rest"].float() / height[:, :, None, None])
        elif plane == "room":
            room, most = observation["room"], observation["best_room"][:, :, None, None]
            close = 1 + 5 * (room.log1p() - most.log1p())
            seen.append(close.clamp(min=0) * (room > 0))
            seen.append(most.log1p().expand(-1, 1, width, depth) / 4)
        elif plane == "fits":
            seen.append(observation["fits"])
        elif plane == "worth":
            best = observation["best_worth"][:, :, None, None]
            behind = observation["worth"] - best
            seen += [(1 + near * behind).clamp(min=0) for near in (20, 200)]
            seen.append(best.expand(-1, 1, width, depth))
        elif plane == "solid":
            seen.append(observation["solid"].float()[:, None])
        elif plane == "filled":
            seen.append(observation["filled"][:, :, None, None].expand(-1, -1, width, depth))
        else:
            seen.append(observation["waste"].float() / (item.prod(1) + 1)[:, None, None, None])
    return torch.cat(seen, 1).contiguous(memory_format=torch.channels_last)


def channels_of(planes: list[str], ways: int) -> list[tuple[str, int]]:
    """The channels :func:`input_planes` makes for A = ``ways`` orientations: (plane, which)."""
    several = {"paper": 4, "solid": 1, "filled": 1, "room": ways + 1, "worth": 2 * ways + 1}
    return [(plane, k) for plane in ["paper", *planes] for k in range(several.get(plane, ways))]


def count_planes(planes: list[str], ways: int) -> int:
    """How many channels :func:`input_planes` makes for A = ``ways`` orientations."""
    return len(channels_of(planes, ways))


def count_features(network: Network, ways: int) -> int:
    """Channels that a trunk makes for A = ``ways`` orientations."""
    return network.channels + (count_planes(network.planes, ways) if network.shortcut else 0)


def pool(features: Tensor) -> Tensor:
    """Mean and maximum over the cells, [B, 2C] of [B, C, W, D]."""
    # adaptive_max_pool2d is amax with a backward pass that costs a quarter.
    most = nn.functional.adaptive_max_pool2d(features, 1).flatten(1)
    return torch.cat((features.mean((2, 3)), most), 1)


class Features:
    """What a trunk makes of an observation: features of every cell, and the planes themselves.

    Args:
        made: float32 [B, C, W, D].
        planes: what else the heads see, float32 [B, P, W, D]; None if nothing.
    """

    def __init__(self, made: Tensor, planes: Tensor | None) -> None:
        self.made, self.planes = made, planes

    @property
    def whole(self) -> Tensor:
        """Both, one after the other: [B, C + P, W, D]."""
        return self.made if self.planes is None else torch.cat((self.made, self.planes), 1)

    @cached_property
    def pooled(self) -> Tensor:
        """:func:`pool` of :attr:`whole`; actor and critic need it made but once."""
        if self.planes is None:
            return pool(self.made)
        # Apart, as nothing is to be learned of the planes: going back through them is dear.
        parts = (pool(values).chunk(2, 1) for values in (self.made, self.planes))
        return torch.cat([part for both in zip(*parts, strict=True) for part in both], 1)


class Trunk(nn.Module):
    """Observation → :class:`Features`, as many as :func:`count_features` says.

    Args:
        ways: orientations A for which the extra planes come.
        network: its shape.
    """

    def __init__(self, ways: int, network: Network) -> None:
        super().__init__()
        self.planes, self.residual = list(network.planes), network.residual
        self.shortcut = network.shortcut
        channels = network.channels
        wide = [count_planes(self.planes, ways)] + [channels] * network.layers
        apart = [1] + [network.dilation] * (network.layers - 1)
        self.convolutions = nn.ModuleList(
            initialized(nn.Conv2d(a, b, 3, padding=d, dilation=d))
            for (a, b), d in zip(pairwise(wide), apart, strict=True)
        )
        self.context = initialized(nn.Linear(2 * channels, channels)) if network.context else None
        # (observation, its features), kept from the actor for the critic that shares this trunk.
        self._kept: tuple[object, Features] | None = None

    def forward(self, observation: Mapping[str, Tensor]) -> Features:
        """Features of every cell."""
        x = planes = input_planes(observation, self.planes)
        for k, convolution in enumerate(self.convolutions):
            y = torch.relu(convolution(x))
            x = x + y if self.residual and k else y
            if k == 0 and self.context is not None:
                x = x + self.context(pool(x))[:, :, None, None]
        return Features(x, planes if self.shortcut else None)

    def keep(self, observation: Mapping[str, Tensor]) -> Features:
        """The features, kept for one :meth:`take` with the same observation."""
        features: Features = self(observation)
        self._kept = (observation, features)
        return features

    def take(self, observation: Mapping[str, Tensor]) -> Features:
        """The features :meth:`keep` has just made of the very same observation, else fresh ones."""
        kept, self._kept = self._kept, None
        if kept is not None and kept[0] is observation:
            return kept[1]
        features: Features = self(observation)
        return features


def widen(
    weights: Mapping[str, Tensor], held: Network, wanted: Network, ways: int
) -> dict[str, Tensor]:
    """An actor's or critic's weights for a network that sees more planes: those weigh 0.

    Args:
        weights: a state_dict of the network ``held``.
        held: its shape.
        wanted: the same shape with every plane of ``held`` among its own.
        ways: orientations A for which the extra planes come.

    Returns:
        A state_dict of ``wanted``, which computes what ``held`` does.
    """
    old, new = (channels_of(network.planes, ways) for network in (held, wanted))
    seen = torch.tensor([new.index(channel) for channel in old])
    features = torch.arange(wanted.channels)
    if wanted.shortcut:
        features = torch.cat((features, wanted.channels + seen))
    every = count_features(wanted, ways)
    places = {  # of each input that there was, in each layer that looks at planes
        "cnns.convolutions.0.weight": (seen, len(new)),
        "mlp.scores.weight": (features, every),
        "mlp.1.weight": (torch.cat((features, every + features)), 2 * every),
    }
    widened = dict(weights)
    for name in widened.keys() & places.keys():
        (place, count), weight = places[name], weights[name]
        widened[name] = weight.new_zeros(weight.shape[0], count, *weight.shape[2:])
        widened[name][:, place.to(weight.device)] = weight
    return widened


def initialized(layer: nn.Conv2d | nn.Linear, gain: float = math.sqrt(2)) -> nn.Module:
    """The layer with orthogonal weights and no bias to begin with."""
    nn.init.orthogonal_(layer.weight, gain)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


def pooled_head(network: Network, ways: int, outputs: int, gain: float) -> nn.Sequential:
    """Pooled features of a trunk → ``outputs`` numbers, by one hidden layer."""
    return nn.Sequential(
        Pool(),
        initialized(nn.Linear(2 * count_features(network, ways), network.hidden)),
        nn.ReLU(),
        initialized(nn.Linear(network.hidden, outputs), gain),
    )


class Pool(nn.Module):
    """:attr:`Features.pooled` as a layer."""

    def forward(self, features: Features) -> Tensor:
        """Mean and maximum over the cells, [B, 2C]."""
        return features.pooled


class ScoreMap(nn.Module):
    """Features → a score for each cell in A orientations, [B, A · W · D].

    Args:
        ways: A.
        network: its shape.
    """

    def __init__(self, ways: int, network: Network) -> None:
        super().__init__()
        self.scores = initialized(nn.Conv2d(count_features(network, ways), ways, 1), 0.01)

    def forward(self, features: Features) -> Tensor:
        """Scores in the order of the actions: orientation, x, y."""
        return self.scores(features.whole).flatten(1)
