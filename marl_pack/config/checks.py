"""Check what the types of settings cannot check: ranges and combinations of values."""

from __future__ import annotations

from typing import NamedTuple

from marl_pack.agents.keys import ORIENTATION_AGENTS, POLICIES, SELECTION_AGENTS
from marl_pack.checks import LARGEST_SEED, shown
from marl_pack.config.schema import Agent, Config, Selection
from marl_pack.options import MOST_AT_ONCE


class ConfigError(ValueError):
    """A setting is impossible; the message says what would be right."""


class Range(NamedTuple):
    """The range of numbers that a setting may have."""

    low: float
    high: float
    open: bool = False  # whether low itself is too low

    def __contains__(self, value: object) -> bool:
        low_enough = self.low < value if self.open else self.low <= value  # type: ignore[operator]  # only numbers have ranges
        return bool(low_enough and value <= self.high)  # type: ignore[operator]  # NaN is not in

    def __str__(self) -> str:
        if self.open:
            return f"a positive number, {self.high:,} at most"
        return f"a number from {self.low:,} to {self.high:,}"


MANY, SEEDS, SHARE = Range(1, 10**9), Range(0, LARGEST_SEED), Range(0, 1)
FASTEST = 1e30  # learning rate; optimisers divide it, and float32 ends at 3e38
POSITIVE, NOT_NEGATIVE = Range(0, 1e38, open=True), Range(0, 1e38)
AGENTS = {"selection": SELECTION_AGENTS, "orientation": ORIENTATION_AGENTS, "placement": POLICIES}
"""The heuristics that can play each agent, by the agent's name."""
RANGES = {
    "seed": SEEDS,
    "threads": Range(1, MOST_AT_ONCE),
    "ppo.num_envs": Range(1, 10**6),
    "ppo.num_steps_per_env": Range(1, 10**6),
    "ppo.max_iterations": MANY,
    "ppo.num_learning_epochs": Range(1, 10**6),
    "ppo.num_mini_batches": MANY,
    "ppo.gamma": SHARE,
    "ppo.lam": SHARE,
    "ppo.clip_param": POSITIVE,
    "ppo.value_loss_coef": NOT_NEGATIVE,
    "ppo.entropy_coef": NOT_NEGATIVE,
    "ppo.final_entropy_coef": NOT_NEGATIVE,
    "ppo.learning_rate": Range(0, FASTEST, open=True),
    "ppo.desired_kl": POSITIVE,
    "ppo.max_grad_norm": POSITIVE,
    "evaluation.every": Range(0, 10**9),
    "evaluation.episodes": Range(2, 10**7),
    "evaluation.seed": SEEDS,
    "output.latest_every": MANY,
    "output.keep_every": MANY,
    **{
        f"{agent}.{key}": NOT_NEGATIVE
        for agent in AGENTS
        for key in ("entropy_coef", "final_entropy_coef")
    },
    **{f"{agent}.teacher_random": SHARE for agent in AGENTS},
    **{f"{agent}.learning_rate": Range(0, FASTEST) for agent in AGENTS},
}
"""The range of each setting; the records of the game and of networks check their own fields."""


def refuse(key: str, value: object, right: str) -> None:
    """Raise ConfigError naming the key, its value and what would be right."""
    text = value if isinstance(value, str) and value.isidentifier() else shown(value)
    raise ConfigError(f"{key} = {text}: {right}")


def check(config: Config) -> None:
    """Refuse settings that have the right type but are impossible.

    Raises:
        ConfigError: naming the key and what would be right.
    """
    values = config.flat()
    for key, allowed in RANGES.items():
        if values[key] is not None and values[key] not in allowed:
            refuse(key, values[key], f"needs {allowed}")
    check_ppo(config)
    check_output(config)
    check_agents(config)


def check_ppo(config: Config) -> None:
    """Refuse impossible combinations of the settings under ``ppo:``."""
    ppo = config.ppo
    first, last = ppo.afterstate_ramp
    if not 0 <= first <= last:
        refuse("ppo.afterstate_ramp", [first, last], "needs two iterations in order, 0 or more")
    if 2 * ppo.num_mini_batches > ppo.num_envs * ppo.num_steps_per_env:
        refuse(
            "ppo.num_mini_batches", ppo.num_mini_batches,
            f"each needs 2 items, an iteration has only {ppo.num_envs * ppo.num_steps_per_env}",
        )  # fmt: skip


def check_output(config: Config) -> None:
    """Refuse an impossible name or path of the run's folder."""
    name, folder = config.output.name, config.output.folder
    if name is not None and (name in ("", ".", "..") or "/" in name or not name.isprintable()):
        refuse("output.name", name, "needs the name of one folder")
    if not folder or "\0" in folder:
        refuse("output.folder", folder, "needs the path of a folder")


def check_agents(config: Config) -> None:
    """Refuse impossible settings of the agents."""
    agents: list[Agent | Selection] = [config.selection, config.orientation, config.placement]
    for (name, heuristics), agent in zip(AGENTS.items(), agents, strict=True):
        if agent.frozen and agent.policy is None:
            refuse(
                f"{name}.policy", "null",
                f"a frozen agent needs one: {', '.join(heuristics)}, a published model, or a run's "
                "folder or checkpoint",
            )  # fmt: skip
        if not agent.frozen and agent.policy is not None:
            refuse(f"{name}.policy", agent.policy, f"needs {name}.frozen: true")
        if (agent.frozen or agent.policy) and config.joint and name != "selection":
            refuse(f"{name}.frozen", "true", "the joint agent cannot be frozen in part")
        check_teacher(name, agent, config)
    selects = config.game.buffer * config.game.bins > 1
    if not selects and config.selection != Selection():
        raise ConfigError(
            "selection: needs game.buffer or game.bins of more than 1; otherwise there is nothing "
            "to select"
        )
    if all(agent.frozen for agent in agents[not selects :]):
        refuse("placement.frozen", "true", "all agents are frozen, so nothing would learn")
    if config.joint and not config.game.mask_orientations:
        refuse("game.mask_orientations", "false", "the joint agent's pairs are always masked")


def check_teacher(name: str, agent: Agent | Selection, config: Config) -> None:
    """Refuse a teacher without a number of iterations, or without a learner that can clone it.

    Raises:
        ConfigError: naming the key and what would be right.
    """
    key, duration = f"{name}.teacher = {agent.teacher}", f"{name}.teacher_iterations"
    iterations = agent.teacher_iterations
    if agent.teacher is None:
        if iterations != 0:
            refuse(duration, iterations, f"needs {name}.teacher")
        return
    if iterations not in MANY:
        refuse(duration, iterations, f"needs {MANY}")
    if agent.frozen:
        raise ConfigError(
            f"{key}: a frozen agent does not learn; give {name}.teacher null and {duration} 0"
        )
    if config.joint and name != "selection":
        raise ConfigError(f"{key}: the joint agent clones no teacher")
    if config.ppo.normalize_advantage_per_mini_batch:
        raise ConfigError(f"{key}: needs ppo.normalize_advantage_per_mini_batch: false")
