"""Measure the best CPU time of a function, and print tables of results."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import torch
from rich.console import Console
from rich.table import Table


def best_time(work: Callable[[], object], repeats: int = 7, device: str = "cpu") -> float:
    """Return the seconds of one call of ``work``: the least of ``repeats`` measurements.

    They are CPU seconds of this process on the CPU, and wall seconds, synchronised, on a CUDA
    device. Disturbances only make a measurement longer.
    """
    clock = time.process_time if device == "cpu" else time.perf_counter
    calls, best = 1, float("inf")
    while True:  # enough calls that the clock's resolution does not matter
        start = clock()
        for _ in range(calls):
            work()
        if device != "cpu":
            torch.cuda.synchronize()
        seconds = clock() - start
        if seconds > 0.05 or calls >= 1 << 16:
            break
        calls *= 2
    best = seconds / calls
    for _ in range(repeats - 1):
        start = clock()
        for _ in range(calls):
            work()
        if device != "cpu":
            torch.cuda.synchronize()
        best = min(best, (clock() - start) / calls)
    return best


def show(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table of results."""
    table = Table(title=title)
    for k, column in enumerate(columns):
        table.add_column(column, justify="right" if k else "left")
    for row in rows:
        table.add_row(*row)
    Console().print(table)


def devices() -> list[str]:
    """Return the CPU, and the CUDA device if there is one."""
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
