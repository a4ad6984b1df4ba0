"""Damaged checkpoints, and the doors through which they come in.

Each case changes one value of a whole checkpoint. A door takes the damaged file or refuses it with
ValueError or FileNotFoundError in one line.
"""

import copy
import random
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.loading import Loader, record_of, trained_game
from marl_pack.config import from_dict
from marl_pack.export import export_agent
from marl_pack.game.packing import Packing
from marl_pack.training.assembly import make_runner
from marl_pack.training.folder import settings_to_resume

Path_ = tuple[Any, ...]

OTHERS: dict[str, Any] = {
    "null": None, "text": "1", "escape": "\x1b[31m", "negative": -5, "huge": 10**12,
    "enormous": 10**400, "fraction": 0.5, "nan": float("nan"), "true": True, "list": [],
    "mapping": {}, "tensor": torch.zeros(2, 3), "expanded": torch.zeros(1).expand(10**9),
}  # fmt: skip
"""Values that replace any other."""


def _first(change: Callable[[Any], Any]) -> Callable[[Tensor], Tensor]:
    """Return a change of the first entry of a tensor."""

    def changed(tensor: Tensor) -> Tensor:
        other = tensor.clone().contiguous()
        if other.numel():
            other.view(-1)[0] = change(other.view(-1)[0].item())
        return other

    return changed


TENSORS: dict[str, Callable[[Tensor], Tensor]] = {
    "longer": lambda tensor: torch.cat((tensor.reshape(-1), tensor.reshape(-1)[:1])),
    "one more axis": lambda tensor: tensor[None],
    "double": lambda tensor: tensor.double(),
    "bool": lambda tensor: tensor.bool(),
    "not a number": lambda tensor: torch.full_like(tensor.float(), float("nan")),
    "infinite": _first(lambda value: value if isinstance(value, int) else float("inf")),
    "minus 126": _first(lambda value: max(value - 126, 0 if value is True else -126)),
    "minus 1": _first(lambda value: value - 1 if not isinstance(value, bool) else not value),
    "plus 1": _first(lambda value: value + 1 if not isinstance(value, bool) else not value),
    "far": _first(lambda value: 100 if not isinstance(value, bool) else not value),
}  # fmt: skip
"""Changes of a tensor by name, each to another tensor."""


def paths(value: Any, path: Path_ = ()) -> Iterator[Path_]:
    """Yield the path of every value in nested mappings and lists."""
    if path:
        yield path
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from paths(item, (*path, key))
    elif isinstance(value, list | tuple):
        for k, item in enumerate(value):
            yield from paths(item, (*path, k))


def cases(seed: int, checkpoint: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield every change of every value of a checkpoint, in an order that the seed draws.

    Args:
        seed: of the order.
        checkpoint: as ``torch.load`` reads it from a file.

    Yields:
        A name of the change, and the changed checkpoint.
    """
    changes: list[tuple[Path_, str]] = []
    for path in paths(checkpoint):
        value = _at(checkpoint, path)
        names = ["deleted", *OTHERS, *(TENSORS if isinstance(value, Tensor) else ())]
        changes += [(path, name) for name in names]
    random.Random(seed).shuffle(changes)
    for path, name in changes:
        changed = _without_tensors(checkpoint)
        parent = _at(changed, path[:-1])
        if isinstance(parent, tuple):  # such as the coefficients of an optimiser
            continue
        if name == "deleted":
            del parent[path[-1]]
        elif name in OTHERS:
            parent[path[-1]] = OTHERS[name]
        else:
            parent[path[-1]] = TENSORS[name](parent[path[-1]])
        yield f"{'.'.join(map(str, path))}: {name}", changed


def _at(value: Any, path: Path_) -> Any:
    for key in path:
        value = value[key]
    return value


def _without_tensors(value: Any) -> Any:
    """Return a copy of nested values that shares their tensors."""
    shared = [item for item in (_at(value, p) for p in paths(value)) if torch.is_tensor(item)]
    return copy.deepcopy(value, {id(tensor): tensor for tensor in shared})


# --- doors ----------------------------------------------------------------------------------------


def play(path: Path) -> None:
    """Play one turn by the policy, in the game that it was trained on."""
    game = trained_game(checkpoints.read(path))
    policy = Loader().policy(str(path))
    games = Packing(2, tuple(game["bin"]), sides=tuple(game["sides"]))
    games.place(*policy(games))


def export(path: Path) -> None:
    """Write the agents as rsl_rl's."""
    for name, agent in checkpoints.read(path)["agents"].items():
        export_agent(agent, name, path.parent, "rsl_rl")


def freeze(path: Path) -> None:
    """Load each agent as a frozen one of another run."""
    for name in ("orientation", "placement"):
        Loader().agent_of(record_of(str(path), name), name)


def resume(path: Path) -> None:
    """Make a runner that resumes from the file."""
    config, checkpoint = settings_to_resume(str(path), [])
    make_runner(config, None, checkpoint)


def begin(path: Path, settings: Mapping[str, Any]) -> None:
    """Make a runner that begins with the weights of the file."""
    config = from_dict(dict(settings))
    config.init = str(path)
    make_runner(config, None)


def outcomes(path: Path, settings: Mapping[str, Any]) -> dict[str, str]:
    """Return what each door says of a file: "taken", or its error.

    Args:
        path: of the file.
        settings: of the run whose checkpoint was damaged.

    Raises:
        AssertionError: if an error is not one printable line.
    """
    doors: dict[str, Callable[[], None]] = {
        "play": lambda: play(path), "export": lambda: export(path), "freeze": lambda: freeze(path),
        "resume": lambda: resume(path), "init": lambda: begin(path, settings),
    }  # fmt: skip
    results = {}
    for name, door in doors.items():
        try:
            door()
            results[name] = "taken"
        except (ValueError, FileNotFoundError) as error:
            results[name] = str(error)
    for name, result in results.items():
        assert result.isprintable(), f"{name}: {result}"
        assert len(result) < 1000, f"{name}: {result}"
    return results
