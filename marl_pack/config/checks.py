"""Check settings beyond what their types can."""

from __future__ import annotations

import math

from marl_pack.config.schema import Agent, Config


class ConfigError(ValueError):
    """A setting is impossible; the message says what would be right."""


def refuse(key: str, value: object, right: str) -> None:
    """Raise ConfigError naming the key, its value and what would be right."""
    raise ConfigError(f"{key} = {value}: {right}")


def check(config: Config) -> None:
    """Refuse settings that have the right type and are impossible.

    Raises:
        ConfigError: naming the key and what would be right.
    """
    check_ppo(config)
    check_run(config)
    check_agents(config)


def check_ppo(config: Config) -> None:
    """Refuse impossible settings of the updates."""
    ppo = config.ppo
    for key in ("num_envs", "num_steps_per_env", "max_iterations", "num_learning_epochs",
                "num_mini_batches"):  # fmt: skip
        if getattr(ppo, key) < 1:
            refuse(f"ppo.{key}", getattr(ppo, key), "needs 1 or more")
    if 2 * ppo.num_mini_batches > ppo.num_envs * ppo.num_steps_per_env:
        refuse(
            "ppo.num_mini_batches", ppo.num_mini_batches,
            f"each needs 2 items, an iteration has only {ppo.num_envs * ppo.num_steps_per_env}",
        )  # fmt: skip
    for key in ("gamma", "lam"):
        if not 0 <= getattr(ppo, key) <= 1:
            refuse(f"ppo.{key}", getattr(ppo, key), "needs a number from 0 to 1")
    for key in ("learning_rate", "clip_param", "max_grad_norm", "desired_kl"):
        value = getattr(ppo, key)
        if not (math.isfinite(value) and value > 0):
            refuse(f"ppo.{key}", value, "needs a positive number")
    for section, values in (
        ("ppo", (ppo.entropy_coef, ppo.final_entropy_coef, ppo.value_loss_coef)),
        ("orientation", _own(config.orientation)),
        ("placement", _own(config.placement)),
    ):
        for value in values:
            if value is not None and not (math.isfinite(value) and value >= 0):
                refuse(section, value, "coefficients and rates need finite numbers, 0 or more")
    if ppo.symmetry and any(config.game.com_offset):
        refuse("ppo.symmetry", "true", "items whose centre of mass is off centre do not mirror")
    orientations = set(config.game.orientations)
    if ppo.symmetry and {o ^ 1 for o in orientations} != orientations:
        refuse("ppo.symmetry", "true", "game.orientations needs the pairs 0 1, 2 3 and 4 5 whole")


def check_run(config: Config) -> None:
    """Refuse impossible settings of the process, the evaluation and the output."""
    evaluation, output = config.evaluation, config.output
    if config.threads < 1:
        refuse("threads", config.threads, "needs 1 or more")
    for key, value in (("seed", config.seed), ("evaluation.seed", evaluation.seed)):
        if value < 0:
            refuse(key, value, "needs 0 or more")
    if evaluation.every < 0:
        refuse("evaluation.every", evaluation.every, "needs 0 (never) or more")
    if evaluation.episodes < 2:
        refuse("evaluation.episodes", evaluation.episodes, "needs 2 or more")
    for key in ("latest_every", "keep_every"):
        if getattr(output, key) < 1:
            refuse(f"output.{key}", getattr(output, key), "needs 1 or more")
    if output.name in ("", ".", "..") or (output.name is not None and "/" in output.name):
        refuse("output.name", repr(output.name), "needs the name of one folder")


def check_agents(config: Config) -> None:
    """Refuse impossible settings of the agents that play and learn."""
    for name, agent in (("orientation", config.orientation), ("placement", config.placement)):
        if agent.frozen and agent.policy is None:
            refuse(f"{name}.policy", "null", "a frozen agent needs one: say who plays it")
        if not agent.frozen and agent.policy is not None:
            refuse(f"{name}.policy", agent.policy, f"goes with {name}.frozen: true")
        if (agent.frozen or agent.policy) and config.joint:
            refuse(f"{name}.frozen", "true", "the joint agent cannot be frozen in part")
        check_teacher(name, agent, config)
    if config.orientation.frozen and config.placement.frozen:
        refuse("placement.frozen", "true", "both agents are frozen, so nothing would learn")
    if config.joint and not config.game.mask_orientations:
        refuse("game.mask_orientations", "false", "the joint agent's pairs are always masked")


def check_teacher(name: str, agent: Agent, config: Config) -> None:
    """Refuse a teacher without a number of iterations, or without a learner that can clone it.

    Raises:
        ConfigError: naming the key and what would be right.
    """
    key, duration = f"{name}.teacher = {agent.teacher}", f"{name}.teacher_iterations"
    iterations = agent.teacher_iterations
    if agent.teacher is None:
        if iterations != 0:
            raise ConfigError(f"{duration} = {iterations}: goes with {name}.teacher")
        return
    if iterations < 1:
        raise ConfigError(f"{duration} = {iterations}: needs 1 or more")
    if agent.frozen:
        raise ConfigError(f"{key}: a frozen agent does not learn")
    if config.joint:
        raise ConfigError(f"{key}: the joint agent clones no teacher")
    if config.ppo.normalize_advantage_per_mini_batch:
        raise ConfigError(f"{key}: needs ppo.normalize_advantage_per_mini_batch: false")


def _own(agent: Agent) -> tuple[float | None, ...]:
    return agent.learning_rate, agent.entropy_coef, agent.final_entropy_coef
