"""Test the judge with controls: stacks for which statics tells whether they stand or fall.

The judge simulates a stack in physics. Most controls belong to a family of stacks with a margin in
millimetres. One centre of mass decides whether the stack stands; the margin says how far inside its
support this centre lies. If the margin is positive, the stack stands. If it is negative, the centre
lies outside and the stack falls. The exact equilibrium is computed as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from marl_pack.plan import Plan
from marl_pack.sapien_check.judge import check
from marl_pack.sapien_check.stack import DENSITY, Stack
from marl_pack.sapien_check.world import DEFAULT, Physics

MARGINS = (1.0, 0.2, -0.2, -1.0)
"""Margins in millimetres at which every family is judged; negative ones are outside the support."""

SCALE = 1000
"""Number of cells in a millimetre, for the exact equilibrium, which needs whole cells."""

WIDEST = 8.0  # millimetres; largest margin at which a flip of the verdict is searched for
BIN = (1000.0, 1000.0, 2000.0)  # millimetres, so that no wall is near


def exact_equilibrium(plan: Plan) -> bool:
    """Return whether a plan in millimetres, rounded to 1/1000 mm, is in strict equilibrium."""
    from marl_pack.stability import in_equilibrium

    boxes = np.rint(plan.boxes * SCALE).astype(np.int64)
    weights = plan.weights / plan.weights.mean()
    return in_equilibrium(boxes, np.column_stack((weights, plan.centres * SCALE)))


def plan_of(
    *rows: tuple[float, ...],
    mass: tuple[float, ...] | None = None,
    last_centre: tuple[float, float] = (0.0, 0.0),
) -> Plan:
    """Return a plan of boxes in millimetres and kilograms, 300 mm from two walls of the bin.

    Args:
        rows: x, y, z, w, d, h of each box.
        mass: kilograms of each box; by default the mass of filled cartons.
        last_centre: x and y of the last box's centre of mass minus those of its middle; the other
            boxes have their centre of mass in the middle.
    """
    boxes = np.array(rows, np.float64)
    boxes[:, :2] += 300.0 - boxes[:, :2].min(0)
    weights = boxes[:, 3:].prod(1) * 1e-9 * DENSITY if mass is None else np.array(mass, float)
    centres = boxes[:, :2] + boxes[:, 3:5] / 2
    centres[-1] += last_centre
    return Plan.of_boxes(BIN, boxes, np.column_stack((weights, centres)), unit_mm=1.0)


def cube(edge: float, margin: float) -> Plan:
    """Return two cubes: about half of the upper one protrudes over the edge of the lower one."""
    return plan_of((0, 0, 0, edge, edge, edge), (edge / 2 - margin, 0, edge, edge, edge, edge))


def board(thickness: float, margin: float) -> Plan:
    """Return a board of 300 mm on a block: about half of it protrudes over the block's edge."""
    return plan_of((0, 0, 0, 300, 100, 100), (150 - margin, 0, 100, 300, 100, thickness))


def heavy_on_light(ratio: float, margin: float) -> Plan:
    """Return the stack in the paper's figure: a box on the protruding end of a light box.

    The centre of mass that decides is the common centre of these two boxes. The upper box has
    ``ratio`` times the mass of the light box.
    """
    middle = ((200 - margin) * (1 + ratio) - 150) / ratio
    return plan_of(
        (0, 0, 0, 200, 200, 100), (0, 0, 100, 300, 200, 50), (middle - 50, 50, 150, 100, 100, 100),
        mass=(1, 1, ratio),
    )  # fmt: skip


def harmonic(count: int, margin: float) -> Plan:
    """Return an overhang of ``count`` planks.

    All planks above a plank have their common centre of mass 5 mm inside its edge; for the lowest
    plank the margin takes the place of the 5 mm.
    """
    length, rows, centre = 300.0, [(0.0, 0.0, 50.0 * (count - 1), 300.0, 100.0, 50.0)], 150.0
    for above in range(1, count):
        slack = margin if above == count - 1 else 5.0
        x = centre + slack - length  # the centre of all planks above lies ``slack`` inside its edge
        rows.append((x, 0.0, 50.0 * (count - 1 - above), length, 100.0, 50.0))
        centre = (centre * above + x + length / 2) / (above + 1)
    return plan_of(*rows[::-1])


def counterweight(margin: float) -> Plan:
    """Return a plank whose middle protrudes beyond a post, and a weight on its other end."""
    weight = (100 + margin) / (75 - margin)
    return plan_of(
        (0, 0, 0, 100, 100, 100), (0, 0, 100, 400, 100, 20), (0, 25, 120, 50, 50, 50),
        mass=(1, 1, weight),
    )  # fmt: skip


