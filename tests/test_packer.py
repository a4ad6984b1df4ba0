"""The packer: boxes in, poses out."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marl_pack import Plan
from marl_pack.packer.answers import REASONS, NoPlace, Placement
from marl_pack.packer.packer import Packer
from marl_pack.plan_archive import load_plans, save_plan
from marl_pack.stability import in_equilibrium

BIN = (800, 600, 700)
KINDS = [(300, 200, 250), (400, 300, 200), (205.5, 200, 180), (150, 120, 90), (390, 290, 110)]


def boxes(seed: int, count: int = 60) -> list[dict[str, Any]]:
    """Random boxes with attributes, as arguments of ``place``."""
    rng = np.random.default_rng(seed)
    return [
        {
            "sides": KINDS[rng.integers(len(KINDS))], "id": f"b{i}",
            "weight": float(rng.integers(1, 30)), "upright": bool(rng.random() < 0.3),
            "stackable": bool(rng.random() > 0.15),
            "max_load": float(rng.integers(5, 60)) if rng.random() < 0.4 else None,
        }
        for i in range(count)
    ]  # fmt: skip


def content(packer: Packer, tmp_path: Path) -> Any:
    """All that a packer saves."""
    packer.save(tmp_path / "saved.json")
    return json.loads((tmp_path / "saved.json").read_text()), packer.plan, packer.state


# --- plans are right, by code that shares nothing with the packer ---------------------------------


def check_plan(
    plan: Plan, given: dict[str, dict[str, Any]], *, sound: bool = True, clearance: float = 0.0
) -> None:
    """Judge a plan in plain Python: no box overlaps, floats, tips or breaks a limit."""
    for k in range(len(plan.bin_sizes)):
        chosen = [i for i in range(len(plan)) if plan.bins[i] == k]
        rows = [tuple(round(10 * v) for v in plan.boxes[i].tolist()) for i in chosen]  # 0.1 mm
        names = [plan.ids[i] for i in chosen]
        for x, y, z, w, d, h in rows:
            gap = 10 * clearance
            assert gap <= x <= 10 * plan.bin_sizes[k][0] - w - gap
            assert gap <= y <= 10 * plan.bin_sizes[k][1] - d - gap
            assert 0 <= z <= 10 * plan.bin_sizes[k][2] - h
        on: dict[int, list[int]] = {i: [] for i in range(len(rows))}
        for i, j in combinations(range(len(rows)), 2):
            a, b = rows[i], rows[j]
            shared = [min(a[c] + a[3 + c], b[c] + b[3 + c]) - max(a[c], b[c]) for c in range(3)]
            assert min(shared) <= 0, f"{names[i]} and {names[j]} overlap"
            if shared[0] > 0 and shared[1] > 0:
                lower, upper = (i, j) if a[2] < b[2] else (j, i)
                if rows[lower][2] + rows[lower][5] == rows[upper][2]:
                    on[upper].append(lower)
            elif shared[2] > 0:
                assert max(-shared[0], -shared[1]) >= 10 * clearance
        above: dict[int, set[int]] = {i: set() for i in range(len(rows))}
        for i in sorted(range(len(rows)), key=lambda i: -rows[i][2]):
            assert rows[i][2] == 0 or on[i], f"{names[i]} floats"
            for j in on[i]:
                above[j] |= {i} | above[i]
        for i, name in enumerate(names):
            box = given[name]
            sides = sorted(round(10 * side) for side in box["sides"])
            assert sorted(rows[i][3:]) == sides
            if box.get("upright"):
                assert rows[i][5] == round(10 * box["sides"][2])
            if box.get("stackable") is False:
                assert not above[i]
            if box.get("max_load") is not None:
                load = sum(given[names[j]]["weight"] for j in above[i])
                assert load <= box["max_load"] * (1 + 1e-9)
        if sound and rows:
            weights = [given[name].get("weight") or 1.0 for name in names]
            loads = [(m, x + w / 2, y + d / 2) for m, (x, y, _, w, d, _) in zip(
                weights, rows, strict=True)]  # fmt: skip
            assert in_equilibrium(np.array(rows), np.array(loads))


@pytest.mark.parametrize("rule", ["lbcp", "hull_alpha", "equilibrium"])
@pytest.mark.parametrize("policy", ["max_contact", "linear", "random"])
def test_no_box_overlaps_floats_or_breaks_a_limit(policy: str, rule: str) -> None:
    packer = Packer(BIN, policy, rule=rule, bins=3, max_weight_kg=300, clearance_mm=1)
    given = boxes(3)
    for box in given:
        if not packer.place(**box):
            packer.skip(**box)
    plan = packer.plan
    assert len(plan) > 15
    check_plan(plan, {box["id"]: box for box in given}, clearance=1)
    for k, weight in enumerate(packer.state.weight):
        assert weight <= 300
        assert weight == pytest.approx(plan.weights[plan.bins == k].sum())
    assert len(plan) + len(plan.left_out) == len(given)


def test_support_and_margin_are_those_of_the_plan() -> None:
    packer = Packer((1000, 1000, 1000), "dblf", rule="hull_1")
    first = packer.place((400, 400, 100), id="floor")
    assert isinstance(first, Placement)
    assert (first.support, first.margin, first.centre) == (1.0, 200.0, (200.0, 200.0, 50.0))
    packer.place((600, 1000, 700), upright=True)
    packer.place((400, 600, 700), upright=True)
    # 300 of 400 mm rest on the first box: the edge of the support is 100 mm from the middle.
    packer = Packer((400, 300, 1000), "dblf", rule="hull_1")
    packer.place((300, 300, 100), orientations=[0])
    top = packer.place((400, 300, 100), orientations=[0])
    assert isinstance(top, Placement)
    assert (top.x, top.z, top.support, top.margin) == (0.0, 100.0, 0.75, 100.0)
    assert packer.plan.supports.tolist() == [1.0, 0.75]
    assert packer.plan.margins.tolist() == [150.0, 100.0]
    assert packer.state.least_margin == 100.0


# --- offer, undo, restore ------------------------------------------------------------------------

POLICIES: dict[str, dict[str, Any]] = {
    "max_contact": {}, "random": {}, "search": {"plan": "budget=60s,top=4,futures=2"},
    "rs": {"grid_mm": 100},
}  # fmt: skip


@pytest.mark.parametrize("policy", POLICIES)
def test_place_does_what_was_offered(policy: str) -> None:
    packer = Packer(BIN, policy, bins=2, seed=5, **POLICIES[policy])
    for box in boxes(1, 14):
        before = packer.state
        offered = packer.offer(**box)
        assert packer.state == before
        assert packer.place(**box) == offered


@pytest.mark.parametrize("policy", POLICIES)
def test_undo_and_restore_bring_everything_back(policy: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    packer = Packer(
        BIN, policy, bins=4, clearance_mm=10, present=[[0, 0, 0, 100, 100, 300]], **POLICIES[policy]
    )
    given = iter(boxes(4, 100))
    kinds: set[str] = set()
    for _ in range(30):
        before = content(packer, tmp_path)
        box = next(given)
        kind = ["place", "place", "next_bin", "actual", "skip"][rng.integers(5)]
        try:
            if kind == "place" and not packer.place(**box):
                continue
            if kind == "next_bin":
                packer.next_bin()
            if kind == "actual":
                x, y, _ = packer.placements[-1].centre
                packer.actual((x + rng.uniform(-3, 3), y + rng.uniform(-3, 3), rng.uniform(-1, 1)))
            if kind == "skip":
                packer.skip((900, 900, 900), id="too large")
        except ValueError:
            assert content(packer, tmp_path) == before  # a refused call changes nothing
            continue
        kinds.add(kind)
        after = content(packer, tmp_path)
        assert after != before
        packer.undo()
        assert content(packer, tmp_path) == before
        again = Packer.restore(tmp_path / "saved.json")
        assert content(again, tmp_path) == before
        if kind == "place":
            assert packer.place(**box) == again.place(**box)
        elif kind == "next_bin":
            packer.next_bin()
        elif kind == "skip":
            packer.skip((900, 900, 900), id="too large")
    assert kinds == {"place", "next_bin", "actual", "skip"}


def test_undo_to_the_beginning_and_not_beyond() -> None:
    packer = Packer(BIN)
    empty = packer.plan
    for box in boxes(0, 5):
        packer.place(**box)
    for _ in range(5):
        packer.undo()
    assert packer.plan == empty
    with pytest.raises(ValueError, match="nothing was done yet"):
        packer.undo()


@pytest.mark.parametrize("ending", [".json", ".csv", ".npz"])
def test_a_plan_survives_files(ending: str, tmp_path: Path) -> None:
    packer = Packer(BIN, bins=3, clearance_mm=10)
    for k, box in enumerate(boxes(6, 40)):
        if k % 5 == 0:
            box["weight"] = None
        answer = packer.place(**box, order=f"order {k // 15}")
        if isinstance(answer, Placement) and k % 3 == 0:
            packer.actual((answer.centre[0] + 1, answer.centre[1] - 1, 0.5))
        if not answer:
            packer.skip(**box)
    plan = packer.plan
    assert plan.yaws.any()
    assert plan.weights_assumed.any()
    assert not plan.stackable.all()
    path = tmp_path / f"plan{ending}"
    save_plan(path, plan)
    (read,) = load_plans(path)
    if ending == ".json":
        assert read == plan
    else:  # these have no boxes that were left out, and no orders
        assert (read.left_out, read.orders) == ((), ())
        assert read.to_dict()["boxes"] == plan.to_dict()["boxes"]


def test_a_changed_file_is_refused(tmp_path: Path) -> None:
    packer = Packer(BIN)
    for box in boxes(0, 6):
        packer.place(**box)
    path = tmp_path / "saved.json"
    packer.save(path)
    saved = json.loads(path.read_text())

    def refuses(change: Callable[[Any], object], message: str) -> None:
        copy = json.loads(json.dumps(saved))
        change(copy)
        path.write_text(json.dumps(copy))
        with pytest.raises(ValueError, match=message):
            Packer.restore(path)

    refuses(lambda c: c["calls"][2].update(units=[0, 0, 0]), "its placement is not legal")
    refuses(lambda c: c["calls"][2].update(bin=3), "its placement is not legal")
    refuses(lambda c: c["calls"][2].update(call="plce"), "needs an object whose call is one of")
    refuses(lambda c: c["calls"][2]["box"].update(sides=[1, 2]), "three")
    refuses(lambda c: c["calls"].insert(0, {"call": "actual", "pose": [0, 0]}), "no box was placed")
    refuses(lambda c: c.update(version=7), "version 7: needs 1")
    refuses(lambda c: c.pop("calls"), "no key 'calls'")
    refuses(lambda c: c["options"].update(rule="hull"), "hull")
    refuses(lambda c: c["calls"].append({"call": "next_bin"}), "all 1 bins are open or closed")
    refuses(lambda c: c["calls"][3].update(order="B"), "its placement is not legal")
    refuses(lambda c: c["calls"].append({**c["calls"][0], "bin": 1}), "all 1 bins")
    refuses(lambda c: c["options"].update(orientations=[5]), "orientation")
    refuses(lambda c: c.update(not_saved=[[1]]), "was not saved")
    refuses(lambda c: c["calls"].append({"call": ["place"]}), "needs an object whose call")
    refuses(
        lambda c: c["calls"].append(
            {"call": "skip", "box": c["calls"][0]["box"], "code": [], "reason": ""}
        ),
        "needs one of the codes",
    )
    refuses(lambda c: c["present"].append({"box": 5, "row": [0, 0, 0, 1, 1, 1]}), "present: needs")


def test_a_function_has_to_be_given_again(tmp_path: Path) -> None:
    def first(turn: Any) -> Any:
        return turn.moves.of(0)[:1] if len(turn.moves.of(0)) else np.array([-1])

    packer = Packer(BIN, first)
    answer = packer.place((300, 200, 100))
    assert isinstance(answer, Placement)
    packer.save(tmp_path / "saved.json")
    with pytest.raises(ValueError, match="policy was not saved: restore needs it"):
        Packer.restore(tmp_path / "saved.json")
    assert Packer.restore(tmp_path / "saved.json", policy=first).placements == (answer,)


def test_reading_a_file_runs_no_code_that_it_names(tmp_path: Path) -> None:
    source = tmp_path / "mine.py"
    source.write_text("def policy(turn):\n    return turn.moves.of(0)[:1]\n")
    packer = Packer(BIN, f"{source}:policy")
    packer.place((300, 200, 100))
    packer.save(tmp_path / "saved.json")
    with pytest.raises(ValueError, match="policy was not saved"):
        Packer.restore(tmp_path / "saved.json")
    assert Packer.restore(tmp_path / "saved.json", policy=f"{source}:policy").plan == packer.plan


def test_a_policy_that_breaks_the_rule_is_stopped() -> None:
    packer = Packer(BIN, lambda turn: np.array([8]))  # at x = 0, y = 1 unit: allowed on the floor
    packer.place((300, 200, 100))
    packer = Packer(BIN, lambda turn: np.array([1 << 43]))  # floats by one unit
    with pytest.raises(ValueError, match="a move that is not legal"):
        packer.place((300, 200, 100))


# --- no place, and why ----------------------------------------------------------------------------


def reason(packer: Packer, sides: Any, **attributes: Any) -> str:
    answer = packer.place(sides, **attributes)
    assert isinstance(answer, NoPlace)
    assert not answer
    assert answer.code in REASONS
    assert packer.skip(sides, **attributes) == answer
    assert packer.plan.left_out[-1].reason == answer.reason
    return answer.code


def test_every_reason_is_found() -> None:
    small = {"orientations": (0,)}
    assert reason(Packer(BIN), (900, 100, 100), upright=True) == "too_large"
    assert reason(Packer(BIN, max_weight_kg=10), (100, 100, 100), weight=11) == "too_heavy"
    assert reason(Packer(BIN, max_weight_kg=10), (100, 100, 100)) == "unknown_weight"
    full = Packer(BIN, max_boxes=1)
    full.place((10, 10, 10))
    assert reason(full, (10, 10, 10)) == "full"
    packer = Packer((100, 100, 100), **small)
    packer.place((100, 100, 60))
    assert reason(packer, (100, 100, 60)) == "too_tall"
    packer = Packer((100, 100, 300), "dblf", **small)
    packer.place((40, 100, 100))
    assert reason(packer, (100, 100, 50)) == "no_support"
    packer = Packer((100, 100, 300), **small)
    packer.place((100, 100, 100), stackable=False)
    assert reason(packer, (50, 50, 50)) == "load"
    packer = Packer((100, 100, 300), **small)
    packer.place((100, 100, 100), max_load=5)
    assert reason(packer, (50, 50, 50), weight=6) == "load"
    assert isinstance(packer.place((50, 50, 50), weight=5), Placement)
    packer = Packer(BIN, bins=1)
    packer.place((10, 10, 10), order="a")
    assert reason(packer, (10, 10, 10), order="b") == "other_order"


def test_the_next_bin_is_opened_when_nothing_fits() -> None:
    packer = Packer((100, 100, 100), bins=2)
    answers = [packer.place((100, 100, 60)) for _ in range(3)]
    assert [answer and answer.bin for answer in answers if answer.placed] == [0, 1]
    assert not answers[2]
    assert packer.state.utilization == (0.6, 0.6)
    with pytest.raises(ValueError, match="all 2 bins are open or closed"):
        packer.next_bin()
    stays = Packer((100, 100, 100), bins=None, open_next=False)
    stays.place((100, 100, 60))
    assert not stays.place((100, 100, 60))
    assert stays.next_bin() == 1
    assert stays.place((100, 100, 60))


def test_each_order_begins_in_a_new_bin() -> None:
    packer = Packer(BIN, bins=None)
    for k in range(12):
        packer.place((200, 200, 200), order=f"order {k // 4}")
    assert packer.plan.orders == ("order 0", "order 1", "order 2")
    assert packer.plan.bins.tolist() == [0] * 4 + [1] * 4 + [2] * 4
    packer.undo()
    assert packer.plan.orders == ("order 0", "order 1", "order 2")


def test_a_function_that_chooses_nothing_is_named_as_the_reason() -> None:
    assert reason(Packer(BIN, lambda turn: np.array([-1])), (10, 10, 10)) == "policy"
    assert reason(Packer(BIN, level_tolerance_mm=5), (100, 100, 4), upright=True) == "too_thin"


def test_boxes_of_a_plan_keep_their_limits_when_they_are_there_already(tmp_path: Path) -> None:
    packer = Packer((300, 300, 300), rule="hull_1")
    packer.place((300, 300, 100), stackable=False, id="a")
    again = Packer((300, 300, 300), rule="hull_1", present=packer.plan)
    assert reason(again, (100, 100, 50)) == "load"
    packer = Packer((300, 300, 300))
    packer.place((300, 300, 100))  # its weight is assumed
    again = Packer((300, 300, 300), present=packer.plan)
    assert again.plan.weights_assumed.tolist() == [True]
    with pytest.raises(ValueError, match="need weights, because max_weight_kg is set"):
        Packer((300, 300, 300), present=packer.plan, max_weight_kg=100)
    packer = Packer((400, 400, 300), clearance_mm=20)
    first = packer.place((100, 100, 100))
    assert isinstance(first, Placement)
    packer.actual((*first.centre[:2], 3.0))
    with pytest.raises(ValueError, match="box 0 has a yaw"):
        Packer((400, 400, 300), present=packer.plan)


def test_an_order_may_begin_on_boxes_that_are_there_already() -> None:
    packer = Packer(BIN, present=[[0, 0, 0, 100, 100, 100]])
    assert packer.place((100, 100, 100), order="A")
    assert reason(packer, (100, 100, 100), order="B") == "other_order"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sides": (True, 10, 10)}, "needs three lengths w, d, h in mm"),
        ({"sides": (10, 10, 10), "id": "a\0"}, "needs a text or a whole number"),
        ({"sides": (0, 10, 10)}, "zero or negative; needs sides > 0 mm"),
        ({"sides": (-5, 10, 10)}, "zero or negative"),
        ({"sides": (float("nan"), 10, 10)}, "needs finite numbers"),
        ({"sides": (10, 10)}, "needs three lengths w, d, h in mm"),
        ({"sides": ("10", 10, 10)}, "needs three lengths w, d, h in mm"),
        ({"sides": (10.05, 10, 10)}, "needs whole units of 0.1 mm"),
        ({"sides": (10, 10, 10), "wieght": 3}, "'wieght'; did you mean 'weight'"),
        ({"sides": (10, 10, 10), "weight": -3}, "weight_kg -3; needs a positive number"),
        ({"sides": (10, 10, 10), "orientations": [7]}, "needs one or more of the numbers 0 … 5"),
        ({"sides": (10, 10, 10), "order": 5}, "order 5: needs a text"),
    ],
)
def test_bad_boxes_are_refused(arguments: dict[str, Any], message: str) -> None:
    packer = Packer(BIN)
    with pytest.raises(ValueError, match=message):
        packer.place(**arguments)
    assert packer.state.boxes == (0,)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"policy": "max_contct"}, "did you mean 'max_contact'"),
        ({"policy": 7}, "needs a name, a path or a function"),
        ({"policy": "dblf", "plan": "budget=1ms"}, "needs the policy search, linear or a .json"),
        ({"policy": "search", "plan": "budget=1"}, "needs budget=500ms, top=M or futures=K"),
        ({"policy": "search", "plan": 5}, "needs a text such as 'budget=500ms'"),
        ({"policy": "linear", "catalogue": [[1, 1, 1]]}, "only a search draws boxes"),
        ({"policy": "linear", "grid_mm": 50}, "only agents trained on cells"),
        ({"policy": "rs", "grid_mm": 1}, "grid_mm = 1: needs a cell from 4 mm"),
        ({"bins": 0}, "bins: needs a whole number from 1"),
        ({"margin_mm": -1}, "margin_mm = -1"),
        ({"margin_mm": 5, "rule": "none"}, "the rule none has no margin"),
        ({"present": [[0, 0, 0, 100, 100, 100], [50, 0, 0, 100, 100, 100]]}, "overlaps box 0"),
        ({"present": [[750, 0, 0, 100, 100, 100]]}, "reaches out of the bin"),
        ({"spec": {}}, "needs an ExactSpec"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        Packer(BIN, **arguments)
