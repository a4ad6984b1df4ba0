"""The service under random requests: good, bad, repeated and after restarts."""

from __future__ import annotations

import json
import logging
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from starlette.testclient import TestClient

from marl_pack import Plan
from marl_pack.service.app import make_app
from marl_pack.service.limits import ServiceLimits
from marl_pack.service.service import Service
from marl_pack.service.store import Store

from .packer import check_plan

Generator = np.random.Generator
SIDES = [[60, 40, 30], [40, 30, 25], [30, 20, 12], [39.5, 29.5, 28.5], [50, 31, 18], [99, 9, 9]]
ACTIONS = ("place",) * 8 + ("offer", "actual", "actual", "undo", "restart", "read", "list")
BAD_VALUES = (
    "NaN", "Infinity", "-1e400", "1" * 400, "1" * 5000, "[" * 20_000, '"\\ud800"', '"\\u0000"',
    "null", "true", '"x"', "[]", "{}", "[1]", "-1", "0.123456789", '{"a": 1, "a": 2}',
    '"' + "x" * 300 + '"', "1e308", "-0.0", "18446744073709551616", "",
    "'", "\x00", "\ufeff1", '"\ud7ff"', "{",
)  # fmt: skip
"""Values that no key of a body may have, or that only few may have."""
NEVER = {
    "sides": {"-1", "true", '"x"', "[]", "{}", "[1]", "1e308", "0.123456789"},
    "weight": {"-1", "true", '"x"', "[]", "{}", "[1]"},
    "upright": {"-1", '"x"', "[]", "{}", "[1]", "0.123456789"},
    "orientations": {"-1", "true", '"x"', "[]", "{}", "0.123456789"},
    "step": {"-1", "true", '"x"', "[]", "{}", "[1]", "0.123456789", "18446744073709551616"},
    "id": {"true", "[]", "{}", "[1]", "0.123456789"},
    "x": {"true", '"x"', "[]", "{}", "[1]", "1e308", "null"},
    "policy": {"true", '"x"', "[]", "{}", "[1]", "-1", "null", '"\\u0000"'},
    "bin_mm": {"true", '"x"', "[]", "{}", "[1]", "-1", "null", "1e308"},
    "present": {"true", '"x"', "[]", "{}", "[1]", "-1"},
    "wieght": {"1", "null", "-1", "true"},
}
"""For each key values that must be refused."""
NO_JSON = {"NaN", "Infinity", "1" * 5000, "[" * 20_000, '"\\ud800"', '{"a": 1, "a": 2}', "", "'",
           "\x00", "\ufeff1", "{"}  # fmt: skip


