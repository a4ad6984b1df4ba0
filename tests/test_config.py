"""The settings: every key explained, every file loads and runs, mistakes named."""

import re
from itertools import islice
from pathlib import Path

import pytest
import yaml
from fuzz.configs import LAUGHS, as_yaml, cases

from marl_pack.config import Agent, Config, ConfigError, from_dict, keys, make_parser, parse
from marl_pack.config.defaults import default_yaml
from marl_pack.train import main

CONFIGS = Path(__file__).parent.parent / "configs"
FILES = sorted(CONFIGS.rglob("*.yaml"))


def test_there_are_configs_for_every_ablation() -> None:
    names = {path.stem for path in FILES if path.parent.name == "ablations"}
    assert names == {
        "both", "joint", "orientation_random", "orientation_first", "placement_random",
        "placement_dblf", "hull_1", "no_afterstate_value", "no_orientation_mask",
        "no_waste_penalty",
    }  # fmt: skip


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_config_runs_two_iterations(path: Path, tmp_path: Path) -> None:
    small = ("--ppo.num_envs=8", "--ppo.num_steps_per_env=4", "--ppo.num_mini_batches=2",
             "--ppo.max_iterations=2", "--evaluation.episodes=4", "--output.name=run")  # fmt: skip
    assert main([f"--config={path}", *small, f"--output.folder={tmp_path}"]) == 0
    assert (tmp_path / "run" / "latest.pt").is_file()
    assert (tmp_path / "run" / "best.pt").is_file()


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_key_of_a_config_has_a_comment_above_it(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    for above, line in zip(["", *lines], lines, strict=False):
        if re.match(r"\s*[\w.]+:", line):
            assert above.strip().startswith("#"), f"{path.name}: no comment above {line.strip()!r}"


def test_the_main_config_holds_every_key_at_its_default() -> None:
    """``make configs`` writes it again from the code."""
    written = (CONFIGS / "default.yaml").read_text(encoding="utf-8")
    assert written == default_yaml()
    assert yaml.safe_load(written) == Config().to_dict()


def test_the_ablations_see_the_same_number_of_items() -> None:
    runs = [parse([f"--config={path}"])[0].ppo for path in FILES if path.parent.name == "ablations"]
    assert {ppo.num_envs * ppo.num_steps_per_env * ppo.max_iterations for ppo in runs} == {81_920}


def test_every_key_is_explained_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse(["--help"])
    output = re.sub(r"\s+", " ", capsys.readouterr().out)
    for key in keys(make_parser()):
        explained = re.search(rf"--{re.escape(key)} (.*?) \(type: ", output)
        assert explained is not None, key
        assert len(explained[1].split()) >= 4, key


def test_settings_go_to_plain_values_and_back() -> None:
    config, _ = parse(["--game.bin=[6,7,8]", "--placement.network.planes=[resting_height]",
                       "--seed=5",
                       "--orientation.frozen=true", "--orientation.policy=first"])  # fmt: skip
    again = from_dict(yaml.safe_load(yaml.safe_dump(config.to_dict())))
    assert again == config
    assert again.game.bin == (6, 7, 8)
    assert again.orientation == Agent(frozen=True, policy="first")


@pytest.mark.parametrize(("options", "expected"), [
    (["--ppo.gama=0.9"], r"key 'ppo\.gama'; did you mean 'ppo\.gamma'\? Keys in ppo: after"),
    (["--sed=1"], r"unknown key 'sed'; did you mean 'seed'\? Keys: device, evaluation"),
    (["--ppo.gamma=much"], r"^ppo\.gamma = much: needs a number$"),
    (["--game.rule=hull"], r"game: unknown stability rule 'hull': needs one of hull_1, hull_alpha"),
    (["--game.rule=null"], r"game\.rule = null: needs the name of a rule"),
    (["--game.mask_orientations=null"], r"^game\.mask_orientations = null: needs true or false$"),
    (["--game.margin=-1"], r"game: margin = -1\.0: needs a number of cells ≥ 0"),
    (["--game.max_items=0"], r"game: max_items = 0: needs a whole number ≥ 1"),
    (["--game.max_item=3"], r"key 'game\.max_item'; did you mean 'game\.max_items'\?"),
    (["--orientation.imitate=dblf"], r"imitate: it is now called orientation\.teacher$"),
    (["--placement.network.planes=[room]"], r"plane 'room' is now called 'feasible_cells'"),
    (["--game.bin=[10,10]"], r"^game\.bin = \[10, 10\]: needs a list of 3 whole numbers, such as "),
    (["--game.bin", "7,5,9"], r"^game\.bin = 7,5,9: needs a list of 3 whole numbers"),
    (["--seed", "7", "5", "9"], r"^5 9: no key takes this; a list is one word, such as"),
    (["--game.bin=[10,10,0]"], r"game: bin size \(10, 10, 0\)"),
    (["--ppo.gamma=1.5"], r"ppo\.gamma = 1\.5: needs a number from 0 to 1$"),
    (["--ppo.learning_rate=1e38"], r"ppo\.learning_rate = 1e\+38: needs a positive number, 1e\+30"),
    (["--game.alpha=1e300"], r"game: alpha = 1e\+300: needs a number from -1e9 to 1e9"),
    (["--game.beta=-1e10"], r"game: beta = -10000000000\.0: needs a number from -1e9 to 1e9"),
    (["--ppo.learning_rate=.nan"], r"ppo\.learning_rate = nan: needs a positive"),
    (["--placement.entropy_coef=-1"], r"placement\.entropy_coef = -1\.0: needs a number from 0 to"),
    (["--ppo.num_envs=0"], r"ppo\.num_envs = 0: needs a number from 1 to"),
    (["--ppo.num_envs=1", "--ppo.num_steps_per_env=2"], r"an iteration has only 2"),
    (["--threads=0"], r"threads = 0: needs a number from 1 to 1,024$"),
    (["--threads=1000000"], r"threads = 1000000: needs a number from 1 to 1,024$"),
    (["--evaluation.every=-1"], r"evaluation\.every"),
    (["--evaluation.episodes=1"], r"evaluation\.episodes"),
    (["--output.latest_every=0"], r"output\.latest_every"),
    (["--output.name=a/b"], r"output\.name"),
    (["--placement.frozen=true"], r"placement\.policy = null: a frozen agent needs one"),
    (["--placement.policy=dblf"], r"needs placement\.frozen"),
    (["--placement.frozen=true", "--placement.policy=dblf", "--orientation.frozen=true",
      "--orientation.policy=random"], r"all agents are frozen"),
    (["--joint=true", "--placement.frozen=true", "--placement.policy=dblf"], r"cannot be frozen"),
    (["--placement.teacher=dblf"], r"placement\.teacher_iterations = 0: needs a number from 1"),
    (["--placement.teacher_iterations=-1"], r"teacher_iterations = -1: needs placement"),
    (["--placement.teacher_iterations=5"], r"= 5: needs placement\.teacher"),
    (["--ppo.afterstate_ramp=[5,2]"], r"afterstate_ramp = \[5, 2\]: needs two iterations"),
    (["--placement.teacher_random=1.5"], r"teacher_random = 1.5: needs a number from 0 to 1"),
    (["--orientation.teacher=first", "--orientation.teacher_iterations=5",
      "--orientation.frozen=true", "--orientation.policy=dblf"], r"a frozen agent does not learn"),
    (["--placement.teacher=dblf", "--placement.teacher_iterations=5", "--joint=true"],
     r"clones no teacher"),
    (["--placement.teacher=dblf", "--placement.teacher_iterations=5",
      "--ppo.normalize_advantage_per_mini_batch=true"], r"per_mini_batch: false"),
    (["--placement.network.layers=0"], r"layers = 0"),
    (["--ppo.symmetry=true"], r"^ppo\.symmetry was removed: the samples .*; leave it out$"),
    (["--placement.network.dilation=1"], r"^placement\.network\.dilation was removed: every conv"),
    (["--joint=true", "--game.mask_orientations=false"], r"mask_orientations.*always masked"),
    (["--ppo=null"], r"ppo"),
    (["--seed=-1"], r"^seed = -1: needs a number from 0 to 9,223,372,036,854,775,807$"),
    ([f"--evaluation.seed={2**63}"], r"^evaluation\.seed = 9223372036854775808: needs a number"),
    (["--output.name=.."], r"output\.name"),
])  # fmt: skip
def test_a_mistake_is_named_with_what_would_be_right(options: list[str], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        parse(options)


@pytest.mark.parametrize("number", ["1_0", "0x10", "0b1", "010", "1:30", "1_0.5", "1:30.5"])
def test_numbers_are_decimal_in_files_and_on_the_command_line(number: str, tmp_path: Path) -> None:
    path = tmp_path / "numbers.yaml"
    for key, value in (
        ("seed", number), ("game.margin", number), ("game.bin", f"[5, {number}, 5]"),
        ("placement.learning_rate", number),
    ):  # fmt: skip
        path.write_text(as_yaml(key, value))
        for option in (f"--config={path}", f"--{key}={value}"):
            with pytest.raises(ConfigError, match=rf"{key} = '{number}': needs .*decimal notation"):
                parse([option])
    assert parse([f"--output.name={number}"])[0].output.name == number


def test_a_typo_in_a_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "typo.yaml"
    path.write_text("placement:\n  network:\n    chanels: 3\n")
    assert main([f"--config={path}"]) == 2
    message = capsys.readouterr().err
    assert (
        "unknown key 'placement.network.chanels'; did you mean 'placement.network.channels'?"
        in message
    )
    path.write_text("pppo:\n  gamma: 3\n")
    assert main([f"--config={path}"]) == 2
    assert "unknown key 'pppo.gamma'; did you mean 'ppo.gamma'?" in capsys.readouterr().err


@pytest.mark.parametrize(("text", "expected"), [
    (b"", "needs keys and values"),
    (b"- 1", "needs keys and values"),
    (b"seed: [1", "not YAML"),
    (b"name: \xff", "not a text in UTF-8"),
    (b"ppo:\n  gamma: 0.9\n  lam: 0.9\n  gamma: 0.8\n", "line 4: ppo.gamma is given twice"),
    (b"ppo:\n", "line 1: ppo is a section"),
    (b"placement:\n  network: 3\n", "line 2: placement.network is a section"),
    (b"resume: runs/x\n", "line 1: --resume needs to be on the command line"),
])  # fmt: skip
def test_a_broken_file_is_named_with_the_line(
    text: bytes, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "broken.yaml"
    path.write_bytes(text)
    for options in ([f"--config={path}"], ["--config", str(path)]):
        assert main(options) == 2
        message = capsys.readouterr().err
        assert str(path) in message
        assert expected in message


@pytest.mark.parametrize(("options", "expected"), [
    (["--device=abacus"], "device 'abacus'"),
    (["--game.items=rs", "--game.bin=[4,4,4]"], "game.items: items 'rs' with sides 2..5"),
    (["--game.items=nowhere.npz"], "nowhere.npz"),
    (["--game.orientations=[7]"], "orientations"),
    (["--game.rule=lbcp", "--game.thresholds=paper"], "thresholds"),
    (["--orientation.frozen=true", "--orientation.policy=nobody"],
     "orientation.policy: 'nobody': needs one of"),
    (["--placement.teacher=nobody", "--placement.teacher_iterations=5"],
     "placement.teacher: 'nobody': needs one of dblf"),
    (["--placement.teacher=first", "--placement.teacher_iterations=5"],
     "placement.teacher: 'first': needs one of dblf"),
])  # fmt: skip
def test_errors_of_the_game_and_of_agents_are_reported_as_plainly(
    options: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*options, f"--output.folder={tmp_path}"]) == 2
    assert expected in capsys.readouterr().err


def test_no_bad_settings_end_in_anything_but_one_line_or_in_what_they_say(tmp_path: Path) -> None:
    path = tmp_path / "case.yaml"
    for name, case in islice(cases(seed=1), 40):
        options = case if isinstance(case, list) else [f"--config={path}"]
        path.write_text(case if isinstance(case, str) else "", encoding="utf-8")
        error = None
        try:
            config, _ = parse(options)
        except ConfigError as refused:
            error = str(refused)
        if error is None:
            assert from_dict(config.to_dict()) == config, name
        else:
            assert len(error.splitlines()) == 1, name


def test_null_is_refused_for_every_key_that_needs_a_value_and_leaves_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "null.yaml"
    null = {key for key, value in Config().flat().items() if value is None}
    null.add("ppo.final_entropy_coef")
    assert "game.margin" in null
    for key in keys(make_parser()):
        path.write_text(as_yaml(key, "null"))
        if key in null:
            assert parse([f"--config={path}"])[0].flat() == Config().flat() | {key: None}
        else:
            with pytest.raises(ConfigError, match=rf"^{re.escape(key)} = null: needs "):
                parse([f"--config={path}"])
            with pytest.raises(ConfigError, match=rf"^{re.escape(key)} = null: needs "):
                parse([f"--{key}=null"])
    path.write_text("ppo:\n  schedule: null\n")
    assert main([f"--config={path}", f"--output.folder={tmp_path / 'runs'}"]) == 2
    assert "ppo.schedule = null: needs one of fixed, linear" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(("text", "expected"), [
    (LAUGHS, "settings need 10,000 values at most"),
    ("game: &a {bin: *a}", "an anchor contains itself"),
    ("seed: " + "[" * 100, "settings need 20 levels at most"),
    ("seed: 1 # " + "x" * 100_000, "settings need 100,000 bytes at most"),
    ("seed: '1'", "line 1: seed: needs a whole number, without quotes"),
    ("config: x.yaml", "line 1: --config needs to be on the command line"),
    ("? [a]\n: 1", "line 1: needs the name of a key"),
    ("null: 1", "line 1: needs the name of a key"),
    ("seed:", "seed = null: needs a whole number"),
    ("game:\n  bin: !!set {9, 8, 7}", "line 2: needs the name of a key"),
    ("seed: !x 1", "line 1: seed: needs a whole number, without a tag"),
    ("device: ''", "device = '': needs a text"),
    ("seed: " + "9" * 5000, "a value needs 4,096 characters at most"),
])  # fmt: skip
def test_settings_beyond_all_need_are_refused_in_files_and_on_the_command_line(
    text: str, expected: str, tmp_path: Path
) -> None:
    path = tmp_path / "large.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=re.escape(expected)):
        parse([f"--config={path}"])
    with pytest.raises(ConfigError):
        parse([f"--config={text}\n"])
    with pytest.raises(ConfigError):
        parse([f"--seed={text.partition(' ')[2]}x"])


def test_a_run_that_needs_more_memory_than_there_is_says_so_and_leaves_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--ppo.num_envs=1000000", "--game.bin=[200,200,200]", f"--output.folder={tmp_path}"]
    assert main(options) == 2
    assert "too little memory for these settings" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
