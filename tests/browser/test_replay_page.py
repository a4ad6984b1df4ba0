"""The replay page in a real browser: every control is used; the values are those of the plan."""

import html
import http.server
import json
import re
import threading
from pathlib import Path

import numpy as np
import pytest

from marl_pack.demo import BIN_MM, MARGIN_MM, draw_cases
from marl_pack.packer.packer import Packer
from marl_pack.plan import Plan
from marl_pack.replay.document import contacts, make_document
from marl_pack.replay.page import make_page
from tests.browser.conftest import OUT, until
from tests.service_program import serving


def write(path: Path, plan: Plan, title: str, live: str | None = None) -> str:
    path.write_text(make_page(make_document(plan, title), live), encoding="utf-8")
    return path.as_uri()


@pytest.fixture(scope="session")
def pallet(tmp_path_factory):
    """A pallet of 60 cases with explanations, and its page."""
    packer = Packer(BIN_MM, "linear", margin_mm=MARGIN_MM, explain=True, max_boxes=100)
    for case in draw_cases(60, seed=0):
        packer.place(**case, stackable=True)
    folder = tmp_path_factory.mktemp("pages")
    return packer.plan, write(folder / "pallet.html", packer.plan, "Sixty cases")


@pytest.fixture(scope="session")
def orders(tmp_path_factory):
    """Three bins of two orders, a box without a place, an unknown weight, a yaw, load limits."""
    packer = Packer((600, 400, 400), "max_contact", bins=3, explain=True, clearance_mm=4)
    for k in range(8):
        packer.place((290, 190, 150), id=f"A{k}", weight=4, max_load=30, order="north")
    packer.actual((packer.placements[-1].centre[0] + 1, packer.placements[-1].centre[1], 0.5))
    for k in range(6):
        packer.place((250, 180, 190), id="<b>&B</b>" if k else None, order="south")
    packer.skip((900, 200, 200), id="long", order="south")
    folder = tmp_path_factory.mktemp("pages")
    return packer.plan, write(folder / "orders.html", packer.plan, "</script><b>Orders</b> & more")


def text(page, selector: str) -> str:
    return page.locator(selector).inner_text().strip()


def step(page) -> int:
    return page.evaluate("page.step")


def picture(page) -> bytes:
    """What the 3D view shows; it is drawn before the next frame is."""
    page.evaluate(
        "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
    )
    return page.locator("#view").screenshot()


def numbers(value: str) -> list[float]:
    """The numbers in a text of the page, such as "1,200 × 800 mm"."""
    return [float(number.replace(",", "")) for number in re.findall(r"-?\d[\d,]*(?:\.\d+)?", value)]


def load_on(plan: Plan, box: int, count: int) -> float:
    """The weight above a box after ``count`` boxes, by the contacts of the plan."""
    below = contacts(plan)[0]
    above: set[int] = set()
    for i in range(count):
        if any(j == box or j in above for j in below[i]):
            above.add(i)
    return float(plan.weights[sorted(above)].sum())


