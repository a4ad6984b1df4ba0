"""What other people's trainers get from us: the network, and the account of what they did."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
import torch

from marl_pack import env_aec
from marl_pack.env_aec import AGENTS
from marl_pack.integrations.network import ActorCritic
from marl_pack.integrations.session import Session, run

EXAMPLES = Path(__file__).parent.parent / "examples"
SMALL = ["--bin", "5", "5", "5", "--sides", "1", "3", "--items", "40", "--episodes", "2"]


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
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
            seen, _, terminated, _, _ = env.last()
            if terminated:
                break
            planes, mask = (torch.as_tensor(seen[k])[None] for k in ("observation", "action_mask"))
            logits, value = networks[agent](planes, mask)
            assert logits.shape == mask.shape
            assert value.shape == (1,)
            assert (torch.softmax(logits, 1)[mask == 0] == 0).all()
            env.step(int(logits.argmax()))


def test_an_example_in_cleanrls_style_fits(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("CleanRL's style", "marl_pack", example("cleanrl_ppo").train, SMALL) == 0
    assert capsys.readouterr().out.strip().endswith("fits")


def test_a_trainer_that_does_not_fit_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    def train(session: Session) -> None:
        session.watch(ActorCritic("orientation"), ActorCritic("placement"))
        env = session.env()
        env.reset(seed=0)
        mask = env.observe(AGENTS[0])["action_mask"]
        env.step(int(mask.argmax()))
        cells = env.observe(AGENTS[1])["action_mask"]
        env.step(int(cells.argmin()))  # not legal, nothing learned, nothing credited

    assert run("nobody", "marl_pack", train, SMALL) == 1
    told = capsys.readouterr()
    assert "illegal: 1" in told.out
    assert "'orientation_0': False" in told.out
    assert "DOES NOT FIT" in told.err
