"""The trainer: two stock PPOs as one, against numbers worked by hand and against itself."""

import json
import warnings
from pathlib import Path

import pytest
import torch
from rsl_rl.algorithms import PPO
from small_runs import recorded_game, rollout, same, tiny, weights
from tensordict import TensorDict
from torch import Tensor

from marl_pack.agents.afterstates.limits import ILLEGAL
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.learned import LearnedAgent
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.learning.runner import RunInterruptedError
from marl_pack.agents.loading import Loader
from marl_pack.agents.networks.kinds import TWO_AGENTS, observe
from marl_pack.agents.policy import Policy
from marl_pack.config import Config
from marl_pack.evaluation.rollout import play
from marl_pack.game.packing import Packing
from marl_pack.geometry import ORIENTATIONS
from marl_pack.training.assembly import evaluation, make_game, make_runner

# --- what PPO records ---------------------------------------------------------------------------


def test_both_agents_store_the_same_reward_and_end_and_their_own_turn() -> None:
    runner = make_runner(tiny(), None)
    env, alg = runner.env, runner.alg
    obs = env.get_observations()
    rewards, dones = [], []
    with torch.inference_mode():
        for _ in range(4):
            game = env.game
            mask, items = game.mask.clone(), game.items.sides.clone()
            heights = game.bins.heightmap.clone()
            actions = alg.act(obs)
            obs, reward, done, extras = env.step(actions)
            alg.process_env_step(obs, reward, done, extras)
            rewards.append(reward)
            dones.append(done)
            step = len(rewards) - 1
            o = actions[:, 0]
            first, second = (alg.learners[n].storage for n in ("orientation", "placement"))
            assert torch.equal(first.actions[step, :, 0].long(), o)
            assert torch.equal(second.actions[step, :, 0].long(), actions[:, 1])
            observed, sides = recorded_game(first.observations[step], game.size)
            assert torch.equal(sides, items)
            for storage in (first, second):
                observed, _ = recorded_game(storage.observations[step], game.size)
                assert torch.equal(observed, heights)
            legal = mask[torch.arange(16), o]
            assert torch.equal(second.observations["mask"][step], legal.flatten(1))
            assert legal.flatten(1).gather(1, actions[:, 1:]).all()
    assert torch.stack(dones).any()
    for ppo in alg.learners.values():
        assert torch.equal(ppo.storage.rewards[..., 0], torch.stack(rewards))
        assert torch.equal(ppo.storage.dones[..., 0], torch.stack(dones))


def test_advantages_are_those_worked_by_hand() -> None:
    config = tiny("--ppo.gamma=0.5", "--ppo.lam=0.5", "--ppo.num_envs=1",
                  "--ppo.num_steps_per_env=3", "--ppo.num_mini_batches=1")  # fmt: skip
    runner = make_runner(config, None)
    for name, ppo in runner.alg.learners.items():
        storage = ppo.storage
        storage.rewards[:, 0, 0] = torch.tensor([1.0, 2.0, 3.0])
        storage.values[:, 0, 0] = torch.tensor([4.0, 5.0, 6.0])
        storage.dones[:, 0, 0] = torch.tensor([0, 1, 0]).byte()
        ppo.critic.mlp = torch.nn.Module()
        ppo.critic.forward = lambda obs: torch.tensor([[8.0]])  # V of the state after the rollout
        env, before = runner.env, [torch.zeros(1, dtype=torch.int64)] * (name == "placement")
        obs = observe(name, env.game, ["mask"], runner.alg.lookahead, *before)
        ppo.compute_returns(TensorDict(obs, batch_size=[1]))
        # δ₂ = 3 + ½·8 − 6 = 1; δ₁ = 2 − 5 = −3 (the episode ends); δ₀ = 1 + ½·5 − 4 = −½
        # A₂ = 1; A₁ = −3; A₀ = −½ + ¼·(−3) = −1¼; returns A + V
        assert storage.returns[:, 0, 0].tolist() == [2.75, 2.0, 7.0]
        advantage = torch.tensor([-1.25, -3.0, 1.0])
        normal = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        assert torch.allclose(storage.advantages[:, 0, 0], normal)


def test_the_value_after_a_rollout_is_that_of_a_drawn_orientation_and_the_game_stays() -> None:
    runner = make_runner(tiny(), None)
    before = runner.env.game.state_dict()
    last = {}
    placement = runner.alg.learners["placement"]
    placement.compute_returns = lambda obs: last.update(obs.items())
    with torch.inference_mode():
        runner.alg.compute_returns(runner.env.get_observations())
    assert same(before, runner.env.game.state_dict())
    drawn = runner.alg.learners["orientation"].actor.distribution
    assert drawn.log_probs.shape == (16, 6)
    items = before["items.sides"]
    _, item = recorded_game(last, runner.env.game.size)
    orientations = _orientations(item, items)
    sides = items.gather(1, torch.tensor(ORIENTATIONS)[orientations])
    assert torch.equal(sides, item)
    assert len(item.unique(dim=0)) > 1
    assert last["mask"].any(1).all(), "a drawn orientation is legal"
    assert (orientations > 0).any(), "not the first one always"


