import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

from marl_pack.backend import Backend
from marl_pack.game.packing import Packing
from marl_pack.items import (
    ATTRIBUTES,
    Items,
    Sequences,
    Uniform,
    check_items,
    cut,
    fingerprint,
    independent,
    load,
    make_stream,
)
from marl_pack.items.random_numbers import below, episode_keys, mix

BIN = (10, 10, 10)


def sequence(stream, seed: int, episode: int, length: int) -> list[list[int]]:
    state = stream.start(seed, torch.tensor([episode]))
    return [stream.item(state, torch.tensor([t])).sides[0].tolist() for t in range(length)]


@pytest.mark.parametrize("name", ["rs", "cut1", "cut2"])
def test_an_episode_is_the_same_in_every_batch(name: str) -> None:
    stream = make_stream(name, BIN)
    together = stream.start(7, torch.arange(50))
    for t in range(8):
        items = stream.item(together, torch.full((50,), t)).sides
        for k in (0, 13, 49):
            assert items[k].tolist() == sequence(stream, 7, k, t + 1)[t]
    assert sequence(stream, 7, 3, 8) != sequence(stream, 8, 3, 8)
    assert sequence(stream, 7, 3, 8) != sequence(stream, 7, 4, 8)


def test_splitmix_matches_its_published_outputs() -> None:
    # First outputs of SplitMix64 from the state 1234567 (Steele, Lea & Flood's generator).
    key = torch.tensor([1234567])
    published = [6457827717110365317, 3203168211198807973, 9817491932198370423]
    assert [int(mix(key, t)) % 2**64 for t in range(3)] == published


def test_rs_draws_every_type_equally_often() -> None:
    stream = Uniform(2, 5)
    state = stream.start(0, torch.arange(2000))
    items = torch.cat([stream.item(state, torch.full((2000,), t)).sides for t in range(32)])
    kind = ((items.long() - 2) * torch.tensor([16, 4, 1])).sum(1)
    counts = torch.bincount(kind, minlength=64)
    assert len(counts) == 64
    assert stats.chisquare(counts.numpy()).pvalue > 1e-4


