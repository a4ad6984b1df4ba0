"""The SAPIEN scene of a stack: the bin, its boxes, gravity, and which bodies collide.

SAPIEN is loaded when the first world is built, so that importing this module needs only NumPy.
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from marl_pack.extras import missing
from marl_pack.sapien_check.stack import Floats, Stack

GROUND_BIT = 31  # the bit of the collision groups that stands for the floor
WALL = 0.05  # metres, thickness of the walls
EVERY = [1 | 1 << GROUND_BIT, 1 | 1 << GROUND_BIT, 0, 0]
"""Collision words of a box that collides with all other boxes that have them, and the floor."""


@dataclass(frozen=True)
class Pass:
    """One simulation: time step in seconds, and position iterations of the solver."""

    dt: float
    iterations: int


@dataclass(frozen=True)
class Physics:
    """Settings of a simulation, and the thresholds of a fall.

    Raises:
        ValueError: for an impossible number.
    """

    friction: float = 0.5  # static and dynamic, between all faces
    duration: float = 1.0  # seconds that a stack has to stand
    patience: float = 3.0  # seconds if a box has moved by a tenth of a threshold by then
    distance: float = 0.003  # metres that the middle of a box may move, in the judge's scale
    angle: float = 1.0  # degrees that a box may rotate
    contact_offset: float = 0.002  # metres at which contacts are made, in the judge's scale
    passes: tuple[Pass, ...] = (Pass(1 / 240, 50), Pass(1 / 1000, 25), Pass(1 / 4000, 100))
    heavy: Pass = Pass(1 / 16000, 200)  # one more if some boxes are far heavier than others
    everything: bool = False  # whether all boxes and the walls collide

    def __post_init__(self) -> None:
        numbers = (self.duration, self.patience, self.distance, self.angle, self.contact_offset)
        if not self.passes or not all(0 < value < np.inf for value in numbers):
            raise ValueError(f"{self}: needs a pass and positive numbers")
        if not 0 <= self.friction < np.inf:
            raise ValueError(f"friction = {self.friction}: needs a number, 0 or more")


DEFAULT = Physics()


class SimulationError(RuntimeError):
    """A stack gets no verdict: its simulation diverged, or it is beyond the judge's limits."""