def test_every_control_does_what_it_says(open_page, pallet, log) -> None:
    plan, url = pallet
    n = len(plan)
    page = open_page(url)
    assert step(page) == n
    pictures = {picture(page)}

    def used(what: str) -> None:
        log(f"{what}: {text(page, '#caption')}")

    page.click("#first")
    assert step(page) == 0
    assert page.locator("#first").is_disabled()
    assert page.locator("#back").is_disabled()
    used("first step")
    for k in range(1, 4):
        page.click("#forward")
        assert step(page) == k
    used("one step on, three times")
    assert text(page, "#caption").startswith("Box 3 of")
    page.click("#back")
    assert step(page) == 2
    used("one step back")
    page.select_option("#speed", "8")
    page.click("#play")
    assert text(page, "#play") == "Pause"
    until(page, "page.step >= 6")
    page.click("#play")
    assert text(page, "#play") == "Play"
    stopped = step(page)
    page.wait_for_timeout(400)
    assert step(page) == stopped
    used("play at 8 times the speed, then pause")
    page.click("#last")
    assert step(page) == n
    assert page.locator("#last").is_disabled()
    used("last step")
    page.locator("#slider").fill("30")
    assert step(page) == 30
    used("slider to 30")
    assert f"{100 * plan.first(30).utilization:.0f} %" in text(page, "#caption")

    colourings = page.locator("#colour option").all_inner_texts()
    assert colourings == ["item", "size", "weight", "margin"]
    for name in colourings:
        page.select_option("#colour", name)
        pictures.add(picture(page))
        used(f"colour by {name}, legend {text(page, '#legend')!r}")
    assert len(pictures) == 1 + len(colourings)
    ends = [float(plan.margins.min()), float(plan.margins.max())]
    assert numbers(text(page, "#legend")) == pytest.approx(ends, abs=0.06)

    before = picture(page)
    area = page.locator("#view").bounding_box()
    page.mouse.move(area["x"] + 300, area["y"] + 200)
    page.mouse.down()
    page.mouse.move(area["x"] + 420, area["y"] + 260, steps=4)
    page.mouse.up()
    turned = picture(page)
    assert turned != before
    used("dragged the view")
    page.mouse.wheel(0, -400)
    page.wait_for_timeout(200)
    zoomed = picture(page)
    assert zoomed != turned
    used("zoomed with the wheel")
    page.mouse.move(area["x"] + 5, area["y"] + 5)
    page.click("#reset")
    page.mouse.move(area["x"] + 5, area["y"] + 5)
    assert picture(page) == before
    used("reset the view")
    theme = page.evaluate("document.documentElement.dataset.theme")
    page.click("#theme")
    assert page.evaluate("document.documentElement.dataset.theme") != theme
    assert picture(page) != before
    used("other theme")
    page.click("#help")
    assert page.locator("#keys").is_visible()
    page.click("#keys button")
    assert not page.locator("#keys").is_visible()
    used("keys shown and closed")