@pytest.mark.parametrize("backend", Backend)
def test_rs_draws_the_types_of_its_definition_in_every_backend(backend: Backend) -> None:
    stream = Uniform(1, 5).to("cpu", backend)
    assert stream.backend is backend
    state, t = stream.start(-5, torch.arange(4000)), torch.arange(4000) % 37
    items = stream.item(state, t)
    kind = below(mix(episode_keys(-5, torch.arange(4000)), t), 125)
    sides = torch.stack((kind // 25, kind // 5 % 5, kind % 5), 1) + 1
    assert items.sides.dtype == torch.int16
    assert torch.equal(items.sides.long(), sides)
    assert torch.equal(items.weights, sides.double().prod(1))
    assert items.ids is t
    assert items.orientations is None


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(
    ("size", "sides"),
    [(BIN, (2, 5)), (BIN, (1, 5)), ((12, 7, 9), (2, 4)), ((120, 60, 90), (6, 60))],
)
def test_cuts_replayed_through_the_masks_fill_the_bin(
    order: int, size: tuple[int, int, int], sides: tuple[int, int]
) -> None:
    n = 20
    boxes = cut(size, order, 3, torch.arange(n), sides)
    edges = boxes[..., 3:][boxes[..., 3] > 0]
    assert int(edges.min()) >= sides[0]
    assert int(edges.max()) <= sides[1]
    game = Packing(n, size, f"cut{order}", sides=sides, seed=3, auto_reset=False)
    for t in range(boxes.shape[1]):
        x, y, _, w, d, h = boxes[:, t].long().T
        assert torch.equal(game.items.sides.long(), torch.stack((w, d, h), 1))
        rest = game.bins.heightmap.long()
        here = game.alive
        cell = x * size[1] + y
        assert (boxes[here, t, 2] == rest.flatten(1)[here, cell[here]]).all()
        game.place(torch.zeros(n, dtype=torch.int64), cell)  # raises if the mask forbids it
    assert not game.alive.any()
    assert (game.bins.filled == size[0] * size[1] * size[2]).all()


def test_cut_1_comes_by_height_and_cut_2_by_any_finished_floor() -> None:
    first = cut(BIN, 1, 0, torch.arange(200), (2, 5))
    real = first[..., 3] > 0
    falls = (first[:, 1:, 2] < first[:, :-1, 2]) & real[:, 1:]
    assert not falls.any()
    second = cut(BIN, 2, 0, torch.arange(200), (2, 5))
    assert ((second[:, 1:, 2] < second[:, :-1, 2]) & (second[:, 1:, 3] > 0)).any()


def test_after_the_last_piece_of_a_cut_bin_there_is_no_item() -> None:
    stream = make_stream("cut1", (2, 2, 2), (1, 1))  # eight pieces, as many as there can be
    state = stream.start(0, torch.arange(5))
    present = [stream.item(state, torch.full((5,), t)).present for t in range(12)]
    assert torch.stack(present[:8]).all()
    assert not torch.stack(present[8:]).any()


def test_cuts_are_uniform_over_the_positions_of_all_long_edges() -> None:
    # With edges of 3 … 6 cells a floor of 7 x 9 is first cut at one of two positions across x or of
    # four across y. Then both parts are cut across the other edge, so only the first cut is one
    # straight line, unless the two later ones meet.
    boxes = cut((7, 9, 3), 1, 0, torch.arange(6000), (3, 6)).numpy()
    assert boxes.shape[1] == 4
    positions = [np.sort(boxes[:, :, axis])[:, 2:] for axis in (0, 1)]  # the two that are not 0
    bent_x, bent_y = ((low != high).sum() for low, high in (p.T for p in positions))
    straight = 6000 - bent_x - bent_y
    # First across x, 1/3: the cuts across y differ in 3 of 4. First across y, 2/3: in 1 of 2.
    expected = np.array([1 / 3, 1 / 4, 5 / 12]) * 6000
    assert stats.chisquare([bent_x, bent_y, straight], expected).pvalue > 1e-4
    for place, first, last in zip(positions, (3, 3), (4, 6), strict=True):
        counts = np.bincount(place.ravel(), minlength=7)[first : last + 1]
        assert counts.sum() == place.size
        assert counts.min() > 0.9 * counts.mean()


def test_neighbours_of_cut_1_are_equal_as_often_as_in_the_published_sequences(
    data_folder: Path,
) -> None:
    def share(sides: np.ndarray) -> float:
        """The share of neighbours in a sequence that are the same box."""
        present = (sides[:, 1:, 0] > 0) & (sides[:, :-1, 0] > 0)
        same = (np.sort(sides[:, 1:]) == np.sort(sides[:, :-1])).all(2)
        return float(same[present].mean())

    published = load(data_folder / "cut_1.npz")[0].items.sides.numpy()
    own = cut(BIN, 1, 0, torch.arange(8000), (2, 5))[..., 3:].numpy()
    assert share(own) == pytest.approx(share(published), abs=0.0025)


@pytest.mark.parametrize("sides", [(3, 4), (11, 30), (0, 5), (5, 2), (2.5, 5)])
def test_sides_that_no_cut_can_give_are_refused(sides: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=r"cutting|sides"):
        make_stream("cut1", BIN, sides)


def test_rs_items_larger_than_the_bin_are_refused() -> None:
    with pytest.raises(ValueError, match="longest side can be 4"):
        make_stream("rs", (10, 4, 10))


@pytest.mark.parametrize(
    ("row", "why"),
    [
        ([2, 2, 11], "no orientation"),
        ([2, -1, 3], "zero or negative"),
        ([2, 0, 3], "zero or negative"),
        ([2, 2.5, 3], "fraction"),
        ([2, float("nan"), 3], "not a number"),
        ([2, float("inf"), 3], "not a number"),
    ],
)
@pytest.mark.parametrize("kind", ["array", "npz", "json", "csv"])
def test_an_impossible_item_is_refused_with_its_row(
    row: list[float], why: str, kind: str, tmp_path: Path
) -> None:
    rows = [[2, 3, 4], [5, 5, 5], row, [2, 2, 2]]
    path = tmp_path / f"items.{kind}"
    with pytest.raises(ValueError, match=rf"row 2 .*{why}"):
        if kind == "array":
            check_items(rows, BIN)
        elif kind == "npz":
            np.savez(path, items=np.array(rows))
            load(path, BIN)
        elif kind == "json":
            path.write_text(json.dumps({"items": rows}))
            load(path, BIN)
        else:
            path.write_text("w,d,h\n" + "\n".join(",".join(map(str, r)) for r in rows))
            load(path, BIN)


def test_an_item_that_fits_lying_down_is_accepted() -> None:
    assert check_items([[2, 2, 9]], (10, 4, 4)).items.sides.tolist() == [[[2, 2, 9]]]


def test_files_give_sequences_weights_and_bin(tmp_path: Path) -> None:
    np.savez(
        tmp_path / "a.npz",
        items=np.array([[[2, 3, 4], [5, 5, 5]], [[3, 3, 3], [0, 0, 0]]], np.int8),
        lengths=np.array([2, 1], np.int16),
        bin=np.array([9, 8, 7]),
    )
    sequences, size = load(tmp_path / "a.npz")
    assert size == (9, 8, 7)
    assert sequences.episodes == 2
    state = sequences.start(0, torch.tensor([0, 1, 2]))
    items = sequences.item(state, torch.tensor([1, 1, 0]))
    assert items.sides.tolist() == [[5, 5, 5], [0, 0, 0], [2, 3, 4]]
    assert items.weights.tolist() == [125, 0, 24]

    (tmp_path / "b.json").write_text('{"bin": [9, 9, 9], "items": [[[2,2,2]], [[3,3,3],[4,4,4]]]}')
    sequences, size = load(tmp_path / "b.json")
    assert size == (9, 9, 9)
    assert sequences.items.sides.tolist() == [[[2, 2, 2], [0, 0, 0]], [[3, 3, 3], [4, 4, 4]]]

    (tmp_path / "c.csv").write_text("w, d, h, weight\n2,3,4,1.5\n5,5,5,0.25\n")
    sequences, _ = load(tmp_path / "c.csv", BIN)
    assert sequences.items.sides.tolist() == [[[2, 3, 4], [5, 5, 5]]]
    assert sequences.items.weights.tolist() == [[1.5, 0.25]]


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("a.csv", "w,d\n1,2\n", "no column 'h'"),
        ("b.csv", "w,d,h\n1,two,3\n", "row 0"),
        ("c.csv", "w,d,h,weight\n2,2,2,-1\n", "row 0 .*weight"),
        ("d.csv", "w,d,h\n", "no items"),
        ("e.json", "{", "JSON"),
        ("f.json", '{"boxes": []}', "no key 'items'"),
        ("g.npz", "not an archive", "archive"),
        ("h.txt", "1 2 3", "ending"),
        ("i.json", '{"items": [[2,2,2],[2,3],[2,2,2]]}', "row 1"),
        ("j.json", '{"items": [[[2,2,2]], 5]}', "sequence 1"),
        ("k.json", '{"items": [[2,2,true]]}', "row 0"),
        ("l.json", '{"items": [[2,2,2]], "bin": 10}', "bin size"),
        ("m.json", '{"items": [[2,2,2]], "bin": [20,20,20]}', "is for the bin"),
        ("n.json", '{"items": [[[2,2,2]],[[3,3,3]]], "weights": [1]}', "weights"),
        ("o.csv", "w,w,d,h\n1,2,3,4\n", "twice"),
        ("p.csv", "w,d,h\n1,2,3,4\n", "row 0 .line 2."),
    ],
)
def test_an_unreadable_file_is_refused(name: str, text: str, why: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=why):
        load(tmp_path / name, BIN)


