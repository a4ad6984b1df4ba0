"""Train with one setting changed, with three seeds each: ``python -m experiments.ablations``.

Every run is short: 80 iterations of 1,024 items, and the schedules of learning rate and entropy end
there. At its end the run is evaluated once on 2,000 held-out sequences, the same for all runs. Runs
are stored in ``--folder`` and can be resumed.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import yaml

from benchmarks.record import record
from experiments.learning_curve import history
from experiments.rows import Rows, main_of
from marl_pack import train as training
from marl_pack.config import parse

BASE = "--config default"
"""Options for the settings to which every change is applied."""
SHORT = "--ppo.max_iterations 80 --evaluation.every 80 --evaluation.episodes 2000"
SEEDS = (0, 1, 2)


def both(option: str) -> str:
    """Return an option of a network for both agents."""
    return f"--orientation.network.{option} --placement.network.{option}"


CHANGES = {
    "none": "",
    "no_afterstate_value": both(
        "planes=[mask,resting_height,waste,feasible_cells,feasible_probability,grounded]"
    ),
    "orientation_first": "--orientation.frozen true --orientation.policy first",
    "placement_dblf": "--placement.frozen true --placement.policy dblf",
    "joint": "--joint true",
    "orientation_random": "--orientation.frozen true --orientation.policy random",
    "placement_random": "--placement.frozen true --placement.policy random",
    "no_feasible_planes": both("planes=[mask,resting_height,waste,grounded]"),
    "papers_channels": both("planes=[]"),
    "clone_max_feasible": " ".join(
        f"--{agent}.teacher max_feasible --{agent}.teacher_iterations 20"
        for agent in ("orientation", "placement")
    ),
    "beta_0": "--game.beta 0",
    "entropy_0.005": "--ppo.entropy_coef 0.005",
    "one_epoch": "--ppo.num_learning_epochs 1",
    "hull_1": "--game.rule hull_1",
    "no_orientation_mask": "--game.mask_orientations false "
    + both("planes=[resting_height,waste,grounded]"),
}
"""The options of each change, by its name; the most important changes come first."""
WORDS = {
    "none": "none",
    "no_afterstate_value": "without the plane `afterstate_value`",
    "orientation_first": "only placement learns; items as they come",
    "placement_dblf": "only orientation learns; cells by `dblf`",
    "joint": "one agent learns pairs (orientation, cell)",
    "orientation_random": "only placement learns; orientations at random",
    "placement_random": "only orientation learns; cells at random",
    "no_feasible_planes": "without the planes `afterstate_value` and `feasible_*`",
    "papers_channels": "the paper's four channels alone",
    "clone_max_feasible": "both clone `max_feasible` for 20 of the 80 iterations",
    "beta_0": "no penalty for waste (`--game.beta 0`)",
    "entropy_0.005": "less entropy at first (`--ppo.entropy_coef 0.005`)",
    "one_epoch": "`--ppo.num_learning_epochs 1`",
    "hull_1": "masks by `hull_1`",
    "no_orientation_mask": "orientations not masked, nor shown",
}
"""The text for each change on the page of results."""


def key_of(change: str, seed: int) -> str:
    """Return the key of a run's row."""
    return f"{change}, seed {seed}"


def train(change: str, seed: int, folder: Path) -> tuple[Path, list[str]]:
    """Train one run to its end, unless that is done; return its folder and options.

    Raises:
        ValueError: if the run in that folder has other settings, or the training failed.
        KeyboardInterrupt: if it was stopped; the run can be resumed.
    """
    run = folder / f"{change}_{seed}"
    own = [*shlex.split(f"{BASE} {SHORT} {CHANGES[change]}"), "--seed", str(seed)]
    options = [*own, "--output.name", run.name, "--output.folder", str(folder)]
    if (run / "latest.pt").is_file():
        settings = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
        if settings != parse(options)[0].to_dict():
            raise ValueError(f"{run}: was trained with other settings; needs another --folder")
        options = ["--resume", str(run)]
    status = training.main(options)
    if status == 130:
        raise KeyboardInterrupt
    if status:
        raise ValueError(f"{run}: the training ended with status {status}")
    return run, own


def main() -> int:
    """Train the runs that are missing; return the exit status."""
    rows = Rows("python -m experiments.ablations", __doc__)
    add = rows.options.add_argument
    add("--changes", nargs="+", choices=CHANGES, default=list(CHANGES),
        help="changes to train with (default: all)")  # fmt: skip
    add("--seeds", nargs="+", type=int, default=SEEDS, help="seeds of each (default: 0 1 2)")
    add("--folder", type=Path, default=Path("runs/ablations"), help="folder of the runs")
    chosen = rows.parse()
    results = rows.results("ablations")
    keys = {key_of(change, seed): (change, seed)
            for change in chosen.changes for seed in chosen.seeds}  # fmt: skip
    for key in rows.missing(results, keys):
        change, seed = keys[key]
        run, options = train(change, seed, chosen.folder)
        last = history(run)[-1]
        figures = {name: float(last[name]) for name in ("utilization", "low", "high", "items")}
        command = f"python -m marl_pack.train {shlex.join(options)}"
        results.put(key, {"change": CHANGES[change], **figures}, record(command, [seed]))
    return 0


if __name__ == "__main__":
    sys.exit(main_of(main))
