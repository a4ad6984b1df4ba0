"""The commands as a user calls them: quick help, and mistakes refused with what was meant."""

import json
import re
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

import marl_pack
from marl_pack import cli, published

HEAVY = ("torch", "numba", "scipy", "rsl_rl", "tensordict", "matplotlib")
"""Packages that take long to import, which only playing and training need."""

LIGHT = """
import contextlib, importlib, io, json, sys
calls, heavy = map(json.loads, sys.argv[1:])
loaded = {}
for module, arguments in calls:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        with contextlib.suppress(SystemExit):
            importlib.import_module(module).main(arguments)
    loaded[" ".join([module, *arguments])] = [name for name in heavy if name in sys.modules]
print(json.dumps(loaded))
"""

MISTAKES = [
    ("", "needs one of train, evaluate"),
    ("evalute", "'evalute': needs one of train, .*; did you mean 'evaluate'"),
    ("evaluate --polcy dblf", "unknown option '--polcy'; did you mean '--policy'"),
    ("evaluate --policy dblff", "'dblff': needs one of .*; did you mean 'dblf'"),
    ("evaluate --policy most_room", "'most_room' is now called 'max_feasible'"),
    ("evaluate --policy ./nowhere", "nowhere: no such checkpoint"),
    ("evaluate --orientation frist --placement dblf", "did you mean 'first'"),
    ("evaluate --rule hull_apha", "'hull_apha': needs one of .*; did you mean 'hull_alpha'"),
    ("evaluate --items cut3", "cut3: no such file; .*; did you mean 'cut"),
    ("evaluate --save-stacks plans.txt", "plans.txt: needs one of the endings .npz, .json, .csv"),
    ("evaluate rs", "'rs': does not belong to an option"),
    ("evaluate --policy rs --plan rollout=8", "'rollout=8': needs rollouts=K, top=M or depth=D"),
    ("export types_125", "'types_125': needs one of .*; did you mean 'types125'"),
    ("export rs --formt onnx", "did you mean '--format'"),
    ("play --pictures bin.png", "did you mean '--picture'"),
    ("play --save plan", "--save plan: needs one of the endings"),
    (
        "judge tabel1",
        "'tabel1': needs one of table1, controls, stack, trial; did you mean 'table1'",
    ),
    ("judge table1 --rules hull", "'hull': needs one of .*; did you mean 'hull_1'"),
    ("judge stack --episods 3", "unknown option '--episods'; did you mean '--episodes'"),
    ("train --ppo.lamm=1", "'ppo.lamm'; did you mean 'ppo.lam'"),
    ("train --config={ppo:\\s{lamm:\\s1}}", "'ppo.lamm'; did you mean 'ppo.lam'"),
    ("train --confg quick", "'confg'; did you mean 'config'"),
    ("train --config quik", "'quik': needs one of .*; did you mean 'quick'"),
    ("train --game.rule=hull_apha", "did you mean 'hull_alpha'"),
    ("train --placement.network.planes=[wast]", "did you mean 'waste'"),
]
"""Command lines, and the end of their one line of error."""


def words_of(line: str) -> list[str]:
    return [word.replace("\\s", " ") for word in line.split()]


def test_help_and_mistakes_import_nothing_that_is_slow() -> None:
    lines = [f"{name} --help".split() for name in cli.COMMANDS]
    calls = [("marl_pack.cli", words) for words in [["--help"], *lines]]
    calls += [(module, ["--help"]) for module, _ in cli.COMMANDS.values()]
    calls += [("marl_pack.cli", words_of(line)) for line, _ in MISTAKES]
    result = subprocess.run(
        [sys.executable, "-c", LIGHT, json.dumps(calls), json.dumps(HEAVY)],
        capture_output=True, text=True,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    loaded = json.loads(result.stdout)
    assert not any(loaded.values()), loaded


@pytest.mark.parametrize(("line", "why"), MISTAKES)
def test_a_mistake_is_one_line_that_says_what_was_meant(
    line: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status: object = cli.main(words_of(line))
    except SystemExit as stop:
        status = stop.code
    assert status == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert re.search(why, error)
    name = line.partition(" ")[0]
    assert error.startswith(f"marl-pack {name}" if name in cli.COMMANDS else "marl-pack: ")


def helped(main: object, *arguments: object, capsys: pytest.CaptureFixture[str]) -> str:
    """What a program prints about itself."""
    with pytest.raises(SystemExit) as stop:
        main(*arguments)  # type: ignore[operator]  # a function of a module
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_the_help_lists_every_command_and_every_exit_status(
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = helped(cli.main, ["--help"], capsys=capsys)
    for name, (_, summary) in cli.COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(summary)}$", text, re.M)
    assert re.findall(r"^  (\d+) ", text, re.M) == ["0", "1", "2", "130"]
    assert max(map(len, text.splitlines())) <= 88
    version = helped(cli.main, ["--version"], capsys=capsys)
    assert version == f"marl_pack {marl_pack.__version__}\n"
    project = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())
    assert project["project"]["scripts"] == {"marl-pack": "marl_pack.cli:main"}


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_a_command_names_itself_as_it_was_called_and_gives_examples(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    module = import_module(cli.COMMANDS[name][0])
    own = f"python -m marl_pack.{'sapien_check' if name == 'judge' else name}"
    for program, text in (
        (f"marl-pack {name}", helped(cli.main, [name, "--help"], capsys=capsys)),
        (own, helped(module.main, ["--help"], capsys=capsys)),
    ):
        assert text.startswith(f"usage: {program} ")
        examples = text.partition("examples:\n")[2].splitlines()
        assert examples
        assert all(example.startswith(f"  {program} ") for example in examples)
    known = {"train": published.configs(), "evaluate": published.models()}
    assert all(each in text for each in known.get(name, ()))
