"""Judge stacks in physics: the command ``marl-pack judge``.

- ``table1``: measure the paper's Table 1, for objects placed at random under a stability rule;
- ``controls``: judge stacks with a known verdict, and find the margins at which the judge's verdict
  flips;
- ``stack FILE``: judge packings saved by ``marl-pack evaluate --save-stacks``, or draw one of them;
- ``trial FILE``: build such packings with the errors of a robot, tilt them and shake them.

``python -m marl_pack.sapien_check`` is the same command.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from marl_pack.checks import LARGEST_SEED, whole_number
from marl_pack.files import Growing, check_writable, write_json
from marl_pack.options import MOST_AT_ONCE
from marl_pack.physics import controls, table1, trials
from marl_pack.physics.options import (
    add_file_options,
    chosen_bodies,
    chosen_episodes,
    load_stacks,
)
from marl_pack.plan_archive import save_plans
from marl_pack.sapien_check.bodies import Bodies
from marl_pack.sapien_check.judge import Judged, Verdict, judge_all
from marl_pack.sapien_check.stack import Stack
from marl_pack.sapien_check.world import DEFAULT, Physics, SimulationError
from marl_pack.stability import RULES
from marl_pack.terminal import Parser, complain, make_console, make_progress

PROGRAM = "python -m marl_pack.sapien_check"

# --- table1 ---------------------------------------------------------------------------------------


def run_table1(options: argparse.Namespace, console: Console) -> None:
    """Place objects under each rule, judge the stacks, and print the paper's Table 1."""
    if options.objects < 1:
        raise ValueError(f"--objects {options.objects}: needs 1 or more")
    rows: dict[str, dict[str, Any]] = {}
    rules = list(dict.fromkeys(options.rules))
    if options.save_falls is not None:
        for rule in rules:
            check_writable(falls_file(options.save_falls, rule))
    report = {
        "objects": options.objects, "seed": options.seed, "physics": asdict(options.physics),
        "complete": False, "rules": rows, "paper": table1.PAPER,
    }  # fmt: skip
    growing = Growing(options.json, write_json)
    try:
        with growing, make_progress(console) as bar:
            for rule in rules:
                for row in judged_rule(rule, options, bar):
                    rows[rule] = row
                    growing.update(report)
            report["complete"] = True
            growing.update(report)
    finally:
        if rows:
            title = f"Table 1, {options.objects:,} objects per rule, seed {options.seed}"
            show_table1(rows, console, title)


def judged_rule(rule: str, options: argparse.Namespace, bar: Progress) -> Iterator[dict[str, Any]]:
    """Fill bins under one rule and judge them; yield the rule's row of the table after each bin.

    With ``--save-falls``, also save the bins in which something fell.
    """
    task = bar.add_task(f"{rule}: objects", total=options.objects)
    path = options.save_falls and falls_file(options.save_falls, rule)
    falls = Growing(path, save_plans)
    settings = table1.Settings(rule, options.seed, options.physics)
    trials: list[table1.Trial] = []
    try:
        for trial in table1.run(settings, options.objects, options.processes):
            trials.append(trial)
            bar.advance(task, len(trial.plan))
            if table1.fallen([trial]):
                falls.update(table1.fallen(trials))
            yield table1.summary(trials)
    finally:
        falls.close()
        if path and table1.fallen(trials):
            bar.console.print(f"{path}: the bins in which something fell", soft_wrap=True)


def falls_file(path: Path, rule: str) -> Path:
    """Return the path of the file for the bins in which something fell under one rule."""
    return path.with_name(f"{path.name.removesuffix('.npz')}_{rule}.npz")


def show_table1(rows: dict[str, dict[str, Any]], console: Console, title: str) -> None:
    """Print the measured row of each rule, and the row that the paper reports."""
    table = Table(title=title, box=box.SIMPLE, padding=0)
    table.add_column("rule", no_wrap=True)
    for column in ("objects", "falls", "unst.", "stood", "masks s", "s each", "judge"):
        table.add_column(column, justify="right", no_wrap=True)

    def falls(r: dict[str, Any]) -> str:
        return f"{r['falls']} ({100 * r['rate']:.2f} %)"

    for rule, r in rows.items():
        table.add_row(
            rule, str(r["objects"]), falls(r), str(r["falls_unstable"]),
            str(r["unstable_standing"]), f"{r['mask_total']:.1f}", f"{r['mask_each']:.5f}",
            f"{r['judge_each']:.3f}",
        )  # fmt: skip
    for rule in rows:
        if rule in table1.PAPER:
            r = table1.PAPER[rule]
            table.add_row(
                f"{rule}, paper", str(r["objects"]), falls(r), "", "", str(r["total"]), r["each"]
            )
    console.print(table)
    console.print(
        "unst.: falls of stacks that the exact equilibrium calls unstable; stood: stacks that\n"
        "it calls unstable and that did not fall; masks s, s each: CPU time in seconds for\n"
        "all masks and for one mask; judge: CPU time in seconds for one verdict.\n"
        "Rows of the paper: the figures that it reports."
    )


