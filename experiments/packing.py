"""Measure how well policies pack: ``python -m experiments.packing``.

There are five tables: ``packing`` has policies on four sets of items; ``two_orientations`` has
policies that may only rotate items about the vertical; ``other_rules`` has heuristics under every
stability rule; ``bodies`` shows what falls in physics if a rule's assumptions do not hold;
``selection`` has games with a buffer, a preview and several bins. Each row is one command
``evaluate``. With ``--physics`` the packings are judged too, which takes most of the time; the
packings of ``bodies`` are always judged.
"""

from __future__ import annotations

import re
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from benchmarks.record import ROOT, Results, record
from experiments.rows import Rows, expanded, main_of
from marl_pack import evaluate
from marl_pack.evaluation.rollout import play
from marl_pack.evaluation.statistics import falls, strict_equilibrium, summary
from marl_pack.plan import Plan
from marl_pack.plan_archive import load_plans, save_plans
from marl_pack.players import Setup, choose, set_threads
from marl_pack.stability import RULES
from marl_pack.terminal import make_console, make_progress

SETS = {
    "RS": "--items $MARL_PACK_DATA/rs.npz",
    "CUT-1": "--items $MARL_PACK_DATA/cut_1.npz",
    "CUT-2": "--items cut2 --episodes 2100 --seed 0",
    "125 types": "--items rs --sides 1 5 --episodes 2100 --seed 0",
}
MODELS = {
    "RS": ("rs", "rs --symmetric", "plain"),
    "CUT-1": ("rs", "cut_1", "plain"),
    "CUT-2": ("rs", "cut_2", "plain"),
    "125 types": ("rs", "types125"),
}
UPRIGHT_SETS = {name: f"{SETS[name]} --orientations 0 1" for name in ("RS", "125 types")}
UPRIGHT_PLAN = "--plan rollouts=16,top=4,depth=2"
UPRIGHT = {
    "RS": ("rs_upright", f"rs_upright {UPRIGHT_PLAN}", "rs"),
    "125 types": ("types125_upright", f"types125_upright {UPRIGHT_PLAN}", "types125"),
}
HEURISTICS = ("max_feasible", "dblf", "height_min", "best_fit", "random")
TABLES = {
    "packing": [
        f"--policy {policy} {items}"
        for name, items in SETS.items()
        for policy in (*MODELS[name], *HEURISTICS)
    ],
    "two_orientations": [
        f"--policy {policy} {UPRIGHT_SETS[name]}"
        for name, policies in UPRIGHT.items()
        for policy in (*policies, *HEURISTICS)
    ],
    "other_rules": [
        f"--policy {policy} {SETS['RS']} --rule {rule}"
        for rule in RULES
        if rule != "none"
        for policy in ("dblf", "random")
    ],
    "bodies": [
        f"--policy dblf --items rs --episodes {episodes} --seed 1{options}"
        for episodes, options in (
            (1000, ""),
            (1000, " --rule none"),
            (300, " --density 100 1000 --com-spread 0.2"),
            (1000, " --density 100 1000 --com-spread 0.2 --margin 0.99"),
            (1000, " --density 100 1000 --com-spread 0.2 --margin 1.42"),
        )
    ],
}
TYPES = "--items rs --sides 1 5 --seed 0"
BEAM = "--plan width=8,depth=4"
NARROW = "--plan width=4,depth=2"
SELECTION = {
    "buffer": [
        *(f"--policy rs {SETS['RS']} --buffer {k} --episodes 2100" for k in (2, 3, 5, 10)),
        *(f"--policy rs {SETS['RS']} --buffer {k} --episodes {n} {BEAM}"
          for k, n in ((2, 500), (3, 500), (5, 2100), (10, 100))),
        *(f"--policy types125 {TYPES} --buffer {k} --episodes {n}"
          for k, n in ((2, 2100), (3, 2100), (5, 2100), (10, 500))),
        f"--policy rs {SETS['RS']} --buffer 10 --episodes 2100 {NARROW}",
        f"--policy types125 {TYPES} --buffer 5 --episodes 2100 {NARROW}",
        f"--policy types125 {TYPES} --buffer 10 --episodes 2100 --plan width=2,depth=2",
        *(f"--policy types125 {TYPES} --buffer {k} --episodes {n} {BEAM}"
          for k, n in ((2, 500), (5, 100), (10, 100))),
        *(f"--policy {name} {SETS['RS']} --buffer 5" for name in ("dblf", "random")),
    ],
    "preview": [
        f"--policy rs {SETS['RS']} --episodes 2100 --preview 1",  # greedy value does not look at it
        *(f"--policy rs {SETS['RS']} --episodes {n} --preview {p} --plan width={width}"
          for p, width, n in (
            (1, 32, 500), (2, 32, 500), (3, 32, 500), (5, 8, 500), (5, 32, 2100), (10, 32, 100))),
    ],
    "bins": [
        f"--policy {policy} --items rs --episodes 100 --seed 0 --bins {b} --closings {20 * b}"
        for policy in ("rs", "dblf") for b in (1, 2, 3, 4)
    ],
    "trained": [
        *(f"--policy rs_buffer5 {SETS['RS']} --buffer {k} --episodes 2100" for k in (3, 5, 10)),
        *(f"--policy rs_bins2 --items rs --episodes 100 --seed 0 --bins {b} --closings {20 * b}"
          for b in (2, 3)),
    ],
    "budget": [
        f"--policy rs {SETS['RS']} --episodes {n} {options}"
        for options, n in (
            ("--plan budget=10ms", 200), ("--plan budget=30ms", 200), ("--plan budget=100ms", 200),
            ("--plan draws=16", 100),
            ("--preview 1 --plan budget=100ms", 50), ("--buffer 3 --plan budget=100ms", 50),
        )
    ],
}  # fmt: skip
"""Rows of the table ``selection`` by the option that they show."""
TABLES["selection"] = [row for rows in SELECTION.values() for row in rows]
PLANS_FOLDER = ROOT / "runs" / "packing"
"""The folder of the plans that are still to be judged."""
PART = 50
"""Number of packings that are judged before the figures are written again."""


