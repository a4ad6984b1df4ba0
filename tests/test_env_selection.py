import pickle
from typing import Any

import numpy as np
import pytest
import torch
from pettingzoo.test import api_test, parallel_api_test, seed_test
from pettingzoo.test.state_test import state_test

from marl_pack import env_aec, env_selection
from marl_pack.agents.player import Player, load
from marl_pack.agents.policy import InTurns, draw_placement
from marl_pack.game.selection import SelectionPacking
from marl_pack.game.spec import SelectionSpec

S, O, P = "selection_0", "orientation_0", "placement_0"  # noqa: E741  # the three agents
SMALL: dict[str, Any] = {"bin_size": (5, 4, 6), "sides": (1, 4)}
VARIANTS: list[dict[str, Any]] = [
    SMALL | {"buffer": k, "preview": p, "bins": b, "closings": c}
    for k in (1, 3)
    for p in (0, 2)
    for b, c in ((1, 1), (1, 3), (2, 3))
    if (k, p, b, c) != (1, 0, 1, 1)
]
FORMS = [{"pad_actions": True}, {"mask_in": "info"}, {"illegal": "repair"}]


def mask_of(env: Any, agent: str) -> np.ndarray:
    value = env.observe(agent)
    return value["action_mask"] if isinstance(value, dict) else env.infos[agent]["action_mask"]


def step_at_random(env: Any, generator: np.random.Generator) -> int:
    """Play a legal action of the acting agent; return it."""
    action = int(generator.choice(np.flatnonzero(mask_of(env, env.agent_selection))))
    env.step(action)
    return action


def goes_on(env: Any) -> bool:
    return bool(env.agents) and not any(env.terminations.values())


# --- PettingZoo's own tests -----------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("arguments", [*VARIANTS, *(VARIANTS[-1] | form for form in FORMS)])
def test_pettingzoos_tests_pass(arguments: dict[str, Any]) -> None:
    api_test(env_aec.env(**arguments), num_cycles=60)
    seed_test(lambda: env_aec.env(**arguments), num_cycles=12)
    state_test(env_aec.env(**arguments), env_aec.parallel_env(**arguments), num_cycles=6)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("arguments", [VARIANTS[-1], VARIANTS[-1] | {"mask_in": "info"}])
def test_pettingzoos_parallel_test_passes(arguments: dict[str, Any]) -> None:
    parallel_api_test(env_aec.parallel_env(**arguments), num_cycles=60)


# --- agents and spaces ----------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", VARIANTS)
def test_agents_and_spaces_are_as_documented(arguments: dict[str, Any]) -> None:
    env = env_aec.env(**arguments)
    k, p, b = (arguments[name] for name in ("buffer", "preview", "bins"))
    selects = k * b > 1
    assert env.possible_agents == [S, O, P][not selects :]
    actions = {S: k * b, O: 6, P: 20}
    planes = 4 + 3 * p + (b + 3 * k) * selects
    for agent in env.possible_agents:
        assert env.action_space(agent).n == actions[agent]
        space = env.observation_space(agent)
        assert space["observation"].shape == (planes, 5, 4)
        assert space["action_mask"].shape == (actions[agent],)
    assert env.state_space.shape == (planes + 1, 5, 4)


def test_without_a_variant_it_is_the_papers_environment() -> None:
    env = env_aec.env(buffer=1, preview=0, bins=1)
    assert isinstance(env.unwrapped, env_aec.raw_env)
    with pytest.raises(ValueError, match="buffer: needs a whole number from 1 to 64, not 0"):
        env_aec.env(buffer=0)
    for more in ({}, {"bins": 2}):
        with pytest.raises(TypeError, match=r"unexpected option 'bufer'; did you mean 'buffer'\?"):
            env_aec.env(bufer=3, **more)
    with pytest.raises(TypeError, match=r"buffer: raw_env has one visible box .* use env_aec.env"):
        env_aec.raw_env(buffer=3)
    with pytest.raises(ValueError, match="buffer: needs world = 'cells'"):
        env_aec.env(world="mm", items=[[300, 200, 100]], buffer=3)


def test_with_one_box_and_one_bin_it_is_the_papers_game_action_by_action() -> None:
    env, paper = env_selection.raw_env(**SMALL), env_aec.raw_env(**SMALL)
    generator = np.random.default_rng(3)
    for seed in range(3):
        env.reset(seed=seed)
        paper.reset(seed=seed)
        while goes_on(paper):
            agent = paper.agent_selection
            assert env.agent_selection == agent
            ours, theirs = env.observe(agent), paper.observe(agent)
            assert np.array_equal(ours["observation"], theirs["observation"])
            assert np.array_equal(ours["action_mask"], theirs["action_mask"])
            env.step(step_at_random(paper, generator))
            assert env.rewards == paper.rewards
            assert env.terminations == paper.terminations
            assert env.utilization == paper.utilization
        assert env.plan.positions.tolist() == paper.plan.positions.tolist()


