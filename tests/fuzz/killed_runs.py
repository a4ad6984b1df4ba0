"""Kill training runs at random moments, resume them, and compare with a run that nobody kills.

``python -m tests.fuzz.killed_runs --runs 40 --seed 0 --out killed.json`` begins each run in a new
process, kills it with SIGKILL and resumes it. While every other run is alive, or just after, a
second process tries to resume it too. Each process has to train or to refuse in one line, and each
run has to end with the weights of the run that nobody killed.
"""

import argparse
import multiprocessing
import os
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.files import Growing, write_json
from marl_pack.train import main as train_main

OPTIONS = (
    "--game.bin=[4,4,4]", "--game.sides=[1,3]", "--ppo.num_envs=8", "--ppo.num_steps_per_env=4",
    "--ppo.num_mini_batches=2", "--ppo.max_iterations=8", "--evaluation.every=2",
    "--evaluation.episodes=4", "--output.latest_every=1", "--output.keep_every=3",
    "--orientation.network.channels=8", "--orientation.network.layers=2",
    "--placement.network.channels=8", "--placement.network.layers=2",
    "--orientation.network.planes=[mask,resting_height,waste]",
    "--placement.network.planes=[mask,afterstate_value]",
)  # fmt: skip

ENDED = "after its end"

# The processes are copies of one that has imported everything, so that most of their time is a
# run's own: what is imported writes no file.
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["marl_pack.train", "marl_pack.training.run"])


@dataclass
class Case:
    """What happened to one run."""

    number: int
    killed_after: float  # seconds
    killed_in: str = ""  # the stage of the run
    processes: list[str] = field(default_factory=list)  # what became of each
    faults: list[str] = field(default_factory=list)


