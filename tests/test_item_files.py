"""Files of items and plans that others wrote: refused in one sentence, or read as they are."""

from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fuzz import item_files

from marl_pack import inputs
from marl_pack.game.packing import Packing
from marl_pack.items import Items, Sequences, fingerprint, independent, load, make_stream
from marl_pack.plan import Plan
from marl_pack.plan_archive import load_plans

BIN = (10, 10, 10)


def read_items(path: Path) -> None:
    stream, _ = load(path, BIN)
    items = stream.item(stream.start(0, torch.arange(stream.episodes)), torch.tensor(0))
    assert (items.sides >= 1).all()
    assert (items.sides <= 10).all()
    assert (items.weights > 0).all()


@pytest.mark.parametrize("plans", [False, True])
def test_a_bad_file_is_refused_in_one_line_that_names_it(plans: bool, tmp_path: Path) -> None:
    read = load_plans if plans else read_items
    for name, content, suffix in item_files.good_files(plans):
        path = tmp_path / f"{name}{suffix}"
        path.write_bytes(content)
        read(path)
    number = 0
    for name, content, suffix in item_files.cases(seed=5, count=300, plans=plans):
        path = tmp_path / f"file{suffix}"
        path.write_bytes(content)
        refusal = refusal_of(read, path)
        if refusal is None:
            assert not name.startswith("bad"), f"{name} is accepted"
        else:
            assert refusal.startswith(f"{path}: "), name
            assert len(refusal.splitlines()) == 1, name
            assert len(refusal) < 600, name
            number += 1
    assert number > 150


def refusal_of(read: Callable[[Path], None], path: Path) -> str | None:
    """The message with which a file is refused, or None if it is read."""
    try:
        read(path)
    except ValueError as error:
        return str(error)
    return None


@pytest.mark.parametrize("cell", ["5", " 5 ", "5.0", "+5", "05", "5e0"])
def test_a_number_of_a_table_is_written_in_decimals(cell: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"w,d,h,weight,quantity\n{cell},2,2,{cell},{cell}\n", encoding="utf-8-sig")
    stream, _ = load(path, BIN)
    assert stream.items.sides.tolist() == [[[5, 2, 2]] * 5]
    assert stream.items.weights.tolist() == [[5.0] * 5]


def test_files_and_archives_have_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table, archive, goods = (tmp_path / name for name in ("a.csv", "a.npz", "a.json"))
    table.write_text("w,d,h\n" + "2,2,2\n" * 200)
    np.savez_compressed(archive, items=np.full((200, 3), 2))
    goods.write_text('{"items": [[2, 2, 2], [3, 3, 3]], "quantity": [5000000, 5000001]}')
    assert load(table, BIN)[0].longest == load(archive, BIN)[0].longest == 200
    with pytest.raises(ValueError, match=r"a.json: 10000001 items: needs at most 10000000"):
        load(goods, BIN)
    monkeypatch.setattr(inputs, "MAX_TEXT", 1 << 10)
    monkeypatch.setattr(inputs, "MAX_ARRAYS", 1 << 10)
    with pytest.raises(ValueError, match=r"a.csv: too large: needs at most"):
        load(table, BIN)
    with pytest.raises(ValueError, match=r"a.npz: .*unpack to at most"):
        load(archive, BIN)