def test_every_key_does_what_it_says(open_page, orders, log) -> None:
    plan, url = orders
    page = open_page(url)
    page.locator("#view").focus()
    for key, expected in (("Home", 0), ("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1),
                          ("End", len(plan))):  # fmt: skip
        page.keyboard.press(key)
        assert step(page) == expected
        log(f"key {key}: {text(page, '#caption')}")
    page.keyboard.press(" ")
    assert page.evaluate("page.playing")
    page.keyboard.press(" ")
    assert not page.evaluate("page.playing")
    page.keyboard.press("End")
    for key in "+-wasd":
        before = picture(page)
        page.keyboard.press(key)
        assert picture(page) != before, key
        log(f"key {key}: the view changed")
    page.keyboard.press("r")
    for key, selector in (("c", "#colour"), ("b", "#bin")):
        values = [page.locator(selector).input_value()]
        for _ in range(page.locator(f"{selector} option").count()):
            page.keyboard.press(key)
            values.append(page.locator(selector).input_value())
        assert values[0] == values[-1]
        assert len(set(values)) == len(values) - 1
        log(f"key {key}: {values}")
    theme = page.evaluate("document.documentElement.dataset.theme")
    page.keyboard.press("t")
    assert page.evaluate("document.documentElement.dataset.theme") != theme
    page.keyboard.press("?")
    assert page.locator("#keys").is_visible()
    page.keyboard.press("Escape")
    assert not page.locator("#keys").is_visible()
    log("keys t, ? and Escape")


def test_the_values_on_hover_are_those_of_the_plan(open_page, pallet, log) -> None:
    plan, url = pallet
    page = open_page(url)
    compared = 0
    for count in (len(plan), 40, 12):
        page.locator("#slider").fill(str(count))
        page.wait_for_timeout(100)
        area = page.locator("#view").bounding_box()
        for i in range(count):
            x, y = page.evaluate(f"page.view.project({i})")
            if page.evaluate(f"page.view.pick({x}, {y})") != i:
                continue  # another box hides its middle
            page.mouse.move(area["x"] + x, area["y"] + y)
            shown = {
                row.get_attribute("data-key"): row.inner_text()
                for row in page.locator("#tooltip dd").all()
            }
            assert shown["id"] == plan.ids[i]
            assert numbers(shown["size"]) == pytest.approx(plan.sides[i].tolist(), abs=0.06)
            assert numbers(shown["position"]) == pytest.approx(plan.positions[i].tolist(), abs=0.06)
            assert numbers(shown["support"]) == pytest.approx([100 * plan.supports[i]], abs=0.06)
            assert numbers(shown["margin"]) == pytest.approx([plan.margins[i]], abs=0.06)
            assert numbers(shown["weight"]) == pytest.approx([plan.weights[i]], abs=0.006)
            assert numbers(shown["load"]) == pytest.approx([load_on(plan, i, count)], abs=0.006)
            compared += 1
            if compared % 10 == 0:
                log(f"hover after {count} boxes: {shown}")
    assert compared >= 30
    log(f"hovered over {compared} boxes: all values equal those of the plan")


def test_the_table_has_all_values_and_sorts(open_page, orders) -> None:
    plan, url = orders
    page = open_page(url)
    page.locator("details summary").click()
    page.locator("#boxes th").first.wait_for()  # the table is written after it is opened
    heads = [head.removesuffix(" ↑") for head in page.locator("#boxes th").all_inner_texts()]
    assert heads == [
        "box",
        "size",
        "position",
        "bin",
        "support",
        "margin",
        "weight, kg",
        "load, kg",
    ]
    loads = [load_on(plan, i, len(plan)) for i in range(len(plan))]
    page.click("#boxes thead button >> nth=7")
    page.click("#boxes thead button >> nth=7")
    assert page.locator("#boxes th").nth(7).get_attribute("aria-sort") == "descending"
    rows = [row.locator("td").all_inner_texts() for row in page.locator("#boxes tbody tr").all()]
    assert [float(row[7]) for row in rows] == pytest.approx(sorted(loads, reverse=True), abs=0.006)
    for row in rows:
        i = int(row[0].split()[0]) - 1
        assert numbers(row[1]) == pytest.approx(plan.sides[i].tolist(), abs=0.06)
        assert numbers(row[2]) == pytest.approx(plan.positions[i].tolist(), abs=0.06)
        assert int(row[3]) == plan.bins[i]
        assert numbers(row[5]) == pytest.approx([plan.margins[i]], abs=0.06)
        assert float(row[6]) == pytest.approx(plan.weights[i], abs=0.006)


def test_a_click_keeps_the_values_of_a_box(open_page, orders) -> None:
    plan, url = orders
    page = open_page(f"{url}#bin=0")
    area = page.locator("#view").bounding_box()
    seen = page.evaluate(
        "() => page.view.visible.find((i) => page.view.pick(...page.view.project(i)) === i)"
    )
    x, y = page.evaluate(f"page.view.project({seen})")
    page.mouse.click(area["x"] + x, area["y"] + y)
    page.mouse.move(area["x"] + 3, area["y"] + 3)
    assert text(page, "#box dd[data-key=id]") == plan.ids[seen]
    page.keyboard.press("Escape")
    assert text(page, "#box dd[data-key=position]") != ""
    assert page.evaluate("page.selected") == -1


def test_values_follow_the_step_and_the_bin(open_page, orders) -> None:
    plan, url = orders
    page = open_page(f"{url}#bin=0&step=6")
    area = page.locator("#view").bounding_box()
    lower = next(i for i in range(6) if load_on(plan, i, 6) != load_on(plan, i, len(plan)))
    x, y = page.evaluate(
        f"(() => {{ for (let dy = -60; dy < 60; dy += 3) for (let dx = -60; dx < 60; dx += 3) {{"
        f" const [x, y] = page.view.project({lower});"
        f" if (page.view.pick(x + dx, y + dy) === {lower}) return [x + dx, y + dy]; }} }})()"
    )
    page.mouse.move(area["x"] + x, area["y"] + y)
    for count in (6, len(plan)):
        page.evaluate(f"page.goTo({count})")
        shown = numbers(text(page, "#tooltip dd[data-key=load]"))
        assert shown[0] == pytest.approx(load_on(plan, lower, count))
    page.keyboard.press("Home")
    assert not page.locator("#tooltip").is_visible()
    page.keyboard.press("End")
    page.mouse.move(area["x"] + 3, area["y"] + 3)
    row = page.locator("#best tbody tr").first
    row.hover()  # a placement in bin 1, while bin 0 is shown: no outline
    assert page.evaluate("page.view.ghost.geometry.drawRange.count") == 0
    page.select_option("#bin", "1")
    page.locator("#best tbody tr").nth(1).hover()
    assert page.evaluate("page.view.ghost.geometry.drawRange.count") == 24
    # The outline of the step before is gone at once; a row under the pointer may show its own.
    count = "page.view.ghost.geometry.drawRange.count"
    assert page.evaluate(f"(() => {{ page.goTo(page.step - 1); return {count}; }})()") == 0
    page.locator("details summary").click()
    page.locator("#boxes tbody button").first.click()
    assert page.locator("#bin").input_value() == "0"  # the box that was chosen is there


def test_the_memory_of_the_view_does_not_grow(open_page, orders) -> None:
    page = open_page(orders[1])
    use = (
        "(() => { const { geometries, textures } = page.view.renderer.info.memory;"
        " return [geometries, textures]; })()"
    )
    counts = []
    for _ in range(2):
        for _ in range(10):
            page.evaluate("page.next(document.getElementById('bin'))")
            page.evaluate("page.update(page.model.doc, false)")
            picture(page)
        counts.append(page.evaluate(use))
    assert counts[0] == counts[1]


def test_a_change_keeps_the_selected_box_and_the_focus(open_page, orders) -> None:
    page = open_page(orders[1])
    page.locator("details summary").click()
    page.locator("#boxes tbody button").nth(3).click()
    page.evaluate("page.update(JSON.parse(JSON.stringify(page.model.doc)), false)")
    assert page.evaluate("page.selected") == 3
    assert page.evaluate("document.activeElement.textContent").startswith("4 ")
    page.click("#boxes thead button >> nth=0")
    assert page.locator("#boxes tbody button").first.inner_text().startswith("14 ")
    page.click("#boxes thead button >> nth=0")
    page.evaluate(
        "(() => { const doc = JSON.parse(JSON.stringify(page.model.doc));"
        " doc.boxes[3].id = 'other'; page.update(doc, false); })()"
    )
    assert page.evaluate("page.selected") == -1


def test_what_scrolls_keeps_its_keys(open_page, pallet) -> None:
    page = open_page(f"{pallet[1]}#step=20")
    page.locator("aside").focus()
    for key in ("End", "Home", " "):
        page.keyboard.press(key)
    assert step(page) == 20
    assert not page.evaluate("page.playing")
    page.keyboard.press("c")
    assert page.locator("#colour").input_value() == "size"


def test_a_choice_of_shading_stays(open_page, tmp_path) -> None:
    packer = Packer((1200, 800, 1000), "rs", explain=True)
    for case in draw_cases(5, seed=1):
        packer.place(case["sides"])
    page = open_page(write(tmp_path / "rs.html", packer.plan, "rs"))
    page.select_option("#map-shade", "probabilities")
    page.click("#back")
    page.click("#theme")
    assert page.locator("#map-shade").input_value() == "probabilities"


def test_the_address_says_what_is_shown_and_can_be_changed(open_page, pallet) -> None:
    page = open_page(f"{pallet[1]}#step=nonsense&colour=none&bin=9")
    assert step(page) == len(pallet[0])
    page.evaluate("location.hash = '#step=9&colour=margin'")
    until(page, "page.step === 9")
    assert page.locator("#colour").input_value() == "margin"
    page.click("#forward")
    until(page, "location.hash.includes('step=10')")


def test_the_page_works_inside_another_one(open_page, pallet, tmp_path) -> None:
    outer = tmp_path / "outer.html"
    content = html.escape(Path(pallet[1].removeprefix("file://")).read_text(encoding="utf-8"))
    outer.write_text(
        "<script>window.page = {model: 1}</script>"
        f'<iframe width=1000 height=600 srcdoc="{content}"></iframe>',
        encoding="utf-8",
    )
    page = open_page(outer.as_uri())
    frame = page.frames[1]
    frame.click("#first")
    frame.click("#forward")
    page.wait_for_timeout(600)
    assert frame.evaluate("page.step") == 1


def test_long_names_do_not_break_the_page(open_page, tmp_path) -> None:
    packer = Packer((600, 400, 400), bins=3)
    for order in ("n" * 150, "s" * 150):
        for k in range(3):
            packer.place((200, 200, 200), id="i" * 190 + str(k), order=order)
    page = open_page(write(tmp_path / "long.html", packer.plan, "t" * 400))
    wide, inner = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert wide <= inner
    page.click("#back")
    assert page.locator("#conveyor figure").first.bounding_box()["width"] < 150
    assert page.locator("#slider").bounding_box()["width"] > 250


def test_bins_orders_and_boxes_without_a_place_are_shown(open_page, orders) -> None:
    plan, url = orders
    page = open_page(url)
    assert page.locator("#bins tbody tr").count() == len(plan.bin_sizes)
    for k, row in enumerate(page.locator("#bins tbody tr").all()):
        cells = row.locator("td").all_inner_texts()
        assert plan.orders[k] in cells[0]
        assert int(cells[1]) == int((plan.bins == k).sum())
        assert numbers(cells[2]) == pytest.approx([100 * plan.in_bin(k).utilization], abs=0.06)
    assert "long" in text(page, "#left-out")
    assert plan.left_out[0].reason in text(page, "#left-out")
    assert page.locator("#colour option").all_inner_texts() == [
        "item", "size", "order", "bin", "weight", "margin",
    ]  # fmt: skip
    page.select_option("#bin", "all")
    everything = page.evaluate("page.view.visible.length")
    page.select_option("#bin", "1")
    assert everything == len(plan)
    assert page.evaluate("page.view.visible.length") == int((plan.bins == 1).sum())
    turned = int(np.flatnonzero(plan.yaws)[0])
    page.locator("details summary").click()
    page.locator("#boxes tbody button").nth(turned).click()
    assert numbers(text(page, "#box dd[data-key=yaw]").rstrip("°")) == [plan.yaws[turned]]
    assert "(assumed)" in page.evaluate(
        f"page.model.values({len(plan) - 1}, {len(plan)}).flat().join()"
    )


def test_names_are_shown_as_they_are(open_page, orders) -> None:
    _, url = orders
    page = open_page(url)
    assert text(page, "#title") == "</script><b>Orders</b> & more"
    assert page.title() == "</script><b>Orders</b> & more"
    assert "<b>&B</b>" in text(page, "#box")
    assert page.locator("#title b, #box b").count() == 0


def test_the_page_says_why_a_box_is_where_it_is(open_page, pallet, tmp_path, log) -> None:
    plan, url = pallet
    page = open_page(f"{url}#step=20")
    why = plan.explanations[19]
    assert f"{why.legal} legal candidates" in text(page, "#why-summary")
    first = page.locator("#best tbody tr").first.locator("td").all_inner_texts()
    assert [float(v.replace(",", "")) for v in first[0].split(", ")] == why.positions[
        why.chosen
    ].tolist()
    assert float(first[2]) == pytest.approx(np.nanmax(why.values), abs=6e-5)
    log(f"why, step 20: {text(page, '#why-summary')} best: {first}")
    before = picture(page)
    page.locator("#best tbody tr").nth(3).hover()
    assert picture(page) != before  # the placement is outlined
    page.locator("#map").hover(position={"x": 20, "y": 160})
    page.click("#back")
    assert page.locator("#why-summary").inner_text() != ""


def test_agents_show_their_probabilities(open_page, tmp_path, log) -> None:
    packer = Packer((1200, 800, 1000), "rs", explain=True)
    for case in draw_cases(6, seed=1):
        packer.place(case["sides"], id=case["id"])
    plan = packer.plan
    page = open_page(write(tmp_path / "rs.html", plan, "rs") + "#step=5")
    why = plan.explanations[4]
    bars = page.locator("#orientations > span").all_inner_texts()[1::2]
    shown = [float(bar.rstrip(" %")) / 100 for bar in bars]
    assert shown == pytest.approx(why.orientation_probabilities.tolist(), abs=6e-4)
    assert page.locator("#map-shade option").all_inner_texts() == [
        "afterstate value",
        "probability of the cell",
    ]
    before = page.locator("#map").screenshot()
    page.select_option("#map-shade", "probabilities")
    assert page.locator("#map").screenshot() != before
    orientation = page.locator("#map-orientation")
    others = [o.get_attribute("value") for o in orientation.locator("option").all()]
    for other in others:
        orientation.select_option(other)
        count = int((why.orientations == int(other)).sum())
        assert page.locator("#map").get_attribute("aria-label").startswith(f"{count} legal")
    log(f"orientation agent: {bars}; orientations on the map: {others}")


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (390, 844), (820, 1180)])
def test_the_page_fits_the_window(open_page, orders, width, height) -> None:
    page = open_page(orders[1], width, height)
    wide, inner = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert wide <= inner
    stage = page.locator("#view").bounding_box()
    assert stage["width"] >= 0.6 * width
    assert stage["height"] >= 0.4 * height
    page.locator("#play").click()  # it can be reached
    if width >= 1280:
        assert page.evaluate("document.documentElement.scrollHeight <= innerHeight")