def run_train(words: Sequence[str], output: str) -> None:
    """Run the command that trains, with its output in a file."""
    with open(output, "wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.exit(train_main(words))


def start(words: Sequence[str], output: Path) -> BaseProcess:
    """Start the command that trains in a process of its own."""
    process = CONTEXT.Process(target=run_train, args=(words, str(output)), daemon=True)
    process.start()
    return process


def outcome(process: BaseProcess, output: Path, case: Case) -> str:
    """Wait for a process; return what became of it, and record what should not be."""
    process.join(120)
    lines = output.read_text().splitlines() if output.exists() else []
    if process.exitcode == 0:
        return "trained"
    if process.exitcode == -9:
        return "killed"
    refusals = [line for line in lines if line.startswith("python -m marl_pack.train: ")]
    if process.exitcode == 2 and len(lines) <= 2 and len(refusals) == 1:
        for reason in ("another process trains", "no run has begun", "no such folder"):
            if reason in refusals[0]:
                return f"refused: {reason}"
    case.faults.append(f"exit {process.exitcode}: {lines[-1:]}")
    process.kill()
    return "FAULT"


def stage(run: Path) -> str:
    """Return how far a run has come."""
    if not run.is_dir():
        return "before its folder"
    if not (run / checkpoints.LATEST).exists():
        return "before its first checkpoint"
    done = checkpoints.read(run / checkpoints.LATEST)["iter"] + 1
    return "before its first iteration" if done == 0 else f"in iteration {done + 1}"


def differences(run: Path, whole: Path) -> list[str]:
    """Return the parts of the latest checkpoints of two runs that are not equal bit by bit."""
    own, other = (checkpoints.read(path / checkpoints.LATEST) for path in (run, whole))
    parts = ("agents", "afterstate_critic", "afterstate_optimizer", "iter", "items", "state")
    for checkpoint in (own, other):
        for state in checkpoint["state"]:
            del state["logger"]["tot_time"]
    unequal = [part for part in parts if not equal(own[part], other[part])]
    histories = [
        [(row["iteration"], row["utilization"]) for row in checkpoint["evaluations"]]
        for checkpoint in (own, other)
    ]
    return unequal + (["evaluations"] if histories[0] != histories[1] else [])


def equal(a: object, b: object) -> bool:
    """Return whether two nested values are equal, tensors bit by bit."""
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(equal(a[k], b[k]) for k in a)
    if isinstance(a, (list, tuple)):
        return isinstance(b, type(a)) and len(a) == len(b) and all(map(equal, a, b))
    return a == b


def kill_and_resume(
    number: int, two: bool, draw: random.Random, start_up: float, length: float, folder: Path
) -> Case:
    """Kill one run at a random moment and resume it to its end.

    Args:
        number: of the run.
        two: whether a second process tries to resume it too.
        draw: random numbers.
        start_up: seconds before a run's first checkpoint.
        length: seconds that a run takes.
        folder: for all runs; ``whole`` there is the one that nobody killed.
    """
    run = folder / str(number)
    words = [*OPTIONS, f"--output.folder={folder}", f"--output.name={number}"]
    late = draw.random() < 0.5
    case = Case(number, draw.uniform(start_up, length) if late else draw.uniform(0, start_up))
    second_after = draw.uniform(0, 1.2 * case.killed_after)
    outputs = (folder / f"{number}_{k}.txt" for k in range(9))
    processes: list[tuple[BaseProcess, Path]] = []

    def begin(words: Sequence[str]) -> None:
        output = next(outputs)
        processes.append((start(words, output), output))

    started = time.monotonic()
    begin(words)
    first = processes[0][0]
    early = two and second_after < case.killed_after
    if early:
        time.sleep(second_after)
        begin(["--resume", str(run)])
    if late:  # the time counts from the first checkpoint on
        wait_for_checkpoint(run, first)
        started = time.monotonic() - start_up
    time.sleep(max(0.0, started + case.killed_after - time.monotonic()))
    first.kill()
    first.join()
    case.killed_in = stage(run) if first.exitcode else ENDED
    if two and not early:
        begin(["--resume", str(run)])
    begin(["--resume", str(run)])
    case.processes = [outcome(*process, case) for process in processes]
    if "trained" not in case.processes:  # nothing was there to resume: begin again
        processes.clear()
        for _ in range(1 + two):
            begin(words)
        case.processes += [outcome(*process, case) for process in processes]
    if "trained" in case.processes:
        case.faults += differences(run, folder / "whole")
    else:
        case.faults.append("no process finished the run")
    case.faults += [f"left {path.name}" for path in run.glob(".part-*")]
    return case


def wait_for_checkpoint(run: Path, process: BaseProcess) -> None:
    """Wait until a run has its first checkpoint, or its process has ended."""
    while not (run / checkpoints.LATEST).exists() and process.is_alive():
        time.sleep(0.005)


def show(cases: Sequence[Case], console: Console) -> None:
    """Print what became of the runs, by the stage in which they were killed."""
    table = Table("killed", "runs", "processes", "ended with the same weights")
    for stage_name in sorted({case.killed_in for case in cases}):
        own = [case for case in cases if case.killed_in == stage_name]
        counts = Counter(process for case in own for process in case.processes)
        table.add_row(
            stage_name, str(len(own)), "\n".join(f"{n} {what}" for what, n in counts.items()),
            str(sum(not case.faults for case in own)),
        )  # fmt: skip
    console.print(table)
    for case in cases:
        if case.faults:
            console.print(f"run {case.number}, killed {case.killed_in}: {case.faults}")
    console.print(f"{len(cases)} runs, {sum(bool(case.faults) for case in cases)} with a fault")


def main(arguments: Sequence[str] | None = None) -> int:
    """Kill runs and print what became of them; return 1 if one of them has a fault."""
    options = argparse.ArgumentParser(prog="python -m tests.fuzz.killed_runs")
    options.add_argument("--runs", type=int, default=40, help="that are killed (default: 40)")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--out", type=Path, help="JSON file for what became of each run")
    chosen = options.parse_args(arguments)
    torch.set_num_threads(1)
    cases: list[Case] = []
    growing = Growing(chosen.out, write_json)
    with tempfile.TemporaryDirectory() as name:
        folder, draw = Path(name), random.Random(chosen.seed)
        case, output = Case(-1, 0.0), folder / "whole.txt"
        outcome(start(["--resume"], output), output, Case(-1, 0.0))  # everything is imported now
        started = time.monotonic()
        whole = start([*OPTIONS, f"--output.folder={folder}", "--output.name=whole"], output)
        wait_for_checkpoint(folder / "whole", whole)
        start_up = time.monotonic() - started
        if outcome(whole, output, case) != "trained":
            raise SystemExit(f"a run does not work: {case.faults}")
        length = time.monotonic() - started
        killed = 0
        while killed < chosen.runs and len(cases) < 2 * chosen.runs + 4:  # some end before that
            two = killed % 2 == 1
            cases.append(kill_and_resume(len(cases), two, draw, start_up, length, folder))
            killed += cases[-1].killed_in != ENDED
            growing.update({"seconds": length, "cases": [asdict(case) for case in cases]})
    growing.close()
    show(cases, Console())
    return int(any(case.faults for case in cases))


if __name__ == "__main__":
    sys.exit(main())
