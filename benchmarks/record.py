"""Store measured figures in ``results/*.json``, each with a record of how it was measured.

A file is a table. Each row has figures and a record: the command, commit, CPU, threads, seeds,
packages and date. A new measurement replaces only its own row, so a table may be made in parts, by
several processes and on several machines.
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

import torch
from filelock import FileLock

from marl_pack.files import write_json

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "results"
PACKAGES = (
    "torch", "rsl-rl-lib", "numpy", "numba", "scipy", "sapien", "opencv-python-headless", "fastapi",
    "uvicorn",
)  # fmt: skip
MEASURED = ("marl_pack", "models/*.pt", "configs")
"""The files that figures depend on, besides the code of the commands."""
PROGRAMS = {
    "packing": "experiments.packing --tables packing",
    "two_orientations": "experiments.packing --tables two_orientations",
    "other_rules": "experiments.packing --tables other_rules",
    "bodies": "experiments.packing --tables bodies",
    "selection": "experiments.packing --tables selection",
    **{name: f"experiments.{name}" for name in (
        "ablations", "learning_curve", "planning", "afterstates", "volume_spread",
        "real_goods", "real_cell", "packer", "packer_selection")},
    **{name: f"experiments.physics {name}" for name in ("controls", "table1")},
    **{name: f"benchmarks.{name}" for name in (
        "masks", "rules", "room", "game", "training", "play", "exact", "page", "service")},
}  # fmt: skip
"""The program that makes each table."""


@dataclass(frozen=True)
class Results:
    """A table of results in a JSON file.

    Args:
        name: name of the file without its ending.
        folder: folder of the file.
    """

    name: str
    folder: Path = RESULTS

    @property
    def path(self) -> Path:
        """The path of the file."""
        return self.folder / f"{self.name}.json"

    def rows(self) -> dict[str, dict[str, Any]]:
        """Return the rows that have been measured, by their keys; each includes its ``record``."""
        if not self.path.is_file():
            return {}
        rows: dict[str, dict[str, Any]] = json.loads(self.path.read_text(encoding="utf-8"))
        return rows

    def row(self, key: str) -> dict[str, Any]:
        """Return one row.

        Raises:
            ValueError: if it has not been measured; names the command that measures it.
        """
        rows = self.rows()
        if key not in rows:
            raise ValueError(f"{self.path}: has no row {key!r}; {made_by(self.name)} measures it")
        return rows[key]

    def put(self, key: str, figures: Mapping[str, Any], record: Mapping[str, Any]) -> None:
        """Write one row; rows that other processes write at the same time are not lost."""
        with self._locked():
            rows = self.rows() | {key: {**figures, "record": dict(record)}}
            write_json(self.path, dict(sorted(rows.items())))

    def remove(self, key: str) -> None:
        """Remove the row of a key from the table."""
        with self._locked():
            write_json(self.path, {k: row for k, row in self.rows().items() if k != key})

    def _locked(self) -> FileLock:
        self.folder.mkdir(exist_ok=True)
        return FileLock(self.folder / f".{self.name}.lock")


class Measurements:
    """The measurements of one program of ``benchmarks/``: each row is printed and stored.

    Args:
        name: name of the program and of its table.
        description: the program's docstring.
        seed: seed of everything random in the program.
    """

    def __init__(self, name: str, description: str, seed: int) -> None:
        self.options = argparse.ArgumentParser(
            prog=f"python -m benchmarks.{name}", description=description,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )  # fmt: skip
        self.options.add_argument("--results", type=Path, default=RESULTS, metavar="FOLDER",
                                  help="folder of the table (default: results)")  # fmt: skip
        self.name, self.seed = name, seed

    def parse(self) -> argparse.Namespace:
        """Read the command line."""
        chosen = self.options.parse_args()
        self.results = Results(self.name, chosen.results)
        self.record = record(f"python -m benchmarks.{self.name}", [self.seed])
        return chosen

    def keep(self, key: str, **figures: float) -> None:
        """Print and store the figures of one row."""
        print(f"{key}: " + ", ".join(f"{name} {value:,.6g}" for name, value in figures.items()),
              flush=True)  # fmt: skip
        self.results.put(key, figures, self.record)


def made_by(table: str) -> str:
    """Return the command that makes a table."""
    return f"python -m {PROGRAMS[table]}"


def reported() -> dict[str, Any]:
    """Return the figures that other works report about themselves."""
    figures: dict[str, Any] = json.loads((RESULTS / "reported.json").read_text(encoding="utf-8"))
    return figures


def record(
    command: str, seeds: Sequence[int] = (), threads: int = 1, **more: Any
) -> dict[str, Any]:
    """Return the record of a measurement: command, commit, processors, seeds, packages and date.

    Args:
        command: the command that measures this row.
        seeds: the seeds of everything random in the measurement.
        threads: number of threads on the CPU.
        **more: further facts about the measurement.
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
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        **({"gpu": torch.cuda.get_device_name()} if torch.cuda.is_available() else {}), **more,
    }  # fmt: skip


def commit() -> str | None:
    """Return the last commit that changed the package, its models or configs; None without git.

    A ``+`` at the end means that there were changes that are not committed.
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
    """Return the model of the CPU and its widest vector instructions."""
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
