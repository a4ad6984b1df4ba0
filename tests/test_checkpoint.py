"""Checkpoints: what they rebuild, and which files are refused."""

from pathlib import Path

import pytest
import torch

from marl_pack.agents.learning import checkpoint
from marl_pack.agents.policy import in_turns
from marl_pack.evaluate import main as evaluate
from marl_pack.game.packing import Packing
from marl_pack.train import main as train


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Short runs: both agents, the joint one, and one with a frozen agent."""
    folder = tmp_path_factory.mktemp("runs")
    small = ["--ppo.num_envs=8", "--ppo.num_steps_per_env=4", "--ppo.num_mini_batches=2",
             "--ppo.max_iterations=1", "--evaluation.episodes=4", f"--output.folder={folder}",
             "--placement.network.planes=[mask,rest,waste]"]  # fmt: skip
    assert train([*small, "--output.name=both", "--orientation.network.planes=[rest]"]) == 0
    assert train([*small, "--output.name=joint", "--joint=true"]) == 0
    frozen = ["--orientation.frozen=true", "--orientation.policy=random"]
    assert train([*small, "--output.name=frozen", *frozen]) == 0
    return folder


@pytest.mark.parametrize("symmetric", [False, True])
def test_a_policy_is_rebuilt_from_its_file_on_any_bin(runs: Path, symmetric: bool) -> None:
    for name in ("both", "joint", "frozen"):
        policy = checkpoint.find_policy(str(runs / name), symmetric=symmetric)
        game = Packing(16, (12, 9, 11), auto_reset=False)
        for _ in range(5):
            game.place(*policy(game))  # raises if a choice is not legal


def test_agents_of_different_sources_play_together(runs: Path) -> None:
    game = Packing(16)
    policy = in_turns(
        checkpoint.find_orientation_agent(str(runs / "joint")),
        checkpoint.find_placement_agent(str(runs / "both" / "latest.pt")),
    )
    for _ in range(5):
        game.place(*policy(game))


def test_evaluate_takes_runs_and_mixtures(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--episodes", "20", "--policy", str(runs / "both"), "dblf"]
    assert evaluate([*options, "--orientation", "first", "--placement", str(runs / "frozen")]) == 0
    shown = "".join(capsys.readouterr().out.split())
    assert "trainedonrs2-5,bin10x10x10,rulehull_alpha,32items,seed0" in shown
    assert shown.count("100.00%") == 3


@pytest.mark.parametrize(("options", "told"), [
    (["--orientation", "first"], "go together"),
    (["--policy", "nobody"], "'nobody' is neither one of dblf"),
    (["--orientation", "nobody", "--placement", "dblf"], "first nor a checkpoint"),
])  # fmt: skip
def test_an_unknown_agent_is_named(
    options: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        evaluate(options)
    assert told in capsys.readouterr().err


def test_a_truncated_foreign_or_mismatched_file_is_refused(runs: Path, tmp_path: Path) -> None:
    whole = (runs / "both" / "latest.pt").read_bytes()
    path = tmp_path / "some.pt"
    for length in (0, 10, len(whole) // 2, len(whole) - 10):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match="not a checkpoint, or cut short"):
            checkpoint.read(path)
    torch.save({"weights": torch.zeros(3)}, path)
    with pytest.raises(ValueError, match=r"not a checkpoint of marl_pack\.train"):
        checkpoint.read(path)
    torch.save(Path, path)
    with pytest.raises(ValueError, match=r"can be read"):
        checkpoint.read(path)
    found = checkpoint.read(runs / "both")
    torch.save(found | {"format": 99}, path)
    with pytest.raises(ValueError, match="format 99, this version reads 1"):
        checkpoint.read(path)
    with pytest.raises(FileNotFoundError, match="no such checkpoint"):
        checkpoint.read(tmp_path / "none.pt")
    with pytest.raises(FileNotFoundError, match=r"neither best\.pt nor latest\.pt"):
        checkpoint.read(tmp_path)
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 255
    path.write_bytes(damaged)
    with pytest.raises(ValueError, match="can be read"):
        checkpoint.read(path)
    torch.save({"format": 1, "agents": []}, path)
    with pytest.raises(ValueError, match=r"not a checkpoint of marl_pack\.train"):
        checkpoint.read(path)
    wrong = {"agents": {"orientation": {"network": {"c": 1}}}}
    with pytest.raises(ValueError, match="orientation agent's weights do not fit"):
        checkpoint.load_actor(wrong, "orientation", "cpu")
    found["agents"]["placement"]["network"]["channels"] = 16
    with pytest.raises(ValueError, match="placement agent's weights do not fit"):
        checkpoint.load_policy(found)
    with pytest.raises(ValueError, match="no learned orientation agent; it has: placement"):
        checkpoint.load_actor(checkpoint.read(runs / "frozen"), "orientation", "cpu")


def test_a_checkpoint_needs_no_code_to_be_trusted(runs: Path) -> None:
    for name in ("latest.pt", "best.pt", "model_0.pt"):
        torch.load(runs / "both" / name, weights_only=True)