def diagonal(margin: float) -> Plan:
    """Return a plate on posts under opposite corners; its centre of mass is off the diagonal."""
    offset = 30 - margin / math.sqrt(2)
    return plan_of(
        (0, 0, 0, 60, 60, 100), (240, 240, 0, 60, 60, 100), (0, 0, 100, 300, 300, 100),
        last_centre=(offset, -offset),
    )  # fmt: skip


def bridge(margin: float) -> Plan:
    """Return a plate on two posts; its centre of mass is near the edge of their common support."""
    return plan_of(
        (0, 0, 0, 80, 60, 150), (200, 0, 0, 100, 60, 150), (0, 0, 150, 300, 100, 40),
        last_centre=(0, 10 - margin),
    )  # fmt: skip


def propped(gap: float, edge: float, margin: float) -> Plan:
    """Return the stack of :func:`cube` and a tall box on the side to which the upper cube tips."""
    cubes = cube(edge, margin).boxes - [300, 300, 0, 0, 0, 0]
    neighbour_x = cubes[1, 0] + edge + gap
    return plan_of(*map(tuple, cubes), (neighbour_x, 0, 0, edge, edge, 3 * edge))


FAMILIES: dict[str, Callable[[float], Plan]] = {
    **{f"cube of {edge} mm over an edge": partial(cube, edge) for edge in (30, 60, 100, 200, 300)},
    **{f"board {t} mm thick over an edge": partial(board, t) for t in (3, 6)},
    **{f"box {r} times heavier on a light one": partial(heavy_on_light, r) for r in (1, 10, 100)},
    "box 1000 times heavier on a light one": partial(heavy_on_light, 1000),
    **{f"harmonic overhang, {n} planks": partial(harmonic, n) for n in (3, 5, 8)},
    "plank held by a counterweight": counterweight,
    "plate on diagonal posts": diagonal,
    "plate over a gap": bridge,
    "cube beside a tall neighbour, 0 mm": partial(propped, 0.0, 100.0),
    "cube beside a tall neighbour, 1 mm": partial(propped, 1.0, 100.0),
}
"""Name of each family, and the function that returns its plan for a margin in millimetres."""


def tower(count: int, edge: float) -> Plan:
    """Return a tower of ``count`` cubes."""
    return plan_of(*((0, 0, edge * k, edge, edge, edge) for k in range(count)))


def wall_of_bricks() -> Plan:
    """Return a wall of six layers of bricks, each layer over the joints of the layer below."""
    rows = []
    for layer in range(6):
        ends = [0, 50, 150, 250, 300] if layer % 2 else [0, 100, 200, 300]
        for a, b in pairwise(ends):
            rows.append((a, 0, 40 * layer, b - a, 60, 40))
    return plan_of(*rows)


STANDING: dict[str, Callable[[], Plan]] = {
    "tower of 20 cubes of 30 mm": partial(tower, 20, 30.0),
    "tower of 6 cubes of 100 mm": partial(tower, 6, 100.0),
    "wall of bricks": wall_of_bricks,
}
"""Stacks that stand with a large margin."""


@dataclass(frozen=True)
class Outcome:
    """The verdicts on one control; a verdict is true if the control stands by it."""

    name: str
    margin: float | None  # mm; None: stands with a large margin
    known: bool  # by statics
    judge: bool  # by the judge with the settings of the command
    equilibrium: bool  # by the exact equilibrium
    everything: bool  # by the judge, if all boxes and the walls collide


def outcome(name: str, margin: float | None, plan: Plan, physics: Physics = DEFAULT) -> Outcome:
    """Judge one control by physics and by the exact equilibrium."""
    stack = Stack.of_plan(plan)
    return Outcome(
        name,
        margin,
        margin is None or margin > 0,
        check(stack, physics).stands,
        exact_equilibrium(plan),
        check(stack, replace(physics, everything=True)).stands,
    )


def cases() -> list[tuple[str, float | None, Plan]]:
    """Return the name, margin and plan of every control."""
    tipping: list[tuple[str, float | None, Plan]] = [
        (name, margin, make(margin)) for name, make in FAMILIES.items() for margin in MARGINS
    ]
    return tipping + [(name, None, build()) for name, build in STANDING.items()]


def flips_at(make: Callable[[float], Plan], physics: Physics = DEFAULT) -> float:
    """Return the margin in mm at which the judge's verdict flips, to 1 µm.

    A perfect judge flips at 0. The result is NaN if the verdict does not flip within 8 mm.
    """

    def stands(margin: float) -> bool:
        return check(Stack.of_plan(make(margin)), physics).stands

    low, high = -WIDEST, WIDEST
    if stands(low) or not stands(high):
        return math.nan
    while high - low > 1e-3:
        middle = (low + high) / 2
        if stands(middle):
            high = middle
        else:
            low = middle
    return (low + high) / 2
