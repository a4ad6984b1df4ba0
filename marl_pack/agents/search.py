"""Search at decision time: try the agents' best pairs (orientation, cell) in imagined futures.

1. The learned agents propose M legal pairs (``SearchSettings.top``): those with the highest joint
   probability π_o(o) · π_p(cell | o). Orientations that give the same box count as one.
2. Each pair is placed in imagined games, which the same agents then play without search. The future
   items are drawn from the known distribution of the items; all pairs get the same future items.
   All M pairs are tried in few futures, then the better half in more futures, and so on.
3. The search takes the pair after which the bin is fullest on average.

An imagined game is an ordinary game with the same masks, so only legal placements are tried.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from marl_pack.agents.learned import LearnedAgent
from marl_pack.agents.networks.actor_critic import Critic
from marl_pack.agents.policy import Placement, Reasons
from marl_pack.agents.search_settings import SearchSettings
from marl_pack.game.moves import Moves
from marl_pack.game.packing import Packing
from marl_pack.geometry import ORIENTATIONS, oriented
from marl_pack.items import Stream

AT_ONCE = 1 << 19
"""Size of a batch of imagined games: approximate number of cells on all their floors together."""


class Planner:
    """A policy that searches with two learned agents.

    Args:
        orientation_agent, placement_agent: the agents, which share one
            :class:`~marl_pack.agents.afterstates.lookahead.Lookahead`. If they are symmetric
            (:class:`LearnedAgent`), they average over the symmetries of the bin to propose pairs,
            but not in the imagined games.
        critic: the orientation agent's critic; needed if the settings have a ``depth``.
        settings: the settings of the search.
        futures: the stream from which future items are drawn at each decision, such as
            ``make_stream("rs", …)``.
        seed: the seed of the futures.
    """

    def __init__(
        self,
        orientation_agent: LearnedAgent,
        placement_agent: LearnedAgent,
        critic: Critic | None,
        settings: SearchSettings,
        futures: Stream,
        seed: int = 0,
    ) -> None:
        if settings.depth is not None and critic is None:
            raise ValueError("plan: a depth needs the orientation agent's critic")
        self.orientation_agent, self.placement_agent = orientation_agent, placement_agent
        self.critic, self.settings, self.futures = critic, settings, futures
        self.seed = -1 - seed  # real games have seeds ≥ 0: the futures differ from them
        # Of each round of the last call: games, their pairs, which are legal, their means, and
        # the number of futures behind these.
        self._tried: list[tuple[Tensor, Tensor, Tensor, Tensor, int]] = []

    @torch.inference_mode()
    def __call__(self, game: Packing, moves: Moves | None = None) -> Placement:
        """Return the best pair of every game, by sequential halving (Karnin et al. 2013).

        Each round plays about the same number of imagined games. The better half of the pairs goes
        to the next round, until one pair is left.

        Args:
            game: the games.
            moves: the legal pairs to choose among; all legal pairs by default.
        """
        self._tried = []
        best = torch.zeros(game.n, dtype=torch.int64, device=game.device)
        index = game.alive.nonzero().squeeze(1)  # [B]
        pairs, legal = self._propose(game, index, moves or game.moves)  # [B, M]
        total, played = torch.zeros(pairs.shape, dtype=torch.float64, device=game.device), 0
        rounds = max(1, math.ceil(math.log2(self.settings.top)))
        for rounds_left in range(rounds, 0, -1):
            best[index] = pairs[:, 0]
            several = legal.sum(1) > 1
            index, pairs, legal, total = (x[several] for x in (index, pairs, legal, total))
            if not len(index):
                break
            budget = self.settings.top * self.settings.rollouts
            k = max(1, budget // (rounds * pairs.shape[1]))
            total[legal] += self._sum(game, index, pairs, legal, played, k)
            played += k
            self._tried.append((index, pairs, legal, total / played, played))
            remaining = 1 if rounds_left == 1 else -(-pairs.shape[1] // 2)
            better = total.masked_fill(~legal, -torch.inf).topk(remaining, 1).indices
            pairs, legal, total = (x.gather(1, better) for x in (pairs, legal, total))
        best[index] = pairs[:, 0]
        return game.floor.split(best)

    def reasons(self, game: Packing, orientation: Tensor) -> Reasons:
        """Return what the agents, and the last call, computed.

        The values are the mean results of the pairs that the last call tried
        (:class:`marl_pack.agents.policy.Explained`).
        """
        values = torch.full(game.mask.shape, torch.nan, dtype=torch.float64, device=game.device)
        tries = torch.zeros(game.mask.shape, dtype=torch.int64, device=game.device)
        for index, pairs, legal, means, played in self._tried:
            row, rank = legal.nonzero().unbind(1)
            values.view(game.n, -1)[index[row], pairs[row, rank]] = means[row, rank]
            tries.view(game.n, -1)[index[row], pairs[row, rank]] = played
        return Reasons(
            self.orientation_agent.chances(game),
            self.placement_agent.chances(game, orientation),
            values, "mean result of imagined games", tries,
        )  # fmt: skip

    def _sum(
        self, game: Packing, index: Tensor, pairs: Tensor, legal: Tensor, first: int, k: int
    ) -> Tensor:
        """Sum the results of each legal pair over futures ``first`` … ``first + k - 1``.

        Args:
            game: the games.
            index: int64 [B], the indices of the games in which to search.
            pairs: int64 [B, M], the proposed pairs, each as one number (``game.floor.split``).
            legal: bool [B, M], whether each pair is legal; L of them are.
            first: number of the first future.
            k: number of futures.

        Returns:
            Float64 [L].
        """
        row, rank = legal.nonzero().unbind(1)
        at_once = max(1, AT_ONCE // game.floor.cells)
        numbers = self._futures(game, index, first, k)[row].flatten()  # [L · k]
        each = row.repeat_interleave(k), rank.repeat_interleave(k), numbers
        values = [
            self._imagine(game.branch(index[r], self.futures, self.seed, f), pairs[r, m])
            for r, m, f in zip(*(torch.split(x, at_once) for x in each), strict=True)
        ]
        return torch.cat(values).view(-1, k).sum(1)

    def _futures(self, game: Packing, index: Tensor, first: int, k: int) -> Tensor:
        """Return the ids of futures ``first`` … ``first + k - 1`` of each game, int64 [B, k]."""
        decision = game.episode[index] * game.bins.boxes.shape[1] + game.t[index]
        numbers = decision * self.settings.top * self.settings.rollouts + first
        return numbers[:, None] + torch.arange(k, device=index.device)

    def _propose(self, game: Packing, index: Tensor, moves: Moves) -> tuple[Tensor, Tensor]:
        """Return the M most probable pairs in each of the B games, and whether each is legal.

        Returns:
            int64 [B, M], each pair as one number (``game.floor.split``), and bool [B, M]: false at
            the end of rows with fewer than M legal pairs.
        """
        count, cells = len(ORIENTATIONS), game.floor.cells
        orientations = torch.arange(count, device=game.device)
        lookahead = self.placement_agent.lookahead
        joint = [torch.zeros(0, count, cells, dtype=torch.float64, device=game.device)]
        for part in torch.split(index, max(1, AT_ONCE // (count * cells))):
            branch = lookahead.branch(game, part)
            observation = self.orientation_agent.observe(branch)
            p_orientation = self.orientation_agent.probabilities(observation)  # [b, 6]
            rows = torch.arange(len(part), device=game.device).repeat_interleave(count)
            branch = lookahead.branch(branch, rows)
            observation = self.placement_agent.observe(branch, orientations.repeat(len(part)))
            p_cell = self.placement_agent.probabilities(observation)  # [b · 6, W · D]
            joint.append(p_orientation[:, :, None] * p_cell.view(-1, count, cells))
        legal = moves.mask[index].flatten(2)
        same = _same_boxes(game)[index].double()
        # Add the probabilities of orientations that give the same box, and keep the first of them.
        sums = torch.einsum("noe,nec->noc", same, torch.cat(joint) * legal)
        duplicates = torch.einsum("noe,nec->noc", same.tril(-1), legal.double()) > 0
        sums = sums.masked_fill(~legal | duplicates, -1).flatten(1)
        probability, pairs = sums.topk(min(self.settings.top, sums.shape[1]))
        return pairs, probability >= 0

    def _imagine(self, game: Packing, pairs: Tensor) -> Tensor:
        """Place the pairs, play the games to their end, and return the filled shares [G].

        With a ``depth``, each game stops after this number of items, the proposed one included.
        Then the critic's value is added for the items that may still come. The critic estimates the
        return (Eq. 5 of Zhou et al. 2024), which subtracts wasted space, so the sum is not exactly
        a filled share.
        """
        value = torch.zeros(game.n, dtype=torch.float64, device=game.device)
        rows = torch.arange(game.n, device=game.device)
        choice = game.floor.split(pairs)
        steps = 0
        while True:
            game.place(*choice, check=False)
            value[rows] = game.bins.filled.double() / game.volume
            steps += 1
            alive = game.alive.nonzero().squeeze(1)
            if not len(alive):
                return value
            if len(alive) < game.n:
                rows, game = rows[alive], game.branch(alive)
            observation = self.orientation_agent.observe(game)
            if steps == self.settings.depth:
                assert self.critic is not None
                value[rows] += self.critic(observation).squeeze(1).double()
                return value
            orientation = self.orientation_agent.best(observation)
            observation = self.placement_agent.observe(game, orientation)
            choice = orientation, self.placement_agent.best(observation)


def _same_boxes(game: Packing) -> Tensor:
    """Return which orientations of the item give the same box, bool [G, 6, 6]."""
    sides = oriented(game.items.sides)
    if any(game.spec.com_offset):  # rotating a cube moves its centre of mass
        return torch.eye(len(ORIENTATIONS), dtype=torch.bool, device=sides.device).expand(
            game.n, -1, -1
        )
    return (sides[:, :, None] == sides[:, None]).all(3)
