"""Let a search for games with selection play games of one visible box and one bin."""

from __future__ import annotations

from dataclasses import fields

from marl_pack.agents.policy import Placement
from marl_pack.agents.selection.budget import BudgetSearch
from marl_pack.game.moves import Moves
from marl_pack.game.packing import Packing
from marl_pack.game.selection import SelectionPacking
from marl_pack.game.spec import GameSpec, SelectionSpec


class OneBoxSearch:
    """A policy for :class:`marl_pack.game.packing.Packing` that searches with a budget.

    Args:
        search: the search, which also plays games with selection.
    """

    def __init__(self, search: BudgetSearch) -> None:
        self.search = search
        self._last: SelectionPacking | None = None

    def __call__(self, game: Packing, moves: Moves | None = None) -> Placement:
        """Return orientation and cell of each game, int64 [G] each.

        Args:
            game: the games.
            moves: the legal placements to choose among; all by default.

        Raises:
            ValueError: if the options of the games do not go with a search.
        """
        _, orientation, cell = self.search(self._selecting(game, moves or game.moves))
        return orientation, cell

    def _selecting(self, game: Packing, moves: Moves) -> SelectionPacking:
        """Return copies of games as games with selection, which have one option."""
        last = self._last
        if last is None or last.stream is not game.stream or last.spec.of_one_box() != game.spec:
            if not game.spec.mask_orientations or any(game.spec.com_offset):
                raise ValueError(
                    "plan: a budget or draws need mask_orientations = true and no com_offset"
                )
            options = {each.name: getattr(game.spec, each.name) for each in fields(GameSpec)}
            last = self._last = SelectionPacking(
                1, game.stream, spec=SelectionSpec(**options), device=game.device,
                backend=game.backend,
            )  # fmt: skip
        return last.like(game, moves)
