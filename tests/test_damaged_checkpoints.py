"""Damaged checkpoints are refused in one line, whatever is wrong and wherever they come in."""

import copy
import io
import zipfile
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import in_play
from fuzz.checkpoints import cases, outcomes
from small_runs import tiny
from torch import Tensor

from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.learning.runner import TrainingDivergedError
from marl_pack.evaluate import main as evaluate
from marl_pack.export import main as export
from marl_pack.game.packing import Packing
from marl_pack.train import main as train
from marl_pack.training.assembly import make_runner

NAN = float("nan")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one iteration, in which the placement agent sees values of afterstates."""
    folder = tmp_path_factory.mktemp("run")
    planes = "--placement.network.planes=[mask,afterstate_value]"
    make_runner(tiny("--orientation.network.planes=[mask]", planes), folder).train(1)
    return folder


@pytest.fixture
def content(run: Path) -> dict[str, Any]:
    """What the run's checkpoint holds, to be damaged."""
    content: dict[str, Any] = torch.load(run / "latest.pt", weights_only=True)
    return content


# --- any value ------------------------------------------------------------------------------------


def test_any_changed_value_is_refused_in_one_line_or_does_no_harm(
    content: dict[str, Any], tmp_path: Path
) -> None:
    """Every door takes the file or names what is wrong (``outcomes`` raises other errors)."""
    path, whole = tmp_path / "changed.pt", tmp_path / "whole.pt"
    torch.save(content, whole)
    assert set(outcomes(whole, content["config"]).values()) == {"taken"}
    refused = 0
    for _, changed in islice(cases(4, content), 10):
        torch.save(changed, path)
        refused += set(outcomes(path, content["config"]).values()) != {"taken"}
    assert refused > 5


