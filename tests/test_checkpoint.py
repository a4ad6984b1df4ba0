"""Checkpoints rebuild their policies, and other files are refused."""

from argparse import Namespace
from pathlib import Path

import pytest
import torch
from small_runs import PLAIN, same

from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.loading import Loader, load_actor, load_afterstate_critic, record_of
from marl_pack.agents.policy import InTurns
from marl_pack.agents.search_settings import SearchSettings
from marl_pack.config import from_dict
from marl_pack.evaluate import main as evaluate
from marl_pack.export import main as export
from marl_pack.game.packing import Packing
from marl_pack.items import make_stream
from marl_pack.players import with_search
from marl_pack.train import main as train
from marl_pack.training.assembly import make_runner


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Short runs: both agents, the joint one, and one with a frozen agent."""
    folder = tmp_path_factory.mktemp("runs")
    small = [PLAIN, "--ppo.num_envs=8", "--ppo.num_steps_per_env=4", "--ppo.num_mini_batches=2",
             "--ppo.max_iterations=1", "--evaluation.episodes=4",
             f"--output.folder={folder}"]  # fmt: skip
    both = ["--output.name=both", "--orientation.network.planes=[resting_height]"]
    assert train([*small, *both]) == 0
    assert train([*small, "--output.name=joint", "--joint=true"]) == 0
    frozen = ["--orientation.frozen=true", "--orientation.policy=random"]
    assert train([*small, "--output.name=frozen", *frozen]) == 0
    return folder


@pytest.mark.parametrize("symmetric", [False, True])
def test_a_policy_is_rebuilt_from_its_file_on_any_bin(runs: Path, symmetric: bool) -> None:
    for name in ("both", "joint", "frozen"):
        policy = Loader(symmetric=symmetric).policy(str(runs / name))
        game = Packing(16, (12, 9, 11), auto_reset=False)
        for _ in range(5):
            game.place(*policy(game))  # raises if a choice is not legal


@pytest.mark.parametrize("name", ["both", "joint", "frozen"])
def test_a_published_checkpoint_plays_and_begins_runs_as_before(
    name: str, runs: Path, tmp_path: Path
) -> None:
    assert export([str(runs / name), "--format", "checkpoint", "--folder", str(tmp_path)]) == 0
    path, game = tmp_path / "published.pt", Packing(16)
    before, after = Loader().policy(runs / name), Loader().policy(path)
    for _ in range(5):
        choice = before(game)
        assert all(map(torch.equal, choice, after(game)))
        game.place(*choice)
    whole, slim = checkpoints.read(runs / name), checkpoints.read(path)
    assert not {"state", "schedule_iteration", "evaluations"} & slim.keys()
    for agent in slim["agents"].values():
        assert not {"optimizer_state_dict", "teacher"} & agent.keys()
    config = from_dict(whole["config"])
    config.init = str(path)
    runner = make_runner(config, None)
    for kind, ppo in runner.alg.learners.items():
        assert same(ppo.critic.state_dict(), whole["agents"][kind]["critic_state_dict"])


def test_agents_of_different_sources_play_together(runs: Path) -> None:
    game = Packing(16)
    loader = Loader()
    policy = InTurns(
        loader.orientation_agent(str(runs / "joint")),
        loader.placement_agent(str(runs / "both" / "latest.pt")),
    )
    for _ in range(5):
        game.place(*policy(game))


def test_evaluate_takes_runs_and_mixtures(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--episodes", "20", "--policy", str(runs / "both"), "dblf"]
    assert evaluate([*options, "--orientation", "first", "--placement", str(runs / "frozen")]) == 0
    output = "".join(capsys.readouterr().out.split())
    assert "trainedonrs2-5,bin10x10x10,rulehull_alpha,32items,seed0" in output
    assert output.count("100.00") == 3  # the column "in equilibrium %"


@pytest.mark.parametrize(("options", "message"), [
    (["--orientation", "first"], "go together"),
    (["--policy", "nobody"], "'nobody': needs one of dblf"),
    (["--orientation", "nobody", "--placement", "dblf"], "first, cut_1, cut_2, "),
    (["--policy", "most_room"], "policy 'most_room' is now called 'max_feasible'"),
    (["--orientation", "first", "--placement", "most_room"], "'most_room' is now called"),
])  # fmt: skip
def test_an_unknown_or_renamed_agent_is_named(
    options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        evaluate(options)
    assert message in capsys.readouterr().err


def test_a_truncated_foreign_or_mismatched_file_is_refused(runs: Path, tmp_path: Path) -> None:
    whole = (runs / "both" / "latest.pt").read_bytes()
    path = tmp_path / "some.pt"
    for length in (0, 10, len(whole) // 2, len(whole) - 10):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match="not a checkpoint, or cut short"):
            checkpoints.read(path)
    torch.save({"weights": torch.zeros(3)}, path)
    with pytest.raises(ValueError, match=r"not a checkpoint of marl_pack\.train"):
        checkpoints.read(path)
    torch.save(Path, path)
    with pytest.raises(ValueError, match=r"can be read"):
        checkpoints.read(path)
    checkpoint = checkpoints.read(runs / "both")
    assert checkpoint["format"] == checkpoints.FORMAT == 2
    torch.save(checkpoint | {"format": 99}, path)
    with pytest.raises(ValueError, match="format 99, this version reads up to 2"):
        checkpoints.read(path)
    with pytest.raises(FileNotFoundError, match="no such checkpoint"):
        checkpoints.read(tmp_path / "none.pt")
    with pytest.raises(FileNotFoundError, match=r"has neither best\.pt nor latest\.pt"):
        checkpoints.read(tmp_path)
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 255
    path.write_bytes(damaged)
    with pytest.raises(ValueError, match="can be read"):
        checkpoints.read(path)
    torch.save({"format": 1, "agents": []}, path)
    with pytest.raises(ValueError, match=r"not a checkpoint of marl_pack\.train"):
        checkpoints.read(path)


def test_a_checkpoint_that_cannot_be_written_to_its_end_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "latest.pt"
    checkpoints.write(path, {"format": 1})
    before = path.read_bytes()

    class Unwritable:
        """A part of a checkpoint that cannot be written, as on a full disk."""

        def __reduce__(self) -> str:
            assert path.read_bytes() == before
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        checkpoints.write(path, {"weights": torch.zeros(1000), "last": Unwritable()})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    with path.open("rb") as reader:  # who has begun to read the old one reads it to its end
        checkpoints.write(path, {"format": 2})
        assert reader.read() == before
    assert path.read_bytes() != before


def test_mismatched_weights_and_missing_agents_are_named(runs: Path) -> None:
    with pytest.raises(ValueError, match="orientation agent's weights do not match"):
        load_actor({"network": {"c": 1}}, "orientation", "cpu")
    checkpoint = checkpoints.read(runs / "both")
    checkpoint["agents"]["placement"]["network"]["channels"] = 16
    with pytest.raises(ValueError, match="placement agent's weights do not match"):
        Loader().policy_of(checkpoint)
    with pytest.raises(ValueError, match="no orientation agent; it has: joint"):
        record_of(str(runs / "joint"), "orientation")
    frozen = checkpoints.agent_record(checkpoints.read(runs / "frozen"), "orientation")
    with pytest.raises(ValueError, match="the orientation agent is the heuristic random"):
        load_actor(frozen, "orientation", "cpu")


def test_a_checkpoint_needs_no_code_to_be_trusted(runs: Path) -> None:
    for name in ("latest.pt", "best.pt", "model_0.pt"):
        torch.load(runs / "both" / name, weights_only=True)


def test_a_depth_needs_a_critic_that_estimates_shares_of_the_bin(runs: Path) -> None:
    checkpoint = checkpoints.read(runs / "both")
    futures, depth = make_stream("rs", (10, 10, 10)), SearchSettings(depth=1)
    assert Loader(seed=3).planner(checkpoint, depth, futures).seed == -4
    for section, key in (("game", "alpha"), ("ppo", "gamma")):
        config = checkpoint["config"]
        other = config | {section: config[section] | {key: 0.5}}
        with pytest.raises(ValueError, match="a depth needs agents trained with"):
            Loader().planner(checkpoint | {"config": other}, depth, futures)
        Loader().planner(checkpoint | {"config": other}, SearchSettings(), futures)


def test_a_search_imagines_items_of_the_training_and_not_those_that_are_evaluated(
    runs: Path,
) -> None:
    source = str(runs / "both")
    arguments = Namespace(
        plan="rollouts=1", orientation=None, device="cpu", seed=0, symmetric=False
    )
    evaluated = make_stream([[1, 1, 1], [9, 9, 9]], (10, 10, 10))
    policies = {source: Loader().policy(source)}
    (planner,) = with_search(policies, arguments, evaluated, (10, 10, 10)).values()
    assert planner.futures == make_stream("rs", (10, 10, 10), (2, 5))


def test_a_frozen_agent_that_plays_at_random_has_the_seed_of_the_evaluation(runs: Path) -> None:
    checkpoint = checkpoints.read(runs / "frozen")
    game = Packing(64)
    first, same, other = (Loader(seed=s).policy_of(checkpoint)(game)[0] for s in (1, 1, 2))
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


def test_a_critic_of_afterstates_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="the critic of afterstates does not match"):
        load_afterstate_critic({"afterstate_critic": {"wrong": torch.zeros(1)}}, "cpu")
