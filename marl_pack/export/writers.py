"""Write networks as ONNX files, agents for rsl_rl, and checkpoints to publish.

Batch and bin size of an ONNX file are free. The masks are inputs and are applied inside: an illegal
action has probability 0 and is never chosen. Each file's metadata describes its inputs and its
training (``docs/onnx.md``).
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rsl_rl.utils import resolve_optimizer
from torch import Tensor, nn

from marl_pack import __version__, published
from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.afterstates.features import FEATURES
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.loading import (
    load_actor,
    load_afterstate_critic,
    load_critic,
    trained_game,
)
from marl_pack.agents.networks.actor_critic import Actor
from marl_pack.agents.networks.kinds import AGENT_KINDS, SELECTION, observe
from marl_pack.agents.networks.planes import ALWAYS_OBSERVED, PLANES, Meaning
from marl_pack.config import from_dict
from marl_pack.files import write_atomically
from marl_pack.game.packing import Packing
from marl_pack.geometry import ORIENTATIONS
from marl_pack.terminal import make_status
from marl_pack.training.assembly import runner_settings

OPSET = 18
PUBLISHED = "published.pt"
"""Name of the file for a checkpoint to publish."""

OUTPUTS = {
    "action": Meaning(
        "number of an action",
        "the most probable legal action: an orientation 0 … 5, or the cell x · D + y of the item's "
        "low corner (of a joint agent o · W · D + x · D + y)",
    ),
    "probabilities": Meaning("0 to 1", "probability of each action; 0 where it is not legal"),
}
"""The meaning of each output of an agent's file, by name."""

FEATURES_OF_AFTERSTATES = Meaning(
    "described in marl_pack.agents.afterstates.features",
    "features of the bin that each of K placements would leave",
)
VALUE_OF_AFTERSTATES = Meaning(
    "reward", "the return still to come after each placement, without the placement's own reward"
)


class Exported(nn.Module):
    """An actor whose inputs and outputs are plain tensors.

    Args:
        actor: the agent's actor.
        names: names of the observation's tensors, in the order of the arguments of ``forward``.
    """

    def __init__(self, actor: Actor, names: Sequence[str]) -> None:
        super().__init__()
        self.trunk, self.head, self.names = actor.cnns, actor.mlp, list(names)
        self.distribution = actor.distribution

    def forward(self, *groups: Tensor) -> tuple[Tensor, Tensor]:
        """Return the best action int64 [B], and the probability of each action [B, K]."""
        observation = dict(zip(self.names, groups, strict=True))
        logits = self.head(self.trunk(observation))
        self.distribution.mask = observation["mask"]
        logits = self.distribution.masked(logits)
        return logits.argmax(-1), logits.softmax(-1)


def example(agent: str, planes: Sequence[str]) -> dict[str, Tensor]:
    """Return an example of an agent's observation in two games, with whole numbers as int64."""
    game = Packing(2, (7, 6, 8), sides=(2, 4))
    kind = AGENT_KINDS[agent]
    before = (game.orientation_mask.int().argmax(1),) if kind.orientations == 1 else ()
    with torch.random.fork_rng(devices=[]):
        lookahead = Lookahead(AfterstateCritic())
    observation = observe(agent, game, planes, lookahead, *before)
    whole = {torch.int16, torch.int32}
    return {
        name: values.long() if values.dtype in whole else values.clone()
        for name, values in observation.items()
    }


def input_meanings(planes: Sequence[str]) -> dict[str, Meaning]:
    """Return the meanings of the inputs of an agent's file, by name, in their order."""
    meanings = dict(ALWAYS_OBSERVED)
    for plane in planes:
        meanings |= PLANES[plane].tensors
    return meanings


