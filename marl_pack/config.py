"""The settings of a training run: typed, each with its meaning, from YAML and the command line.

``configs/rs.yaml`` holds every key with its default. The classes' docstrings are what
``python -m marl_pack.train --help`` shows.
"""

from __future__ import annotations

import contextlib
import difflib
import math
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import yaml
from jsonargparse import ArgumentError, ArgumentParser, Namespace

from marl_pack.agents.networks.trunk import Network
from marl_pack.bins import check_size
from marl_pack.game.packing import ALL_ORIENTATIONS
from marl_pack.items import DEFAULT_SIDES


@dataclass
class Game:
    """The packing game (docs/environment.md).

    Args:
        bin: size W, D, H in cells.
        items: what the conveyor brings: rs, cut1, cut2, or a file of sequences (.npz, .json, .csv).
        sides: shortest and longest side of generated items, in cells.
        rule: stability rule of the masks.
        margin: cells by which the support polygon is shrunk; null for none.
        thresholds: thresholds of the rule area_ratio, paper or code; null for its default.
        orientations: indices of the orientations that may be chosen, of 0 to 5.
        mask_orientations: whether orientations without a stable cell are excluded; else choosing
            one ends the episode.
        alpha: weight of the volume gained in the reward (Eq. 5).
        beta: weight of the space wasted in the reward (Eq. 5).
        com_offset: centre of mass of the items from their middle, in fractions of w, d, h.
    """

    bin: tuple[int, int, int] = (10, 10, 10)
    items: str = "rs"
    sides: tuple[int, int] = DEFAULT_SIDES
    rule: Literal["hull_1", "hull_alpha", "area_ratio", "lbcp", "equilibrium", "none"] = (
        "hull_alpha"
    )
    margin: float | None = None
    thresholds: Literal["paper", "code"] | None = None
    orientations: list[int] = field(default_factory=lambda: list(ALL_ORIENTATIONS))
    mask_orientations: bool = True
    alpha: float = 1.0
    beta: float = 1.0
    com_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def rule_parameters(self) -> dict[str, Any]:
        """What is bound to the rule."""
        named = {"margin": self.margin, "thresholds": self.thresholds}
        return {key: value for key, value in named.items() if value is not None}


@dataclass
class Agent:
    """One of the two agents.

    Args:
        frozen: whether it plays without learning.
        policy: who plays a frozen agent: random, dblf, height_min, best_fit, most_room, for the
            orientation agent also first (as the item comes), or a run's folder or checkpoint.
        network: shape of its network.
        imitate: whose choices it learns at first, as for policy; null for nobody's.
        imitate_iterations: for how many iterations.
        learning_rate: the agent's own, in place of ppo.learning_rate; null for that.
        entropy_coef: the agent's own, in place of ppo.entropy_coef; null for that.
        final_entropy_coef: the agent's own, in place of ppo.final_entropy_coef; null for that.
    """

    frozen: bool = False
    policy: str | None = None
    network: Network = field(default_factory=Network)
    imitate: str | None = None
    imitate_iterations: int = 0
    learning_rate: float | None = None
    entropy_coef: float | None = None
    final_entropy_coef: float | None = None


@dataclass
class PPO:
    """Proximal policy optimization, by the names that rsl_rl gives these.

    Args:
        num_envs: bins played at once (by each process).
        num_steps_per_env: items placed in each bin between two updates.
        max_iterations: updates in all; a run sees num_envs * num_steps_per_env * max_iterations
            items (times the number of processes).
        num_learning_epochs: passes over the items of one iteration.
        num_mini_batches: minibatches in each pass.
        gamma: discount of the reward, per item.
        lam: lambda of the generalised advantage estimate.
        clip_param: largest change of an action's probability, relative, that is rewarded.
        value_loss_coef: weight of the critic's loss.
        use_clipped_value_loss: whether the critic's change is clipped by clip_param as well.
        entropy_coef: bonus for the entropy of the actions, at the start.
        final_entropy_coef: that bonus at the end, linear between; null for no change.
        learning_rate: step size of the optimiser, at the start.
        schedule: learning rate over the run: fixed; linear, down to 0 at the end; or adaptive, by
            the KL divergence.
        desired_kl: KL divergence of an update that the adaptive schedule aims at.
        max_grad_norm: longest gradient of the actor, and of the critic.
        normalize_advantage_per_mini_batch: normalise advantages there, not over the iteration.
        optimizer: the optimiser, one of torch's.
        symmetry: show each sample to the update through a random symmetry of the bin.
    """

    num_envs: int = 256
    num_steps_per_env: int = 16
    max_iterations: int = 300
    num_learning_epochs: int = 2
    num_mini_batches: int = 32
    gamma: float = 1.0
    lam: float = 0.96
    clip_param: float = 0.2
    value_loss_coef: float = 0.5
    use_clipped_value_loss: bool = False
    entropy_coef: float = 0.005
    final_entropy_coef: float | None = None
    learning_rate: float = 7e-4
    schedule: Literal["fixed", "linear", "adaptive"] = "linear"
    desired_kl: float = 0.01
    max_grad_norm: float = 1.0
    normalize_advantage_per_mini_batch: bool = False
    optimizer: Literal["adam", "adamw", "sgd", "rmsprop"] = "adam"
    symmetry: bool = False


