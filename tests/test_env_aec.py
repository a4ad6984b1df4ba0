import inspect
import pickle
import warnings
from dataclasses import fields
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pettingzoo
import pytest
import torch
from gymnasium import spaces
from pettingzoo.test import (
    api_test,
    max_cycles_test,
    parallel_api_test,
    render_test,
    seed_test,
)
from pettingzoo.test.state_test import state_test
from pettingzoo.utils import wrappers

from marl_pack import env_aec, env_cells, env_selection, env_turns
from marl_pack.game.packing import Packing
from marl_pack.game.spec import GameSpec, SelectionSpec
from marl_pack.geometry import ORIENTATIONS

O, P = "orientation_0", "placement_0"  # noqa: E741  # the two agents

VARIANTS: list[dict[str, Any]] = [
    {},
    {"pad_actions": True},
    {"mask_in": "info"},
    {"mask_in": "info", "pad_actions": True},
    {"illegal": "repair"},
    {"bin_size": (8, 5, 12), "items": "cut2", "sides": (1, 4), "rule": "lbcp"},
    {"bin_size": (1, 2, 9), "sides": (1, 1), "pad_actions": True},
]


@pytest.mark.parametrize(
    ("make", "spec"),
    [
        (env_aec.env, SelectionSpec),
        (env_aec.parallel_env, SelectionSpec),
        (env_aec.raw_env, GameSpec),
        (env_selection.raw_env, SelectionSpec),
    ],
)
def test_the_signature_names_every_option_with_its_default(make: Any, spec: Any) -> None:
    parameters = inspect.signature(make).parameters
    for option in fields(spec):
        assert parameters[env_cells.TAKEN.get(option.name, option.name)].default == option.default
    # What type checkers and editors read names the same arguments.
    typed = env_aec.Options.__optional_keys__
    raw = env_aec.raw_env if spec is GameSpec else env_selection.raw_env
    assert set(inspect.signature(raw).parameters) <= typed & set(parameters)
    assert typed == set(inspect.signature(env_selection.raw_env).parameters)


def mask_of(env: Any, agent: str) -> np.ndarray:
    value = env.observe(agent)
    return value["action_mask"] if isinstance(value, dict) else env.infos[agent]["action_mask"]


def planes_of(env: Any, agent: str) -> np.ndarray:
    value = env.observe(agent)
    return value["observation"] if isinstance(value, dict) else value


def play(env: Any, seed: int) -> list[tuple[str, int, float]]:
    """Random legal play to the end: agent, action and the reward it brought."""
    generator, history = np.random.default_rng(seed), []
    env.reset(seed=seed)
    for agent in env.agent_iter():
        if env.terminations[agent] or env.truncations[agent]:
            env.step(None)
            continue
        action = int(generator.choice(np.flatnonzero(mask_of(env, agent))))
        env.step(action)
        history.append((agent, action, env.rewards[agent]))
    return history


# --- PettingZoo's own tests -----------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("arguments", VARIANTS)
def test_pettingzoos_tests_pass(arguments: dict[str, Any]) -> None:
    api_test(env_aec.env(**arguments), num_cycles=60)
    seed_test(partial(env_aec.env, **arguments))
    state_test(env_aec.env(**arguments), env_aec.parallel_env(**arguments), 20)


@pytest.mark.filterwarnings("ignore")
def test_pettingzoos_parallel_test_passes() -> None:
    parallel_api_test(env_aec.parallel_env(), num_cycles=60)
    parallel_api_test(env_aec.parallel_env(simultaneous=True, illegal="repair"), num_cycles=60)


@pytest.mark.filterwarnings("ignore")
def test_pettingzoos_max_cycles_test_passes() -> None:
    # It plays at random without masks, and takes one parallel step for one cycle: four items must
    # never fill the bin.
    roomy: dict[str, Any] = {"illegal": "repair", "bin_size": (20, 20, 20), "sides": (1, 2)}
    module = SimpleNamespace(
        env=partial(env_aec.env, **roomy),
        parallel_env=partial(env_aec.parallel_env, simultaneous=True, **roomy),
    )
    max_cycles_test(module)


@pytest.mark.filterwarnings("ignore")
def test_pettingzoos_render_test_passes() -> None:
    render_test(env_aec.env)


