"""The rules on true rectangles, against hand numbers, the plain reference and whole cells."""

from __future__ import annotations

import itertools
import os
from typing import Any

import numpy as np
import pytest
import torch

from marl_pack import Packing, make_rule
from marl_pack.agents.heuristics import make_policy
from marl_pack.exact import reference
from marl_pack.exact.bins import ExactBins, placements
from marl_pack.exact.goods import Goods, check_goods
from marl_pack.exact.limits import SCALE
from marl_pack.exact.polygons import clip, convex_hull, deeper, has_area
from marl_pack.exact.spec import ExactSpec
from marl_pack.stability.static_equilibrium import in_equilibrium

STATES = int(os.environ.get("MARL_PACK_STATES", "300"))
"""Random states of each comparison; 10^5 for a release (docs/millimetres.md)."""
CHAIN = ("hull_alpha", "lbcp", "equilibrium", "hull_1")
ALWAYS = np.ones(1, np.bool_)


def goods(sides: Any, spec: ExactSpec, **attributes: Any) -> Goods:
    return check_goods(np.atleast_2d(sides), spec, attributes)


def bins_with(boxes: Any, spec: ExactSpec, **attributes: Any) -> ExactBins:
    """One bin with boxes that were placed without asking the rule."""
    bins = ExactBins(1, spec)
    sides = np.array(boxes, np.float64)[:, 3:] * spec.unit_mm
    everything = goods(sides, spec, **attributes)
    for i, box in enumerate(np.array(boxes, np.int64)):
        bins.add(box[None], everything[i : i + 1], ALWAYS)
    return bins


def allowed(boxes: Any, item: Any, at: tuple[int, int], **options: Any) -> bool:
    """Whether an item may stand at a corner, in orientation 0 and units of a millimetre."""
    spec = ExactSpec(bin_mm=(2000, 2000, 2000), unit_mm=1, orientations=(0,), **options)
    bins = bins_with(boxes, spec) if len(boxes) else ExactBins(1, spec)
    return len(bins.moves_at(0, goods(item, spec), np.array([at]))) == 1


# --- hand numbers ---------------------------------------------------------------------------------

PILLAR = [(0, 0, 0, 400, 300, 500)]


@pytest.mark.parametrize("rule", CHAIN)
def test_a_box_stands_if_its_middle_lies_inside_the_support(rule: str) -> None:
    # A box 600 long on a pillar 400 long: its middle is at 300 + x.
    assert allowed(PILLAR, (600, 300, 100), (99, 0), rule=rule)
    assert not allowed(PILLAR, (600, 300, 100), (100, 0), rule=rule)  # balanced on the edge
    assert not allowed(PILLAR, (600, 300, 100), (101, 0), rule=rule)


@pytest.mark.parametrize("rule", CHAIN)
def test_the_margin_is_a_distance_in_mm_and_at_most_a_share_of_the_shorter_side(rule: str) -> None:
    assert allowed(PILLAR, (600, 300, 100), (79, 0), rule=rule, margin_mm=20)
    assert not allowed(PILLAR, (600, 300, 100), (80, 0), rule=rule, margin_mm=20)
    # A box 600 × 40: a quarter of 40 is 10.
    assert allowed(PILLAR, (600, 40, 100), (89, 100), rule=rule, margin_mm=20)
    assert not allowed(PILLAR, (600, 40, 100), (90, 100), rule=rule, margin_mm=20)
    assert allowed(PILLAR, (600, 40, 100), (95, 100), rule=rule, margin_mm=20, margin_share=0.1)


def test_the_margin_holds_on_the_floor_only_if_it_is_asked_there() -> None:
    box = (60, 60, 60)
    assert allowed([], box, (0, 0), margin_mm=40, margin_share=1)
    assert not allowed([], box, (0, 0), margin_mm=30, margin_share=1, margin_on_floor=True)
    assert allowed([], box, (0, 0), margin_mm=29, margin_share=1, margin_on_floor=True)


