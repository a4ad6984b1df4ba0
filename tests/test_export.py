"""ONNX files compute what PyTorch computes, for any batch and bin size, and say what they are."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from small_runs import PLAIN

from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.afterstates.features import FEATURES, features
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.loading import Loader
from marl_pack.agents.networks.actor_critic import Actor, make_actor
from marl_pack.agents.networks.kinds import AGENT_KINDS, observe
from marl_pack.agents.networks.planes import PLANES
from marl_pack.export import (
    Exported,
    example,
    export_afterstates,
    export_onnx,
    main,
    writers,
)
from marl_pack.game.packing import Packing
from marl_pack.game.spec import GameSpec
from marl_pack.geometry import ORIENTATIONS
from marl_pack.train import main as train

SCRIPT = Path(__file__).parent.parent / "examples" / "drive_onnx.py"

onnxruntime = pytest.importorskip("onnxruntime")


def varied_actor(agent: str, network: dict[str, object]) -> Actor:
    """Return an actor whose probabilities differ clearly between actions."""
    torch.manual_seed(0)
    actor = make_actor(agent, network, "cpu").eval()
    for weight in actor.mlp.parameters():
        weight.data.mul_(30)  # else a fresh network is almost uniform
    return actor


def check_file(path: Path, actor: Actor, agent: str, names: list[str], game: Packing) -> None:
    """Assert that the file and the actor agree in games that have begun."""
    session = onnxruntime.InferenceSession(str(path))
    assert [i.name for i in session.get_inputs()] == names
    for _ in range(3):
        orientation = game.orientation_mask.int().argmax(1)
        game.place(orientation, game.orient(orientation).mask.flatten(1).int().argmax(1))
    before = [game.orientation_mask.int().argmax(1)] if agent == "placement" else []
    lookahead = Lookahead(AfterstateCritic())
    observation = observe(agent, game, actor.cnns.planes, lookahead, *before)
    assert list(observation) == names
    with torch.inference_mode():
        action, probabilities = Exported(actor, names)(*observation.values())
    inputs = {name: values.numpy() for name, values in observation.items()}
    for name, values in inputs.items():
        if np.issubdtype(values.dtype, np.integer):
            inputs[name] = values.astype(np.int64)
    outputs = session.run(["action", "probabilities"], inputs)
    assert np.array_equal(outputs[0], action.numpy())
    np.testing.assert_allclose(outputs[1], probabilities.numpy(), atol=1e-5)
    assert (outputs[1][~observation["mask"].numpy()] == 0).all()


@pytest.mark.parametrize("agent", AGENT_KINDS)
@pytest.mark.parametrize("planes", [(), tuple(PLANES)])
def test_an_exported_agent_agrees_with_pytorch(
    agent: str, planes: tuple[str, ...], tmp_path: Path
) -> None:
    network = {"channels": 8, "layers": 3, "context": True, "planes": list(planes)}
    actor = varied_actor(agent, network)
    path = tmp_path / "agent.onnx"
    names = export_onnx(actor, agent, path)
    for n, size in ((1, (5, 5, 5)), (7, (10, 8, 12)), (3, (13, 13, 6))):
        check_file(path, actor, agent, names, Packing(n, size, sides=(2, 4), seed=n))


@pytest.mark.parametrize("plane", PLANES)
def test_an_agent_with_one_plane_is_exported(plane: str, tmp_path: Path) -> None:
    actor = varied_actor("placement", {"channels": 4, "layers": 1, "planes": [plane]})
    path = tmp_path / "agent.onnx"
    names = export_onnx(actor, "placement", path)
    check_file(path, actor, "placement", names, Packing(3, (9, 8, 7), sides=(2, 4)))


def test_an_exported_critic_of_afterstates_agrees_with_pytorch(tmp_path: Path) -> None:
    critic = AfterstateCritic()
    export_afterstates(critic, tmp_path / "afterstates.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "afterstates.onnx"))
    game, lookahead = Packing(3), Lookahead()
    for _ in range(4):
        inputs = features(lookahead.afterstates(game), game.volume)
        value = session.run(["value"], {"features": inputs.numpy()})[0]
        np.testing.assert_allclose(value, critic(inputs).detach().numpy(), atol=1e-6)
        orientation = game.orientation_mask.int().argmax(1)
        game.place(orientation, game.orient(orientation).mask.flatten(1).int().argmax(1))


SMALL = (
    PLAIN, "--ppo.num_envs=4", "--ppo.num_steps_per_env=2", "--ppo.num_mini_batches=1",
    "--ppo.max_iterations=1", "--evaluation.every=0",
)  # fmt: skip


def test_the_command_writes_every_learned_agent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [*SMALL, f"--output.folder={tmp_path}", "--output.name=run",
               "--orientation.frozen=true", "--orientation.policy=first",
               "--placement.network.planes=[afterstate_value]", "--placement.teacher=dblf",
               "--placement.teacher_iterations=5"]  # fmt: skip
    assert train(options) == 0
    assert main([str(tmp_path / "run")]) == 0
    assert "orientation: played by first" in capsys.readouterr().out
    assert (tmp_path / "run" / "placement.onnx").is_file()
    assert (tmp_path / "run" / "afterstate_critic.onnx").is_file()
    assert main([str(tmp_path / "run"), "--format", "rsl_rl", "--folder", str(tmp_path / "o")]) == 0
    state = torch.load(tmp_path / "o" / "placement.pt", weights_only=True)
    agent = checkpoints.read(tmp_path / "run")["agents"]["placement"]
    assert "teacher" in agent
    assert state.keys() == agent.keys() - {"teacher"}
    with pytest.raises(SystemExit):
        main([str(tmp_path / "nowhere")])
    assert "no such checkpoint" in capsys.readouterr().err

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(writers, "export_agent", interrupt)
        main([str(tmp_path / "run")])
    assert end.value.code == 130
    assert capsys.readouterr().err == "python -m marl_pack.export: interrupted\n"


def test_agents_that_do_not_yet_observe_full_values_are_not_exported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = f"--output.folder={tmp_path}", "--output.name=run", "--ppo.afterstate_ramp=[0,100]"
    assert train([*SMALL, *options, "--placement.network.planes=[afterstate_value]"]) == 0
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path / "run")])
    assert ended.value.code == 2
    assert "of the values of afterstates so far" in capsys.readouterr().err


def test_a_frozen_networks_own_critic_is_written_beside_the_runs(tmp_path: Path) -> None:
    run, folder = "--output.name=run", f"--output.folder={tmp_path}"
    planes = "--placement.network.planes=[afterstate_value]"
    assert train([*SMALL, folder, "--output.name=first", planes]) == 0
    frozen = ("--placement.frozen=true", f"--placement.policy={tmp_path / 'first'}")
    planes = "--orientation.network.planes=[afterstate_value]"
    assert train([*SMALL, folder, run, planes, *frozen]) == 0
    assert main([str(tmp_path / "run")]) == 0
    inputs = np.random.default_rng(0).random((3, FEATURES), np.float32)
    values = []
    for name in ("afterstate_critic", "placement_afterstate_critic"):
        session = onnxruntime.InferenceSession(str(tmp_path / "run" / f"{name}.onnx"))
        values.append(session.run(["value"], {"features": inputs})[0])
    assert not np.allclose(*values)


def metadata(path: Path) -> dict[str, object]:
    entries = onnxruntime.InferenceSession(str(path)).get_modelmeta().custom_metadata_map
    return {key: json.loads(value) for key, value in entries.items()}


PLAIN = ("mask", "resting_height", "waste")


@pytest.fixture(scope="module")
def plain_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short run of plain agents, exported."""
    folder = tmp_path_factory.mktemp("runs")
    networks = [
        f"--{agent}.network.{option}"
        for agent in ("orientation", "placement")
        for option in (f"planes=[{','.join(PLAIN)}]", "channels=8", "layers=2")
    ]
    options = [f"--output.folder={folder}", "--output.name=plain", "--seed=5"]
    assert train([*SMALL, *options, *networks]) == 0
    assert main([str(folder / "plain")]) == 0
    return folder / "plain"