def test_the_page_follows_the_colours_of_the_system(open_page, pallet) -> None:
    for scheme in ("dark", "light"):
        page = open_page(pallet[1], color_scheme=scheme)
        assert page.evaluate("document.documentElement.dataset.theme") == scheme


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_is_accessible(open_page, pallet, orders, scheme) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    for (_, url), width in ((pallet, 1280), (orders, 390)):
        page = open_page(url, width, color_scheme=scheme)
        page.locator("details summary").click()
        for dialog in (False, True):
            if dialog:
                page.locator("#help").click()
            results = axe.run(page)
            assert results.violations_count == 0, results.generate_report()
    assert results.response["passes"]  # the tool has looked at something


def test_the_page_works_without_3d(browser, pallet) -> None:
    context = browser.new_context()
    page = context.new_page()
    page.add_init_script(
        "const get = HTMLCanvasElement.prototype.getContext;"
        "HTMLCanvasElement.prototype.getContext = function (kind, ...more) {"
        " return kind.startsWith('webgl') ? null : get.call(this, kind, ...more); };"
    )
    page.goto(pallet[1])
    assert page.locator("#no-webgl").is_visible()
    page.click("#first")
    page.click("#forward")
    assert text(page, "#box dd[data-key=id]") == pallet[0].ids[0]
    context.close()