def test_a_margin_of_a_slanted_edge_is_measured_at_right_angles() -> None:
    # Three pillars: the support is the triangle (0, 0), (100, 0), (0, 100) and their squares' hull.
    pillars = [(0, 0, 0, 10, 10, 50), (190, 0, 0, 10, 10, 50), (0, 190, 0, 10, 10, 50)]
    # The slanted edge runs from (200, 10) to (10, 200): x + y = 210. The middle is at (100, 100):
    # its distance is 10 / √2 = 7.07.
    for margin, stands in ((7, True), (7.1, False)):
        options = {"margin_mm": margin, "margin_share": 1}
        assert allowed(pillars, (200, 200, 10), (0, 0), rule="hull_1", **options) is stands


def test_lower_tops_support_within_the_level_tolerance() -> None:
    pillars = [(0, 0, 0, 100, 300, 500), (500, 0, 0, 100, 300, 497)]
    plank = (600, 300, 100)
    for rule in ("hull_1", "hull_alpha", "lbcp", "equilibrium"):
        assert not allowed(pillars, plank, (0, 0), rule=rule)
        assert not allowed(pillars, plank, (0, 0), rule=rule, level_tolerance_mm=2)
        assert allowed(pillars, plank, (0, 0), rule=rule, level_tolerance_mm=3)


def test_a_clearance_is_kept_to_walls_and_neighbours_but_not_to_supports() -> None:
    for x, fits in ((0, False), (4, False), (5, True)):
        assert allowed([], (100, 100, 100), (x, 5), clearance_mm=5) is fits
    for x, fits in ((400, False), (404, False), (405, True)):
        assert allowed(PILLAR, (100, 100, 100), (x, 5), clearance_mm=5) is fits
    assert allowed([(5, 5, 0, 400, 300, 500)], (400, 300, 100), (5, 5), clearance_mm=5)


def test_the_overhang_is_a_share_of_each_side_beyond_the_supporting_boxes() -> None:
    plank = (600, 300, 100)
    assert allowed(PILLAR, plank, (-0, 0), rule="none", max_overhang=0.34)
    assert not allowed(PILLAR, plank, (0, 0), rule="none", max_overhang=0.33)  # 200 of 600


def test_area_ratio_counts_area_and_corners() -> None:
    # 200 of 300 of the length rests: 2/3 of the area, two corners.
    assert not allowed(PILLAR, (300, 300, 50), (200, 0), rule="area_ratio")
    # Four corners and 60 % exactly: strictly more is asked.
    pillars = [(0, 0, 0, 30, 100, 50), (70, 0, 0, 30, 100, 50)]
    assert not allowed(pillars, (100, 100, 10), (0, 0), rule="area_ratio")
    pillars[0] = (0, 0, 0, 31, 100, 50)
    assert allowed(pillars, (100, 100, 10), (0, 0), rule="area_ratio")


def test_hull_alpha_asks_for_filled_ground_and_lbcp_for_a_polygon() -> None:
    table = [(0, 0, 0, 100, 100, 50), (500, 0, 0, 100, 100, 50), (0, 0, 50, 600, 100, 20)]
    box = (100, 100, 50)
    at = (250, 0)  # in the middle of the plank, above a gap
    assert not allowed(table, box, at, rule="hull_alpha")
    assert allowed(table, box, at, rule="lbcp")
    assert allowed(table, box, at, rule="equilibrium")


def test_equilibrium_sees_the_weights_and_the_other_rules_do_not() -> None:
    # A plank on a pillar, 40 % of it beyond: a box on the far end tips it, unless it is light.
    spec = ExactSpec(bin_mm=(2000, 2000, 2000), unit_mm=1, orientations=(0,), rule="equilibrium")
    stack = [(0, 0, 0, 600, 300, 500), (0, 0, 500, 1000, 300, 50)]
    corner = np.array([[800, 0]])
    for weight, stands in ((0.9, True), (1.1, False)):
        # The plank weighs 3 kg with its middle at 500; the box's middle is at 900 and the edge of
        # the pillar at 600: 3 · 100 against weight · 300.
        bins = bins_with(stack, spec, weights=[10.0, 3.0])
        light = goods((200, 300, 50), spec, weights=[weight])
        assert (len(bins.moves_at(0, light, corner)) == 1) is stands


# --- polygons -------------------------------------------------------------------------------------


def test_the_convex_hull_of_points_is_that_of_the_reference() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        points = rng.integers(0, 12, (int(rng.integers(1, 20)), 2))
        hull = np.empty((2 * len(points) + 1, 2), np.int64)
        size = convex_hull(points.copy(), len(points), hull)
        expected = reference.hull_of([tuple(p) for p in points.tolist()])
        if len(expected) > 2:
            assert [tuple(p) for p in hull[:size].tolist()] == expected
        else:
            assert size < 3


