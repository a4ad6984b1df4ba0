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
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from marl_pack import bins as bin_state
from marl_pack.backend import Backend
from marl_pack.bins import Bins
from marl_pack.checks import LARGEST_SEED, described, shown, truth_value, whole_number
from marl_pack.game.moves import Moves
from marl_pack.game.origins import origin, without_origin
from marl_pack.game.packing import LAST_EPISODE, MOST_SKIPPED, Packing
from marl_pack.game.selection_state import (
    EVERYTHING,
    NOTHING,
    NothingMore,
    SelectionOutcome,
    SelectionState,
)
from marl_pack.game.spec import SelectionSpec
from marl_pack.game.state import Copied, GameState, refuse_where
from marl_pack.geometry import ORIENTATIONS
from marl_pack.items import DEFAULT_SIDES, Items, Stream
from marl_pack.plan import Plan

FIRST_CHOICES = 64
"""Choices of an episode for which there is memory at first."""


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
        self._all_options: tuple[object, Packing] | None = None
        self._number()
        self.reset(first_episode=first_episode)

    def _number(self) -> None:
        """Number the options: the game, the slot and the bin of each row of views."""
        games = torch.arange(self.n, device=self.device)
        option = torch.arange(self.options, device=self.device)
        self._games = games
        self._game_of = games.repeat_interleave(self.options)  # [G · k · b]
        self._slot_of = (option // self.b).repeat(self.n)
        self.bin_of = self._game_of * self.b + (option % self.b).repeat(self.n)

    def reset(
        self, seed: int | None = None, first_episode: int = 0, *, skip: bool | None = None
    ) -> None:
        """Begin the episodes ``first_episode + g`` with empty bins.

        Args:
            seed, first_episode, skip: as for :meth:`marl_pack.game.packing.Packing.reset`.

        Raises:
            ValueError: for an impossible seed or episode, or if all episodes are skipped. The games
                have not changed then.
        """
        attributes = dict(vars(self))
        try:
            if seed is not None:
                self.seed = whole_number(seed, "seed", 0, LARGEST_SEED)
            first = whole_number(first_episode, "first_episode", 0, LAST_EPISODE - self.n)
            self._start(self._games + first)
            if self.auto_reset if skip is None else skip:
                self._restart(~self.alive)
        except ValueError:
            vars(self).update(attributes)
            raise

    def _start(self, episode: Tensor) -> None:
        """Begin episodes, int64 [G], in new bins."""
        most = self._base.most_items(self.stream.smallest, self.stream.longest)
        bins = bin_state.empty(self.n * self.b, self.size, most, self.device, self.backend)
        zeros = torch.zeros_like(episode)
        shape = self.n, self.options, len(ORIENTATIONS), *self.size[:2]
        self.state = SelectionState(
            bins, torch.arange(self.k, device=self.device).repeat(self.n, 1), zeros + self.k,
            zeros + EVERYTHING, episode, self.stream.start(self.seed, episode), zeros.clone(),
            zeros + self.b, zeros.clone(), zeros.clone(), zeros.bool(),
            torch.zeros(shape, dtype=torch.bool, device=self.device),
        )  # fmt: skip
        self.closed_plans: list[list[Plan]] = [[] for _ in range(self.n)]
        self.history = self._no_choices(FIRST_CHOICES) if self.auto_reset else None
        self._find(torch.arange(len(self._game_of), device=self.device))
        self._close_where_stuck()

    def _no_choices(self, most: int) -> Tensor:
        """Return memory for the choices of an episode, int32 [G, most, 3]; -1 for no choice."""
        shape = self.n, most, 3
        return torch.full(shape, -1, dtype=torch.int32, device=self.device)

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
        if rows is None:  # the policies of one turn share this view, and what they compute of it
            if self._all_options is None or self._all_options[0] is not self.turn:
                all_rows = torch.arange(len(self._game_of), device=self.device)
                self._all_options = self.turn, self.view(all_rows)
            return self._all_options[1]
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
        if self.preview:
            view.following = self._items_at(game, state.t[game]).sides
        view.turn = object()
        return view

    def rows(self, selection: Tensor) -> Tensor:
        """Return the rows of the chosen options, int64 [G]."""
        return self._games * self.options + selection

    def plans(self) -> list[Plan]:
        """Return the boxes in all opened bins as a plan, one for each game.

        Raises:
            ValueError: if the games restart by themselves: then closed bins are not kept.
        """
        if self.auto_reset:
            raise ValueError("plans: games with auto_reset do not keep their closed bins")
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
        self._record(torch.stack((selection, orientation, cell), 1))
        state.placed = state.placed + alive.long()
        following = torch.where(state.t < state.known, state.t, NOTHING)[:, None]
        slots = state.slots.scatter(1, slot, following)
        state.slots = torch.where(alive[:, None], slots, state.slots)
        state.t = state.t + alive.long()
        same = (self._slot_of == slot.squeeze(1)[self._game_of]) | (
            self.bin_of == bins[self._game_of]
        )
        self._find((same & alive[self._game_of]).nonzero().squeeze(1))
        emptied = self._close_where_stuck()
        done = alive & ~self.alive
        outcome = SelectionOutcome(
            reward, done, state.packed, state.placed, self.opened, emptied | done[:, None],
            self.volume,
        )  # fmt: skip
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

    def _record(self, choices: Tensor) -> None:
        """Record the choices int64 [G, 3] of the games that play, if they restart by themselves."""
        if self.history is None:
            return
        most, count = self.history.shape[1], self.state.placed
        if int(count.max()) >= most:
            self.history = torch.cat((self.history, self._no_choices(most)), 1)
        self.history[self._games, count] = torch.where(
            self.alive[:, None], choices.int(), self.history[self._games, count]
        )

    def _close_where_stuck(self) -> Tensor:
        """Close the fullest bin of the games in which no box has a place, until one has.

        Returns:
            Which bins were closed and replaced, bool [G, b].
        """
        emptied = torch.zeros(self.n * self.b, dtype=torch.bool, device=self.device)
        while bool((stuck := ~self.alive & ~self.state.ended).any()):
            state = self.state
            if self.searching:
                state.ended = state.ended | stuck
                self._find(self._games[:0])
                break
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
            if not self.auto_reset:
                self._keep_plans(again, closed)
            emptied[closed] = True
            which = torch.zeros(self.n * self.b, dtype=torch.bool, device=self.device)
            which[closed] = True
            bin_state.clear(state.bins, which)
            self._find(which[self.bin_of].nonzero().squeeze(1))
        return emptied.view(self.n, self.b)

    def _keep_plans(self, games: Tensor, closed: Tensor) -> None:
        """Keep the plan of a bin of each of these games before it is cleared, int64 [K] each."""
        bins, names = self.state.bins.to("cpu"), self.stream.id_names
        for g, row in zip(games.tolist(), closed.tolist(), strict=True):
            self.closed_plans[g].append(Plan.from_bins(bins, row, id_names=names))

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
            if self.history is not None:
                self.history = self.history.masked_fill(ended[:, None, None], -1)
            self._find(ended[self._game_of].nonzero().squeeze(1))
            self._close_where_stuck()
            ended = ended & ~self.alive
        raise ValueError("no episode can begin: no first box has a legal cell in an empty bin")

    def state_dict(self) -> dict[str, Tensor]:
        """Return what the rest of the games depends on: their episodes and the choices so far.

        Raises:
            ValueError: if the games do not record choices, because they have no ``auto_reset``.
        """
        if self.history is None:
            raise ValueError("state_dict: only games with auto_reset record their choices")
        longest = int(self.state.placed.max())
        choices = self.history[:, :longest].clone()
        return {"episode": self.episode.clone(), "choices": choices, "t": self.state.t.clone()} | (
            origin(self.stream, self.spec, self.seed)
        )

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore a :meth:`state_dict` of games made with the same arguments.

        The choices in it are played again and checked, so its file need not be trusted.

        Raises:
            ValueError: if it belongs to other games, or these games cannot reach it. The games have
                not changed then.
        """
        tensors = without_origin(tensors, origin(self.stream, self.spec, self.seed))
        if set(tensors) != {"episode", "choices", "t"} or not all(
            isinstance(tensor, Tensor) for tensor in tensors.values()
        ):
            raise ValueError("state of another game: needs tensors episode, choices and t")
        episode, choices, t = tensors["episode"], tensors["choices"], tensors["t"]
        whole = episode.dtype == t.dtype == torch.int64 and choices.dtype == torch.int32
        if not whole or choices.dim() != 3 or (episode.shape, t.shape, choices.shape[::2]) != (
            (self.n,), (self.n,), (self.n, 3)
        ):  # fmt: skip
            raise ValueError(f"state of another game: needs the numbers of {self.n} games")
        refuse_where(episode.abs() > LAST_EPISODE, "episode", "the number of an episode")
        attributes = dict(vars(self))
        try:
            self.auto_reset = False
            self._start(episode.to(self.device))
            self.history = self._no_choices(max(FIRST_CHOICES, choices.shape[1] + 1))
            self._replay(choices.to(self.device).long())
            refuse_where(self.state.t != t.to(self.device), "t", "the boxes that its choices bring")
            refuse_where(~self.alive, "episode", "one that has not ended")
            self.auto_reset = True
        except ValueError:
            vars(self).update(attributes)
            raise

    def _replay(self, choices: Tensor) -> None:
        """Play recorded choices, int64 [G, T, 3]; -1 after the last one of a game."""
        for k in range(choices.shape[1]):
            playing = choices[:, k, 0] >= 0
            refuse_where(playing & ~self.alive, "choices", "none after the end of an episode")
            refuse_where(playing & (self.state.placed != k), "choices", "no gaps")
            self.alive = playing  # the others ignore their choice
            try:
                self.place(*choices[:, k].unbind(1))
            except ValueError as error:
                raise ValueError(f"state of another game: {error}") from None

    def like(self, game: Packing, moves: Moves) -> Self:
        """Return copies of games of one box and one bin as games with selection, of one option.

        Args:
            game: the games, with the options and the stream of these.
            moves: the legal placements.
        """
        copies = self.branch(torch.zeros(game.n, dtype=torch.int64, device=self.device))
        state, new = game.state, copies.state
        new.bins, new.slots, new.t = state.bins.clone(), state.t[:, None], state.t + 1
        new.episode, new.stream, new.ended = state.episode, state.stream, ~game.alive
        new.packed, new.placed = state.bins.filled.clone(), state.bins.count.clone()
        new.mask = moves.mask[:, None].clone()
        copies._find(copies._games[:0])
        return copies

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
        branched.history = None
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
