"""Agents that were trained on cells choose among the moves of the exact world.

The bin is shown to them on a grid: heights are rounded up to cells, and so are the sides of boxes.
The exact world says what is legal: a placement in cells is legal if a legal move has its low corner
there. So the grid limits what the agents see, and nothing else.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.loading import Loader, trained_game
from marl_pack.agents.policy import Explained
from marl_pack.checks import real_number
from marl_pack.exact.bins import NOWHERE, ExactBins, placements
from marl_pack.exact.choice import LINEAR, best_of
from marl_pack.exact.explaining import Reasons
from marl_pack.exact.goods import AXES
from marl_pack.exact.lengths import in_units
from marl_pack.exact.policies import HEURISTICS
from marl_pack.exact.spec import ExactSpec
from marl_pack.explanation import PROBABILITY_OF
from marl_pack.game.moves import Moves
from marl_pack.game.packing import Packing
from marl_pack.geometry import resting_heights_and_waste
from marl_pack.installation import njit

if TYPE_CHECKING:
    from marl_pack.packer.turn import Turn

FLOOR_CELLS = 10
"""Cells along the longer side of the floor, by default; the published agents were trained on 10."""
MOST_CELLS = 200
"""Largest number of cells along a side."""
ROUNDING = 1e-9
"""Cells by which a float may be wrong."""


@njit(cache=True)
def rasterize(boxes: Any, n: int, cell: float, heights: Any, empty: Any) -> int:
    """Write the heights of the columns of a grid and the empty cells below; return filled cells.

    A column is as high as the highest box that reaches into it, rounded up. A cell of it is filled
    if a box covers the cell's part of the column whole.

    Args:
        boxes: int [≥ n, 10], rows of the state.
        n: number of boxes.
        cell: edge of a cell in units.
        heights, empty: int16 [W, D], written.

    Returns:
        The number of cells that the boxes' volume fills.
    """
    width, depth = heights.shape
    levels = 1
    volume = 0.0
    for j in range(n):
        levels = max(levels, int(np.ceil((boxes[j, 2] + boxes[j, 5]) / cell)))
        volume += float(boxes[j, 3]) * boxes[j, 4] * boxes[j, 5]
    solid = np.zeros((width, depth, levels), np.bool_)
    heights[:] = 0
    for j in range(n):
        x0, y0, z0 = boxes[j, 0] / cell, boxes[j, 1] / cell, boxes[j, 2] / cell
        x1, y1, z1 = x0 + boxes[j, 3] / cell, y0 + boxes[j, 4] / cell, z0 + boxes[j, 5] / cell
        top = np.ceil(z1 - 1e-9)
        for x in range(int(x0), min(width, int(np.ceil(x1 - 1e-9)))):
            for y in range(int(y0), min(depth, int(np.ceil(y1 - 1e-9)))):
                heights[x, y] = max(heights[x, y], top)
                # A box fills the cells in which its middle plane is: rounding is to the nearest.
                inside_x = min(x1, x + 1.0) - max(x0, float(x))
                inside_y = min(y1, y + 1.0) - max(y0, float(y))
                if inside_x * inside_y >= 0.5:
                    for z in range(int(np.round(z0)), int(top)):
                        solid[x, y, z] = True
    for x in range(width):
        for y in range(depth):
            empty[x, y] = 0
            for z in range(heights[x, y]):
                empty[x, y] += not solid[x, y, z]
    return int(volume / cell**3)


class CellAgent:
    """A policy of the exact world that asks agents trained on cells.

    Args:
        source: name of a published model, or path of a run's folder or a checkpoint.
        spec: the game in millimetres.
        grid_mm: edge of a cell in millimetres; by default the longer side of the floor has
            :data:`FLOOR_CELLS` cells.
        seed: seed of agents that play at random.

    Raises:
        ValueError, FileNotFoundError: if there are no such agents, or the grid is impossible.
    """

    def __init__(
        self, source: str | Path, spec: ExactSpec, grid_mm: float | None = None, seed: int = 0
    ) -> None:
        checkpoint = checkpoints.read(source)
        self.policy: Any = Loader(seed=seed).policy_of(checkpoint)
        game = trained_game(checkpoint)
        default = max(spec.bin_mm[:2]) / FLOOR_CELLS
        self.grid_mm = default if grid_mm is None else real_number(grid_mm, "grid_mm")
        longest = max(spec.bin_mm)
        if not longest / MOST_CELLS <= self.grid_mm <= min(spec.bin_mm):
            raise ValueError(
                f"grid_mm = {self.grid_mm:g}: needs a cell from {longest / MOST_CELLS:g} mm (the "
                f"bin's longest side has at most {MOST_CELLS} cells) to the bin's shortest side"
            )
        self.cell = float(in_units(self.grid_mm, spec.unit_mm))
        size = [int(np.ceil(side / self.cell - 1e-9)) for side in spec.size]
        # The stream is never played: it says which boxes the agents expect to come.
        sides = game["sides"] if "." not in game["items"] else (2, 5)
        shortest = min(sides[0], *size)
        self.game = Packing(
            1, (size[0], size[1], size[2]), "rs", sides=(shortest, min(sides[1], *size)),
            auto_reset=False, rule="hull_alpha",
        )  # fmt: skip
        self._cells = np.empty(0, np.int64)  # [M]  of each legal move in the last call
        self._contact = HEURISTICS["max_contact"]().weights

    def __call__(self, turn: Turn) -> NDArray[np.int64]:
        """Return the move of each option, int64 [G]; NOWHERE where its box has no place."""
        return np.array([self._move(turn, g) for g in range(len(turn.pairs))])

    def _move(self, turn: Turn, g: int) -> int:
        """Return the move of option ``g``."""
        numbers = turn.moves.of(g)
        if not len(numbers):
            return NOWHERE
        with torch.inference_mode():
            moves = self._choose(turn, g, numbers)
        bins = turn.bins
        return best_of(
            LINEAR, self._contact, bins.limits, bins.size, bins.state.boxes[g],
            int(bins.state.count[g]), turn.items.sides[g], moves,
        )  # fmt: skip

    def reasons(self, turn: Turn, g: int, moves: NDArray[np.int64], move: int) -> Reasons:
        """Return what the agents computed for option ``g`` in the last call.

        Moves that the grid shows at the same cell have the same probability and value
        (:class:`marl_pack.exact.explaining.Explained`).
        """
        if len(turn.pairs) > 1:  # the game on the grid shows the last option
            self._move(turn, g)
        cells, orientations = self._cells, placements(moves)[:, 0]
        if not (cells >= 0).any() or not isinstance(self.policy, Explained):
            return Reasons()
        orientation = placements(move)[0]
        with torch.inference_mode():
            own = self.policy.reasons(self.game, torch.tensor([int(orientation)]))
        probabilities = values = first = None
        if own.orientation_probabilities is not None:
            first = own.orientation_probabilities[0].double().numpy()
        if own.probabilities is not None:
            known = (cells >= 0) & (orientations == orientation)
            probabilities = np.where(known, own.probabilities[0].double().numpy()[cells], np.nan)
        if own.values is not None:
            of_cells = own.values[0].double().flatten(1).numpy()
            values = np.where(cells >= 0, of_cells[orientations, cells], np.nan)
        return Reasons(values, own.value_of, first, probabilities, probability_of=PROBABILITY_OF[1])

    def _choose(self, turn: Turn, g: int, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Show the agents option ``g`` on the grid, and return the moves at the cell they choose.

        Moves that the grid cannot show, because the box would reach above the bin there, are left
        out; if there are no others, all moves are returned.
        """
        game = self.game
        where = placements(numbers)
        sides = self._show(turn.bins, g, turn.items.sides[g], np.unique(where[:, 0]))
        cells = self._cells = self._cells_of(where, sides)
        shown = cells >= 0
        if not shown.any():
            return numbers
        mask = torch.zeros(1, len(AXES), game.floor.cells, dtype=torch.bool)
        mask[0, where[shown, 0], cells[shown]] = True
        mask = mask.view(1, len(AXES), *game.size[:2])
        game.moves = Moves(mask)
        game.orientation_mask = game.moves.orientations
        game.alive = torch.ones(1, dtype=torch.bool)
        game.turn = object()
        orientation, cell = self.policy(game)
        return numbers[(where[:, 0] == int(orientation)) & (cells == int(cell))]

    def _show(
        self, bins: ExactBins, b: int, sides: NDArray[np.int64], legal: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Write a bin and the visible box, rounded up to cells, into the game of the agents.

        Args:
            bins, b: the bins, and the number of the one to show.
            sides: int64 [3], the box's own sides in units.
            legal: the orientations that have a move.

        Returns:
            The box's sides in cells in the six orientations, int64 [6, 3].
        """
        game, state = self.game, self.game.state
        heights, empty = np.zeros(game.size[:2], np.int16), np.zeros(game.size[:2], np.int16)
        filled = rasterize(bins.state.boxes[b], int(bins.state.count[b]), self.cell, heights, empty)
        state.bins.heightmap[0] = torch.from_numpy(np.minimum(heights, game.size[2]))
        state.bins.empty_map[0] = torch.from_numpy(np.minimum(empty, game.size[2]))
        state.bins.filled[0] = min(filled, game.volume)
        own = np.ceil(sides / self.cell - ROUNDING).astype(np.int64)
        for o in legal:  # a side that was rounded up may be longer than the grid
            np.minimum.at(own, AXES[o], game.size)
        state.items.sides[0] = torch.from_numpy(own.astype(np.int16))
        return own[AXES]

    def _cells_of(
        self, where: NDArray[np.int64], sides: NDArray[np.int64]
    ) -> NDArray[np.int64]:  # fmt: skip
        """Return the cell that shows each move, int64 [M]; -1 if the grid cannot show it.

        Of the cells around the low corner it is the one where the box rests at the most similar
        height.

        Args:
            where: int64 [M, 4], orientation and low corner of each move in units.
            sides: int64 [6, 3], the box in cells.
        """
        game = self.game
        bins, size = game.state.bins, np.array(game.size)
        rest = resting_heights_and_waste(
            bins.heightmap, torch.from_numpy(sides[None].astype(np.int16)), bins.height,
            waste=False, backend=bins.backend,
        )[0][0].numpy()  # fmt: skip
        orientation = where[:, 0]
        own = sides[orientation]
        corner = where[:, 1:3] / self.cell
        best, cells = np.full(len(where), np.inf), np.full(len(where), -1)
        for shift in ((0, 0), (0, 1), (1, 0), (1, 1)):
            low = np.floor(corner + ROUNDING).astype(np.int64) + shift
            low = np.clip(low, 0, size[:2] - own[:, :2])
            z = rest[orientation, low[:, 0], low[:, 1]].astype(np.int64)
            difference = np.abs(z - where[:, 3] / self.cell)
            better = (difference < best) & (z + own[:, 2] <= size[2])
            best = np.where(better, difference, best)
            cells = np.where(better, game.floor.cell(low[:, 0], low[:, 1]), cells)
        return cells
