"""Run tasks in several processes and return their results in order."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing.connection import Connection
from typing import TypeVar

from marl_pack.sapien_check.world import SimulationError

T = TypeVar("T")
R = TypeVar("R")


def in_order(task: Callable[[T], R], inputs: Iterable[T], processes: int) -> Iterator[R]:
    """Yield the result of ``task`` for each input, in order; several processes work ahead a little.

    The processes end when this generator ends, and when the process that runs it ends in any way.

    Raises:
        SimulationError: if a process dies.
    """
    context = multiprocessing.get_context("spawn")  # not forked: torch and PhysX have threads
    reader, writer = context.Pipe(duplex=False)  # this process alone has the writer
    source = iter(inputs)
    with reader, ProcessPoolExecutor(
        processes, mp_context=context, initializer=_follow, initargs=(reader,)
    ) as pool:  # fmt: skip
        waiting = deque(pool.submit(task, each) for each in islice(source, 2 * processes))
        try:
            while waiting:
                result = waiting.popleft().result()
                waiting.extend(pool.submit(task, each) for each in islice(source, 1))
                yield result
        except BrokenProcessPool as error:
            raise SimulationError(f"a process of the judge has died: {error}") from None
        finally:
            writer.close()
            pool.shutdown(cancel_futures=True)


def _follow(reader: Connection) -> None:
    """End this process as soon as the other end of a pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that waits

    def end() -> None:
        reader.poll(None)  # nothing is ever sent
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()
