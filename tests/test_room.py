"""What placements leave: against the meaning of the words, and tensor code against compiled."""

from itertools import permutations, product

import numpy as np
import pytest
import torch
from conftest import in_play

from marl_pack.agents.afterstates import bitboards
from marl_pack.agents.afterstates.afterstates import (
    WORTH_A_THREAD,
    Afterstates,
    _left_torch,
    afterstates_of,
    probe_lengths,
)
from marl_pack.agents.heuristics import make_policy
from marl_pack.bins import ORIENTATIONS
from marl_pack.game.packing import Packing
from marl_pack.stability import reference

GAMES = (
    {},
    {"size": (6, 5, 7), "sides": (1, 3)},
    {"orientations": (0, 3)},
    {"size": (16, 12, 20), "sides": (3, 12)},
    {"size": (10, 10, 4), "items": "cut1"},
    {"com_offset": (0.3, 0.2, 0.0)},
    {"size": (3, 40, 9), "sides": (1, 3)},
    {"size": (64, 2, 9), "sides": (1, 2)},
    {"size": (14, 6, 6), "items": [[2, 2, 2], [13, 2, 2], [3, 4, 5]] * 4},
)


def legal_cells(heights: np.ndarray, hollow: np.ndarray, box: tuple[int, ...], top: int) -> int:
    """Cells where ``box`` stands by hull_alpha, one window at a time."""
    w, d, _ = box

    def stands(x: int, y: int) -> bool:
        window = np.s_[x : x + w, y : y + d]
        return reference.hull(heights[window], hollow[window] == 0, (w / 2, d / 2))

    return int(reference.window_mask(stands, heights, box, top).sum())


@pytest.mark.parametrize("orientations", [(0, 1, 2, 3, 4, 5), (0, 1), (3,)])
def test_it_is_what_may_be_set_down_afterwards(orientations: tuple[int, ...]) -> None:
    game = in_play(3, 4, size=(5, 4, 6), sides=(1, 3), orientations=orientations)
    room, fits = game.room()
    chances = []
    for b, o in product(range(3), orientations):
        for x, y in game.mask[b, o].nonzero().tolist()[:2]:
            after = game.branch(torch.tensor([b]))
            after.place(torch.tensor([o]), torch.tensor([x * 4 + y]))
            maps = after.bins.heightmap[0].numpy(), after.bins.empty_map[0].numpy()
            boxes = list(product((1, 2, 3), repeat=3))
            cells = {box: legal_cells(*maps, box, 6) for box in boxes}
            assert room[b, o, x, y].item() == pytest.approx(np.mean(list(cells.values())))
            ways = [ORIENTATIONS[a] for a in orientations]
            found = [any(cells[tuple(box[k] for k in way)] for way in ways) for box in boxes]
            assert fits[b, o, x, y].item() == pytest.approx(np.mean(found))
            chances.append(np.mean(found))
    assert min(chances) < 1  # some placements leave no place for some items
    assert not room[~game.mask].any()
    assert not fits[~game.mask].any()


def maps(left: Afterstates, game: Packing) -> list[torch.Tensor]:
    """Everything that is known of each placement, on the bins' maps."""
    known = [left.counts.flatten(1), left.surface, left.volume[:, None], left.waste[:, None],
             left.filled[:, None], left.room()[:, None],
             left.chance(game.orientations)[:, None]]  # fmt: skip
    return [torch.where(game.mask[..., None], values[left.index], 0) for values in known]


def settings_of_left(game: Packing) -> tuple[object, ...]:
    sides = game.orient_item(game.items, game.weights).sides
    return game.bins, sides, game.mask, probe_lengths(*game.stream.sides)


@pytest.mark.parametrize("settings", GAMES)
def test_tensor_code_gives_the_same_numbers(settings: dict[str, object]) -> None:
    game = in_play(6, 9, **settings)
    known = settings_of_left(game)
    for ours, theirs in zip(
        maps(afterstates_of(*known), game), maps(_left_torch(*known), game), strict=True
    ):
        assert torch.allclose(ours.double(), theirs.double(), rtol=0, atol=1e-6)
        if not ours.is_floating_point():
            assert torch.equal(ours, theirs)


