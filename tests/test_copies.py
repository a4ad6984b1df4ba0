"""Copies, pickles and branches continue exactly, and refused calls change nothing."""

import copy
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from marl_pack import env_aec
from marl_pack.backend import Backend
from marl_pack.game import packing
from marl_pack.game.packing import Packing
from marl_pack.vec_env import PackingVecEnv

COPIES: dict[str, Callable[[Any], Any]] = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda thing: pickle.loads(pickle.dumps(thing)),
}
every_copy = pytest.mark.parametrize("name", COPIES)

ATTRIBUTES = {
    "items": [[2, 3, 1], [1, 2, 2], [3, 1, 1], [2, 2, 2], [1, 1, 3]] * 3,
    "weights": [1.5, 2, 3, 0.7, 2.25] * 3,
    "orientations": [[0, 1], [0, 2, 4], [0, 1, 2, 3, 4, 5], [3], [5, 4]] * 3,
    "ids": list("abcde") * 3,
}
SMALL: dict[str, Any] = {"sides": (1, 3)}
GAMES: dict[str, dict[str, Any]] = {
    "rs": SMALL | {"rule": "lbcp", "com_offset": (0.1, 0, -0.2)},
    "cut": {"items": "cut2", "sides": (1, 3), "max_items": 5},
    "attributes": {"items": ATTRIBUTES, "rule": "equilibrium"},
    "unmasked": {  # the long item fits upright alone
        "items": [[2, 3, 1], [1, 1, 5], [2, 2, 2], [1, 1, 5], [3, 1, 1]] * 2,
        "mask_orientations": False,
        "rule": "none",
    },
}


# --- environments ---------------------------------------------------------------------------------


