"""The settings of a training run: each with its type, default and meaning.

``marl-pack train --help`` shows these docstrings; ``configs/default.yaml`` has every key with its
default.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from marl_pack.agents.keys import POLICIES
from marl_pack.agents.networks.shape import Network, SelectionNetwork
from marl_pack.game.spec import SelectionSpec
from marl_pack.items import DEFAULT_SIDES
from marl_pack.option_record import document


@document(SelectionSpec, " " * 8)
@dataclass(frozen=True)
class Game(SelectionSpec):
    """The packing game (docs/environment.md, docs/buffer.md).

    Args:
        {options}
        items: items on the conveyor: rs, cut1, cut2, or a file of sequences (.npz, .json, .csv).
        sides: shortest and longest side of generated items, in cells.
    """

    items: str = "rs"
    sides: tuple[int, int] = DEFAULT_SIDES

    def __post_init__(self) -> None:
        """Check every option; messages name the section too."""
        try:
            super().__post_init__()
        except ValueError as error:
            raise ValueError(f"game: {error}") from None


@dataclass
class Selection:
    """The agent that selects a box and a bin, in games with several to choose from.

    Args:
        frozen: whether it plays without learning.
        policy: the policy of a frozen agent: {policies}, first (the first box that has a place), or
            a published model, a run's folder or checkpoint; a model without a selection agent takes
            what gains most by its critic of afterstates.
        network: shape of its network.
        teacher: the policy whose choices the agent clones at first, named like policy; null for
            none.
        teacher_iterations: number of iterations in which it clones the teacher.
        teacher_random: share of the teacher's choices that are random instead, 0 to 1.
        learning_rate: the agent's own learning rate; null for ppo.learning_rate.
        entropy_coef: the agent's own entropy bonus; null for ppo.entropy_coef.
        final_entropy_coef: the agent's own entropy bonus at the end; null for
            ppo.final_entropy_coef.
    """

    frozen: bool = False
    policy: str | None = None
    network: SelectionNetwork = field(default_factory=SelectionNetwork)
    teacher: str | None = None
    teacher_iterations: int = 0
    teacher_random: float = 0.1
    learning_rate: float | None = None
    entropy_coef: float | None = None
    final_entropy_coef: float | None = None


@dataclass
class Agent:
    """The orientation agent or the placement agent.

    Args:
        frozen: whether it plays without learning.
        policy: the policy of a frozen agent: {policies}, for the orientation agent also first (as
            the item comes), or a published model, a run's folder or checkpoint.
        network: shape of its network.
        teacher: the policy whose choices the agent clones at first, named like policy; null for
            none.
        teacher_iterations: number of iterations in which it clones the teacher.
        teacher_random: share of the teacher's choices that are random instead, 0 to 1.
        learning_rate: the agent's own learning rate; null for ppo.learning_rate.
        entropy_coef: the agent's own entropy bonus; null for ppo.entropy_coef.
        final_entropy_coef: the agent's own entropy bonus at the end; null for
            ppo.final_entropy_coef.
    """

    frozen: bool = False
    policy: str | None = None
    network: Network = field(default_factory=Network)
    teacher: str | None = None
    teacher_iterations: int = 0
    teacher_random: float = 0.1
    learning_rate: float | None = None
    entropy_coef: float | None = None
    final_entropy_coef: float | None = None


for _agent in (Selection, Agent):
    _agent.__doc__ = (_agent.__doc__ or "").replace("{policies}", ", ".join(POLICIES))


@dataclass
class PPO:
    """Proximal policy optimization, with rsl_rl's names.

    Args:
        num_envs: bins played at once (by each process).
        num_steps_per_env: items placed in each bin between two updates.
        max_iterations: total number of updates; a run sees num_envs * num_steps_per_env *
            max_iterations items (times the number of processes).
        num_learning_epochs: passes over the items of one iteration.
        num_mini_batches: minibatches in each pass.
        gamma: discount of the reward, per item.
        lam: lambda of the generalised advantage estimate.
        clip_param: largest relative change of an action's probability that is rewarded.
        value_loss_coef: weight of the critic's loss.
        use_clipped_value_loss: whether the critic's change is clipped by clip_param as well.
        entropy_coef: bonus for the entropy of the actions, at the start.
        final_entropy_coef: the bonus at the end, linear in between; null for no change.
        learning_rate: step size of the optimiser, at the start.
        schedule: learning rate over the run: fixed; linear, down to 0 at the end; or adaptive, by
            the KL divergence.
        desired_kl: KL divergence of an update that the adaptive schedule aims at.
        max_grad_norm: largest norm of the gradient, for the actor and for the critic.
        normalize_advantage_per_mini_batch: whether to normalise advantages in each minibatch
            instead of over the whole iteration.
        optimizer: name of torch's optimiser.
        precision: numbers in the convolutions of training: float32; or bfloat16, faster on
            processors with instructions for it (AVX512-BF16, AMX) and on GPUs.
        afterstate_ramp: iterations between which the values of afterstates that agents observe grow
            from 0 to full size.
    """

    num_envs: int = 64
    num_steps_per_env: int = 16
    max_iterations: int = 2500
    num_learning_epochs: int = 2
    num_mini_batches: int = 16
    gamma: float = 1.0
    lam: float = 0.96
    clip_param: float = 0.2
    value_loss_coef: float = 30.0
    use_clipped_value_loss: bool = False
    entropy_coef: float = 0.02
    final_entropy_coef: float | None = 0.001
    learning_rate: float = 1e-3
    schedule: Literal["fixed", "linear", "adaptive"] = "linear"
    desired_kl: float = 0.01
    max_grad_norm: float = 1.0
    normalize_advantage_per_mini_batch: bool = False
    optimizer: Literal["adam", "adamw", "sgd", "rmsprop"] = "adam"
    precision: Literal["float32", "bfloat16"] = "float32"
    afterstate_ramp: tuple[int, int] = (0, 0)


@dataclass
class Evaluation:
    """Evaluation during training, with the most probable actions on held-out sequences.

    Args:
        every: iterations between evaluations (one more at the end); 0 for no evaluations.
        episodes: number of sequences.
        seed: seed of these sequences; training draws others.
    """

    every: int = 80
    episodes: int = 1000
    seed: int = 2024


@dataclass
class Output:
    """Where the run is stored, and how often.

    Args:
        folder: the folder in which each run makes its own folder.
        name: name of the run's folder; null for a name with the date, time and seed.
        logger: where scalars go: tensorboard, or wandb (which writes TensorBoard's files as well).
        wandb_project: the project on Weights & Biases.
        latest_every: iterations between checkpoints to resume from.
        keep_every: iterations between checkpoints that are never overwritten.
    """

    folder: str = "runs"
    name: str | None = None
    logger: Literal["tensorboard", "wandb"] = "tensorboard"
    wandb_project: str = "marl_pack"
    latest_every: int = 5
    keep_every: int = 100


@dataclass
class Config:
    """All settings of a training run.

    Args:
        seed: seed of weights, actions and items.
        device: the device that computes everything: cpu, cuda, or cuda:1; with torchrun, cuda
            means each process's own GPU.
        threads: threads on the CPU.
        joint: whether one agent that chooses the pair (orientation, cell) replaces the two; its
            network is placement.network.
        init: a published model, a run's folder or a checkpoint; the learning agents begin with its
            weights; null for new weights.
        game: the game.
        selection: the agent that selects a box and a bin first; it plays only where game.buffer or
            game.bins is more than 1.
        orientation: the agent that chooses the orientation.
        placement: the agent that places the item.
        ppo: how the agents learn.
        evaluation: evaluation during training.
        output: where the run is stored.
    """

    seed: int = 0
    device: str = "cpu"
    threads: int = 1
    joint: bool = False
    init: str | None = None
    game: Game = field(default_factory=Game)
    selection: Selection = field(default_factory=Selection)
    orientation: Agent = field(default_factory=Agent)
    placement: Agent = field(default_factory=Agent)
    ppo: PPO = field(default_factory=PPO)
    evaluation: Evaluation = field(default_factory=Evaluation)
    output: Output = field(default_factory=Output)

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as plain lists, dicts and values."""
        plain: dict[str, Any] = _plain(asdict(self))
        return plain

    def flat(self) -> dict[str, Any]:
        """Return the plain value of every key, with dots between sections."""
        return _flat(self.to_dict(), "")


def _flat(settings: dict[str, Any], prefix: str) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, value in settings.items():
        key = prefix + name
        values |= _flat(value, f"{key}.") if isinstance(value, dict) else {key: value}
    return values


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
