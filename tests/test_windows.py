"""Resting height and waste of every window, by both codes, against a box set down there."""

import pytest
import torch

from marl_pack import bins as state
from marl_pack.agents.heuristics import make_policy
from marl_pack.game.packing import Packing
from marl_pack.stability import windows


def played(n: int = 12, size: tuple[int, int, int] = (7, 6, 9)) -> Packing:
    game = Packing(n, size, sides=(1, 4), seed=3)
    policy = make_policy("random", 1)
    for _ in range(6):
        game.place(*policy(game))
    return game


def test_rest_and_waste_are_what_setting_the_box_down_gives() -> None:
    game = played()
    sides = game.orient_item(game.items, game.weights).sides
    rest, waste = windows.rest_and_waste(game.bins, sides)
    tried = game.mask.nonzero()[::7]
    for b, o, x, y in tried.tolist():
        one = game.bins[torch.tensor([b])].clone()
        cell = torch.tensor([x * 6 + y])
        z, wasted, _ = state.place(one, sides[b, o][None], cell, game.weights[b][None])
        assert (rest[b, o, x, y], waste[b, o, x, y]) == (z.item(), wasted.item())


def test_windows_that_leave_the_bin_rest_at_its_top() -> None:
    game = Packing(1, (4, 4, 5), [[2, 3, 1]])
    rest, waste = windows.rest_and_waste(game.bins, torch.tensor([[[2, 3, 1], [9, 1, 1]]]).short())
    assert (rest[0, 0, :3, :2] == 0).all()
    assert (rest[0, 0, 3] == 5).all()
    assert (rest[0, 0, :, 2:] == 5).all()
    assert (rest[0, 1] == 5).all()
    assert (waste == 0).all()


def test_compiled_and_tensor_code_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    game = played()
    sides = game.orient_item(game.items, game.weights).sides
    sides[0, 2] = 0
    compiled = windows.rest_and_waste(game.bins, sides)
    monkeypatch.setattr(windows, "compiled", lambda device: False)
    tensor = windows.rest_and_waste(game.bins, sides)
    assert torch.equal(compiled[0], tensor[0])
    assert torch.equal(compiled[1], tensor[1])
    assert windows.rest_and_waste(game.bins, sides, waste=False)[1].numel() == 0