def plain(value: Any) -> Any:
    """Return a value in which arrays are lists, so that it can be compared."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return value.tolist() if isinstance(value, np.ndarray) else value


def mask_of(env: Any, agent: str) -> np.ndarray:
    return env.unwrapped.action_mask(agent)


def trace(env: Any, turns: int = 9) -> list[Any]:
    """What an environment shows while it is played at random, into its next episodes."""
    parallel = hasattr(env, "aec_env")
    generator, shown = np.random.default_rng(3), []
    raw = env.unwrapped
    if not hasattr(raw, "agent_selection"):
        env.reset(seed=8)
    for _ in range(turns):
        actions = {
            agent: int(generator.choice(np.flatnonzero(legal) if legal.any() else [0]))
            for agent in raw.agents
            for legal in [mask_of(env, agent)]
        }
        if not raw.agents:
            env.reset()
        elif parallel:
            shown.append(plain(env.step(actions)))
        else:
            agent = env.agent_selection
            shown.append(plain(env.last()))
            ended = env.terminations[agent] or env.truncations[agent]
            env.step(None if ended else actions[agent])
            shown.append(plain([env.rewards, env.infos, env.agents]))
        shown.append([plain(raw.state()), raw.plan, raw.utilization])
        shown.append([raw.action_space(agent).sample() for agent in env_aec.AGENTS])
    return shown


def first_legal(env: Any, turns: int) -> None:
    for _ in range(turns):
        raw = env.unwrapped
        acting = raw.agent_selection
        action = int(np.flatnonzero(mask_of(env, acting))[0])
        env.step(dict.fromkeys(raw.agents, action) if hasattr(env, "aec_env") else action)


def lose(env: Any) -> None:
    """Choose an orientation without a cell: a 1 × 1 × 2 item lies in a bin of one column."""
    env.reset(seed=1)
    env.step(5)


def to_the_end(env: Any) -> None:
    env.reset(seed=1, options={"items": [[2, 2, 2]]})
    first_legal(env, 2)
    for _ in range(2):
        env.step(None)


COLUMN = {
    "bin_size": (1, 1, 4), "items": [[1, 1, 2], [1, 1, 1]], "mask_orientations": False,
}  # fmt: skip
STATES: dict[str, tuple[Callable[[Any], None], dict[str, Any]]] = {
    "before the reset": (lambda env: None, {}),
    "after the reset": (lambda env: env.reset(seed=1), {}),
    "in the third episode": (lambda env: [env.reset(seed=1), env.reset(), env.reset()], {}),
    "between the agents": (lambda env: [env.reset(seed=1), first_legal(env, 3)], {}),
    "with items of its own": (
        lambda env: [env.reset(seed=1, options={"items": ATTRIBUTES}), first_legal(env, 1)], {},
    ),
    "after a termination": (
        lambda env: [env.reset(options={"items": [[2, 2, 2]]}), first_legal(env, 2)], {},
    ),
    "after a truncation": (
        lambda env: [env.reset(seed=1), first_legal(env, 4)], {"max_cycles": 2},
    ),
    "after the end": (to_the_end, {}),
    "after an orientation without a cell": (lose, COLUMN),
}  # fmt: skip


@every_copy
@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("kind", [env_aec.raw_env, env_aec.env])
def test_a_copied_environment_continues_exactly_and_shares_nothing(
    kind: Callable[..., Any], state: str, name: str
) -> None:
    prepare, options = STATES[state]
    arguments = SMALL | {"bin_size": (5, 4, 6), "render_mode": "human"} | options
    env, untouched = kind(**arguments), kind(**arguments)
    for each in (env, untouched):
        each.unwrapped._seed = 4  # what a first reset without a seed would draw
        for space in each.unwrapped.action_spaces.values():
            space.seed(2)
        each.unwrapped.render_mode = None
        prepare(each)
    copied = COPIES[name](env)
    assert str(copied) == str(env)
    expected = trace(untouched)
    assert trace(copied) == expected
    assert trace(env) == expected


@every_copy
@pytest.mark.parametrize("turns", [None, 0, 3])
@pytest.mark.parametrize("simultaneous", [False, True])
def test_a_copied_parallel_environment_continues_exactly(
    simultaneous: bool, turns: int | None, name: str
) -> None:
    arguments = SMALL | {"bin_size": (5, 4, 6), "illegal": "repair", "simultaneous": simultaneous}
    env, untouched = env_aec.parallel_env(**arguments), env_aec.parallel_env(**arguments)
    for each in (env, untouched):
        for space in each.unwrapped.action_spaces.values():
            space.seed(2)
        if turns is not None:
            each.reset(seed=1)
            first_legal(each, turns)
    copied = COPIES[name](env)
    expected = trace(untouched)
    assert trace(copied) == expected
    assert trace(env) == expected


def test_a_window_stays_with_the_environment_that_opened_it() -> None:
    env = env_aec.raw_env()
    env._window = object()
    assert all(COPIES[name](env)._window is None for name in COPIES)
    assert env._window is not None


@pytest.mark.parametrize("kind", [env_aec.raw_env, env_aec.env])
@pytest.mark.parametrize(
    "refused",
    [
        {"seed": 9, "options": {"items": [[2, 3, 11]]}},
        {"seed": 9, "options": {"items": [[1, 1, 1]]}},
        {"seed": 1.5}, {"seed": True}, {"seed": "3"}, {"seed": -1}, {"seed": 2**63},
        {"seed": 9, "options": [1]},
        {},
    ],
)  # fmt: skip
def test_a_refused_reset_changes_nothing(
    kind: Callable[..., Any], refused: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the margin 1, only items with sides ≥ 3 can begin: sequences 1 to 4 cannot."""
    monkeypatch.setattr(packing, "MOST_SKIPPED", 2)
    rows = [[[4, 4, 2], [3, 3, 3]], *([[[2, 2, 2]]] * 4)]
    env, untouched = (kind(items=rows, margin=1.0) for _ in range(2))
    for each in (env, untouched):
        for space in each.action_spaces.values():
            space.seed(2)
        each.reset(seed=1)
        first_legal(each, 1)
    with pytest.raises(ValueError) as error:  # noqa: PT011  # each has its own sentence
        env.reset(**refused)
    assert "\n" not in str(error.value)
    assert trace(env, 4) == trace(untouched, 4)
    assert env.unwrapped._seed == untouched.unwrapped._seed
    assert env.unwrapped._episode == untouched.unwrapped._episode


def test_a_first_reset_that_is_refused_does_not_count() -> None:
    env = env_aec.env()
    with pytest.raises(ValueError, match="whole number"):
        env.reset(seed=1.5)
    with pytest.raises(AttributeError, match="before reset"):
        env.agents  # noqa: B018
    with pytest.raises(AttributeError, match="before reset"):
        env.last()


# --- games ----------------------------------------------------------------------------------------


