"""The service: its answers, its file, its door, and the program."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import httpx2 as httpx
import jsonschema
import numpy as np
import pytest
from fuzz.packer import check_plan
from service_program import killed_and_repeated, serving
from starlette.testclient import TestClient

import marl_pack
from marl_pack import Packer, Plan, serve
from marl_pack.exact.spec import ExactSpec
from marl_pack.packer.calls import BOX_ATTRIBUTES
from marl_pack.service import models
from marl_pack.service.app import make_app
from marl_pack.service.limits import ServiceLimits
from marl_pack.service.refusals import CODES
from marl_pack.service.service import Service
from marl_pack.service.store import Store, StoreError

CARTONS = [[600, 400, 300], [400, 300, 250], [300, 200, 120], [395, 295, 285], [500, 310, 180]]
SCHEMA = json.loads((Path(marl_pack.__file__).parent / "plan.schema.json").read_text())
TOKEN = "0123456789abcdef"


@contextmanager
def client_of(
    path: Path, token: str | None = None, policies: tuple[str, ...] = (), **limits: Any
) -> Iterator[TestClient]:
    """A client of a service with a file; the service is closed at the end."""
    service = Service(Store(path), ServiceLimits(**limits), policies)
    with TestClient(
        make_app(service, token), "http://localhost", raise_server_exceptions=False
    ) as client:
        client.service = service  # type: ignore[attr-defined]  # for tests that look inside
        yield client


@pytest.fixture
def client(tmp_path: Path) -> Iterator[TestClient]:
    with client_of(tmp_path / "bins.sqlite") as client:
        yield client


def done(response: httpx.Response, status: int = 200) -> Any:
    assert response.status_code == status, response.text
    return response.json()


def error(response: httpx.Response) -> tuple[int, str, str]:
    """Status, code and message of a refused request; every error has the same form."""
    content = response.json()
    assert set(content) == {"error"}
    assert set(content["error"]) == {"code", "message"}
    code, message = content["error"]["code"], content["error"]["message"]
    assert len(message.splitlines()) == 1
    if code in CODES:
        assert CODES[code][0] == response.status_code
    return response.status_code, code, message


def as_json(value: Any) -> Any:
    return json.loads(json.dumps(value))


def keyed(key: str) -> dict[str, str]:
    return {"Idempotency-Key": key}


# --- a session ------------------------------------------------------------------------------------


def test_answers_and_plan_are_those_of_a_packer(client: TestClient) -> None:
    options = {"bin_mm": [800, 600, 500], "margin_mm": 15.0, "max_weight_kg": 300}
    options["clearance_mm"] = 10
    done(client.post("/bins", json={"id": "a", "policy": "linear", **options}), 201)
    packer = Packer(policy="linear", **options)  # type: ignore[arg-type]  # options by name
    generator, step = np.random.default_rng(1), 0
    poses = 0

    def asked(action: str, body: Any) -> Any:
        return done(client.post(f"/bins/a/{action}", json=body))

    for k in range(25):
        box = {"sides": CARTONS[generator.integers(len(CARTONS))], "id": f"b{k}", "weight": 4.5}
        expected = as_json(packer.offer(**box).to_dict())
        assert asked("offer", box) == {**expected, "step": step}
        expected = as_json(packer.place(**box).to_dict())
        step += expected["placed"]
        assert asked("place", box) == {**expected, "step": step}
        if expected["placed"] and k % 3 == 0:
            x, y, _ = expected["centre"]
            poses, step = poses + 1, step + 1
            expected = as_json(packer.actual((x, y, 0.4)).to_dict())
            assert asked("actual", {"x": x, "y": y, "yaw": 0.4, "id": f"b{k}"}) == {
                **expected, "step": step,
            }  # fmt: skip
        if k % 7 == 6:
            packer.undo()
            step += 1
            assert asked("undo", {})["step"] == step
    assert poses > 3
    plan = done(client.get("/bins/a/plan"))
    jsonschema.validate(plan, SCHEMA)
    assert plan == as_json(packer.plan.to_dict())
    state = done(client.get("/bins/a"))
    assert (state["step"], state["boxes"]) == (step, len(packer.placements))
    assert state["utilization"] == packer.state.utilization[0]
    assert state["policy"] == "linear"
    assert done(client.post("/bins/a/close")) == {
        "closed": True, "boxes": len(packer.placements), "step": step + 1,
    }  # fmt: skip
    for action in ("place", "offer", "undo", "close", "actual"):
        body: Any = {"sides": [10, 10, 10]} if action in ("place", "offer") else {}
        body = {"x": 1, "y": 1} if action == "actual" else body
        assert error(client.post(f"/bins/a/{action}", json=body))[:2] == (409, "closed")
    assert done(client.get("/bins/a/plan")) == plan


def test_bins_are_listed_in_pages(client: TestClient) -> None:
    ids = [done(client.post("/bins"), 201)["id"] for _ in range(5)]
    assert len(set(ids)) == 5
    done(client.post(f"/bins/{ids[1]}/close"))
    seen: list[dict[str, Any]] = []
    after = None
    while True:
        page = done(client.get("/bins", params={"limit": 2, **({"after": after} if after else {})}))
        seen += page["bins"]
        after = page["next"]
        if after is None:
            break
    assert [bin["id"] for bin in seen] == ids
    assert [bin["closed"] for bin in seen] == [False, True, False, False, False]
    assert [bin["step"] for bin in seen] == [0, 1, 0, 0, 0]


def test_a_bin_may_begin_with_boxes(client: TestClient) -> None:
    packer = Packer((800, 600, 500))
    packer.place((400, 300, 250), id="old", weight=3)
    present = packer.plan.to_dict()
    done(client.post("/bins", json={"id": "a", "bin_mm": [800, 600, 500], "present": present}), 201)
    assert error(client.post("/bins/a/undo"))[:2] == (409, "nothing_done")
    assert error(client.post("/bins/a/actual", json={"x": 200, "y": 150}))[1] == "nothing_done"
    assert done(client.post("/bins/a/place", json={"sides": [400, 300, 250]}))["placed"]
    assert done(client.get("/bins/a"))["boxes"] == 2


def test_a_box_without_a_place_changes_nothing(client: TestClient) -> None:
    done(client.post("/bins", json={"id": "a", "bin_mm": [100, 100, 100], "max_boxes": 1}), 201)
    answer = done(client.post("/bins/a/place", json={"sides": [101, 10, 10], "id": "x"}))
    assert (answer["placed"], answer["code"], answer["step"]) == (False, "too_large", 0)
    assert "inches" not in answer["reason"]
    assert done(client.post("/bins/a/place", json={"sides": [10, 10, 10]}))["placed"]
    assert done(client.post("/bins/a/place", json={"sides": [10, 10, 10]}))["code"] == "full"


# --- requests that are refused --------------------------------------------------------------------

BAD = [
    ("/bins", '{"policy": "/etc/passwd"}', "impossible", "needs one of dblf"),
    ("/bins", '{"policy": "my.py:policy"}', "impossible", "needs one of dblf"),
    ("/bins", '{"policy": "max_contct"}', "impossible", "did you mean 'max_contact'"),
    ("/bins", '{"policy": "search", "plan": "budget=5s"}', "impossible", "at most 1000 ms"),
    ("/bins", '{"policy": "search", "plan": "budgt=5s"}', "impossible", "needs budget=500ms"),
    ("/bins", '{"plan": "budget=5ms"}', "impossible", "plan: needs the policy search"),
    ("/bins", '{"catalogue": "goods.csv"}', "impossible", "unknown key 'catalogue'"),
    ("/bins", '{"id": "../x"}', "impossible", "id: needs letters, digits"),
    ("/bins", '{"id": "a"}', "exists", "there is a bin with this id already"),
    ("/bins", '{"bin_mm": [1200, 800]}', "impossible", "bin_mm.2: is missing"),
    ("/bins", '{"bin_mm": [1200, 800, 0]}', "impossible", "needs three lengths in millimetres > 0"),
    ("/bins", '{"margin_mm": "20"}', "impossible", "margin_mm: input should be a valid number"),
    ("/bins", '{"margin_m": 20}', "impossible", "unknown key 'margin_m'; did you mean 'margin_mm'"),
    ("/bins", '{"rule": "hull"}', "impossible", "'hull'"),
    ("/bins", '{"max_boxes": 1000}', "impossible", "this server allows at most 256"),
    ("/bins", '{"seed": -1}', "impossible", "seed: input should be greater than or equal to 0"),
    ("/bins", '{"grid_mm": 50}', "impossible", "only agents trained on cells see a grid"),
    ("/bins", '{"present": {"boxes": []}}', "impossible", "present: not a plan in JSON"),
    ("/bins", "[]", "impossible", "body: input should be a valid dictionary"),
    ("/bins/nowhere/place", '{"sides": [10, 10, 10]}', "unknown_bin", "there is no such bin"),
    ("/bins/a/place", "", "impossible", "body: is missing"),
    ("/bins/a/place", "{}", "impossible", "sides: is missing"),
    ("/bins/a/place", '{"sides": [1, 2]}', "impossible", "sides.2: is missing"),
    (
        "/bins/a/place",
        '{"sides": [10, 20, 0]}',
        "impossible",
        "zero or negative",
    ),
    ("/bins/a/place", '{"sides": [10, 20, 0.05]}', "impossible", "whole units of 0.1 mm"),
    ("/bins/a/place", '{"sides": [1, 2, true]}', "impossible", "valid number, not true"),
    ("/bins/a/place", '{"sides": [1, 2, "3"]}', "impossible", 'valid number, not "3"'),
    ("/bins/a/place", '{"sides": [1, 2, 1e999]}', "impossible", "finite number"),
    ("/bins/a/place", '{"sides": [10, 20, 30], "weight": -1}', "impossible", "weight"),
    ("/bins/a/place", '{"sides": [1, 2, 3], "weigth": 1}', "impossible", "did you mean 'weight'"),
    ("/bins/a/place", '{"sides": [10, 20, 30], "orientations": [6]}', "impossible", "0 … 5"),
    ("/bins/a/place", '{"sides": [1, 2, 3], "step": 4}', "wrong_step", "the bin is at step 1"),
    (
        "/bins/a/place",
        '{"sides": [1, 2, 3], "id": "' + 201 * "x" + '"}',
        "impossible",
        "id: string should have",
    ),
    ("/bins/a/place", '{"sides": [1, 2, NaN]}', "not_json", "NaN is not a number"),
    ("/bins/a/place", '{"sides": [1, 2, -Infinity]}', "not_json", "-Infinity is not a number"),
    ("/bins/a/place", '{"sides": [1, 2, 3], "sides": [10, 20, 30]}', "not_json", "is given twice"),
    ("/bins/a/place", '{"sides": [1, 2, ' + 5000 * "9" + "]}", "not_json", "thousands of digits"),
    ("/bins/a/place", '{"sides": [1, 2, ' + 400 * "9" + "]}", "impossible", "valid number"),
    ("/bins/a/place", '{"sides": ' + 20_000 * "[" + 20_000 * "]" + "}", "not_json", "too deeply"),
    ("/bins/a/place", '{"sides": [1, 2, 3], "id": "\\ud800"}', "not_json", "not Unicode"),
    ("/bins/a/place", '{"sides": [1, 2', "not_json", "Expecting"),
    ("/bins/a/place", "{" + 300_000 * " " + "}", "too_large", "at most 262144 bytes"),
    ("/bins/a/actual", '{"x": 1}', "impossible", "y: is missing"),
    ("/bins/a/actual", '{"x": 1, "y": 1}', "impossible_pose", "would reach out of the bin"),
    ("/bins/a/actual", '{"x": 200, "y": 150, "yaw": 46}', "impossible", "degrees from -45 to 45"),
    ("/bins/a/actual", '{"x": 200, "y": 150, "id": "b"}', "other_box", "placed last is 'first'"),
    ("/bins/a/undo", '{"step": 0}', "wrong_step", "the bin is at step 1"),
    ("/nothing", "{}", "not_found", "there is no such page"),
    ("/health", "{}", "wrong_method", "the page takes GET only"),
]
"""Path and body of requests, and what the answer says."""


@pytest.mark.parametrize(("path", "body", "code", "message"), BAD)
def test_a_bad_request_says_what_would_be_right(
    path: str, body: str, code: str, message: str, client: TestClient
) -> None:
    done(client.post("/bins", json={"id": "a"}), 201)
    done(client.post("/bins/a/place", json={"sides": [400, 300, 250], "id": "first"}))
    before = done(client.get("/bins/a")), done(client.get("/bins/a/plan"))
    headers = {"Content-Type": "application/json"}
    refused = client.post(path, content=body, headers=headers)
    assert error(refused)[1] == code
    assert message in error(refused)[2]
    assert refused.status_code == CODES[code][0]
    assert (done(client.get("/bins/a")), done(client.get("/bins/a/plan"))) == before


def test_other_requests_that_are_refused(client: TestClient) -> None:
    assert error(client.post("/bins", content="{}", headers={"Content-Type": "text/plain"})) == (
        415, "wrong_type", "Content-Type 'text/plain': needs application/json",
    )  # fmt: skip
    assert error(client.post("/bins", content="{}"))[1] == "wrong_type"
    chunks = (b" " * 10_000 for _ in range(40))
    headers = {"Content-Type": "application/json"}  # and no Content-Length
    assert error(client.post("/bins", content=chunks, headers=headers))[1] == "too_large"
    assert error(client.get("/bins", params={"after": "nowhere"}))[1] == "unknown_bin"
    assert error(client.get("/bins", params={"limit": 0}))[1] == "impossible"
    assert error(client.post("/bins", headers=keyed("k" * 201)))[1] == "impossible"
    assert error(client.delete("/bins"))[1] == "wrong_method"
    for page in ("", "/plan"):
        assert error(client.get(f"/bins/nowhere{page}"))[1] == "unknown_bin"


def test_limits_are_named(tmp_path: Path) -> None:
    with client_of(tmp_path / "a.sqlite", max_bins=2, max_boxes=3, max_steps=4) as client:
        for id in "ab":
            done(client.post("/bins", json={"id": id}), 201)
        assert error(client.post("/bins"))[1:] == (
            "too_many_bins", "2 bins are open, as many as may be (max_bins); close one first",
        )  # fmt: skip
        for _ in range(2):
            assert done(client.post("/bins/a/place", json={"sides": [100, 100, 100]}))["placed"]
            done(client.post("/bins/a/undo"))
        refused = error(client.post("/bins/a/place", json={"sides": [100, 100, 100]}))
        assert refused[:2] == (409, "too_many_steps")
        assert "max_steps" in refused[2]
        done(client.post("/bins/a/close"))
        done(client.post("/bins"), 201)
        for k in range(4):
            answer = done(client.post("/bins/b/place", json={"sides": [100, 100, 100]}))
            assert answer["placed"] == (k < 3)
        assert answer["code"] == "full"


# --- idempotency and order ------------------------------------------------------------------------


def test_the_same_key_gets_the_same_answer(client: TestClient) -> None:
    opened = client.post("/bins", json={"bin_mm": [500, 500, 500]}, headers=keyed("k"))
    again = client.post("/bins", json={"bin_mm": [500, 500, 500]}, headers=keyed("k"))
    assert done(again, 201) == done(opened, 201)
    assert "idempotent-replayed" not in opened.headers
    assert again.headers["idempotent-replayed"] == "true"
    assert error(client.post("/bins", headers=keyed("k")))[:2] == (422, "key_reused")
    path = f"/bins/{opened.json()['id']}"

    def twice(action: str, body: Any, key: str) -> Any:
        first = client.post(f"{path}/{action}", json=body, headers=keyed(key))
        second = client.post(f"{path}/{action}", json=body, headers=keyed(key))
        assert first.json() == second.json()
        assert second.headers["idempotent-replayed"] == "true"
        return done(first)

    placed = twice("place", {"sides": [400, 300, 250]}, "1")
    assert (placed["placed"], placed["step"]) == (True, 1)
    assert twice("place", {"sides": [600, 300, 250]}, "2")["placed"] is False
    assert twice("actual", {"x": 210, "y": 160}, "3")["step"] == 2
    assert twice("undo", {}, "4")["undone"] == "actual"
    assert twice("undo", {}, "5")["undone"] == "place"
    # The key of a call that was undone still gets its answer, and places nothing.
    assert twice("place", {"sides": [400, 300, 250]}, "1") == placed
    assert done(client.get(path))["boxes"] == 0
    for action, body in (("place", {"sides": [400, 300, 251]}), ("undo", {})):
        refused = client.post(f"{path}/{action}", json=body, headers=keyed("1"))
        assert error(refused)[:2] == (422, "key_reused")
    assert twice("close", {}, "6")["closed"] is True
    # A key belongs to its bin.
    other = done(client.post("/bins"), 201)["id"]
    answer = client.post(f"/bins/{other}/place", json={"sides": [9, 9, 9]}, headers=keyed("1"))
    assert done(answer)["step"] == 1


def test_a_key_that_comes_many_times_at_once_places_once(client: TestClient) -> None:
    done(client.post("/bins", json={"id": "a"}), 201)
    box = {"sides": [300, 200, 120], "id": "x"}
    with ThreadPoolExecutor(16) as pool:
        answers = list(
            pool.map(
                lambda k: client.post("/bins/a/place", json=box, headers=keyed(f"{k % 2}")),
                range(32),
            )
        )
        opened = list(
            pool.map(lambda _: client.post("/bins", json={"id": "b"}, headers=keyed("b")), range(8))
        )
    assert {answer.status_code for answer in answers} == {200}
    assert len({answer.text for answer in answers}) == 2
    assert sum("idempotent-replayed" not in answer.headers for answer in answers) == 2
    assert done(client.get("/bins/a"))["boxes"] == 2
    assert {answer.status_code for answer in opened} == {201}
    assert len(done(client.get("/bins"))["bins"]) == 2


SLOW = """
import time
from pathlib import Path
from marl_pack.exact.policies import make_exact_policy

