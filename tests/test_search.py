"""Search: imagined games follow the rules, futures are drawn, and looking ahead helps."""

from typing import Any

import numpy as np
import pytest
import torch
from small_runs import PLAIN_NETWORK
from torch import Tensor

from marl_pack import BudgetSettings, SelectionPacking, SelectionSpec, evaluate, load
from marl_pack.agents import search
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.heuristics import (
    make_orientation_agent,
    make_placement_agent,
    make_policy,
)
from marl_pack.agents.learned import LearnedAgent
from marl_pack.agents.networks.actor_critic import make_actor, make_critic
from marl_pack.agents.policy import InTurns, Policy
from marl_pack.agents.search import Planner
from marl_pack.agents.search_settings import SearchSettings
from marl_pack.agents.selection.beam import Beam
from marl_pack.agents.selection.beam_settings import BeamSettings
from marl_pack.agents.selection.budget import BudgetSearch
from marl_pack.agents.selection.choosing import lookahead_of
from marl_pack.agents.selection.kinds import kinds_of
from marl_pack.agents.selection.policies import GreedyValue
from marl_pack.agents.selection.touching import keep_touching
from marl_pack.evaluation.rollout import play
from marl_pack.game.packing import Packing
from marl_pack.game.spec import GameSpec
from marl_pack.items import Uniform, make_stream

SIZE = (6, 6, 6)
FUTURES = make_stream("rs", SIZE, (1, 3))
Agents = tuple[LearnedAgent, LearnedAgent]


def game(n: int, first_episode: int = 0, **options: Any) -> Packing:
    settings = {"sides": (1, 3), "auto_reset": False, "seed": 4} | options
    return Packing(n, SIZE, first_episode=first_episode, **settings)


@pytest.fixture(scope="module")
def agents() -> Agents:
    torch.manual_seed(0)
    lookahead = Lookahead()
    first, second = (
        LearnedAgent(kind, make_actor(kind, PLAIN_NETWORK, "cpu").eval(), lookahead)
        for kind in ("orientation", "placement")
    )
    return first, second


def utilization(policy: Policy, episodes: int = 24) -> float:
    return float(play(policy, game, episodes).utilization.mean())


def test_a_branch_continues_like_the_game_it_comes_from() -> None:
    policy = make_policy("dblf")
    whole = game(5)
    for _ in range(6):
        whole.place(*policy(whole))
    state = whole.state_dict()
    which = torch.tensor([3, 1, 3])
    part = whole.branch(which)
    for _ in range(4):
        part.place(*policy(part))
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, state[name]), name
    for _ in range(4):
        whole.place(*policy(whole))
    assert torch.equal(part.bins.heightmap, whole.bins.heightmap[which])
    for name, values in whole.items.tensors().items():
        assert torch.equal(part.items.tensors()[name], values[which]), name
    assert torch.equal(part.alive, whole.alive[which])


def test_a_branch_shows_its_item_and_then_those_of_another_stream() -> None:
    whole = game(2)
    whole.place(*make_policy("dblf")(whole))
    stream = make_stream([[1, 1, 1], [2, 2, 2], [3, 3, 3]], SIZE)
    part = whole.branch(torch.tensor([0, 0]), stream, seed=0, episodes=torch.tensor([4, 5]))
    assert part.episode.tolist() == [4, 5]
    assert torch.equal(part.items.sides[0], whole.items.sides[0])
    part.place(*make_policy("dblf")(part))
    assert part.items.sides.tolist() == [[3, 3, 3], [3, 3, 3]]


def test_a_branch_of_games_that_restart_ends_with_its_episode() -> None:
    whole, first = Packing(2, (2, 2, 2), [[2, 2, 1], [2, 2, 1]]), torch.zeros(2, dtype=torch.int64)
    part = whole.branch(torch.tensor([0, 1]))
    for game_of_two in (whole, part):
        for _ in range(2):
            game_of_two.place(first, first)
    assert whole.episode.tolist() == [2, 3]
    assert part.episode.tolist() == [0, 1]
    assert not part.alive.any()
    assert part.bins.filled.tolist() == [8, 8]


def test_searching_beats_the_same_agents_without(agents: Agents) -> None:
    alone = InTurns(*agents)
    planner = Planner(*agents, None, SearchSettings(rollouts=3, top=6), FUTURES)
    assert utilization(planner) > utilization(alone) + 0.03


