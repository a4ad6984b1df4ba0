"""A step in tensor code never waits for the device: its host reads are counted on the CPU."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.networks.kinds import observe
from marl_pack.agents.networks.planes import PLANES
from marl_pack.backend import Backend
from marl_pack.game.packing import Packing
from marl_pack.vec_env import PackingVecEnv

WAITING = {
    "_local_scalar_dense", "equal", "is_nonzero", "masked_select", "nonzero", "nonzero_static",
    "unique_consecutive", "unique_dim", "_unique", "_unique2",
}  # fmt: skip
"""Operations whose result the host reads, or whose shape depends on numbers of the device."""
COPYING = {Tensor.tolist, Tensor.numpy, Tensor.cpu, torch.tensor, torch.as_tensor, torch.from_numpy}
"""Functions that copy between the host and the device; on the CPU no operation shows it."""


class Operations(TorchDispatchMode):
    """Counts the operations that wait for the device."""

    def __init__(self, counts: Counter[str]) -> None:
        super().__init__()
        self.counts = counts

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        indices = args[1] if "index" in name and isinstance(args[1], list) else ()
        if name in WAITING or any(i is not None and i.dtype == torch.bool for i in indices):
            self.counts[name] += 1
        return func(*args, **(kwargs or {}))


class Functions(TorchFunctionMode):
    """Counts the functions that copy between the host and the device."""

    def __init__(self, counts: Counter[str]) -> None:
        super().__init__()
        self.counts = counts

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in COPYING:
            self.counts[func.__name__] += 1
        return func(*args, **(kwargs or {}))


@contextmanager
def waits() -> Iterator[Counter[str]]:
    """Count what would make the program wait, if the tensors were on another device."""
    counts: Counter[str] = Counter()
    with Operations(counts), Functions(counts):
        yield counts


CENTRE = {"bin": (8, 6, 30), "sides": (1, 4), "com_offset": (0.3, 0.2, 0.0)}
LARGE = {"bin": (24, 20, 60), "sides": (3, 12), "orientations": (0, 1)}


def steps(rule: str, settings: dict[str, Any]) -> tuple[Packing, Callable[[], object]]:
    """Return games in tensor code, and a function that plays one step of them."""
    game = Packing(12, rule=rule, backend=Backend.TENSOR, seed=3, **settings)
    policy = make_policy("random", 1)
    for _ in range(12):
        game.place(*policy(game))
    orientation, cell = policy(game)
    return game, lambda: game.place(orientation, cell, check=False)


@pytest.mark.parametrize("settings", [{}, CENTRE, LARGE], ids=["plain", "centre", "large"])
@pytest.mark.parametrize("rule", ["hull_1", "hull_alpha", "area_ratio", "none", "lbcp"])
def test_a_step_in_tensor_code_does_not_wait(rule: str, settings: dict[str, Any]) -> None:
    _, step = steps(rule, settings)
    with waits() as counts:
        step()
    # lbcp reads once how many boxes it has to replay, and how long their sides are.
    assert counts == ({"tolist": 1} if rule == "lbcp" else {})


class Divisions(TorchDispatchMode):
    """Lists the Python numbers that tensors are divided by."""

    def __init__(self) -> None:
        super().__init__()
        self.numbers: set[float] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.overloadpacket.__name__ == "div" and not isinstance(args[1], Tensor):
            self.numbers.add(args[1])
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("rule", ["hull_1", "hull_alpha", "area_ratio", "lbcp", "equilibrium"])
def test_a_step_divides_alike_on_every_device(rule: str) -> None:
    """On CUDA, a Python number's reciprocal is rounded first; that of a power of 2 is exact."""
    with Divisions() as divisions:
        assert torch.tensor([38.0]) / 10 > 3
    assert divisions.numbers == {10}
    _, step = steps(rule, CENTRE)
    with Divisions() as divisions:
        step()
    assert divisions.numbers <= {2}


@pytest.mark.parametrize("rule", ["hull_alpha", "area_ratio"])
def test_a_step_needs_no_number_of_the_device(rule: str) -> None:
    """With fake tensors, which have no numbers, every read of a number raises an error."""
    game, step = steps(rule, {})
    step()
    assert game.alive.all()
    with FakeTensorMode(allow_non_fake_inputs=True):
        step()
        with pytest.raises(DataDependentOutputException):
            bool(game.alive.all())


def test_the_counter_sees_every_kind_of_wait() -> None:
    numbers = torch.arange(5)
    with waits() as counts:
        assert numbers[2] == 2
        assert numbers[numbers > 1].tolist() == [2, 3, 4]
        numbers[numbers > 3] = 0
        assert len(numbers.nonzero()) == 3
        assert float(numbers.sum()) == 6
        torch.tensor([1, 2])
        torch.unique(numbers)
    assert counts == {
        "_local_scalar_dense": 2, "index": 1, "index_put_": 1, "nonzero": 1, "tensor": 1,
        "tolist": 1, "_unique2": 1,
    }  # fmt: skip
    _, step = steps("hull_alpha", {"margin": 0.5})
    with waits() as counts:
        step()
    assert counts["nonzero"] == 1  # with a margin, the undecided windows are listed


def test_observing_and_logging_do_not_wait() -> None:
    """The afterstates are listed, so their number is read once; the logger reads later."""
    game = Packing(8, backend=Backend.TENSOR, seed=3)
    lookahead = Lookahead(AfterstateCritic())
    env = PackingVecEnv(game, lambda game: observe("orientation", game, [*PLANES], lookahead))
    policy = make_policy("random", 1)
    logs = []
    for _ in range(12):
        actions = torch.stack(policy(game), 1)
        with waits() as counts:
            *_, extras = env.step(actions)
        assert counts == {"nonzero": 1}
        logs.append(extras["log"])
    assert any(logs)
    assert all(len(log["Train/items"]) for log in logs if log)