def test_weights_that_are_not_finite_are_refused_by_every_command_and_named(
    content: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.pt"
    content["agents"]["placement"]["actor_state_dict"]["mlp.scores.weight"][0, 0] = NAN
    torch.save(content, path)
    message = f"{path}: agents.placement.actor_state_dict.mlp.scores.weight: has numbers that are"
    commands: list[tuple[Callable[[list[str]], int], list[str]]] = [
        (evaluate, ["--policy", str(path)]),
        (evaluate, ["--orientation", "first", "--placement", str(path)]),
        (export, [str(path), "--format", "rsl_rl", "--folder", str(tmp_path)]),
        (train, ["--resume", str(path)]),
        (train, [f"--init={path}", f"--output.folder={tmp_path}"]),
        (train, ["--placement.frozen=true", f"--placement.policy={path}",
                 f"--output.folder={tmp_path}"]),
    ]  # fmt: skip
    for command, options in commands:
        try:
            status = command(options)
        except SystemExit as end:
            status = int(end.code or 0)
        error = capsys.readouterr().err
        assert status == 2, options
        assert message in error
        assert error.count("\n") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["bad.pt"]


@pytest.mark.parametrize("options", [[], ["--symmetric"], ["--plan", "rollouts=2,top=2"]])
def test_a_network_whose_outputs_are_no_numbers_does_not_play(
    options: list[str], content: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = content["agents"]["placement"]["actor_state_dict"]
    for name, tensor in weights.items():
        weights[name] = tensor * 1e38
    path = tmp_path / "large.pt"
    torch.save(content, path)
    with pytest.raises(SystemExit, match="2"):
        evaluate(["--policy", str(path), "--episodes", "2", *options])
    assert "an agent's network returns NaN" in capsys.readouterr().err


def test_a_run_whose_weights_end_up_not_finite_keeps_its_last_checkpoint(tmp_path: Path) -> None:
    runner = make_runner(tiny("--placement.network.planes=[afterstate_value]"), tmp_path)
    placement = runner.alg.learners["placement"].actor.mlp.scores.weight
    for name, weight in (
        ("afterstate_critic", next(runner.alg.afterstates.critic.parameters())),
        ("placement", placement),
    ):
        runner.show = lambda progress, weight=weight: weight.data.fill_(NAN)
        with pytest.raises(TrainingDivergedError, match=f"{name}/weights.* not finite"):
            runner.train(1)
        assert checkpoints.read(tmp_path / "latest.pt")["iter"] == -1
        weight.data.fill_(0.1)
        runner.current_learning_iteration = 0


def changed_value(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    """Return a change that puts a value at a path."""
    *parents, last = path.split("/")

    def change(content: dict[str, Any]) -> None:
        for key in parents:
            content = content[key]
        content[last] = value

    return change


@pytest.mark.parametrize(("change", "message"), [
    (lambda c: c["agents"].update({"../../EVIL": c["agents"]["placement"]}),
     r"agents: '\.\./\.\./EVIL' is none of selection, orientation, placement, joint"),
    (changed_value("agents/placement", {"name": "\x1b[2Jnobody"}),
     r"agents\.placement\.name: a text with control characters, '\\x1b\[2Jnobody'"),
    (changed_value("agents/placement", {"name": "nobody"}), r"'nobody' is none of dblf"),
    (changed_value("agents/placement", {}), r"agents\.placement\.network is missing"),
    (changed_value("agents/placement/actor_state_dict/mlp.scores.bias", [1.0]),
     r"mlp\.scores\.bias: needs a tensor, not \[1\.0\]"),
    (changed_value("config/game/sides", [2]), r"config\.game\.sides: has 1 entries, needs 2"),
    (changed_value("config/game/rule", torch.zeros(3)), r"config\.game\.rule: is a tensor"),
    (changed_value("config/game/rule", "x" * 5000), r"a text of more than 4096 characters"),
    (changed_value("items", 10**30), r"items: 1000000000000000000000000000000 is too large"),
    (changed_value("seconds", NAN), r"seconds: is nan, needs a finite number"),
    (changed_value("infos", torch.zeros(1).expand(10**10)), r"infos: the tensors take more memory"),
    (changed_value("infos", torch.eye(3).to_sparse()), r"infos: needs an ordinary dense tensor"),
    (changed_value("infos", {0.5: 1}), r"infos: has a key that is neither a text nor a whole"),
    (changed_value("infos", {1, 2}), r"infos: a set, needs a tensor or a plain value"),
    (lambda c: c.update(infos=nested(100, 1)), r"nested too deeply"),
    (lambda c: c.update(infos=nested(20, 10)), r"too many values"),
])  # fmt: skip
def test_a_checkpoint_of_another_form_is_refused_with_the_value_named(
    change: Callable[[dict[str, Any]], None], message: str, content: dict[str, Any], tmp_path: Path
) -> None:
    change(content)
    path = tmp_path / "other.pt"
    torch.save(content, path)
    with pytest.raises(ValueError, match=message) as error:
        checkpoints.read(path)
    assert str(error.value).startswith(f"{path}: ")
    assert str(error.value).isprintable()


def nested(depth: int, width: int) -> list[Any]:
    """Return lists in lists; each holds the next one several times, in the memory of one."""
    value: list[Any] = []
    for _ in range(depth):
        value = [value] * width
    return value


def test_a_file_that_unpacks_to_more_than_its_size_is_refused_before_it_is_read(
    tmp_path: Path,
) -> None:
    path = tmp_path / "small.pt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for k in range(3):
            archive.writestr(f"archive/data/{k}", bytes(1 << 22))
    assert path.stat().st_size < 1 << 15
    with pytest.raises(ValueError, match="its members are larger than the file"):
        checkpoints.read(path)


def test_no_message_is_that_of_torch(
    run: Path, content: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its own have many lines, or advise to trust the file."""
    path = tmp_path / "foreign.pt"
    torch.save({"format": Path("x")}, path)
    with pytest.raises(ValueError, match=r"holds more than tensors and plain values$"):
        checkpoints.read(path)
    content["agents"]["placement"]["network"]["channels"] = 16
    torch.save(content, path)
    with pytest.raises(SystemExit):
        evaluate(["--policy", str(path)])
    error = capsys.readouterr().err
    assert "weights do not match its network: actor_state_dict.cnns.convolutions.0.weight" in error
    assert error.count("\n") == 1


# --- the state of games ---------------------------------------------------------------------------

Change = Callable[[dict[str, Tensor]], Any]


def add(name: str, number: int, *index: int) -> Change:
    """Return a change that adds a number to an entry of a tensor."""

    def change(tensors: dict[str, Tensor]) -> None:
        tensors[name][index] += number

    return change


def put(name: str, value: Any) -> Change:
    """Return a change that replaces a tensor."""
    return lambda tensors: tensors.update({name: value})


DAMAGED: list[tuple[Change, str]] = [
    *((add("bins.count", number, 0), r"bins\.\w+ of game 0") for number in (-(10**7), -126, -1, 1)),
    (add("bins.count", 10**7, 2), "bins.count of game 2: needs from 0 to"),
    (add("bins.heightmap", 1, 1, 0, 0), "bins.heightmap of game 1"),
    (add("bins.heightmap", 30000, 1, 0, 0), "bins.heightmap of game 1"),
    (add("bins.empty_map", -1, 1, 9, 9), "bins.empty_map of game 1"),
    (add("bins.filled", 1, 3), "bins.filled of game 3"),
    *((add("bins.boxes", number, 0, 0, k), "bins.boxes of game 0")
      for k in range(6) for number in (-100, 1000)),
    (add("bins.labels", 9, 0, 0, 1), "bins.labels of game 0"),
    (put("bins.count", torch.zeros(4, dtype=torch.int32)), "bins.count is torch.int32"),
    (put("bins.count", [0, 0, 0, 0]), r"bins.count is \[0, 0, 0, 0\], needs a tensor"),
    (put("t", torch.zeros(5, dtype=torch.int64)), r"t is \[5\], needs \[4\]"),
    (lambda tensors: tensors.pop("lost"), "lost is missing"),
    (add("items.sides", 30000, 1, 2), "items.sides of game 1: needs from 1 to 10"),
    (add("items.sides", -9, 1, 2), "items.sides of game 1: needs from 1 to 10"),
    (put("items.weights", torch.full((4,), NAN, dtype=torch.float64)), "items.weights of game 0"),
    (add("t", -100, 0), "t of game 0: needs 0 or more"),
]  # fmt: skip
"""States that no game comes into."""

FOREIGN: list[tuple[Change, str]] = [
    (add("t", 1, 0), "of game 0: needs the result of the choices in the state"),
    (add("episode", 4, 0), "stream of game 0: needs the items of its episode"),
    (add("episode", 2**62 + 1, 0), "episode of game 0"),
    (add("stream", 1, 3), "stream of game 3"),
    (put("lost", torch.tensor([False, True, False, False])), "lost of game 1: needs false"),
    (add("items.sides", -1, 0, 0), "of game 0"),
    (add("bins.labels", 1, 0, 0, 0), "bins.labels of game 0"),
    (put("seed", torch.tensor(5)), "needs the seed of this game"),
    (put("items_fingerprint", torch.tensor(5)), "needs the items of this game; was their file"),
]
"""States that these games do not come into."""


def damaged(game: Packing, change: Change) -> dict[str, Tensor]:
    tensors = copy.deepcopy(game.state_dict())
    change(tensors)
    return tensors


@pytest.mark.parametrize(("change", "message"), [*DAMAGED, *FOREIGN])
def test_a_state_that_these_games_do_not_come_into_is_refused_and_changes_nothing(
    change: Change, message: str
) -> None:
    game = in_play(4, 6)
    before = game.state_dict()
    with pytest.raises(ValueError, match=f"^state of another game: .*{message}"):
        game.load_state_dict(damaged(game, change))
    assert all(torch.equal(value, before[name]) for name, value in game.state_dict().items())
    game.load_state_dict(before)


@pytest.mark.parametrize(("change", "message"), DAMAGED)
def test_a_state_that_no_game_comes_into_is_not_set(change: Change, message: str) -> None:
    game = in_play(4, 6)
    tensors = {n: v for n, v in damaged(game, change).items() if n in game.state.tensors()}
    with pytest.raises(ValueError, match=f"^state of another game: .*{message}"):
        game.state.load(tensors)


@pytest.mark.parametrize("other", [{"rule": "hull_1"}, {"margin": 1.0}, {"alpha": 2.0}])
def test_a_state_of_a_game_with_other_options_or_another_seed_is_refused(
    other: dict[str, Any],
) -> None:
    state = in_play(4, 6).state_dict()
    with pytest.raises(ValueError, match="needs the options of this game"):
        Packing(4, seed=4, **other).load_state_dict(state)
    with pytest.raises(ValueError, match="needs the seed of this game"):
        Packing(4, seed=5).load_state_dict(state)


@pytest.mark.parametrize("options", [
    {"items": "cut2"}, {"mask_orientations": False}, {"auto_reset": False}, {"max_items": 4},
    {"auto_reset": False, "mask_orientations": False}, {"com_offset": (0.1, -0.2, 0.0)},
    {"items": {"items": [[3, 4, 2]] * 9, "upright": [True] * 9, "weights": [0.7] * 9}},
    {"orientations": (0, 1), "rule": "equilibrium"},
])  # fmt: skip
def test_every_state_that_games_come_into_is_restored(options: dict[str, Any]) -> None:
    for steps in (0, 7, 30):
        game = in_play(6, steps, **options)
        again = Packing(6, seed=4, **options)
        again.load_state_dict(game.state_dict())
        assert torch.equal(again.mask, game.mask)
        assert torch.equal(again.alive, game.alive)
        again.set_state(game.state)


# --- what a run resumes from ----------------------------------------------------------------------


@pytest.mark.parametrize(("path", "value", "message"), [
    ("state/0/game/bins.count", torch.full((16,), -(10**7)), "bins.count of game 0"),
    ("state/0/random/cpu", torch.zeros(5056, dtype=torch.uint8), "no state of the random"),
    ("state/0/random/cpu", torch.zeros(9, dtype=torch.uint8), "cpu: is uint8 [9], needs uint8"),
    ("state/0/logger/cur_reward_sum", torch.zeros(3), "state.logger.cur_reward_sum: is float32"),
    ("state/0/logger/tot_time", -1e300, "state.logger.tot_time: needs seconds from 0 to"),
    ("state/0/afterstates/rollouts", 7, "afterstates.inputs: needs"),
    ("afterstate_optimizer/state", {}, "afterstate_optimizer.state.0 is missing"),
    ("agents/placement/optimizer_state_dict/state/0/exp_avg", torch.zeros(2), "0.exp_avg: is"),
    ("agents/placement/optimizer_state_dict/param_groups/0/betas", (2.0, 3.0), "betas: is"),
    ("agents/placement/network/residual", False, "placement.network: differs from"),
    ("iter", 5, "schedule_iteration = 1: needs 6 after 6 iterations"),
    ("evaluations", [{"seed": 1}], "evaluations.0.utilization: needs a number"),
    ("config/ppo/num_envs", 1000, "items = 64: needs 4000 after 1 iterations"),
    ("config/ppo/num_envs", 10**9, "ppo.num_envs = 1000000000: needs a number from 1 to"),
])  # fmt: skip
def test_a_run_resumes_only_from_what_it_could_have_written(
    path: str, value: Any, message: str, content: dict[str, Any], tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    damage: Any = content
    *parents, last = (int(key) if key.isdigit() else key for key in path.split("/"))
    for key in parents:
        damage = damage[key]
    damage[last] = value
    torch.save(content, tmp_path / "latest.pt")
    assert train(["--resume", str(tmp_path / "latest.pt")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_generator_that_points_beyond_its_words_is_refused(content: dict[str, Any]) -> None:
    state = content["state"][0]["random"]["cpu"]
    state[16:24] = torch.tensor([112, 2, 0, 0, 0, 0, 0, 0], dtype=torch.uint8)  # the 624th of 624
    config = tiny("--orientation.network.planes=[mask]",
                  "--placement.network.planes=[mask,afterstate_value]")  # fmt: skip
    with pytest.raises(ValueError, match=r"random\.cpu: no state of the random generator"):
        make_runner(config, None, as_read(content))


def as_read(content: dict[str, Any]) -> dict[str, Any]:
    """Return the content of a file as the reader returns it."""
    file = io.BytesIO()
    torch.save(content, file)
    return torch.load(io.BytesIO(file.getvalue()), weights_only=True)
