"""Games in millimetres: lengths, goods, bins, heuristics, streams and files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marl_pack import ExactPacking, ExactSpec, make_exact_policy, stable_place
from marl_pack.exact import reference
from marl_pack.exact.bins import NOWHERE, ExactBins, placements
from marl_pack.exact.choice import LINEAR, best_of, waste_of
from marl_pack.exact.features import FEATURES
from marl_pack.exact.goods import Goods, check_goods
from marl_pack.exact.lengths import to_mm, to_units
from marl_pack.exact.moves import encode
from marl_pack.exact.policies import HEURISTICS, linear_weights
from marl_pack.exact.present import check_present
from marl_pack.exact.streams import Draws, Given, make_goods_stream, read_goods
from marl_pack.plan import Plan
from marl_pack.stability.static_equilibrium import in_equilibrium

SMALL = ExactSpec(bin_mm=(60, 50, 90), unit_mm=1, max_boxes=64)


def goods(sides: Any, spec: ExactSpec = SMALL, **attributes: Any) -> Goods:
    return check_goods(np.atleast_2d(sides), spec, attributes)


def play_random(bins: ExactBins, everything: Goods, rng: np.random.Generator) -> list[int]:
    """Place goods at random, one after the other; return the rows that had a place."""
    placed = []
    for row in range(len(everything)):
        item = everything[row : row + 1]
        moves = bins.moves(item).numbers
        if len(moves):
            bins.place(item, rng.choice(moves, 1))
            placed.append(row)
    return placed


# --- lengths --------------------------------------------------------------------------------------


def test_lengths_are_exact_and_finer_ones_are_not_rounded() -> None:
    units, wrong = to_units([0.1, 0.3, 1234.5, 0.25, 1e-9, np.nan, np.inf, 1e9], 0.1)
    assert units.tolist()[:3] == [1, 3, 12345]
    assert wrong.tolist() == [False, False, False, True, True, True, True, True]
    assert to_mm(units[:3], 0.1).tolist() == [0.1, 0.3, 1234.5]
    single = np.array([0.3], np.float32)  # means 0.3, as it is printed
    assert to_units(single, 0.1)[0].tolist() == [3]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bin_mm": (1, 2)}, "needs three lengths"),
        ({"bin_mm": (100, 100, 0)}, "needs three lengths in millimetres > 0"),
        ({"bin_mm": (100.05, 100, 100)}, "whole units of 0.1 mm"),
        ({"bin_mm": (1e7, 100, 100)}, "at most 1000000 of them"),
        ({"clearance_mm": 0.01}, "clearance_mm = 0.01: needs whole units"),
        ({"level_tolerance_mm": -1}, "level_tolerance_mm = -1: needs a length"),
        ({"margin_mm": np.nan}, "margin_mm = nan: needs a finite number"),
        ({"margin_share": 1.5}, "margin_share = 1.5: needs a share from 0 to 1"),
        ({"rule": "lbpc"}, "did you mean 'lbcp'"),
        ({"rule": "none", "margin_mm": 5}, "the rule none has no margin"),
        ({"thresholds": "paper"}, "only the rule area_ratio has them"),
        ({"max_boxes": 0}, "max_boxes: needs a whole number from 1"),
        ({"max_weight_kg": 0}, "max_weight_kg = 0: needs a weight > 0"),
        ({"orientations": (7,)}, "need one or more of 0 … 5"),
        ({"unit_mm": 0}, "unit_mm 0: needs a number of millimetres"),
    ],
)
def test_an_impossible_option_is_refused_with_what_would_be_right(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        ExactSpec(**options)


def test_an_unknown_option_is_refused_with_the_nearest_one() -> None:
    with pytest.raises(TypeError, match="did you mean 'margin_mm'"):
        ExactPacking(1, [[10, 10, 10]], margin_m=3)


# --- goods ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sides", "attributes", "message"),
    [
        ([[10, 10]], {}, "needs rows of three numbers"),
        ([[10, 10, 10], [10, 0, 10]], {}, r"row 1 is \[10\.0, 0\.0, 10\.0\]: zero or negative"),
        ([[10, 10, np.nan]], {}, "needs finite numbers"),
        ([[10, 10, 1.5]], {}, "needs whole units of 1 mm; choose a smaller unit"),
        ([[10, 10, 91]], {}, "fits into the bin of 60 x 50 x 90 mm in none"),
        ([[70, 10, 10]], {"upright": [True]}, "fits into the bin"),
        ([[10, 10, 10]], {"weights": [-1.0]}, "weight_kg -1.0; needs a positive number"),
        ([[10, 10, 10]], {"weights": [1.0, 2.0]}, "needs one value for each of 1 rows"),
        ([[10, 10, 10]], {"max_load": [-2]}, "max_load_kg -2; needs a number ≥ 0"),
        ([[10, 10, 10]], {"stackable": ["perhaps"]}, "stackable 'perhaps'; needs true or false"),
        ([[10, 10, 10]], {"upright": [True], "orientations": [[2]]}, "may only be 0 and 1"),
        ([[10, 10, 10]], {"wieghts": [1.0]}, "did you mean 'weights'"),
    ],
)
def test_impossible_goods_are_refused_by_their_row(
    sides: Any, attributes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        check_goods(sides, SMALL, attributes)


def test_a_box_must_be_higher_than_the_level_tolerance() -> None:
    spec = SMALL.with_options({"level_tolerance_mm": 5})
    with pytest.raises(ValueError, match="lower than level_tolerance_mm = 5"):
        check_goods([[10, 10, 5]], spec)
    check_goods([[10, 10, 6]], spec)


def test_a_quantity_repeats_its_row() -> None:
    rows = goods([[10, 10, 10], [20, 10, 10]], quantity=[2, 1], ids=["a", "b"])
    assert rows.ids.tolist() == ["a", "a", "b"]


def test_a_file_gives_the_same_goods_as_csv_and_json(tmp_path: Path) -> None:
    (tmp_path / "goods.csv").write_text(
        "id,w_mm,d_mm,h_mm,weight_kg,upright,stackable,max_load_kg,quantity,sequence\n"
        "a,10,12,9,1.5,yes,no,0,1,s\nb,20,10,8,2,no,yes,7.5,2,t\nc,9,9,9,3,no,yes,1,1,s\n"
    )
    records = [
        {"id": "a", "w_mm": 10, "d_mm": 12, "h_mm": 9, "weight_kg": 1.5, "upright": True,
         "stackable": False, "max_load_kg": 0, "quantity": 1, "sequence": "s"},
        {"id": "b", "w_mm": 20, "d_mm": 10, "h_mm": 8, "weight_kg": 2, "upright": False,
         "stackable": True, "max_load_kg": 7.5, "quantity": 2, "sequence": "t"},
        {"id": "c", "w_mm": 9, "d_mm": 9, "h_mm": 9, "weight_kg": 3, "upright": False,
         "stackable": True, "max_load_kg": 1, "quantity": 1, "sequence": "s"},
    ]  # fmt: skip
    (tmp_path / "goods.json").write_text(json.dumps(records))
    results = [read_goods(tmp_path / name, SMALL) for name in ("goods.csv", "goods.json")]
    for rows, counts in results:
        assert rows.ids.tolist() == ["a", "c", "b", "b"]  # sequence by sequence
        assert counts.tolist() == [2, 2]
        assert rows.weights.tolist() == [1.5, 3, 2, 2]
        assert rows.stackable.tolist() == [False, True, True, True]
        assert rows.max_load.tolist() == [0, 1, 7.5, 7.5]
        assert rows.orientations.sum(1).tolist() == [2, 6, 6, 6]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "w,d,h\n1,2,3\n", "no column 'w_mm', 'd_mm', 'h_mm'"),
        ("a.csv", "w_mm,d_mm,h_mm\n1,x,3\n", "row 0 .*d_mm 'x' is not a number"),
        ("a.csv", "w_mm,d_mm,h_mm,colour\n1,2,3,red\n", "unknown column 'colour'"),
        ("a.json", "{}", "needs a list of records"),
        ("a.json", '[{"w_mm": 1, "d_mm": 2, "h_mm": "3"}]', "row 0 .* needs three lengths in mm"),
        ("a.json", '[{"w_mm": 1, "d_mm": 2}]', "no key 'h_mm'"),
        (
            "a.json",
            '[{"w_mm": 1, "d_mm": 2, "h_mm": 3, "sequence": {}}]',
            "needs a text or a whole",
        ),
        ("a.csv", "w_mm,d_mm,h_mm\n1,,3\n", "needs a value for each"),
        ("a.txt", "", "unknown ending '.txt'"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        make_goods_stream(tmp_path / name, SMALL)


def test_a_value_that_is_left_out_is_the_default(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "w_mm,d_mm,h_mm,weight_kg,upright,stackable,max_load_kg,quantity,id,orientations\n"
        "10,12,9,,,,,,,\n20,10,8,2,yes,no,7.5,2,b,0\n"
    )
    (tmp_path / "a.json").write_text(json.dumps([
        {"w_mm": 10, "d_mm": 12, "h_mm": 9, "weight_kg": None},
        {"w_mm": 20, "d_mm": 10, "h_mm": 8, "weight_kg": 2, "upright": True, "stackable": False,
         "max_load_kg": 7.5, "quantity": 2, "id": "b", "orientations": [0]},
    ]))  # fmt: skip
    for name in ("a.csv", "a.json"):
        rows, counts = read_goods(tmp_path / name, SMALL)
        assert counts.tolist() == [3]
        assert np.isnan(rows.weights[0])
        assert rows.weights[1:].tolist() == [2, 2]
        assert rows.stackable.tolist() == [True, False, False]
        assert rows.max_load.tolist() == [np.inf, 7.5, 7.5]
        assert rows.ids.tolist() == ["", "b", "b"]
        assert rows.orientations.sum(1).tolist() == [6, 1, 1]


def test_windows_and_draws() -> None:
    rows = [[10 + k, 10, 10] for k in range(7)]
    stream = make_goods_stream(rows, SMALL, length=3)
    assert isinstance(stream, Given)
    assert [stream.sequence(e).tolist() for e in range(3)] == [[0, 1, 2], [3, 4, 5], [0, 1, 2]]
    drawn = make_goods_stream(rows, SMALL, order="draw", length=5, seed=3)
    assert isinstance(drawn, Draws)
    assert drawn.sequence(4).tolist() == drawn.sequence(4).tolist() != drawn.sequence(5).tolist()
    assert drawn.seeded(4).sequence(4).tolist() != drawn.sequence(4).tolist()
    with pytest.raises(ValueError, match="needs length"):
        make_goods_stream(rows, SMALL, order="draw")
    with pytest.raises(ValueError, match="needs at least 8"):
        make_goods_stream(rows, SMALL, length=8)


# --- limits of goods and bins ---------------------------------------------------------------------


def above(boxes: np.ndarray[Any, Any], i: int) -> set[int]:
    """The boxes that rest on box i, directly or through others; plain code."""
    found: set[int] = set()
    for k in range(len(boxes)):
        on = {j for j, _ in reference.contacts(boxes[:k].tolist(), boxes[k].tolist())}
        if i in on or on & found:
            found.add(k)
    return found


def test_max_load_and_stackable_are_never_violated() -> None:
    rng = np.random.default_rng(0)
    spec = ExactSpec(bin_mm=(60, 50, 90), unit_mm=1, rule="hull_1", max_boxes=64)
    stacked = refused = 0
    for _ in range(40):
        count = 18
        everything = goods(
            rng.integers(8, 30, (count, 3)), spec, weights=rng.uniform(0.5, 4, count),
            stackable=(rng.random(count) < 0.8), max_load=rng.choice([0.0, 3, 6, 1e3], count),
        )  # fmt: skip
        bins = ExactBins(1, spec)
        placed = play_random(bins, everything, rng)
        refused += count - len(placed)
        boxes = bins.boxes(0)
        for i, row in enumerate(placed):
            higher = above(boxes, i)
            weight = sum(everything.weights[placed[k]] for k in higher)
            assert weight <= everything.max_load[row]
            assert everything.stackable[row] or not higher
            assert bins.state.carried[0, i] == pytest.approx(weight)
            stacked += len(higher)
    assert stacked > 100
    assert refused


def test_a_box_of_unknown_weight_may_not_add_to_a_limited_load() -> None:
    spec = SMALL.with_options({"orientations": (0,)})
    present = check_present([[0, 0, 0, 60, 50, 20]], spec, {"max_load": [5]})
    bins = ExactBins(1, spec, present)
    assert not len(bins.moves(goods([[60, 50, 20]], spec)).numbers)
    for weight, count in ((5, 1), (5.01, 0)):
        assert len(bins.moves(goods([[60, 50, 20]], spec, weights=[weight])).numbers) == count


def test_the_load_counts_boxes_above_through_every_contact() -> None:
    spec = SMALL.with_options({"orientations": (0,)})
    # Two pillars, a plank on both, a box on the plank: each pillar carries both.
    boxes = [(0, 0, 0, 10, 50, 20), (50, 0, 0, 10, 50, 20), (0, 0, 20, 60, 50, 10)]
    bins = ExactBins(
        1, spec, check_present(boxes, spec, {"weights": [1, 1, 4], "max_load": [6, 9, 9]})
    )
    assert bins.state.carried[0, :3].tolist() == [4, 4, 0]
    top = goods([[60, 50, 10]], spec, weights=[2])
    above = bins.select([0])
    above.place(top, above.moves(top).numbers)
    assert above.state.carried[0, :4].tolist() == [6, 6, 2, 0]
    assert not len(bins.moves(goods([[60, 50, 10]], spec, weights=[2.1])).numbers)


def test_the_forces_of_the_linear_program_never_exceed_the_load() -> None:
    """The weights of all boxes above bound what any distribution of forces puts on a box."""
    from scipy.optimize import linprog

    from marl_pack.stability.static_equilibrium import contacts

    rng = np.random.default_rng(3)
    spec = ExactSpec(bin_mm=(60, 50, 90), unit_mm=1, rule="lbcp", max_boxes=64)
    for _ in range(6):
        everything = goods(rng.integers(10, 30, (14, 3)), spec, weights=rng.uniform(1, 4, 14))
        bins = ExactBins(1, spec)
        placed = play_random(bins, everything, rng)
        boxes, weights = bins.boxes(0), everything.weights[placed]
        pairs, rectangles = contacts(boxes)
        points = rectangles[:, [0, 1, 0, 3, 2, 1, 2, 3]].reshape(-1, 2)
        upper, lower = np.repeat(pairs, 4, axis=0).T
        a = np.zeros((3 * len(boxes), len(points)))
        centre = boxes[:, :2] + boxes[:, 3:5] / 2
        for f, (i, j) in enumerate(zip(upper, lower, strict=True)):
            for box, sign in ((i, 1), (j, -1)):
                if box >= 0:
                    a[3 * box, f] += sign
                    a[3 * box + 1 : 3 * box + 3, f] += sign * (points[f] - centre[box])
        b = np.zeros(3 * len(boxes))
        b[::3] = weights
        for k in range(len(boxes)):
            cost = -(lower == k).astype(float)  # the largest force on box k
            result = linprog(cost, A_eq=a, b_eq=b, bounds=(0, None))
            assert result.status == 0
            assert -result.fun <= bins.state.carried[0, k] + 1e-6


def test_the_weight_limit_of_a_bin_holds_for_known_weights_only() -> None:
    spec = SMALL.with_options({"max_weight_kg": 5.0})
    bins = ExactBins(1, spec)
    item = goods([[10, 10, 10]], spec, weights=[3])
    bins.place(item, bins.moves(item).numbers[:1])
    assert not len(bins.moves(item).numbers)
    assert len(bins.moves(goods([[10, 10, 10]], spec, weights=[2])).numbers)
    assert not len(bins.moves(goods([[10, 10, 10]], spec)).numbers)


def test_a_full_bin_says_so() -> None:
    spec = SMALL.with_options({"max_boxes": 2})
    bins = ExactBins(1, spec)
    item = goods([[10, 10, 10]], spec)
    for _ in range(2):
        bins.place(item, bins.moves(item).numbers[:1])
    with pytest.raises(ValueError, match="already holds 2 boxes; needs a larger max_boxes"):
        bins.moves(item)


@pytest.mark.parametrize(
    ("boxes", "message"),
    [
        ([[0, 0, 0, 61, 10, 10]], "reaches out"),
        ([[51, 0, 0, 10, 10, 10]], "reaches out of the bin"),
        ([[0, 0, 0, 10, 10, 10], [5, 5, 0, 10, 10, 10]], "overlaps box 0"),
        ([[0, 0, 0, 10, 10]], "needs rows of six numbers"),
        ("abc", "needs rows of six numbers"),
        ([[0, 0, 5, 10, 10, 10]], "floats"),
        ([[0, 0, 0.5, 10, 10, 10]], "whole units of 1 mm"),
    ],
)
def test_impossible_boxes_in_the_bin_are_refused(boxes: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        stable_place([10, 10, 10], boxes, bin_mm=(60, 50, 90), unit_mm=1)


# --- moves and heuristics -------------------------------------------------------------------------


def test_moves_are_candidates_at_edges_in_order() -> None:
    spec = SMALL.with_options({"orientations": (0,), "rule": "none"})
    bins = ExactBins(1, spec, check_present([[0, 0, 0, 20, 10, 30]], spec))
    rows = placements(bins.moves(goods([[15, 8, 10]], spec)).numbers)
    assert rows[:, 1:].tolist() == sorted(rows[:, 1:].tolist(), key=lambda r: (r[2], r[0], r[1]))
    assert set(rows[:, 1].tolist()) == {0, 5, 20, 45}  # walls, and both edges in both alignments
    assert set(rows[:, 2].tolist()) == {0, 2, 10, 42}
    assert {tuple(r) for r in rows[:, 1:].tolist()} >= {(0, 0, 30), (20, 0, 0), (45, 42, 0)}
    assert (placements(bins.moves(goods([[15, 8, 10]], spec)).numbers) == rows).all()


def test_a_clearance_adds_candidates_beside_edges_and_keeps_off_walls() -> None:
    options = {"orientations": (0,), "rule": "none", "clearance_mm": 2}
    spec = SMALL.with_options(options)
    bins = ExactBins(1, spec, check_present([[2, 2, 0, 20, 10, 30]], spec))
    rows = placements(bins.moves(goods([[15, 8, 10]], spec)).numbers)
    assert set(rows[:, 1].tolist()) == {2, 4, 5, 7, 22, 24, 43}
    for _, x, y, z in rows.tolist():
        near = x < 24 and x + 15 > 0 and y < 14 and y + 8 > 0
        assert z == 30 or not near


def test_no_edge_leads_a_box_into_the_clearance_of_a_wall() -> None:
    spec = SMALL.with_options({"orientations": (0,), "rule": "none", "clearance_mm": 2})
    bins = ExactBins(1, spec, check_present([[16, 2, 0, 28, 18, 30]], spec))
    rows = placements(bins.moves(goods([[15, 8, 10]], spec)).numbers)
    assert 1 not in rows[:, 1]  # its high side would lie at the edge 16
    assert rows[:, 1].min() == 2
    assert rows[:, 1].max() == 43  # and not 44, its low side at the edge 44


def test_equal_boxes_in_two_orientations_are_listed_once() -> None:
    bins = ExactBins(1, SMALL)
    assert set(placements(bins.moves(goods([[10, 10, 10]])).numbers)[:, 0].tolist()) == {0}
    listed = placements(bins.moves(goods([[10, 10, 20]])).numbers)[:, 0]
    assert set(listed.tolist()) == {0, 2, 3}


def test_event_points_lose_nothing_for_a_heuristic_against_all_positions() -> None:
    """Of all whole positions, the lowest one of dblf is an event point."""
    rng = np.random.default_rng(4)
    spec = ExactSpec(bin_mm=(14, 12, 16), unit_mm=1, rule="none", max_boxes=64)
    corners = np.stack(np.meshgrid(np.arange(14), np.arange(12), indexing="ij"), -1).reshape(-1, 2)
    for _ in range(40):
        bins = ExactBins(1, spec)
        play_random(bins, goods(rng.integers(2, 7, (6, 3)), spec), rng)
        item = goods(rng.integers(2, 7, 3), spec)
        every = np.sort(bins.moves_at(0, item, corners))
        if len(every):
            assert bins.moves(item).numbers[0] == every[0]


@pytest.mark.parametrize("name", list(HEURISTICS))
@pytest.mark.parametrize("rule", ["lbcp", "none"])
def test_a_heuristic_takes_the_best_of_the_listed_moves(name: str, rule: str) -> None:
    rng = np.random.default_rng(5)
    spec = SMALL.with_options({"rule": rule, "level_tolerance_mm": 1.0})
    policy: Any = HEURISTICS[name]()
    bins = ExactBins(1, spec)
    for _ in range(20):
        item = goods(rng.integers(7, 30, 3), spec)
        listed = bins.moves(item).numbers
        best = int(bins.best(item, policy.kind, policy.weights)[0])
        assert best == best_of(
            policy.kind, policy.weights, bins.limits, bins.size, bins.state.boxes[0],
            int(bins.state.count[0]), item.sides[0], listed,
        )  # fmt: skip
        if best >= 0:
            bins.place(item, np.array([best]))


def test_a_linear_score_is_the_sum_of_the_features() -> None:
    rng = np.random.default_rng(6)
    bins = ExactBins(1, SMALL)
    for _ in range(25):
        item = goods(rng.integers(7, 30, 3))
        weights = rng.normal(size=len(FEATURES))
        listed = bins.moves(item).numbers
        if not len(listed):
            continue
        table = bins.features(0, item.sides[0], listed)
        assert (table >= 0).all()
        assert (table <= 1).all()
        best = bins.best(item, LINEAR, weights)
        chosen = int(np.flatnonzero(listed == best[0])[0])
        assert table[chosen] @ weights == pytest.approx((table @ weights).max())
        bins.place(item, rng.choice(listed, 1))


def test_features_by_hand() -> None:
    spec = SMALL.with_options({"orientations": (0,), "rule": "none"})
    bins = ExactBins(1, spec, check_present([[0, 0, 0, 20, 10, 30]], spec))
    item = goods([[10, 20, 30]], spec)
    moves = bins.moves(item).numbers
    rows = [tuple(row[1:]) for row in placements(moves).tolist()]
    beside = dict(zip(FEATURES, bins.features(0, item.sides[0], moves)[rows.index((20, 0, 0))],
                      strict=True))  # fmt: skip
    surface = 2 * (10 * 20 + 10 * 30 + 20 * 30)
    assert beside["bottom"] == 10 * 20 / surface  # the floor
    assert beside["sides"] == 10 * 30 / surface  # 10 of its 20 along y, 30 high
    assert beside["walls"] == 10 * 30 / surface  # the wall y = 0
    assert beside["level"] == 10 / 60  # of its four sides 10 + 20 + 10 + 20
    assert beside["top"] == 30 / 90
    assert beside["waste"] == 0
    assert beside["gap_x"] == 0  # the gap of 30 to the wall is wider than the box
    on_top = dict(zip(FEATURES, bins.features(0, item.sides[0], moves)[rows.index((10, 0, 30))],
                      strict=True))  # fmt: skip
    assert on_top["bottom"] == 10 * 10 / surface
    assert on_top["waste"] == 10 * 10 * 30 / (10 * 20 * 90)
    assert on_top["rest"] == 30 / 90


def test_waste_is_the_space_between_a_box_and_the_tops_that_are_seen_from_above() -> None:
    rng = np.random.default_rng(7)
    spec = SMALL.with_options({"rule": "none"})
    for _ in range(30):
        bins = ExactBins(1, spec)
        play_random(bins, goods(rng.integers(7, 30, (10, 3)), spec), rng)
        heights = np.zeros((60, 50), np.int64)
        for x, y, z, w, d, h in bins.boxes(0).tolist():
            heights[x : x + w, y : y + d] = z + h
        item = goods(rng.integers(7, 30, 3), spec)
        for move in bins.moves(item).numbers[::5].tolist():
            _, x, y, z = placements(move).tolist()
            w, d = (item.sides[0][list(ORDER[move & 7])][:2]).tolist()
            expected = (z - heights[x : x + w, y : y + d]).sum()
            got = waste_of(bins.state.boxes[0], int(bins.state.count[0]), item.sides[0], move)
            assert got == expected


ORDER = ((0, 1, 2), (1, 0, 2), (0, 2, 1), (2, 0, 1), (1, 2, 0), (2, 1, 0))


def test_random_moves_are_uniform() -> None:
    game = ExactPacking(4000, [[25, 20, 90]], spec=SMALL, orientations=(0,), auto_reset=False)
    policy = make_exact_policy("random", 1)
    chosen, counts = np.unique(policy(game), return_counts=True)
    assert len(chosen) == len(game.moves.of(0)) == 4
    assert counts.min() > 900


@pytest.mark.parametrize(
    ("name", "message"),
    [("max_contac", "did you mean 'max_contact'"), (3, "needs one of dblf"), ("x.json", "x.json")],
)
def test_an_unknown_policy_is_refused(name: Any, message: str) -> None:
    with pytest.raises((ValueError, OSError), match=message):
        make_exact_policy(name)


def test_weights_need_names_of_features() -> None:
    with pytest.raises(ValueError, match="did you mean 'bottom'"):
        linear_weights({"botom": 1.0})


# --- games ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(HEURISTICS))
def test_games_at_once_are_the_games_one_by_one(name: str) -> None:
    rng = np.random.default_rng(8)
    items = rng.integers(8, 30, (6 * 12, 3)).tolist()
    together = ExactPacking(6, items, spec=SMALL, length=12, auto_reset=False)
    policy = make_exact_policy(name)
    while together.alive.any():
        together.place(policy(together))
    for g in range(6):
        alone = ExactPacking(1, items, spec=SMALL, length=12, auto_reset=False, first_episode=g)
        while alone.alive.any():
            alone.place(policy(alone))
        assert alone.plan(0) == together.plan(g)


def test_a_game_ends_when_the_visible_box_has_no_move_and_restarts() -> None:
    items = [[30, 25, 45]] * 9  # eight fill the bin
    game = ExactPacking(1, items, spec=SMALL, orientations=(0,), auto_reset=True)
    for k in range(8):
        outcome = game.place(make_exact_policy("dblf")(game))
        assert outcome.reward[0] == pytest.approx(1 / 8)
        assert bool(outcome.done[0]) == (k == 7)
    assert outcome.utilization[0] == pytest.approx(1)
    assert outcome.packed[0] == 8
    assert game.episode[0] == 1
    assert game.bins.state.count[0] == 0


def test_a_game_that_is_played_needs_a_move() -> None:
    game = ExactPacking(1, [[10, 10, 10]], spec=SMALL)
    with pytest.raises(ValueError, match="game 0: needs one of its legal moves"):
        game.place(np.array([NOWHERE]))


def test_an_illegal_move_is_refused_and_changes_nothing() -> None:
    boxes = [[30, 25, 45], [30, 25, 45]]
    game = ExactPacking(1, boxes, spec=SMALL, orientations=(0,), auto_reset=False)
    game.place(game.moves.of(0)[:1])
    before = [array.copy() for array in game.bins.state]
    legal = int(game.moves.of(0)[-1])
    unstable = int(encode(0, 16, 0, 45))  # its middle lies beyond the edge of the first box
    floating, inside, beyond, turned = (
        int(encode(*move)) for move in ((0, 30, 0, 7), (0, 5, 5, 0), (0, 31, 0, 0), (1, 30, 0, 0))
    )
    for wrong in (unstable, floating, inside, beyond, turned, NOWHERE):
        with pytest.raises(ValueError, match="game 0: needs one of its legal moves"):
            game.place(np.array([wrong]))
        assert all((a == b).all() for a, b in zip(before, game.bins.state, strict=True))
    for wrong in ([1.5], [[legal]], [legal, legal], ["a"]):
        with pytest.raises(ValueError, match="moves: needs whole numbers"):
            game.place(wrong)
    game.place([legal])
    assert game.bins.state.count[0] == 2


def test_weights_that_add_up_to_the_limit_are_not_above_it() -> None:
    spec = SMALL.with_options({"max_weight_kg": 0.3})
    bins = ExactBins(1, spec)
    for weight in (0.1, 0.2):
        item = goods([[10, 10, 10]], spec, weights=[weight])
        bins.place(item, bins.moves(item).numbers[:1])
    assert not len(bins.moves(goods([[10, 10, 10]], spec, weights=[0.001])).numbers)


def test_selected_games_are_copies() -> None:
    game = ExactPacking(2, [[10, 10, 10]] * 5, spec=SMALL, auto_reset=False)
    policy = make_exact_policy("max_contact")
    game.place(policy(game))
    copies = game.select([1, 1, 0])
    copies.place(policy(copies))
    assert copies.bins.state.count.tolist() == [2, 2, 2]
    assert game.bins.state.count.tolist() == [1, 1]
    assert copies.plan(0).first(1) == game.plan(1)


def test_plans_have_ids_orientations_weights_and_whole_lengths() -> None:
    items = {"items": [[10, 20, 30], [10.5, 20, 30]], "ids": ["a", "b"], "weights": [1, 2]}
    game = ExactPacking(1, items, bin_mm=(60, 50, 90), auto_reset=False)
    policy = make_exact_policy("dblf")
    game.place(policy(game))
    assert game.plan(0).sides.dtype == np.int64
    assert sorted(game.plan(0).boxes_mm[0, 3:].tolist()) == [10, 20, 30]
    game.place(policy(game))
    plan = game.plan(0)
    assert plan.unit_mm == 0.1
    assert plan.ids == ("a", "b")
    assert plan.weights.tolist() == [1, 2]
    assert sorted(plan.sides[1].tolist()) == [105, 200, 300]
    assert (plan.orientations >= 0).all()
    assert in_equilibrium(plan.boxes, plan.loads)
    assert isinstance(plan, Plan)


def test_an_unknown_weight_above_a_limit_leaves_no_room_for_more() -> None:
    """A box of unknown weight that is already there may weigh anything."""
    boxes = [[0, 0, 0, 400, 300, 500], [0, 0, 500, 400, 300, 500]]
    item = {"items": [[100, 100, 100]], "weights": [4]}
    for max_load, count in (([5, 1000], 0), ([1e9, 1000], 0)):
        rows = stable_place(item, boxes, attributes={"max_load": max_load}, at=(0, 0))
        assert len(rows) == count
    known = {"max_load": [6, 1000], "weights": [9, 2]}
    assert len(stable_place(item, boxes, attributes=known, at=(0, 0))) == 1


def test_present_boxes_are_in_every_bin_and_come_back_in_the_next_episode() -> None:
    present = [[0, 0, 0, 60, 50, 40]]
    game = ExactPacking(2, [[60, 50, 25]] * 3, spec=SMALL, present=present, orientations=(0,))
    for episode in range(3):
        assert game.bins.utilization.tolist() == [40 / 90] * 2
        outcome = game.place([game.moves.of(g)[0] for g in range(2)])
        assert outcome.packed.tolist() == [2, 2]
        assert not outcome.done.any()
        outcome = game.place([game.moves.of(g)[0] for g in range(2)])
        assert outcome.done.all()
        assert outcome.utilization.tolist() == [1, 1]
        assert game.episode.tolist() == [2 * episode + 2, 2 * episode + 3]
    plan = ExactPacking(1, [[60, 50, 25]], spec=SMALL, present=present).plan(0)
    again = ExactPacking(1, [[60, 50, 25]], spec=SMALL, present=plan, auto_reset=False)
    assert again.plan(0) == plan
    with pytest.raises(ValueError, match="needs a plan of one bin with unit_mm"):
        ExactPacking(1, [[60, 50, 25]], spec=SMALL, present=Plan.of_boxes((9, 9, 9), present[:0]))


def test_present_boxes_have_attributes_that_a_plan_does_not_know() -> None:
    plan = Plan.of_boxes((60, 50, 90), [[0, 0, 0, 60, 50, 20]], unit_mm=1)
    item = [[60, 50, 20]]
    for present, count in ((plan, 1), ({"boxes": plan, "stackable": [False]}, 0)):
        game = ExactPacking(1, item, spec=SMALL, present=present, auto_reset=False)
        assert bool(game.alive[0]) == bool(count)
    with pytest.raises(ValueError, match="need weights, because max_weight_kg is set"):
        ExactPacking(1, item, spec=SMALL, present=plan.boxes, max_weight_kg=9)
    with pytest.raises(ValueError, match="did you mean 'stackable'"):
        ExactPacking(1, item, spec=SMALL, present={"boxes": plan, "stackabel": [False]})


def test_present_boxes_may_touch_walls_within_the_clearance() -> None:
    spec = SMALL.with_options({"clearance_mm": 5})
    check_present([[0, 0, 0, 60, 50, 20]], spec)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"item": None}, "item: needs rows of three numbers"),
        ({"item": [True, True, True]}, "item: needs rows of three numbers"),
        ({"item": ["600", "300", "100"]}, "item: needs rows of three numbers"),
        ({"item": [[600], [300], [100]]}, "item: needs rows of three numbers"),
        ({"item": [10, 10, 10], "boxes": [[0, 0, 0], [400, 300, 500]]}, "rows of six numbers"),
        ({"item": [10, 10, 10], "at": ("99", "0")}, "at: needs rows of two numbers"),
        ({"item": [10, 10, 10], "at": 5}, "at: needs rows of two numbers"),
        ({"item": [10, 10, 10], "attributes": [1]}, "need a mapping"),
        ({"item": [10, 10, 10], "attributes": {"colour": [1]}}, "unknown attribute 'colour'"),
        ({"item": [10, 10, 10], "boxes": [[0, 0, 0, 9, 9, 9]], "attributes": {"quantity": [2]}},
         "'quantity' has no meaning"),
    ],
)  # fmt: skip
def test_wrong_arguments_of_stable_place_are_refused(
    arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        stable_place(**arguments)


def test_orientations_of_the_same_box_count_once_at_a_corner() -> None:
    assert len(stable_place([100, 100, 100], at=(0, 0))) == 1
    assert len(stable_place([100, 100, 200], at=(0, 0))) == 3


@pytest.mark.parametrize("items", [None, 5, {1, 2, 3}, "abc", (x for x in ([1, 2, 3],))])
def test_things_that_are_not_items_are_refused(items: Any) -> None:
    with pytest.raises((ValueError, OSError), match=r"items|abc|ending"):
        ExactPacking(1, items)


def test_goods_belong_to_the_unit_of_their_game() -> None:
    with pytest.raises(ValueError, match=r"units of 1 mm; needs the game's unit_mm, 0\.1"):
        ExactPacking(1, check_goods([[600, 400, 300]], ExactSpec(unit_mm=1)))
    bins = ExactBins(4, SMALL)
    with pytest.raises(ValueError, match="needs one for each of 4 bins"):
        bins.moves(goods([[10, 10, 10]]))


def test_an_episode_ends_when_the_bin_holds_max_boxes() -> None:
    game = ExactPacking(1, [[10, 10, 10]] * 5, spec=SMALL, max_boxes=3, auto_reset=False)
    done = [bool(game.place(game.moves.of(0)[:1]).done[0]) for _ in range(3)]
    assert done == [False, False, True]
    assert len(game.plan(0)) == 3


def test_more_parts_than_there_was_memory_for() -> None:
    """Carrying parts grow: many small boxes below one large box."""
    spec = ExactSpec(bin_mm=(100, 100, 40), unit_mm=1, rule="hull_alpha", max_boxes=128)
    small = [[x, y, 0, 9, 9, 10] for x in range(0, 100, 10) for y in range(0, 100, 10)]
    bins = ExactBins(2, spec, check_present(small, spec))
    before = bins.state.parts.shape[1]
    for k in range(9):
        plank = goods([[100, 100, 1]], spec)
        index = np.zeros(2, np.int64)
        moves = bins.moves(plank[index], np.array([True, False]))
        bins.place(plank[index], np.array([moves.of(0)[0], NOWHERE]))
        assert bins.state.count.tolist() == [101 + k, 100]
    assert bins.state.parts.shape[1] > before


def test_stable_place_by_hand() -> None:
    rows = stable_place([600, 300, 100], [[0, 0, 0, 400, 300, 500]], orientations=(0,), at=(99, 0))
    assert rows.tolist() == [[0, 99, 0, 500]]
    for x in (100, 101):
        boxes = [[0, 0, 0, 400, 300, 500]]
        assert len(stable_place([600, 300, 100], boxes, orientations=(0,), at=(x, 0))) == 0
    free = stable_place([600, 300, 100], orientations=(0, 1))
    assert {tuple(row) for row in free.tolist()} == {
        (0, 0, 0, 0), (0, 600, 0, 0), (0, 0, 500, 0), (0, 600, 500, 0),
        (1, 0, 0, 0), (1, 900, 0, 0), (1, 0, 200, 0), (1, 900, 200, 0),
    }  # fmt: skip
    with pytest.raises(ValueError, match=r"at = .* needs x, y"):
        stable_place([10, 10, 10], at=(0.05, 0))
