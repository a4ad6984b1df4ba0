"""Checkpoints of format 1 are migrated to format 2."""

from pathlib import Path
from typing import Any

import pytest
import torch
from rsl_rl.algorithms import PPO
from small_runs import PLAIN, same
from torch import Tensor

from marl_pack import config as configs
from marl_pack import published
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.loading import Loader
from marl_pack.agents.networks.planes import PLANES
from marl_pack.export import main as export
from marl_pack.game.packing import Packing
from marl_pack.train import main as train
from marl_pack.training.assembly import make_runner

ORIGINAL = Path(__file__).parent / "data" / "format_1.pt"
"""What the last version with format 1 wrote, of small networks after one iteration."""


# --- a file that an earlier version wrote ---------------------------------------------------------


def test_a_checkpoint_of_format_1_is_read_as_format_2() -> None:
    original, checkpoint = torch.load(ORIGINAL, weights_only=True), checkpoints.read(ORIGINAL)
    assert original["format"] == 1
    assert checkpoint["format"] == 2
    assert not {"afterstates", "state"} & checkpoint.keys()
    assert checkpoint["afterstate_optimizer"].keys() == {"state", "param_groups"}
    settings = configs.from_dict(checkpoint["config"])
    for name, agent in checkpoint["agents"].items():
        weights = original["agents"][name]["actor_state_dict"]
        assert any(key.startswith("afterstates.") for key in weights)
        rest = {k: w for k, w in weights.items() if not k.startswith("afterstates.")}
        assert same(agent["actor_state_dict"], rest)
        critic = {f"afterstates.{k}": w for k, w in checkpoint["afterstate_critic"].items()}
        assert same(rest | critic, weights)
        assert "afterstate_critic" not in agent
        planes = agent["network"]["planes"]
        assert set(planes) <= set(PLANES)
        assert len(planes) == len(original["agents"][name]["network"]["planes"])
        assert planes == getattr(settings, name).network.planes


@pytest.mark.parametrize("path", [ORIGINAL, published.model("rs")], ids=lambda path: path.stem)
def test_the_export_of_a_checkpoint_loads_into_a_stock_ppo(path: Path, tmp_path: Path) -> None:
    """A published model gets a fresh optimiser; that of format 1 had the critic's parameters."""
    assert export([str(path), "--format", "rsl_rl", "--folder", str(tmp_path)]) == 0
    settings = configs.from_dict(checkpoints.read(path)["config"])
    settings.init = str(path)
    settings.ppo.num_envs, settings.ppo.num_steps_per_env, settings.ppo.num_mini_batches = 4, 2, 2
    runner = make_runner(settings, None)
    for name, stock in runner.alg.learners.items():
        assert type(stock) is PPO
        state = torch.load(tmp_path / f"{name}.pt", weights_only=True)
        assert same(stock.actor.state_dict(), state["actor_state_dict"]), "by init"
        with torch.no_grad():
            for weight in stock.actor.parameters():
                weight.zero_()
        stock.load(state, None, True)
        assert same(stock.actor.state_dict(), state["actor_state_dict"])
        assert same(stock.critic.state_dict(), state["critic_state_dict"])
        parameters = [*stock.actor.parameters(), *stock.critic.parameters()]
        (group,) = stock.optimizer.param_groups
        assert len(group["params"]) == len(parameters)
        assert group["lr"] == state["optimizer_state_dict"]["param_groups"][0]["lr"] > 0
        for parameter in parameters if path == ORIGINAL else ():
            assert stock.optimizer.state[parameter]["exp_avg"].shape == parameter.shape
    critic = checkpoints.read(path)["afterstate_critic"]
    assert same(runner.alg.lookahead.critic.state_dict(), critic)
    runner.train(1)


# --- checkpoints made by hand ---------------------------------------------------------------------


def critic_of(value: float) -> dict[str, Tensor]:
    return {"layers.0.weight": torch.full((2, 3), value), "layers.0.bias": torch.full((2,), value)}


