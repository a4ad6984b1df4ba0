"""Play policies on item sequences and print a table of their results.

``marl-pack evaluate --policy dblf --items rs --episodes 1000`` prints a table: mean utilization
with its 95 % interval, its standard deviation, items packed, decisions a second, and the share of
episodes whose final stack is in strict static equilibrium. A linear program that shares no code
with the masks decides about equilibrium.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from marl_pack.checks import whole_number
from marl_pack.evaluation.rollout import Rollout
from marl_pack.evaluation.statistics import (
    FEWEST,
    falls,
    spread,
    strict_equilibrium,
    summary,
    together,
)
from marl_pack.files import Growing, check_writable, same_plain_file, write_json
from marl_pack.game.spec import SelectionSpec
from marl_pack.options import (
    GAME_NOTE,
    IN_MM,
    MOST_AT_ONCE,
    ONLY_CELLS,
    ONLY_MM,
    add_explain,
    add_mm_options,
    add_options,
    check_explain,
    check_names,
)
from marl_pack.physics.options import BODY_OPTIONS, add_body_options, chosen_bodies
from marl_pack.plan import Plan
from marl_pack.plan_archive import check_ending, save_plans
from marl_pack.sapien_check.bodies import Bodies
from marl_pack.sapien_check.judge import Judged, judge_all
from marl_pack.sapien_check.world import SimulationError, load_sapien
from marl_pack.terminal import PIPED_WIDTH, Parser, make_console, make_progress, make_status

if TYPE_CHECKING:
    from marl_pack.players import Setup
    from marl_pack.players_mm import SetupMm

PROGRAM = "python -m marl_pack.evaluate"
EPISODES = 1000  # default number of episodes of a generated stream
MOST_EXPLAINED = 100  # largest number of episodes with --explain: their files are large


def show(rows: dict[str, dict[str, Any]], title: str, console: Console) -> None:
    """Print the results as a table with a row for each policy.

    If the names are too long for the terminal, the table has numbers, and the names come below it.
    """
    console.print(title, soft_wrap=True)
    table = figures(rows, list(rows))
    wide = console.options.update(width=PIPED_WIDTH)
    if console.measure(table, options=wide).maximum <= console.width:
        console.print(table)
    else:
        numbers = [f"({k})" for k in range(1, len(rows) + 1)]
        console.print(figures(rows, numbers))
        for number, name in zip(numbers, rows, strict=True):
            console.print(f"{number} {name}", soft_wrap=True)
    console.print(
        f"±: 95 % interval of the mean, if there are {FEWEST} or more episodes;\n"
        "dec./s: decisions (items placed) a second;\n"
        "in equilibrium: share of final stacks in strict static equilibrium"
    )
    if any("falls" in row for row in rows.values()):
        console.print("falls: episodes in which something fell in physics")


def figures(rows: dict[str, dict[str, Any]], names: list[str]) -> Table:
    """Return the table of results.

    Args:
        rows: the figures of each policy, by its name.
        names: the text in the first column of each row.
    """
    table = Table(box=box.SIMPLE, pad_edge=False, collapse_padding=True)
    table.add_column("policy", no_wrap=True)
    physics = any("falls" in row for row in rows.values())
    columns = ["episodes", "utilization %", "std", "items", "dec./s", "in equi-\nlibrium %"]
    for column in [*columns, "falls"] if physics else columns:
        table.add_column(column, justify="right", no_wrap=True)
    for name, row in zip(names, rows.values(), strict=True):
        table.add_row(
            name,
            str(row["episodes"]),
            f"{100 * row['utilization']:.2f}{spread(row['utilization'], row['interval'])}",
            "" if row["std"] is None else f"{100 * row['std']:.2f}",
            f"{row['packed']:.2f}",
            f"{row['decisions_per_second']:,.0f}",
            f"{100 * row['strict_equilibrium']:.2f}",
            *([falls_of(row)] if physics else []),
        )
    return table


def falls_of(row: dict[str, Any]) -> str:
    """Return the number of episodes with a fall; adds "of N" if only N have been judged."""
    judged = row.get("judged_episodes", 0)
    return f"{row.get('falls', 0)}" + ("" if judged == row["episodes"] else f" of {judged}")


def parser(program: str = PROGRAM) -> Parser:
    """Return the parser of the command's options."""
    options = Parser(
        prog=program, usage=f"{program} [OPTIONS]",
        description=__doc__.split("\n\n")[0], notes=[GAME_NOTE],
        examples=(
            "--policy rs dblf --episodes 100",
            "--policy runs/NAME --items boxes.csv --bin 12 10 14 --json figures.json",
            "--policy rs --plan rollouts=16,top=8 --episodes 20",
            "--policy rs --episodes 100 --physics --save-stacks plans.csv",
            "--world mm --items boxes_mm.csv --bin-mm 1200 800 1500 --margin-mm 20",
        ),
    )  # fmt: skip
    add_options(options, SelectionSpec)
    add_mm_options(options)
    options.add_argument_group("episodes").add_argument(
        "--episodes", type=int,
        help=f"number of episodes (default: {EPISODES}; all sequences of a file)",
    )  # fmt: skip
    physics = options.add_argument_group("physics")
    add = physics.add_argument
    add("--physics", action="store_true",
        help="judge every packing in SAPIEN after each placement; adds the column falls"
        )  # fmt: skip
    add_body_options(physics)
    add("--processes", type=int, default=1,
        help="number of processes that judge at once (default: 1)")  # fmt: skip
    group = options.add_argument_group("output")
    add = group.add_argument
    add("--json", type=Path, metavar="FILE", help="write the figures to this file")
    add(
        "--save-stacks",
        type=Path,
        metavar="FILE",
        help="write the packed boxes of every episode to this file (.npz, .json or .csv)",
    )
    add_explain(group, "--save-stacks")
    return options


