"""The packer with a buffer, a preview and several open bins."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_packer import BIN, KINDS, boxes, check_plan

from marl_pack import Plan, pack
from marl_pack.exact.bins import NOWHERE, ExactBins
from marl_pack.exact.futures import Shown
from marl_pack.exact.goods import joined
from marl_pack.exact.options import Options
from marl_pack.exact.policies import HEURISTICS, TUNED, read_weights
from marl_pack.exact.search import Search, _Trial
from marl_pack.exact.search_settings import ExactSearchSettings
from marl_pack.feed import Feed
from marl_pack.packer.answers import NoPlace, Placement, Waiting
from marl_pack.packer.calls import goods_of
from marl_pack.packer.packer import Packer
from marl_pack.packer.turn import Turn

VARIANTS = [(k, p, b) for k in (1, 3) for p in (0, 2) for b in (1, 2)]
POLICIES: dict[str, dict[str, Any]] = {
    "max_contact": {}, "dblf": {}, "random": {}, "rs": {"grid_mm": 100},
    "search": {"plan": "budget=1000s,top=4,futures=4"},
}  # fmt: skip


def packer_of(variant: tuple[int, int, int], policy: Any = "max_contact", **more: Any) -> Packer:
    k, p, b = variant
    options = {"bins": None, "buffer": k, "preview": p, "open_bins": b, **more}
    return Packer(BIN, policy, **options, **POLICIES.get(str(policy), {}))


def feed(packer: Packer, given: list[dict[str, Any]]) -> Iterator[Placement | NoPlace]:
    """Show boxes and place them; yield each answer. A box without a place is left out."""
    for box in given:
        packer.show(**box)
        while not packer.needs_box:
            yield packer.place_next() or packer.skip_next()
    while packer.waiting:
        yield packer.place_next() or packer.skip_next()


def content(packer: Packer, tmp_path: Path) -> Any:
    """All that a packer knows and saves."""
    packer.save(tmp_path / "saved.json")
    return (tmp_path / "saved.json").read_text(), packer.plan, packer.state


# --- without options ------------------------------------------------------------------------------


def test_without_options_each_box_gets_the_best_place_in_the_open_bin() -> None:
    """Call by call as plain code does it: the open bin first, then a new one."""
    policy = HEURISTICS["max_contact"]()
    packer, bin, number = Packer(BIN, bins=None), ExactBins(1, Packer(BIN).spec), 0
    for box in boxes(7, 40):
        answer = packer.place(**box)
        attributes = {key: value for key, value in box.items() if key != "sides"}
        item = goods_of(box["sides"], attributes, packer.spec)
        move = bin.best(item, policy.kind, policy.weights)
        if move[0] == NOWHERE:
            bin, number = ExactBins(1, packer.spec), number + 1
            move = bin.best(item, policy.kind, policy.weights)
        bin.place(item, move)
        assert isinstance(answer, Placement)
        assert (answer.bin, answer.number) == (number, None)
        row = bin.state.boxes[0, bin.state.count[0] - 1, :6] / 10
        assert [answer.x, answer.y, answer.z, answer.w, answer.d, answer.h] == row.tolist()
    assert number > 0


@pytest.mark.parametrize("policy", POLICIES)
def test_one_box_that_is_shown_is_placed_like_one_that_is_not(policy: str) -> None:
    one, other = packer_of((1, 0, 1), policy, seed=4), packer_of((1, 0, 1), policy, seed=4)
    for box in boxes(5, 8):
        placed, waits = one.place(**box), other.show(**box)
        assert isinstance(waits, Waiting)
        shown = other.place_next()
        assert {**shown.to_dict(), "number": None} == {**placed.to_dict(), "number": None}
        assert (shown.number, waits.id) == (waits.number, box["id"])
    assert one.plan == other.plan


# --- what may be chosen ---------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("policy", ["max_contact", "random"])
def test_every_packing_is_right_and_follows_the_rule_of_closing(
    policy: str, variant: tuple[int, int, int]
) -> None:
    k, p, b = variant
    packer, given = packer_of(variant, policy, seed=1), boxes(3, 45)
    known: list[int] = []
    opened, numbers = set(range(b)), iter(range(len(given)))
    for box in given:
        assert packer.show(**box)
        known.append(next(numbers))
        if packer.needs_box:
            continue
        assert [waits.number for waits in packer.waiting] == known
        assert len(known) == k + p
        before = packer.state
        answer = packer.place_next()
        assert isinstance(answer, Placement)
        assert answer.number in known[:k]  # those of the preview keep their order
        assert answer.id == given[answer.number]["id"]
        known.remove(answer.number)
        if answer.bin not in opened:  # it is new: the fullest was closed, and nothing fitted
            fullest = max(opened, key=lambda n: (before.utilization[n], -n))
            assert set(packer.state.open_bins) == opened - {fullest} | {answer.bin}
            packer.undo()
            stuck = Packer(BIN, policy, bins=before.bins, buffer=k, preview=p, open_bins=b, seed=1)
            stuck.replay(packer.calls)
            assert not stuck.place_next()
            packer.place_next()
            opened = set(packer.state.open_bins)
        assert set(packer.state.open_bins) == opened
    while packer.waiting:
        assert packer.place_next()
    plan = packer.plan
    check_plan(plan, {box["id"]: box for box in given})
    assert len(plan) == len(given)
    assert len(plan.bin_sizes) > b  # some were closed
    assert packer.state.boxes == tuple(np.bincount(plan.bins, minlength=packer.state.bins))


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_visible_box_with_a_place_may_be_chosen(variant: tuple[int, int, int]) -> None:
    """A function may choose any option; every visible box and every open bin is one."""
    k, _, b = variant
    chosen: set[tuple[int, int]] = set()
    generator = np.random.default_rng(2)

    def any_option(turn: Turn) -> Any:
        moves = np.full(len(turn.pairs), NOWHERE)
        able = np.flatnonzero(turn.moves.counts)
        if len(able):
            g = int(generator.choice(able))
            moves[g] = turn.moves.of(g)[0]
            chosen.add((int(turn.pairs[g, 0]), int(turn.pairs[g, 1])))
        return moves

    packer = packer_of(variant, any_option)
    given = boxes(6, 40)
    assert all(feed(packer, given))
    assert chosen == {(i, j) for i in range(k) for j in range(b)}
    check_plan(packer.plan, {box["id"]: box for box in given})


def test_a_box_without_a_place_waits_while_another_one_has_one() -> None:
    """The bin is 300 wide: after the first box only the flat one fits on top of it."""
    packer = Packer((300, 300, 300), buffer=2, orientations=[0])
    sides = [(300, 300, 200), (300, 300, 150), (300, 300, 60), (300, 300, 40)]
    answers = list(feed(packer, [{"sides": s, "id": str(k)} for k, s in enumerate(sides)]))
    assert [(answer.id, bool(answer)) for answer in answers] == [
        ("0", True), ("2", True), ("3", True), ("1", False)
    ]  # fmt: skip
    assert [(box.id, box.reason) for box in packer.plan.left_out] == [("1", answers[3].reason)]


def test_the_policy_does_not_see_what_is_hidden() -> None:
    """Two conveyors that begin alike are packed alike as far as boxes were known alike."""
    seen: list[list[Any]] = []

    def watches(turn: Turn) -> Any:
        seen[-1].append([turn.known.sides.tolist(), turn.shown(0).sides.tolist()])
        return turn.bins.best(turn.items, 1, np.zeros(13))

    first, second = boxes(1, 20), boxes(2, 20)
    for given in (first, first[:10] + second[:10]):
        seen.append([])
        list(feed(packer_of((2, 2, 1), watches), given))
    assert seen[0][:7] == seen[1][:7]  # decision n knows n + 3 boxes
    assert seen[0][7] != seen[1][7]
    for known, shown in seen[0]:
        assert len(known) <= 4
        assert shown[-len(known) :] == known


# --- orders ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_bin_has_boxes_of_one_order(variant: tuple[int, int, int]) -> None:
    packer, given = packer_of(variant), boxes(8, 30)
    assert all(feed(packer, [{**box, "order": f"o{k // 8}"} for k, box in enumerate(given)]))
    plan = packer.plan
    for name, bin in zip(plan.ids, plan.bins.tolist(), strict=True):
        assert plan.orders[bin] == f"o{int(name[1:]) // 8}"


def test_an_order_begins_when_its_box_is_the_first_that_waits() -> None:
    """Boxes of b come early, but a goes on: b begins no bin before a has no more boxes."""
    packer = packer_of((3, 0, 1))
    given = [{"sides": KINDS[3], "order": order} for order in "aabab"]
    answers = [answer.number for answer in feed(packer, given)]
    assert answers == [0, 1, 3, 2, 4]
    assert packer.plan.orders == ("a", "b")
    stays = packer_of((2, 0, 1), open_next=False)
    stays.show((600, 500, 600), order="a")
    stays.show((600, 500, 600), order="a")
    assert stays.place_next()
    assert not stays.place_next()  # the bin stays open
    assert isinstance(stays.skip_next(), NoPlace)
    stays.show((100, 100, 100), order="b")
    assert getattr(stays.place_next(), "bin", None) == 1  # each order begins in a new bin


# --- undo, save, restore, actual ------------------------------------------------------------------


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("variant", [(3, 2, 2), (1, 2, 1)])
def test_undo_and_restore_bring_everything_back(
    policy: str, variant: tuple[int, int, int], tmp_path: Path
) -> None:
    rng = np.random.default_rng(2)
    more = {"clearance_mm": 10, "present": [[0, 0, 0, 100, 100, 300]], "explain": policy == "rs"}
    packer = packer_of(variant, policy, **more)
    given, kinds = iter(boxes(4, 100)), set()
    for step in range(12 if policy in ("search", "rs") else 30):
        before = content(packer, tmp_path)
        kind = ["place", "place", "next_bin", "actual", "skip"][rng.integers(5)]
        kind = "show" if packer.needs_box and step < 30 else kind
        try:
            if kind == "show":
                packer.show(**next(given))
            elif kind == "place":
                assert packer.offer_next() == packer.place_next()
            elif kind == "next_bin":
                packer.next_bin()
            elif kind == "actual":
                x, y, _ = packer.placements[-1].centre
                packer.actual((x + rng.uniform(-3, 3), y + rng.uniform(-3, 3), rng.uniform(-1, 1)))
            else:
                packer.skip((900, 900, 900), id="too large")
        except ValueError:
            assert content(packer, tmp_path) == before  # a refused call changes nothing
            continue
        kinds.add(kind)
        after = content(packer, tmp_path)
        again = Packer.restore(tmp_path / "saved.json")
        assert content(again, tmp_path) == after
        packer.undo()
        assert content(packer, tmp_path) == before
        packer = again
    assert {"show", "place"} < kinds


def test_the_pose_of_the_last_box_is_reported_in_whichever_bin_it_is() -> None:
    packer = packer_of((1, 0, 2), clearance_mm=10)
    for box in boxes(2, 20):
        placed = packer.place(**box)
        assert isinstance(placed, Placement)
        x, y, _ = placed.centre
        actual = packer.actual((x + 1, y - 1, 0.5))
        assert (actual.bin, actual.id, actual.yaw) == (placed.bin, placed.id, 0.5)
    assert {box.bin for box in packer.placements} >= {0, 1}
    last = packer.placements[-1]
    while last.bin in packer.state.open_bins:
        packer.next_bin()
        if last.bin in packer.state.open_bins:
            packer.place((100, 100, 100))
            break
    else:
        with pytest.raises(ValueError, match="no box was placed in the open bin"):
            packer.actual((100, 100, 0))


def test_explanations_are_those_of_the_chosen_box_and_bin() -> None:
    for policy in POLICIES:
        packer = packer_of((2, 1, 2), policy, explain=True)
        list(feed(packer, boxes(3, 5)))
        plan = packer.plan
        for k, why in enumerate(plan.explanations):
            assert why is not None
            assert why.orientations[why.chosen] == plan.orientations[k]
            assert why.positions[why.chosen].tolist() == plan.positions[k].tolist()
        assert Plan.of_dict(plan.to_dict(), "plan") == plan


# --- the search -----------------------------------------------------------------------------------


def test_a_future_begins_with_the_known_boxes() -> None:
    """k = 2, b = 1: the largest visible box comes next; the future ends when both are stuck."""
    spec = Packer((300, 300, 300), orientations=[0]).spec
    known = [
        goods_of(sides, {}, spec)
        for sides in ((300, 300, 100), (300, 300, 60), (300, 300, 110), (300, 300, 25))
    ]
    goods = joined(known, spec.unit_mm)
    options = Options(ExactBins(1, spec), goods, 2, np.array([[0, 0], [1, 0]]))
    moves = options.bins.best(options.items, 1, np.zeros(13))
    trial = _Trial(read_weights(TUNED), options, np.arange(2), moves)
    drawn = np.zeros(1, np.int64)
    # After box 0: 110, 60, 25 and no room for the drawn 100. After box 1: 110, 100, 25.
    layers = [trial.value(m, goods[[0]], drawn) / (3000 * 3000 * 10) for m in range(2)]
    assert layers == [110 + 60 + 25, 110 + 100 + 25]


def test_a_search_knows_the_preview_and_nothing_more() -> None:
    """Its choices depend on the known boxes, and not on those that come later."""
    given = boxes(9, 14)
    settings = ExactSearchSettings(budget_ms=1e6, top=2, futures=6)

    def packed(preview: int, given: list[dict[str, Any]]) -> list[Any]:
        search = Search(read_weights(TUNED), settings, Shown())
        packer = packer_of((1, preview, 1), search)
        return [answer.to_dict() for answer in feed(packer, given)]

    changed = given[:9] + boxes(10, 5)
    assert packed(3, given)[:6] == packed(3, changed)[:6]
    assert packed(3, given) != packed(0, given)


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"buffer": 0}, "buffer: needs a whole number from 1"),
        ({"preview": -1}, "preview: needs a whole number from 0"),
        ({"open_bins": 2}, "open_bins = 2: needs at least as many bins, not bins = 1"),
        ({"buffer": 65}, "buffer: needs a whole number from 1 to 64"),
    ],
)
def test_bad_options_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Packer(BIN, **arguments)


def test_calls_that_make_no_sense_are_refused_with_what_would_be_right(tmp_path: Path) -> None:
    packer = packer_of((2, 1, 1))
    for call in (packer.place, packer.offer):
        with pytest.raises(ValueError, match=r"show\(box\) tells of a box, and place_next\(\)"):
            call((100, 100, 100))
    for name in ("place_next", "skip_next", "offer_next"):
        with pytest.raises(ValueError, match=f"{name}: no box is known"):
            getattr(packer, name)()
    refused = packer.show((900, 900, 900), id="large")
    assert isinstance(refused, NoPlace)
    assert (refused.code, packer.waiting, packer.calls) == ("too_large", (), [])
    assert packer.skip((900, 900, 900), id="large") == refused
    with pytest.raises(ValueError, match="has a place in an empty bin; show it"):
        packer.skip((100, 100, 100))
    heavy = Packer(BIN, buffer=2, max_weight_kg=10).show((100, 100, 100), weight=11)
    assert (heavy.to_dict()["code"], bool(heavy)) == ("too_heavy", False)
    for k in range(3):
        packer.show((100, 100, 100), id=k)
    with pytest.raises(ValueError, match="3 boxes are known, as many as may be"):
        packer.show((100, 100, 100))
    with pytest.raises(ValueError, match="a visible box has a place; place_next"):
        packer.skip_next()
    path = tmp_path / "saved.json"
    assert packer.place_next()
    packer.save(path)
    saved = json.loads(path.read_text())
    for change, message in (
        ({"number": 3}, "box 3: is not visible"), ({"bin": 5}, "its placement is not legal"),
        ({"units": [5, 5, 5]}, "its placement is not legal"), ({"number": "a"}, "number"),
    ):  # fmt: skip
        wrong = json.loads(json.dumps(saved))
        wrong["calls"][-1].update(change)
        path.write_text(json.dumps(wrong))
        with pytest.raises(ValueError, match=message):
            Packer.restore(path)
    first, last = saved["calls"][0], saved["calls"].pop()
    del last["number"]
    saved["calls"].append({**last, "call": "place", "box": first["box"], "order": ""})
    path.write_text(json.dumps(saved))
    with pytest.raises(ValueError, match="each box has to be shown first"):
        Packer.restore(path)
    with pytest.raises(ValueError, match="needs one for each option"):
        list(feed(packer_of((2, 0, 1), lambda turn: np.array([NOWHERE])), boxes(1, 3)))


# --- the command ----------------------------------------------------------------------------------

WORDS = ["--bin-mm", "800", "600", "700", "--buffer", "3", "--preview", "1", "--open-bins", "2"]


def line_of(box: dict[str, Any]) -> str:
    w, d, h = box["sides"]
    return json.dumps({"id": box["id"], "w_mm": w, "d_mm": d, "h_mm": h}) + "\n"


def conveyor(
    text: str, words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> list[dict[str, Any]]:
    """Run the command on lines; return its answers."""
    monkeypatch.setattr(sys, "stdin", io.StringIO(text))
    assert pack.main(["-", *WORDS, *words]) == 0
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_a_conveyor_answers_as_soon_as_it_can(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    """Each line says that its box waits; from the fourth on a placement follows."""
    out, other = tmp_path / "plan.json", tmp_path / "file.json"
    given = boxes(1, 12)
    answers = conveyor("".join(map(line_of, given)), ["--out", str(out)], monkeypatch, capsys)
    kinds = ["waiting" if "waiting" in answer else "placed" for answer in answers]
    assert kinds == ["waiting"] * 3 + ["waiting", "placed"] * 9 + ["placed"] * 3
    placed = [answer for answer in answers if "placed" in answer]
    plan = Plan.from_json(out)
    assert [answer["id"] for answer in placed] == list(plan.ids)
    assert [[a["x"], a["y"], a["z"]] for a in placed] == plan.positions.tolist()
    assert [answer["line"] for answer in placed] == [int(a["id"][1:]) + 1 for a in placed]
    path = tmp_path / "boxes.csv"
    rows = [",".join([box["id"], *map(str, box["sides"])]) for box in given]
    path.write_text("\n".join(["id,w_mm,d_mm,h_mm", *rows]) + "\n")
    assert pack.main([str(path), *WORDS, "--out", str(other)]) == 0
    assert Plan.from_json(other) == plan


def test_a_conveyor_that_is_stopped_loses_no_box_that_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    """The state after some answers, as if the program was killed there: the next run goes on."""
    text, state = [line_of(box) for box in boxes(1, 12)], tmp_path / "state.json"
    whole, out = tmp_path / "whole.json", tmp_path / "plan.json"
    conveyor("".join(text), ["--out", str(whole)], monkeypatch, capsys)

    class Killed(io.StringIO):
        def __next__(self) -> str:
            line = super().__next__()
            if line == "killed\n":
                raise KeyboardInterrupt
            return line

    monkeypatch.setattr(sys, "stdin", Killed("".join(text[:6]) + "killed\n"))
    words = ["-", *WORDS, "--state", str(state), "--out", str(out)]
    with pytest.raises(SystemExit):
        pack.main(words)
    capsys.readouterr()
    kept = Packer.restore(state)
    assert len(kept.waiting) == 3
    assert len(kept.placements) == 3
    answers = conveyor("".join(text[6:]), words[len(WORDS) + 1 :], monkeypatch, capsys)
    assert Plan.from_json(out) == Plan.from_json(whole)
    lines = {answer["number"]: answer["line"] for answer in answers}
    assert {number: line for number, line in lines.items() if number < 6} == {
        waits.number: None for waits in kept.waiting
    }
    assert Packer.restore(state).waiting == ()


def test_a_run_that_was_killed_decides_before_it_shows_the_next_box(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    state = tmp_path / "state.json"
    options = ["-", "--bin-mm", "600", "400", "400", "--buffer", "2", "--state", str(state)]
    boxes = [{"id": name, "w_mm": 300, "d_mm": 200, "h_mm": 200} for name in "abc"]
    box_lines = [json.dumps(box) + "\n" for box in boxes]
    monkeypatch.setattr("sys.stdin", io.StringIO("".join(box_lines[:2])))
    with monkeypatch.context() as killed:  # after the second box has been shown
        killed.setattr(Feed, "_possible", lambda self: iter(()))
        killed.setattr(Feed, "rest", lambda self: iter(()))
        assert pack.main(options) == 0
    capsys.readouterr()
    monkeypatch.setattr("sys.stdin", io.StringIO(box_lines[2]))
    assert pack.main(options) == 0
    answers = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [answer.get("placed") for answer in answers] == [True, None, True, True]
    assert {answer["id"] for answer in answers if "placed" in answer} == {"a", "b", "c"}
