"""Try bad and hard input for long: ``python -m tests.fuzz --minutes 20`` (``make fuzz``).

Every source yields cases: a name, and a function that tries one. A case ends well if its input is
refused in one line, or is taken and the result is right. A source plays in a process of its own,
with a limit of memory; a case that takes too long or ends the process is a fault too.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
from rich import box
from rich.console import Console
from rich.table import Table

Case = tuple[str, Callable[[], str]]
"""A name, and a function that returns REFUSED or RIGHT, or raises."""

REFUSED, RIGHT = "refused in one line", "right"
FAULTS = ("traceback", "wrong result", "wrongly accepted", "crash", "hang", "memory")
LIMIT_S = 120.0
"""Seconds that a case may take on a busy machine, compilation included."""
LIMIT_BYTES = 8 << 30
"""Memory that a process may allocate."""
LIMIT_GROWTH = 1 << 30
"""Memory by which one case may raise the peak of its process."""
LONGEST = 1000
"""Characters of a message of one line."""


class WronglyAcceptedError(Exception):
    """Bad input was taken."""


# --- the sources ----------------------------------------------------------------------------------


def arguments(seed: int, folder: Path) -> Iterator[Case]:
    """Yield calls of public functions with one wrong argument."""
    from .arguments import cases

    for name, call in cases(seed):
        yield name, lambda call=call: _done(call())


def games(seed: int, folder: Path) -> Iterator[Case]:
    """Yield games in the mode that compares every placement with plain code."""
    from .games import cases

    yield from cases(seed)


def selection(seed: int, folder: Path) -> Iterator[Case]:
    """Yield games with a buffer, a preview and several bins, played by both backends."""
    from .selection import cases

    yield from cases(seed)


def hull_rules(seed: int, folder: Path) -> Iterator[Case]:
    """Yield windows at the edge of support, a thousand a case."""
    from .exact_stability import check_hulls

    for part in range(10**9):
        yield f"windows {seed}-{part}", lambda part=part: _done(check_hulls([seed, part], 1000))


def equilibria(seed: int, folder: Path) -> Iterator[Case]:
    """Yield stacks in equilibrium or nearly so, ten a case."""
    from .exact_stability import check_equilibrium

    for part in range(10**9):
        yield f"stacks {seed}-{part}", lambda part=part: _done(check_equilibrium([seed, part], 10))


def millimetres(seed: int, folder: Path) -> Iterator[Case]:
    """Yield games in millimetres, checked by plain code."""
    from .millimetres import cases

    for name, case in cases(seed):
        yield name, lambda case=case: _done(case())


def packers(seed: int, folder: Path) -> Iterator[Case]:
    """Yield packers with random calls, checked by plain code."""
    from .packer import cases

    for name, case in cases(seed):
        yield name, lambda case=case: _done(case())


def service(seed: int, folder: Path) -> Iterator[Case]:
    """Yield sessions with the service: random requests, checked by what they answered."""
    from .service import cases

    for name, case in cases(seed):
        yield name, lambda case=case: _done(case())


def item_files(seed: int, folder: Path) -> Iterator[Case]:
    """Yield files of items, and play the first turn with those that are taken."""
    from marl_pack.game.packing import Packing
    from marl_pack.items import load

    def read(path: Path) -> None:
        load(path, (10, 10, 10))
        Packing(2, (10, 10, 10), items=str(path))

    yield from _files(seed, folder, read, plans=False)


def plan_files(seed: int, folder: Path) -> Iterator[Case]:
    """Yield files of plans, as JSON, CSV and npz."""
    from marl_pack.plan_archive import load_plans
    from marl_pack.replay.document import make_document

    def read(path: Path) -> None:
        for plan in load_plans(path):
            json.dumps(make_document(plan), allow_nan=False)

    yield from _files(seed, folder, read, plans=True)


def _files(seed: int, folder: Path, read: Callable[[Path], Any], plans: bool) -> Iterator[Case]:
    from .item_files import cases

    for name, content, suffix in cases(seed, plans=plans):

        def case(name: str = name, content: bytes = content, suffix: str = suffix) -> str:
            path = folder / f"file{suffix}"
            path.write_bytes(content)
            read(path)
            if name.startswith("bad"):
                raise WronglyAcceptedError(name)
            return RIGHT

        yield name, case


def settings(seed: int, folder: Path) -> Iterator[Case]:
    """Yield settings of training, on the command line and as YAML."""
    from marl_pack.config import from_dict, parse

    from .configs import cases

    path = folder / "case.yaml"
    for name, case in cases(seed):

        def attempt(case: list[str] | str = case) -> str:
            path.write_text(case if isinstance(case, str) else "", encoding="utf-8")
            config, _ = parse(case if isinstance(case, list) else [f"--config={path}"])
            assert from_dict(config.to_dict()) == config
            return RIGHT

        yield name, attempt


def checkpoints(seed: int, folder: Path) -> Iterator[Case]:
    """Yield checkpoints with one wrong value, tried at every door."""
    from marl_pack.train import main

    from .checkpoints import cases, outcomes
    from .killed_runs import OPTIONS

    run = folder / "run"
    if not run.exists():
        options = [*OPTIONS, "--ppo.max_iterations=1", "--output.name=run"]
        assert main([*options, f"--output.folder={folder}"]) == 0
    content = torch.load(run / "latest.pt", weights_only=False)
    path = folder / "changed.pt"
    for name, changed in cases(seed, content):

        def case(changed: dict[str, Any] = changed) -> str:
            torch.save(changed, path)
            results = set(outcomes(path, content["config"]).values())
            return RIGHT if results == {"taken"} else REFUSED

        yield name, case


SOURCES: dict[str, Callable[[int, Path], Iterator[Case]]] = {
    source.__name__: source
    for source in (
        arguments, settings, item_files, plan_files, checkpoints, games, selection, millimetres,
        packers, service, hull_rules, equilibria,
    )
}  # fmt: skip


def _done(_: object) -> str:
    return RIGHT


# --- the worker -----------------------------------------------------------------------------------


def work(source: str, seed: int, folder: Path, pipe: Connection) -> None:
    """Try the cases of a source, without end, and report each before and after."""
    quiet = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(quiet, stream)
    resource.setrlimit(resource.RLIMIT_DATA, (LIMIT_BYTES, LIMIT_BYTES))
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    while True:
        for name, case in SOURCES[source](seed, folder):
            pipe.send((name, None, ""))
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            outcome, detail = attempt(case)
            growth = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
            if growth > LIMIT_GROWTH:
                outcome, detail = "memory", f"{growth >> 20} MiB more; {detail}"
            pipe.send((name, outcome, detail))
        seed += 1000


def attempt(case: Callable[[], str]) -> tuple[str, str]:
    """Try one case; return its class, and what was wrong."""
    try:
        return case(), ""
    except WronglyAcceptedError as error:
        return "wrongly accepted", str(error)
    except AssertionError as error:
        return "wrong result", str(error)
    except (ValueError, FileNotFoundError) as error:
        text = str(error)
        if len(text.splitlines()) == 1 and len(text) <= LONGEST:
            return REFUSED, ""
        return "traceback", f"{len(text.splitlines())} lines, {len(text)} characters: {text[:300]}"
    except MemoryError as error:
        return "memory", str(error)
    except BaseException as error:
        import traceback

        place = traceback.extract_tb(error.__traceback__)[-1]
        at = f"{Path(place.filename).name}:{place.lineno}"
        return "traceback", f"{type(error).__name__} at {at}: {str(error)[:300]}"


# --- the parent -----------------------------------------------------------------------------------


@dataclass
class Tally:
    """The outcomes of one source."""

    outcomes: Counter[str] = field(default_factory=Counter)
    faults: list[dict[str, str]] = field(default_factory=list)

    def add(self, case: str, outcome: str, detail: str) -> None:
        """Count the outcome of one case, and keep it if it is a fault."""
        self.outcomes[outcome] += 1
        if outcome in FAULTS:
            self.faults.append({"case": case, "outcome": outcome, "detail": detail})


def run(source: str, seed: int, seconds: float) -> Tally:
    """Try the cases of a source for some time; a process that ends is begun again."""
    tally, end = Tally(), time.monotonic() + seconds
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        while time.monotonic() < end:
            here, there = context.Pipe()
            process = context.Process(
                target=work, args=(source, seed, Path(folder), there), daemon=True
            )
            process.start()
            there.close()
            case = "start"
            try:
                while time.monotonic() < end:
                    if not here.poll(LIMIT_S):
                        tally.add(case, "hang", f"more than {LIMIT_S:g} s")
                        break
                    case, outcome, detail = here.recv()
                    if outcome is not None:
                        tally.add(case, outcome, detail)
            except EOFError:
                process.join()
                tally.add(case, "crash", f"exit status {process.exitcode}")
            process.kill()
            process.join()
            seed += 1
    return tally


def show(tallies: dict[str, Tally], console: Console) -> None:
    """Print a row of outcomes for each source, and every fault."""
    table = Table(box=box.SIMPLE)
    table.add_column("source")
    columns = (RIGHT, REFUSED, *FAULTS)
    for column in ("cases", *columns):
        table.add_column(column, justify="right")
    total: Counter[str] = Counter()
    for source, tally in tallies.items():
        total += tally.outcomes
        counts = [tally.outcomes.total(), *(tally.outcomes[column] for column in columns)]
        table.add_row(source, *(f"{count:,}" for count in counts))
    counts = [total.total(), *(total[column] for column in columns)]
    table.add_row("all", *(f"{count:,}" for count in counts))
    console.print(table)
    for source, tally in tallies.items():
        for fault in tally.faults[:20]:
            line = f"{source}: {fault['outcome']}: {fault['case']}: {fault['detail']}"
            console.print(line, markup=False, soft_wrap=True)


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; return 1 if there was a fault."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sources", nargs="+", choices=SOURCES, default=list(SOURCES))
    parser.add_argument("--processes", type=int, default=2, help="sources that run at once")
    parser.add_argument("--json", type=Path, help="write the outcomes there")
    options = parser.parse_args(words)
    seconds = 60 * options.minutes * options.processes / len(options.sources)
    seconds = min(seconds, 60 * options.minutes)
    console = Console(width=160 if not sys.stdout.isatty() else None)

    def one(source: str) -> Tally:
        return run(source, options.seed, seconds)

    with ThreadPoolExecutor(options.processes) as pool:
        tallies = dict(zip(options.sources, pool.map(one, options.sources), strict=True))
    show(tallies, console)
    if options.json:
        report = {name: {"outcomes": t.outcomes, "faults": t.faults} for name, t in tallies.items()}
        options.json.write_text(json.dumps(report, indent=1))
    return int(any(tally.faults for tally in tallies.values()))
