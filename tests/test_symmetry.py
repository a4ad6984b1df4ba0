"""The bin's symmetries: mirrored play is play in the mirrored bin."""

from dataclasses import replace

import pytest
import torch
from conftest import mirrored, mirrored_map, put_boxes
from torch import Tensor

from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.networks.actor_critic import make_actor
from marl_pack.agents.networks.kinds import AGENT_KINDS, observe
from marl_pack.agents.networks.planes import PLANES
from marl_pack.agents.networks.shape import Network
from marl_pack.agents.networks.symmetry import (
    count,
    mean_probabilities,
    mirror_actions,
    mirror_observation,
)
from marl_pack.game.packing import Packing

SIZE = (6, 6, 8)
LOOKAHEAD = Lookahead(AfterstateCritic())


def played(size: tuple[int, int, int]) -> Packing:
    """Return games in which random play has placed five items."""
    game = Packing(64, size, sides=(1, 4), seed=5)
    policy = make_policy("random", 2)
    for _ in range(5):
        game.place(*policy(game))
    return game


def in_mirrored_bin(game: Packing, symmetry: int) -> Packing:
    """Return the same games in the mirrored bin: boxes mirrored, the same items, masks computed."""
    size = (game.size[1], game.size[0], game.size[2]) if symmetry & 4 else game.size
    other = Packing(game.n, size, sides=(1, 4), seed=5)
    put_boxes(other, mirrored(game.bins, symmetry))
    other.set_state(replace(other.state, items=game.items))
    return other


def observed(agent: str, game: Packing, orientation: Tensor) -> dict[str, Tensor]:
    """Return what the agent observes, the placement agent with these orientations."""
    before = (orientation,) if agent == "placement" else ()
    return observe(agent, game, tuple(PLANES), LOOKAHEAD, *before)


@pytest.mark.parametrize("symmetry", range(8))
@pytest.mark.parametrize("agent", AGENT_KINDS)
def test_a_transformed_observation_is_that_of_the_mirrored_bin(agent: str, symmetry: int) -> None:
    game = played(SIZE)
    other = in_mirrored_bin(game, symmetry)
    orientation, cell = make_policy("random", 3)(game)
    rotated = orientation ^ 1 if symmetry & 4 else orientation
    symmetries = torch.full((game.n,), symmetry)
    observation = observed(agent, game, orientation)
    expected = observed(agent, other, rotated)
    kind, action = AGENT_KINDS[agent], orientation
    if kind.acts_on_cells:
        action = cell if kind.orientations == 1 else game.floor.pair(orientation, cell)
    transformed = mirror_observation(observation, agent, symmetries)
    moved = mirror_actions(action[:, None], observation["item"], SIZE[:2], agent, symmetries)
    assert transformed.keys() == expected.keys()
    for name, values in expected.items():
        if name.endswith("afterstate_value"):  # sums in another order
            assert torch.allclose(transformed[name], values, atol=1e-5), name
        else:
            assert torch.equal(transformed[name], values), name
    if not kind.acts_on_cells:
        assert torch.equal(moved.squeeze(1), rotated)
        return
    # The box placed by the new action stands where the mirrored box would.
    new_cell = moved.squeeze(1) % game.floor.cells
    before, after = game.bins.heightmap.clone(), other.bins.heightmap.clone()
    game.place(orientation, cell)
    other.place(rotated, new_cell)
    going_on = (game.t > 0) & (other.t > 0)
    raised = mirrored_map(game.bins.heightmap - before, symmetry)
    assert going_on.any()
    assert torch.equal(raised[going_on], (other.bins.heightmap - after)[going_on])


def test_a_square_bin_has_eight_symmetries_and_another_one_four() -> None:
    assert [count(*size) for size in ((5, 5), (5, 7))] == [8, 4]


def test_a_bin_that_is_not_square_is_mirrored() -> None:
    game = played((7, 5, 8))
    observation = observed("orientation", game, torch.zeros(game.n, dtype=torch.int64))
    symmetry = torch.full((game.n,), 3)
    once = mirror_observation(observation, "orientation", symmetry)
    twice = mirror_observation(once, "orientation", symmetry)
    assert all(torch.equal(twice[name], observation[name]) for name in observation)


@pytest.mark.parametrize("agent", AGENT_KINDS)
@pytest.mark.parametrize("size", [SIZE, (7, 5, 8)])
def test_the_mean_over_the_symmetries_is_the_same_in_the_mirrored_bin(
    agent: str, size: tuple[int, int, int]
) -> None:
    torch.manual_seed(4)
    actor = make_actor(agent, vars(Network(channels=8, planes=list(PLANES))), "cpu")
    with torch.no_grad():  # else the heads begin with nearly even odds
        for weight in actor.mlp.parameters():
            weight.normal_()
    game = played(size)
    orientation, _ = make_policy("random", 3)(game)
    observation = observed(agent, game, orientation)
    here = mean_probabilities(actor, observation, agent)
    assert torch.allclose(here.sum(1), torch.ones(game.n))
    legal = observation["mask"]
    assert (here[~legal] == 0).all()
    assert not torch.allclose(here, actor.log_probs(observation).exp(), atol=0.01)
    actions = torch.arange(here.shape[1]).expand(game.n, -1)
    for symmetry in range(count(*size[:2])):
        kinds = torch.full((game.n,), symmetry)
        there = mean_probabilities(actor, mirror_observation(observation, agent, kinds), agent)
        moved = mirror_actions(actions, observation["item"], size[:2], agent, kinds)
        assert torch.allclose(there.gather(1, moved)[legal], here[legal], atol=1e-5)