def test_an_empty_plan_has_a_page(open_page, tmp_path) -> None:
    plan = Plan.of_boxes((4, 4, 4), np.zeros((0, 6), int))
    page = open_page(write(tmp_path / "empty.html", plan, ""))
    assert text(page, "#caption") == "Box 0 of 0 · 0 % filled"
    page.click("#play")
    page.keyboard.press("ArrowRight")
    assert step(page) == 0


def test_a_live_page_follows_a_plan_that_grows(open_page, pallet, tmp_path, log) -> None:
    plan = pallet[0]
    document = {"count": 3}

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            first = make_document(plan.first(document["count"]), "live")
            page = self.path.startswith("/page")
            body = make_page(first, live="plan.json") if page else json.dumps(first)
            self.send_response(200)
            self.send_header("Content-Type", "text/html" if page else "application/json")
            self.end_headers()
            self.wfile.write(body.encode())

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    page = open_page(f"http://127.0.0.1:{server.server_port}/page")
    assert step(page) == 3
    document["count"] = 5
    until(page, "page.step === 5")
    log(f"live: {text(page, '#caption')}, {text(page, '#live')}")
    page.click("#first")
    document["count"] = 7
    until(page, "page.model.last === 7")
    assert step(page) == 0  # who looks at an earlier step stays there
    page.close()
    server.shutdown()


