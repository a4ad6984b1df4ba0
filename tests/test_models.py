"""The trained checkpoints of models/ play right after installation, as their cards say."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from conftest import mirrored, put_boxes

from marl_pack import config
from marl_pack.agents import learned
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.loading import Loader
from marl_pack.agents.networks.actor_critic import Actor
from marl_pack.agents.networks.symmetry import mean_probabilities
from marl_pack.evaluate import main
from marl_pack.game.packing import Packing
from marl_pack.play import main as play

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
    model, heuristic = rows[str(path)], rows["dblf"]
    assert model["strict_equilibrium"] == 1
    assert model["utilization"] > heuristic["utilization"] + 0.05
    assert f"{path}: trained on" in capsys.readouterr().out


def test_in_all_symmetries_a_model_plays_the_same_in_the_mirrored_bin() -> None:
    game = Packing(64, seed=3)
    for _ in range(4):
        game.place(*make_policy("random", 2)(game))
    other = game.branch(torch.arange(game.n))
    put_boxes(other, mirrored(game.bins, 1))

    def agreement(symmetric: bool) -> float:
        policy = Loader(symmetric=symmetric).policy("types125")
        (orientation, cell), (other_orientation, other_cell) = policy(game), policy(other)
        x, y = game.floor.corner(cell)
        x = 10 - game.orient(orientation).sides[:, 0].long() - x
        same = (orientation == other_orientation) & (game.floor.cell(x, y) == other_cell)
        return float(same.float().mean())

    assert agreement(symmetric=False) < 0.9
    assert agreement(symmetric=True) > 0.95  # but for ties


@pytest.mark.parametrize("path", MODELS, ids=lambda path: path.stem)
def test_a_model_comes_with_its_settings_and_its_learning_curve(path: Path) -> None:
    checkpoint = checkpoints.read(path)
    settings = yaml.safe_load(path.with_suffix(".yaml").read_text(encoding="utf-8"))
    assert settings == checkpoint["config"]
    config.from_dict(settings)  # this version reads them
    curve = np.genfromtxt(path.with_suffix(".csv"), delimiter=",", names=True)
    assert curve["items"][-1] >= checkpoint["items"]
    assert f"## {path.stem}\n" in (path.parent / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("path", MODELS, ids=lambda path: path.stem)
def test_a_model_holds_only_what_others_need_of_it(path: Path) -> None:
    content = torch.load(path, weights_only=True)
    published = checkpoints.without_training(content)
    assert content["format"] == checkpoints.FORMAT
    assert content.keys() == published.keys()
    for name, agent in content["agents"].items():
        assert agent.keys() == published["agents"][name].keys()


def test_play_shows_a_model_in_the_game_it_was_trained_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, game in (("cut_1", "cut1"), ("types125", "rs 1-5")):
        model = next(path for path in MODELS if path.stem == name)
        assert play(["--policy", str(model), "--picture", str(tmp_path / "bin.png")]) == 0
        output = " ".join(capsys.readouterr().out.split())
        assert f"plays {game}, bin 10 x 10 x 10, rule hull_alpha" in output


def test_only_learned_agents_are_asked_in_all_symmetries(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        main(["--policy", "dblf", "--symmetric", "--episodes", "2"])
    assert "--symmetric: needs" in capsys.readouterr().err


@pytest.mark.parametrize("plan", [[], ["--plan", "rollouts=1,top=2,depth=1"]])
def test_the_option_symmetric_reaches_the_agents(
    plan: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    agents = set()

    def spied(actor: Actor, observation: Mapping[str, torch.Tensor], agent: str) -> torch.Tensor:
        agents.add(agent)
        return mean_probabilities(actor, observation, agent)

    monkeypatch.setattr(learned, "mean_probabilities", spied)
    command = ["--policy", str(MODELS[-1]), "--symmetric", "--episodes", "2", *plan]
    assert main(command) == 0
    assert agents == {"orientation", "placement"}
    assert "learned agents asked in all" in " ".join(capsys.readouterr().out.split())
