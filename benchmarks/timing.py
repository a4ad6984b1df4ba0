"""Measure the best CPU time of a function."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch


def best_time(work: Callable[[], object], repeats: int = 7, device: str = "cpu") -> float:
    """Return the seconds of one call of ``work``: the shortest of ``repeats`` measurements.

    On the CPU these are CPU seconds of this process, on a CUDA device synchronised wall seconds.
    Disturbances only make a measurement longer.
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


def devices() -> list[str]:
    """Return the CPU, and the CUDA device if there is one."""
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
