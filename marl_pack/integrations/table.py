"""The accounts of several trainers as one table.

``python -m marl_pack.integrations.table FOLDER`` reads the files that examples wrote with
``--json``.
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

from marl_pack.integrations.session import fits, percent


def draw(accounts: Iterable[dict[str, Any]]) -> Table:
    """A row a trainer."""
    table = Table(box=box.SIMPLE)
    table.add_column("trainer", no_wrap=True)
    for title in (
        "version", "bin", "items", "minutes", "illegal\nactions", "items\nrepeat",
        "both agents\nupdated", "rewards\nright", "utilization\nbefore", "utilization\nafter",
    ):  # fmt: skip
        table.add_column(title, justify="right", no_wrap=True)
    for found in accounts:
        table.add_row(
            found["trainer"],
            found["version"],
            " × ".join(map(str, found["bin"])),
            f"{found['items']:,}",
            f"{found['minutes']:.1f}",
            f"{found['illegal']:,}",
            "YES" if found["repeats"] else "no",
            "yes" if all(found["updated"].values()) else "NO",
            "yes" if all(found["rewards_right"].values()) else "NO",
            percent(found["before"]),
            percent(found["after"]),
        )
    return table


def main() -> int:
    """Print the table; the exit status is 1 if a trainer does not fit, or there is none."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="of the accounts")
    files = sorted(parser.parse_args().folder.glob("*.json"))
    if not files:
        parser.error("no account there; examples write one with --json FILE")
    accounts = [json.loads(file.read_text()) for file in files]
    Console(width=None if sys.stdout.isatty() else 140).print(draw(accounts))
    return 0 if all(map(fits, accounts)) else 1


if __name__ == "__main__":
    sys.exit(main())
