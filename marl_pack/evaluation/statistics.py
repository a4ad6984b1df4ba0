"""Compute figures of packings: utilization with its interval, equilibrium, and falls in physics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.evaluation.rollout import Rollout
from marl_pack.plan import Plan
from marl_pack.sapien_check.judge import Judged

FEWEST = 10
"""Smallest number of episodes for an interval: with fewer, Student's t tells too little."""


def interval(values: NDArray[np.floating[Any]]) -> tuple[float, float] | None:
    """Compute the 95 % interval of the mean (Student's t); None for a single value."""
    if len(values) < 2:
        return None
    if np.ptp(values) == 0:  # Student's t would give NaN
        return float(values[0]), float(values[0])
    from scipy import stats  # slow to import

    bounds = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    return float(bounds.low), float(bounds.high)


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Compute the 95 % interval of a share (Wilson's score), from a count of 1 or more trials."""
    from scipy import stats  # slow to import

    bounds = stats.binomtest(count, total).proportion_ci(0.95, method="wilson")
    return float(bounds.low), float(bounds.high)


def mean_utilization(rollout: Rollout) -> dict[str, Any]:
    """Compute mean utilization with its 95 % interval over episodes, and items packed.

    Keys: ``episodes``; ``utilization``, ``low``, ``high`` and ``std``, as shares of the bin's
    volume; ``packed``, the mean number of boxes. The interval (Student's t) is clipped to shares
    from 0 to 1. It is None for fewer than :data:`FEWEST` episodes; the standard deviation is None
    for one episode.
    """
    utilization = rollout.utilization
    low, high = None, None
    if len(utilization) >= FEWEST:
        low, high = np.clip(interval(utilization) or (0, 1), 0, 1).tolist()
    return {
        "episodes": len(utilization),
        "utilization": float(utilization.mean()),
        "low": low,
        "high": high,
        "std": float(utilization.std(ddof=1)) if len(utilization) > 1 else None,
        "packed": float(rollout.packed.mean()),
    }


def spread(mean: float, bounds: Sequence[float] | None) -> str:
    """Return an interval of a share as text in per cent, such as `` ± 0.52``; empty if None.

    If the interval is clipped at 0 or 1, the text shows the distance to the farther bound.
    """
    if bounds is None:
        return ""
    return f" ± {100 * max(mean - bounds[0], bounds[1] - mean):.2f}"


def summary(rollout: Rollout, balanced: NDArray[np.bool_]) -> dict[str, Any]:
    """Compute the figures of one row of evaluate's table.

    Args:
        rollout: the packings.
        balanced: bool [E], whether the stack of each of the E episodes is in strict equilibrium.
    """
    figures = mean_utilization(rollout)
    low, high = figures.pop("low"), figures.pop("high")
    return {
        **figures,
        "interval": None if low is None else [low, high],
        "decisions_per_second": float(rollout.packed.sum() / max(rollout.seconds, 1e-9)),
        "strict_equilibrium": float(balanced.mean()),
    }


def strict_equilibrium(plan: Plan) -> bool:
    """Return whether the stack in every bin is in strict static equilibrium.

    Raises:
        ValueError: unless the lengths of the plan are integers; contacts are exact only then.
    """
    from marl_pack.stability import in_equilibrium

    if plan.sides.dtype.kind != "i":
        raise ValueError(
            "the plan has lengths of type float: needs whole numbers; choose a smaller unit"
        )
    stacks = [plan.in_bin(k) for k in range(len(plan.bin_sizes))]
    return all(in_equilibrium(stack.boxes, stack.loads) for stack in stacks)


def together(results: Sequence[Judged]) -> Judged:
    """Return the results of the bins of one episode as one: something fell if it did in any bin."""
    return Judged(
        sum(result.placements for result in results),
        next((result.fall for result in results if result.fall is not None), None),
        sum(result.seconds for result in results),
        next((result.error for result in results if result.error is not None), None),
    )


def falls(results: Sequence[Judged]) -> dict[str, Any]:
    """Compute the figures of packings that the physics engine has judged.

    Keys: ``falls`` (episodes in which something fell), ``no_verdict`` (episodes that the engine
    could not judge), ``judged_episodes`` (all episodes that it was given), ``judged`` (placements)
    and ``judge_seconds`` (seconds for one placement).
    """
    placements = sum(result.placements for result in results)
    return {
        "falls": sum(result.fall is not None for result in results),
        "no_verdict": sum(result.error is not None for result in results),
        "judged_episodes": len(results),
        "judged": placements,
        "judge_seconds": sum(result.seconds for result in results) / max(placements, 1),
    }
