"""Item streams: what the conveyor brings, episode by episode.

A stream is two pure functions. ``start(seed, episodes)`` returns the state of each episode, and
``item(state, t)`` the item at step t of each. Episode k of seed s is the same sequence in every
batch, on every device, whatever was played before. Weights are volumes unless a file gives them.

Sources (Zhao et al. 2021, sec. 5): ``rs`` draws uniformly from all types; ``cut1`` and ``cut2`` cut
the bin itself into items, so that a perfect packing is known (:mod:`marl_pack.items.cutting`).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import torch
from numba import njit
from torch import Tensor

from marl_pack import bins
from marl_pack.bins import Size
from marl_pack.items.cutting import cut
from marl_pack.items.random_numbers import GOLDEN, below, draw, episode_keys, mix


class Stream(Protocol):
    """Where items come from."""

    @property
    def smallest(self) -> int:
        """A lower bound on an item's volume in cells: it tells how many boxes a bin can hold."""
        ...

    @property
    def sides(self) -> tuple[int, int]:
        """Shortest and longest side that an item may have."""
        ...

    @property
    def episodes(self) -> int | None:
        """How many different episodes there are; None if there is no end of them."""
        ...

    @property
    def longest(self) -> int | None:
        """The most items an episode has; None if there is no end of them."""
        ...

    def start(self, seed: int, episodes: Tensor) -> Tensor:
        """State [K, …] at the start of the episodes numbered ``episodes`` (int64 [K])."""
        ...

    def item(self, state: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Sides int16 [N, 3] and weights float64 [N] at step ``t`` (int64 [N]); 0 at the end."""
        ...

    def to(self, device: torch.device | str) -> Stream:
        """The same stream with its tables on ``device``."""
        ...


# --- RS -------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _uniform_items(keys: Any, t: Any, low: int, kinds: int, sides: Any, weights: Any) -> None:
    """:meth:`Uniform.item` on the CPU, where a loop beats thirty tensor operations."""
    state = np.empty(1, np.uint64)
    for b in range(keys.size):
        state[0] = np.uint64(keys[b]) + np.uint64(t[b]) * np.uint64(GOLDEN)
        kind = draw(state, kinds**3)
        w, d, h = low + kind // kinds**2, low + kind // kinds % kinds, low + kind % kinds
        sides[b, 0], sides[b, 1], sides[b, 2] = w, d, h
        weights[b] = float(w) * d * h


@dataclass(frozen=True)
class Uniform:
    """RS: i.i.d. uniform over the types {low..high}³, without end."""

    low: int
    high: int
    episodes: None = None
    longest: None = None

    @property
    def smallest(self) -> int:
        """Volume of the smallest type."""
        return self.low**3

    @property
    def sides(self) -> tuple[int, int]:
        """Shortest and longest side."""
        return self.low, self.high

    def start(self, seed: int, episodes: Tensor) -> Tensor:
        """The episodes' keys, int64 [K]."""
        return episode_keys(seed, episodes)

    def item(self, state: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Sides int16 [N, 3] and weights float64 [N]."""
        kinds = self.high - self.low + 1
        if bins.compiled(state.device):
            out = np.empty((len(state), 3), np.int16), np.empty(len(state))
            _uniform_items(state.numpy(), t.numpy(), self.low, kinds, *out)
            return torch.from_numpy(out[0]), torch.from_numpy(out[1])
        kind = below(mix(state, t), kinds**3)
        sides = torch.stack((kind // kinds**2, kind // kinds % kinds, kind % kinds), 1) + self.low
        return sides.to(torch.int16), sides.double().prod(1)

    def to(self, device: torch.device | str) -> Uniform:
        """Itself: it has no tables."""
        return self


# --- CUT-1 and CUT-2 ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cut:
    """CUT-1 (``order`` 1) or CUT-2 (2): pieces of the bin, so that a perfect packing exists."""

    size: Size
    order: Literal[1, 2]
    low: int
    high: int
    episodes: None = None

    @property
    def smallest(self) -> int:
        """Volume of the smallest possible piece."""
        return self.low**3

    @property
    def sides(self) -> tuple[int, int]:
        """Shortest and longest side of a piece."""
        return self.low, self.high

    @property
    def longest(self) -> int:
        """As many pieces as fit if all are the smallest."""
        return int(np.prod([s // self.low for s in self.size]))

    def start(self, seed: int, episodes: Tensor) -> Tensor:
        """The episodes' items, int16 [K, L, 3]."""
        boxes = cut(self.size, self.order, seed, episodes, (self.low, self.high))[..., 3:]
        items = torch.zeros(len(boxes), self.longest, 3, dtype=torch.int16)
        items[:, : boxes.shape[1]] = boxes
        return items.to(episodes.device)

    def item(self, state: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Sides int16 [N, 3] and weights float64 [N]."""
        sides = _row(state, t)
        return sides, sides.double().prod(1)

    def to(self, device: torch.device | str) -> Cut:
        """Itself: the cuts are made on the CPU and handed over episode by episode."""
        return self


def fingerprint(stream: Stream) -> int:
    """A number that differs between streams of different items, the same in every process."""
    digest = hashlib.blake2b(type(stream).__name__.encode(), digest_size=7)
    for value in getattr(stream, "__dict__", {}).values():
        held = value.cpu().numpy().tobytes() if isinstance(value, Tensor) else repr(value).encode()
        digest.update(held)
    return int.from_bytes(digest.digest(), "little")


def _row(table: Tensor, t: Tensor) -> Tensor:
    """Row ``t`` [N] of each table [N, L, 3]; zeros past the end."""
    last = table.shape[1] - 1
    rows = table[torch.arange(len(table), device=table.device), t.clamp(max=last)]
    return rows * (t <= last)[:, None].to(rows.dtype)


# --- what may come --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Drawn:
    """Items drawn i.i.d. from the rows of a table, without end."""

    items: Tensor  # int16 [R, 3]     sides
    weights: Tensor  # float64 [R]
    episodes: None = None
    longest: None = None

    @property
    def smallest(self) -> int:
        """Volume of the smallest item."""
        return int(self.items.long().prod(1).min())

    @property
    def sides(self) -> tuple[int, int]:
        """Shortest and longest side of any item."""
        return int(self.items.min()), int(self.items.max())

    def start(self, seed: int, episodes: Tensor) -> Tensor:
        """The episodes' keys, int64 [K]."""
        return episode_keys(seed, episodes)

    def item(self, state: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Sides int16 [N, 3] and weights float64 [N]."""
        row = below(mix(state, t), len(self.items))
        return self.items[row], self.weights[row]

    def to(self, device: torch.device | str) -> Drawn:
        """The same table on ``device``."""
        return Drawn(self.items.to(device), self.weights.to(device))


def independent(stream: Stream, sequences: int = 500) -> Stream:
    """Items one by one as probable as in ``stream``, whatever came before them.

    Args:
        stream: RS, which is so itself; else the rows of its sequences are drawn from.
        sequences: how many of them, where they have no end.
    """
    if isinstance(stream, Uniform):
        return stream
    count = stream.episodes or sequences
    state = stream.start(-1, torch.arange(count))  # episodes that are played have seeds from 0
    rows = []
    for t in range(stream.longest or 0):
        sides, weights = stream.item(state, torch.full((count,), t))
        held = (sides > 0).all(1)
        rows.append((sides[held], weights[held]))
    if not rows:
        raise ValueError(f"{type(stream).__name__}: needs sequences that end, or a stream of RS")
    boxes, masses = zip(*rows, strict=True)
    return Drawn(torch.cat(boxes), torch.cat(masses))
