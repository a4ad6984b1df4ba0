"""The legal actions of a game: an orientation of the item, and a cell of the bin's floor.

A placement is a pair of an orientation o (0 … 5) and a cell, the low corner (x, y) of the box. The
cell has the number ``x · D + y``, the pair the number ``o · W · D + cell``. Only this module
computes these numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from marl_pack.backend import Backend
from marl_pack.bins import Bins
from marl_pack.game import compiled
from marl_pack.game.spec import GameSpec
from marl_pack.geometry import ALL_ORIENTATIONS, ORIENTATIONS, oriented
from marl_pack.items import Items
from marl_pack.stability import OrientedItem
from marl_pack.stability.oriented_item import rotated_offsets

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

    @cached_property
    def array(self) -> NDArray[np.bool_]:
        """The mask as a NumPy array [G, 6, W · D] that shares its memory; only on the CPU."""
        return self.mask.numpy().reshape(self.mask.shape[0], len(ORIENTATIONS), -1)

    def __getstate__(self) -> dict[str, Any]:
        """Return the mask for a copy or a pickle: an array would not share memory there."""
        return {"mask": self.mask}

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
        backend: the implementation to use.
    """

    def __init__(self, spec: GameSpec, device: torch.device, backend: Backend) -> None:
        self.spec, self.rule, self.backend = spec, spec.make_rule(), backend
        allowed = torch.tensor([o in spec.orientations for o in ALL_ORIENTATIONS])
        # bool [6], the allowed orientations, as the code of the backend needs them
        self._allowed: Any = backend.pick(compiled=allowed.numpy(), tensor=allowed.to(device))
        self._offsets = rotated_offsets(spec.com_offset)

    def orient(self, items: Items) -> OrientedItem:
        """Return items in their six orientations; orientations that are not allowed get zero sides.

        The game's options and the item's attribute ``orientations`` say which are allowed.
        """
        code = self.backend.pick(compiled=_orient_compiled, tensor=_orient_tensor)
        sides = code(items, self._allowed)
        return OrientedItem(sides, self._offsets, items.weights)

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
        code = self.backend.pick(compiled=_choices_compiled, tensor=_choices_tensor)
        return code(moves, items, self._allowed, self.spec.mask_orientations)


NO_SETS = np.empty((0, len(ORIENTATIONS)), np.bool_)
"""Stands for items that allow all orientations."""


def _own_orientations(items: Items) -> NDArray[np.bool_]:
    return NO_SETS if items.orientations is None else items.orientations.numpy()


def _orient_compiled(items: Items, allowed: Any) -> Tensor:
    """Return items' sides [G, 6, 3] in six orientations; zeros where one is not allowed."""
    sides = items.sides.numpy()
    oriented_sides = np.empty((len(sides), len(ORIENTATIONS), 3), np.int16)
    compiled.orient_items(sides, allowed, _own_orientations(items), oriented_sides)
    return torch.from_numpy(oriented_sides)


def _orient_tensor(items: Items, allowed: Any) -> Tensor:
    possible = allowed if items.orientations is None else allowed & items.orientations
    return oriented(items.sides) * possible[..., None]


def _choices_compiled(
    moves: Moves, items: Items, allowed: Any, masked: bool
) -> tuple[Tensor, Tensor]:
    """Return the orientations that may be chosen, bool [G, 6], and whether games go on [G]."""
    masks = moves.array
    possible, alive = np.empty(masks.shape[:2], np.bool_), np.empty(masks.shape[0], np.bool_)
    compiled.find_choices(masks, allowed, _own_orientations(items), masked, possible, alive)
    return torch.from_numpy(possible), torch.from_numpy(alive)


def _choices_tensor(
    moves: Moves, items: Items, allowed: Any, masked: bool
) -> tuple[Tensor, Tensor]:
    possible = moves.orientations
    alive = possible.any(1)
    if not masked:
        possible = allowed & alive[:, None]
        if items.orientations is not None:
            possible &= items.orientations
    return possible, alive


@lru_cache(maxsize=64)
def _numbers(n: int, device: torch.device) -> Tensor:
    """Return 0 … n - 1, int64 [n]."""
    return torch.arange(n, device=device)