def test_a_file_without_a_bin_size_asks_for_one(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("w,d,h\n2,2,2\n")
    with pytest.raises(ValueError, match="bin size"):
        load(tmp_path / "a.csv")
    with pytest.raises(FileNotFoundError, match="no such file"):
        load(tmp_path / "b.csv", BIN)
    with pytest.raises(ValueError, match="unknown items 'sr'"):
        make_stream("sr", BIN)


def test_items_after_a_sequences_end_are_refused() -> None:
    with pytest.raises(ValueError, match=r"sequence 0, row 2 .*after the end"):
        check_items([[[2, 2, 2], [0, 0, 0], [3, 3, 3]]] * 2, BIN)
    with pytest.raises(ValueError, match="sequence 1 has no items"):
        check_items([[[2, 2, 2]], [[0, 0, 0]]], BIN)


def test_the_published_sequences_are_read(data_folder: Path) -> None:
    for name in ("rs.npz", "cut_1.npz"):
        sequences, size = load(data_folder / name)
        assert size == BIN
        assert sequences.episodes == 2100


@pytest.mark.parametrize("name", ["cut1", "cut2"])
def test_independent_items_are_those_of_no_episode_that_is_played(name: str) -> None:
    stream = make_stream(name, BIN, (2, 5))
    drawn = independent(stream, 5).items.sides.tolist()
    for seed in range(4):
        state = stream.start(seed, torch.arange(5))
        played = [state[:, t].tolist() for t in range(state.shape[1])]
        assert drawn != [sides for step in played for sides in step if sides[0] > 0]


def test_independent_items_are_as_probable_as_in_their_sequences() -> None:
    rows = [[[2, 2, 2], [3, 3, 3]], [[2, 2, 2], [4, 5, 3]]]
    drawn = independent(make_stream(rows, BIN))
    state = drawn.start(3, torch.arange(4000))
    items = drawn.item(state, torch.zeros(4000, dtype=torch.int64))
    sides, weights = items.sides, items.weights
    assert torch.equal(weights, sides.double().prod(1))
    share = (sides == 2).all(1).double().mean().item()
    assert share == pytest.approx(0.5, abs=0.04)
    assert drawn.sides == (2, 5)
    assert drawn.smallest == 8
    assert len({tuple(row) for row in sides.tolist()}) == 3
    uniform = make_stream("rs", BIN)
    assert independent(uniform) is uniform
    pieces = independent(make_stream("cut1", BIN))
    t = torch.full((500,), 7)
    items = pieces.item(pieces.start(0, torch.arange(500)), t)
    assert items.sides.min() == 2
    assert items.sides.max() == 5
    assert items.ids is t
    assert independent(pieces) is pieces


# --- attributes of goods --------------------------------------------------------------------------

ROWS = [[2, 3, 4], [5, 5, 5], [4, 2, 2]]
GOODS = {
    "items": ROWS,
    "weights": [1.5, 0.25, 3],
    "upright": [True, False, False],
    "orientations": [[0, 1], [0, 1, 2, 3, 4, 5], [2, 4]],
    "ids": ["red", "blue", "red"],
    "quantity": [1, 2, 1],
}
CSV = """w,d,h,weight,upright,orientations,id,quantity
2,3,4,1.5,yes ,0 1, red ,1
5,5,5,0.25,0,0 1 2 3 4 5,blue,2
4,2,2,3,False,2 4,red,1
"""


def goods_stream(kind: str, goods: dict, folder: Path) -> Sequences:
    """Goods as the stream that they give by way of a file, arrays, a mapping or a record."""
    path = folder / f"goods.{kind}"
    if kind == "csv":
        columns = {"items": "w,d,h"} | {a.key: a.column for a in ATTRIBUTES}
        lines = [",".join(columns[key] for key in goods)]
        for values in zip(*goods.values(), strict=True):
            cells = [values[0][0], values[0][1], values[0][2], *values[1:]]
            lines.append(
                ",".join(" ".join(map(str, c)) if isinstance(c, list) else str(c) for c in cells)
            )
        path.write_text("\n".join(lines))
        return load(path, BIN)[0]
    if kind == "json":
        path.write_text(json.dumps(goods))
        return load(path, BIN)[0]
    arrays = {key: np.array(values) for key, values in goods.items() if key != "orientations"}
    if "orientations" in goods:
        arrays["orientations"] = np.array([np.isin(range(6), o) for o in goods["orientations"]])
    if kind == "npz":
        np.savez(path, **arrays)
        return load(path, BIN)[0]
    if kind == "array":
        return check_items(arrays.pop("items"), BIN, **arrays)
    if kind == "mapping":
        return make_stream(goods, BIN)
    whole = check_items(ROWS, BIN, **{k: v for k, v in goods.items() if k != "items"}).items
    return make_stream(whole[0] if kind == "record" else whole, BIN)


FILES = ["csv", "json", "npz", "array", "mapping"]


@pytest.mark.parametrize("kind", FILES)
def test_goods_have_the_same_attributes_however_they_are_given(kind: str, tmp_path: Path) -> None:
    stream = goods_stream(kind, GOODS, tmp_path)
    assert stream.items.sides[0].tolist() == [[2, 3, 4], [5, 5, 5], [5, 5, 5], [4, 2, 2]]
    assert stream.items.weights[0].tolist() == [1.5, 0.25, 0.25, 3]
    allowed = [[o for o in range(6) if row[o]] for row in stream.items.orientations[0].tolist()]
    assert allowed == [[0, 1], [0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5], [2, 4]]
    names = [stream.id_names[number] for number in stream.items.ids[0]]
    assert names == ["red", "blue", "blue", "red"]
    assert stream.orientation_sets == {(0, 1): 0.25, (0, 1, 2, 3, 4, 5): 0.5, (2, 4): 0.25}
    items = stream.item(torch.tensor([0, 0]), torch.tensor([2, 4]))
    assert items.ids[0] == stream.items.ids[0, 1]
    assert items.orientations.all(1).tolist() == [True, False]
    assert items.sides.tolist() == [[5, 5, 5], [0, 0, 0]]


def test_a_csv_file_holds_attributes_as_words(tmp_path: Path) -> None:
    (tmp_path / "goods.csv").write_text(CSV)
    stream, _ = load(tmp_path / "goods.csv", BIN)
    assert fingerprint(stream) == fingerprint(make_stream(GOODS, BIN))


@pytest.mark.parametrize("kind", FILES)
def test_upright_alone_means_orientations_0_and_1(kind: str, tmp_path: Path) -> None:
    stream = goods_stream(kind, {"items": ROWS, "upright": [1, 0, 1]}, tmp_path)
    upright = [True, True, False, False, False, False]
    assert stream.items.orientations[0].tolist() == [upright, [True] * 6, upright]
    stream = goods_stream(kind, {"items": ROWS, "upright": [0, 0, 0]}, tmp_path)
    assert stream.items.orientations is None


@pytest.mark.parametrize("shape", ["record", "records"])
def test_a_record_of_items_is_a_stream(shape: str, tmp_path: Path) -> None:
    goods = {key: values for key, values in GOODS.items() if key != "ids"} | {"ids": [7, 8, 7]}
    stream, same = goods_stream(shape, goods, tmp_path), make_stream(goods, BIN)
    assert stream.id_names is None
    assert stream.items.ids[0].tolist() == [7, 8, 8, 7]
    assert fingerprint(stream) == fingerprint(same)


@pytest.mark.parametrize(
    ("ids", "numbers", "names"),
    [
        (["7", "12"], [7, 12], None),
        ([7, 12], [7, 12], None),
        (["007", "12"], [0, 1], ("007", "12")),
        (["b", "a"], [1, 0], ("a", "b")),
        ([str(10**30), "1"], [1, 0], ("1", str(10**30))),
    ],
)
def test_ids_are_numbers_or_texts(ids: list, numbers: list[int], names: tuple | None) -> None:
    stream = check_items([[1, 1, 1], [2, 2, 2]], BIN, ids=ids)
    assert stream.items.ids.tolist() == [numbers]
    assert stream.id_names == names
    assert stream.item(torch.tensor([0]), torch.tensor([1])).ids.tolist() == [numbers[1]]


def test_sequences_of_unequal_length_keep_their_attributes(tmp_path: Path) -> None:
    goods = {
        "items": [[[2, 2, 2]], [[3, 3, 3], [4, 4, 4]]],
        "weights": [[1], [2, 3]],
        "orientations": [[[0]], [[1], [0, 1]]],
        "quantity": [[3], [1, 1]],
        "ids": [[5], [6, 7]],
    }
    (tmp_path / "a.json").write_text(json.dumps(goods))
    (tmp_path / "a.csv").write_text(
        "sequence,w,d,h,weight,orientations,quantity,id\n"
        "z,2,2,2,1,0,3,5\nb,3,3,3,2,1,1,6\nb,4,4,4,3,0 1,1,7\n"
    )
    files = [load(tmp_path / name, BIN)[0] for name in ("a.json", "a.csv")]
    for stream in (make_stream(goods, BIN), *files):
        assert stream.items.sides[..., 0].tolist() == [[2, 2, 2], [3, 4, 0]]
        assert stream.items.weights.tolist() == [[1, 1, 1], [2, 3, 0]]
        assert stream.items.ids.tolist() == [[5, 5, 5], [6, 7, 0]]
        assert stream.items.orientations.sum(2).tolist() == [[1, 1, 1], [1, 2, 0]]
        assert stream.orientation_sets == {(0,): 0.6, (1,): 0.2, (0, 1): 0.2}
        assert fingerprint(make_stream(stream.items, BIN)) == fingerprint(stream)


@pytest.mark.parametrize(
    ("key", "value", "why"),
    [
        ("weights", 0, "weight .*; needs a positive number"),
        ("weights", "heavy", "weight .*; needs a positive number"),
        ("upright", "maybe", "upright .*; needs true or false"),
        ("upright", 2, "upright .*; needs true or false"),
        ("orientations", [0, 6], "orientations .*; needs one or more of the numbers 0 … 5"),
        ("orientations", [0, 0, 1, 0, 0, 0], "orientations .*; needs .*, each once"),
        ("orientations", [-1], "orientations .*; needs"),
        ("quantity", 0, "quantity .*; needs a whole number ≥ 1"),
        ("quantity", 1.5, "quantity .*; needs a whole number ≥ 1"),
    ],
)
@pytest.mark.parametrize("kind", ["json", "mapping", "csv"])
def test_an_impossible_attribute_is_refused_with_its_row(
    key: str, value: object, why: str, kind: str, tmp_path: Path
) -> None:
    values = [*GOODS[key][:2], value]
    with pytest.raises(ValueError, match=rf"row 2 is \[4.*: {why}"):
        goods_stream(kind, {"items": ROWS, key: values}, tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "why"),
    [
        ("orientations", [], r"orientations \[\]; needs"),
        ("orientations", [True], r"orientations \[True\]; needs"),
        ("orientations", 0, "orientations 0; needs"),
        ("ids", "", "id ''; needs a text or a whole number"),
        ("ids", 1.5, "id 1.5; needs a text or a whole number"),
        ("ids", True, "id True; needs a text or a whole number"),
        ("weights", None, "weight None; needs"),
    ],
)
@pytest.mark.parametrize("kind", ["json", "mapping"])
def test_a_value_of_a_wrong_type_is_refused_with_its_row(
    key: str, value: object, why: str, kind: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=rf"row 2 is \[4.*: {why}"):
        goods_stream(kind, {"items": ROWS, key: [*GOODS[key][:2], value]}, tmp_path)


