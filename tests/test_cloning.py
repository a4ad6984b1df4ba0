"""Behaviour cloning: an agent begins by learning a teacher's choices, then learns on its own."""

from pathlib import Path

import torch
from small_runs import recorded_game, same, tiny, weights

from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.learning.runner import Runner
from marl_pack.agents.loading import Loader
from marl_pack.agents.policy import Policy
from marl_pack.geometry import ORIENTATIONS
from marl_pack.training.assembly import make_game, make_runner

CLONING = (
    "--orientation.teacher=dblf", "--orientation.teacher_iterations=25",
    "--placement.teacher=dblf", "--placement.teacher_iterations=20",
)  # fmt: skip


def test_a_teachers_choices_are_recorded_as_the_learners_own_and_count_as_a_success() -> None:
    runner = make_runner(tiny(*CLONING, "--ppo.num_envs=256"), None)
    env, alg = runner.env, runner.alg
    obs = env.get_observations()
    first, second = Loader().orientation_agent("dblf"), Loader().placement_agent("dblf")
    agreements = []
    with torch.inference_mode():
        for step in range(4):
            orientation = first(env.game)
            actions = alg.act(obs)
            cell = second(env.game, actions[:, 0])
            agreements.append(actions == torch.stack((orientation, cell), 1))
            for name, taken in zip(("orientation", "placement"), actions.T, strict=True):
                transition = alg.learners[name].transition
                assert torch.equal(transition.actions.squeeze(1).long(), taken), (name, step)
            obs, *rest = env.step(actions)
            alg.process_env_step(obs, *rest)
        agreement = torch.cat(agreements).float().mean(0)
        # One in ten is drawn, at times the same.
        assert ((agreement > 0.88) & (agreement < 0.98)).all()
        last = {}
        placement = alg.learners["placement"]
        stock = placement.compute_returns
        placement.compute_returns = lambda obs: (last.update(obs.items()), stock(obs))
        items = env.game.items.sides.clone()
        orientation = first(env.game)
        alg.compute_returns(obs)
        sides = items.gather(1, torch.tensor(ORIENTATIONS)[orientation])
        assert (sides == recorded_game(last, env.game.size)[1]).all(1).float().mean() > 0.88
        for ppo in alg.learners.values():
            storage = ppo.storage
            assert (storage.advantages == 1).all()
            assert (storage.returns - storage.values).std() > 0.01  # what the critic learns
            ppo.actor(storage.observations[3], stochastic_output=True)
            log_prob = ppo.actor.get_output_log_prob(storage.actions[3])
            assert torch.allclose(log_prob, storage.actions_log_prob[3].squeeze(1), atol=1e-5)


def test_an_agent_learns_to_play_as_its_teacher_and_then_on_its_own() -> None:
    runner = make_runner(tiny(*CLONING, "--ppo.learning_rate=0.005"), None)
    dblf = Loader().policy("dblf")
    before = agreement(runner, dblf)
    runner.train(20)
    orientation, cell = agreement(runner, dblf)
    assert orientation > before[0] + 0.2
    assert cell > before[1] + 0.4
    runner.train(22)
    first, second = (runner.alg.learners[n].storage for n in ("orientation", "placement"))
    assert (first.advantages == 1).all()
    assert len(second.advantages.unique()) > 10
    runner.train(26)
    assert len(first.advantages.unique()) > 10


def agreement(runner: Runner, teacher: Policy) -> tuple[float, float]:
    """Return how often the networks choose the teacher's orientation, and then its cell.

    Only choices among several count.
    """
    game = make_game(tiny(), 200, 7, auto_reset=True, device="cpu")
    checkpoint, loader = runner.checkpoint(), Loader()
    first = loader.orientation_agent_of(checkpoints.agent_record(checkpoint, "orientation"))
    second = loader.placement_agent_of(checkpoints.agent_record(checkpoint, "placement"))
    orientations, cells = [], []
    for _ in range(5):
        orientation, cell = teacher(game)
        several = game.orientation_mask.sum(1) > 1
        orientations.append((first(game) == orientation)[several])
        several = game.orient(orientation).mask.flatten(1).sum(1) > 1
        cells.append((second(game, orientation) == cell)[several])
        game.place(orientation, cell)
    return tuple(float(torch.cat(same).float().mean()) for same in (orientations, cells))


def test_where_orientations_are_not_masked_a_teacher_draws_none_without_a_legal_cell() -> None:
    config = tiny("--orientation.teacher=dblf", "--orientation.teacher_iterations=9",
                  "--game.mask_orientations=false")  # fmt: skip
    runner = make_runner(config, None)
    env = runner.env
    obs = env.get_observations()
    with torch.inference_mode():
        for _ in range(60):
            actions = runner.alg.act(obs)
            assert env.game.moves.of(actions[:, 0]).flatten(1).any(1).all()
            obs, *_ = env.step(actions)


def test_a_run_that_clones_a_network_resumes_without_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "first.pt"
    other = tiny("--seed=7", "--placement.network.planes=[mask,afterstate_value]",
                 "--placement.network.channels=4")  # fmt: skip
    checkpoints.write(path, make_runner(other, None).checkpoint())
    config = tiny(f"--placement.teacher={path}", "--placement.teacher_iterations=3")
    whole = make_runner(config, None)
    teacher = Loader().placement_agent(str(path))
    with torch.inference_mode():
        actions = whole.alg.act(whole.env.get_observations())
    assert (actions[:, 1] == teacher(whole.env.game, actions[:, 0])).float().mean() > 0.5
    whole = make_runner(config, None)
    whole.train(5)
    part = make_runner(config, tmp_path / "run")
    part.train(2)
    path.unlink()
    latest = checkpoints.read(tmp_path / "run" / "latest.pt")
    resumed = make_runner(config, None, latest)
    resumed.train(5)
    for name in ("orientation", "placement"):
        assert same(weights(whole, name), weights(resumed, name))
    assert "afterstate_critic" in latest["agents"]["placement"]["teacher"]
    assert "afterstate_critic" not in latest, "the run's agents see no values"
    assert "teacher" not in resumed.checkpoint()["agents"]["placement"]
