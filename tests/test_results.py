"""Figures in results/ say what made them, and experiments go on where they were stopped."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.record import RESULTS, Results, record
from experiments import ablations, packing
from marl_pack import evaluate
from marl_pack.config import parse


def test_every_row_says_what_made_it() -> None:
    for path in RESULTS.glob("*.json"):
        if path.name == "reported.json":
            continue
        for key, row in json.loads(path.read_text("utf-8")).items():
            made = row["record"]
            for name in ("command", "commit", "cpu", "threads", "seeds", "packages", "date"):
                assert name in made, f"{path.name}: {key}"
            assert not made["commit"].endswith("+"), f"{path.name}: {key}: changes not committed"


def test_two_programs_that_write_one_table_keep_each_others_rows(tmp_path: Path) -> None:
    one, other = Results("table", tmp_path), Results("table", tmp_path)
    made = record("python -m x", [1, 2], 3)
    one.put("b", {"u": 0.5}, made)
    other.put("a", {"u": 0.25}, made)
    one.put("b", {"u": 0.75}, made)
    assert [(key, row["u"]) for key, row in one.rows().items()] == [("a", 0.25), ("b", 0.75)]
    assert one.row("a")["record"] == made
    assert (made["command"], made["seeds"], made["threads"]) == ("python -m x", "1, 2", 3)


def test_a_row_of_packings_goes_on_where_its_judgement_was_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("sapien")
    key = "--policy random --items rs --rule none --episodes 12 --seed 0"
    results, verdicts = Results("packing", tmp_path), iter(range(2))
    judge = evaluate.judge_plans

    def killed(*arguments: Any, **options: Any) -> Any:
        if next(verdicts) == 1:
            raise KeyboardInterrupt
        return judge(*arguments, **options)

    monkeypatch.setattr(packing, "PART", 5)
    monkeypatch.setattr(evaluate, "judge_plans", killed)
    with pytest.raises(KeyboardInterrupt):
        packing.measure(results, key, physics=True, plans_folder=tmp_path)
    assert results.row(key)["judged_episodes"] == 5
    monkeypatch.setattr(evaluate, "judge_plans", judge)
    packing.measure(results, key, physics=True, plans_folder=tmp_path)
    evaluate.main([*key.split(), "--physics", "--json", str(tmp_path / "whole.json")])
    [whole] = json.loads((tmp_path / "whole.json").read_text("utf-8"))["policies"].values()
    row = results.row(key)
    for name in ("utilization", "packed", "interval", "strict_equilibrium", "falls", "judged"):
        assert row[name] == whole[name], name
    assert (row["judged_episodes"], whole["falls"] > 0) == (12, True)
    assert not list(tmp_path.glob("*.npz"))  # nothing is left to be judged


def test_every_ablation_changes_settings_that_there_are() -> None:
    flat = {}
    for change, options in ablations.CHANGES.items():
        words = f"{ablations.BASE} {ablations.SHORT} {options}".split()
        flat[change] = tuple(sorted((k, str(v)) for k, v in parse(words)[0].flat().items()))
    assert len(set(flat.values())) == len(ablations.CHANGES)
    assert set(ablations.WORDS) == set(ablations.CHANGES)