def test_a_critic_may_value_the_rest_after_a_depth(agents: Agents) -> None:
    batches: list[int] = []

    class FlatTops(torch.nn.Module):
        """A critic that prefers flat tops."""

        def forward(self, observation: dict[str, Tensor]) -> Tensor:
            batches.append(len(observation["item"]))
            return -observation["heightmap"].double().flatten(1).std(1, keepdim=True)

    settings = SearchSettings(rollouts=2, top=6, depth=1)
    planner = Planner(*agents, FlatTops(), settings, FUTURES)  # type: ignore[arg-type]  # a stand-in
    assert utilization(planner) > utilization(InTurns(*agents)) + 0.03
    assert max(batches) > 6  # pairs times futures times games


@pytest.mark.parametrize("cell", [(0, 0), (5, 5), (2, 3)])
def test_the_placement_that_the_critic_values_most_is_taken(
    agents: Agents, cell: tuple[int, int]
) -> None:
    class Covered(torch.nn.Module):
        """A critic that wants one column covered."""

        def forward(self, observation: dict[str, Tensor]) -> Tensor:
            return (observation["heightmap"][:, cell[0], cell[1], None] > 0).double()

    settings = SearchSettings(rollouts=1, top=200, depth=1)
    planner = Planner(*agents, Covered(), settings, FUTURES)  # type: ignore[arg-type]  # a stand-in
    real = game(2)
    real.place(*planner(real))
    assert (real.bins.heightmap[:, cell[0], cell[1]] > 0).all()


@pytest.mark.parametrize("depth", [1, 3])
def test_a_critic_values_the_bin_once_so_many_items_are_placed(agents: Agents, depth: int) -> None:
    filled: set[float] = set()

    class Counts(torch.nn.Module):
        """A critic that counts the unit cubes in the bins it values."""

        def forward(self, observation: dict[str, Tensor]) -> Tensor:
            cells = observation["heightmap"].flatten(1).sum(1, keepdim=True).double()
            filled.update(cells.flatten().tolist())
            return 0 * cells

    settings = SearchSettings(rollouts=1, top=4, depth=depth)
    cubes = make_stream("rs", SIZE, (1, 1))
    Planner(*agents, Counts(), settings, cubes)(game(1, sides=(1, 1)))  # type: ignore[arg-type]  # a stand-in
    assert filled == {depth}


def test_every_decision_has_futures_of_its_own(agents: Agents) -> None:
    drawn: set[int] = set()

    class Recorded(Uniform):
        """A stream that records the keys of its episodes."""

        def start(self, seed: int, episodes: Tensor) -> Tensor:
            keys = super().start(seed, episodes)
            drawn.update(keys.tolist())
            return keys

    planner = Planner(*agents, None, SearchSettings(rollouts=2, top=3), Recorded(1, 3))
    decisions = []
    for episode in range(3):
        real = game(1, episode)
        for _ in range(3):
            drawn.clear()
            real.place(*planner(real))
            decisions.append(frozenset(drawn))
    assert all(decisions)
    assert len(frozenset.union(*decisions)) == sum(map(len, decisions))


def test_a_decision_does_not_depend_on_the_batch(agents: Agents) -> None:
    planner = Planner(*agents, None, SearchSettings(rollouts=2, top=3), FUTURES, seed=5)
    together = game(4)
    chosen = torch.stack(planner(together), 1)
    for i in range(4):
        assert torch.equal(torch.stack(planner(game(1, i)), 1)[0], chosen[i])


def test_pairs_share_their_futures_and_no_future_is_the_real_one(
    agents: Agents, monkeypatch: pytest.MonkeyPatch
) -> None:
    branches: list[Packing] = []
    branch = Packing.branch

    def spied(self: Packing, *arguments: Any) -> Packing:
        branches.append(branch(self, *arguments))
        return branches[-1]

    monkeypatch.setattr(Packing, "branch", spied)
    real = game(1, 2, seed=0)
    Planner(*agents, None, SearchSettings(rollouts=4, top=3), FUTURES, seed=0)(real)
    imagined = (one for one in branches if one.n == 6 and one.seed < 0)
    first, second = (one.state.stream for one in imagined)
    drawn = []
    for keys in (first.view(3, 2), second.view(2, 3)):  # 3 pairs, then the better 2
        assert (keys == keys[0]).all()
        drawn += keys[0].tolist()
    assert len(set(drawn)) == 5
    assert int(real.state.stream) not in drawn


