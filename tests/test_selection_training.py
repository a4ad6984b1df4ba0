"""Training and playing with a selection agent."""

import io
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console

from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.learned import LearnedSelection
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.learning.bin_returns import BinReturns
from marl_pack.agents.learning.ppo import Step
from marl_pack.agents.loading import Loader, record_of
from marl_pack.agents.networks.actor_critic import make_actor, make_critic
from marl_pack.agents.networks.kinds import SELECTION, observe
from marl_pack.agents.networks.planes import PREVIEW
from marl_pack.agents.networks.selection import BEHIND, OPTION_NUMBERS, observe_options
from marl_pack.agents.player import load
from marl_pack.agents.selection.policies import GreedyValue, SelectFirst
from marl_pack.config import ConfigError
from marl_pack.export.writers import run
from marl_pack.game.packing import Packing
from marl_pack.game.selection import SelectionPacking
from marl_pack.game.spec import SelectionSpec
from marl_pack.training.assembly import evaluation, make_runner
from tests.small_runs import rollout, same, tiny, weights

FROZEN = (
    "--orientation.frozen=true", "--orientation.policy=dblf", "--placement.frozen=true",
    "--placement.policy=dblf",
)  # fmt: skip
VARIANTS = [
    ("--game.buffer=3",),
    ("--game.buffer=2", "--game.preview=2", "--game.bins=2", "--game.closings=3"),
    ("--game.bins=2", "--game.closings=2", "--joint=true"),
    ("--game.preview=1",),
]


def game_of(n: int = 4, seed: int = 0, **options: Any) -> SelectionPacking:
    return SelectionPacking(n, "rs", spec=SelectionSpec(bin=(5, 5, 5), **options), sides=(1, 3),
                            seed=seed)  # fmt: skip


@pytest.fixture(scope="module")
def lookahead() -> Lookahead:
    torch.manual_seed(0)
    return Lookahead(AfterstateCritic().eval())


# --- what the agent observes ----------------------------------------------------------------------


def test_an_option_is_described_by_its_box_its_bin_and_its_gain(lookahead: Lookahead) -> None:
    game = game_of(buffer=3, bins=2, preview=2)
    game.place(*GreedyValue(lookahead)(game))
    observation = observe_options(game, lookahead)
    options = dict(zip(OPTION_NUMBERS, observation["options"].unbind(2), strict=True))
    sides = game.items().sides.view(4, 6, 3).float()
    assert torch.equal(5 * options["longest"], sides.amax(2))
    assert torch.equal(5 * options["shortest"], sides.amin(2))
    assert torch.allclose(options["volume"], 8 * sides.prod(2) / 125)
    assert torch.equal(options["legal"] > 0, game.selection_mask)
    assert options["behind"].amax(1).tolist() == [0] * 4
    best = GreedyValue(lookahead)(game)[0]
    assert torch.equal(options["gain"].argmax(1), best)
    filled = game.bins.filled.view(4, 1, 2).expand(4, 3, 2).flatten(1) / 125
    assert torch.allclose(options["filled"], filled)
    assert torch.equal(
        5 * observation["previews"][:, 0, 0],
        game.previews().sides.view(4, 2, 3)[:, 0].amax(1).float(),
    )
    values = lookahead.state_value(game.bins, game.view()).view(4, 2).sum(1)
    gain = options["gain"].gather(1, best[:, None]).squeeze(1) / 10
    assert torch.allclose(observation["expected"].squeeze(1), values + gain, atol=1e-6)


def test_it_sees_nothing_hidden(lookahead: Lookahead) -> None:
    items = torch.randint(1, 4, (2, 9, 3), generator=torch.Generator().manual_seed(1))
    items[1, :4] = items[0, :4]
    spec = SelectionSpec(bin=(5, 5, 5), buffer=3, preview=1)
    a, b = (
        observe_options(SelectionPacking(1, items[i].numpy(), spec=spec), lookahead) for i in (0, 1)
    )
    assert same(a, b)


def test_the_network_treats_all_boxes_alike(lookahead: Lookahead) -> None:
    observation = observe_options(game_of(buffer=4, preview=1), lookahead)
    order = torch.tensor([2, 0, 3, 1])
    moved = observation | {
        name: observation[name][:, order] for name in ("options", "present", "mask")
    }
    actor = make_actor(SELECTION, {}, "cpu")
    critic = make_critic(SELECTION, {}, "cpu", actor)
    assert torch.allclose(actor.log_probs(observation)[:, order], actor.log_probs(moved), atol=1e-5)
    assert torch.allclose(critic(observation), critic(moved), atol=1e-5)