def test_registered_where_pettingzoo_has_a_registry() -> None:
    if not hasattr(pettingzoo, "make"):
        pytest.skip("this PettingZoo has no registry")
    env = pettingzoo.make("aec", "marl_pack/Packing-v0", bin_size=(8, 6, 9))
    env.reset(seed=0)
    assert env.action_space(P).n == 48
    assert pettingzoo.make("parallel", "marl_pack/Packing-v0").possible_agents == [O, P]


# --- spaces and observations ----------------------------------------------------------------------


@pytest.mark.parametrize("arguments", VARIANTS)
def test_observations_lie_in_their_spaces_at_all_times(arguments: dict[str, Any]) -> None:
    env = env_aec.env(**arguments)
    generator = np.random.default_rng(0)
    env.reset(seed=1)
    for _ in range(30):
        for agent in (O, P):
            assert env.observation_space(agent).contains(env.observe(agent))
            assert env.observation_space(agent) is env.observation_space(agent)
            assert env.action_space(agent) is env.action_space(agent)
        assert env.state_space.contains(env.state())
        if not env.agents:
            break
        agent = env.agent_selection
        ended = env.terminations[agent] or env.truncations[agent]
        mask = mask_of(env, agent)
        env.step(None if ended else int(generator.choice(np.flatnonzero(mask))))
    assert env.state_space.contains(env.state())


def test_spaces_are_as_documented() -> None:
    env = env_aec.env(bin_size=(7, 4, 9), sides=(1, 4))
    assert env.action_space(O) == spaces.Discrete(6)
    assert env.action_space(P) == spaces.Discrete(28)
    assert list(env.observation_space(O)) == ["observation", "action_mask"]
    assert env.observation_space(P)["observation"].shape == (4, 7, 4)
    assert env.observation_space(P)["action_mask"].shape == (28,)
    assert env.state_space.shape == (5, 7, 4)
    padded = env_aec.env(bin_size=(7, 4, 9), sides=(1, 4), pad_actions=True)
    assert padded.action_space(O) == padded.action_space(P) == spaces.Discrete(28)
    assert padded.observation_space(O) == padded.observation_space(P)
    assert padded.observation_space(O)["observation"].shape == (5, 7, 4)
    bare = env_aec.env(bin_size=(7, 4, 9), sides=(1, 4), mask_in="info")
    assert isinstance(bare.observation_space(O), spaces.Box)


def test_planes_show_heights_and_the_rotated_item() -> None:
    env = env_aec.env(bin_size=(10, 8, 20), items=[[2, 4, 6], [3, 3, 5], [1, 1, 1]])
    env.reset(seed=0)
    for agent in (O, P):
        assert planes_of(env, agent)[1:, 0, 0].tolist() == pytest.approx([0.1, 0.2, 0.3])
    env.step(4)  # (d, h, w) along x, y, z
    assert planes_of(env, O)[1:, 3, 3].tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert planes_of(env, P)[1:, 3, 3].tolist() == pytest.approx([0.2, 0.3, 0.1])
    assert env.state()[1:, 0, 0].tolist() == pytest.approx([0.2, 0.3, 0.1, 1])
    env.step(5 * 8 + 2)
    heights = planes_of(env, O)[0] * 20
    assert heights.sum() == pytest.approx(4 * 6 * 2)
    assert heights[5:9, 2:8] == pytest.approx(2)
    assert env.state()[4].max() == 0


# --- masks ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", VARIANTS)
def test_the_environment_plays_the_batched_game_step_by_step(arguments: dict[str, Any]) -> None:
    env = env_aec.env(**arguments)
    core = {"bin": arguments.get("bin_size", (10, 10, 10))}
    core |= {k: arguments[k] for k in ("items", "sides", "rule") if k in arguments}
    game = Packing(1, **core, auto_reset=False, seed=5)
    generator = np.random.default_rng(5)
    env.reset(seed=5)
    while env.agents:
        cells = game.size[0] * game.size[1]
        if env.terminations[env.agent_selection]:
            assert not game.alive.any()
            env.step(None)
            continue
        if env.agent_selection == O:
            assert (mask_of(env, O)[:6] == game.orientation_mask[0].numpy()).all()
            assert not mask_of(env, O)[6:].any()
            assert not mask_of(env, P).any()
            choice = int(generator.choice(np.flatnonzero(mask_of(env, O))))
            env.step(choice)
            assert env.rewards == {O: 0, P: 0}
        else:
            assert (mask_of(env, P)[:cells] == game.mask[0, choice].numpy().ravel()).all()
            assert not mask_of(env, P)[cells:].any()
            assert not mask_of(env, O).any()
            cell = int(generator.choice(np.flatnonzero(mask_of(env, P))))
            env.step(cell)
            outcome = game.place(torch.tensor([choice]), torch.tensor([cell]))
            assert env.rewards == {O: float(outcome.reward), P: float(outcome.reward)}
            assert env.terminations == {O: bool(outcome.done), P: bool(outcome.done)}
            assert env.infos[O]["utilization"] == pytest.approx(float(outcome.utilization))
            assert env.infos[P]["packed"] == int(outcome.placed)
            unit = np.float32(max(game.size))
            assert (planes_of(env, O)[0] == game.bins.heightmap[0].numpy() / unit).all()


