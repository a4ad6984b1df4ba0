import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_runs import PLAIN

from marl_pack import evaluate, train
from marl_pack import play as play_command
from marl_pack.agents.heuristics import make_policy
from marl_pack.evaluation import rollout
from marl_pack.evaluation.rollout import Rollout
from marl_pack.evaluation.statistics import spread, strict_equilibrium, summary
from marl_pack.game.packing import Packing
from marl_pack.plan import Plan
from marl_pack.plan_archive import ENDINGS, load_plans
from marl_pack.terminal import make_console


def test_the_table_the_json_and_the_stacks_agree(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, stacks = tmp_path / "out.json", tmp_path / "stacks.npz"
    arguments = ["--policy", "dblf", "--items", "rs", "--episodes", "40", "--seed", "3"]
    assert evaluate.main([*arguments, "--save-stacks", str(tmp_path / "stacks.csv")]) == 0
    assert evaluate.main([*arguments, "--json", str(out), "--save-stacks", str(stacks)]) == 0
    assert load_plans(tmp_path / "stacks.csv") == load_plans(stacks)
    report = json.loads(out.read_text())
    row = report["policies"]["dblf"]
    plans = load_plans(stacks)
    assert row["episodes"] == len(plans) == 40
    assert row["utilization"] == pytest.approx(np.mean([plan.utilization for plan in plans]))
    assert row["packed"] == pytest.approx(np.mean([len(plan) for plan in plans]))
    assert row["strict_equilibrium"] == 1.0
    assert report["settings"]["seed"] == 3
    assert f"{100 * row['utilization']:.2f}" in capsys.readouterr().out
    # The stacks hold the boxes that make the utilization.
    with np.load(stacks) as archive:
        boxes, count = archive["boxes"], archive["count"]
        volume = boxes[..., 3:].astype(int).prod(2).sum(1)
        assert (volume / 1000 == archive["utilization"]).all()
        assert (archive["utilization"] == [plan.utilization for plan in plans]).all()
        assert ((boxes[..., 3] > 0).sum(1) == count).all()
    assert not list(tmp_path.glob("*.part"))


def test_what_is_played_does_not_depend_on_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    def play() -> Rollout:
        return rollout.play(
            make_policy("best_fit"),
            lambda n, first: Packing(n, seed=1, first_episode=first, auto_reset=False),
            25,
        )

    whole = play()
    monkeypatch.setattr(rollout, "BATCH", 7)
    parts = play()
    assert len(whole.plans) == 25
    assert (whole.utilization == parts.utilization).all()
    assert whole.plans == parts.plans


def test_progress_counts_every_episode_once() -> None:
    counted: list[int] = []
    rollout.play(
        make_policy("random"),
        lambda n, first: Packing(n, first_episode=first, auto_reset=False),
        30,
        counted.append,
    )
    assert sum(counted) == 30


@pytest.mark.parametrize("episodes", [0, -1, 1.5, True, "3"])
def test_episodes_to_play_are_a_whole_number(episodes: object) -> None:
    with pytest.raises(ValueError, match="episodes: needs a whole number >= 1"):
        rollout.play(make_policy("dblf"), lambda n, first: Packing(n), episodes)


def filled(height: int, boxes: int) -> Plan:
    """A bin of 10³ with so many plates, filled up to a height."""
    rows = [(0, 0, k, 10, 10, 1) for k in range(boxes - 1)]
    return Plan.of_boxes((10, 10, 10), [*rows, (0, 0, boxes - 1, 10, 10, height - boxes + 1)])


def test_the_summary_is_as_worked_by_hand() -> None:
    played = Rollout([filled(5, 5), filled(6, 2), filled(7, 5)] * 4, seconds=3.0)
    figures = summary(played, np.array([True, True, False] * 4))
    assert figures["utilization"] == pytest.approx(0.6)
    assert figures["std"] == pytest.approx(0.1 * (8 / 11) ** 0.5)
    # Student's t with eleven degrees of freedom: 2.20099 · 0.08528 / √12
    assert figures["interval"] == pytest.approx([0.6 - 0.054185, 0.6 + 0.054185], abs=1e-5)
    assert figures["packed"] == pytest.approx(4)
    assert figures["decisions_per_second"] == pytest.approx(16)
    assert figures["strict_equilibrium"] == pytest.approx(2 / 3)


def test_equal_episodes_have_an_interval_of_no_width() -> None:
    figures = summary(Rollout([filled(5, 2)] * 10, 1.0), np.ones(10, np.bool_))
    assert figures["interval"] == [0.5, 0.5]
    assert figures["std"] == 0


def test_intervals_need_ten_episodes_and_lie_within_the_bin() -> None:
    plans = [*[filled(1, 1)] * 9, filled(10, 2)]
    assert summary(Rollout(plans[1:], 1.0), np.ones(9, np.bool_))["interval"] is None
    figures = summary(Rollout(plans, 1.0), np.ones(10, np.bool_))
    # Student's t with nine degrees of freedom: 0.19 ± 2.26216 · 0.28460 / √10
    assert figures["interval"] == pytest.approx([0, 0.39359], abs=1e-5)
    assert spread(figures["utilization"], figures["interval"]) == " ± 20.36"


def test_a_stack_that_falls_is_not_in_equilibrium() -> None:
    balanced = [(0, 0, 0, 2, 2, 2), (0, 0, 2, 4, 2, 1)]  # on the edge
    falls = Plan.of_boxes((9, 9, 9), balanced, [(8, 1, 1), (8, 2, 1)])
    stands = Plan.of_boxes((9, 9, 9), [balanced[0], (0, 0, 2, 3, 2, 1)], [(8, 1, 1), (6, 1.5, 1)])
    assert [strict_equilibrium(plan) for plan in (falls, stands)] == [False, True]


def test_every_bin_of_a_plan_must_be_in_equilibrium() -> None:
    rows = np.array([(0, 0, 0, 2, 2, 2), (0, 0, 0, 2, 2, 2), (0, 0, 2, 3, 2, 1)])
    for last, stands in ((0, False), (1, True)):  # in bin 0 the last box is on nothing
        plan = Plan(
            np.full((2, 3), 9), np.array([1, 1, last]), rows[:, :3], rows[:, 3:], np.zeros(3, int),
            np.ones(3), rows[:, :2] + rows[:, 3:5] / 2, ("",) * 3,
        )  # fmt: skip
        if stands:
            plan = replace(plan, positions=np.array([(0, 0, 0), (5, 5, 0), (0, 0, 2)]),
                           centres=np.array([(1, 1), (6, 6), (1.5, 1)]))  # fmt: skip
        assert strict_equilibrium(plan) == stands


def test_fractions_of_a_unit_are_not_judged_as_cells() -> None:
    with pytest.raises(ValueError, match="whole numbers"):
        strict_equilibrium(Plan.of_boxes((9, 9, 9), [(0, 0, 0, 2.5, 2, 2)]))


def test_only_sound_rules_keep_every_stack_standing(tmp_path: Path) -> None:
    shares = {}
    for rule in ("hull_1", "hull_alpha", "lbcp", "equilibrium"):
        out = tmp_path / f"{rule}.json"
        arguments = f"--policy random --rule {rule} --episodes 150 --json {out}".split()
        assert evaluate.main(arguments) == 0
        shares[rule] = json.loads(out.read_text())["policies"]["random"]["strict_equilibrium"]
    assert shares["hull_1"] < 1
    assert [shares[rule] for rule in ("hull_alpha", "lbcp", "equilibrium")] == [1, 1, 1]


def test_all_heuristics_beat_random_play(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    names = ["dblf", "height_min", "best_fit", "random"]
    evaluate.main(["--policy", *names, "--episodes", "200", "--json", str(out)])
    rows = json.loads(out.read_text())["policies"]
    for name in names[:3]:
        assert rows[name]["interval"][0] > rows["random"]["interval"][1] + 0.1


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ("--policy nobody", "'nobody': needs one of"),
        ("--items missing.npz", "no such file"),
        ("--items=", "no such file"),
        ("--items sr", "unknown items|no such file"),
        ("--episodes 0", "--episodes 0"),
        ("--margin -1", "margin"),
        ("--seed 1_0", "--seed: invalid int value: '1_0'"),
        ("--bin 10 10 1_0", "--bin: invalid int value: '1_0'"),
        ("--alpha 1_0.5", "--alpha: invalid float value: '1_0.5'"),
        ("--beta 1e300", "beta = 1e.300: needs a number from -1e9 to 1e9"),
        ("--thresholds code", "no parameter 'thresholds'"),
        ("--bin 10 10 0", "bin size"),
        ("--bin 4 4 4", "longest side"),
        ("--orientations 7", "orientations"),
        ("--json nowhere/out.json", "does not exist"),
        ("--policy dblf random --save-stacks s.npz", "needs a single policy"),
        ("--json tests", "is a folder"),
        ("--json new.json --save-stacks ./new.json", "--save-stacks: new.json: need two files"),
        ("--device nowhere", "device 'nowhere'"),
        ("--device meta", "needs cpu, cuda"),
        ("--seed -1", "--seed: needs a whole number from 0 to 9223372036854775807, not -1"),
        ("--threads 0", "--threads: needs a whole number from 1 to 1024, not 0"),
        ("--threads 1000000", "from 1 to 1024, not 1000000"),
        ("--processes 1000000", "--processes: needs a whole number from 1 to 1024"),
    ],
)
def test_impossible_options_are_refused_without_a_traceback(
    arguments: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        evaluate.main(arguments.split())
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert "Traceback" not in message
    assert re.search(why, message)


def test_more_episodes_than_a_file_has_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "items.csv"
    path.write_text("w,d,h\n2,2,2\n3,3,3\n")
    options = ["--items", str(path), "--bin", "5", "5", "5"]
    with pytest.raises(SystemExit):
        evaluate.main([*options, "--episodes", "2"])
    assert "1 … 1" in capsys.readouterr().err
    assert evaluate.main(options) == 0


@pytest.mark.parametrize("length", [8, 40, 200])
def test_a_policys_name_is_never_broken_however_narrow_the_terminal(length: int) -> None:
    names = ["dblf", "n" * length]
    row = {
        "episodes": 1000, "utilization": 0.9, "interval": (0.8, 1.0), "std": 0.1, "packed": 20.0,
        "decisions_per_second": 10_000.0, "strict_equilibrium": 1.0, "falls": 7,
        "judged_episodes": 10,
    }  # fmt: skip
    output = io.StringIO()
    console = make_console(file=output, force_terminal=True, width=80, color_system=None)
    evaluate.show(dict.fromkeys(names, row), "a game", console)
    lines = output.getvalue().splitlines()
    for name in names:
        assert sum(name in line for line in lines) == 1
    assert sum("90.00 ± 10.00" in line and "7 of 10" in line for line in lines) == 2


def test_a_single_episode_has_no_interval(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    assert evaluate.main(["--episodes", "1", "--json", str(out)]) == 0
    row = json.loads(out.read_text(), parse_constant=pytest.fail)["policies"]["dblf"]
    assert row["interval"] is None
    assert row["std"] is None


def test_episodes_that_cannot_begin_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate.main(["--margin", "1", "--episodes", "40"]) == 0
    assert "may be placed nowhere" in " ".join(capsys.readouterr().out.split())


def test_a_checkpoints_own_game_is_played_unless_options_change_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [PLAIN, "--ppo.max_iterations=1", "--ppo.num_envs=8", "--ppo.num_mini_batches=2",
               "--game.bin=[6,6,7]", "--game.sides=[1,3]", "--game.rule=area_ratio",
               "--game.thresholds=code", "--game.orientations=[0,1]", "--evaluation.every=0",
               "--game.com_offset=[0.05,0,0]", "--output.name=run"]  # fmt: skip
    assert train.main([*options, f"--output.folder={tmp_path}"]) == 0
    run, out = str(tmp_path / "run"), tmp_path / "out.json"
    command = ["--policy", run, "random", "--episodes", "4", "--json", str(out)]

    def settings(*more: str) -> dict[str, object]:
        assert evaluate.main([*command, *more]) == 0
        report: dict[str, object] = json.loads(out.read_text())["settings"]
        return report

    own = settings()
    assert own["bin"] == [6, 6, 7]
    assert own["sides"] == [1, 3]
    assert own["rule"] == "area_ratio"
    assert own["thresholds"] == "code"
    assert own["orientations"] == [0, 1]
    assert own["com_offset"] == [0.05, 0, 0]
    output = " ".join(capsys.readouterr().out.split())
    assert "rule area_ratio, thresholds code, orientations 0 1, centre of mass off by" in output
    other = settings("--rule", "hull_alpha", "--bin", "8", "8", "8", "--items", "cut2")
    assert (other["rule"], other["thresholds"]) == ("hull_alpha", None)
    assert (other["bin"], other["sides"], other["items"]) == ([8, 8, 8], [1, 3], "cut2")


def test_play_shows_the_game_and_draws_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bin.png"
    saved = [tmp_path / f"plan{ending}" for ending in ENDINGS]
    for plan in saved:
        assert play_command.main(["--picture", str(path), "--save", str(plan)]) == 0
    text = capsys.readouterr().out
    assert "in strict equilibrium" in text
    assert load_plans(saved[0]) == load_plans(saved[1]) == load_plans(saved[2])
    assert f"{len(load_plans(saved[0])[0])} boxes" in text
    assert Plan.from_json(tmp_path / "plan.json") == Plan.from_csv(tmp_path / "plan.csv")
    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    film = tmp_path / "bin.gif"
    assert play_command.main(["--picture", str(film)]) == 0
    assert film.read_bytes()[:6] == b"GIF89a"
    for wrong, why in (
        (["--picture", "bin.xyz"], "ending .png, .gif, .mp4"),
        (["--policy", "dblf", "random", "--picture", str(path)], "needs one policy"),
        (["--episode", "-1", "--picture", str(path)], "needs 0"),
    ):
        with pytest.raises(SystemExit):
            play_command.main(wrong)
        assert why in capsys.readouterr().err


def test_play_shows_where_a_choice_without_a_cell_ends_the_game(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    items = tmp_path / "items.csv"
    items.write_text("sequence,w,d,h\n0,4,4,1\n0,4,1,4\n", encoding="utf-8")
    command = ["--orientation", "first", "--placement", "dblf", "--no-orientation-mask",
               "--items", str(items), "--bin", "4", "4", "4",
               "--picture", str(tmp_path / "x.png")]  # fmt: skip
    assert play_command.main(command) == 0
    text = capsys.readouterr().out
    assert "nowhere" in text
    assert "1 boxes" in text


def test_a_policy_of_ones_own_is_measured_beside_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(
        "from marl_pack import load\ndblf = load('dblf')\nnumber = 3\n", encoding="utf-8"
    )
    Path("broken.py").write_text("import no_such_package\n", encoding="utf-8")
    assert evaluate.main(["--policy", "mine.py:dblf", "dblf", "--episodes", "20"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if "dblf" in line]
    mine, theirs = (row.split("dblf", 1)[1].split()[:3] for row in rows)
    assert mine == theirs
    for source, why in (
        ("mine.py:best", "mine.py has no function best"),
        ("mine.py:number", "mine.py has no function number"),
        ("yours.py:dblf", "yours.py: no such file"),
        ("broken.py:dblf", "broken.py: cannot be run: ModuleNotFoundError: No module named"),
    ):
        with pytest.raises(SystemExit):
            evaluate.main(["--policy", source, "--episodes", "20"])
        assert why in capsys.readouterr().err


def test_boxes_without_a_bin_are_packed_into_that_of_the_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    items = tmp_path / "boxes.csv"
    items.write_text("w,d,h\n4,4,1\n", encoding="utf-8")
    assert evaluate.main(["--policy", "plain", "--items", str(items)]) == 0
    assert "bin 10 x 10 x 10" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        evaluate.main(["--policy", "dblf", "--items", str(items)])
    assert "boxes.csv: has no bin size; give one, W D H" in capsys.readouterr().err
