"""ONNX files say what PyTorch says, for any batch and bin size."""

from pathlib import Path

import numpy as np
import pytest
import torch

from marl_pack.agents.afterstates.critic import AfterstateCritic, features
from marl_pack.agents.learning import checkpoint
from marl_pack.agents.networks.actor_critic import make_actor
from marl_pack.agents.networks.trunk import PLANES
from marl_pack.export import Exported, export_afterstates, export_onnx, main
from marl_pack.game.packing import Packing

onnxruntime = pytest.importorskip("onnxruntime")


@pytest.mark.parametrize("agent", ["orientation", "placement", "joint"])
@pytest.mark.parametrize("planes", [(), PLANES])
def test_an_exported_agent_agrees_with_pytorch(
    agent: str, planes: tuple[str, ...], tmp_path: Path
) -> None:
    torch.manual_seed(0)
    network = {"channels": 8, "layers": 3, "context": True, "planes": list(planes)}
    actor = make_actor(agent, network, "cpu").eval()
    for weight in actor.mlp.parameters():
        weight.data.mul_(30)  # else the first network is almost uniform
    path = tmp_path / "agent.onnx"
    names = export_onnx(actor, agent, path)
    session = onnxruntime.InferenceSession(str(path))
    assert [i.name for i in session.get_inputs()] == names
    for n, size in ((1, (5, 5, 5)), (7, (10, 8, 12)), (3, (13, 13, 6))):
        game = Packing(n, size, sides=(2, 4), seed=n)
        for _ in range(3):
            chosen = game.orientation_mask.int().argmax(1)
            game.place(chosen, game.orient(chosen).mask.flatten(1).int().argmax(1))
        chosen = [game.orientation_mask.int().argmax(1)] if agent == "placement" else []
        seen = actor.see(game, *chosen)
        with torch.inference_mode():
            action, probabilities = Exported(actor, names)(*(seen[name] for name in names))
        given = {name: seen[name].numpy() for name in names}
        for name, values in given.items():
            if np.issubdtype(values.dtype, np.integer):
                given[name] = values.astype(np.int64)
        out = session.run(["action", "probabilities"], given)
        assert np.array_equal(out[0], action.numpy())
        np.testing.assert_allclose(out[1], probabilities.numpy(), atol=1e-5)
        assert (out[1][~seen["mask"].numpy()] == 0).all()


def test_an_exported_critic_of_afterstates_agrees_with_pytorch(tmp_path: Path) -> None:
    critic = AfterstateCritic()
    export_afterstates(critic, tmp_path / "afterstates.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "afterstates.onnx"))
    game = Packing(3)
    for _ in range(4):
        seen = features(game.left(), game.volume)
        value = session.run(["value"], {"features": seen.numpy()})[0]
        np.testing.assert_allclose(value, critic(seen).detach().numpy(), atol=1e-6)
        chosen = game.orientation_mask.int().argmax(1)
        game.place(chosen, game.orient(chosen).mask.flatten(1).int().argmax(1))


def test_the_command_writes_every_learned_agent(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from marl_pack.train import main as train

    options = ["--ppo.num_envs=4", "--ppo.num_steps_per_env=2", "--ppo.num_mini_batches=1",
               "--ppo.max_iterations=1", "--evaluation.every=0", f"--output.folder={tmp_path}",
               "--output.name=run", "--orientation.frozen=true", "--orientation.policy=first",
               "--placement.network.planes=[worth]", "--placement.imitate=dblf",
               "--placement.imitate_iterations=5"]  # fmt: skip
    assert train(options) == 0
    assert main([str(tmp_path / "run")]) == 0
    assert "orientation: played by first" in capsys.readouterr().out
    assert (tmp_path / "run" / "placement.onnx").is_file()
    assert (tmp_path / "run" / "placement_afterstates.onnx").is_file()
    assert main([str(tmp_path / "run"), "--format", "rsl_rl", "--folder", str(tmp_path / "o")]) == 0
    state = torch.load(tmp_path / "o" / "placement.pt", weights_only=True)
    found = checkpoint.read(tmp_path / "run")
    assert state.keys() == found["agents"]["placement"].keys() - {"imitated"}
    with pytest.raises(SystemExit):
        main([str(tmp_path / "nowhere")])
    assert "no such checkpoint" in capsys.readouterr().err
