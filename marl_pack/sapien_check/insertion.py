"""Find where a box can be let down among boxes that stand, exactly, for boxes in any rotation.

Two boxes are apart if one of 15 directions separates them: the normals of their faces, and the
products of their edges (the separating axis theorem). For a box that moves straight up or down,
each direction leaves an interval of heights at which it does not separate the two. The boxes
overlap at the heights that are in all 15 intervals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marl_pack.sapien_check.stack import Floats

PRESS = 0.0005
"""Metres by which a box may overlap another when it is let go: boxes that touch do not block each
other. The simulation pushes them apart."""

STEP = 0.0005  # metres between the places that are tried; a slot without any gap is 2 PRESS wide
AT_ONCE = 400  # number of places that are tested together
PARALLEL = 1e-6  # length of the product of two edges below which they count as parallel
LEVEL = 1e-9  # vertical part below which a direction counts as horizontal


@dataclass(frozen=True)
class Standing:
    """The m boxes and walls among which a box is let down."""

    middles: Floats  # [m, 3]       metres
    rotations: Floats  # [m, 3, 3]  matrices; a column is the direction of a side
    halves: Floats  # [m, 3]        half of each side, metres
    under: NDArray[np.bool_]  # [m]  whether the box may rest on it; the others block its way

    def near(self, place: Floats, reach: float) -> Standing:
        """Return those that a point within ``reach`` of a place (x, y) may be in."""
        radius = np.linalg.norm(self.halves, axis=1)
        close = np.linalg.norm(self.middles[:, :2] - place, axis=1) < radius + reach
        return Standing(*(array[close] for array in vars(self).values()))


@dataclass(frozen=True)
class Descent:
    """A box that is let down to its planned place, with the errors of a robot."""

    half: Floats  # [3]     half of each side, metres
    yaw: float  # radians
    aim: Floats  # [2]      x, y at which the robot lets go, if nothing is in the way
    planned: Floats  # [3]  planned middle of the box
    drop: float  # metres above what carries it, where the robot lets go
    give: float  # largest distance from the aim to which the box may be shifted
    distance: float  # largest distance from the planned middle at which it may come to rest

    def release(self, standing: Standing) -> Floats | None:
        """Return the middle [3] at which the box is let go, at the free place nearest to the aim.

        The result is None if there is no free place within ``give`` of the aim, or if the box would
        come to rest there farther than ``distance`` from its planned place, because something under
        it is missing or something beside it is in the way.
        """
        near = standing.near(self.aim, float(np.linalg.norm(self.half)) + self.give)
        offsets = _offsets(self.give)
        # The first place alone: mostly it is free.
        for part in (offsets[:1], *_parts(offsets[1:])):
            places = self.aim + part
            rest, free = self._rest(places, near)
            if free.any():
                k = free.argmax()
                middle = np.array([*places[k], rest[k]])
                fits = np.linalg.norm(middle - self.planned) <= self.distance
                return middle + np.array([0.0, 0.0, self.drop]) if fits else None
        return None

    def _rest(self, places: Floats, standing: Standing) -> tuple[Floats, NDArray[np.bool_]]:
        """Return, for k places, the height of the middle at rest, and whether the way is free."""
        half = self.half - np.minimum(PRESS, self.half / 10) * (1, 1, 0)
        low, high = overlap_heights(half, self.yaw, places, standing)
        meet, under = low < high, standing.under
        rest = np.where(meet & under, high, -np.inf).max(1, initial=self.half[2])
        blocks = (low + PRESS < rest[:, None] + self.drop) & (high - PRESS > rest[:, None])
        return rest, ~(meet & blocks & ~under).any(1)


def overlap_heights(
    half: Floats, yaw: float, places: Floats, standing: Standing
) -> tuple[Floats, Floats]:
    """Return the lowest and highest middle at which an upright box overlaps others, both [k, m].

    If the lowest is not below the highest, they overlap at no height.

    Args:
        half: half of each side of the upright box.
        yaw: its rotation about the vertical, radians.
        places: [k, 2], x, y of its middle.
        standing: the m others.
    """
    cos, sin = math.cos(yaw), math.sin(yaw)
    own = np.array([(cos, sin, 0), (-sin, cos, 0), (0, 0, 1)])  # rows: directions of its sides
    others = standing.rotations.transpose(0, 2, 1)
    count = len(others)
    edges = np.cross(own[None, :, None], others[:, None]).reshape(count, 9, 3)
    axes = np.concatenate((np.broadcast_to(own, (count, 3, 3)), others, edges), axis=1)
    length = np.linalg.norm(axes, axis=-1, keepdims=True)
    # Parallel edges have no product; the vertical, which is among the directions, replaces it.
    axes = np.where(length > PARALLEL, axes / np.maximum(length, PARALLEL), own[2])
    reach = np.abs(axes @ own.T) @ half
    reach += (np.abs(axes @ standing.rotations) * standing.halves[:, None]).sum(-1)
    offset = np.einsum("kc,mac->kma", places, axes[..., :2])
    offset -= np.einsum("mc,mac->ma", standing.middles, axes)
    rise = axes[..., 2]
    level = np.abs(rise) < LEVEL
    rise = np.where(level, 1.0, rise)
    middle, spread = -offset / rise, reach / np.abs(rise)
    always = np.where(np.abs(offset) < reach, np.inf, -np.inf)  # at all heights, or at none
    low = np.where(level, -always, middle - spread).max(-1)
    high = np.where(level, always, middle + spread).min(-1)
    return low, high


def rotation_matrices(quaternions: Floats) -> Floats:
    """Return the matrices [n, 3, 3] of quaternions [n, 4], w first."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def _offsets(give: float) -> Floats:
    """Return shifts [k, 2] on a grid within ``give``, the shortest first."""
    count = math.floor(give / STEP + 1e-9)
    line = STEP * np.arange(-count, count + 1)
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    length = np.linalg.norm(grid, axis=1)
    order = np.argsort(length, kind="stable")
    return grid[order[length[order] <= give * (1 + 1e-9)]]


def _parts(offsets: Floats) -> list[Floats]:
    """Return shifts in parts of at most :data:`AT_ONCE`."""
    return [offsets[k : k + AT_ONCE] for k in range(0, len(offsets), AT_ONCE)]