def inside(critic: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return a critic's weights as they stood among an actor's."""
    return {f"afterstates.{name}": weight for name, weight in critic.items()}


OWN, FROZEN, TEACHER = critic_of(1.0), critic_of(2.0), critic_of(3.0)
ACTOR = {"cnns.weight": torch.tensor([0.0]), "mlp.weight": torch.tensor([1.0])}
NETWORK = {"channels": 4, "planes": ["mask", "rest", "room", "fits", "worth", "solid", "filled"]}
NEW_PLANES = ["mask", "resting_height", "feasible_cells", "feasible_probability",
              "afterstate_value", "grounded", "filled"]  # fmt: skip
NEW_NETWORK = {"channels": 4, "shortcut": False, "context": False, "planes": NEW_PLANES}


def learner(**others: Any) -> dict[str, Any]:
    """Return a learner's record of format 1; its optimiser knows two of four last parameters."""
    return {
        "network": NETWORK,
        "actor_state_dict": ACTOR | inside(OWN),
        "critic_state_dict": {"mlp.weight": torch.tensor([4.0]), "mlp.bias": torch.tensor([5.0])},
        "optimizer_state_dict": {
            "state": {k: {"exp_avg": torch.tensor([float(k)])} for k in (0, 1, 4, 5)},
            "param_groups": [{"lr": 0.1, "params": [0, 1, 2, 3, 4, 5]}],
        },
        **others,
    }


def network_of(critic: dict[str, Tensor]) -> dict[str, Any]:
    """Return the record of a network that another run trained, in format 1."""
    return {"network": NETWORK, "actor_state_dict": ACTOR | inside(critic)}


def read(folder: Path, agents: dict[str, Any], number: int = 1, **config: Any) -> dict[str, Any]:
    """Write a checkpoint of an earlier format and read it."""
    path = folder / "old.pt"
    checkpoint = {
        "format": number, "marl_pack": "0.9", "config": config, "agents": agents, "iter": 3,
        "items": 8, "seconds": 1.0, "evaluations": [], "schedule_iteration": 4,
        "afterstates": {"state": {}}, "state": [{"game": {}}],
    }  # fmt: skip
    torch.save(checkpoint, path)
    return checkpoints.read(path)


def test_a_learner_loses_its_copy_of_the_critic(tmp_path: Path) -> None:
    checkpoint = read(tmp_path, {"orientation": learner(), "placement": learner()})
    assert same(checkpoint["afterstate_critic"], OWN)
    assert checkpoint["afterstate_optimizer"] == {"state": {}}
    for agent in checkpoint["agents"].values():
        assert "afterstate_critic" not in agent
        assert same(agent["actor_state_dict"], ACTOR)
        assert agent["network"] == NEW_NETWORK
        optimizer = agent["optimizer_state_dict"]
        assert optimizer["param_groups"] == [{"lr": 0.1, "params": [0, 1, 2, 3]}]
        moments = {k: float(state["exp_avg"]) for k, state in optimizer["state"].items()}
        assert moments == {0: 0, 1: 1, 2: 4, 3: 5}


def test_frozen_networks_and_teachers_have_critics_of_their_own(tmp_path: Path) -> None:
    agents = {
        "orientation": learner(imitated=network_of(TEACHER)), "placement": network_of(FROZEN)
    }  # fmt: skip
    checkpoint = read(tmp_path, agents)
    assert same(checkpoint["afterstate_critic"], OWN)
    orientation, placement = checkpoint["agents"].values()
    assert "imitated" not in orientation
    for record, critic in ((orientation["teacher"], TEACHER), (placement, FROZEN)):
        assert same(record["afterstate_critic"], critic)
        assert same(record["actor_state_dict"], ACTOR)
        assert record["network"]["planes"] == NEW_PLANES
    own = checkpoints.agent_record(checkpoint, "placement")
    assert same(own["afterstate_critic"], FROZEN), "not that of the run"
    assert same(checkpoints.agent_record(checkpoint, "orientation")["afterstate_critic"], OWN)


def test_agents_that_see_no_values_have_no_critic(tmp_path: Path) -> None:
    blind = {"network": {"planes": ["mask", "room"]}, "actor_state_dict": ACTOR}
    checkpoint = read(tmp_path, {"orientation": blind, "placement": learner()})
    assert same(checkpoint["agents"]["orientation"]["actor_state_dict"], ACTOR)
    assert "afterstate_critic" not in checkpoints.agent_record(checkpoint, "orientation")
    assert "afterstate_critic" not in read(tmp_path, {"orientation": blind, "placement": blind})


def test_heuristics_and_settings_get_their_new_names(tmp_path: Path) -> None:
    agents = {
        "orientation": learner(imitated={"name": "most_room"}), "placement": {"name": "most_room"}
    }  # fmt: skip
    settings = {
        "orientation": {"network": NETWORK, "imitate": "most_room", "imitate_iterations": 5},
        "placement": {"frozen": True, "policy": "most_room"},
        "game": {"bin": [4, 4, 4]},
    }
    checkpoint = read(tmp_path, agents, **settings)
    assert checkpoint["agents"]["orientation"]["teacher"] == {"name": "max_feasible"}
    assert checkpoint["agents"]["placement"] == {"name": "max_feasible"}
    assert checkpoint["config"] == {
        "orientation": {
            "network": NEW_NETWORK,
            "teacher": "max_feasible", "teacher_iterations": 5,
        },
        "placement": {"frozen": True, "policy": "max_feasible"},
        "game": {"bin": [4, 4, 4]},
    }  # fmt: skip
    config = configs.from_dict(checkpoint["config"])
    assert config.orientation.teacher == config.placement.policy == "max_feasible"
    agent = Loader().placement_agent_of(checkpoint["agents"]["placement"])
    game = Packing(4)
    orientation = game.orientation_mask.int().argmax(1)
    assert game.moves.allows(orientation, agent(game, orientation)).all()


REMOVED = {"dilation": 1, "share_trunk": True}


@pytest.mark.parametrize("number", [1, 2])
def test_settings_that_were_removed_are_dropped(number: int, tmp_path: Path) -> None:
    player = network_of(OWN) | {"network": NETWORK | REMOVED}
    agents = {"orientation": player | {"teacher": player}, "placement": player}
    settings = {"ppo": {"symmetry": False, "lam": 0.9}, "placement": {"network": REMOVED}}
    checkpoint = read(tmp_path, agents, number, **settings)
    assert not REMOVED.keys() & checkpoint["config"]["placement"]["network"].keys()
    assert checkpoint["config"]["ppo"] == {"lam": 0.9}
    orientation, placement = checkpoint["agents"].values()
    for record in (orientation, orientation["teacher"], placement):
        assert NETWORK.keys() <= record["network"].keys()
        assert not REMOVED.keys() & record["network"].keys()


@pytest.mark.parametrize(("where", "name", "value"), [
    ("config.ppo", "symmetry", True), ("config.orientation.network", "dilation", 2),
    ("agents.placement.network", "share_trunk", False),
    ("agents.placement.teacher.network", "dilation", True),
])  # fmt: skip
def test_another_value_of_a_removed_setting_is_refused(
    where: str, name: str, value: object, tmp_path: Path
) -> None:
    agents = {"placement": network_of(OWN) | {"teacher": network_of(OWN)}}
    checkpoint = {"agents": agents, "ppo": {}, "orientation": {"network": {}}}
    section: Any = checkpoint
    for key in where.removeprefix("config.").split("."):
        section[key] = section = dict(section[key])
    section[name] = value
    with pytest.raises(ValueError, match=rf"{where}\.{name} = {value}: was removed; only "):
        read(tmp_path, checkpoint.pop("agents"), 2, **checkpoint)


def test_a_run_of_format_1_is_not_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = [PLAIN, "--game.bin=[4,4,4]", "--game.sides=[1,3]", "--ppo.num_envs=4",
             "--ppo.num_steps_per_env=2", "--ppo.num_mini_batches=2", "--ppo.max_iterations=1",
             "--evaluation.every=0", "--output.name=run",
             f"--output.folder={tmp_path}"]  # fmt: skip
    assert train(small) == 0
    path = tmp_path / "run" / "latest.pt"
    checkpoint = checkpoints.read(path) | {"format": 1}
    for name in ("orientation", "placement"):
        settings = checkpoint["config"][name]
        settings["imitate"] = settings.pop("teacher")
        settings["imitate_iterations"] = settings.pop("teacher_iterations")
        for network in (settings["network"], checkpoint["agents"][name]["network"]):
            network["planes"] = ["mask", "rest", "waste"]
    checkpoints.write(path, checkpoint)
    assert isinstance(checkpoints.read(path)["state"], str)
    before = path.read_bytes()
    capsys.readouterr()
    assert train(["--resume", str(tmp_path / "run"), "--ppo.max_iterations=2"]) == 2
    message = capsys.readouterr().err
    assert "this run cannot be resumed: an earlier version wrote it" in message
    assert "--init" in message
    assert path.read_bytes() == before
    again = [*small, "--output.name=again", f"--init={tmp_path / 'run' / 'latest.pt'}"]
    assert train(again) == 0, "what the reason advises"
