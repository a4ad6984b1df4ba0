import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

from marl_pack.game.packing import Packing
from marl_pack.items import Uniform, check_items, cut, independent, load, make_stream
from marl_pack.items.random_numbers import below, episode_keys, mix
from marl_pack.items.streams import _uniform_items

BIN = (10, 10, 10)


def sequence(stream, seed: int, episode: int, length: int) -> list[list[int]]:
    state = stream.start(seed, torch.tensor([episode]))
    return [stream.item(state, torch.tensor([t]))[0][0].tolist() for t in range(length)]


@pytest.mark.parametrize("name", ["rs", "cut1", "cut2"])
def test_an_episode_is_the_same_in_every_batch(name: str) -> None:
    stream = make_stream(name, BIN)
    together = stream.start(7, torch.arange(50))
    for t in range(8):
        items = stream.item(together, torch.full((50,), t))[0]
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
    items = torch.cat([stream.item(state, torch.full((2000,), t))[0] for t in range(32)])
    kind = ((items.long() - 2) * torch.tensor([16, 4, 1])).sum(1)
    counts = torch.bincount(kind, minlength=64)
    assert len(counts) == 64
    assert stats.chisquare(counts.numpy()).pvalue > 1e-4


def test_the_compiled_draw_equals_the_tensor_one() -> None:
    keys, t = episode_keys(-5, torch.arange(4000)), torch.arange(4000) % 37
    sides, weights = np.empty((4000, 3), np.int16), np.empty(4000)
    _uniform_items(keys.numpy(), t.numpy(), 1, 5, sides, weights)
    kind = below(mix(keys, t), 125)
    assert (sides == torch.stack((kind // 25, kind // 5 % 5, kind % 5), 1).numpy() + 1).all()
    assert (weights == sides.astype(float).prod(1)).all()


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
        assert torch.equal(game.items.long(), torch.stack((w, d, h), 1))
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


def test_an_item_that_fits_lying_down_is_taken() -> None:
    assert check_items([[2, 2, 9]], (10, 4, 4)).items.tolist() == [[[2, 2, 9]]]


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
    sides, weights = sequences.item(state, torch.tensor([1, 1, 0]))
    assert sides.tolist() == [[5, 5, 5], [0, 0, 0], [2, 3, 4]]
    assert weights.tolist() == [125, 0, 24]

    (tmp_path / "b.json").write_text('{"bin": [9, 9, 9], "items": [[[2,2,2]], [[3,3,3],[4,4,4]]]}')
    sequences, size = load(tmp_path / "b.json")
    assert size == (9, 9, 9)
    assert sequences.items.tolist() == [[[2, 2, 2], [0, 0, 0]], [[3, 3, 3], [4, 4, 4]]]

    (tmp_path / "c.csv").write_text("w, d, h, weight\n2,3,4,1.5\n5,5,5,0.25\n")
    sequences, _ = load(tmp_path / "c.csv", BIN)
    assert sequences.items.tolist() == [[[2, 3, 4], [5, 5, 5]]]
    assert sequences.weights.tolist() == [[1.5, 0.25]]


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("a.csv", "w,d\n1,2\n", "no column h"),
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


def test_items_one_by_one_are_as_probable_as_in_their_sequences() -> None:
    rows = [[[2, 2, 2], [3, 3, 3]], [[2, 2, 2], [4, 5, 3]]]
    drawn = independent(make_stream(rows, BIN))
    state = drawn.start(3, torch.arange(4000))
    sides, weights = drawn.item(state, torch.zeros(4000, dtype=torch.int64))
    assert torch.equal(weights, sides.double().prod(1))
    share = (sides == 2).all(1).double().mean().item()
    assert share == pytest.approx(0.5, abs=0.04)
    assert drawn.sides == (2, 5)
    assert drawn.smallest == 8
    assert len({tuple(row) for row in sides.tolist()}) == 3
    uniform = make_stream("rs", BIN)
    assert independent(uniform) is uniform
    pieces = independent(make_stream("cut1", BIN))
    found, _ = pieces.item(pieces.start(0, torch.arange(500)), torch.full((500,), 7))
    assert found.min() == 2
    assert found.max() == 5
