"""Compare training with and without each agent and choice: ``python -m benchmarks.ablations``.

Every config in ``configs/ablations`` is trained with three seeds for the same number of items. With
``--config`` and ``--changes`` it is one config, each time with the options of one change. Runs that
exist are resumed or just read. The figure of a run is its last evaluation, on the
same held-out sequences for all; intervals are Student's over the seeds, and so is that of the
difference to the first row, taken seed by seed.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from benchmarks.learning_curve import history
from benchmarks.planning import spread
from benchmarks.timing import show
from marl_pack.config import parse

CONFIGS = Path(__file__).parent.parent / "configs" / "ablations"
SEEDS = (0, 1, 2)


def train(name: str, options: list[str], seed: int, folder: Path) -> Path:
    """Train one run to its end, unless it exists, and return its folder."""
    run = folder / f"{name}_{seed}"
    options = [*options, "--seed", str(seed), "--output.name", run.name,
               "--output.folder", str(folder)]  # fmt: skip
    command = [sys.executable, "-m", "marl_pack.train"]
    if (run / "latest.pt").is_file():
        settings = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
        if settings != parse(options)[0].to_dict():
            raise SystemExit(f"{run}: was trained with other settings; needs another --folder")
        command += ["--resume", str(run)]
    else:
        command += options
    subprocess.run(command, check=True)
    return run


def main() -> None:
    """Train the runs that are missing, then print the table."""
    options = argparse.ArgumentParser(prog="python -m benchmarks.ablations")
    options.add_argument("names", nargs="*", help="configs in configs/ablations (default: all)")
    options.add_argument("--folder", type=Path, default=Path("runs/ablations"))
    options.add_argument("--config", type=Path, help="train this config with --changes instead")
    options.add_argument("--changes", nargs="+", default=[], metavar="OPTIONS",
                         help='of marl_pack.train, as "--seed 1"; "" for no change')  # fmt: skip
    options.add_argument("--every", default="", metavar="OPTIONS", help="options of every run")
    chosen = options.parse_args()
    if bool(chosen.config) != bool(chosen.changes):
        options.error("--config and --changes go together")
    if chosen.config:
        runs = {
            "_".join((chosen.config.stem, *re.findall(r"[\w.]+", change))): (chosen.config, change)
            for change in chosen.changes
        }
        if len(runs) < len(chosen.changes):
            options.error("--changes: two of them have the same words")
    else:
        named = [CONFIGS / f"{n}.yaml" for n in chosen.names] or sorted(CONFIGS.glob("*.yaml"))
        runs = {config.stem: (config, "") for config in named}
    table: list[list[str]] = []
    first: NDArray[np.float64] | None = None
    for name, (config, change) in runs.items():
        arguments = ["--config", str(config), *shlex.split(chosen.every), *shlex.split(change)]
        last = [history(train(name, arguments, seed, chosen.folder))[-1] for seed in SEEDS]
        u = np.array([row["utilization"] for row in last])
        first = u if first is None else first
        minutes = np.mean([row["seconds"] for row in last]) / 60
        table.append([name, spread(u).lstrip("+"), " ".join(f"{100 * v:.2f}" for v in u),
                      spread(u - first) if table else "",
                      f"{last[0]['items']:,.0f}", f"{minutes:.1f}"])  # fmt: skip
    columns = ["config", "utilization %", "each seed", "difference", "items", "minutes"]
    show(f"ablations, {len(SEEDS)} seeds", columns, table)


if __name__ == "__main__":
    main()