# --- controls -------------------------------------------------------------------------------------


def run_controls(options: argparse.Namespace, console: Console) -> bool:
    """Judge and print the controls; return whether all verdicts of the judge are correct."""
    cases = controls.cases()
    outcomes: list[controls.Outcome] = []
    flips: dict[str, float] = {}
    growing = Growing(options.json, write_json)
    try:
        with growing, make_progress(console) as bar:
            task = bar.add_task("controls", total=len(cases))
            for name, margin, plan in cases:
                outcomes.append(controls.outcome(name, margin, plan, options.physics))
                growing.update(controls_report(outcomes, flips, options))
                bar.advance(task)
            task = bar.add_task("margins", total=len(controls.FAMILIES))
            for name, make in controls.FAMILIES.items():
                flips[name] = controls.flips_at(make, options.physics)
                growing.update(controls_report(outcomes, flips, options))
                bar.advance(task)
    finally:
        if outcomes:
            show_controls(outcomes, flips, console)
    return all(o.judge == o.known for o in outcomes)


def controls_report(
    outcomes: list[controls.Outcome], flips: dict[str, float], options: argparse.Namespace
) -> dict[str, Any]:
    """Return the report of the controls that have been judged so far."""
    return {
        "complete": len(flips) == len(controls.FAMILIES),
        "controls": [asdict(o) for o in outcomes],
        "flips_at_mm": {name: None if math.isnan(at) else at for name, at in flips.items()},
        "physics": asdict(options.physics),
    }


def show_controls(
    outcomes: list[controls.Outcome], flips: dict[str, float], console: Console
) -> None:
    """Print a row for each stack, with its verdicts at all margins.

    Args:
        outcomes: the outcomes of the controls that have been judged.
        flips: name of a family -> margin in millimetres at which the verdict flips.
        console: the console to print to.
    """
    correct = {of: sum(getattr(o, of) == o.known for o in outcomes)
             for of in ("judge", "equilibrium", "everything")}  # fmt: skip
    table = Table(title="controls: + stands, - falls", box=box.SIMPLE, pad_edge=False)
    table.add_column("stack", no_wrap=True)
    for column in ("known", "judge", "exact", "collide", "flips, mm"):
        table.add_column(column, justify="right", no_wrap=True)
    for name in dict.fromkeys(o.name for o in outcomes):
        stacks = [o for o in outcomes if o.name == name]
        signs = [
            "".join("+" if getattr(o, of) else "-" for o in stacks)
            for of in ("known", "judge", "equilibrium", "everything")
        ]
        at = flips.get(name)
        flip = "" if at is None else "beyond 8" if math.isnan(at) else f"{at:+.3f}"
        table.add_row(name, *signs, flip)
    console.print(table)
    margins = ", ".join(f"{m:+g}" for m in controls.MARGINS)
    console.print(
        f"{len(outcomes)} controls, {margins} mm between the deciding centre of mass and the\n"
        "edge of its support (negative: outside);\n"
        f"correct verdicts: judge {correct['judge']}; exact equilibrium {correct['equilibrium']}; "
        f"judge if all boxes and walls collide {correct['everything']}\n"
        "flips: how far the centre of mass lies inside its support when the judge's verdict changes"
    )


# --- stack ----------------------------------------------------------------------------------------


