"""The state of G games: all that the rest of a game depends on, listed once.

The letters of shapes: G games played at once, k visible items of each, b bins of each. The game of
the paper has k = 1 and b = 1, so the tensors here have no axis for them: the visible item is
``items`` [G], and game g packs bin g.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

from torch import Tensor

from marl_pack.bins import Bins
from marl_pack.items.items import Items


@dataclass
class GameState:
    """The state of G games in play; copying, selecting and saving derive from the fields."""

    bins: Bins  # of G bins: game g packs bin g
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
            tensors: as :meth:`tensors` names them.

        Raises:
            ValueError: if one is missing, unknown or has another shape; nothing has changed then.
        """
        own = self.tensors()
        unknown = sorted(set(tensors) - set(own))
        if unknown:
            raise ValueError(f"state of another game: this one has no {', '.join(unknown)}")
        for name, tensor in own.items():
            if name not in tensors or tensors[name].shape != tensor.shape:
                shape = list(tensors[name].shape) if name in tensors else "missing"
                raise ValueError(
                    f"state of another game: {name} is {shape}, needs {list(tensor.shape)}"
                )
        for name, tensor in own.items():
            tensor.copy_(tensors[name])


def _tensors(record: Any, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    """Yield the tensors of a record and of the records in it, with dotted names."""
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, Tensor):
            yield prefix + field.name, value
        elif is_dataclass(value):
            yield from _tensors(value, f"{prefix}{field.name}.")
