"""Check the tests: break one line of a copy of the package at a time, and see which test notices.

Run ``make mutations``, or ``python -m tests.mutations NAME …`` for those whose names begin so. The
records stand in :mod:`tests.mutation_table`. The working tree is not written to.
"""

from __future__ import annotations

import argparse
import ast
import json
import multiprocessing
import os
import shutil
import sys
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Column, Table

from tests.mutation_table import MUTATIONS, PACKAGE, Mutation

ROOT = Path(__file__).parent.parent
LEFT_OUT = shutil.ignore_patterns(".*", "build", "runs", "shared", "*.egg-info")
LONGEST = 600  # seconds that the tests of one mutation may take
PROCESSES = multiprocessing.get_context("forkserver")  # which imports what all tests do only once
PRELOADED = ["__main__", "torch", "numba", "scipy.optimize", "tensordict", "rsl_rl.runners"]


@dataclass(frozen=True)
class Result:
    """The tests of one mutation that failed."""

    mutation: Mutation
    noticed: tuple[str, ...]


def mutated(mutation: Mutation, root: Path) -> str:
    """Return the text of the mutated file.

    Raises:
        ValueError: unless the text to replace is in the file exactly once.
    """
    path = root / PACKAGE / mutation.file
    text = path.read_text() if path.is_file() else ""
    count = text.count(mutation.old)
    if count != 1:
        raise ValueError(
            f"{mutation.name}: {PACKAGE}/{mutation.file} has the text to replace {count} times, "
            f"needs it exactly once: {mutation.old!r}"
        )
    return text.replace(mutation.old, mutation.new)


def chosen(names: Sequence[str]) -> list[Mutation]:
    """Return the mutations whose names begin with one of ``names``; all if there are none.

    Raises:
        ValueError: for a name with which none begins, and as :func:`mutated`.
    """
    for name in names:
        if not any(mutation.name.startswith(name) for mutation in MUTATIONS):
            raise ValueError(f"no mutation is called {name!r}: see --list")
    wanted = [m for m in MUTATIONS if not names or m.name.startswith(tuple(names))]
    for mutation in wanted:
        mutated(mutation, ROOT)
    return wanted


class Failures:
    """A plugin of pytest that collects what fails."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Record a test that failed."""
        if report.failed:
            self.names.append(report.nodeid)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Record a file that could not be read."""
        if report.failed:
            self.names.append(report.nodeid)


def work(folder: Path, tests: Sequence[str], result: Connection) -> None:
    """Run tests in a copy up to the first failure, in a process of their own; send what failed."""
    os.chdir(folder)
    os.environ["PYTHONPATH"] = str(folder)
    sys.path.insert(0, str(folder))
    sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115  # until the process ends
    failures = Failures()
    options = ["-x", "-q", "--tb=no", "-p", "no:cacheprovider"]
    code = pytest.main([*options, *(f"tests/{test}" for test in tests)], plugins=[failures])
    result.send(failures.names or ([] if code == 0 else [f"pytest ended with {int(code)}"]))


def run_tests(folder: Path, tests: Iterable[str], limit: float | None = None) -> tuple[str, ...]:
    """Return what failed of a copy's tests, up to the first failure; end after ``limit`` s."""
    receiver, sender = PROCESSES.Pipe(duplex=False)
    process = PROCESSES.Process(target=work, args=(folder, tuple(tests), sender))
    process.start()
    sender.close()
    try:
        if not receiver.poll(limit):
            return (f"no end after {limit} s",)
        return tuple(receiver.recv())
    except EOFError:
        process.join()
        return (f"the process ended with {process.exitcode}",)
    finally:
        process.kill()
        process.join()


def importers(root: Path, file: str) -> set[Path]:
    """Return the modules that import a file of the package, directly or through others."""
    sources = {path: path.read_text() for path in (root / PACKAGE).rglob("*.py")}
    imported: dict[Path, set[str]] = {}
    for path, text in sources.items():
        nodes = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)]
        names = {f"{node.module}.{alias.name}" for node in nodes for alias in node.names}
        imported[path] = names | {str(node.module) for node in nodes}
    found: set[Path] = set()
    remaining = [root / PACKAGE / file]
    while remaining:
        path = remaining.pop()
        name = ".".join(path.relative_to(root).with_suffix("").parts)
        more = {other for other, names in imported.items() if name in names} - found
        found |= more
        remaining += more
    return found


def forget_compiled_callers(root: Path, file: str) -> None:
    """Delete the compiled code of modules that may have that of ``file`` in their own."""
    for path in importers(root, file):
        for cache in (path.parent / "__pycache__").glob(f"{path.stem}.*.nb[ci]"):
            cache.unlink()


def try_mutation(base: Path, mutation: Mutation) -> Result:
    """Run the tests of a mutation in a copy of ``base`` that has it."""
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        folder = Path(shutil.copytree(base, Path(name) / "copy"))
        text = mutated(mutation, folder)
        (folder / PACKAGE / mutation.file).write_text(text)
        if "@njit" in text:
            forget_compiled_callers(folder, mutation.file)
        return Result(mutation, run_tests(folder, mutation.tests, LONGEST))


def table_of(results: Sequence[Result]) -> Table:
    """Return the table of the mutations and the tests that noticed them."""
    table = Table("mutation", "file", Column("noticed by", overflow="fold"), box=None)
    for result in results:
        names = (name.removeprefix("tests/") for name in result.noticed)
        noticed = escape(", ".join(names)) or "[bold red]nothing"
        table.add_row(escape(result.mutation.name), result.mutation.file, noticed)
    return table


def main(arguments: Sequence[str] | None = None) -> int:
    """Try the mutations; return 1 if one survives, 2 if they cannot be tried."""
    parser = argparse.ArgumentParser("python -m tests.mutations", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="beginnings of names; default all")
    parser.add_argument("--list", action="store_true", help="show the mutations and end")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results there as well")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="mutations tried at once")
    options = parser.parse_args(arguments)
    console = Console()
    try:
        mutations = chosen(options.names)
    except ValueError as error:
        parser.error(str(error))
    if options.list:
        for mutation in mutations:
            print(f"{mutation.name}  ({mutation.file})")
        return 0
    os.environ.pop("NUMBA_CACHE_DIR", None)  # copies have compiled code beside their files
    PROCESSES.set_forkserver_preload(PRELOADED)
    with tempfile.TemporaryDirectory(prefix="mutations-") as name:
        base = Path(shutil.copytree(ROOT, Path(name) / "base", ignore=LEFT_OUT))
        console.print("the tests on the unchanged copy …")
        tests = sorted({test for mutation in mutations for test in mutation.tests})
        failed = run_tests(base, tests)
        if failed:
            parser.error(f"tests fail without a mutation: {', '.join(failed)}")
        results = []
        with Progress(console=console) as bar, ThreadPoolExecutor(options.jobs) as pool:
            task = bar.add_task("mutations", total=len(mutations))
            for result in pool.map(partial(try_mutation, base), mutations):
                results.append(result)
                noticed = "[green]noticed" if result.noticed else "[bold red]survived"
                bar.console.print(f"{noticed}:[/] {escape(result.mutation.name)}")
                bar.advance(task)
    console.print(table_of(results))
    survivors = sum(not result.noticed for result in results)
    console.print(f"{len(results)} mutations, {survivors} survived")
    if options.json is not None:
        report = [
            {"name": r.mutation.name, "file": r.mutation.file, "noticed": list(r.noticed)}
            for r in results
        ]
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