def check_outputs(arguments: argparse.Namespace) -> None:
    """Refuse output files that cannot be written.

    Raises:
        ValueError: if a file cannot be written; names it.
    """
    if arguments.save_stacks is not None:
        check_ending(arguments.save_stacks, "--save-stacks")
    if arguments.explain:
        check_explain(arguments.save_stacks, "--save-stacks")
    for path in (arguments.json, arguments.save_stacks):
        if path is not None:
            check_writable(path)
    both = arguments.json, arguments.save_stacks
    if None not in both and same_plain_file(*both):
        raise ValueError(f"--json, --save-stacks: {arguments.json}: need two files")


def check_options(
    arguments: argparse.Namespace, setup: Setup | SetupMm
) -> tuple[int, Bodies | None]:
    """Check the options; return the number of episodes, and the bodies with ``--physics``.

    Raises:
        ValueError: if an option is impossible; says what would be right.
    """
    if arguments.save_stacks and len(setup.policies) > 1:
        raise ValueError("--save-stacks: needs a single policy, as it stores one stack an episode")
    bodies = chosen_bodies(arguments) if arguments.physics else None
    if bodies is not None:
        load_sapien()  # fails here, before the games, if it is not installed
    elif any(getattr(arguments, key) is not None for key in BODY_OPTIONS):
        raise ValueError("--cell, --density and --com-spread go with --physics")
    whole_number(arguments.processes, "--processes", 1, MOST_AT_ONCE)
    episodes, available = arguments.episodes, setup.stream.episodes
    if episodes is None:
        episodes = available or EPISODES
    if episodes < 1 or (available and episodes > available):
        most = f" … {available}, the sequences of the file" if available else " or more"
        raise ValueError(f"--episodes {episodes}: needs 1{most}")
    if arguments.explain and getattr(setup.spec, "selects", False):
        raise ValueError("--explain: goes with games of one visible box and one bin")
    if arguments.explain and episodes > MOST_EXPLAINED:
        raise ValueError(
            f"--explain: needs at most {MOST_EXPLAINED} episodes, not {episodes}; use --episodes"
        )
    return episodes, bodies


def evaluate_policy(
    name: str,
    policy: Any,
    setup: Setup | SetupMm,
    episodes: int,
    bodies: Bodies | None,
    bar: Progress,
) -> Iterator[dict[str, Any]]:
    """Play and judge one policy; yield its row of figures each time it has grown.

    With ``--save-stacks`` the packings are saved.
    """
    arguments, console = setup.arguments, bar.console
    task = bar.add_task(f"{name}: episodes", total=episodes)
    solving = bar.add_task(f"{name}: equilibria", total=episodes)
    rollout, balanced = Rollout([], 0.0), np.empty(episodes, np.bool_)
    stacks = Growing(arguments.save_stacks, partial(save_plans, policy=name))
    row: dict[str, Any] = {}
    try:
        for part in setup.batches(policy, episodes, lambda ended: bar.advance(task, ended)):
            for e, plan in enumerate(part.plans, len(rollout.plans)):
                balanced[e] = strict_equilibrium(plan)
                bar.advance(solving)
            rollout = Rollout(rollout.plans + part.plans, rollout.seconds + part.seconds)
            stacks.update(rollout.plans)
            row = summary(rollout, balanced[: len(rollout.plans)])
            yield row
    finally:
        stacks.close()
    unplayable = int((rollout.packed == 0).sum())
    if unplayable:
        console.print(
            f"{name}: {unplayable} episodes have a first item that may be placed "
            "nowhere; they count as utilization 0",
            soft_wrap=True,
        )
    if bodies is None:
        return
    judging = bar.add_task(f"{name}: physics", total=episodes)
    judged: list[Judged] = []
    numbers = range(episodes)
    for verdict in judge_plans(bodies, rollout.plans, numbers, processes=arguments.processes):
        judged.append(verdict)
        bar.advance(judging)
        yield row | falls(judged)
    unjudged = sum(verdict.error is not None for verdict in judged)
    if unjudged:
        console.print(f"{name}: {unjudged} episodes without a verdict", soft_wrap=True)


