"""The judge: stacks with a known verdict, collisions, and refused stacks and options."""

import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch

from marl_pack import evaluate
from marl_pack.game.packing import Packing
from marl_pack.physics import controls, film, table1
from marl_pack.physics.command import main
from marl_pack.plan import Plan
from marl_pack.plan_archive import load_plans
from marl_pack.sapien_check import (
    Physics,
    SimulationError,
    Stack,
    check,
    judge,
    judge_all,
)
from marl_pack.sapien_check import world as world_module
from marl_pack.sapien_check.bodies import Bodies
from marl_pack.sapien_check.world import GROUND_BIT, World, collision_groups
from marl_pack.stability import in_equilibrium

BIN = (10, 10, 10)
TIMES = ("mask_total", "mask_each", "mask_low", "mask_high", "judge_each")
FLAT = (0, 0, 0, 4, 4, 2)


def stack(*boxes: tuple[float, ...], **named: object) -> Stack:
    return Stack.of_cells(BIN, boxes, **{"density": 500.0, **named})  # type: ignore[arg-type]  # bad ones, too


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(("boxes", "named", "why"), [
    ([FLAT, (3, 3, 0, 2, 2, 2)], {}, r"box 1 \(3, 3, 0, 2, 2, 2\) overlaps box 0 \(0, 0, 0"),
    ([FLAT, (8, 0, 0, 3, 1, 1)], {}, r"box 1 .*: reaches out of the bin"),
    ([(0, 0, 9, 1, 1, 2)], {}, r"box 0 .*: reaches out of the bin"),
    ([(-1, 0, 0, 2, 2, 2)], {}, r"box 0 .*: reaches out of the bin"),
    ([FLAT, (0, 0, 3, 2, 2, 2)], {}, r"box 1 .*: floats"),
    ([FLAT, (4, 4, 2, 2, 2, 2)], {}, r"box 1 .*: floats"),  # it touches a corner only
    ([(0, 0, 2, 2, 2, 2), FLAT], {}, r"box 0 .*: floats"),  # what carries it comes later
    ([(0, 0, float("nan"), 2, 2, 2)], {}, r"box 0 .*: needs finite numbers"),
    ([FLAT, (0, 0, 2, 0, 2, 2)], {}, r"box 1 .*: needs sides longer than 0"),
    ([FLAT], {"density": None}, r"either the density \(kg/m³\) or the mass"),
    ([FLAT], {"mass": 1.0}, r"either the density"),
    ([FLAT, (4, 4, 0, 1, 1, 1)], {"density": [500, 0]}, r"box 1 \(0\): needs a positive mass"),
    ([FLAT], {"density": float("nan")}, r"box 0 .*positive mass"),
    ([FLAT], {"density": [1, 2]}, r"density or mass: shape \(2,\), needs \(\) or \(1,\)"),
    ([FLAT], {"com_offset": (0.5, 0, 0)}, r"box 0 .*centre of mass inside the box"),
    ([FLAT], {"com_offset": (0, 0)}, r"com_offset: shape \(2,\)"),
    ([FLAT], {"cell": 0.0}, r"cell = 0\.0: needs a positive length"),
    ([(0, 0, 0, 1, 1)], {}, r"needs \[n, 6\]"),
    ([FLAT], {"density": 1e308, "cell": 100.0}, r"box 0 .*: its mass is not a number > 0"),
])  # fmt: skip
def test_an_impossible_stack_is_refused_with_the_box_named(
    boxes: list[tuple[float, ...]], named: dict[str, object], why: str
) -> None:
    with pytest.raises(ValueError, match=why):
        stack(*boxes, **named)


def test_an_impossible_bin_is_refused() -> None:
    with pytest.raises(ValueError, match="three positive numbers"):
        Stack.of_cells((1, 2, 0), [FLAT], density=1.0)


def test_boxes_that_differ_too_much_are_not_judged() -> None:
    with pytest.raises(SimulationError, match=r"shortest side is 0\.00556 of the longest"):
        check(Stack.of_cells((200, 200, 100), [(0, 0, 0, 180, 180, 1)], density=1.0))
    with pytest.raises(SimulationError, match=r"weighs 1e\+05 times the lightest"):
        check(stack(FLAT, (0, 0, 2, 4, 4, 1), density=[1, 2e5]))
    judged = list(judge_all([stack(FLAT, (0, 0, 2, 4, 4, 1), density=[1, 2e5]), stack(FLAT)]))
    assert [j.placements for j in judged] == [1, 1]
    assert "times the lightest" in str(judged[0].error)
    assert judged[1].error is None


