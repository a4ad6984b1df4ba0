"""The input planes of the networks: :data:`PLANES` has one record for each plane.

A record says which tensors of an observation belong to a plane, and which input channels they
become. Everything else is derived from these records: the settings and their help, the symmetries
of the bin, the exported files, and networks that get more planes.

The shape of a tensor in an observation says what it describes. In [G, W, D] each cell describes a
column of the bin; in [G, A, W, D] each cell describes a placement with its low corner there, in one
of the A orientations that the agent judges; [G, 1] is one number for the bin.

The settings need the names of the planes, so this module imports torch only where it is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from marl_pack.agents.afterstates.limits import ILLEGAL

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from marl_pack.agents.networks.sight import Observation, Sight


@dataclass(frozen=True)
class Meaning:
    """The meaning of the numbers in one tensor of an observation.

    Args:
        unit: their unit, or the range of their values.
        text: what they describe, and how they are computed.
    """

    unit: str
    text: str


@dataclass(frozen=True)
class Plane:
    """One plane that a network may see beside the paper's four channels.

    Args:
        name: its name in settings.
        meaning: its meaning in a few words.
        observe: view of a turn → tensors of the observation, by name; planes may share a tensor.
        tensors: the meaning of these tensors, by name.
        channels: number of input channels for A orientations.
        encode: observation → input channels, float32 [G, …, W, D] each.
        needs_critic: whether the plane needs a critic of afterstates.
    """

    name: str
    meaning: str
    observe: Callable[[Sight], dict[str, Tensor]]
    tensors: dict[str, Meaning]
    channels: Callable[[int], int]
    encode: Callable[[Observation], list[Tensor]]
    needs_critic: bool = False


def _shape(observation: Observation) -> torch.Size:
    return observation["heightmap"].shape[1:]


def _at_every_cell(number: Tensor, shape: torch.Size) -> Tensor:
    """Repeat a number of each bin [G, 1] at every cell, [G, 1, W, D]."""
    return number[:, :, None, None].expand(-1, 1, *shape)


def _height(observation: Observation) -> Tensor:
    """Return the bin's height H, float32 [G, 1, 1, 1]."""
    return observation["height"].float()[:, :, None, None]


def _encode_waste(observation: Observation) -> list[Tensor]:
    volume = observation["item"].float().prod(1) + 1
    return [observation["waste"].float() / volume[:, None, None, None]]


def _observe_feasible_cells(sight: Sight) -> dict[str, Tensor]:
    cells = sight.lookahead.feasible_cells(sight.game)
    most = cells.flatten(1).amax(1, keepdim=True)
    return {"feasible_cells": sight.judged(cells), "most_feasible_cells": most}


def _encode_feasible_cells(observation: Observation) -> list[Tensor]:
    cells, most = observation["feasible_cells"], observation["most_feasible_cells"]
    close = 1 + 5 * (cells.log1p() - most[:, :, None, None].log1p())
    level = _at_every_cell(most.log1p() / 4, _shape(observation))
    return [close.clamp(min=0) * (cells > 0), level]


def _observe_afterstate_value(sight: Sight) -> dict[str, Tensor]:
    import torch

    value = sight.judged(sight.lookahead.afterstate_value(sight.game))
    best = value.flatten(1).amax(1, keepdim=True)
    best = torch.where(best > ILLEGAL, best, 0)
    return {"afterstate_value": value, "best_afterstate_value": best}


def _encode_afterstate_value(observation: Observation) -> list[Tensor]:
    best = observation["best_afterstate_value"]
    behind = observation["afterstate_value"] - best[:, :, None, None]
    near = [(1 + scale * behind).clamp(min=0) for scale in (20, 200)]
    return [*near, _at_every_cell(best, _shape(observation))]


ALWAYS_OBSERVED = {
    "heightmap": Meaning("cells", "height of each column: the top of its highest box; 0 if empty"),
    "item": Meaning(
        "cells",
        "sides w, d, h of the item as it comes; for the placement agent its sides along x, y, z in "
        "the chosen orientation",
    ),
    "height": Meaning("cells", "height H of the bin"),
    "mask": Meaning(
        "true or false",
        "whether each action is legal (an orientation is legal if it has a legal cell); illegal "
        "actions have probability 0",
    ),
}
"""The meaning of the tensors that every observation has, by name."""

PREVIEW = ("preview_longest", "preview_middle", "preview_shortest")
"""The tensors of the plane ``preview``; sides in order mean the same if the bin is mirrored."""

