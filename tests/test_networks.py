"""The agents' networks: what they see, any bin size, shared trunks."""

import pytest
import torch

from marl_pack.agents import joint, orientation, placement
from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.networks.actor_critic import AGENTS, Actor, Critic, make_actor, make_critic
from marl_pack.agents.networks.trunk import PLANES, Network, Trunk, input_planes, widen
from marl_pack.game.packing import Packing

SMALL = {"channels": 8, "layers": 2, "hidden": 16, "planes": []}


def observed(agent: str, game: Packing, planes: tuple[str, ...]) -> dict[str, torch.Tensor]:
    critic = AfterstateCritic()
    if agent == "placement":
        chosen = game.orientation_mask.int().argmax(1)
        return placement.observe(game, planes, chosen, afterstates=critic)
    return (joint if agent == "joint" else orientation).observe(game, planes, critic)


@pytest.mark.parametrize("agent", AGENTS)
@pytest.mark.parametrize("planes", [(), PLANES])
def test_one_network_runs_on_any_bin_size(agent: str, planes: tuple[str, ...]) -> None:
    actor = make_actor(agent, {**SMALL, "planes": list(planes), "context": True}, "cpu")
    for size in ((5, 5, 5), (9, 6, 7), (24, 30, 20)):
        game = Packing(3, size, sides=(2, 4))
        seen = observed(agent, game, planes)
        actions = actor(seen, stochastic_output=True)
        assert actions.shape == (3, 1)
        assert seen["mask"].gather(1, actions.long()).all()
        assert actor.distribution.log_probs.shape == seen["mask"].shape


def test_the_planes_are_the_papers_four_channels_and_the_extra_ones() -> None:
    game = Packing(1, (4, 6, 8), [[2, 3, 4]] * 2)
    game.place(torch.tensor([0]), torch.tensor([0]))
    seen = orientation.observe(game, ())
    seen["item"] = torch.tensor([[2, 3, 4]])
    planes = input_planes(seen, [])
    assert planes.shape == (1, 4, 4, 6)
    assert planes[0, 0, 0, 0] == 4 / 8
    assert planes[0, 0, 3, 5] == 0
    assert planes[0, 1:, 2, 2].tolist() == [2 / 4, 3 / 6, 4 / 8]
    assert (planes[0, 1:] == planes[0, 1:, :1, :1]).all()
    game = Packing(2, (6, 6, 6), sides=(2, 4))
    seen = orientation.observe(game, PLANES, AfterstateCritic())
    assert input_planes(seen, list(PLANES)).shape == (2, 4 + 7 * 6 + 4, 6, 6)


def test_solid_are_the_columns_without_a_gap() -> None:
    # A box of 2 x 2 x 2, then a plank across it and beyond.
    game = Packing(1, (4, 2, 8), [[2, 2, 2], [3, 2, 1], [1, 1, 1]])
    game.place(torch.tensor([0]), torch.tensor([0]))
    game.place(torch.tensor([0]), torch.tensor([0]))
    solid = orientation.observe(game, ("solid",))["solid"]
    assert solid[0].tolist() == [[True, True], [True, True], [False, False], [True, True]]
    assert torch.equal(
        input_planes(orientation.observe(game, ("solid",)), ["solid"])[0, 4], solid[0].float()
    )


@pytest.mark.parametrize(("dilation", "far"), [(1, 3), (2, 5)])
def test_three_layers_look_as_far_as_their_dilation_lets_them(dilation: int, far: int) -> None:
    torch.manual_seed(0)
    trunk = Trunk(1, Network(channels=4, planes=[], dilation=dilation))
    seen = {
        "heightmap": torch.zeros(1, 15, 15),
        "item": torch.ones(1, 3),
        "height": torch.full((1, 1), 10),
    }
    flat = trunk(seen).whole
    seen["heightmap"][0, 7, 7] = 5
    changed = (trunk(seen).whole != flat).any(1)[0].nonzero()
    assert changed.min(0).values.tolist() == [7 - far, 7 - far]
    assert changed.max(0).values.tolist() == [7 + far, 7 + far]


def test_with_a_shortcut_the_heads_see_the_planes() -> None:
    game = Packing(3, seed=1)
    seen = orientation.observe(game, ("mask", "room"))
    network = Network(channels=4, layers=2, planes=["mask", "room"], shortcut=True)
    features = Trunk(6, network)(seen).whole
    planes = input_planes(seen, network.planes)
    assert features.shape == (3, 4 + 4 + 6 + 7, 10, 10)
    assert torch.equal(features[:, 4:], planes)


