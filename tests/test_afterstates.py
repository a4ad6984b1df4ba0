"""The critic of afterstates: features, values of placements, learning, and its owner."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import in_play, mirrored, put_boxes
from small_runs import PLAIN, same
from torch import Tensor

from marl_pack.agents.afterstates import critic as critics
from marl_pack.agents.afterstates import lookahead as lookaheads
from marl_pack.agents.afterstates.critic import AfterstateCritic, AfterstateLearner
from marl_pack.agents.afterstates.features import FEATURES, features
from marl_pack.agents.afterstates.limits import ILLEGAL
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.learned import LearnedAgent
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.learning.runner import Runner
from marl_pack.agents.loading import Loader
from marl_pack.agents.networks.kinds import observe
from marl_pack.agents.networks.planes import ENCODED, input_channels
from marl_pack.bins import place
from marl_pack.config import parse
from marl_pack.game.moves import Moves
from marl_pack.game.packing import Packing
from marl_pack.training.assembly import make_runner

SMALL = (
    PLAIN,
    "--game.bin=[5,5,5]", "--game.sides=[1,3]", "--ppo.num_envs=8", "--ppo.num_steps_per_env=4",
    "--ppo.num_mini_batches=2", "--evaluation.every=0",
)  # fmt: skip
BOTH_SEE_VALUES = tuple(
    f"--{agent}.network.planes=[mask,afterstate_value]" for agent in ("orientation", "placement")
)


def small_runner(folder: Path | None, *options: str) -> Runner:
    return make_runner(parse([*SMALL, *options])[0], folder)


def varied_critic(seed: int = 0) -> AfterstateCritic:
    """Return a critic whose values differ clearly between afterstates."""
    torch.manual_seed(seed)
    critic = AfterstateCritic()
    for weight in critic.parameters():
        torch.nn.init.normal_(weight, std=0.3)
    return critic


def copies(critic: torch.nn.Module) -> dict[str, Tensor]:
    return {name: weight.clone() for name, weight in critic.state_dict().items()}


def features_of(game: Packing, orientation: Tensor, cell: Tensor) -> Tensor:
    """Compute the features of one placement in each game, float32 [G, F]."""
    afterstates = Lookahead().afterstates(game)
    return features(afterstates, game.volume, Moves.gather(afterstates.index, orientation, cell))


# --- features and values --------------------------------------------------------------------------


def test_features_do_not_change_when_the_bin_is_rotated() -> None:
    game = in_play(16, 6)
    o, c = make_policy("dblf")(game)
    own = features_of(game, o, c)
    other = in_play(16, 6)
    put_boxes(other, mirrored(other.bins, 2 | 4))
    # Rotated by 90 degrees about the vertical, the item stands at the mirrored corner.
    width = other.orient(o ^ 1).sides[:, 0].long()
    x, y = game.floor.corner(c)
    cell = other.floor.cell(10 - width - y, x)
    assert other.moves.allows(o ^ 1, cell).all()
    assert torch.allclose(own, features_of(other, o ^ 1, cell), atol=1e-6)
    assert own.shape == (16, FEATURES)


def test_boxes_of_fewer_lengths_take_the_places_of_the_longest() -> None:
    few, many = Packing(1, sides=(2, 5)), Packing(1, sides=(1, 5))
    many.set_state(replace(many.state, items=few.items))
    rows = torch.tensor([0])
    first, second = (features(Lookahead().afterstates(game), 1000, rows)[0] for game in (few, many))
    used = first != 0
    assert torch.equal(first[used], second[used])
    assert int((second != 0).sum()) > int(used.sum())


def test_the_afterstate_value_is_the_reward_and_the_critics_value() -> None:
    game, critic = in_play(5, 7, alpha=2.0, beta=0.5), varied_critic()
    lookahead = Lookahead(critic)
    values = lookahead.afterstate_value(game)
    assert (values[~game.mask] == ILLEGAL).all()
    weights = game.items.weights
    for g, o, x, y in game.mask.nonzero()[::40].tolist():
        bins = game.bins[torch.tensor([g])]
        sides = game.orient_item(game.items).sides[g, o][None]
        corner = torch.tensor([[x, y]])
        _, waste, volume = place(bins, sides, corner, weights[[g]], None)
        row = lookahead.afterstates(game).index[g, o, x, y][None]
        with torch.no_grad():
            value = critic(features(lookahead.afterstates(game), 1000, row))
        expected = 2 * float(volume) / 1000 - 0.5 * float(waste) / 1000 + float(value)
        assert float(values[g, o, x, y]) == pytest.approx(expected, abs=1e-5)


def test_values_are_computed_once_a_turn_and_again_after_the_critic_has_learned() -> None:
    game, critic = in_play(4, 3), AfterstateCritic()
    lookahead = Lookahead(critic)
    first = lookahead.afterstate_value(game)
    assert lookahead.afterstate_value(game) is first
    with torch.no_grad():
        critic.layers[-1].bias += 1
    lookahead.forget_values()
    second = lookahead.afterstate_value(game)
    assert torch.allclose(second[game.mask], first[game.mask] + 1)
    games = torch.tensor([2, 2])
    branched = lookahead.branch(game, games)
    with torch.no_grad():
        critic.layers[-1].bias += 1  # what was computed of the turn goes with the branch
    assert torch.equal(lookahead.afterstate_value(branched), second[games])


def test_the_afterstate_value_is_observed_relative_to_the_best() -> None:
    game, lookahead = in_play(6, 5), Lookahead(AfterstateCritic())
    planes = ["afterstate_value"]
    observation = observe("orientation", game, planes, lookahead)
    channels = input_channels(observation, planes)[:, 4:]
    values = lookahead.afterstate_value(game).flatten(1)
    best = values.argmax(1)
    for near in (channels[:, :6], channels[:, 6:12]):
        assert (near.flatten(1).gather(1, best[:, None]) == 1).all()
        assert (near[~game.mask] == 0).all()
    assert (channels[:, 6:12] <= channels[:, :6]).all()
    assert torch.equal(channels[:, 12, 0, 0], values.amax(1))
    orientation = game.orientation_mask.int().argmax(1)
    observation = observe("placement", game, planes, lookahead, orientation)
    assert (input_channels(observation, planes)[:, 4].flatten(1).amax(1) == 1).all()
    with pytest.raises(ValueError, match="critic of afterstates"):
        observe("orientation", game, planes, Lookahead())


# --- learning -------------------------------------------------------------------------------------


@pytest.mark.parametrize("rollouts", [3, 64])
def test_the_learner_predicts_returns_and_stores_the_last_rollouts(
    rollouts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(critics, "REMEMBERED", rollouts * 4 * 32)
    torch.manual_seed(0)
    game, critic = Packing(32, seed=1), AfterstateCritic()
    learner = AfterstateLearner(critic, Lookahead(critic), 4, 32)
    policy = make_policy("random", seed=1)
    errors, targets = [], []
    for _ in range(100):
        filled = torch.zeros(4, 32, 1)
        for step in range(4):
            choice = policy(game)
            learner.record(game, *choice)
            before = game.bins.filled.clone()
            volume = game.orient(choice[0]).sides.long().prod(1)
            game.place(*choice)
            filled[step, :, 0] = (before + volume) / 1000
        errors.append(learner.learn((1 - filled).squeeze(-1), 1e-3))
        targets.append(1 - filled.squeeze(-1))
    assert errors[-1] < 0.02 * errors[0]
    remembered = sorted(learner.targets.flatten().tolist())
    last = torch.stack(targets[-rollouts:]).flatten().tolist()
    assert remembered == pytest.approx(sorted(last))
    assert all(weight.grad is None for weight in critic.parameters())
    learner.record(game, *policy(game))
    with pytest.raises(ValueError, match="1 steps recorded: a rollout needs 4"):
        learner.learn(torch.zeros(4, 32), 1e-3)


def test_the_critic_learns_at_the_first_learners_learning_rate() -> None:
    runner = small_runner(
        None, *BOTH_SEE_VALUES, "--ppo.learning_rate=2e-3", "--placement.learning_rate=7e-3",
        "--ppo.max_iterations=10",
    )  # fmt: skip
    alg = runner.alg
    optimizer = alg.afterstates.optimizer
    runner.train(1)
    assert optimizer.param_groups[0]["lr"] == pytest.approx(2e-3)
    runner.train(6)
    assert optimizer.param_groups[0]["lr"] == pytest.approx(2e-3 * 0.5)
    game, before = Packing(8, seed=1), copies(alg.afterstates.critic)
    learner = AfterstateLearner(alg.afterstates.critic, Lookahead(), 1, 8)
    learner.record(game, *make_policy("dblf")(game))
    learner.learn(torch.ones(1, 8), 0.0)
    assert same(before, alg.afterstates.critic.state_dict())


def test_the_critic_learns_what_comes_after_a_reward(monkeypatch: pytest.MonkeyPatch) -> None:
    runner = small_runner(None, *BOTH_SEE_VALUES)
    storage, seen = next(iter(runner.alg.learners.values())).storage, []

    def spied(own: AfterstateLearner, targets: Tensor, *rest: float) -> float:
        seen.append((targets, (storage.returns - storage.rewards).squeeze(-1).clone()))
        return 0.0

    monkeypatch.setattr(AfterstateLearner, "learn", spied)
    runner.train(1)
    [(targets, expected)] = seen
    assert torch.equal(targets, expected)
    assert bool((storage.rewards != 0).any())


def test_a_choice_without_a_legal_cell_is_not_learned_from() -> None:
    game = Packing(16, (4, 4, 4), sides=(1, 4), seed=2, mask_orientations=False)
    critic = AfterstateCritic()
    lookahead = Lookahead(critic)
    learner = AfterstateLearner(critic, lookahead, 8, 16)
    for _ in range(8):
        o = torch.zeros(16, dtype=torch.int64)
        cells = game.moves.of(o).flatten(1)
        c = cells.int().argmax(1)
        learner.record(game, o, c)
        assert torch.equal(learner.legal[0, learner.step - 1], cells.any(1))
        observation = observe("orientation", game, ["afterstate_value"], lookahead)
        lost = ~game.moves.any()
        assert (observation["best_afterstate_value"][lost] == 0).all()
        channels = input_channels(observation, ["afterstate_value"])[:, 4:16]
        assert (channels[~game.mask.repeat(1, 2, 1, 1)] == 0).all()
        game.place(o, c)
    assert not learner.legal[0].all()
    returns = torch.where(learner.legal[0], 0.0, 1e6)[..., None]
    assert learner.learn(returns.squeeze(-1), 1e-3) < 1


# --- the run's one critic -------------------------------------------------------------------------


def test_both_agents_see_the_critic_that_learns_and_checkpoints_hold_it_once(
    tmp_path: Path,
) -> None:
    runner = small_runner(tmp_path / "run", *BOTH_SEE_VALUES)
    critic = runner.alg.lookahead.critic
    assert isinstance(critic, AfterstateCritic)
    assert runner.alg.afterstates is not None
    assert runner.alg.afterstates.critic is critic
    before = copies(critic)
    runner.train(3)
    after = copies(critic)
    assert not any(torch.equal(before[name], after[name]) for name in after)
    checkpoint = checkpoints.read(tmp_path / "run")
    assert same(checkpoint["afterstate_critic"], after)
    shapes = Counter(tuple(weight.shape) for weight in tensors(checkpoint["agents"]))
    assert (64, FEATURES) not in shapes, "no agent holds a copy"
    loader = Loader()
    first, second = (
        loader.learned(checkpoints.agent_record(checkpoint, agent), agent)
        for agent in ("orientation", "placement")
    )
    assert first.lookahead is second.lookahead, "values are computed once for both"
    assert isinstance(first.lookahead.critic, AfterstateCritic)
    assert same(first.lookahead.critic.state_dict(), after)
    policy = Loader().policy_of(checkpoint)
    policy(Packing(2, (5, 5, 5), sides=(1, 3)))


def tensors(value: object) -> list[Tensor]:
    """List all tensors in nested dicts and lists."""
    if isinstance(value, Tensor):
        return [value]
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [tensor for part in parts for tensor in tensors(part)]


def test_a_run_begins_with_the_critic_of_another_run_or_a_new_one(tmp_path: Path) -> None:
    first = small_runner(tmp_path / "run", *BOTH_SEE_VALUES)
    first.train(1)
    assert first.alg.lookahead.critic is not None
    again = small_runner(None, *BOTH_SEE_VALUES, f"--init={tmp_path / 'run'}")
    critic = again.alg.lookahead.critic
    assert isinstance(critic, AfterstateCritic)
    assert same(critic.state_dict(), first.alg.lookahead.critic.state_dict())
    # No value that the fresh weights gave is left.
    game = again.env.game
    fresh_values = Lookahead(critic).afterstate_value(game)
    assert torch.equal(again.alg.lookahead.afterstate_value(game), fresh_values)
    fewer = [option.replace(",afterstate_value", "") for option in BOTH_SEE_VALUES]
    less = small_runner(tmp_path / "less", *fewer)
    assert less.alg.afterstates is None
    less.train(1)
    assert "afterstate_critic" not in checkpoints.read(tmp_path / "less")
    more = small_runner(None, *BOTH_SEE_VALUES, f"--init={tmp_path / 'less'}")
    more.train(1)


def test_one_agent_alone_may_see_values(tmp_path: Path) -> None:
    options = ("--orientation.network.planes=[mask]", BOTH_SEE_VALUES[1])
    small_runner(tmp_path / "one", *options).train(1)
    checkpoint = checkpoints.read(tmp_path / "one")
    assert "afterstate_critic" in checkpoint
    planes = {name: agent["network"]["planes"] for name, agent in checkpoint["agents"].items()}
    assert planes == {"orientation": ["mask"], "placement": ["mask", "afterstate_value"]}
    Loader().policy_of(checkpoint)(Packing(2, (5, 5, 5), sides=(1, 3)))


def test_after_learning_the_agents_observe_values_of_the_new_critic() -> None:
    runner = small_runner(None, *BOTH_SEE_VALUES)
    critic = runner.alg.lookahead.critic
    assert isinstance(critic, AfterstateCritic)
    observations, planes = [], ["mask", "afterstate_value"]
    act = runner.alg.act

    def spied(obs: dict[str, Tensor]) -> Tensor:
        game = runner.env.game
        expected = Lookahead(critic).afterstate_value(game)  # computed by the critic as it is
        observations.append(torch.equal(obs["afterstate_value"], expected))
        actions = act(obs)
        second = runner.alg.learners["placement"].transition.observations[ENCODED]
        own = observe("placement", runner.env.game, planes, Lookahead(critic), actions[:, 0])
        observations.append(torch.equal(second.movedim(3, 1), input_channels(own, planes)))
        return actions

    runner.alg.act = spied  # type: ignore[method-assign]  # a test watches it
    before = copies(critic)
    runner.train(3)
    assert not same(before, copies(critic))
    assert len(observations) == 2 * 3 * 4
    assert all(observations)


def test_a_frozen_network_observes_the_values_of_its_own_critic(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each critic values the afterstates by itself; these are computed once a turn for both."""
    small_runner(tmp_path / "first", *BOTH_SEE_VALUES).train(2)
    frozen = ("--placement.frozen=true", f"--placement.policy={tmp_path / 'first'}", "--seed=5")
    runner = small_runner(tmp_path / "second", BOTH_SEE_VALUES[0], *frozen)
    (agent,) = (seat.frozen for seat in runner.alg.seats if seat.frozen is not None)
    assert isinstance(agent, LearnedAgent)
    own = agent.lookahead.critic
    assert isinstance(own, AfterstateCritic)
    first = checkpoints.read(tmp_path / "first")
    assert same(own.state_dict(), first["afterstate_critic"])
    assert own is not runner.alg.lookahead.critic
    game = runner.env.game
    orientation = game.orientation_mask.int().argmax(1)
    observation = agent.observe(game, orientation)
    for critic, sees in ((own, True), (runner.alg.lookahead.critic, False)):
        values = Moves.gather(Lookahead(critic).afterstate_value(game), orientation)[:, None]
        assert torch.equal(observation["afterstate_value"], values) == sees

    turns: list[int] = []
    compute = lookaheads.afterstates_of

    def counted(*arguments: object) -> object:
        turns.append(game.turn)
        return compute(*arguments)  # type: ignore[arg-type]  # as they come

    monkeypatch.setattr(lookaheads, "afterstates_of", counted)
    runner.train(2)
    assert len(turns) == len(set(turns)), "once a turn"
    assert len(turns) >= 2 * 4
    second = checkpoints.read(tmp_path / "second" / "latest.pt")
    record = second["agents"]["placement"]
    assert same(record["afterstate_critic"], first["afterstate_critic"])
    assert not same(second["afterstate_critic"], first["afterstate_critic"])
    loader = Loader()
    for name, owner in (("orientation", second), ("placement", first)):
        player = loader.learned(checkpoints.agent_record(second, name), name)
        assert isinstance(player.lookahead.critic, AfterstateCritic)
        assert same(player.lookahead.critic.state_dict(), owner["afterstate_critic"])
    Loader().policy_of(second)(Packing(2, (5, 5, 5), sides=(1, 3)))