@functools.cache
def load_sapien() -> Any:
    """Return the package ``sapien``; the first call imports it.

    Raises:
        ModuleNotFoundError: if it is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns about drivers for rendering, not used here
            import sapien
    except ModuleNotFoundError as error:
        raise missing(error, "the judge needs SAPIEN", "physics") from None
    return sapien


class World:
    """A simulated bin with boxes at their nominal poses, under gravity.

    SAPIEN has one set of solver settings for the whole process. It reads them when a system and its
    bodies are made, so each new world sets them.

    Args:
        stack: the boxes.
        physics: friction, and which boxes collide.
        step: time step and iterations.
        groups: the result of :func:`collision_groups`, if the caller has computed it.
    """

    tgs = True  # whether the solver is TGS; else PGS

    def __init__(
        self, stack: Stack, physics: Physics, step: Pass, groups: list[list[int]] | None = None
    ) -> None:
        sapien = self.sapien = load_sapien()
        physx = sapien.physx
        physx.set_scene_config(enable_tgs=self.tgs, enable_pcm=True, enable_ccd=False)
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
            for wall in walls(stack.size):
                self._fix(*wall)
        groups = collision_groups(stack, physics) if groups is None else groups
        self.bodies: list[Any] = []
        for i in range(len(stack)):
            self.add_box(stack, i, groups[i])

    def _fix(self, middle: Sequence[float], half: Sequence[float]) -> None:
        """Add a fixed box with which all boxes on the floor collide."""
        physx = self.sapien.physx
        body = physx.PhysxRigidStaticComponent()
        shape = physx.PhysxCollisionShapeBox(np.array(half, np.float32), self.material)
        shape.set_collision_groups([1 << GROUND_BIT, 1 << GROUND_BIT, 0, 0])
        body.attach(shape)
        self._add(body, middle)

    def _add(self, body: Any, middle: Sequence[float], yaw: float = 0.0) -> None:
        """Add a body to the scene with its middle at a point, rotated about the vertical."""
        entity = self.sapien.Entity()
        entity.add_component(body)
        rotation = [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]
        entity.set_pose(self.sapien.Pose(list(middle), rotation))
        self.scene.add_entity(entity)

    def add_box(self, stack: Stack, i: int, groups: list[int]) -> Any:
        """Add box i of a stack as a moving body at its nominal pose, and return the body."""
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
        self._add(body, stack.middle[i].tolist(), float(stack.yaw[i]))
        self.bodies.append(body)
        return body

    def set_poses(self, middles: Floats, rotations: Floats) -> None:
        """Put the first boxes at poses in the form that :meth:`poses` returns."""
        for body, middle, rotation in zip(self.bodies, middles, rotations, strict=False):
            body.entity.set_pose(self.sapien.Pose(middle.tolist(), rotation.tolist()))

    def run(self, seconds: float) -> None:
        """Simulate a number of seconds, rounded to whole steps."""
        for _ in range(max(1, round(seconds / self.system.timestep))):
            self.system.step()

    def poses(self) -> tuple[Floats, Floats]:
        """Return middles [n, 3] in metres and quaternions [n, 4], w first.

        Raises:
            SimulationError: if a pose is not finite, or a box is over 1 km away.
        """
        poses = [body.entity_pose for body in self.bodies]
        middles = np.array([pose.p for pose in poses], np.float64).reshape(-1, 3)
        rotations = np.array([pose.q for pose in poses], np.float64).reshape(-1, 4)
        if not (np.isfinite(middles).all() and np.isfinite(rotations).all()):
            raise SimulationError("the simulation diverged: poses are not finite")
        if (np.abs(middles) > 1e3).any():
            raise SimulationError("the simulation diverged: a box is over 1 km away")
        return middles, rotations

    def movement(self) -> tuple[Floats, Floats]:
        """Return how far each box is from its nominal pose: its middle in metres, and degrees, [n].

        Raises:
            SimulationError: for the reasons of :meth:`poses`.
        """
        return movement(*self.poses(), self.stack.middle, self.stack.yaw)

    def moved(self) -> tuple[int, ...]:
        """Return the boxes that moved by more than a threshold."""
        return past(*self.movement(), self.physics)


def movement(
    middles: Floats, rotations: Floats, nominal: Floats, yaw: Floats
) -> tuple[Floats, Floats]:
    """Return how far boxes are from their nominal poses: their middles in metres, and degrees, [n].

    Args:
        middles: [n, 3], metres.
        rotations: quaternions [n, 4], w first.
        nominal: [n, 3], middles of the nominal poses.
        yaw: [n], their rotations about the vertical, radians.
    """
    # The vector part's length is the sine of half the angle: exact for small angles.
    cos, sin = np.cos(yaw / 2), np.sin(yaw / 2)
    w, x, y, z = rotations.T
    vector = np.sqrt((x * cos + y * sin) ** 2 + (y * cos - x * sin) ** 2 + (z * cos - w * sin) ** 2)
    distance = np.linalg.norm(middles - nominal, axis=1)
    return distance, np.degrees(2 * np.arcsin(vector.clip(max=1.0)))


def walls(size: Floats) -> list[tuple[list[float], list[float]]]:
    """Return the middle and the half sides of the four walls of a bin, which are as tall as it."""
    fixed = []
    for axis in (0, 1):
        for side in (-WALL / 2, size[axis] + WALL / 2):
            middle, half = size / 2, size / 2 + WALL
            middle[axis], half[axis], half[2] = side, WALL / 2, size[2] / 2
            fixed.append((middle.tolist(), half.tolist()))
    return fixed


def past(distance: Floats, angle: Floats, physics: Physics, share: float = 1) -> tuple[int, ...]:
    """Return the boxes that moved or rotated by more than a share of the thresholds."""
    far = (distance > share * physics.distance) | (angle > share * physics.angle)
    return tuple(np.flatnonzero(far).tolist())


def collision_groups(stack: Stack, physics: Physics) -> list[list[int]]:
    """Return SAPIEN's four collision words for each box.

    Two shapes collide if the first word of one and the second word of the other have a common bit.
    Each box that carries others has one bit as its first word, and the boxes that rest on it have
    that bit in their second word. There are fewer bits than boxes. So two boxes share a bit if
    nothing that rests on one of them could touch the other before the verdict is reached.
    """
    n = len(stack)
    if physics.everything:
        return [EVERY] * n
    on = stack.rests_on()
    near = 2 * (physics.distance + physics.contact_offset)  # both boxes may come closer
    beside, above = stack.overlaps()
    stray = (
        (-beside < near) & (-above < near) & ~on
    )  # [i, j]: i could touch j later, but does not rest on it
    np.fill_diagonal(stray, False)
    # j and k may not share a bit if something on j could touch k without resting on it.
    apart = (on.T.astype(np.float32) @ stray.astype(np.float32)) > 0
    apart |= apart.T
    bit = np.full(n, -1)
    for j in np.flatnonzero(on.any(0)):
        used = set(bit[apart[j]].tolist())
        bit[j] = next(b for b in range(n + 1) if b not in used)
    if n and bit.max() >= GROUND_BIT:
        raise SimulationError(
            f"{n} boxes: too many so close together for {GROUND_BIT} collision groups"
        )
    first = [1 << int(b) if b >= 0 else 0 for b in bit]
    second = [0] * n
    for i, j in np.argwhere(on):
        second[i] |= first[j]
    for i in np.flatnonzero(stack.low[:, 2] < stack.slack):
        second[i] |= 1 << GROUND_BIT
    return [[a, b, 0, 0] for a, b in zip(first, second, strict=True)]
