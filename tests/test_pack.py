"""``marl-pack pack``: files, orders and a conveyor."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

import marl_pack
from marl_pack import Plan, pack
from marl_pack.plan_archive import load_plans

SCHEMA = json.loads((Path(marl_pack.__file__).parent / "plan.schema.json").read_text())
ROWS = (
    "id,w_mm,d_mm,h_mm,quantity,weight_kg,upright,stackable\n"
    "A,400,300,250,6,8.2,yes,yes\nB,300.5,200,180,8,,no,yes\nC,285,190,160,5,2.2,no,no\n"
)
BIN = ["--bin-mm", "800", "600", "700"]


@pytest.fixture
def csv(tmp_path: Path) -> Path:
    path = tmp_path / "boxes.csv"
    path.write_text(ROWS)
    return path


def read_plan(path: Path) -> Plan:
    """Read a plan; its file satisfies the published schema."""
    jsonschema.validate(json.loads(path.read_text()), SCHEMA)
    return Plan.from_json(path)


def test_a_file_becomes_a_plan(
    csv: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "plan.json"
    assert pack.main([str(csv), *BIN, "--margin-mm", "20", "--out", str(out)]) == 0
    plan, printed = read_plan(out), capsys.readouterr().out
    assert len(plan) == 19
    assert plan.unit_mm == 1
    assert set(plan.ids) == {"A", "B", "C"}
    assert "19 boxes in" in printed
    assert "max_contact, bin 800 x 600 x 700 mm, rule lbcp, margin 20 mm" in printed
    assert plan.weights_assumed.tolist() == [name == "B" for name in plan.ids]
    assert plan.stackable.tolist() == [name != "C" for name in plan.ids]
    margin = np.array(plan.margins)[plan.positions[:, 2] > 0].min()
    assert f"least margin {margin:g} mm" in printed
    assert margin >= 20


@pytest.mark.parametrize("ending", [".json", ".csv", ".npz"])
def test_every_format_of_plans_is_written(csv: Path, tmp_path: Path, ending: str) -> None:
    out = tmp_path / f"plan{ending}"
    assert pack.main([str(csv), *BIN, "--out", str(out)]) == 0
    assert len(load_plans(out)[0]) == 19


def test_boxes_without_a_place(
    csv: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "plan.json"
    words = [str(csv), *BIN, "--out", str(out)]
    assert pack.main([*words, "--bins", "1"]) == 0
    plan, printed = read_plan(out), capsys.readouterr().out
    assert len(plan) + len(plan.left_out) == 19
    assert len(plan.left_out) > 0
    assert f"no place: box {plan.left_out[0].id!r} of" in printed
    assert plan.left_out[0].reason in printed
    assert pack.main([*words, "--no-place", "skip"]) == 0
    assert read_plan(out) == plan
    assert pack.main([*words, "--no-place", "stop"]) == 0
    stopped = read_plan(out)
    assert "stopped at the first box without a place" in capsys.readouterr().out
    assert stopped.left_out == ()
    assert stopped == plan.first(len(stopped))


BED_BPP = {
    "00100408": {
        "item_sequence": {
            str(k): {
                "article": f"a-{k}", "id": f"i{k}", "product_group": "x", "length/mm": 300 + 10 * k,
                "width/mm": 200, "height/mm": 150, "weight/kg": 2.5, "sequence": k,
            } for k in range(1, 6)
        },
        "properties": {"id": "1", "order_nr": "2", "type": "t", "target": "euro-pallet"},
    }
}  # fmt: skip
BED_BPP["00100001"] = BED_BPP["00100408"]


def test_orders_of_bed_bpp_are_read_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "orders.json", tmp_path / "plan.json"
    path.write_text(json.dumps(BED_BPP))
    assert pack.main([str(path), *BIN, "--out", str(out)]) == 0
    plan = read_plan(out)
    assert plan.orders == ("00100408", "00100001")
    assert plan.ids[:5] == ("i1", "i2", "i3", "i4", "i5")
    assert set(plan.orientations.tolist()) <= {0, 1}  # upright
    assert plan.sides[:, 2].tolist() == [150] * 10
    assert "00100001" in capsys.readouterr().out


def test_rows_of_an_order_belong_together(tmp_path: Path) -> None:
    path, out = tmp_path / "boxes.csv", tmp_path / "plan.json"
    path.write_text("order,id,w_mm,d_mm,h_mm\nx,1,100,100,100\ny,2,100,100,100\nx,3,100,100,100\n")
    assert pack.main([str(path), *BIN, "--out", str(out)]) == 0
    assert (read_plan(out).ids, read_plan(out).orders) == (("1", "3", "2"), ("x", "y"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("w_mm,d_mm,h_mm\n100,100,100\n0,100,100\n", "row 1 (line 3) is [0.0, 100.0, 100.0]: zero"),
        ("w_mm,d_mm,h_mm\n\n-5,100,100\n", "row 0 (line 3) is [-5.0, 100.0, 100.0]: zero or"),
        ("w_mm,d_mm,h_mm\nnan,100,100\n", "'nan' is not a number"),
        ("w_mm,d_mm,h_mm\n900,900,900\n", "row 0 (line 2) is [900.0, 900.0, 900.0]: fits into the"),
        ("w_mm,d_mm,h_mm\n100,100,10.05\n", "needs whole units of 0.1 mm"),
        ("w_mm,d_mm,h_mm,wieght_kg\n1,1,1,1\n", "'wieght_kg'; did you mean 'weight_kg'"),
        ("w_cm,d_cm,h_cm\n10,10,10\n", "lengths need to be in millimetres, in w_mm, d_mm and h_mm"),
        ("length_in,w_mm,d_mm,h_mm\n1,1,1,1\n", "lengths need to be in millimetres"),
        ("w_mm;d_mm;h_mm\n10;10;10\n", "values are separated by ';'; needs commas"),
        ("w_mm,d_mm\n10,10\n", "no column 'h_mm'"),
        ("w_mm,d_mm,h_mm,quantity\n10,10,10,0\n", "quantity 0; needs a whole number ≥ 1"),
        (
            "w_mm,d_mm,h_mm,order,sequence\n10,10,10,a,b\n",
            "order and sequence, which mean the same",
        ),
        ("w_mm,d_mm,h_mm\n", "has no items"),
    ],
)
def test_a_wrong_file_says_the_line_and_the_reason(
    text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "boxes.csv", tmp_path / "plan.json"
    path.write_text(text)
    with pytest.raises(SystemExit) as ended:
        pack.main([str(path), *BIN, "--out", str(out)])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert str(path) in error
    assert error.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["missing.csv"], "missing.csv"),
        (["FILE", "--margin-mm", "-3"], "margin_mm = -3"),
        (["FILE", "--bin-mm", "0", "1", "1"], "bin_mm"),
        (["FILE", "--policy", "linaer"], "did you mean 'linear'"),
        (["FILE", "--plan", "budget=500ms"], "needs the policy search, linear"),
        (["FILE", "--bins", "0"], "bins: needs a whole number from 1"),
        (["FILE", "--out", "plan.txt"], "--out plan.txt: needs one of the endings"),
        (["FILE", "--state", "state.json"], "--state: only with -, for a conveyor"),
        (["FILE", "--present", "nothing.json"], "--present nothing.json: no such file"),
        (["FILE", "--no-place", "wait"], "needs one of next-bin, skip, stop"),
    ],
)
def test_a_wrong_option_says_what_would_be_right(
    words: list[str], message: str, csv: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        pack.main([str(csv) if word == "FILE" else word for word in words])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


# --- the conveyor ---------------------------------------------------------------------------------


def lines(count: int, **more: Any) -> list[str]:
    sides = [(400, 300, 250), (300.5, 200, 180), (285, 190, 160)]
    return [
        json.dumps(
            {
                "id": f"b{k}",
                **dict(zip(("w_mm", "d_mm", "h_mm"), sides[k % 3], strict=True)),
                **more,
            }
        )
        for k in range(count)
    ]


def conveyor(
    text: str, words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> tuple[int, list[dict[str, Any]], str]:
    """Run the command on lines; return its status, the answers and the summary."""
    monkeypatch.setattr(sys, "stdin", io.StringIO(text))
    try:
        status = pack.main(["-", *BIN, *words])
    except SystemExit as ended:
        status = int(ended.code or 0)
    printed = capsys.readouterr()
    return status, [json.loads(line) for line in printed.out.splitlines()], printed.err


def test_a_conveyor_gives_the_plan_of_the_file(
    csv: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    out, other = tmp_path / "plan.json", tmp_path / "conveyor.json"
    assert pack.main([str(csv), *BIN, "--out", str(out)]) == 0
    capsys.readouterr()
    plan = read_plan(out)
    rows = {"A": (400, 300, 250, 8.2, True, True), "B": (300.5, 200, 180, None, False, True),
            "C": (285, 190, 160, 2.2, False, False)}  # fmt: skip
    keys = ("w_mm", "d_mm", "h_mm", "weight_kg", "upright", "stackable")
    text = "\n".join(
        json.dumps({"id": name, **dict(zip(keys, rows[name], strict=True))})
        for name in ["A"] * 6 + ["B"] * 8 + ["C"] * 5
    )
    status, answers, _ = conveyor(text, ["--out", str(other)], monkeypatch, capsys)
    assert status == 0
    assert read_plan(other) == plan
    assert [answer["line"] for answer in answers] == list(range(1, 20))
    assert [[a["x"], a["y"], a["z"]] for a in answers] == plan.positions.tolist()


def test_lines_that_are_not_boxes_are_answered_and_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    good = lines(3)
    bad = {
        "{": "not readable as JSON",
        "[1, 2]": "needs a record with the keys w_mm, d_mm, h_mm",
        '{"w_mm": 1, "d_mm": 1}': "no key 'h_mm'",
        '{"w_mm": 1, "d_mm": 1, "h_mm": 1, "quantity": 2}': "unknown key 'quantity'",
        '{"w_mm": NaN, "d_mm": 1, "h_mm": 1}': "NaN is not a number",
        '{"w_mm": 0, "d_mm": 1, "h_mm": 1}': "zero or negative",
        '{"w_mm": "a", "d_mm": 1, "h_mm": 1}': "needs three lengths",
        '{"w_mm": 1e999, "d_mm": 1, "h_mm": 1}': "finite",
        '{"w_mm": true, "d_mm": 1, "h_mm": 1}': "needs three lengths",
        '{"w_mm": 1, "w_mm": 2, "d_mm": 1, "h_mm": 1}': "the key 'w_mm' is given twice",
        '{"w_mm": 1, "d_mm": 1, "h_mm": 1, "order": 1, "sequence": 1}': "which mean the same",
        "{" * 100_000: "needs at most 65536 characters",
        "[" * 5000: "not readable as JSON",
    }
    text = "\n".join([good[0], "", *bad, good[1], good[2]])
    status, answers, summary = conveyor(text, [], monkeypatch, capsys)
    assert status == 2
    assert f"{len(bad)} lines were refused" in summary
    errors = [answer for answer in answers if "error" in answer]
    for answer, message in zip(errors, bad.values(), strict=True):
        assert message in answer["error"]
        assert f"line {answer['line']}" in answer["error"]
    placed = [answer for answer in answers if "error" not in answer]
    assert [answer["id"] for answer in placed] == ["b0", "b1", "b2"]
    assert all(answer["placed"] for answer in placed)


def test_a_box_that_is_too_large_is_answered(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    text = '{"w_mm": 900, "d_mm": 900, "h_mm": 900, "id": 7}\n' + lines(1)[0]
    status, (large, small), summary = conveyor(text, [], monkeypatch, capsys)
    assert status == 0
    assert (large["placed"], large["code"], large["id"]) == (False, "too_large", "7")
    assert small["placed"]
    assert "no place: box '7'" in summary


def test_a_conveyor_goes_on_from_its_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    state, out = tmp_path / "state.json", tmp_path / "plan.json"
    words = ["--state", str(state), "--out", str(out), "--policy", "random"]
    text = [line + "\n" for line in lines(30)]
    conveyor("".join(text), ["--policy", "random", "--out", str(out)], monkeypatch, capsys)
    whole = read_plan(out)
    for first, last in ((0, 7), (7, 8), (8, 30)):
        conveyor("".join(text[first:last]), words, monkeypatch, capsys)
    assert read_plan(out) == whole
    status, _, summary = conveyor("", [*words, "--margin-mm", "3"], monkeypatch, capsys)
    assert (status, "was saved with other options" in summary) == (2, True)


def test_units_and_catalogues_go_with_states(
    csv: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    catalogue = tmp_path / "goods.csv"
    catalogue.write_text("w_mm,d_mm,h_mm\n100,100,100\n300,200,100\n")
    words = ["--state", str(tmp_path / "state.json"), "--policy", "search", "--unit-mm", "10",
             "--plan", "budget=1ms", "--catalogue", str(catalogue)]  # fmt: skip
    text = '{"w_mm": 300, "d_mm": 200, "h_mm": 100}'
    for count in (1, 2):
        status, answers, _ = conveyor(text, words, monkeypatch, capsys)
        assert (status, len(answers)) == (0, 1)
        saved = json.loads((tmp_path / "state.json").read_text())
        assert len(saved["calls"]) == count


@pytest.mark.parametrize("killed_after", [1, 6])
def test_a_conveyor_that_is_killed_leaves_a_valid_plan_with_every_answer(
    killed_after: int, tmp_path: Path
) -> None:
    out, state = tmp_path / "plan.json", tmp_path / "state.json"
    command = [sys.executable, "-m", "marl_pack.pack", "-", *BIN, "--out", str(out),
               "--state", str(state)]  # fmt: skip
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdin
        assert process.stdout
        answers = []
        for line in lines(killed_after):
            process.stdin.write(line + "\n")
            process.stdin.flush()
            answers.append(json.loads(process.stdout.readline()))
        process.stdin.write(lines(1)[0][:20])  # half of the next line
        process.stdin.flush()
        process.kill()
    plan = read_plan(out)
    assert [[a["x"], a["y"], a["z"]] for a in answers] == plan.positions.tolist()
    from marl_pack.packer.packer import Packer

    assert Packer.restore(state).plan == plan


# --- the schema -----------------------------------------------------------------------------------

WRONG: dict[str, Any] = {
    "no boxes": lambda c: c.pop("boxes"),
    "no unit": lambda c: c.pop("unit_mm"),
    "unit 0": lambda c: c.update(unit_mm=0),
    "version 3": lambda c: c.update(version=3),
    "another key": lambda c: c.update(robot="r2"),
    "no bins": lambda c: c.update(bins=[]),
    "a flat bin": lambda c: c["bins"].__setitem__(0, [1, 2, 0]),
    "a bin of two sides": lambda c: c["bins"].__setitem__(0, [1, 2]),
    "a box without a side": lambda c: c["boxes"][0].pop("w"),
    "a text as a side": lambda c: c["boxes"][0].update(w="3"),
    "a flat box": lambda c: c["boxes"][0].update(h=0),
    "a bin below 0": lambda c: c["boxes"][0].update(bin=-1),
    "orientation 6": lambda c: c["boxes"][0].update(orientation=6),
    "no weight": lambda c: c["boxes"][0].update(weight=0),
    "yaw 50": lambda c: c["boxes"][0].update(yaw=50),
    "stackable 1": lambda c: c["boxes"][0].update(stackable=1),
    "a load below 0": lambda c: c["boxes"][0].update(max_load=-1),
    "support 2": lambda c: c["boxes"][0].update(support=2),
    "another key of a box": lambda c: c["boxes"][0].update(colour="red"),
    "left out without a reason": lambda c: c["left_out"][0].pop("reason"),
    "orders of numbers": lambda c: c.update(orders=[1]),
}


@pytest.mark.parametrize("name", WRONG)
def test_the_schema_refuses_what_is_wrong_and_so_does_the_reader(name: str, csv: Path) -> None:
    out = csv.parent / "plan.json"
    pack.main([str(csv), *BIN, "--bins", "1", "--out", str(out)])
    content = json.loads(out.read_text())
    assert Plan.of_dict(content, "plan").to_dict() == content
    WRONG[name](content)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(content, SCHEMA)
    with pytest.raises(ValueError, match="plan"):
        Plan.of_dict(content, "plan")


def test_plans_of_the_first_version_are_read() -> None:
    content = {"unit_mm": None, "bins": [[10, 10, 10]], "boxes": []}
    jsonschema.validate(content, SCHEMA)
    assert len(Plan.of_dict(content, "plan")) == 0
