"""Search at decision time: try the agents' best pairs in imagined futures.

The learned agents propose the M legal pairs (orientation, cell) whose joint probability
π_o(o) · π_p(cell | o) is highest; orientations that give the same box count as one. Each pair is
then played in futures drawn from the known distribution of the items, the same futures for all
pairs, by the same agents without search: in few futures for all M pairs, then in more for the
better half, and so on. The pair whose bin is fullest on average is taken. An imagined game is an
ordinary game with the same masks, so the search can choose only legal pairs.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from marl_pack.agents.learned import LearnedAgent
from marl_pack.agents.networks.actor_critic import Critic
from marl_pack.agents.policy import Placement
from marl_pack.agents.search_settings import SearchSettings
from marl_pack.game.moves import Moves
from marl_pack.game.packing import Packing
from marl_pack.geometry import ORIENTATIONS, oriented
from marl_pack.items import Stream

AT_ONCE = 1 << 19
"""Approximate number of cells on the floors of all imagined games that are played at once."""


class Planner:
    """A policy that searches with two learned agents.

    Args:
        orientation_agent, placement_agent: the agents, which share one lookahead. If they are
            symmetric, they average over the symmetries of the bin to propose pairs, but not in
            the imagined games.
        critic: the orientation agent's critic; needed with a ``depth``.
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
        self.seed = -1 - seed  # games have seeds ≥ 0: the real items stay unknown

    @torch.inference_mode()
    def __call__(self, game: Packing, moves: Moves | None = None) -> Placement:
        """Return the best pair of every game, by sequential halving (Karnin et al. 2013).

        Each round plays the same number of futures in total. The better half of the pairs goes to
        the next round, until one pair is left.

        Args:
            game: the games.
            moves: the moves to choose among; all legal moves by default.
        """
        best = torch.zeros(game.n, dtype=torch.int64, device=game.device)
        games = game.alive.nonzero().squeeze(1)  # [B]
        pairs, legal = self._propose(game, games, moves or game.moves)  # [B, M]
        total, played = torch.zeros(pairs.shape, dtype=torch.float64, device=game.device), 0
        rounds = max(1, math.ceil(math.log2(self.settings.top)))
        for rounds_left in range(rounds, 0, -1):
            best[games] = pairs[:, 0]
            several = legal.sum(1) > 1
            games, pairs, legal, total = (x[several] for x in (games, pairs, legal, total))
            if not len(games):
                break
            budget = self.settings.top * self.settings.rollouts
            k = max(1, budget // (rounds * pairs.shape[1]))
            total[legal] += self._sum(game, games, pairs, legal, played, k)
            played += k
            remaining = 1 if rounds_left == 1 else -(-pairs.shape[1] // 2)
            better = total.masked_fill(~legal, -torch.inf).topk(remaining, 1).indices
            pairs, legal, total = (x.gather(1, better) for x in (pairs, legal, total))
        best[games] = pairs[:, 0]
        return game.floor.split(best)

    def _sum(
        self, game: Packing, games: Tensor, pairs: Tensor, legal: Tensor, first: int, k: int
    ) -> Tensor:
        """Sum the results of each legal pair over ``k`` futures, from number ``first`` on.

        Args:
            game: the games.
            games: int64 [B], the indices of the games in which to search.
            pairs: int64 [B, M], the proposed pairs.
            legal: bool [B, M], whether each pair is legal; L pairs are.
            first: number of the first future.
            k: number of futures.

        Returns:
            Float64 [L].
        """
        row, rank = legal.nonzero().unbind(1)
        at_once = max(1, AT_ONCE // game.floor.cells)
        numbers = self._futures(game, games, first, k)[row].flatten()  # [L · k]
        each = row.repeat_interleave(k), rank.repeat_interleave(k), numbers
        values = [
            self._imagine(game.branch(games[r], self.futures, self.seed, f), pairs[r, m])
            for r, m, f in zip(*(torch.split(x, at_once) for x in each), strict=True)
        ]
        return torch.cat(values).view(-1, k).sum(1)

    def _futures(self, game: Packing, games: Tensor, first: int, k: int) -> Tensor:
        """Return the numbers of k futures of each game, int64 [B, k], from ``first`` on."""
        decision = game.episode[games] * game.bins.boxes.shape[1] + game.t[games]
        numbers = decision * self.settings.top * self.settings.rollouts + first
        return numbers[:, None] + torch.arange(k, device=games.device)

    def _propose(self, game: Packing, games: Tensor, moves: Moves) -> tuple[Tensor, Tensor]:
        """Return the M most probable moves in each of the B games, and whether each is legal.

        Returns:
            int64 [B, M], and bool [B, M]: false at the end of rows with fewer than M legal pairs.
        """
        count, cells = len(ORIENTATIONS), game.floor.cells
        orientations = torch.arange(count, device=game.device)
        lookahead = self.placement_agent.lookahead
        joint = [torch.zeros(0, count, cells, dtype=torch.float64, device=game.device)]
        for part in torch.split(games, max(1, AT_ONCE // (count * cells))):
            branch = lookahead.branch(game, part)
            first = self.orientation_agent.probabilities(self.orientation_agent.observe(branch))
            rows = torch.arange(len(part), device=game.device).repeat_interleave(count)
            branch = lookahead.branch(branch, rows)
            observation = self.placement_agent.observe(branch, orientations.repeat(len(part)))
            second = self.placement_agent.probabilities(observation)  # [b · 6, W · D]
            joint.append(first[:, :, None] * second.view(-1, count, cells))
        legal = moves.mask[games].flatten(2)
        same = _same_boxes(game)[games].double()
        merged = torch.einsum("noe,nec->noc", same, torch.cat(joint) * legal)
        earlier = torch.einsum("noe,nec->noc", same.tril(-1), legal.double())
        merged = merged.masked_fill(~legal | (earlier > 0), -1).flatten(1)
        probability, pairs = merged.topk(min(self.settings.top, merged.shape[1]))
        return pairs, probability >= 0

    def _imagine(self, game: Packing, pairs: Tensor) -> Tensor:
        """Play the pairs and then the imagined games to their end; return the filled shares [G].

        With a depth, each game stops after so many items, and the critic's value is added for the
        items that may still come. It estimates the return (Eq. 5), which subtracts wasted space.
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
