"""Bad files of items and of plans, at random: as CSV, JSON and npz."""

import io
import json
import random
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np

Case = tuple[str, bytes, str]
"""Name, content and ending of a file. A name that begins with "bad": to be refused."""

CELLS = (
    "", " ", "1_0", "٥", "五", "²", "0x2", "0b1", "2..0", "2.5", "--2", "1e", "nan",
    "NaN", "inf", "-inf",
    "1e400", "-1", "0", "2;3", "2 3", "9" * 400, "9" * 5000, "True", "null", "None", "[2]", "two",
    "\x00", "\x1b[31m2", "=2+3", "1e-400", "x" * 200_000,
)  # fmt: skip
"""Cells that are no side of an item."""
VALUES: tuple[Any, ...] = (
    None, True, False, "5", "", "٥", [], [2], {}, {"w": 2}, 2.5, -1, 0, 1e308, float("nan"),
    float("inf"), -float("inf"), 10**400, [[2, 2, 2]], "x" * 100_000,
)  # fmt: skip
"""Values of JSON that are no side of an item."""
COLUMNS = ("Weight", "Sequence", "order", "this_side_up", "qty", "depth", "W", "w", "", "weights")
GOODS: dict[str, Any] = {
    "items": [[[2, 3, 4], [5, 5, 5]], [[4, 2, 2]]],
    "weights": [[1.5, 2], [3]],
    "upright": [[True, False], [False]],
    "orientations": [[[0, 1], [0, 2, 4]], [[5]]],
    "ids": [["red", 7], ["blue"]],
    "quantity": [[1, 2], [3]],
    "bin": [10, 10, 10],
}
TABLE = """sequence,w,d,h,weight,upright,orientations,id,quantity
a,2,3,4,1.5,yes,0 1,red,1
a,5,5,5,2,no,0 2 4,7,2
b,4,2,2,3,0,5,blue,3
"""
PLAN: dict[str, Any] = {
    "unit_mm": 10.0,
    "bins": [[10, 10, 10]],
    "boxes": [
        {"id": "a", "bin": 0, "x": 0, "y": 0, "z": 0, "w": 2, "d": 3, "h": 4, "orientation": 0,
         "weight": 24.0, "centre_x": 1.0, "centre_y": 1.5},
        {"id": "b", "bin": 0, "x": 2, "y": 0, "z": 0, "w": 5, "d": 5, "h": 5, "orientation": -1,
         "weight": 1.0, "centre_x": 4.5, "centre_y": 2.5},
    ],
    "explanations": [
        None,
        {"legal": 3, "chosen": 1, "value_of": "score", "values": [0.5, None],
         "probabilities": [None, 1.0], "orientation_probabilities": [0, 0, 0, 0.5, 0.25, 0.25],
         "placements": {"orientation": [0, 3], "x": [2, 2], "y": [0, 1.5], "z": [0, 0]}},
    ],
}  # fmt: skip
"""A plan of two boxes as :meth:`marl_pack.plan.Plan.to_json` writes it."""


def archive(**arrays: Any) -> bytes:
    """Return an npz archive of arrays."""
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def forged(
    shape: tuple[int, ...], data: bytes, size: int | None = None, text: str = "<i2"
) -> bytes:
    """Return an archive whose header and directory say what they like about ``items``."""
    header = io.BytesIO()
    description = {"descr": text, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, description)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as members:
        members.writestr("items.npy", header.getvalue() + data)
        if size is not None:
            members.infolist()[0].file_size = size
    return file.getvalue()


