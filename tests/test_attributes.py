"""Attributes of goods reach every part: masks, afterstates, agents, search, environment, plans."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from marl_pack import env_aec
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.keys import POLICIES
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.loading import Loader
from marl_pack.agents.search_settings import SearchSettings
from marl_pack.backend import Backend
from marl_pack.config import parse
from marl_pack.evaluate import main as evaluate
from marl_pack.game.packing import Packing
from marl_pack.geometry import ORIENTATIONS
from marl_pack.items import Items, independent, make_stream
from marl_pack.plan_archive import load_plans
from marl_pack.stability import RULES, reference
from marl_pack.training.assembly import make_runner

BIN = (10, 10, 10)
MODEL = str(Path(__file__).parent.parent / "models" / "rs.pt")


def goods(sequences: int, length: int, seed: int = 0) -> Items:
    """Items of which a third is upright, a third may take odd orientations, a third any."""
    draw = np.random.default_rng(seed)
    sides = torch.from_numpy(draw.integers(2, 6, (sequences, length, 3)).astype(np.int16))
    orientations = torch.ones(sequences, length, 6, dtype=torch.bool)
    kind = torch.from_numpy(draw.integers(0, 3, (sequences, length)))
    orientations[kind == 0] = torch.tensor([True, True, False, False, False, False])
    some = torch.from_numpy(draw.integers(0, 2, (sequences, length, 6)).astype(bool))
    some[..., 3] = True
    orientations = torch.where((kind == 1)[..., None], some, orientations)
    ids = 1000 + torch.arange(sequences * length).view(sequences, length)
    return Items(sides, sides.double().prod(-1), orientations, ids)


def played(policy_name: str, items: Items, n: int, **options: object) -> Packing:
    game = Packing(n, BIN, items, auto_reset=False, **options)
    policy = make_policy(policy_name, seed=1)
    while game.alive.any():
        game.place(*policy(game))
    return game


def assert_allowed(game: Packing, items: Items) -> None:
    """Every placed box lies in an orientation that its item allows."""
    lying = 0
    for g, plan in enumerate(game.plans()):
        assert plan.ids == tuple(map(str, items.ids[g, : len(plan)].tolist()))
        own = items.sides[g, : len(plan)].numpy()
        axes = np.array(ORIENTATIONS)[plan.orientations]
        assert (np.take_along_axis(own, axes, 1) == plan.sides).all()
        allowed = items.orientations[g, : len(plan)].numpy()
        assert allowed[np.arange(len(plan)), plan.orientations].all()
        lying += int((plan.orientations > 1).sum())
    assert lying > 0, "some items may lie, and do"


@pytest.mark.parametrize("name", POLICIES)
def test_heuristics_place_items_only_as_they_allow(name: str) -> None:
    items = goods(40, 60)
    assert_allowed(played(name, items, 40), items)


@pytest.mark.parametrize("backend", Backend)
@pytest.mark.parametrize("rule", ["hull_1", "hull_alpha", "area_ratio", "none"])
def test_masks_equal_the_reference_in_allowed_orientations(rule: str, backend: Backend) -> None:
    items = goods(6, 30, seed=3)
    game = Packing(6, BIN, items, rule=rule, backend=backend)
    policy = make_policy("random", 2)
    for _ in range(5):
        game.place(*policy(game))
    assert {"hull_1", "hull_alpha", "area_ratio", "none"} <= set(RULES)
    for g in range(6):
        heights, empty_map = game.bins.heightmap[g].numpy(), game.bins.empty_map[g].numpy()
        for o in range(6):
            sides = tuple(game.items.sides[g, list(ORIENTATIONS[o])].tolist())
            allowed = bool(game.items.orientations[g, o])

            def stands(x: int, y: int, sides: tuple[int, int, int] = sides) -> bool:
                window = np.s_[x : x + sides[0], y : y + sides[1]]
                if rule == "none":
                    return True
                if rule == "area_ratio":
                    thresholds = ((0.60, 4), (0.80, 3), (0.95, 0))
                    return reference.area_ratio(heights[window], thresholds)  # noqa: B023  # called at once
                bearing = np.ones_like(empty_map) if rule == "hull_1" else empty_map == 0  # noqa: B023
                centre = (sides[0] / 2, sides[1] / 2)
                return reference.hull(heights[window], bearing[window] > 0, centre)  # noqa: B023

            expected = reference.window_mask(stands, heights, sides, BIN[2])
            assert (game.mask[g, o].numpy() == (expected & allowed)).all()


def test_afterstates_count_only_the_orientations_that_next_items_may_take() -> None:
    # A bin of one column: nothing but an upright 1 x 1 x h fits.
    rows = [[1, 1, 1], [1, 1, 2], [1, 1, 1]]
    standing = Packing(1, (1, 2, 4), {"items": rows, "upright": [True] * 3})
    free = Packing(1, (1, 2, 4), {"items": rows})
    assert standing.orientation_sets == {(0, 1): 1.0}
    assert free.orientation_sets == {(0, 1, 2, 3, 4, 5): 1.0}
    mixed = Packing(1, (1, 2, 4), {"items": rows, "upright": [True, False, False]})
    probabilities = [
        float(Lookahead().feasible_probability(game)[0, 0, 0, 0])
        for game in (standing, mixed, free)
    ]
    assert probabilities[0] < probabilities[1] < probabilities[2]
    share = probabilities[0] / 3 + probabilities[2] * 2 / 3
    assert probabilities[1] == pytest.approx(share, abs=1e-6)


def test_the_games_own_orientations_exclude_more() -> None:
    items = {"items": [[2, 3, 4]] * 3, "orientations": [[0, 2], [2, 4], [4]]}
    game = Packing(1, BIN, items, orientations=(0, 2))
    assert game.orientation_mask[0].tolist() == [True, False, True, False, False, False]
    assert game.orientation_sets == {(0, 2): 1 / 3, (2,): 1 / 3, (): 1 / 3}
    items["orientations"] = [[0, 2], [0, 2, 4], [0, 1]]
    sets = Packing(1, BIN, items, orientations=(0, 2)).orientation_sets
    assert sets == {(0, 2): pytest.approx(2 / 3), (0,): pytest.approx(1 / 3)}


def test_a_branch_counts_the_orientations_of_what_comes_there() -> None:
    rows = [[1, 1, 1], [1, 1, 2], [1, 1, 1]]
    free = Packing(1, (1, 2, 4), {"items": rows})
    standing = Packing(1, (1, 2, 4), {"items": rows, "upright": [True] * 3})
    one = torch.tensor([0])
    branch = free.branch(one, independent(standing.stream), 0, one)
    assert branch.orientation_sets == {(0, 1): 1.0}
    assert free.orientation_sets == {(0, 1, 2, 3, 4, 5): 1.0}
    chance = Lookahead().feasible_probability
    assert torch.equal(chance(branch)[0, 0], chance(standing)[0, 0])
    assert (chance(branch)[0, 0] < chance(free)[0, 0])[free.mask[0, 0]].all()


def test_a_negative_id_is_kept() -> None:
    items = {"items": [[2, 2, 2], [3, 3, 3], [4, 4, 4]], "ids": [-5, -1, 7]}
    game = Packing(1, BIN, items, auto_reset=False)
    while game.alive.any():
        game.place(*make_policy("dblf")(game))
    assert game.plans()[0].ids == ("-5", "-1", "7")


def test_the_environment_shows_and_plays_only_what_items_allow() -> None:
    rows = {"items": [[2, 3, 4], [4, 3, 2], [5, 2, 3]], "upright": ["yes", 0, 1],
            "ids": ["a-1", "b-2", "c-3"]}  # fmt: skip
    env = env_aec.env(items=rows)
    env.reset(seed=0)
    masks = []
    for agent in env.agent_iter():
        observation, _, ended, _, _ = env.last()
        if ended:
            env.step(None)
            continue
        if agent == "orientation_0":
            masks.append(observation["action_mask"].tolist())
        env.step(int(np.flatnonzero(observation["action_mask"])[-1]))
    assert masks == [[1, 1, 0, 0, 0, 0], [1] * 6, [1, 1, 0, 0, 0, 0]]
    plan = env.unwrapped.plan
    assert plan.ids == ("a-1", "b-2", "c-3")
    assert plan.orientations.tolist() == [1, 5, 1]
    env.reset(options={"items": {"items": [[2, 3, 4]], "upright": [True]}})
    assert env.observe("orientation_0")["action_mask"].tolist() == [1, 1, 0, 0, 0, 0]
    with pytest.raises(ValueError, match="did you mean 'upright'"):
        env.reset(options={"items": {"items": [[2, 3, 4]], "uprigth": [True]}})
    with pytest.raises(ValueError, match="needs to be an array"):
        env_aec.env(items=object())


@pytest.mark.parametrize("plan", [None, SearchSettings(rollouts=2, top=3, depth=1)])
@pytest.mark.parametrize("symmetric", [False, True])
def test_learned_agents_and_search_place_items_only_as_they_allow(
    plan: SearchSettings | None, symmetric: bool
) -> None:
    items = goods(4, 40, seed=5)
    loader = Loader(symmetric=symmetric)
    policy = loader.policy(MODEL)
    if plan is not None:
        futures = independent(make_stream(items, BIN))
        assert futures.orientation_sets == pytest.approx(items.orientation_sets())
        policy = loader.planner(checkpoints.read(MODEL), plan, futures)
    game = Packing(4, BIN, items, auto_reset=False)
    while game.alive.any():
        game.place(*policy(game))
    assert_allowed(game, items)


def test_a_file_with_attributes_is_evaluated_and_its_plans_are_saved(tmp_path: Path) -> None:
    path, stacks, table = tmp_path / "goods.csv", tmp_path / "s.npz", tmp_path / "t.json"
    path.write_text("id,w,d,h,upright,quantity\ncola,2,2,4,yes,9\ncrate,3,4,2,no,5\n")
    options = ["--items", str(path), "--bin", "10", "10", "10", "--save-stacks", str(stacks)]
    assert evaluate([*options, "--policy", "dblf", "--json", str(table)]) == 0
    (plan,) = load_plans(stacks)
    assert plan.ids == ("cola",) * 9 + ("crate",) * 5
    assert set(plan.sides[:9, 2].tolist()) == {4}
    assert json.loads(table.read_text())["policies"]["dblf"]["packed"] == 14


def test_agents_learn_on_goods_that_stay_upright(tmp_path: Path) -> None:
    path = tmp_path / "goods.json"
    rows = {"bin": [6, 6, 6], "items": [[2, 3, 1], [3, 1, 2]] * 10, "upright": [True, False] * 10}
    path.write_text(json.dumps(rows))
    small = [f"--game.items={path}", "--game.bin=[6,6,6]", "--ppo.num_envs=8",
             "--ppo.num_steps_per_env=4", "--ppo.num_mini_batches=2", "--evaluation.every=0",
             "--placement.network.planes=[mask,feasible_probability,afterstate_value]"]  # fmt: skip
    runner = make_runner(parse(small)[0], None)
    runner.train(2)
    game = runner.env.game
    upright = game.items.orientations.sum(1) == 2
    observed: Tensor = runner.env.get_observations()["mask"]
    assert upright.any()
    assert not observed[upright][:, 2:].any()
    state = game.state_dict()
    again = make_runner(parse(small)[0], None).env.game
    again.load_state_dict(state)
    assert torch.equal(again.items.orientations, game.items.orientations)
    assert torch.equal(again.mask, game.mask)


def test_without_a_mask_of_orientations_an_item_still_bars_its_own() -> None:
    # A bin of one column and two cells: an item 1 x 1 x 2 stands upright or has no place.
    rows = {"items": [[1, 1, 2]] * 3, "upright": [True, False, True]}
    game = Packing(1, (1, 1, 4), rows, mask_orientations=False, auto_reset=False)
    assert game.orientation_mask[0].tolist() == [True, True, False, False, False, False]
    game.place(torch.tensor([0]), torch.tensor([0]))
    assert game.orientation_mask.all()
    outcome = game.place(torch.tensor([2]), torch.tensor([0]))
    assert bool(outcome.done)
    assert int(outcome.placed) == 1


def test_a_branch_with_items_of_other_ids_names_no_box_wrongly() -> None:
    game = Packing(1, items={"items": [[2, 2, 3], [2, 2, 2], [1, 1, 1]], "ids": ["a", "b", "c"]})
    game.place(*make_policy("dblf")(game))
    future = make_stream({"items": [[1, 1, 2]] * 3, "ids": ["x", "y", "z"]}, game.size)
    for stream, last in ((future, "z"), (make_stream("rs", game.size), "2")):
        branch = game.branch(torch.tensor([0]), stream, 0, torch.tensor([0]))
        for _ in range(2):
            branch.place(*make_policy("dblf")(branch))
        assert branch.plans()[0].ids == ("", "", last)