def _orientations(sides: Tensor, items: Tensor) -> Tensor:
    """Return the first orientation that gives each item (own sides [G, 3]) the ``sides``."""
    oriented = items[:, torch.tensor(ORIENTATIONS)]  # [G, 6, 3]
    return (oriented == sides[:, None]).all(2).int().argmax(1)


def test_learning_rate_and_entropy_follow_their_schedules() -> None:
    config = tiny("--ppo.learning_rate=1e-3", "--placement.learning_rate=4e-3",
                  "--ppo.entropy_coef=0.01", "--ppo.final_entropy_coef=0.002",
                  "--ppo.max_iterations=10")  # fmt: skip
    runner = make_runner(config, None)
    alg = runner.alg
    alg.iteration = 5
    obs = rollout(runner)
    with torch.inference_mode():
        alg.compute_returns(obs)
    losses = alg.update()
    for name, rate in (("orientation", 5e-4), ("placement", 2e-3)):
        ppo = alg.learners[name]
        assert ppo.optimizer.param_groups[0]["lr"] == pytest.approx(rate)
        assert losses[f"{name}/learning_rate"] == pytest.approx(rate)
        assert ppo.entropy_coef == pytest.approx(0.006)


def test_in_bfloat16_an_update_moves_the_weights_as_in_float32_but_not_exactly() -> None:
    moves: dict[str, dict[str, Tensor]] = {}
    for precision in ("float32", "bfloat16"):
        with warnings.catch_warnings():  # some processors have no instructions for it
            warnings.simplefilter("ignore")
            runner = make_runner(tiny(f"--ppo.precision={precision}", "--ppo.optimizer=sgd"), None)
        before = {name: weights(runner, name) for name in runner.alg.learners}
        runner.train(1)
        moves[precision] = {}
        for name, old in before.items():
            after = weights(runner, name)
            moves[precision][name] = torch.cat([(after[key] - old[key]).flatten() for key in old])
        checkpoint = runner.checkpoint()
        assert checkpoint["config"]["ppo"]["precision"] == precision
        played = Loader().agent_of(checkpoint["agents"]["placement"], "placement")
        assert isinstance(played, LearnedAgent)
        assert played.actor.cnns.precision == torch.float32
    for name, move in moves["float32"].items():
        other = moves["bfloat16"][name]
        assert not torch.equal(move, other), name
        assert torch.cosine_similarity(move, other, 0) > 0.99, name
        assert float(other.norm() / move.norm()) == pytest.approx(1, abs=0.02), name


def test_the_kl_that_is_reported_is_that_of_the_old_policy_to_the_new() -> None:
    runner = make_runner(tiny(), None)
    obs = rollout(runner)
    with torch.inference_mode():
        runner.alg.compute_returns(obs)
        for ppo in runner.alg.learners.values():  # an old policy far from the new one
            mask = ppo.storage.observations["mask"]
            logits = torch.where(mask, 3 * torch.randn(mask.shape), -1e9)
            ppo.storage.distribution_params[0].copy_(logits.log_softmax(-1))
    losses = runner.alg.update()
    for name, ppo in runner.alg.learners.items():
        old = ppo.storage.distribution_params[0].flatten(0, 1)
        new = ppo.actor.log_probs(ppo.storage.observations.flatten(0, 1)).detach()
        kl = float((old.exp() * (old - new)).sum(1).mean())
        assert losses[f"{name}/kl"] == pytest.approx(kl, rel=1e-4)
        assert float((new.exp() * (new - old)).sum(1).mean()) != pytest.approx(kl, rel=0.1)


@pytest.mark.parametrize("schedule", ["fixed", "adaptive"])
def test_the_other_schedules_run(schedule: str) -> None:
    runner = make_runner(tiny(f"--ppo.schedule={schedule}", "--ppo.desired_kl=1e-9"), None)
    runner.train(2)
    rate = runner.alg.learners["placement"].optimizer.param_groups[0]["lr"]
    assert (rate == 7e-4) == (schedule == "fixed")


# --- learning -----------------------------------------------------------------------------------


def played(config: Config, policy: Policy) -> float:
    """Utilization of the config's one sequence."""

    def game(n: int, first: int) -> Packing:
        return make_game(config, n, 0, auto_reset=False, device="cpu", first_episode=first)

    return float(play(policy, game, 1).utilization.mean())


