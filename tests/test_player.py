"""A loaded player plays many games at once, and the environment turn by turn."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from pettingzoo import AECEnv
from small_runs import PLAIN_NETWORK

from marl_pack import Packing, Player, SearchSettings, env, load, parallel_env
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.learned import JointPolicy, LearnedAgent
from marl_pack.agents.networks.actor_critic import make_actor

OTHER = {"pad_actions": True, "mask_in": "info", "margin": 0.2, "orientations": (0, 2, 3)}


def joint() -> Player:
    torch.manual_seed(1)
    actor = make_actor("joint", PLAIN_NETWORK | {"channels": 4, "layers": 1}, "cpu").eval()
    for weight in actor.mlp.parameters():
        weight.data.mul_(30)  # else a fresh network is almost uniform
    return Player(JointPolicy(LearnedAgent("joint", actor, Lookahead())))


PLAYERS: dict[str, Callable[[], Player]] = {
    "dblf": partial(load, "dblf"),
    "random": partial(load, "random", seed=5),
    "rs": partial(load, "rs"),
    "symmetric": partial(load, "cut_2", symmetric=True),
    "search": partial(load, "rs", search=SearchSettings(rollouts=2, top=2, depth=1)),
    "joint": joint,
}


def packed(player: Player, seed: int, **options: Any) -> list[list[int]]:
    """The boxes that the player places in a game of many at once."""
    game = Packing(1, seed=seed, auto_reset=False, **options)
    while bool(game.alive):
        game.place(*player(game))
    return game.plans()[0].boxes.tolist()


@pytest.mark.parametrize("options", [{"margin": 0.0}, OTHER], ids=str)
@pytest.mark.parametrize("name", PLAYERS)
def test_in_the_environment_a_player_packs_as_in_a_game(name: str, options: dict[str, Any]) -> None:
    rules = {key: value for key, value in options.items() if key in ("margin", "orientations")}
    expected = packed(PLAYERS[name](), 7, items="cut2", **rules)
    player = PLAYERS[name]()
    for make in (env, parallel_env):
        player = PLAYERS[name]()
        view = make(items="cut2", **options)
        view.reset(seed=7)
        while view.agents:
            view.step(player.act(view))
        assert view.unwrapped.plan.boxes.tolist() == expected
    assert len(expected) > 5


@pytest.mark.parametrize("name", PLAYERS)
def test_the_item_is_placed_in_the_orientation_that_somebody_else_chose(name: str) -> None:
    view, player, random = env(illegal="repair"), PLAYERS[name](), load("random", seed=3)
    view.reset(seed=2)
    while view.agents:
        if view.agent_selection == "orientation_0":
            view.step(random.act(view))
            continue
        legal = view.unwrapped.action_mask("placement_0")
        orientation = view.unwrapped.chosen
        action = player.act(view)
        assert action is None or legal[action]
        view.step(action)
        assert action is None or view.unwrapped.plan.orientations[-1] == orientation


def test_both_agents_act_at_once_where_the_environment_wants_it() -> None:
    view, player = parallel_env(simultaneous=True, illegal="repair"), load("height_min")
    view.reset(seed=1)
    while view.agents:
        view.step(player.act(view))
    assert view.unwrapped.plan.boxes.tolist() == packed(player, 1)


def test_a_player_names_what_it_cannot_play() -> None:
    player = load("dblf")
    for other in (AECEnv(), object(), None, Packing(1)):
        with pytest.raises(ValueError, match=r"act: needs an environment of marl_pack\.env_aec"):
            player.act(other)
    with pytest.raises(ValueError, match=r"no agent is left to act: .* reset\(\)"):
        player.act(env())


@pytest.mark.parametrize(("options", "message"), [
    ({"source": "dbfl"}, r"'dbfl': needs one of dblf, .*, rs, .* did you mean 'dblf'\?"),
    ({"source": 3}, "policy 3: needs a name or a path"),
    ({"source": "dblf", "symmetric": True}, "need a learned policy, not dblf"),
    ({"source": "rs", "search": 16}, "search = 16: needs SearchSettings"),
    ({"source": "rs", "seed": -1}, "seed"),
    ({"source": "rs", "device": "abacus"}, "device 'abacus'"),
    ({"source": "most_room"}, "'most_room' is now called 'max_feasible'"),
])  # fmt: skip
def test_what_cannot_be_loaded_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load(**options)
