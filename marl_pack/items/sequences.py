"""The stream of item sequences that the user gives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from marl_pack.backend import Backend
from marl_pack.items.items import Items


@dataclass(frozen=True)
class Sequences:
    """The stream of given sequences: episode k is sequence k modulo their number."""

    rows: Items  # [R]     the items of all sequences, one after the other
    spans: (
        Tensor  # int64 [S, 2]  number of each sequence's first row, and of the row after its last
    )
    id_names: tuple[str, ...] | None = None  # texts that the ids index

    @property
    def items(self) -> Items:
        """The items of each sequence [S, L], with zeros after its end."""
        numbers = torch.arange(self.episodes, device=self.spans.device)
        places = numbers.repeat_interleave(self.spans.diff().squeeze(1)), self.steps()
        shape = self.episodes, self.longest
        return self.rows.map(
            lambda values: values.new_zeros(*shape, *values.shape[1:]).index_put(places, values)
        )

    def steps(self) -> Tensor:
        """Return the position of each row in its sequence, int64 [R]."""
        first, end = self.spans.unbind(1)
        rows = torch.arange(len(self.rows.sides), device=first.device)
        return rows - first.repeat_interleave(end - first)

    @property
    def smallest(self) -> int:
        """Volume of the smallest item, in cells."""
        return int(self.rows.sides.long().prod(1).min())

    @property
    def sides(self) -> tuple[int, int]:
        """Shortest and longest side of any item, in cells."""
        return int(self.rows.sides.min()), int(self.rows.sides.max())

    @property
    def orientation_sets(self) -> dict[tuple[int, ...], float]:
        """Sets of orientations that items may take → share of items with this set."""
        return self.rows.orientation_sets()

    @property
    def episodes(self) -> int:
        """Number of sequences S."""
        return len(self.spans)

    @property
    def longest(self) -> int:
        """Length L of the longest sequence."""
        return int(self.spans.diff().max())

    def start(self, seed: int, episodes: Tensor) -> Tensor:
        """Return the indices of the sequences, int64 [K]; the seed has no effect."""
        return episodes % self.episodes

    def restart(self, state: Tensor, seed: int, episodes: Tensor, ended: Tensor) -> Tensor:
        """Return the state in which the games ``ended`` have begun the episodes ``episodes``."""
        return torch.where(ended, self.start(seed, episodes), state)

    def item(self, state: Tensor, t: Tensor) -> Items:
        """Return the items [N] at step ``t`` of each sequence; zeros after its end."""
        first, end = self.spans[state].unbind(1)
        row = first + t
        past = row >= end
        beyond = past[:, None]
        row = row.masked_fill(past, 0)
        return self.rows.map(
            lambda table: table[row].masked_fill_(past if table.ndim == 1 else beyond, 0)
        ).numbered(t)

    def to(self, device: torch.device | str, backend: Backend | None = None) -> Sequences:
        """Return the same sequences on ``device``; both backends use the same code."""
        return replace(self, rows=self.rows.to(device), spans=self.spans.to(device))
