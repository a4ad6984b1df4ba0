"""Write a checkpoint's agents for use elsewhere: ONNX, or rsl_rl's own format.

``python -m marl_pack.export CHECKPOINT`` writes ``orientation.onnx`` and ``placement.onnx`` beside
the checkpoint, and ``AGENT_afterstates.onnx``, the critic of afterstates of an agent that hears
one. Batch and bin size are free. The masks are inputs and are applied inside: an illegal action has
probability 0 and is never the best.
"""

from __future__ import annotations

import argparse
import logging
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from rich.console import Console
from torch import Tensor, nn

from marl_pack.agents.afterstates.critic import FEATURES, AfterstateCritic
from marl_pack.agents.learning import checkpoint
from marl_pack.agents.networks.actor_critic import AGENTS, Actor
from marl_pack.files import write_atomically

OPSET = 18


class Exported(nn.Module):
    """An actor with plain tensors in and out.

    Args:
        actor: the agent's.
        names: the observation's groups, in the order of the arguments.
    """

    def __init__(self, actor: Actor, names: Sequence[str]) -> None:
        super().__init__()
        self.trunk, self.head, self.names = actor.cnns, actor.mlp, list(names)
        self.distribution = actor.distribution

    def forward(self, *groups: Tensor) -> tuple[Tensor, Tensor]:
        """The best action int64 [B], and the probability of each action [B, K]."""
        seen = dict(zip(self.names, groups, strict=True))
        logits = self.head(self.trunk(seen))
        self.distribution.mask = seen["mask"]
        logits = self.distribution.masked(logits)
        return logits.argmax(-1), logits.softmax(-1)


def example(agent: str, planes: Sequence[str], batch: int, size: tuple[int, int, int]) -> dict[
    str, Tensor
]:  # fmt: skip
    """An observation of an agent: random bins, all actions legal."""
    width, depth, height = size
    ways = AGENTS[agent].WAYS
    shape = (batch, ways, width, depth)
    generator = torch.Generator().manual_seed(0)

    def draw(most: int, *dims: int) -> Tensor:
        return torch.randint(0, most + 1, dims, generator=generator, dtype=torch.int64)

    seen = {
        "heightmap": draw(height, batch, width, depth),
        "item": draw(2, batch, 3) + 1,
        "height": torch.full((batch, 1), height),
    }
    actions = ways if agent == "orientation" else ways * width * depth
    seen["mask"] = torch.ones(batch, actions, dtype=torch.bool)
    if "mask" in planes:
        seen["cells"] = torch.ones(shape, dtype=torch.bool)
    if "rest" in planes:
        seen["rest"] = draw(height, *shape)
    if "waste" in planes:
        seen["waste"] = draw(20, *shape)
    for plane in ("room", "fits", "worth"):
        if plane in planes:
            seen[plane] = torch.rand(shape, generator=generator)
            if plane != "fits":
                seen[f"best_{plane}"] = torch.ones(batch, 1)
    if "solid" in planes:
        seen["solid"] = torch.ones(batch, width, depth, dtype=torch.bool)
    if "filled" in planes:
        seen["filled"] = torch.rand(batch, 1, generator=generator)
    return seen


