"""Afterstates equal the bins after each placement, and counts by bits equal those by masks."""

import pickle
from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pytest
import torch
from conftest import in_play
from test_backends import GAMES

from marl_pack.agents.afterstates.afterstates import Afterstates, afterstates_of, probe_lengths
from marl_pack.agents.afterstates.bitboards import count_by_bits, fit_in_words
from marl_pack.agents.afterstates.compiled import (
    PER_THREAD,
    compute_compiled,
    count_by_masks,
    probability_compiled,
)
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.afterstates.sampled import sampled_afterstates, samples
from marl_pack.agents.afterstates.tensor import probability_tensor
from marl_pack.agents.heuristics import make_policy
from marl_pack.backend import Backend
from marl_pack.game.packing import Packing
from marl_pack.geometry import ORIENTATIONS
from marl_pack.stability import reference


def legal_cells(heights: np.ndarray, empty_map: np.ndarray, box: tuple[int, ...], top: int) -> int:
    """Cells where ``box`` stands by hull_alpha, one window at a time."""
    w, d, _ = box

    def stands(x: int, y: int) -> bool:
        window = np.s_[x : x + w, y : y + d]
        return reference.hull(heights[window], empty_map[window] == 0, (w / 2, d / 2))

    return int(reference.window_mask(stands, heights, box, top).sum())


@pytest.mark.parametrize("orientations", [(0, 1, 2, 3, 4, 5), (0, 1), (3,)])
def test_feasible_cells_and_probability_equal_the_reference(
    orientations: tuple[int, ...],
) -> None:
    game = in_play(3, 4, bin=(5, 4, 6), sides=(1, 3), orientations=orientations)
    lookahead = Lookahead()
    mean_cells, probability = (
        lookahead.feasible_cells(game),
        lookahead.feasible_probability(game),
    )
    chances = []
    for b, o in product(range(3), orientations):
        for x, y in game.mask[b, o].nonzero().tolist()[:2]:
            after = game.branch(torch.tensor([b]))
            after.place(torch.tensor([o]), torch.tensor([x * 4 + y]))
            maps = after.bins.heightmap[0].numpy(), after.bins.empty_map[0].numpy()
            boxes = list(product((1, 2, 3), repeat=3))
            cells = {box: legal_cells(*maps, box, 6) for box in boxes}
            assert mean_cells[b, o, x, y].item() == pytest.approx(np.mean(list(cells.values())))
            axes = [ORIENTATIONS[a] for a in orientations]
            feasible = [any(cells[tuple(box[k] for k in row)] for row in axes) for box in boxes]
            assert probability[b, o, x, y].item() == pytest.approx(np.mean(feasible))
            chances.append(np.mean(feasible))
    assert min(chances) < 1  # some placements leave no place for some items
    assert not mean_cells[~game.mask].any()
    assert not probability[~game.mask].any()


@pytest.mark.parametrize("lengths", [1, 4, 5])
@pytest.mark.parametrize("orientations", [(0, 1, 2, 3, 4, 5), (0, 1), (4,)])
def test_the_probability_counts_every_box(lengths: int, orientations: tuple[int, ...]) -> None:
    """The boxes are sets of bits: 4 lengths fill one word, 5 lengths need two."""
    generator = torch.Generator().manual_seed(lengths)
    counts = torch.randint(0, 3, (200, *[lengths] * 3), generator=generator, dtype=torch.int32)
    counts *= torch.rand(200, 1, 1, 1, generator=generator) > torch.rand(
        counts.shape, generator=generator
    )
    axes = [ORIENTATIONS[o] for o in orientations]
    expected = [
        np.mean([
            any(row[tuple(box[k] for k in way)] for way in axes)
            for box in product(range(lengths), repeat=3)
        ])
        for row in counts.numpy()
    ]  # fmt: skip
    for compute in (probability_compiled, probability_tensor):
        np.testing.assert_allclose(compute(counts, axes), expected, rtol=1e-6)


def maps(afterstates: Afterstates, game: Packing) -> list[torch.Tensor]:
    """Every value of each placement, on the bins' maps."""
    rows = [
        afterstates.volume, afterstates.waste, afterstates.filled, afterstates.feasible_cells(),
        afterstates.feasible_probability({game.spec.orientations: 1.0}),
    ]  # fmt: skip
    tables = [afterstates.counts.flatten(1), afterstates.surface, *(row[:, None] for row in rows)]
    return [torch.where(game.mask[..., None], table[afterstates.index], 0) for table in tables]


