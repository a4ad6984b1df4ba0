"""Resting height and waste of every window against a box placed there."""

import torch

from marl_pack import bins as state
from marl_pack.agents.heuristics import make_policy
from marl_pack.game.packing import Packing
from marl_pack.geometry import resting_heights_and_waste


def played(n: int = 12, size: tuple[int, int, int] = (7, 6, 9)) -> Packing:
    game = Packing(n, size, sides=(1, 4), seed=3)
    policy = make_policy("random", 1)
    for _ in range(6):
        game.place(*policy(game))
    return game


def test_resting_height_and_waste_are_those_of_the_box_placed_there() -> None:
    game = played()
    sides = game.orient_item(game.items).sides
    z_map, waste = resting_heights_and_waste(game.bins.heightmap, sides, game.bins.height)
    tried = game.mask.nonzero()[::7]
    for b, o, x, y in tried.tolist():
        one = game.bins[torch.tensor([b])].clone()
        corner = torch.tensor([[x, y]])
        z, wasted, _ = state.place(one, sides[b, o][None], corner, game.items.weights[b][None])
        assert (z_map[b, o, x, y], waste[b, o, x, y]) == (z.item(), wasted.item())


def test_windows_that_leave_the_bin_rest_at_its_top() -> None:
    sides = torch.tensor([[[2, 3, 1], [9, 1, 1]]]).short()
    z, waste = resting_heights_and_waste(torch.zeros(1, 4, 4, dtype=torch.int16), sides, 5)
    assert (z[0, 0, :3, :2] == 0).all()
    assert (z[0, 0, 3] == 5).all()
    assert (z[0, 0, :, 2:] == 5).all()
    assert (z[0, 1] == 5).all()
    assert (waste == 0).all()
