"""Search with a time budget: known boxes are played as they are, only the boxes after them drawn.

1. A beam places the known boxes (:mod:`marl_pack.agents.selection.beam`). Its best ends are the
   candidates.
2. Every candidate is played on with the same drawn boxes: at each step the best placement of a
   visible box, by the critic of afterstates. After :data:`AHEAD` boxes the critic's value stands
   for the rest. A *draw* is one such future.
3. The half of the candidates with the better means gets more draws, and so on, until the time or
   the number of draws is used up (sequential halving, Karnin et al. 2013). The first placement of
   the best candidate is chosen. A mean of few draws counts little beside the critic's value
   (:data:`TRUST`).

Drawn boxes come from the distribution of the stream, never from the game's hidden boxes. Equal bins
are computed once, however they were reached.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from marl_pack import bins as bin_state
from marl_pack.agents.afterstates.limits import ILLEGAL
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.selection.beam import Beam
from marl_pack.agents.selection.beam_settings import BeamSettings
from marl_pack.agents.selection.budget_settings import BudgetSettings
from marl_pack.agents.selection.kinds import Kinds, kinds_of
from marl_pack.agents.selection.policies import SelectionPlacement, split
from marl_pack.agents.selection.touching import BestPlacements
from marl_pack.bins import Bins
from marl_pack.game.selection import SelectionPacking
from marl_pack.items import Stream

CANDIDATES = 8
"""Largest number of candidates."""
OF_EACH = 2
"""Largest number of candidates that begin with the same placement."""
AHEAD = 3
"""Number of drawn boxes that are placed in each future."""
ROWS = 64
"""Number of futures, of all candidates together, that are played at once."""
TRUST = 4.0
"""Weight of the critic's value, in draws: a mean of n draws counts n / (n + TRUST)."""
SAME = 1e-7
"""Candidates whose values differ by less are mirrored or rotated copies."""
Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class BudgetSearch:
    """A policy that searches before each placement for as long as its settings say.

    Args:
        lookahead: computes the values of afterstates.
        settings: time, draws and width.
        futures: the stream from which boxes are drawn.
        seed: the seed of the drawn boxes.
        clock: returns the time in nanoseconds.
    """

    lookahead: Lookahead
    settings: BudgetSettings
    futures: Stream
    seed: int = 0
    clock: Callable[[], int] = time.perf_counter_ns
    _kinds: dict[tuple[int, ...], Kinds] = field(default_factory=dict, repr=False)

    @torch.inference_mode()
    def __call__(self, game: SelectionPacking) -> SelectionPlacement:
        """Return option, orientation and cell of each game, int64 [G] each.

        Raises:
            ValueError: unless the games are on the CPU.
        """
        if game.device.type != "cpu":
            raise ValueError("plan: a budget or draws need the device cpu")
        number = torch.zeros(game.n, dtype=torch.int64)
        for g in game.alive.nonzero().squeeze(1).tolist():
            number[g] = self._search(game, g)
        return split(game, number)

    def _search(self, game: SelectionPacking, g: int) -> int:
        """Return the number of the best placement of game ``g``."""
        start, budget = self.clock(), self.settings.budget_ms
        deadline = math.inf if budget is None else start + 1e6 * budget
        beam = Beam(self.lookahead, BeamSettings(self.settings.width))
        ends = list(beam.ends(game, torch.tensor([g]), lambda: self.clock() > deadline))
        value = torch.cat([values for _, values in ends]).numpy()
        first = torch.cat([nodes.first for nodes, _ in ends]).numpy()
        chosen = _candidates(value, first)
        last = ends[-1][0].games
        early = len(value) - last.n  # ends in which no known box has a place come first
        placed_all = not bool((last.items().sides > 0).any())
        if len(set(first[chosen].tolist())) == 1 or not placed_all or not _more_come(game, g):
            return int(first[value.argmax()])
        goes_on = chosen >= early
        rows = (chosen[goes_on, None] - early) * game.b + np.arange(game.b)
        futures = _Futures(self, game, g, last.bins[torch.from_numpy(rows.ravel())])
        gained = np.zeros(len(chosen))
        gained[goes_on] = futures.mean_gains(value[chosen[goes_on]], start, deadline)
        return int(first[chosen[(value[chosen] + gained).argmax()]])

    def kinds(self, game: SelectionPacking) -> Kinds:
        """Return the kinds of boxes that may come."""
        key = game.spec.orientations
        if key not in self._kinds:
            self._kinds[key] = kinds_of(self.futures, game.spec, -1 - self.seed)
        return self._kinds[key]