def bad_items() -> Iterator[Case]:
    """Yield files of items that must be refused."""
    for cell in CELLS:
        yield f"bad cell {cell[:20]!r}", f"w,d,h\n2,2,2\n2,{cell},2\n".encode(), ".csv"
    for column in COLUMNS:
        yield f"bad column {column!r}", f"{column},w,d,h,id\n1,2,2,2,a\n".encode(), ".csv"
    for value in VALUES:
        rows = [[2, 2, 2], [2, value, 2]]
        yield f"bad value {value!r:.20}", json.dumps({"items": rows}).encode(), ".json"
        rows[1] = value
        yield f"bad row {value!r:.20}", json.dumps(rows).encode(), ".json"
    wrong: dict[str, tuple[Any, ...]] = {
        "weights": (None, True, "5", -1, 0, 10**400, float("nan"), [1]),
        "upright": (None, 2, "maybe", [True]),
        "orientations": (None, 0, [], [6], [True], "01", [0, 0], [1.5], ["0"]),
        "ids": (None, "", "\ud800", True, 1.5, "x" * 1000, 10**400, ["a"]),
        "quantity": (None, True, "2", 1.5, 0, -1, 10**9, 10**30, float("inf")),
        "lengths": (None, True, "1", 1.0, 0, 2),
    }
    for key, values in wrong.items():
        for value in values:
            goods = {"items": [[[2, 2, 2]], [[3, 3, 3]]], key: [[1], [value]]}
            goods[key] = [1, value] if key == "lengths" else [[GOODS[key][0][0]], [value]]
            yield f"bad {key} {value!r:.20}", json.dumps(goods).encode(), ".json"
    for bin_size in (
        None,
        10,
        "10",
        [10, 10],
        [True, 10, 10],
        ["10", 10, 10],
        [10**400] * 3,
        [9.5] * 3,
    ):
        goods = {"items": [[2, 2, 2]], "bin": bin_size}
        yield f"bad bin {bin_size!r:.20}", json.dumps(goods).encode(), ".json"
    for key in ("weight", "Bin", "order", "Quantity", "items "):
        yield f"bad key {key}", json.dumps({"items": [[2, 2, 2]], key: [1]}).encode(), ".json"
        yield f"bad array {key}", archive(items=[[2, 2, 2]], **{key: [1]}), ".npz"
    texts = {
        "nested lists": "[" * 100_000, "nested items": "[" * 900 + "2" + "]" * 900,
        "nested objects": '{"items":' * 100_000, "5000 digits": f"[[2,2,{'9' * 5000}]]",
        "twice": '{"items": [[2,2,2]], "items": [[3,3,3]]}', "empty": "", "null": "null",
    }  # fmt: skip
    for name, text in texts.items():
        yield f"bad JSON, {name}", text.encode(), ".json"
    table = b"w,d,h,id\n2,2,2,a\n"
    for name, content in {
        "UTF-16": table.decode().encode("utf-16"), "Latin-1": table + b"2,2,2,\xe9\n",
        "NUL": table + b"2,2,2,\0\n", "open quote": table + b'2,2,2,"b\n2,2,2,c\n',
        "long field": table + b"2,2,2," + b"x" * 200_000,
        "long id": table + b"2,2,2," + b"x" * 1000,
        "two marks": b"\xef\xbb\xbf\xef\xbb\xbf" + table, "empty": b"", "binary": bytes(range(256)),
    }.items():  # fmt: skip
        yield f"bad CSV, {name}", content, ".csv"
    two = b"\2\0" * 6
    for name, content in {
        "giant header": forged((10**12, 3), two), "giant member": forged((2, 3), two, 2**32 - 1),
        "short header": forged((1, 3), two), "negative": forged((-2, -3), two),
        "nothing": forged((10**15, 3), b"", text="|V0"),
        "objects": forged((2, 3), b"x" * 48, text="|O"),
        "pickle": archive_of_objects(), "texts": archive(items=[["2", "2", "2"]]),
        "truths": archive(items=np.ones((2, 3), bool)),
        "complex": archive(items=np.ones((2, 3), complex)),
        "dates": archive(items=np.zeros((2, 3), "M8[s]")), "flat": archive(items=[2, 2, 2]),
        "none": archive(items=np.zeros((0, 3))), "no archive": b"PK\3\4", "empty": b"",
        "not a number": archive(items=[[2, 2, np.nan]]), "many": archive(items=[[2**62] * 3]),
    }.items():  # fmt: skip
        yield f"bad npz, {name}", content, ".npz"


def archive_of_objects() -> bytes:
    """Return an archive with an array of Python objects."""
    return archive(items=np.array([[2, 2, None]], object))


