"""The agents' networks: their inputs, any bin size, shared trunks, and the kinds of agents."""

import math

import pytest
import torch
from conftest import in_play
from torch import Tensor

from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.afterstates.limits import ILLEGAL
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.networks.actor_critic import Actor, Critic, make_actor, make_critic
from marl_pack.agents.networks.kinds import AGENT_KINDS, Choice, observe
from marl_pack.agents.networks.planes import (
    PLANES,
    channel_names,
    encode_observation,
    input_channels,
)
from marl_pack.agents.networks.shape import Network
from marl_pack.agents.networks.symmetry import mirror_actions, mirror_observation
from marl_pack.agents.networks.trunk import Trunk, widen
from marl_pack.game.packing import Packing
from marl_pack.geometry import ORIENTATIONS

ALL_PLANES = tuple(PLANES)
SMALL = {"channels": 8, "layers": 2, "hidden": 16, "planes": []}
PAPER = {"heightmap", "item", "height", "mask"}


def first_orientation(game: Packing, agent: str) -> Choice:
    """Return the choices before the agent's turn: the first legal orientation, or nothing."""
    return (game.orientation_mask.int().argmax(1),) if agent == "placement" else ()


def observed(
    agent: str, game: Packing, planes: tuple[str, ...], *orientation: Tensor
) -> dict[str, Tensor]:
    """Return what an agent observes with a lookahead of its own."""
    before = orientation or first_orientation(game, agent)
    return observe(agent, game, planes, Lookahead(AfterstateCritic()), *before)


@pytest.mark.parametrize("agent", AGENT_KINDS)
@pytest.mark.parametrize("planes", [(), ALL_PLANES])
def test_one_network_runs_on_any_bin_size(agent: str, planes: tuple[str, ...]) -> None:
    actor = make_actor(agent, {**SMALL, "planes": list(planes), "context": True}, "cpu")
    for size in ((5, 5, 5), (9, 6, 7), (24, 30, 20)):
        observation = observed(agent, Packing(3, size, sides=(2, 4)), planes)
        actions = actor(observation, stochastic_output=True)
        assert actions.shape == (3, 1)
        assert observation["mask"].gather(1, actions.long()).all()
        assert actor.distribution.log_probs.shape == observation["mask"].shape


def test_the_input_is_the_papers_four_channels_and_those_of_the_planes() -> None:
    game = Packing(1, (4, 6, 8), [[2, 3, 4]] * 2)
    game.place(torch.tensor([0]), torch.tensor([0]))
    observation = observed("orientation", game, ())
    observation["item"] = torch.tensor([[2, 3, 4]])
    channels = input_channels(observation, [])
    assert channels.shape == (1, 4, 4, 6)
    assert channels[0, 0, 0, 0] == 4 / 8
    assert channels[0, 0, 3, 5] == 0
    assert channels[0, 1:, 2, 2].tolist() == [2 / 4, 3 / 6, 4 / 8]
    assert (channels[0, 1:] == channels[0, 1:, :1, :1]).all()
    observation = observed("orientation", Packing(2, (6, 6, 6), sides=(2, 4)), ALL_PLANES)
    count = 4 + sum(PLANES[name].channels(6) for name in ALL_PLANES)
    assert input_channels(observation, ALL_PLANES).shape == (2, count, 6, 6)


