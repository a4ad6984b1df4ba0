"""Beam search over the boxes that are known: the buffer and the preview.

1. A node is a copy of a game to which the conveyor brings only known boxes. At each depth every
   node tries all its placements. The best ones by return so far plus the critic's value of the
   afterstate are carried out.
2. Nodes that reach the same state in another order are merged.
3. A node ends when the known boxes are placed, or none of them has a place. If its slots are full
   then, a bin is closed, and nothing more is expected of this bin.
4. The search takes the first placement of the best node. Nothing beyond the known boxes is drawn or
   looked up: the critic stands for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from marl_pack.agents.afterstates.gains import gains
from marl_pack.agents.afterstates.limits import ILLEGAL
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.selection.beam_settings import BeamSettings
from marl_pack.agents.selection.policies import SelectionPlacement, split
from marl_pack.game.selection import SelectionPacking

TIE = 1e-12
"""Difference between the gains of equal placements, one number after the other."""
GAMES_AT_ONCE = 64
"""Games that are searched together."""


@dataclass
class Nodes:
    """The nodes of a beam."""

    games: SelectionPacking  # N games
    root: Tensor  # int64 [N]     number of the real game
    gain: Tensor  # float64 [N]   return since the root, plus the change of the values of the bins
    first: Tensor  # int64 [N]    number of the first placement; -1 at the root

    def select(self, which: Tensor) -> Nodes:
        """Return some of the nodes, int64 [K]."""
        return Nodes(
            self.games.branch(which), self.root[which], self.gain[which], self.first[which]
        )


@dataclass(frozen=True)
class Beam:
    """A policy that searches among the known boxes before each placement.

    Args:
        lookahead: computes the values of afterstates.
        settings: width and depth of the search.
    """

    lookahead: Lookahead
    settings: BeamSettings

    @torch.inference_mode()
    def __call__(self, game: SelectionPacking) -> SelectionPlacement:
        """Return option, orientation and cell of each game, int64 [G] each."""
        number = torch.zeros(game.n, dtype=torch.int64, device=game.device)
        for part in torch.split(game.alive.nonzero().squeeze(1), GAMES_AT_ONCE):
            number[part] = self._search(game, part)
        return split(game, number)

    def _search(self, game: SelectionPacking, games: Tensor) -> Tensor:
        """Return the number of the best placement of some games, int64 [K]."""
        best = np.full(len(games), -np.inf)
        choice = np.zeros(len(games), np.int64)
        for ends, values in self.ends(game, games):
            roots, firsts = ends.root.tolist(), ends.first.tolist()
            for v, root, first in zip(values.tolist(), roots, firsts, strict=True):
                if v > best[root]:
                    best[root], choice[root] = v, first
        return torch.from_numpy(choice).to(game.device)

    def ends(
        self, game: SelectionPacking, games: Tensor, late: Callable[[], bool] = lambda: False
    ) -> Iterator[tuple[Nodes, Tensor]]:
        """Search, and yield the nodes that end at each depth, with their values float64 [N].

        Args:
            game: the games.
            games: int64 [K], numbers of the games to search in.
            late: whether to end at this depth; asked before each depth but the first.
        """
        count, depth = len(games), self.settings.depth_in(game)
        nodes = Nodes(
            game.branch(games, only_known=True), torch.arange(count, device=game.device),
            torch.zeros(count, dtype=torch.float64, device=game.device),
            torch.full((count,), -1, device=game.device),
        )  # fmt: skip
        for level in range(depth):
            nodes = self._expand(nodes)
            last = level + 1 == depth or late()
            finished = nodes.games.state.ended | last
            ends = nodes.select(finished.nonzero().squeeze(1))
            yield ends, self._final(ends)
            nodes = nodes.select((~finished).nonzero().squeeze(1))
            if not len(nodes.root):
                break

    def _expand(self, nodes: Nodes) -> Nodes:
        """Carry out the best placements of the nodes of each root, and merge equal states."""
        width = self.settings.width
        gain = gains(nodes.games, self.lookahead).flatten(1).double()
        # Of equal placements the first one counts, on every machine.
        gain -= TIE * torch.arange(gain.shape[1], device=gain.device)
        scores, numbers = gain.topk(min(2 * width, gain.shape[1]), 1)
        node, rank = (scores > ILLEGAL / 2).nonzero().unbind(1)
        number, score = numbers[node, rank], nodes.gain[node] + scores[node, rank]
        kept = best_of_each(score, nodes.root[node], 2 * width)
        node, number, score = node[kept], number[kept], score[kept]
        games = nodes.games.branch(node)
        games.place(*split(games, number), check=False)
        first = torch.where(nodes.first[node] < 0, number, nodes.first[node])
        after = Nodes(games, nodes.root[node], score, first)
        return after.select(distinct(after.games, after.root, width))

    def _final(self, nodes: Nodes) -> Tensor:
        """Return the value of nodes that end, float64 [N].

        A node whose slots are full, and that has no place left, closes its fullest bin, so what was
        expected of this bin does not count. At the last closing that holds for all bins.
        """
        games, state = nodes.games, nodes.games.state
        over = state.ended & (state.slots >= 0).all(1)
        value = nodes.gain.clone()
        if bool(over.any()):
            expected = self.lookahead.state_value(games.bins, games.view()).double()
            expected = expected.view(len(over), -1)
            fullest = state.bins.filled.view(len(over), -1).argmax(1, keepdim=True)
            last = state.closed + 1 >= games.spec.most_closings
            lost = torch.where(last, expected.sum(1), expected.gather(1, fullest).squeeze(1))
            value -= torch.where(over, lost, 0.0)
        return value


def best_of_each(score: Tensor, root: Tensor, most: int) -> Tensor:
    """Return the numbers of the ``most`` highest scores of each root, the best first, int64 [K].

    Args:
        score: float64 [N].
        root: int64 [N].
        most: largest number for each root.
    """
    order = torch.argsort(score, descending=True, stable=True)
    order = order[torch.argsort(root[order], stable=True)]
    sorted_roots = root[order]
    begin = torch.searchsorted(sorted_roots, sorted_roots)
    rank = torch.arange(len(order), device=order.device) - begin
    return order[rank < most]


def distinct(games: SelectionPacking, root: Tensor, most: int) -> Tensor:
    """Return the first ``most`` different states of each root, int64 [K].

    States are equal if their bins have the same maps and the same boxes are still in the slots.

    Args:
        games: N games, the best of each root first.
        root: int64 [N].
        most: largest number for each root.
    """

    def rows(values: Tensor) -> NDArray[np.int64]:
        return values.cpu().numpy().reshape(len(root), -1).astype(np.int64)

    state = games.state
    slots = state.slots.sort(1).values
    parts = [rows(root), rows(state.bins.heightmap), rows(state.bins.empty_map), rows(slots)]
    seen: set[bytes] = set()
    counts: dict[int, int] = {}
    kept = []
    for n, row in enumerate(np.hstack(parts)):
        key = row.tobytes()
        of_root = int(row[0])
        if key in seen or counts.get(of_root, 0) >= most:
            continue
        seen.add(key)
        counts[of_root] = counts.get(of_root, 0) + 1
        kept.append(n)
    return torch.tensor(kept, dtype=torch.int64, device=root.device)