PLANES: dict[str, Plane] = {
    plane.name: plane
    for plane in (
        Plane(
            "mask",
            "the cells where the item may be placed",
            lambda sight: {"legal_cells": sight.mask},
            {
                "legal_cells": Meaning(
                    "true or false",
                    "whether the item may be placed with its low corner there: it is inside the "
                    "bin and stable by the rule of training",
                )
            },
            lambda orientations: orientations,
            lambda observation: [observation["legal_cells"].float()],
        ),
        Plane(
            "resting_height",
            "the item's resting height at every cell, as a share of H",
            lambda sight: {"resting_height": sight.windows[0]},
            {
                "resting_height": Meaning(
                    "cells",
                    "height of the highest column in the item's w × d window with its low corner "
                    "there; H where the window is not inside the bin",
                )
            },
            lambda orientations: orientations,
            lambda observation: [observation["resting_height"].float() / _height(observation)],
        ),
        Plane(
            "waste",
            "the cells that the item would enclose, as a share of its own volume",
            lambda sight: {"waste": sight.windows[1]},
            {
                "waste": Meaning(
                    "cells",
                    "empty cells that the item would enclose below it: the sum over its window of "
                    "resting height - height of the column; 0 where the window is not inside the "
                    "bin",
                )
            },
            lambda orientations: orientations,
            _encode_waste,
        ),
        Plane(
            "feasible_cells",
            "the mean number of cells where the next item could be placed afterwards: 1 for the "
            "largest number, 0 for a fifth less or fewer; and the largest number itself",
            _observe_feasible_cells,
            {
                "feasible_cells": Meaning(
                    "cells",
                    "mean number of cells where a box that may come next could be placed after "
                    "this placement, by hull_alpha; 0 where it is not legal",
                ),
                "most_feasible_cells": Meaning(
                    "cells", "largest feasible_cells of all placements in all orientations"
                ),
            },
            lambda orientations: orientations + 1,
            _encode_feasible_cells,
        ),
        Plane(
            "feasible_probability",
            "the probability that the next item has a feasible cell afterwards",
            lambda sight: {
                "feasible_probability": sight.judged(
                    sight.lookahead.feasible_probability(sight.game)
                )
            },
            {
                "feasible_probability": Meaning(
                    "0 to 1",
                    "probability that the next item has a feasible cell after this placement, by "
                    "hull_alpha; 0 where it is not legal",
                )
            },
            lambda orientations: orientations,
            lambda observation: [observation["feasible_probability"]],
        ),
        Plane(
            "afterstate_value",
            "the return that a critic of afterstates expects from each placement, on two scales: 1 "
            "for the best placement, 0 for a twentieth or a two-hundredth of the bin less; and the "
            "best return itself",
            _observe_afterstate_value,
            {
                "afterstate_value": Meaning(
                    "reward",
                    "reward of this placement plus the value of its afterstate by "
                    f"afterstate_critic.onnx; {ILLEGAL:.0f} where it is not legal",
                ),
                "best_afterstate_value": Meaning(
                    "reward", "largest value of all placements; 0 if none is legal"
                ),
            },
            lambda orientations: 2 * orientations + 1,
            _encode_afterstate_value,
            needs_critic=True,
        ),
        Plane(
            "grounded",
            "the columns that are filled down to the floor, which carry boxes under hull_alpha",
            lambda sight: {"grounded": sight.game.bins.empty_map == 0},
            {
                "grounded": Meaning(
                    "true or false", "whether the column is filled from the floor to its top"
                )
            },
            lambda orientations: 1,
            lambda observation: [observation["grounded"].float()[:, None]],
        ),
        Plane(
            "filled",
            "the filled share of the bin; if items are cut from a bin, the rest is still to come",
            lambda sight: {"filled": sight.utilization[:, None].float()},
            {"filled": Meaning("0 to 1", "filled share of the bin's volume")},
            lambda orientations: 1,
            lambda observation: [_at_every_cell(observation["filled"], _shape(observation))],
        ),
        Plane(
            "preview",
            "the sides of the first box of the preview in falling order, as shares of H; 0 without "
            "a preview",
            lambda sight: {
                name: sight.following[:, i : i + 1].float() for i, name in enumerate(PREVIEW)
            },
            {
                name: Meaning("cells", f"{side} side of the first box of the preview; 0 for none")
                for name, side in zip(PREVIEW, ("longest", "middle", "shortest"), strict=True)
            },
            lambda orientations: 3,
            lambda observation: [
                _at_every_cell(observation[name] / observation["height"], _shape(observation))
                for name in PREVIEW
            ],
        ),
    )
}
"""Every plane by its name."""


def need_critic(planes: Iterable[str]) -> bool:
    """Return whether any of the planes needs a critic of afterstates.

    Unknown names are ignored here; a network refuses them when it is built.
    """
    return any(name in PLANES and PLANES[name].needs_critic for name in planes)


ENCODED = "input_channels"
"""The tensor float32 [G, W, D, C] of an encoded observation (:func:`encode_observation`)."""


def encode_observation(observation: Observation, planes: Sequence[str]) -> dict[str, Tensor]:
    """Return the observation with its input channels in place of the tensors they are made of.

    A network computes the same from both. What is observed often is so encoded only once.
    """
    channels = input_channels(observation, planes).movedim(1, 3)
    return {ENCODED: channels, "mask": observation["mask"]}


def input_channels(observation: Observation, planes: Sequence[str]) -> Tensor:
    """Build a network's input: the paper's four channels, then those of the planes.

    The four channels are the heightmap as a share of H and the item's sides as shares of W, D and
    H, so that they mean the same in every bin (paper, sec. III-D).

    Args:
        observation: ``heightmap`` int [G, W, D], ``item`` int [G, 3], ``height`` int [G, 1] (H),
            and the tensors of the planes; or an encoded
            observation.
        planes: names in :data:`PLANES`.

    Returns:
        Float32 [G, C, W, D], channels last in memory.
    """
    import torch

    if ENCODED in observation:
        return observation[ENCODED].movedim(3, 1)
    heightmap, item = observation["heightmap"], observation["item"].float()
    width, depth = heightmap.shape[1:]
    height = observation["height"].float()  # [G, 1]
    scale = torch.cat((torch.full_like(height, width), torch.full_like(height, depth), height), 1)
    channels = [heightmap.float()[:, None] / height[:, :, None, None]]
    channels.append((item / scale)[:, :, None, None].expand(-1, -1, width, depth))
    for name in planes:
        channels += PLANES[name].encode(observation)
    return torch.cat(channels, 1).contiguous(memory_format=torch.channels_last)


def channel_names(planes: Sequence[str], orientations: int) -> list[tuple[str, int]]:
    """List the channels of :func:`input_channels` for A orientations, as (plane, number)."""
    counts = [("paper", 4), *((name, PLANES[name].channels(orientations)) for name in planes)]
    return [(name, k) for name, count in counts for k in range(count)]
