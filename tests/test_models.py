"""The trained checkpoints of models/ play right after installation, as their cards say."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from marl_pack import config
from marl_pack.agents import checkpoint
from marl_pack.evaluate import main

MODELS = sorted((Path(__file__).parent.parent / "models").glob("*.pt"))


@pytest.mark.parametrize("path", MODELS, ids=lambda path: path.stem)
def test_a_model_plays_the_game_it_was_trained_on(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "table.json"
    command = ["--policy", str(path), "dblf", "--episodes", "60", "--seed", "3"]
    assert main([*command, "--json", str(table)]) == 0
    figures = yaml.safe_load(table.read_text(encoding="utf-8"))
    rows = figures.get("policies", figures)
    learned, heuristic = rows[str(path)], rows["dblf"]
    assert learned["strict_equilibrium"] == 1
    assert learned["utilization"] > heuristic["utilization"] + 0.05
    assert f"{path}: trained on" in capsys.readouterr().out


@pytest.mark.parametrize("path", MODELS, ids=lambda path: path.stem)
def test_a_model_comes_with_its_settings_and_its_learning_curve(path: Path) -> None:
    found = checkpoint.read(path)
    settings = yaml.safe_load(path.with_suffix(".yaml").read_text(encoding="utf-8"))
    assert settings == found["config"]
    config.from_dict(settings)  # this version reads them
    curve = np.genfromtxt(path.with_suffix(".csv"), delimiter=",", names=True)
    assert curve["items"][-1] >= found["items"]
    assert f"## {path.stem}\n" in (path.parent / "README.md").read_text(encoding="utf-8")