chosen, go = make_exact_policy("max_contact"), Path({path!r})

def policy(turn):
    while not go.exists():
        time.sleep(0.001)
    return chosen(turn)
"""
"""A policy that thinks until a file exists."""


def wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)


def test_nobody_waits_while_a_policy_thinks_except_for_its_own_bin(tmp_path: Path) -> None:
    go, code = tmp_path / "go", tmp_path / "slow.py"
    code.write_text(SLOW.format(path=str(go)))
    slow = f"{code}:policy"
    with client_of(tmp_path / "a.sqlite", policies=(slow,)) as client:
        done(client.post("/bins", json={"id": "slow", "policy": slow}), 201)
        done(client.post("/bins", json={"id": "fast"}), 201)
        bin = client.service._bin("slow")  # type: ignore[attr-defined]  # as in client_of
        with ThreadPoolExecutor(8) as pool:
            try:
                waiting = []
                for k in range(6):  # one after the other, so that their order is known
                    box = {"sides": [100 + k, 100, 100], "id": str(k)}
                    waiting.append(pool.submit(client.post, "/bins/slow/place", json=box))
                    wait_until(lambda k=k: len(bin.turn._waiters or ()) == k and bin.turn.locked())
                assert done(client.get("/health"))["status"] == "ok"
                assert done(client.get("/bins/slow"))["boxes"] == 0
                assert done(client.get("/bins/slow/plan"))["boxes"] == []
                assert done(client.post("/bins/fast/place", json={"sides": [9, 9, 9]}))["placed"]
                assert not any(future.done() for future in waiting)
            finally:
                go.touch()
            steps = [done(future.result())["step"] for future in waiting]
        assert steps == [1, 2, 3, 4, 5, 6]
        plan = Plan.of_dict(done(client.get("/bins/slow/plan")), "plan")
        assert plan.ids == ("0", "1", "2", "3", "4", "5")


# --- the file -------------------------------------------------------------------------------------


def test_bins_come_back_from_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    box = {"sides": [300, 200, 120], "weight": 2.0}
    options = {"clearance_mm": 10, "policy": "linear"}
    with client_of(path, in_memory=1) as client:
        for id in "ab":
            done(client.post("/bins", json={"id": id, **options}), 201)
        for k in range(6):
            for id in "ab":  # in turns, so that each time the bin is made again
                answer = done(client.post(f"/bins/{id}/place", json=box, headers=keyed(str(k))))
        done(client.post("/bins/a/undo"))
        x, y, _ = answer["centre"]
        done(client.post("/bins/b/actual", json={"x": x, "y": y + 1, "yaw": 0.5}))
        done(client.post("/bins/b/close"))
        urls = [f"/bins/{id}{page}" for id in "ab" for page in ("", "/plan")] + ["/bins"]
        before = [done(client.get(url)) for url in urls]
        assert len(client.service._bins) <= 2  # type: ignore[attr-defined]  # as in client_of
    with client_of(path) as client:
        assert [done(client.get(url)) for url in urls] == before
        assert done(client.post("/bins/a/place", json=box, headers=keyed("5")))["step"] == 6
        assert done(client.post("/bins/a/place", json=box, headers=keyed("9")))["step"] == 8
        assert error(client.post("/bins/b/undo"))[1] == "closed"
        packer = Packer(**options)  # type: ignore[arg-type]  # options by name
        for _ in range(6):
            packer.place(**box)
        assert done(client.get("/bins/a/plan")) == as_json(packer.plan.to_dict())


def test_a_full_disk_changes_nothing(tmp_path: Path) -> None:
    with client_of(tmp_path / "a.sqlite") as client:
        done(client.post("/bins", json={"id": "a"}), 201)
        done(client.post("/bins/a/place", json={"sides": [400, 300, 250]}))
        file = client.service.store._file  # type: ignore[attr-defined]  # as in client_of
        (pages,) = file.execute("PRAGMA page_count").fetchone()
        file.execute(f"PRAGMA max_page_count = {pages}")
        box = {"sides": [300, 200, 100], "id": 200 * "x"}
        answers = []
        for k in range(100):
            response = client.post("/bins/a/place", json=box, headers=keyed(str(k)))
            answers.append(response)
            if response.status_code != 200:
                break
        assert error(response)[:2] == (503, "storage")
        assert "full" in error(response)[2]
        boxes = 1 + sum(answer.status_code == 200 for answer in answers)
        assert done(client.get("/bins/a"))["boxes"] == boxes
        assert error(client.post("/bins/a/undo", json={}, headers=keyed(200 * "u")))[0] in (
            200,
            503,
        )
        file.execute(f"PRAGMA max_page_count = {10**6}")
        response = client.post("/bins/a/place", json=box, headers=keyed(str(k)))
        assert "idempotent-replayed" not in response.headers
        assert done(response)["placed"]


def make_foreign(path: Path) -> None:
    with closing(sqlite3.connect(path)) as file:
        file.execute("CREATE TABLE stock (name TEXT)")


def make_damaged(path: Path) -> None:
    Store(path).close()
    content = bytearray(path.read_bytes())
    content[4096:] = os.urandom(len(content) - 4096)
    path.write_bytes(content)


def make_newer(path: Path) -> None:
    Store(path).close()
    with closing(sqlite3.connect(path)) as file:
        file.execute("PRAGMA user_version = 9")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: path.write_text("no database, but a text of some length\n" * 100), "not a"),
        (make_foreign, "belongs to another program"),
        (make_damaged, "damaged|not a readable"),
        (make_newer, "has version 9; needs 1"),
        (lambda path: path.mkdir(), "is a folder|directory"),
    ],
)
def test_a_wrong_file_is_refused_at_the_door(
    make: Callable[[Path], Any], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.sqlite"
    make(path)
    with pytest.raises(SystemExit) as ended:
        serve.main(["--data", str(path), "--port", "0"])
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(f"a.sqlite: .*({message})", line)


def test_a_file_in_use_is_refused(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.sqlite")
    code = "import sys; from marl_pack import serve; serve.main(sys.argv[1:])"
    words = [sys.executable, "-c", code, "--data", str(tmp_path / "a.sqlite"), "--port", "0"]
    result = subprocess.run(words, capture_output=True, text=True, timeout=60)
    store.close()
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    assert line.endswith("a.sqlite: another program is using this file")


def test_requests_that_wait_share_a_commit(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.sqlite")
    commits = []
    store._file.set_trace_callback(lambda text: commits.append(text) if text == "COMMIT" else None)
    with ThreadPoolExecutor(8) as pool:
        with store._lock:
            work = [pool.submit(store.add_bin, str(k), "now", "{}", "{}", None) for k in range(8)]
            wait_until(lambda: len(store._waiting) == 8)
        for each in work:
            each.result()
    assert len(commits) == 1
    assert store.count_open() == 8
    store.close()


def test_a_write_that_fails_fails_for_all_that_share_the_commit(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.sqlite")
    texts: list[Any] = ["1", "2", "\ud800", "4"]  # the third cannot be stored
    with ThreadPoolExecutor(4) as pool:
        with store._lock:
            work = [pool.submit(store.add_bin, text, "now", "{}", "{}", None) for text in texts]
            wait_until(lambda: len(store._waiting) == 4)
        for each in work:
            with pytest.raises(StoreError, match="cannot be written"):
                each.result()
    assert store.count_open() == 0
    store.add_bin("1", "now", "{}", "{}", None)
    store.close()


# --- the door -------------------------------------------------------------------------------------


def test_a_token_opens_the_door(tmp_path: Path) -> None:
    with client_of(tmp_path / "a.sqlite", TOKEN) as client:
        refused = client.get("/bins")
        assert error(refused)[:2] == (401, "unauthorized")
        assert refused.headers["www-authenticate"].startswith('Bearer, Basic realm="marl_pack"')
        wrong: list[Any] = [
            {"Authorization": value}
            for value in ("Bearer", f"Bearer {TOKEN}x", f"Bearer {TOKEN[:-1]}", "Basic !",
                          "Basic Og==", f"Token {TOKEN}", "Bearer é")
        ]  # fmt: skip
        for headers in wrong:
            encoded = {key: value.encode("latin-1") for key, value in headers.items()}
            assert error(client.get("/bins", headers=encoded))[1] == "unauthorized"
        assert done(client.get("/bins", headers={"Authorization": f"Bearer {TOKEN}"}))
        assert done(client.get("/bins", auth=("anyone", TOKEN)))
        assert done(client.get("/health"))["status"] == "ok"
        assert error(client.get("/docs"))[0] == 401
        assert (
            client.get("/docs", auth=("", TOKEN), headers={"Host": "cell.example"}).status_code
            == 200
        )


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1:8000", "[::1]:8000", "LOCALHOST:1"])
def test_addresses_of_this_machine_are_served(host: str, client: TestClient) -> None:
    assert done(client.get("/bins", headers={"Host": host}))


@pytest.mark.parametrize("host", ["evil.example", "localhost.a.example", "10.0.0.1", "", "[::2]"])
def test_other_hosts_are_refused_without_a_token(host: str, client: TestClient) -> None:
    assert error(client.get("/bins", headers={"Host": host}))[:2] == (403, "foreign_host")


def test_pages_of_other_sites_are_refused(client: TestClient) -> None:
    for origin in ("http://evil.example", "null", "http://localhost:1"):
        refused = client.post("/bins", headers={"Origin": origin})
        assert error(refused)[:2] == (403, "foreign_origin")
    done(client.post("/bins", headers={"Origin": "http://localhost"}), 201)


# --- the description ------------------------------------------------------------------------------


def test_the_bodies_have_the_keys_of_the_packer() -> None:
    assert set(models.Box.model_fields) == {"sides", "order", "step", *BOX_ATTRIBUTES}
    options = {each.name for each in fields(ExactSpec)} - set(models.LEFT_OUT)
    own = {"id", "policy", "plan", "grid_mm", "seed", "present", "explain"}
    assert set(models.OpenBin.model_fields) == options | own


def test_the_description_is_complete_and_needs_no_network(client: TestClient) -> None:
    description = done(client.get("/openapi.json"))
    assert set(description["paths"]) == {
        "/health", "/bins", "/bins/{id}",
        *(f"/bins/{{id}}/{page}" for page in (
            "offer", "place", "actual", "undo", "close", "plan", "replay", "replay.json")),
    }  # fmt: skip
    schemas = description["components"]["schemas"]
    for name in ("Box", "Actual", "OpenBin", "Placed", "NotPlaced", "State"):
        for example in schemas[name]["examples"]:
            whole = {**schemas[name], "components": description["components"]}
            jsonschema.validate(example, whole)
    page = client.get("/docs").text
    assert "https://" not in page
    for local in re.findall(r'(?:src|href)="([^"]+)"', page):
        assert client.get(local).status_code == 200, local


def test_the_replay_page_shows_the_bin(client: TestClient) -> None:
    done(client.post("/bins", json={"id": "a"}), 201)
    done(client.post("/bins/a/place", json={"sides": CARTONS[0], "id": "first"}))
    page = client.get("/bins/a/replay")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    assert 'data-live="replay.json"' in page.text
    shown = done(client.get("/bins/a/replay.json"))
    assert shown["title"] == "a"
    assert [box["id"] for box in shown["boxes"]] == ["first"]


@pytest.mark.parametrize("policy", ["max_contact", "rs"])
def test_a_bin_can_say_why_its_boxes_are_where_they_are(tmp_path: Path, policy: str) -> None:
    for k in range(2):  # the second time the bins are made again from the file
        with client_of(tmp_path / "bins.sqlite") as client:
            for id, explain in (("why", True), ("plain", False)):
                if k == 0:
                    opened = {"id": id, "policy": policy, "explain": explain}
                    done(client.post("/bins", json=opened), 201)
                for sides in CARTONS[:3]:
                    done(client.post(f"/bins/{id}/place", json={"sides": sides}))
            plan = Plan.of_dict(done(client.get("/bins/why/plan")), "why")
            assert len(plan.explanations) == 3 * (k + 1)
            for why, position in zip(plan.explanations, plan.positions, strict=True):
                assert why is not None
                assert why.positions[why.chosen].tolist() == position.tolist()
            assert "explanations" not in done(client.get("/bins/plain/plan"))


def test_an_error_in_the_service_says_nothing_of_the_code(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    done(client.post("/bins", json={"id": "a"}), 201)
    monkeypatch.setattr(Packer, "place", lambda *_, **__: 1 / 0)
    refused = client.post("/bins/a/place", json={"sides": [10, 10, 10]})
    assert error(refused) == (500, "internal", "an error in the service; its log says more")


# --- the program ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "required: --data"),
        ("--data {}/none/a.sqlite", "the folder .* does not exist"),
        ("--data {}/a.sqlite --port 70000", "--port: needs a whole number from 0 to 65535"),
        ("--data {}/a.sqlite --host 0.0.0.0", "others could reach it; needs --token-file"),
        ("--data {}/a.sqlite --host 192.0.2.1 --token-file {}/token", "cannot listen on"),
        ("--data {}/a.sqlite --token-file {}/none", "none: no such file"),
        ("--data {}/a.sqlite --token-file {}/short", "at least 16 printable ASCII characters"),
        ("--data {}/a.sqlite --policy {}/none.json", "none.json"),
        ("--data {}/a.sqlite --max-boxes 0", "max_boxes"),
    ],
)
def test_a_mistake_is_one_line(
    words: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "token").write_text(f"{TOKEN}\n")
    (tmp_path / "short").write_text("secret\n")
    with pytest.raises(SystemExit) as ended:
        serve.main(words.replace("{}", str(tmp_path)).split())
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(message, line)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_the_program_finishes_what_it_has_begun(
    number: signal.Signals, status: int, tmp_path: Path
) -> None:
    words = ["--data", str(tmp_path / "a.sqlite")]
    with serving(words) as (process, address), httpx.Client(base_url=address) as client:
        bin = {"id": "a", "policy": "search", "plan": "budget=800ms"}
        done(client.post("/bins", json=bin), 201)
        for _ in range(3):
            done(client.post("/bins/a/place", json={"sides": [300, 200, 120]}))
        with ThreadPoolExecutor(1) as pool:
            last = pool.submit(client.post, "/bins/a/place", json={"sides": [400, 300, 250]})
            time.sleep(0.3)
            process.send_signal(number)
            assert done(last.result())["step"] == 4
        assert process.wait(20) == status
    with client_of(tmp_path / "a.sqlite") as client:
        assert done(client.get("/bins/a"))["boxes"] == 4


def test_a_killed_server_has_forgotten_nothing(tmp_path: Path) -> None:
    report = killed_and_repeated(tmp_path, clients=4, kills=3, seconds=1.0)
    assert report["answered"] > 50
    assert report["kills"] == 3
    for plan in report["plans"]:
        check_plan(plan, 0.1, 0.0)


@pytest.mark.skipif(shutil.which("curl") is None, reason="the session needs curl")
def test_the_session_of_the_page_runs_as_it_is_printed(tmp_path: Path) -> None:
    page = (Path(__file__).parent.parent / "docs/service.md").read_text("utf-8")
    session = re.findall(r"^\$ (curl .*)\n(.*)$", page, re.MULTILINE)
    assert len(session) == 4
    with serving(["--data", str(tmp_path / "a.sqlite")]) as (_, address):
        for command, printed in session:
            words = shlex.split(command.replace("localhost:8000", address))
            result = subprocess.run(words, capture_output=True, text=True, timeout=60)
            assert json.loads(result.stdout) == json.loads(printed)


def test_the_example_of_a_robot_cell_runs(tmp_path: Path) -> None:
    example = Path(__file__).parent.parent / "examples/robot_cell.py"
    with serving(["--data", str(tmp_path / "a.sqlite")]) as (_, address):
        words = [sys.executable, str(example), address, "p7", str(tmp_path / "plan.json")]
        for _ in range(2):  # the second time it gets the answers of the first time
            result = subprocess.run(words, capture_output=True, text=True, timeout=60)
            assert result.returncode == 0, result.stderr
            plan = Plan.from_json(tmp_path / "plan.json")
            assert len(plan) == 5 == result.stdout.count("middle at")
            assert plan.yaws.all()
        words[2] = address.removeprefix("http://")
        result = subprocess.run(words, capture_output=True, text=True, timeout=60)
        assert result.returncode == 2
        assert "needs http://" in result.stderr


def test_the_first_page_lists_the_bins(client: TestClient) -> None:
    assert "No bins yet" in client.get("/").text
    for id in ("first", "second"):
        done(client.post("/bins", json={"id": id}), 201)
    done(client.post("/bins/first/close", json={}))
    page = client.get("/").text
    assert page.index("second") < page.index("first")
    assert 'href="bins/second/replay"' in page
    assert page.count("<td>open</td>") == page.count("<td>closed</td>") == 1


def test_a_bin_says_its_options(client: TestClient) -> None:
    done(client.post("/bins", json={"id": "a", "margin_mm": 15, "clearance_mm": 4}), 201)
    options = done(client.get("/bins/a"))["options"]
    assert options["margin_mm"] == 15
    assert set(options) == {each.name for each in fields(ExactSpec)}


def test_an_impossible_pose_has_a_code_of_its_own(client: TestClient) -> None:
    done(client.post("/bins", json={"id": "a"}), 201)
    done(client.post("/bins/a/place", json={"sides": CARTONS[0]}))
    status, code, message = error(client.post("/bins/a/actual", json={"x": 299, "y": 200}))
    assert (status, code) == (409, "impossible_pose")
    assert "reach out of the bin by 1.0 mm" in message
    assert done(client.get("/bins/a"))["step"] == 1


@pytest.mark.parametrize("path", ["/bins/a/place", "/bins/a/offer"])
def test_metres_are_refused(client: TestClient, path: str) -> None:
    done(client.post("/bins", json={"id": "a"}), 201)
    for request, body in (
        (path, {"sides": [0.3, 0.2, 0.1]}),
        ("/bins", {"bin_mm": [1.2, 0.8, 1.5]}),
    ):
        status, code, message = error(client.post(request, json=body))
        assert (status, code) == (422, "impossible")
        assert "lengths are in millimetres" in message