def test_an_empty_cell_is_refused_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("w,d,h,id\n\n2,2,2,a\n2,2,2,\n")
    with pytest.raises(ValueError, match=r"row 1 \(line 4\) .*a value for each of w, d, h, id"):
        load(tmp_path / "a.csv", BIN)


@pytest.mark.parametrize(
    ("attributes", "why"),
    [
        ({"upright": [False, True]}, r"row 1 .*in none of its orientations \[0, 1\]"),
        ({"orientations": [[0], [1, 0]]}, r"row 1 .*in none of its orientations \[0, 1\]"),
        ({"orientations": [[0], [0, 2]], "upright": [1, 1]}, "row 1 .*may only be 0 and 1"),
        ({"weights": [1]}, "'weights' needs one value for each item"),
        ({"ids": "ab"}, "'ids' needs one value for each item"),
        ({"lengths": [3]}, "lengths need 1 whole numbers in 1 … 2"),
    ],
)
def test_attributes_that_exclude_each_other_are_refused(attributes: dict, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        check_items([[2, 2, 2], [2, 2, 5]], (6, 6, 4), **attributes)


def test_upright_may_be_combined_with_upright_orientations() -> None:
    goods = {"orientations": [[0], [2, 3], [1]], "upright": [True, False, False]}
    stream = check_items(ROWS, BIN, **goods)
    assert stream.items.orientations[0].int().argmax(1).tolist() == [0, 2, 1]
    assert stream.items.orientations.sum() == 4


# --- names ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("header", "hint"),
    [
        (
            "w,d,h,Weight",
            "unknown column 'Weight'; did you mean 'weight'? Columns: w, d, h, weight",
        ),
        ("w,d,h,this_side_up", "'this_side_up'; did you mean 'upright'?"),
        ("w,d,h,This side up", "'This side up'; did you mean 'upright'?"),
        ("w,d,h,mass", "'mass'; did you mean 'weight'?"),
        ("w,d,h,SKU", "'SKU'; did you mean 'id'?"),
        ("w,d,h,order_id", "'order_id'; did you mean 'sequence'?"),
        ("w,d,h,qty", "'qty'; did you mean 'quantity'?"),
        ("w,d,h,orientation", "'orientation'; did you mean 'orientations'?"),
        (
            "length,width,height,id",
            "no column 'w', 'd', 'h'; unknown column 'length'; did you mean",
        ),
        ("w,width,h,id", "'width'; did you mean 'd'?"),
        ("width,d,h,id", "'width'; did you mean 'w'?"),
        ("w,d,h,colour", "unknown column 'colour'. Columns: w, d, h"),
    ],
)
def test_an_unknown_column_is_refused_with_the_nearest(
    header: str, hint: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"{header}\n2,2,2,1\n")
    with pytest.raises(ValueError, match=re.escape(hint)) as error:
        load(path, BIN)
    assert str(error.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("weight", "did you mean 'weights'?"),
        ("name", "did you mean 'ids'?"),
        ("mass", "did you mean 'weights'?"),
        ("colour", "unknown [a-z]+ 'colour'. [A-Z]"),
    ],
)
@pytest.mark.parametrize("kind", FILES[1:])
def test_an_unknown_key_is_refused_with_the_nearest(
    key: str, hint: str, kind: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=hint.replace("?", r"\?")):
        goods_stream(kind, {"items": ROWS, key: [1, 1, 1]}, tmp_path)


