"""Measure the service: ``python -m benchmarks.service``.

The server runs as a process of its own, on the loopback address, with a file on the disk. Each
client has a bin of its own and places cartons of mixed sizes, drawn at random; when a box has no
place, it closes the bin and opens the next one. In a closed loop a client sends the next box when
it has the answer; paced, it sends one box a second. Clients and server share the machine's cores.
Then a client reads a bin while 8 others search, for 500 ms a box. Times are those that the client
waits, in milliseconds. The last row is the memory of the whole server, in MiB.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.exact import CARTONS
from benchmarks.record import Measurements

SEED = 7
CLIENTS = (1, 8, 32)
SECONDS = {"closed loop": 15.0, "one box a second": 30.0}
BINS, BOXES = 1000, 20
"""Bins that are open, and boxes in each, when the memory is measured."""
MARGIN_MM = 20.0


class Client:
    """One connection to the server, with no more work than a request needs."""

    def __init__(self, port: int) -> None:
        self.port = port

    async def connect(self) -> Client:
        """Open the connection."""
        self.reader, self.writer = await asyncio.open_connection("127.0.0.1", self.port)
        return self

    async def post(self, path: str, body: Any, method: str = "POST") -> Any:
        """Send JSON and return the answer's JSON.

        Raises:
            ValueError: if the server refuses it.
        """
        content = json.dumps(body).encode()
        self.writer.write(
            f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
            f"Content-Length: {len(content)}\r\n\r\n".encode()
            + content
        )
        head = (await self.reader.readuntil(b"\r\n\r\n")).decode().lower()
        length = int(head.partition("content-length:")[2].split("\r\n")[0])
        answer = json.loads(await self.reader.readexactly(length))
        if " 20" not in head.split("\r\n")[0]:
            raise ValueError(f"{path}: {answer}")
        return answer

    async def open(self, **arguments: Any) -> str:
        """Open a bin and return its path."""
        bin = await self.post("/bins", {"margin_mm": MARGIN_MM, **arguments})
        return f"/bins/{bin['id']}"


async def place_boxes(
    port: int, number: int, seconds: float, pause: float, **arguments: Any
) -> list[float]:
    """Place boxes for some time as one client; return the seconds that each answer took."""
    generator = np.random.default_rng((SEED, number))
    client = await Client(port).connect()
    times: list[float] = []
    path = await client.open(**arguments)
    await asyncio.sleep(pause * generator.random())
    end = due = time.perf_counter()
    end += seconds
    while due < end:
        box = {"sides": CARTONS[generator.integers(len(CARTONS))], "id": str(len(times))}
        start = time.perf_counter()
        answer = await client.post(f"{path}/place", box)
        times.append(time.perf_counter() - start)
        if not answer["placed"]:
            await client.post(f"{path}/close", {})
            path = await client.open(**arguments)
        due = max(due + pause, time.perf_counter()) if pause else time.perf_counter()
        await asyncio.sleep(max(0.0, due - time.perf_counter()))
    return times


async def load(port: int, clients: int, seconds: float, pause: float) -> dict[str, float]:
    """Return the figures of several clients at once."""
    start = time.perf_counter()
    work = [place_boxes(port, number, seconds, pause) for number in range(clients)]
    times = np.concatenate(await asyncio.gather(*work))
    return figures_of(times, time.perf_counter() - start)


async def read_bin(port: int, seconds: float) -> list[float]:
    """Read the state of a bin for some time; return the seconds that each answer took."""
    client = await Client(port).connect()
    times: list[float] = []
    path = await client.open()
    end = time.perf_counter() + seconds
    while (start := time.perf_counter()) < end:
        await client.post(path, {}, "GET")
        times.append(time.perf_counter() - start)
        await asyncio.sleep(0.02)
    return times


async def searches(port: int, clients: int, seconds: float) -> dict[str, float]:
    """Return the figures of one client that reads while others place by search."""
    start = time.perf_counter()
    work = [
        place_boxes(port, number, seconds, 0, policy="search", plan="budget=500ms")
        for number in range(clients)
    ]
    times, *_ = await asyncio.gather(read_bin(port, seconds), *work)
    return figures_of(np.array(times), time.perf_counter() - start)


def figures_of(times: NDArray[np.float64], took: float) -> dict[str, float]:
    """Return the figures of answers that took so many seconds, and all together ``took``."""
    times = times * 1000
    p50, p95, p99 = np.percentile(times, (50, 95, 99)).tolist()
    return {
        "ms_p50": p50, "ms_p95": p95, "ms_p99": p99, "ms_max": float(times.max()),
        "requests_per_second": len(times) / took, "requests": len(times),
    }  # fmt: skip


async def fill(port: int, bins: int, boxes: int) -> None:
    """Open bins and place boxes in each."""
    generator = np.random.default_rng(SEED)
    client = await Client(port).connect()
    for _ in range(bins):
        path = await client.open()
        for _ in range(boxes):
            await client.post(f"{path}/place", {"sides": CARTONS[generator.integers(len(CARTONS))]})


def memory(process: subprocess.Popen[str]) -> float:
    """Return the resident memory of a process in MiB."""
    text = Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8")
    return int(text.partition("VmRSS:")[2].split()[0]) / 1024


def start(folder: Path, options: Sequence[str] = ()) -> tuple[subprocess.Popen[str], int]:
    """Start a server and wait until it is ready; return the process and its port."""
    process = subprocess.Popen(
        [sys.executable, "-m", "marl_pack", "serve", "--data", str(folder / "bins.sqlite"),
         "--port", "0", *options],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    return process, int(process.stdout.readline().rpartition(":")[2])


def main() -> None:
    """Measure everything."""
    measured = Measurements("service", __doc__, seed=SEED)
    measured.options.add_argument("--folder", type=Path, help="folder of the server's file")
    chosen = measured.parse()
    with tempfile.TemporaryDirectory() as folder:  # compiles what is not compiled yet
        process, _ = start(Path(folder))
        process.terminate()
        process.wait()
    with tempfile.TemporaryDirectory(dir=chosen.folder) as folder:
        process, port = start(Path(folder))
        try:
            empty = memory(process)
            for kind, seconds in SECONDS.items():
                for clients in CLIENTS:
                    pause = 0.0 if kind == "closed loop" else 1.0
                    figures = asyncio.run(load(port, clients, seconds, pause))
                    name = f"{kind}, {clients} client{'s' if clients > 1 else ''}"
                    measured.keep(name, clients=clients, **figures)
            figures = asyncio.run(searches(port, 8, SECONDS["closed loop"]))
            measured.keep("reading a bin while 8 others search", clients=9, **figures)
        finally:
            process.terminate()
            process.wait()
    with tempfile.TemporaryDirectory(dir=chosen.folder) as folder:
        process, port = start(Path(folder))
        try:
            asyncio.run(fill(port, BINS, BOXES))
            measured.keep("memory", mib_empty=empty, mib_1000_bins=memory(process))
        finally:
            process.terminate()
            process.wait()


if __name__ == "__main__":
    main()