def test_the_parallel_environment_never_shows_a_stale_mask() -> None:
    env = env_aec.parallel_env()
    observation, _ = env.reset(seed=3)
    generator = np.random.default_rng(3)
    core = env.unwrapped
    turns = 0
    while env.agents:
        legal = {agent: np.flatnonzero(observation[agent]["action_mask"]) for agent in env.agents}
        acting = core.agent_selection
        assert [agent for agent in env.agents if len(legal[agent])] == [acting]
        choice = int(generator.choice(legal[acting]))
        observation, rewards, ended, _, infos = env.step({O: choice, P: choice})
        assert rewards[O] == rewards[P]
        assert all("illegal" not in str(info) for info in infos.values())
        turns += 1
    assert turns % 2 == 0
    assert turns > 6
    assert ended == {O: True, P: True}


def test_masks_in_info_are_those_of_the_observation() -> None:
    one, other = env_aec.env(), env_aec.env(mask_in="info")
    one.reset(seed=2)
    other.reset(seed=2)
    for _ in range(10):
        agent = one.agent_selection
        assert (one.observe(agent)["action_mask"] == other.infos[agent]["action_mask"]).all()
        assert "action_mask" not in one.infos[agent]
        action = int(np.flatnonzero(one.observe(agent)["action_mask"])[0])
        one.step(action)
        other.step(action)


def test_a_mask_that_was_observed_is_not_written_to() -> None:
    env = env_aec.env()
    env.reset(seed=0)
    observation = env.observe(O)
    copy = {key: value.copy() for key, value in observation.items()}
    for _ in range(4):
        env.step(int(np.flatnonzero(env.observe(env.agent_selection)["action_mask"])[0]))
    assert all((observation[key] == copy[key]).all() for key in observation)


# --- rewards, end, seeds --------------------------------------------------------------------------


def test_both_agents_are_credited_with_every_reward() -> None:
    env = env_aec.env(alpha=2.0, beta=0.5)
    env.reset(seed=4)
    generator, total, credited = np.random.default_rng(4), 0.0, {O: 0.0, P: 0.0}
    for agent in env.agent_iter():
        _, reward, ended, _, _ = env.last()
        credited[agent] += reward
        if ended:
            env.step(None)
            continue
        env.step(int(generator.choice(np.flatnonzero(mask_of(env, agent)))))
        if agent == P:
            total += env.rewards[P]
    assert total != 0
    assert credited == pytest.approx({O: total, P: total})


def test_reward_is_the_volume_gained_less_the_waste() -> None:
    env = env_aec.env(bin_size=(4, 2, 4), items=[[2, 2, 2], [3, 2, 1], [1, 1, 1]])
    env.reset()
    for action, reward in ((0, 0), (0, 8 / 32), (0, 0), (0, (6 - 4) / 32)):
        env.step(action)
        assert env.rewards == pytest.approx({O: reward, P: reward})


def test_the_same_seed_gives_the_same_episode_and_no_seed_the_next() -> None:
    env = env_aec.env()
    first = play(env, 6)
    assert play(env, 6) == first
    assert play(env_aec.env(), 6) == first
    env.reset(seed=6)
    item = env.state()[1:4, 0, 0].tolist()
    env.reset()
    following = [env.state()[1:4, 0, 0].tolist()]
    for _ in range(5):
        env.reset()
        following.append(env.state()[1:4, 0, 0].tolist())
    assert any(other != item for other in following)