@pytest.mark.parametrize("agent", AGENT_KINDS)
def test_every_kind_of_agent_keeps_the_contract(agent: str) -> None:
    """K actions are masked and scored, place an item, and mirroring twice changes nothing."""
    kind = AGENT_KINDS[agent]
    assert kind.name == agent
    game = Packing(6, (6, 5, 7), sides=(2, 4), seed=1)
    game.place(*make_policy("random", 0)(game))
    before = first_orientation(game, agent)
    observation = observed(agent, game, ALL_PLANES, *before)
    cells = 6 * 5 if kind.acts_on_cells else 1
    actions = (6 if not before else 1) * cells  # K
    assert kind.orientations == (1 if before else 6)
    assert observation["mask"].shape == (6, actions)
    assert observation["mask"].dtype == torch.bool
    trunk = Trunk(kind.orientations, Network(**SMALL))
    assert kind.head(Network(**SMALL))(trunk(observation)).shape == (6, actions)
    action = observation["mask"].int().argmax(1)
    for symmetry in range(4):
        bits = torch.full((6,), symmetry)
        once = mirror_observation(observation, agent, bits)
        there = mirror_actions(action[:, None], observation["item"], (6, 5), agent, bits)
        assert once["mask"].gather(1, there).all(), "the moved action is legal"
        twice = mirror_observation(once, agent, bits)
        assert torch.equal(mirror_actions(there, once["item"], (6, 5), agent, bits)[:, 0], action)
        assert observation.keys() == twice.keys()
        assert all(torch.equal(twice[name], observation[name]) for name in observation)
    choice = kind.extend(before, action, game.floor)
    if len(choice) == 1:  # the placement agent takes its turn
        choice = (*choice, game.moves.of(*choice).flatten(1).int().argmax(1))
    count = game.bins.count.clone()
    orientation, cell = choice
    outcome = game.place(orientation, cell)  # raises if it is not legal
    assert torch.equal(outcome.placed, count + 1)


@pytest.mark.parametrize("agent", AGENT_KINDS)
@pytest.mark.parametrize("name", PLANES)
def test_every_plane_keeps_the_contract_alone(name: str, agent: str) -> None:
    """Shapes say what a tensor describes; the channels are as many as the record says."""
    plane, orientations = PLANES[name], AGENT_KINDS[agent].orientations
    assert plane.name == name
    assert plane.meaning
    game = Packing(5, (6, 5, 7), sides=(2, 4), seed=3)
    observation = observed(agent, game, (name,))
    tensors = {key: values for key, values in observation.items() if key not in PAPER}
    assert tensors
    columns, numbers, placements = (5, 6, 5), (5, 1), (5, orientations, 6, 5)
    for key, values in tensors.items():
        assert tuple(values.shape) in (columns, numbers, placements), key
    count = plane.channels(orientations)
    assert channel_names([name], orientations)[4:] == [(name, k) for k in range(count)]
    channels = input_channels(observation, [name])
    assert channels.shape == (5, 4 + count, 6, 5)
    assert channels.dtype == torch.float32
    assert channels.isfinite().all()
    mirrored = mirror_observation(observation, agent, torch.full((5,), 3))
    assert mirrored.keys() == observation.keys()
    assert input_channels(mirrored, [name]).shape == channels.shape


def test_waste_and_resting_height_are_those_of_the_item_in_its_orientation() -> None:
    # On a block of 1 x 2 x 2 at x = 0, an item of 2 x 2 x 1 rests at 2 and encloses 4 cells.
    game = Packing(1, (4, 2, 8), [[1, 2, 2], [2, 2, 1], [1, 1, 1]], rule="none")
    game.place(torch.tensor([0]), torch.tensor([0]))
    planes = ("resting_height", "waste")
    for agent, *chosen in (("placement", torch.tensor([0])), ("orientation",)):
        observation = observed(agent, game, planes, *chosen)
        assert observation["waste"][0, 0, :3, 0].tolist() == [4, 0, 0]
        assert observation["resting_height"][0, 0, :3, 0].tolist() == [2, 0, 0]
    channels = input_channels(observation, planes)
    assert channels[0, 4, 0, 0] == 2 / 8
    assert channels[0, 10, 0, 0] == 4 / 5


def test_the_placement_agent_sees_the_item_as_it_is_oriented() -> None:
    planes = ("mask", "resting_height", "waste")
    game = in_play(4, 5, bin=(5, 6, 8), sides=(1, 3))
    before = observed("orientation", game, planes)
    for o, axes in enumerate(ORIENTATIONS):
        observation = observed("placement", game, planes, torch.full((4,), o))
        assert torch.equal(observation["item"], game.items.sides[:, list(axes)])
        for name in ("legal_cells", "resting_height", "waste"):
            assert torch.equal(observation[name][:, 0], before[name][:, o])