def run_stack(options: argparse.Namespace, console: Console) -> None:
    """Draw one saved packing (``--render``), judge packings, and print and write the verdicts."""
    plans = load_stacks(options.file)
    bodies = chosen_bodies(options)
    chosen = chosen_episodes(options, plans)
    if options.render is not None:
        if len(chosen) != 1:
            raise ValueError("--render: needs one stack; choose it with --episodes K")
        title = f"{options.file.stem}, episode {chosen[0]}"
        draw(bodies.stack(plans[chosen[0]], chosen[0]), title, options, console)
    judged: dict[int, Judged] = {}
    growing = Growing(options.json, write_json)
    try:
        with growing, make_progress(console) as bar:
            task = bar.add_task("episodes", total=len(chosen))
            stacks = bodies.stacks(plans, chosen)
            verdicts = judge_all(stacks, options.physics, options.processes)
            for e, verdict in zip(chosen, verdicts, strict=True):
                judged[e] = verdict
                growing.update(stack_report(judged, chosen, bodies, options))
                bar.advance(task)
    finally:
        if judged:
            show_judged(judged, console)


def stack_report(
    judged: dict[int, Judged], chosen: Sequence[int], bodies: Bodies, options: argparse.Namespace
) -> dict[str, Any]:
    """Return the report of the chosen packings that have been judged so far."""
    return {
        "file": str(options.file), "complete": len(judged) == len(chosen),
        "packings": len(judged), "placements": sum(j.placements for j in judged.values()),
        "bodies": asdict(bodies), "physics": asdict(options.physics),
        "falls": [
            {"episode": e, "boxes": len(j.fall.distance), "moved": j.fall.moved,
             "metres": j.fall.distance.tolist(), "degrees": j.fall.angle.tolist()}
            for e, j in judged.items() if j.fall is not None
        ],
        "errors": {e: j.error for e, j in judged.items() if j.error is not None},
    }  # fmt: skip


def show_judged(judged: dict[int, Judged], console: Console) -> None:
    """Print the first falls and errors, and the numbers of all.

    Args:
        judged: number of an episode -> its result.
        console: the console to print to.
    """
    falls = {e: j.fall for e, j in judged.items() if j.fall is not None}
    for e, fall in list(falls.items())[:20]:
        console.print(f"episode {e}: {in_words(fall)}", soft_wrap=True)
    if len(falls) > 20:
        console.print(f"… and {len(falls) - 20} more (--json writes all)")
    errors = {e: j.error for e, j in judged.items() if j.error is not None}
    for e, error in list(errors.items())[:20]:
        console.print(f"episode {e}: no verdict: {error}", soft_wrap=True)
    placements = sum(j.placements for j in judged.values())
    seconds = sum(j.seconds for j in judged.values())
    console.print(
        f"{len(judged):,} packings, {placements:,} placements judged, {len(falls)} fell, "
        f"{len(errors)} without a verdict; "
        f"{seconds / max(placements, 1):.3f} s per placement",
        soft_wrap=True,
    )


def in_words(fall: Verdict) -> str:
    """Describe a fall: the box placed last, and the box that rotated most."""
    box_index = max(fall.moved, key=lambda i: fall.angle[i])
    others = f" and {len(fall.moved) - 1} more" if len(fall.moved) > 1 else ""
    return (
        f"placing box {len(fall.distance) - 1} moved box {box_index} by "
        f"{1000 * fall.distance[box_index]:.1f} mm and {fall.angle[box_index]:.1f}°{others}"
    )


def draw(stack: Stack, title: str, options: argparse.Namespace, console: Console) -> None:
    """Write the picture or film of one stack."""
    from marl_pack.physics import film  # only this needs a renderer

    with make_progress(console) as bar:
        task = bar.add_task("film: boxes", total=len(stack))
        frame = film.render(
            stack, options.render, title, options.physics,
            lambda boxes: bar.update(task, completed=boxes),
        )  # fmt: skip
    moved = ", ".join(map(str, frame.moved))
    state = f"moved boxes: {moved}" if frame.moved else "no box moved"
    console.print(
        f"{options.render}: {state} (in the film all boxes and walls collide)", soft_wrap=True
    )


# --- the command ----------------------------------------------------------------------------------


