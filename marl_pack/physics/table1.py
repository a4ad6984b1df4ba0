"""Measure the paper's Table 1: place objects at random where a rule allows it, and count falls.

The bin is a cube of 0.6 m, in cells of 5 mm. The sides of objects are uniform in 0.03–0.3 m. Each
object is placed in its first orientation, at a cell drawn uniformly from its mask. Physics judges
the stack after every placement. A bin ends when nothing fits or something has fallen.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.evaluation.statistics import strict_equilibrium
from marl_pack.plan import Plan
from marl_pack.sapien_check.judge import check
from marl_pack.sapien_check.processes import in_order
from marl_pack.sapien_check.stack import DENSITY, Stack
from marl_pack.sapien_check.world import DEFAULT, Physics
from marl_pack.stability import make_rule

if TYPE_CHECKING:
    from torch import Tensor

    from marl_pack.bins import Bins
    from marl_pack.game.packing import Packing
    from marl_pack.stability import OrientedItem, Rule

SIZE, CELL, SIDES = (120, 120, 120), 0.005, (6, 60)
PAPER: dict[str, dict[str, Any]] = {
    "hull_1":
        {"objects": 3000, "falls": 153, "rate": 0.051, "total": 4203.3, "each": "1.40-1.00"},
    "hull_alpha":
        {"objects": 3000, "falls": 1, "rate": 0.0003, "total": 4452.6, "each": "1.48-1.00"},
}  # fmt: skip
"""The figures that the paper reports; its times, in seconds, are the total and the "per cost"."""


@dataclass(frozen=True)
class Settings:
    """The rule, seed and physics of one row of the table."""

    rule: str
    seed: int = 0
    physics: Physics = DEFAULT


@dataclass(frozen=True)
class Trial:
    """The record of one bin: its n boxes, and the verdicts and times for each placement."""

    plan: Plan
    stands: NDArray[np.bool_]  # [n]          by the judge
    equilibrium: NDArray[np.bool_]  # [n]     by the exact equilibrium of the stack
    mask_seconds: NDArray[np.float64]  # [n]  CPU time of the placement's mask
    judge_seconds: NDArray[np.float64]  # [n]  CPU time of the verdict

    def first(self, n: int) -> Trial:
        """Return the trial with only its first n placements, or all if there are fewer."""
        arrays = {f.name: getattr(self, f.name)[:n] for f in fields(self) if f.name != "plan"}
        return replace(self, plan=self.plan.first(n), **arrays)


class Timed:
    """A rule that measures how long the computation of its masks takes."""

    def __init__(self, rule: Rule) -> None:
        self.rule = rule
        self.seconds: list[float] = []  # CPU time of each mask

    def __call__(self, bins: Bins, item: OrientedItem) -> Tensor:
        """Return the rule's mask, and record how long it took."""
        start = time.process_time()
        mask = self.rule(bins, item)
        self.seconds.append(time.process_time() - start)
        return mask


@cache
def _compile(settings: Settings) -> None:
    """Compile the rule, so that no measured time includes compilation."""
    list(_play(settings, -1, Timed(make_rule(settings.rule))))


def _play(settings: Settings, number: int, rule: Timed) -> Iterator[Packing]:
    """Yield the game of bin ``number`` after each of its placements."""
    import torch

    from marl_pack.game.packing import Packing

    draw = np.random.default_rng((settings.seed, 1 + number))
    game = Packing(
        1, SIZE, "rs", sides=SIDES, rule=rule, orientations=(0,), seed=settings.seed,
        first_episode=1 + number, auto_reset=False,
    )  # fmt: skip
    while bool(game.alive):
        cells = game.mask[0, 0].flatten().nonzero().flatten()
        game.place(torch.zeros(1, dtype=torch.int64), cells[[draw.integers(len(cells))]])
        yield game


def fill(settings: Settings, number: int) -> Trial:
    """Fill bin ``number`` until its end, and judge it after every placement."""
    import torch

    torch.set_num_threads(1)
    _compile(settings)
    rule = Timed(make_rule(settings.rule))
    rows = []
    for game in _play(settings, number, rule):
        plan = Plan.from_bins(game.bins, 0, unit_mm=1000 * CELL)
        start = time.process_time()
        stack = Stack.of_plan(plan, density=DENSITY)
        stands = check(stack, settings.physics).stands
        judge_seconds = time.process_time() - start
        # The list also has the time of the next object's mask; the first time is this object's.
        rows.append((stands, strict_equilibrium(plan), rule.seconds.pop(0), judge_seconds))
        if not stands:
            break
    return Trial(plan, *map(np.array, zip(*rows, strict=True)))


def run(settings: Settings, objects: int, processes: int = 1) -> Iterator[Trial]:
    """Fill bins until ``objects`` objects have been placed; the last trial is cut short.

    The number of processes does not change the objects.

    Args:
        settings: rule, seed and physics.
        objects: total number of placements, 1 or more.
        processes: number of processes that work at once.
    """
    left = objects
    task = partial(fill, settings)
    trials = map(task, count()) if processes == 1 else in_order(task, count(), processes)
    while left:
        trial = next(trials).first(left)
        left -= len(trial.plan)
        yield trial


def summary(trials: Sequence[Trial]) -> dict[str, Any]:
    """Compute the figures of one row of the table; times are in seconds."""
    stands, equilibrium, mask, judge = (
        np.concatenate([getattr(trial, name) for trial in trials])
        for name in ("stands", "equilibrium", "mask_seconds", "judge_seconds")
    )
    return {
        "objects": len(stands),
        "bins": len(trials),
        "falls": int((~stands).sum()),
        "rate": float((~stands).mean()),
        "falls_unstable": int((~stands & ~equilibrium).sum()),
        "unstable_standing": int((stands & ~equilibrium).sum()),
        "mask_total": float(mask.sum()),
        "mask_each": float(mask.mean()),
        "mask_low": float(np.quantile(mask, 0.05)),
        "mask_high": float(np.quantile(mask, 0.95)),
        "judge_each": float(judge.mean()),
    }


def fallen(trials: Sequence[Trial]) -> list[Plan]:
    """Return the plans of the bins in which something fell."""
    return [trial.plan for trial in trials if not trial.stands[-1]]
