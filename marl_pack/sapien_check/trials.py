"""Trials of a real cell: does a packing survive a robot's errors, a tilt and a shake?

The judge says whether a stack stands at its exact poses. In a trial the true sizes differ from the
measured ones, and each box is dropped a little beside its place into one simulation that goes on.
So the errors of earlier boxes stay. All boxes collide with each other. Then the pallet may be
tilted in four directions, each time from the settled packing, and shaken along x and then along y.

The trial ends at the first collapse: after a placement, a tilt or a shake, a settled box is too far
from its planned pose.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from marl_pack.checks import LARGEST_SEED, real_number, truth_value, whole_number
from marl_pack.sapien_check.insertion import Descent
from marl_pack.sapien_check.live import LiveWorld
from marl_pack.sapien_check.processes import in_order
from marl_pack.sapien_check.stack import Floats, Stack
from marl_pack.sapien_check.world import Pass, Physics, SimulationError, movement, past

PASSES = {
    10.0: (Pass(1 / 240, 50), Pass(1 / 480, 60)),
    100.0: (Pass(1 / 480, 60), Pass(1 / 960, 60)),
}
"""The simulations for stacks whose masses differ by up to a ratio. A collapse counts only if it
happens in both: boxes creep by errors of the solver, more so under heavy ones, and the errors
shrink with the step."""
HIGHEST = 30  # boxes on top of each other; higher ones sag, as forces need an iteration a box

PLACED = 2.0  # seconds at most between two placements
END = (1.0, 5.0)  # seconds at least and at most after the last one
DIRECTIONS = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))  # of the tilts


@dataclass(frozen=True)
class Trial:
    """Settings of a trial. Lengths are in metres, angles in degrees.

    Raises:
        ValueError: for an impossible value.
    """

    size_error: float = 0.0  # largest error of a measured side, as a share of it
    place_error: float = 0.0  # radius of the disc in which a box is put down
    yaw: float = 0.0  # largest error of the rotation about the vertical
    drop: float = 0.0  # height of release above what carries the box
    tilt: float = 0.0  # angle of the tilt; 0: none
    shake: float = 0.0  # largest acceleration of the shake, in g; 0: none
    frequency: float = 2.0  # of the shake, in Hz
    walls: bool = False  # whether the bin has walls; else it is an open pallet
    give: float = 0.020  # farthest shift of a box that would overlap others
    friction: float = 0.5  # between all faces
    distance: float = 0.020  # a collapse is a middle farther than this from its planned place
    angle: float = 5.0  # or a rotation by more than this
    seed: int = 0  # with the number of the episode it determines all errors

    def __post_init__(self) -> None:
        limits = {
            "size_error": (0, 0.5, "a share"), "drop": (0, 10, "metres"),
            "tilt": (0, 89, "degrees"), "shake": (0, 3, "g"), "frequency": (0.5, 30, "Hz"),
            "give": (0, 0.1, "metres"), "friction": (0, 1000, "a number"),
            "distance": (0.001, 1, "metres"), "angle": (0.1, 180, "degrees"),
            "place_error": (0, 1, "metres"), "yaw": (0, 180, "degrees"),
        }  # fmt: skip
        for name, (low, high, unit) in limits.items():
            value = real_number(getattr(self, name), name)
            if not low <= value <= high:
                raise ValueError(f"{name} = {value:g}: needs {unit} from {low:g} to {high:g}")
        for name, limit in (("place_error", "distance"), ("yaw", "angle")):
            if getattr(self, name) >= getattr(self, limit):
                raise ValueError(
                    f"{name} = {getattr(self, name):g}: needs less than the {limit} of a collapse, "
                    f"{getattr(self, limit):g}"
                )
        truth_value(self.walls, "walls")
        whole_number(self.seed, "seed", 0, LARGEST_SEED)


DEFAULT = Trial()


@dataclass(frozen=True)
class Errors:
    """The errors of n boxes in one trial."""

    sides: Floats  # [n, 3]  true sides as shares of the measured ones
    shift: Floats  # [n, 2]  metres
    yaw: Floats  # [n]       radians

    @classmethod
    def drawn(cls, trial: Trial, count: int, episode: int, repeat: int = 0) -> Errors:
        """Draw the errors of one trial; settings scale them, so all trials of a seed are alike."""
        # The last number is never 0, so that no stream is that of the masses (bodies.Bodies).
        rng = np.random.default_rng((trial.seed, episode, 1 + repeat))
        sides = 1 + trial.size_error * rng.uniform(-1, 1, (count, 3))
        radius = trial.place_error * np.sqrt(rng.uniform(0, 1, count))  # uniform in the disc
        direction = rng.uniform(0, 2 * math.pi, count)
        shift = np.column_stack((radius * np.cos(direction), radius * np.sin(direction)))
        return cls(sides, shift, np.radians(trial.yaw) * rng.uniform(-1, 1, count))


@dataclass(frozen=True)
class TrialResult:
    """The outcome of one trial."""

    inserted: int  # number of boxes put into the bin
    left_out: tuple[int, ...]  # boxes that could not be inserted
    collapse: str | None  # "placement", "tilt" or "shake"; None: the packing survives
    placement: int | None  # the box whose placement ends in a collapse
    off: tuple[int, ...]  # boxes too far from their planned poses
    distance: float  # largest distance of a settled box from its planned middle, metres
    angle: float  # largest rotation from the planned pose, degrees
    planned: float  # utilization of the plan
    in_physics: float  # utilization by the boxes that stood before the first collapse
    seconds: float  # time of computing

    def __str__(self) -> str:
        """Describe the outcome in a few words."""
        if self.collapse is None:
            words = f"survives with {self.inserted} boxes"
        else:
            cause = "" if self.placement is None else f" of box {self.placement}"
            words = (
                f"collapses in the {self.collapse}{cause}: {len(self.off)} of {self.inserted} "
                f"boxes off by up to {1000 * self.distance:.1f} mm and {self.angle:.1f}°"
            )
        left = f"; {len(self.left_out)} could not be inserted" if self.left_out else ""
        return words + left


def run_trial(
    stack: Stack, trial: Trial = DEFAULT, episode: int = 0, repeat: int = 0
) -> TrialResult:
    """Build a stack once as a robot would, then tilt it and shake it.

    Args:
        stack: the planned boxes in order.
        trial: the errors, tilt and shake.
        episode: number of the stack; with the seed and ``repeat`` it determines the errors.
        repeat: number of this trial of the same stack.

    Raises:
        SimulationError: if the simulation diverges, or the boxes differ too much in mass.
    """
    start = time.perf_counter()
    errors = Errors.drawn(trial, len(stack), episode, repeat)
    for step in passes_for(stack):
        result = _Run(stack, trial, errors, step).result()
        if result.collapse is None:
            break
    return replace(result, seconds=time.perf_counter() - start)


def run_trials(
    stacks: Iterable[tuple[Stack, int, int]], trial: Trial = DEFAULT, processes: int = 1
) -> Iterator[TrialResult | SimulationError]:
    """Run many trials in several processes; yield the results, or errors, in order.

    With more than one process the calling script needs ``if __name__ == "__main__":``.

    Args:
        stacks: each stack with its numbers of episode and repeat.
        trial: the settings of all trials.
        processes: number of processes that work at once.
    """
    task: Callable[[tuple[Stack, int, int]], TrialResult | SimulationError]
    task = functools.partial(_caught, trial=trial)
    yield from map(task, stacks) if processes == 1 else in_order(task, stacks, processes)


def _caught(numbered: tuple[Stack, int, int], trial: Trial) -> TrialResult | SimulationError:
    """Run one trial; return the error if it has no result."""
    stack, episode, repeat = numbered
    try:
        return run_trial(stack, trial, episode, repeat)
    except SimulationError as error:
        return error


def passes_for(stack: Stack) -> tuple[Pass, ...]:
    """Return the simulations for a stack; the more its masses differ, the finer.

    Raises:
        SimulationError: if they differ too much, or too many boxes stand on each other.
    """
    on, level = stack.rests_on(), np.zeros(len(stack), int)
    for i in range(len(stack)):
        level[i] = 1 + level[:i][on[i, :i]].max(initial=0)
    if level.max(initial=0) > HIGHEST:
        raise SimulationError(f"{level.max()} boxes stand on each other; a trial goes to {HIGHEST}")
    ratio = float(stack.mass.max(initial=0) / stack.mass.min(initial=np.inf))
    for most, passes in PASSES.items():
        if ratio <= most:
            return passes
    raise SimulationError(
        f"the heaviest box weighs {ratio:.3g} times the lightest; a trial goes to {max(PASSES):g}"
    )


class _Run:
    """One simulation of a trial while it goes on."""

    def __init__(self, stack: Stack, trial: Trial, errors: Errors, step: Pass) -> None:
        self.plan, self.trial, self.errors = stack, trial, errors
        sides = stack.sides * errors.sides
        # A robot holds a box at the middle. No outcome depends on the unit of mass.
        true = replace(
            stack, low=stack.middle - sides / 2, sides=sides, com=stack.com * errors.sides,
            mass=stack.mass / stack.mass.mean() if len(stack) else stack.mass,
        )  # fmt: skip
        self.physics = Physics(
            friction=trial.friction, distance=trial.distance, angle=trial.angle,
            everything=trial.walls,
        )  # fmt: skip
        self.world = LiveWorld(true, self.physics, step)
        self.left_out: list[int] = []
        self.off: tuple[int, ...] = ()
        self.distance = self.angle = 0.0

    def result(self) -> TrialResult:
        """Run the trial to its end or its first collapse."""
        collapse, placement = self._first_collapse()
        inserted = self.world.inserted
        stood = [i for i in inserted if i != placement]
        shares = self.plan.sides.prod(1) / self.plan.size.prod()
        return TrialResult(
            len(inserted), tuple(self.left_out), collapse, placement, self.off, self.distance,
            self.angle, float(shares.sum()), float(shares[stood].sum()), 0.0,
        )  # fmt: skip

    def _first_collapse(self) -> tuple[str | None, int | None]:
        """Return the cause of the first collapse, and the box whose placement it was; or None."""
        world = self.world
        for i in range(len(self.plan)):
            if not self._insert(i):
                self.left_out.append(i)
                continue
            world.settle(0.0, PLACED)
            if self._collapsed():
                return "placement", i
        if not world.inserted:
            return None, None
        world.settle(*END)
        if self._collapsed():
            return "placement", world.inserted[-1]
        for cause in self._disturbances():
            if self._collapsed():
                return cause, None
        return None, None

    def _insert(self, i: int) -> bool:
        """Let down box i where a robot would; return whether there is a place for it."""
        plan, trial = self.plan, self.trial
        inserted = self.world.inserted
        under = plan.high[inserted, 2] < plan.low[i, 2] + plan.slack
        yaw = float(plan.yaw[i] + self.errors.yaw[i])
        descent = Descent(
            self.world.boxes.sides[i] / 2, yaw, plan.middle[i, :2] + self.errors.shift[i],
            plan.middle[i], trial.drop, trial.give, trial.distance,
        )  # fmt: skip
        middle = descent.release(self.world.standing(under))
        if middle is None:
            return False
        self.world.insert(i, middle, yaw)
        return True

    def _collapsed(self) -> bool:
        """Return whether a box is too far from its planned pose, and record which and how far."""
        inserted = np.array(self.world.inserted)
        distance, angle = movement(
            *self.world.poses(), self.plan.middle[inserted], self.plan.yaw[inserted]
        )
        self.distance = max(self.distance, float(distance.max()))
        self.angle = max(self.angle, float(angle.max()))
        self.off = tuple(inserted[list(past(distance, angle, self.physics))].tolist())
        return bool(self.off)

    def _disturbances(self) -> Iterator[str]:
        """Tilt the settled packing to each side, and shake it along x and then y; name each."""
        trial, world = self.trial, self.world
        settled = world.poses()
        if trial.tilt:
            for direction in DIRECTIONS:
                world.put_back(settled)
                world.tilt(trial.tilt, np.array(direction))
                yield "tilt"
        if trial.shake:
            world.put_back(settled)
            for direction in DIRECTIONS[::2]:
                world.shake(trial.shake, trial.frequency, np.array(direction))
                yield "shake"
