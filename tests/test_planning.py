"""Planning: imagined games are real ones, futures are drawn, and looking ahead pays."""

from typing import Any

import pytest
import torch
from torch import Tensor

from marl_pack.agents import search
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.learning.checkpoint import learned_orientation_agent, learned_placement_agent
from marl_pack.agents.networks.actor_critic import Actor, make_actor, make_critic
from marl_pack.agents.policy import Policy, in_turns
from marl_pack.agents.search import Plan, Planner
from marl_pack.evaluate import play
from marl_pack.game.packing import Packing
from marl_pack.items import make_stream

SIZE = (6, 6, 6)
NETWORK = {"channels": 8, "layers": 2}
FUTURES = make_stream("rs", SIZE, (1, 3))


def game(n: int, first_episode: int = 0, **options: Any) -> Packing:
    given = {"sides": (1, 3), "auto_reset": False, "seed": 4} | options
    return Packing(n, SIZE, first_episode=first_episode, **given)


@pytest.fixture(scope="module")
def agents() -> tuple[Actor, Actor]:
    torch.manual_seed(0)
    first, second = (
        make_actor(name, NETWORK, "cpu").eval() for name in ("orientation", "placement")
    )
    return first, second


def utilization(policy: Policy, episodes: int = 24) -> float:
    return float(play(policy, game, episodes).utilization.mean())


def test_a_branch_plays_on_like_the_game_it_comes_from() -> None:
    policy = make_policy("dblf")
    whole = game(5)
    for _ in range(6):
        whole.place(*policy(whole))
    kept = whole.state_dict()
    which = torch.tensor([3, 1, 3])
    part = whole.branch(which)
    for _ in range(4):
        part.place(*policy(part))
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, kept[name]), name
    for _ in range(4):
        whole.place(*policy(whole))
    assert torch.equal(part.bins.heightmap, whole.bins.heightmap[which])
    assert torch.equal(part.items, whole.items[which])
    assert torch.equal(part.alive, whole.alive[which])


def test_a_branch_sees_its_item_and_then_another_stream() -> None:
    whole = game(2)
    whole.place(*make_policy("dblf")(whole))
    stream = make_stream([[1, 1, 1], [2, 2, 2], [3, 3, 3]], SIZE)
    part = whole.branch(torch.tensor([0, 0]), stream, seed=0, episodes=torch.tensor([0, 0]))
    assert torch.equal(part.items[0], whole.items[0])
    part.place(*make_policy("dblf")(part))
    assert part.items.tolist() == [[3, 3, 3], [3, 3, 3]]


def test_planning_beats_the_same_agents_without(agents: tuple[Actor, Actor]) -> None:
    alone = in_turns(learned_orientation_agent(agents[0]), learned_placement_agent(agents[1]))
    planner = Planner(*agents, None, Plan(rollouts=3, top=6), FUTURES)
    assert utilization(planner) > utilization(alone) + 0.03


def test_a_critic_may_value_the_futures(agents: tuple[Actor, Actor]) -> None:
    asked: list[int] = []

    class Told(torch.nn.Module):
        """Says that flat tops are worth more."""

        def forward(self, seen: dict[str, Tensor]) -> Tensor:
            asked.append(len(seen["item"]))
            return -seen["heightmap"].double().flatten(1).std(1, keepdim=True)

    planner = Planner(*agents, Told(), Plan(rollouts=2, top=6, depth=1), FUTURES)  # type: ignore[arg-type]  # a stand-in
    alone = in_turns(learned_orientation_agent(agents[0]), learned_placement_agent(agents[1]))
    assert utilization(planner) > utilization(alone) + 0.03
    assert max(asked) > 6  # pairs times futures times bins


def test_what_is_planned_does_not_depend_on_the_batch(agents: tuple[Actor, Actor]) -> None:
    planner = Planner(*agents, None, Plan(rollouts=2, top=3), FUTURES, seed=5)
    together = game(4)
    chosen = torch.stack(planner(together), 1)
    for i in range(4):
        assert torch.equal(torch.stack(planner(game(1, i)), 1)[0], chosen[i])