@pytest.mark.parametrize("joint", [False, True])
def test_the_trainer_learns_to_pack_a_tiny_bin_optimally(joint: bool, tmp_path: Path) -> None:
    """Ten boxes of 3 × 2 × 1 are the most that 4 × 4 × 4 holds; random play places eight."""
    path = tmp_path / "items.json"
    path.write_text(json.dumps({"bin": [4, 4, 4], "items": [[3, 2, 1]] * 12}))
    config = tiny(f"--game.items={path}", "--ppo.num_envs=64", "--ppo.num_steps_per_env=8",
                  "--ppo.learning_rate=3e-3", "--ppo.num_mini_batches=4", "--ppo.max_iterations=60",
                  "--placement.network.channels=16", f"--joint={str(joint).lower()}")  # fmt: skip
    sampled: list[float] = []  # utilization of the training's own episodes
    runner = make_runner(
        config, tmp_path, show=lambda progress: sampled.append(progress.utilization)
    )
    runner.train(60)
    assert sum(sampled[:3]) / 3 < 0.8
    assert sum(sampled[-3:]) / 3 > 0.9
    assert played(config, Loader().policy_of(runner.checkpoint())) == 60 / 64


@pytest.mark.parametrize("options", [
    ("--orientation.frozen=true", "--orientation.policy=random"),
    ("--orientation.frozen=true", "--orientation.policy=first"),
    ("--placement.frozen=true", "--placement.policy=random"),
    ("--placement.frozen=true", "--placement.policy=dblf"),
])  # fmt: skip
def test_a_frozen_heuristic_plays_and_the_other_agent_learns(options: tuple[str, ...]) -> None:
    runner = make_runner(tiny(*options), None)
    (learner,) = runner.alg.learners
    before = weights(runner, learner)
    runner.train(2)
    assert not same(before, weights(runner, learner))
    frozen = {"orientation", "placement"} - {learner}
    agents = runner.checkpoint()["agents"]
    assert agents[frozen.pop()] == {"name": options[1].partition("=")[2]}


def test_values_of_afterstates_grow_over_the_ramp_in_training_and_in_checkpoints(
    tmp_path: Path,
) -> None:
    """Agents that are loaded observe the share that they observed last, also as frozen agents."""
    planes = [f"--{name}.network.planes=[mask,afterstate_value]" for name in TWO_AGENTS]
    runner = make_runner(tiny(*planes, "--ppo.afterstate_ramp=[1,4]"), None)
    loader, path, shares = Loader(), tmp_path / "run.pt", []
    for iterations in range(1, 6):
        shares.append(runner.alg.lookahead.value_share)
        runner.train(iterations)
    assert shares == pytest.approx([0, 0, 1 / 3, 2 / 3, 1])
    runner = make_runner(tiny(*planes, "--ppo.afterstate_ramp=[1,5]"), None)
    runner.train(2)
    checkpoints.write(path, runner.checkpoint())
    agent = loader.orientation_agent(str(path))
    assert isinstance(agent, LearnedAgent)
    game, full = Packing(4, (4, 4, 4), sides=(1, 3)), Lookahead(agent.lookahead.critic)
    values, expected = agent.lookahead.afterstate_value(game), full.afterstate_value(game)
    assert torch.allclose(values[game.mask], expected[game.mask] / 4)
    assert (values[~game.mask] == ILLEGAL).all()
    other = make_runner(tiny("--placement.frozen=true", f"--placement.policy={path}"), None)
    other.train(1)
    record = checkpoints.agent_record(other.checkpoint(), "placement")
    assert record["value_share"] == 1 / 4


@pytest.mark.parametrize("frozen", ["orientation", "placement"])
def test_a_frozen_networks_weights_do_not_move_and_the_others_do(
    frozen: str, tmp_path: Path
) -> None:
    first = make_runner(tiny(), None)
    first.train(2)
    path = tmp_path / "first.pt"
    checkpoints.write(path, first.checkpoint())
    second = make_runner(tiny(f"--{frozen}.frozen=true", f"--{frozen}.policy={path}"), None)
    (learner,) = second.alg.learners
    assert learner != frozen
    before = weights(second, learner)
    second.train(2)
    assert not same(before, weights(second, learner))
    record = second.checkpoint()["agents"][frozen]
    own = first.checkpoint()["agents"][frozen]
    assert same(record["actor_state_dict"], own["actor_state_dict"])
    assert "optimizer_state_dict" not in record
    # It is that network which plays, its most probable action.
    game = second.env.game
    with torch.inference_mode():
        actions = second.alg.act(second.env.get_observations())
    if frozen == "orientation":
        plays = Loader().orientation_agent(str(path))(game)
        assert torch.equal(actions[:, 0], plays)
    else:
        plays = Loader().placement_agent(str(path))(game, actions[:, 0])
        assert torch.equal(actions[:, 1], plays)


