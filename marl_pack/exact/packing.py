"""The packing game in millimetres: G games at once, each with one bin and its own conveyor.

A box is visible; it is placed by one of its listed moves; then the next box comes. An episode ends
when the visible box has no move, when its sequence ends, or when the bin holds ``max_boxes``.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_pack.checks import LARGEST_SEED, described, shown, truth_value, whole_number
from marl_pack.exact.bins import NOWHERE, ExactBins, ListedMoves, placements
from marl_pack.exact.goods import AXES, Goods
from marl_pack.exact.present import check_present
from marl_pack.exact.spec import ExactSpec
from marl_pack.exact.streams import GoodsStream, make_goods_stream
from marl_pack.option_record import document
from marl_pack.plan import Plan

MOST_GAMES = 1 << 16
"""The largest number of games that can be played at once."""
LAST_EPISODE = 1 << 62
"""The largest number that the first episode can have."""
MOST_SKIPPED = 1000
"""Number of episodes in a row whose first box has no move, after which a game gives up."""


@dataclass(frozen=True)
class ExactOutcome:
    """The result of placing a box in each game; zeros where nothing was placed."""

    reward: NDArray[np.float64]  # [G]   alpha · volume - beta · waste, as shares of the bin (Eq. 5)
    done: NDArray[np.bool_]  # [G]       whether the episode ended with this placement
    utilization: NDArray[np.float64]  # [G]  share of the bin that is filled, before any reset
    packed: NDArray[np.int64]  # [G]     boxes in the bin, before any reset


@document(ExactSpec, " " * 8)
class ExactPacking:
    """G games in millimetres.

    Attributes:
        spec: the options of the game.
        bins: the bins (:class:`marl_pack.exact.bins.ExactBins`).
        items: the visible box of each game (:class:`marl_pack.exact.goods.Goods`).
        t: number of boxes that came before the visible one, int64 [G].
        episode: number of the episode that each game plays, int64 [G].
        alive: bool [G], false where an episode has ended (only without ``auto_reset``).

    Args:
        n: number of games G.
        items: a CSV or JSON file, rows of sides in millimetres, a mapping with attributes, goods or
            a stream (:func:`marl_pack.exact.streams.make_goods_stream`).
        spec: options of the game; by default ``ExactSpec()``.
        present: boxes that are in every bin at first: rows x, y, z, w, d, h in millimetres, or a
            plan of one bin (:func:`marl_pack.exact.present.check_present`).
        order: ``"file"`` or ``"draw"``, the order in which the boxes come.
        length: number of boxes in an episode.
        auto_reset: begin a new episode in a game as soon as its episode ends. Episodes whose first
            box has no move are skipped.
        seed: seed of drawn boxes.
        first_episode: game g plays the episodes ``first_episode + g``, then every G-th after it.
        **options: options of the game that replace those in ``spec``:
        {options}

    Raises:
        ValueError, TypeError: if an argument is impossible; the message says what would be right.
    """

    def __init__(
        self,
        n: int,
        items: Any,
        *,
        spec: ExactSpec | None = None,
        present: Any = (),
        order: str = "file",
        length: int | None = None,
        auto_reset: bool = True,
        seed: int = 0,
        first_episode: int = 0,
        **options: Any,
    ) -> None:
        if not (spec is None or isinstance(spec, ExactSpec)):
            raise ValueError(f"spec = {shown(spec)}: needs an ExactSpec")
        self.spec = (spec or ExactSpec()).with_options(options)
        self.n = whole_number(n, "n, at least one game", 1, MOST_GAMES)
        self.auto_reset = truth_value(auto_reset, "auto_reset")
        seed = whole_number(seed, "seed", 0, LARGEST_SEED)
        self.stream: GoodsStream = make_goods_stream(
            items, self.spec, order=order, length=length, seed=seed
        )
        self.bins = ExactBins(self.n, self.spec, check_present(present, self.spec))
        self.reset(first_episode)

    def reset(self, first_episode: int = 0) -> None:
        """Empty all bins and begin the episodes ``first_episode + g``.

        Raises:
            ValueError: for an impossible episode, or if all episodes are skipped.
        """
        first = whole_number(first_episode, "first_episode", 0, LAST_EPISODE)
        everything = np.ones(self.n, np.bool_)
        self.bins.clear(everything)
        self.episode = first + np.arange(self.n)
        self.t = np.zeros(self.n, np.int64)
        self.alive = everything
        self.rows = np.full((self.n, self.spec.max_boxes), -1)
        self.orientations = np.full((self.n, self.spec.max_boxes), -1)
        self._sequences = [self.stream.sequence(e) for e in self.episode.tolist()]
        self._moves: ListedMoves | None = None
        self._show()
        if self.auto_reset:
            self._restart(~self.alive)

    @property
    def moves(self) -> ListedMoves:
        """The legal moves of each visible box; games that have ended have none."""
        if self._moves is None:
            self._moves = self.bins.moves(self.items, self.alive)
        return self._moves

    @property
    def visible(self) -> NDArray[np.int64]:
        """Row of each visible box in the stream's goods, int64 [G]; -1 where a sequence ended."""
        return np.array([
            sequence[t] if t < len(sequence) else -1
            for sequence, t in zip(self._sequences, self.t.tolist(), strict=True)
        ])  # fmt: skip

    def shown(self, g: int) -> Goods:
        """Return the boxes that game ``g`` has shown so far, in order; the visible one is last."""
        return self.stream.goods[self._sequences[g][: int(self.t[g]) + 1]]

    def _show(self) -> None:
        """Show the next box in each game; a game ends if it has no box or its box has no move."""
        self._row = self.visible
        self.items: Goods = self.stream.goods[np.maximum(self._row, 0)]
        self._moves = None
        full = self.bins.state.count >= self.spec.max_boxes
        self.alive = self.bins.any_move(self.items, self.alive & (self._row >= 0) & ~full)

    def place(self, moves: ArrayLike, *, check: bool = True) -> ExactOutcome:
        """Place the visible box in each game; games that have ended ignore their move.

        Args:
            moves: whole numbers [G], legal moves such as members of :attr:`moves`.
            check: whether to check that they are legal.

        Raises:
            ValueError: if a game that is played gets a move that is not legal. Nothing has changed
                then.
        """
        numbers = np.asarray(moves)
        if numbers.shape != (self.n,) or numbers.dtype.kind not in "iu":
            raise ValueError(f"moves: needs whole numbers [{self.n}], not {described(numbers)}")
        moves = np.where(self.alive, numbers.astype(np.int64), NOWHERE)
        lost = self.alive & (moves < 0)
        if check:
            lost |= ~self.bins.legal(self.items, moves)
        if lost.any():
            raise ValueError(f"game {int(lost.argmax())}: needs one of its legal moves")
        placed = self.alive.copy()
        waste = self.bins.waste(self.items, moves)
        games, count = np.flatnonzero(placed), self.bins.state.count[placed]
        self.rows[games, count] = self._row[games]
        self.orientations[games, count] = moves[games] & 7
        self.bins.place(self.items, moves)
        volume = np.where(placed, self.items.volumes, 0.0)
        reward = (self.spec.alpha * volume - self.spec.beta * waste) / self.bins.volume
        self.t += placed
        self._show()
        done = placed & ~self.alive
        outcome = ExactOutcome(reward, done, self.bins.utilization, self.bins.state.count.copy())
        if self.auto_reset:
            self._restart(done)
        return outcome

    def _restart(self, ended: NDArray[np.bool_]) -> None:
        """Begin the next episode of the games that have ended; skip those without a move."""
        for _ in range(MOST_SKIPPED):
            if not ended.any():
                return
            self.bins.clear(ended)
            self.rows[ended], self.orientations[ended] = -1, -1
            self.t[ended] = 0
            self.episode[ended] += self.n
            for g in np.flatnonzero(ended).tolist():
                self._sequences[g] = self.stream.sequence(int(self.episode[g]))
            self.alive = self.alive | ended
            self._show()
            ended = ~self.alive
        raise ValueError(f"{MOST_SKIPPED} episodes in a row have a first box without a legal move")

    def select(self, games: Any) -> ExactPacking:
        """Return games that continue as copies of some of these, and do not restart.

        Args:
            games: whole numbers, a slice or bool [G].
        """
        other = copy.copy(self)
        index = np.atleast_1d(np.arange(self.n)[games])
        other.n, other.auto_reset = len(index), False
        other.bins = self.bins.select(index)
        for name in ("episode", "t", "alive", "rows", "orientations", "_row"):
            setattr(other, name, getattr(self, name)[index].copy())
        other.items = self.items[index]
        other._sequences = [self._sequences[g] for g in index.tolist()]
        other._moves = None
        return other

    def plan(self, g: int) -> Plan:
        """Return what game ``g`` has packed, in millimetres."""
        count = int(self.bins.state.count[g])
        rows = self.rows[g, :count]
        ids = [self.stream.goods.ids[row] if row >= 0 else "" for row in rows.tolist()]
        return self.bins.plan(g, ids, self.orientations[g, :count])

    def sides(self, moves: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the visible boxes' sides along x, y, z at moves, int64 [G, 3] in units."""
        orientations = placements(np.maximum(moves, 0))[:, 0]
        return np.take_along_axis(self.items.sides, AXES[orientations], 1)