def test_a_mapping_is_for_its_own_bin() -> None:
    assert make_stream({"items": ROWS, "bin": BIN}, BIN).longest == 3
    with pytest.raises(ValueError, match=r"unknown key 'Bin'; did you mean 'bin'\?"):
        make_stream({"items": ROWS, "Bin": BIN}, BIN)
    with pytest.raises(ValueError, match="items: is for the bin"):
        make_stream({"items": ROWS, "bin": [9, 9, 9]}, BIN)
    with pytest.raises(
        ValueError, match="items: no key 'items'; unknown key 'boxes'; did you mean"
    ):
        make_stream({"boxes": ROWS}, BIN)


def test_an_object_that_lacks_a_member_of_a_stream_is_refused() -> None:
    class Half:
        smallest, sides, episodes, longest, id_names, orientation_sets = 8, (2, 5), 1, 1, None, {}

        def start(self, seed: int, episodes: torch.Tensor) -> torch.Tensor:
            return episodes

        def to(self, device: str) -> "Half":
            return self

    with pytest.raises(ValueError, match=r"items Half: .* needs restart, item$"):
        make_stream(Half(), BIN)
    whole = make_stream("cut1", BIN)
    assert make_stream(whole, BIN) is whole


# --- states and fingerprints ----------------------------------------------------------------------


