"""The trainer: two stock PPOs as one, against numbers worked by hand and against itself."""

import json
from pathlib import Path

import pytest
import torch
from rsl_rl.algorithms import PPO
from torch import Tensor

from marl_pack import evaluate
from marl_pack.agents.learning import checkpoint
from marl_pack.agents.learning.runner import RunInterruptedError, Runner
from marl_pack.agents.learning.symmetry import see_through_symmetries
from marl_pack.agents.policy import Policy
from marl_pack.bins import ORIENTATIONS
from marl_pack.config import Config, parse
from marl_pack.game.packing import Packing
from marl_pack.train import evaluation, make_game, make_runner

TINY = (
    "--game.bin=[4,4,4]", "--game.sides=[1,3]", "--ppo.num_envs=16", "--ppo.num_steps_per_env=4",
    "--ppo.num_mini_batches=2", "--evaluation.every=0", "--output.latest_every=1",
    "--orientation.network.channels=8", "--orientation.network.layers=2",
    "--placement.network.channels=8", "--placement.network.layers=2",
)  # fmt: skip


def tiny(*options: str) -> Config:
    return parse([*TINY, *options])[0]


def weights(runner: Runner, name: str) -> dict[str, Tensor]:
    ppo = runner.alg.learners[name]
    both = {"actor": ppo.actor.state_dict(), "critic": ppo.critic.state_dict()}
    return {f"{k}.{n}": v.clone() for k, s in both.items() for n, v in s.items()}


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


# --- what PPO is told ---------------------------------------------------------------------------


def test_both_agents_store_the_same_reward_and_end_and_their_own_turn() -> None:
    runner = make_runner(tiny(), None)
    env, alg = runner.env, runner.alg
    obs = env.get_observations()
    rewards, dones = [], []
    with torch.inference_mode():
        for _ in range(4):
            game = env.game
            mask, items = game.mask.clone(), game.items.clone()
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
            assert torch.equal(first.observations["item"][step], items)
            for storage in (first, second):
                assert torch.equal(storage.observations["heightmap"][step], heights)
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
        obs = runner.env.get_observations()
        if name == "placement":
            obs = runner.env.orient(torch.zeros(1, dtype=torch.int64))
        ppo.compute_returns(obs)
        # δ₂ = 3 + ½·8 − 6 = 1; δ₁ = 2 − 5 = −3 (the episode ends); δ₀ = 1 + ½·5 − 4 = −½
        # A₂ = 1; A₁ = −3; A₀ = −½ + ¼·(−3) = −1¼; returns A + V
        assert storage.returns[:, 0, 0].tolist() == [2.75, 2.0, 7.0]
        advantage = torch.tensor([-1.25, -3.0, 1.0])
        normal = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        assert torch.allclose(storage.advantages[:, 0, 0], normal)


def test_the_last_states_value_is_of_an_orientation_drawn_there_and_nothing_moves() -> None:
    runner = make_runner(tiny(), None)
    before = runner.env.game.state_dict()
    seen = {}
    placement = runner.alg.learners["placement"]
    placement.compute_returns = lambda obs: seen.update(obs.items())
    with torch.inference_mode():
        runner.alg.compute_returns(runner.env.get_observations())
    assert same(before, runner.env.game.state_dict())
    drawn = runner.alg.learners["orientation"].actor.distribution
    assert drawn.log_probs.shape == (16, 6)
    sides = before["items"].gather(1, torch.tensor(ORIENTATIONS)[_orientations(seen, before)])
    assert torch.equal(sides, seen["item"])
    assert len(seen["item"].unique(dim=0)) > 1
    assert seen["mask"].any(1).all(), "a drawn orientation is legal"
    assert (_orientations(seen, before) > 0).any(), "not the first one always"


def _orientations(seen: dict[str, Tensor], before: dict[str, Tensor]) -> Tensor:
    """The first orientation that gives each item the sides that are seen."""
    turned = before["items"][:, torch.tensor(ORIENTATIONS)]  # [N, 6, 3]
    return (turned == seen["item"][:, None]).all(2).int().argmax(1)


def test_learning_rate_and_entropy_follow_their_schedules() -> None:
    config = tiny("--ppo.learning_rate=1e-3", "--placement.learning_rate=4e-3",
                  "--ppo.entropy_coef=0.01", "--ppo.final_entropy_coef=0.002",
                  "--ppo.max_iterations=10")  # fmt: skip
    alg = make_runner(config, None).alg
    alg.iteration = 5
    for name, rate in (("orientation", 5e-4), ("placement", 2e-3)):
        alg.anneal(name)
        ppo = alg.learners[name]
        assert ppo.optimizer.param_groups[0]["lr"] == pytest.approx(rate)
        assert ppo.entropy_coef == pytest.approx(0.006)


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

    return float(evaluate.play(policy, game, 1).utilization.mean())


