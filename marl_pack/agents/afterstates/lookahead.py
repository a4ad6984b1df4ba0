"""Afterstates of the legal placements and their values, computed once a turn.

A player owns a :class:`Lookahead` that its agents share. The game and the environment do not use
it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from marl_pack.agents.afterstates.afterstates import Afterstates, afterstates_of, probe_lengths
from marl_pack.agents.afterstates.features import features
from marl_pack.agents.afterstates.limits import ILLEGAL
from marl_pack.agents.afterstates.sampled import EXACT_CELLS, sampled_afterstates
from marl_pack.bins import Bins
from marl_pack.game.packing import Packing

T = TypeVar("T")

AT_ONCE = {"cpu": 1 << 11, "cuda": 1 << 15}
"""Largest number of afterstates that the critic values at once on each device."""
MULTIPLE = 256
"""Divides these numbers: a CPU prepares its code for each number of rows, so there are few."""


class Memo:
    """A store for results that are computed once a turn; it holds the results of one turn."""

    def __init__(self) -> None:
        self._turn: object = None
        self._results: dict[Any, Any] = {}

    def once(self, game: Packing, name: Any, compute: Callable[[], T]) -> T:
        """Return the result ``name`` of the game's turn; compute it if it is not stored."""
        if self._turn is not game.turn:
            self._turn, self._results = game.turn, {}
        if name not in self._results:
            self._results[name] = compute()
        result: T = self._results[name]
        return result

    def forget(self, name: Any) -> None:
        """Delete a result, so that it is computed again when it is needed."""
        self._results.pop(name, None)

    def follow(self, game: Packing, games: Tensor, branched: Packing) -> None:
        """Select the results for ``branched``, a branch of the games ``games`` (int64 [K])."""
        if self._turn is game.turn:
            self._results = {
                name: result.select(games) if isinstance(result, Afterstates) else result[games]
                for name, result in self._results.items()
            }
            self._turn = branched.turn


def value_share_at(ramp: Sequence[int], iteration: int) -> float:
    """Return the share of the values of afterstates that agents observe during training.

    At first the critic knows little, and agents that trust it may settle for a worse way to play.

    Args:
        ramp: first and last iteration of the time in which the share grows from 0 to 1.
        iteration: number of iterations done.
    """
    first, last = ramp
    return 1.0 if iteration >= last else max(0.0, (iteration - first) / max(1, last - first))


class Value(Protocol):
    """A critic of afterstates: features [K, F] → the return still to come [K]."""

    def estimate(self, inputs: Tensor, /) -> Tensor:
        """Estimate the values, float32 [K], without gradients."""