def arguments_of(game: Packing) -> tuple[object, ...]:
    sides = game.orient_item(game.items).sides
    return game.bins, sides, game.mask, probe_lengths(*game.stream.sides)


@pytest.mark.parametrize("settings", GAMES[:3] + GAMES[4:])
def test_sets_of_bits_count_what_masks_count(settings: dict[str, object]) -> None:
    game = in_play(64, 12, **settings)
    assert fit_in_words(*game.size[:2])
    bits, masks = (
        compute_compiled(*arguments_of(game), count_cells=code)[1]
        for code in (count_by_bits, count_by_masks)
    )
    assert torch.equal(bits, masks)


def test_the_probability_is_weighted_by_the_shares_of_the_orientation_sets() -> None:
    afterstates = Lookahead().afterstates(in_play(8, 6))
    upright, all_six = (
        afterstates.feasible_probability({o: 1.0}) for o in ((0, 1), tuple(range(6)))
    )
    mixed = afterstates.feasible_probability({(0, 1): 0.25, tuple(range(6)): 0.75})
    assert torch.allclose(mixed, 0.25 * upright + 0.75 * all_six)
    assert (upright < all_six).any()


def test_afterstates_equal_the_bins_after_the_placement() -> None:
    game = in_play(8, 5)
    afterstates = Lookahead().afterstates(game)
    policy = make_policy("random", seed=2)
    o, c = policy(game)
    row = afterstates.index[torch.arange(8), o, c // 10, c % 10]
    after = game.branch(torch.arange(8))
    after.place(o, c)
    assert torch.equal(afterstates.filled[row], after.bins.filled)
    assert torch.equal(afterstates.volume[row], after.bins.filled - game.bins.filled)
    empty_map = [b.empty_map.sum((1, 2), dtype=torch.int64) for b in (game.bins, after.bins)]
    assert torch.equal(afterstates.waste[row], empty_map[1] - empty_map[0])
    heights = after.bins.heightmap
    for level in range(11):
        share = (heights == level).float().mean((1, 2))
        assert torch.allclose(afterstates.surface[row, level], share)
    steps = torch.cat([heights.diff(dim=axis).abs().flatten(1) for axis in (1, 2)], 1)
    for step in range(6):
        share = (steps.clamp(max=5) == step).float().mean(1)
        assert torch.allclose(afterstates.surface[row, 11 + step], share)


def test_lengths_longer_than_the_floor_have_no_feasible_cell() -> None:
    game = in_play(4, 3, bin=(3, 12, 9), sides=(1, 3))
    sides = game.orient_item(game.items).sides
    for lengths in ((4, 5), (2, 13), (20,)):
        arguments = game.bins, sides, game.mask, lengths
        ours = afterstates_of(*arguments)
        theirs = afterstates_of(replace(game.bins, backend=Backend.TENSOR), *arguments[1:])
        for counts in (ours, theirs):
            assert not counts.counts[:, -1].any()
        assert torch.equal(maps(ours, game)[0], maps(theirs, game)[0])


def test_no_games_have_no_afterstates() -> None:
    game = in_play(4, 3).branch(torch.zeros(0, dtype=torch.int64))
    assert Lookahead().feasible_cells(game).shape == (0, 6, 10, 10)


def test_a_branch_reuses_the_afterstates_of_its_game() -> None:
    game, lookahead = in_play(6, 4), Lookahead()
    afterstates = lookahead.afterstates(game)
    which = torch.tensor([4, 1, 1])
    branch = lookahead.branch(game, which)
    assert lookahead.afterstates(branch).counts is afterstates.counts
    fresh = afterstates_of(*arguments_of(branch))
    own = lookahead.afterstates(branch)
    for stored, computed in zip(maps(own, branch), maps(fresh, branch), strict=True):
        assert torch.equal(stored, computed)


def test_without_a_legal_placement_there_is_no_afterstate() -> None:
    game = Packing(2, (4, 4, 4), [[3, 3, 3]] * 3, auto_reset=False)
    while game.alive.any():
        game.place(*make_policy("dblf")(game))
    assert Lookahead().afterstates(game).feasible_cells().shape == (0,)
    assert Lookahead().afterstates(game).feasible_probability({(0,): 1.0}).shape == (0,)
    mean_cells, probability = (
        Lookahead().feasible_cells(game),
        Lookahead().feasible_probability(game),
    )
    assert mean_cells.shape == probability.shape == (2, 6, 4, 4)
    assert not mean_cells.any()


def test_a_lookahead_belongs_to_one_turn_of_one_game() -> None:
    game, lookahead = in_play(4, 3), Lookahead()
    first = lookahead.feasible_cells(game)
    assert lookahead.feasible_cells(game) is first
    plain = game.branch(torch.tensor([2, 0]))
    assert torch.equal(lookahead.feasible_cells(plain), first[[2, 0]])
    copy = lookahead.branch(game, torch.tensor([2, 0]))
    assert torch.equal(lookahead.feasible_cells(copy), first[[2, 0]])
    assert torch.equal(lookahead.feasible_cells(game), first)
    game.place(*make_policy("dblf")(game))
    assert not torch.equal(lookahead.feasible_cells(game), first)
    assert torch.equal(lookahead.feasible_cells(copy), first[[2, 0]])
    again = pickle.loads(pickle.dumps(game))
    assert torch.equal(lookahead.feasible_cells(again), lookahead.feasible_cells(game))
    assert again.turn is not game.turn, "a copy in another process has turns of its own"
    state = game.state_dict()
    second = lookahead.feasible_cells(game)
    game.place(*make_policy("dblf")(game))
    game.load_state_dict(state)
    assert torch.equal(lookahead.feasible_cells(game), second)


def test_probe_lengths_are_few_and_evenly_spaced() -> None:
    assert probe_lengths(2, 5) == (2, 3, 4, 5)
    assert probe_lengths(1, 5) == (1, 2, 3, 4, 5)
    assert probe_lengths(6, 60) == (6, 20, 33, 46, 60)
    assert probe_lengths(3, 3) == (3,)


def test_max_feasible_leaves_more_feasible_cells_than_others() -> None:
    assert sorted(ORIENTATIONS) == list(permutations(range(3)))
    game = in_play(32, 6)
    rows = torch.arange(32)
    cells = []
    for name in ("max_feasible", "dblf", "random"):
        o, c = make_policy(name)(game)
        cells.append(Lookahead().feasible_cells(game).flatten(2)[rows, o, c])
    assert (cells[0] >= cells[1]).all()
    assert (cells[0] >= cells[2]).all()
    assert cells[0].mean() > cells[1].mean() > cells[2].mean()
    best = Lookahead().feasible_cells(game).flatten(1).amax(1)
    assert torch.equal(cells[0], best)


def test_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    game = in_play(12, 5)
    assert int(game.mask.sum()) > 3 * PER_THREAD  # so several share the work
    results = []
    for threads in (1, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda t=threads: t)
        results.append(maps(afterstates_of(*arguments_of(game)), game))
    for alone, shared in zip(*results, strict=True):
        assert torch.equal(alone, shared)


@pytest.mark.parametrize("backend", Backend)
def test_a_large_floor_is_seen_at_every_second_column(backend: Backend) -> None:
    game = in_play(2, 6, bin=(18, 15, 9), sides=(1, 5))
    assert [list(cells) for cells in samples(18, 15)] == [[*range(1, 18, 2)], [*range(1, 15, 2)]]
    boxes = list(product((1, 1, 2, 2, 3), (1, 1, 2, 2, 3), (1, 2, 3, 4, 5)))
    bins, *others = arguments_of(game)
    afterstates = sampled_afterstates(replace(bins, backend=backend), *others)  # type: ignore[type-var]  # untyped list
    for g, o, x, y in game.mask.nonzero()[::80].tolist():
        after = game.branch(torch.tensor([g]))
        after.place(torch.tensor([o]), torch.tensor([x * 15 + y]))
        maps = [m[0, 1::2, 1::2].numpy() for m in (after.bins.heightmap, after.bins.empty_map)]
        row = afterstates.index[g, o, x, y]
        cells = [legal_cells(*maps, box, 9) for box in boxes]
        assert afterstates.counts[row].flatten().tolist() == cells
        assert afterstates.filled[row] == after.bins.filled
        wasted = after.bins.empty_map.sum() - game.bins.empty_map[g].sum()
        assert afterstates.waste[row] <= wasted
        assert afterstates.volume[row] == after.bins.filled - game.bins.filled[g]


def test_a_large_floor_has_few_afterstates_and_a_small_one_those_of_all_columns() -> None:
    large = Packing(1, (120, 100, 100), sides=(20, 50))
    assert len(Lookahead().afterstates(large).counts) < 3000 < int(large.mask.sum())
    small = in_play(2, 3, bin=(15, 15, 8), sides=(2, 4))
    exact = afterstates_of(*arguments_of(small))  # type: ignore[arg-type]  # untyped tuple
    assert torch.equal(Lookahead().afterstates(small).counts, exact.counts)
