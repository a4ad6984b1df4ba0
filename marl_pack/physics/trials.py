"""Build packings in physics as a robot would, with its errors, and tilt and shake them.

Each box is dropped near its planned place into one simulation that goes on. A box that does not fit
between the others is shifted a little, or left out. A collapse is a settled box more than 20 mm or
5° off its planned pose.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from marl_pack.checks import whole_number
from marl_pack.evaluation.statistics import FEWEST, interval, share_interval, spread
from marl_pack.files import Growing, write_json
from marl_pack.physics import trial_controls
from marl_pack.physics.options import (
    add_file_options,
    chosen_bodies,
    chosen_episodes,
    load_stacks,
)
from marl_pack.sapien_check.bodies import Bodies
from marl_pack.sapien_check.trials import Trial, TrialResult, run_trials
from marl_pack.sapien_check.world import DEFAULT, SimulationError
from marl_pack.terminal import make_progress

MOST_REPEATS = 1_000_000
SHOWN = 20  # collapses that are described


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``judge trial`` that no other command has."""
    add_file_options(parser)
    add = parser.add_argument_group("the robot").add_argument
    add("--place-error", nargs=2, type=float, metavar=("MM", "YAW"), default=(0.0, 0.0),
        help="put each box down up to MM millimetres beside its place, rotated by up to YAW "
             "degrees about the vertical (default: 0 0)")  # fmt: skip
    add("--drop", type=float, metavar="MM", default=0.0,
        help="let go this much above what carries the box (default: 0)")  # fmt: skip
    add("--give", type=float, metavar="MM", default=1000 * Trial.give,
        help="shift a box that would overlap others by up to this, or leave it out "
             f"(default: {1000 * Trial.give:g})")  # fmt: skip
    add("--size-error", type=float, metavar="SHARE", default=0.0,
        help="largest error of a measured side, such as 0.01 for 1 %% (default: 0)")  # fmt: skip
    add = parser.add_argument_group("the pallet").add_argument
    add("--walls", action="store_true", help="the bin has walls (default: an open pallet)")
    add("--tilt", type=float, metavar="DEG", default=0.0,
        help="tilt it slowly to each of four sides (default: no tilt)")  # fmt: skip
    add("--shake", nargs=2, type=float, metavar=("G", "HZ"), default=(0.0, Trial.frequency),
        help="shake it along x and y with an acceleration of up to G times gravity, HZ times a "
             "second (default: no shake)")  # fmt: skip
    add = parser.add_argument_group("random numbers").add_argument
    add("--repeats", type=int, metavar="N", default=1,
        help="trials of each packing, with other errors (default: 1)")  # fmt: skip
    add("--seed", type=int, default=0, help="seed of all errors (default: 0)")


def chosen_trial(options: argparse.Namespace) -> Trial:
    """Return the trial that the options choose; they are in millimetres.

    Raises:
        ValueError: for an impossible value.
    """
    return Trial(
        size_error=options.size_error, place_error=options.place_error[0] / 1000,
        yaw=options.place_error[1], drop=options.drop / 1000, tilt=options.tilt,
        shake=options.shake[0], frequency=options.shake[1], walls=options.walls,
        give=options.give / 1000, friction=options.friction, seed=options.seed,
    )  # fmt: skip


@dataclass(frozen=True)
class Numbered:
    """The result of one trial, or the error that it ended with."""

    episode: int
    repeat: int
    result: TrialResult | SimulationError


def run(options: argparse.Namespace, console: Console) -> None:
    """Run trials of saved packings; print a summary and the first collapses, and write all."""
    whole_number(options.repeats, "--repeats", 1, MOST_REPEATS)
    trial = chosen_trial(options)
    plans = load_stacks(options.file)
    bodies = chosen_bodies(options)
    numbers = [(e, r) for e in chosen_episodes(options, plans) for r in range(options.repeats)]
    stacks = ((bodies.stack(plans[e], e), e, r) for e, r in numbers)
    done: list[Numbered] = []
    growing = Growing(options.json, write_json)
    try:
        with growing, make_progress(console) as bar:
            task = bar.add_task("trials", total=len(numbers))
            results = run_trials(stacks, trial, options.processes)
            for (e, r), result in zip(numbers, results, strict=True):
                done.append(Numbered(e, r, result))
                growing.update(report(done, len(numbers), trial, bodies, options))
                bar.advance(task)
    finally:
        if done:
            show(done, console)


def report(
    done: Sequence[Numbered], total: int, trial: Trial, bodies: Bodies, options: argparse.Namespace
) -> dict[str, Any]:
    """Return the report of the trials that have been run so far."""
    results, errors = _split(done)
    return {
        "file": str(options.file), "complete": len(done) == total, "trial": asdict(trial),
        "bodies": asdict(bodies), "summary": summary([result for _, result in results]),
        "trials": [
            {"episode": n.episode, "repeat": n.repeat, **asdict(result)} for n, result in results
        ],
        "errors": [
            {"episode": n.episode, "repeat": n.repeat, "error": str(error)} for n, error in errors
        ],
    }  # fmt: skip


