"""The rules of the packing game: G games are played at once, with two turns for each item.

First the visible item of each game gets an orientation (:meth:`Packing.orient`), then a place
(:meth:`Packing.place`). One mask [G, 6, W, D] is computed when an item arrives and is used in both
turns. The orientation agent chooses among the orientations with a legal cell, the placement agent
among the legal cells of this orientation. So after a legal orientation there is always a legal
cell. An episode ends when the visible item has no legal cell in any orientation, when its stream
has no more items, or when the bin contains the largest number of items allowed.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn, Unpack

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from marl_pack import bins as bin_state
from marl_pack.backend import Backend, default_backend
from marl_pack.bins import COUNT, UNKNOWN, Bins, check_device
from marl_pack.checks import LARGEST_SEED, described, shown, truth_value, whole_number
from marl_pack.game import compiled, invariants
from marl_pack.game.moves import Floor, LegalMoves, Moves
from marl_pack.game.origins import origin, without_origin
from marl_pack.game.spec import GameOptions, GameSpec, SelectionSpec
from marl_pack.game.state import Copied, GameState, refuse_where
from marl_pack.game.turns import Oriented, Outcome
from marl_pack.geometry import ALL_ORIENTATIONS, orientation_table
from marl_pack.items import DEFAULT_SIDES, Items, Stream, make_stream
from marl_pack.option_record import document
from marl_pack.plan import Plan
from marl_pack.stability import OrientedItem

MOST_GAMES = 1 << 20
"""The largest number of games that can be played at once."""
MOST_SKIPPED = 1000
"""Number of episodes in a row without a legal cell for the first item, after which the game gives
up."""
NO_CENTRES = np.empty((0, 2))
"""Stands for centres of mass in the middle."""
Played = tuple[Tensor, Tensor, Tensor, Tensor]
"""Rewards, filled cells and numbers of boxes after a placement, and t, [G] each."""
LAST_EPISODE = 2**62
"""The largest number that an episode can have."""


@document(GameSpec, " " * 8)
class Packing(Copied):
    """G games, each with one bin and its own conveyor.

    An episode whose first item has no legal cell in the empty bin cannot be played. With
    ``auto_reset`` it is skipped; without, its game has ended.

    Attributes:
        spec: the options of the game.
        state: everything that the rest of the games depends on
            (:class:`marl_pack.game.state.GameState`).
        bins, items, t, episode: parts of the state.
        moves: the legal placements (:class:`marl_pack.game.moves.Moves`).
        mask: bool [G, 6, W, D], where the item may be placed in each orientation.
        orientation_mask: bool [G, 6], the orientations that may be chosen: those with a legal cell.
        alive: bool [G], false where an episode has ended (only without ``auto_reset``).
        turn: an object that identifies this turn of these games; every turn has a new one.
        checked: whether every placement is checked with simple code, which is slow
            (:mod:`marl_pack.game.invariants`).
        following: int16 [G, 3], the sides of the first item of a preview; None without one.
        orientation_sets: the sets of orientations that items may take in this game, each with the
            share of the items that have exactly this set.
        n, size, volume, floor: G, (W, D, H), W · D · H, and the numbers of cells and pairs.
        bin_height: int16 [G, 1], H.

    Args:
        n: number of games G.
        bin: size (W, D, H) in cells; an option of the game, as below.
        items: ``"rs"``, ``"cut1"``, ``"cut2"``, a file, an array, items or a stream
            (:func:`marl_pack.items.make_stream`).
        spec: options of the game; by default ``GameSpec()``.
        sides: shortest and longest side of generated items.
        auto_reset: begin a new episode in a game as soon as its episode ends. Without it, a game
            that has ended does not change: its mask is empty and its actions are ignored.
        device: the device of all tensors.
        backend: compiled loops or tensor code; by default the faster one on the device.
        seed: seed of the item streams.
        first_episode: game g plays the episodes ``first_episode + g``, then every G-th after it.
        **options: options of the game that replace those in ``spec``:
        {options}

    Raises:
        ValueError, TypeError: if an argument is impossible; the message says what would be right.
    """

    def __init__(
        self,
        n: int,
        bin: tuple[int, int, int] | None = None,  # the option's name
        items: str | Path | ArrayLike | Items | Mapping[str, Any] | Stream = "rs",
        *,
        spec: GameSpec | None = None,
        sides: tuple[int, int] = DEFAULT_SIDES,
        auto_reset: bool = True,
        device: torch.device | str = "cpu",
        backend: Backend | None = None,
        seed: int = 0,
        first_episode: int = 0,
        **options: Unpack[GameOptions],
    ) -> None:
        if not (spec is None or isinstance(spec, GameSpec)):
            raise ValueError(f"spec = {shown(spec)}: needs a GameSpec")
        bin_option = {} if bin is None else {"bin": bin}
        self.spec = (spec or GameSpec()).with_options({**options, **bin_option})
        if isinstance(self.spec, SelectionSpec):
            if self.spec.selects:
                raise ValueError(
                    "buffer, preview, bins, closings: need SelectionPacking "
                    "(marl_pack.game.selection)"
                )
            self.spec = self.spec.of_one_box()
        self.n = n = whole_number(n, "n, at least one game", 1, MOST_GAMES)
        self.auto_reset = truth_value(auto_reset, "auto_reset")
        self.checked = invariants.wanted()
        self.device = check_device(device)
        self.backend = _backend_of(backend, self.device)
        self.size = self.spec.bin
        width, depth, height = self.size
        self.floor, self.volume = Floor(width, depth), width * depth * height
        self.legal = LegalMoves(self.spec, self.device, self.backend)
        self.stream = make_stream(items, self.size, sides).to(self.device, self.backend)
        self.orientation_sets = _orientation_sets(self.stream, self.spec)
        self._games = torch.arange(n, device=self.device)
        self.bin_height = torch.full((n, 1), height, dtype=torch.int16, device=self.device)
        self._gain, self._loss = self.spec.alpha / self.volume, self.spec.beta / self.volume
        empty = bin_state.empty(n, self.size, 0, self.device, self.backend)
        self._empty = replace(empty, untouched=True)
        self._all_fit = self.backend is Backend.TENSOR and self._every_item_fits()
        self.following: Tensor | None = None
        self.seed = whole_number(seed, "seed", 0, LARGEST_SEED)
        self.reset(first_episode=first_episode)

    def __deepcopy__(self, memo: dict[int, Any]) -> Packing:
        """Return games that continue exactly as these do; only the item stream is shared."""
        memo[id(self.stream)] = self.stream  # a stream never changes
        copied = memo[id(self)] = object.__new__(type(self))
        vars(copied).update(copy.deepcopy(vars(self), memo))
        return copied

    def most_items(self, smallest: int, longest: int | None) -> int:
        """Return the most boxes that a bin can ever hold.

        Args:
            smallest: volume of the smallest item.
            longest: number of items in the longest sequence; None if sequences do not end.
        """
        limits = (self.volume // smallest, longest, self.spec.max_items)
        return min(limit for limit in limits if limit is not None)

    # --- the state --------------------------------------------------------------------------------

    @property
    def bins(self) -> Bins:
        """The bins and the boxes in them."""
        return self.state.bins

    @property
    def items(self) -> Items:
        """The visible item of each game, [G]."""
        return self.state.items

    @property
    def t(self) -> Tensor:
        """Number of items that each episode had before the visible one, int64 [G]."""
        return self.state.t

    @property
    def episode(self) -> Tensor:
        """Number of the episode that each game plays, int64 [G]."""
        return self.state.episode

    @property
    def mask(self) -> Tensor:
        """Where the item may be placed in each orientation, bool [G, 6, W, D]."""
        return self.moves.mask

    def reset(
        self, seed: int | None = None, first_episode: int = 0, *, skip: bool | None = None
    ) -> None:
        """Empty all bins and begin the episodes ``first_episode + g``.

        Args:
            seed: seed of the item streams; by default the last seed.
            first_episode: the episode of the first game.
            skip: whether to skip episodes whose first item has no legal cell; by default only with
                ``auto_reset``.

        Raises:
            ValueError: for an impossible seed or episode, or if all episodes are skipped. The games
                have not changed then.
        """
        attributes = dict(vars(self))
        most = self.most_items(self.stream.smallest, self.stream.longest)
        try:
            if seed is not None:
                self.seed = whole_number(seed, "seed", 0, LARGEST_SEED)
            first = whole_number(first_episode, "first_episode", 0, LAST_EPISODE - self.n)
            self._start(self._games + first, most)
            if self.auto_reset if skip is None else skip:
                self._restart(~self.alive)
        except ValueError:
            vars(self).update(attributes)
            raise

    def _start(self, episode: Tensor, most: int) -> None:
        """Begin episodes, int64 [G], in new bins that can hold ``most`` boxes."""
        bins = bin_state.empty(self.n, self.size, most, self.device, self.backend)
        t = torch.zeros_like(episode)
        stream = self.stream.start(self.seed, episode)
        lost = torch.zeros(self.n, dtype=torch.bool, device=self.device)
        self.state = GameState(bins, self.stream.item(stream, t), episode, t, lost, stream)
        self._find_moves()

    def alias(self) -> Packing:
        """Return games that share all attributes with these; the caller then replaces the state."""
        alias = object.__new__(type(self))
        vars(alias).update(vars(self))
        return alias

    def set_state(self, state: GameState) -> None:
        """Put the games into a copy of a state, such as a result of :meth:`GameState.select`.

        Raises:
            ValueError: if the state belongs to other games, or no game can reach it. The games have
                not changed then.
        """
        self.state.load(state.tensors())
        self._find_moves()

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of all tensors that the rest of the games depends on."""
        tensors = {name: tensor.clone() for name, tensor in self.state.tensors().items()}
        return tensors | origin(self.stream, self.spec, self.seed)

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore a :meth:`state_dict` of games made with the same arguments.

        The choices in it are played again to check it, so its file need not be trusted.

        Raises:
            ValueError: if it belongs to other games, or these games cannot reach it. The games have
                not changed then.
        """
        tensors = without_origin(tensors, origin(self.stream, self.spec, self.seed))
        state = self.state.holding(tensors)
        self._check_origin(state)
        self.state.copy_from(state)
        self._find_moves()

    def _check_origin(self, state: GameState) -> None:
        """Play the choices in a state again, and refuse the state if they do not lead to it.

        Raises:
            ValueError: naming the first game and tensor that are wrong.
        """
        again, count = self.alias(), state.bins.count
        again.auto_reset = again.checked = False
        beyond = (state.episode < -LAST_EPISODE) | (state.episode > LAST_EPISODE)
        refuse_where(beyond, "episode", "the number of an episode")
        again._start(state.episode.clone(), state.bins.boxes.shape[1])
        refuse_where(again.state.stream != state.stream, "stream", "the items of its episode")
        for k in range(int(count.max())):
            again.alive = again.alive & (k < count)
            x, y = state.bins.boxes[:, k, :2].long().unbind(1)
            cell = torch.where(again.alive, self.floor.cell(x, y), 0)
            orientation = torch.where(again.alive, state.bins.labels[:, k, 1], 0)
            try:
                again.place(orientation, cell)
            except ValueError as error:
                raise ValueError(f"state of another game: {error}") from None
        may_lose = again.alive & (again.orientation_mask & ~again.moves.orientations).any(1)
        refuse_where(state.lost & ~may_lose, "lost", "false")
        if self.auto_reset:
            refuse_where(state.lost | ~again.alive, "episode", "one that has not ended")
        again.state.lost = state.lost
        real = torch.arange(state.bins.boxes.shape[1], device=self.device) < count[:, None]
        others = again.state.tensors()
        for name, value in state.tensors().items():
            other = others[name]
            wrong = value != other
            if value.is_floating_point():  # devices may round differently
                wrong &= ~torch.isclose(value, other, rtol=1e-12, atol=0)
            if name.removeprefix("bins.") in bin_state.ROWS:
                wrong &= real[..., None]
            refuse_where(wrong, name, "the result of the choices in the state")

    def branch(
        self,
        games: Tensor,
        stream: Stream | None = None,
        seed: int = 0,
        episodes: Tensor | None = None,
    ) -> Packing:
        """Return games that begin as copies of some of these and are then played independently.

        They do not restart when they end.

        Args:
            games: int64 [K], numbers of the games to copy, from 0 to G - 1; a number may occur
                several times.
            stream: brings the items after the visible ones; by default this game's stream. If its
                ids have other texts, the boxes that are already placed have no ids in
                :meth:`plans`.
            seed: seed of ``stream``.
            episodes: int64 [K], the episode of ``stream`` for each copy.

        Raises:
            ValueError: if the numbers of games or episodes are impossible.
        """
        if not isinstance(games, Tensor) or games.dtype != torch.int64 or games.dim() != 1:
            raise ValueError(f"games: needs int64 [K], numbers of games, not {described(games)}")
        known = self.device.type == "cpu" and len(games) > 0  # on another device this would wait
        if known and not 0 <= int(games.min()) <= int(games.max()) < self.n:
            raise ValueError(f"games: needs numbers of games from 0 to {self.n - 1}")
        branched = self.alias()
        branched.n, branched.auto_reset = len(games), False
        branched._games = torch.arange(len(games), device=self.device)
        branched.bin_height = self.bin_height[games]
        branched.state = self.state.select(games)
        if stream is not None:
            if not isinstance(episodes, Tensor) or episodes.shape != games.shape:
                raise ValueError(f"episodes: a stream needs one for each of {len(games)} games")
            branched.stream = stream
            # A search uses negative seeds, which users may not give.
            branched.seed = whole_number(seed, "seed", -1 - LARGEST_SEED, LARGEST_SEED)
            branched.orientation_sets = _orientation_sets(stream, self.spec)
            most = self.most_items(min(self.stream.smallest, stream.smallest), None)
            branched.state.bins = branched.bins.for_boxes(most)
            if stream.id_names != self.stream.id_names:
                branched.bins.labels[..., 0] = UNKNOWN
                ids = torch.full_like(branched.t, UNKNOWN)
                branched.state.items = replace(branched.items, ids=ids)
            branched.state.episode = episodes.clone()
            branched.state.stream = stream.start(seed, episodes)
        branched.turn = object()
        branched.moves = Moves(self.mask[games])
        branched.orientation_mask, branched.alive = self.orientation_mask[games], self.alive[games]
        return branched

    def plans(self) -> list[Plan]:
        """Return the boxes in each bin as a plan, one for each game."""
        bins, names = self.bins.to("cpu"), self.stream.id_names
        return [Plan.from_bins(bins, g, id_names=names) for g in range(self.n)]

    # --- a turn -----------------------------------------------------------------------------------

    def orient_item(self, items: Items) -> OrientedItem:
        """Return items in their six orientations; orientations that are not allowed get zero sides.

        See :meth:`marl_pack.game.moves.LegalMoves.orient`.
        """
        return self.legal.orient(items)

    def orient(self, orientation: Tensor, *, check: bool = True) -> Oriented:
        """Return each item in an orientation, with its legal cells: the first turn.

        The games do not change.

        Args:
            orientation: int64 [G], indices into :data:`marl_pack.geometry.ORIENTATIONS`.
            check: whether to check the range on a GPU; the program waits for this check. On the
                CPU the check costs nothing and is always made.

        Raises:
            ValueError: unless the orientations are indices 0 … 5, one for each game.
        """
        self._check_choice("orientation", orientation)
        if check and self.device.type != "cpu":
            self._check_orientations(orientation)
        return Oriented(self._sides(orientation), self.moves.of(orientation))

    def _check_choice(self, what: str, choice: Tensor) -> None:
        """Raise ValueError unless a choice is int64 [G] on the games' device."""
        if (
            not isinstance(choice, Tensor)
            or choice.dtype != torch.int64
            or choice.shape != (self.n,)
            or choice.device != self._games.device
        ):
            where = f" on {choice.device}" if isinstance(choice, Tensor) else ""
            raise ValueError(
                f"{what}: needs one whole number for each of {self.n} games, int64 [{self.n}] on "
                f"{self._games.device}, not {described(choice)}{where}"
            )

    def _check_orientations(self, orientation: Tensor) -> None:
        """Raise ValueError unless all orientations are indices 0 … 5."""
        wrong = ((orientation < 0) | (orientation >= len(ALL_ORIENTATIONS))).nonzero()
        if len(wrong):
            g = int(wrong[0])
            raise ValueError(
                f"game {g}: orientation: needs a whole number from 0 to 5, not "
                f"{int(orientation[g])}"
            )

    def _sides(self, orientation: Tensor) -> Tensor:
        """Return the items' sides along x, y, z, int16 [G, 3].

        Raises:
            ValueError: on the CPU, unless all orientations are indices 0 … 5.
        """
        code = self.backend.pick(compiled=_sides_compiled, tensor=_sides_tensor)
        try:
            return code(self.items.sides, orientation)
        except IndexError:
            self._check_orientations(orientation)
            raise

    def place(self, orientation: Tensor, cell: Tensor, *, check: bool = True) -> Outcome:
        """Place each item and bring the next one: the second turn.

        Args:
            orientation: int64 [G], as in :meth:`orient`.
            cell: int64 [G], cell numbers of the low corners (:class:`marl_pack.game.moves.Floor`).
            check: whether to check that the choices are legal. Pass False only for choices taken
                from the mask: an illegal choice makes the state invalid.

        Raises:
            ValueError: if a choice is not legal. The games have not changed then.
        """
        self._check_choice("orientation", orientation)
        self._check_choice("cell", cell)
        expected = invariants.before(self, orientation, cell) if self.checked else None
        state, alive = self.state, self.alive
        place = self.backend.pick(compiled=self._place_compiled, tensor=self._place_tensor)
        reward, filled, placed, state.t = place(orientation, cell, check)
        if expected is not None:
            invariants.check_bins(state.bins, expected)

        # A game that has ended keeps the item without a legal cell, and so its empty mask.
        state.items = self.stream.item(state.stream, state.t)
        self._find_moves()
        done = alive != self.alive
        if self.auto_reset:
            self._restart(done)
        if self.checked:
            invariants.check(self)
        return Outcome(reward, done, filled, placed, self.volume)

    def _centres(self, orientation: Tensor) -> tuple[Tensor | None, float]:
        """Return the items' centres of mass as in :func:`marl_pack.bins.place`, and their unit."""
        if not any(self.spec.com_offset):
            return None, 1.0
        item = self.orient_item(self.items)
        centres = item.centre_table(0.0, max(self.size[:2]))
        return Moves.gather(centres.units(item.sides), orientation), centres.unit

    def _place_compiled(self, orientation: Tensor, cell: Tensor, check: bool) -> Played:
        """Place each item in compiled loops; see :meth:`place`."""
        state, masked = self.state, self.spec.mask_orientations
        bins, items = state.bins, state.items
        masks, table = self.moves.array, (bins.arrays[COUNT], bins.boxes.shape[1])
        alive, sides = self.alive.numpy(), items.sides.numpy()
        chosen = orientation.numpy(), cell.numpy()
        fault, g = compiled.find_fault(
            masks, self.orientation_mask.numpy(), alive, sides, *table, self.size[1], *chosen,
            masked, check,
        )  # fmt: skip
        if fault == compiled.ILLEGAL:
            self._refuse(g, orientation, cell)
        if fault == compiled.WRONG_ORIENTATION:
            self._check_orientations(orientation)
        if fault:
            bin_state.refuse(bins, full=fault == compiled.FULL)
        t = state.t.numpy().copy()
        ids = t if items.ids is None else items.ids.numpy()
        com, unit = self._centres(orientation)
        reward, after = np.empty(self.n, np.float32), np.empty((2, self.n), np.int64)
        compiled.place_items(
            *bins.arrays, masks, alive, sides, items.weights.numpy(), ids, *chosen,
            NO_CENTRES if com is None else com.double().numpy(), unit, masked, self._gain,
            self._loss, state.lost.numpy(), t, reward, after,
        )  # fmt: skip
        filled, placed = map(torch.from_numpy, after)
        return torch.from_numpy(reward), filled, placed, torch.from_numpy(t)

    def _place_tensor(self, orientation: Tensor, cell: Tensor, check: bool) -> Played:
        """Place each item in tensor code; see :meth:`place`."""
        if check:
            self._check(orientation, cell)
        state, alive = self.state, self.alive
        sides, played = self._sides(orientation), alive
        if not self.spec.mask_orientations:
            possible = Moves.gather(self.moves.orientations, orientation)
            state.lost = state.lost | (alive & ~possible)
            played = alive & ~state.lost
        if not (self.auto_reset and self.spec.mask_orientations):
            sides = torch.where(played[:, None], sides, 0)
        com, unit = self._centres(orientation)
        corners = torch.stack(self.floor.corner(cell), 1)
        labels = self.items.ids_at(state.t), orientation
        _, waste, volume = bin_state.place(
            state.bins, sides, corners, self.items.weights, com, labels, unit, check
        )
        # R = α · w d h / (W D H) - β · v_waste / (W D H)
        reward = (self._gain * volume.double() - self._loss * waste.double()).float()
        return reward, state.bins.filled.clone(), state.bins.count.clone(), state.t + played

    def _check(self, orientation: Tensor, cell: Tensor) -> None:
        """Raise ValueError if a choice in a game that has not ended is not legal."""
        legal = self.moves.allows(orientation, cell)
        if not self.spec.mask_orientations:  # an orientation without a cell may be chosen
            real = (orientation >= 0) & (orientation < len(ALL_ORIENTATIONS))
            real &= (cell >= 0) & (cell < self.floor.cells)
            chosen = orientation * real
            without_cell = ~Moves.gather(self.moves.orientations, chosen)
            legal |= real & without_cell & Moves.gather(self.orientation_mask, chosen)
        illegal = self.alive & ~legal
        if bool(illegal.any()):
            self._refuse(int(illegal.nonzero()[0]), orientation, cell)

    def _refuse(self, g: int, orientation: Tensor, cell: Tensor) -> NoReturn:
        """Raise ValueError for the choice of game ``g``, which is not legal."""
        x, y = self.floor.corner(int(cell[g]))
        raise ValueError(
            f"game {g}: item {self.items.sides[g].tolist()} in orientation "
            f"{int(orientation[g])} may not be placed at ({x}, {y}), cell {int(cell[g])}; "
            "choose where the mask is true"
        )

    # --- masks and episodes -----------------------------------------------------------------------

    def _find_moves(self) -> None:
        """Find the legal moves of the visible items; a game without a legal move has ended."""
        self.turn = object()
        state = self.state
        self.moves = self.legal.moves(state.bins, state.items, state.lost)
        self.orientation_mask, self.alive = self.legal.choices(self.moves, state.items)

    def _restart(self, ended: Tensor) -> None:
        """Begin the next episode with a legal first item in the games ``ended``, bool [G].

        Raises:
            ValueError: if :data:`MOST_SKIPPED` episodes in a row have no such item.
        """
        if self._all_fit:  # so the device need not be asked whether an episode is skipped
            self._begin_by_mask(~self.alive)
            return
        begin = self.backend.pick(compiled=self._begin_some, tensor=self._begin_by_mask)
        for _ in range(MOST_SKIPPED):
            if not bool(ended.any()):
                return
            begin(ended)
            ended = ended & ~self.alive
        first = self.items.sides[int(ended.nonzero()[0])].tolist()
        raise ValueError(
            f"no episode can begin: a first item such as {first} has no legal cell in the empty "
            f"bin {self.size}; check the allowed orientations {self.spec.orientations}, the rule's "
            "margin and com_offset"
        )

    def _every_item_fits(self) -> bool:
        """Return whether every item of the stream surely has a legal cell in an empty bin.

        In an orientation in which the longest cube fits, every item fits. If the shortest cube is
        stable on the floor in an orientation, every larger footprint is, by the rules of
        :mod:`marl_pack.stability`.
        """
        if not isinstance(self.spec.rule, str):  # a function may refuse any item
            return False
        shortest, longest = self.stream.sides
        sides = torch.tensor([[shortest] * 3, [longest] * 3], dtype=torch.int16, device=self.device)
        bins = bin_state.empty(2, self.size, 0, self.device, self.backend)
        items = Items(sides, sides.double().prod(1))
        both = self.legal.moves(bins, items).orientations.all(0).tolist()
        return all(any(both[o] for o in some) for some in self.orientation_sets)

    def _begin_some(self, ended: Tensor) -> None:
        """Begin the next episode where ``ended``, computing nothing for the other games."""
        state, games = self.state, np.flatnonzero(ended.numpy())
        heightmap, empty_map, *_, count, filled = state.bins.arrays
        episode, t, stream = state.episode.numpy(), state.t.numpy(), state.stream.numpy()
        episode[games] += self.n
        for values in (t, state.lost.numpy(), heightmap, empty_map, count, filled):
            values[games] = 0
        begun = self.stream.start(self.seed, torch.from_numpy(episode[games]))
        stream[games] = begun.numpy()
        items = self.stream.item(begun, torch.from_numpy(t[games]))
        empty = self._empty if len(games) == self.n else self._empty[: len(games)]
        moves = self.legal.moves(empty, items)
        possible, alive = self.legal.choices(moves, items)
        for old, new in (
            (self.mask, moves.mask), (self.orientation_mask, possible), (self.alive, alive),
            *zip(state.items.tensors().values(), items.tensors().values(), strict=True),
        ):  # fmt: skip
            old.numpy()[games] = new.numpy()

    def _begin_by_mask(self, ended: Tensor) -> None:
        """Begin the next episode where ``ended``; tensor shapes are fixed, so no device waits."""
        state = self.state
        state.episode = torch.where(ended, state.episode + self.n, state.episode)
        state.t = state.t.masked_fill(ended, 0)
        state.lost = state.lost & ~ended
        bin_state.clear(state.bins, ended)
        state.stream = self.stream.restart(state.stream, self.seed, state.episode, ended)
        state.items = self.stream.item(state.stream, state.t)
        new = self.legal.moves(self._empty, state.items).mask
        self.moves = Moves(torch.where(ended[:, None, None, None], new, self.mask))
        self.orientation_mask, self.alive = self.legal.choices(self.moves, state.items)