def test_the_service_shows_a_bin_while_it_is_packed(open_page, tmp_path, log) -> None:
    httpx = pytest.importorskip("httpx2")
    with serving(["--data", str(tmp_path / "bins.sqlite")]) as (_, address):
        bin_url = f"{address}/bins/cell"
        assert (
            httpx.post(f"{address}/bins", json={"id": "cell", "explain": True}).status_code == 201
        )
        page = open_page(f"{bin_url}/replay")
        assert text(page, "#live") == "live"
        for k in range(3):
            box = {"sides": [400, 300, 200], "id": f"box {k}", "weight": 3}
            answer = httpx.post(f"{bin_url}/place", json=box).json()
            until(page, f"page.step === {k + 1}")
            shown = numbers(text(page, "#box dd[data-key=position]"))
            assert shown == [answer["x"], answer["y"], answer["z"]]
            assert "legal candidates" in text(page, "#why-summary")
        log(f"service: {text(page, '#caption')}, {text(page, '#live')}")
        httpx.post(f"{bin_url}/undo")
        until(page, "page.step === 2")
        httpx.post(f"{bin_url}/actual", json={"x": 900, "y": 500, "yaw": 4})
        until(page, "page.why.moved")
        assert "reported at another place than planned" in text(page, "#why-summary")
        httpx.post(f"{bin_url}/close")
        until(page, "document.getElementById('live').textContent === 'closed'")
        page.close()


def test_screenshots(open_page, pallet, orders) -> None:
    """Write the pictures start, middle and end to build/browser."""
    plan, url = pallet
    for name, at in (("start", 1), ("middle", len(plan) // 2), ("end", len(plan))):
        page = open_page(f"{url}#step={at}")
        picture(page)
        page.screenshot(path=OUT / f"{name}.png")
    page = open_page(f"{orders[1]}#bin=all&colour=order", color_scheme="dark")
    picture(page)
    page.screenshot(path=OUT / "orders_dark.png")
    page = open_page(f"{url}#step=30", 390, 844)
    picture(page)
    page.screenshot(path=OUT / "phone.png")
    sizes = [path.stat().st_size for path in OUT.glob("*.png")]
    assert len(sizes) >= 5
    assert min(sizes) > 10_000
