"""The judge: it builds a stack in SAPIEN (PhysX on the CPU) and checks whether it stands.

After each placement the boxes start at their nominal poses, under gravity. The stack stands
if no box moves or rotates by more than a threshold within about a second. Why a verdict can be
trusted:

- Boxes collide only with boxes that they touch from above or below, and with the floor. A
  neighbour or a wall at a box's side would prop it up by friction, or by the solver's tolerance,
  and hide a fall. (With :attr:`Physics.everything` all of them collide, as in a real bin.)
- A fall has to happen again at finer time steps. Errors of the solver let a box creep, more so if a
  heavy box stands on a light one. They shrink with the step and the solver's iterations; a true
  fall does not (:attr:`Physics.passes`, :attr:`Physics.heavy`).
- All stacks are judged at one scale of length and mass (:func:`check`).
- Boxes never sleep, and the simulation runs longer if something creeps: a box at the tipping point
  begins to fall slowly.

A new scene is made for every verdict, so a verdict depends on the stack alone.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from marl_pack.sapien_check.processes import in_order
from marl_pack.sapien_check.stack import Floats, Stack
from marl_pack.sapien_check.world import (
    DEFAULT,
    Pass,
    Physics,
    SimulationError,
    World,
    collision_groups,
    past,
)

SAMPLE = 0.05  # seconds between looks at the boxes
CREEP = 0.1  # share of a threshold from which on a box may be about to fall
LONGEST = 0.3  # metres; boxes are scaled so that their longest side is the paper's longest
THINNEST = 1 / 100  # share of the longest side: in thinner boxes a threshold would be a large part
WIDEST = 3000.0  # ratio of the longest sides of bin and boxes: beyond, boxes may be over 1 km away
HEAVY = 100.0  # ratio of masses above which a fall has to happen in Physics.heavy as well
HEAVIEST = 1e4  # ratio of masses beyond which the solver cannot be trusted


@dataclass(frozen=True)
class Verdict:
    """The movement of k boxes after the last of them was placed."""

    stands: bool
    distance: Floats  # [k]  metres that each box's middle moved in the last pass, unscaled
    angle: Floats  # [k]     degrees that each box rotated
    moved: tuple[int, ...]  # boxes that moved by more than a threshold; empty if the stack stands
    passes: int  # number of simulations
    seconds: float  # simulated seconds of the last one


def check(stack: Stack, physics: Physics = DEFAULT) -> Verdict:
    """Judge whether the stack stands; all boxes begin at their nominal poses.

    Args:
        stack: the boxes in order; the last one was placed just now.
        physics: settings of the simulation.

    Statics has no scale: whether a stack stands does not depend on the unit of length or of
    mass. But the thresholds, the contacts and the solver's numbers do. So all stacks are judged at
    one scale, the scale of the paper's boxes.

    Raises:
        SimulationError: if the simulation diverges, or the boxes differ too much in size or mass.
    """
    if not len(stack):
        return Verdict(True, np.zeros(0), np.zeros(0), (), 0, 0.0)
    thinnest = float(stack.sides.min() / stack.sides.max())
    if thinnest < THINNEST:
        raise SimulationError(
            f"the shortest side is {thinnest:.3g} of the longest; the judge needs {THINNEST:g}"
        )
    widest = float(stack.size.max() / stack.sides.max())
    if widest > WIDEST:
        raise SimulationError(
            f"the bin is {widest:.3g} times as long as the longest box; the judge goes to "
            f"{WIDEST:g}"
        )
    ratio = float(stack.mass.max() / stack.mass.min())
    if ratio > HEAVIEST:
        raise SimulationError(
            f"the heaviest box weighs {ratio:.3g} times the lightest; the judge goes to "
            f"{HEAVIEST:g}"
        )
    scale = LONGEST / float(stack.sides.max())
    scaled = stack.scaled(scale)
    groups = collision_groups(scaled, physics)
    passes = [*physics.passes, physics.heavy] if ratio > HEAVY else physics.passes
    for number, step in enumerate(passes, 1):
        verdict = replace(_simulate(scaled, physics, step, groups), passes=number)
        if verdict.stands:
            break
    return replace(verdict, distance=verdict.distance / scale)


def _simulate(stack: Stack, physics: Physics, step: Pass, groups: list[list[int]]) -> Verdict:
    """Run one pass, which ends as soon as a box has moved too far."""
    world = World(stack, physics, step, groups)
    seconds = 0.0
    while True:
        world.run(SAMPLE)
        seconds += SAMPLE
        distance, angle = world.movement()
        moved = past(distance, angle, physics)
        creeps = past(distance, angle, physics, CREEP)
        long = physics.patience if creeps else physics.duration
        if moved or seconds > long - SAMPLE / 2:
            return Verdict(not moved, distance, angle, moved, 1, seconds)


def judge(stack: Stack, physics: Physics = DEFAULT) -> Iterator[Verdict]:
    """Yield the verdict after each placement, up to the first fall.

    Only boxes that are connected to the new box by a chain of contacts are simulated. The forces on
    the other boxes have not changed, so their last verdict still holds.

    Raises:
        SimulationError: for the reasons of :func:`check`.
    """
    if not len(stack):
        return
    from scipy.sparse.csgraph import connected_components  # slow to import

    on = stack.scaled(LONGEST / float(stack.sides.max())).rests_on()  # at the scale of check
    distance, angle = np.zeros(len(stack)), np.zeros(len(stack))
    for count in range(1, len(stack) + 1):
        part = np.arange(count)
        if not physics.everything:
            _, group = connected_components(on[:count, :count], directed=False)
            part = np.flatnonzero(group == group[-1])
        verdict = check(stack.only(part), physics)
        distance[part], angle[part] = verdict.distance, verdict.angle
        yield replace(
            verdict, distance=distance[:count].copy(), angle=angle[:count].copy(),
            moved=tuple(part[list(verdict.moved)].tolist()),
        )  # fmt: skip
        if not verdict.stands:
            return


@dataclass(frozen=True)
class Judged:
    """The result of judging one stack after each of its placements."""

    placements: int  # number of judged placements, up to the first fall
    fall: Verdict | None  # the last verdict, if it is a fall
    seconds: float  # time that judging took
    error: str | None = None  # why the next placement has no verdict


def judge_whole(stack: Stack, physics: Physics = DEFAULT) -> Judged:
    """Judge a stack after each of its placements, and time it."""
    start = time.perf_counter()
    verdicts, error = [], None
    try:
        for verdict in judge(stack, physics):
            verdicts.append(verdict)
    except SimulationError as failed:
        error = str(failed)
    fall = verdicts[-1] if verdicts and not verdicts[-1].stands else None
    return Judged(len(verdicts), fall, time.perf_counter() - start, error)


def judge_all(
    stacks: Iterable[Stack], physics: Physics = DEFAULT, processes: int = 1
) -> Iterator[Judged]:
    """Judge many stacks in several processes; yield the results in the order of the stacks.

    With more than one process the calling script needs ``if __name__ == "__main__":``.
    """
    task: Callable[[Stack], Judged] = functools.partial(judge_whole, physics=physics)
    if processes == 1:
        yield from map(task, stacks)
        return
    yield from in_order(task, stacks, processes)