def test_a_simulation_that_breaks_down_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def far(self: World, seconds: float) -> None:
        self.set_poses(np.array([[1e4, 0, 0]]), np.array([[1.0, 0, 0, 0]]))

    monkeypatch.setattr(World, "run", far)
    with pytest.raises(SimulationError, match="1 km"):
        check(stack(FLAT))


# --- units and contacts ---------------------------------------------------------------------------


def test_cells_become_metres_and_kilograms() -> None:
    pile = stack(FLAT, (0, 0, 2, 2, 4, 1), cell=0.1, com_offset=(0.25, 0, -0.25))
    assert pile.size == pytest.approx([1, 1, 1])
    assert pile.low[1] == pytest.approx([0, 0, 0.2])
    assert pile.sides[1] == pytest.approx([0.2, 0.4, 0.1])
    assert pile.mass == pytest.approx([500 * 0.032, 500 * 0.008])
    assert pile.com[1] == pytest.approx([0.05, 0, -0.025])
    assert stack(FLAT).size == pytest.approx([0.6, 0.6, 0.6])  # the paper's bin
    assert stack(FLAT, density=None, mass=7.0).mass == pytest.approx([7])


def test_faces_that_share_an_edge_only_do_not_touch() -> None:
    pile = stack(FLAT, (4, 0, 0, 2, 4, 2), (0, 0, 2, 4, 4, 1), (4, 0, 2, 2, 2, 2))
    assert np.argwhere(pile.rests_on()).tolist() == [[2, 0], [3, 1]]


def random_stack(seed: int, rule: str = "none") -> Stack:
    """Small boxes placed anywhere: many close to one another."""
    game = Packing(1, (12, 12, 12), sides=(1, 4), rule=rule, auto_reset=False, seed=seed)
    draw = np.random.default_rng(seed)
    while bool(game.alive):
        pair = torch.tensor([draw.choice(np.flatnonzero(game.mask[0].numpy()))])
        game.place(*game.floor.split(pair))
    boxes = game.bins.boxes[0, : int(game.bins.count)].numpy()
    return Stack.of_cells((12, 12, 12), boxes, density=300.0)


@pytest.mark.parametrize("seed", range(5))
def test_a_box_collides_with_the_boxes_below_it_and_no_neighbour(seed: int) -> None:
    pile = random_stack(seed)
    assert len(pile) > 20
    groups = np.array(collision_groups(pile, Physics()), np.int64)
    first, second = groups[:, 0], groups[:, 1]
    collide = ((first[:, None] & second) | (second[:, None] & first)) > 0
    on = pile.rests_on()
    touch = on | on.T
    assert collide[touch].all()
    gap = np.maximum(pile.low[:, None], pile.low) - np.minimum(pile.high[:, None], pile.high)
    near = (gap < 0.01).all(-1) & ~np.eye(len(pile), dtype=bool)
    assert not (collide & near & ~touch).any()
    assert (((second >> GROUND_BIT) & 1) == (pile.low[:, 2] < 1e-6)).all()
    assert not ((first >> GROUND_BIT) & 1).any()


# --- verdicts -------------------------------------------------------------------------------------


@pytest.mark.parametrize("margin", [0.2, -0.2])
@pytest.mark.parametrize("name", controls.FAMILIES)
def test_a_control_is_judged_right_a_fifth_of_a_millimetre_from_tipping(
    name: str, margin: float
) -> None:
    plan = controls.FAMILIES[name](margin)
    assert check(Stack.of_plan(plan)).stands == (margin > 0)
    assert controls.exact_equilibrium(plan) == (margin > 0)


@pytest.mark.parametrize("name", controls.STANDING)
def test_stacks_with_a_large_margin_stand(name: str) -> None:
    verdict = check(Stack.of_plan(controls.STANDING[name]()))
    assert verdict.stands
    assert verdict.passes == 1
    assert verdict.distance.max() < 1e-3


