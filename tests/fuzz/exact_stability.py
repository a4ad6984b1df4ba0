"""Decimals at the edge of support: the rules' verdicts against exact fractions."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import numpy as np
import torch

from marl_pack import bins as bin_state
from marl_pack.backend import Backend
from marl_pack.bins import Bins
from marl_pack.stability import OrientedItem, make_rule, reference, stable_mask

Generator = np.random.Generator
BOX_SIDES = (1, 5)


def decimal(generator: Generator, low: float, high: float) -> float:
    """Return a number of one to 17 digits."""
    value = float(generator.uniform(low, high))
    return round(value, int(generator.choice([1, 1, 2, 2, 3, 6, 12, 17])))


def offset_at(generator: Generator, side: int, short: bool = False) -> float:
    """Return an offset that often puts the centre of mass on the edge of a cell, or next to it.

    Args:
        generator: of random numbers.
        side: the item's side in cells.
        short: whether to take decimals of few digits only.
    """
    if generator.random() < 0.3:
        return round(decimal(generator, -0.44, 0.44), 2 if short else 17)
    place = Fraction(int(generator.integers(1, 2 * side)), 2 * side) - Fraction(1, 2)
    if short:
        return float(round(place, 3))  # half a cell is an edge of other hulls
    nudge = generator.choice([0.0, 0.0, 0.0, 1e-17, -1e-17, 1e-9, -1e-9])
    return float(np.clip(float(place) + nudge, -0.49, 0.49))


def random_stacks(generator: Generator, n: int, size: tuple[int, int, int]) -> Bins:
    """Return bins with boxes placed anywhere: pillars of one cell, or larger boxes.

    Pillars make hulls with slanted edges, which pass through many corners of cells.
    """
    bins = bin_state.empty(n, size, max_boxes=6)
    pillars = generator.random() < 0.6
    for _ in range(int(generator.integers(2, 7))):
        sides = np.ones((n, 3), np.int64)
        if not pillars:
            sides = generator.integers(*BOX_SIDES, (n, 3), endpoint=True)
            sides = np.minimum(sides, [*size[:2], 2])
        corners = np.stack([generator.integers(0, size[k] - sides[:, k] + 1) for k in (0, 1)], 1)
        room = bins.heightmap.amax((1, 2)).numpy() + sides[:, 2] < size[2]
        if pillars:
            taken = bins.heightmap.numpy()[np.arange(n), corners[:, 0], corners[:, 1]] > 0
            room &= ~taken
        placed = torch.from_numpy(np.where(room[:, None], sides, 0).astype(np.int16))
        bin_state.place(bins, placed, torch.from_numpy(corners))
    return bins


def mirrored(bins: Bins, item: OrientedItem) -> tuple[Bins, OrientedItem]:
    """Return the bins and the item mirrored along x; of the boxes only the maps."""
    maps = bins.map(torch.clone)
    maps.heightmap.copy_(bins.heightmap.flip(1))
    maps.empty_map.copy_(bins.empty_map.flip(1))
    offsets = tuple((-x, y) for x, y in item.offsets or ())
    return maps, OrientedItem(item.sides, offsets or None)


def check_hulls(seed: int, windows: int) -> int:
    """Compare the hull rules and ``area_ratio`` with the reference on every backend.

    Returns:
        The number of windows compared, at least ``windows``.

    Raises:
        AssertionError: naming the first window that is judged wrongly.
    """
    generator = np.random.default_rng(seed)
    compared = 0
    while compared < windows:
        size = (int(generator.integers(2, 9)), int(generator.integers(2, 9)), 9)
        bins = random_stacks(generator, 4, size)
        sides = np.minimum(generator.integers(1, 8, 3), [*size[:2], 7])
        short = bool(generator.random() < 0.6)
        item = OrientedItem(
            torch.from_numpy(np.tile(sides.astype(np.int16), (4, 2, 1))),
            tuple(
                (offset_at(generator, sides[0], short), offset_at(generator, sides[1], short))
                for _ in "ab"
            ),
        )
        margin = float(generator.choice([0, 0, 0.1, 0.3, 0.5, 0.7, 1, decimal(generator, 0, 2)]))
        thresholds = (
            (float(generator.choice([0.1, 0.3, 0.6, 0.7, 0.8, decimal(generator, 0, 1)])), 2),
            (float(generator.choice([0.5, 0.9, 0.55, decimal(generator, 0, 1)])), 0),
        )
        rules = {
            "hull_1": {"margin": margin},
            "hull_alpha": {"margin": margin},
            "lbcp": {"margin": margin},
            "area_ratio": {"thresholds": thresholds},
        }
        for name, parameters in rules.items():
            rule = make_rule(name, **parameters)
            expected = _expected(name, bins, item, margin, thresholds)
            for backend in Backend:
                mask = rule(_on(bins, backend), item).numpy()
                _compare(mask, expected, f"{name} {parameters} {backend}", bins, item)
            compared += int((size[0] - sides[0] + 1) * (size[1] - sides[1] + 1)) * 8
            image, reflected = mirrored(bins, item)
            mask = rule(image, reflected).numpy()
            for a in range(2):
                places = size[0] - int(sides[0]) + 1
                flipped = mask[:, a, :places][:, ::-1]
                if name in ("hull_1", "hull_alpha"):
                    _compare(flipped, expected[:, a, :places], f"{name} mirrored", bins, item)
    return compared


def _on(bins: Bins, backend: Backend) -> Bins:
    values = [*bins.tensors(), bins.height, backend]
    return Bins(*values)


def _expected(
    name: str,
    bins: Bins,
    item: OrientedItem,
    margin: float,
    thresholds: tuple[tuple[float, int], ...],
) -> np.ndarray:
    """Compute the masks by the reference, window by window."""
    n, orientations = item.sides.shape[:2]
    masks = np.zeros((n, orientations, *bins.size[:2]), np.bool_)
    for b in range(n):
        heights = bins.heightmap[b].numpy()
        bearing = {
            "hull_1": np.ones(heights.shape, np.bool_),
            "hull_alpha": bins.empty_map[b].numpy() == 0,
            "lbcp": reference.lbcp_bearing(
                heights.shape, bins.boxes[b, : int(bins.count[b])].numpy()
            ),
        }.get(name)
        for a in range(orientations):
            w, d, h = item.sides[b, a].tolist()
            com = item.exact_centre(a, w, d)

            def stands(x: int, y: int) -> bool:
                window = np.s_[x : x + w, y : y + d]  # noqa: B023  # called at once
                if name == "area_ratio":
                    return reference.area_ratio(heights[window], thresholds)  # noqa: B023
                return reference.hull(heights[window], bearing[window], com, margin)  # noqa: B023

            masks[b, a] = reference.window_mask(stands, heights, (w, d, h), bins.height)
    return masks


def _compare(
    mask: np.ndarray, expected: np.ndarray, what: str, bins: Bins, item: OrientedItem
) -> None:
    for index in np.argwhere(mask != expected):
        b = index[0]
        raise AssertionError(
            f"{what}: window {index.tolist()} is {mask[tuple(index)]}; sides"
            f" {item.sides[b, 0].tolist()} offsets {item.offsets} heights"
            f" {bins.heightmap[b].tolist()} empty {bins.empty_map[b].tolist()}"
        )


# --- equilibrium ----------------------------------------------------------------------------------


def levers(generator: Generator) -> tuple[np.ndarray, list[float], float, tuple[int, int, int]]:
    """Return a plank on a pillar and an item that nearly or exactly balances it.

    Returns:
        Boxes, their weights, the item's weight and its sides. The item is 1 x 1 x 1.
    """
    left, width = int(generator.integers(1, 4)), int(generator.integers(1, 3))
    right = int(generator.integers(2, 6))
    length = left + width + right
    pillar, plank = (left, 0, 0, width, 2, 1), (0, 0, 1, length, 2, 1)
    weight = decimal(generator, 0.1, 5) or 0.5
    # About the pillar's right edge: the plank's centre to its left, the item at the far end.
    arm, far = left + width - length / 2, length - 0.5 - (left + width)
    balance = weight * arm / far
    own = [balance, round(balance, 2), round(balance, 6), decimal(generator, 0.1, 5)]
    item = max(float(generator.choice(own)), 0.001)
    return np.array([pillar, plank]), [decimal(generator, 0.1, 9) or 1.0, weight], item, (1, 1, 1)


def equilibrium_cases(seed: int) -> Iterator[dict[str, Any]]:
    """Yield arguments of :func:`stable_mask` for the rule ``equilibrium``, without end."""
    generator = np.random.default_rng(seed)
    while True:
        if generator.random() < 0.5:
            boxes, weights, weight, sides = levers(generator)
            size = (12, 2, 6)
        else:
            size = (int(generator.integers(2, 7)), int(generator.integers(2, 5)), 9)
            bins = random_stacks(generator, 1, size)
            boxes = bins.boxes[0, : int(bins.count[0])].numpy().astype(np.int64)
            weights = [decimal(generator, 0.1, 9) or 1.0 for _ in boxes]
            weight = decimal(generator, 0.1, 9) or 1.0
            sides = tuple(np.minimum(generator.integers(1, 5, 3), [*size[:2], 3]).tolist())
        heights, empty = np.zeros(size[:2], np.int64), np.zeros(size[:2], np.int64)
        for x, y, _, w, d, h in boxes.tolist():
            reference.place_box(heights, empty, (x, y), (w, d, h))
        central = generator.random() < 0.4
        offset = (0.0, 0.0)
        if not central:
            offset = offset_at(generator, sides[0]), offset_at(generator, sides[1])
        yield {
            "heightmap": heights, "empty_map": empty, "item": sides, "bin_height": size[2],
            "boxes": boxes, "weights": weights, "weight": weight, "com_offset": (*offset, 0),
        }  # fmt: skip


def mirrored_case(case: dict[str, Any]) -> dict[str, Any]:
    """Return a case mirrored along x."""
    boxes = case["boxes"].copy()
    boxes[:, 0] = len(case["heightmap"]) - boxes[:, 0] - boxes[:, 3]
    x, y, z = case["com_offset"]
    maps = {name: case[name][::-1].copy() for name in ("heightmap", "empty_map")}
    return case | maps | {"boxes": boxes, "com_offset": (-x, y, z)}


def check_equilibrium(seed: int, cases: int) -> int:
    """Compare one placement of each case with the reference, the hard ones first.

    Returns:
        The number of placements compared.

    Raises:
        AssertionError: naming the first case that is judged wrongly.
    """
    generator = np.random.default_rng([seed, 1])
    compared = 0
    for case in equilibrium_cases(seed):
        if compared == cases:
            return compared
        mask = stable_mask("equilibrium", **case)
        own = {key: value for key, value in case.items() if key not in ("weights", "weight")}
        one, alpha = (stable_mask(rule, **own) for rule in ("hull_1", "hull_alpha"))
        open_cells = np.argwhere(one & ~alpha)
        cells = open_cells if len(open_cells) else np.argwhere(one)
        if not len(cells):
            continue
        x, y = generator.choice(cells).tolist()
        (w, d, h), boxes = case["item"], case["boxes"]
        z = int(case["heightmap"][x : x + w, y : y + d].max())
        if z + h > case["bin_height"]:
            continue
        loads = [
            (weight, bx + Fraction(bw, 2), by + Fraction(bd, 2))
            for weight, (bx, by, _, bw, bd, _) in zip(case["weights"], boxes.tolist(), strict=True)
        ]
        fx, fy, _ = (Fraction(1, 2) + Fraction(str(f)) for f in case["com_offset"])
        loads.append((case["weight"], x + w * fx, y + d * fy))
        stack = np.vstack((boxes, (x, y, z, w, d, h)))
        if mask[x, y] != reference.equilibrium(stack, loads):
            raise AssertionError(f"equilibrium at {x, y} is {mask[x, y]}: {case}")
        margin = float(generator.choice([0.0, 0.25, 0.3]))
        masks = [
            stable_mask("equilibrium", **own_case, margin=margin)
            for own_case in (case, mirrored_case(case))
        ]
        places = mask.shape[0] - w + 1
        if (masks[0][:places] != masks[1][:places][::-1]).any():
            raise AssertionError(f"equilibrium with margin {margin} differs mirrored: {case}")
        compared += 1
    return compared
