"""The shape of a network, in settings and checkpoints."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from marl_pack import renamed
from marl_pack.agents.networks.planes import PLANES
from marl_pack.checks import shown, truth_value, whole_number

MOST = {"channels": 4096, "layers": 128, "hidden": 65536}
"""The largest value of each size of a network."""

DEFAULT_PLANES = (
    "mask", "resting_height", "waste", "feasible_cells", "feasible_probability",
    "afterstate_value", "grounded",
)  # fmt: skip
"""The default input planes of a network: with these, agents learn best on RS."""


@dataclass
class SelectionNetwork:
    """The shape of the selection agent's network.

    Args:
        hidden: units of each hidden layer.
    """

    hidden: int = 64

    def __post_init__(self) -> None:
        _check_sizes(self)


@dataclass
class Network:
    """The shape of an agent's network.

    Args:
        channels: feature channels of the convolutional trunk.
        layers: number of 3 × 3 convolutions in the trunk.
        residual: whether each convolution after the first adds its output to its input.
        shortcut: whether the heads see the input channels in addition to the features.
        context: whether features pooled over the whole bin are added to the features of every cell.
        planes: input planes in addition to the paper's four channels: any of {planes}.
        hidden: units of the hidden layer in the heads that follow pooling.
    """

    channels: int = 32
    layers: int = 3
    residual: bool = True
    shortcut: bool = True
    context: bool = True
    planes: list[str] = field(default_factory=lambda: list(DEFAULT_PLANES))
    hidden: int = 64

    def __post_init__(self) -> None:
        _check_sizes(self)
        for name in ("residual", "shortcut", "context"):
            truth_value(getattr(self, name), f"network: {name}")
        if not isinstance(self.planes, list | tuple) or not all(
            isinstance(plane, str) for plane in self.planes
        ):
            raise ValueError(f"network: planes = {shown(self.planes)}: needs a list of names")
        for plane in self.planes:
            renamed.refuse_old(plane, renamed.PLANES, "network: plane")
        unknown = [plane for plane in self.planes if plane not in PLANES]
        if unknown or len(set(self.planes)) < len(self.planes):
            guess = renamed.guess(unknown[0], PLANES) if unknown else ""
            raise ValueError(
                f"network: planes {shown(self.planes)}: any of {', '.join(PLANES)}, once{guess}"
            )


def _check_sizes(network: Network | SelectionNetwork) -> None:
    """Refuse a size that is not a whole number from 1 to its limit in :data:`MOST`."""
    for each in fields(network):
        if each.name in MOST:
            value = getattr(network, each.name)
            whole_number(value, f"network: {each.name} = {shown(value)}", 1, MOST[each.name])


Network.__doc__ = (Network.__doc__ or "").replace("{planes}", ", ".join(PLANES))
