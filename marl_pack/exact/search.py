"""Search before each placement: play the best moves to the end of the bin in imagined futures.

The best moves by the linear score are tried. Each is followed by futures: boxes drawn like the
goods, placed one after the other by the linear score until one has no place. All moves are tried in
the same futures. Moves that do badly are dropped after each round (sequential halving, Karnin et
al. 2013), so the best ones are tried in most futures.

With a buffer of k boxes, a preview or several open bins, the moves of all visible boxes in all open
bins are tried, and a future begins with the boxes that are known. It ends when k boxes have no
place in any bin: there a bin would be closed.
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
from marl_pack.exact.choice import LINEAR, best_move, linear_score
from marl_pack.exact.explaining import Reasons
from marl_pack.exact.features import make_columns
from marl_pack.exact.futures import Futures, Shown
from marl_pack.exact.goods import Goods, joined
from marl_pack.exact.limits import CARRIES, ROW, Limits
from marl_pack.exact.moves import AXES, by_top, decode
from marl_pack.exact.options import Options
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
def _copy_bin(source: State, b: int, target: State, t: int) -> None:
    """Copy bin ``b`` of ``source`` into bin ``t`` of ``target``, which has room for it."""
    n = source.count[b]
    target.count[t] = n
    for j in range(n):
        for i in range(ROW):
            target.boxes[t, j, i] = source.boxes[b, j, i]
        for i in range(source.below.shape[2]):
            target.below[t, j, i] = source.below[b, j, i]
    target.weights[t, :n], target.known[t, :n] = source.weights[b, :n], source.known[b, :n]
    target.stackable[t, :n], target.max_load[t, :n] = (
        source.stackable[b, :n],
        source.max_load[b, :n],
    )
    target.carried[t, :n], target.grounded[t, :n] = source.carried[b, :n], source.grounded[b, :n]
    target.starts[t, : n + 1] = source.starts[b, : n + 1]
    rows = source.starts[b, n]
    target.parts[t, :rows] = source.parts[b, :rows]


@njit(cache=True)
def _largest(slots: Any, sides: Any) -> int:
    """Return the slot of the largest box, int64 [k], the first of equal ones; -1 if none is full.

    Args:
        slots: int64 [k], the row of each box in the goods; -1: empty.
        sides: int64 [R, 3], of the goods.
    """
    best, most = -1, 0.0
    for i in range(slots.size):
        r = slots[i]
        if r >= 0:
            volume = float(sides[r, 0]) * sides[r, 1] * sides[r, 2]
            if volume > most:
                best, most = i, volume
    return best


@njit(cache=True, nogil=True)
def _play_out(
    weights: Any, limits: Limits, size: Any, max_weight: float, source: State, first: int,
    target: State, sides: Any, allowed: Any, kilograms: Any, known: Any, stackable: Any,
    max_load: Any, rows: Any, k: int, out: Any,
) -> tuple[float, int, int]:  # fmt: skip
    """Copy b bins, and place boxes in the copies by the linear score until k have no place.

    The largest visible box is placed next. A box that has no place stays in the buffer.

    Args:
        weights: float64 [F], of the features.
        limits, size: of a bin.
        max_weight: largest weight of all boxes in a bin in kilograms; inf for no limit.
        source: the bins; those to copy begin at bin ``first``.
        first: the first bin to copy.
        target: memory for the copies; it has b bins.
        sides, allowed, kilograms, known, stackable, max_load: the goods.
        rows: int64 [L], the goods that come, in order; the first k are visible.
        k: number of visible boxes.
        out: int64 [M], memory for candidates.

    Returns:
        The volume of the boxes that were placed, in cubic units; the rows of carrying parts that
        ``target`` needs, and the candidates that ``out`` needs, both 0 if it had room.
    """
    b = target.count.size
    totals = np.zeros(b)
    for j in range(b):
        _copy_bin(source, first + j, target, j)
        for i in range(target.count[j]):
            totals[j] += target.weights[j, i] if target.known[j, i] else np.inf
    blocked = np.zeros(target.boxes.shape[1], np.bool_)
    new, features = np.empty(ROW, np.int64), np.empty(weights.size)
    slots = np.full(k, -1)
    coming = min(k, rows.size)  # boxes that became visible so far
    slots[:coming] = rows[:coming]
    volume = 0.0
    while True:
        slot = _largest(slots, sides)
        if slot < 0:
            return volume, 0, 0
        r = slots[slot]
        best, at, most = -1, 0, -np.inf
        for j in range(b):
            n = target.count[j]
            heavy = max_weight < np.inf and (
                not known[r] or totals[j] + kilograms[r] > max_weight * (1 + ROUNDING)
            )
            if n >= target.boxes.shape[1] or heavy:
                continue
            blocked_boxes(target, j, kilograms[r], known[r], blocked)
            needed, move = best_move(
                LINEAR, weights, limits, size, target.boxes[j], n, target.starts[j],
                target.parts[j], blocked, sides[r], allowed[r], out,
            )  # fmt: skip
            if needed < 0:
                return 0.0, 0, -needed
            if move < 0:
                continue
            points = 0.0
            if b > 1:
                points = linear_score(
                    weights, limits, size, by_top(target.boxes[j], n), n, sides[r], move,
                    make_columns(n), features, -np.inf,
                )  # fmt: skip
            if best < 0 or points > most:
                best, at, most = move, j, points
        slots[slot] = -1  # it is placed, or has no place any more
        if best < 0:
            continue
        o, new[0], new[1], new[2] = decode(best)
        for i in range(3):
            new[3 + i] = sides[r, AXES[o, i]]
        for i in range(2):
            new[CARRIES + i], new[CARRIES + 2 + i] = new[i], new[i] + new[3 + i]
        more = add_box(
            limits, target, at, new, kilograms[r], known[r], stackable[r], max_load[r]
        )  # fmt: skip
        if more > 0:
            return 0.0, more, 0
        volume += float(new[3]) * new[4] * new[5]
        totals[at] += kilograms[r]
        if coming < rows.size:
            slots[slot] = rows[coming]
            coming += 1


@dataclass(frozen=True)
class _Tried:
    """The moves of one option that the last call tried."""

    moves: NDArray[np.int64]  # [M]
    volumes: NDArray[np.float64]  # [futures, M]  placed after each; NaN: not tried


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
        self._tried: dict[int, _Tried] = {}  # in each game, or of each option

    def __call__(self, game: ExactPacking | Options) -> NDArray[np.int64]:
        """Return the moves, int64 [G]; NOWHERE where a box has no place.

        Of several options, only the one that is chosen gets a move.
        """
        moves = np.full(len(game.bins), NOWHERE)
        self._tried = {}
        games = [0] if isinstance(game, Options) else np.flatnonzero(game.alive).tolist()
        for g in games:
            begin = self.clock()
            shown = game.shown(g)
            generator = np.random.default_rng((self.seed, int(game.episode[g]), len(shown)))
            if isinstance(game, Options):
                option, move = self._choose(game, shown, generator, begin)
                moves[option] = move
                continue
            alone = Options(game.bins.select([g]), game.items[[g]])
            _, moves[g] = self._choose(alone, shown, generator, begin, g)
        return moves

    def reasons(self, game: Any, g: int, moves: NDArray[np.int64], move: int) -> Reasons:
        """Return the mean results of the moves that the last call tried in game ``g``.

        They are filled shares of the open bins (:class:`marl_pack.exact.explaining.Explained`).
        """
        tried = self._tried[g]
        counts = np.isfinite(tried.volumes).sum(0)
        sums = np.nansum(tried.volumes, 0)
        means = np.where(counts, sums / np.maximum(counts, 1), np.nan)
        opened = game.open.utilization if isinstance(game, Options) else game.bins.utilization[[g]]
        filled = opened.sum() + float(game.items.volumes[g]) / game.bins.volume
        values = np.full(len(moves), np.nan)
        where = np.searchsorted(moves, tried.moves)
        values[where] = (filled + means / game.bins.volume) / len(opened)
        tries = np.zeros(len(moves), np.int64)
        tries[where] = counts
        return Reasons(values, "mean filled share in futures", tries=tries)

    def ranked(self, bins: ExactBins, item: Goods) -> NDArray[np.int64]:
        """Return the best moves of an item in the only bin by the linear score, the best first."""
        moves = bins.moves(item).of(0)
        scores = bins.features(0, item.sides[0], moves) @ self.weights
        return moves[np.lexsort((moves, -scores))[: self.settings.top]]

    def candidates(self, options: Options) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the moves to try, the best first: their options and the moves, int64 [M] each.

        First come the best moves of all options, then their second-best moves, and so on.
        """
        ranked = [
            self.ranked(options.bins.select([g]), options.items[[g]])
            for g in range(len(options.pairs))
        ]
        best = np.array([moves[0] if len(moves) else NOWHERE for moves in ranked])
        preferred = [0]
        if len(ranked) > 1:
            preferred = np.argsort(-options.values(self.weights, best), kind="stable").tolist()
        tried = [
            (g, ranked[g][n])
            for n in range(self.settings.top)
            for g in preferred
            if n < len(ranked[g])
        ][: self.settings.top]
        which, moves = zip(*tried, strict=True) if tried else ((), ())
        return np.array(which, np.int64), np.array(moves, np.int64)

    def _choose(
        self, options: Options, shown: Goods, generator: np.random.Generator, begin: int,
        first: int = 0,
    ) -> tuple[int, int]:  # fmt: skip
        """Return the best option and its move; NOWHERE if no box has a place.

        Args:
            options: the boxes and the bins.
            shown: all boxes that were shown so far.
            generator: of random numbers, for the futures.
            begin: the time at which the decision began.
            first: number of the first option in :meth:`reasons`.
        """
        which, moves = self.candidates(options)
        boxes = options.open.state.count
        room = options.open.spec.max_boxes * len(boxes) - int(boxes.sum()) - 1
        values = np.empty((0, len(moves)))
        chosen = 0
        if len(moves) > 1 and room:
            last = options.known[[len(options.known) - 1]]
            trial = _Trial(self.weights, options, which, moves)
            chosen, values = self._compare(
                trial, lambda: self.futures.draw(generator, last, shown, room), begin
            )
        count = values.shape[1]
        for g in range(len(options.pairs)):
            of_option = which[:count] == g
            self._tried[first + g] = _Tried(moves[:count][of_option], values[:, of_option])
        return (int(which[chosen]), int(moves[chosen])) if len(moves) else (0, NOWHERE)

    def _compare(
        self, trial: _Trial, draw: Callable[[], tuple[Goods, NDArray[np.int64]]], begin: int
    ) -> tuple[int, NDArray[np.float64]]:
        """Try moves in futures.

        Args:
            trial: the moves.
            draw: draws a future.
            begin: the time at which the decision began.

        Returns:
            The best move, and the volumes that were placed after each, [futures, moves]; NaN: not
            tried. With little time there are fewer moves, the first ones.
        """
        end = begin + int(self.settings.budget_ms * MILLISECOND)
        future, started = draw(), self.clock()
        value = trial.value(0, *future)
        cost = max(1, self.clock() - started)
        count = len(trial.moves)
        if self.settings.futures is None:  # as many moves as there is time for
            affordable = (end - self.clock()) // (cost * SHARE)
            count = max(2, min(count, affordable))
        values = np.empty((0, count))
        gains = trial.volumes[:count] - trial.volumes[0]  # of the boxes that are placed now
        survivors = np.arange(count)
        rounds = math.ceil(math.log2(count))
        for k in range(rounds):
            deadline = begin + (end - begin) * (k + 1) // rounds
            tries = self.settings.tries(k, rounds, len(survivors))
            played = 0
            while played < tries and self.clock() < deadline:
                row = np.full(count, np.nan)
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
            means = np.zeros(len(survivors))
            if len(values):
                means = (values + gains)[:, survivors].mean(0)
            order = np.argsort(-means, kind="stable")
            survivors = np.sort(survivors[order[: -(-len(survivors) // 2)]])
        return self._better(int(survivors[0]), values + gains), values

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
    """The bins after each move that is tried, and memory for playing futures in them.

    Args:
        weights: float64 [F], of the linear score.
        options: the boxes and the bins.
        which: int64 [M], the option of each move.
        moves: int64 [M].
    """

    def __init__(
        self, weights: NDArray[np.float64], options: Options, which: NDArray[np.int64],
        moves: NDArray[np.int64],
    ) -> None:  # fmt: skip
        self.weights, self.options, self.moves = weights, options, moves
        self.box = options.pairs[which, 0]
        items, b, count = options.known[self.box], len(options.open), len(moves)
        self.volumes = items.volumes
        # The bins after move m are b · m and the following ones.
        self.after = options.open.select(np.tile(np.arange(b), count))
        spread = np.full((count, b), NOWHERE)
        spread[np.arange(count), options.pairs[which, 1]] = moves
        self.after.place(items[np.repeat(np.arange(count), b)], spread.ravel())
        limit = options.open.spec.max_weight_kg
        self.max_weight = np.inf if limit is None else limit
        self.out = np.empty(FIRST_ROOM, np.int64)
        self._make_room(2 * self.after.state.parts.shape[1])
        self._drawn, self._goods = options.known, options.known

    def _make_room(self, parts: int) -> None:
        """Make memory for bins with so many rows of carrying parts."""
        b, spec = len(self.options.open), self.after.spec
        state = empty_state(b, spec.max_boxes, keeps_parts(self.after.limits.rule))
        more = np.zeros((b, max(parts, state.parts.shape[1]), 4), np.int32)
        self.memory = state._replace(parts=more)

    def _with_known(
        self, m: int, goods: Goods, rows: NDArray[np.int64]
    ) -> tuple[Goods, NDArray[np.int64]]:
        """Return the goods and rows of a future that begins with the other known boxes."""
        known = self.options.known
        if len(known) == 1:
            return goods, rows
        if goods is not self._drawn:
            self._drawn, self._goods = goods, joined([known, goods], goods.unit_mm)
        others = np.delete(np.arange(len(known)), self.box[m])
        return self._goods, np.concatenate((others, rows + len(known)))

    def value(self, m: int, goods: Goods, rows: NDArray[np.int64]) -> float:
        """Return the volume that is placed after move ``m`` when the known boxes and these come."""
        after = self.after
        goods, rows = self._with_known(m, goods, rows)
        kilograms, known = after.weights_of(goods)
        while True:
            volume, parts, candidates = _play_out(
                self.weights, after.limits, after.size, self.max_weight, after.state,
                m * len(self.options.open), self.memory, goods.sides, goods.orientations,
                kilograms, known, goods.stackable, goods.max_load, rows, self.options.buffer,
                self.out,
            )  # fmt: skip
            if parts:
                self._make_room(2 * parts)
            elif candidates:
                self.out = np.empty(2 * candidates, np.int64)
            else:
                return float(volume)
