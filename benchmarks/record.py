"""Keep measured figures in ``results/*.json``, each with what made it.

A file is a table. Each of its rows has figures and a record: the command, commit, CPU, threads,
seeds, packages and date. What is measured again replaces its row alone, so a table may be made in
parts, by several processes and on several machines.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from filelock import FileLock

from marl_pack.files import write_json

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "results"
PACKAGES = ("torch", "rsl-rl-lib", "numpy", "numba", "scipy", "sapien", "opencv-python-headless")
MEASURED = ("marl_pack", "models/*.pt", "configs")
"""What figures depend on, beside the commands themselves."""
PROGRAMS = {
    "packing": "experiments.packing --tables packing",
    "other_rules": "experiments.packing --tables other_rules",
    "bodies": "experiments.packing --tables bodies",
    **{name: f"experiments.{name}" for name in (
        "ablations", "learning_curve", "planning", "afterstates", "volume_spread")},
    **{name: f"experiments.physics {name}" for name in ("controls", "table1")},
    **{name: f"benchmarks.{name}" for name in ("masks", "rules", "room", "game", "training")},
}  # fmt: skip
"""The program that makes each table."""


@dataclass(frozen=True)
class Results:
    """A table of results in a JSON file.

    Args:
        name: of the file, without its ending.
        folder: of the file.
    """

    name: str
    folder: Path = RESULTS

    @property
    def path(self) -> Path:
        """The path of the file."""
        return self.folder / f"{self.name}.json"

    def rows(self) -> dict[str, dict[str, Any]]:
        """Return the rows that have been measured, by their keys; each has ``record`` too."""
        if not self.path.is_file():
            return {}
        rows: dict[str, dict[str, Any]] = json.loads(self.path.read_text(encoding="utf-8"))
        return rows

    def row(self, key: str) -> dict[str, Any]:
        """Return one row.

        Raises:
            ValueError: if it has not been measured; names the command that does.
        """
        rows = self.rows()
        if key not in rows:
            raise ValueError(f"{self.path}: has no row {key!r}; {made_by(self.name)} measures it")
        return rows[key]

    def put(self, key: str, figures: Mapping[str, Any], record: Mapping[str, Any]) -> None:
        """Write one row and keep the others, also those that another process has just written."""
        with self._locked():
            rows = self.rows() | {key: {**figures, "record": dict(record)}}
            write_json(self.path, dict(sorted(rows.items())))

    def remove(self, key: str) -> None:
        """Forget one row."""
        with self._locked():
            write_json(self.path, {k: row for k, row in self.rows().items() if k != key})

    def _locked(self) -> FileLock:
        self.folder.mkdir(exist_ok=True)
        return FileLock(self.folder / f".{self.name}.lock")


class Measurements:
    """What one program of ``benchmarks/`` measures: each row is printed and kept.

    Args:
        name: of the program and of its table.
        description: the program's docstring.
        seed: of all that is random in it.
    """

    def __init__(self, name: str, description: str, seed: int) -> None:
        self.options = argparse.ArgumentParser(
            prog=f"python -m benchmarks.{name}", description=description,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )  # fmt: skip
        self.options.add_argument("--results", type=Path, default=RESULTS, metavar="FOLDER",
                                  help="of the table (default: results)")  # fmt: skip
        self.name, self.seed = name, seed

    def parse(self) -> argparse.Namespace:
        """Read the command line."""
        chosen = self.options.parse_args()
        self.results = Results(self.name, chosen.results)
        self.record = record(f"python -m benchmarks.{self.name}", [self.seed])
        return chosen

    def keep(self, key: str, **figures: float) -> None:
        """Print and keep the figures of one row."""
        print(f"{key}: " + ", ".join(f"{name} {value:,.6g}" for name, value in figures.items()),
              flush=True)  # fmt: skip
        self.results.put(key, figures, self.record)


def made_by(table: str) -> str:
    """Return the command that makes a table."""
    return f"python -m {PROGRAMS[table]}"


def reported() -> dict[str, Any]:
    """Return the figures that other works report of themselves."""
    figures: dict[str, Any] = json.loads((RESULTS / "reported.json").read_text(encoding="utf-8"))
    return figures


def record(
    command: str, seeds: Sequence[int] = (), threads: int = 1, **more: Any
) -> dict[str, Any]:
    """Return what a measurement was made with.

    Args:
        command: that measures this row.
        seeds: of all that is random in it.
        threads: on the CPU.
        **more: further figures about the measurement itself.
    """
    versions = [f"python {platform.python_version()}"]
    for name in PACKAGES:
        try:
            versions.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    return {
        "command": command, "commit": commit(), "cpu": cpu(), "cores": os.cpu_count(),
        "threads": threads, "seeds": ", ".join(map(str, seeds)),
        "packages": ", ".join(versions),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(), **more,
    }  # fmt: skip


def commit() -> str | None:
    """Return the last commit that changed the package, its models or configs; None outside of git.

    Changes that are not committed add a ``+``.
    """

    def git(*words: str) -> str:
        command = ["git", "-C", str(ROOT), *words, "--", *MEASURED]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    try:
        last = git("log", "-1", "--format=%h", "--abbrev=12")
        return last + ("+" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def cpu() -> str:
    """Return the model of the CPU, and the widest vectors that it knows."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor() or platform.machine()
    lines = (line.partition(":") for line in text.splitlines())
    fields = {name.strip(): value.strip() for name, _, value in lines}
    flags = fields.get("flags", "").split()
    vectors = next((f" with {v}" for f, v in (("avx512f", "AVX-512"), ("avx2", "AVX2"))
                    if f in flags), "")  # fmt: skip
    return fields.get("model name", platform.machine()) + vectors
