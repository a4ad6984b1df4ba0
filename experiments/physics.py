"""Measure the judge and the rules in physics: ``python -m experiments.physics``.

There are two tables: ``controls`` has stacks whose outcome follows from statics; ``table1`` is the
paper's Table 1. Each row of ``table1`` is one command ``judge table1``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.record import record
from experiments.rows import Rows, main_of
from marl_pack.stability import RULES

TABLE1 = [
    *(f"--rules {rule} --objects 3000 --seed 0" for rule in RULES if rule != "none"),
    "--rules hull_alpha --objects 3000 --seed 1",
]
CONTROLS = "controls"


def measured(options: list[str]) -> dict[str, Any]:
    """Run the command ``judge`` and return its report.

    Raises:
        ValueError: if the command failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "report.json")
        words = [sys.executable, "-m", "marl_pack.sapien_check", *options, "--json", str(path)]
        status = subprocess.run(words).returncode
        if status in (130, -2, -15):
            raise KeyboardInterrupt
        if status:
            raise ValueError(f"sapien_check {' '.join(options)}: ended with status {status}")
        report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return report


def main() -> int:
    """Measure the missing rows of the chosen tables; return the exit status."""
    rows = Rows("python -m experiments.physics", __doc__)
    rows.options.add_argument("tables", nargs="*", default=[CONTROLS, "table1"])
    rows.options.add_argument("--processes", type=int, default=1,
                              help="number of processes that judge at once")  # fmt: skip
    chosen = rows.parse()
    results = rows.results(CONTROLS)
    for key in rows.missing(results, [CONTROLS] * (CONTROLS in chosen.tables)):
        report = measured([CONTROLS])
        figures = {name: report[name] for name in ("controls", "flips_at_mm")}
        results.put(key, figures, record("python -m marl_pack.sapien_check controls"))
    results = rows.results("table1")
    for key in rows.missing(results, TABLE1 if "table1" in chosen.tables else []):
        words = key.split()
        report = measured(["table1", *words, "--processes", str(chosen.processes)])
        [figures] = report["rules"].values()
        command = f"python -m marl_pack.sapien_check table1 {key}"
        results.put(key, figures, record(command, [int(words[-1])]))
    return 0


if __name__ == "__main__":
    sys.exit(main_of(main))
