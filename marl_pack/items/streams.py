"""Item streams: the items that the conveyor brings, episode by episode.

A stream has three pure functions. ``start(seed, episodes)`` returns the state of each episode,
``item(state, t)`` returns the item at step t of each episode, and ``restart`` returns the state
after some episodes have ended. Episode k of seed s is the same sequence in every batch and on every
device. By default, the weight of an item is its volume.

The generated streams are those of Zhao et al. 2021, sec. 5: ``rs`` draws uniformly from all types;
``cut1`` and ``cut2`` cut the bin itself into items, so that a perfect packing is known
(:mod:`marl_pack.items.cutting`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from marl_pack.backend import Backend, default_backend
from marl_pack.geometry import ALL_ORIENTATIONS, Size
from marl_pack.installation import njit
from marl_pack.items.cutting import cut
from marl_pack.items.items import Items, join
from marl_pack.items.random_numbers import GOLDEN, below, draw, episode_keys, mix
from marl_pack.items.sequences import Sequences


class Stream(Protocol):
    """A source of items, one after the other, in numbered episodes."""

    @property
    def smallest(self) -> int:
        """A lower bound on an item's volume in cells; it bounds how many boxes a bin can hold."""
        ...

    @property
    def sides(self) -> tuple[int, int]:
        """Shortest and longest side that an item may have, in cells."""
        ...

    @property
    def orientation_sets(self) -> Mapping[tuple[int, ...], float]:
        """Sets of orientations that items may take, with the share of items that have each."""
        ...

    @property
    def id_names(self) -> tuple[str, ...] | None:
        """The texts that the items' ids index; None if ids are numbers."""
        ...

    @property
    def episodes(self) -> int | None:
        """Number of different episodes; None if it is not limited."""
        ...

    @property
    def longest(self) -> int | None:
        """The largest number of items in an episode; None if it is not limited."""
        ...

    def start(self, seed: int, episodes: Tensor) -> Tensor:
        """Return the state [K, …] at the start of the episodes ``episodes`` (int64 [K])."""
        ...

    def restart(self, state: Tensor, seed: int, episodes: Tensor, ended: Tensor) -> Tensor:
        """Return the state [N, …] in which some episodes begin and the others continue.

        Args:
            state: state of the N episodes; it is not changed.
            seed: seed of the episodes that begin.
            episodes: int64 [N], numbers of the episodes that begin; the other numbers have no
                effect.
            ended: bool [N], where an episode has ended and the next one begins.
        """
        ...

    def item(self, state: Tensor, t: Tensor) -> Items:
        """Return the items [N] at step ``t`` (int64 [N]); zeros past the end.

        Their ids are those that the user gave; without ids, they are ``t``.
        """
        ...

    def to(self, device: torch.device | str, backend: Backend | None = None) -> Stream:
        """Return the same stream with its tables on ``device``.

        Args:
            device: the device of states and items.
            backend: the code that draws items; by default the faster one on ``device``.
        """
        ...


# --- RS -------------------------------------------------------------------------------------------


def _uniform_compiled(keys: Tensor, t: Tensor, low: int, kinds: int) -> tuple[Tensor, Tensor]:
    """Draw items by one compiled loop, on the CPU faster than thirty tensor operations."""
    sides, weights = np.empty((len(keys), 3), np.int16), np.empty(len(keys))
    _uniform_loop(keys.numpy(), t.numpy(), low, kinds, sides, weights)
    return torch.from_numpy(sides), torch.from_numpy(weights)


@njit(cache=True, nogil=True)
def _uniform_loop(keys: Any, t: Any, low: int, kinds: int, sides: Any, weights: Any) -> None:
    """Write the sides [N, 3] and the weights [N] of the items drawn."""
    state = np.empty(1, np.uint64)
    for b in range(keys.size):
        state[0] = np.uint64(keys[b]) + np.uint64(t[b]) * np.uint64(GOLDEN)
        kind = draw(state, kinds**3)
        w, d, h = low + kind // kinds**2, low + kind // kinds % kinds, low + kind % kinds
        sides[b, 0], sides[b, 1], sides[b, 2] = w, d, h
        weights[b] = float(w) * d * h