@pytest.mark.parametrize("joint", [False, True])
def test_the_trainer_learns_to_pack_a_tiny_bin_as_well_as_can_be(
    joint: bool, tmp_path: Path
) -> None:
    """Ten boxes of 3 × 2 × 1 are the most that 4 × 4 × 4 holds; random play sets down eight."""
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
    assert played(config, checkpoint.load_policy(runner.checkpoint())) == 60 / 64


@pytest.mark.parametrize("options", [
    ("--orientation.frozen=true", "--orientation.policy=random"),
    ("--orientation.frozen=true", "--orientation.policy=first"),
    ("--placement.frozen=true", "--placement.policy=random"),
    ("--placement.frozen=true", "--placement.policy=dblf"),
])  # fmt: skip
def test_a_frozen_rule_plays_and_the_other_agent_learns(options: tuple[str, ...]) -> None:
    runner = make_runner(tiny(*options), None)
    (learner,) = runner.alg.learners
    before = weights(runner, learner)
    runner.train(2)
    assert not same(before, weights(runner, learner))
    frozen = {"orientation", "placement"} - {learner}
    agents = runner.checkpoint()["agents"]
    assert agents[frozen.pop()] == {"name": options[1].partition("=")[2]}


@pytest.mark.parametrize("frozen", ["orientation", "placement"])
def test_a_frozen_networks_weights_do_not_move_and_the_others_do(
    frozen: str, tmp_path: Path
) -> None:
    first = make_runner(tiny(), None)
    first.train(2)
    path = tmp_path / "first.pt"
    checkpoint.write(path, first.checkpoint())
    second = make_runner(tiny(f"--{frozen}.frozen=true", f"--{frozen}.policy={path}"), None)
    (learner,) = second.alg.learners
    assert learner != frozen
    before = weights(second, learner)
    second.train(2)
    assert not same(before, weights(second, learner))
    kept = second.checkpoint()["agents"][frozen]
    assert same(kept["actor_state_dict"], first.checkpoint()["agents"][frozen]["actor_state_dict"])
    assert "optimizer_state_dict" not in kept
    # It is that network which plays, its most probable action.
    game = second.env.game
    with torch.inference_mode():
        actions = second.alg.act(second.env.get_observations())
    if frozen == "orientation":
        plays = checkpoint.find_orientation_agent(str(path))(game)
        assert torch.equal(actions[:, 0], plays)
    else:
        plays = checkpoint.find_placement_agent(str(path))(game, actions[:, 0])
        assert torch.equal(actions[:, 1], plays)


def test_a_run_with_a_frozen_network_goes_on_without_the_old_file(tmp_path: Path) -> None:
    first = make_runner(tiny(), None)
    path = tmp_path / "first.pt"
    checkpoint.write(path, first.checkpoint())
    config = tiny("--placement.frozen=true", f"--placement.policy={path}")
    second = make_runner(config, tmp_path / "run")
    second.train(1)
    path.unlink()
    found = checkpoint.read(tmp_path / "run" / "latest.pt")
    resumed = make_runner(config, None, found)
    resumed.train(2)
    weights_kept = resumed.checkpoint()["agents"]["placement"]["actor_state_dict"]
    assert same(weights_kept, found["agents"]["placement"]["actor_state_dict"])


IMITATES = (
    "--orientation.imitate=dblf", "--orientation.imitate_iterations=25",
    "--placement.imitate=dblf", "--placement.imitate_iterations=20",
)  # fmt: skip