class _Session:
    """A service, and what its one bin has to be like."""

    def __init__(self, folder: Path, generator: Generator) -> None:
        self.path, self.generator = folder / "bins.sqlite", generator
        self.boxes: list[tuple[str, dict[str, Any]]] = []  # each change: what, and the answer
        self.step, self.keys = 0, 0
        self.done: list[tuple[str, bytes, str, str]] = []  # action, body, key, answer
        self.begin()

    def begin(self) -> None:
        service = Service(Store(self.path), ServiceLimits(in_memory=2))
        self.client = TestClient(make_app(service), "http://localhost")
        self.client.__enter__()

    def end(self) -> None:
        self.client.__exit__(None, None, None)

    def send(self, path: str, body: bytes, key: str = "", **headers: str) -> tuple[int, Any]:
        headers = {"Content-Type": "application/json", **headers}
        if key:
            headers["Idempotency-Key"] = key
        answer = self.client.post(path, content=body, headers=headers)
        assert answer.status_code < 500, f"{path}: {body[:200]!r}: {answer.text}"
        content = answer.json()
        if answer.status_code >= 400:
            assert set(content) == {"error"}, content
            assert set(content["error"]) == {"code", "message"}, content
            assert len(content["error"]["message"].splitlines()) == 1, content
        return answer.status_code, content

    def get(self, path: str) -> Any:
        answer = self.client.get(path)
        assert answer.status_code == 200, f"{path}: {answer.text}"
        return answer.json()

    def check(self) -> None:
        """The bin is what the answers said."""
        state, plan = self.get("/bins/a"), self.get("/bins/a/plan")
        placed: dict[str, dict[str, Any]] = {answer["id"]: answer for _, answer in self.boxes}
        assert state["step"] == self.step, "step"
        assert [box["id"] for box in plan["boxes"]] == list(placed), "boxes"
        for box, answer in zip(plan["boxes"], placed.values(), strict=True):
            assert all(abs(box[k] - answer[k]) < 1e-9 for k in "xyzwdh"), "poses"

    def good(self) -> None:
        """Send a request that is right, sometimes twice."""
        generator = self.generator
        action = ACTIONS[generator.integers(len(ACTIONS))]
        if action == "restart":
            self.end()
            self.begin()
            return
        if action in ("read", "list"):
            self.get("/bins/a" if action == "read" else "/bins?limit=1")
            return
        body: dict[str, Any] = {}
        if action in ("place", "offer"):
            body = {"sides": SIDES[generator.integers(len(SIDES))], "id": f"b{self.keys}"}
        if action == "actual":
            if not self.boxes:
                return
            x, y, _ = self.boxes[-1][1]["centre"]
            x, y = x + generator.uniform(-0.5, 0.5), y + generator.uniform(-0.5, 0.5)
            body = {"x": round(x, 3), "y": round(y, 3), "yaw": round(generator.uniform(-1, 1), 2)}
        if generator.random() < 0.3:
            body["step"] = self.step
        self.keys += 1
        key = f"k{self.keys}" if action != "offer" and generator.random() < 0.7 else ""
        content = json.dumps(body).encode()
        status, answer = self.send(f"/bins/a/{action}", content, key)
        changed = status == 200 and action != "offer" and answer.get("placed") is not False
        self.step += changed
        if status == 200:
            assert answer["step"] == self.step, "step of an answer"
        if changed and action == "undo":
            self.boxes.pop()
        elif changed:
            self.boxes.append((action, answer))
        if key and status == 200:
            self.done.append((action, content, key, json.dumps(answer)))
        if self.done and generator.random() < 0.3:
            action, content, key, first = self.done[generator.integers(len(self.done))]
            assert json.dumps(self.send(f"/bins/a/{action}", content, key)[1]) == first, "repeated"
            assert self.send(f"/bins/a/{action}", content[:-1] + b', "step": 77}', key)[0] >= 400

    def bad(self) -> None:
        """Send a request that is wrong, or strange."""
        from .program import WronglyAcceptedError

        generator = self.generator
        key = list(NEVER)[generator.integers(len(NEVER))]
        value = BAD_VALUES[generator.integers(len(BAD_VALUES))]
        kind = "/bins" if key in ("policy", "bin_mm", "present") else "/bins/a/offer"
        kind = "/bins/a/actual" if key == "x" else kind
        others = {
            "/bins": "",
            "/bins/a/offer": '"sides": [1, 2, 3], ',
            "/bins/a/actual": '"y": 1, ',
        }
        start = "" if key == "sides" else others[kind]
        body = f'{{{start}"{key}": {value}}}'.encode("utf-8", "surrogatepass")
        status, answer = self.send(kind, body)
        if status < 400 and (value in NEVER[key] or value in NO_JSON or key == "wieght"):
            raise WronglyAcceptedError(f"{kind}: {body[:200]!r}: {answer}")
        cut = body[: generator.integers(len(body))]
        if cut and self.send(kind, cut)[0] < 400:
            raise WronglyAcceptedError(f"{kind}: {cut[:200]!r}")
        noise = bytearray(body)
        for _ in range(generator.integers(1, 4)):
            noise[generator.integers(len(noise))] = generator.integers(256)
        if kind != "/bins/a/actual":
            self.send(kind, bytes(noise))
        name = bytes(generator.integers(33, 127, 8).tolist()).decode().replace("/", "_")
        assert self.client.get(f"/bins/{name}").status_code in (200, 404)


def case_of(seed: list[int]) -> None:
    """Send random requests and check what they did.

    Raises:
        AssertionError: if an answer is wrong, or the service fails.
        WronglyAcceptedError: if a bad request is taken.
    """
    logging.disable()
    generator = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        session = _Session(Path(folder), generator)
        try:
            policy = str(generator.choice(["max_contact", "linear", "random", "dblf"]))
            body = {"id": "a", "bin_mm": [100, 80, 70], "policy": policy, "clearance_mm": 2}
            assert session.send("/bins", json.dumps(body).encode())[0] == 201
            for _ in range(30):
                session.good() if generator.random() < 0.7 else session.bad()
            session.check()
            session.end()
            session.begin()
            session.check()
            check_plan(Plan.of_dict(session.get("/bins/a/plan"), "plan"), 0.1, 0.0)
        finally:
            session.end()


def cases(seed: int) -> Iterator[tuple[str, Callable[[], None]]]:
    """Yield sessions without end: a name, and a function that plays and checks one."""
    for part in range(10**9):
        yield f"service {seed}-{part}", lambda part=part: case_of([seed, part])
