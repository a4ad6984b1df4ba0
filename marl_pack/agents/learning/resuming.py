"""Check what a run resumes from: the states of optimisers and of the random generator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.optim import Optimizer

from marl_pack.agents.learning.form import check_alike, check_keys
from marl_pack.checks import real_number, shown

NOT_NEGATIVE = ("step", "exp_avg_sq", "square_avg")
"""Names of torch's moments and counters that are never negative."""
TWISTER_WORDS = 624
"""Number of words of the Mersenne twister's state."""


def check_progress(checkpoint: Mapping[str, Any], items: int) -> None:
    """Refuse a checkpoint whose counters do not belong to one point of a run.

    Args:
        checkpoint: to resume from.
        items: of each iteration, in all processes.

    Raises:
        ValueError: naming the counter and what it needs to be.
    """
    done = checkpoint["iter"] + 1
    for key, needed in (("schedule_iteration", done), ("items", done * items)):
        if checkpoint.get(key) != needed:
            value = shown(checkpoint.get(key))
            raise ValueError(f"{key} = {value}: needs {needed} after {done} iterations")


def checked_optimizer(
    state: Mapping[str, Any], optimizer: Optimizer, where: str, begun: bool
) -> dict[str, Any]:
    """Return an optimiser's state that another one with the same settings may load.

    Only the learning rate changes during a run. Settings that other versions of torch do not write
    are the optimiser's own.

    Args:
        state: a ``state_dict``.
        optimizer: to load it.
        where: names the state, for messages.
        begun: whether it has learned, so that there are moments.

    Raises:
        ValueError: naming the first value that the optimiser would not have written.
    """
    own = optimizer.state_dict()["param_groups"]
    check_keys(state, ["state", "param_groups"], where)
    if len(state["param_groups"]) != len(own):
        raise ValueError(f"{where}.param_groups: needs {len(own)}")
    groups = []
    for k, (group, ours) in enumerate(zip(state["param_groups"], own, strict=True)):
        name = f"{where}.param_groups.{k}"
        if real_number(group.get("lr"), f"{name}.lr") < 0:
            raise ValueError(f"{name}.lr = {group['lr']}: needs 0 or more")
        for key, value in group.items():
            if key != "lr" and (key not in ours or not _equal(value, ours[key])):
                needs = shown(ours[key]) if key in ours else "none"
                raise ValueError(f"{name}.{key}: is {shown(value)}, needs {needs}")
        groups.append(ours | {"lr": group["lr"]})
    moments = state["state"]
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    if moments or (begun and _after_a_step(optimizer, weights[0])):
        check_keys(moments, range(len(weights)), f"{where}.state")
    for k, values in moments.items():
        name = f"{where}.state.{k}"
        check_alike(values, _after_a_step(optimizer, weights[k]), name)
        for key, value in values.items():
            if isinstance(value, Tensor) and key in NOT_NEGATIVE and bool((value < 0).any()):
                raise ValueError(f"{name}.{key}: needs numbers that are not negative")
    return {"state": moments, "param_groups": groups}


def _equal(value: Any, own: Any) -> bool:
    """Return whether two settings are equal and of one kind; a list is a tuple."""
    if isinstance(own, list | tuple):
        return (
            isinstance(value, list | tuple)
            and len(value) == len(own)
            and all(map(_equal, value, own))
        )
    number = isinstance(own, int | float) and not isinstance(own, bool)
    kinds = (int, float) if number else (type(own),)
    return type(value) in kinds and bool(value == own)


def _after_a_step(optimizer: Optimizer, weight: Tensor) -> dict[str, Any]:
    """Return what an optimiser stores for a weight, without memory for its values."""
    number = torch.nn.Parameter(torch.zeros((), device="cpu"))
    number.grad = torch.zeros(())
    small = type(optimizer)([number], **optimizer.defaults)
    small.step()
    like = weight.detach().to("meta")
    return {
        name: value if name == "step" or not isinstance(value, Tensor) else like
        for name, value in small.state[number].items()
    }


def check_generator(state: Tensor, where: str) -> None:
    """Refuse a state of torch's random generator on the CPU that points beyond its own words.

    torch checks the rest as it loads it. The state begins with the seed (8 bytes), the number of
    words left (4), whether there was a seed (4), and the index of the next word (8).

    Raises:
        ValueError: naming the state.
    """
    content = state.cpu().numpy().tobytes()
    left, seeded = np.frombuffer(content, np.int32, 2, 8)
    following = int(np.frombuffer(content, np.uint64, 1, 16)[0])
    fresh = (left, following) == (1, 0)
    running = 1 <= left <= TWISTER_WORDS and left + following == TWISTER_WORDS + 1
    if seeded != 1 or not (fresh or running):
        raise ValueError(f"{where}: no state of the random generator")