def choices(game: Packing, generator: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Choices that may be made, orientations without a cell included."""
    orientation, cell = np.zeros((2, game.n), np.int64)
    for g in range(game.n):
        draw = generator.random(2)
        may = np.flatnonzero(game.orientation_mask[g])
        orientation[g] = may[int(draw[0] * len(may))] if len(may) else 0
        legal = np.flatnonzero(game.mask[g, orientation[g]])
        cell[g] = legal[int(draw[1] * len(legal))] if len(legal) else 0
    return torch.from_numpy(orientation), torch.from_numpy(cell)


def steps(game: Packing, seed: int, count: int = 4) -> list[Any]:
    """The state, the moves and the outcomes of games that are played at random."""
    generator, shown = np.random.default_rng(seed), []
    for _ in range(count):
        outcome = game.place(*choices(game, generator))
        shown.append({k: v.tolist() for k, v in vars(outcome).items() if k != "volume"})
        shown.append([part.tolist() for part in (game.mask, game.orientation_mask, game.alive)])
        shown.append([game.t.tolist(), game.episode.tolist(), game.items.sides.tolist()])
        shown.append(game.plans())
    return shown


@every_copy
@pytest.mark.parametrize("backend", Backend)
@pytest.mark.parametrize("auto_reset", [True, False])
@pytest.mark.parametrize("settings", GAMES)
def test_copied_games_continue_exactly_and_share_nothing(
    settings: str, auto_reset: bool, backend: Backend, name: str
) -> None:
    for played in (0, 6):
        game, untouched = (
            Packing(3, (4, 4, 5), seed=7, auto_reset=auto_reset, backend=backend, **GAMES[settings])
            for _ in range(2)
        )
        assert steps(game, 1, played) == steps(untouched, 1, played)
        copied = COPIES[name](game)
        branch = game.branch(torch.arange(3))
        if played and settings == "unmasked" and not auto_reset:
            assert game.state.lost.any()
        begun = [copied, branch] if not auto_reset else [copied]
        expected = steps(untouched, 2)
        for other in (*begun, game):
            assert other.turn is not game.turn or other is game
            assert steps(other, 2) == expected
            other.reset()
        assert game.seed == copied.seed == branch.seed == 7
        assert torch.equal(game.items.sides, copied.items.sides)


@pytest.mark.parametrize("backend", Backend)
def test_a_branch_of_games_that_restart_is_equal_to_them_until_they_end(backend: Backend) -> None:
    game = Packing(8, (4, 4, 5), seed=7, backend=backend, **GAMES["unmasked"])
    steps(game, 1, 4)
    branch, generator = game.branch(torch.arange(8)), np.random.default_rng(5)
    ended = torch.zeros(8, dtype=torch.bool)
    for _ in range(5):
        chosen = choices(game, generator)
        mine = branch.place(*chosen, check=not ended.any())
        outcome = game.place(*chosen)
        assert torch.equal(mine.done[~ended], outcome.done[~ended])
        assert torch.equal(mine.reward[~ended], outcome.reward[~ended])
        ended |= outcome.done
        assert torch.equal(branch.alive, ~ended)
        assert torch.equal(branch.mask[~ended], game.mask[~ended])
    assert ended.any()


def test_games_with_items_of_a_file_need_it_no_longer(tmp_path: Path) -> None:
    path = tmp_path / "items.npz"
    np.savez(path, items=np.array([[[2, 1, 3], [3, 3, 3]], [[1, 2, 2], [2, 2, 2]]]))
    game, untouched = (Packing(2, (4, 4, 5), path) for _ in range(2))
    env = env_aec.raw_env(items=path)
    env.reset(seed=1)
    pickles = [pickle.dumps(game), pickle.dumps(env)]
    path.unlink()
    assert steps(pickle.loads(pickles[0]), 1) == steps(untouched, 1)
    first_legal(pickle.loads(pickles[1]), 2)


def test_games_that_were_played_without_gradients_are_copied() -> None:
    game = Packing(3, (4, 4, 5), seed=7, **SMALL)
    with torch.inference_mode():
        steps(game, 1)
    assert [steps(COPIES[name](game), 2) for name in COPIES] == [steps(game, 2)] * 3


def heights(game: Packing) -> dict[str, torch.Tensor]:
    return {"heightmap": game.bins.heightmap}


@every_copy
def test_a_copied_training_environment_plays_games_of_its_own(name: str) -> None:
    env = PackingVecEnv(Packing(3, (4, 4, 5), seed=7, **SMALL), heights)
    copied = COPIES[name](env)
    assert steps(copied.game, 1) == steps(env.game, 1)
    env.step(torch.stack(choices(env.game, np.random.default_rng(3)), 1))
    assert not torch.equal(copied.get_observations()["heightmap"], heights(env.game)["heightmap"])


def test_a_refused_reset_of_games_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packing, "MOST_SKIPPED", 2)
    rows = [[[4, 4, 2], [3, 3, 3], [3, 3, 3]], *([[[2, 2, 2]]] * 4)]
    game, untouched = (Packing(1, items=rows, margin=1.0) for _ in range(2))
    for refused in (
        {"seed": 1.5}, {"seed": 2**64}, {"first_episode": -1}, {"first_episode": 0.5},
        {"seed": 9, "first_episode": 1},
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"whole number|no episode can begin"):
            game.reset(**refused)
    assert game.seed == 0
    assert steps(game, 1, 2) == steps(untouched, 1, 2)