def test_a_new_agent_follows_the_critic_of_afterstates(lookahead: Lookahead) -> None:
    game = game_of(8, buffer=4)
    actor = make_actor(SELECTION, {}, "cpu")
    torch.nn.init.zeros_(actor.mlp.score.weight)
    agent, greedy = LearnedSelection(actor, lookahead), GreedyValue(lookahead)
    for _ in range(4):
        observation = observe_options(game, lookahead)
        best = observation["options"][..., BEHIND].where(game.selection_mask, -1).argmax(1)
        assert torch.equal(agent(game)[game.alive], best[game.alive])
        game.place(*greedy(game))


def test_networks_on_a_bin_see_the_first_box_of_the_preview(lookahead: Lookahead) -> None:
    game = game_of(preview=2)
    seen = observe("orientation", game.view(), ["preview"], lookahead)
    sides = torch.cat([seen[name] for name in PREVIEW], 1)
    first = game.previews().sides.view(4, 2, 3)[:, 0]
    assert torch.equal(sides, first.sort(1, descending=True).values.float())
    alone = observe("orientation", Packing(2, (5, 5, 5), sides=(1, 3)), ["preview"], lookahead)
    assert not any(alone[name].any() for name in PREVIEW)


# --- returns of each bin --------------------------------------------------------------------------


def test_a_bins_return_ends_where_it_is_closed() -> None:
    returns = BinReturns(4, 1, 2, "cpu")
    none, first = torch.tensor([[False, False]]), torch.tensor([[True, False]])
    for bin, reward, closed in ((0, 1, none), (1, 2, first), (0, 4, none), (1, 8, none)):
        returns.record(torch.tensor([bin]), torch.tensor([float(reward)]), closed)
    targets = returns.targets(torch.tensor([[16.0, 32.0]]), 1.0)
    assert targets.squeeze(1).tolist() == [0, 40, 16, 32]
    with pytest.raises(ValueError, match="0 steps recorded: a rollout needs 4"):
        returns.targets(torch.zeros(1, 2), 1.0)


def test_targets_are_the_rewards_that_a_bin_still_gets(lookahead: Lookahead) -> None:
    """Play whole episodes, so that nothing is estimated."""
    game, greedy = game_of(3, bins=2, closings=3), GreedyValue(lookahead)
    records = []
    while bool(game.alive.any()):
        alive = game.alive.clone()
        option, *choice = greedy(game)
        outcome = game.place(option, *choice)
        records.append((option % 2, outcome.reward, outcome.emptied, alive))
    returns = BinReturns(len(records), 3, 2, "cpu")
    for bin, reward, closed, _ in records:
        returns.record(bin, reward, closed)
    targets = returns.targets(torch.full((3, 2), 100.0), 1.0)
    for g in range(3):
        coming = {0: 0.0, 1: 0.0}
        for t in reversed(range(len(records))):
            bin, reward, closed, alive = (value[g] for value in records[t])
            if not alive:
                continue
            for j in (0, 1):
                coming[j] *= not closed[j]
            assert float(targets[t, g]) == pytest.approx(coming[int(bin)], abs=1e-5)
            coming[int(bin)] += float(reward)


# --- training -------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", VARIANTS)
def test_every_agent_of_every_variant_learns(options: tuple[str, ...]) -> None:
    runner = make_runner(tiny(*options), None)
    names = list(runner.alg.learners)
    assert (SELECTION in names) == ("--game.preview=1" not in options)
    before = {name: weights(runner, name) for name in names}
    with torch.inference_mode():
        runner.alg.compute_returns(rollout(runner))
    losses = runner.alg.update()
    for name in names:
        assert not same(before[name], weights(runner, name))
        assert f"{name}/kl" in losses
    game, policy = runner.env.game, runner.get_inference_policy()
    with torch.inference_mode():
        option, orientation, cell = policy(game)
    assert bool(game.state.mask.flatten(3)[torch.arange(game.n), option, orientation, cell].all())


