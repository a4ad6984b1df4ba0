"""The commands as a user calls them: quick help, and mistakes refused with what was meant."""

import json
import subprocess
import sys

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

COMMANDS = ("train", "evaluate", "play", "physics.command")


def test_help_and_mistakes_import_nothing_that_is_slow() -> None:
    calls = [(f"marl_pack.{name}", [word]) for name in COMMANDS for word in ("--help", "--hepl")]
    calls += [
        ("marl_pack.train", ["--ppo.lamm=1"]),
        ("marl_pack.train", ["--config={ppo: {lamm: 1}}"]),
        ("marl_pack.train", ["--game.rule=hull"]),
        ("marl_pack.train", ["--placement.network.planes=[masks]"]),
    ]
    result = subprocess.run(
        [sys.executable, "-c", LIGHT, json.dumps(calls), json.dumps(HEAVY)],
        capture_output=True, text=True,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    loaded = json.loads(result.stdout)
    assert len(loaded) == len(calls)
    assert not any(loaded.values()), loaded
