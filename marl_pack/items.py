"""Item streams: what the conveyor brings, episode by episode.

A stream is two pure functions. ``start(seed, episodes)`` returns the state of each episode, and
``item(state, t)`` the item at step t of each. Episode k of seed s is the same sequence in every
batch, on every device, whatever was played before. Weights are volumes unless a file gives them.

Sources (Zhao et al. 2021, sec. 5): ``rs`` draws uniformly from all types; ``cut1`` and ``cut2`` cut
the bin itself into items, so that a perfect packing is known (:func:`cut`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import torch
from numba import njit
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from marl_pack import bins
from marl_pack.bins import check_size
from marl_pack.item_files import read_fields

Size = tuple[int, int, int]

GENERATED = ("rs", "cut1", "cut2")
"""Names of the streams that need no file."""

DEFAULT_SIDES = (2, 5)
"""Shortest and longest side of a generated item: the 64 types {2..5}³ of RS and CUT."""


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


# --- random numbers by counting -------------------------------------------------------------------

_GOLDEN, _MIX_1, _MIX_2 = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB


def _signed(value: int) -> int:
    """A 64-bit pattern as the signed integer that has it."""
    value &= (1 << 64) - 1
    return value - (1 << 64) if value >> 63 else value


def _shift_right(x: Tensor, bits: int) -> Tensor:
    """Logical right shift of int64."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def mix(key: Tensor, counter: Tensor | int) -> Tensor:
    """64 random bits a (key, counter), int64: SplitMix64's output function (Steele et al. 2014)."""
    z = key + (torch.as_tensor(counter, device=key.device) + 1) * _signed(_GOLDEN)
    z = (z ^ _shift_right(z, 30)) * _signed(_MIX_1)
    z = (z ^ _shift_right(z, 27)) * _signed(_MIX_2)
    return z ^ _shift_right(z, 31)


def below(bits: Tensor, limit: int) -> Tensor:
    """Random bits turned into a whole number in 0 … limit - 1, uniform (bias under limit / 2³²)."""
    return _shift_right(_shift_right(bits, 32) * limit, 32)


def episode_keys(seed: int, episodes: Tensor) -> Tensor:
    """One independent key, int64 [K], for each episode of a seed."""
    return mix(mix(torch.full_like(episodes, _signed(seed)), 0), episodes)


@njit(cache=True)
def _draw(state: Any, limit: int) -> int:
    """The next whole number in 0 … limit - 1 of the SplitMix64 generator ``state`` (uint64 [1])."""
    state[0] += np.uint64(_GOLDEN)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(_MIX_1)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(_MIX_2)
    z = z ^ (z >> np.uint64(31))
    return int(((z >> np.uint64(32)) * np.uint64(limit)) >> np.uint64(32))


# --- RS -------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _uniform_items(keys: Any, t: Any, low: int, kinds: int, sides: Any, weights: Any) -> None:
    """:meth:`Uniform.item` on the CPU, where a loop beats thirty tensor operations."""
    state = np.empty(1, np.uint64)
    for b in range(keys.size):
        state[0] = np.uint64(keys[b]) + np.uint64(t[b]) * np.uint64(_GOLDEN)
        kind = _draw(state, kinds**3)
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


@njit(cache=True)
def _cut_bin(size: Any, low: int, high: int, state: Any, waiting: Any, pieces: Any) -> int:
    """Cut the bin until every edge is in low … high; rows x, y, z, w, d, h. Returns how many.

    Pieces come in the order in which they are finished.
    """
    waiting[0, :3] = 0
    waiting[0, 3:] = size
    left, n = int(size.max() > high), 0
    if left == 0:
        pieces[0] = waiting[0]
        n = 1
    parts = np.empty((2, 6), np.int64)
    while left > 0:
        chosen = _draw(state, left)
        parts[:] = waiting[chosen]
        left -= 1
        waiting[chosen] = waiting[left]
        edges = parts[0, 3:].copy()
        cuts = 0  # an edge can be cut in two, each at least low, in so many places
        for axis in range(3):
            if edges[axis] > high:
                cuts += edges[axis] - 2 * low + 1
        pick = _draw(state, cuts)
        for axis in range(3):
            if edges[axis] > high:
                places = edges[axis] - 2 * low + 1
                if 0 <= pick < places:
                    parts[0, 3 + axis] = low + pick
                    parts[1, axis] += low + pick
                    parts[1, 3 + axis] = edges[axis] - low - pick
                pick -= places
        for part in parts:
            if part[3:].max() > high:
                waiting[left] = part
                left += 1
            else:
                pieces[n] = part
                n += 1
    return n