def test_frozen_agents_do_not_learn_and_selection_is_recorded() -> None:
    runner = make_runner(tiny("--game.buffer=3", *FROZEN), None)
    assert list(runner.alg.learners) == [SELECTION]
    game, obs = runner.env.game, runner.env.get_observations()
    with torch.inference_mode():
        actions = runner.alg.act(obs)
    stored = runner.alg.learners[SELECTION].transition.actions
    assert torch.equal(stored.squeeze(1).long(), actions[:, 0])
    view = game.view(game.rows(actions[:, 0]))
    orientation, cell = load("dblf")(view)
    assert torch.equal(actions[:, 1:], torch.stack((orientation, cell), 1))


def test_later_agents_see_the_selected_box_and_share_what_was_computed(
    lookahead: Lookahead,
) -> None:
    game = game_of(buffer=3, bins=2)
    values = lookahead.afterstate_value(game.view())
    step = Step(game, lookahead)
    option = game.selection_mask.int().argmax(1)
    step.select(option)
    rows = game.rows(option)
    assert torch.equal(step.table.items.sides, game.items(rows).sides)
    assert lookahead.afterstate_value(step.table).data_ptr() != values.data_ptr()
    assert torch.equal(lookahead.afterstate_value(step.table), values[rows])


@pytest.mark.parametrize("options", [VARIANTS[0], VARIANTS[1], VARIANTS[3]])
def test_a_run_resumes_exactly(options: tuple[str, ...], tmp_path: Path) -> None:
    config = tiny(*options, "--ppo.max_iterations=4")
    whole = make_runner(config, tmp_path / "whole")
    whole.train(4)
    first = make_runner(config, tmp_path / "parts")
    first.train(2)
    checkpoint = checkpoints.read(tmp_path / "parts" / "latest.pt")
    again = make_runner(config, tmp_path / "parts", checkpoint)
    again.train(4)
    for name in whole.alg.learners:
        assert same(weights(whole, name), weights(again, name))
    assert torch.equal(whole.env.game.episode, again.env.game.episode)
    figures = evaluation(tiny(*options, "--evaluation.episodes=4"), again.checkpoint())
    assert 0 < figures["utilization"] < 1


def test_a_changed_state_of_the_game_is_refused() -> None:
    game = game_of(2, buffer=2)
    with pytest.raises(ValueError, match="only games with auto_reset record"):
        game.state_dict()
    game = SelectionPacking(2, "rs", spec=game.spec, sides=(1, 3), auto_reset=True)
    greedy = load("dblf")
    for _ in range(30):
        game.place(*greedy(game))
    state, after = game.state_dict(), [game.episode.clone(), game.bins.heightmap.clone()]
    for name, change, why in (
        ("choices", lambda v: v.index_fill(1, torch.tensor([0]), 10**6), "is not legal"),
        ("choices", lambda v: torch.cat((v, v), 1), "choices of game|is not legal"),
        ("episode", lambda v: v + 2**63 - 5, "episode"),
        ("t", lambda v: v + 1, "t of game 0"),
        ("t", lambda v: v[:1], "the numbers of 2 games"),
        ("episode", lambda v: "x", "needs tensors"),
        ("seed", lambda v: v + 1, "needs the seed of this game"),
    ):
        with pytest.raises(ValueError, match=why):
            game.load_state_dict(state | {name: change(state[name])})
        assert torch.equal(game.episode, after[0])
        assert torch.equal(game.bins.heightmap, after[1])
    other = SelectionPacking(2, "rs", spec=game.spec, sides=(1, 3), auto_reset=True)
    other.load_state_dict(state)
    for _ in range(40):
        choice = greedy(game)
        assert all(map(torch.equal, choice, greedy(other)))
        game.place(*choice)
        other.place(*choice)
    assert torch.equal(game.bins.heightmap, other.bins.heightmap)


