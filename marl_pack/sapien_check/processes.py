"""Run tasks in several processes, with their results in order."""

from __future__ import annotations

import functools
import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import TypeVar

from marl_pack.sapien_check.world import SimulationError

T = TypeVar("T")
R = TypeVar("R")


def in_order(task: Callable[[T], R], inputs: Iterable[T], processes: int) -> Iterator[R]:
    """Yield ``task`` of each input in order; several processes work a little ahead.

    Raises:
        SimulationError: if a process dies.
    """
    # Not forked: torch and PhysX have threads. Ctrl-C is for the process that waits.
    context = multiprocessing.get_context("spawn")
    ignore = functools.partial(signal.signal, signal.SIGINT, signal.SIG_IGN)
    source = iter(inputs)
    with ProcessPoolExecutor(processes, mp_context=context, initializer=ignore) as pool:
        waiting = deque(pool.submit(task, each) for each in islice(source, 2 * processes))
        try:
            while waiting:
                result = waiting.popleft().result()
                waiting.extend(pool.submit(task, each) for each in islice(source, 1))
                yield result
        except BrokenProcessPool as error:
            raise SimulationError(f"a process of the judge has died: {error}") from None
        finally:
            pool.shutdown(cancel_futures=True)