def test_grounded_are_the_columns_without_a_gap() -> None:
    # A box of 2 x 2 x 2, then a plank across it and beyond.
    game = Packing(1, (4, 2, 8), [[2, 2, 2], [3, 2, 1], [1, 1, 1]])
    game.place(torch.tensor([0]), torch.tensor([0]))
    game.place(torch.tensor([0]), torch.tensor([0]))
    observation = observed("orientation", game, ("grounded",))
    grounded = observation["grounded"]
    assert grounded[0].tolist() == [[True, True], [True, True], [False, False], [True, True]]
    assert torch.equal(input_channels(observation, ["grounded"])[0, 4], grounded[0].float())


def test_three_layers_without_context_reach_three_cells_far() -> None:
    torch.manual_seed(0)
    trunk = Trunk(1, Network(channels=4, planes=[], shortcut=False, context=False))
    observation = {
        "heightmap": torch.zeros(1, 15, 15),
        "item": torch.ones(1, 3),
        "height": torch.full((1, 1), 10),
    }
    flat = trunk(observation).cells
    observation["heightmap"][0, 7, 7] = 5
    changed = (trunk(observation).cells != flat).any(1)[0].nonzero()
    assert changed.min(0).values.tolist() == [4, 4]
    assert changed.max(0).values.tolist() == [10, 10]


def test_with_a_shortcut_the_heads_see_the_input_channels() -> None:
    observation = observed("orientation", Packing(3, seed=1), ("mask", "feasible_cells"))
    network = Network(channels=4, layers=2, planes=["mask", "feasible_cells"], shortcut=True)
    features = Trunk(6, network)(observation)
    assert features.cells.shape == (3, 4, 10, 10)
    assert torch.equal(features.inputs, input_channels(observation, network.planes))
    mean, most = features.pooled.chunk(2, 1)
    whole = torch.cat((features.cells, features.inputs), 1)
    assert whole.shape == (3, 4 + 4 + 6 + 7, 10, 10)
    assert torch.allclose(mean, whole.mean((2, 3)), atol=1e-6)
    assert torch.equal(most, whole.amax((2, 3)))
    head = AGENT_KINDS["joint"].head(network)
    assert torch.allclose(head(features), head.scores(whole).flatten(1), atol=1e-6)


def test_a_network_computes_the_same_from_an_encoded_observation() -> None:
    for agent, kind in AGENT_KINDS.items():
        observation = observed(agent, Packing(3, seed=1), ALL_PLANES)
        trunk = Trunk(kind.orientations, Network(planes=list(ALL_PLANES)))
        features, again = trunk(observation), trunk(encode_observation(observation, ALL_PLANES))
        assert torch.equal(features.cells, again.cells), agent
        assert torch.equal(features.inputs, again.inputs), agent


def test_feasible_cells_are_observed_relative_to_the_best_placement() -> None:
    game = Packing(4, seed=1)
    for _ in range(8):
        game.place(*make_policy("dblf")(game))
    cells = Lookahead().feasible_cells(game)
    observation = observed("orientation", game, ("feasible_cells",))
    channels = input_channels(observation, ["feasible_cells"])
    near, most = channels[:, 4:10], channels[:, 10]
    assert (near.flatten(1).amax(1) == 1).all()
    assert (near[~game.mask] == 0).all()
    best = cells.flatten(1).argmax(1)
    assert (near.flatten(1).gather(1, best[:, None]) == 1).all()
    assert torch.allclose(most[:, 0, 0], cells.flatten(1).amax(1).log1p() / 4)
    orientation, _ = game.floor.split(best)
    observation = observed("placement", game, ("feasible_cells",), orientation)
    oriented = input_channels(observation, ["feasible_cells"])
    assert torch.equal(oriented[:, 4], near[torch.arange(4), orientation])