# --- settings and checkpoints ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("--selection.frozen=true", "--selection.policy=dblf"), "selection: needs game.buffer"),
        (("--game.buffer=2", "--selection.frozen=true"), "selection.policy = null: a frozen agent"),
        (("--game.buffer=2", "--selection.policy=dblf"), "needs selection.frozen: true"),
        (("--game.buffer=2", "--selection.network.hidden=0"), "hidden"),
        (
            ("--game.buffer=2", *FROZEN, "--selection.frozen=true", "--selection.policy=first"),
            "all agents are frozen",
        ),
        (("--game.buffer=0",), "buffer: needs a whole number"),
    ],
)
def test_impossible_settings_are_refused(options: tuple[str, ...], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        tiny(*options)


@pytest.mark.parametrize("policy", ["dblf", "random", "first", "rs"])
def test_the_selection_agent_may_be_frozen(policy: str) -> None:
    options = "--game.buffer=2", "--selection.frozen=true", f"--selection.policy={policy}"
    runner = make_runner(tiny(*options), None)
    assert list(runner.alg.learners) == ["orientation", "placement"]
    with torch.inference_mode():
        runner.alg.compute_returns(rollout(runner))
    runner.alg.update()
    checkpoint = runner.checkpoint()
    played = Loader().policy_of(checkpoint)
    assert isinstance(played, SelectFirst)
    game = SelectionPacking(2, "rs", spec=runner.env.game.spec, sides=(1, 3))
    game.place(*played(game))


def test_a_teacher_is_cloned() -> None:
    options = ("--selection.teacher=dblf", "--selection.teacher_iterations=1",
               "--selection.teacher_random=0")  # fmt: skip
    runner = make_runner(tiny("--game.buffer=3", *FROZEN, *options), None)
    obs, expected = runner.env.get_observations(), load("dblf")(runner.env.game)[0]
    with torch.inference_mode():
        assert torch.equal(runner.alg.act(obs)[:, 0], expected)


def test_a_model_without_a_selection_agent_selects_by_its_critic() -> None:
    record = record_of("rs", SELECTION)
    assert record["name"] == "greedy_value"
    agent = Loader().selection_agent_of(record)
    game = SelectionPacking(2, "rs", spec=SelectionSpec(buffer=3))
    assert torch.equal(agent(game), load("rs")(game)[0])


def test_a_policy_with_a_selection_agent_plays_games_of_one_box() -> None:
    runner = make_runner(tiny("--game.buffer=2"), None)
    policy = Loader().policy_of(runner.checkpoint())
    game = Packing(2, (4, 4, 4), sides=(1, 3), auto_reset=False)
    game.place(*policy(game))


def test_a_run_with_a_selection_agent_begins_with_a_model_without_one() -> None:
    config = tiny("--game.buffer=2", "--game.bin=[10,10,10]", "--game.sides=[2,5]", *FROZEN)
    runner = make_runner(config, None)
    checkpoint = checkpoints.read("rs")
    runner.begin_with(checkpoint)
    critic = runner.alg.afterstates.critic.state_dict()
    assert same(critic, checkpoint["afterstate_critic"])


def test_an_agent_that_was_frozen_there_begins_with_new_weights() -> None:
    game = "--game.buffer=2"
    frozen = make_runner(tiny(game, "--selection.frozen=true", "--selection.policy=first"), None)
    runner = make_runner(tiny(game), None)
    before = weights(runner, SELECTION)
    runner.begin_with(frozen.checkpoint())
    assert same(before, weights(runner, SELECTION))


def test_the_critic_learns_whatever_share_of_it_the_agents_observe(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    runner = make_runner(tiny("--game.buffer=2", "--ppo.afterstate_ramp=[5,9]"), None)
    assert runner.alg.lookahead.value_share == 0
    seen = []
    targets = BinReturns.targets

    def spied(own: BinReturns, values: torch.Tensor, gamma: float) -> torch.Tensor:
        seen.append(values)
        return targets(own, values, gamma)

    monkeypatch.setattr(BinReturns, "targets", spied)
    torch.nn.init.constant_(runner.alg.afterstates.critic.layers[-1].bias, 0.5)
    with torch.inference_mode():
        runner.alg.compute_returns(rollout(runner))
    runner.alg.update()
    assert (seen[0] - 0.5).abs().max() < 0.2


def test_export_leaves_the_selection_agent_out(tmp_path: Path) -> None:
    runner = make_runner(tiny("--game.buffer=2", "--ppo.max_iterations=1"), tmp_path)
    runner.train(1)
    console = Console(file=io.StringIO(), width=200)
    run(str(tmp_path / "latest.pt"), tmp_path / "out", "onnx", console)
    assert "selection: left out" in console.file.getvalue()
    assert sorted(path.name for path in (tmp_path / "out").glob("*.onnx")) == [
        "afterstate_critic.onnx", "orientation.onnx", "placement.onnx"
    ]  # fmt: skip
    run(str(tmp_path / "latest.pt"), tmp_path / "out", "checkpoint", console)
    published = checkpoints.read(next((tmp_path / "out").glob("*.pt")))
    assert isinstance(Loader().policy_of(published), SelectFirst)