def test_room_is_seen_beside_the_most_there_is() -> None:
    game = Packing(4, seed=1)
    for _ in range(8):
        game.place(*make_policy("dblf")(game))
    seen = orientation.observe(game, ("room",))
    planes = input_planes(seen, ["room"])
    room, most = planes[:, 4:10], planes[:, 10]
    assert (room.flatten(1).amax(1) == 1).all()
    assert (room[~game.mask] == 0).all()
    best = game.room()[0].flatten(1).argmax(1)
    assert (room.flatten(1).gather(1, best[:, None]) == 1).all()
    assert torch.allclose(most[:, 0, 0], game.room()[0].flatten(1).amax(1).log1p() / 4)
    chosen = best // 100
    turned = input_planes(placement.observe(game, ("room",), chosen), ["room"])
    assert torch.equal(turned[:, 4], room[torch.arange(4), chosen])


def test_an_observation_does_not_change_when_the_game_goes_on() -> None:
    game = Packing(8, seed=1)
    seen = orientation.observe(game, PLANES, AfterstateCritic())
    kept = {name: values.clone() for name, values in seen.items()}
    for _ in range(30):
        o = game.orientation_mask.int().argmax(1)
        game.place(o, game.orient(o).mask.flatten(1).int().argmax(1))
    assert all(torch.equal(seen[name], kept[name]) for name in kept)


def pair(share: bool) -> tuple[Actor, Critic]:
    torch.manual_seed(0)
    arguments = {"agent": "placement", "network": {**SMALL, "share_trunk": share}}
    groups = {"actor": [], "critic": []}
    actor = Actor({}, groups, "actor", 1, **arguments)
    cnns = {"cnns": actor.cnns} if share else {}
    return actor, Critic({}, groups, "critic", 1, **arguments, **cnns)


def test_a_critic_that_shares_the_trunk_sees_the_features_of_the_moment() -> None:
    actor, critic = pair(share=True)
    game = Packing(4, (6, 6, 6), sides=(2, 3))
    first = observed("placement", game, ())
    other = dict(first, item=first["item"] + 1)
    actor(first)
    kept = critic(first)
    assert torch.equal(kept, critic(first)), "with and without the actor's features"
    actor(first)
    assert not torch.equal(critic(other), kept), "another observation is looked at anew"
    actor(first)
    critic(first)
    with torch.no_grad():
        for weight in actor.cnns.parameters():
            weight.mul_(0.5)
    assert not torch.equal(critic(first), kept), "changed weights are seen"


def test_a_shared_trunk_is_the_actors_alone_in_parameters_and_state() -> None:
    for share in (True, False):
        actor, critic = pair(share)
        own = {id(p) for p in actor.parameters()}
        assert not own & {id(p) for p in critic.parameters()}
        assert any(name.startswith("cnns.") for name in critic.state_dict()) != share


def test_a_critic_teaches_the_shared_trunk() -> None:
    actor, critic = pair(share=True)
    seen = observed("placement", Packing(4, (6, 6, 6), sides=(2, 3)), ())
    actor(seen, stochastic_output=True)
    critic(seen).sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in actor.cnns.parameters())


@pytest.mark.parametrize("wrong", [{"channels": 0}, {"layers": 0}, {"planes": ["depth"]},
                                   {"planes": ["mask", "mask"]}])  # fmt: skip
def test_an_impossible_network_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="network: "):
        Network(**wrong)


@pytest.mark.parametrize("agent", AGENTS)
@pytest.mark.parametrize("shortcut", [False, True])
@pytest.mark.parametrize("share", [False, True])
def test_a_widened_network_computes_what_it_did(agent: str, shortcut: bool, share: bool) -> None:
    shape = {**SMALL, "shortcut": shortcut, "context": True, "share_trunk": share}
    held = shape | {"planes": ["waste", "room"]}
    wanted = shape | {"planes": ["filled", "room", "mask", "waste"]}
    game = Packing(4, (6, 5, 7), sides=(2, 4))
    game.place(*make_policy("random", seed=0)(game))
    seen = observed(agent, game, PLANES)
    answers = []
    networks = []
    for network in (held, wanted):
        actor = make_actor(agent, network, "cpu")
        networks.append((actor, make_critic(agent, network, "cpu", actor)))
    for narrow, wide in zip(*networks, strict=True):
        weights = narrow.state_dict()
        shapes = Network(**held), Network(**wanted)
        wide.load_state_dict(widen(weights, *shapes, AGENTS[agent].WAYS))
    for actor, critic in networks:
        actor(seen, stochastic_output=True)
        answers.append((actor.output_distribution_params[0], critic(seen)))
    assert answers[0][1].std() > 0
    for narrow_answer, wide_answer in zip(*answers, strict=True):
        assert torch.allclose(narrow_answer, wide_answer, atol=1e-6)
