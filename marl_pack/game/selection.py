"""Games in which a box and a bin are selected first: a buffer of visible boxes, several open bins.

k boxes are visible and any of them may be placed next; the conveyor's next box takes its slot.
b bins are open. An *option* is a pair of a slot i and a bin j; its number is ``i · b + j``. The p
boxes after the visible ones are seen, too, but may not be placed yet.

When no visible box has a place in any bin, the fullest bin is closed and replaced by an empty one.
The last closing ends the episode, and replaces nothing. The episode also ends when the sequence
does, and when no visible box would have a place in an empty bin. With k = b = 1 and one closing
this is the game of :class:`marl_pack.game.packing.Packing`, action by action.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from marl_pack import bins as bin_state
from marl_pack.backend import Backend
from marl_pack.bins import Bins
from marl_pack.checks import described, shown, truth_value, whole_number
from marl_pack.game.moves import Moves
from marl_pack.game.packing import LAST_EPISODE, MOST_SKIPPED, Packing
from marl_pack.game.spec import SelectionSpec
from marl_pack.game.state import Copied, GameState
from marl_pack.geometry import ORIENTATIONS
from marl_pack.items import DEFAULT_SIDES, Items, Stream
from marl_pack.plan import Plan

NOTHING = -1
"""Position of a slot that holds no box."""
EVERYTHING = 2**62
"""Larger than the position of any box."""


@dataclass
class SelectionState:
    """The state of G games with k slots and b bins; selecting derives from the fields."""

    bins: Bins  # [G · b], bin j of game g has the number g · b + j
    slots: Tensor  # int64 [G, k]   position in the sequence of each visible box, or NOTHING
    t: Tensor  # int64 [G]          position of the conveyor's next box
    known: Tensor  # int64 [G]      boxes from this position on are unknown; only a search sets it
    episode: Tensor  # int64 [G]    number of the episode
    stream: Tensor  # [G, …]        state of the item stream in each episode
    closed: Tensor  # int64 [G]     bins closed so far
    opened: Tensor  # int64 [G]     bins opened so far
    packed: Tensor  # int64 [G]     cells filled in all bins, closed ones included
    placed: Tensor  # int64 [G]     boxes in all bins, closed ones included
    ended: Tensor  # bool [G]       whether the episode has ended
    mask: Tensor  # bool [G, k · b, 6, W, D]  legal placements of each option

    def select(self, games: Tensor) -> SelectionState:
        """Return copies of games, int64 [K]."""
        b = len(self.bins) // len(self.t)
        rows = (games[:, None] * b + torch.arange(b, device=games.device)).flatten()
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return SelectionState(**{
            name: value[rows if name == "bins" else games] for name, value in values.items()
        })  # fmt: skip


@dataclass(frozen=True)
class SelectionOutcome:
    """The result of placing a box in each game; before any reset."""

    reward: Tensor  # float32 [G]   Eq. 5, relative to the volume of one bin
    done: Tensor  # bool [G]        whether the episode ended with this placement
    packed: Tensor  # int64 [G]     cells filled in all bins of the episode
    placed: Tensor  # int64 [G]     boxes in all bins of the episode
    opened: Tensor  # int64 [G]     bins opened in the episode
    volume: int  # volume of a bin, in cells

    @property
    def utilization(self) -> Tensor:
        """Share of the volume of all opened bins that is filled, float64 [G]."""
        return self.packed.double() / (self.opened * self.volume)


class NothingMore:
    """A stream that describes the boxes of another stream, and brings none.

    Args:
        stream: the other stream.
    """

    def __init__(self, stream: Stream) -> None:
        self.stream = stream

    def __getattr__(self, name: str) -> Any:
        if name == "stream":  # a copy that is still empty
            raise AttributeError(name)
        return getattr(self.stream, name)

    def item(self, state: Tensor, t: Tensor) -> Items:
        """Return no items: zero sides [N]."""
        items = self.stream.item(state, t)
        return replace(items, sides=torch.zeros_like(items.sides))


class SelectionPacking(Copied):
    """G games with a buffer, a preview and several bins (see the module).

    Three choices make a step: an option, then an orientation and a cell for its box in its bin. A
    policy for one box and one bin sees an option as a game of its own (:meth:`view`).

    Attributes:
        spec: the options of the game; ``buffer``, ``preview``, ``bins`` and ``closings`` are k, p,
            b and the number of closings.
        state: everything that the rest of the games depends on.
        n, options, size, volume, floor: G, k · b, (W, D, H), W · D · H, the numbers of cells.
        selection_mask: bool [G, k · b], the options with a legal placement.
        alive: bool [G], false where an episode has ended.
        turn: an object that identifies this turn of these games; every turn has a new one.

    Args:
        n: number of games G.
        items, sides, device, backend, seed, first_episode: as for
            :class:`marl_pack.game.packing.Packing`.
        spec: the options of the game.
        auto_reset: begin a new episode in a game as soon as its episode ends.

    Raises:
        ValueError, TypeError: if an argument is impossible; the message says what would be right.
    """

    def __init__(
        self,
        n: int,
        items: str | Path | ArrayLike | Items | Mapping[str, Any] | Stream = "rs",
        *,
        spec: SelectionSpec,
        sides: tuple[int, int] = DEFAULT_SIDES,
        auto_reset: bool = False,
        device: torch.device | str = "cpu",
        backend: Backend | None = None,
        seed: int = 0,
        first_episode: int = 0,
    ) -> None:
        if not isinstance(spec, SelectionSpec):
            raise ValueError(f"spec = {shown(spec)}: needs a SelectionSpec")
        self.spec, self.n = spec, whole_number(n, "n", 1)
        self.auto_reset = truth_value(auto_reset, "auto_reset")
        self.searching = False  # whether games end where a bin would be closed
        self.k, self.b, self.preview = spec.buffer, spec.bins, spec.preview
        self.options = self.k * self.b
        # What all options share: the rule, the stream and its tables.
        self._base = Packing(
            1, items=items, spec=spec.of_one_box(), sides=sides, auto_reset=False, device=device,
            backend=backend, seed=seed,
        )  # fmt: skip
        base = self._base
        self.stream, self.size, self.volume = base.stream, base.size, base.volume
        self.floor, self.device, self.backend = base.floor, base.device, base.backend
        self.seed = base.seed
        self._nothing_more: Any = NothingMore(self.stream)
        self._number()
        self.reset(first_episode)

    def _number(self) -> None:
        """Number the options: the game, the slot and the bin of each row of views."""
        games = torch.arange(self.n, device=self.device)
        option = torch.arange(self.options, device=self.device)
        self._games = games
        self._game_of = games.repeat_interleave(self.options)  # [G · k · b]
        self._slot_of = (option // self.b).repeat(self.n)
        self.bin_of = self._game_of * self.b + (option % self.b).repeat(self.n)

    def reset(self, first_episode: int = 0) -> None:
        """Begin the episodes ``first_episode + g`` with empty bins."""
        first = whole_number(first_episode, "first_episode", 0, LAST_EPISODE - self.n)
        most = self._base.most_items(self.stream.smallest, self.stream.longest)
        bins = bin_state.empty(self.n * self.b, self.size, most, self.device, self.backend)
        episode = self._games + first
        zeros = torch.zeros_like(episode)
        shape = self.n, self.options, len(ORIENTATIONS), *self.size[:2]
        self.state = SelectionState(
            bins, torch.arange(self.k, device=self.device).repeat(self.n, 1), zeros + self.k,
            zeros + EVERYTHING, episode, self.stream.start(self.seed, episode), zeros.clone(),
            zeros + self.b, zeros.clone(), zeros.clone(), zeros.bool(),
            torch.zeros(shape, dtype=torch.bool, device=self.device),
        )  # fmt: skip
        self.closed_plans: list[list[Plan]] = [[] for _ in range(self.n)]
        self._find(torch.arange(len(self._game_of), device=self.device))
        self._close_where_stuck()
        if self.auto_reset:
            self._restart(~self.alive)

    # --- what there is ----------------------------------------------------------------------------

    @property
    def bins(self) -> Bins:
        """The open bins, [G · b]."""
        return self.state.bins

    @property
    def episode(self) -> Tensor:
        """Number of the episode that each game plays, int64 [G]."""
        return self.state.episode

    @property
    def opened(self) -> Tensor:
        """Bins opened in each episode so far, int64 [G]."""
        return self.state.opened

    @property
    def utilization(self) -> Tensor:
        """Share of the volume of all opened bins that is filled, float64 [G]."""
        return self.state.packed.double() / (self.opened * self.volume)

    def items(self, rows: Tensor | None = None) -> Items:
        """Return the boxes of options; zero sides for an empty slot.

        Args:
            rows: int64 [R], as for :meth:`view`.
        """
        rows = torch.arange(len(self._game_of), device=self.device) if rows is None else rows
        game = self._game_of[rows]
        return self._items_at(game, self.state.slots[game, self._slot_of[rows]])

    def previews(self) -> Items:
        """Return the boxes after the visible ones, [G · p]; zero sides where there is none."""
        game = self._games.repeat_interleave(self.preview)
        ahead = torch.arange(self.preview, device=self.device).repeat(self.n)
        return self._items_at(game, self.state.t[game] + ahead)

    def _items_at(self, game: Tensor, position: Tensor) -> Items:
        """Return boxes at positions of sequences, int64 [R] each; zero sides for NOTHING."""
        items = self.stream.item(self.state.stream[game], position.clamp(min=0))
        gone = (position < 0) | (position >= self.state.known[game])
        return replace(items, sides=torch.where(gone[:, None], 0, items.sides))

    def view(self, rows: Tensor | None = None) -> Packing:
        """Return options as games of one box and one bin, which policies for such games can play.

        The view has copies: placing a box in it changes nothing here. Its stream brings no further
        box, so a policy that looks ahead with it sees nothing that is hidden.

        Args:
            rows: int64 [R], numbers ``game · (k · b) + option``; by default all, in order.
        """
        rows = torch.arange(len(self._game_of), device=self.device) if rows is None else rows
        base, state, game = self._base, self.state, self._game_of[rows]
        view = base.alias()
        view.stream = self._nothing_more
        view.n = len(rows)
        view._games = torch.arange(len(rows), device=self.device)
        view.bin_height = base.bin_height.expand(len(rows), 1)
        view.state = GameState(
            state.bins[self.bin_of[rows]], self.items(rows), state.episode[game],
            state.slots[game, self._slot_of[rows]].clamp(min=0),
            torch.zeros_like(state.ended[game]), state.stream[game],
        )  # fmt: skip
        view.moves = Moves(state.mask.flatten(0, 1)[rows])
        view.orientation_mask, alive = base.legal.choices(view.moves, view.state.items)
        view.alive = alive & ~state.ended[game]
        view.turn = object()
        return view

    def rows(self, selection: Tensor) -> Tensor:
        """Return the rows of the chosen options, int64 [G]."""
        return self._games * self.options + selection

    def plans(self) -> list[Plan]:
        """Return the boxes in all opened bins as a plan, one for each game."""
        bins, names = self.state.bins.to("cpu"), self.stream.id_names
        return [
            joined_plan([*closed, *self._open_plans(bins, g, names)])
            for g, closed in enumerate(self.closed_plans)
        ]

    def _open_plans(self, bins: Bins, g: int, names: Any) -> list[Plan]:
        """Return the plans of the open bins of game ``g``."""
        return [Plan.from_bins(bins, g * self.b + j, id_names=names) for j in range(self.b)]

    # --- rules ------------------------------------------------------------------------------------

    def place(
        self, selection: Tensor, orientation: Tensor, cell: Tensor, *, check: bool = True
    ) -> SelectionOutcome:
        """Place the selected box in the selected bin of each game, and bring the next box.

        Args:
            selection: int64 [G], options.
            orientation, cell: int64 [G], as for :meth:`marl_pack.game.packing.Packing.place`.
            check: whether to check that the choices are legal.

        Raises:
            ValueError: if a choice is not legal. The games have not changed then.
        """
        alive = self.alive
        if check:
            self._check(selection, orientation, cell)
        # Games that have ended ignore their choice.
        selection, orientation, cell = (
            torch.where(alive, choice, 0) for choice in (selection, orientation, cell)
        )
        state, rows = self.state, self.rows(selection)
        bins, slot = self.bin_of[rows], (selection // self.b)[:, None]
        items = self.items(rows)
        oriented = Moves.gather(self._base.legal.orient(items).sides, orientation)
        oriented = torch.where(alive[:, None], oriented, 0)
        position = state.slots.gather(1, slot).squeeze(1)
        waste, volume = self._put(
            bins, oriented, cell, items.weights, items.ids_at(position), orientation
        )
        base = self._base
        reward = (base._gain * volume.double() - base._loss * waste.double()).float()
        state.packed = state.packed + volume
        state.placed = state.placed + alive.long()
        following = torch.where(state.t < state.known, state.t, NOTHING)[:, None]
        slots = state.slots.scatter(1, slot, following)
        state.slots = torch.where(alive[:, None], slots, state.slots)
        state.t = state.t + alive.long()
        same = (self._slot_of == slot.squeeze(1)[self._game_of]) | (
            self.bin_of == bins[self._game_of]
        )
        self._find((same & alive[self._game_of]).nonzero().squeeze(1))
        self._close_where_stuck()
        done = alive & ~self.alive
        outcome = SelectionOutcome(
            reward, done, state.packed, state.placed, self.opened, self.volume
        )
        if self.auto_reset:
            self._restart(done)
        return outcome

    def _check(self, selection: Tensor, orientation: Tensor, cell: Tensor) -> None:
        """Raise ValueError if a choice in a game that has not ended is not legal."""
        for what, choice in (
            ("selection", selection), ("orientation", orientation), ("cell", cell)
        ):  # fmt: skip
            wrong = not isinstance(choice, Tensor) or choice.dtype != torch.int64
            if wrong or choice.shape != (self.n,):
                raise ValueError(f"{what}: needs int64 [{self.n}], not {described(choice)}")
        inside = (selection >= 0) & (selection < self.options)
        option = selection.clamp(0, self.options - 1)
        moves = Moves(self.state.mask[self._games, option])
        illegal = self.alive & ~(inside & moves.allows(orientation, cell))
        if bool(illegal.any()):
            g = int(illegal.nonzero()[0])
            raise ValueError(
                f"game {g}: selection {int(selection[g])}, orientation {int(orientation[g])}, cell "
                f"{int(cell[g])} is not legal; choose where the mask is true"
            )

    def _put(
        self, bin_of: Tensor, sides: Tensor, cell: Tensor, weights: Tensor, ids: Tensor,
        orientation: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Put a box in one bin of each game; zero sides put nothing.

        Returns:
            Wasted cells and volume of each box, int64 [G] each.
        """
        total = self.n * self.b

        def of_bins(values: Tensor, elsewhere: float) -> Tensor:
            spread = torch.full((total, *values.shape[1:]), elsewhere, dtype=values.dtype)
            spread = spread.to(self.device)
            spread[bin_of] = values
            return spread

        corners = of_bins(torch.stack(self.floor.corner(cell), 1), 0)
        labels = of_bins(ids, 0), of_bins(orientation, 0)
        _, waste, volume = bin_state.place(
            self.state.bins, of_bins(sides, 0), corners, of_bins(weights, 1.0), None, labels, 1.0,
            False,
        )  # fmt: skip
        return waste[bin_of].long(), volume[bin_of].long()

    def _find(self, rows: Tensor) -> None:
        """Find the legal placements of options, int64 [R]."""
        self.turn = object()
        state = self.state
        if len(rows):
            moves = self._base.legal.moves(state.bins[self.bin_of[rows]], self.items(rows))
            state.mask.flatten(0, 1)[rows] = moves.mask
        self.selection_mask = (state.mask.flatten(2).sum(2, dtype=torch.int32) > 0) & ~state.ended[
            :, None
        ]
        self.alive = self.selection_mask.any(1)

    def _close_where_stuck(self) -> None:
        """Close the fullest bin of the games in which no box has a place, until one has."""
        while bool((stuck := ~self.alive & ~self.state.ended).any()):
            state = self.state
            if self.searching:
                state.ended = state.ended | stuck
                self._find(self._games[:0])
                return
            hopeless = stuck & ~self._any_fits(stuck)
            closing = stuck & ~hopeless
            state.closed = state.closed + closing.long()
            over = hopeless | (closing & (state.closed >= self.spec.most_closings))
            state.ended = state.ended | over
            replaced = closing & ~over
            state.opened = state.opened + replaced.long()
            fullest = state.bins.filled.view(self.n, self.b).argmax(1)
            again = replaced.nonzero().squeeze(1)
            closed = again * self.b + fullest[again]
            names = self.stream.id_names
            for g, row in zip(again.tolist(), closed.tolist(), strict=True):
                self.closed_plans[g].append(
                    Plan.from_bins(state.bins.to("cpu"), row, id_names=names)
                )
            which = torch.zeros(self.n * self.b, dtype=torch.bool, device=self.device)
            which[closed] = True
            bin_state.clear(state.bins, which)
            self._find(which[self.bin_of].nonzero().squeeze(1))

    def _any_fits(self, games: Tensor) -> Tensor:
        """Return whether a visible box has a place in an empty bin, bool [G]; false elsewhere.

        A box that has none there never has one.
        """
        which = (games[self._game_of] & (self.bin_of % self.b == 0)).nonzero().squeeze(1)
        items = self.items(which)
        empty = bin_state.empty(len(which), self.size, 0, self.device, self.backend)
        fits = torch.zeros(self.n, dtype=torch.bool, device=self.device)
        fits[self._game_of[which][self._base.legal.moves(empty, items).any()]] = True
        return fits

    def _restart(self, ended: Tensor) -> None:
        """Begin the next episode in games, bool [G]; skip episodes without a first placement."""
        for _ in range(MOST_SKIPPED):
            if not bool(ended.any()):
                return
            state = self.state
            state.episode = torch.where(ended, state.episode + self.n, state.episode)
            state.stream = self.stream.restart(state.stream, self.seed, state.episode, ended)
            first = torch.arange(self.k, device=self.device)
            state.slots = torch.where(ended[:, None], first, state.slots)
            for name, value in (
                ("t", self.k), ("closed", 0), ("opened", self.b), ("packed", 0), ("placed", 0)
            ):  # fmt: skip
                setattr(state, name, getattr(state, name).masked_fill(ended, value))
            state.ended = state.ended & ~ended
            bin_state.clear(state.bins, ended.repeat_interleave(self.b))
            for g in ended.nonzero().squeeze(1).tolist():
                self.closed_plans[g] = []
            self._find(ended[self._game_of].nonzero().squeeze(1))
            self._close_where_stuck()
            ended = ended & ~self.alive
        raise ValueError("no episode can begin: no first box has a legal cell in an empty bin")

    def branch(self, games: Tensor, *, only_known: bool = False) -> Self:
        """Return games that begin as copies of some of these and are then played independently.

        Args:
            games: int64 [K], numbers of the games to copy; a number may occur several times.
            only_known: whether the conveyor brings only the boxes of the preview; after them,
                slots stay empty. So a search cannot foresee. Games end where a bin would be closed.
        """
        branched = object.__new__(type(self))
        vars(branched).update(vars(self))
        branched.n, branched.auto_reset = len(games), False
        branched.searching = self.searching or only_known
        branched.state = self.state.select(games)
        if only_known:
            limit = branched.state.t + self.preview
            branched.state.known = torch.minimum(branched.state.known, limit)
        branched.closed_plans = [list(self.closed_plans[g]) for g in games.tolist()]
        branched.selection_mask, branched.alive = self.selection_mask[games], self.alive[games]
        branched._number()
        branched.turn = object()
        return branched


def joined_plan(plans: list[Plan]) -> Plan:
    """Return plans of one bin each as one plan of several bins."""
    first = plans[0]
    return replace(
        first,
        bin_sizes=torch.tensor([plan.bin_sizes[0].tolist() for plan in plans]).numpy(),
        bins=torch.tensor([k for k, plan in enumerate(plans) for _ in range(len(plan))]).numpy(),
        **{
            name: _concatenated([getattr(plan, name) for plan in plans])
            for name in (
                "positions", "sides", "orientations", "weights", "centres", "yaws",
                "weights_assumed", "stackable", "max_loads", "supports", "margins",
            )
        },
        ids=tuple(name for plan in plans for name in plan.ids),
    )  # fmt: skip


def _concatenated(parts: list[Any]) -> Any:
    return torch.cat([torch.tensor(part) for part in parts]).numpy()
