"""The choice between two codes that give the same results: compiled loops, and tensor code.

A backend is chosen once, where bins are made (:func:`marl_pack.bins.empty`), from their device.
Everything that is computed of these bins asks it which of two functions to call.
"""

from __future__ import annotations

from enum import Enum
from typing import TypeVar

import torch

F = TypeVar("F")


class Backend(Enum):
    """Which code computes masks, placements, items and afterstates."""

    COMPILED = "compiled"
    """Loops compiled by Numba; for tensors on the CPU."""
    TENSOR = "tensor"
    """Batched PyTorch operations; for tensors on any device."""

    def pick(self, *, compiled: F, tensor: F) -> F:
        """Return the function of this backend: the one switch between the two codes."""
        return compiled if self is Backend.COMPILED else tensor


def default_backend(device: torch.device | str) -> Backend:
    """Return the faster backend for tensors on ``device``."""
    return Backend.COMPILED if torch.device(device).type == "cpu" else Backend.TENSOR