def _sides_compiled(sides: Tensor, orientation: Tensor) -> Tensor:
    """Return items' sides [G, 3] along x, y, z in orientations int64 [G], by a compiled loop.

    Raises:
        IndexError: for an orientation that is not one of 0 … 5.
    """
    chosen = np.empty((orientation.shape[0], 3), np.int16)
    if not compiled.rotate_items(sides.numpy(), orientation.numpy(), chosen):
        raise IndexError
    return torch.from_numpy(chosen)


def _sides_tensor(sides: Tensor, orientation: Tensor) -> Tensor:
    """Return the same as :func:`_sides_compiled`, in tensor code; a GPU raises no clear error."""
    axes = orientation_table(sides.device).index_select(0, orientation)  # refuses negative indices
    return sides.gather(1, axes)


def _orientation_sets(stream: Stream, spec: GameSpec) -> dict[tuple[int, ...], float]:
    """Return the sets of orientations that a stream's items may take under the spec."""
    shares: dict[tuple[int, ...], float] = {}
    for orientations, share in stream.orientation_sets.items():
        allowed = tuple(o for o in orientations if o in spec.orientations)
        shares[allowed] = shares.get(allowed, 0.0) + share
    return shares


def _backend_of(backend: Backend | None, device: torch.device) -> Backend:
    """Return the backend, or the device's default for None; refuse one that cannot use it."""
    if backend is None:
        return default_backend(device)
    if not isinstance(backend, Backend):
        raise ValueError(f"backend = {shown(backend)}: needs one of {', '.join(map(str, Backend))}")
    if backend is Backend.COMPILED and device.type != "cpu":
        raise ValueError(f"backend = {backend}: needs the device cpu, not {device}")
    return backend