def test_a_clipped_polygon_lies_inside_the_exact_one_and_loses_less_than_a_lattice_point() -> None:
    rng = np.random.default_rng(1)
    for _ in range(300):
        points = rng.integers(-200, 200, (8, 2))
        hull = np.empty((17, 2), np.int64)
        size = convex_hull(points.copy(), 8, hull)
        x0, y0 = rng.integers(-200, 100, 2).tolist()
        x1, y1 = x0 + int(rng.integers(1, 200)), y0 + int(rng.integers(1, 200))
        out = np.empty((size + 8, 2), np.int64)
        n = clip(hull, size, x0, y0, x1, y1, out, 0)
        polygon = [tuple(p) for p in hull[:size].tolist()]
        exact = reference.clip(polygon, (x0, y0, x1, y1))
        for p in out[:n].tolist():
            assert x0 <= p[0] <= x1
            assert y0 <= p[1] <= y1
            assert all(reference.cross(a, b, p) >= 0 for a, b in reference.edges(polygon))
        assert has_area(out, 0, n) or not exact or _thin(exact)
        for p in exact:  # each exact corner has a rounded one beside it, if it is not a sliver
            near = np.abs(out[:n] - np.array([float(c) for c in p])).max(1) if n else np.array([9])
            assert near.min() < 1 or len(exact) < 3 or _thin(exact)


def _thin(polygon: Any) -> bool:
    area = sum(a[0] * b[1] - a[1] * b[0] for a, b in reference.edges(polygon))
    return float(area) < 400


def test_a_point_on_the_edge_is_not_deeper_than_nothing() -> None:
    square = np.array([(0, 0), (8, 0), (8, 8), (0, 8)])
    assert deeper(square, 4, 4, 4, 3)
    assert not deeper(square, 4, 4, 4, 4)
    assert not deeper(square, 4, 0, 4, 0)
    assert not deeper(square, 2, 4, 4, 0)


# --- random states --------------------------------------------------------------------------------


def random_stack(rng: np.random.Generator, rule: str, count: int, **options: Any) -> ExactBins:
    """A bin in which random boxes were placed at random by a rule."""
    spec = ExactSpec(bin_mm=(60, 50, 90), unit_mm=1, rule=rule, max_boxes=32, **options)
    bins = ExactBins(1, spec)
    for _ in range(count):
        item = goods(rng.integers(7, 34, 3), spec)
        moves = bins.moves(item).numbers
        if len(moves):
            bins.place(item, rng.choice(moves, 1))
    return bins


def as_rule(bins: ExactBins, rule: str, **options: Any) -> ExactBins:
    """The same boxes in a bin of another rule."""
    changed = {"rule": rule, "margin_mm": 0.0} | options
    return bins_with(bins.boxes(0), bins.spec.with_options(changed))


def verdicts(bins: ExactBins, item: Any, rule: str, **options: Any) -> set[tuple[int, ...]]:
    other = as_rule(bins, rule, **options)
    return set(map(tuple, placements(other.moves(goods(item, other.spec)).numbers).tolist()))