def test_what_an_agent_imitates_is_recorded_as_its_own_and_counts_as_a_success() -> None:
    runner = make_runner(tiny(*IMITATES, "--ppo.num_envs=256"), None)
    env, alg = runner.env, runner.alg
    obs = env.get_observations()
    orients, places = (
        checkpoint.find_orientation_agent("dblf"), checkpoint.find_placement_agent("dblf")
    )  # fmt: skip
    as_the_model = []
    with torch.inference_mode():
        for step in range(4):
            model = orients(env.game)
            actions = alg.act(obs)
            cell = places(env.game, actions[:, 0])
            as_the_model.append(actions == torch.stack((model, cell), 1))
            for name, taken in zip(("orientation", "placement"), actions.T, strict=True):
                transition = alg.learners[name].transition
                assert torch.equal(transition.actions.squeeze(1).long(), taken), (name, step)
            obs, *rest = env.step(actions)
            alg.process_env_step(obs, *rest)
        alike = torch.cat(as_the_model).float().mean(0)
        assert ((alike > 0.88) & (alike < 0.98)).all()  # one in ten is drawn, at times the same
        seen = {}
        placement = alg.learners["placement"]
        stock = placement.compute_returns
        placement.compute_returns = lambda last: (seen.update(last.items()), stock(last))
        before = {"items": env.game.items.clone()}
        model = orients(env.game)
        alg.compute_returns(obs)
        turned = before["items"].gather(1, torch.tensor(ORIENTATIONS)[model])
        assert (turned == seen["item"]).all(1).float().mean() > 0.88
        for ppo in alg.learners.values():
            storage = ppo.storage
            assert (storage.advantages == 1).all()
            assert (storage.returns - storage.values).std() > 0.01  # what the critic learns
            ppo.actor(storage.observations[3], stochastic_output=True)
            ours = ppo.actor.get_output_log_prob(storage.actions[3])
            assert torch.allclose(ours, storage.actions_log_prob[3].squeeze(1), atol=1e-5)


def test_an_agent_learns_to_play_as_its_model_and_then_on_its_own() -> None:
    runner = make_runner(tiny(*IMITATES, "--ppo.learning_rate=0.005"), None)
    dblf = checkpoint.find_policy("dblf")
    before = agreement(runner, dblf)
    runner.train(20)
    orientation, cell = agreement(runner, dblf)
    assert orientation > before[0] + 0.2
    assert cell > before[1] + 0.4
    runner.train(22)
    orientation, placement = (runner.alg.learners[n].storage for n in ("orientation", "placement"))
    assert (orientation.advantages == 1).all()
    assert len(placement.advantages.unique()) > 10
    runner.train(26)
    assert len(orientation.advantages.unique()) > 10


def agreement(runner: Runner, model: Policy) -> tuple[float, float]:
    """How often the networks choose the model's orientation, and then its cell, of several."""
    game = make_game(tiny(), 200, 7, auto_reset=True, device="cpu")
    found = runner.checkpoint()
    orients, places = (
        checkpoint.orientation_agent(found, "cpu"), checkpoint.placement_agent(found, "cpu")
    )  # fmt: skip
    turned, put = [], []
    for _ in range(5):
        orientation, cell = model(game)
        several = game.orientation_mask.sum(1) > 1
        turned.append((orients(game) == orientation)[several])
        several = game.orient(orientation).mask.flatten(1).sum(1) > 1
        put.append((places(game, orientation) == cell)[several])
        game.place(orientation, cell)
    return tuple(float(torch.cat(same).float().mean()) for same in (turned, put))


def test_where_orientations_are_not_masked_none_that_is_lost_is_drawn_to_imitate() -> None:
    config = tiny("--orientation.imitate=dblf", "--orientation.imitate_iterations=9",
                  "--game.mask_orientations=false")  # fmt: skip
    runner = make_runner(config, None)
    env = runner.env
    obs = env.get_observations()
    with torch.inference_mode():
        for _ in range(60):
            actions = runner.alg.act(obs)
            cells = env.game.mask[torch.arange(16), actions[:, 0]].flatten(1)
            assert cells.any(1).all()
            obs, *_ = env.step(actions)


def test_a_run_that_imitates_a_network_goes_on_without_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "first.pt"
    other = tiny("--seed=7", "--placement.network.planes=[mask,worth]",
                 "--placement.network.channels=4")  # fmt: skip
    checkpoint.write(path, make_runner(other, None).checkpoint())
    config = tiny("--placement.imitate=" + str(path), "--placement.imitate_iterations=3")
    whole = make_runner(config, None)
    model = checkpoint.find_placement_agent(str(path))
    with torch.inference_mode():
        actions = whole.alg.act(whole.env.get_observations())
    assert (actions[:, 1] == model(whole.env.game, actions[:, 0])).float().mean() > 0.5
    whole = make_runner(config, None)
    whole.train(5)
    part = make_runner(config, tmp_path / "run")
    part.train(2)
    path.unlink()
    found = checkpoint.read(tmp_path / "run" / "latest.pt")
    resumed = make_runner(config, None, found)
    resumed.train(5)
    for name in ("orientation", "placement"):
        assert same(weights(whole, name), weights(resumed, name))
    assert "imitated" in found["agents"]["placement"]
    assert "imitated" not in resumed.checkpoint()["agents"]["placement"]


