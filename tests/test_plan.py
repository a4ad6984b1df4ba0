"""Plans: refused values, their parts, and files that read back as they were written."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from marl_pack.agents.heuristics import make_policy
from marl_pack.game.packing import Packing
from marl_pack.plan import COLUMNS, Plan
from marl_pack.plan_archive import ENDINGS, load_plans, save_plan, save_plans

BIN = (10, 10, 10)
ROWS = [(0, 0, 0, 4, 4, 2), (1, 0, 2, 3, 4, 1)]
PLAIN = Plan.of_boxes(BIN, ROWS)
NAMED = Plan.of_boxes(
    BIN, ROWS, [(3.25, 2.5, 2.0), (0.1, 1.5, 1 / 3)],
    orientations=[4, -1], ids=('A "1", left', ""), unit_mm=12.5,
)  # fmt: skip
MILLIMETRES = Plan.of_boxes((400.0, 300, 200), np.array(ROWS) * 10.1, unit_mm=1.0)
SEVERAL = Plan(
    np.array([BIN, (5, 6, 7)]), np.array([1, 0, 1]), np.array([(0, 0, 0), (6, 6, 0), (0, 0, 2)]),
    np.array([(2, 2, 2), (4, 4, 4), (1, 2, 3)]), np.array([0, 1, 5]), np.array([8.0, 1, 2]),
    np.array([(1.0, 1), (8, 8), (0.5, 1)]), ("a", "b", "c"), 10.0,
)  # fmt: skip
NOTHING = Plan.of_boxes(BIN, [])
ALL = (PLAIN, NAMED, MILLIMETRES, SEVERAL)


def test_a_plan_holds_all_attributes_of_its_boxes() -> None:
    assert len(NAMED) == 2
    assert NAMED.boxes.tolist() == [list(row) for row in ROWS]
    assert NAMED.loads.tolist() == [[3.25, 2.5, 2.0], [0.1, 1.5, 1 / 3]]
    assert PLAIN.loads.tolist() == [[32, 2, 2], [12, 2.5, 2]]
    assert PLAIN.utilization == 44 / 1000
    assert SEVERAL.utilization == (8 + 64 + 6) / (1000 + 210)
    assert NOTHING.utilization == 0
    assert PLAIN.sides.dtype == np.int64
    assert MILLIMETRES.sides.dtype == MILLIMETRES.bin_sizes.dtype == np.float64
    assert replace(NAMED) == NAMED
    assert replace(NAMED, ids=("B", "")) != NAMED != PLAIN


def test_a_plan_keeps_no_array_that_others_may_change() -> None:
    boxes = np.array(ROWS)
    plan = Plan.of_boxes(BIN, boxes)
    boxes[:] = 9
    assert plan == PLAIN
    with pytest.raises(ValueError, match="read-only"):
        plan.sides[0] = 1


def test_parts_of_a_plan_are_plans() -> None:
    assert [len(SEVERAL.first(k)) for k in range(4)] == [0, 1, 2, 3]
    assert SEVERAL.first(3) == SEVERAL
    own = SEVERAL.in_bin(1)
    assert own.ids == ("a", "c")
    assert own.bins.tolist() == [0, 0]
    assert own.bin_sizes.tolist() == [[5, 6, 7]]
    assert own.utilization == 14 / 210


@pytest.mark.parametrize(("change", "why"), [
    ({"bin_sizes": [(10, 10)]}, r"bin_sizes: shape \(1, 2\), needs \(1, 3\)"),
    ({"bin_sizes": [(10, 10, 0)]}, "bin_sizes .*: needs positive sides"),
    ({"bins": [0, 1]}, r"box 1 \(1, 0, 2, 3, 4, 1\): needs a bin from 0 to 0"),
    ({"bins": [0.0, 0.5]}, "bins: needs whole numbers"),
    ({"positions": [(0, 0, 0), (8, 0, 2)]}, r"box 1 \(8, .*: reaches out of its bin"),
    ({"positions": [(0, 0, 0), (0, -1, 2)]}, "box 1 .*: reaches out"),
    ({"positions": [(0, 0, 0), (0, np.nan, 2)]}, "positions: needs finite numbers"),
    ({"sides": [(4, 4, 2), (0, 1, 1)]}, "box 1 .*: needs sides longer than 0"),
    ({"sides": [(4, 4, 2)]}, r"sides: shape \(1, 3\), needs \(2, 3\)"),
    ({"orientations": [0, 6]}, "box 1 .*: needs an orientation from 0 to 5, or -1"),
    ({"weights": [1, 0]}, "box 1 .*: needs a positive weight"),
    ({"weights": ["heavy", "light"]}, "weights: needs finite numbers"),
    ({"centres": [(2, 2), (0.5, 1)]}, "box 1 .*: needs a centre of mass inside the box"),
    ({"ids": ("a",)}, "ids: needs one text for each of 2 boxes"),
    ({"ids": (1, 2)}, "ids: needs one text"),
    ({"unit_mm": 0.0}, "unit_mm = 0.0: needs a positive length"),
])  # fmt: skip
def test_impossible_values_are_refused_with_the_box_named(
    change: dict[str, object], why: str
) -> None:
    with pytest.raises(ValueError, match=why):
        replace(PLAIN, **change)  # type: ignore[arg-type]  # bad ones are meant


def test_rows_that_are_no_boxes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"needs \[n, 6\]"):
        Plan.of_boxes(BIN, [(1, 2, 3)])


@pytest.mark.parametrize("plan", [*ALL, NOTHING, replace(SEVERAL, bins=np.zeros(3, np.int64))])
def test_json_reads_back_as_it_was(plan: Plan, tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    plan.to_json(str(path))
    again = Plan.from_json(path)
    assert again == plan
    assert again.sides.dtype == plan.sides.dtype


@pytest.mark.parametrize("plan", [*ALL, NOTHING, replace(SEVERAL, bins=np.zeros(3, np.int64))])
def test_csv_reads_back_as_it_was(plan: Plan, tmp_path: Path) -> None:
    path = tmp_path / "plan.csv"
    plan.to_csv(str(path))
    again = Plan.from_csv(path)
    assert again == plan
    assert again.sides.dtype == plan.sides.dtype


def test_a_line_of_csv_holds_everything_about_its_box(tmp_path: Path) -> None:
    path = tmp_path / "plan.csv"
    SEVERAL.to_csv(path)
    header, first, *_ = path.read_text().splitlines()
    assert header == ("id,bin,x,y,z,w,d,h,orientation,weight,centre_x,centre_y,"
                      "bin_w,bin_d,bin_h,unit_mm")  # fmt: skip
    assert first == "a,1,0,0,0,2,2,2,0,8.0,1.0,1.0,5,6,7,10.0"


def test_an_empty_bin_is_a_line_of_csv_with_its_size_alone(tmp_path: Path) -> None:
    path = tmp_path / "plan.csv"
    replace(SEVERAL, bins=np.zeros(3, np.int64)).to_csv(path)
    assert path.read_text().splitlines()[-1] == ",1,,,,,,,,,,,5,6,7,10.0"


@pytest.mark.parametrize(("text", "why"), [
    ("not json", "plan.json"),
    ("[1]", "not a plan in JSON"),
    ('{"bins": [[1, 1, 1]], "boxes": []}', "unit_mm"),
    ('{"bins": [[1, 1, 1]], "unit_mm": null, "boxes": [{"id": "a"}]}', "bin"),
    ('{"bins": [[1, 1]], "unit_mm": null, "boxes": []}', "bin_sizes: shape"),
    ('{"bins": [[1, 1, 1]], "unit_mm": "cm", "boxes": []}', "not a plan in JSON"),
])  # fmt: skip
def test_json_that_is_no_plan_is_refused(text: str, why: str, tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=why) as refused:
        Plan.from_json(path)
    assert str(path) in str(refused.value)


@pytest.mark.parametrize(("change", "why"), [
    (lambda lines: [], "needs the columns id,bin"),
    (lambda lines: lines[:1], "and at least one line"),
    (lambda lines: ["a,b", *lines[1:]], "needs the columns"),
    (lambda lines: [*lines[:2], "1,2"], "box 1: has 2 values, needs 16"),
    (lambda lines: [lines[0], lines[1].replace("8.0", "heavy")], "box 0: .*heavy"),
    (lambda lines: [*lines[:3], lines[3].replace("5,6,7", "5,6,8")], "bin 1 has different sizes"),
    (lambda lines: [*lines[:3], lines[3].replace("10.0", "")], "needs one unit"),
    (lambda lines: lines[:2], "without a gap"),
    (lambda lines: [lines[0], lines[2].replace("64", "1").replace("6,6,0", "7,6,0")], "out of its"),
])  # fmt: skip
def test_csv_that_is_no_plan_is_refused(
    change: Callable[[list[str]], list[str]], why: str, tmp_path: Path
) -> None:
    path = tmp_path / "plan.csv"
    SEVERAL.to_csv(path)
    path.write_text("\n".join(change(path.read_text().splitlines())))
    with pytest.raises(ValueError, match=why) as refused:
        Plan.from_csv(path)
    assert str(path) in str(refused.value)


def test_the_columns_of_csv_are_distinct() -> None:
    assert len(set(COLUMNS)) == len(COLUMNS)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("plans", [[PLAIN], [PLAIN, NAMED, NOTHING], list(ALL), [NOTHING]])
def test_archives_read_back_as_they_were(plans: list[Plan], ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"plans{ending}"
    save_plans(path, plans, "rs, plan rollouts=16,top=8")
    assert load_plans(path) == plans
    for plan in plans:
        save_plan(path, plan)
        assert load_plans(path) == [plan]


@pytest.mark.parametrize("plans", [[PLAIN], [PLAIN, NAMED, NOTHING], list(ALL), [NOTHING]])
def test_an_archive_of_arrays_holds_what_its_page_says(plans: list[Plan], tmp_path: Path) -> None:
    path = tmp_path / "plans.npz"
    save_plans(path, plans)
    with np.load(path) as archive:
        assert archive["count"].tolist() == [len(plan) for plan in plans]
        assert archive["utilization"].tolist() == [plan.utilization for plan in plans]
        one = all(len(plan.bin_sizes) == 1 and plan.bin_sizes[0, 0] == 10 for plan in plans)
        assert (archive["bin"].tolist() == list(BIN)) == one
        assert archive["boxes"].dtype == (np.int16 if one else np.float64)


@pytest.mark.parametrize("ending", ENDINGS)
def test_no_plans_make_no_archive(ending: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no plans"):
        save_plans(tmp_path / f"plans{ending}", [])


def test_a_line_of_a_csv_archive_names_the_policy_and_the_episode(tmp_path: Path) -> None:
    path = tmp_path / "plans.csv"
    save_plans(path, [NAMED, PLAIN], "dblf")
    header, *lines = path.read_text().splitlines()
    assert header == ",".join(("policy", "episode", *COLUMNS))
    assert [line.split(",")[:2] for line in lines] == [["dblf", k] for k in "0011"]


@pytest.mark.parametrize(("name", "change", "why"), [
    ("s.csv", lambda text: text.replace("\n,1,", "\n,2,"), "episode 1 together and before"),
    ("s.csv", lambda text: text.replace("\n,1,", "\n,0,"), "episode 0: needs one unit"),
    ("s.csv", lambda text: text.replace("unit_mm", "unit"), "needs the columns policy,episode"),
    ("s.csv", lambda text: f"{text}x\n", "episode 2 together and before those of ''"),
    ("s.csv", lambda text: text.replace(",12.5", ",cm"), "episode 1: box 0: 'cm' is not a number"),
    ("s.json", lambda text: text.replace('"episode": 1', '"episode": 2'), "plan 1: .*episode is 1"),
    ("s.json", lambda text: text.replace('"unit_mm": 12.5', '"unit": 1'), "episode 1: .*unit_mm"),
    ("s.json", lambda text: '{"plans": []}', "plans needs a list"),
    ("s.json", lambda text: '{"plans": [], "policies": ""}', "unknown key 'policies'"),
])  # fmt: skip
def test_an_archive_of_text_that_is_wrong_is_refused(
    name: str, change: Callable[[str], str], why: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    save_plans(path, [PLAIN, NAMED])
    path.write_text(change(path.read_text()))
    with pytest.raises(ValueError, match=why) as refused:
        load_plans(path)
    assert str(path) in str(refused.value)


def test_older_archives_are_read(tmp_path: Path) -> None:
    path = tmp_path / "stacks.npz"
    boxes = np.zeros((2, 2, 6), np.int16)
    boxes[0], boxes[1, 0] = ROWS, ROWS[0]
    loads = np.zeros((2, 2, 3))
    loads[0], loads[1, 0] = PLAIN.loads, PLAIN.loads[0]
    np.savez_compressed(path, bin=np.array(BIN), count=np.array([2, 1]), boxes=boxes, loads=loads,
                        utilization=np.array([0.044, 0.032]))  # fmt: skip
    assert load_plans(path) == [PLAIN, PLAIN.first(1)]


def test_a_foreign_archive_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    np.savez(path, other=np.zeros(3))
    with pytest.raises(ValueError, match="not a file of plans"):
        load_plans(path)
    path.write_bytes(b"no archive")
    with pytest.raises(ValueError, match="not a file of plans"):
        load_plans(path)
    with pytest.raises(FileNotFoundError):
        load_plans(tmp_path / "nowhere.npz")


def test_an_archive_of_mismatched_arrays_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    good = {"bin": np.array(BIN), "count": np.array([1]), "boxes": np.array([ROWS[:1]]),
            "loads": np.array([[(32.0, 2, 2)]]), "utilization": np.array([0.032])}  # fmt: skip
    np.savez(path, **good)
    assert load_plans(path) == [PLAIN.first(1)]
    for name, value in (("count", [-1]), ("count", [2]), ("count", [1, 1]), ("bin", [10.5, 1, 1]),
                        ("boxes", [[ROWS[0][:5]]]), ("loads", [[(1.0, 1)]]),
                        ("orientations", [1]), ("unit_mm", [1.0, 1.0]),
                        ("bin", [[(10, 10, 10)]] * 2)):  # fmt: skip
        np.savez(path, **{**good, name: np.array(value)})
        with pytest.raises(ValueError, match="needs arrays of matching shapes"):
            load_plans(path)
    np.savez(path, **{**good, "boxes": np.array([[(9, 0, 0, 2, 2, 2)]])})
    with pytest.raises(ValueError, match=r"episode 0: box 0 .*: reaches out"):
        load_plans(path)


def test_a_plan_of_a_game_holds_the_boxes_in_its_bin() -> None:
    game = Packing(3, seed=1, com_offset=(0.1, 0, 0), auto_reset=False)
    policy = make_policy("dblf")
    while bool(game.alive.any()):
        game.place(*policy(game))
    plans = [Plan.from_bins(game.bins, k, unit_mm=60.0) for k in range(3)]
    for k, plan in enumerate(plans):
        n = int(game.bins.count[k])
        assert len(plan) == n
        assert torch.equal(torch.from_numpy(plan.boxes), game.bins.boxes[k, :n].long())
        assert torch.equal(torch.from_numpy(plan.loads), game.bins.loads[k, :n])
        assert plan.utilization == float(game.bins.filled[k]) / 1000
        assert plan.unit_mm == 60


class Labelled:
    """A state of one bin whose boxes have labels."""

    size = BIN
    count = torch.tensor([2])
    boxes = torch.tensor([ROWS])
    loads = torch.from_numpy(PLAIN.loads)[None]
    labels = torch.tensor([[(1, 3), (-1, -1)]])


def test_labels_of_a_state_become_ids_and_orientations() -> None:
    plan = Plan.from_bins(Labelled(), 0, id_names=("first", "second"))  # type: ignore[arg-type]  # all that is read
    assert plan.ids == ("second", "")
    assert plan.orientations.tolist() == [3, -1]
    assert Plan.from_bins(Labelled(), 0).ids == ("1", "")  # type: ignore[arg-type]  # the same


def test_a_plan_prints_as_one_line() -> None:
    boxes = [(0, 0, 0, 400, 300, 200), (0, 0, 200, 400, 300, 300)]
    plan = Plan.of_boxes((800, 300, 1000), boxes, unit_mm=1)
    assert str(plan) == "2 boxes in a bin of 800 × 300 × 1000 units of 1 mm, 25.0% filled"
    assert str(plan.first(1)).startswith("1 box in a bin of ")
