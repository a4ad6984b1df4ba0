"""The service as a program, and a load that kills it again and again."""

from __future__ import annotations

import random
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2 as httpx

from marl_pack import Plan

CARTONS = [[600, 400, 300], [400, 300, 250], [300, 200, 120], [395, 295, 285], [500, 310, 180]]


@contextmanager
def serving(words: Sequence[str]) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A running server with a free port; yields the process and the address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "marl_pack", "serve", "--port", "0", *words],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        yield process, process.stdout.readline().removeprefix("ready: ").strip()
    finally:
        process.kill()
        process.wait()


class _Cell:
    """A client that repeats each request with its key until it is answered."""

    def __init__(self, number: int, address: list[str], stop: threading.Event) -> None:
        self.id, self.address, self.stop = f"cell-{number}", address, stop
        self.generator = random.Random(number)
        self.answers: dict[str, Any] = {}  # the first answer to each key
        self.repeated = 0
        self.wrong: list[str] = []

    def ask(self, path: str, body: Any, key: str) -> Any:
        tries = 0
        while True:
            try:
                response = httpx.post(
                    self.address[0] + path, json=body, headers={"Idempotency-Key": key}, timeout=30
                )
                break
            except httpx.TransportError:
                tries += 1
                time.sleep(0.02)
        self.repeated += tries > 0
        answer = response.json()
        if response.status_code not in (200, 201):
            self.wrong.append(f"{path} {key}: {answer}")
        if self.answers.setdefault(key, answer) != answer:
            self.wrong.append(f"{path} {key}: {answer} after {self.answers[key]}")
        return answer

    def run(self) -> None:
        self.ask("/bins", {"id": self.id, "margin_mm": 10}, self.id)
        k = 0
        while not self.stop.is_set():
            key, k = f"k{k}", k + 1
            box = {"sides": self.generator.choice(CARTONS), "id": key}
            answer = self.ask(f"/bins/{self.id}/place", box, key)
            if not answer.get("placed"):  # make room, so that the load goes on
                for j in range(5):
                    self.ask(f"/bins/{self.id}/undo", {}, f"{key}-undo{j}")
            elif self.generator.random() < 0.2:  # the same request, once more
                self.ask(f"/bins/{self.id}/place", box, key)


def killed_and_repeated(folder: Path, clients: int, kills: int, seconds: float) -> dict[str, Any]:
    """Let clients place boxes while the server is killed (SIGKILL) and started again.

    Args:
        folder: folder of the server's file.
        clients: number of clients, each with a bin of its own.
        kills: how often the server is killed.
        seconds: how long it runs each time.

    Returns:
        ``answered`` requests, ``repeated`` ones (no answer at first), ``kills``, and the ``plans``.

    Raises:
        AssertionError: if an answer was lost or changed, or a box is there twice or without answer.
    """
    data, address, stop = folder / "killed.sqlite", [""], threading.Event()
    cells = [_Cell(number, address, stop) for number in range(clients)]
    threads = [threading.Thread(target=cell.run) for cell in cells]
    for k in range(kills + 1):
        with serving(["--data", str(data)]) as (_, address[0]):
            if k == 0:
                for thread in threads:
                    thread.start()
            time.sleep(seconds)
            if k == kills:
                stop.set()
                for thread in threads:
                    thread.join()
                plans = []
                for cell in cells:
                    _check(cell)
                    plan = httpx.get(f"{address[0]}/bins/{cell.id}/plan").json()
                    _check_boxes(cell, plan)
                    plans.append(Plan.of_dict(plan, cell.id))
    return {
        "answered": sum(len(cell.answers) for cell in cells),
        "repeated": sum(cell.repeated for cell in cells), "kills": kills, "plans": plans,
    }  # fmt: skip


def _check(cell: _Cell) -> None:
    assert not cell.wrong, cell.wrong[:3]
    steps = [
        answer["step"] for answer in cell.answers.values() if answer.get("placed") is not False
    ]
    assert steps == list(range(len(steps))), "a change was lost or done twice"


def _check_boxes(cell: _Cell, plan: dict[str, Any]) -> None:
    """The plan has exactly the boxes whose placement was answered and not undone."""
    expected: list[str] = []
    for key, answer in cell.answers.items():
        if answer.get("placed"):
            expected.append(key)
        elif "undone" in answer:
            expected.pop()
    assert [box["id"] for box in plan["boxes"]] == expected
    for box in plan["boxes"]:
        answer = cell.answers[box["id"]]
        for name in ("x", "y", "z", "w", "d", "h", "orientation"):
            assert box[name] == answer[name], (box["id"], name)
