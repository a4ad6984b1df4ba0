"""``marl-pack evaluate --world mm``: games in millimetres from a file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marl_pack import evaluate
from marl_pack.plan_archive import load_plans

ROWS = (
    "id,w_mm,d_mm,h_mm,weight_kg,upright,quantity\n"
    "a,300,200,250,4,yes,4\nb,400,300,200,6,no,3\nc,205.5,200,200,2,no,5\n"
)


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    (tmp_path / "goods.csv").write_text(ROWS)
    return [
        "--world",
        "mm",
        "--items",
        str(tmp_path / "goods.csv"),
        "--bin-mm",
        "800",
        "600",
        "700",
    ]


def test_the_table_the_figures_and_the_plans_agree(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, plans = tmp_path / "out.json", tmp_path / "plans.json"
    words = [*words, "--order", "draw", "--length", "20", "--episodes", "12", "--margin-mm", "10"]
    assert evaluate.main([*words, "--json", str(out), "--save-stacks", str(plans)]) == 0
    report = json.loads(out.read_text())
    row = report["policies"]["max_contact"]
    packings = load_plans(plans)
    assert row["episodes"] == len(packings) == 12
    assert row["utilization"] == pytest.approx(np.mean([plan.utilization for plan in packings]))
    assert row["strict_equilibrium"] == 1.0
    assert report["settings"]["margin_mm"] == 10
    assert report["settings"]["bin_mm"] == [800, 600, 700]
    assert {plan.unit_mm for plan in packings} == {0.1}
    assert set(packings[0].ids) <= {"a", "b", "c"}
    printed = capsys.readouterr().out
    assert f"{100 * row['utilization']:.2f}" in printed
    assert "bin 800 x 600 x 700 mm, rule lbcp, margin 10 mm" in printed


def test_windows_of_a_file_are_its_episodes(words: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    policies = ["--policy", "dblf", "linear", "random"]
    assert evaluate.main([*words, "--length", "4", *policies, "--json", str(out)]) == 0
    report = json.loads(out.read_text())
    assert {row["episodes"] for row in report["policies"].values()} == {3}  # 12 boxes
    assert set(report["policies"]) == {"dblf", "linear", "random"}


def test_a_policy_of_the_users_own(words: list[str], tmp_path: Path) -> None:
    code = tmp_path / "mine.py"
    code.write_text(
        "from marl_pack.exact.policies import make_exact_policy\n"
        "def lowest(game):\n    return make_exact_policy('dblf')(game)\n"
    )
    out = tmp_path / "out.json"
    policies = ["--policy", "dblf", f"{code}:lowest"]
    assert evaluate.main([*words, *policies, "--json", str(out)]) == 0
    first, second = json.loads(out.read_text())["policies"].values()
    assert first["utilization"] == second["utilization"]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--bin", "3", "3", "3"], "--bin: goes with --world cells; here it is --bin-mm"),
        (["--margin", "1"], "--margin: goes with --world cells"),
        (["--device", "cuda"], "--device and --threads go with --world cells"),
        (["--margin-mm", "-1"], "margin_mm = -1.0: needs a length"),
        (["--clearance-mm", "0.05"], "whole units of 0.1 mm"),
        (["--policy", "dbfl"], "did you mean 'dblf'"),
        (["--policy", "rs"], "needs one of dblf"),
        (["--order", "draw"], "needs length"),
        (["--length", "40"], "needs at least 40"),
        (["--episodes", "3"], "--episodes 3: needs 1"),
        (["--unit-mm", "1"], "row 2 (line 4) is [205.5, 200.0, 200.0]: needs whole units of 1 mm"),
    ],
)
def test_a_wrong_option_says_what_would_be_right(
    words: list[str], more: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _status([*words, *more]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--margin-mm", "3"], "--margin-mm: goes with --world mm"),
        (["--order", "draw"], "--order: goes with --world mm"),
        (["--world", "mm"], "needs --items FILE"),
        (["--world", "mm", "--items", "nowhere.csv"], "nowhere.csv"),
        (["--world", "inches"], "needs one of cells, mm"),
    ],
)
def test_options_of_the_other_world_are_refused(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _status(words) == 2
    assert message in capsys.readouterr().err


def _status(words: list[str]) -> Any:
    try:
        return evaluate.main(words)
    except SystemExit as error:
        return error.code


def test_boxes_of_a_plan_are_in_every_bin(words: list[str], tmp_path: Path) -> None:
    from marl_pack.plan import Plan

    plan = Plan.of_boxes((800, 600, 700), [[0, 0, 0, 800, 600, 350]], unit_mm=1)
    plan.to_json(tmp_path / "there.json")
    out = tmp_path / "out.json"
    more = ["--present", str(tmp_path / "there.json"), "--length", "3", "--json", str(out)]
    assert evaluate.main([*words, *more]) == 0
    assert json.loads(out.read_text())["policies"]["max_contact"]["utilization"] > 0.5
    assert _status([*words, "--present", str(tmp_path / "nowhere.json")]) == 2
    Plan.of_boxes((9, 9, 9), [[0, 0, 3, 9, 9, 3]], unit_mm=1).to_json(tmp_path / "bad.json")
    assert _status([*words, "--present", str(tmp_path / "bad.json")]) == 2


def test_a_policy_that_returns_no_legal_move_is_refused(words: list[str], tmp_path: Path) -> None:
    code = tmp_path / "wrong.py"
    code.write_text(
        "import numpy as np\n"
        "def seven(game):\n    return np.full(game.n, 7)\n"
        "def short(game):\n    return np.zeros(1, np.int64)\n"
        "def nothing(game):\n    return None\n"
    )
    for name in ("seven", "short", "nothing"):
        assert _status([*words, "--length", "3", "--policy", f"{code}:{name}"]) == 2
