"""Why a box is where it is: what plans say with ``--explain``."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import torch

import marl_pack
from marl_pack import Packer, Packing, Plan, evaluate, load, pack, play
from marl_pack.agents.explaining import explain
from marl_pack.agents.search_settings import SearchSettings
from marl_pack.evaluation.rollout import Reasons
from marl_pack.explanation import MOST_LISTED, Explanation
from marl_pack.plan_archive import load_plans

SCHEMA = json.loads((Path(marl_pack.__file__).parent / "plan.schema.json").read_text())
BOXES = [(400, 300, 250), (300, 200, 180), (285, 190, 160), (400, 200, 150), (250, 250, 120)]


def packed(policy: Any = "max_contact", **options: Any) -> Packer:
    packer = Packer((800, 600, 700), policy, explain=True, seed=3, **options)
    for k in range(12):
        packer.place(BOXES[k % len(BOXES)], id=str(k))
    return packer


def chosen_row(why: Explanation) -> list[float]:
    return [float(why.orientations[why.chosen]), *why.positions[why.chosen].tolist()]


@pytest.mark.parametrize("policy", ["max_contact", "linear", "dblf", "random", "search", "rs"])
def test_the_chosen_placement_is_where_the_box_is(policy: str) -> None:
    plan = packed(policy, **({"plan": "budget=5ms"} if policy == "search" else {})).plan
    assert len(plan.explanations) == len(plan) > 6
    for k, why in enumerate(plan.explanations):
        assert why is not None
        assert why.legal == len(why.orientations)
        assert chosen_row(why) == [float(plan.orientations[k]), *plan.positions[k].tolist()]


@pytest.mark.parametrize("policy", ["max_contact", "linear"])
def test_the_chosen_placement_has_the_best_score(policy: str) -> None:
    for why in packed(policy).plan.explanations:
        assert why is not None
        assert why.values is not None
        assert why.value_of == "score"
        assert why.values[why.chosen] == pytest.approx(why.values.max(), abs=1e-12)
        assert np.ptp(why.values) > 0


def test_the_listed_placements_are_the_legal_ones() -> None:
    packer = Packer((800, 600, 700), explain=True)
    packer.place(BOXES[0])
    packer.place(BOXES[1])
    why = packer.plan.explanations[1]
    assert why is not None
    seen = set()

    def every(turn: Any) -> Any:
        seen.update(turn.moves.of(0).tolist())
        return turn.moves.of(0)[:1]

    other = Packer((800, 600, 700), every)
    other.place(BOXES[0])
    seen.clear()
    other.place(BOXES[1])
    assert why.legal == len(seen)


def test_a_search_says_what_the_tried_moves_are_worth() -> None:
    plan = packed("search", plan="budget=60ms,top=4,futures=8").plan
    tried = 0
    for k, why in enumerate(plan.explanations):
        assert why is not None
        assert why.values is not None
        known = why.values[np.isfinite(why.values)]
        assert len(known) <= 4
        assert why.tries is not None
        assert ((why.tries > 0) == np.isfinite(why.values)).all()
        assert why.tries.max() <= 8 * 4
        # Each share has the boxes that are there and the new one, and is at most 1.
        assert (known >= plan.first(k + 1).utilization - 1e-9).all()
        assert (known <= 1).all()
        tried += len(known) >= 2
    assert tried >= 6


def test_agents_on_a_grid_say_their_probabilities() -> None:
    for why in packed("rs").plan.explanations:
        assert why is not None
        assert why.orientation_probabilities is not None
        assert why.orientation_probabilities.sum() == pytest.approx(1)
        assert why.probabilities is not None
        own = why.orientations == why.orientations[why.chosen]
        assert np.isnan(why.probabilities[~own]).all()
        assert why.probability_of == "cell"
        assert why.probabilities[why.chosen] == np.nanmax(why.probabilities)


@pytest.mark.parametrize("name", ["rs", "rs_upright", "dblf", "max_feasible", "random"])
def test_the_choice_on_cells_is_the_best_of_what_was_computed(name: str) -> None:
    policy = load(name).policy
    game = Packing(4, bin=(10, 10, 10), items="rs", seed=5, auto_reset=False)
    for _ in range(8):
        choice = policy(game)
        reasons = explain(policy, game, choice)
        for g, why in enumerate(reasons):
            if not game.alive[g]:
                assert why is None
                continue
            assert why is not None
            assert why.legal == int(game.mask[g].sum())
            x, y = divmod(int(choice[1][g]), 10)
            assert chosen_row(why)[:3] == [float(choice[0][g]), x, y]
            if why.orientation_probabilities is not None:
                assert why.orientation_probabilities.argmax() == int(choice[0][g])
                assert why.probabilities is not None
                assert np.nansum(why.probabilities) == pytest.approx(1)
                assert why.probabilities[why.chosen] == np.nanmax(why.probabilities)
            elif name != "random":
                assert why.values is not None
                assert why.values[why.chosen] == 0 == why.values.max()
        outcome = game.place(*choice)
        heights = game.bins.boxes[torch.arange(4), game.bins.count.long() - 1, 2]
        for why, z, done in zip(reasons, heights.tolist(), outcome.done.tolist(), strict=True):
            assert why is None or done or chosen_row(why)[3] == z


def test_a_joint_agent_and_a_search_on_cells_are_explained() -> None:
    game = Packing(2, bin=(10, 10, 10), items="rs", seed=5, auto_reset=False)
    policy = load("rs", search=SearchSettings.parse("rollouts=2,top=3")).policy
    choice = policy(game)
    for g, why in enumerate(explain(policy, game, choice)):
        assert why is not None
        assert why.values is not None
        known = np.isfinite(why.values)
        assert known.sum() == 3
        assert why.tries is not None
        assert ((why.tries > 0) == known).all()
        assert why.tries[why.chosen] == why.tries.max()
        last = why.tries == why.tries.max()  # the placements of the last round
        assert why.values[why.chosen] == why.values[last].max() > 0.3
        assert why.orientations[why.chosen] == int(choice[0][g])


def test_plans_keep_explanations_in_json(tmp_path: Path) -> None:
    plan = packed().plan
    plan.to_json(tmp_path / "plan.json")
    content = json.loads((tmp_path / "plan.json").read_text())
    jsonschema.validate(content, SCHEMA)
    again = Plan.from_json(tmp_path / "plan.json")
    assert again == plan
    assert again.explanations[3] is not None
    assert plan.first(2).explanations == plan.explanations[:2]
    without = copy.copy(content)
    del without["explanations"]
    assert Plan.of_dict(without, "without") != plan


def test_a_saved_packer_keeps_explanations_and_undo_forgets_one(tmp_path: Path) -> None:
    packer = packed()
    packer.save(tmp_path / "state.json")
    again = Packer.restore(tmp_path / "state.json")
    assert again.plan == packer.plan
    again.undo()
    assert len(again.plan.explanations) == len(packer.plan) - 1
    assert not Packer((800, 600, 700)).plan.explanations


def test_a_reported_pose_keeps_the_explanation() -> None:
    packer = Packer((800, 600, 700), explain=True, clearance_mm=10)
    placed = packer.place(BOXES[0])
    before = packer.plan.explanations
    packer.actual((placed.centre[0] + 2, placed.centre[1], 0.3))
    assert packer.plan.explanations == before


def test_long_lists_keep_the_chosen_and_the_best() -> None:
    count = MOST_LISTED + 500
    values = np.arange(count, dtype=float)
    long = Explanation(
        count, 7, np.zeros(count, np.int64), np.zeros((count, 3)), values=values, value_of="score"
    )
    short = long.shortened()
    assert len(short.orientations) == MOST_LISTED
    assert short.values is not None
    assert short.values[short.chosen] == 7
    assert set(short.values.tolist()) == {7.0, *values[-MOST_LISTED + 1 :].tolist()}
    assert short.legal == count
    plain = Explanation(count, 7, np.zeros(count, np.int64), np.zeros((count, 3)) + values[:, None])
    spaced = plain.shortened().positions[:, 0]
    assert len(spaced) == MOST_LISTED
    assert 7 in spaced
    assert np.diff(spaced).max() <= 2  # no part of the list is missing
    assert long.shortened(count) is long


def test_an_item_that_is_placed_nowhere_has_no_explanation() -> None:
    why = packed().plan.explanations[0]
    reasons = Reasons(2)
    reasons.add([why, why], [3, 2])  # game 0 began with 2 boxes, game 1 with one
    reasons.add([why, None], [3, 2])  # nothing was placed
    plans = [Plan.of_boxes((8, 8, 8), [(2 * k, 0, 0, 2, 2, 2) for k in range(n)]) for n in (3, 2)]
    assert [plan.explanations for plan in reasons.of(plans)] == [(None, None, why), (None, why)]


WRONG: dict[str, Any] = {
    "needs an object": lambda w: 3,
    "key": lambda w: {**w, "extra": 1},
    "legal": lambda w: {**w, "legal": 1},
    "chosen": lambda w: {**w, "chosen": 10**6},
    "same length": lambda w: {**w, "placements": {**w["placements"], "x": [1]}},
    "orientation": lambda w: {
        **w, "placements": {**w["placements"], "orientation": [9] * len(w["placements"]["x"])},
    },
    "values": lambda w: {**w, "values": [1.0]},
    "number": lambda w: {**w, "values": ["a"] * len(w["placements"]["x"])},
    "value_of": lambda w: {**w, "value_of": 4},
    "tries": lambda w: {**w, "tries": [0.5] * len(w["placements"]["x"])},
    "probability_of": lambda w: {**w, "probability_of": "bin"},
    "orientation_probabilities": lambda w: {**w, "orientation_probabilities": [1, 0]},
}  # fmt: skip


@pytest.mark.parametrize("words", WRONG)
def test_impossible_explanations_are_refused(words: str) -> None:
    content = packed().plan.to_dict()
    content["explanations"][4] = WRONG[words](content["explanations"][4])
    with pytest.raises(ValueError, match=rf"not a plan in JSON: (explanation 4|.*{words})"):
        Plan.of_dict(content, "file")


def test_a_plan_needs_an_explanation_for_each_box() -> None:
    content = packed().plan.to_dict()
    content["explanations"].pop()
    with pytest.raises(ValueError, match="needs one for each of 12 boxes"):
        Plan.of_dict(content, "file")


def test_programs_write_explanations(tmp_path: Path) -> None:
    csv = tmp_path / "boxes.csv"
    csv.write_text("id,w_mm,d_mm,h_mm,quantity\nA,400,300,250,6\nB,300,200,180,5\n")
    bin_mm = ["--bin-mm", "800", "600", "700"]
    out = tmp_path / "plan.json"
    assert pack.main([str(csv), *bin_mm, "--out", str(out), "--explain"]) == 0
    assert all(Plan.from_json(out).explanations)
    played = ["--policy", "dblf", "--picture", str(tmp_path / "p.png"), "--explain"]
    assert play.main([*played, "--save", str(out)]) == 0
    plan = Plan.from_json(out)
    assert all(plan.explanations)
    assert len(plan.explanations) == len(plan)
    episodes = ["--episodes", "3", "--save-stacks", str(out), "--explain"]
    assert evaluate.main(["--policy", "rs", *episodes]) == 0
    assert all(all(plan.explanations) and len(plan.explanations) for plan in load_plans(out))
    world = ["--world", "mm", "--items", str(csv), *bin_mm, "--order", "draw", "--length", "20"]
    assert evaluate.main([*world, *episodes]) == 0
    plans = load_plans(out)
    assert len(plans) == 3
    for plan in plans:
        assert plan.unit_mm == 0.1
        assert len(plan.explanations) == len(plan) > 1
        for why, position in zip(plan.explanations, plan.positions, strict=True):
            assert why is not None
            assert why.positions[why.chosen].tolist() == position.tolist()


@pytest.mark.parametrize(
    ("program", "arguments", "words"),
    [
        (pack, ["boxes.csv", "--explain"], "--explain: needs --out with a .json file"),
        (pack, ["boxes.csv", "--explain", "--out", "plan.csv"], "needs --out with a .json file"),
        (play, ["--explain"], "--explain: needs --save with a .json file"),
        (evaluate, ["--explain"], "--explain: needs --save-stacks with a .json file"),
        (evaluate, ["--explain", "--save-stacks", "p.json", "--episodes", "101"],
         "--explain: needs at most 100 episodes, not 101; use --episodes"),
    ],
)  # fmt: skip
def test_explain_needs_a_json_file(
    program: Any, arguments: list[str], words: str, tmp_path: Path,
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("boxes.csv").write_text("w_mm,d_mm,h_mm\n300,200,100\n")
    with pytest.raises(SystemExit) as stop:
        program.main(arguments)
    assert stop.value.code == 2
    assert words in capsys.readouterr().err