def test_a_verdict_reports_which_boxes_moved_and_how_far() -> None:
    pile = stack(FLAT, (6, 6, 0, 2, 2, 2), (2, 0, 2, 5, 4, 1))  # its middle 0.5 cells over the edge
    verdict = check(pile)
    assert not verdict.stands
    assert verdict.moved == (2,)
    assert verdict.angle[2] > 1
    assert verdict.distance[1] < 1e-4
    assert verdict.passes == 3  # it has fallen three times


def test_judging_ends_at_the_first_fall() -> None:
    pile = stack(FLAT, (2, 0, 2, 5, 4, 1), (0, 4, 0, 1, 1, 1))
    assert [verdict.stands for verdict in judge(pile)] == [True, False]
    assert list(judge(pile.first(0))) == []
    assert check(pile.first(0)).stands


@pytest.mark.parametrize("seed", range(8))
def test_judging_only_boxes_connected_to_the_last_gives_the_verdict_on_all(
    seed: int,
) -> None:
    pile = random_stack(seed, "none")
    for count, verdict in enumerate(judge(pile), 1):
        whole = check(pile.first(count))
        assert verdict.stands == whole.stands
        assert verdict.moved == whole.moved
        assert verdict.distance.shape == verdict.angle.shape == (count,)


def test_if_all_boxes_collide_a_neighbour_props_up_a_falling_box() -> None:
    pile = Stack.of_plan(controls.propped(0.0, 100.0, -5.0))
    assert not check(pile).stands
    assert check(pile, Physics(everything=True)).stands


def test_walls_hold_boxes_that_collide_with_them() -> None:
    """A plate that tips off its post, with walls far away or close to it."""
    boxes = np.array([(0, 0, 0, 40, 50, 50), (0, 0, 50, 99, 50, 5)])
    wide = Stack.of_cells(
        (200, 200, 100), boxes + np.array((50, 70, 0, 0, 0, 0)), cell=0.005, density=500.0
    )
    tight = Stack.of_cells((200, 50, 100), boxes, cell=0.005, density=500.0)
    assert not check(wide, Physics(everything=True)).stands
    assert not check(tight).stands
    assert check(tight, Physics(everything=True)).stands


@pytest.mark.parametrize("unit", [1e-30, 1.0, 1e30])
@pytest.mark.parametrize("cell", [1e-4, 0.06, 4.0])
def test_a_verdict_does_not_depend_on_units_of_mass_and_length(unit: float, cell: float) -> None:
    for far, stands in ((2, False), (1, True)):
        pile = Stack.of_cells(BIN, [FLAT, (far, 0, 2, 5, 4, 1)], cell=cell, mass=unit)
        assert check(pile).stands == stands


@pytest.mark.parametrize("cell", [1e-12, 0.06, 1e12])
def test_what_touches_and_overlaps_does_not_depend_on_the_unit(cell: float) -> None:
    near = Stack.of_cells(BIN, [FLAT, (0, 0, 2 - 1e-9, 4, 4, 1)], cell=cell, mass=1.0)
    assert near.rests_on()[1, 0]
    for row, why in (((0, 0, 1.999, 4, 4, 1), "overlaps"), ((0, 0, 2.001, 4, 4, 1), "floats")):
        with pytest.raises(ValueError, match=why):
            Stack.of_cells(BIN, [FLAT, row], cell=cell, mass=1.0)


def test_a_cube_in_a_far_corner_stands_or_is_not_judged() -> None:
    for side in (1000, 2999):
        far = [(side - 1, side - 1, k, 1, 1, 1) for k in range(2)]
        assert check(Stack.of_cells((side, side, 9), far, mass=1.0)).stands
    with pytest.raises(SimulationError, match=r"bin is 1e\+09 times as long .*goes to 3000"):
        check(Stack.of_cells((10**9, 10**9, 9), [(0, 0, 0, 1, 1, 1)], mass=1.0))


def test_a_stack_of_too_many_boxes_is_refused() -> None:
    cubes = [(x, y, 0, 1, 1, 1) for x in range(60) for y in range(51)]
    with pytest.raises(ValueError, match="3060 boxes: needs at most 3000"):
        Stack.of_cells((60, 60, 60), cubes, mass=1.0)


