"""Assemble a training run from its settings: the games, the agents and the runner."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.learning.ppo import first_observation
from marl_pack.agents.learning.runner import Runner
from marl_pack.agents.loading import Loader, record_of
from marl_pack.agents.networks.kinds import JOINT, SELECTION, TWO_AGENTS
from marl_pack.agents.networks.planes import need_critic
from marl_pack.bins import check_device
from marl_pack.config import Agent, Config, ConfigError, Selection
from marl_pack.evaluation.rollout import play
from marl_pack.evaluation.statistics import mean_utilization
from marl_pack.game.packing import Packing
from marl_pack.game.selection import SelectionPacking
from marl_pack.items import Stream, choose_stream
from marl_pack.vec_env import PackingVecEnv


def rank() -> int:
    """Return the rank of this process under torchrun; 0 if it is the only process."""
    return int(os.environ.get("RANK", "0"))


def local_device(config: Config) -> str:
    """Return the device of this process."""
    if config.device == "cuda" and int(os.environ.get("WORLD_SIZE", "1")) > 1:
        return f"cuda:{os.environ['LOCAL_RANK']}"
    return config.device


def derived_seed(*parts: int) -> int:
    """Derive a seed from numbers; it is large, so it differs from the seeds that users choose."""
    low, high = np.random.SeedSequence(parts).generate_state(2, np.uint32)
    return int(high >> 1) << 32 | int(low)


def fast_precision(precision: str, device: str) -> bool:
    """Return whether the device has instructions for a precision (``ppo.precision``)."""
    if precision == "float32":
        return True
    if torch.device(device).type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    supported: bool = torch.cpu._is_avx512_bf16_supported()
    return supported


def make_stream(config: Config) -> Stream:
    """Return the item stream of the game.

    Raises:
        ConfigError: if the stream has no items for this bin.
    """
    game = config.game
    try:
        return choose_stream(game.items, game.bin, game.sides)[0]
    except ValueError as error:
        raise ConfigError(f"game.items: {error}") from None


def make_game(
    config: Config, n: int, seed: int, *, auto_reset: bool, device: str, first_episode: int = 0
) -> Packing | SelectionPacking:
    """Return ``n`` games with the options in the settings."""
    kind = SelectionPacking if config.game.selects else Packing
    return kind(
        n, items=make_stream(config), spec=config.game, auto_reset=auto_reset, device=device,
        seed=seed, first_episode=first_episode,
    )  # fmt: skip


def agents_of(config: Config) -> dict[str, Agent | Selection]:
    """Return the settings of the agents that play, by name, in the order of their turns."""
    agents: dict[str, Agent | Selection] = {}
    if config.game.buffer * config.game.bins > 1:
        agents[SELECTION] = config.selection
    if config.joint:
        return agents | {JOINT: config.placement}
    return agents | {name: getattr(config, name) for name in TWO_AGENTS}


def other_agents(
    config: Config, checkpoint: Mapping[str, Any] | None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the records of the frozen agents and of the teachers, by the agents' names.

    Args:
        config: the settings of the run.
        checkpoint: the checkpoint of the run to resume, which contains the records; it has a
            teacher's record only as long as the teacher is cloned.

    Raises:
        ConfigError: if an agent cannot be loaded; the message names the key.
    """
    records: dict[str, dict[str, Any]] = {"policy": {}, "teacher": {}}
    for name, agent in agents_of(config).items():
        for key, source in (("policy", agent.policy), ("teacher", agent.teacher)):
            if source is None:
                continue
            if checkpoint is not None:
                stored = checkpoints.agent_of(checkpoint, name)
                record = stored if agent.frozen else stored.get("teacher")
                if record is None and checkpoint["iter"] + 1 < agent.teacher_iterations:
                    raise ConfigError(f"{name}.{key}: agents.{name}.teacher is missing")
            else:
                try:
                    record = record_of(source, name)
                except (ValueError, FileNotFoundError) as error:
                    raise ConfigError(f"{name}.{key}: {error}") from None
            if record is not None:
                records[key][name] = record
    return records["policy"], records["teacher"]