def test_orientations_that_give_the_same_box_count_as_one(
    agents: Agents, monkeypatch: pytest.MonkeyPatch
) -> None:
    planner = Planner(*agents, None, SearchSettings(rollouts=1, top=200), FUTURES)

    def proposed(**options: Any) -> list[int]:
        cube = Packing(1, (4, 4, 4), [[3, 3, 3]], auto_reset=False, **options)
        pairs, legal = planner._propose(cube, torch.tensor([0]), cube.moves)
        proposals: list[int] = pairs[legal].tolist()
        assert len(set(proposals)) == len(proposals)
        return proposals

    assert len(proposed()) == 4  # its places
    assert {pair // 16 for pair in proposed(orientations=[2, 5])} == {2}
    assert len(proposed(com_offset=(0.1, 0, 0))) == 24


def test_a_game_with_few_pairs_or_at_its_end_is_searched_too(agents: Agents) -> None:
    planner = Planner(*agents, None, SearchSettings(rollouts=2, top=64), FUTURES)
    tight = Packing(3, (2, 2, 3), [[2, 2, 1], [2, 2, 1], [2, 2, 1]], auto_reset=False)
    for _ in range(4):  # the last one plays bins that have ended
        tight.place(*planner(tight))
    assert not tight.alive.any()
    assert (tight.bins.filled == 12).all()


@pytest.mark.parametrize(
    "text",
    [
        "rollouts",
        "rollouts=0",
        "top=-1",
        "k=3",
        "rollouts=2;top=3",
        "",
        "rollouts=²",
        "top=3,top=4",
        "rollouts=99999999999999999999",
        "rollouts=1000000,top=4",
    ],
)
def test_settings_that_cannot_be_read_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="plan"):
        SearchSettings.parse(text)


@pytest.mark.parametrize("wrong", [
    {"rollouts": 1.5}, {"rollouts": True}, {"rollouts": "3"}, {"rollouts": None}, {"top": 2.0},
    {"top": np.nan}, {"depth": 0}, {"depth": "1"},
])  # fmt: skip
def test_settings_are_whole_numbers(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=f"plan: {next(iter(wrong))}: needs a whole number >= 1"):
        SearchSettings(**wrong)
    assert str(SearchSettings(rollouts=np.int64(3))) == "plan rollouts=3,top=8"


def test_settings_are_read_and_shown() -> None:
    assert SearchSettings.parse("rollouts=3, top=2") == SearchSettings(3, 2)
    assert str(SearchSettings.parse("top=2,depth=4")) == "plan rollouts=16,top=2,depth=4"


def test_a_single_legal_pair_is_taken_without_imagining(
    agents: Agents, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Planner, "_imagine", None)
    full = Packing(2, (3, 3, 3), [[3, 3, 3]], auto_reset=False)
    choice = Planner(*agents, None, SearchSettings(rollouts=2, top=4), FUTURES)(full)
    full.place(*choice)
    assert (full.bins.filled == 27).all()


def test_the_work_may_be_split_into_parts(agents: Agents, monkeypatch: pytest.MonkeyPatch) -> None:
    planner = Planner(*agents, None, SearchSettings(rollouts=3, top=5), FUTURES)
    at_once = torch.stack(planner(game(3)))
    monkeypatch.setattr(search, "AT_ONCE", 7 * 36)  # seven bins
    assert torch.equal(torch.stack(planner(game(3))), at_once)


def test_a_depth_needs_a_critic(agents: Agents) -> None:
    with pytest.raises(ValueError, match="critic"):
        Planner(*agents, None, SearchSettings(depth=2), FUTURES)
    critic = make_critic("orientation", PLAIN_NETWORK, "cpu", agents[0].actor)
    Planner(*agents, critic, SearchSettings(depth=2), FUTURES)


@pytest.mark.parametrize("seed", [1.5, True, "3", -1, 2**64, np.nan, torch.tensor(3)])
def test_seeds_of_random_play_are_whole_numbers(seed: Any) -> None:
    for make in (make_policy, make_orientation_agent, make_placement_agent):
        with pytest.raises(ValueError, match="seed: needs a whole number from 0 to"):
            make("random", seed)
        make("random", np.int64(4))
        make("random", None)


# --- with a time budget ---------------------------------------------------------------------------

ONE_BOX: dict[str, int] = {}
VARIANTS = [
    ONE_BOX, {"buffer": 3}, {"preview": 2}, {"bins": 2, "closings": 3}, {"buffer": 2, "preview": 1}
]  # fmt: skip