def training_facts(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return the facts about a checkpoint's training for the metadata of its files.

    ``game`` has the options of :class:`marl_pack.game.spec.GameSpec` with ``items`` and ``sides``,
    ``trained_items`` is the number of items seen, ``seed`` the seed of the run.
    """
    return {
        "game": trained_game(checkpoint),
        "trained_items": checkpoint["items"],
        "seed": checkpoint["config"].get("seed"),
    }


def export_onnx(
    actor: Actor, agent: str, path: Path, training: Mapping[str, Any] | None = None
) -> list[str]:
    """Write one agent as ONNX.

    Inputs are the tensors of the agent's observation
    (:func:`marl_pack.agents.networks.kinds.observe`), with whole numbers as int64: ``heightmap``
    [B, W, D], ``item`` [B, 3], ``height`` [B, 1], ``mask`` bool [B, K], and the tensors of the
    planes that its network sees. Outputs are ``action`` int64 [B] and ``probabilities`` float32
    [B, K].

    Args:
        actor: the agent's actor.
        agent: the agent's name.
        path: the file to write.
        training: facts for the file's metadata (:func:`training_facts`).

    Returns:
        The names of the inputs.

    Raises:
        ModuleNotFoundError: if the packages of the extra ``export`` are missing.
    """
    observation = example(agent, actor.cnns.planes)
    names = list(observation)
    batch, width, depth = (torch.export.Dim(name, min=1) for name in ("batch", "width", "depth"))
    # The number of dimensions determines which are free (marl_pack.agents.networks.kinds.observe).
    free: dict[int, dict[int, object]] = {
        2: {0: batch}, 3: {0: batch, 1: width, 2: depth}, 4: {0: batch, 2: width, 3: depth},
    }  # fmt: skip
    shapes = {name: free[values.dim()] for name, values in observation.items()}
    if AGENT_KINDS[agent].acts_on_cells:
        shapes["mask"] = {0: batch, 1: torch.export.Dim.DYNAMIC}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            Exported(actor, names).eval(), tuple(observation.values()), dynamo=True,
            opset_version=OPSET, input_names=names, output_names=["action", "probabilities"],
            verbose=False, dynamic_shapes=(tuple(shapes[name] for name in names),),
        )  # fmt: skip
    described = {
        "agent": agent,
        "planes": list(actor.cnns.planes),
        "inputs": _as_json(input_meanings(actor.cnns.planes)),
        "outputs": _as_json(OUTPUTS),
        "orientations": ORIENTATIONS,
    }
    _write(program, path, described | dict(training or {}))
    return names


def export_afterstates(
    critic: AfterstateCritic, path: Path, training: Mapping[str, Any] | None = None
) -> None:
    """Write the critic of afterstates as ONNX: ``features`` [K, F] → ``value`` [K], both float32.

    The value of a placement is its reward plus the critic's value of its afterstate's features
    (:func:`marl_pack.agents.afterstates.features.features`).
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            critic.eval(), (torch.zeros(2, FEATURES),), dynamo=True, opset_version=OPSET,
            input_names=["features"], output_names=["value"], verbose=False,
            dynamic_shapes=({0: torch.export.Dim("placements", min=1)},),
        )  # fmt: skip
    described = {
        "agent": "afterstate_critic",
        "inputs": _as_json({"features": FEATURES_OF_AFTERSTATES}),
        "outputs": _as_json({"value": VALUE_OF_AFTERSTATES}),
    }
    _write(program, path, described | dict(training or {}))


def _as_json(meanings: Mapping[str, Meaning]) -> dict[str, dict[str, str]]:
    return {name: {"unit": m.unit, "meaning": m.text} for name, m in meanings.items()}


def _write(program: torch.onnx.ONNXProgram | None, path: Path, metadata: Mapping[str, Any]) -> None:
    """Write an ONNX file whose metadata are JSON texts."""
    assert program is not None
    model = program.model_proto
    for key, value in {**metadata, "marl_pack": __version__}.items():
        model.metadata_props.add(key=key, value=json.dumps(value, ensure_ascii=False))
    write_atomically(path, lambda file: file.write(model.SerializeToString()))