@njit(cache=True)
def _stacking_order(pieces: Any, n: int, shape: tuple[int, int], state: Any, out: Any) -> None:
    """CUT-2: draw uniformly among the pieces whose whole floor is built, until none is left."""
    height = np.zeros(shape, np.int64)
    left = np.arange(n)
    ready = np.empty(n, np.int64)
    for k in range(n):
        count = 0
        for i in range(n - k):
            x, y, z, w, d, _ = pieces[left[i]]
            if (height[x : x + w, y : y + d] == z).all():
                ready[count] = i
                count += 1
        i = ready[_draw(state, count)]
        out[k] = pieces[left[i]]
        x, y, z, w, d, h = out[k]
        height[x : x + w, y : y + d] = z + h
        left[i : n - k - 1] = left[i + 1 : n - k].copy()


@njit(cache=True, nogil=True)
def _cut_all(keys: Any, size: Any, low: int, high: int, order: int, out: Any) -> None:
    most = out.shape[1]
    pieces, waiting = np.empty((most, 6), np.int64), np.empty((most, 6), np.int64)
    state = np.empty(1, np.uint64)
    for b in range(keys.size):
        state[0] = np.uint64(keys[b])
        n = _cut_bin(size, low, high, state, waiting, pieces)
        if order == 2:
            _stacking_order(pieces, n, (size[0], size[1]), state, out[b])
        else:
            out[b, :n] = pieces[:n][np.argsort(pieces[:n, 2], kind="mergesort")]


