"""Trials of a real cell: known outcomes, insertion among rotated boxes, settings, the command."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from marl_pack.evaluation.statistics import share_interval
from marl_pack.physics import trial_controls
from marl_pack.physics.command import main
from marl_pack.plan import Plan
from marl_pack.plan_archive import save_plans
from marl_pack.sapien_check import SimulationError, Stack, Trial, run_trial, run_trials
from marl_pack.sapien_check import trials as trials_module
from marl_pack.sapien_check.insertion import (
    Descent,
    Standing,
    overlap_heights,
    rotation_matrices,
)
from marl_pack.sapien_check.trials import Errors
from marl_pack.sapien_check.world import Pass

BIN = (600.0, 600.0, 1000.0)
CONTROLS = trial_controls.all_controls()


def plan(*boxes: tuple[float, ...]) -> Plan:
    return Plan.of_boxes(BIN, boxes, unit_mm=1.0)


def stack(*boxes: tuple[float, ...], **named: object) -> Stack:
    return Stack.of_plan(plan(*boxes), **named)  # type: ignore[arg-type]  # of several types


# --- known outcomes -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", list(dict.fromkeys(c.kind for c in CONTROLS)))
def test_every_control_has_its_known_outcome(kind: str) -> None:
    controls = [c for c in CONTROLS if c.kind == kind]
    assert len({c.known for c in controls}) > 1  # on both sides of the limit
    outcomes = [trial_controls.outcome(c) for c in controls]
    assert outcomes == [c.known for c in controls]


# A layer of four, and one box over the middle of all of them, twice.
STABLE = [
    *((300 * i, 300 * j, 0, 300, 300, 200) for i in range(2) for j in range(2)),
    (150, 150, 200, 300, 300, 200),
    (150, 150, 400, 300, 300, 200),
]


@pytest.mark.parametrize("walls", [False, True])
@pytest.mark.parametrize("ratio", [1, 100])
def test_without_errors_a_stable_stack_hardly_moves(walls: bool, ratio: int) -> None:
    pile = stack(*STABLE, mass=np.geomspace(1, ratio, len(STABLE)))
    result = run_trial(pile, Trial(walls=walls))
    assert (result.inserted, result.left_out, result.collapse) == (6, (), None)
    assert result.distance < 0.001
    assert result.in_physics == result.planned == pytest.approx(6 * 0.3 * 0.3 * 0.2 / 0.36)


def test_thin_boards_and_a_box_on_a_lower_top_have_a_result() -> None:
    boards = Plan.of_boxes(
        (2400.0, 900.0, 600.0), [(0, 0, 30 * k, 2400, 900, 30) for k in range(8)], unit_mm=1.0
    )
    assert run_trial(Stack.of_plan(boards)).collapse is None
    # One of two supports is 3 mm lower: the box tips by a little.
    result = run_trial(stack((0, 0, 0, 300, 300, 200), (300, 0, 0, 300, 300, 197),
                             (100, 0, 200, 400, 300, 100)))  # fmt: skip
    assert result.collapse is None
    assert 0.1 < result.angle < 2


def test_boards_on_boxes_do_not_creep() -> None:
    rows = []
    for z in range(0, 1600, 200):
        rows += [(x, 0, z, 300, 1200, 170) for x in (0, 1000, 2100)]
        rows.append((0, 0, z + 170, 2400, 900, 30))
    result = run_trial(Stack.of_plan(Plan.of_boxes((2400.0, 1200.0, 1600.0), rows, unit_mm=1.0)))
    assert result.distance < 0.002


def test_a_collapse_has_to_happen_in_the_finer_simulation_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pile, coarse, fine = stack(*STABLE), Pass(1 / 15, 1), Pass(1 / 240, 50)
    monkeypatch.setattr(trials_module, "PASSES", {10.0: (coarse,)})
    assert run_trial(pile).collapse is not None
    monkeypatch.setattr(trials_module, "PASSES", {10.0: (coarse, fine)})
    assert run_trial(pile).collapse is None


def test_utilization_in_physics_counts_what_stood_before_the_collapse() -> None:
    # A cube of 200 mm, a cube over its edge that tips, and a cube that is never placed.
    boxes = [(0, 0, 0, 200, 200, 200), (150, 0, 200, 200, 200, 200), (400, 400, 0, 200, 200, 200)]
    result = run_trial(stack(*boxes))
    assert (result.collapse, result.placement, result.off) == ("placement", 1, (1,))
    assert result.inserted == 2
    assert result.planned == pytest.approx(3 * 0.2**3 / 0.36)
    assert result.in_physics == pytest.approx(0.2**3 / 0.36)
    assert "collapses in the placement of box 1: 1 of 2 boxes off" in str(result)
    # If the packing survives, but not a tilt, all of it had stood before.
    column = stack((0, 0, 0, 50, 50, 800), (300, 300, 0, 200, 200, 100))
    tilted = run_trial(column, Trial(tilt=6.0))
    assert (tilted.collapse, tilted.placement, tilted.off) == ("tilt", None, (0,))
    assert tilted.in_physics == tilted.planned


def test_a_box_without_a_place_is_left_out_and_so_is_what_stands_on_it() -> None:
    # The middle box is planned in a slot of exactly its width; its true width is larger.
    boxes = [(0, 0, 0, 200, 600, 200), (400, 0, 0, 200, 600, 200), (200, 0, 0, 200, 600, 300),
             (200, 0, 300, 200, 600, 100), (0, 0, 200, 200, 600, 100)]  # fmt: skip
    repeat = next(
        r for r in range(50)
        if Errors.drawn(Trial(size_error=0.05), 5, 0, r).sides[:3, 0].sum() > 3.02
    )  # fmt: skip
    result = run_trial(stack(*boxes), Trial(size_error=0.05), repeat=repeat)
    assert result.left_out == (2, 3)
    assert result.inserted == 3
    assert "2 could not be inserted" in str(result)
    assert result.collapse is None
    assert result.in_physics == pytest.approx((2 * 0.2 + 0.1) * 0.2 * 0.6 / 0.36)


# --- errors and seeds -----------------------------------------------------------------------------


def test_seed_episode_and_repeat_determine_the_result() -> None:
    trial = Trial(place_error=0.004, yaw=1, drop=0.005, size_error=0.01, tilt=2, shake=0.1, seed=3)
    pile = stack(*STABLE)

    def run(trial: Trial, episode: int, repeat: int) -> dict[str, object]:
        return asdict(replace(run_trial(pile, trial, episode, repeat), seconds=0.0))

    first = run(trial, 1, 0)
    assert run(trial, 1, 0) == first
    others = [run(replace(trial, seed=4), 1, 0), run(trial, 2, 0), run(trial, 1, 1)]
    assert all(other["distance"] != first["distance"] for other in others)


def test_errors_are_within_their_limits() -> None:
    trial = Trial(size_error=0.02, place_error=0.005, yaw=2)
    errors = Errors.drawn(trial, 4000, 0)
    radius = np.linalg.norm(errors.shift, axis=1)
    assert 0.0049 < radius.max() <= 0.005
    assert (radius < 0.0025).mean() == pytest.approx(0.25, abs=0.03)  # uniform in the disc
    assert 0.0195 < np.abs(errors.sides - 1).max() <= 0.02
    assert 1.95 < np.degrees(np.abs(errors.yaw)).max() <= 2
    exact = Errors.drawn(Trial(), 10, 0)
    assert (exact.sides == 1).all()
    assert not exact.shift.any()
    assert not exact.yaw.any()


def test_trials_that_are_beyond_the_limits_have_an_error() -> None:
    heavy = stack((0, 0, 0, 300, 300, 200), (0, 0, 200, 300, 300, 200), mass=[1, 101])
    high = stack(*((0, 0, 30 * k, 300, 300, 30) for k in range(31)))
    fine = stack((0, 0, 0, 300, 300, 200))
    results = list(run_trials([(heavy, 0, 0), (high, 1, 0), (fine, 2, 0)]))
    assert [isinstance(result, SimulationError) for result in results] == [True, True, False]
    assert "weighs 101 times the lightest; a trial goes to 100" in str(results[0])
    assert "31 boxes stand on each other; a trial goes to 30" in str(results[1])


def test_a_box_that_is_thrown_off_the_pallet_collapses() -> None:
    result = run_trial(stack((0, 0, 0, 100, 100, 300)), Trial(shake=3, frequency=0.5))
    assert result.collapse == "shake"
    assert result.distance > 10  # it falls beside the floor


def test_an_empty_stack_survives() -> None:
    result = run_trial(stack(), Trial(tilt=5, shake=0.5))
    assert (result.inserted, result.collapse, result.in_physics) == (0, None, 0)


@pytest.mark.parametrize(("named", "why"), [
    ({"size_error": 0.6}, "size_error = 0.6: needs a share from 0 to 0.5"),
    ({"drop": -0.001}, "drop = -0.001: needs metres from 0 to 10"),
    ({"tilt": 90}, "tilt = 90: needs degrees from 0 to 89"),
    ({"shake": float("nan")}, "shake: needs a finite number, not nan"),
    ({"shake": 11}, "shake = 11: needs g from 0 to 3"),
    ({"frequency": 0}, "frequency = 0: needs Hz from 0.5 to 30"),
    ({"give": 0.2}, "give = 0.2: needs metres from 0 to 0.1"),
    ({"friction": -1}, "friction = -1: needs a number from 0"),
    ({"place_error": 0.02}, "place_error = 0.02: needs less than the distance of a collapse, 0.02"),
    ({"yaw": 6}, "yaw = 6: needs less than the angle of a collapse, 5"),
    ({"walls": 1}, "walls = 1: needs true or false"),
    ({"seed": -1}, "seed: needs a whole number from 0"),
])  # fmt: skip
def test_impossible_settings_are_refused(named: dict[str, float], why: str) -> None:
    with pytest.raises(ValueError, match=why.replace(".", r"\.")):
        Trial(**named)  # type: ignore[arg-type]  # bad ones


# --- insertion ------------------------------------------------------------------------------------


def random_standing(draw: np.random.Generator, count: int, turn: float) -> Standing:
    """Boxes near the origin, in rotations of up to ``turn`` radians about any axis."""
    axes = draw.normal(size=(count, 3))
    vectors = turn * draw.uniform(0, 1, (count, 1)) * axes / np.linalg.norm(axes, axis=1)[:, None]
    quaternions = Rotation.from_rotvec(vectors).as_quat(scalar_first=True)
    return Standing(
        draw.uniform(-0.3, 0.3, (count, 3)), rotation_matrices(quaternions),
        draw.uniform(0.02, 0.3, (count, 3)), np.ones(count, bool),
    )  # fmt: skip


def faces(middle: np.ndarray, rotation: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, ...]:
    """The half-spaces a · x <= b of a box."""
    normals = np.vstack((rotation.T, -rotation.T))
    return normals, normals @ middle + np.tile(half, 2)


@pytest.mark.parametrize("turn", [0.0, 1e-8, 0.02, 2.0])
def test_heights_of_overlap_are_those_of_a_linear_program(turn: float) -> None:
    draw = np.random.default_rng(5)
    others = random_standing(draw, 12, turn)
    half, yaw = np.array([0.1, 0.2, 0.05]), 0.3
    places = draw.uniform(-0.3, 0.3, (2, 2))
    low, high = overlap_heights(half, yaw, places, others)
    upright = Rotation.from_euler("z", yaw).as_matrix()
    met = 0
    for k, (x, y) in enumerate(places):
        a, b = faces(np.array([x, y, 0.0]), upright, half)
        for m in range(12):
            c, d = faces(others.middles[m], others.rotations[m], others.halves[m])
            # Variables: a common point, and the height of the upright box's middle.
            rows = np.vstack((np.column_stack((a, -a[:, 2])), np.column_stack((c, np.zeros(6)))))
            ends = []
            for sign in (1, -1):
                found = linprog([0, 0, 0, sign], rows, np.append(b, d), bounds=[(None, None)] * 4)
                ends.append(found.x[3] if found.status == 0 else math.nan)
            if math.isnan(ends[0]):
                assert low[k, m] > high[k, m] - 1e-9
            else:
                met += 1
                assert (low[k, m], high[k, m]) == pytest.approx(tuple(ends), abs=1e-6)
    assert met > 5


def descent(**named: object) -> Descent:
    settings = {
        "half": np.array([0.05, 0.05, 0.05]), "yaw": 0.0, "aim": np.array([0.3, 0.3]),
        "planned": np.array([0.3, 0.3, 0.05]), "drop": 0.01, "give": 0.02, "distance": 0.02,
    }  # fmt: skip
    return Descent(**{**settings, **named})  # type: ignore[arg-type]  # of several types


def cubes(*middles: tuple[float, float, float], under: bool = False) -> Standing:
    """Upright cubes of 100 mm."""
    count = len(middles)
    return Standing(
        np.array(middles).reshape(-1, 3), np.tile(np.eye(3), (count, 1, 1)),
        np.full((count, 3), 0.05), np.full(count, under),
    )  # fmt: skip


def test_a_box_is_shifted_to_the_nearest_free_place() -> None:
    assert descent().release(cubes()) == pytest.approx([0.3, 0.3, 0.06])
    beside = cubes((0.395, 0.3, 0.05))  # it overlaps the box by 5 mm along x
    assert descent().release(beside) == pytest.approx([0.2955, 0.3, 0.06])  # pressed by half a mm
    assert descent(give=0.003).release(beside) is None
    # 8 mm along x, or 3 mm along y.
    corner = cubes((0.392, 0.397, 0.05))
    assert descent().release(corner) == pytest.approx([0.3, 0.2975, 0.06])
    both = cubes((0.395, 0.3, 0.05), (0.205, 0.3, 0.05))  # 10 mm too narrow
    assert descent().release(both) is None


def test_a_box_is_released_above_what_is_under_it() -> None:
    under = cubes((0.395, 0.3, 0.05), under=True)
    planned = np.array([0.3, 0.3, 0.15])
    assert descent(planned=planned).release(under) == pytest.approx([0.3, 0.3, 0.16])
    # Nothing under it: it would come to rest 100 mm lower than planned.
    assert descent(planned=planned).release(cubes()) is None
    # A neighbour is 8 mm higher than what carries it: in the way while the box is let down.
    higher = Standing(*(
        np.concatenate((a, b)) for a, b in zip(
            vars(under).values(), vars(cubes((0.205, 0.3, 0.058))).values(), strict=True)
    ))  # fmt: skip
    moved = descent(planned=planned).release(higher)
    assert moved is not None
    assert moved == pytest.approx([0.3045, 0.3, 0.16])


# --- the command ----------------------------------------------------------------------------------


def test_the_command_writes_all_trials(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = tmp_path / "plans.npz", tmp_path / "trials.json"
    column = plan((0, 0, 0, 50, 50, 500))  # it tips at 5.7°
    save_plans(path, [plan(*STABLE), column])
    command = ["trial", str(path), "--tilt", "8", "--place-error", "2", "0.5", "--drop", "2",
               "--repeats", "2", "--json", str(out)]  # fmt: skip
    assert main(command) == 0
    report = json.loads(out.read_text())
    assert report["complete"]
    assert report["trial"]["place_error"] == 0.002
    assert [(t["episode"], t["repeat"]) for t in report["trials"]] == [
        (0, 0), (0, 1), (1, 0), (1, 1)
    ]  # fmt: skip
    assert [t["collapse"] for t in report["trials"]] == [None, None, "tilt", "tilt"]
    assert report["summary"]["collapses"] == 2
    assert report["summary"]["collapse_interval"] == pytest.approx(share_interval(2, 4))
    printed = " ".join(capsys.readouterr().out.split())
    assert "episode 1, repeat 1: collapses in the tilt: 1 of 1 boxes off" in printed
    assert "4 trials: 2 collapsed (2 in a tilt), 50.0 %" in printed
    assert "0 of 14 boxes could not be inserted" in printed
    assert main([*command, "--episodes", "1", "--processes", "2"]) == 0
    again = json.loads(out.read_text())["trials"]
    for one, other in zip(report["trials"][2:], again, strict=True):
        assert {**one, "seconds": 0} == {**other, "seconds": 0}


def test_the_command_names_packings_without_a_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "plans.json"
    heavy = Plan.of_boxes(BIN, [(0, 0, 0, 300, 300, 200), (0, 0, 200, 300, 300, 200)],
                          [(1, 150, 150), (500, 150, 150)], unit_mm=1.0)  # fmt: skip
    heavy.to_json(path)
    assert main(["trial", str(path)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "episode 0: no result: the heaviest box weighs 500 times the lightest" in printed
    assert "1 trials without a result" in printed


@pytest.mark.parametrize(("arguments", "why"), [
    ("trial nowhere.npz", "nowhere.npz"),
    ("trial nowhere.npz --tilt 95", "tilt = 95: needs degrees from 0 to 89"),
    ("trial nowhere.npz --place-error 25 1", "needs less than the distance of a collapse"),
    ("trial nowhere.npz --repeats 0", "--repeats: needs a whole number from 1"),
    ("controls --trials --everything", "needs no --everything"),
])  # fmt: skip
def test_impossible_options_are_refused(
    arguments: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments.split()) == 2
    assert why in capsys.readouterr().err


def test_the_command_of_the_controls_counts_right_outcomes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = [c for c in CONTROLS if c.kind == "tilt"][:2]
    wrong = replace(few[0], known=trial_controls.LEFT_OUT)
    out = tmp_path / "c.json"
    for controls, status in ((few, 0), ([*few, wrong], 1)):
        monkeypatch.setattr(trial_controls, "all_controls", lambda each=controls: each)
        assert main(["controls", "--trials", "--json", str(out)]) == status
        assert f"{len(controls)} controls, 2 outcomes as known" in capsys.readouterr().out
    assert [c["outcome"] for c in json.loads(out.read_text())["controls"]] == [
        "survives", "collapses", "survives"
    ]  # fmt: skip