def test_boxes_move_alike_in_every_unit_of_length() -> None:
    cells = (0.0006, 0.06, 6.0)
    small, usual, large = (
        check(Stack.of_cells(BIN, [FLAT, (2, 0, 2, 5, 4, 1)], cell=cell, mass=1.0))
        for cell in cells
    )
    for verdict, cell in ((small, cells[0]), (large, cells[2])):
        assert verdict.seconds == pytest.approx(usual.seconds)
        assert verdict.angle == pytest.approx(usual.angle, rel=0.05, abs=0.01)
        assert verdict.distance / cell == pytest.approx(usual.distance / 0.06, rel=0.05, abs=1e-3)


def test_heavy_boxes_on_light_ones_stand() -> None:
    column = [(0, 0, k, 4, 4, 1) for k in range(8)]
    for ratio in (1e3, 9e3):
        verdict = check(stack(*column, density=[500, 500 * ratio] * 4))
        assert verdict.stands


@pytest.mark.parametrize("seed", range(6))
def test_the_judge_agrees_with_the_exact_equilibrium_on_random_stacks(seed: int) -> None:
    """The first stack of each bin that is not in equilibrium, and the one before it."""
    pile = random_stack(seed, "hull_1" if seed % 2 else "none")
    rng = np.random.default_rng(seed)
    bodies = replace(
        pile, mass=pile.mass * rng.uniform(1, 30, len(pile)),
        com=pile.sides * rng.uniform(-0.15, 0.15, pile.com.shape),
    )  # fmt: skip
    cell = bodies.size[0] / 12
    boxes = np.rint(np.hstack([bodies.low, bodies.sides]) / cell).astype(np.int64)
    centres = (bodies.middle + bodies.com)[:, :2] / cell
    loads = np.column_stack([bodies.mass / bodies.mass.mean(), centres])
    stands = [in_equilibrium(boxes[:n], loads[:n]) for n in range(1, len(boxes) + 1)]
    last = stands.index(False) if False in stands else len(stands) - 1
    for n in (last, last + 1):
        assert check(bodies.first(n)).stands == (n == 0 or stands[n - 1])


def test_a_centre_of_mass_decides() -> None:
    leaning = stack(FLAT, (2, 0, 2, 4, 4, 4), com_offset=[(0, 0, 0), (0.1, 0, 0)])
    assert not check(leaning).stands
    balanced = stack(FLAT, (2, 0, 2, 4, 4, 4), com_offset=[(0, 0, 0), (-0.1, 0, 0)])
    assert check(balanced).stands


def test_several_processes_give_the_same_verdicts() -> None:
    piles = [stack(FLAT, (2, 0, 2, 5, 4, 1)), stack(FLAT), stack(FLAT, (0, 0, 2, 4, 4, 1))]
    alone = list(judge_all(piles))
    both = list(judge_all(piles, processes=2))
    assert [j.placements for j in alone] == [j.placements for j in both] == [2, 1, 2]
    assert [j.fall is None for j in alone] == [j.fall is None for j in both] == [False, True, True]
    assert alone[0].fall is not None
    assert both[0].fall is not None
    assert (alone[0].fall.distance == both[0].fall.distance).all()


# --- packings and commands ------------------------------------------------------------------------


