"""Counter-based random numbers, equal on every device, in every batch and with both backends."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from marl_pack.backend import Backend, default_backend
from marl_pack.installation import njit

GOLDEN, _MIX_1, _MIX_2 = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB


def _signed(value: int) -> int:
    """Return the signed integer with the 64-bit pattern of ``value``."""
    value &= (1 << 64) - 1
    return value - (1 << 64) if value >> 63 else value


def _shift_right(x: Tensor, bits: int) -> Tensor:
    """Return int64 ``x`` shifted right by ``bits``, with zeros for the bits that come in."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def mix(key: Tensor, counter: Tensor | int) -> Tensor:
    """Return 64 random bits for each (key, counter), int64.

    This is the output function of SplitMix64 (Steele et al. 2014).
    """
    if not isinstance(counter, Tensor):
        counter = torch.full_like(key, counter)
    z = key + (counter + 1) * _signed(GOLDEN)
    z = (z ^ _shift_right(z, 30)) * _signed(_MIX_1)
    z = (z ^ _shift_right(z, 27)) * _signed(_MIX_2)
    return z ^ _shift_right(z, 31)


def below(bits: Tensor, limit: int) -> Tensor:
    """Return a uniform whole number in 0 … limit - 1 from random bits (bias below limit / 2³²)."""
    return _shift_right(_shift_right(bits, 32) * limit, 32)


def episode_keys(seed: int, episodes: Tensor, backend: Backend | None = None) -> Tensor:
    """Return one independent key, int64 [K], for each episode of a seed."""
    chosen = default_backend(episodes.device) if backend is None else backend
    code = chosen.pick(compiled=_keys_compiled, tensor=_keys_tensor)
    return code(_signed(seed), episodes)


def _keys_tensor(seed: int, episodes: Tensor) -> Tensor:
    return mix(mix(torch.full_like(episodes, seed), 0), episodes)


def _keys_compiled(seed: int, episodes: Tensor) -> Tensor:
    keys = np.empty(len(episodes), np.int64)
    _write_keys(seed, episodes.numpy(), keys)
    return torch.from_numpy(keys)


@njit(cache=True, inline="always")
def _mixed(z: Any) -> Any:
    """Return the output function of SplitMix64 for a state uint64."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(_MIX_1)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(_MIX_2)
    return z ^ (z >> np.uint64(31))


@njit(cache=True, nogil=True)
def _write_keys(seed: int, episodes: Any, keys: Any) -> None:
    own = _mixed(np.uint64(seed) + np.uint64(GOLDEN))
    for k in range(keys.size):
        keys[k] = np.int64(
            _mixed(own + (np.uint64(episodes[k]) + np.uint64(1)) * np.uint64(GOLDEN))
        )


@njit(cache=True)
def draw(state: Any, limit: int) -> int:
    """Return the next whole number in 0 … limit - 1 of the generator ``state``.

    The generator is SplitMix64; ``state`` (uint64 [1]) is advanced in place.
    """
    state[0] += np.uint64(GOLDEN)
    z = _mixed(state[0])
    return int(((z >> np.uint64(32)) * np.uint64(limit)) >> np.uint64(32))
