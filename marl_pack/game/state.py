"""The state of G games: everything that the rest of a game depends on.

Shapes use the letters G (games played at once), k (visible items of each game) and b (bins of each
game). The game of the paper has k = 1 and b = 1, so the tensors here have no axis for k and b: the
visible item is ``items`` [G], and game g packs bin g.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Self

import torch
from torch import Tensor

from marl_pack.bins import UNKNOWN, Bins, empty, place
from marl_pack.checks import shown
from marl_pack.geometry import ORIENTATIONS
from marl_pack.items.items import Items


class Copied:
    """A base class whose copies continue exactly like the original and share no state with it."""

    def __copy__(self) -> Self:
        """Return an independent copy; a shallow copy would share the game's state."""
        return copy.deepcopy(self)


@dataclass
class GameState:
    """The state of G games in play; copying, selecting and saving derive from the fields."""

    bins: Bins  # the G bins: game g packs bin g
    items: Items  # [G], the visible item of each game; zero sides at the end of its sequence
    episode: Tensor  # int64 [G]   number of the episode
    t: Tensor  # int64 [G]         items that the episode has had before the visible one
    lost: Tensor  # bool [G]       an orientation without a legal cell was chosen
    stream: Tensor  # [G, …]       state of the item stream in each episode

    def __len__(self) -> int:
        return len(self.t)

    def select(self, games: Tensor | slice) -> GameState:
        """Return the chosen games: copies for a tensor of indices, views for a slice."""
        return GameState(**{f.name: getattr(self, f.name)[games] for f in fields(self)})

    def tensors(self) -> dict[str, Tensor]:
        """Return every tensor by a dotted name, such as ``bins.heightmap``."""
        return dict(_tensors(self))

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Copy tensors into this state.

        Args:
            tensors: all tensors, with the names that :meth:`tensors` uses.

        Raises:
            ValueError: if a tensor is missing, unknown or of another shape or type, or if no game
                can reach this state. Nothing has changed then.
        """
        self.copy_from(self.holding(tensors))

    def copy_from(self, state: GameState) -> None:
        """Copy the tensors of another state of the same shapes into this one."""
        for target, tensor in zip(self.tensors().values(), state.tensors().values(), strict=True):
            target.copy_(tensor)

    def holding(self, tensors: Mapping[str, Tensor]) -> GameState:
        """Return a new state of the same games with other tensors; this state does not change.

        The arguments and the errors are those of :meth:`load`.
        """
        current = self.tensors()
        unknown = sorted(set(tensors) - set(current))
        if unknown:
            raise _of_another_game(f"this game has no {', '.join(unknown)}")
        for name, tensor in current.items():
            if name not in tensors:
                raise _of_another_game(f"{name} is missing, needs {list(tensor.shape)}")
            new = tensors[name]
            if not isinstance(new, Tensor):
                raise _of_another_game(f"{name} is {shown(new)}, needs a tensor")
            if new.shape != tensor.shape:
                raise _of_another_game(f"{name} is {list(new.shape)}, needs {list(tensor.shape)}")
            if new.dtype != tensor.dtype:
                raise _of_another_game(f"{name} is {new.dtype}, needs {tensor.dtype}")
        state = self.select(torch.arange(len(self), device=self.t.device))  # a copy
        for name, tensor in state.tensors().items():
            tensor.copy_(tensors[name])
        state.check()
        return state

    def check(self) -> None:
        """Refuse a state that no game can reach: the maps must follow from the boxes.

        Raises:
            ValueError: naming the first game and tensor that are wrong, and what would be right.
        """
        bins, items = self.bins, self.items
        most, longest = bins.boxes.shape[1], max(bins.size)
        refuse_where((bins.count < 0) | (bins.count > most), "bins.count", f"from 0 to {most}")
        real = torch.arange(most, device=bins.device) < bins.count[:, None]  # [G, M]
        corners, sides = bins.boxes[..., :3].long(), bins.boxes[..., 3:].long()
        top = torch.tensor(bins.size, device=bins.device)
        inside = (corners >= 0) & (sides >= 1) & (corners + sides <= top)
        refuse_where(real & ~inside.all(2), "bins.boxes", "boxes in the bin")
        weights, centres = bins.loads[..., 0], bins.loads[..., 1:]
        middle = centres - corners[..., :2]
        balanced = (weights > 0) & weights.isfinite()
        balanced &= ((middle >= 0) & (middle <= sides[..., :2])).all(2)
        refuse_where(real & ~balanced, "bins.loads", "a positive weight and a centre in the box")
        labels = (bins.labels >= UNKNOWN).all(2) & (bins.labels[..., 1] < len(ORIENTATIONS))
        refuse_where(real & ~labels, "bins.labels", "an item's number and an orientation")
        rebuilt = empty(len(self), bins.size, most, bins.device, bins.backend)
        for k in range(int(bins.count.max())):
            present = torch.where(real[:, k, None], bins.boxes[:, k, 3:], 0)
            place(rebuilt, present, torch.where(real[:, k, None], corners[:, k, :2], 0))
        for name in ("heightmap", "empty_map", "filled", "boxes"):
            wrong = getattr(bins, name) != getattr(rebuilt, name)
            wrong = wrong & real[..., None] if name == "boxes" else wrong
            refuse_where(wrong, f"bins.{name}", "the result of placing the boxes in order")
        shape = (items.sides >= 1) & (items.sides <= longest)
        present = items.sides.any(1)
        refuse_where(present & ~shape.all(1), "items.sides", f"from 1 to {longest}, or zeros")
        heavy = (items.weights > 0) & items.weights.isfinite()
        refuse_where(present & ~heavy, "items.weights", "a positive number")
        refuse_where(self.t < 0, "t", "0 or more")


def refuse_where(wrong: Tensor, name: str, needs: str) -> None:
    """Raise ValueError with the first game in which a tensor of a state is wrong, bool [G, …]."""
    games = wrong.flatten(1).any(1) if wrong.dim() > 1 else wrong
    if bool(games.any()):
        raise _of_another_game(f"{name} of game {int(games.int().argmax())}: needs {needs}")


def _of_another_game(reason: str) -> ValueError:
    return ValueError(f"state of another game: {reason}")


def _tensors(record: Any, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    """Yield the tensors of a record and of the records in it, with dotted names."""
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, Tensor):
            yield prefix + field.name, value
        elif is_dataclass(value):
            yield from _tensors(value, f"{prefix}{field.name}.")
