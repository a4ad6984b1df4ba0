"""Check the state from which a run resumes: counters, optimisers and the random generator."""

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
WAYS_TO_COMPUTE = ("foreach", "fused")
"""Names of torch's settings that change how an optimiser computes its steps, not what they are."""
TWISTER_WORDS = 624
"""Number of words of the Mersenne twister's state."""


def check_progress(checkpoint: Mapping[str, Any], items: int) -> None:
    """Refuse a checkpoint whose counters do not belong to one point of a run.

    Args:
        checkpoint: the checkpoint to resume from.
        items: number of items in each iteration, of all processes.

    Raises:
        ValueError: the message names the wrong counter and says what it needs to be.
    """
    done = checkpoint["iter"] + 1
    for key, needed in (("schedule_iteration", done), ("items", done * items)):
        if checkpoint.get(key) != needed:
            value = shown(checkpoint.get(key))
            raise ValueError(f"{key} = {value}: needs {needed} after {done} iterations")


def checked_optimizer(
    state: Mapping[str, Any], optimizer: Optimizer, where: str, begun: bool
) -> dict[str, Any]:
    """Return an optimiser's state after checking that ``optimizer`` may load it.

    Only the learning rate changes during a run, so all other settings must be equal. Settings that
    the state lacks, because another version of torch wrote it, are those of ``optimizer``; so are
    :data:`WAYS_TO_COMPUTE`.

    Args:
        state: the ``state_dict`` to check.
        optimizer: the optimiser that will load it.
        where: name of the state, for messages.
        begun: whether the optimiser has made a step, so that it must have moments.

    Raises:
        ValueError: the message names the first value that ``optimizer`` would not have written.
    """
    expected = optimizer.state_dict()["param_groups"]
    check_keys(state, ["state", "param_groups"], where)
    if len(state["param_groups"]) != len(expected):
        raise ValueError(f"{where}.param_groups: needs {len(expected)}")
    groups = []
    for k, (group, needed) in enumerate(zip(state["param_groups"], expected, strict=True)):
        name = f"{where}.param_groups.{k}"
        if real_number(group.get("lr"), f"{name}.lr") < 0:
            raise ValueError(f"{name}.lr = {group['lr']}: needs 0 or more")
        for key, value in group.items():
            if key not in ("lr", *WAYS_TO_COMPUTE) and (
                key not in needed or not _equal(value, needed[key])
            ):
                needs = shown(needed[key]) if key in needed else "none"
                raise ValueError(f"{name}.{key}: is {shown(value)}, needs {needs}")
        groups.append(needed | {"lr": group["lr"]})
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
    """Return whether two settings are equal and of the same kind; lists count as tuples."""
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
    """Return the state of an optimiser for a weight, as tensors without memory for numbers."""
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

    torch checks the rest when it loads the state. The state begins with the seed (8 bytes), the
    number of words left (4), whether there was a seed (4), and the index of the next word (8).

    Raises:
        ValueError: the message names the state.
    """
    content = state.cpu().numpy().tobytes()
    left, seeded = np.frombuffer(content, np.int32, 2, 8)
    next_word = int(np.frombuffer(content, np.uint64, 1, 16)[0])
    fresh = (left, next_word) == (1, 0)
    running = 1 <= left <= TWISTER_WORDS and left + next_word == TWISTER_WORDS + 1
    if seeded != 1 or not (fresh or running):
        raise ValueError(f"{where}: no state of the random generator")