def test_a_run_with_a_frozen_network_resumes_without_the_old_file(tmp_path: Path) -> None:
    first = make_runner(tiny(), None)
    path = tmp_path / "first.pt"
    checkpoints.write(path, first.checkpoint())
    config = tiny("--placement.frozen=true", f"--placement.policy={path}")
    second = make_runner(config, tmp_path / "run")
    second.train(1)
    path.unlink()
    latest = checkpoints.read(tmp_path / "run" / "latest.pt")
    resumed = make_runner(config, None, latest)
    resumed.train(2)
    stored = latest["agents"]["placement"]["actor_state_dict"]
    assert same(resumed.checkpoint()["agents"]["placement"]["actor_state_dict"], stored)


def test_how_often_a_run_is_evaluated_does_not_change_its_weights(tmp_path: Path) -> None:
    results = []
    for every in (0, 1):
        config = tiny(f"--evaluation.every={every}", "--evaluation.episodes=4")
        runner = make_runner(
            config, tmp_path / str(every), evaluate=lambda state, c=config: evaluation(c, state)
        )
        runner.train(3)
        results.append(weights(runner, "placement"))
    assert same(*results)


# --- stopping and resuming -----------------------------------------------------------------------


@pytest.mark.parametrize("options", [
    (), ("--joint=true",), ("--orientation.frozen=true", "--orientation.policy=random"),
    ("--ppo.schedule=adaptive", "--game.items=cut2"),
    ("--orientation.network.planes=[mask,afterstate_value]",
     "--placement.network.planes=[afterstate_value,feasible_cells]",
     "--ppo.afterstate_ramp=[1,4]"),
    ("--orientation.teacher=random", "--orientation.teacher_iterations=4"),
])  # fmt: skip
def test_a_resumed_run_gives_the_weights_of_one_never_stopped(
    options: tuple[str, ...], tmp_path: Path
) -> None:
    config = tiny(*options, "--ppo.max_iterations=5")
    whole = make_runner(config, tmp_path / "whole")
    whole.train(5)
    part = make_runner(config, tmp_path / "part")
    part.show = lambda progress: setattr(part, "stop_requested", progress.iteration == 2)
    with pytest.raises(RunInterruptedError):
        part.train(5)
    torch.manual_seed(12345)
    latest = checkpoints.read(tmp_path / "part" / "latest.pt")
    for record in latest["agents"].values():  # as versions without fused optimisers wrote it
        if "optimizer_state_dict" in record:
            record["optimizer_state_dict"]["param_groups"][0]["fused"] = None
    resumed = make_runner(config, tmp_path / "part", latest)
    assert resumed.current_learning_iteration == 2
    resumed.train(5)
    for name in whole.alg.learners:
        assert same(weights(whole, name), weights(resumed, name))
    if whole.alg.afterstates is not None:
        own, other = (runner.alg.afterstates.critic.state_dict() for runner in (whole, resumed))
        assert same(own, other)
    assert same(whole.env.game.state_dict(), resumed.env.game.state_dict())
    a, b = (checkpoints.read(tmp_path / run / "latest.pt") for run in ("whole", "part"))
    assert a["items"] == b["items"] == 5 * 16 * 4
    assert a["state"][0]["logger"]["rewbuffer"] == b["state"][0]["logger"]["rewbuffer"]


def test_another_games_state_is_refused(tmp_path: Path) -> None:
    first = make_runner(tiny(), tmp_path)
    first.train(1)
    latest = checkpoints.read(tmp_path / "latest.pt")
    other = make_runner(tiny("--game.bin=[5,5,5]"), None)
    with pytest.raises(ValueError, match="state of another game"):
        other.resume(latest)
    latest.pop("state")
    with pytest.raises(ValueError, match=r"latest\.pt"):
        other.resume(latest)


def test_a_stock_ppo_reads_an_agents_state(tmp_path: Path) -> None:
    runner = make_runner(tiny(), None)
    runner.train(1)
    path = tmp_path / "placement.pt"
    checkpoints.write(path, runner.checkpoint()["agents"]["placement"])
    other = make_runner(tiny("--seed=7"), None)
    stock = other.alg.learners["placement"]
    assert type(stock) is PPO
    assert not same(weights(other, "placement"), weights(runner, "placement"))
    stock.load(torch.load(path, weights_only=True), None, True)
    assert same(weights(other, "placement"), weights(runner, "placement"))
    assert stock.learning_rate == runner.alg.learners["placement"].learning_rate


def test_the_same_seed_gives_the_same_weights_and_another_seed_others() -> None:
    results = []
    for seed in (1, 1, 2):
        runner = make_runner(tiny(f"--seed={seed}"), None)
        runner.train(2)
        results.append(weights(runner, "orientation"))
    assert same(results[0], results[1])
    assert not same(results[0], results[2])