def test_bodies_are_drawn_within_their_bounds_and_the_same_again(tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    evaluate.main(["--episodes", "3", "--save-stacks", str(path)])
    plans = load_plans(path)
    plain = Bodies().stack(plans[1], 1)
    assert plain.mass == pytest.approx(500 * plain.sides.prod(1))
    assert plain.com == pytest.approx(np.zeros((len(plain), 3)))
    drawn = Bodies(density=(100.0, 1000.0), com_spread=0.2, seed=4)
    pile = drawn.stack(plans[1], 1)
    density = pile.mass / pile.sides.prod(1)
    assert ((density >= 100) & (density <= 1000)).all()
    assert density.max() > 2 * density.min()
    off = np.abs(pile.com / pile.sides)
    assert off.max() <= 0.2
    assert off.max() > 0.1
    again = drawn.stack(plans[1], 1)
    assert (again.mass == pile.mass).all()
    other = drawn.stack(plans[1], 2)
    assert not np.array_equal(other.com[:5], pile.com[:5])


@pytest.mark.parametrize("named", [
    {"density": (0.0, 1.0)}, {"density": (2.0, 1.0)}, {"com_spread": 0.5}, {"com_spread": -0.1},
    {"seed": -1}, {"density": (1.0, float("inf"))},
])  # fmt: skip
def test_impossible_bodies_are_refused(named: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="needs"):
        Bodies(**named)  # type: ignore[arg-type]  # bad ones are meant


def test_evaluate_counts_falls(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.json"
    for rule, some in (("hull_alpha", False), ("none", True)):
        arguments = f"--policy dblf --rule {rule} --episodes 8 --physics --json {out}"
        assert evaluate.main(arguments.split()) == 0
        row = json.loads(out.read_text())["policies"]["dblf"]
        assert (row["falls"] > 0) == some
        placed = round(8 * row["packed"])
        assert row["judged"] < placed if some else row["judged"] == placed
        assert "falls" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        evaluate.main(["--com-spread", "0.1"])
    assert "go with --physics" in capsys.readouterr().err


def test_saved_stacks_are_judged_and_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "s.npz", tmp_path / "out.json"
    evaluate.main(["--rule", "none", "--policy", "random", "--episodes", "4",
                   "--save-stacks", str(path)])  # fmt: skip
    assert main(["stack", str(path), "--json", str(out)]) == 0
    report = json.loads(out.read_text())
    assert report["packings"] == 4
    fall = report["falls"][0]
    assert f"episode {fall['episode']}: placing box {fall['boxes'] - 1} moved box" in " ".join(
        capsys.readouterr().out.split()
    )
    picture = tmp_path / "s.png"
    command = ["stack", str(path), "--episodes", str(fall["episode"]), "--render", str(picture)]
    assert main(command) == 0
    assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".json", ".npz", ".png"]


@pytest.mark.parametrize(("arguments", "why"), [
    ("stack nowhere.npz", "nowhere.npz"),
    ("table1 --objects 0", "--objects 0"),
    ("table1 --processes 0", "--processes: needs a whole number from 1 to 1024, not 0"),
    ("table1 --processes 1000000", "from 1 to 1024, not 1000000"),
    ("table1 --seed -1", "--seed: needs a whole number from 0 to"),
    ("controls --friction nan", "friction = nan"),
    ("table1 --json nowhere/x.json", "does not exist"),
])  # fmt: skip
def test_impossible_options_are_refused(
    arguments: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments.split()) == 2
    assert why in capsys.readouterr().err


def test_table1_does_not_depend_on_the_processes_and_counts_falls(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, falls = tmp_path / "t.json", tmp_path / "falls"
    options = ["--objects", "20", "--json", str(out), "--save-falls", str(falls)]
    rows = []
    for more in (["--rules", "none", "hull_alpha"], ["--rules", "none", "--processes", "2"]):
        assert main(["table1", *options, *more]) == 0
        rules = json.loads(out.read_text())["rules"]
        rows.append({rule: {key: value for key, value in row.items() if key not in TIMES}
                     for rule, row in rules.items()})  # fmt: skip
    assert rows[0]["none"] == rows[1]["none"]
    assert rows[0]["none"]["objects"] == 20
    assert rows[0]["none"]["falls"] > 0
    assert rows[0]["none"]["falls"] == rows[0]["none"]["falls_unstable"]
    assert rows[0]["hull_alpha"]["falls"] == 0
    output = capsys.readouterr().out
    assert "hull_alpha, paper" in output
    assert "hull_1, paper" not in output  # it is not asked for
    plans = load_plans(tmp_path / "falls_none.npz")
    assert len(plans) == rows[0]["none"]["falls"]
    assert all(plan.unit_mm == 1000 * table1.CELL for plan in plans)
    judged = list(judge_all(Bodies().stacks(plans, range(len(plans)))))
    assert all(j.fall is not None for j in judged)
    assert [j.placements for j in judged] == [len(plan) for plan in plans]


def test_a_film_shows_the_fall(tmp_path: Path) -> None:
    pile = Stack.of_plan(controls.FAMILIES["box 10 times heavier on a light one"](-20.0))
    frames = list(film.simulate(pile))
    assert [len(f.middles) for f in frames[:1] + frames[-1:]] == [1, 3]
    assert frames[-1].moved
    assert frames[-1].middles[2, 2] == pytest.approx(0.05, abs=0.01)  # the heavy one is down
    path = tmp_path / "fall.gif"
    assert film.render(pile, path, "falls").moved
    captions = [film.caption_of("falls", len(f.middles), 3) for f in (frames[0], frames[-1])]
    assert captions == ["falls: 1 of 3 boxes", "falls: 3 of 3 boxes"]
    pictures = imageio.mimread(path)
    falling = sum(
        len(a.middles) == len(b.middles) and np.abs(b.middles - a.middles).max() > 0.002
        for a, b in pairwise(frames)
    )
    assert falling > 8
    assert falling < len(pictures) < len(frames)  # frames in which nothing moves are one
    assert np.any(pictures[0] != pictures[-1])
    with pytest.raises(ValueError, match=r"\.png, \.gif, \.mp4"):
        film.render(pile, tmp_path / "fall.avi")
    with pytest.raises(ValueError, match="no boxes"):
        film.render(pile.first(0), path)


def test_a_plan_becomes_a_stack_in_its_own_unit() -> None:
    boxes = [FLAT, (0, 0, 2, 2, 4, 1)]
    loads = [(32.0, 2, 2), (3.0, 0.5, 3)]
    plan = Plan.of_boxes(BIN, boxes, loads)
    pile = Stack.of_plan(plan)
    assert pile.size == pytest.approx([0.6, 0.6, 0.6])  # the paper's bin
    assert pile.mass.tolist() == [32, 3]
    assert pile.com / pile.sides == pytest.approx(np.array([(0, 0, 0), (-0.25, 0.25, 0)]))
    own = Stack.of_plan(replace(plan, unit_mm=25.0), density=400.0, com_offset=(0, 0, 0.1))
    assert own.size == pytest.approx([0.25, 0.25, 0.25])
    assert own.mass == pytest.approx(400 * 0.025**3 * np.array([32, 8]))
    assert own.com / own.sides == pytest.approx(np.array([(0, 0, 0.1)] * 2))
    bodies = Bodies().stack(replace(plan, unit_mm=25.0), 0)
    assert bodies.size == pytest.approx([0.25, 0.25, 0.25])
    assert bodies.mass == pytest.approx(500 * 0.025**3 * np.array([32, 3]))


def test_a_plan_of_several_bins_is_judged_bin_by_bin() -> None:
    plan = Plan.of_boxes(BIN, [FLAT, (0, 0, 0, 2, 2, 2)][:1])
    plan = replace(plan, bin_sizes=np.array([BIN, BIN]))
    with pytest.raises(ValueError, match=r"2 bins: needs one, plan\.in_bin\(k\)"):
        Stack.of_plan(plan)
    assert [len(Stack.of_plan(plan.in_bin(k))) for k in (0, 1)] == [1, 0]


def test_the_judge_imports_nothing_that_packs() -> None:
    folder = Path(world_module.__file__).parent
    imported = {
        name
        for path in folder.glob("*.py") if path.name != "__main__.py"
        for name in re.findall(r"^ *from marl_pack\.([\w.]+) import", path.read_text(), re.M)
    }  # fmt: skip
    assert {name.split(".")[0] for name in imported} <= {
        "bins", "checks", "extras", "geometry", "plan", "files", "sapien_check"
    }  # fmt: skip


def test_an_episode_is_named_with_its_box(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "s.npz"
    np.savez(path, bin=np.array(BIN), count=np.array([1, 2]), utilization=np.zeros(2),
             boxes=np.array([[FLAT] * 2] * 2),
             loads=np.array([[(32.0, 2, 2)] * 2] * 2))  # fmt: skip
    assert main(["stack", str(path)]) == 2
    assert "episode 1: box 1 (0, 0, 0, 4, 4, 2) overlaps box 0" in capsys.readouterr().err


def test_without_sapien_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    from marl_pack.sapien_check.world import load_sapien

    load_sapien.cache_clear()
    monkeypatch.setitem(sys.modules, "sapien", None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install -e "\.\[physics\]"'):
        check(stack(FLAT))
    load_sapien.cache_clear()
