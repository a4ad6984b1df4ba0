"""The packing game: N bins at once, two turns an item.

The item on each conveyor is turned (:meth:`Packing.orient`), then set down (:meth:`Packing.place`).
One mask [N, 6, W, D] is made when an item arrives and serves both turns: the orientation agent sees
which orientations have a cell, the placement agent the cells of the chosen one, so a legal
orientation never leaves the placement without a legal cell. An episode ends when the visible item
has no legal cell in any orientation, or when its stream has no more items.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from marl_pack import bins as state
from marl_pack.agents.afterstates.afterstates import Afterstates, afterstates_of, probe_lengths
from marl_pack.bins import ORIENTATIONS, check_device, check_size
from marl_pack.items import DEFAULT_SIDES, Stream, fingerprint, make_stream
from marl_pack.stability import OrientedItem, Rule, make_rule, orient_item
from marl_pack.stability.oriented_item import NO_OFFSET, check_com_offset

ALL_ORIENTATIONS = tuple(range(len(ORIENTATIONS)))

MOST_SKIPPED = 1000
"""Episodes in a row whose first item has no place, before the game gives up."""

BIN_FIELDS = tuple(field.name for field in fields(state.Bins) if field.name != "height")
GAME_FIELDS = ("items", "weights", "episode", "t", "stream_state", "lost")


@dataclass(frozen=True)
class Oriented:
    """What the placement turn sees once an orientation is chosen."""

    sides: Tensor  # int16 [N, 3]    the item's sides along x, y, z
    mask: Tensor  # bool [N, W, D]   the cells where it may be set down


@dataclass(frozen=True)
class Outcome:
    """What placing an item brought."""

    reward: Tensor  # float32 [N]   Eq. 5
    done: Tensor  # bool [N]        whether the episode ended with this placement
    filled: Tensor  # int64 [N]     cells filled in the bin right after it, before any reset
    placed: Tensor  # int64 [N]     boxes in the bin right after it
    volume: int  # of a bin, in cells

    @property
    def utilization(self) -> Tensor:
        """Share of each bin's volume filled right after the placement, float64 [N]."""
        return self.filled.double() / self.volume


def orientations_with_a_cell(mask: Tensor) -> Tensor:
    """Bool [N, 6] of a mask [N, 6, W, D] (a sum is many times faster than ``any`` on the CPU)."""
    return mask.sum((2, 3), dtype=torch.int32) > 0


