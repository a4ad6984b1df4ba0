"""Stacks whose fate is known by statics, to judge the judge by.

Each family has a margin in millimetres: how far the decisive centre of mass lies inside its support
(positive: the stack stands; negative: it falls). Beside the judge stands the exact equilibrium.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from marl_pack.sapien_check.judge import DEFAULT, Physics, check
from marl_pack.sapien_check.stack import DENSITY, Stack
from marl_pack.stability import in_equilibrium

MARGINS = (1.0, 0.2, -0.2, -1.0)
"""Millimetres inside the support at which every family is judged."""

SCALE = 1000
"""Cells a millimetre for the exact equilibrium, which takes whole cells."""

WIDEST = 8.0  # millimetres; the verdict is expected to flip within
BIN = (1000.0, 1000.0, 2000.0)  # millimetres, so that no wall is near


@dataclass(frozen=True)
class Boxes:
    """A stack in millimetres."""

    rows: NDArray[np.float64]  # [n, 6]  x, y, z, w, d, h
    mass: NDArray[np.float64]  # [n]     kg
    com: NDArray[np.float64]  # [n, 2]   centre of mass from the middle, mm

    def stack(self) -> Stack:
        """For the judge."""
        offset = np.zeros((len(self.rows), 3))
        offset[:, :2] = self.com / self.rows[:, 3:5]
        return Stack.of_cells(BIN, self.rows, cell=1e-3, mass=self.mass, com_offset=offset)

    def stands(self) -> bool:
        """By the exact equilibrium."""
        boxes = np.rint(self.rows * SCALE).astype(np.int64)
        centres = (self.rows[:, :2] + self.rows[:, 3:5] / 2 + self.com) * SCALE
        return in_equilibrium(boxes, np.column_stack((self.mass / self.mass.mean(), centres)))


def _boxes(*rows: tuple[float, ...], mass: tuple[float, ...] | None = None) -> Boxes:
    """Boxes with their centre of mass in the middle, pushed into the middle of the bin."""
    boxes = np.array(rows, np.float64)
    boxes[:, :2] += 300.0 - boxes[:, :2].min(0)
    weights = boxes[:, 3:].prod(1) * 1e-9 * DENSITY if mass is None else np.array(mass, float)
    return Boxes(boxes, weights, np.zeros((len(boxes), 2)))


def cube(edge: float, margin: float) -> Boxes:
    """A cube half over another's edge."""
    return _boxes((0, 0, 0, edge, edge, edge), (edge / 2 - margin, 0, edge, edge, edge, edge))


def heavy_on_light(ratio: float, margin: float) -> Boxes:
    """The paper's figure: a light box hangs over, and a heavier one stands on what hangs over.

    The decisive centre is that of both together.
    """
    middle = ((200 - margin) * (1 + ratio) - 150) / ratio
    return _boxes(
        (0, 0, 0, 200, 200, 100), (0, 0, 100, 300, 200, 50), (middle - 50, 50, 150, 100, 100, 100),
        mass=(1, 1, ratio),
    )  # fmt: skip


def harmonic(count: int, margin: float) -> Boxes:
    """Planks, each as far out as those above allow less 5 mm; the lowest decides."""
    length, rows, centre = 300.0, [(0.0, 0.0, 50.0 * (count - 1), 300.0, 100.0, 50.0)], 150.0
    for above in range(1, count):
        slack = margin if above == count - 1 else 5.0
        x = centre + slack - length  # its edge lies so far beyond the centre of all above
        rows.append((x, 0.0, 50.0 * (count - 1 - above), length, 100.0, 50.0))
        centre = (centre * above + x + length / 2) / (above + 1)
    return _boxes(*rows[::-1])


def counterweight(margin: float) -> Boxes:
    """A plank with its middle beyond the post, held by a weight on its other end."""
    weight = (100 + margin) / (75 - margin)
    return _boxes(
        (0, 0, 0, 100, 100, 100), (0, 0, 100, 400, 100, 20), (0, 25, 120, 50, 50, 50),
        mass=(1, 1, weight),
    )  # fmt: skip


def diagonal(margin: float) -> Boxes:
    """A plate on posts under two opposite corners, its centre of mass off the diagonal."""
    boxes = _boxes((0, 0, 0, 60, 60, 100), (240, 240, 0, 60, 60, 100), (0, 0, 100, 300, 300, 100))
    off = 30 - margin / math.sqrt(2)
    return replace(boxes, com=np.array([(0, 0), (0, 0), (off, -off)]))


