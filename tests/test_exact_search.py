"""Search in millimetres, and agents of cells on a grid."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from marl_pack.exact import choice
from marl_pack.exact.bins import ExactBins
from marl_pack.exact.choice import LINEAR
from marl_pack.exact.futures import Catalogue, History, Shown
from marl_pack.exact.goods import Goods, check_goods
from marl_pack.exact.options import Options
from marl_pack.exact.packing import ExactPacking
from marl_pack.exact.policies import HEURISTICS, TUNED, read_weights
from marl_pack.exact.search import CERTAINTY, FEWEST, Search, _Trial
from marl_pack.exact.search_settings import ExactSearchSettings
from marl_pack.exact.spec import ExactSpec
from marl_pack.packer.cells import CellAgent, rasterize
from marl_pack.packer.packer import Packer
from marl_pack.packer.turn import Turn

SPEC = ExactSpec(bin_mm=(80, 60, 70), unit_mm=1, rule="lbcp", max_boxes=40, max_weight_kg=60)
WEIGHTS = read_weights(TUNED)
COUNTED = ExactSearchSettings(budget_ms=1e6, top=4, futures=FEWEST)


def goods(seed: int, count: int) -> Goods:
    rng = np.random.default_rng(seed)
    attributes = {
        "weights": rng.uniform(0.5, 4, count), "upright": rng.random(count) < 0.3,
        "stackable": rng.random(count) > 0.1, "max_load": rng.uniform(2, 30, count),
    }  # fmt: skip
    return check_goods(rng.integers(8, 40, (count, 3)), SPEC, attributes)


@pytest.mark.parametrize("rule", ["lbcp", "hull_alpha", "none"])
def test_a_future_is_played_like_a_game(rule: str) -> None:
    """The compiled future places the same boxes as bins that are fed box after box."""
    spec = SPEC.with_options({"rule": rule})
    kinds = goods(1, 30)
    rng = np.random.default_rng(2)
    every = np.ones(1, np.bool_)
    for _ in range(12):
        bins = ExactBins(1, spec)
        for row in rng.integers(0, 30, 4).tolist():
            move = bins.best(kinds[[row]], LINEAR, WEIGHTS)
            bins.place(kinds[[row]], move)
        item, rows = kinds[[int(rng.integers(30))]], rng.integers(0, 30, 30)
        moves = bins.moves(item).of(0)
        if not len(moves):
            continue
        move = moves[[rng.integers(len(moves))]]
        trial = _Trial(WEIGHTS, Options(bins, item), np.zeros(1, np.int64), move)
        volume = trial.value(0, kinds, rows)
        bins.place(item, move)
        before = bins.utilization[0]
        for row in rows.tolist():
            best = bins.best(kinds[[row]], LINEAR, WEIGHTS, every)
            if best[0] < 0:
                break
            bins.place(kinds[[row]], best)
        assert volume == pytest.approx((bins.utilization[0] - before) * bins.volume, abs=1e-6)


def test_the_search_takes_the_move_that_is_best_in_its_futures() -> None:
    """With one round there is no halving: compare with all futures played one by one."""
    settings = ExactSearchSettings(budget_ms=1e6, top=2, futures=FEWEST)
    better = 0
    for seed in range(20):
        kinds = goods(20 + seed, 20)
        game = ExactPacking(1, kinds, spec=SPEC, auto_reset=False)
        for _ in range(3):
            if game.alive.any():
                game.place(game.bins.best(game.items, LINEAR, WEIGHTS))
        if not game.alive.any():
            continue
        search = Search(WEIGHTS, settings, Catalogue(kinds), seed)
        moves = search.ranked(game.bins, game.items)
        if len(moves) < 2:
            continue
        chosen = int(search(game)[0])
        generator = np.random.default_rng((seed, 0, 4))
        options = Options(game.bins, game.items)
        trial = _Trial(WEIGHTS, options, np.zeros(len(moves), np.int64), moves)
        values = []
        for _ in range(FEWEST):
            future = Catalogue(kinds).draw(generator, game.items, kinds, 36)
            values.append([trial.value(m, *future) for m in range(2)])
        gains = np.diff(values, axis=1).ravel()
        sure = gains.mean() > CERTAINTY * gains.std(ddof=1) / np.sqrt(FEWEST)
        assert chosen == moves[int(sure)]
        better += chosen != moves[0]
    assert better > 0


def test_the_search_does_not_foresee() -> None:
    """Two sequences that begin alike are packed alike as far as they are alike."""
    kinds = goods(4, 24)
    ends = kinds[np.arange(8)], kinds[np.concatenate((np.arange(4), np.arange(20, 24)))]
    packings = []
    for end in ends:
        game = ExactPacking(1, end, spec=SPEC, auto_reset=False)
        search = Search(WEIGHTS, COUNTED, Shown())
        for _ in range(4):
            game.place(search(game))
        packings.append(game.bins.boxes(0))
    assert (packings[0] == packings[1]).all()


def test_the_search_stops_by_the_clock() -> None:
    kinds = goods(5, 20)
    ticks = iter(range(0, 10**12, 10_000_000))  # each look at the clock takes 10 ms
    search = Search(
        WEIGHTS, ExactSearchSettings(budget_ms=300), Catalogue(kinds), clock=lambda: next(ticks)
    )
    game = ExactPacking(1, kinds, spec=SPEC, auto_reset=False)
    search(game)
    assert next(ticks) <= 340_000_000
    assert search.played > 0


def test_a_search_without_time_plays_the_linear_score() -> None:
    kinds = goods(6, 20)
    game = ExactPacking(1, kinds, spec=SPEC, auto_reset=False)
    search = Search(WEIGHTS, ExactSearchSettings(budget_ms=0.001), Catalogue(kinds))
    while game.alive.any():
        moves = search(game)
        assert moves == game.bins.best(game.items, LINEAR, WEIGHTS)
        game.place(moves)


def test_futures_follow_the_history() -> None:
    spec = ExactSpec(bin_mm=(100, 100, 100), unit_mm=1)
    kinds = check_goods([[10, 10, 10]] * 5 + [[20, 20, 20]] * 5 + [[30, 30, 30]] * 5, spec)
    generator = np.random.default_rng(0)
    history = History(kinds, jump=0.0)
    followers = [
        tuple(history.draw(generator, kinds[[0]], kinds, 1)[0].sides[
            history.draw(generator, kinds[[0]], kinds, 1)[1][0]].tolist())
        for _ in range(300)
    ]  # fmt: skip
    assert set(followers) == {(10, 10, 10), (20, 20, 20)}  # after a box of 10 mm: 4 of 5 the same
    assert followers.count((10, 10, 10)) / 300 == pytest.approx(0.8, abs=0.1)
    _, rows = History(kinds, jump=1.0).draw(generator, kinds[[0]], kinds, 6000)
    assert np.bincount(rows, minlength=15).min() > 300  # any box, all equally often
    _, rows = Shown().draw(generator, kinds[[3]], kinds[:4], 50)
    assert set(rows.tolist()) <= {0, 1, 2, 3}
    other = check_goods([[44, 44, 44]], spec)  # a box that the history does not have
    _, rows = history.draw(generator, other, kinds, 100)
    assert len(rows) == 100


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("budget", "needs budget=500ms"), ("budget=5", "needs budget=500ms"),
        ("top=x", "needs budget=500ms"), ("budget=1ms,budget=2ms", "given twice"),
        ("budget=0ms", "needs more than 0 ms"), ("top=0", "top: needs a whole number from 1"),
        ("futures=0", "futures: needs a whole number"), ("depth=3", "needs budget=500ms"),
    ],
)  # fmt: skip
def test_impossible_settings_are_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ExactSearchSettings.parse(text)


def test_settings_are_read() -> None:
    assert ExactSearchSettings.parse("budget=0.5s,top=3") == ExactSearchSettings(500.0, 3)
    assert ExactSearchSettings.parse("futures=7").futures == 7
    settings = ExactSearchSettings(80.0, 5, 9)
    assert ExactSearchSettings.parse(str(settings)) == settings


def test_the_bound_of_a_linear_score_holds() -> None:
    """No move scores more than its bound, so no best move is ever left out."""
    rng = np.random.default_rng(7)
    kinds = goods(8, 30)
    for clearance in (0, 2):
        bins = ExactBins(1, SPEC.with_options({"clearance_mm": clearance, "rule": "none"}))
        for _ in range(14):
            item = kinds[[int(rng.integers(30))]]
            best = bins.best(item, LINEAR, HEURISTICS["max_contact"]().weights)
            if best[0] >= 0:
                bins.place(item, best)
        for _ in range(20):
            weights = rng.normal(size=len(WEIGHTS))
            item = kinds[[int(rng.integers(30))]]
            out, faces = np.empty(1 << 14, np.int64), np.empty(1 << 14, np.uint8)
            rows = choice.by_top(bins.state.boxes[0], int(bins.state.count[0]))
            count = choice.candidates(
                bins.limits, bins.size, rows, len(rows), item.sides[0], item.orientations[0], out,
                faces,
            )  # fmt: skip
            scores = bins.features(0, item.sides[0], out[:count]) @ weights
            bounds = [
                choice.most(weights, bins.limits, bins.size, item.sides[0], out[m], faces[m])
                for m in range(count)
            ]
            assert (scores <= np.array(bounds) + 1e-9).all()


# --- cells ----------------------------------------------------------------------------------------


def test_a_bin_is_shown_on_a_grid() -> None:
    boxes = np.zeros((3, 10), np.int32)
    boxes[:, :6] = [(0, 0, 0, 30, 20, 25), (30, 0, 0, 15, 20, 10), (0, 0, 25, 30, 20, 20)]
    heights, empty = np.zeros((6, 4), np.int16), np.zeros((6, 4), np.int16)
    filled = rasterize(boxes, 3, 10.0, heights, empty)
    assert heights[:3, :2].tolist() == [[5, 5]] * 3  # 45 mm: rounded up
    assert heights[3:5, :2].tolist() == [[1, 1]] * 2  # the second box reaches into two columns
    assert heights[5:].max() == heights[:, 2:].max() == 0
    assert empty[:3].max() == 0
    assert filled == 30
    floating = boxes[1:2].copy()
    floating[0, 2] = 20
    rasterize(floating, 1, 10.0, heights, empty)
    assert heights[3, 0] == 3
    assert empty[3, 0] == 2


@pytest.mark.parametrize("grid", [None, 75, 130, 400])
@pytest.mark.parametrize("source", ["rs", "plain"])
def test_agents_of_cells_choose_legal_moves_on_any_grid(source: str, grid: Any) -> None:
    rng = np.random.default_rng(9)
    packer = Packer((1000, 700, 900), source, grid_mm=grid, bins=2, margin_mm=10)
    answers = [packer.place(rng.integers(30, 690, 3).tolist()) for _ in range(25)]
    assert sum(map(bool, answers)) >= 8  # the packer checks that they are legal


def test_on_whole_cells_agents_see_the_game_they_were_trained_on() -> None:
    """Sizes in whole cells: the map is that of the game on cells, and so are legal cells."""
    from marl_pack.game.packing import Packing

    rng = np.random.default_rng(10)
    items = rng.integers(2, 6, (30, 3))
    game = Packing(1, (10, 10, 10), items=[items], auto_reset=False)
    spec = ExactSpec(bin_mm=(1000, 1000, 1000), rule="hull_alpha", margin_on_floor=True)
    bins, agent = ExactBins(1, spec), CellAgent("rs", spec)
    assert agent.grid_mm == 100
    while bool(game.alive):
        item = check_goods([(items[int(game.t)] * 100).tolist()], spec)
        turn = Turn(bins, item)
        move = agent(turn)
        shown = agent.game
        assert (shown.bins.heightmap == game.bins.heightmap).all()
        assert (shown.bins.empty_map == game.bins.empty_map).all()
        assert (shown.items.sides == game.items.sides).all()
        assert not (shown.mask & ~game.mask).any()  # the exact world lists edges alone
        bins.place(item, move)
        o, x, y = int(move[0]) & 7, (int(move[0]) >> 23) & 0xFFFFF, (int(move[0]) >> 3) & 0xFFFFF
        import torch

        game.place(torch.tensor([o]), torch.tensor([x // 1000 * 10 + y // 1000]))