def test_both_agents_are_truncated_after_max_cycles() -> None:
    env = env_aec.env(max_cycles=3)
    history = play(env, 0)
    assert [agent for agent, *_ in history] == [O, P] * 3
    env.reset(seed=0)
    for _ in range(6):
        env.step(int(np.flatnonzero(mask_of(env, env.agent_selection))[0]))
    assert env.truncations == {O: True, P: True}
    assert env.terminations == {O: False, P: False}


def test_an_episode_that_ends_in_its_last_cycle_is_not_truncated_as_well() -> None:
    env = env_aec.raw_env(items=[[2, 2, 2], [3, 3, 3]], max_cycles=2)
    env.reset(seed=0)
    for _ in range(4):
        env.step(int(np.flatnonzero(mask_of(env, env.agent_selection))[0]))
    assert env.terminations == {O: True, P: True}
    assert env.truncations == {O: False, P: False}


def test_a_given_sequence_is_played_once() -> None:
    env = env_aec.env(items="rs")
    env.reset(seed=1, options={"items": np.array([[2, 3, 4], [5, 5, 5]])})
    assert env.state()[1:4, 0, 0].tolist() == pytest.approx([0.2, 0.3, 0.4])
    for action in (0, 0, 0, 50):
        env.step(action)
    assert env.terminations == {O: True, P: True}  # no more items
    assert env.infos[O]["packed"] == 2
    env.reset(seed=1)
    expected = env_aec.env(items="rs")
    expected.reset(seed=1)
    assert (env.state() == expected.state()).all()
    with pytest.raises(ValueError, match="row 0"):
        env.reset(options={"items": [[2, 3, 11]]})


def test_sequences_of_a_file_come_in_their_order(tmp_path: Path) -> None:
    path = tmp_path / "items.npz"
    np.savez(path, items=np.array([[[2, 2, 2]], [[3, 3, 3]], [[4, 4, 4]]]))
    env = env_aec.env(items=path)
    sides = []
    for _ in range(4):
        env.reset()
        sides.append(round(float(env.state()[1, 0, 0]) * 10))
    assert sides == [2, 3, 4, 2]


# --- illegal actions ------------------------------------------------------------------------------


def first_illegal(env: Any) -> int:
    return int(np.flatnonzero(mask_of(env, env.agent_selection) == 0)[0])


@pytest.mark.parametrize("mask_in", ["observation", "info"])
def test_an_illegal_action_ends_the_game_where_asked(mask_in: str) -> None:
    env = env_aec.env(illegal_reward=-3.0, mask_in=mask_in)
    env.reset(seed=0)
    env.step(0)
    env.last()
    env.step(first_illegal(env))
    assert env.terminations == {O: True, P: True}
    assert env.rewards[P] == -3.0
    for _ in range(2):
        env.step(None)
    assert env.agents == []


def test_the_raw_environment_refuses_an_illegal_action() -> None:
    env = env_aec.raw_env()
    env.reset(seed=0)
    env.step(0)
    with pytest.raises(ValueError, match=r"placement_0: action .* is not legal"):
        env.step(first_illegal(env))
    with pytest.raises(ValueError, match="action: needs a whole number from 0 to 99, not 100"):
        env.step(100)


@pytest.mark.parametrize("illegal", ["terminate", "repair"])
@pytest.mark.parametrize("kind", [env_aec.raw_env, env_aec.env])
@pytest.mark.parametrize(
    "action",
    [5.99, 1.0, True, "1", None, -1, 6, [1], np.bool_(1), np.float32(1), np.array([1]),
     np.ma.array(1, mask=True), torch.tensor(1.5), torch.tensor(True), torch.tensor([1])],
)  # fmt: skip
def test_an_action_is_a_whole_number_of_its_space(kind: Any, action: Any, illegal: str) -> None:
    env = kind(illegal=illegal)
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(ValueError, match="orientation_0: action: needs a whole number from 0 to 5"):
        env.step(action)
    assert (env.state() == before).all()
    assert env.agent_selection == O


@pytest.mark.parametrize("one", [1, np.int8(1), np.array(1), torch.tensor(1)])
def test_whole_numbers_of_every_type_are_actions(one: Any) -> None:
    for kind in (env_aec.raw_env, env_aec.env):
        env = kind()
        env.reset(seed=0)
        env.step(one)
        assert env.unwrapped._chosen == 1


