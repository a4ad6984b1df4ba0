"""Choose the rows of an experiment, and list those that are still to be measured."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.record import RESULTS, Results
from marl_pack.evaluation.statistics import interval


class Rows:
    """The rows that a command's options choose.

    Args:
        program: name of the command.
        description: the docstring of the command's module.
    """

    def __init__(self, program: str, description: str) -> None:
        self.options = argparse.ArgumentParser(
            prog=program, description=description,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )  # fmt: skip
        add = self.options.add_argument
        add("--only", nargs="+", default=[], metavar="WORD",
            help="only rows that have all these words")  # fmt: skip
        add("--again", action="store_true", help="measure rows again that are there already")
        add("--results", type=Path, default=RESULTS, metavar="FOLDER",
            help="folder of the tables (default: results)")  # fmt: skip
        add("--list", action="store_true", help="print the rows and measure nothing")

    def parse(self) -> argparse.Namespace:
        """Read the command line."""
        self.chosen = self.options.parse_args()
        return self.chosen

    def results(self, table: str) -> Results:
        """Return a table in the chosen folder."""
        return Results(table, self.chosen.results)

    def missing(
        self,
        results: Results,
        keys: Iterable[str],
        done: Callable[[dict[str, Any]], bool] = lambda row: True,
    ) -> Iterator[str]:
        """Yield the keys of the chosen rows that are still to be measured.

        Args:
            results: the table; with ``--again`` each row is removed before it is yielded.
            keys: the keys of all rows of the table.
            done: a function that returns whether a row of the table is complete.
        """
        for key in keys:
            if not set(self.chosen.only) <= set(key.replace("/", " ").split()) | set(key.split()):
                continue
            row = results.rows().get(key)
            complete = row is not None and done(row) and not self.chosen.again
            state = "done" if complete else "part" if row else "missing"
            print(f"{results.name}: {key}: {state}", flush=True)
            if complete or self.chosen.list:
                continue
            if self.chosen.again and row is not None:
                results.remove(key)
            yield key


def expanded(options: str) -> list[str]:
    """Return options as words, with ``$MARL_PACK_DATA`` replaced by its value.

    Raises:
        ValueError: if it is not set.
    """
    if "$MARL_PACK_DATA" in options and not os.environ.get("MARL_PACK_DATA"):
        raise ValueError("MARL_PACK_DATA: needs the folder of the published sequences, with rs.npz")
    return shlex.split(os.path.expandvars(options))


def main_of(program: Callable[[], int]) -> int:
    """Run a command and return its exit status; bad input ends it with status 2 and one line."""
    try:
        return program()
    except KeyboardInterrupt:
        print("interrupted; the same command continues", file=sys.stderr)
        return 130
    except (ValueError, OSError, ModuleNotFoundError) as error:
        print(error, file=sys.stderr)
        return 2


def mean(values: NDArray[np.float64]) -> dict[str, float]:
    """Return the mean and half of its 95 % interval (Student's t)."""
    low, high = interval(values) or (np.nan, np.nan)
    return {"mean": float(values.mean()), "half": float((high - low) / 2)}