@pytest.mark.parametrize(("tolerance", "margin"), [(0, 0), (0, 3), (4, 0), (4, 2.5)])
def test_verdicts_are_those_of_the_reference(tolerance: int, margin: float) -> None:
    rng = np.random.default_rng(10 * tolerance + int(margin))
    pairs = ((0.6, 4), (0.8, 3), (0.95, 0))
    compared = 0
    for _ in range(STATES // 10):
        bins = random_stack(rng, "hull_1", 9, level_tolerance_mm=tolerance)
        item = rng.integers(7, 34, 3)
        boxes = bins.boxes(0).tolist()
        every = verdicts(bins, item, "none", level_tolerance_mm=tolerance)
        for rule in ("hull_1", "hull_alpha", "lbcp", "area_ratio"):
            options: dict[str, Any] = {"level_tolerance_mm": tolerance, "margin_share": 1}
            options |= {} if rule == "area_ratio" else {"margin_mm": margin}
            chosen = verdicts(bins, item, rule, **options)
            assert chosen <= every
            for o, x, y, z in sorted(every)[::7]:
                sides = [int(item[axis]) for axis in ORIENTATIONS[o]]
                assert z == reference.resting_height(boxes, x, y, *sides[:2])
                expected = reference.stable(
                    rule, boxes, (x, y, z, *sides), margin=margin, tolerance=tolerance,
                    thresholds=pairs,
                )  # fmt: skip
                assert ((o, x, y, z) in chosen) == expected, (rule, boxes, (o, x, y, z), item)
                compared += 1
    assert compared > 500 * STATES // 300


ORIENTATIONS = ((0, 1, 2), (1, 0, 2), (0, 2, 1), (2, 0, 1), (1, 2, 0), (2, 1, 0))


def test_each_rule_contains_the_stricter_ones() -> None:
    rng = np.random.default_rng(5)
    for k in range(STATES // 10):
        bins = random_stack(rng, CHAIN[k % 3], 10)
        item = rng.integers(7, 34, 3)
        sets = [verdicts(bins, item, rule) for rule in CHAIN]
        for inner, outer in itertools.pairwise(sets):
            assert inner <= outer


def test_whatever_a_sound_rule_places_stands_by_the_linear_program() -> None:
    rng = np.random.default_rng(6)
    for k in range(STATES // 10):
        rule = CHAIN[k % 3]
        bins = random_stack(rng, rule, 14)
        assert in_equilibrium(bins.boxes(0))
    tipped = sum(not in_equilibrium(random_stack(rng, "hull_1", 14).boxes(0)) for _ in range(20))
    assert tipped  # hull_1 is not sound: the check can fail


def test_equilibrium_is_that_of_the_whole_stack() -> None:
    rng = np.random.default_rng(7)
    seen = {True: 0, False: 0}
    for _ in range(STATES // 10):
        bins = random_stack(rng, "equilibrium", 10)
        item = rng.integers(7, 34, 3)
        chosen = verdicts(bins, item, "equilibrium")
        band = verdicts(bins, item, "hull_1") - verdicts(bins, item, "hull_alpha")
        for o, x, y, z in sorted(band)[:12]:
            sides = [int(item[axis]) for axis in ORIENTATIONS[o]]
            stands = in_equilibrium([*bins.boxes(0).tolist(), [x, y, z, *sides]])
            assert ((o, x, y, z) in chosen) == stands
            seen[stands] += 1
    assert seen[True]
    assert seen[False]


@pytest.mark.parametrize("rule", CHAIN)
def test_mirrored_stacks_have_mirrored_moves(rule: str) -> None:
    rng = np.random.default_rng(8)
    for _ in range(STATES // 30):
        bins = random_stack(rng, "equilibrium", 8)
        item = rng.integers(7, 34, 3)
        boxes = bins.boxes(0)
        mirrored = boxes.copy()
        mirrored[:, 0] = 60 - boxes[:, 0] - boxes[:, 3]
        here = verdicts(bins, item, rule)
        there = verdicts(bins_with(mirrored, bins.spec), item, rule)
        back = {(o, 60 - x - int(item[ORIENTATIONS[o][0]]), y, z) for o, x, y, z in there}
        assert here == back


def copied(game: Packing, spec: ExactSpec) -> tuple[ExactBins, Goods]:
    """The boxes of games on cells, and their visible items, in the exact world."""
    bins = ExactBins(game.n, spec)
    boxes, count = game.bins.boxes.numpy().astype(np.int64), game.bins.count.numpy()

    def record(sides: Any) -> Goods:
        n = len(sides)
        weights = sides.astype(np.float64).prod(1)  # the default weights of items on cells
        return Goods(
            sides, weights, np.ones((n, 6), np.bool_), np.ones(n, np.bool_), np.full(n, np.inf),
            np.full(n, "", object), 1.0,
        )  # fmt: skip

    for k in range(int(count.max())):
        bins.add(boxes[:, k], record(np.maximum(boxes[:, k, 3:], 1)), count > k)
    return bins, record(game.items.sides.numpy().astype(np.int64))


@pytest.mark.parametrize("rule", [*CHAIN, "area_ratio", "none"])
def test_on_whole_cells_both_worlds_agree(rule: str) -> None:
    rng = np.random.default_rng(9)
    size, games = (8, 7, 9), 32
    corners = np.stack(np.meshgrid(np.arange(8), np.arange(7), indexing="ij"), -1).reshape(-1, 2)
    legal = more = compared = 0
    while compared < STATES // 4:
        items = rng.integers(1, 6, (games, 14, 3))
        placed_by = str(rng.choice(CHAIN))
        if rule == "equilibrium":
            placed_by = "equilibrium"  # its stacks stand
        game = Packing(games, size, items=items, rule=placed_by, auto_reset=False)
        policy = make_policy("random", int(rng.integers(1 << 30)))
        for _ in range(int(rng.integers(3, 12))):
            if game.alive.any():
                game.place(*policy(game))
        margin = float(rng.choice([0, 0, 0.25, 0.5]))
        parameters = {} if rule in ("area_ratio", "none") else {"margin": margin}
        mask = make_rule(rule, **parameters)(game.bins, game.orient_item(game.items)).numpy()
        spec = ExactSpec(
            bin_mm=size, unit_mm=1, rule=rule, margin_mm=parameters.get("margin", 0),
            margin_share=1, margin_on_floor=True, max_boxes=32,
        )  # fmt: skip
        bins, items_now = copied(game, spec)
        for g in torch.nonzero(game.items.present).flatten().tolist():
            exact = np.zeros(mask[g].shape, np.bool_)
            rows = placements(bins.moves_at(g, items_now, corners))
            exact[rows[:, 0], rows[:, 1], rows[:, 2]] = True
            if rule == "lbcp":
                assert (mask[g] <= exact).all()
                more += int((exact & ~mask[g]).sum())
            else:
                assert (mask[g] == exact).all()
            legal += int(mask[g].sum())
            compared += 1
    assert legal > 100
    assert rule != "lbcp" or STATES < 300 or more


def test_a_polygon_of_four_corners_that_is_no_rectangle_is_not_the_whole_top() -> None:
    """Each box stands, and the last one tips the one below it."""
    boxes = [(0, 0, 0, 40, 100, 10), (90, 90, 0, 10, 10, 10), (0, 0, 10, 100, 100, 1),
             (0, 0, 11, 80, 60, 1)]  # fmt: skip
    last = (60, 0, 12, 20, 20, 380)
    assert not in_equilibrium([*map(list, boxes), list(last)])
    spec = ExactSpec(bin_mm=(100, 100, 400), unit_mm=1, rule="lbcp", orientations=(0,))
    bins = bins_with(boxes, spec)
    assert not len(bins.moves_at(0, goods(last[3:], spec), np.array([last[:2]])))
    assert not reference.stable("lbcp", boxes, last)


@pytest.mark.parametrize("rule", CHAIN[:3])
def test_stacks_of_round_sizes_stand(rule: str) -> None:
    """Round sizes meet at corners, where polygons have few corners."""
    rng = np.random.default_rng(11)
    spec = ExactSpec(bin_mm=(10, 10, 60), unit_mm=1, rule=rule, max_boxes=32)
    for _ in range(STATES // 5):
        bins = ExactBins(1, spec)
        for _ in range(14):
            sides = rng.integers(1, 11, 3)
            item = goods(sides, spec)
            moves = bins.moves(item).numbers
            if len(moves):
                bins.place(item, rng.choice(moves, 1))
        boxes = bins.boxes(0)
        assert in_equilibrium(boxes)
        if rule != "equilibrium":  # these rules are sound for any weights
            weights = 10.0 ** rng.integers(-2, 3, len(boxes))
            centres = boxes[:, :2] + boxes[:, 3:5] / 2
            assert in_equilibrium(boxes, np.column_stack((weights, centres)))


def test_cells_round_load_bearing_polygons_inward() -> None:
    """The case in which an exact polygon carries a box that cells refuse."""
    stack = [(0, 0, 0, 1, 1, 1), (5, 0, 0, 1, 1, 1), (0, 2, 0, 1, 1, 1), (0, 0, 1, 6, 3, 1)]
    spec = ExactSpec(bin_mm=(6, 3, 5), unit_mm=1, rule="lbcp", orientations=(0,))
    item = goods((4, 1, 1), spec)
    assert len(bins_with(stack, spec).moves_at(0, item, np.array([[1, 1]]))) == 1


def test_scale_is_even() -> None:
    assert SCALE % 2 == 0  # the middle of a box of odd length lies on the lattice