@dataclass
class Evaluation:
    """Evaluation during training: the most probable actions, on generated sequences held out.

    Args:
        every: iterations between evaluations (and one at the end); 0 for none at all.
        episodes: how many sequences.
        seed: seed of those sequences; training draws others.
    """

    every: int = 20
    episodes: int = 1000
    seed: int = 2024


@dataclass
class Output:
    """Where the run is kept.

    Args:
        folder: where the runs' folders are made.
        name: name of the run's folder; null for one made of the date and time.
        logger: where scalars go: tensorboard, or wandb (which keeps TensorBoard's files as well).
        wandb_project: the project on Weights & Biases.
        latest_every: iterations between checkpoints to resume from.
        keep_every: iterations between checkpoints that are all kept.
    """

    folder: str = "runs"
    name: str | None = None
    logger: Literal["tensorboard", "wandb"] = "tensorboard"
    wandb_project: str = "marl_pack"
    latest_every: int = 5
    keep_every: int = 100


@dataclass
class Config:
    """A training run.

    Args:
        seed: seed of weights, actions and items.
        device: where everything happens: cpu, cuda, or cuda:1; with torchrun, cuda means each
            process's own GPU.
        threads: threads on the CPU.
        joint: one agent that chooses the pair (orientation, cell) in place of the two; its network
            is placement.network.
        init: a run's folder or checkpoint whose weights the learning agents begin with; null for
            fresh ones.
        game: the game.
        orientation: the agent that turns the item.
        placement: the agent that sets it down.
        ppo: how they learn.
        evaluation: evaluation during training.
        output: where the run is kept.
    """

    seed: int = 0
    device: str = "cpu"
    threads: int = 1
    joint: bool = False
    init: str | None = None
    game: Game = field(default_factory=Game)
    orientation: Agent = field(default_factory=Agent)
    placement: Agent = field(default_factory=Agent)
    ppo: PPO = field(default_factory=PPO)
    evaluation: Evaluation = field(default_factory=Evaluation)
    output: Output = field(default_factory=Output)

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, dicts and values."""
        plain: dict[str, Any] = _plain(asdict(self))
        return plain


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


class ConfigError(ValueError):
    """A setting that cannot be, with what would be right."""


def make_parser() -> ArgumentParser:
    """The options of ``python -m marl_pack.train``: every key of :class:`Config`."""
    parser = ArgumentParser(
        prog="python -m marl_pack.train",
        description="Train the orientation and the placement agent.",
        exit_on_error=False,
        allow_abbrev=False,
    )
    parser.add_argument("--config", action="config", help="YAML file of settings; may be repeated")
    parser.add_argument(
        "--resume", metavar="RUN", default=None,
        help="go on with the run in this folder, exactly; only output.*, evaluation.* and "
        "ppo.max_iterations may be given beside it",
    )  # fmt: skip
    parser.add_class_arguments(Config, None)
    return parser


def parse(arguments: Sequence[str] | None = None) -> tuple[Config, Namespace]:
    """Read the settings.

    Args:
        arguments: of the command line.

    Returns:
        The checked settings, and the options as they were given.

    Raises:
        ConfigError: for an unknown key, a wrong type or an impossible value.
    """
    given = sys.argv[1:] if arguments is None else arguments
    for before, option in pairwise(("", *given)):
        path = option if before == "--config" else option.removeprefix("--config=")
        if "\n" in path:  # settings themselves, not a file's name
            continue
        if (before == "--config" or path != option) and Path(path).is_file():
            check_file(Path(path))
    parser = make_parser()
    with _explained(parser):
        options = parser.parse_args(given)
        return build(parser, options), options


def check_file(path: Path) -> None:
    """Refuse what the parser would take silently, or not say where it stands.

    Raises:
        ConfigError: for a file that is no YAML mapping, or has a key twice or an empty section.
    """
    try:
        root = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text in UTF-8 ({error.reason})") from None
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(root, yaml.MappingNode):
        raise ConfigError(f"{path}: needs keys and values, as configs/rs.yaml has them")
    sections = {key.rpartition(".")[0] for key in keys(make_parser())} - {""}

    def look(node: yaml.MappingNode, prefix: str) -> None:
        seen = set()
        for name, value in node.value:
            key, where = f"{prefix}{name.value}", f"{path}, line {name.start_mark.line + 1}"
            if key in seen:
                raise ConfigError(f"{where}: {key} stands there twice")
            if key == "resume":
                raise ConfigError(f"{where}: --resume goes on the command line")
            seen.add(key)
            if isinstance(value, yaml.MappingNode):
                look(value, f"{key}.")
            elif key in sections:
                raise ConfigError(f"{where}: {key} is a section; its keys go below it, indented")

    look(root, "")


def build(parser: ArgumentParser, options: Namespace) -> Config:
    """The checked :class:`Config` of parsed options."""
    built = parser.instantiate(options)
    config = Config(**{name: built[name] for name in Config.__dataclass_fields__})
    check(config)
    return config


def from_dict(settings: dict[str, Any]) -> Config:
    """The settings that a checkpoint holds.

    Raises:
        ConfigError: if they are not settings of this version.
    """
    parser = make_parser()
    with _explained(parser):
        return build(parser, parser.parse_object(settings))


@contextlib.contextmanager
def _explained(parser: ArgumentParser) -> Iterator[None]:
    """Turn what the parser and the settings' own checks raise into ConfigError."""
    try:
        yield
    except ConfigError:
        raise
    except ArgumentError as error:
        raise ConfigError(explain(parser, str(error))) from None
    except (ValueError, TypeError) as error:
        raise ConfigError(str(error)) from None


