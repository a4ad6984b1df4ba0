"""Bins in whole units of length: what may be placed where, and placing it.

:class:`ExactBins` holds B bins of the same size and rule. Their state is the table of boxes; it is
copied by :meth:`ExactBins.select`. :class:`ListedMoves` holds the placements that a rule allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_pack.exact import balance, choice
from marl_pack.exact.features import FEATURES
from marl_pack.exact.goods import AXES, Goods
from marl_pack.exact.limits import EQUILIBRIUM, ROW, Limits
from marl_pack.exact.moves import BITS, MASK, decode, list_moves, moves_at
from marl_pack.exact.present import Present
from marl_pack.exact.rules import NO, OPEN, YES
from marl_pack.exact.spec import ExactSpec
from marl_pack.exact.state import ROUNDING, State, add_box, blocked_boxes, empty_state, keeps_parts
from marl_pack.installation import njit
from marl_pack.plan import Plan
from marl_pack.sapien_check.stack import DENSITY

NOWHERE = -1
"""Stands for the move of an item that has no place."""
FIRST_ROOM = 4096
"""Number of candidates that there is memory for at first."""


@dataclass(frozen=True)
class ListedMoves:
    """The placements of one item in each of B bins, one bin after the other.

    Within a bin they are in the order of z, x, y, orientation.
    """

    numbers: NDArray[np.int64]  # [M]     the moves (marl_pack.exact.moves.encode)
    starts: NDArray[np.int64]  # [B + 1]  first move of each bin

    @property
    def counts(self) -> NDArray[np.int64]:
        """Number of moves in each bin, int64 [B]."""
        return np.diff(self.starts)

    def of(self, b: int) -> NDArray[np.int64]:
        """Return the moves of bin ``b``, int64 [M_b]."""
        return self.numbers[self.starts[b] : self.starts[b + 1]]


def placements(numbers: ArrayLike) -> NDArray[np.int64]:
    """Return moves as rows: orientation and low corner x, y, z in units, int64 [..., 4]."""
    n = np.asarray(numbers, np.int64)
    return np.stack((n & 7, (n >> (3 + BITS)) & MASK, (n >> 3) & MASK, n >> (3 + 2 * BITS)), -1)


@njit(cache=True, nogil=True)
def _list_all(
    limits: Limits, size: Any, state: State, items: Any, allowed: Any, weights: Any, known: Any,
    chosen: Any, starts: Any, out: Any, verdicts: Any, first: int,
) -> tuple[int, int]:  # fmt: skip
    """List the moves of all bins from bin ``first`` on, as long as there is room.

    Returns:
        The bin at which the room ended (B at the end), and the room that its candidates need.
    """
    blocked = np.zeros(state.boxes.shape[1], np.bool_)
    for b in range(first, chosen.size):
        total = 0
        if chosen[b]:
            blocked_boxes(state, b, weights[b], known[b], blocked)
            total = list_moves(
                limits, size, state.boxes[b], state.count[b], state.starts[b], state.parts[b],
                blocked, items[b], allowed[b], out[starts[b] :], verdicts[starts[b] :],
            )  # fmt: skip
        if total < 0:
            return b, starts[b] - total
        starts[b + 1] = starts[b] + total
    return chosen.size, 0


@njit(cache=True, nogil=True)
def _best_all(
    kind: int, score_weights: Any, limits: Limits, size: Any, state: State, items: Any,
    allowed: Any, weights: Any, known: Any, chosen: Any, out: Any, best: Any, first: int,
) -> tuple[int, int]:  # fmt: skip
    """Choose the best move in each bin from bin ``first`` on; returns as :func:`_list_all`."""
    blocked = np.zeros(state.boxes.shape[1], np.bool_)
    for b in range(first, chosen.size):
        best[b] = -1
        if chosen[b]:
            blocked_boxes(state, b, weights[b], known[b], blocked)
            needed, best[b] = choice.best_move(
                kind, score_weights, limits, size, state.boxes[b], state.count[b], state.starts[b],
                state.parts[b], blocked, items[b], allowed[b], out,
            )  # fmt: skip
            if needed < 0:
                return b, -needed
    return chosen.size, 0


@njit(cache=True, nogil=True)
def _place_all(
    limits: Limits, state: State, rows: Any, weights: Any, known: Any, stackable: Any,
    max_load: Any, chosen: Any, first: int,
) -> tuple[int, int]:  # fmt: skip
    """Place a box in each chosen bin; return B, or the bin that needs more rows, and the rows."""
    for b in range(first, chosen.size):
        if chosen[b]:
            needed = add_box(
                limits, state, b, rows[b], weights[b], known[b], stackable[b], max_load[b]
            )  # fmt: skip
            if needed > 0:
                return b, needed
    return chosen.size, 0


@njit(cache=True, nogil=True)
def _check_all(
    limits: Limits, size: Any, state: State, items: Any, allowed: Any, weights: Any, known: Any,
    moves: Any,
) -> Any:  # fmt: skip
    """Return the verdict on the move in each bin, uint8 [B]; YES for NOWHERE."""
    blocked = np.zeros(state.boxes.shape[1], np.bool_)
    verdicts = np.full(moves.size, YES, np.uint8)
    corner, out, answer = np.empty((1, 2), np.int64), np.empty(6, np.int64), np.empty(6, np.uint8)
    for b in range(moves.size):
        if moves[b] < 0:
            continue
        blocked_boxes(state, b, weights[b], known[b], blocked)
        _, corner[0, 0], corner[0, 1], _ = decode(moves[b])
        total = moves_at(
            limits, size, state.boxes[b], state.count[b], state.starts[b], state.parts[b], blocked,
            items[b], allowed[b], corner, out, answer,
        )  # fmt: skip
        verdicts[b] = NO
        for m in range(total):
            if out[m] == moves[b]:
                verdicts[b] = answer[m]
    return verdicts


@njit(cache=True, nogil=True)
def _waste_all(state: State, items: Any, moves: Any) -> Any:
    """Return the space that a placement encloses in each bin, float64 [B]; 0 for NOWHERE."""
    waste = np.zeros(moves.size)
    for b in range(moves.size):
        if moves[b] >= 0:
            waste[b] = choice.waste_of(state.boxes[b], state.count[b], items[b], moves[b])
    return waste


class ExactBins:
    """B bins in whole units of length, with the boxes that are in them.

    Attributes:
        spec: the options of the game.
        limits: those that compiled code reads.
        size: int64 [3], W, D, H in units.
        state: the arrays of the bins (:class:`marl_pack.exact.state.State`).

    Args:
        n: number of bins B.
        spec: options of the game.
        present: boxes that are in every bin at first
            (:func:`marl_pack.exact.present.check_present`).
    """

    def __init__(self, n: int, spec: ExactSpec, present: Present | None = None) -> None:
        self.spec, self.limits = spec, spec.limits()
        self.size = np.array(spec.size, np.int64)
        self.state = empty_state(1, spec.max_boxes, keeps_parts(self.limits.rule))
        if present is not None:
            for k in range(len(present.rows)):
                self.add(present.rows[[k]], present.goods[[k]], np.ones(1, np.bool_))
        self._first = self.state
        self.state = self.state.at(np.zeros(n, np.int64))

    def __len__(self) -> int:
        return len(self.state.count)

    @property
    def volume(self) -> float:
        """Volume of a bin in cubic units."""
        return float(self.size.astype(np.float64).prod())

    @property
    def utilization(self) -> NDArray[np.float64]:
        """Share of each bin's volume that is filled, float64 [B]."""
        sides = self.state.boxes[:, :, 3:6].astype(np.float64)  # zeros beyond the last box
        return np.asarray(sides.prod(2).sum(1) / self.volume)

    @property
    def weight(self) -> NDArray[np.float64]:
        """Known weights in each bin in kilograms, float64 [B]."""
        return np.where(self.state.known, self.state.weights, 0.0).sum(1)

    def select(self, index: Any) -> ExactBins:
        """Return copies of the bins ``index``: whole numbers, a slice or bool [B]."""
        index = np.atleast_1d(np.arange(len(self))[index])
        other = object.__new__(ExactBins)
        other.spec, other.limits, other.size = self.spec, self.limits, self.size
        other._first, other.state = self._first, self.state.at(index)
        return other

    def clear(self, chosen: NDArray[np.bool_]) -> None:
        """Take all boxes out of the chosen bins, bool [B], except those there at first."""
        for name, array in self.state._asdict().items():
            first = getattr(self._first, name)[0]
            if name == "parts":
                array[chosen, : len(first)] = first  # the bins may have got more rows
            else:
                array[chosen] = first

    def moves(self, items: Goods, chosen: NDArray[np.bool_] | None = None) -> ListedMoves:
        """List where an item may be placed in each bin.

        Args:
            items: one row for each bin.
            chosen: bool [B], the bins to list moves for; by default all.
        """
        weights, known = self._check(items)
        chosen = self._open(weights, known, chosen)
        starts = np.zeros(len(self) + 1, np.int64)
        room = FIRST_ROOM * max(1, len(self) // 16)
        out, verdicts, first = np.empty(room, np.int64), np.empty(room, np.uint8), 0
        while True:
            first, needed = _list_all(
                self.limits, self.size, self.state, items.sides, items.orientations, weights, known,
                chosen, starts, out, verdicts, first,
            )  # fmt: skip
            if not needed:
                break
            bigger = max(needed, 2 * len(out))
            out, verdicts = np.resize(out, bigger), np.resize(verdicts, bigger)
        listed = ListedMoves(out[: starts[-1]].copy(), starts)
        unsure = np.flatnonzero(verdicts[: starts[-1]] == OPEN)
        if len(unsure):
            listed = self._settle(listed, unsure, items, weights)
        listed.numbers.setflags(write=False)
        return listed

    def moves_at(self, b: int, items: Goods, corners: NDArray[np.int64]) -> NDArray[np.int64]:
        """List where an item may be placed in bin ``b`` at given corners, int64 [M].

        Args:
            b: number of the bin.
            items: one row for each bin.
            corners: int64 [K, 2], low corners x, y in units.
        """
        weights, known = self._check(items)
        if not self._open(weights, known, np.arange(len(self)) == b)[b]:
            return np.empty(0, np.int64)
        state, n = self.state, self.state.count[b]
        blocked = self.blocked(b, items[[b]])
        out, verdicts = np.empty(6 * len(corners), np.int64), np.empty(6 * len(corners), np.uint8)
        total = moves_at(
            self.limits, self.size, state.boxes[b], n, state.starts[b], state.parts[b], blocked,
            items.sides[b], items.orientations[b], corners, out, verdicts,
        )  # fmt: skip
        return np.array([
            move
            for move, verdict in zip(out[:total].tolist(), verdicts[:total].tolist(), strict=True)
            if verdict == YES or balance.in_balance(
                self.limits, state, b, items.sides[b], float(weights[b]), move
            )
        ], np.int64)  # fmt: skip

    def legal(self, items: Goods, moves: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return in which bins an item may be placed by a move, bool [B]; true for NOWHERE.

        Args:
            items: one row for each bin.
            moves: int64 [B].
        """
        weights, known = self._check(items)
        chosen = moves >= 0
        verdicts = _check_all(
            self.limits, self.size, self.state, items.sides, items.orientations, weights, known,
            moves,
        )  # fmt: skip
        legal = (verdicts != NO) & (self._open(weights, known, chosen) | ~chosen)
        for b in np.flatnonzero(verdicts == OPEN).tolist():
            legal[b] &= balance.in_balance(
                self.limits, self.state, b, items.sides[b], float(weights[b]), int(moves[b])
            )
        return legal

    def _settle(
        self, listed: ListedMoves, unsure: NDArray[np.intp], items: Goods, weights: Any
    ) -> ListedMoves:
        """Return the moves without those that the linear program of ``equilibrium`` refuses."""
        stands = np.ones(len(listed.numbers), np.bool_)
        bins = np.repeat(np.arange(len(self)), listed.counts)
        for m in unsure.tolist():
            b, move = int(bins[m]), int(listed.numbers[m])
            stands[m] = balance.in_balance(
                self.limits, self.state, b, items.sides[b], float(weights[b]), move
            )
        total = np.concatenate(([0], stands.cumsum()))
        return ListedMoves(listed.numbers[stands], total[listed.starts])

    def best(
        self,
        items: Goods,
        kind: int,
        score_weights: NDArray[np.float64],
        chosen: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.int64]:
        """Choose the best move of an item in each bin.

        Args:
            items: one row for each bin.
            kind: a score of :mod:`marl_pack.exact.choice`.
            score_weights: float64 [F], weights of the features, for the score LINEAR.
            chosen: bool [B], the bins to choose for; by default all.

        Returns:
            The moves, int64 [B]; NOWHERE where an item has no place.
        """
        weights, known = self._check(items)
        chosen = self._open(weights, known, chosen)
        if self.limits.rule == EQUILIBRIUM:
            return self._best_listed(items, kind, score_weights, chosen)
        best = np.empty(len(self), np.int64)
        out, first = np.empty(FIRST_ROOM, np.int64), 0
        while True:
            first, needed = _best_all(
                kind, score_weights, self.limits, self.size, self.state, items.sides,
                items.orientations, weights, known, chosen, out, best, first,
            )  # fmt: skip
            if not needed:
                return best
            out = np.empty(max(needed, 2 * len(out)), np.int64)

    def _best_listed(
        self, items: Goods, kind: int, score_weights: NDArray[np.float64], chosen: Any
    ) -> NDArray[np.int64]:
        """Choose the best of the listed moves of each bin."""
        listed = self.moves(items, chosen)
        return np.array([
            choice.best_of(
                kind, score_weights, self.limits, self.size, self.state.boxes[b],
                int(self.state.count[b]), items.sides[b], listed.of(b),
            )
            for b in range(len(self))
        ], np.int64)  # fmt: skip

    def _open(
        self, weights: Any, known: Any, chosen: NDArray[np.bool_] | None
    ) -> NDArray[np.bool_]:
        """Return the chosen bins that may bear the weight of one more item, bool [B]."""
        chosen = np.ones(len(self), np.bool_) if chosen is None else chosen
        self._refuse_full(chosen)
        if self.spec.max_weight_kg is None:
            return chosen
        placed = np.arange(self.spec.max_boxes) < self.state.count[:, None]
        unknown = (~self.state.known & placed).any(1)
        heavy = self.weight + weights > self.spec.max_weight_kg * (1 + ROUNDING)
        return chosen & known & ~heavy & ~unknown

    def any_move(self, items: Goods, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return in which of the chosen bins an item has a move, bool [B].

        Args:
            items: one row for each bin.
            chosen: bool [B].
        """
        return self.best(items, choice.ANY, np.zeros(len(FEATURES)), chosen) >= 0

    def features(
        self, b: int, item: NDArray[np.int64], moves: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Describe moves of an item in bin ``b`` (:mod:`marl_pack.exact.features`).

        Args:
            b: number of the bin.
            item: int64 [3], the item's own sides.
            moves: int64 [M].

        Returns:
            Float64 [M, F].
        """
        state = self.state
        return choice.describe_all(
            self.limits, self.size, state.boxes[b], state.count[b], item, moves
        )

    def waste(self, items: Goods, moves: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the space that each placement newly encloses, float64 [B], in cubic units.

        Args:
            items: one row for each bin.
            moves: int64 [B]; NOWHERE: no placement, no waste.
        """
        self._check(items)  # checks the items
        return _waste_all(self.state, items.sides, moves)

    def weights_of(self, goods: Goods) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the weights of goods, assumed where they are unknown, and which are known.

        Unknown weights are those of boxes of :data:`marl_pack.sapien_check.stack.DENSITY`.
        """
        known = ~np.isnan(goods.weights)
        metre = self.spec.unit_mm / 1000
        return np.where(known, goods.weights, goods.volumes * metre**3 * DENSITY), known

    def _check(self, items: Goods) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the items' weights (:meth:`weights_of`).

        Raises:
            ValueError: unless there is an item in the unit of the game for each bin.
        """
        if len(items) != len(self) or items.unit_mm != self.spec.unit_mm:
            raise ValueError(
                f"items: {len(items)} in units of {items.unit_mm:g} mm; needs one for each of "
                f"{len(self)} bins, in units of {self.spec.unit_mm:g} mm"
            )
        return self.weights_of(items)

    def place(self, items: Goods, moves: NDArray[np.int64]) -> None:
        """Place an item in each bin where its move is not NOWHERE.

        The moves have to be moves that :meth:`moves` or :meth:`best` returned for these items, or
        that :meth:`legal` allows. They are not checked.

        Args:
            items: one row for each bin.
            moves: int64 [B].

        Raises:
            ValueError: if a bin already holds ``max_boxes`` boxes.
        """
        self._check(items)  # checks the items
        chosen = moves >= 0
        where = placements(np.maximum(moves, 0))
        sides = np.take_along_axis(items.sides, AXES[where[:, 0]], 1)
        self.add(np.hstack((where[:, 1:], sides)), items, chosen)

    def add(self, rows: NDArray[np.int64], items: Goods, chosen: NDArray[np.bool_]) -> None:
        """Add a box to each chosen bin at a row that is not checked.

        Args:
            rows: int64 [B, 6], x, y, z, w, d, h; or [B, 10], rows of the state.
            items: one row for each bin.
            chosen: bool [B].
        """
        self._refuse_full(chosen)
        if rows.shape[1] < ROW:  # the whole top carries
            rows = np.hstack((rows, rows[:, :2], rows[:, :2] + rows[:, 3:5]))
        weights, known = self._check(items)
        first = 0
        while True:
            first, needed = _place_all(
                self.limits, self.state, rows, weights, known, items.stackable, items.max_load,
                chosen, first,
            )  # fmt: skip
            if not needed:
                return
            parts = self.state.parts
            more = np.zeros((len(self), max(needed, 2 * parts.shape[1]), 4), np.int32)
            more[:, : parts.shape[1]] = parts
            self.state = self.state._replace(parts=more)

    def blocked(self, b: int, item: Goods) -> NDArray[np.bool_]:
        """Return on which boxes of bin ``b`` an item, one row, may not rest, bool [C].

        The reasons are the limits of goods: a box is not stackable, or would carry too much.
        """
        weights, known = self.weights_of(item)
        blocked = np.zeros(self.spec.max_boxes, np.bool_)
        blocked_boxes(self.state, b, weights[0], known[0], blocked)
        return blocked

    def _refuse_full(self, chosen: NDArray[np.bool_]) -> None:
        """Raise ValueError if a chosen bin has no memory for one more box."""
        full = chosen & (self.state.count >= self.spec.max_boxes)
        if full.any():
            raise ValueError(
                f"bin {int(full.argmax())} already holds {self.spec.max_boxes} boxes; "
                "needs a larger max_boxes"
            )

    def boxes(self, b: int) -> NDArray[np.int64]:
        """Return the boxes of bin ``b`` in units, int64 [count, 6], rows x, y, z, w, d, h."""
        return self.state.boxes[b, : self.state.count[b], :6].astype(np.int64)

    def plan(
        self,
        b: int,
        ids: Sequence[str] | None = None,
        orientations: ArrayLike | None = None,
    ) -> Plan:
        """Return the plan of bin ``b``, in whole units of ``spec.unit_mm`` (``Plan.boxes_mm``).

        Args:
            b: number of the bin.
            ids: id of each box.
            orientations: orientation of each box.
        """
        boxes, size, unit = self.boxes(b), self.size, self.spec.unit_mm
        weights = self.state.weights[b, : len(boxes)]
        loads = np.column_stack((weights, boxes[:, :2] + boxes[:, 3:5] / 2))
        return Plan.of_boxes(
            size.tolist(), boxes, loads, ids=ids, orientations=orientations, unit_mm=unit
        )  # fmt: skip
