"""Check games with simple code before and after every placement (``MARL_PACK_CHECK=1``).

The maps, the counts and the masks are computed again from the table of boxes, one box and one
window at a time, by :mod:`marl_pack.stability.reference` and, for the rule ``equilibrium``, by the
linear program of the whole stack. This is slow; use it for tests and for debugging.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from marl_pack.bins import Bins, utilization
from marl_pack.checks import exact
from marl_pack.game.moves import LegalMoves, Moves
from marl_pack.game.spec import GameSpec
from marl_pack.game.state import GameState
from marl_pack.geometry import ORIENTATIONS, Size
from marl_pack.stability import RULES, reference
from marl_pack.stability.exact_equilibrium import Load
from marl_pack.stability.parameters import check_thresholds
from marl_pack.stability.reduced_equilibrium import shifts_of
from marl_pack.stability.static_equilibrium import stands as stack_stands

VARIABLE = "MARL_PACK_CHECK"
"""Name of the environment variable that switches the mode on (1) or off (0, the default)."""

Table = NDArray[np.float64]
"""The boxes of a bin in order, [K, 11]: x y z w d h, weight, centre x y, id, orientation."""
Map = NDArray[np.int64]
Mask = NDArray[np.bool_]


class Games(Protocol):
    """The parts of G games that are checked: their state and the moves computed from it."""

    spec: GameSpec
    state: GameState
    legal: LegalMoves
    moves: Moves
    orientation_mask: Tensor
    alive: Tensor


def wanted() -> bool:
    """Return whether the mode is switched on.

    Raises:
        ValueError: if the environment variable is neither 0 nor 1.
    """
    value = os.environ.get(VARIABLE, "")
    if value not in ("", "0", "1"):
        raise ValueError(f"{VARIABLE} = {value!r}: needs 1 or 0")
    return value == "1"


def before(game: Games, orientation: Tensor, cell: Tensor) -> list[Table]:
    """Check the games before a placement; return the boxes that each bin must contain after it.

    Args:
        game: the games.
        orientation: int64 [G], the chosen orientations.
        cell: int64 [G], the chosen cells.

    Raises:
        AssertionError: naming the first difference, or a choice that is not legal.
    """
    check(game)
    bins, items = game.state.bins.to("cpu"), game.state.items
    item, ids = game.legal.orient(items), _array(items.ids_at(game.state.t))
    table_of_centres = item.centre_table(0.0, max(bins.size[:2]))
    centres, unit = _array(table_of_centres.units(item.sides)), table_of_centres.unit
    weights = _array(item.weights())
    tables = []
    for g in range(len(game.state)):
        table = _table(bins, g)
        o, number = int(orientation[g]), int(cell[g])
        if bool(game.alive[g]) and not _ends_game(game, g, o, number):
            x, y = divmod(number, bins.size[1])
            w, d, h = (int(items.sides[g, axis]) for axis in ORIENTATIONS[o])
            z = int(bins.heightmap[g, x : x + w, y : y + d].max())
            centre = (np.array((x, y)) * unit + centres[g, o]) / unit
            load = weights[g], *centre
            table = np.vstack((table, (x, y, z, w, d, h, *load, ids[g], o)))
        tables.append(table)
    return tables


def _ends_game(game: Games, g: int, orientation: int, cell: int) -> bool:
    """Return whether a choice ends its game without a placement; refuse an illegal choice."""
    mask = _array(game.moves.mask[g]).reshape(len(ORIENTATIONS), -1)
    real = 0 <= orientation < len(mask) and 0 <= cell < mask.shape[1]
    if real and not game.spec.mask_orientations and not mask[orientation].any():
        return True
    if not real or not mask[orientation, cell]:
        raise AssertionError(f"game {g}: orientation {orientation}, cell {cell} is not legal")
    return False


def check_bins(bins: Bins, expected: list[Table]) -> None:
    """Compare bins with the boxes that they must contain.

    Raises:
        AssertionError: naming the first difference.
    """
    bins = bins.to("cpu")
    for g, table in enumerate(expected):
        actual = _table(bins, g)
        _same(g, "count", "", len(actual), len(table))
        _same(g, "table of boxes", "row, column", actual, table)
        _check_bin(bins, g, actual)


def check(game: Games) -> None:
    """Check that the maps and the legal moves of all games follow from their boxes.

    Raises:
        AssertionError: naming the first difference: the game, the array and the index.
    """
    bins, items, spec = game.state.bins.to("cpu"), game.state.items.to("cpu"), game.spec
    item = game.legal.orient(game.state.items)
    weights = _array(item.weights())
    rule: Any = game.legal.rule
    function, parameters = getattr(rule, "func", rule), getattr(rule, "keywords", {})
    known = function in RULES.values()
    for g in range(len(game.state)):
        table = _table(bins, g)
        _check_bin(bins, g, table)
        allowed = np.isin(range(len(ORIENTATIONS)), spec.orientations)
        if items.orientations is not None:
            allowed &= items.orientations[g].numpy()
        sides = items.sides[g].numpy()[np.array(ORIENTATIONS)] * allowed[:, None]
        closed = not spec.mask_orientations and bool(game.state.lost[g])
        closed |= spec.max_items is not None and len(table) >= spec.max_items
        mask = np.array([
            _mask(
                function.__name__ if known else "none", tuple(parameters.items()) if known else (),
                bins.size, tuple(map(tuple, table[:, :9].tolist())),
                (*side.tolist(), *item.exact_centre(o, *side[:2].tolist()), float(weights[g])),
            )
            for o, side in enumerate(sides)
        ])  # fmt: skip
        mask &= not closed
        actual = _array(game.moves.mask[g])
        if not known:  # a rule of the user: only whether the item fits is known
            mask = mask & actual
        _same(g, "mask", "orientation, x, y", actual, mask)
        possible = mask.any((1, 2))
        _same(g, "alive", "", bool(game.alive[g]), bool(possible.any()))
        if not spec.mask_orientations:
            possible = allowed & possible.any()
        _same(g, "orientation_mask", "orientation", _array(game.orientation_mask[g]), possible)


def _array(values: Tensor) -> NDArray[Any]:
    """Return the values of a tensor on any device as a NumPy array."""
    array: NDArray[Any] = values.cpu().numpy()
    return array


def _same(g: int, name: str, axes: str, actual: Any, expected: Any) -> None:
    """Raise AssertionError unless two values or arrays of one shape are equal."""
    different = np.argwhere(np.asarray(actual) != np.asarray(expected))
    if len(different):
        first = tuple(different[0].tolist())
        at = f" at ({axes}) = {first}" if first else ""
        raise AssertionError(
            f"game {g}: {name}{at} is {np.asarray(actual)[first]}, but must be "
            f"{np.asarray(expected)[first]}"
        )


def _table(bins: Bins, g: int) -> Table:
    """Return the boxes of one bin; refuse an impossible number of them."""
    count, most = int(bins.count[g]), bins.boxes.shape[1]
    if not 0 <= count <= most:
        raise AssertionError(f"game {g}: count is {count}, but must be from 0 to {most}")
    parts = bins.boxes[g, :count].double(), bins.loads[g, :count], bins.labels[g, :count].double()
    return np.hstack([part.numpy() for part in parts])


def _maps(boxes: NDArray[Any], size: Size, g: int = -1) -> tuple[Map, Map]:
    """Return the heightmap and the empty map after boxes [K, ≥ 6] are placed one by one.

    Raises:
        AssertionError: for a box outside the bin, in another box or in the air.
    """
    heights, empty = np.zeros(size[:2], np.int64), np.zeros(size[:2], np.int64)
    low, sides = boxes[:, :3].astype(np.int64), boxes[:, 3:6].astype(np.int64)
    high = low + sides
    for k in range(len(boxes)):
        row = f"game {g}: box {k}, {[*low[k].tolist(), *sides[k].tolist()]},"
        if (low[k] < 0).any() or (sides[k] < 1).any() or (high[k] > size).any():
            raise AssertionError(f"{row} must lie in the bin {size}")
        overlap = ((low[:k] < high[k]) & (low[k] < high[:k])).all(1)
        if overlap.any():
            raise AssertionError(f"{row} must not overlap box {int(overlap.argmax())}")
        z, _ = reference.place_box(heights, empty, tuple(low[k, :2]), tuple(sides[k].tolist()))
        if z != low[k, 2]:
            raise AssertionError(f"{row} must rest at z = {z}")
    return heights, empty


def _check_bin(bins: Bins, g: int, table: Table) -> None:
    """Check that one bin's maps and filled volume follow from its boxes."""
    heights, empty = _maps(table, bins.size, g)
    _same(g, "heightmap", "x, y", bins.heightmap[g].numpy(), heights)
    _same(g, "empty_map", "x, y", bins.empty_map[g].numpy(), empty)
    volume = int(table[:, 3:6].prod(1).sum())
    _same(g, "filled", "", int(bins.filled[g]), volume)
    share = volume / float(np.prod(bins.size))
    _same(g, "utilization", "", float(utilization(bins[g : g + 1])), share)


