"""Poses that a robot reports: rotated boxes in bins, plans and the judge."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_pack import Plan, Stack
from marl_pack.geometry.rotated import overlap, overlap_area
from marl_pack.packer.answers import Placement
from marl_pack.packer.calls import goods_of
from marl_pack.packer.packer import Packer
from marl_pack.packer.poses import Pose, rectangles
from marl_pack.sapien_check.trials import Trial, run_trial

SIDES = st.integers(1, 4000)
PLACES = [st.floats(-20, 20)] * 2
SHAPES = st.tuples(*PLACES, *[st.floats(1, 30)] * 2, st.floats(-45, 45))


def corners(x: float, y: float, w: float, d: float, yaw: float) -> np.ndarray:
    angle = math.radians(yaw)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return np.array([(x, y)]) + np.array([(-w, -d), (w, -d), (w, d), (-w, d)]) / 2 @ turn.T


def inside(points: np.ndarray, x: float, y: float, w: float, d: float, yaw: float) -> bool:
    angle = math.radians(-yaw)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    own = np.abs((points - (x, y)) @ turn.T)
    return bool((own <= np.array((w, d)) / 2 + 1e-4).all())


@settings(max_examples=300, deadline=None)
@given(st.floats(-500, 500), st.floats(-500, 500), SIDES, SIDES, st.floats(-45, 45))
def test_one_rectangle_is_around_the_box_and_one_is_inside(
    x: float, y: float, w: int, d: int, yaw: float
) -> None:
    around, within = rectangles(x, y, w, d, yaw)
    points = corners(x, y, w, d, yaw)
    assert (around[:2] <= points + 1e-4).all()
    assert (around[2:] >= points - 1e-4).all()
    assert (around[2:] - around[:2] <= np.ptp(points, axis=0) + 2).all()  # at most a unit each side
    if (within[2:] > within[:2]).all():
        x0, y0, x1, y1 = within.tolist()
        assert inside(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]), x, y, w, d, yaw)


def test_the_inner_rectangle_is_nearly_the_box_for_small_angles() -> None:
    _, within = rectangles(3000, 2000, 6000, 4000, 1.0)
    assert (within[2:] - within[:2]).tolist() == pytest.approx([5930, 3895], abs=3)
    _, whole = rectangles(3000, 2000, 6000, 4000, 0.0)
    assert whole.tolist() == [0, 0, 6000, 4000]


@settings(max_examples=200, deadline=None)
@given(SHAPES, SHAPES)
def test_boxes_overlap_if_and_only_if_they_share_points(a: Any, b: Any) -> None:
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 41)] * 2), -1).reshape(-1, 2)
    angle = math.radians(a[4])
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    points = grid * (a[2], a[3]) @ turn.T + a[:2]
    shared = any(inside(point[None], *b) for point in points)
    depth = overlap(a, b)
    if shared:
        assert depth > -1e-3
    if depth < -1e-3:
        assert not shared
    assert depth == pytest.approx(overlap(b, a))


def test_later_boxes_keep_away_from_the_rotated_box() -> None:
    packer = Packer((600, 400, 500), "dblf", orientations=(0,), clearance_mm=10)
    first = packer.place((300, 200, 100), id="a")
    assert isinstance(first, Placement)
    actual = packer.actual(Pose(first.centre[0] + 4, first.centre[1] + 3, 2.0))
    assert (actual.yaw, actual.problem, actual.z) == (2.0, "", 0.0)
    assert actual.centre == (first.centre[0] + 4, first.centre[1] + 3, 50.0)
    around, _ = rectangles(1640, 1130, 3000, 2000, 2.0)
    beside = packer.place((250, 180, 100), id="b")
    assert isinstance(beside, Placement)
    assert beside.x == around[2] / 10 + 10 or beside.y == around[3] / 10 + 10
    plan = packer.plan
    assert plan.yaws.tolist() == [2.0, 0.0]
    assert plan.sides[0].tolist() == [300, 200, 100]
    Stack.of_plan(plan)  # no box overlaps another one


@pytest.mark.parametrize("rule", ["hull_1", "hull_alpha", "lbcp", "equilibrium"])
def test_only_the_inner_rectangle_carries(rule: str) -> None:
    """The upper box is centred on the edge strip that the rotation takes away."""
    packer = Packer((1000, 600, 1000), "dblf", rule=rule, clearance_mm=60, orientations=(0,))
    first = packer.place((600, 300, 100))
    assert isinstance(first, Placement)
    before = packer.bin.moves_at(
        0, goods_of((100, 100, 100), {}, packer.spec), np.array([[6050, 1000]])
    )
    assert len(before) > 0  # 55 of 100 mm rest on it
    packer.actual((first.centre[0], first.centre[1], 5.0))
    after = packer.bin.moves_at(
        0, goods_of((100, 100, 100), {}, packer.spec), np.array([[6050, 1000]])
    )
    assert len(after) == 0  # the rectangle inside ends 9.8 mm earlier


def test_a_pose_without_support_is_accepted_and_flagged() -> None:
    packer = Packer((350, 300, 800), "dblf", rule="hull_1", orientations=(0,), margin_mm=20)
    packer.place((200, 300, 100))
    top = packer.place((200, 300, 700))
    assert isinstance(top, Placement)
    assert top.z == 100
    actual = packer.actual((top.centre[0] + 120, top.centre[1], 0))
    assert actual.z == 100
    assert actual.problem == "it does not stand there by the rule hull_1"
    assert packer.placements[-1] == actual
    assert packer.plan.positions[-1].tolist() == [120, 0, 100]
    packer.undo()
    assert packer.placements[-1] == top


def test_impossible_poses_are_refused_and_change_nothing() -> None:
    packer = Packer((600, 400, 500), "dblf", orientations=(0,), present=[[0, 0, 0, 100, 100, 50]])
    with pytest.raises(ValueError, match="no box was placed in the open bin"):
        packer.actual((50, 50))
    packer.place((200, 400, 100), id="a")
    last = packer.place((200, 400, 100), id="b")
    assert isinstance(last, Placement)
    x, y, _ = last.centre
    before = packer.state, packer.plan
    for pose, message in (
        ((x - 30, y, 0), "would overlap box 'a'"),
        ((x, y + 1, 0), "would reach out of the bin"),
        ((x, y, 3), "would reach out of the bin"),
        ((x, y, 50), "needs degrees from -45 to 45"),
        ((x,), "needs x, y in mm and yaw in degrees"),
        ((x, float("nan")), "needs a finite number"),
    ):
        with pytest.raises(ValueError, match=message):
            packer.actual(pose)
        assert (packer.state, packer.plan) == before


def test_a_box_that_nothing_carries_has_no_margin() -> None:
    """A bridge is rotated so far that the rectangle inside it reaches neither pier."""
    piers = [[0, 0, 0, 60, 300, 100], [340, 0, 0, 60, 300, 100]]
    packer = Packer((600, 300, 300), "dblf", rule="hull_1", present=piers, orientations=(0,))
    bridge = packer.place((400, 100, 190), id="bridge")
    assert isinstance(bridge, Placement)
    assert bridge.z == 100
    actual = packer.actual((bridge.centre[0] + 10, 150, 15))
    assert (actual.margin, actual.support) == (None, 0.0)
    assert actual.problem
    assert json.loads(json.dumps(actual.to_dict(), allow_nan=False))["margin"] is None
    assert np.isnan(packer.plan.margins[2])
    assert packer.state.least_margin is None
    assert Plan.of_dict(packer.plan.to_dict(), "plan") == packer.plan


def test_limits_hold_in_the_space_of_a_rotated_box() -> None:
    """The rectangle that carries is smaller than the box, but nothing may touch the box."""
    packer = Packer((400, 400, 300), "dblf", rule="none", orientations=(0,), clearance_mm=60)
    first = packer.place((200, 40, 100), stackable=False)
    assert isinstance(first, Placement)
    packer.actual((200, 200, 35))
    around, inside = rectangles(2000, 2000, 2000, 400, 35)
    corner = np.array([[around[2] - 300, around[3] - 300]])  # outside of the inner rectangle
    assert (corner[0] > inside[2:]).all()
    item = goods_of((100, 100, 100), {}, packer.spec)
    assert len(packer.bin.moves_at(0, item, corner)) == 0


def test_thin_boxes_and_coarse_units() -> None:
    packer = Packer((600, 300, 300), "dblf", unit_mm=10, rule="hull_1", orientations=(0,),
                    present=[[0, 0, 0, 600, 300, 100]])  # fmt: skip
    plank = packer.place((100, 10, 200))
    assert isinstance(plank, Placement)
    assert plank.z == 100
    actual = packer.actual((300, 150, 45))
    assert (actual.support, actual.margin) == (0.0, None)
    packer.undo()
    assert packer.placements[-1] == plank


def test_a_second_report_replaces_the_first() -> None:
    packer = Packer((600, 300, 300), rule="none", policy=lambda t: t.moves.of(0)[-1:],
                    orientations=(0,), present=[[0, 0, 0, 200, 200, 100]])  # fmt: skip
    top = packer.place((200, 100, 50))
    assert isinstance(top, Placement)
    assert top.z == 100
    assert packer.actual((450, 150)).z == 0
    assert packer.actual(top.centre[:2]).z == 100


def test_a_box_that_lost_its_support_rests_lower() -> None:
    packer = Packer((500, 200, 800), "dblf", rule="none", orientations=(0,))
    packer.place((200, 200, 100), id="low")
    packer.place((300, 200, 800), id="tall")
    top = packer.place((200, 200, 50), id="top")
    assert isinstance(top, Placement)
    assert (top.x, top.z) == (0, 100)
    packer = Packer((500, 200, 800), "dblf", rule="none", orientations=(0,))
    packer.place((200, 200, 100))
    packer.place((301, 200, 50), orientations=[1])
    actual = packer.actual((350, 100))
    assert actual.z == 0


def test_the_judge_builds_rotated_boxes() -> None:
    pytest.importorskip("sapien")
    from marl_pack.sapien_check import check

    low = np.array([[0, 0, 0, 400, 300, 100], [100, 50, 100, 200, 200, 100]])
    plan = Plan.of_boxes((600, 400, 500), low, unit_mm=1)
    content = plan.to_dict()
    content["boxes"][1]["yaw"] = 30.0
    turned = Plan.of_dict(content, "plan")
    verdict = check(Stack.of_plan(turned))
    assert verdict.stands
    assert verdict.angle.max() < 0.5  # measured from the rotated pose
    result = run_trial(Stack.of_plan(turned), Trial())
    assert result.collapse is None
    assert result.angle < 1


def test_the_judge_refuses_rotated_boxes_that_overlap_or_float() -> None:
    # Two boxes side by side, 10 mm apart: rotated by 10°, one reaches 13 mm into the other.
    rows = [(0, 0, 0, 300, 300, 100), (310, 0, 0, 280, 300, 100)]
    Stack.of_cells((700, 500, 500), rows, cell=0.001, density=500)
    with pytest.raises(ValueError, match="overlaps"):
        Stack.of_cells((800, 500, 500), [(60, 60, 0, 300, 300, 100), (370, 60, 0, 280, 300, 100)],
                       cell=0.001, density=500, yaw=[10, 0])  # fmt: skip
    with pytest.raises(ValueError, match="reaches out of the bin"):
        Stack.of_cells((700, 500, 500), rows, cell=0.001, density=500, yaw=[10, 0])
    # A diamond touches the square only with its corner region; turned back it rests beside it.
    lower, upper = (0, 0, 0, 200, 200, 100), (195, 195, 100, 200, 200, 100)
    Stack.of_cells((700, 500, 500), [lower, upper], cell=0.001, density=500)
    with pytest.raises(ValueError, match="floats"):
        Stack.of_cells((700, 500, 500), [lower, upper], cell=0.001, density=500, yaw=[0, 45])


def test_the_shared_area_is_that_of_the_two_rectangles() -> None:
    assert overlap_area((0, 0, 4, 2, 0), (1, 0, 4, 2, 0)) == pytest.approx(6)
    assert overlap_area((0, 0, 4, 4, 0), (0, 0, 4, 4, 45)) == pytest.approx(16 * 2 * (2**0.5 - 1))
    assert overlap_area((0, 0, 2, 2, 30), (9, 0, 2, 2, 10)) == 0
    assert overlap_area((3, 5, 10, 8, 20), (3, 5, 2, 1, -40)) == pytest.approx(2)
    generator = np.random.default_rng(0)
    for _ in range(20):
        a, b = (
            (*generator.uniform(0, 3, 2), *generator.uniform(1, 4, 2), generator.uniform(-45, 45))
            for _ in range(2)
        )
        points = generator.uniform(-4, 7, (40_000, 2))
        inside = np.ones(len(points), np.bool_)
        for x, y, w, d, yaw in (a, b):
            cos, sin = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
            dx, dy = points[:, 0] - x, points[:, 1] - y
            inside &= (abs(dx * cos + dy * sin) <= w / 2) & (abs(dy * cos - dx * sin) <= d / 2)
        assert overlap_area(a, b) == pytest.approx(121 * inside.mean(), abs=0.25)
