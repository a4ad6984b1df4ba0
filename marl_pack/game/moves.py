"""The legal actions of a game: an orientation of the item, and a cell of the bin's floor.

A placement is a pair of an orientation o (0 … 5) and a cell, the low corner (x, y) of the box. The
cell has the number ``x · D + y``, the pair the number ``o · W · D + cell``. Only this module
computes these numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from marl_pack.backend import Backend
from marl_pack.bins import Bins
from marl_pack.game.spec import GameSpec
from marl_pack.geometry import ALL_ORIENTATIONS, ORIENTATIONS, orientation_table
from marl_pack.installation import njit
from marl_pack.items import Items
from marl_pack.stability import OrientedItem, orient_item

Numbers = TypeVar("Numbers", int, Tensor, NDArray[np.int64])


@dataclass(frozen=True)
class Floor:
    """The numbers of cells and of pairs on a floor of W × D cells.

    All functions take whole numbers, arrays or tensors, and return the same kind.
    """

    width: int  # W
    depth: int  # D

    @property
    def cells(self) -> int:
        """Number of cells W · D."""
        return self.width * self.depth

    @property
    def pairs(self) -> int:
        """Number of pairs of an orientation and a cell."""
        return len(ORIENTATIONS) * self.cells

    def cell(self, x: Numbers, y: Numbers) -> Numbers:
        """Return the number of the cell (x, y)."""
        return x * self.depth + y

    def corner(self, cell: Numbers) -> tuple[Numbers, Numbers]:
        """Return the low corner x and y of cells."""
        return cell // self.depth, cell % self.depth

    def corners(self, cell: Tensor, backend: Backend) -> Tensor:
        """Return the low corners (x, y) of cells int64 [N], as int64 [N, 2]."""
        code = backend.pick(compiled=_corners_compiled, tensor=_corners_tensor)
        return code(cell, self.depth)

    def pair(self, orientation: Numbers, cell: Numbers) -> Numbers:
        """Return the numbers of pairs (orientation, cell)."""
        return orientation * self.cells + cell

    def split(self, pair: Numbers) -> tuple[Numbers, Numbers]:
        """Return the orientation and the cell of pairs."""
        return pair // self.cells, pair % self.cells

    def nearest(self, cell: int, legal: NDArray[np.int64]) -> int:
        """Return the cell of ``legal`` (int64 [K], K ≥ 1) that is nearest to ``cell``."""
        (x, y), (legal_x, legal_y) = self.corner(cell), self.corner(legal)
        return int(legal[np.hypot(legal_x - x, legal_y - y).argmin()])


@dataclass(frozen=True)
class Moves:
    """The legal placements of the visible items of G games, as a mask."""

    mask: Tensor  # bool [G, 6, W, D]

    @property
    def floor(self) -> Floor:
        """The floor, which numbers cells and pairs."""
        return Floor(self.mask.shape[2], self.mask.shape[3])

    @property
    def orientations(self) -> Tensor:
        """The orientations with a legal cell, bool [G, 6]."""
        # A sum is many times faster than ``any`` on the CPU.
        return self.mask.sum((2, 3), dtype=torch.int32) > 0

    def any(self) -> Tensor:
        """Return whether there is a legal placement at all, bool [G]."""
        return self.orientations.any(1)

    def of(self, orientation: Tensor) -> Tensor:
        """Return the legal cells bool [G, W, D] of one orientation (int64 [G]) for each game."""
        return self.gather(self.mask, orientation)

    def only(self, orientation: Tensor) -> Moves:
        """Return the moves that use one orientation (int64 [G]) for each game."""
        chosen = torch.nn.functional.one_hot(orientation, len(ORIENTATIONS)).bool()
        return Moves(self.mask & chosen[:, :, None, None])

    def allows(self, orientation: Tensor, cell: Tensor) -> Tensor:
        """Return whether placements (int64 [G] each, any numbers) are legal, bool [G]."""
        floor = self.floor
        near = orientation.clamp(0, len(ORIENTATIONS) - 1), cell.clamp(0, floor.cells - 1)
        legal = self.mask.flatten(1).gather(1, floor.pair(*near)[:, None]).squeeze(1)
        return legal & (near[0] == orientation) & (near[1] == cell)

    def least(self, key: Tensor) -> tuple[Tensor, Tensor]:
        """Return each game's legal orientation and cell with the smallest key.

        Args:
            key: numbers [G, 6, W, D]. Among equal keys, the first one counts.

        Returns:
            int64 [G] each; they are legal where the game has a legal placement.
        """
        worst = torch.inf if key.is_floating_point() else torch.iinfo(key.dtype).max
        return self.floor.split(torch.where(self.mask, key, worst).flatten(1).argmin(1))

    @staticmethod
    def gather(values: Tensor, orientation: Tensor, cell: Tensor | None = None) -> Tensor:
        """Return each game's values for one orientation, or for one orientation and cell.

        Args:
            values: [G, 6, …], or [G, 6, W, D] if a cell is given.
            orientation: int64 [G], the orientation in each game.
            cell: int64 [G], the cell in each game; None for all cells.
        """
        games = _numbers(len(values), values.device)
        if cell is None:
            return values[games, orientation]
        return values[games, orientation].flatten(1)[games, cell]


class LegalMoves:
    """Finds the legal placements of items under the options of a game.

    Args:
        spec: the options of the game.
        device: the device of the tensors.
    """

    def __init__(self, spec: GameSpec, device: torch.device) -> None:
        self.spec, self.rule = spec, spec.make_rule()
        self._barred = [o for o in ALL_ORIENTATIONS if o not in spec.orientations]
        self._allowed = torch.tensor([o in spec.orientations for o in ALL_ORIENTATIONS])
        self._allowed = self._allowed.to(device)  # [6]

    def orient(self, items: Items) -> OrientedItem:
        """Return items in their six orientations; orientations that are not allowed get zero sides.

        The game's options and the item's attribute ``orientations`` say which are allowed.
        """
        oriented = orient_item(items.sides, items.weights, self.spec.com_offset)
        if self._barred:
            oriented.sides[:, self._barred] = 0
        if items.orientations is not None:
            oriented.sides.masked_fill_(~items.orientations[..., None], 0)
        return oriented

    def moves(self, bins: Bins, items: Items, lost: Tensor | None = None) -> Moves:
        """Return the legal moves of one item [G] in each bin.

        Args:
            bins: G bins.
            items: the items [G].
            lost: bool [G], games that ended because an orientation without a legal cell was chosen.
        """
        mask = self.rule(bins, self.orient(items))
        if lost is not None and not self.spec.mask_orientations:
            mask &= ~lost[:, None, None, None]
        if self.spec.max_items is not None:
            mask &= (bins.count < self.spec.max_items)[:, None, None, None]
        return Moves(mask)

    def choices(self, moves: Moves, items: Items) -> tuple[Tensor, Tensor]:
        """Return the orientations that may be chosen, and whether the game goes on.

        Without ``mask_orientations``, every orientation that the game and the item allow may be
        chosen, as long as at least one of them has a legal cell.

        Args:
            moves: the legal moves of the items.
            items: the items [G].

        Returns:
            Bool [G, 6] and bool [G].
        """
        possible = moves.orientations
        alive = possible.any(1)
        if not self.spec.mask_orientations:
            possible = self._allowed & alive[:, None]
            if items.orientations is not None:
                possible &= items.orientations
        return possible, alive


@lru_cache(maxsize=64)
def _numbers(n: int, device: torch.device) -> Tensor:
    """Return 0 … n - 1, int64 [n]."""
    return torch.arange(n, device=device)


@njit(cache=True)
def _write_corners(cells: Any, depth: int, corners: Any) -> None:
    for k in range(cells.size):
        corners[k, 0], corners[k, 1] = cells[k] // depth, cells[k] % depth


def _corners_compiled(cells: Tensor, depth: int) -> Tensor:
    corners = np.empty((len(cells), 2), np.int64)
    _write_corners(cells.numpy(), depth, corners)
    return torch.from_numpy(corners)


def _corners_tensor(cells: Tensor, depth: int) -> Tensor:
    return torch.stack((cells // depth, cells % depth), 1)


TABLE = np.array(ORIENTATIONS)


@njit(cache=True)
def _write_sides(sides: Any, orientation: Any, table: Any, chosen: Any) -> bool:
    """Write the sides along x, y, z; return whether all orientations are rows of the table."""
    for g in range(orientation.size):
        o = orientation[g]
        if not 0 <= o < len(table):
            return False
        for axis in range(3):
            chosen[g, axis] = sides[g, table[o, axis]]
    return True


def sides_compiled(sides: Tensor, orientation: Tensor) -> Tensor:
    """Return items' sides [G, 3] along x, y, z in orientations int64 [G], by a compiled loop.

    Raises:
        IndexError: for an orientation that is not one of 0 … 5.
    """
    chosen = np.empty((len(sides), 3), np.int16)
    if not _write_sides(sides.numpy(), orientation.numpy(), TABLE, chosen):
        raise IndexError
    return torch.from_numpy(chosen)


def sides_tensor(sides: Tensor, orientation: Tensor) -> Tensor:
    """Return the same as :func:`sides_compiled`, in tensor code; a GPU raises no clear error."""
    axes = orientation_table(sides.device).index_select(0, orientation)  # refuses negative indices
    return sides.gather(1, axes)
