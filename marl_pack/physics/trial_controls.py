"""Test the trials with controls: stacks whose outcome follows from statics or energy.

Each kind of trial has stacks that survive and stacks that collapse, or whose box can or cannot be
inserted. Where the errors are drawn at random, the outcome is computed from the drawn values, and
draws too close to the limit are left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from marl_pack.physics import controls
from marl_pack.plan import Plan
from marl_pack.sapien_check.stack import Stack
from marl_pack.sapien_check.trials import Errors, Trial, run_trial

REPEATS = 12  # draws of each control with random errors
SURVIVES, COLLAPSES, LEFT_OUT = "survives", "collapses", "left out"


@dataclass(frozen=True)
class Control:
    """A stack, its trial and the known outcome."""

    kind: str  # of the trial
    name: str
    plan: Plan
    trial: Trial
    known: str
    repeat: int = 0  # number of the draw


def outcome(control: Control) -> str:
    """Run the trial of a control and return its outcome in the words of ``Control.known``."""
    result = run_trial(Stack.of_plan(control.plan), control.trial, repeat=control.repeat)
    if result.left_out:
        return LEFT_OUT
    return SURVIVES if result.collapse is None else COLLAPSES


def all_controls() -> list[Control]:
    """Return all controls, kind by kind."""
    kinds = (_exact, _placed, _sized, _dropped, _inserted, _tilted, _shaken)
    return [control for kind in kinds for control in kind()]


def _exact() -> Iterator[Control]:
    """Yield stacks that stand with a margin, and one that does not, without any error."""
    for name, build in controls.STANDING.items():
        yield Control("no error", name, build(), Trial(), SURVIVES)
    overhang = controls.FAMILIES["harmonic overhang, 5 planks"]
    for margin, known in ((5.0, SURVIVES), (-5.0, COLLAPSES)):
        name = f"overhang of 5 planks, {margin:+g} mm"
        yield Control("no error", name, overhang(margin), Trial(), known)


def _placed() -> Iterator[Control]:
    """Yield a cube over an edge, with a margin that errors of 5 mm cannot or can use up.

    The cube stands if its margin, plus the error of the lower cube along x, minus its own error, is
    positive.
    """
    trial = Trial(place_error=0.005)
    for margin in (20.0, 1.0):
        name = f"cube over an edge, {margin:g} mm inside"
        plan = controls.cube(100.0, margin)
        for repeat in range(REPEATS):
            lower, upper = 1000 * Errors.drawn(trial, 2, 0, repeat).shift[:, 0]
            left = margin + lower - upper
            if abs(left) > 0.5:
                known = SURVIVES if left > 0 else COLLAPSES
                yield Control("place error", name, plan, trial, known, repeat)


def _sized() -> Iterator[Control]:
    """Yield planks on two pillars: of unequal heights, and with planks that hardly reach them."""
    plan = controls.plan_of(
        (20, 0, 0, 20, 60, 100), (140, 0, 0, 20, 60, 100), (0, 0, 100, 180, 60, 20)
    )
    trial = Trial(size_error=0.14)
    for repeat in range(REPEATS):
        sides = plan.sides * Errors.drawn(trial, 3, 0, repeat).sides
        high, low = (0, 1) if sides[0, 2] > sides[1, 2] else (1, 0)
        # The plank touches the higher pillar's inner edge and the lower pillar's outer edge.
        span = 120 - sides[high, 0] / 2 + sides[low, 0] / 2
        angle = math.degrees(math.atan((sides[high, 2] - sides[low, 2]) / span))
        if abs(angle - 5) > 0.5:
            known = SURVIVES if angle < 5 else COLLAPSES
            yield Control("size error", "plank on unequal pillars", plan, trial, known, repeat)
    plan = controls.plan_of(
        (0, 0, 0, 200, 60, 100), (396, 0, 0, 200, 60, 100), (198, 0, 100, 200, 60, 20)
    )
    trial = Trial(size_error=0.04)
    for repeat in range(REPEATS):
        longer = plan.sides[:, 0] * (Errors.drawn(trial, 3, 0, repeat).sides[:, 0] - 1)
        overlap = 2 + (longer[:2] + longer[2]) / 2  # of the plank and each pillar
        if (abs(overlap) > 1).all():
            # Without both pillars, the plank has nothing near its planned height to rest on.
            known = (LEFT_OUT, COLLAPSES, SURVIVES)[(overlap > 0).sum()]
            yield Control("size error", "plank that just reaches", plan, trial, known, repeat)


def _dropped() -> Iterator[Control]:
    """Yield a box dropped on a plank's protruding end, or on the part above the post.

    The plank of 4 kg turns about the post's edge, 50 mm from its middle; the box of 2 kg is 40 mm
    beyond the edge. At rest the plank stands. A box that falls 1 m gives it 1.4 J, and 0.1 J turn
    it by 5°.
    """
    for x, drop, known in (
        (220, 0.001, SURVIVES), (220, 1.0, COLLAPSES), (70, 1.0, SURVIVES)
    ):  # fmt: skip
        plan = controls.plan_of(
            (0, 0, 0, 200, 100, 100), (0, 0, 100, 300, 100, 20), (x, 20, 120, 60, 60, 60),
            mass=(4, 4, 2),
        )  # fmt: skip
        place = "on the end of a plank" if x == 220 else "above a post"
        yield Control("drop", f"{place}, {1000 * drop:g} mm", plan, Trial(drop=drop), known)


def _inserted() -> Iterator[Control]:
    """Yield boxes in slots that are wide enough, or too narrow by more than a box gives."""
    plan = controls.plan_of(
        (0, 0, 0, 200, 200, 200), (304, 0, 0, 200, 200, 200), (202, 0, 0, 100, 200, 200)
    )
    trial = Trial(place_error=0.005)
    for repeat in range(REPEATS):
        shift = 1000 * Errors.drawn(trial, 3, 0, repeat).shift[:, 0]
        room = 4 + shift[1] - shift[0]
        if room > 0 or room < -1.5:
            known = SURVIVES if room > 0 else LEFT_OUT
            yield Control("insertion", "slot of 4 mm more", plan, trial, known, repeat)
    plan = Plan.of_boxes((300.0, 300.0, 600.0), [(0.0, 0.0, 0.0, 300.0, 300.0, 200.0)], unit_mm=1.0)
    trial = Trial(size_error=0.02, walls=True)
    for repeat in range(REPEATS):
        longest = 300 * Errors.drawn(trial, 1, 0, repeat).sides[0, :2].max()
        if longest < 300 or longest > 301.5:
            known = SURVIVES if longest < 300 else LEFT_OUT
            yield Control("insertion", "box as wide as the bin", plan, trial, known, repeat)


def _tilted() -> Iterator[Control]:
    """Yield boxes that tip or slide at an angle.

    A box tips if the angle's tangent is more than its half base by its half height, and slides if
    it is more than the friction.
    """
    for name, sides, degrees, known in (
        ("column 1 : 10", (100, 100, 1000), 3.0, SURVIVES),  # it tips at 5.7°
        ("column 1 : 10", (100, 100, 1000), 8.0, COLLAPSES),
        ("plate 3 : 1 : 10", (300, 100, 1000), 4.5, SURVIVES),
        ("plate 3 : 1 : 10", (300, 100, 1000), 8.0, COLLAPSES),
        ("plate 1 : 3 : 10", (100, 300, 1000), 8.0, COLLAPSES),
        ("flat box, friction 0.5", (400, 400, 200), 24.0, SURVIVES),  # it slides at 26.6°
        ("flat box, friction 0.5", (400, 400, 200), 29.0, COLLAPSES),
    ):
        plan = controls.plan_of((0, 0, 0, *sides))
        yield Control("tilt", f"{name}, {degrees:g}°", plan, Trial(tilt=degrees), known)


def _shaken() -> Iterator[Control]:
    """Yield boxes that tip or slide while the ground shakes slowly, at 0.5 Hz.

    A box begins to tip if the acceleration in g is more than its base by its height, and to slide
    if it is more than the friction. It may slide out and back again; at 1.2 g it is left behind,
    since the ground moves at 3.7 m/s on average and friction takes most of a second to reach that.
    """
    for name, sides, strength, known in (
        ("column 1 : 4", (100, 100, 400), 0.2, SURVIVES),  # it tips at 0.25 g
        ("column 1 : 4", (100, 100, 400), 0.35, COLLAPSES),
        ("plate 4 : 1 : 4", (400, 100, 400), 0.35, COLLAPSES),
        ("plate 1 : 4 : 4", (100, 400, 400), 0.35, COLLAPSES),
        ("flat box, friction 0.5", (400, 400, 100), 0.42, SURVIVES),
        ("flat box, friction 0.5", (400, 400, 100), 1.2, COLLAPSES),
    ):
        plan = controls.plan_of((0, 0, 0, *sides))
        trial = Trial(shake=strength, frequency=0.5)
        yield Control("shake", f"{name}, {strength:g} g", plan, trial, known)