def selecting(n: int, items: Any = "rs", **options: int) -> SelectionPacking:
    return SelectionPacking(n, items, spec=SelectionSpec(**options), seed=4)


def budget_search(settings: str = "draws=2,width=4", **arguments: Any) -> BudgetSearch:
    lookahead = lookahead_of(load("rs").policy)
    assert lookahead is not None
    boxes = make_stream("rs", (10, 10, 10))
    return BudgetSearch(lookahead, BudgetSettings.parse(settings), boxes, **arguments)


def choices(placement: tuple[Tensor, ...]) -> list[list[int]]:
    return torch.stack(placement, 1).tolist()


@pytest.mark.parametrize("options", VARIANTS)
def test_hidden_boxes_change_no_choice_of_a_budget_search(options: dict[str, int]) -> None:
    items = np.random.default_rng(1).integers(2, 6, (2, 40, 3))
    known = 7 + options.get("buffer", 1) + options.get("preview", 0)
    items[1, :known] = items[0, :known]
    game, policy = selecting(2, items, **options), budget_search()
    for _ in range(8):
        choice = policy(game)
        first, second = choices(choice)
        assert first == second
        game.place(*choice)
    again = selecting(2, items, **options)
    assert choices(policy(again)) == choices(budget_search()(again))


def test_a_budget_search_plays_on_with_few_visible_boxes_and_full_bins() -> None:
    for options in VARIANTS:
        game, policy = selecting(2, **options), budget_search("draws=1,width=2")
        while bool(game.alive.any()):
            game.place(*policy(game))
        assert (game.utilization > 0.6).all()


@pytest.mark.parametrize("side", [5, 2])
def test_a_budget_search_draws_more_boxes_than_the_sequences_have(side: int) -> None:
    items = np.full((1, 6 if side == 2 else 40, 3), side)  # memory for 6 and 8 boxes in a bin
    game, policy = selecting(1, items), budget_search("draws=2,width=2")
    while bool(game.alive.any()):
        game.place(*policy(game))
    assert int(game.state.placed) == (6 if side == 2 else 8)


def test_a_budget_search_is_a_beam_where_everything_is_known() -> None:
    items = np.random.default_rng(2).integers(2, 6, (6, 4, 3))
    game = selecting(6, items, preview=5)
    policy = budget_search("draws=9,width=8")
    beam = Beam(policy.lookahead, BeamSettings(8))
    while bool(game.alive.any()):
        choice = beam(game)
        assert choices(policy(game)) == choices(choice)
        game.place(*choice)


def test_a_budget_search_finds_more_than_the_critic() -> None:
    game, plain = selecting(12), selecting(12)
    policy, greedy = budget_search("draws=4"), GreedyValue(budget_search().lookahead)
    while bool(game.alive.any()):
        game.place(*policy(game))
    while bool(plain.alive.any()):
        plain.place(*greedy(plain))
    assert float(game.utilization.mean()) > float(plain.utilization.mean()) + 0.01


@pytest.mark.parametrize("options", [ONE_BOX, {"buffer": 4, "preview": 4}])
def test_a_budget_search_ends_in_time(options: dict[str, int]) -> None:
    """The clock advances by 1 ms at each look; a search looks at least before each draw."""
    looks = []

    def clock() -> int:
        looks.append(len(looks))
        return 1_000_000 * len(looks)

    game = selecting(1, **options)
    for budget, most in ((1, 8), (20, 26), (60, 66)):
        looks.clear()
        game.place(*budget_search(f"budget={budget}ms", clock=clock)(game))
        assert len(looks) <= most
        assert len(looks) >= min(most, 20) - 8 or options


def test_a_search_for_one_box_is_the_search_with_selection() -> None:
    game = Packing(3, seed=4, auto_reset=False)
    player = load("rs", search=BudgetSettings(draws=2, width=4))
    other = selecting(3)
    for _ in range(4):
        choice, expected = player(game), player(other)
        assert choices(choice) == choices(expected[1:])
        game.place(*choice)
        other.place(*expected)
    orientation = torch.tensor([2, 2, 2])
    chosen = player.policy(game, game.moves.only(orientation))  # type: ignore[call-arg]  # a search
    assert (chosen[0] == orientation)[game.moves.orientations[:, 2]].all()


