"""Search before each placement: play the best moves to the end of the bin in imagined futures.

The best moves by the linear score are tried. Each is followed by futures: boxes drawn like the
goods, placed one after the other by the linear score until one has no place. All moves are tried in
the same futures. Moves that do badly are dropped after each round (sequential halving, Karnin et
al. 2013), so the best ones are tried in most futures.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.exact.bins import FIRST_ROOM, NOWHERE, ExactBins
from marl_pack.exact.choice import LINEAR, best_move
from marl_pack.exact.explaining import Reasons
from marl_pack.exact.futures import Futures, Shown
from marl_pack.exact.goods import Goods
from marl_pack.exact.limits import CARRIES, ROW, Limits
from marl_pack.exact.moves import AXES, decode
from marl_pack.exact.search_settings import ExactSearchSettings
from marl_pack.exact.state import ROUNDING, State, add_box, blocked_boxes, empty_state, keeps_parts
from marl_pack.installation import njit

if TYPE_CHECKING:
    from marl_pack.exact.packing import ExactPacking

MILLISECOND = 1_000_000  # nanoseconds
CERTAINTY = 0.5
"""Standard errors by which a move has to be better than the one with the best score."""
FEWEST = 6
"""Futures that this needs at least."""
SHARE = 8
"""So many futures there should be time for, for each move that is tried."""


@njit(cache=True)
def _copy_bin(source: State, b: int, target: State) -> None:
    """Copy bin ``b`` of ``source`` into the only bin of ``target``, which has room for it."""
    n = source.count[b]
    target.count[0] = n
    for j in range(n):
        for i in range(ROW):
            target.boxes[0, j, i] = source.boxes[b, j, i]
        for i in range(source.below.shape[2]):
            target.below[0, j, i] = source.below[b, j, i]
    target.weights[0, :n], target.known[0, :n] = source.weights[b, :n], source.known[b, :n]
    target.stackable[0, :n], target.max_load[0, :n] = (
        source.stackable[b, :n],
        source.max_load[b, :n],
    )
    target.carried[0, :n], target.grounded[0, :n] = source.carried[b, :n], source.grounded[b, :n]
    target.starts[0, : n + 1] = source.starts[b, : n + 1]
    rows = source.starts[b, n]
    target.parts[0, :rows] = source.parts[b, :rows]


@njit(cache=True, nogil=True)
def _play_out(
    weights: Any, limits: Limits, size: Any, max_weight: float, source: State, b: int,
    target: State, sides: Any, allowed: Any, kilograms: Any, known: Any, stackable: Any,
    max_load: Any, rows: Any, out: Any,
) -> tuple[float, int, int]:  # fmt: skip
    """Copy a bin, and place boxes in the copy by the linear score until one has no place.

    Args:
        weights: float64 [F], of the features.
        limits, size: of the bin.
        max_weight: largest weight of all boxes in kilograms; inf for no limit.
        source, b: the bin.
        target: memory for the copy.
        sides, allowed, kilograms, known, stackable, max_load: the goods.
        rows: int64 [L], the goods that come, in order.
        out: int64 [M], memory for candidates.

    Returns:
        The volume of the boxes that were placed, in cubic units; the rows of carrying parts that
        ``target`` needs, and the candidates that ``out`` needs, both 0 if it had room.
    """
    _copy_bin(source, b, target)
    blocked = np.zeros(target.boxes.shape[1], np.bool_)
    new = np.empty(ROW, np.int64)
    volume, total = 0.0, 0.0
    for j in range(target.count[0]):
        total += target.weights[0, j] if target.known[0, j] else np.inf
    for r in rows:
        n = target.count[0]
        heavy = max_weight < np.inf and (
            not known[r] or total + kilograms[r] > max_weight * (1 + ROUNDING)
        )
        if n >= target.boxes.shape[1] or heavy:
            break
        blocked_boxes(target, 0, kilograms[r], known[r], blocked)
        needed, move = best_move(
            LINEAR, weights, limits, size, target.boxes[0], n, target.starts[0], target.parts[0],
            blocked, sides[r], allowed[r], out,
        )  # fmt: skip
        if needed < 0:
            return 0.0, 0, -needed
        if move < 0:
            break
        o, new[0], new[1], new[2] = decode(move)
        for i in range(3):
            new[3 + i] = sides[r, AXES[o, i]]
        for i in range(2):
            new[CARRIES + i], new[CARRIES + 2 + i] = new[i], new[i] + new[3 + i]
        more = add_box(
            limits, target, 0, new, kilograms[r], known[r], stackable[r], max_load[r]
        )  # fmt: skip
        if more > 0:
            return 0.0, more, 0
        volume += float(new[3]) * new[4] * new[5]
        total += kilograms[r]
    return volume, 0, 0


@dataclass
class Search:
    """A policy that tries the best moves in imagined futures before each placement.

    Args:
        weights: float64 [F], weights of the linear score that chooses the moves to try, and plays
            the futures.
        settings: how much to try.
        futures: draws the boxes that may come; by default from the boxes that were shown so far.
        seed: seed of the futures.
        clock: returns the time in nanoseconds.
    """

    weights: NDArray[np.float64]
    settings: ExactSearchSettings = field(default_factory=ExactSearchSettings)
    futures: Futures = field(default_factory=Shown)
    seed: int = 0
    clock: Callable[[], int] = time.perf_counter_ns

    def __post_init__(self) -> None:
        self.played = 0  # futures played so far
        # Of the last call: the moves tried in each game, the volumes [futures, moves] that were
        # placed after them (NaN: not tried).
        self._tried: dict[int, tuple[NDArray[np.int64], NDArray[np.float64]]] = {}

    def __call__(self, game: ExactPacking) -> NDArray[np.int64]:
        """Return the move of each game, int64 [G]; NOWHERE where the box has no place."""
        moves = np.full(len(game.bins), NOWHERE)
        self._tried = {}
        for g in np.flatnonzero(game.alive).tolist():
            begin = self.clock()
            shown = game.shown(g)
            generator = np.random.default_rng((self.seed, int(game.episode[g]), len(shown)))
            bins, item = game.bins.select([g]), game.items[[g]]
            moves[g], tried, volumes = self._choose(bins, item, shown, generator, begin)
            self._tried[g] = tried, volumes
        return moves

    def reasons(self, game: Any, g: int, moves: NDArray[np.int64], move: int) -> Reasons:
        """Return the mean results of the moves that the last call tried in game ``g``.

        They are filled shares of the bin (:class:`marl_pack.exact.explaining.Explained`).
        """
        tried, volumes = self._tried[g]
        counts = np.isfinite(volumes).sum(0)
        means = np.where(counts, np.nansum(volumes, 0) / np.maximum(counts, 1), np.nan)
        filled = game.bins.utilization[g] + float(game.items.volumes[g]) / game.bins.volume
        values = np.full(len(moves), np.nan)
        values[np.searchsorted(moves, tried)] = filled + means / game.bins.volume
        tries = np.zeros(len(moves), np.int64)
        tries[np.searchsorted(moves, tried)] = counts
        return Reasons(values, "mean filled share in futures", tries=tries)

    def ranked(self, bins: ExactBins, item: Goods) -> NDArray[np.int64]:
        """Return the best moves of an item in the only bin by the linear score, the best first."""
        moves = bins.moves(item).of(0)
        scores = bins.features(0, item.sides[0], moves) @ self.weights
        return moves[np.lexsort((moves, -scores))[: self.settings.top]]

    def _choose(
        self, bins: ExactBins, item: Goods, shown: Goods, generator: np.random.Generator,
        begin: int,
    ) -> tuple[int, NDArray[np.int64], NDArray[np.float64]]:  # fmt: skip
        """Return the best move of an item in the only bin, the moves tried and their results."""
        moves = self.ranked(bins, item)
        room = bins.spec.max_boxes - int(bins.state.count[0]) - 1
        if len(moves) < 2 or not room:
            return int(moves[0]) if len(moves) else NOWHERE, moves, np.empty((0, len(moves)))
        trial = _Trial(self.weights, bins, item, moves)
        end = begin + int(self.settings.budget_ms * MILLISECOND)

        def draw() -> tuple[Goods, NDArray[np.int64]]:
            return self.futures.draw(generator, item, shown, room)

        future, started = draw(), self.clock()
        value = trial.value(0, *future)
        cost = max(1, self.clock() - started)
        if self.settings.futures is None:  # as many moves as there is time for
            affordable = (end - self.clock()) // (cost * SHARE)
            moves = moves[: max(2, min(len(moves), affordable))]
        values = np.empty((0, len(moves)))  # [futures, moves]; NaN: not tried
        survivors = np.arange(len(moves))
        rounds = math.ceil(math.log2(len(moves)))
        for k in range(rounds):
            deadline = begin + (end - begin) * (k + 1) // rounds
            tries = self.settings.tries(k, rounds, len(survivors))
            played = 0
            while played < tries and self.clock() < deadline:
                row = np.full(len(moves), np.nan)
                if len(values):
                    future = draw()
                    row[survivors[0]] = trial.value(int(survivors[0]), *future)
                else:
                    row[0] = value
                for m in survivors[1:].tolist():
                    if self.clock() >= end:
                        break
                    row[m] = trial.value(m, *future)
                if np.isnan(row[survivors]).any():  # the time is over: the future is not complete
                    break
                values = np.vstack((values, row))
                played += 1
            self.played += played * len(survivors)
            # Survivors were tried in all futures. A stable sort keeps the better score first.
            means = values[:, survivors].mean(0) if len(values) else np.zeros(len(survivors))
            order = np.argsort(-means, kind="stable")
            survivors = np.sort(survivors[order[: -(-len(survivors) // 2)]])
        return int(moves[self._better(int(survivors[0]), values)]), moves, values

    @staticmethod
    def _better(m: int, values: NDArray[np.float64]) -> int:
        """Return move ``m`` if the futures show that it is better than the first one, else 0.

        It has to be better by :data:`CERTAINTY` standard errors, in the futures that both had: the
        score that ranks the moves is right more often than a few futures.
        """
        gains = values[:, m] - values[:, 0]
        gains = gains[np.isfinite(gains)]
        if len(gains) < FEWEST:
            return 0
        error = gains.std(ddof=1) / math.sqrt(len(gains))
        return m if gains.mean() > CERTAINTY * error else 0


class _Trial:
    """The bins after each move that is tried, and memory for playing futures in them."""

    def __init__(
        self, weights: NDArray[np.float64], bins: ExactBins, item: Goods,
        moves: NDArray[np.int64],
    ) -> None:  # fmt: skip
        self.weights = weights
        self.after = bins.select(np.zeros(len(moves), np.int64))
        self.after.place(item[np.zeros(len(moves), np.int64)], moves)
        limit = bins.spec.max_weight_kg
        self.max_weight = np.inf if limit is None else limit
        self.out = np.empty(FIRST_ROOM, np.int64)
        self._make_room(2 * self.after.state.parts.shape[1])

    def _make_room(self, parts: int) -> None:
        """Make memory for a bin with so many rows of carrying parts."""
        state = empty_state(1, self.after.spec.max_boxes, keeps_parts(self.after.limits.rule))
        more = np.zeros((1, max(parts, state.parts.shape[1]), 4), np.int32)
        self.memory = state._replace(parts=more)

    def value(self, m: int, goods: Goods, rows: NDArray[np.int64]) -> float:
        """Return the volume that is placed after move ``m`` when these goods come."""
        after = self.after
        kilograms, known = after.weights_of(goods)
        while True:
            volume, parts, candidates = _play_out(
                self.weights, after.limits, after.size, self.max_weight, after.state, m,
                self.memory, goods.sides, goods.orientations, kilograms, known, goods.stackable,
                goods.max_load, rows, self.out,
            )  # fmt: skip
            if parts:
                self._make_room(2 * parts)
            elif candidates:
                self.out = np.empty(2 * candidates, np.int64)
            else:
                return float(volume)