# --- the game -------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", VARIANTS)
def test_it_plays_the_batched_game_step_by_step(arguments: dict[str, Any]) -> None:
    env = env_aec.env(**arguments)
    env.reset(seed=5)
    options = {name: arguments[name] for name in ("buffer", "preview", "bins", "closings")}
    spec = SelectionSpec(bin=arguments["bin_size"], **options)
    game = SelectionPacking(1, "rs", spec=spec, sides=arguments["sides"], seed=5)
    generator, turns = np.random.default_rng(1), 0
    while goes_on(env):
        actions = {S: 0, O: 0, P: 0}
        for agent in env.possible_agents:
            assert env.agent_selection == agent
            assert mask_of(env, agent).any()  # no choice led to a dead end
            others = [name for name in env.possible_agents if name != agent]
            assert not any(mask_of(env, name).any() for name in others)
            for name in env.possible_agents:
                assert env.observation_space(name).contains(env.observe(name))
            actions[agent] = step_at_random(env, generator)
        outcome = game.place(*(torch.tensor([actions[agent]]) for agent in (S, O, P)))
        assert set(env.rewards.values()) == {float(outcome.reward)}
        assert set(env.terminations.values()) == {bool(outcome.done)}
        assert env.unwrapped.utilization == float(game.utilization)
        assert env.infos[env.agents[0]]["opened"] == int(game.opened)
        turns += 1
    assert turns >= 2
    assert env.unwrapped.plan.positions.tolist() == game.plans()[0].positions.tolist()


def test_planes_show_bins_boxes_and_the_preview() -> None:
    items = [[[2, 3, 1], [1, 2, 3], [3, 3, 2], [1, 1, 1], [2, 1, 4]]]
    env = env_selection.raw_env((6, 5, 6), items, buffer=2, preview=1, bins=2)
    env.reset(seed=0)
    env.step(1)  # box 0, bin 1
    env.step(0)
    env.step(0)
    planes = env.observe(S)["observation"]
    assert planes.shape == (4 + 2 + 6 + 3, 6, 5)
    assert not planes[:4].any()
    assert not planes[4].any()
    assert planes[5, :2, :3].tolist() == [[pytest.approx(1 / 6)] * 3] * 2
    sides = [[3, 3, 2], [1, 2, 3], [1, 1, 1]]  # box 2 took the empty slot
    assert (6 * planes[6:, 0, 0]).round().tolist() == [side for box in sides for side in box]
    env.step(3)  # box 1, bin 1
    own = env.observe(O)["observation"]
    assert np.array_equal(own[0], planes[5])
    assert (6 * own[1:4, 2, 2]).round().tolist() == [1, 2, 3]
    assert np.array_equal(own[4:], planes[4:])
    env.step(2)
    assert (6 * env.observe(P)["observation"][1:4, 2, 2]).round().tolist() == [1, 3, 2]
    assert env.state()[-1].max() == 1


@pytest.mark.parametrize("arguments", [{"buffer": 2, "preview": 1}, {"bins": 2, "closings": 2}])
def test_hidden_boxes_stay_hidden(arguments: dict[str, Any]) -> None:
    generator = np.random.default_rng(0)
    known = arguments.get("buffer", 1) + arguments.get("preview", 0)
    items = generator.integers(1, 4, (12, 3))
    others = np.concatenate((items[: known + 1], generator.integers(1, 4, (11 - known, 3))))
    first, second = (env_selection.raw_env((5, 5, 5), **arguments) for _ in range(2))
    first.reset(seed=0, options={"items": items})
    second.reset(seed=0, options={"items": others})
    for agent in first.possible_agents * 2:  # until another hidden box becomes visible
        for name in first.possible_agents:
            a, b = first.observe(name), second.observe(name)
            assert np.array_equal(a["observation"], b["observation"])
            assert np.array_equal(a["action_mask"], b["action_mask"])
        assert np.array_equal(first.state(), second.state())
        if agent == P:
            break
        second.step(step_at_random(first, generator))


def test_a_game_ends_after_its_last_closing_and_counts_all_bins() -> None:
    env = env_aec.env(**SMALL, buffer=2, bins=2, closings=3)
    env.reset(seed=1)
    generator = np.random.default_rng(0)
    while goes_on(env):
        step_at_random(env, generator)
    info = env.infos[P]
    assert (info["closed"], info["opened"]) == (3, 4)
    plan = env.unwrapped.plan
    assert info["packed"] == len(plan)
    assert len(plan.bin_sizes) == 4
    assert info["utilization"] == pytest.approx(plan.sides.prod(1).sum() / (4 * 120))


