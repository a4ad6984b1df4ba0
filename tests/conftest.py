import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from marl_pack import bins as state
from marl_pack.agents.heuristics import make_policy
from marl_pack.bins import Bins
from marl_pack.game.packing import Packing
from marl_pack.geometry import oriented
from marl_pack.geometry.tensor import resting_heights, windows_inside
from marl_pack.stability import OrientedItem, Rule, orient_item

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of the published test sequences, named by MARL_PACK_DATA."""
    folder = os.environ.get("MARL_PACK_DATA")
    if not folder or not (Path(folder) / "rs.npz").is_file():
        pytest.skip("MARL_PACK_DATA does not name a folder with rs.npz and cut_1.npz")
    return Path(folder)


def stack(size: tuple[int, int, int], *boxes: tuple[int, int, int, int, int, int]) -> Bins:
    """One bin with the boxes x, y, z, w, d, h; fails if one does not rest at its z."""
    bins = state.empty(1, size, max_boxes=len(boxes) + 1)
    for x, y, z, w, d, h in boxes:
        rest, *_ = state.place(
            bins, torch.tensor([[w, d, h]], dtype=torch.int16), torch.tensor([[x, y]])
        )
        assert int(rest) == z, f"box {(x, y, z, w, d, h)} rests at {int(rest)}"
    return bins


def random_play(
    rule: Rule, n: int, size: tuple[int, int, int], sides: tuple[int, int], steps: int, seed: int
) -> Bins:
    """N bins with up to ``steps`` random boxes at cells that ``rule`` allows."""
    generator = torch.Generator().manual_seed(seed)
    bins = state.empty(n, size, max_boxes=steps)
    for _ in range(steps):
        items = torch.randint(sides[0], sides[1] + 1, (n, 3), generator=generator).short()
        allowed = rule(bins, orient_item(items))[:, 0].flatten(1)
        cell = torch.multinomial(
            allowed.float() + ~allowed.any(1, keepdim=True), 1, generator=generator
        )
        corner = torch.cat((cell // size[1], cell % size[1]), 1)
        state.place(bins, torch.where(allowed.any(1, keepdim=True), items, 0), corner)
    return bins


def random_maps(
    n: int, size: tuple[int, int, int], sides: tuple[int, int], steps: int, seed: int
) -> Bins:
    """N bins with boxes placed anywhere, stable or not."""

    def anywhere(bins: Bins, item) -> torch.Tensor:
        top = resting_heights(bins.heightmap, item.sides) + item.sides[..., 2, None, None]
        inside = windows_inside(item.sides.flatten(0, 1).long(), *bins.size[:2])
        return (top <= bins.height) & inside.unflatten(0, item.sides.shape[:2])

    return random_play(anywhere, n, size, sides, steps, seed)


def mirrored_map(values: Tensor, symmetry: int) -> Tensor:
    """Maps [G, W, D] with x mirrored (1), y mirrored (2), and then x and y swapped (4)."""
    if symmetry & 1:
        values = values.flip(1)
    if symmetry & 2:
        values = values.flip(2)
    return values.transpose(1, 2) if symmetry & 4 else values


def mirrored(bins: Bins, symmetry: int) -> Bins:
    """The bins after a symmetry, their boxes and their maps."""
    maps = (mirrored_map(values, symmetry) for values in (bins.heightmap, bins.empty_map))
    boxes, loads = bins.boxes.clone(), bins.loads.clone()
    for axis in (0, 1):
        if symmetry & 1 << axis:
            boxes[..., axis] = bins.size[axis] - boxes[..., axis] - boxes[..., axis + 3]
            loads[..., axis + 1] = bins.size[axis] - loads[..., axis + 1]
    if symmetry & 4:
        boxes, loads = boxes[..., [1, 0, 2, 4, 3, 5]], loads[..., [0, 2, 1]]
    heightmap, empty_map = maps
    return replace(bins, heightmap=heightmap, empty_map=empty_map, boxes=boxes, loads=loads)


def put_boxes(game: Packing, bins: Bins) -> None:
    """Put the boxes of other bins into a game, with new masks."""
    game.set_state(replace(game.state, bins=bins))


def boxes_of(bins: Bins, i: int) -> np.ndarray:
    return bins.boxes[i, : int(bins.count[i])].numpy()


def some_items(n: int, sides: tuple[int, int], seed: int) -> Tensor:
    """Items int16 [N, 3] with random sides."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(sides[0], sides[1] + 1, (n, 3), generator=generator).short()


def off_centre(items: Tensor, seed: int) -> OrientedItem:
    """OrientedItem whose centres of mass lie in the middle half of each footprint.

    Offsets are decimals of one to three places, and one of 17 digits.
    """
    generator = np.random.default_rng(seed)
    pairs = [
        tuple(round(float(offset), 1 + a % 3) for offset in generator.uniform(-0.25, 0.25, 2))
        for a in range(5)
    ]
    return OrientedItem(oriented(items), (*pairs, (1 / 6, -1 / 12)))


def in_play(n: int, steps: int, **settings: object) -> Packing:
    """A game after some steps of random play."""
    game = Packing(n, seed=4, **settings)  # type: ignore[arg-type]  # a game's options have many types
    policy = make_policy("random", seed=1)
    for _ in range(steps):
        game.place(*policy(game))
    return game