def encoded(name: str, **observation: object) -> list[list[float]]:
    """Return the channels of one plane, from rows of a 1 × D floor, as rows."""
    tensors = {key: torch.tensor(value) for key, value in observation.items()}
    channels = PLANES[name].encode({"heightmap": torch.zeros(1, 1, 4), **tensors})
    return torch.cat(channels, 1)[0].flatten(1).tolist()


def test_values_are_seen_as_what_they_lack_of_the_best() -> None:
    channels = encoded(
        "afterstate_value", afterstate_value=[[[[0.5, 0.4975, 0.475, ILLEGAL]]]],
        best_afterstate_value=[[0.5]],
    )  # fmt: skip
    expected = [[1, 0.95, 0.5, 0], [1, 0.5, 0, 0], [0.5] * 4]
    assert channels == [pytest.approx(row, abs=1e-5) for row in expected]


def test_a_cell_that_is_not_legal_is_never_near_the_most_feasible_cells() -> None:
    channels = encoded(
        "feasible_cells", feasible_cells=[[[[0.0, 0.1, 0.05, 0.0]]]], most_feasible_cells=[[0.1]]
    )
    near = 1 + 5 * (math.log1p(0.05) - math.log1p(0.1))
    assert channels[0] == pytest.approx([0, 1, near, 0], abs=1e-5)


def test_waste_is_a_share_of_the_item_and_finite_without_one() -> None:
    row = [[[[7, 0, 14, 1]]]]
    assert encoded("waste", waste=row, item=[[1, 2, 3]])[0] == pytest.approx([1, 0, 2, 1 / 7])
    assert encoded("waste", waste=row, item=[[0, 0, 0]])[0] == pytest.approx([7, 0, 14, 1])


def test_a_game_that_has_ended_has_the_best_value_zero() -> None:
    game = Packing(2, (4, 4, 4), [[4, 4, 2], [4, 4, 4]], auto_reset=False)
    game.place(torch.zeros(2, dtype=torch.int64), torch.zeros(2, dtype=torch.int64))
    assert not game.alive.any()
    observation = observed("orientation", game, ("afterstate_value",))
    assert observation["best_afterstate_value"].tolist() == [[0.0], [0.0]]
    assert input_channels(observation, ["afterstate_value"]).abs().max() <= 1


def test_the_orientation_agent_observes_what_may_be_chosen() -> None:
    game = Packing(1, (1, 1, 3), [[1, 1, 2], [1, 1, 1]], mask_orientations=False)
    assert observed("orientation", game, ())["mask"].all()
    assert not game.moves.orientations.all()


ONLY_TWO: list[dict[str, object]] = [
    {"orientations": [0, 4]}, {"items": {"items": [[2, 3, 4]], "orientations": [[0, 4]]}}
]  # fmt: skip


@pytest.mark.parametrize("options", ONLY_TWO)
def test_planes_show_nothing_of_orientations_that_are_barred(options: dict[str, object]) -> None:
    game = Packing(4, **{"items": [[2, 3, 4]]} | options)
    game.bins.heightmap.fill_(2)
    game.bins.heightmap[:, 3, 3] = 5
    observation = observed("orientation", game, ("resting_height", "waste"))
    for name in ("resting_height", "waste"):
        shown = observation[name].flatten(2).amax(2) != observation[name].flatten(2).amin(2)
        assert shown.tolist() == [[True, False, False, False, True, False]] * 4, name


@pytest.mark.parametrize("agent", AGENT_KINDS)
def test_a_new_agent_is_nearly_indifferent(agent: str) -> None:
    game = Packing(4, seed=1)
    torch.manual_seed(0)
    actor = make_actor(agent, SMALL, "cpu")
    observation = observed(agent, game, ())
    probability, mask = actor.log_probs(observation).exp(), observation["mask"]
    uniform = mask / mask.sum(1, keepdim=True)
    assert torch.allclose(probability, uniform, rtol=0.05, atol=1e-6)