def judge_plans(
    bodies: Bodies, plans: Sequence[Plan], episodes: Sequence[int], processes: int = 1
) -> Iterator[Judged]:
    """Judge packings in physics, bin by bin; yield one result for each episode.

    Args:
        bodies: how boxes become bodies.
        plans: the packings of all episodes.
        episodes: the episodes to judge.
        processes: number of processes that judge at once.
    """
    verdicts = judge_all(
        (
            bodies.stack(plans[e].in_bin(k), e)
            for e in episodes
            for k in range(len(plans[e].bin_sizes))
        ),
        processes=processes,
    )
    for e in episodes:
        yield together([next(verdicts) for _ in range(len(plans[e].bin_sizes))])


def check_world(arguments: argparse.Namespace) -> None:
    """Refuse options that do not go with the world, and names that do not exist.

    Raises:
        ValueError, FileNotFoundError: if an option is impossible; says what would be right.
    """
    in_mm = arguments.world == "mm"
    for name in ONLY_CELLS if in_mm else ONLY_MM:
        if getattr(arguments, name) is not None:
            flag = "--" + name.replace("_", "-")
            hint = f"; here it is --{IN_MM[name].replace('_', '-')}" if name in IN_MM else ""
            raise ValueError(f"{flag}: goes with --world {'cells' if in_mm else 'mm'}{hint}")
    if not in_mm:
        check_names(arguments)
    elif arguments.symmetric or arguments.device != "cpu" or arguments.threads != 1:
        raise ValueError("--world mm: --symmetric, --device and --threads go with --world cells")


def choose_setup(arguments: argparse.Namespace, console: Console) -> Setup | SetupMm:
    """Return the policies and the game that the options name.

    Raises:
        ValueError, FileNotFoundError: if an option is impossible; says what would be right.
    """
    with make_status(console, "loading the players"):
        if arguments.world == "mm":
            from marl_pack.players_mm import choose_mm

            return choose_mm(arguments, console)
        from marl_pack.players import choose, set_threads  # slow to import

        set_threads(arguments.threads)
        return choose(arguments, console)


def run(arguments: argparse.Namespace, console: Console) -> dict[str, dict[str, Any]]:
    """Play the policies that the options choose; return a row of figures for each.

    The figures are written while they grow. At the end they are shown, also if the program is
    stopped early.

    Raises:
        ValueError, FileNotFoundError: if an option is impossible; says what would be right.
    """
    check_world(arguments)
    check_outputs(arguments)
    setup = choose_setup(arguments, console)
    episodes, bodies = check_options(arguments, setup)
    bar = make_progress(console)
    title = str(setup)
    if bodies is not None and str(bodies):
        title += f"; {bodies}"
    rows: dict[str, dict[str, Any]] = {}
    report = {
        "settings": setup.settings | {"episodes": episodes}, "complete": False, "policies": rows
    }  # fmt: skip
    growing = Growing(arguments.json, write_json)
    try:
        with growing, bar:
            for name, policy in setup.policies.items():
                for row in evaluate_policy(name, policy, setup, episodes, bodies, bar):
                    rows[name] = row
                    growing.update(report)
            report["complete"] = True
            growing.update(report)
    finally:
        if rows:
            show(rows, title, console)
    return rows


def main(arguments: Sequence[str] | None = None, program: str = PROGRAM) -> int:
    """Run the command ``marl-pack evaluate``; return its exit status."""
    options = parser(program)
    chosen = options.parse_args(arguments)
    try:
        run(chosen, make_console())
    except SimulationError as error:  # a process of the judge has died
        options.exit(1, f"{options.prog}: {error}")
    except KeyboardInterrupt:
        options.exit(130, f"{options.prog}: interrupted")
    except (ValueError, OSError, ModuleNotFoundError) as error:
        options.exit(2, f"{options.prog}: {error}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