def export_agent(
    agent: Mapping[str, Any],
    name: str,
    folder: Path,
    form: str,
    training: Mapping[str, Any] | None = None,
) -> str:
    """Write one agent of a checkpoint; return a line that reports the file.

    Args:
        agent: the agent's record in the checkpoint.
        name: the agent's name.
        folder: the folder to write to.
        form: the format, ``onnx`` or ``rsl_rl``.
        training: facts for the metadata of an ONNX file (:func:`training_facts`).
    """
    if "network" not in agent:
        return f"{name}: played by {agent['name']}, no network to export"
    if form == "rsl_rl":
        if "critic_state_dict" not in agent:
            return f"{name}: frozen, so it has no critic that rsl_rl could load"
        checkpoints.check_weights(agent, name)
        path = folder / f"{name}.pt"
        checkpoints.write(path, {k: v for k, v in agent.items() if k != "teacher"})
        return f"{path}: for rsl_rl's PPO.load"
    path = folder / f"{name}.onnx"
    inputs = export_onnx(load_actor(agent, name, "cpu"), name, path, training)
    return f"{path}: inputs {', '.join(inputs)}"


def fresh_optimizer(checkpoint: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the state of a new optimiser for an agent, made from its run's settings.

    Raises:
        ValueError: if this version cannot read the settings, or the weights do not match them.
    """
    agent = checkpoints.agent_of(checkpoint, name)
    settings = runner_settings(from_dict(checkpoint["config"]), {}, {})["agents"]
    actor = load_actor(agent, name, "cpu")
    critic = load_critic(checkpoint, name, "cpu", actor)
    algorithm = checkpoints.agent_of({"agents": settings}, name)["algorithm"]
    optimizer: torch.optim.Optimizer = resolve_optimizer(algorithm["optimizer"])(
        chain(actor.parameters(), critic.parameters()), lr=algorithm["learning_rate"]
    )
    return optimizer.state_dict()


def run(source: str, folder: Path | None, form: str, console: Console) -> None:
    """Write every agent of a checkpoint, and its critic of afterstates.

    Args:
        source: a published model's name, or the path of a checkpoint or a run's folder.
        folder: the folder to write to; by default the checkpoint's folder, or ``./NAME`` for a
            published model.
        form: the format, ``onnx``, ``rsl_rl`` or ``checkpoint``.
        console: the console that shows which files were written.

    Raises:
        ValueError, OSError: if the checkpoint cannot be read or a file cannot be written.
    """
    path = checkpoints.resolve(source)
    checkpoint = checkpoints.read(path)
    folder = folder or (path.parent if published.is_path(source) else Path(source))
    folder.mkdir(parents=True, exist_ok=True)
    if form == "checkpoint":
        path = folder / PUBLISHED
        slim = checkpoints.without_training(checkpoint) | {"marl_pack": __version__}
        checkpoints.write(path, slim)
        console.print(f"{path}: a checkpoint to publish, {path.stat().st_size:,} bytes")
        return
    if (share := checkpoints.value_share(checkpoint)) < 1:
        raise ValueError(
            f"{source}: the agents observe {share:.0%} of the values of afterstates so far; export "
            "them after the last iteration of ppo.afterstate_ramp"
        )
    training = training_facts(checkpoint)
    for name, agent in checkpoint["agents"].items():
        if name == SELECTION:
            console.print("selection: left out, only agents on a bin are exported", soft_wrap=True)
            continue
        learned = "critic_state_dict" in agent
        if form == "rsl_rl" and learned and "optimizer_state_dict" not in agent:
            state = fresh_optimizer(checkpoint, name)
            agent = {**agent, "optimizer_state_dict": state}
        with make_status(console, f"exporting {name}"):
            line = export_agent(agent, name, folder, form, training)
        console.print(line, soft_wrap=True)
        own = load_afterstate_critic(agent, "cpu")
        if own is not None and form == "onnx":  # the critic of a frozen agent from another run
            export_afterstates(own, folder / f"{name}_afterstate_critic.onnx", training)
    critic = load_afterstate_critic(checkpoint, "cpu")
    if critic is not None and form == "onnx":
        path = folder / "afterstate_critic.onnx"
        export_afterstates(critic, path, training)
        console.print(f"{path}: features of an afterstate to its value", soft_wrap=True)