@pytest.mark.parametrize("joint", [False, True])
def test_symmetry_begins_the_update_from_ratios_of_one(joint: bool) -> None:
    """Else the KL that the adaptive schedule sees is huge, and the learning rate collapses."""
    config = tiny("--ppo.symmetry=true", "--ppo.schedule=adaptive", "--ppo.desired_kl=0.02",
                  f"--joint={str(joint).lower()}")  # fmt: skip
    runner = make_runner(config, None)
    runner.train(3)
    for name, ppo in runner.alg.learners.items():
        assert ppo.learning_rate > 7e-4, name
    with torch.inference_mode():
        obs = runner.env.get_observations()
        for _ in range(4):
            actions = runner.alg.act(obs)
            obs, *rest = runner.env.step(actions)
            runner.alg.process_env_step(obs, *rest)
    for name, ppo in runner.alg.learners.items():
        see_through_symmetries(ppo, name)
        storage = ppo.storage
        for step in range(4):
            seen = storage.observations[step]
            ppo.actor(seen, stochastic_output=True)
            log_prob = ppo.actor.get_output_log_prob(storage.actions[step])
            assert torch.allclose(log_prob, storage.actions_log_prob[step, :, 0], atol=1e-5)
            assert (log_prob > -30).all(), "the moved action is legal in what is seen"


def test_how_often_a_run_is_evaluated_does_not_change_its_weights(tmp_path: Path) -> None:
    made = []
    for every in (0, 1):
        config = tiny(f"--evaluation.every={every}", "--evaluation.episodes=4")
        runner = make_runner(
            config, tmp_path / str(every), evaluate=lambda found, c=config: evaluation(c, found)
        )
        runner.train(3)
        made.append(weights(runner, "placement"))
    assert same(*made)


def test_a_critic_with_a_trunk_of_its_own_and_symmetry_learn_too() -> None:
    runner = make_runner(tiny("--ppo.symmetry=true", "--placement.network.share_trunk=false",
                              "--orientation.network.planes=[mask,rest,waste]"), None)  # fmt: skip
    before = weights(runner, "placement")
    runner.train(2)
    after = weights(runner, "placement")
    assert all(not torch.equal(before[n], after[n]) for n in before if n.endswith("weight"))


# --- stopping and going on ----------------------------------------------------------------------


@pytest.mark.parametrize("options", [
    (), ("--joint=true",), ("--orientation.frozen=true", "--orientation.policy=random"),
    ("--ppo.symmetry=true", "--ppo.schedule=adaptive", "--game.items=cut2"),
    ("--orientation.network.planes=[mask,worth]", "--placement.network.planes=[worth,room]"),
    ("--orientation.imitate=random", "--orientation.imitate_iterations=4"),
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
    found = checkpoint.read(tmp_path / "part" / "latest.pt")
    resumed = make_runner(config, tmp_path / "part", found)
    assert resumed.current_learning_iteration == 2
    resumed.train(5)
    for name in whole.alg.learners:
        assert same(weights(whole, name), weights(resumed, name))
    assert same(whole.env.game.state_dict(), resumed.env.game.state_dict())
    a, b = (checkpoint.read(tmp_path / run / "latest.pt") for run in ("whole", "part"))
    assert a["items"] == b["items"] == 5 * 16 * 4
    assert a["state"][0]["logger"]["rewbuffer"] == b["state"][0]["logger"]["rewbuffer"]


def test_another_games_state_is_refused(tmp_path: Path) -> None:
    first = make_runner(tiny(), tmp_path)
    first.train(1)
    found = checkpoint.read(tmp_path / "latest.pt")
    other = make_runner(tiny("--game.bin=[5,5,5]"), None)
    with pytest.raises(ValueError, match="state of another game"):
        other.resume(found)
    found.pop("state")
    with pytest.raises(ValueError, match=r"latest\.pt"):
        other.resume(found)


def test_a_stock_ppo_reads_an_agents_state(tmp_path: Path) -> None:
    runner = make_runner(tiny(), None)
    runner.train(1)
    path = tmp_path / "placement.pt"
    checkpoint.write(path, runner.checkpoint()["agents"]["placement"])
    other = make_runner(tiny("--seed=7"), None)
    stock = other.alg.learners["placement"]
    assert type(stock) is PPO
    assert not same(weights(other, "placement"), weights(runner, "placement"))
    stock.load(torch.load(path, weights_only=True), None, True)
    assert same(weights(other, "placement"), weights(runner, "placement"))
    assert stock.learning_rate == runner.alg.learners["placement"].learning_rate


def test_the_same_seed_gives_the_same_weights_and_another_seed_others() -> None:
    made = []
    for seed in (1, 1, 2):
        runner = make_runner(tiny(f"--seed={seed}"), None)
        runner.train(2)
        made.append(weights(runner, "orientation"))
    assert same(made[0], made[1])
    assert not same(made[0], made[2])
