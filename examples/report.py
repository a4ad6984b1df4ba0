"""Print the compliance reports of several trainers as one table.

``python examples/report.py FOLDER`` reads the files that the examples wrote with ``--json``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from session import passes, percent


def draw(reports: Iterable[dict[str, Any]]) -> Table:
    """Return a table of reports with a row for each trainer."""
    table = Table(box=box.SIMPLE)
    table.add_column("trainer", no_wrap=True)
    for title in (
        "version", "bin", "items", "minutes", "illegal\nactions", "items\nrepeat",
        "all agents\nupdated", "rewards\ncorrect", "utilization\nbefore", "utilization\nafter",
    ):  # fmt: skip
        table.add_column(title, justify="right", no_wrap=True)
    for report in reports:
        table.add_row(
            report["trainer"],
            report["version"],
            " × ".join(map(str, report["bin"])),
            f"{report['items']:,}",
            f"{report['minutes']:.1f}",
            f"{report['illegal']:,}",
            "YES" if report["repeats"] else "no",
            "yes" if all(report["updated"].values()) else "NO",
            "yes" if all(report["rewards_right"].values()) else "NO",
            percent(report["before"]),
            percent(report["after"]),
        )
    return table


def main() -> int:
    """Print the table; return 1 if a trainer does not pass or there is no report, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of the reports")
    files = sorted(parser.parse_args().folder.glob("*.json"))
    if not files:
        parser.error("the folder has no report; examples write one with --json FILE")
    reports = [json.loads(file.read_text()) for file in files]
    Console(width=None if sys.stdout.isatty() else 140).print(draw(reports))
    return 0 if all(map(passes, reports)) else 1


if __name__ == "__main__":
    sys.exit(main())