def test_a_files_metadata_say_what_its_inputs_are_and_what_it_was_trained_on(
    plain_run: Path,
) -> None:
    for agent in ("orientation", "placement"):
        facts = metadata(plain_run / f"{agent}.onnx")
        assert (facts["agent"], facts["planes"]) == (agent, list(PLAIN))
        assert facts["inputs"].keys() == example(agent, PLAIN).keys()
        assert facts["inputs"]["resting_height"]["unit"] == "cells"
        assert facts["outputs"].keys() == {"action", "probabilities"}
        assert facts["orientations"] == [list(row) for row in ORIENTATIONS]
        assert GameSpec.of(facts["game"]) == GameSpec()
        assert (facts["game"]["items"], facts["game"]["sides"]) == ("rs", [2, 5])
        assert (facts["trained_items"], facts["seed"]) == (8, 5)


def test_a_plane_says_what_each_of_its_tensors_means() -> None:
    for name, plane in PLANES.items():
        assert example("joint", [name]).keys() - example("joint", ()).keys() == plane.tensors.keys()


def test_thirty_lines_without_marl_pack_play_as_the_package_does(plain_run: Path) -> None:
    assert sum(bool(line) for line in SCRIPT.read_text("utf-8").splitlines()) <= 30
    alone = (
        "import runpy, sys; sys.modules |= {'marl_pack': None, 'torch': None}; "
        "sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0])"
    )
    policy = Loader().policy(str(plain_run))
    for seed in range(3):
        command = [sys.executable, "-c", alone, str(SCRIPT), str(plain_run), str(seed)]
        printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        rows = [line.split() for line in printed.splitlines()]
        boxes = [[int(number) for number in row[:6]] for row in rows]

        bin_ = np.zeros((10, 10, 10), int)
        for x, y, z, w, d, h in boxes:
            assert max(x + w, y + d, z + h) <= 10
            bin_[x : x + w, y : y + d, z : z + h] += 1
        assert bin_.max() == 1  # no two boxes overlap
        assert rows[-1][-1] == f"{bin_.mean():.1%}"

        items = np.random.default_rng(seed).integers(2, 6, (200, 3))
        game = Packing(1, items=items, auto_reset=False)
        while game.alive.any():
            game.place(*policy(game))
        assert game.bins.boxes[0, : len(boxes)].tolist() == boxes
        assert int(game.bins.count) == len(boxes)