def bridge(margin: float) -> Boxes:
    """A plate over a gap, its centre of mass near the line from post to post."""
    boxes = _boxes((0, 0, 0, 80, 60, 150), (200, 0, 0, 100, 60, 150), (0, 0, 150, 300, 100, 40))
    return replace(boxes, com=np.array([(0, 0), (0, 0), (0, 10 - margin)]))


def propped(gap: float, edge: float, margin: float) -> Boxes:
    """A cube half over another's edge, with a tall neighbour on the side it would fall to."""
    high = cube(edge, margin).rows - [300, 300, 0, 0, 0, 0]
    side = high[1, 0] + edge + gap
    return _boxes(*map(tuple, high), (side, 0, 0, edge, edge, 3 * edge))


FAMILIES: dict[str, Callable[[float], Boxes]] = {
    **{f"cube of {edge} mm over an edge": partial(cube, edge) for edge in (30, 60, 100, 200, 300)},
    **{f"box {r} times heavier on a light one": partial(heavy_on_light, r) for r in (1, 10, 100)},
    "box 1000 times heavier on a light one": partial(heavy_on_light, 1000),
    **{f"harmonic overhang, {n} planks": partial(harmonic, n) for n in (3, 5, 8)},
    "plank held by a counterweight": counterweight,
    "plate on diagonal posts": diagonal,
    "plate over a gap": bridge,
    "cube beside a tall neighbour, 0 mm": partial(propped, 0.0, 100.0),
    "cube beside a tall neighbour, 1 mm": partial(propped, 1.0, 100.0),
}
"""Margin in millimetres -> boxes."""


def tower(count: int, edge: float) -> Boxes:
    """Cubes one on the other."""
    return _boxes(*((0, 0, edge * k, edge, edge, edge) for k in range(count)))


def wall_of_bricks() -> Boxes:
    """Six courses of bricks, each over the joints of the one below."""
    rows = []
    for course in range(6):
        ends = [0, 50, 150, 250, 300] if course % 2 else [0, 100, 200, 300]
        for a, b in pairwise(ends):
            rows.append((a, 0, 40 * course, b - a, 60, 40))
    return _boxes(*rows)


STANDING: dict[str, Callable[[], Boxes]] = {
    "tower of 20 cubes of 30 mm": partial(tower, 20, 30.0),
    "tower of 6 cubes of 100 mm": partial(tower, 6, 100.0),
    "wall of bricks": wall_of_bricks,
}
"""Stacks that stand with room to spare."""


@dataclass(frozen=True)
class Outcome:
    """What was found of one control."""

    name: str
    margin: float | None  # mm; None: stands with room to spare
    known: bool  # whether it stands, by statics
    judge: bool
    equilibrium: bool
    everything: bool  # the judge's, with all boxes and the walls colliding


def outcome(name: str, margin: float | None, boxes: Boxes, physics: Physics = DEFAULT) -> Outcome:
    """Judge one control in every way."""
    stack = boxes.stack()
    return Outcome(
        name,
        margin,
        margin is None or margin > 0,
        check(stack, physics).stands,
        boxes.stands(),
        check(stack, replace(physics, everything=True)).stands,
    )


def cases() -> list[tuple[str, float | None, Boxes]]:
    """Every control: name, margin and boxes."""
    made: list[tuple[str, float | None, Boxes]] = [
        (name, margin, make(margin)) for name, make in FAMILIES.items() for margin in MARGINS
    ]
    return made + [(name, None, make_one()) for name, make_one in STANDING.items()]


def flips_at(make: Callable[[float], Boxes], physics: Physics = DEFAULT) -> float:
    """The margin in millimetres at which the judge's verdict flips, to 1 µm; 0 would be right.

    NaN if it does not flip within 8 mm.
    """
    low, high = -WIDEST, WIDEST
    if check(make(low).stack(), physics).stands or not check(make(high).stack(), physics).stands:
        return math.nan
    while high - low > 1e-3:
        middle = (low + high) / 2
        if check(make(middle).stack(), physics).stands:
            high = middle
        else:
            low = middle
    return (low + high) / 2
