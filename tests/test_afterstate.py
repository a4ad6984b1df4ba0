"""The critic of afterstates: what it sees, what it says of placements, what it learns."""

from pathlib import Path

import pytest
import torch
from conftest import in_play

from marl_pack.agents import orientation, placement
from marl_pack.agents.afterstates import critic as afterstate
from marl_pack.agents.afterstates.critic import (
    FEATURES,
    ILLEGAL,
    AfterstateCritic,
    AfterstateLearner,
    features,
)
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.learning import checkpoint
from marl_pack.agents.networks.trunk import input_planes
from marl_pack.bins import place
from marl_pack.config import parse
from marl_pack.game.packing import Packing
from marl_pack.train import make_runner


def test_a_mirrored_or_turned_bin_looks_the_same_to_it() -> None:
    game = in_play(16, 6)
    o, c = make_policy("dblf")(game)
    seen = features(
        game.left(), game.volume, game.left().index[torch.arange(16), o, c // 10, c % 10]
    )
    other = in_play(16, 6)
    for maps in (other.bins.heightmap, other.bins.empty_map):
        maps.copy_(maps.transpose(1, 2).flip(1).clone())
    other._look()
    # Turned by 90 degrees about the vertical, the item stands at the mirrored corner.
    width = other.orient(o ^ 1).sides[:, 0].long()
    x, y = 10 - width - c % 10, c // 10
    assert other.mask[torch.arange(16), o ^ 1, x, y].all()
    again = features(other.left(), other.volume, other.left().index[torch.arange(16), o ^ 1, x, y])
    assert torch.allclose(seen, again, atol=1e-6)
    assert seen.shape == (16, FEATURES)


def test_boxes_of_fewer_lengths_stand_where_the_longest_of_many_do() -> None:
    few, many = Packing(1, sides=(2, 5)), Packing(1, sides=(1, 5))
    many.items, many.weights = few.items, few.weights
    many._look()
    seen = [features(game.left(), 1000, torch.tensor([0]))[0] for game in (few, many)]
    known = seen[0] != 0
    assert torch.equal(seen[0][known], seen[1][known])
    assert int((seen[1] != 0).sum()) > int(known.sum())


def test_worth_is_reward_and_value_of_what_is_left() -> None:
    game = in_play(5, 7, beta=0.5)
    critic = AfterstateCritic()
    for weight in critic.parameters():
        torch.nn.init.normal_(weight, std=0.3)
    worth = critic.worth(game)
    assert (worth[~game.mask] == ILLEGAL).all()
    for b, o, x, y in game.mask.nonzero()[::40].tolist():
        bins = game.bins[torch.tensor([b])]
        sides = game.orient_item(game.items, game.weights).sides[b, o][None]
        _, waste, volume = place(bins, sides, torch.tensor([x * 10 + y]), game.weights[[b]], None)
        row = game.left().index[b, o, x, y][None]
        with torch.no_grad():
            value = critic(features(game.left(), 1000, row))
        expected = float(volume) / 1000 - 0.5 * float(waste) / 1000 + float(value)
        assert float(worth[b, o, x, y]) == pytest.approx(expected, abs=1e-5)


def test_it_is_made_once_a_turn_and_anew_when_it_has_learned() -> None:
    game, critic = in_play(4, 3), AfterstateCritic()
    first = critic.worth(game)
    assert critic.worth(game) is first
    assert torch.equal(critic.worth(game.branch(torch.tensor([2, 2]))), first[[2, 2]])
    with torch.no_grad():
        critic.layers[-1].bias += 1
    game.forget(critic)
    assert torch.allclose(critic.worth(game)[game.mask], first[game.mask] + 1)


def test_worth_is_seen_beside_the_best() -> None:
    game, critic = in_play(6, 5), AfterstateCritic()
    seen = orientation.observe(game, ("worth",), critic)
    planes = input_planes(seen, ["worth"])[:, 4:]
    best = critic.worth(game).flatten(1).argmax(1)
    for near in (planes[:, :6], planes[:, 6:12]):
        assert (near.flatten(1).gather(1, best[:, None]) == 1).all()
        assert (near[~game.mask] == 0).all()
    assert (planes[:, 6:12] <= planes[:, :6]).all()
    assert torch.equal(planes[:, 12, 0, 0], critic.worth(game).flatten(1).amax(1))
    chosen = game.orientation_mask.int().argmax(1)
    turned = input_planes(
        placement.observe(game, ("worth",), chosen, afterstates=critic), ["worth"]
    )[:, 4]
    assert (turned.flatten(1).amax(1) == 1).all()
    with pytest.raises(ValueError, match="critic of afterstates"):
        orientation.observe(game, ("worth",))


@pytest.mark.parametrize("rollouts", [3, 64])
def test_the_learner_finds_what_placements_bring_and_remembers(
    rollouts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(afterstate, "REMEMBERED", rollouts * 4 * 32)
    torch.manual_seed(0)
    game, critic = Packing(32, seed=1), AfterstateCritic()
    learner = AfterstateLearner(critic, 4, 32)
    policy = make_policy("random", seed=1)
    errors, given = [], []
    for _ in range(100):
        rewards, filled = torch.rand(4, 32, 1), torch.zeros(4, 32, 1)
        for step in range(4):
            choice = policy(game)
            learner.record(game, *choice)
            before = game.bins.filled.clone()
            volume = game._turned(choice[0]).long().prod(1)
            game.place(*choice)
            filled[step, :, 0] = (before + volume) / 1000
        errors.append(learner.learn(1 - filled + rewards, rewards, 1e-3))
        given.append(1 - filled.squeeze(-1))
    assert errors[-1] < 0.02 * errors[0]
    remembered = sorted(learner.wanted.flatten().tolist())
    assert remembered == pytest.approx(sorted(torch.stack(given[-rollouts:]).flatten().tolist()))
    assert all(weight.grad is None for weight in critic.parameters())
    learner.record(game, *policy(game))
    with pytest.raises(ValueError, match="1 steps recorded, a rollout has 4"):
        learner.learn(rewards, rewards, 1e-3)


def test_a_choice_without_a_place_is_not_learned_from() -> None:
    game = Packing(16, (4, 4, 4), sides=(1, 4), seed=2, mask_orientations=False)
    critic = AfterstateCritic()
    learner = AfterstateLearner(critic, 8, 16)
    for _ in range(8):
        o = torch.zeros(16, dtype=torch.int64)
        c = game.mask[:, 0].flatten(1).int().argmax(1)
        expected = game.mask[:, 0].flatten(1).any(1)
        learner.record(game, o, c)
        assert torch.equal(learner.legal[0, learner.step - 1], expected)
        seen = orientation.observe(game, ("worth",), critic)
        lost = ~game.mask.flatten(1).any(1)
        assert (seen["best_worth"][lost] == 0).all()
        assert (input_planes(seen, ["worth"])[:, 4:16][~game.mask.repeat(1, 2, 1, 1)] == 0).all()
        game.place(o, c)
    assert not learner.legal[0].all()
    error = learner.learn(
        torch.where(learner.legal[0], 0.0, torch.nan)[..., None].nan_to_num(1e6),
        torch.zeros(8, 16, 1), 1e-3,
    )  # fmt: skip
    assert error < 1


def test_both_agents_hear_the_one_that_learns_and_checkpoints_hold_it(tmp_path: Path) -> None:
    planes = [f"--{agent}.network.planes=[mask,worth]" for agent in ("orientation", "placement")]
    small = [
        "--game.bin=[5,5,5]", "--game.sides=[1,3]", "--ppo.num_envs=8",
        "--ppo.num_steps_per_env=4", "--ppo.num_mini_batches=2", "--evaluation.every=0",
    ]  # fmt: skip
    runner = make_runner(parse([*small, *planes])[0], tmp_path / "run")
    critic = runner.env.afterstates
    assert critic is not None
    before = {name: weight.clone() for name, weight in critic.state_dict().items()}
    runner.train(3)
    assert all(ppo.actor.afterstates is critic for ppo in runner.alg.learners.values())
    assert not any(torch.equal(before[name], now) for name, now in critic.state_dict().items())
    found = checkpoint.read(tmp_path / "run")
    for agent in ("orientation", "placement"):
        loaded = checkpoint.load_actor(found, agent, "cpu").afterstates
        assert loaded is not None
        for name, weight in critic.state_dict().items():
            assert torch.equal(loaded.state_dict()[name], weight)
    policy = checkpoint.load_policy(found)
    policy(Packing(2, (5, 5, 5), sides=(1, 3)))
    # A run that begins with these weights has its word; one of agents without begins with its own.
    again = make_runner(parse([*small, *planes, f"--init={tmp_path / 'run'}"])[0], None)
    assert again.env.afterstates is not None
    assert torch.equal(again.env.afterstates.layers[0].weight, critic.layers[0].weight)
    cached = again.env.game.once(again.env.afterstates, lambda: torch.zeros(0))
    assert not len(cached)  # nothing that the one of before has said
    fewer = [option.replace(",worth", "") for option in planes]
    make_runner(parse([*small, *fewer])[0], tmp_path / "less").train(1)
    one = make_runner(parse([*small, fewer[0], planes[1]])[0], tmp_path / "one")
    one.train(1)
    mixed = checkpoint.read(tmp_path / "one")
    assert checkpoint.load_actor(mixed, "orientation", "cpu").afterstates is None
    assert checkpoint.load_actor(mixed, "placement", "cpu").afterstates is not None
    more = make_runner(parse([*small, *planes, f"--init={tmp_path / 'less'}"])[0], None)
    more.train(1)
