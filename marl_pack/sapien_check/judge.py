"""The judge: a stack is set up in SAPIEN (PhysX on the CPU) and has to stand.

After each placement the boxes are put at their nominal poses and left to gravity; the stack stands
if none moves or turns by more than a threshold in the time given. What makes the verdict one that
can be trusted:

- Only boxes in nominal vertical contact collide, with one another or with the floor. A neighbour or
  a wall that touches a box's side would prop it up by friction, or by the solver's tolerance, and
  hide a box that falls. (:attr:`Physics.everything` lets all of them collide, as in a real bin.)
- A fall has to survive finer time steps: the solver leaves residues that let a box creep, more so
  where a heavy box stands on a light one, and these shrink with the step and the solver's
  iterations where a true fall does not (:attr:`Physics.passes`, :attr:`Physics.heavy`).
- All stacks are judged at one scale of length and mass (:func:`check`).
- No sleeping, and more time where something creeps: a box at the tipping point begins slowly.

The scene is made anew for every verdict, so a verdict depends on the stack alone.
"""

from __future__ import annotations

import functools
import multiprocessing
import signal
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, TypeVar

import numpy as np
from scipy.sparse.csgraph import connected_components

from marl_pack.sapien_check.stack import SLACK, Floats, Stack, overlaps

T = TypeVar("T")
R = TypeVar("R")

GROUND_BIT = 31  # of the collision groups: the floor
SAMPLE = 0.05  # seconds between looks at the boxes
CREEP = 0.1  # share of a threshold from which on a box may be about to fall
LONGEST = 0.3  # metres; boxes are scaled so that their longest side is the paper's longest
THINNEST = 1 / 50  # of the longest side: below, the thresholds would be a large part of a box
HEAVY = 100.0  # ratio of masses from which on a fall has to survive Physics.heavy as well
HEAVIEST = 1e4  # ratio of masses; beyond, the solver is no judge
WALL = 0.05  # metres, thickness of the walls


@dataclass(frozen=True)
class Pass:
    """One simulation: time step in seconds, and position iterations of the solver."""

    dt: float
    iterations: int


@dataclass(frozen=True)
class Physics:
    """How it is simulated, and what counts as a fall."""

    friction: float = 0.5  # static and dynamic, between all faces
    duration: float = 1.0  # seconds that a stack has to stand
    patience: float = 3.0  # the same where a box is past a tenth of a threshold by then
    distance: float = 0.003  # metres that the middle of a box may move, once scaled
    angle: float = 1.0  # degrees that a box may turn
    contact_offset: float = 0.002  # metres from which on contacts are made, once scaled
    passes: tuple[Pass, ...] = (Pass(1 / 240, 50), Pass(1 / 1000, 25), Pass(1 / 4000, 100))
    heavy: Pass = Pass(1 / 16000, 200)  # one more where some boxes are far heavier than others
    everything: bool = False  # all boxes and the walls collide

    def __post_init__(self) -> None:
        numbers = (self.duration, self.patience, self.distance, self.angle, self.contact_offset)
        if not self.passes or not all(0 < value < np.inf for value in numbers):
            raise ValueError(f"{self}: needs a pass and positive numbers")
        if not 0 <= self.friction < np.inf:
            raise ValueError(f"friction = {self.friction}: needs a number, 0 or more")


DEFAULT = Physics()


@dataclass(frozen=True)
class Verdict:
    """What k boxes did after the last of them was placed."""

    stands: bool
    distance: Floats  # [k]  metres that each box's middle moved, in the last pass, unscaled
    angle: Floats  # [k]     degrees that each box turned
    moved: tuple[int, ...]  # boxes past a threshold; empty if the stack stands
    passes: int  # simulations it took
    seconds: float  # simulated in the last one


class SimulationError(RuntimeError):
    """There is no verdict: the simulation diverged, or the stack is beyond it."""


