"""The network and the compliance report that other trainers use."""

import importlib.util
import json
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from pettingzoo.utils.wrappers import BaseWrapper

from marl_pack import env_aec
from marl_pack.env_aec import AGENTS
from marl_pack.integrations.network import ActorCritic

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"
sys.path.insert(0, str(EXAMPLES))  # as if an example ran

from report import main as show_reports  # noqa: E402
from session import Session, current, run  # noqa: E402

SMALL = [
    "--bin",
    "5",
    "5",
    "5",
    "--sides",
    "1",
    "3",
    "--items",
    "40",
    "--turns",
    "80",
    "--episodes",
    "9",
]


def example(name: str, folder: Path = EXAMPLES) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("size", [(4, 6, 5), (2, 2, 3), (9, 7, 8)])
def test_the_network_gives_legal_actions_alone_for_any_bin(size: tuple[int, int, int]) -> None:
    for padded in (False, True):
        env = env_aec.env(bin_size=size, sides=(1, 2), pad_actions=padded)
        env.reset(seed=0)
        networks = {a: ActorCritic("both" if padded else a.partition("_")[0]) for a in AGENTS}
        for agent in env.agent_iter(8):
            observation, _, terminated, _, _ = env.last()
            if terminated:
                break
            planes, mask = (
                torch.as_tensor(observation[k])[None] for k in ("observation", "action_mask")
            )
            logits, value = networks[agent](planes, mask)
            assert logits.shape == mask.shape
            assert value.shape == (1,)
            assert (torch.softmax(logits, 1)[mask == 0] == 0).all()
            env.step(int(logits.argmax()))


@pytest.mark.parametrize("world", ["cells", "mm"])
def test_an_example_in_cleanrls_style_passes(
    capsys: pytest.CaptureFixture[str], world: str
) -> None:
    words = [*SMALL, "--world", world]
    train = example("cleanrl_ppo").train
    assert run("CleanRL's style", "marl_pack", train, words, worlds=("cells", "mm")) == 0
    assert capsys.readouterr().out.strip().endswith("passes")


def test_a_trainer_that_does_not_pass_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    def train(session: Session) -> None:
        session.watch(ActorCritic("orientation"), ActorCritic("placement"))
        env = session.env()
        env.reset(seed=0)
        mask = env.observe(AGENTS[0])["action_mask"]
        env.step(int(mask.argmax()))
        cells = env.observe(AGENTS[1])["action_mask"]
        env.step(int(cells.argmin()))  # not legal, nothing learned, nothing credited

    assert run("nobody", "marl_pack", train, SMALL) == 1
    printed = capsys.readouterr()
    assert "illegal: 1" in printed.out
    assert "'orientation_0': False" in printed.out
    assert "DOES NOT PASS" in printed.err


def test_rewards_stored_wrongly_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    def train(session: Session) -> None:
        assert current() is session
        example("cleanrl_ppo").train(session)
        session.credit(AGENTS[0], 0.1)

    assert run("nobody", "marl_pack", train, SMALL) == 1
    assert "rewards_right: {'orientation_0': False, 'placement_0': True}" in capsys.readouterr().out


def test_items_that_repeat_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    def train(session: Session) -> None:
        new_env = session.env
        session.env = lambda **options: Seeded(new_env(**options))  # type: ignore[method-assign]  # on purpose
        example("cleanrl_ppo").train(session)

    class Seeded(BaseWrapper):
        def reset(self, seed: int | None = None, options: object = None) -> None:
            self.env.reset(seed=7)

        def __getattr__(self, name: str) -> object:
            return getattr(self.env, name)

    assert run("nobody", "marl_pack", train, SMALL) == 1
    assert "repeats: 0" not in capsys.readouterr().out


def test_an_agent_whose_critic_alone_learns_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    def train(session: Session) -> None:
        cleanrl = example("cleanrl_ppo")
        learn = cleanrl.learn

        def only_values(turns: Any, network: ActorCritic, optimizer: Any) -> None:
            head = network.orientations.weight
            head.requires_grad_(network.agent != "orientation")
            learn(turns, network, optimizer)

        cleanrl.learn = only_values
        cleanrl.train(session)

    assert run("nobody", "marl_pack", train, SMALL) == 1
    assert "updated: {'orientation_0': False, 'placement_0': True}" in capsys.readouterr().out


def test_the_parallel_view_is_counted_as_well() -> None:
    session = Session([*SMALL, "--seed", "3"])
    env = session.parallel_env()
    observations, _ = env.reset(seed=0)
    rewards = dict.fromkeys(AGENTS, 0.0)
    while env.agents:
        actions = {a: int(observations[a]["action_mask"].argmax()) for a in AGENTS}
        observations, step, _, _, _ = env.step(actions)
        rewards = {a: rewards[a] + step[a] for a in AGENTS}
    assert session.placed > 1
    assert session.envs[0].totals == pytest.approx(rewards)
    assert session.envs[0].illegal == 0


def test_reports_make_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "cleanrl.json"
    train = example("cleanrl_ppo").train
    assert run("CleanRL's style", "marl_pack", train, [*SMALL, "--json", str(file)]) == 0
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path)])
    assert show_reports() == 0
    row = capsys.readouterr().out.splitlines()[-2]
    report = json.loads(file.read_text())
    before, after = (f"{100 * report[k][0]:.1f} ± {100 * report[k][1]:.1f} %"
                     for k in ("before", "after"))  # fmt: skip
    assert "CleanRL's style" in row
    assert "5 × 5 × 5" in row
    assert f"  {report['items']}  " in row
    assert before in row
    assert after in row

    file.write_text(json.dumps(report | {"illegal": 1}))
    assert show_reports() == 1
    file.unlink()
    with pytest.raises(SystemExit):
        show_reports()
    assert "the folder has no report" in capsys.readouterr().err


def test_one_episode_has_no_interval(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        Session(["--episodes", "1"])
    assert "at least 2" in capsys.readouterr().err


def test_every_example_is_run_and_can_be_installed() -> None:
    sessions = example("noxfile", ROOT).EXAMPLES
    assert set(sessions.values()) == {file.stem for file in EXAMPLES.glob("*ppo.py")}
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    for extra, file in sessions.items():
        head = (EXAMPLES / f"{file}.py").read_text().split('"""')[1]
        if extra == "cleanrl":  # needs nothing
            continue
        assert extra in extras
        assert f'pip install -e ".[{extra}]" && python examples/{file}.py' in head
