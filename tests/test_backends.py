"""Every backend gives the results of the reference, or of the other backends, cell by cell."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import boxes_of, in_play, off_centre, random_maps, random_play, some_items

from marl_pack import bins as state
from marl_pack.agents.afterstates.afterstates import Afterstates, afterstates_of, probe_lengths
from marl_pack.agents.afterstates.features import features
from marl_pack.backend import Backend
from marl_pack.bins import Bins
from marl_pack.geometry import resting_heights_and_waste
from marl_pack.stability import (
    RULES,
    OrientedItem,
    hull_alpha,
    make_rule,
    orient_item,
    reference,
)
from marl_pack.stability.load_bearing import lbcp_bearing
from marl_pack.stability.parameters import check_thresholds

PLACES = [((5, 5, 6), (1, 4)), ((7, 4, 9), (1, 5)), ((10, 10, 10), (2, 5)), ((3, 8, 200), (1, 7))]
LARGE_SIZES = [(10, 10, 10), (40, 30, 50), (33, 64, 300)]
GAMES = (
    {},
    {"bin": (6, 5, 7), "sides": (1, 3)},
    {"orientations": (0, 3)},
    {"bin": (16, 12, 20), "sides": (3, 12)},
    {"bin": (10, 10, 4), "items": "cut1"},
    {"com_offset": (0.3, 0.2, 0.0)},
    {"bin": (3, 40, 9), "sides": (1, 3)},
    {"bin": (64, 2, 9), "sides": (1, 2)},
    {"bin": (14, 6, 6), "items": [[2, 2, 2], [13, 2, 2], [3, 4, 5]] * 4},
)

every_backend = pytest.mark.parametrize("backend", Backend)


def expected(
    bins: Bins, item: OrientedItem, stands: Callable[[int, int, int, int, int, int], bool]
) -> np.ndarray:
    """Every cell by ``stands(bin, orientation, x, y, w, d)``, in a loop."""
    return np.array(
        [
            [
                reference.window_mask(
                    lambda x, y, b=b, a=a, w=w, d=d: stands(b, a, x, y, w, d),
                    bins.heightmap[b].numpy(),
                    (w, d, h),
                    bins.height,
                )
                for a, (w, d, h) in enumerate(item.sides[b].tolist())
            ]
            for b in range(len(bins))
        ]
    )


@every_backend
@pytest.mark.parametrize("size", [(6, 9, 20), (12, 4, 40)])
def test_placed_boxes_change_the_bins_as_the_reference_does(
    backend: Backend, size: tuple[int, int, int]
) -> None:
    generator = torch.Generator().manual_seed(1)
    n, steps = 20, 15
    bins = state.empty(n, size, max_boxes=steps, backend=backend)
    maps = np.zeros((n, 2, *size[:2]), np.int64)
    rows: list[list[list[float]]] = [[] for _ in range(n)]
    for step in range(steps):
        sides = torch.randint(0, 5, (n, 3), generator=generator).short()
        corners = torch.stack(
            [torch.randint(0, s - 3, (n,), generator=generator) for s in size[:2]], 1
        )
        weights = torch.rand(n, generator=generator) if step % 2 else None
        com = torch.rand(n, 2, generator=generator).double() if step % 3 else None
        labels = None
        if step % 4:
            labels = tuple(torch.randint(0, 6, (2, n), generator=generator))
        heights, waste, volume = state.place(bins, sides, corners, weights, com, labels)
        for b in range(n):
            (x, y), (w, d, h) = corners[b].tolist(), sides[b].tolist()
            if min(w, d, h) == 0:
                assert (heights[b], waste[b], volume[b]) == (0, 0, 0)
                continue
            z, wasted = reference.place_box(maps[b, 0], maps[b, 1], (x, y), (w, d, h))
            assert (heights[b], waste[b], volume[b]) == (z, wasted, w * d * h)
            centre = [w / 2, d / 2] if com is None else com[b].tolist()
            load = [
                w * d * h if weights is None else float(weights[b]),
                x + centre[0],
                y + centre[1],
            ]
            label = [-1, -1] if labels is None else [int(values[b]) for values in labels]
            rows[b].append([x, y, z, w, d, h, *load, *label])
    assert (bins.heightmap.numpy() == maps[:, 0]).all()
    assert (bins.empty_map.numpy() == maps[:, 1]).all()
    assert (bins.filled.numpy() == (maps[:, 0] - maps[:, 1]).sum((1, 2))).all()
    table = torch.cat((bins.boxes.double(), bins.loads, bins.labels.double()), 2)
    for b in range(n):
        assert int(bins.count[b]) == len(rows[b])
        assert table[b, : len(rows[b])].tolist() == rows[b]


@every_backend
@pytest.mark.parametrize(("size", "sides"), PLACES)
def test_resting_heights_and_waste_equal_the_reference(
    backend: Backend, size: tuple[int, int, int], sides: tuple[int, int]
) -> None:
    bins = random_maps(6, size, sides, 12, seed=2)
    item = orient_item(some_items(6, (1, 5), 3))
    item.sides[0, 2] = 0
    heights, waste = resting_heights_and_waste(
        bins.heightmap, item.sides, bins.height, backend=backend
    )
    for b, a, x, y in np.ndindex(*heights.shape):
        w, d, h = item.sides[b, a].tolist()
        want = (bins.height, 0)
        if min(w, d, h) > 0 and x + w <= size[0] and y + d <= size[1]:
            maps = np.array(bins.heightmap[b].numpy(), np.int64), np.zeros(size[:2], int)
            want = reference.place_box(*maps, (x, y), (w, d, h))
        assert (heights[b, a, x, y], waste[b, a, x, y]) == want
    alone, none = resting_heights_and_waste(
        bins.heightmap, item.sides, bins.height, waste=False, backend=backend
    )
    assert torch.equal(alone, heights)
    assert none.numel() == 0


@every_backend
@pytest.mark.parametrize(("size", "sides"), PLACES)
@pytest.mark.parametrize("margin", [0.0, 0.5, 0.8])
@pytest.mark.parametrize("com", ["central", "off centre"])
@pytest.mark.parametrize("rule", ["hull_1", "hull_alpha", "lbcp"])
def test_hull_masks_equal_the_reference(
    backend: Backend,
    size: tuple[int, int, int],
    sides: tuple[int, int],
    margin: float,
    com: str,
    rule: str,
) -> None:
    bins = replace(random_maps(12, size, sides, 12, seed=1), backend=backend)
    items = some_items(12, sides, 2)
    item = orient_item(items) if com == "central" else off_centre(items, 3)
    bearing = {
        "hull_1": np.ones(bins.empty_map.shape, bool),
        "hull_alpha": bins.empty_map.numpy() == 0,
        "lbcp": np.array([reference.lbcp_bearing(size[:2], boxes_of(bins, b)) for b in range(12)]),
    }[rule]

    def stands(b: int, a: int, x: int, y: int, w: int, d: int) -> bool:
        window = np.s_[b, x : x + w, y : y + d]
        centre = item.exact_centre(a, w, d)
        return reference.hull(bins.heightmap.numpy()[window], bearing[window], centre, margin)

    mask = make_rule(rule, margin=margin)(bins, item)
    assert (mask.numpy() == expected(bins, item, stands)).all()


@every_backend
@pytest.mark.parametrize(
    ("margin", "offset"), [(0.0, 0.0), (0.5, 0.0), (0.0, 0.1), (0.5, 0.1), (1.3, 0.1)]
)
def test_hull_masks_of_rough_maps_equal_the_reference(
    backend: Backend, margin: float, offset: float
) -> None:
    # Few columns stand one cell higher, so most windows rest on two to six of them.
    high = np.random.default_rng(0).random((2, 14, 15)) < 0.15
    bins = replace(state.empty(2, (14, 15, 9), 1), heightmap=torch.from_numpy(high).short())
    item = OrientedItem(
        torch.tensor([[[6, 5, 2], [5, 6, 2]]] * 2).short(), ((offset, -offset),) * 2
    )
    bins = replace(bins, backend=backend)

    def stands(b: int, a: int, x: int, y: int, w: int, d: int) -> bool:
        window = np.s_[b, x : x + w, y : y + d]
        heights = bins.heightmap.numpy()[window]
        return reference.hull(heights, heights >= 0, item.exact_centre(a, w, d), margin)

    mask = make_rule("hull_alpha", margin=margin)(bins, item)
    assert (mask.numpy() == expected(bins, item, stands)).all()


@every_backend
@pytest.mark.parametrize(("size", "sides"), PLACES)
@pytest.mark.parametrize("thresholds", ["paper", "code"])
def test_area_masks_equal_the_reference(
    backend: Backend, size: tuple[int, int, int], sides: tuple[int, int], thresholds: str
) -> None:
    bins = replace(random_maps(12, size, sides, 12, seed=4), backend=backend)
    item = orient_item(some_items(12, sides, 5))
    pairs = check_thresholds(thresholds)

    def stands(b: int, a: int, x: int, y: int, w: int, d: int) -> bool:
        return reference.area_ratio(bins.heightmap[b, x : x + w, y : y + d].numpy(), pairs)

    mask = make_rule("area_ratio", thresholds=thresholds)(bins, item)
    assert (mask.numpy() == expected(bins, item, stands)).all()


@every_backend
@pytest.mark.parametrize("seed", range(3))
def test_load_bearing_maps_equal_the_reference(backend: Backend, seed: int) -> None:
    bins = random_maps(60, (8, 7, 25), (1, 6), 15, seed=seed)
    bearing = lbcp_bearing(replace(bins, backend=backend))
    for b in range(60):
        want = reference.lbcp_bearing((8, 7), boxes_of(bins, b))
        assert (bearing[b].numpy() == want).all()
    assert (bearing & (bins.empty_map > 0)).any()  # some gaps do carry


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("size", LARGE_SIZES)
def test_masks_of_larger_maps_are_equal(rule: str, size: tuple[int, int, int]) -> None:
    longest = min(size) // 2
    n = 3 if rule == "equilibrium" and size != (10, 10, 10) else 24
    play = hull_alpha_play if rule == "equilibrium" else random_maps
    bins = play(n, size, (2, longest), 25, seed=6)
    margins = (0.0, 1.3) if rule in ("hull_1", "hull_alpha", "lbcp") else (0.0,)
    for margin in margins:
        bound = make_rule(rule, **({"margin": margin} if margin else {}))
        for seed in range(1 if n == 3 else 3):
            items = some_items(n, (2, longest), seed)
            for item in (orient_item(items), off_centre(items, seed)):
                masks = [bound(replace(bins, backend=backend), item) for backend in Backend]
                for mask in masks[1:]:
                    assert torch.equal(mask, masks[0])


@pytest.mark.parametrize("size", [(12, 9, 130), (24, 20, 16), (26, 20, 16)])
def test_masks_of_rough_maps_are_equal(size: tuple[int, int, int]) -> None:
    """Where columns differ at random, the quadrants leave many windows to the exact test."""
    generator = torch.Generator().manual_seed(3)
    bins = state.empty(8, size, 0)
    bins.heightmap.copy_(torch.rand(bins.heightmap.shape, generator=generator) < 0.1)
    bins.empty_map.copy_(torch.rand(bins.heightmap.shape, generator=generator) < 0.2)
    bins.heightmap[::2] *= size[2] - 4  # the largest numbers
    for items in (some_items(8, (2, 4), 1), some_items(8, (3, 9), 2), some_items(8, (6, 12), 3)):
        for item in (orient_item(items), off_centre(items, 4)):
            for margin in (0.0, 0.7):
                compiled, tensor = (
                    hull_alpha(replace(bins, backend=backend), item, margin) for backend in Backend
                )
                assert torch.equal(compiled, tensor)
                assert compiled.any()


def hull_alpha_play(
    n: int, size: tuple[int, int, int], sides: tuple[int, int], steps: int, seed: int
) -> Bins:
    """N bins of stacks in equilibrium."""
    return random_play(hull_alpha, n, size, sides, steps, seed)


@every_backend
@pytest.mark.parametrize("rule", RULES)
def test_no_bins_and_orientations_that_are_not_allowed_have_no_cell(
    backend: Backend, rule: str
) -> None:
    bins = state.empty(2, (4, 5, 6), backend=backend)
    sides = torch.full((2, 6, 3), 2, dtype=torch.int16)
    sides[:, 1::2, 0] = 0
    mask = make_rule(rule)(bins, OrientedItem(sides))
    assert not mask[:, 1::2].any()
    assert mask[:, ::2].sum() == 2 * 3 * 3 * 4
    none = make_rule(rule)(bins[:0], OrientedItem(sides[:0]))
    assert none.shape == (0, 6, 4, 5)


def fields_of(
    left: Afterstates, mask: torch.Tensor, allowed: tuple[int, ...]
) -> list[torch.Tensor]:
    """Every value of each placement, on the bins' maps."""
    numbers = [
        left.counts.flatten(1), left.surface, left.volume[:, None], left.waste[:, None],
        left.filled[:, None], left.feasible_cells()[:, None],
        left.feasible_probability({allowed: 1.0})[:, None],
        left.feasible_probability({(0, 1): 0.3, allowed: 0.7})[:, None],
        features(left, 10_000),
    ]  # fmt: skip
    return [torch.where(mask[..., None], values[left.index], 0) for values in numbers]


@pytest.mark.parametrize("settings", [*GAMES, {"bin": (18, 18, 18), "sides": (4, 17)}])
def test_afterstates_are_equal(settings: dict[str, object]) -> None:
    game = in_play(6, 9, **settings)
    sides = game.orient_item(game.items).sides
    lengths = probe_lengths(*game.stream.sides)
    by_backend = [
        fields_of(
            afterstates_of(replace(game.bins, backend=backend), sides, game.mask, lengths),
            game.mask,
            game.spec.orientations,
        )
        for backend in Backend
    ]
    for one, other in zip(*by_backend, strict=True):
        if one.is_floating_point():
            assert torch.allclose(one.double(), other.double(), rtol=0, atol=1e-6)
        else:
            assert torch.equal(one, other)