def test_a_few_draws_count_less_than_the_critic(monkeypatch: pytest.MonkeyPatch) -> None:
    lookahead = lookahead_of(load("rs").policy)
    assert lookahead is not None
    settings, stream = BudgetSettings(draws=2), make_stream("rs", (10, 10, 10), (2, 5))
    game = SelectionPacking(6, "rs", spec=SelectionSpec(), seed=4)
    for _ in range(6):
        game.place(*GreedyValue(lookahead)(game))

    def choices(trust: float) -> list[list[int]]:
        monkeypatch.setattr("marl_pack.agents.selection.budget.TRUST", trust)
        chosen = BudgetSearch(lookahead, settings, stream)(game)
        return [choice.tolist() for choice in chosen]

    critic = [choice.tolist() for choice in Beam(lookahead, BeamSettings(settings.width))(game)]
    assert choices(1e9) == critic
    assert choices(0.0) != critic


def test_boxes_are_drawn_as_often_as_they_come() -> None:
    kinds = kinds_of(make_stream("rs", (10, 10, 10)), GameSpec(), -1)
    assert len(kinds.reached) == 20
    share = np.diff(kinds.reached, prepend=0)
    equal = (kinds.items.sides == kinds.items.sides[:, :1]).all(1).numpy()
    assert share[equal] == pytest.approx(1 / 64, abs=0.006)
    drawn = np.bincount(kinds.at((np.arange(6400) + 0.5) / 6400), minlength=20) / 6400
    assert drawn == pytest.approx(share, abs=1e-3)
    upright = kinds_of(make_stream("rs", (10, 10, 10)), GameSpec(orientations=(0, 1)), -1)
    assert len(upright.reached) == 64


def test_boxes_are_placed_where_they_touch() -> None:
    game = Packing(40, seed=1, auto_reset=False)
    policy = make_policy("random", 0)
    for _ in range(5):
        sides = game.orient_item(game.items).sides
        mask = game.mask.clone()
        keep_touching(game.bins.heightmap.numpy(), sides.numpy(), mask.numpy())
        for g in game.alive.nonzero().squeeze(1).tolist():
            level = np.pad(game.bins.heightmap[g].numpy(), 1, constant_values=99)
            expected = torch.zeros_like(mask[g])
            for o, x, y in game.mask[g].nonzero().tolist():
                w, d, _ = sides[g, o].tolist()
                z = level[x + 1 : x + w + 1, y + 1 : y + d + 1].max()
                beside = level[[x, x + w + 1], y + 1 : y + d + 1] > z
                behind = level[x + 1 : x + w + 1][:, [y, y + d + 1]] > z
                expected[o, x, y] = bool(beside.any() and behind.any())
            assert torch.equal(mask[g], expected if expected.any() else game.mask[g])
        game.place(*policy(game))


@pytest.mark.parametrize("text", ["budget=100ms", "draws=5", "budget=0.5s,draws=7,width=3"])
def test_settings_of_a_budget_are_read(text: str) -> None:
    settings = BudgetSettings.parse(text)
    assert BudgetSettings.parse(str(settings)) == settings


@pytest.mark.parametrize(
    ("text", "words"),
    [("budget=5", "needs budget=100ms"), ("budget=0ms", "more than 0"), ("width=3", "needs a"),
     ("draws=2,draws=3", "given twice"), ("draws=9999999", "draws"), ("top=3", "needs budget"),
     ("draws=100000000000", "draws: needs a whole number from 1 to")],
)  # fmt: skip
def test_impossible_budgets_are_refused(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        BudgetSettings.parse(text)


def test_a_budget_needs_a_critic_of_afterstates_and_centred_boxes() -> None:
    settings = BudgetSettings(draws=1)
    with pytest.raises(ValueError, match="need agents with a critic of afterstates"):
        load("plain", search=settings)
    with pytest.raises(ValueError, match="does not ask the agents"):
        load("rs", search=settings, symmetric=True)
    with pytest.raises(ValueError, match="no com_offset"):
        load("rs", search=settings)(Packing(1, com_offset=(0.1, 0, 0)))


def test_evaluate_plans_with_a_budget(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--policy", "rs", "--items", "rs", "--episodes", "2", "--plan", "draws=1"]
    for options in ([], ["--buffer", "2"], ["--bins", "2", "--closings", "2"]):
        assert evaluate.main([*words, *options]) == 0
        assert "rs, draws=1" in capsys.readouterr().out