def runner_settings(
    config: Config, frozen: Mapping[str, Any], teachers: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the configuration of :class:`marl_pack.agents.learning.runner.Runner`.

    Args:
        config: the settings of the run.
        frozen, teachers: the records that :func:`other_agents` returns.
    """
    ppo = asdict(config.ppo)
    steps, iterations = ppo.pop("num_steps_per_env"), ppo.pop("max_iterations")
    final_entropy, schedule = ppo.pop("final_entropy_coef"), ppo.pop("schedule")
    precision, ramp = ppo.pop("precision"), ppo.pop("afterstate_ramp")
    ppo.pop("num_envs")
    ppo["schedule"] = "adaptive" if schedule == "adaptive" else "fixed"

    def learner(name: str, agent: Agent | Selection) -> dict[str, Any]:
        rate = ppo["learning_rate"] if agent.learning_rate is None else agent.learning_rate
        entropy = ppo["entropy_coef"] if agent.entropy_coef is None else agent.entropy_coef
        last = final_entropy if agent.final_entropy_coef is None else agent.final_entropy_coef
        return {
            "network": asdict(agent.network),
            "precision": precision,
            "algorithm": {**ppo, "learning_rate": rate, "entropy_coef": entropy},
            "teacher": teachers.get(name),
            "teacher_iterations": agent.teacher_iterations,
            "teacher_random": agent.teacher_random,
            "schedule": {
                "schedule": schedule, "learning_rate": rate, "entropy_coef": entropy,
                "final_entropy_coef": entropy if last is None else last,
            },
        }  # fmt: skip

    logger: str | dict[str, Any] = "tensorboard"
    if config.output.logger == "wandb":
        logger = {"class_name": "WandbLogWriter", "project_name": config.output.wandb_project}
    return {
        "num_steps_per_env": steps,
        "save_interval": config.output.keep_every,
        "check_for_nan": True,
        "logger": logger,
        "algorithm": {
            "class_name": "marl_pack.agents.learning.ppo:PackingPPO", "iterations": iterations,
            "afterstate_ramp": ramp,
        },
        "agents": {
            name: {"record": frozen[name]} if name in frozen else learner(name, agent)
            for name, agent in agents_of(config).items()
        },
        "latest_every": config.output.latest_every,
        "evaluate_every": config.evaluation.every,
    }  # fmt: skip


def make_runner(
    config: Config,
    folder: Path | None,
    checkpoint: Mapping[str, Any] | None = None,
    **reports: Callable[..., Any],
) -> Runner:
    """Return the runner of a run; with a checkpoint, the run is resumed.

    Args:
        config: the settings of the run.
        folder: the folder of the run; None writes no files.
        checkpoint: the checkpoint of the run to resume.
        **reports: the arguments ``evaluate``, ``show`` and ``evaluated`` of the runner.

    Raises:
        ConfigError: if a setting is impossible.
    """
    device = local_device(config)
    try:
        check_device(device)
        precision = config.ppo.precision
        if not fast_precision(precision, device):
            warnings.warn(
                f"ppo.precision = {precision}: this processor has no instructions for it "
                "(AVX512-BF16 on CPUs), so it is probably slower than float32",
                stacklevel=2,
            )
        torch.manual_seed(config.seed)
        frozen, teachers = other_agents(config, checkpoint)
        settings = runner_settings(config, frozen, teachers)
        game = make_game(
            config, config.ppo.num_envs, derived_seed(config.seed, rank()), auto_reset=True,
            device=device,
        )  # fmt: skip
        learners = {n: a["network"] for n, a in settings["agents"].items() if "network" in a}
        values = any(n == SELECTION or need_critic(a["planes"]) for n, a in learners.items())
        critic = AfterstateCritic().to(device) if values else None
        lookahead = Lookahead(critic)
        loader = Loader(device, None, memo=lookahead.memo)
        settings["algorithm"] |= {
            "lookahead": lookahead,
            "frozen": {name: loader.agent_of(record, name) for name, record in frozen.items()},
            "teachers": {name: loader.agent_of(record, name) for name, record in teachers.items()},
        }
        first = next(iter(settings["agents"]))
        planes = learners.get(first, {}).get("planes", ())
        env = PackingVecEnv(
            game,
            lambda games: first_observation(first, games, planes, lookahead, first in learners),
            config,
        )
        runner = Runner(env, settings, folder, device, config=config.to_dict(), **reports)
        torch.manual_seed(derived_seed(config.seed, rank(), 1))  # processes draw different actions
        if checkpoint is not None:
            runner.resume(checkpoint)
        elif config.init is not None:
            runner.begin_with(checkpoints.read(config.init, device))
    except (ValueError, FileNotFoundError) as error:
        raise ConfigError(str(error)) from None
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "memory" not in str(error):
            raise
        raise ConfigError(f"too little memory for these settings: {error}") from None
    return runner


def evaluation(config: Config, checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Play held-out sequences with a checkpoint's agents; return the statistics of utilization."""
    device = local_device(config)
    policy = Loader(device, config.evaluation.seed).policy_of(checkpoint)

    def game(n: int, first_episode: int) -> Any:
        return make_game(
            config, n, config.evaluation.seed, auto_reset=False, device=device,
            first_episode=first_episode,
        )  # fmt: skip

    stream = make_stream(config)
    episodes = min(config.evaluation.episodes, stream.episodes or config.evaluation.episodes)
    statistics = mean_utilization(play(policy, game, episodes))
    return {"seed": config.evaluation.seed, **statistics}
