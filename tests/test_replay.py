"""``marl-pack replay`` and ``demo``: pages, pictures and films of plans."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from marl_pack import Packer, Plan, demo
from marl_pack.explanation import Explanation
from marl_pack.plan import LeftOut
from marl_pack.plan_archive import save_plans
from marl_pack.render.animation import BAR, Film, save_film
from marl_pack.render.colours import COLOURINGS, PALETTE, SCALE, UNKNOWN, colour_plan
from marl_pack.replay import command
from marl_pack.replay.document import contacts, make_document
from marl_pack.replay.page import make_page


@pytest.fixture(scope="module")
def plan() -> Plan:
    """Eleven boxes of two orders, in two bins."""
    packer = Packer((600, 400, 300), bins=None)
    for k in range(6):
        packer.place((290, 190, 140), id=f"A{k}", weight=4 + k, order="north")
    for _ in range(5):
        packer.place((200, 180, 150), id="</script><img src=x>", order="south")
    return packer.plan


@pytest.fixture
def path(plan: Plan, tmp_path: Path) -> Path:
    plan.to_json(tmp_path / "plan.json")
    return tmp_path / "plan.json"


# --- what the page shows --------------------------------------------------------------------------


def test_the_document_has_the_plan_and_what_rests_on_what(plan: Plan) -> None:
    document = make_document(plan, "two orders")
    assert document["title"] == "two orders"
    assert document["unit"] == "mm"
    assert Plan.of_dict({k: document[k] for k in plan.to_dict()} | {"boxes": [
        {key: value for key, value in box.items() if key != "rests_on"}
        for box in document["boxes"]
    ]}, "document") == plan  # fmt: skip
    assert document["orders"] == ["north", "south"]
    json.dumps(document, allow_nan=False)


def test_contacts_are_those_of_the_boxes() -> None:
    boxes = [(0, 0, 0, 4, 4, 2), (4, 0, 0, 4, 4, 2), (2, 0, 2, 4, 4, 3), (3, 1, 5, 2, 2, 1),
             (0, 4, 0, 2, 2, 5), (0, 4, 5, 4, 2, 1)]  # fmt: skip
    below, shares = contacts(Plan.of_boxes((8, 8, 8), boxes))
    assert below == [[], [], [0, 1], [2], [], [4]]
    assert shares.tolist() == [1, 1, 1, 1, 1, 0.5]


def test_boxes_of_other_bins_carry_nothing() -> None:
    first = Plan.of_boxes((8, 8, 8), [(0, 0, 0, 4, 4, 2), (0, 0, 2, 4, 4, 2)])
    both = replace(
        first, bin_sizes=np.array([[8, 8, 8], [8, 8, 8]]), bins=np.array([0, 1]),
    )  # fmt: skip
    below, shares = contacts(both)
    assert below == [[], []]
    assert shares.tolist() == [1, 0]


def test_rotated_boxes_rest_on_what_is_under_them() -> None:
    boxes = [
        (100, 250, 0, 600, 100, 100),
        (600, 100, 100, 100, 100, 50),
        (100, 280, 100, 50, 40, 50),
    ]
    straight = Plan.of_boxes((800, 800, 400), boxes, unit_mm=1)
    assert contacts(straight)[0] == [[], [], [0]]
    rotated = replace(straight, yaws=np.array([-30.0, 0, 0]))
    below, shares = contacts(rotated)
    assert below == [[], [0], []]
    assert 0 < shares[1] < 1
    assert shares[2] == 0


def test_support_shares_of_the_plan_are_kept() -> None:
    packer = Packer((600, 400, 400), rule="none")
    for sides in [(300, 200, 100), (500, 400, 100), (200, 200, 50)]:
        packer.place(sides)
    plan = packer.plan
    assert [box["support"] for box in make_document(plan)["boxes"]] == plan.supports.tolist()
    assert contacts(plan)[1] == pytest.approx(plan.supports)


@pytest.mark.parametrize(
    ("unit", "name", "scale"), [(None, "cells", 1), (1.0, "mm", 1), (10.0, "mm", 10)]
)
def test_lengths_are_in_millimetres_if_the_plan_knows_them(
    unit: float | None, name: str, scale: float
) -> None:
    why = Explanation(2, 1, np.array([0, 1]), np.array([[0.0, 0, 0], [1, 1, 0]]))
    plan = replace(
        Plan.of_boxes((4, 4, 4), [(1, 1, 0, 2, 2, 1.5)], unit_mm=unit),
        margins=np.array([0.5]), left_out=(LeftOut("a", (9, 1, 1), "too long"),),
        explanations=(why,),
    )  # fmt: skip
    document = make_document(plan)
    assert document["unit"] == name
    assert document["bins"] == [[4 * scale] * 3]
    box = document["boxes"][0]
    assert [box[key] for key in "xyzwdh"] == [v * scale for v in (1, 1, 0, 2, 2, 1.5)]
    assert box["margin"] == 0.5 * scale
    assert document["left_out"][0]["w"] == 9 * scale
    assert document["explanations"][0]["placements"]["x"] == [0, scale]


def test_the_page_has_everything_in_it_and_runs_nothing_else(plan: Plan) -> None:
    page = make_page(make_document(plan, "a <title>"))
    assert "<title>a &lt;title&gt;</title>" in page
    scripts = re.findall(r"<script>(.*?)</script>", page, re.S)
    found = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    assert found is not None
    policy = html.unescape(found[1])
    hashes = {
        "'sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() + "'"
        for text in scripts
    }
    assert hashes == set(re.findall(r"'sha256-[^']*'", policy))
    assert "default-src 'none'" in policy
    assert "connect-src 'none'" in policy
    assert "img src=x" not in page.replace("\\u003cimg src=x", "")
    assert not re.findall(r'(?:src|href)="', page)
    live = make_page(make_document(plan), live="replay.json")
    assert "connect-src 'self'" in html.unescape(live)
    assert 'data-live="replay.json"' in live
    found = re.search(r'id="document">(.*?)</script>', page, re.S)
    assert found is not None
    content = json.loads(found[1])
    assert [box["id"] for box in content["boxes"]] == list(plan.ids)


def test_three_js_comes_with_its_licence(plan: Plan) -> None:
    page = make_page(make_document(plan))
    assert "The MIT License" in page
    assert "three.js authors" in page


# --- colours --------------------------------------------------------------------------------------


def test_colours_show_what_they_say(plan: Plan) -> None:
    colours = {by: colour_plan(plan, by) for by in COLOURINGS}
    assert all(of is not None and len(of.boxes) == len(plan) for of in colours.values())
    order, weight = colours["order"], colours["weight"]
    assert order is not None
    assert order.names == ("north", "south")
    assert [PALETTE.index(c) for c in order.boxes] == [int(b) for b in plan.bins]
    assert weight is not None
    assert weight.range == (plan.weights.min(), plan.weights.max())
    assert weight.boxes[int(plan.weights.argmin())] == SCALE[0]
    assert weight.boxes[int(plan.weights.argmax())] == SCALE[-1]


def test_plans_without_values_have_no_such_colours() -> None:
    plan = Plan.of_boxes((8, 8, 8), [(0, 0, 0, 4, 4, 2), (4, 0, 0, 4, 4, 2)])
    assert [by for by in COLOURINGS if colour_plan(plan, by)] == ["item", "weight"]
    with pytest.raises(ValueError, match="colours by margin: the plan has no such values"):
        Film(plan, colouring="margin")


def test_unknown_values_have_a_colour_of_their_own(plan: Plan) -> None:
    some = replace(plan, margins=np.where(np.arange(len(plan)) < 3, np.nan, 5.0))
    colouring = colour_plan(some, "margin")
    assert colouring is not None
    assert colouring.boxes[:3] == (UNKNOWN,) * 3
    assert UNKNOWN not in colouring.boxes[3:]


# --- pictures and films ---------------------------------------------------------------------------


def test_captions_move_and_the_bar_grows(plan: Plan) -> None:
    film = Film(plan, "two orders")
    assert len(film) == len(plan) + 1
    assert film.caption(0) == "two orders: box 0 of 11, bin 0, 0 %"
    filled = plan.in_bin(0).first(4).utilization
    assert film.caption(4) == f"two orders: box 4 of 11, bin 0, {100 * filled:.0f} %"
    assert film.caption(11).startswith("two orders: box 11 of 11, bin 1, ")
    done = [int((film.frame(step)[-BAR // 2] == (11, 92, 173)).all(1).sum()) for step in (0, 4, 11)]
    assert done == [0, round(720 * 4 / 11), 720]


def test_a_frame_shows_the_boxes_that_are_placed(plan: Plan) -> None:
    film = Film(plan.in_bin(0))
    assert len(film.plan) == 6
    # The item beside the bin is the box that comes next, and nothing lies in the empty bin.
    from marl_pack.render.picture import draw, drawable

    whole = drawable(film.plan)
    for step in (0, 3):
        w, d, h = whole.boxes[step, 3:].tolist()
        expected = draw(
            whole.size, whole.boxes[:step], (w, d, h), title=film.caption(step),
            pixels=(720, 480), leave_space=True, parts=whole.parts,
        )  # fmt: skip
        assert np.array_equal(film.frame(step)[:-BAR], expected[:-BAR])


def test_films_show_every_box(plan: Plan, tmp_path: Path) -> None:
    imageio = pytest.importorskip("imageio.v2")
    frames = []
    save_film(tmp_path / "film.gif", Film(plan), seconds=0.2, progress=lambda: frames.append(1))
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == len(plan) + 1 == len(frames)
        assert film.size == (720, 480)
        film.seek(3)
        assert film.info["duration"] == 200
    save_film(tmp_path / "film.mp4", Film(plan, pixels=(321, 241)), seconds=0.2)
    reader = imageio.get_reader(tmp_path / "film.mp4")
    assert reader.get_meta_data()["size"] == (320, 240)
    # 20 pictures a second: 0.2 s for each frame, and 3 s for the last one
    assert abs(reader.count_frames() - (4 * len(plan) + 60)) <= 1
    save_film(tmp_path / "film.mp4", Film(plan, pixels=(320, 240)), seconds=0.13)
    frames = imageio.get_reader(tmp_path / "film.mp4").count_frames()
    assert abs(frames - 20 * (0.13 * len(plan) + 3)) <= 1


@pytest.mark.parametrize(
    ("boxes", "yaws", "unit"),
    [([(0.4, 0.3, 0, 0.4, 0.3, 0.2)], [10.0], 1000.0), ([(2, 2, 0, 2, 2, 2)], [5.0], None),
     ([(100, 300, 0, 600, 100, 100)], [45.0], 1.0), ([(0, 0, 0, 1 / 3, 1 / 3, 1 / 3)], [0.0], 1.0),
     ([(1e-6, 0, 0, 2e-6, 2e-6, 2e-6)], [0.0], None), ([(1e8, 1e8, 0, 4e8, 3e8, 2e8)], [3.0], 1.0)],
)  # fmt: skip
def test_every_plan_without_overlaps_can_be_drawn(
    boxes: Any, yaws: list[float], unit: float | None, tmp_path: Path
) -> None:
    size = [10 ** np.ceil(np.log10(np.max(boxes)))] * 3
    plan = replace(Plan.of_boxes(size, boxes, unit_mm=unit), yaws=np.array(yaws))
    save_film(tmp_path / "bin.png", Film(plan))
    assert (tmp_path / "bin.png").stat().st_size > 3000


def test_a_picture_of_very_many_pixels_is_refused(plan: Plan, tmp_path: Path) -> None:
    two = Film(plan, pixels=(9000, 9000))
    with pytest.raises(ValueError, match="a picture of 2 bins of 9000 x 9000 pixels each has more"):
        save_film(tmp_path / "bins.png", two)


def test_a_picture_shows_all_bins_that_were_opened(plan: Plan, tmp_path: Path) -> None:
    sizes = []
    for step in (2, None):
        save_film(tmp_path / "bins.png", Film(plan, pixels=(300, 200)), step=step)
        with Image.open(tmp_path / "bins.png") as picture:
            sizes.append(picture.size)
    assert sizes == [(300, 200), (600, 200)]


# --- the commands ---------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".html", ".png", ".gif"])
def test_the_command_writes_pages_pictures_and_films(
    path: Path, ending: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = path.with_suffix(ending)
    extra = [] if ending == ".html" else ["--pixels", "320", "240", "--colour", "weight"]
    assert command.main([str(path), "--out", str(out), *extra]) == 0
    assert out.stat().st_size > 3000
    assert "11 boxes" in capsys.readouterr().out


def test_an_episode_of_an_archive_is_chosen(tmp_path: Path) -> None:
    plans = [
        Plan.of_boxes((4, 4, 4), [(0, 0, 0, 2, 2, 1)] + [(2, 0, 0, 1, 1, 1)] * k) for k in (0, 1)
    ]
    save_plans(tmp_path / "plans.npz", plans)
    out = tmp_path / "page.html"
    assert command.main([str(tmp_path / "plans.npz"), "--episode", "1", "--out", str(out)]) == 0
    assert out.read_text().count('"rests_on"') >= 2


REFUSED: list[tuple[list[str], str]] = [
    (["--out", "page.pdf"], "--out page.pdf: needs the ending .html, .png, .gif, .mp4"),
    (["--out", "page.html", "--step", "2"], "--step: goes with .png, .gif, .mp4, not with a page"),
    (["--out", "page.html", "--colour", "bin"], "--colour: goes with"),
    (["--out", "film.gif", "--open"], "--open: goes with a page"),
    (["--out", "film.gif", "--step", "2"], "--step: goes with a picture (.png)"),
    (["--out", "bin.png", "--seconds", "1"], "--seconds: goes with a film"),
    (["--out", "film.gif", "--seconds", "0"], "--seconds 0: needs from 0.05 to 60"),
    (["--out", "film.gif", "--seconds", "nan"], "--seconds"),
    (["--out", "bin.png", "--pixels", "10", "10"], "--pixels"),
    (["--out", "bin.png", "--step", "12"], "--step"),
    (["--out", "page.html", "--episode", "1"], "--episode 1: needs 0, the only plan of the file"),
    (["--out", "nowhere/page.html"], "nowhere"),
]


@pytest.mark.parametrize(("arguments", "words"), REFUSED)
def test_impossible_options_are_refused(
    path: Path, arguments: list[str], words: str, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(path.parent)
    before = sorted(path.parent.iterdir())
    with pytest.raises(SystemExit) as stop:
        command.main([str(path), *arguments])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error
    assert sorted(path.parent.iterdir()) == before


def test_a_plan_that_cannot_be_drawn_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "over.json"
    Plan.of_boxes((4, 4, 4), [(0, 0, 0, 2, 2, 2), (1, 1, 0, 2, 2, 2)]).to_json(path)
    for out, words in (("bin.png", "over.json: boxes overlap"), ("film.gif", "boxes overlap")):
        with pytest.raises(SystemExit):
            command.main([str(path), "--out", str(tmp_path / out)])
        assert words in capsys.readouterr().err
    assert command.main([str(path), "--out", str(tmp_path / "page.html")]) == 0
    named = ["--out", str(tmp_path / "bin.png"), "--colour", "margin"]
    with pytest.raises(SystemExit):
        command.main([str(path), *named])
    assert "--colour margin: the plan has no such values" in capsys.readouterr().err


def test_a_missing_or_foreign_plan_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other.json").write_text('{"a": 1}')
    for name, words in (("none.json", "no such file"), ("other.json", "not a plan")):
        with pytest.raises(SystemExit):
            command.main([str(tmp_path / name), "--out", str(tmp_path / "page.html")])
        assert words in capsys.readouterr().err


def test_the_demo_packs_cases_and_opens_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or True)
    out = tmp_path / "page.html"
    assert demo.main(["--boxes", "12", "--policy", "linear", "--out", str(out)]) == 0
    assert opened == [out.as_uri()]
    plan = Plan.from_json(tmp_path / "page.json")
    assert len(plan) == 12
    assert all(plan.explanations)
    assert "12 cases, packed by linear" in out.read_text()
    assert demo.main(["--boxes", "2", "--policy", "dblf", "--out", str(out), "--no-open"]) == 0
    assert len(opened) == 1


def test_the_demo_draws_realistic_cases() -> None:
    cases = demo.draw_cases(200, seed=4)
    assert cases == demo.draw_cases(200, seed=4)
    assert cases != demo.draw_cases(200, seed=5)
    assert len({case["id"] for case in cases}) == 200
    assert len({case["sides"] for case in cases}) <= demo.LINES
    assert all(0.1 < case["weight"] < 25 for case in cases)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--boxes", "0"], "--boxes"), (["--seed", "-1"], "--seed"),
     (["--out", "page.txt"], "needs the ending .html")],
)  # fmt: skip
def test_the_demo_refuses_impossible_options(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        demo.main(arguments)
    assert stop.value.code == 2
    assert words in capsys.readouterr().err


def test_pack_and_play_take_films(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from marl_pack import pack

    csv = tmp_path / "boxes.csv"
    csv.write_text("w_mm,d_mm,h_mm,quantity\n300,200,150,4\n")
    film = tmp_path / "film.gif"
    arguments: list[Any] = [str(csv), "--bin-mm", "600", "400", "400", "--picture", str(film)]
    assert pack.main(arguments) == 0
    with Image.open(film) as frames:
        assert frames.n_frames == 5