def measure(
    results: Results, key: str, physics: bool, processes: int = 1, plans_folder: Path = PLANS_FOLDER
) -> None:
    """Play the policy of a row and judge its packings, unless that is done.

    Args:
        results: the table.
        key: the row's options of the command ``evaluate``, without ``--physics``.
        physics: whether to judge the packings.
        processes: number of processes that judge at once.
        plans_folder: folder of the plans that are still to be judged.
    """
    console = make_console()
    options = expanded(key) + ["--physics", "--processes", str(processes)] * physics
    arguments = evaluate.parser().parse_args(options)
    set_threads(arguments.threads)
    setup = choose(arguments, console)
    episodes, bodies = evaluate.check_options(arguments, setup)
    command = f"python -m marl_pack.evaluate {key}" + " --physics" * physics
    row = results.rows().get(key)
    plans_folder.mkdir(parents=True, exist_ok=True)
    plans_file = plans_folder / f"{re.sub(r'[^A-Za-z0-9.]+', '_', key).strip('_')}.npz"
    with make_progress(console) as bar:
        plans: list[Plan] | None = None
        if row is None or (physics and not plans_file.is_file() and not judged(row)):
            figures, plans = packed(setup, episodes, bar)
            row = {**figures, **(row or {})}
            save_plans(plans_file, plans)
            results.put(key, row, record(command, [arguments.seed], arguments.threads))
        if bodies is None or judged(row):
            return
        plans = plans or load_plans(plans_file)
        task = bar.add_task("judged", total=episodes, completed=row.get("judged_episodes", 0))
        for first in range(row.get("judged_episodes", 0), episodes, PART):
            part = range(first, min(first + PART, episodes))
            verdicts = falls(list(evaluate.judge_plans(bodies, plans, part, processes)))
            row = joined(row, verdicts)
            results.put(key, row, record(command, [arguments.seed], arguments.threads))
            bar.advance(task, len(part))
    plans_file.unlink()


def packed(setup: Setup, episodes: int, bar: Progress) -> tuple[dict[str, Any], list[Plan]]:
    """Return the figures of a policy's packings, and the packings."""
    [(name, policy)] = setup.policies.items()
    task = bar.add_task(f"{name}: episodes", total=episodes)
    start = time.process_time()
    rollout = play(policy, setup.game, episodes, lambda ended: bar.advance(task, ended))
    seconds = time.process_time() - start
    solving = bar.add_task("equilibria", total=episodes)
    balanced = np.empty(episodes, np.bool_)
    for e, plan in enumerate(rollout.plans):
        balanced[e] = strict_equilibrium(plan)
        bar.advance(solving)
    figures = summary(rollout, balanced)
    figures["cpu_seconds"] = seconds  # for the game and the policy, including loading code
    del figures["decisions_per_second"]  # wall time, which other work on the machine changes
    return figures, rollout.plans


def judged(row: dict[str, Any]) -> bool:
    """Return whether all packings of a row have been judged."""
    return bool(row.get("judged_episodes") == row["episodes"])


def joined(row: dict[str, Any], verdicts: dict[str, Any]) -> dict[str, Any]:
    """Return a row to which the verdicts on more of its packings are added."""
    counts = ("falls", "no_verdict", "judged_episodes", "judged")
    sums = {name: row.get(name, 0) + verdicts[name] for name in counts}
    seconds = sum(r.get("judged", 0) * r.get("judge_seconds", 0) for r in (row, verdicts))
    return row | sums | {"judge_seconds": seconds / max(sums["judged"], 1)}


def main() -> int:
    """Measure the missing rows of the chosen tables; return the exit status."""
    rows = Rows("python -m experiments.packing", __doc__)
    add = rows.options.add_argument
    add("--tables", nargs="+", choices=TABLES, default=list(TABLES),
        help="tables to measure (default: all)")  # fmt: skip
    add("--physics", action="store_true", help="judge the packings of every table")
    add("--processes", type=int, default=1,
        help="number of processes that judge at once (default: 1)")  # fmt: skip
    chosen = rows.parse()
    for table in chosen.tables:
        results, physics = rows.results(table), chosen.physics or table == "bodies"

        def done(row: dict[str, Any], physics: bool = physics) -> bool:
            return judged(row) or not physics

        for key in rows.missing(results, TABLES[table], done):
            measure(results, key, physics, chosen.processes)
    return 0


if __name__ == "__main__":
    sys.exit(main_of(main))