def ragged(counts: list[int]) -> Sequences:
    """Sequences of these numbers of items, all items different, with every attribute."""
    numbers = iter(range(sum(counts)))
    items = [[[1 + k % 9, 1 + k // 9 % 9, 1 + k // 81] for k in islice(numbers, count)]
             for count in counts]  # fmt: skip
    goods = {"items": items, "ids": [[f"{row}" + "x" for row in rows] for rows in items],
             "orientations": [[[sum(row) % 6] for row in rows] for rows in items]}  # fmt: skip
    stream = make_stream(goods, BIN)
    assert isinstance(stream, Sequences)
    return stream


def numbers_in(stream: Any) -> int:
    """How many numbers the tensors of a stream have."""
    parts = [value.tensors() if isinstance(value, Items) else {"": value}
             for value in vars(stream).values()]  # fmt: skip
    return sum(t.numel() for part in parts for t in part.values() if isinstance(t, torch.Tensor))


def test_sequences_cost_memory_in_proportion_to_their_rows() -> None:
    rows = 2 * 300
    stream = ragged([1] * 300 + [300])
    assert numbers_in(stream) <= 14 * rows
    assert numbers_in(independent(stream)) <= 14 * rows
    bin_of_table = Packing(2, BIN, stream)
    assert bin_of_table.items.sides.tolist() == [[1, 1, 1], [2, 1, 1]]


def test_sequences_of_rows_play_as_padded_tables() -> None:
    counts = [3, 1, 4, 1, 5]
    stream = ragged(counts)
    table = stream.items
    assert table.sides.shape == (5, 5, 3)
    assert table.present.sum(1).tolist() == counts
    assert (stream.episodes, stream.longest) == (5, 5)
    state = stream.start(0, torch.arange(10))
    for t in range(7):
        items = stream.item(state, torch.full((10,), t))
        for name, values in items.tensors().items():
            padded = table.tensors()[name]
            right = padded[:, t] if t < 5 else torch.zeros_like(padded[:, 0])
            assert torch.equal(values, right.repeat(2, *[1] * (right.ndim - 1))), name
    in_turn = table.map(lambda values: values.transpose(0, 1))
    drawn = independent(stream)
    right = in_turn[in_turn.present]
    for name, values in drawn.items.tensors().items():  # type: ignore[attr-defined]  # a table
        assert torch.equal(values, right.tensors()[name]), name


@pytest.mark.parametrize("key", ["items", "weights", "lengths"])
def test_masked_values_are_refused(key: str) -> None:
    goods = {
        "items": np.full((2, 2, 3), 2),
        "weights": np.ones((2, 2)),
        "lengths": np.array([2, 2]),
    }
    assert make_stream(goods, BIN).longest == 2
    goods[key] = np.ma.masked_array(goods[key], np.ones_like(goods[key], bool))
    with pytest.raises(ValueError, match="items: has masked values; needs them left out"):
        make_stream(goods, BIN)


def test_where_a_sequence_ends_is_part_of_its_fingerprint() -> None:
    rows = [[2, 2, 2], [3, 3, 3], [4, 4, 4]]
    ends = [[rows], [rows[:1], rows[1:]], [rows[:2], rows[2:]]]
    assert len({fingerprint(make_stream(items, BIN)) for items in ends}) == 3


WHOLE = make_stream("rs", BIN)


@pytest.mark.parametrize(
    ("member", "value", "why"),
    [
        ("smallest", 0, "smallest: needs a whole number >= 1, not 0"),
        ("smallest", 8.0, "smallest: needs a whole number"),
        ("longest", True, "longest: needs a whole number"),
        ("episodes", -1, "episodes: needs a whole number"),
        ("sides", None, "sides needs the shortest and the longest side"),
        ("sides", (5, 2), "longest of sides: needs a whole number >= 5"),
        ("orientation_sets", {}, "orientation_sets needs a mapping"),
        ("item", None, "item needs to be a method"),
    ],
)
def test_a_stream_with_an_impossible_member_is_refused(member: str, value: Any, why: str) -> None:
    class Other:
        def __getattr__(self, name: str) -> Any:
            return value if name == member else getattr(WHOLE, name)

    with pytest.raises(ValueError, match=rf"^items Other: {why}"):
        Packing(1, BIN, Other())  # type: ignore[arg-type]  # the fault


def test_a_plan_of_long_sides_has_the_right_utilization() -> None:
    side = 10**8
    plan = Plan.of_boxes((side, side, 2 * side), [(0, 0, 0, side, side, side)])
    assert plan.utilization == 0.5
    with pytest.raises(ValueError, match="sides: needs lengths of at most 1e"):
        Plan.of_boxes((10, 10, 10), [(0, 0, 0, 2**63 - 1, 1, 1)])