def stream_of(name: str, backend: Backend) -> object:
    """A stream by its name, with the code of a backend."""
    goods = {"items": [[[k, 2, 2], [2, k, 3]] for k in range(1, 6)]}
    table = make_stream(goods, BIN)
    streams = {"sequences": table, "drawn": independent(table)}
    return (streams.get(name) or make_stream(name, BIN)).to("cpu", backend)


@pytest.mark.parametrize("backend", Backend)
@pytest.mark.parametrize("name", ["rs", "cut1", "cut2", "sequences", "drawn"])
def test_a_restart_changes_only_the_episodes_that_ended(name: str, backend: Backend) -> None:
    stream = stream_of(name, backend)
    before = stream.start(3, torch.arange(6))
    copy = before.clone()
    episodes = torch.arange(6) + 9
    ended = torch.tensor([True, False, False, True, True, False])
    state = stream.restart(before, 3, episodes, ended)
    begun = stream.start(3, episodes)
    assert torch.equal(before, copy), "the state given is not changed"
    assert torch.equal(state[ended], begun[ended])
    assert torch.equal(state[~ended], before[~ended])
    assert not torch.equal(begun[ended], before[ended])
    assert not torch.equal(begun[~ended], before[~ended])
    assert torch.equal(
        stream.restart(before, 3, episodes, torch.zeros(6, dtype=torch.bool)), before
    )