class _Futures:
    """The drawn futures of one decision.

    Args:
        search: the search.
        game, g: the games, and the number of the one that is searched.
        bins: the bins of the candidates, [C · b].
    """

    def __init__(self, search: BudgetSearch, game: SelectionPacking, g: int, bins: Bins) -> None:
        self.search, self.k, self.b = search, game.k, game.b
        # Drawn boxes may be smaller, and more, than those of the game's own sequences.
        self.bins = bins.for_boxes(bins.boxes.shape[1] + AHEAD)
        self.kinds, self.one = search.kinds(game), game.view(torch.tensor([g * game.options]))
        self.best = BestPlacements(search.lookahead, self.kinds, self.one)
        self.last = bool(game.state.closed[g] + 1 >= game.spec.most_closings)
        self.value = search.lookahead.state_value(bins, self.one).double().numpy()
        self.value = self.value.reshape(-1, self.b)
        generator = np.random.default_rng((search.seed, int(game.state.placed[g])))
        self.shift = generator.random(game.k + AHEAD - 1)

    def mean_gains(self, value: Floats, start: float, deadline: float) -> Floats:
        """Return what each candidate gains, [C]; -inf for those that were left.

        A mean of few draws is shrunk towards 0, the critic's own estimate.

        Args:
            value: float64 [C], the values of the candidates so far.
            start, deadline: times at which the search began and has to end.
        """
        clock, draws = self.search.clock, self.search.settings.draws
        count, drawn = len(value), 0
        total, mean, left = np.zeros(count), np.zeros(count), np.arange(count)
        rounds, cost = max(1, math.ceil(math.log2(count))), 1.0
        for k in range(1, rounds + 1):
            until = deadline if k == rounds else start + (deadline - start) * k / rounds
            most = math.inf if draws is None else max(1, round(draws * count / rounds / len(left)))
            played = 0
            while played < most:
                begin = clock()
                in_time = (until - begin) / cost / len(left)
                if not drawn:  # one draw is made in any case, and shows how long a draw takes
                    in_time = max(1, in_time) if math.isinf(deadline) else 1
                n = int(min(most - played, max(1, ROWS // len(left)), in_time))
                if n < 1:
                    break
                total[left] += self._play(left, drawn, n).sum(1)
                played, drawn = played + n, drawn + n
                cost = max(1.0, clock() - begin) / (n * len(left))
            mean[left] = total[left] / (drawn + TRUST)
            if k < rounds:
                order = np.argsort(-(value + mean)[left], kind="stable")
                dropped = left[order[-(-len(left) // 2) :]]
                left = left[order[: -(-len(left) // 2)]]
                mean[dropped] = -math.inf
        return mean

    def boxes(self, first: int, n: int) -> Numbers:
        """Draw the boxes of futures ``first`` … ``first + n - 1``, kinds [n, k + AHEAD - 1].

        The points are those of an additive recurrence (Roberts 2018), which fill the space evenly.
        """
        size = len(self.shift)
        ratio = 2.0
        for _ in range(30):  # the root of x^(size + 1) = x + 1
            ratio = (1 + ratio) ** (1 / (size + 1))
        steps = ratio ** -np.arange(1.0, size + 1)
        points = (self.shift + np.arange(first + 1, first + n + 1)[:, None] * steps) % 1
        return self.kinds.at(points)

    def _play(self, candidates: Numbers, first: int, n: int) -> Floats:
        """Play candidates on in ``n`` futures; return their gains, [C, n]."""
        boxes = np.tile(self.boxes(first, n), (len(candidates), 1))  # [R, k + AHEAD - 1]
        candidate = candidates.repeat(n)
        rows = (candidate[:, None] * self.b + np.arange(self.b)).ravel()
        bins, value = self.bins[torch.from_numpy(rows)], self.value[candidate]  # [R · b], [R, b]
        slots, gained = boxes[:, : self.k].copy(), np.zeros(len(boxes))
        shape = len(boxes), self.k, self.b
        returns, pairs = np.zeros(shape), np.zeros(shape, np.int64)
        stale, alive = np.ones(shape, np.bool_), np.ones(len(boxes), np.bool_)
        for step in range(AHEAD):
            r, slot, j = (stale & alive[:, None, None]).nonzero()
            of_rows = bins[torch.from_numpy(r * self.b + j)]
            returns[r, slot, j], pairs[r, slot, j] = self.best.find(of_rows, slots[r, slot])
            stale[:] = False
            gains = np.where(returns > ILLEGAL / 2, returns - value[:, None], ILLEGAL)
            gains = gains.reshape(len(boxes), -1)
            choice, most = gains.argmax(1), gains.max(1)
            stuck = alive & (most < ILLEGAL / 2)
            if stuck.any():
                gained[stuck] -= self._lost(bins, value)[stuck]
                alive &= ~stuck
            r = alive.nonzero()[0]
            if not len(r):
                break
            slot, j = choice[r] // self.b, choice[r] % self.b
            gained[r] += most[r]
            if step + 1 < AHEAD:
                reward = self._place(bins, r * self.b + j, slots[r, slot], pairs[r, slot, j])
                value[r, j] = returns[r, slot, j] - reward
                slots[r, slot] = boxes[r, self.k + step]
                stale[r, slot] = True
                stale[r, :, j] = True
        return gained.reshape(len(candidates), n)

    def _lost(self, bins: Bins, value: Floats) -> Floats:
        """Return what was expected of the bin that is closed, at the last closing of all, [R]."""
        if self.last:
            return value.sum(1)
        fullest = bins.filled.numpy().reshape(value.shape).argmax(1)
        return value[np.arange(len(value)), fullest]

    def _place(self, bins: Bins, rows: Numbers, kinds: Numbers, pairs: Numbers) -> Floats:
        """Place boxes in some of the bins, which change; return the rewards [N] as in the gains."""
        index, game = torch.from_numpy(rows), self.one
        items = self.kinds.items[torch.from_numpy(kinds)]
        orientation, cell = game.floor.split(torch.from_numpy(pairs))
        sides = game.orient_item(items).sides[torch.arange(len(rows)), orientation]
        after = bins[index]
        labels = torch.full_like(index, bin_state.UNKNOWN), orientation
        corners = torch.stack(game.floor.corner(cell), 1)
        _, waste, volume = bin_state.place(
            after, sides, corners, items.weights, None, labels, 1.0, False
        )
        for old, new in zip(bins.tensors(), after.tensors(), strict=True):
            old[index] = new
        spec = game.spec
        reward = (spec.alpha * volume.double() - spec.beta * waste.double()) / game.volume
        share: Floats = reward.numpy() * self.search.lookahead.value_share
        return share


def _more_come(game: SelectionPacking, g: int) -> bool:
    """Return whether boxes may come after the known ones: no slot or preview is empty."""
    visible = game.items(torch.arange(game.options) + g * game.options).present
    first = g * game.preview
    return bool(visible.all() and game.previews()[first : first + game.preview].present.all())


def _candidates(value: Floats, first: Numbers) -> Numbers:
    """Return the best ends, without copies and few for each first placement, int64 [C]."""
    chosen: list[int] = []
    for n in np.argsort(-value, kind="stable").tolist():
        same = sum(first[c] == first[n] for c in chosen)
        copy = bool(chosen) and value[chosen[-1]] - value[n] < SAME
        if same < OF_EACH and not copy:
            chosen.append(n)
        if len(chosen) == CANDIDATES:
            break
    return np.array(chosen)
