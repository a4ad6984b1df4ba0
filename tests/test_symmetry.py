"""Augmentation by the bin's symmetries: transformed play is play in the transformed bin."""

import pytest
import torch
from torch import Tensor

from marl_pack.agents import joint, orientation, placement
from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.learning.symmetry import carry, count, mean_probabilities, see, transform
from marl_pack.agents.networks.actor_critic import make_actor
from marl_pack.agents.networks.trunk import PLANES, Network
from marl_pack.game.packing import Packing

SIZE = (6, 6, 8)
CRITIC = AfterstateCritic()


def played(size: tuple[int, int, int]) -> Packing:
    game = Packing(64, size, sides=(1, 4), seed=5)
    policy = make_policy("random", 2)
    for _ in range(5):
        game.place(*policy(game))
    return game


def mirrored_map(heightmap: Tensor, symmetry: int) -> Tensor:
    if symmetry & 1:
        heightmap = heightmap.flip(1)
    if symmetry & 2:
        heightmap = heightmap.flip(2)
    return heightmap.transpose(1, 2) if symmetry & 4 else heightmap


def in_mirrored_bin(game: Packing, symmetry: int) -> Packing:
    """The same game in the mirrored bin: maps mirrored, the same items, masks made anew."""
    size = (game.size[1], game.size[0], game.size[2]) if symmetry & 4 else game.size
    other = Packing(game.n, size, sides=(1, 4), seed=5)
    other.bins.heightmap.copy_(mirrored_map(game.bins.heightmap, symmetry))
    other.bins.empty_map.copy_(mirrored_map(game.bins.empty_map, symmetry))
    other.bins.filled.copy_(game.bins.filled)
    other.items, other.weights = game.items, game.weights
    other._look()
    return other


def observed(agent: str, game: Packing, chosen: Tensor) -> dict[str, Tensor]:
    """What the agent sees, the placement agent with these orientations."""
    if agent == "placement":
        return placement.observe(game, PLANES, chosen, afterstates=CRITIC)
    return {"orientation": orientation, "joint": joint}[agent].observe(game, PLANES, CRITIC)


@pytest.mark.parametrize("symmetry", range(8))
@pytest.mark.parametrize("agent", ["orientation", "placement", "joint"])
def test_a_transformed_observation_is_that_of_the_mirrored_bin(agent: str, symmetry: int) -> None:
    game = played(SIZE)
    other = in_mirrored_bin(game, symmetry)
    chosen, cell = make_policy("random", 3)(game)
    turned = chosen ^ 1 if symmetry & 4 else chosen
    cells = SIZE[0] * SIZE[1]
    kinds = torch.full((game.n,), symmetry)
    seen, expected = observed(agent, game, chosen), observed(agent, other, turned)
    action = {"orientation": chosen, "placement": cell, "joint": chosen * cells + cell}[agent]
    moved, new = transform(seen, action[:, None].float(), agent, kinds)
    for name, values in expected.items():
        if name.endswith("worth"):  # sums in another order
            assert torch.allclose(moved[name], values, atol=1e-5), name
        else:
            assert torch.equal(moved[name], values), name
    if agent == "orientation":
        assert torch.equal(new.squeeze(1).long(), turned)
        return
    # The box set down by the new action stands where the mirrored box would.
    place = new.squeeze(1).long() % cells
    before, after = game.bins.heightmap.clone(), other.bins.heightmap.clone()
    game.place(chosen, cell)
    other.place(turned, place)
    going_on = (game.t > 0) & (other.t > 0)
    raised = mirrored_map(game.bins.heightmap - before, symmetry)
    assert going_on.any()
    assert torch.equal(raised[going_on], (other.bins.heightmap - after)[going_on])


def test_a_bin_that_is_not_square_is_mirrored() -> None:
    game = played((7, 5, 8))
    seen = orientation.observe(game, PLANES, CRITIC)
    action = torch.zeros(game.n, 1)
    twice, _ = transform(
        *transform(seen, action, "orientation", torch.full((game.n,), 3)),
        "orientation",
        torch.full((game.n,), 3),
    )
    assert all(torch.equal(twice[name], seen[name]) for name in seen)


@pytest.mark.parametrize("agent", ["orientation", "placement", "joint"])
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
    chosen, _ = make_policy("random", 3)(game)
    seen = observed(agent, game, chosen)
    here = mean_probabilities(actor, seen, agent)
    assert torch.allclose(here.sum(1), torch.ones(game.n))
    assert (here[~seen["mask"]] == 0).all()
    assert not torch.allclose(here, actor.log_probs(seen).exp(), atol=0.01)
    actions = torch.arange(here.shape[1]).expand(game.n, -1)
    for symmetry in range(count(*size[:2])):
        kinds = torch.full((game.n,), symmetry)
        there = mean_probabilities(actor, see(seen, agent, kinds), agent)
        moved = carry(actions, seen["item"], size[:2], agent, kinds)
        assert torch.allclose(there.gather(1, moved)[seen["mask"]], here[seen["mask"]], atol=1e-5)