class Lookahead:
    """The afterstates of the visible items' legal placements, and their values.

    The next boxes are those with sides between the shortest and longest of the game's stream.
    ``hull_alpha`` decides where they could be placed, whatever the game's own rule is.

    Args:
        critic: estimates the values of afterstates; None if no agent observes them.
        memo: stores the results; shared by players of the same games.
        value_share: the values are multiplied by it, see :func:`value_share_at`.
    """

    def __init__(
        self, critic: Value | None = None, memo: Memo | None = None, value_share: float = 1.0
    ) -> None:
        self.critic = critic
        self.memo = memo or Memo()
        self.value_share = value_share

    def afterstates(self, game: Packing) -> Afterstates:
        """Compute the afterstate of each legal placement."""

        def compute() -> Afterstates:
            sides = game.orient_item(game.items).sides
            return self.after(game.bins, sides, game.mask, game)

        return self.memo.once(game, "afterstates", compute)

    def feasible_cells(self, game: Packing) -> Tensor:
        """Compute the mean number of cells where the next box could be placed after each placement.

        Returns:
            Float32 [G, 6, W, D]; 0 where the placement is not legal.
        """

        def compute() -> Tensor:
            afterstates = self.afterstates(game)
            return afterstates.as_map(afterstates.feasible_cells(), game.mask)

        return self.memo.once(game, "feasible_cells", compute)

    def feasible_probability(self, game: Packing) -> Tensor:
        """Compute the probability that the next item has a feasible cell after each placement.

        Each box between the shortest and longest side of the stream is equally probable, in the
        orientations that the stream's items may take.

        Returns:
            Float32 [G, 6, W, D]; 0 where the placement is not legal.
        """

        def compute() -> Tensor:
            afterstates = self.afterstates(game)
            probability = afterstates.feasible_probability(game.orientation_sets)
            return afterstates.as_map(probability, game.mask)

        return self.memo.once(game, "feasible_probability", compute)

    def afterstate_value(self, game: Packing) -> Tensor:
        """Estimate the return of each placement: its reward (Eq. 5) plus the critic's value.

        Returns:
            Float32 [G, 6, W, D]; :data:`ILLEGAL` where the placement is not legal.

        Raises:
            ValueError: if there is no critic.
        """

        def compute() -> Tensor:
            return self.returns(self.afterstates(game), game.mask, game)

        return self.memo.once(game, ("afterstate_value", self.critic), compute)

    def after(self, bins: Bins, sides: Tensor, mask: Tensor, game: Packing) -> Afterstates:
        """Compute the afterstates of placements in any bins of a game's size.

        Args:
            bins, sides, mask: as for
                :func:`marl_pack.agents.afterstates.afterstates.afterstates_of`.
            game: a game with the stream of these bins.
        """
        width, depth, _ = bins.size
        code = afterstates_of if width * depth <= EXACT_CELLS else sampled_afterstates
        return code(bins, sides, mask, probe_lengths(*game.stream.sides))

    def returns(self, afterstates: Afterstates, mask: Tensor, game: Packing) -> Tensor:
        """Estimate the returns of placements: their reward (Eq. 5) plus the critic's value.

        Args:
            afterstates: the afterstates of the placements.
            mask: bool [N, A, W, D], where a placement is legal.
            game: a game with the volume and the rewards of these placements.

        Returns:
            Float32 [N, A, W, D]; :data:`ILLEGAL` where the placement is not legal.

        Raises:
            ValueError: if there is no critic.
        """
        spec = game.spec
        gain, loss = spec.alpha * afterstates.volume, spec.beta * afterstates.waste
        reward = (gain - loss) / game.volume
        value = (reward + self._estimates(afterstates, game)) * self.value_share
        return afterstates.as_map(value.float(), mask, ILLEGAL)

    def _estimates(self, afterstates: Afterstates, game: Packing) -> Tensor:
        """Estimate the return that is still to come after each of K placements, float32 [K]."""
        if self.critic is None:
            raise ValueError("the values of placements and bins need a critic of afterstates")
        count, device = len(afterstates.volume), afterstates.volume.device
        rows = torch.arange(-(-count // MULTIPLE) * MULTIPLE, device=device)
        values = [
            self.critic.estimate(features(afterstates, game.volume, part.clamp(max=count - 1)))
            for part in torch.split(rows, AT_ONCE[device.type])
        ]
        return torch.cat(values)[:count]

    def state_value(self, bins: Bins, game: Packing) -> Tensor:
        """Estimate the return that is still to come from bins as they are, float32 [N].

        Like the values of placements, it is multiplied by :attr:`value_share`.

        Args:
            bins: N bins.
            game: a game with the stream of these bins.

        Raises:
            ValueError: if there is no critic.
        """
        return self.expected(bins, game) * self.value_share

    def expected(self, bins: Bins, game: Packing) -> Tensor:
        """Estimate the return as :meth:`state_value` does, whatever share of it agents observe."""
        width, depth, _ = bins.size
        # A box without height changes nothing, so its afterstate is the bin as it is.
        sides = torch.tensor([[[1, 1, 0]]], dtype=torch.int16, device=bins.device)
        mask = torch.zeros(len(bins), 1, width, depth, dtype=torch.bool, device=bins.device)
        mask[:, :, 0, 0] = True
        after = self.after(bins, sides.expand(len(bins), 1, 3).contiguous(), mask, game)
        return self._estimates(after, game)[after.index[:, 0, 0, 0]]

    def heightmap(self, game: Packing) -> Tensor:
        """Return a copy of the heightmaps int16 [G, W, D], which later placements do not change."""
        return self.memo.once(game, "heightmap", game.bins.heightmap.clone)

    def forget_values(self) -> None:
        """Delete the values of afterstates, after the critic has learned."""
        for name in ("afterstate_value", "values_before"):
            self.memo.forget((name, self.critic))

    def branch(self, game: Packing, games: Tensor) -> Packing:
        """Return ``game.branch(games)``, and select the turn's results for it."""
        branched = game.branch(games)
        self.memo.follow(game, games, branched)
        return branched