@lru_cache(maxsize=2048)  # each stack is checked twice: after a placement and before the next one
def _mask(
    rule: str,
    parameters: tuple[tuple[str, Any], ...],
    size: Size,
    rows: tuple[tuple[float, ...], ...],
    item: tuple[Any, ...],
) -> Mask:
    """Return the mask of an item in one orientation by the definition of a rule, bool [W, D].

    Args:
        rule: the rule's name.
        parameters: names and values of the rule's parameters.
        size: (W, D, H).
        rows: the boxes in the bin: x y z w d h, weight, centre x y.
        item: w d h along x y z, centre x y from the low corner, weight.
    """
    w, d, h = (int(side) for side in item[:3])
    if min(w, d, h) < 1:
        return np.zeros(size[:2], np.bool_)
    table = np.array(rows).reshape(-1, 9)
    heights, _ = maps = _maps(table, size)
    verdict = _verdict(rule, dict(parameters), table, maps, item)
    return reference.window_mask(
        lambda x, y: verdict(np.s_[x : x + w, y : y + d], x, y), heights, (w, d, h), size[2]
    )


def _verdict(
    rule: str,
    parameters: dict[str, Any],
    table: Table,
    maps: tuple[Map, Map],
    item: tuple[Any, ...],
) -> Callable[[Any, int, int], bool]:
    """Return the function (window, x, y) → whether the item is stable there by a rule."""
    (heights, empty), boxes = maps, table[:, :6].astype(np.int64)
    centre, margin = (item[3], item[4]), parameters.get("margin", 0.0)
    if rule == "none":
        return lambda window, x, y: True
    if rule == "area_ratio":
        thresholds = check_thresholds(parameters.get("thresholds", "paper"))
        return lambda window, x, y: reference.area_ratio(heights[window], thresholds)
    if rule == "lbcp":
        bearing = reference.lbcp_bearing(heights.shape, boxes)
    else:
        bearing = np.ones(heights.shape, np.bool_) if rule == "hull_1" else empty == 0

    def supported(window: Any, x: int, y: int) -> bool:
        return reference.hull(heights[window], bearing[window], centre, margin)

    loads = [Load(*map(exact, row)) for row in table[:, 6:9].tolist()]

    def stands(window: Any, x: int, y: int) -> bool:
        z = int(heights[window].max())
        stack = np.vstack((boxes, (x, y, z, *item[:3]))).astype(np.int64)
        places = ((x + centre[0] + dx, y + centre[1] + dy) for dx, dy in shifts_of(margin))
        return all(stack_stands(stack, [*loads, Load(exact(item[5]), *place)]) for place in places)

    if rule == "equilibrium":
        if not margin:
            return stands
        # The disc of radius margin is rounded up to a polygon, but not above filled columns.
        return lambda window, x, y: supported(window, x, y) or stands(window, x, y)
    return supported