def parser(program: str = PROGRAM) -> Parser:
    """Return the parser of the command's options."""
    options = Parser(
        prog=program,
        description="Judge stacks in physics (SAPIEN, on the CPU).",
        examples=(
            "stack plans.npz",
            "stack plans.npz --episodes 3 --render film.mp4",
            "trial plans.npz --place-error 5 1 --drop 5",
            "controls",
            "table1 --objects 3000 --processes 2",
        ),
    )
    commands = options.add_subparsers(dest="command", required=True)
    common = Parser(add_help=False)
    add = common.add_argument_group("physics").add_argument
    add("--friction", type=float, default=DEFAULT.friction,
        help=f"friction between all faces (default: {DEFAULT.friction})")  # fmt: skip
    add = common.add_argument_group("output").add_argument
    add("--json", type=Path, metavar="FILE", help="write the results to this file")
    colliding = Parser(add_help=False)
    colliding.add_argument_group("collisions").add_argument(
        "--everything", action="store_true",
        help="let all boxes and the walls collide, as in a real bin; then neighbours may prop up "
             "boxes that would fall",
    )  # fmt: skip
    parallel = Parser(add_help=False)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    hint = f"processes that work at once (default: 1; this computer has {cores} cores)"
    parallel.add_argument_group("computation").add_argument(
        "--processes", type=int, default=1, help=hint
    )

    table = commands.add_parser(
        "table1", parents=[common, colliding, parallel], help="the paper's Table 1",
        description=table1.__doc__,
        examples=("--objects 300", "--rules hull_1 hull_alpha lbcp --json table1.json"),
    )  # fmt: skip
    add = table.add_argument_group("objects").add_argument
    add("--rules", nargs="+", choices=list(RULES), default=["hull_1", "hull_alpha"],
        help="stability rules (default: the paper's two)")  # fmt: skip
    add("--objects", type=int, default=3000,
        help="number of objects placed under each rule (default: 3000)")  # fmt: skip
    add("--seed", type=int, default=0, help="seed of objects and cells (default: 0)")
    add("--save-falls", type=Path, metavar="FILE",
        help="save the bins in which something fell as FILE_RULE.npz; judge stack reads "
             "these files")  # fmt: skip

    known = commands.add_parser(
        "controls", parents=[common, colliding], help="stacks with a known verdict",
        description=controls.__doc__, examples=("--json controls.json", "--trials"),
    )  # fmt: skip
    known.add_argument_group("choice").add_argument(
        "--trials", action="store_true", help="run the controls of trials instead"
    )

    stack = commands.add_parser(
        "stack", parents=[common, colliding, parallel],
        help="packings saved by evaluate --save-stacks",
        description="Judge saved packings after each of their placements.",
        examples=("plans.npz --processes 2", "plans.csv --episodes 3 --render film.mp4"),
    )  # fmt: skip
    add_file_options(stack)
    add = stack.add_argument_group("random numbers").add_argument
    add("--seed", type=int, default=0,
        help="seed of random densities and centres of mass (default: 0)")  # fmt: skip
    add = stack.add_argument_group("film").add_argument
    add("--render", type=Path, metavar="FILE",
        help="draw the stack being built, as a film (.mp4, .gif), or its end (.png)")  # fmt: skip

    trial = commands.add_parser(
        "trial", parents=[common, parallel],
        help="packings in a real cell: errors of sizes and places, a tilt, a shake",
        description=trials.__doc__,
        examples=(
            "plans.npz --place-error 5 1 --drop 5",
            "plans.npz --tilt 5 --shake 0.3 2 --repeats 10 --json trials.json",
        ),
    )  # fmt: skip
    trials.add_options(trial)
    return options


def main(arguments: Sequence[str] | None = None, program: str = PROGRAM) -> int:
    """Run the command ``marl-pack judge``; return its exit status."""
    options = parser(program).parse_args(arguments)
    console = make_console()
    try:
        for name, low, high in (("processes", 1, MOST_AT_ONCE), ("seed", 0, LARGEST_SEED)):
            whole_number(getattr(options, name, low), f"--{name}", low, high)
        if options.json is not None:
            check_writable(options.json)
        options.physics = replace(
            Physics(), friction=options.friction, everything=getattr(options, "everything", False)
        )
        if options.command == "table1":
            run_table1(options, console)
        elif options.command == "trial":
            trials.run(options, console)
        elif options.command == "controls" and options.trials:
            return 0 if trials.run_controls(options, console) else 1
        elif options.command == "controls":
            return 0 if run_controls(options, console) else 1
        else:
            run_stack(options, console)
    except SimulationError as error:
        complain(program, f"no verdict: {error}")
        return 1
    except KeyboardInterrupt:
        complain(program, "interrupted")
        return 130
    except (ValueError, OSError, ModuleNotFoundError) as error:
        complain(program, error)
        return 2
    return 0
