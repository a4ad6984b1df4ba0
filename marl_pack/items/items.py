"""The items to be packed: one record whose fields every file, array, stream and plan shares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Items:
    """Items with their attributes, one tensor an attribute.

    Leading dimensions are free, e.g. [G] for the visible item of G games or [S, L] for S sequences.
    An attribute that is None has its default for every item, which costs nothing to carry.
    """

    sides: Tensor  # int16 [..., 3]              own sides w, d, h in cells; zeros: no item
    weights: Tensor  # float64 [...]             weight; volumes unless given
    orientations: Tensor | None = None  # bool [..., 6]  orientations it may be placed in; None: all
    ids: Tensor | None = None  # int64 [...]     number of the item; None: its place in the sequence

    def map(self, change: Callable[[Tensor], Tensor]) -> Items:
        """Return the items with ``change`` applied to every field that is not None."""
        return replace(self, **{name: change(value) for name, value in self.tensors().items()})

    def __getitem__(self, index: Any) -> Items:
        """Return the chosen items."""
        return self.map(lambda values: values[index])

    def to(self, device: torch.device | str) -> Items:
        """Return the items on ``device``."""
        return self.map(lambda values: values.to(device))

    def tensors(self) -> dict[str, Tensor]:
        """Return the fields that are not None, by name."""
        named = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in named.items() if value is not None}