def cut(
    size: Size, order: Literal[1, 2], seed: int, episodes: Tensor, sides: tuple[int, int]
) -> Tensor:
    """Sequences made by cutting the bin, with their perfect solution.

    Start with the bin; while there are pieces with an edge longer than ``high``, choose one of them
    and one of its possible cuts, across such an edge at a position in [low, edge - low], both
    uniformly, and replace it by the two parts. With pieces in the order in which they are finished,
    neighbours in a sequence are as often alike as in the published CUT-1.

    Args:
        size: (W, D, H).
        order: 1 sorts the pieces by the height of their bottom face; 2 repeatedly draws one whose
            whole floor is built.
        seed: of the sequences.
        episodes: int64 [K], which ones.
        sides: (low, high), shortest and longest edge; ``high ≥ 2 · low - 1`` and the bin's sides
            at least ``low``.

    Returns:
        int16 [K, L, 6] on the CPU, rows x, y, z, w, d, h in the order of arrival, then zeros. The
        boxes fill the bin exactly, and in this order each finds its floor complete.

    Raises:
        ValueError: if the bin cannot be cut into such pieces.
    """
    low, high = check_sides(sides)
    size = check_size(size)
    if high < 2 * low - 1 or min(size) < low:
        raise ValueError(
            f"cutting {size} into edges {low}..{high}: needs a longest edge of at least "
            f"{2 * low - 1} (twice the shortest, less one) and bin sides of at least {low}"
        )
    keys = episode_keys(seed, episodes.cpu()).numpy()
    most = int(np.prod([s // low for s in size]))
    out = np.zeros((len(keys), most, 6), np.int64)
    _cut_all(keys, np.array(size), low, high, order, out)
    longest = int((out[..., 3] > 0).sum(1).max(initial=1))
    return torch.from_numpy(out[:, :longest].astype(np.int16))


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


# --- given sequences ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sequences:
    """Given sequences, played in their order: episode k is sequence k, round and round."""

    items: Tensor  # int16 [S, L, 3]     sides, zeros after each sequence's end
    weights: Tensor  # float64 [S, L]

    @property
    def smallest(self) -> int:
        """Volume of the smallest item."""
        volume = self.items.long().prod(2)
        return int(volume[volume > 0].min())

    @property
    def sides(self) -> tuple[int, int]:
        """Shortest and longest side of any item."""
        return int(self.items[self.items > 0].min()), int(self.items.max())

    @property
    def episodes(self) -> int:
        """The number of sequences."""
        return len(self.items)

    @property
    def longest(self) -> int:
        """Length of the longest sequence."""
        return self.items.shape[1]

    def start(self, seed: int, episodes: Tensor) -> Tensor:
        """Indices of the sequences, int64 [K]; the seed plays no part."""
        return episodes % len(self.items)

    def item(self, state: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Sides int16 [N, 3] and weights float64 [N]."""
        last = self.items.shape[1] - 1
        held, step = t <= last, t.clamp(max=last)
        sides = self.items[state, step] * held[:, None].to(self.items.dtype)
        return sides, self.weights[state, step] * held

    def to(self, device: torch.device | str) -> Sequences:
        """The same sequences on ``device``."""
        return Sequences(self.items.to(device), self.weights.to(device))


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


def check_sides(sides: tuple[int, int]) -> tuple[int, int]:
    """Return (shortest, longest) side as ints.

    Raises:
        ValueError: unless they are whole numbers with 1 ≤ shortest ≤ longest.
    """
    pair = tuple(sides)
    if len(pair) != 2 or any(int(s) != s for s in pair) or not 1 <= pair[0] <= pair[1]:
        raise ValueError(f"sides {sides!r}: need two whole numbers, 1 ≤ shortest ≤ longest")
    return int(pair[0]), int(pair[1])


def _numbers(values: ArrayLike, source: str) -> NDArray[np.float64]:
    """``values`` as float64, refused with the first row named that is not of numbers."""
    try:
        array = np.asarray(values)
        if array.dtype.kind in "iuf":
            return array.astype(np.float64)
    except ValueError as error:
        if not isinstance(values, Iterable):
            raise ValueError(f"{source}: needs numbers ({error})") from None
    rows = values if isinstance(values, Iterable) else [values]
    for number, row in enumerate(rows):
        if np.shape(row) != (3,) or np.asarray(row).dtype.kind not in "iuf":
            raise ValueError(f"{source}: row {number} is {row!r}: needs three numbers w, d, h")
    raise ValueError(f"{source}: needs numbers")


def check_items(
    items: ArrayLike,
    size: Size,
    weights: ArrayLike | None = None,
    lengths: ArrayLike | None = None,
    source: str = "items",
) -> Sequences:
    """Sequences from arrays, refused with the row named if an item cannot be.

    Args:
        items: whole numbers [L, 3] (one sequence) or [S, L, 3], rows w, d, h. Rows of zeros may
            only fill the end of a sequence.
        size: (W, D, H) of the bin they must fit into, in at least one orientation.
        weights: positive [L] or [S, L]; volumes by default.
        lengths: whole numbers [S]; by default a sequence ends at its first row of zeros.
        source: what to call the items in an error.

    Raises:
        ValueError: naming the sequence and row.
    """
    array = _numbers(items, source)
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
        raise ValueError(f"{source}: shape {array.shape}, needs [L, 3] or [S, L, 3] (w, d, h)")
    count, length, _ = array.shape

    blank = (array == 0).all(2)
    ends = np.where(blank.any(1), blank.argmax(1), length)
    if lengths is not None:
        given = np.asarray(lengths)
        if given.shape != (count,) or given.dtype.kind not in "iu" or not (
            (given >= 1) & (given <= length)
        ).all():  # fmt: skip
            raise ValueError(f"{source}: lengths need {count} whole numbers in 1 … {length}")
        ends = given.astype(np.int64)
    inside = np.arange(length) < ends[:, None]

    def refuse(wrong: NDArray[np.bool_], why: str) -> None:
        if wrong.any():
            s, row = np.argwhere(wrong)[0]
            where = f"row {row}" if count == 1 else f"sequence {s}, row {row}"
            raise ValueError(f"{source}: {where} is {array[s, row].tolist()}: {why}")

    if not inside[:, 0].all():
        s = int(np.flatnonzero(~inside[:, 0])[0])
        raise ValueError(f"{source}: sequence {s} has no items")
    rows = inside[..., None]
    refuse((rows & ~np.isfinite(array)).any(2), "not a number; needs whole cells ≥ 1")
    refuse((rows & (array % 1 != 0)).any(2), "a fraction of a cell; needs whole cells ≥ 1")
    refuse((rows & (array < 1)).any(2), "zero or negative; needs whole cells ≥ 1")
    refuse(~inside & ~blank, "after the end of its sequence; needs zeros there")
    fits = np.sort(array, axis=2) <= np.sort(np.array(size))
    refuse(inside & ~fits.all(2), f"fits into the bin {tuple(size)} in no orientation")

    mass = array.prod(2)
    if weights is not None:
        mass = _numbers(weights, f"{source}: weights")
        mass = mass[None] if mass.ndim == 1 else mass
        if mass.shape != (count, length):
            raise ValueError(f"{source}: weights {mass.shape}, need one an item {(count, length)}")
        refuse(inside & ~(np.isfinite(mass) & (mass > 0)), "has a weight that is not positive")
    longest = int(ends.max())
    sides = np.where(rows, array, 0)[:, :longest].astype(np.int16)
    return Sequences(
        torch.from_numpy(sides), torch.from_numpy(np.where(inside, mass, 0)[:, :longest])
    )


# --- files ----------------------------------------------------------------------------------------


def load(path: str | Path, size: Size | None = None) -> tuple[Sequences, Size]:
    """Read item sequences from a file, by its ending.

    - ``.npz``: ``items`` [S, L, 3] or [L, 3], with ``lengths`` [S], ``weights`` and ``bin`` [3] if
      present.
    - ``.json``: an object with the same keys, ``items`` also as sequences of unequal length; or
      just the items.
    - ``.csv``: a header naming the columns w, d, h and, if wanted, weight (one weight a row) and
      sequence (a number; rows of one sequence stand together); one item a row.

    Args:
        path: the file.
        size: (W, D, H); by default the file's own ``bin``.

    Returns:
        The sequences and the bin size.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for another ending, a missing key or column, no bin size or another one than
            the file's, or an item that cannot be, with its row.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; items are {', '.join(GENERATED)} or a file")
    fields = read_fields(path)
    told = fields.get("bin")
    try:
        told = None if told is None else check_size(told)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    bin_size = told if size is None else check_size(size)
    if bin_size is None:
        raise ValueError(f"{path}: says no bin size; give one")
    if told not in (None, bin_size):
        raise ValueError(f"{path}: is for the bin {told}, not {bin_size}; give that size")
    sequences = check_items(
        fields["items"], bin_size, fields.get("weights"), fields.get("lengths"), str(path)
    )
    return sequences, bin_size


def make_stream(
    items: str | Path | ArrayLike | Stream,
    size: Size,
    sides: tuple[int, int] = DEFAULT_SIDES,
) -> Stream:
    """The stream that ``items`` names.

    Args:
        items: ``"rs"``, ``"cut1"``, ``"cut2"``, a file (:func:`load`), an array [L, 3] or
            [S, L, 3], or a stream.
        size: (W, D, H) of the bin.
        sides: shortest and longest side of generated items.

    Raises:
        ValueError: if an item fits into the bin in no orientation, or the name is unknown.
    """
    size = check_size(size)
    if isinstance(items, str) and items in GENERATED:
        low, high = check_sides(sides)
        if items == "rs":
            if high > min(size):
                raise ValueError(
                    f"items 'rs' with sides {low}..{high}: the largest fits into the bin {size} "
                    f"in no orientation; the longest side can be {min(size)}"
                )
            return Uniform(low, high)
        stream = Cut(size, 1 if items == "cut1" else 2, low, high)
        cut(size, stream.order, 0, torch.zeros(1, dtype=torch.int64), (low, high))
        return stream
    if isinstance(items, str | Path):
        if isinstance(items, str) and not Path(items).suffix:
            raise ValueError(f"unknown items {items!r}: one of {', '.join(GENERATED)}, or a file")
        return load(items, size)[0]
    if all(hasattr(items, name) for name in ("start", "item", "to", "smallest", "longest")):
        return items  # type: ignore[return-value]  # a Stream, by its two functions
    return check_items(items, size)  # type: ignore[arg-type]  # not a stream, so an array


def choose_stream(
    items: str, size: Size | None = None, sides: tuple[int, int] = DEFAULT_SIDES
) -> tuple[Stream, Size]:
    """The stream and bin size that a command's options name.

    Args:
        items: a name in :data:`GENERATED` or a file.
        size: (W, D, H); by default the file's own, else 10 × 10 × 10.
        sides: shortest and longest side of generated items.
    """
    if items in GENERATED:
        size = (10, 10, 10) if size is None else check_size(size)
        return make_stream(items, size, sides), size
    return load(items, size)
