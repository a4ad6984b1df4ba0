"""Choose between two implementations with equal results: compiled loops and tensor code.

A backend is chosen once, from the device, when bins are made (:func:`marl_pack.bins.empty`). Every
operation on these bins calls :meth:`Backend.pick` to select one of two functions.
"""

from __future__ import annotations

from enum import Enum
from typing import TypeVar

import torch

F = TypeVar("F")


class Backend(Enum):
    """The implementation that computes masks, placements, items and afterstates."""

    COMPILED = "compiled"
    """Loops compiled by Numba; for tensors on the CPU."""
    TENSOR = "tensor"
    """Batched PyTorch operations; for tensors on any device."""

    __hash__ = object.__hash__  # members are single objects; that of Enum takes a microsecond

    def pick(self, *, compiled: F, tensor: F) -> F:
        """Return the function of this backend; this is the only switch between the two."""
        return compiled if self is Backend.COMPILED else tensor


def default_backend(device: torch.device | str) -> Backend:
    """Return the faster backend for tensors on ``device``."""
    return Backend.COMPILED if torch.device(device).type == "cpu" else Backend.TENSOR