@pytest.mark.parametrize("backend", Backend)
def test_the_fingerprint_of_rs_is_that_of_saved_games(backend: Backend) -> None:
    assert fingerprint(make_stream("rs", BIN).to("cpu", backend)) == 54910279278873042


def test_fingerprints_of_streams_without_attributes_stay() -> None:
    assert fingerprint(make_stream("cut1", BIN)) == 53488612129790224
    rows = make_stream([[2, 3, 4], [5, 5, 5]], BIN)
    assert fingerprint(rows) == 25778313913411233
    assert fingerprint(independent(rows)) == 71845663407437813


def test_fingerprints_differ_by_every_attribute() -> None:
    others = [{"weights": [1, 2, 3]}, {"upright": [1, 0, 0]}, {"upright": [0, 1, 0]},
              {"orientations": [[0], [1], [2]]}, {"ids": [1, 2, 3]}, {"ids": ["a", "b", "c"]},
              {"ids": ["a", "b", "d"]}, {"quantity": [1, 1, 2]}]  # fmt: skip
    streams = [check_items(ROWS, BIN, **attributes) for attributes in ({}, *others)]
    streams += [independent(stream) for stream in streams]
    assert len({fingerprint(stream) for stream in streams}) == 2 * (1 + len(others))


def test_drawn_items_keep_their_attributes() -> None:
    drawn = independent(make_stream(GOODS, BIN))
    items = drawn.item(drawn.start(0, torch.arange(900)), torch.arange(900))
    rows = {
        (tuple(s), w, tuple(o), drawn.id_names[i])
        for s, w, o, i in zip(
            items.sides.tolist(), items.weights.tolist(), items.orientations.tolist(),
            items.ids.tolist(), strict=True,
        )
    }  # fmt: skip
    whole = tuple([True] * 6)
    upright = (True, True, False, False, False, False)
    lying = (False, False, True, False, True, False)
    assert rows == {
        ((2, 3, 4), 1.5, upright, "red"),
        ((5, 5, 5), 0.25, whole, "blue"),
        ((4, 2, 2), 3.0, lying, "red"),
    }
    assert drawn.orientation_sets == {(0, 1): 0.25, (0, 1, 2, 3, 4, 5): 0.5, (2, 4): 0.25}


def test_generated_items_may_take_every_orientation() -> None:
    for name in ("rs", "cut1", "cut2"):
        stream = make_stream(name, BIN)
        t = torch.zeros(3, dtype=torch.int64)
        items = stream.item(stream.start(0, torch.arange(3)), t)
        assert isinstance(items, Items)
        assert items.ids is t
        assert items.orientations is None
        assert stream.id_names is None
        assert stream.orientation_sets == {(0, 1, 2, 3, 4, 5): 1.0}


def test_commas_after_the_last_column_are_ignored(tmp_path: Path) -> None:
    (tmp_path / "sheet.csv").write_text("w,d,h,,\n2,3,4,,\n1,1,1,,\n")
    sequences, _ = load(tmp_path / "sheet.csv", BIN)
    item = sequences.item(sequences.start(0, torch.tensor([0])), torch.tensor([1]))
    assert item.sides.tolist() == [[1, 1, 1]]
    (tmp_path / "more.csv").write_text("w,d,h,\n2,3,4,5\n")
    with pytest.raises(ValueError, match="row 0"):
        load(tmp_path / "more.csv", BIN)