def test_an_illegal_option_is_refused_or_repaired() -> None:
    items = [[[5, 4, 6], [9, 9, 9], [1, 1, 1]]]
    with pytest.raises(ValueError, match="bin"):
        env_selection.raw_env((5, 4, 6), items, buffer=2)  # a box that fits nowhere
    items = [[[5, 4, 5], [5, 4, 6], [1, 1, 1]]]
    env = env_selection.raw_env((5, 4, 6), items, buffer=2)
    env.reset(seed=0)
    for action in (0, 0, 0):
        env.step(action)
    assert mask_of(env, S).tolist() == [1, 0]
    with pytest.raises(ValueError, match="selection_0: action 1 is not legal; 1 are"):
        env.step(1)
    repairing = env_selection.raw_env((5, 4, 6), items, buffer=2, illegal="repair")
    repairing.reset(seed=0)
    for action in (0, 0, 0, 1):
        repairing.step(action)
    assert repairing.selected == 0
    assert repairing.infos[S]["repaired"]


def test_a_first_box_without_a_place_is_refused_at_reset() -> None:
    env = env_selection.raw_env((5, 5, 6), buffer=2, orientations=(2,))
    with pytest.raises(ValueError, match="first item"):
        env.reset(options={"items": [[1, 1, 6]]})


def test_copies_and_pickles_play_the_same_game() -> None:
    env = env_aec.env(**SMALL, buffer=3, bins=2, closings=2)
    env.reset(seed=2)
    for turns in range(8):
        again = pickle.loads(pickle.dumps(env))
        ends = []
        for one in (again, env):
            generator = np.random.default_rng(turns)
            step_at_random(one, generator)
            ends.append([one.state(), one.observe(one.agent_selection)["action_mask"]])
        assert all(np.array_equal(a, b) for a, b in zip(*ends, strict=True))


def test_both_agents_may_act_at_once_with_repair() -> None:
    env = env_aec.parallel_env(**SMALL, buffer=2, illegal="repair", simultaneous=True)
    observations, _ = env.reset(seed=0)
    player = load("dblf")
    for _ in range(4):
        assert observations[S]["action_mask"].any()
        assert not observations[P]["action_mask"].any()
        observations, *_ = env.step(player.act(env))
    assert env.unwrapped.game.state.placed.item() == 4


# --- players --------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["dblf", "max_feasible"])
def test_a_player_acts_in_the_environment_as_in_the_game(policy: str) -> None:
    arguments = {"buffer": 2, "preview": 1, "bins": 2, "closings": 2}
    player, env = load(policy), env_aec.env(**SMALL, **arguments)
    env.reset(seed=4)
    for _ in env.agent_iter():
        env.step(player.act(env))
    spec = SelectionSpec(bin=SMALL["bin_size"], **arguments)
    game = SelectionPacking(1, "rs", spec=spec, sides=SMALL["sides"], seed=4)
    while bool(game.alive):
        game.place(*player(game))
    assert env.unwrapped.plan.positions.tolist() == game.plans()[0].positions.tolist()


def test_a_player_places_the_box_that_another_player_has_selected() -> None:
    env = env_aec.env(**SMALL, buffer=3)
    in_turns = Player(InTurns(lambda game: draw_placement(game)[0], _first_cell))
    generator = np.random.default_rng(0)
    for player in (load("dblf"), in_turns):
        env.reset(seed=1)
        while goes_on(env):
            if env.agent_selection == P or (env.agent_selection == O and env.unwrapped.selected):
                env.step(player.act(env))
            else:
                step_at_random(env, generator)
        assert env.unwrapped.utilization > 0.2


def _first_cell(game: Any, orientation: torch.Tensor) -> torch.Tensor:
    return game.mask[0, int(orientation)].flatten().int().argmax()[None]


# --- pictures -------------------------------------------------------------------------------------


def test_text_and_pictures_show_every_bin() -> None:
    arguments = SMALL | {"buffer": 2, "preview": 1, "bins": 2}
    env = env_aec.env(**arguments, render_mode="ansi")
    env.reset(seed=0)
    text = env.render()
    assert "0 boxes, utilization 0.0%\nvisible " in text
    assert "\npreview " in text
    assert text.count("item 0 x 0 x 0") == 2
    env.step(0)
    assert env.render().count("item 0 x 0 x 0") == 1
    pictures = {}
    for bins in (1, 2):
        shown = env_aec.env(**arguments | {"bins": bins}, render_mode="rgb_array")
        shown.reset(seed=0)
        shown.step(0)
        pictures[bins] = shown.render()
    assert pictures[2].shape[1] == 2 * pictures[1].shape[1]