def _uniform_tensor(keys: Tensor, t: Tensor, low: int, kinds: int) -> tuple[Tensor, Tensor]:
    """Draw the same items by tensor operations, on any device."""
    kind = below(mix(keys, t), kinds**3)
    sides = torch.stack((kind // kinds**2, kind // kinds % kinds, kind % kinds), 1) + low
    return sides.to(torch.int16), sides.double().prod(1)


@dataclass(frozen=True)
class Uniform:
    """The stream RS: items drawn uniformly from the types {low..high}³, without end."""

    low: int
    high: int
    episodes: None = None
    longest: None = None
    id_names: None = None
    backend: Backend = field(default=Backend.COMPILED, compare=False)

    @property
    def smallest(self) -> int:
        """Volume of the smallest type, in cells."""
        return self.low**3

    @property
    def sides(self) -> tuple[int, int]:
        """Shortest and longest side of an item, in cells."""
        return self.low, self.high

    @property
    def orientation_sets(self) -> dict[tuple[int, ...], float]:
        """All six orientations, for every item."""
        return {ALL_ORIENTATIONS: 1.0}

    def start(self, seed: int, episodes: Tensor) -> Tensor:
        """Return the episodes' keys, int64 [K]."""
        return episode_keys(seed, episodes, self.backend)

    def restart(self, state: Tensor, seed: int, episodes: Tensor, ended: Tensor) -> Tensor:
        """Return the keys, new where episodes have ended."""
        return torch.where(ended, self.start(seed, episodes), state)

    def item(self, state: Tensor, t: Tensor) -> Items:
        """Return the items [N] at step ``t``, drawn from the episode's key and ``t``."""
        draw_items = self.backend.pick(compiled=_uniform_compiled, tensor=_uniform_tensor)
        sides, weights = draw_items(state, t, self.low, self.high - self.low + 1)
        return Items(sides, weights, ids=t)

    def to(self, device: torch.device | str, backend: Backend | None = None) -> Uniform:
        """Return the stream that draws by ``backend``; it has no tables."""
        return replace(self, backend=backend or default_backend(device))


# --- CUT-1 and CUT-2 ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cut:
    """The stream CUT-1 (``order`` 1) or CUT-2 (2): pieces of the bin, which fill it perfectly."""

    size: Size
    order: Literal[1, 2]
    low: int
    high: int
    episodes: None = None
    id_names: None = None

    @property
    def smallest(self) -> int:
        """Volume of the smallest possible piece, in cells."""
        return self.low**3

    @property
    def sides(self) -> tuple[int, int]:
        """Shortest and longest side of a piece, in cells."""
        return self.low, self.high

    @property
    def orientation_sets(self) -> dict[tuple[int, ...], float]:
        """All six orientations, for every piece."""
        return {ALL_ORIENTATIONS: 1.0}

    @property
    def longest(self) -> int:
        """Number of pieces if all have the smallest size."""
        return int(np.prod([s // self.low for s in self.size]))

    def start(self, seed: int, episodes: Tensor) -> Tensor:
        """Return the episodes' items, int16 [K, L, 3]."""
        return self.boxes(seed, episodes)[..., 3:].contiguous()

    def boxes(self, seed: int, episodes: Tensor) -> Tensor:
        """Return the episodes' pieces where they were cut: x, y, z, w, d, h, int16 [K, L, 6]."""
        cut_boxes = cut(self.size, self.order, seed, episodes, (self.low, self.high))
        boxes = torch.zeros(len(cut_boxes), self.longest, 6, dtype=torch.int16)
        boxes[:, : cut_boxes.shape[1]] = cut_boxes
        return boxes.to(episodes.device)

    def restart(self, state: Tensor, seed: int, episodes: Tensor, ended: Tensor) -> Tensor:
        """Return the episodes' items, newly cut where an episode has ended.

        Cutting is CPU code, so only these episodes are cut, and the host waits for their number.
        """
        index = ended.nonzero().squeeze(1)
        return state.index_copy(0, index, self.start(seed, episodes[index]))

    def item(self, state: Tensor, t: Tensor) -> Items:
        """Return the pieces [N] at step ``t`` of each episode; zeros past the end."""
        last = state.shape[1] - 1
        sides = state[torch.arange(len(state), device=state.device), t.clamp(max=last)]
        sides = sides * (t <= last)[:, None].to(sides.dtype)
        return Items(sides, sides.double().prod(1), ids=t)

    def to(self, device: torch.device | str, backend: Backend | None = None) -> Cut:
        """Return the stream itself: bins are cut on the CPU, whatever the device and backend."""
        return self


# --- i.i.d. from a table --------------------------------------------------------------------------


@dataclass(frozen=True)
class Drawn:
    """A stream of items drawn i.i.d. from the rows of a table, without end."""

    items: Items  # [R]
    episodes: None = None
    longest: None = None
    id_names: tuple[str, ...] | None = None

    @property
    def smallest(self) -> int:
        """Volume of the smallest item, in cells."""
        return int(self.items.sides.long().prod(1).min())

    @property
    def sides(self) -> tuple[int, int]:
        """Shortest and longest side of any item, in cells."""
        return int(self.items.sides.min()), int(self.items.sides.max())

    @property
    def orientation_sets(self) -> dict[tuple[int, ...], float]:
        """Sets of orientations that items may take, with the share of items that have each."""
        return self.items.orientation_sets()

    def start(self, seed: int, episodes: Tensor) -> Tensor:
        """Return the episodes' keys, int64 [K]."""
        return episode_keys(seed, episodes)

    def restart(self, state: Tensor, seed: int, episodes: Tensor, ended: Tensor) -> Tensor:
        """Return the keys, new where episodes have ended."""
        return torch.where(ended, self.start(seed, episodes), state)

    def item(self, state: Tensor, t: Tensor) -> Items:
        """Return the items [N] at step ``t``, drawn from the table by key and ``t``."""
        return self.items[below(mix(state, t), len(self.items.sides))].numbered(t)

    def to(self, device: torch.device | str, backend: Backend | None = None) -> Drawn:
        """Return the stream with its table on ``device``; every backend draws by tensor code."""
        return replace(self, items=self.items.to(device))


AT_ONCE = 1 << 20
"""Approximate number of state entries copied at once when a stream's items are collected."""


def independent(stream: Stream, sequences: int = 500) -> Stream:
    """Return a stream of i.i.d. items, each as probable as in ``stream``.

    Args:
        stream: a stream. RS and tables are i.i.d. and are returned unchanged; for other streams,
            items are drawn from their sequences.
        sequences: number of sequences to draw from if the stream has no limit on episodes.

    Raises:
        ValueError: if the stream's sequences have no end.
    """
    if isinstance(stream, Uniform | Drawn):
        return stream
    if isinstance(stream, Sequences):  # in the order in which the loop below collects items
        order = stream.steps().argsort(stable=True)
        return Drawn(stream.rows[order], id_names=stream.id_names)
    if stream.longest is None:
        raise ValueError(f"{type(stream).__name__}: needs sequences that end, or a stream of RS")
    count = stream.episodes or sequences
    state = stream.start(-1, torch.arange(count))  # played episodes have seeds ≥ 0
    parts = []
    for steps in torch.split(torch.arange(stream.longest), max(1, AT_ONCE // state.numel())):
        t = steps.repeat_interleave(count)
        items = stream.item(state[torch.arange(count).repeat(len(steps))], t)
        if items.ids is t:  # a position means nothing outside its sequence
            items = replace(items, ids=None)
        parts.append(items[items.present])
    return Drawn(join(parts), id_names=stream.id_names)


def fingerprint(stream: Stream) -> int:
    """Return a number that differs between streams of different items.

    It is the same in every process, on every device and for every backend.
    """
    digest = hashlib.blake2b(type(stream).__name__.encode(), digest_size=7)
    for name, value in getattr(stream, "__dict__", {}).items():
        if name == "id_names":
            digest.update(b"" if value is None else repr(value).encode())
        elif name == "spans" and len(value) == 1:
            pass  # one sequence, which has all rows
        elif isinstance(value, Items):
            for tensor in value.tensors().values():
                digest.update(tensor.cpu().numpy().tobytes())
        elif isinstance(value, Tensor):
            digest.update(value.cpu().numpy().tobytes())
        elif not isinstance(value, Backend):
            digest.update(repr(value).encode())
    return int.from_bytes(digest.digest(), "little")
