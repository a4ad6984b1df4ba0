"""The paper's algorithms as they are printed, and where the package departs from them."""

import sys

import numpy as np
import pytest
import torch
from conftest import boxes_of, random_maps, stack

from marl_pack.stability import OrientedItem, hull_1
from marl_pack.stability.paper import convex_hull_1, convex_hull_alpha, update_empty_map


def test_convex_hull_1_on_squares_is_the_rule_hull_1() -> None:
    bins = random_maps(8, (8, 7, 12), (1, 4), 10, seed=3)
    item = OrientedItem(torch.tensor([[[4, 3, 2]]], dtype=torch.int16).expand(8, 1, 3))
    masks = hull_1(bins, item).numpy()
    for b in range(8):
        assert (
            masks[b, 0] == convex_hull_1(bins.heightmap[b].numpy(), (4, 3, 2), 12, "squares")
        ).all()


def test_algorithm_2_makes_the_empty_map_of_the_bins() -> None:
    bins = random_maps(1, (6, 7, 20), (1, 4), 12, seed=4)
    heightmap, empty_map = np.zeros((6, 7), int), np.zeros((6, 7), int)
    for x, y, z, w, d, h in boxes_of(bins, 0).tolist():
        empty_map = update_empty_map(heightmap, empty_map, (x, y), (w, d, h))
        heightmap[x : x + w, y : y + d] = z + h
    assert empty_map.any()
    assert (empty_map == bins.empty_map[0].numpy()).all()


def test_points_let_boxes_tip_and_forbid_boxes_that_stand() -> None:
    # Seen from the front, a box of 4 x 2 over a block of 2 x 2 at x = 2. Its middle is x + 2.
    #   x=0: B B B B . .  its middle is the block's left edge: it tips
    #   x=1: . B B B B .  its middle is that of the block: it stands
    #   x=2: . . B B B B  its middle is the block's right edge: it tips
    #        . . A A . .
    heightmap = stack((6, 2, 6), (2, 0, 0, 2, 2, 2)).heightmap[0].numpy()
    masks = {
        reading: convex_hull_1(heightmap, (4, 2, 1), 6, reading)[:3, 0].tolist()
        for reading in ("points", "squares")
    }
    assert masks == {"points": [True, True, False], "squares": [False, True, False]}
    # A box of the block's own size, 1 x 1, has one point, which is not its centre.
    pillar = stack((1, 1, 6), (0, 0, 0, 1, 1, 2)).heightmap[0].numpy()
    assert not convex_hull_1(pillar, (1, 1, 1), 6, "points")[0, 0]
    assert convex_hull_1(pillar, (1, 1, 1), 6, "squares")[0, 0]


def test_without_opencv_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    maps = np.ones((2, 2), int), np.zeros((2, 2), int)
    with pytest.raises(ModuleNotFoundError, match=r"\[reference\]"):
        convex_hull_alpha(*maps, (1, 1, 1), 4)