def test_pairs_share_their_futures_and_no_future_is_what_comes(
    agents: tuple[Actor, Actor], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Packing] = []
    branch = Packing.branch

    def spied(self: Packing, *arguments: Any) -> Packing:
        seen.append(branch(self, *arguments))
        return seen[-1]

    monkeypatch.setattr(Packing, "branch", spied)
    real = game(1, 2, seed=0)
    Planner(*agents, None, Plan(rollouts=4, top=3), FUTURES, seed=0)(real)
    first, second = (one.stream_state for one in seen if one.n == 6 and one.seed < 0)
    drawn = []
    for keys in (first.view(3, 2), second.view(2, 3)):  # 3 pairs, then the better 2
        assert (keys == keys[0]).all()
        drawn += keys[0].tolist()
    assert len(set(drawn)) == 5
    assert int(real.stream_state) not in drawn


def test_orientations_that_turn_a_box_into_itself_count_as_one(
    agents: tuple[Actor, Actor], monkeypatch: pytest.MonkeyPatch
) -> None:
    planner = Planner(*agents, None, Plan(rollouts=1, top=200), FUTURES)

    def proposed(**options: Any) -> list[int]:
        cube = Packing(1, (4, 4, 4), [[3, 3, 3]], auto_reset=False, **options)
        pairs, legal = planner._propose(cube, torch.tensor([0]))
        found: list[int] = pairs[legal].tolist()
        assert len(set(found)) == len(found)
        return found

    assert len(proposed()) == 4  # its places
    assert {pair // 16 for pair in proposed(orientations=[2, 5])} == {2}
    assert len(proposed(com_offset=(0.1, 0, 0))) == 24


def test_a_bin_with_few_pairs_or_at_its_end_is_planned_too(agents: tuple[Actor, Actor]) -> None:
    planner = Planner(*agents, None, Plan(rollouts=2, top=64), FUTURES)
    tight = Packing(3, (2, 2, 3), [[2, 2, 1], [2, 2, 1], [2, 2, 1]], auto_reset=False)
    for _ in range(4):  # the last one plays bins that have ended
        tight.place(*planner(tight))
    assert not tight.alive.any()
    assert (tight.bins.filled == 12).all()


@pytest.mark.parametrize(
    "text",
    [
        "rollouts",
        "rollouts=0",
        "top=-1",
        "k=3",
        "rollouts=2;top=3",
        "",
        "rollouts=²",
        "top=3,top=4",
        "rollouts=99999999999999999999",
        "rollouts=1000000,top=4",
    ],
)
def test_a_plan_that_cannot_be_read_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="plan"):
        Plan.parse(text)


def test_a_plan_is_read_and_shown() -> None:
    assert Plan.parse("rollouts=3, top=2") == Plan(3, 2)
    assert str(Plan.parse("top=2,depth=4")) == "plan rollouts=16,top=2,depth=4"


def test_one_legal_pair_is_taken_without_a_thought(
    agents: tuple[Actor, Actor], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Planner, "_imagine", None)
    full = Packing(2, (3, 3, 3), [[3, 3, 3]], auto_reset=False)
    choice = Planner(*agents, None, Plan(rollouts=2, top=4), FUTURES)(full)
    full.place(*choice)
    assert (full.bins.filled == 27).all()


def test_the_work_may_be_cut_into_parts(
    agents: tuple[Actor, Actor], monkeypatch: pytest.MonkeyPatch
) -> None:
    planner = Planner(*agents, None, Plan(rollouts=3, top=5), FUTURES)
    at_once = torch.stack(planner(game(3)))
    monkeypatch.setattr(search, "AT_ONCE", 7 * 36)  # seven bins
    assert torch.equal(torch.stack(planner(game(3))), at_once)


def test_a_depth_needs_a_critic(agents: tuple[Actor, Actor]) -> None:
    with pytest.raises(ValueError, match="critic"):
        Planner(*agents, None, Plan(depth=2), FUTURES)
    critic = make_critic("orientation", NETWORK, "cpu", agents[0])
    Planner(*agents, critic, Plan(depth=2), FUTURES)
