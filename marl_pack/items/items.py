"""The items to be packed: the record that streams, games and plans use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from marl_pack.geometry import ALL_ORIENTATIONS


@dataclass(frozen=True)
class Items:
    """Items with their attributes, one tensor for each attribute.

    Leading dimensions are free, e.g. [G] for the visible item of G games or [S, L] for S sequences.
    An attribute that is None has its default value for every item and needs no memory.
    """

    sides: Tensor  # int16 [..., 3]              own sides w, d, h in cells; zeros: no item
    weights: Tensor  # float64 [...]             weight; by default the volume
    orientations: Tensor | None = None  # bool [..., 6]  orientations it may be placed in; None: all
    ids: Tensor | None = None  # int64 [...]     index of the id; None: position in the sequence

    def map(self, change: Callable[[Tensor], Tensor]) -> Items:
        """Return the items with ``change`` applied to every field that is not None."""
        return Items(**{name: change(value) for name, value in self.tensors().items()})

    def __getitem__(self, index: Any) -> Items:
        """Return the chosen items."""
        return self.map(lambda values: values[index])

    def to(self, device: torch.device | str) -> Items:
        """Return the items on ``device``."""
        return self.map(lambda values: values.to(device))

    def tensors(self) -> dict[str, Tensor]:
        """Return the fields that are not None, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def numbered(self, t: Tensor) -> Items:
        """Return the items with ids: their own, or their positions ``t`` in the sequences."""
        return self if self.ids is not None else Items(**self.tensors() | {"ids": t})

    def ids_at(self, t: Tensor) -> Tensor:
        """Return the items' ids; without ids, their positions ``t`` in the sequences."""
        return t if self.ids is None else self.ids

    @property
    def present(self) -> Tensor:
        """The entries that hold an item, bool [...]."""
        return self.sides[..., 0] > 0

    def orientation_sets(self) -> dict[tuple[int, ...], float]:
        """Return the sets of orientations that items may take → share of items with this set."""
        if self.orientations is None:
            return {ALL_ORIENTATIONS: 1.0}
        masks = self.orientations[self.present].cpu().numpy()
        rows, counts = np.unique(masks, axis=0, return_counts=True)
        sets = [tuple(np.flatnonzero(row).tolist()) for row in rows]
        return dict(zip(sets, (counts / len(masks)).tolist(), strict=True))


def join(parts: Sequence[Items]) -> Items:
    """Return the items of all ``parts``, which have the same fields, in one record."""
    tensors = [part.tensors() for part in parts]
    return Items(**{name: torch.cat([part[name] for part in tensors]) for name in tensors[0]})
