"""Games with a buffer, a preview and several bins: their rules, views and policies."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from marl_pack import Packing, Plan, SearchSettings, evaluate, load, play
from marl_pack.agents.afterstates.gains import gains
from marl_pack.agents.heuristics import HEURISTICS
from marl_pack.agents.selection.beam import Beam, best_of_each, distinct
from marl_pack.agents.selection.beam_settings import BeamSettings
from marl_pack.agents.selection.choosing import selection_policy_of
from marl_pack.agents.selection.policies import (
    GreedyValue,
    RandomSelection,
    RankedSelection,
    SelectAs,
    SelectFirst,
    split,
)
from marl_pack.evaluation.statistics import strict_equilibrium
from marl_pack.game.selection import SelectionPacking
from marl_pack.game.spec import GameSpec, SelectionSpec
from marl_pack.plan_archive import load_plans

RULES = ("hull_alpha", "lbcp", "equilibrium")
VARIANTS = [
    {"buffer": k, "preview": p, "bins": b, "closings": c}
    for k in (1, 3) for p in (0, 2) for b in (1, 2) for c in (None, 3)
]  # fmt: skip


def game_of(n: int = 4, items: Any = "rs", **options: Any) -> SelectionPacking:
    seed, first = options.pop("seed", 0), options.pop("first_episode", 0)
    reset = options.pop("auto_reset", False)
    return SelectionPacking(
        n, items, spec=SelectionSpec(**options), seed=seed, first_episode=first, auto_reset=reset
    )


def random_policy(seed: int = 0) -> RandomSelection:
    generator = torch.Generator().manual_seed(seed)
    from marl_pack.agents.heuristics import make_policy

    return RandomSelection(make_policy("random", seed), generator)


@pytest.fixture(scope="module")
def greedy() -> GreedyValue:
    agents: Any = load("rs").policy
    return GreedyValue(agents.placement_agent.lookahead)


# --- rules ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["rs", "dblf", "max_feasible"])
def test_one_box_and_one_bin_is_the_old_game(name: str) -> None:
    policy = load(name).policy
    old = Packing(6, (10, 10, 10), "rs", seed=3, auto_reset=False)
    new = game_of(6, seed=3)
    while bool(old.alive.any()):
        option = torch.zeros(6, dtype=torch.int64)
        view = new.view()
        assert torch.equal(view.mask[old.alive], old.mask[old.alive])
        assert torch.equal(view.items.sides[old.alive], old.items.sides[old.alive])
        assert torch.equal(new.selection_mask[:, 0], old.alive)
        choice = policy(old)
        assert all(map(torch.equal, choice, policy(view)))
        before, after = old.place(*choice), new.place(option, *choice)
        assert torch.equal(before.reward, after.reward)
        assert torch.equal(before.done, after.done)
        assert torch.equal(before.utilization, after.utilization)
    assert new.plans() == old.plans()
    assert not new.alive.any()


@pytest.mark.parametrize("options", VARIANTS)
def test_every_variant_is_played_to_its_end(options: dict[str, Any]) -> None:
    game, policy = game_of(5, **options), random_policy()
    rewards = torch.zeros(5)
    shown = 0
    while bool(game.alive.any()):
        shown += 1
        view = game.view()
        # A chosen option has an orientation, and a chosen orientation has a cell.
        assert torch.equal(game.selection_mask.flatten(), view.alive)
        assert torch.equal(view.orientation_mask.any(1), view.alive)
        outcome = game.place(*policy(game))
        rewards += outcome.reward
    spec = game.spec
    assert (game.state.closed == spec.most_closings).all()
    assert (game.opened == game.b + spec.most_closings - 1).all()
    plans = game.plans()
    for g, plan in enumerate(plans):
        assert len(plan.bin_sizes) == int(game.opened[g])
        assert len(plan) == int(game.state.placed[g])
        assert plan.utilization == pytest.approx(float(game.utilization[g]))
        for k in range(len(plan.bin_sizes)):
            assert strict_equilibrium(plan.in_bin(k))
    assert shown >= 8


def slow_play(
    items: list[list[int]], k: int, b: int, closings: int, seed: int
) -> list[list[tuple[int, int, int]]]:
    """The rules in a few lines: one game, lists in place of tensors, hull_alpha by ``Packing``."""
    generator = np.random.default_rng(seed)
    queue = list(range(len(items)))
    slots = [queue.pop(0) for _ in range(min(k, len(queue)))]
    bins: list[list[tuple[int, int, int]]] = [[] for _ in range(b)]
    finished: list[list[tuple[int, int, int]]] = []

    def after(moves: list[tuple[int, int, int]], item: int | None) -> Packing:
        order = [m[0] for m in moves] + ([] if item is None else [item])
        game = Packing(1, (6, 6, 6), [items[i] for i in order] or [items[0]],
                       sides=(2, 4), auto_reset=False)  # fmt: skip
        for _, orientation, cell in moves:
            game.place(torch.tensor([orientation]), torch.tensor([cell]))
        return game

    while True:
        legal = [
            (i, j, o, c)
            for i, item in enumerate(slots) for j, moves in enumerate(bins)
            for game in [after(moves, item)]
            for o in range(6) for c in np.flatnonzero(game.mask[0, o].flatten()).tolist()
        ]  # fmt: skip
        if legal:
            i, j, o, c = legal[generator.integers(len(legal))]
            bins[j].append((slots[i], o, c))
            if queue:
                slots[i] = queue.pop(0)
            else:
                slots.pop(i)
            continue
        volumes = [int(after(moves, None).bins.filled[0]) if moves else 0 for moves in bins]
        fullest = int(np.argmax(volumes))
        closings -= 1
        if closings == 0 or volumes[fullest] == 0 or not slots:
            return [*finished, *bins]
        finished.append(bins[fullest])
        bins[fullest] = []


@pytest.mark.parametrize(("k", "b", "closings"), [(1, 1, 1), (3, 1, 1), (1, 2, 3), (2, 2, 2)])
def test_the_rules_are_those_of_a_slow_program(k: int, b: int, closings: int) -> None:
    generator = np.random.default_rng(k + 10 * b)
    items = generator.integers(2, 5, (30, 3)).tolist()
    expected = slow_play(items, k, b, closings, seed=5)
    game = game_of(1, items=items, bin=(6, 6, 6), buffer=k, bins=b, closings=closings)
    draws = np.random.default_rng(5)
    where = {}
    slots = list(range(k))
    while bool(game.alive.any()):
        # The same order of legal placements: slots in the order of the list, then bins.
        order = [int(np.flatnonzero(game.state.slots[0].numpy() == s)[0]) for s in slots]
        legal = [
            (i * b + j, o, c)
            for i in order for j in range(b) for o in range(6)
            for c in np.flatnonzero(game.state.mask[0, i * b + j, o].flatten()).tolist()
        ]  # fmt: skip
        option, o, c = legal[draws.integers(len(legal))]
        item = int(game.state.slots[0, option // b])
        where[item] = (o, c)
        at, following = slots.index(item), int(game.state.t[0])
        game.place(*(torch.tensor([v]) for v in (option, o, c)))
        if following < len(items):
            slots[at] = following
        else:
            slots.pop(at)
    moves = [move for moves in expected for move in moves]
    assert {item: (o, c) for item, o, c in moves} == where
    plan = game.plans()[0]
    assert [int(name) for name in plan.ids] == [item for item, _, _ in moves]
    assert len(plan.bin_sizes) == len(expected)


def test_a_finite_sequence_ends_the_episode() -> None:
    items = [[2, 2, 2]] * 5
    game = game_of(2, items=items, buffer=3, bins=2)
    policy = random_policy()
    for _ in range(5):
        assert game.alive.all()
        outcome = game.place(*policy(game))
    assert outcome.done.all()
    assert (game.state.slots >= 5).all()
    plans = game.plans()
    assert [len(plan) for plan in plans] == [5, 5]
    assert game.opened.tolist() == outcome.opened.tolist() == [2, 2]
    assert game.utilization.tolist() == pytest.approx([plan.utilization for plan in plans])
    assert outcome.utilization.tolist() == game.utilization.tolist()


def test_a_box_that_fits_no_empty_bin_closes_none() -> None:
    items = [[4, 4, 4]] * 6 + [[2, 2, 8]] + [[4, 4, 4]] * 6
    game = game_of(1, items=items, bin=(10, 10, 5), orientations=(0,), bins=2, closings=40)
    while bool(game.alive.any()):
        game.place(*RankedSelection(HEURISTICS["dblf"])(game))
    assert game.opened.tolist() == [2]
    assert int(game.state.closed[0]) == 0
    assert len(game.plans()[0].bin_sizes) == 2


def test_games_that_have_ended_ignore_their_choice() -> None:
    game = game_of(2, items=[[[2, 2, 2]], [[2, 2, 2]] * 3], buffer=2)
    zero = torch.zeros(2, dtype=torch.int64)
    game.place(zero, zero, zero)
    assert game.alive.tolist() == [False, True]
    outcome = game.place(
        torch.tensor([-7, 1]), torch.tensor([99, 0]), torch.tensor([-1, 44])
    )  # fmt: skip
    assert outcome.placed.tolist() == [1, 2]


@pytest.mark.parametrize("options", [{"bins": 3, "closings": 5}, {"buffer": 3, "bins": 2}])
def test_a_game_is_played_the_same_alone_and_in_a_batch(
    options: dict[str, int], greedy: GreedyValue
) -> None:
    for policy in (greedy, Beam(greedy.lookahead, BeamSettings(2, 2))):
        many = game_of(7, **options)
        alone = [game_of(1, first_episode=g, **options) for g in range(7)]
        for _ in range(12):
            choice = policy(many)
            for g, game in enumerate(alone):
                own = policy(game)
                assert [int(part[0]) for part in own] == [int(part[g]) for part in choice]
                game.place(*own)
            many.place(*choice)


def test_a_view_shows_no_hidden_box() -> None:
    game = game_of(1, buffer=2)
    view = game.view()
    assert (view.items.sides > 0).all()
    view.place(*load("dblf")(view))
    assert (view.items.sides == 0).all()
    assert not view.alive.any()
    copied = copy.deepcopy(game)
    assert torch.equal(copied.view().items.sides, game.view().items.sides)


def test_games_restart_by_themselves() -> None:
    game, policy = game_of(3, buffer=2, auto_reset=True), random_policy()
    ends = 0
    for _ in range(80):
        outcome = game.place(*policy(game))
        ends += int(outcome.done.sum())
        assert game.alive.all()
        assert (outcome.utilization[outcome.done] > 0.2).all()
        assert (game.state.placed[outcome.done] == 0).all()
    assert ends >= 6
    assert int(game.episode.max()) >= 3


def test_an_illegal_choice_is_refused_and_changes_nothing() -> None:
    game = game_of(2, buffer=2, bins=2)
    before = game.state.packed.clone(), game.state.slots.clone()
    zero = torch.zeros(2, dtype=torch.int64)
    for choice, words in (
        ((zero + 4, zero, zero), "game 0: selection 4, orientation 0, cell 0 is not legal"),
        ((zero, zero + 7, zero), "orientation 7"),
        ((zero, zero, zero + 99), "cell 99"),
        ((zero[:1], zero, zero), r"selection: needs int64 \[2\]"),
        ((zero, zero.float(), zero), "orientation: needs int64"),
    ):
        with pytest.raises(ValueError, match=words):
            game.place(*choice)
    assert torch.equal(game.state.packed, before[0])
    assert torch.equal(game.state.slots, before[1])


@pytest.mark.parametrize(
    ("options", "words"),
    [({"buffer": 0}, "buffer"), ({"buffer": 65}, "buffer"), ({"bins": 17}, "bins"),
     ({"preview": -1}, "preview"), ({"closings": 0}, "closings"), ({"buffer": 2.5}, "buffer"),
     ({"buffer": 2, "com_offset": (0.1, 0, 0)}, "no com_offset"),
     ({"bins": 2, "mask_orientations": False}, "need mask_orientations")],
)  # fmt: skip
def test_impossible_options_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        game_of(1, **options)


@pytest.mark.parametrize("options", [{"buffer": 2}, {"preview": 1}, {"bins": 2}, {"closings": 2}])
def test_the_game_of_one_box_refuses_other_games(options: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="need SelectionPacking"):
        Packing(1, spec=SelectionSpec(**options))
    with pytest.raises(ValueError, match="needs a SelectionSpec"):
        SelectionPacking(1, spec=GameSpec())  # type: ignore[arg-type]  # it is refused
    assert Packing(1, spec=SelectionSpec(closings=1)).spec == GameSpec()


def test_copies_and_branches_do_not_share_their_state() -> None:
    game, policy = game_of(3, buffer=3, bins=2, closings=4), random_policy()
    for _ in range(12):
        game.place(*policy(game))
    other, branch = copy.deepcopy(game), game.branch(torch.tensor([2, 0, 0]))
    assert torch.equal(branch.state.mask, game.state.mask[[2, 0, 0]])
    choice = policy(game)
    first = game.place(*choice)
    assert other.state.placed.tolist() != game.state.placed.tolist()
    second = other.place(*choice)
    assert torch.equal(first.reward, second.reward)
    assert torch.equal(game.state.mask, other.state.mask)
    third = branch.place(*(part[[2, 0, 0]] for part in choice))
    assert torch.equal(third.reward, first.reward[[2, 0, 0]])


# --- what is hidden -------------------------------------------------------------------------------


@pytest.mark.parametrize(("k", "p"), [(1, 0), (3, 0), (1, 3), (2, 2)])
def test_hidden_boxes_change_no_choice(k: int, p: int, greedy: GreedyValue) -> None:
    generator = np.random.default_rng(1)
    items = generator.integers(2, 6, (2, 40, 3))
    known = 6 + k + p
    items[1, :known] = items[0, :known]
    beam = Beam(greedy.lookahead, BeamSettings(4, None))
    dblf = RankedSelection(HEURISTICS["dblf"])
    for policy in (greedy, beam, dblf, SelectFirst(SelectAs(greedy), load("rs").policy)):
        game = game_of(2, items=items, buffer=k, preview=p)
        for _ in range(6):
            choice = policy(game)
            # Both games look the same until the position of the first different box is known.
            assert all(int(part[0]) == int(part[1]) for part in choice)
            game.place(*choice)


def test_a_branch_of_known_boxes_ends_with_them() -> None:
    game = game_of(1, buffer=2, preview=3)
    branch, policy = game.branch(torch.tensor([0]), only_known=True), random_policy()
    seen = []
    while bool(branch.alive.any()):
        seen.append(branch.state.slots.tolist()[0])
        branch.place(*policy(branch))
    assert max(max(row) for row in seen) == 4
    assert int(branch.state.placed[0]) == 5
    previews = game.previews()
    stream = game.stream.item(game.state.stream.repeat(3), torch.tensor([2, 3, 4]))
    assert torch.equal(previews.sides, stream.sides)


# --- policies -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["dblf", "height_min", "max_feasible", "best_fit"])
def test_a_heuristic_takes_the_best_of_all_options(name: str) -> None:
    heuristic = HEURISTICS[name]
    game, policy = game_of(4, buffer=3, bins=2), RankedSelection(heuristic)
    for _ in range(10):
        option, orientation, cell = policy(game)
        ranks = heuristic.rank(game.view()).view(4, 6, -1)
        legal = game.state.mask.flatten(2)
        for g in range(4):
            chosen = int(game.floor.pair(orientation[g], cell[g]))
            assert ranks[g, option[g], chosen] == ranks[g][legal[g]].min()
        game.place(option, orientation, cell)


def test_gains_are_rewards_and_changes_of_value(greedy: GreedyValue) -> None:
    game = game_of(3, buffer=2, bins=2)
    for _ in range(8):
        gain = gains(game, greedy.lookahead)
        view = game.view()
        before = greedy.lookahead.state_value(game.bins, view).view(3, 2)
        option, orientation, cell = split(game, gain.flatten(1).argmax(1))
        x, y = game.floor.corner(cell)
        chosen = gain[torch.arange(3), option, orientation, x, y]
        outcome = game.place(option, orientation, cell)
        if bool((game.state.closed > 0).any()):
            break
        after = greedy.lookahead.state_value(game.bins, game.view()).view(3, 2)
        change = (after - before).sum(1)
        assert chosen.tolist() == pytest.approx((outcome.reward + change).tolist(), abs=1e-5)


@pytest.mark.parametrize(
    ("options", "better", "worse"),
    [({"buffer": 5}, "greedy", "one box"), ({"bins": 2, "closings": 10}, "greedy", "one bin"),
     ({"buffer": 5}, "beam", "greedy"), ({"preview": 5}, "beam", "greedy")],
)  # fmt: skip
def test_more_choice_and_more_search_fill_more(
    options: dict[str, int], better: str, worse: str, greedy: GreedyValue
) -> None:
    def mean(name: str) -> float:
        one = {"closings": options["closings"]} if "closings" in options else {}
        spec = one if name in ("one box", "one bin") else options
        game = game_of(24, seed=9, **spec)
        policy = Beam(greedy.lookahead, BeamSettings(6, 4)) if name == "beam" else greedy
        while bool(game.alive.any()):
            game.place(*policy(game))
        return float(game.utilization.mean())

    assert mean(better) > mean(worse) + 0.005


def test_a_beam_of_one_known_box_is_the_greedy_choice(greedy: GreedyValue) -> None:
    game, beam = game_of(8), Beam(greedy.lookahead, BeamSettings(5, None))
    while bool(game.alive.any()):
        alive, choice = game.alive.clone(), greedy(game)
        assert all(torch.equal(a[alive], b[alive]) for a, b in zip(choice, beam(game), strict=True))
        game.place(*choice)


def test_a_wide_beam_is_an_exhaustive_search(greedy: GreedyValue) -> None:
    """In a small bin with two known boxes, every pair of placements is tried by hand."""
    items = np.random.default_rng(4).integers(2, 4, (12, 3)).tolist()
    game = game_of(1, items=items, bin=(5, 5, 6), preview=1)
    beam, tried = Beam(greedy.lookahead, BeamSettings(1024, None)), 0
    while bool(game.alive.any()):
        values = {}
        for number in game.state.mask.flatten().nonzero().squeeze(1).tolist():
            one = game.branch(torch.tensor([0]), only_known=True)
            value = float(one.place(*split(one, torch.tensor([number]))).reward[0])
            if bool(one.alive[0]):
                view = one.view()
                value += float(greedy.lookahead.afterstate_value(view)[view.mask].max())
            values[number] = value  # nothing more comes if the next box has no place
        option, orientation, cell = beam(game)
        chosen = int(game.floor.pair(orientation, cell)[0])
        assert values[chosen] == pytest.approx(max(values.values()), abs=1e-5)
        tried += max(values.values()) > min(values.values()) + 1e-3
        game.place(option, orientation, cell)
    assert tried >= 2


def test_equal_states_are_merged() -> None:
    items = [[2, 2, 2], [2, 2, 2], [3, 3, 3], [4, 4, 4]]
    game = game_of(1, items=items, buffer=2)
    both = game.branch(torch.tensor([0, 0]), only_known=True)
    cells = [0, 55]
    for first, second in ((0, 1),):
        order = torch.tensor([first, second])
        both.place(
            torch.tensor([0, 1]), torch.zeros(2, dtype=torch.int64), torch.tensor(cells)[order]
        )
        both.place(
            torch.tensor([1, 0]), torch.zeros(2, dtype=torch.int64), torch.tensor(cells)[1 - order]
        )
    assert distinct(both, torch.zeros(2, dtype=torch.int64), 9).tolist() == [0]
    assert distinct(both, torch.tensor([0, 1]), 9).tolist() == [0, 1]


def test_the_best_of_each_root_are_kept() -> None:
    score = torch.tensor([1.0, 5, 3, 4, 2, 9])
    root = torch.tensor([0, 1, 0, 1, 0, 1])
    assert best_of_each(score, root, 2).tolist() == [2, 4, 5, 1]
    assert best_of_each(score, root, 9).tolist() == [2, 4, 0, 5, 1, 3]


@pytest.mark.parametrize("text", ["width=4", "width=4,depth=2", "depth=3"])
def test_settings_of_the_beam_are_read(text: str) -> None:
    settings = BeamSettings.parse(text)
    assert BeamSettings.parse(str(settings)) == settings


@pytest.mark.parametrize(
    "text", ["", "width=0", "width=4,width=4", "rollouts=2", "depth=99", "width=a"]
)
def test_impossible_settings_of_the_beam_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"width|plan|depth"):
        BeamSettings.parse(text)


def test_a_loaded_policy_plays_games_with_selection(greedy: GreedyValue) -> None:
    game = game_of(3, buffer=3, bins=2)
    for policy, expected in (
        (load("rs"), greedy), (load("dblf"), RankedSelection(HEURISTICS["dblf"])),
        (load("rs", search=BeamSettings(3, 2)), Beam(greedy.lookahead, BeamSettings(3, 2))),
    ):  # fmt: skip
        assert all(map(torch.equal, policy(game), expected(game)))
    option, orientation, cell = load("random", seed=3)(game)
    assert game.place(option, orientation, cell).placed.tolist() == [1, 1, 1]
    with pytest.raises(ValueError, match="need agents with a critic of afterstates"):
        load("plain")(game)
    for source, words in (
        (load("rs", search=SearchSettings()), "need BeamSettings or BudgetSettings, not"),
        (load("rs", symmetric=True), "symmetric: goes with games of one visible box"),
    ):
        with pytest.raises(ValueError, match=words):
            source(game)
    with pytest.raises(ValueError, match="BeamSettings go with games with selection"):
        load("rs", search=BeamSettings())(Packing(1))
    with pytest.raises(ValueError, match=r"needs to return .option"):
        selection_policy_of(lambda game: game.options)(game)  # type: ignore[arg-type, return-value]
    with pytest.raises(ValueError, match="a beam search needs learned agents"):
        selection_policy_of(HEURISTICS["dblf"], BeamSettings())


def test_evaluate_plays_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plans, figures = tmp_path / "plans.json", tmp_path / "figures.json"
    words = ["--policy", "rs", "--items", "rs", "--episodes", "4", "--json", str(figures)]
    selection = ["--bins", "2", "--closings", "3", "--buffer", "2"]
    assert evaluate.main([*words, *selection, "--save-stacks", str(plans)]) == 0
    assert "buffer 2, 2 open bins, 3 closings" in capsys.readouterr().out
    row = json.loads(figures.read_text())["policies"]["rs"]
    saved = load_plans(plans)
    assert row["utilization"] == pytest.approx(np.mean([plan.utilization for plan in saved]))
    assert [len(plan.bin_sizes) for plan in saved] == [4] * 4
    assert row["strict_equilibrium"] == 1
    assert evaluate.main([*words, "--buffer", "3", "--plan", "width=2,depth=2"]) == 0
    assert "rs, width=2,depth=2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--policy", "plain", "--buffer", "2"], "plain: a buffer, a preview or several bins need"),
     (["--policy", "dblf", "--buffer", "2", "--plan", "width=3"], "--plan: needs --policy with"),
     (["--policy", "rs", "--buffer", "2", "--plan", "rollouts=3"], "needs width=W or depth=D"),
     (["--policy", "rs", "--buffer", "2", "--symmetric"], "go with games of one visible box"),
     (["--orientation", "first", "--placement", "dblf", "--bins", "2"], "go with games of one"),
     (["--policy", "rs", "--plan", "width=8"], "width goes with --buffer"),
     (["--buffer", "0"], "buffer"), (["--world", "mm", "--buffer", "2"], "goes with --world cells"),
     (["--policy", "rs", "--buffer", "2", "--explain", "--save-stacks", "p.json"],
      "--explain: goes with games of one visible box and one bin")],
)  # fmt: skip
def test_what_evaluate_refuses(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        evaluate.main([*arguments, "--episodes", "2"])
    assert stop.value.code == 2
    assert words in capsys.readouterr().err


def test_play_shows_box_and_bin(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--policy", "dblf", "--bin", "5", "5", "5", "--sides", "1", "4", "--seed", "1"]
    variant = ["--buffer", "2", "--bins", "2", "--closings", "2"]
    plan_file, picture = tmp_path / "plan.json", tmp_path / "bins.png"
    outputs = ["--save", str(plan_file), "--picture", str(picture)]
    assert play.main([*words, *variant, *outputs]) == 0
    plan = Plan.from_json(plan_file)
    printed = capsys.readouterr().out
    assert f"{len(plan)} boxes, utilization {plan.utilization:.1%}" in printed
    assert len(plan.bin_sizes) == 3
    assert picture.is_file()
    for position in plan.positions.tolist():
        assert " ".join(map(str, position)) in printed
    with pytest.raises(SystemExit):
        play.main([*words, *variant, *outputs, "--explain"])
    assert "--explain: goes with games of one visible box" in capsys.readouterr().err