@functools.cache
def load_sapien() -> Any:
    """The package, loaded when it is first needed.

    Raises:
        ModuleNotFoundError: if it is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about drivers for rendering, which is not done here
            import sapien
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{error}: the judge needs SAPIEN (pip install 'marl_pack[physics]')"
        ) from None
    return sapien


class World:
    """A bin with boxes at their nominal poses, and gravity.

    SAPIEN keeps solver settings for the whole process and takes them when a system and its bodies
    are made: a world changes them.

    Args:
        stack: the boxes.
        physics: friction, and what collides.
        step: time step and iterations.
        groups: what :func:`collision_groups` gave, where it is at hand.
    """

    def __init__(
        self, stack: Stack, physics: Physics, step: Pass, groups: list[list[int]] | None = None
    ) -> None:
        sapien = self.sapien = load_sapien()
        physx = sapien.physx
        physx.set_scene_config(enable_tgs=True, enable_pcm=True, enable_ccd=False)
        physx.set_body_config(
            solver_position_iterations=step.iterations, solver_velocity_iterations=1,
            sleep_threshold=0.0,
        )  # fmt: skip
        physx.set_shape_config(contact_offset=physics.contact_offset, rest_offset=0.0)
        self.system = physx.PhysxCpuSystem()
        self.system.timestep = step.dt
        self.scene = sapien.Scene([self.system])
        self.stack, self.physics = stack, physics
        self.material = physx.PhysxMaterial(physics.friction, physics.friction, 0.0)
        self._fix((*stack.size[:2] / 2, -0.5), (*(stack.size[:2] / 2 + 1.0), 0.5))
        if physics.everything:
            self._add_walls(stack.size)
        groups = collision_groups(stack, physics) if groups is None else groups
        self.bodies = [self._add_box(stack, i, groups[i]) for i in range(len(stack))]

    def _fix(self, middle: Sequence[float], half: Sequence[float]) -> None:
        """Add a box that does not move, with which all on the floor collide."""
        physx = self.sapien.physx
        body = physx.PhysxRigidStaticComponent()
        shape = physx.PhysxCollisionShapeBox(np.array(half, np.float32), self.material)
        shape.set_collision_groups([1 << GROUND_BIT, 1 << GROUND_BIT, 0, 0])
        body.attach(shape)
        self._add(body, middle)

    def _add(self, body: Any, middle: Sequence[float]) -> None:
        entity = self.sapien.Entity()
        entity.add_component(body)
        entity.set_pose(self.sapien.Pose(list(middle)))
        self.scene.add_entity(entity)

    def _add_walls(self, size: Floats) -> None:
        """Add four walls, as tall as the bin."""
        for axis in (0, 1):
            for side in (-WALL / 2, size[axis] + WALL / 2):
                middle, half = size / 2, size / 2 + WALL
                middle[axis], half[axis], half[2] = side, WALL / 2, size[2] / 2
                self._fix(middle.tolist(), half.tolist())

    def _add_box(self, stack: Stack, i: int, groups: list[int]) -> Any:
        physx = self.sapien.physx
        body = physx.PhysxRigidDynamicComponent()
        sides, mass = stack.sides[i], float(stack.mass[i])
        shape = physx.PhysxCollisionShapeBox((sides / 2).astype(np.float32), self.material)
        shape.set_collision_groups(groups)
        body.attach(shape)
        body.set_mass(mass)
        body.set_cmass_local_pose(self.sapien.Pose(stack.com[i].tolist()))
        square = sides**2
        body.set_inertia((mass / 12 * (square.sum() - square)).astype(np.float32))
        body.set_linear_damping(0.0)
        body.set_angular_damping(0.0)
        self._add(body, stack.middle[i].tolist())
        return body

    def set_poses(self, middles: Floats, turns: Floats) -> None:
        """Put the first boxes elsewhere than at their nominal poses, as :meth:`poses` gives it."""
        for body, middle, turn in zip(self.bodies, middles, turns, strict=False):
            body.entity.set_pose(self.sapien.Pose(middle.tolist(), turn.tolist()))

    def run(self, seconds: float) -> None:
        """Let time pass, to the nearest step."""
        for _ in range(max(1, round(seconds / self.system.timestep))):
            self.system.step()

    def poses(self) -> tuple[Floats, Floats]:
        """Middles [n, 3] in metres and quaternions [n, 4], w first.

        Raises:
            SimulationError: if they are no numbers, or boxes have shot away.
        """
        found = [body.entity_pose for body in self.bodies]
        middles = np.array([pose.p for pose in found], np.float64).reshape(-1, 3)
        turns = np.array([pose.q for pose in found], np.float64).reshape(-1, 4)
        if not (np.isfinite(middles).all() and np.isfinite(turns).all()):
            raise SimulationError("the simulation diverged: poses are not finite")
        if (np.abs(middles) > 1e3).any():
            raise SimulationError("the simulation diverged: a box is over 1 km away")
        return middles, turns

    def movement(self) -> tuple[Floats, Floats]:
        """How far each box is from its nominal pose: metres [n] that its middle moved, degrees [n].

        Raises:
            SimulationError: as :meth:`poses`.
        """
        middles, turns = self.poses()
        # The vector part's length is the sine of half the angle: exact for small ones.
        vector = np.linalg.norm(turns[:, 1:], axis=1)
        distance = np.linalg.norm(middles - self.stack.middle, axis=1)
        return distance, np.degrees(2 * np.arcsin(vector.clip(max=1.0)))

    def moved(self) -> tuple[int, ...]:
        """The boxes past a threshold."""
        return past(*self.movement(), self.physics)


def past(distance: Floats, angle: Floats, physics: Physics, share: float = 1) -> tuple[int, ...]:
    """The boxes that have moved or turned by more than a share of the thresholds."""
    far = (distance > share * physics.distance) | (angle > share * physics.angle)
    return tuple(np.flatnonzero(far).tolist())


def collision_groups(stack: Stack, physics: Physics) -> list[list[int]]:
    """SAPIEN's four collision words for each box.

    Two shapes collide if a bit of one's first word is in the other's second. Each box that carries
    others has one bit as its first word, and those that rest on it have that bit in their second.
    There are fewer bits than boxes, so boxes share one where nothing that rests on either could
    come to touch the other before the verdict falls.
    """
    n = len(stack)
    if physics.everything:
        every = 1 | 1 << GROUND_BIT
        return [[every, every, 0, 0]] * n
    on = stack.rests_on()
    near = 2 * (physics.distance + physics.contact_offset)  # both may come closer
    gap = -overlaps(stack.low, stack.high)
    stray = (gap < near).all(-1) & ~on  # [i, j]: i could come to touch j, but does not rest on it
    np.fill_diagonal(stray, False)
    # j and k may not share a bit if something on j could touch k without resting on it.
    apart = (on.T.astype(np.float32) @ stray.astype(np.float32)) > 0
    apart |= apart.T
    bit = np.full(n, -1)
    for j in np.flatnonzero(on.any(0)):
        taken = set(bit[apart[j]].tolist())
        bit[j] = next(b for b in range(n + 1) if b not in taken)
    if n and bit.max() >= GROUND_BIT:
        raise SimulationError(f"{n} boxes are too many so close to one another to be told apart")
    first = [1 << int(b) if b >= 0 else 0 for b in bit]
    second = [0] * n
    for i, j in np.argwhere(on):
        second[i] |= first[j]
    for i in np.flatnonzero(stack.low[:, 2] < SLACK):
        second[i] |= 1 << GROUND_BIT
    return [[a, b, 0, 0] for a, b in zip(first, second, strict=True)]


def check(stack: Stack, physics: Physics = DEFAULT) -> Verdict:
    """Does the stack stand, all boxes at their nominal poses to begin with?

    Args:
        stack: the boxes, the last one just placed.
        physics: how it is simulated.

    Statics knows no scale: whether a stack stands does not change with the unit of length or of
    mass, but the thresholds, the contacts and the numbers of a solver do. So all stacks are judged
    at one scale, that of the paper's boxes.

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
    """One pass, ended as soon as a box has moved too far."""
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
    """The verdict after each placement, up to the first fall.

    Simulated are the boxes that hang together with the one just placed, each by its contacts with
    the next. Nothing acts on the others that did not when they were judged: what was found of them
    then still holds.

    Raises:
        SimulationError: as :func:`check`.
    """
    if not len(stack):
        return
    on = stack.scaled(LONGEST / float(stack.sides.max())).rests_on()  # as check sees it
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
    """What came of one stack."""

    placements: int  # judged: all, or up to and with the one that fell
    fall: Verdict | None  # the last verdict, if it was a fall
    seconds: float  # that the judging took
    error: str | None = None  # why there is no verdict, of the placement after these