def test_actions_of_a_parallel_step_are_checked_before_any_is_played() -> None:
    for simultaneous in (False, True):
        env = env_aec.parallel_env(simultaneous=simultaneous, illegal="repair")
        with pytest.raises(ValueError, match="no episode has begun"):
            env.step({O: 0, P: 0})
        env.reset(seed=0)
        before = env.state()
        for actions in ({}, 5, {P: 1}, {O: 0.5, P: 1}, {O: True, P: 1}):
            with pytest.raises(ValueError, match=r"action of orientation_0|orientation_0: action"):
                env.step(actions)
        if simultaneous:
            for actions in ({O: 0}, {O: 0, P: 1.5}):
                with pytest.raises(ValueError, match="placement_0"):
                    env.step(actions)
        assert (env.state() == before).all()
        env.step({O: 0, P: 0})


@pytest.mark.parametrize("kind", [env_aec.raw_env, env_aec.env])
def test_after_the_end_no_agent_is_left_to_act(kind: Any) -> None:
    env = kind(items=[[5, 5, 5]])
    env.reset()
    for action in (0, 0, None, None):
        env.last()
        env.step(action)
    with pytest.raises(ValueError, match=r"no agent is left to act: begin an episode with reset"):
        env.last()
    raw = env.unwrapped
    with pytest.raises(ValueError, match="no agent is left to act"):
        raw.step(0)
    with pytest.raises(ValueError, match="no agent is left to act"):
        env_aec.raw_env().step(0)
    env.reset()
    assert env.last()[1:4] == (0, False, False)


def test_an_illegal_action_is_repaired_to_the_nearest_legal_one() -> None:
    env = env_aec.env(illegal="repair", bin_size=(6, 6, 6), items=[[3, 3, 3], [1, 1, 1]])
    env.reset()
    env.step(0)
    env.step(5 * 6 + 0)  # (5, 0): the nearest corner of a 3 x 3 box is (3, 0)
    assert env.unwrapped._game.bins.boxes[0, 0].tolist() == [3, 0, 0, 3, 3, 3]
    assert env.infos[P]["repaired"] is True
    assert "repaired" not in env.infos[O]
    env.step(0)
    assert "repaired" not in env.infos[O]