def test_an_observation_does_not_change_when_the_game_goes_on() -> None:
    game = Packing(8, seed=1)
    observation = observed("orientation", game, ALL_PLANES)
    copies = {name: values.clone() for name, values in observation.items()}
    for _ in range(30):
        o = game.orientation_mask.int().argmax(1)
        game.place(o, game.orient(o).mask.flatten(1).int().argmax(1))
    assert all(torch.equal(observation[name], copies[name]) for name in copies)


def actor_and_critic() -> tuple[Actor, Critic]:
    """Build the placement agent's networks."""
    torch.manual_seed(0)
    actor = make_actor("placement", SMALL, "cpu")
    return actor, make_critic("placement", SMALL, "cpu", actor)


def test_a_critic_that_shares_the_trunk_sees_the_current_features() -> None:
    actor, critic = actor_and_critic()
    first = observed("placement", Packing(4, (6, 6, 6), sides=(2, 3)), ())
    other = dict(first, item=first["item"] + 1)
    actor(first)
    value = critic(first)
    assert torch.equal(value, critic(first)), "with and without the actor's features"
    actor(first)
    assert not torch.equal(critic(other), value), "another observation gets its own features"
    actor(first)
    critic(first)
    with torch.no_grad():
        for weight in actor.cnns.parameters():
            weight.mul_(0.5)
    assert not torch.equal(critic(first), value), "changed weights are seen"


def test_a_shared_trunk_is_the_actors_alone_in_parameters_and_state() -> None:
    actor, critic = actor_and_critic()
    own = {id(p) for p in actor.parameters()}
    assert not own & {id(p) for p in critic.parameters()}
    assert not any(name.startswith("cnns.") for name in critic.state_dict())


def test_a_critic_trains_the_shared_trunk() -> None:
    actor, critic = actor_and_critic()
    observation = observed("placement", Packing(4, (6, 6, 6), sides=(2, 3)), ())
    actor(observation, stochastic_output=True)
    critic(observation).sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in actor.cnns.parameters())


@pytest.mark.parametrize("wrong", [{"channels": 0}, {"layers": 0}, {"planes": ["depth"]},
                                   {"planes": ["mask", "mask"]}])  # fmt: skip
def test_an_impossible_network_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="network: "):
        Network(**wrong)


@pytest.mark.parametrize(("old", "new"), [
    ("rest", "resting_height"), ("room", "feasible_cells"), ("fits", "feasible_probability"),
    ("worth", "afterstate_value"), ("solid", "grounded"),
])  # fmt: skip
def test_a_plane_by_its_old_name_is_refused_with_the_new_one(old: str, new: str) -> None:
    with pytest.raises(ValueError, match=f"network: plane '{old}' is now called '{new}'"):
        Network(planes=["mask", old])
    assert Network(planes=["mask", new]).planes == ["mask", new]


@pytest.mark.parametrize("agent", AGENT_KINDS)
@pytest.mark.parametrize("shortcut", [False, True])
def test_a_widened_network_computes_the_same(agent: str, shortcut: bool) -> None:
    shape = {**SMALL, "shortcut": shortcut, "context": True}
    narrow = shape | {"planes": ["waste", "feasible_cells"]}
    wide = shape | {"planes": ["filled", "feasible_cells", "mask", "waste"]}
    game = Packing(4, (6, 5, 7), sides=(2, 4))
    game.place(*make_policy("random", seed=0)(game))
    observation = observed(agent, game, ALL_PLANES)
    networks = []
    for network in (narrow, wide):
        actor = make_actor(agent, network, "cpu")
        networks.append((actor, make_critic(agent, network, "cpu", actor)))
    shapes = Network(**narrow), Network(**wide)
    for old, new in zip(*networks, strict=True):
        weights = widen(old.state_dict(), *shapes, AGENT_KINDS[agent].orientations)
        new.load_state_dict(weights)
    outputs = []
    for actor, critic in networks:
        actor(observation, stochastic_output=True)
        outputs.append((actor.output_distribution_params[0], critic(observation)))
    assert outputs[0][1].std() > 0
    for old_output, new_output in zip(*outputs, strict=True):
        assert torch.allclose(old_output, new_output, atol=1e-6)
