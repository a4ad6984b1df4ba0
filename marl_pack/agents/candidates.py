"""Compute the numbers by which heuristics compare the placements of the visible items."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.game.packing import Packing
from marl_pack.geometry import resting_heights_and_waste
from marl_pack.items.streams import Cut


class Candidates:
    """All placements of the visible items, legal or not; tensors broadcast to [G, 6, W, D].

    Args:
        game: the games.
        lookahead: computes the afterstates of the placements.
    """

    def __init__(self, game: Packing, lookahead: Lookahead) -> None:
        self.game, self.lookahead = game, lookahead
        self.size = game.size
        self.sides = game.orient_item(game.items).sides  # int16 [G, 6, 3]
        self.x = torch.arange(game.size[0], device=game.device)[:, None]  # int64 [W, 1]
        self.y = torch.arange(game.size[1], device=game.device)[None, :]  # int64 [1, D]

    def _windows(self, waste: bool) -> tuple[Tensor, Tensor]:
        bins = self.game.bins
        return resting_heights_and_waste(
            bins.heightmap, self.sides, bins.height, waste=waste, backend=bins.backend
        )

    @cached_property
    def _heights_and_waste(self) -> tuple[Tensor, Tensor]:
        """Resting height and number of wasted cells for every placement, computed together."""
        return self._windows(waste=True)

    @cached_property
    def z(self) -> Tensor:
        """Resting height of the item in cells, int64 [G, 6, W, D]."""
        if "_heights_and_waste" in vars(self):
            return self._heights_and_waste[0].long()
        return self._windows(waste=False)[0].long()

    @cached_property
    def waste(self) -> Tensor:
        """Number of empty cells that the item would enclose below itself, int64 [G, 6, W, D]."""
        return self._heights_and_waste[1].long()

    @cached_property
    def top(self) -> Tensor:
        """Height of the item's top in cells, at most H, int64 [G, 6, W, D]."""
        return (self.z + self.sides[..., 2, None, None]).clamp(max=self.size[2])

    @cached_property
    def feasible_cells(self) -> Tensor:
        """Mean number of cells where a box that may come next could be placed, float32."""
        return self.lookahead.feasible_cells(self.game)

    @cached_property
    def elsewhere(self) -> Tensor:
        """0 where a piece of a generated cut was cut out, 1 elsewhere, int64 [G, 6, W, D]."""
        game = self.game
        elsewhere = torch.ones_like(game.mask, dtype=torch.int64)
        if isinstance(game.stream, Cut):
            boxes = game.stream.boxes(game.seed, game.episode)
            games, steps = torch.arange(game.n, device=game.device), game.t
            x, y = boxes[games, steps.clamp(max=boxes.shape[1] - 1), :2].long().unbind(1)
            elsewhere[games, 0, x, y] = 0
        return elsewhere