def export_onnx(actor: Actor, agent: str, path: Path) -> list[str]:
    """Write one agent as ONNX.

    Inputs are the groups of the agent's ``observe``, whole numbers as int64: ``heightmap``
    [B, W, D], ``item`` [B, 3], ``height`` [B, 1], ``mask`` bool [B, K], and ``cells`` bool,
    ``rest``, ``waste``, float32 ``room``, ``fits``, ``worth`` [B, A, W, D], ``best_room``,
    ``best_worth``, ``filled`` [B, 1], ``solid`` bool [B, W, D] where its network has these planes.
    Outputs are ``action`` int64 [B] and ``probabilities`` float32 [B, K].

    Returns:
        The names of the inputs.

    Raises:
        ModuleNotFoundError: if the packages of the extra ``export`` are missing.
    """
    seen = example(agent, actor.cnns.planes, 2, (7, 6, 8))
    names = list(seen)
    batch, width, depth = (torch.export.Dim(name, min=1) for name in ("batch", "width", "depth"))
    actions = 6 if agent == "orientation" else torch.export.Dim.DYNAMIC
    shapes: dict[str, dict[int, object]] = {
        "heightmap": {0: batch, 1: width, 2: depth},
        "item": {0: batch},
        "height": {0: batch},
        "best_room": {0: batch},
        "best_worth": {0: batch},
        "filled": {0: batch},
        "mask": {0: batch} if agent == "orientation" else {0: batch, 1: actions},
    }
    for plane in ("cells", "rest", "waste", "room", "fits", "worth"):
        shapes[plane] = {0: batch, 2: width, 3: depth}
    shapes["solid"] = shapes["heightmap"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            Exported(actor, names).eval(), tuple(seen.values()), dynamo=True, opset_version=OPSET,
            input_names=names, output_names=["action", "probabilities"], verbose=False,
            dynamic_shapes=(tuple(shapes[name] for name in names),),
        )  # fmt: skip
    _write(program, path)
    return names


def export_afterstates(critic: AfterstateCritic, path: Path) -> None:
    """Write the critic of afterstates: ``features`` float32 [K, F] → ``value`` float32 [K].

    What a placement is worth is its reward and this value of
    :func:`marl_pack.agents.afterstates.critic.features`.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            critic.eval(), (torch.zeros(2, FEATURES),), dynamo=True, opset_version=OPSET,
            input_names=["features"], output_names=["value"], verbose=False,
            dynamic_shapes=({0: torch.export.Dim("placements", min=1)},),
        )  # fmt: skip
    _write(program, path)


def _write(program: torch.onnx.ONNXProgram | None, path: Path) -> None:
    assert program is not None
    content = program.model_proto.SerializeToString()
    write_atomically(path, lambda file: file.write(content))


def main(arguments: Sequence[str] | None = None) -> int:
    """The command ``python -m marl_pack.export``."""
    options = argparse.ArgumentParser(
        prog="python -m marl_pack.export", description=__doc__.split("\n\n")[0]
    )
    options.add_argument("checkpoint", help="a checkpoint or a run's folder")
    options.add_argument(
        "--format", choices=["onnx", "rsl_rl"], default="onnx",
        help="ONNX (default), or the state that a stock rsl_rl PPO loads",
    )  # fmt: skip
    options.add_argument("--folder", type=Path, help="where to (default: beside the checkpoint)")
    chosen = options.parse_args(arguments)
    console = Console()
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    try:
        source = checkpoint.resolve(chosen.checkpoint)
        found = checkpoint.read(source)
        folder = chosen.folder or source.parent
        folder.mkdir(parents=True, exist_ok=True)
        for name, agent in found["agents"].items():
            if "network" not in agent:
                console.print(f"{name}: played by {agent['name']}, no network to export")
                continue
            if chosen.format == "rsl_rl":
                if "critic_state_dict" not in agent:
                    console.print(f"{name}: was frozen, has no critic that rsl_rl could load")
                    continue
                path = folder / f"{name}.pt"
                checkpoint.write(path, {k: v for k, v in agent.items() if k != "imitated"})
                console.print(f"{path}: for rsl_rl's PPO.load", soft_wrap=True)
                continue
            path = folder / f"{name}.onnx"
            actor = checkpoint.load_actor(found, name, "cpu")
            inputs = export_onnx(actor, name, path)
            console.print(f"{path}: inputs {', '.join(inputs)}", soft_wrap=True)
            if actor.afterstates is not None:
                path = folder / f"{name}_afterstates.onnx"
                export_afterstates(actor.afterstates, path)
                console.print(f"{path}: what {name} hears of placements", soft_wrap=True)
    except ModuleNotFoundError as error:
        options.exit(2, f"{options.prog}: {error}; install marl_pack[export]\n")
    except (ValueError, OSError) as error:
        options.exit(2, f"{options.prog}: {error}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
