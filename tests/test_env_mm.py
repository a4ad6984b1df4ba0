"""The environment in millimetres keeps PettingZoo's contracts and the game's rules."""

from __future__ import annotations

import copy
import pickle
import warnings
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import api_test, parallel_api_test, seed_test

from marl_pack import env, parallel_env
from marl_pack.env_aec import AGENTS
from marl_pack.env_mm import COLUMNS, raw_env
from marl_pack.exact.bins import placements

GOODS = {
    "items": [[300, 200, 100], [400, 300, 200], [250, 250, 300.5], [120, 320, 220]],
    "weights": [1, 2, 3, 4],
}
OPTIONS: dict[str, Any] = {
    "items": GOODS, "order": "draw", "length": 30, "bin_mm": (800, 600, 900), "margin_mm": 10,
    "max_moves": 40,
}  # fmt: skip


def make(**options: Any) -> Any:
    return env(world="mm", **OPTIONS | options)


def play(environment: Any, cycles: int = 10**6, seed: int = 0) -> list[tuple[Any, ...]]:
    """Play at random by the masks; return what was seen."""
    generator = np.random.default_rng(seed)
    seen = []
    for agent in environment.agent_iter(2 * cycles):
        observation, reward, terminated, truncated, info = environment.last()
        action = None
        if not (terminated or truncated):
            action = int(generator.choice(np.flatnonzero(observation["action_mask"])))
        seen.append((agent, observation, reward, terminated, truncated, dict(info), action))
        environment.step(action)
    return seen


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("options", [{}, {"mask_in": "info"}, {"illegal": "repair"}])
def test_pettingzoo_api(options: dict[str, Any]) -> None:
    api_test(make(**options), num_cycles=60)
    parallel_api_test(parallel_env(world="mm", **OPTIONS | options), num_cycles=40)
    seed_test(lambda: make(**options), num_cycles=20)


def test_no_legal_action_is_refused_and_every_turn_has_one() -> None:
    environment = make()
    for episode in range(3):
        environment.reset(seed=episode)
        seen = play(environment, seed=episode)
        for agent, observation, _, terminated, truncated, _, action in seen:
            if not (terminated or truncated):
                assert observation["action_mask"][action] == 1
                assert environment.observation_space(agent).contains(observation)
        raw = environment.unwrapped
        assert raw.plan.utilization == pytest.approx(raw.utilization)
        rewards = sum(s[2] for s in seen if s[0] == AGENTS[1])
        assert rewards <= raw.utilization + 1e-9


def test_the_masks_and_rows_are_those_of_the_listed_moves() -> None:
    raw = raw_env(**OPTIONS)
    raw.reset(seed=3)
    for _ in range(12):
        listed = raw.game.moves.of(0)
        rows = placements(listed)
        assert set(np.flatnonzero(raw.action_mask(AGENTS[0]))) == set(rows[:, 0].tolist())
        assert not raw.action_mask(AGENTS[1]).any()
        o = int(rows[len(rows) // 2, 0])
        raw.step(o)
        own = rows[rows[:, 0] == o]
        observation = raw.observe(AGENTS[1])
        count = min(len(own), raw.max_moves)
        assert observation["action_mask"].sum() == count
        assert raw.infos[AGENTS[1]]["moves_left_out"] == len(own) - count
        table = observation["observation"]
        size = raw.game.bins.size
        assert np.allclose(table[:count, 1:4] * size, own[:count, 1:], atol=0.01)
        assert table[:count, 0].all()
        assert not table[count:].any()
        raw.step(count - 1)
        if not raw.agents or raw.terminations[AGENTS[0]]:
            break
    assert len(COLUMNS) == table.shape[1]


def test_an_illegal_action_ends_the_game_or_is_repaired() -> None:
    environment = make()
    environment.reset(seed=0)
    mask = environment.last()[0]["action_mask"]
    environment.step(int(np.flatnonzero(mask)[0]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        environment.step(OPTIONS["max_moves"] - 1)
    assert environment.rewards[AGENTS[1]] == -1
    assert all(environment.terminations.values())

    repairing = make(illegal="repair")
    repairing.reset(seed=0)
    repairing.step(int(np.flatnonzero(mask)[0]))
    repairing.step(OPTIONS["max_moves"] - 1)
    assert repairing.infos[AGENTS[1]]["repaired"]
    assert repairing.unwrapped.plan.utilization > 0


@pytest.mark.parametrize(
    "copied", [copy.copy, copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))]
)
def test_a_copy_continues_alike_and_shares_nothing(copied: Any) -> None:
    environment = make()
    environment.reset(seed=5)
    play(environment, cycles=3)
    other = copied(environment)
    mine, theirs = play(environment, seed=9), play(other, seed=9)
    assert len(mine) == len(theirs)
    for a, b in zip(mine, theirs, strict=True):
        assert a[0] == b[0]
        assert a[2:] == b[2:]
        assert (a[1]["observation"] == b[1]["observation"]).all()


def test_episodes_follow_one_another_and_a_seed_begins_again() -> None:
    environment = make()
    plans = []
    for seed in (1, None, 1):
        environment.reset(seed=seed)
        play(environment, seed=4)
        plans.append(environment.unwrapped.plan)
    assert plans[0] == plans[2] != plans[1]


def test_items_of_reset_options_are_played_once() -> None:
    environment = make()
    environment.reset(seed=1, options={"items": [[100, 100, 100]]})
    play(environment)
    assert environment.unwrapped.plan.boxes_mm[:, 3:].tolist() == [[100, 100, 100]]
    with pytest.raises(ValueError, match="fits into the bin"):
        environment.reset(options={"items": [[10000, 100, 100]]})
    environment.reset()
    assert len(environment.unwrapped.game.stream.goods) == 4


def test_episodes_are_truncated_after_max_cycles() -> None:
    environment = make(max_cycles=3)
    environment.reset(seed=0)
    seen = play(environment)
    assert seen[-1][4]
    assert len(environment.unwrapped.plan) == 3


def test_pictures_and_text() -> None:
    environment = make(render_mode="rgb_array")
    environment.reset(seed=0)
    play(environment, cycles=4)
    picture = environment.render()
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    text = make(render_mode="ansi")
    text.reset(seed=0)
    assert "mm" in text.render()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_moves": 0}, "max_moves"),
        ({"rule": "x"}, "unknown stability rule"),
        ({"margin": 2}, "did you mean 'margin_mm'"),
        ({"order": "drawn"}, "needs one of file, draw"),
        ({"render_mode": "human"}, "render_mode"),
    ],
)
def test_a_wrong_argument_says_what_would_be_right(options: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        make(**options)


def test_an_unknown_world_is_refused() -> None:
    with pytest.raises(ValueError, match="world = 'inches': one of 'cells', 'mm'"):
        env(world="inches")  # type: ignore[call-overload]  # it must be refused
