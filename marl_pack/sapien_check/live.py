"""A running simulation into which boxes are let down one after another, and that can be tilted.

It has the true scale of the boxes, and all boxes collide with each other. The ground itself never
moves: a tilt or a shake is what somebody standing on the ground would feel. A tilt changes the
direction of gravity. A shake adds the inertial force, which is opposite to the acceleration of the
ground; for a ground that moves without rotating this is exactly the same. SAPIEN cannot change the
gravity of a scene that has begun, so the difference acts on each box as an acceleration of its
centre of mass, as gravity does.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from marl_pack.sapien_check.insertion import Standing, rotation_matrices
from marl_pack.sapien_check.stack import Floats, Stack
from marl_pack.sapien_check.world import EVERY, Pass, Physics, World, walls

GRAVITY = 9.81  # m/s², SAPIEN's
PUSH_OUT = 0.5  # m/s at most with which boxes that overlap are pushed apart: none may fly away
WINDOW = 0.2  # seconds; at rest is what has hardly moved for so long
STILL = 1e-4  # metres that a box at rest may move in this time
TURN = 0.02  # degrees that it may rotate

TILT_SPEED = 10.0  # degrees per second: slow, so that only the angle matters
HOLD = 1.0  # seconds for which the angle is held
SHAKING = 3.0  # seconds of shaking at least, in whole periods


class LiveWorld(World):
    """A simulation that goes on while boxes are added.

    Args:
        boxes: the true boxes; none of them is there at first.
        physics: friction, and with ``everything`` the bin's walls.
        step: time step and iterations.
    """

    # TGS divides each step by its iterations. Over the minutes of a trial the steps become so short
    # that rounding lets boxes slide by centimetres. PGS (projected Gauss-Seidel) does not do that.
    tgs = False

    def __init__(self, boxes: Stack, physics: Physics, step: Pass) -> None:
        super().__init__(boxes.first(0), physics, step)
        self.boxes = boxes
        self.inserted: list[int] = []  # boxes that are in the simulation, in order
        self.extra = np.zeros(3)  # m/s² that act on all boxes besides gravity

    def standing(self, under: NDArray[np.bool_]) -> Standing:
        """Return the boxes and walls as they stand now.

        Args:
            under: for each inserted box, whether the next box may rest on it.
        """
        middles, quaternions = self.poses()
        fixed = walls(self.boxes.size) if self.physics.everything else []
        upright = np.broadcast_to(np.eye(3), (len(fixed), 3, 3))
        corners = np.array(fixed, np.float64).reshape(-1, 2, 3)
        return Standing(
            np.vstack((middles, corners[:, 0])),
            np.concatenate((rotation_matrices(quaternions), upright)),
            np.vstack((self.boxes.sides[self.inserted] / 2, corners[:, 1])),
            np.array([*under, *[False] * len(fixed)], bool),
        )

    def insert(self, i: int, middle: Floats, yaw: float) -> None:
        """Let go of box i at rest, with its middle at a point and rotated about the vertical."""
        body = self.add_box(self.boxes, i, EVERY)
        body.set_max_depenetration_velocity(PUSH_OUT)
        rotation = [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]
        body.entity.set_pose(self.sapien.Pose(middle.tolist(), rotation))
        self.inserted.append(i)

    def run(self, seconds: float) -> None:
        """Simulate a number of seconds, rounded to whole steps, with the extra acceleration."""
        pushed = self.bodies if self.extra.any() else []
        for _ in range(max(1, round(seconds / self.system.timestep))):
            for body in pushed:
                body.add_force_torque(self.extra, np.zeros(3), "acceleration")
            self.system.step()

    def settle(self, least: float, most: float) -> None:
        """Simulate until everything is at rest, for a time between two limits in seconds."""
        seconds = 0.0
        before = self.poses()
        while seconds < most:
            self.run(WINDOW)
            seconds += WINDOW
            now = self.poses()
            if seconds >= least and _at_rest(before, now):
                return
            before = now

    def put_back(self, poses: tuple[Floats, Floats]) -> None:
        """Put all boxes at rest at poses in the form that :meth:`poses` returns."""
        self.set_poses(*poses)
        for body in self.bodies:
            body.set_linear_velocity(np.zeros(3))
            body.set_angular_velocity(np.zeros(3))

    def tilt(self, degrees: float, direction: Floats) -> None:
        """Turn gravity slowly to a direction [2] by an angle, and hold it for a while."""
        for angle in np.arange(0.0, degrees, TILT_SPEED * self.system.timestep):
            self._lean(float(angle), direction)
            self.run(self.system.timestep)
        self._lean(degrees, direction)
        self.settle(HOLD, 2 * HOLD)
        self.extra = np.zeros(3)

    def _lean(self, degrees: float, direction: Floats) -> None:
        """Set the extra acceleration that turns gravity by an angle."""
        angle = math.radians(degrees)
        across = math.sin(angle) * direction
        self.extra = GRAVITY * np.array([*across, 1 - math.cos(angle)])

    def shake(self, strength: float, frequency: float, direction: Floats) -> None:
        """Shake the ground to and fro along a direction [2], and wait until everything rests.

        It lasts for whole periods, so that the ground is at rest before and after it.

        Args:
            strength: largest acceleration, in g.
            frequency: periods per second.
            direction: of length 1.
        """
        seconds = math.ceil(SHAKING * frequency) / frequency
        largest = strength * GRAVITY * np.array([*direction, 0.0])
        for time in np.arange(0.0, seconds, self.system.timestep):
            self.extra = -largest * math.sin(2 * math.pi * frequency * time)
            self.run(self.system.timestep)
        self.extra = np.zeros(3)
        self.settle(HOLD, 2 * HOLD)


def _at_rest(before: tuple[Floats, Floats], now: tuple[Floats, Floats]) -> bool:
    """Return whether no box has moved between two results of :meth:`World.poses`."""
    (middles, rotations), (later, rotated) = before, now
    moved = np.linalg.norm(later - middles, axis=1)
    # Two quaternions of one rotation have the same or the opposite sign. The length of their
    # difference is half the angle in radians, also for angles too small for an arc cosine.
    rotated = rotated * np.where((rotations * rotated).sum(1, keepdims=True) < 0, -1, 1)
    turned = np.degrees(2 * np.linalg.norm(rotated - rotations, axis=1))
    return bool((moved < STILL).all() and (turned < TURN).all())