def bad_plans() -> Iterator[Case]:
    """Yield files of plans that must be refused."""
    for key in PLAN["boxes"][0]:
        right = {"id": (str,), "bin": (int,), "orientation": (int,)}.get(key, (int, float))
        for value in VALUES:
            if type(value) in right and (key == "id" or value in (2.5, 1e308, 0, -1)):
                continue  # some plans have it
            plan = json.loads(json.dumps(PLAN))
            plan["boxes"][1][key] = value
            yield f"bad box, {key} {value!r:.20}", json.dumps(plan).encode(), ".json"
            if key != "id" and value != "5" and not isinstance(value, list | dict):
                yield f"bad cell, {key} {value!r:.20}", _as_csv(plan), ".csv"
    changes: tuple[dict[str, Any], ...] = (
        {"unit": 1}, {"boxes": {}}, {"bins": 3}, {"bins": [[10, 10, True]]}, {"unit_mm": "10"},
        {"bins": [[2**70] * 3]}, {"unit_mm": float("inf")}, {"unit_mm": True},
    )  # fmt: skip
    for change in changes:
        yield f"bad plan {change}", json.dumps(PLAN | change).encode(), ".json"
    for key, wrong in (
        ("legal", (1, -1, "3", None, 1e300)), ("chosen", (2, -2, 0.5, None)),
        ("values", ([1.0], "ab", [1, "a"], None)), ("probabilities", ([], [[1], [2]])),
        ("orientation_probabilities", ([1], 6 * ["x"])), ("value_of", (3, None)),
        ("placements", ({}, [], {"orientation": [6, 0], "x": [1, 1], "y": [1, 1], "z": [1, 1]})),
        ("colour", (1,)),
    ):  # fmt: skip
        for value in wrong:
            plan = json.loads(json.dumps(PLAN))
            plan["explanations"][1][key] = value
            yield f"bad explanation {key} {value!r}", json.dumps(plan).encode(), ".json"
    yield "bad explanations", json.dumps(PLAN | {"explanations": [None]}).encode(), ".json"
    table = _as_csv(PLAN)
    for name, content in {
        "digits": table.replace(b"a,0,0,0", "a,0,0,٠".encode()), "Latin-1": table + b"\xe9",
        "long field": table + b"x" * 200_000, "NUL": table + b"\0",
        "bin": table.replace(b"a,0,", b"a,0.0,"),
        "underscore": table.replace(b"24.0", b"2_4"), "spaces": table.replace(b"24.0", b" 24"),
    }.items():  # fmt: skip
        yield f"bad CSV, {name}", content, ".csv"
    good = plan_arrays()
    for key, value in {
        "boxes": np.array([[(0, 0, 0, True, 1, 1)]], object), "bin": np.array([2**62] * 3),
        "Loads": [1], "ids": np.array([[1]]), "unit_mm": np.array(["1_0"]),
        "count": np.array([True]),
        "loads": np.full((1, 1, 3), np.nan), "orientations": np.array([[0.5]]),
    }.items():  # fmt: skip
        yield f"bad archive, {key}", archive(**good | {key: value}), ".npz"
    yield "bad archive, giant", forged((10**12, 1, 6), b"\2\0" * 6), ".npz"
    yield (
        "bad archive, a far corner",
        archive(**good | {"boxes": [[(2**63 - 2, 0, 0, 9, 1, 1)]]}),
        ".npz",
    )


def plan_arrays() -> dict[str, Any]:
    """Return the arrays of an archive with one plan of one box."""
    return {
        "bin": np.array([10, 10, 10]), "count": np.array([1]),
        "boxes": np.array([[(0, 0, 0, 2, 2, 2)]]), "loads": np.array([[(8.0, 1, 1)]]),
    }  # fmt: skip


def _as_csv(plan: dict[str, Any]) -> bytes:
    """Return a plan of JSON as CSV."""
    keys = list(PLAN["boxes"][0])
    lines = [",".join([*keys, "bin_w", "bin_d", "bin_h", "unit_mm"])]
    lines += [",".join(map(str, [*box.values(), 10, 10, 10, 10.0])) for box in plan["boxes"]]
    return "\n".join(lines).encode()


def good_files(plans: bool) -> list[Case]:
    """Return files that are right."""
    if plans:
        text = {"policy": "dblf", "plans": [{"episode": k} | PLAN for k in (0, 1)]}
        header, *lines = _as_csv(PLAN).decode().splitlines()
        rows = [f"dblf,{k},{line}" for k in (0, 1) for line in lines]
        table = "\n".join([f"policy,episode,{header}", *rows])
        return [("plan", json.dumps(PLAN).encode(), ".json"), ("plan", _as_csv(PLAN), ".csv"),
                ("plans", json.dumps(text).encode(), ".json"),
                ("plans", table.encode(), ".csv"),
                ("plans", archive(**plan_arrays()), ".npz")]  # fmt: skip
    arrays = {"items": [[2, 3, 4], [5, 5, 5]], "weights": [1.5, 2.0], "ids": ["red", "7"]}
    return [("items", json.dumps(GOODS).encode(), ".json"), ("items", TABLE.encode(), ".csv"),
            ("items", archive(**arrays), ".npz")]  # fmt: skip


def cases(seed: int, count: int = 1000, plans: bool = False) -> Iterator[Case]:
    """Yield the bad files in random order, then right ones with random changes of bytes.

    Args:
        seed: of the order and of the changes.
        count: number of changed files.
        plans: whether the files are of plans, not of items.
    """
    rng = random.Random(seed)
    bad = list(bad_plans() if plans else bad_items())
    rng.shuffle(bad)
    yield from bad
    good = good_files(plans)
    for k in range(count):
        name, content, suffix = rng.choice(good)
        changed = bytearray(content)
        for _ in range(rng.choice((1, 1, 2, 8))):
            at, other = rng.randrange(len(changed)), rng.randrange(len(changed))
            change = rng.randrange(4)
            if change == 0:
                changed[at] = rng.randrange(256)
            elif change == 1:
                changed[at:at] = rng.choice(
                    (b"0", b"-", b"e9", b".", b"_", b",", b'"', b"[", b"\n", b"\0")
                )
            elif change == 2:
                del changed[at : at + rng.randrange(1, 9)]
            else:
                changed[at:at] = changed[min(at, other) : max(at, other)][:200]
        yield f"changed {name} {k}", bytes(changed), suffix
