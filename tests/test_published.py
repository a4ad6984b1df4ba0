"""Models and settings that the package publishes are given by their names."""

from pathlib import Path

import pytest

from marl_pack import published
from marl_pack.agents.keys import ORIENTATION_AGENTS
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.config import ConfigError, parse
from marl_pack.evaluate import main as evaluate
from marl_pack.export import main as export

ROOT = Path(__file__).parent.parent


def test_every_model_and_every_file_of_settings_has_a_name() -> None:
    assert set(published.models()) >= {"cut_1", "cut_2", "rs", "types125"}
    assert set(published.configs()) >= {"quick", "paper", "ablations/joint"}
    assert all(published.model(name).is_file() for name in published.models())
    assert all(published.config(name).is_file() for name in published.configs())


def test_they_are_in_the_wheel() -> None:
    builder = pytest.importorskip("hatchling.builders.wheel").WheelBuilder(str(ROOT))
    files = {file.distribution_path for file in builder.recurse_included_files()}
    own = [*ROOT.glob("models/*.pt"), *ROOT.glob("models/*.yaml"), *ROOT.rglob("configs/*.yaml")]
    assert {f"marl_pack/{path.relative_to(ROOT).as_posix()}" for path in own} <= files
    assert all(file.startswith("marl_pack/") for file in files)


def test_no_model_is_called_as_a_heuristic() -> None:
    assert not set(published.models()) & set(ORIENTATION_AGENTS)


def test_names_work_in_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert evaluate(["--policy", "rs", "--episodes", "2"]) == 0
    assert evaluate(["--orientation", "first", "--placement", "cut_1", "--episodes", "2"]) == 0
    assert "cut_1: trained on cut1" in capsys.readouterr().out
    assert parse(["--config", "quick"])[0] == parse([f"--config={ROOT}/configs/quick.yaml"])[0]
    assert parse(["--config=quick", "--config=ablations/hull_1"])[0].game.rule == "hull_1"
    assert export(["rs", "--format", "rsl_rl"]) == 0  # beside nothing in the installed package
    assert (tmp_path / "rs" / "placement.pt").is_file()


@pytest.mark.parametrize("path", ["./rs", "runs/rs", "rs.pt"])
def test_a_path_is_no_name(path: str) -> None:
    with pytest.raises(FileNotFoundError, match="no such checkpoint"):
        checkpoints.read(path)


def test_an_unknown_name_is_answered_with_the_nearest_and_all_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, meant in (("cut1", "cut_1"), ("best_fitt", "best_fit"), ("type125", "types125")):
        with pytest.raises(SystemExit):
            evaluate(["--policy", name])
        message = capsys.readouterr().err
        assert f"'{name}': needs one of dblf, " in message
        assert f"a run's folder; did you mean '{meant}'?" in message
    with pytest.raises(ConfigError, match=r"--config 'quik': needs one of .* mean 'quick'\?"):
        parse(["--config", "quik"])


def test_a_file_or_folder_in_the_current_folder_is_given_as_a_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    with pytest.raises(ValueError, match=r"'mine': needs one of .* mean './mine'\?"):
        checkpoints.read("mine")
    (tmp_path / "settings").write_text("seed: 3")
    with pytest.raises(ConfigError, match=r"mean './settings'\?"):
        parse(["--config=settings"])
    assert parse(["--config=./settings"])[0].seed == 3