def test_wrappers_are_in_pettingzoos_order() -> None:
    def chain(env: Any) -> list[type]:
        out = []
        while isinstance(env, wrappers.BaseWrapper):
            out.append(type(env))
            env = env.env
        return [*out, type(env)]

    assert issubclass(env_turns.OrderEnforcing, wrappers.OrderEnforcingWrapper)
    outer = [env_turns.OrderEnforcing, wrappers.AssertOutOfBoundsWrapper]
    assert chain(env_aec.env()) == [*outer, wrappers.TerminateIllegalWrapper, env_aec.raw_env]
    assert chain(env_aec.env(illegal="repair")) == [*outer, env_aec.raw_env]


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ({"mask_in": "both"}, "mask_in"),
        ({"illegal": "ignore"}, "illegal"),
        ({"render_mode": "3d"}, "render_mode"),
        *[({"max_cycles": value}, "max_cycles .*: needs a whole number >= 1")
          for value in (0, 1.5, 2.0, True, "3")],
        ({"pad_actions": "no"}, "pad_actions = 'no': needs true or false"),
        ({"illegal_reward": "-1"}, "illegal_reward: needs a finite number"),
        ({"rule": "hull"}, "unknown stability rule"),
        ({"bin_size": (10, 10, 0)}, "bin size"),
        ({"items": [[11, 11, 11]]}, "row 0"),
    ],
)  # fmt: skip
def test_impossible_arguments_are_refused(arguments: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        env_aec.env(**arguments)


def test_parallel_steps_of_both_agents_at_once_need_repair() -> None:
    with pytest.raises(ValueError, match="repair"):
        env_aec.parallel_env(simultaneous=True)


def test_every_info_names_the_acting_agent() -> None:
    env = env_aec.parallel_env(items=[[5, 5, 5]])
    _, infos = env.reset()
    assert [info["active_agent"] for info in infos.values()] == [O, O]
    *_, infos = env.step({O: 0, P: 0})
    assert [info["active_agent"] for info in infos.values()] == [P, P]
    *_, infos = env.step({O: 0, P: 0})
    assert set(infos) == {O, P}


def test_a_refused_reset_leaves_the_game_as_it_was() -> None:
    env = env_aec.raw_env(margin=1.0, sides=(3, 5))
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(ValueError, match="placed nowhere"):
        env.reset(options={"items": [[2, 2, 2]]})
    assert (env.state() == before).all()


def test_observations_can_be_asked_for_before_the_first_reset() -> None:
    env = env_aec.raw_env()
    assert env.state_space.contains(env.state())
    assert env.observation_space(O).contains(env.observe(O))


def test_an_episode_that_cannot_begin_is_skipped() -> None:
    rows = [[[2, 2, 9]], [[3, 3, 3]], [[2, 9, 2]], [[4, 4, 4]]]
    env = env_aec.raw_env(bin_size=(9, 5, 5), items=rows, orientations=(0,))
    observation = []
    for _ in range(3):
        env.reset()
        observation.append(round(float(env.state()[1, 0, 0]) * 9))
    assert observation == [3, 4, 3]


def test_a_first_item_without_a_legal_cell_is_refused_at_reset() -> None:
    env = env_aec.env(margin=4.0)
    with pytest.raises(ValueError, match="no episode can begin"):
        env.reset(seed=0)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("illegal", ["terminate", "repair"])
def test_without_a_mask_of_orientations_one_without_a_cell_ends_the_episode(illegal: str) -> None:
    # A bin of one column: an item 1 x 1 x 2 that lies has no place.
    rows = [[1, 1, 2], [1, 1, 1]]
    env = env_aec.env(bin_size=(1, 1, 3), items=rows, mask_orientations=False, illegal=illegal)
    env.reset(seed=0)
    assert mask_of(env, O).all()
    env.step(5)
    assert env.terminations == {O: True, P: True}
    assert env.rewards == {O: 0, P: 0}
    assert not mask_of(env, P).any()
    assert len(env.unwrapped.plan) == 0
    for _ in range(2):
        env.step(None)
    assert env.agents == []
    api_test(env, num_cycles=20)


# --- pickling and pictures ------------------------------------------------------------------------


def test_a_pickled_environment_plays_the_same_game() -> None:
    env = env_aec.raw_env(bin_size=(8, 8, 8), rule="equilibrium", orientations=(0, 1))
    again = pickle.loads(pickle.dumps(env))
    assert play(again, 7) == play(env, 7)


def test_pictures_show_the_state() -> None:
    env = env_aec.env(render_mode="rgb_array")
    env.reset(seed=0)
    images = [env.render()]
    for _ in range(2):
        env.step(int(np.flatnonzero(mask_of(env, env.agent_selection))[0]))
        images.append(env.render())
    assert all(image.shape == images[0].shape and image.dtype == np.uint8 for image in images)
    assert (images[0] != images[1]).any()
    assert (images[1] != images[2]).any()


def test_text_shows_the_heightmap_with_y_upwards() -> None:
    env = env_aec.env(render_mode="ansi", bin_size=(4, 3, 9), items=[[2, 1, 3], [1, 1, 2]])
    env.reset()
    env.step(0)
    env.step(1 * 3 + 0)
    assert env.render().splitlines() == [
        "1 boxes, utilization 5.6%",
        "item 1 x 1 x 2",
        "0 0 0 0",
        "0 0 0 0",
        "0 3 3 0",
    ]


def test_rendering_works_after_the_end_and_without_a_mode_it_warns() -> None:
    env = env_aec.env(render_mode="rgb_array")
    play(env, 0)
    assert env.render().ndim == 3
    silent = env_aec.raw_env()
    silent.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert silent.render() is None


def test_importing_the_package_needs_neither_trainer_nor_physics() -> None:
    import subprocess
    import sys

    code = (
        "import sys, marl_pack.env_aec; "
        "assert not {'rsl_rl', 'sapien', 'matplotlib.pyplot'} & set(sys.modules)"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        subprocess.run([sys.executable, "-c", code], check=True)


def test_every_orientation_is_named_by_its_row() -> None:
    env = env_aec.env(items=[[2, 3, 4], [1, 1, 1]])
    for o, permutation in enumerate(ORIENTATIONS):
        env.reset()
        env.step(o)
        lying = (env.state()[1:4, 0, 0] * 10).round().astype(int).tolist()
        assert lying == [(2, 3, 4)[axis] for axis in permutation]


def test_the_bin_of_the_environment_has_one_name() -> None:
    with pytest.raises(TypeError, match="did you mean 'bin_size'"):
        env_aec.raw_env((6, 6, 6), bin=(8, 8, 8))