@pytest.mark.parametrize("settings", GAMES[:3] + GAMES[4:])
def test_sets_of_bits_say_what_maps_say(
    settings: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    game = in_play(64, 12, **settings)
    assert bitboards.hold(*game.size[:2])
    known = settings_of_left(game)
    bits = afterstates_of(*known)
    monkeypatch.setattr(bitboards, "hold", lambda width, depth: False)
    assert torch.equal(afterstates_of(*known).counts, bits.counts)


def test_what_is_said_of_a_placement_is_what_it_does() -> None:
    game = in_play(8, 5)
    left = game.left()
    policy = make_policy("random", seed=2)
    o, c = policy(game)
    row = left.index[torch.arange(8), o, c // 10, c % 10]
    after = game.branch(torch.arange(8))
    after.place(o, c)
    assert torch.equal(left.filled[row], after.bins.filled)
    assert torch.equal(left.volume[row], after.bins.filled - game.bins.filled)
    hollow = [b.empty_map.sum((1, 2), dtype=torch.int64) for b in (game.bins, after.bins)]
    assert torch.equal(left.waste[row], hollow[1] - hollow[0])
    heights = after.bins.heightmap
    for level in range(11):
        share = (heights == level).float().mean((1, 2))
        assert torch.allclose(left.surface[row, level], share)
    steps = torch.cat([heights.diff(dim=axis).abs().flatten(1) for axis in (1, 2)], 1)
    for step in range(6):
        share = (steps.clamp(max=5) == step).float().mean(1)
        assert torch.allclose(left.surface[row, 11 + step], share)


def test_lengths_longer_than_the_floor_have_no_place() -> None:
    game = in_play(4, 3, size=(3, 12, 9), sides=(1, 3))
    sides = game.orient_item(game.items, game.weights).sides
    for lengths in ((4, 5), (2, 13), (20,)):
        known = game.bins, sides, game.mask, lengths
        ours, theirs = afterstates_of(*known), _left_torch(*known)
        for counts in (ours, theirs):
            assert not counts.counts[:, -1].any()
        assert torch.equal(maps(ours, game)[0], maps(theirs, game)[0])


def test_of_no_bins_there_is_nothing_left() -> None:
    game = in_play(4, 3).branch(torch.zeros(0, dtype=torch.int64))
    assert game.room()[0].shape == (0, 6, 10, 10)


def test_a_branch_knows_what_is_left_already() -> None:
    game = in_play(6, 4)
    left = game.left()
    which = torch.tensor([4, 1, 1])
    branch = game.branch(which)
    assert branch.left().counts is left.counts
    fresh = afterstates_of(*settings_of_left(branch))
    for known, made in zip(maps(branch.left(), branch), maps(fresh, branch), strict=True):
        assert torch.equal(known, made)


def test_no_placement_no_room() -> None:
    game = Packing(2, (4, 4, 4), [[3, 3, 3]] * 3, auto_reset=False)
    while game.alive.any():
        game.place(*make_policy("dblf")(game))
    assert game.left().room().shape == game.left().chance([0]).shape == (0,)
    room, fits = game.room()
    assert room.shape == fits.shape == (2, 6, 4, 4)
    assert not room.any()


def test_it_is_of_the_moment_and_a_branch_has_its_own() -> None:
    game = in_play(4, 3)
    first = game.room()[0]
    assert game.room()[0] is first
    copy = game.branch(torch.tensor([2, 0]))
    assert torch.equal(copy.room()[0], first[[2, 0]])
    game.place(*make_policy("dblf")(game))
    assert not torch.equal(game.room()[0], first)
    assert torch.equal(copy.room()[0], first[[2, 0]])
    kept = game.state_dict()
    second = game.room()[0]
    game.place(*make_policy("dblf")(game))
    game.load_state_dict(kept)
    assert torch.equal(game.room()[0], second)


def test_lengths_are_spread_evenly_and_few() -> None:
    assert probe_lengths(2, 5) == (2, 3, 4, 5)
    assert probe_lengths(1, 5) == (1, 2, 3, 4, 5)
    assert probe_lengths(6, 60) == (6, 20, 33, 46, 60)
    assert probe_lengths(3, 3) == (3,)


def test_the_heuristic_leaves_more_than_others_do() -> None:
    assert sorted(ORIENTATIONS) == list(permutations(range(3)))
    game = in_play(32, 6)
    rows = torch.arange(32)
    left = []
    for name in ("most_room", "dblf", "random"):
        o, c = make_policy(name)(game)
        left.append(game.room()[0].flatten(2)[rows, o, c])
    assert (left[0] >= left[1]).all()
    assert (left[0] >= left[2]).all()
    assert left[0].mean() > left[1].mean() > left[2].mean()
    best = game.room()[0].flatten(1).amax(1)
    assert torch.equal(left[0], best)


def test_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    game = in_play(12, 5)
    assert int(game.mask.sum()) > 3 * WORTH_A_THREAD  # so several share the work
    given = []
    for threads in (1, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda t=threads: t)
        given.append(maps(afterstates_of(*settings_of_left(game)), game))
    for alone, shared in zip(*given, strict=True):
        assert torch.equal(alone, shared)
