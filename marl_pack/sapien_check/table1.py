"""The paper's Table 1: objects set down at random where a rule allows it, and how many fall.

A bin of 0.6 m in cells of 5 mm; sides uniform in 0.03–0.3 m; each object as it comes, at a cell
drawn uniformly from its mask; physics after every placement. A bin ends when nothing fits or
something has fallen.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from itertools import count
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from marl_pack.bins import Bins
from marl_pack.evaluate import Episodes
from marl_pack.game.packing import Packing
from marl_pack.sapien_check.judge import DEFAULT, Physics, check, in_order
from marl_pack.sapien_check.stack import DENSITY, Stack
from marl_pack.stability import OrientedItem, Rule, in_equilibrium, make_rule

SIZE, CELL, SIDES = (120, 120, 120), 0.005, (6, 60)
PAPER: dict[str, dict[str, Any]] = {
    "hull_1":
        {"objects": 3000, "falls": 153, "rate": 0.051, "total": 4203.3, "each": "1.40-1.00"},
    "hull_alpha":
        {"objects": 3000, "falls": 1, "rate": 0.0003, "total": 4452.6, "each": "1.48-1.00"},
}  # fmt: skip
"""The paper's columns, its own figures: time cost in all and "per cost", in seconds."""


@dataclass(frozen=True)
class Settings:
    """What is tried."""

    rule: str
    seed: int = 0
    physics: Physics = DEFAULT


@dataclass(frozen=True)
class Placement:
    """One object."""

    stands: bool  # by the judge
    equilibrium: bool  # by the exact equilibrium of the stack
    mask_seconds: float  # of CPU time
    judge_seconds: float  # of CPU time


@dataclass(frozen=True)
class Bin:
    """One bin to its end."""

    placements: list[Placement]
    boxes: NDArray[np.int16]  # [n, 6]
    loads: NDArray[np.float64]  # [n, 3]

    def first(self, n: int) -> Bin:
        """Its first n placements."""
        return Bin(self.placements[:n], self.boxes[:n], self.loads[:n])


class Timed:
    """A rule that takes its own time."""

    def __init__(self, rule: Rule) -> None:
        self.rule = rule
        self.taken: list[float] = []  # CPU seconds, a mask each

    def __call__(self, bins: Bins, item: OrientedItem) -> Tensor:
        """The rule's mask."""
        start = time.process_time()
        mask = self.rule(bins, item)
        self.taken.append(time.process_time() - start)
        return mask


@cache
def _compile(settings: Settings) -> None:
    """Have the rule compiled, so that no mask's time counts it."""
    list(_play(settings, -1, Timed(make_rule(settings.rule))))


def _play(settings: Settings, number: int, rule: Timed) -> Iterator[Packing]:
    """Bin ``number`` after each of its placements."""
    draw = np.random.default_rng((settings.seed, 1 + number))
    game = Packing(
        1, SIZE, "rs", sides=SIDES, rule=rule, orientations=(0,), seed=settings.seed,
        first_episode=1 + number, auto_reset=False,
    )  # fmt: skip
    while bool(game.alive):
        cells = game.mask[0, 0].flatten().nonzero().flatten()
        game.place(torch.zeros(1, dtype=torch.int64), cells[[draw.integers(len(cells))]])
        yield game


def fill(settings: Settings, number: int) -> Bin:
    """Play bin ``number`` to its end, judging after every placement."""
    torch.set_num_threads(1)
    _compile(settings)
    rule = Timed(make_rule(settings.rule))
    placements: list[Placement] = []
    for game in _play(settings, number, rule):
        n = int(game.bins.count)
        boxes, loads = game.bins.boxes[0, :n].numpy(), game.bins.loads[0, :n].numpy()
        start = time.process_time()
        stack = Stack.of_cells(SIZE, boxes, cell=CELL, density=DENSITY)
        stands = check(stack, settings.physics).stands
        judge_seconds = time.process_time() - start
        masks = rule.taken.pop(0)  # the placement's own; the next object's has been made already
        placements.append(Placement(stands, in_equilibrium(boxes, loads), masks, judge_seconds))
        if not stands:
            break
    return Bin(placements, boxes, loads)


def run(
    settings: Settings,
    objects: int,
    processes: int = 1,
    progress: Callable[[int], object] = lambda done: None,
) -> list[Bin]:
    """Bin after bin until so many objects have been placed; the last bin is cut short.

    What comes does not depend on the number of processes.
    """
    bins: list[Bin] = []
    left = objects
    task = partial(fill, settings)
    for filled in map(task, count()) if processes == 1 else in_order(task, count(), processes):
        bins.append(filled.first(left))
        left -= len(bins[-1].placements)
        progress(len(bins[-1].placements))
        if not left:
            break
    return bins


def summary(bins: list[Bin]) -> dict[str, Any]:
    """The rows of the table."""
    placements = [p for filled in bins for p in filled.placements]
    n = len(placements)
    falls = [p for p in placements if not p.stands]
    mask = np.array([p.mask_seconds for p in placements])
    return {
        "objects": n,
        "bins": len(bins),
        "falls": len(falls),
        "rate": len(falls) / n,
        "falls_unstable": sum(not p.equilibrium for p in falls),
        "unstable_standing": sum(p.stands and not p.equilibrium for p in placements),
        "mask_total": float(mask.sum()),
        "mask_each": float(mask.mean()),
        "mask_low": float(np.quantile(mask, 0.05)),
        "mask_high": float(np.quantile(mask, 0.95)),
        "judge_each": float(np.mean([p.judge_seconds for p in placements])),
    }


def fallen(bins: list[Bin]) -> Episodes:
    """The bins in which something fell, as packings."""
    fell = [filled for filled in bins if not filled.placements[-1].stands]
    count = np.array([len(filled.boxes) for filled in fell], np.int64)
    boxes = np.zeros((len(fell), count.max(initial=1), 6), np.int16)
    loads = np.zeros((*boxes.shape[:2], 3))
    for e, filled in enumerate(fell):
        boxes[e, : count[e]], loads[e, : count[e]] = filled.boxes, filled.loads
    filled_share = boxes[..., 3:].astype(np.int64).prod(2).sum(1) / np.prod(SIZE)
    return Episodes(SIZE, filled_share, count, boxes, loads, float("nan"))