class Packing:
    """N bins, each with its own conveyor.

    An episode whose first item has no legal cell in the empty bin is over before it begins: it is
    skipped with ``auto_reset``, and leaves its bin finished without.

    Attributes:
        bins: what stands where (:class:`marl_pack.bins.Bins`).
        items: int16 [N, 3], the visible item's own sides w, d, h.
        weights: float64 [N], its weight.
        mask: bool [N, 6, W, D], where it may be set down in each orientation.
        orientation_mask: bool [N, 6], the orientations that may be chosen: those with a legal cell.
        alive: bool [N], false where an episode has ended (only without ``auto_reset``).
        episode, t: int64 [N], number of the episode played in each bin and items placed in it.
        bin_height: int16 [N, 1], H.

    Args:
        n: number of bins N.
        size: (W, D, H) in cells.
        items: ``"rs"``, ``"cut1"``, ``"cut2"``, a file, an array or a stream
            (:func:`marl_pack.items.make_stream`).
        sides: shortest and longest side of generated items.
        rule: name of a stability rule, or a rule from :func:`marl_pack.stability.make_rule`.
        rule_parameters: what to bind to a named rule, e.g. ``{"margin": 1.0}``.
        orientations: indices into :data:`marl_pack.bins.ORIENTATIONS` that may be chosen.
        alpha: weight of the volume gained, Eq. 5.
        beta: weight of the space wasted, Eq. 5.
        com_offset: the items' centre of mass from their geometric centre, in fractions of w, d, h.
        mask_orientations: whether orientations without a legal cell are excluded (the paper's
            way). Else all allowed ones may be chosen, and a choice without a cell ends the episode
            with nothing placed and no reward.
        auto_reset: begin a new episode in a bin as soon as one ends there. Without it a finished
            bin stays as it is, its mask stays empty and what is played there is ignored.
        device: where everything happens.
        seed: of the item streams.
        first_episode: bin i plays the episodes ``first_episode + i``, then every N-th after it.

    Raises:
        ValueError: if an argument cannot be, naming what would be right.
    """

    def __init__(
        self,
        n: int,
        size: tuple[int, int, int] = (10, 10, 10),
        items: str | Path | ArrayLike | Stream = "rs",
        *,
        sides: tuple[int, int] = DEFAULT_SIDES,
        rule: str | Rule = "hull_alpha",
        rule_parameters: Mapping[str, Any] | None = None,
        orientations: Sequence[int] = ALL_ORIENTATIONS,
        alpha: float = 1.0,
        beta: float = 1.0,
        com_offset: tuple[float, float, float] = NO_OFFSET,
        mask_orientations: bool = True,
        auto_reset: bool = True,
        device: torch.device | str = "cpu",
        seed: int = 0,
        first_episode: int = 0,
    ) -> None:
        if n < 1:
            raise ValueError(f"n = {n}: needs at least one bin")
        chosen = sorted({int(o) for o in orientations})
        if not chosen or not set(chosen) <= set(ALL_ORIENTATIONS):
            raise ValueError(f"orientations {orientations!r}: need one or more of 0 … 5")
        self.n = n
        self.size = check_size(size)
        self.device = check_device(device)
        self.stream = make_stream(items, self.size, sides).to(self.device)
        if isinstance(rule, str):
            rule = make_rule(rule, **(rule_parameters or {}))
        elif rule_parameters:
            raise ValueError("rule_parameters go with the name of a rule, not with a bound one")
        self.rule = rule
        self.orientations = tuple(chosen)
        self.alpha, self.beta = float(alpha), float(beta)
        if not (math.isfinite(self.alpha) and math.isfinite(self.beta)):
            raise ValueError(f"alpha = {alpha}, beta = {beta}: need finite numbers")
        self.com_offset = check_com_offset(com_offset)
        self.mask_orientations, self.auto_reset = mask_orientations, auto_reset
        self._index = torch.arange(n, device=self.device)
        self._allowed = torch.tensor(
            [o in chosen for o in ALL_ORIENTATIONS], device=self.device
        )  # [6]
        self._banned = [o for o in ALL_ORIENTATIONS if o not in chosen]
        width, depth, height = self.size
        self.volume = width * depth * height
        self.bin_height = torch.full((n, 1), height, dtype=torch.int16, device=self.device)
        self._gain, self._loss = self.alpha / self.volume, self.beta / self.volume
        most = self.volume // self.stream.smallest
        if self.stream.longest is not None:
            most = min(most, self.stream.longest)
        self.bins = state.empty(n, self.size, max_boxes=most, device=self.device)
        self._empty = state.empty(n, self.size, max_boxes=0, device=self.device)
        self._left: Afterstates | None = None
        self._known: dict[Hashable, Tensor] = {}
        self.reset(seed, first_episode)

    def reset(self, seed: int | None = None, first_episode: int = 0) -> None:
        """Empty all bins and begin the episodes ``first_episode + i``.

        Raises:
            ValueError: with ``auto_reset``, if no episode has a legal first item.
        """
        if seed is not None:
            self.seed = int(seed)
        self.episode = self._index + first_episode
        self.t = torch.zeros_like(self.episode)
        self.lost = torch.zeros(self.n, dtype=torch.bool, device=self.device)
        state.clear(self.bins, slice(None))
        self.stream_state = self.stream.start(self.seed, self.episode)
        self.items, self.weights = self.stream.item(self.stream_state, self.t)
        self._look()
        if self.auto_reset:
            self._begin((~self.alive).nonzero().squeeze(1))

    def left(self) -> Afterstates:
        """What each legal placement of the visible items would leave; made once a turn.

        For boxes with sides between the stream's shortest and longest.
        """
        if self._left is None:
            sides = self.orient_item(self.items, self.weights).sides
            lengths = probe_lengths(*self.stream.sides)
            self._left = afterstates_of(self.bins, sides, self.mask, lengths)
        return self._left

    def room(self) -> tuple[Tensor, Tensor]:
        """Room after each legal placement, float32 [N, 6, W, D] each; 0 where none is legal.

        In how many cells a box that may come could be set down in the mean, and how probable it is
        that the next item finds a place.
        """
        return (
            self.once("room", lambda: self.left().spread(self.left().room(), self.mask)),
            self.once("fits", lambda: self.left().spread(self.left().chance(self.orientations),
                                                         self.mask)),
        )  # fmt: skip

    def once(self, what: Hashable, make: Callable[[], Tensor]) -> Tensor:
        """What ``make`` gives [N, …], made once a turn; branches get their bins' part of it."""
        if what not in self._known:
            self._known[what] = make()
        return self._known[what]

    def forget(self, what: Hashable) -> None:
        """Make it anew when it is next asked for: see :meth:`once`."""
        self._known.pop(what, None)

    def masks(self, bins: state.Bins, items: Tensor, weights: Tensor) -> Tensor:
        """Bool [N, 6, W, D]: where ``items`` [N, 3] may be set down in ``bins``, each way."""
        return self.rule(bins, self.orient_item(items, weights))

    def orient_item(self, items: Tensor, weights: Tensor) -> OrientedItem:
        """The items in their six orientations; those that may not be chosen have zero sides."""
        turned = orient_item(items, weights, self.com_offset)
        if self._banned:
            turned.sides[:, self._banned] = 0
        return turned

    def orient(self, orientation: Tensor) -> Oriented:
        """First turn: what would be seen with each item turned so. Changes nothing.

        Args:
            orientation: int64 [N], indices into :data:`marl_pack.bins.ORIENTATIONS`.
        """
        return Oriented(self._turned(orientation), self.mask[self._index, orientation])

    def _turned(self, orientation: Tensor) -> Tensor:
        """The items' sides along x, y, z, int16 [N, 3]."""
        return self.items.gather(1, state.orientation_table(self.device)[orientation])

    def place(self, orientation: Tensor, cell: Tensor, *, check: bool = True) -> Outcome:
        """Second turn: set each item down, and bring the next one.

        Args:
            orientation: int64 [N], as in :meth:`orient`.
            cell: int64 [N], low corners ``x · D + y``.
            check: whether to look if the choices are legal. Only a caller that has taken them from
                the mask may do without: an illegal one would spoil the stack.

        Raises:
            ValueError: if a choice is not legal; nothing has changed then.
        """
        alive = self.alive
        if orientation.shape != (self.n,) or cell.shape != (self.n,):
            raise ValueError(
                f"orientation {list(orientation.shape)} and cell {list(cell.shape)}: need one "
                f"whole number for each of {self.n} bins"
            )
        if check:
            self._check(orientation, cell)
        sides = self._turned(orientation)
        if not self.mask_orientations:
            possible = orientations_with_a_cell(self.mask)[self._index, orientation]
            self.lost = self.lost | (alive & ~possible)
        if not (self.auto_reset and self.mask_orientations):
            sides = torch.where((alive & ~self.lost)[:, None], sides, 0)
        com = None
        if any(self.com_offset):
            com = self.orient_item(self.items, self.weights).centres()[self._index, orientation]
        _, waste, volume = state.place(self.bins, sides, cell, self.weights, com)
        # R = α · w d h / (W D H) - β · v_waste / (W D H)
        reward = (self._gain * volume).sub_(waste, alpha=self._loss).float()
        filled, placed = self.bins.filled.clone(), self.bins.count.clone()

        # A finished bin keeps the item that found no place, and so its empty mask.
        self.t = self.t + (alive & ~self.lost)
        self.items, self.weights = self.stream.item(self.stream_state, self.t)
        self._look()
        done = alive & ~self.alive
        if self.auto_reset:
            self._begin(done.nonzero().squeeze(1))
        return Outcome(reward, done, filled, placed, self.volume)

    def branch(
        self,
        which: Tensor,
        stream: Stream | None = None,
        seed: int = 0,
        episodes: Tensor | None = None,
    ) -> Packing:
        """A game of its own that begins with copies of some of these bins, as they are now.

        Its bins are not begun anew when they end.

        Args:
            which: int64 [K], bins to copy; one may come several times.
            stream: what comes after the visible items; as here, unless given.
            seed, episodes: int64 [K], the episodes of ``stream`` that come.
        """
        game = copy.copy(self)
        game.n, game.auto_reset = len(which), False
        game._index = torch.arange(len(which), device=self.device)
        game.bins, game.bin_height = self.bins[which], self.bin_height[which]
        game._left = None if self._left is None else self._left.of(which)
        game._known = {what: made[which] for what, made in self._known.items()}
        for name in ("items", "weights", "mask", "orientation_mask", "alive", "lost", "t"):
            setattr(game, name, getattr(self, name)[which])
        if stream is None:
            game.episode, game.stream_state = self.episode[which], self.stream_state[which]
        else:
            assert episodes is not None
            game.stream, game.seed, game.episode = stream, seed, episodes
            smallest = min(self.stream.smallest, stream.smallest)
            game.bins = game.bins.for_boxes(self.volume // smallest)
            game.stream_state = stream.start(seed, episodes)
        return game

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that the rest of the game depends on, to be kept and loaded again."""
        tensors = dict(zip(BIN_FIELDS, self.bins.tensors(), strict=True))
        tensors |= {name: getattr(self, name) for name in GAME_FIELDS}
        tensors["stream"] = torch.tensor(fingerprint(self.stream))
        return {name: tensor.clone() for name, tensor in tensors.items()}

    def load_state_dict(self, kept: Mapping[str, Tensor]) -> None:
        """Go on from where :meth:`state_dict` was taken of a game made with the same arguments.

        Raises:
            ValueError: if it is another game's.
        """
        own = self.state_dict()
        for name, tensor in own.items():
            if name not in kept or kept[name].shape != tensor.shape:
                found = list(kept[name].shape) if name in kept else "missing"
                raise ValueError(
                    f"state of another game: {name} is {found}, needs {list(tensor.shape)}"
                )
        if kept["stream"].cpu() != own["stream"]:
            raise ValueError(
                "state of another game: its items are not this game's; a changed file?"
            )
        for name, tensor in zip(BIN_FIELDS, self.bins.tensors(), strict=True):
            tensor.copy_(kept[name])
        for name in GAME_FIELDS:
            setattr(self, name, kept[name].to(own[name]).clone())
        self._look()

    def _check(self, orientation: Tensor, cell: Tensor) -> None:
        """Raise ValueError if a choice in a living bin is not legal."""
        cells = self.size[0] * self.size[1]
        real = (orientation >= 0) & (orientation < len(ORIENTATIONS)) & (cell >= 0) & (cell < cells)
        turned, spot = torch.where(real, orientation, 0), torch.where(real, cell, 0)
        legal = self.mask.flatten(2)[self._index, turned, spot]
        if not self.mask_orientations:
            legal |= self.orientation_mask[self._index, turned] & ~self.mask[
                self._index, turned
            ].flatten(1).any(1)
        wrong = self.alive & ~(real & legal)
        if bool(wrong.any()):
            i = int(wrong.nonzero()[0])
            x, y = divmod(int(cell[i]), self.size[1])
            raise ValueError(
                f"bin {i}: item {self.items[i].tolist()} in orientation {int(orientation[i])} may "
                f"not be set down at ({x}, {y}), cell {int(cell[i])}; choose where the mask is true"
            )

    def _look(self) -> None:
        """Make the masks of the items that have come; a bin where none is legal has ended."""
        self._left, self._known = None, {}
        self.mask = self.masks(self.bins, self.items, self.weights)
        if not self.mask_orientations:
            self.mask &= ~self.lost[:, None, None, None]
        self.orientation_mask, self.alive = self._choices(self.mask)

    def _choices(self, mask: Tensor) -> tuple[Tensor, Tensor]:
        """The orientations that may be chosen [K, 6], and whether the episode goes on [K]."""
        possible = orientations_with_a_cell(mask)
        alive = possible.any(1)
        if not self.mask_orientations:
            possible = self._allowed & alive[:, None]
        return possible, alive

    def _begin(self, which: Tensor) -> None:
        """Begin the next episode in the bins ``which`` (int64 [K]) that has a legal first item.

        Raises:
            ValueError: if there is none within :data:`MOST_SKIPPED` episodes.
        """
        for _ in range(MOST_SKIPPED):
            if not len(which):
                return
            self.episode[which] += self.n
            self.t[which] = 0
            self.lost[which] = False
            state.clear(self.bins, which)
            self.stream_state[which] = self.stream.start(self.seed, self.episode[which])
            items, weights = self.stream.item(self.stream_state[which], self.t[which])
            mask = self.masks(self._empty[: len(which)], items, weights)
            self.items[which], self.weights[which], self.mask[which] = items, weights, mask
            self.orientation_mask[which], self.alive[which] = self._choices(mask)
            which = which[~self.alive[which]]
        if len(which):
            raise ValueError(
                f"no item that begins an episode, such as {self.items[which[0]].tolist()}, may be "
                f"set down anywhere in the empty bin {self.size}: check the orientations allowed "
                f"{self.orientations}, the rule's margin and com_offset"
            )