def summary(results: Sequence[TrialResult]) -> dict[str, Any] | None:
    """Compute the figures of all trials that have a result; None if there are none.

    Intervals of 95 % take the trials as independent: repeats of one packing tell about this
    packing only.
    """
    if not results:
        return None
    collapses = Counter(result.collapse for result in results if result.collapse is not None)
    standing = np.array([result.in_physics for result in results])
    boxes = [result.inserted + len(result.left_out) for result in results]
    return {
        "trials": len(results),
        "collapses": collapses.total(),
        "causes": dict(collapses),
        "collapse_interval": share_interval(collapses.total(), len(results)),
        "boxes": sum(boxes),
        "left_out": sum(len(result.left_out) for result in results),
        "planned": float(np.mean([result.planned for result in results])),
        "in_physics": float(standing.mean()),
        "in_physics_interval": interval(standing) if len(standing) >= FEWEST else None,
        "seconds": float(np.mean([result.seconds for result in results])),
    }


def show(done: Sequence[Numbered], console: Console) -> None:
    """Print the first collapses and errors, and the summary."""
    results, errors = _split(done)
    collapses = [(n, result) for n, result in results if result.collapse is not None]
    for title, lines in (("", collapses), ("no result: ", errors)):
        for n, words in lines[:SHOWN]:
            name = f"episode {n.episode}" + (f", repeat {n.repeat}" if n.repeat else "")
            console.print(f"{name}: {title}{words}", soft_wrap=True)
        if len(lines) > SHOWN:
            console.print(f"… and {len(lines) - SHOWN} more (--json writes all)")
    figures = summary([result for _, result in results])
    if figures is not None:
        console.print(in_words(figures), soft_wrap=True)
    if errors:
        console.print(f"{len(errors)} trials without a result")


def in_words(figures: dict[str, Any]) -> str:
    """Return the text of a summary."""
    low, high = (100 * bound for bound in figures["collapse_interval"])
    share = 100 * figures["collapses"] / figures["trials"]
    causes = ", ".join(f"{count} in a {cause}" for cause, count in figures["causes"].items())
    error = spread(figures["in_physics"], figures["in_physics_interval"])
    return (
        f"{figures['trials']:,} trials: {figures['collapses']} collapsed"
        f"{f' ({causes})' if causes else ''}, {share:.1f} % (95 % interval {low:.1f} to "
        f"{high:.1f} %)\n"
        f"{figures['left_out']} of {figures['boxes']:,} boxes could not be inserted\n"
        f"utilization: {100 * figures['planned']:.2f} % planned, "
        f"{100 * figures['in_physics']:.2f}{error} % in physics (boxes that stood before the "
        f"first collapse;\nthose that a tilt or a shake brought down had stood)\n"
        f"{figures['seconds']:.1f} s for a trial"
    )


def _split(
    done: Sequence[Numbered],
) -> tuple[list[tuple[Numbered, TrialResult]], list[tuple[Numbered, SimulationError]]]:
    """Return the trials that have a result, and those that ended with an error."""
    results = [(n, n.result) for n in done if isinstance(n.result, TrialResult)]
    errors = [(n, n.result) for n in done if isinstance(n.result, SimulationError)]
    return results, errors


# --- controls -------------------------------------------------------------------------------------


def run_controls(options: argparse.Namespace, console: Console) -> bool:
    """Run and print the controls of trials; return whether all outcomes are as known."""
    if options.everything or options.friction != DEFAULT.friction:
        raise ValueError("--trials: has its own physics; needs no --everything and no --friction")
    every = trial_controls.all_controls()
    outcomes: list[tuple[trial_controls.Control, str]] = []
    growing = Growing(options.json, write_json)
    try:
        with growing, make_progress(console) as bar:
            task = bar.add_task("controls of trials", total=len(every))
            for control in every:
                outcomes.append((control, trial_controls.outcome(control)))
                growing.update(controls_report(outcomes, len(every)))
                bar.advance(task)
    finally:
        if outcomes:
            show_controls(outcomes, console)
    return all(control.known == outcome for control, outcome in outcomes)


def controls_report(
    outcomes: Sequence[tuple[trial_controls.Control, str]], total: int
) -> dict[str, Any]:
    """Return the report of the controls that have been run so far."""
    return {
        "complete": len(outcomes) == total,
        "controls": [
            {"kind": control.kind, "name": control.name, "repeat": control.repeat,
             "trial": asdict(control.trial), "known": control.known, "outcome": outcome}
            for control, outcome in outcomes
        ],
    }  # fmt: skip


def show_controls(outcomes: Sequence[tuple[trial_controls.Control, str]], console: Console) -> None:
    """Print a row for each stack and known outcome: how many outcomes are right."""
    table = Table(title="controls of trials", box=box.SIMPLE, pad_edge=False)
    for column in ("kind", "stack", "known"):
        table.add_column(column, no_wrap=True)
    table.add_column("right", justify="right", no_wrap=True)
    rows: dict[tuple[str, str, str], list[bool]] = {}
    for control, outcome in outcomes:
        row = rows.setdefault((control.kind, control.name, control.known), [])
        row.append(outcome == control.known)
    for names, right in rows.items():
        table.add_row(*names, f"{sum(right)} of {len(right)}")
    console.print(table)
    right_ones = sum(control.known == outcome for control, outcome in outcomes)
    console.print(f"{len(outcomes)} controls, {right_ones} outcomes as known")