def judge_whole(stack: Stack, physics: Physics = DEFAULT) -> Judged:
    """Judge a stack after each of its placements."""
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
    """Judge many stacks, in their order, by several processes.

    With more than one the calling script needs the usual ``if __name__ == "__main__":``.
    """
    task: Callable[[Stack], Judged] = functools.partial(judge_whole, physics=physics)
    if processes == 1:
        yield from map(task, stacks)
        return
    yield from in_order(task, stacks, processes)


def in_order(task: Callable[[T], R], given: Iterable[T], processes: int) -> Iterator[R]:
    """``task`` of each that is given, in order, worked on a little ahead by several processes.

    Raises:
        SimulationError: if a process dies.
    """
    # Not forked: torch and PhysX have threads. Ctrl-C is for the process that waits.
    context = multiprocessing.get_context("spawn")
    ignore = functools.partial(signal.signal, signal.SIGINT, signal.SIG_IGN)
    source = iter(given)
    with ProcessPoolExecutor(processes, mp_context=context, initializer=ignore) as pool:
        waiting = deque(pool.submit(task, one) for one in islice(source, 2 * processes))
        try:
            while waiting:
                done = waiting.popleft().result()
                waiting.extend(pool.submit(task, one) for one in islice(source, 1))
                yield done
        except BrokenProcessPool as error:
            raise SimulationError(f"a process that judges has died: {error}") from None
        finally:
            pool.shutdown(cancel_futures=True)