def keys(parser: ArgumentParser) -> list[str]:
    """Every key, dotted."""
    return [
        key for key in parser.get_defaults().keys(branches=False) if key not in ("config", "resume")
    ]


def explain(parser: ArgumentParser, message: str) -> str:
    """The parser's message, with the nearest and all valid keys where one is unknown."""
    message = re.sub(r"\s*\n\s*", " ", message).strip()
    message = re.sub(r"Expected a typing\.Literal\[(.*?)\]", r"Expected one of \1", message)
    message = re.sub(r"Expected a <class '(\w+)'>", r"Expected \1", message)
    inside = re.search(r"Group '([\w.]+)' does not accept option '([\w.]+)'", message)
    beside = re.search(r"unrecognized arguments: --([\w.]+)", message)
    if inside is not None:
        key = f"{inside[1]}.{inside[2]}"
    elif beside is not None:
        key = beside[1]
    else:
        alone = re.search(r"Option '([\w.]+)' is not accepted", message)
        if alone is None:
            return message
        key = alone[1]
    known = keys(parser)
    section = key.rpartition(".")[0]
    while section and not any(name.startswith(section + ".") for name in known):
        section = section.rpartition(".")[0]
    prefix = f"{section}." if section else ""
    valid = {n[len(prefix) :].partition(".")[0] for n in known if n.startswith(prefix)}
    near = difflib.get_close_matches(key, known, 1)
    guess = f" Did you mean {near[0]}?" if near else ""
    where = f" in {section}" if section else ""
    return f"unknown key {key}.{guess} Keys{where}: {', '.join(sorted(valid))}"


def check(config: Config) -> None:
    """Refuse what no type can.

    Raises:
        ConfigError: naming the key and what would be right.
    """

    def refuse(key: str, value: object, right: str) -> None:
        raise ConfigError(f"{key} = {value}: {right}")

    ppo, evaluation, output = config.ppo, config.evaluation, config.output
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
    for name, agent in (("orientation", config.orientation), ("placement", config.placement)):
        if agent.frozen and agent.policy is None:
            refuse(f"{name}.policy", "null", "a frozen agent needs one: say who plays it")
        if not agent.frozen and agent.policy is not None:
            refuse(f"{name}.policy", agent.policy, f"goes with {name}.frozen: true")
        if (agent.frozen or agent.policy) and config.joint:
            refuse(f"{name}.frozen", "true", "the joint agent cannot be frozen in part")
        check_imitation(name, agent, config)
    if config.orientation.frozen and config.placement.frozen:
        refuse("placement.frozen", "true", "both agents are frozen, so nothing would learn")
    game = config.game
    if config.joint and not game.mask_orientations:
        refuse("game.mask_orientations", "false", "the joint agent's pairs are always masked")
    try:
        check_size(game.bin)
    except ValueError as error:
        raise ConfigError(f"game.bin: {error}") from None
    if ppo.symmetry and any(game.com_offset):
        refuse("ppo.symmetry", "true", "items whose centre of mass is off centre do not mirror")
    if ppo.symmetry and {o ^ 1 for o in game.orientations} != set(game.orientations):
        refuse("ppo.symmetry", "true", "game.orientations needs the pairs 0 1, 2 3 and 4 5 whole")


def check_imitation(name: str, agent: Agent, config: Config) -> None:
    """Refuse an imitation without a model, an end or a learner that could.

    Raises:
        ConfigError: naming the key and what would be right.
    """
    given, span = f"{name}.imitate = {agent.imitate}", f"{name}.imitate_iterations"
    iterations = agent.imitate_iterations
    if agent.imitate is None:
        if iterations != 0:
            raise ConfigError(f"{span} = {iterations}: goes with {name}.imitate")
        return
    if iterations < 1:
        raise ConfigError(f"{span} = {iterations}: needs 1 or more")
    if agent.frozen:
        raise ConfigError(f"{given}: a frozen agent does not learn")
    if config.joint:
        raise ConfigError(f"{given}: the joint agent imitates nobody")
    if config.ppo.normalize_advantage_per_mini_batch:
        raise ConfigError(f"{given}: needs ppo.normalize_advantage_per_mini_batch: false")


def _own(agent: Agent) -> tuple[float | None, ...]:
    return agent.learning_rate, agent.entropy_coef, agent.final_entropy_coef
