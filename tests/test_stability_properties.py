"""Properties of every state: the rules' order and their symmetry."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import boxes_of, off_centre, random_maps, random_play, some_items
from hypothesis import given, settings
from hypothesis import strategies as st
from test_backends import PLACES

from marl_pack import bins as state
from marl_pack.backend import Backend
from marl_pack.bins import Bins
from marl_pack.stability import (
    RULES,
    OrientedItem,
    equilibrium,
    equilibrium_masks,
    hull_1,
    hull_alpha,
    in_equilibrium,
    lbcp,
    make_rule,
    orient_item,
    reference,
    stable_mask,
)
from marl_pack.stability.paper import convex_hull_alpha
from marl_pack.stability.reduced_equilibrium import UNSURE
from marl_pack.stability.static_equilibrium import least_force

# --- the hull test against other codes ------------------------------------------------------------


@pytest.mark.parametrize(("size", "sides"), PLACES)
def test_hull_alpha_equals_opencvs_hull_of_the_squares_corners(
    size: tuple[int, int, int], sides: tuple[int, int]
) -> None:
    bins = random_maps(12, size, sides, 12, seed=7)
    item = orient_item(some_items(12, sides, 8))

    masks = hull_alpha(bins, item).numpy()
    for b, oriented in enumerate(item.sides.tolist()):
        maps = bins.heightmap[b].numpy(), bins.empty_map[b].numpy()
        for a, sides_a in enumerate(oriented):
            expected = convex_hull_alpha(*maps, tuple(sides_a), bins.height, "squares")
            assert (masks[b, a] == expected).all()


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**36 - 1), st.floats(-0.49, 0.49), st.floats(-0.49, 0.49), st.floats(0, 2))
def test_any_pattern_of_contact_is_judged_as_the_reference_does(
    bits: int, x: float, y: float, margin: float
) -> None:
    cells = np.array([bits >> k & 1 for k in range(36)], dtype=bool).reshape(6, 6)
    heights = torch.from_numpy(cells.astype(np.int16))[None]
    item = OrientedItem(
        torch.tensor([[[6, 6, 1]]], dtype=torch.int16),
        ((x, y),),
    )
    contact = cells if cells.any() else ~cells
    for backend in Backend:
        bins = state.empty(1, (6, 6, 5), max_boxes=0, backend=backend)
        bins.heightmap.copy_(heights)
        mask = hull_1(bins, item, margin)
        assert bool(mask[0, 0, 0, 0]) == reference.supported(
            contact, item.exact_centre(0, 6, 6), margin
        )


# --- the order of the rules -----------------------------------------------------------------------


def assert_order(bins: Bins, item: OrientedItem) -> tuple[int, int, int, int]:
    alpha, load, exact, one = (rule(bins, item) for rule in (hull_alpha, lbcp, equilibrium, hull_1))
    assert not (alpha & ~load).any()
    assert not (load & ~exact).any()
    assert not (exact & ~one).any()
    return tuple(int(m.sum()) for m in (alpha, load, exact, one))


@pytest.mark.parametrize("rule", ["hull_alpha", "lbcp", "equilibrium"])
@pytest.mark.parametrize(("size", "sides"), PLACES)
def test_alpha_within_lbcp_within_equilibrium_within_hull_1(
    rule: str, size: tuple[int, int, int], sides: tuple[int, int]
) -> None:
    bins = random_play(make_rule(rule), 60, size, sides, 14, seed=9)
    sizes = assert_order(bins, orient_item(some_items(60, sides, 10)))
    if size == (10, 10, 10):
        assert sizes[0] < sizes[1] < sizes[2] < sizes[3]  # the inclusions are strict


def test_the_order_holds_on_every_small_stack_of_three() -> None:
    """All stacks of three boxes of sides 1 … 3 (heights 1, 3) in a 1 x 5 slice of space."""
    kinds = [(1, d, h) for d in (1, 2, 3) for h in (1, 3)]
    places = [(d, h, y) for _, d, h in kinds for y in range(5 - d + 1)]
    pairs = list(itertools.product(places, repeat=2))
    bins = state.empty(len(pairs), (1, 5, 9), max_boxes=3)
    for k in range(2):
        sides = torch.tensor([[1, p[k][0], p[k][1]] for p in pairs], dtype=torch.int16)
        allowed = equilibrium(bins, OrientedItem(sides[:, None]))[:, 0, 0]
        cell = torch.tensor([p[k][2] for p in pairs])
        stands = allowed.gather(1, cell[:, None]).squeeze(1)
        corner = torch.stack((torch.zeros_like(cell), cell), 1)
        state.place(bins, torch.where(stands[:, None], sides, 0), corner)
    for kind in kinds:
        item = OrientedItem(torch.tensor(kind, dtype=torch.int16).expand(len(pairs), 1, 3))
        exact = equilibrium(bins, item)
        assert_order(bins, item)
        for b in range(0, len(pairs), 7):
            for y in range(5 - kind[1] + 1):
                z = int(bins.heightmap[b, 0, y : y + kind[1]].max())
                if z + kind[2] > 9:
                    continue
                stack = np.vstack((boxes_of(bins, b), [0, y, z, *kind]))
                assert in_equilibrium(stack) == bool(exact[b, 0, 0, y])


@pytest.mark.parametrize("rule", ["hull_alpha", "lbcp", "equilibrium"])
def test_stacks_built_under_a_sound_rule_stand_as_a_whole(rule: str) -> None:
    for size, sides in PLACES:
        bins = random_play(make_rule(rule), 40, size, sides, 20, seed=11)
        assert all(in_equilibrium(boxes_of(bins, b)) for b in range(40))


def test_stacks_built_under_hull_1_often_do_not_stand() -> None:
    bins = random_play(hull_1, 100, (10, 10, 10), (2, 5), 20, seed=12)
    share = np.mean([in_equilibrium(boxes_of(bins, b)) for b in range(100)])
    assert 0.5 < share < 0.99


@pytest.mark.parametrize("rule", ["hull_alpha", "lbcp", "equilibrium"])
def test_sound_rules_hold_whatever_the_centre_of_mass_is_if_it_is_known(rule: str) -> None:
    bound = make_rule(rule)
    bins = state.empty(60, (8, 8, 30), max_boxes=15)
    generator = torch.Generator().manual_seed(13)
    for step in range(15):
        item = off_centre(some_items(60, (1, 5), 100 + step), step)
        item = OrientedItem(item.sides[:, :1], item.offsets[:1])
        allowed = bound(bins, item)[:, 0].flatten(1)
        cell = torch.multinomial(allowed.float() + 1e-12, 1, generator=generator)[:, 0]
        stands = allowed.gather(1, cell[:, None])
        corner = torch.stack((cell // 8, cell % 8), 1)
        sides = torch.where(stands, item.sides[:, 0], 0)
        state.place(bins, sides, corner, com=item.centre_table(0.0, 8).cells(item.sides)[:, 0])
    for b in range(60):
        n = int(bins.count[b])
        assert in_equilibrium(bins.boxes[b, :n].numpy(), bins.loads[b, :n].numpy())


def test_hull_alpha_and_lbcp_hold_for_any_weights() -> None:
    generator = np.random.default_rng(14)
    for rule in (hull_alpha, lbcp):
        bins = random_play(rule, 40, (8, 8, 20), (1, 5), 15, seed=15)
        for b in range(40):
            n = int(bins.count[b])
            loads = bins.loads[b, :n].numpy().copy()
            loads[:, 0] = 10 ** generator.uniform(-2, 2, n)
            assert least_force(bins.boxes[b, :n].numpy(), loads) > 0


STRICT = 1e-9
"""Least force that counts as positive in float64; whole and half cells leave none near it."""

# --- exact equilibrium against a library's solver -------------------------------------------------


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("rule", ["hull_alpha", "equilibrium"])
def test_reduced_equilibrium_equals_the_whole_stacks_linear_program(
    rule: str, weighted: bool
) -> None:
    bins = random_play(make_rule(rule), 60, (7, 7, 12), (1, 5), 16, seed=16)
    items = some_items(60, (1, 5), 17)
    weight = None
    if weighted:
        weight = (
            torch.rand(60, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 99
        )
    item = orient_item(items, weight)
    exact, band = equilibrium(bins, item), hull_1(bins, item) & ~hull_alpha(bins, item)
    checked, positive = 0, []
    for b, a, x, y in band.nonzero().tolist()[:400]:
        w, d, h = item.sides[b, a].tolist()
        z = int(bins.heightmap[b, x : x + w, y : y + d].max())
        n = int(bins.count[b])
        boxes = np.vstack((bins.boxes[b, :n].numpy(), [x, y, z, w, d, h]))
        load = [float(item.weights()[b]), x + w / 2, y + d / 2]
        force = least_force(boxes, np.vstack((bins.loads[b, :n].numpy(), load)))
        assert (force > STRICT) == bool(exact[b, a, x, y])
        checked += 1
        if force > STRICT:
            positive.append(force)
        else:
            assert force < 1e-12  # nothing lies near the threshold
    assert checked > 100
    assert min(positive) > 1e3 * STRICT


@pytest.mark.parametrize(
    ("size", "sides", "steps"), [((12, 9, 400), (1, 7), 60), ((40, 40, 120), (4, 20), 60)]
)
def test_reduced_equilibrium_equals_the_linear_program_on_tall_stacks(
    size: tuple[int, int, int], sides: tuple[int, int], steps: int
) -> None:
    bins = random_play(equilibrium, 8, size, sides, steps, seed=30)
    item = orient_item(some_items(8, sides, 31))
    exact, band = equilibrium(bins, item), hull_1(bins, item) & ~hull_alpha(bins, item)
    cells = band.nonzero()
    assert len(cells) > 100
    for b, a, x, y in cells[:: len(cells) // 60].tolist():
        w, d, h = item.sides[b, a].tolist()
        z = int(bins.heightmap[b, x : x + w, y : y + d].max())
        stack = np.vstack((boxes_of(bins, b), [x, y, z, w, d, h]))
        assert in_equilibrium(stack) == bool(exact[b, a, x, y])


@pytest.mark.parametrize(
    ("name", "size", "verdict"),
    [("falls", (12, 9, 400), False), ("stands", (120, 120, 240), True)],
)
def test_the_simplex_solves_deep_degenerate_stacks(
    name: str, size: tuple[int, int, int], verdict: bool
) -> None:
    # Eighty and forty boxes deep: most pivots are degenerate, and small ones make large errors.
    with np.load(Path(__file__).parent / "data" / "hard_stacks.npz") as archive:
        boxes = archive[name]
    heights, empty_map = np.zeros(size[:2], int), np.zeros(size[:2], int)
    for x, y, _, w, d, h in boxes[:-1].tolist():
        reference.place_box(heights, empty_map, (x, y), (w, d, h))
    last = boxes[-1]
    mask = stable_mask("equilibrium", heights, empty_map, last[3:], size[2], boxes[:-1])
    assert mask[last[0], last[1]] == in_equilibrium(boxes) == verdict


def test_fractions_decide_where_the_simplex_is_unsure(monkeypatch: pytest.MonkeyPatch) -> None:
    bins = random_play(hull_alpha, 6, (7, 7, 12), (1, 5), 12, seed=32)
    item = orient_item(some_items(6, (1, 5), 33))
    expected_mask = equilibrium(bins, item)

    def unsure(*arrays: np.ndarray) -> None:
        *_, band, verdict = arrays
        verdict[band] = UNSURE

    monkeypatch.setattr(equilibrium_masks, "_solve_band", unsure)
    assert torch.equal(equilibrium(bins, item), expected_mask)


def test_equilibrium_with_a_margin_needs_every_position_of_the_centre() -> None:
    bins = random_play(hull_alpha, 60, (7, 7, 12), (1, 5), 16, seed=18)
    item = orient_item(some_items(60, (1, 5), 19))
    free, strict = equilibrium(bins, item), equilibrium(bins, item, margin=0.4)
    assert not (strict & ~free).any()
    assert strict.sum() < free.sum()
    for dx, dy in ((0.4, 0), (-0.4, 0), (0, 0.4), (0, -0.4), (0.28, -0.28)):
        for b, a in itertools.product(range(20), range(6)):
            w, d, _ = item.sides[b, a].tolist()
            moved = OrientedItem(item.sides[b : b + 1, a : a + 1], ((dx / w, dy / d),))
            assert not (strict[b, a] & ~equilibrium(bins[b : b + 1], moved)[0, 0]).any()


# --- symmetry and independence --------------------------------------------------------------------


def mirrored(bins: Bins) -> Bins:
    """The bins mirrored along x."""
    boxes, loads = bins.boxes.clone(), bins.loads.clone()
    width = bins.size[0]
    boxes[..., 0] = width - boxes[..., 0] - boxes[..., 3]
    loads[..., 1] = width - loads[..., 1]
    maps = bins.heightmap.flip(1), bins.empty_map.flip(1)
    return replace(bins, heightmap=maps[0], empty_map=maps[1], boxes=boxes, loads=loads)


def transposed(bins: Bins) -> Bins:
    """The bins with x and y exchanged."""
    boxes, loads = bins.boxes[..., [1, 0, 2, 4, 3, 5]], bins.loads[..., [0, 2, 1]]
    maps = bins.heightmap.transpose(1, 2), bins.empty_map.transpose(1, 2)
    heightmap, empty_map = (values.contiguous() for values in maps)
    return replace(bins, heightmap=heightmap, empty_map=empty_map, boxes=boxes, loads=loads)


@pytest.mark.parametrize("rule", RULES)
def test_masks_follow_the_bins_symmetries(rule: str) -> None:
    bound = make_rule(rule)
    bins = random_play(hull_alpha, 30, (8, 6, 12), (1, 5), 14, seed=20)
    item = orient_item(some_items(30, (1, 5), 21))
    mask = bound(bins, item)
    reflected = bound(mirrored(bins), item)
    for b, a, x, y in mask.nonzero().tolist():
        assert reflected[b, a, 8 - x - int(item.sides[b, a, 0]), y]
    assert mask.sum() == reflected.sum()
    # Exchanging x and y exchanges the orientations o and o ^ 1.
    swapped = bound(transposed(bins), item)
    assert torch.equal(swapped[:, [1, 0, 3, 2, 5, 4]].transpose(2, 3), mask)


@pytest.mark.parametrize("rule", RULES)
def test_a_bins_mask_does_not_depend_on_the_others(rule: str) -> None:
    bound = make_rule(rule)
    bins = random_play(hull_alpha, 20, (10, 10, 10), (2, 5), 10, seed=22)
    item = orient_item(some_items(20, (2, 5), 23))
    together = bound(bins, item)
    for b in (0, 7, 19):
        alone = torch.tensor([b])
        assert torch.equal(bound(bins[alone], item[alone])[0], together[b])


def test_an_orientation_that_is_not_allowed_changes_no_other_ones_mask() -> None:
    bins = random_play(hull_alpha, 40, (7, 7, 12), (1, 5), 14, seed=25)
    sides = some_items(40, (1, 5), 26)
    item, others = orient_item(sides), orient_item(sides)
    others.sides[:, 0] = 0
    for rule in RULES:
        bound = make_rule(rule)
        assert torch.equal(bound(bins, others)[:, 1:], bound(bins, item)[:, 1:])


def test_orientations_with_a_zero_side_have_no_cell() -> None:
    bins = random_play(hull_alpha, 8, (6, 6, 9), (1, 4), 6, seed=24)
    for rule in RULES:
        for axis in range(3):
            sides = torch.full((8, 6, 3), 2, dtype=torch.int16)
            sides[:, ::2, axis] = 0
            mask = make_rule(rule)(bins, OrientedItem(sides))
            assert not mask[:, ::2].any()
            assert mask[:, 1::2].any()
