"""A headless browser, and pages to open in it. `make browser` runs these tests."""

import os
import shutil
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OUT = ROOT / "build" / "browser"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
ARGUMENTS = (
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)  # fmt: skip


def browser_path() -> str | None:
    """The browser of MARL_PACK_BROWSER, or the first one on the PATH."""
    return os.environ.get("MARL_PACK_BROWSER") or next(
        filter(None, map(shutil.which, BROWSERS)), None
    )


def until(page, condition: str, seconds: float = 10) -> None:
    """Wait until a condition holds; ``wait_for_function`` would need the page to allow eval."""
    end = time.monotonic() + seconds
    while not page.evaluate(condition):
        assert time.monotonic() < end, f"still not: {condition}"
        page.wait_for_timeout(30)


@pytest.fixture(scope="session")
def browser():
    path = browser_path()
    if path is None:
        pytest.skip(
            "no browser: install Debian's package chromium, or set MARL_PACK_BROWSER to a browser"
        )
    playwright = pytest.importorskip("playwright.sync_api").sync_playwright().start()
    running = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
    yield running
    running.close()
    playwright.stop()


@pytest.fixture(scope="session")
def log():
    """Writes what was clicked and seen to build/browser/log.txt."""
    OUT.mkdir(parents=True, exist_ok=True)
    with (OUT / "log.txt").open("w", encoding="utf-8") as file:

        def write(text: str) -> None:
            print(text)
            file.write(text + "\n")
            file.flush()

        yield write


@pytest.fixture
def open_page(browser):
    """Opens a page; the test fails if it asks for anything on a network, or logs an error."""
    contexts, problems = [], []

    def open_(url: str, width: int = 1280, height: int = 720, **options):
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: problems.append(f"error: {error}"))
        page.on(
            "console",
            lambda line: problems.append(line.text) if line.type == "error" else None,
        )
        own = url.split("#")[0].rsplit("/", 1)[0]
        page.on(
            "request",
            lambda request: (
                None
                if request.url.startswith((own, "blob:", "data:"))
                else problems.append(f"asked for {request.url}")
            ),
        )
        page.goto(url)
        until(page, "window.page?.model !== undefined")
        return page

    yield open_
    for context in contexts:
        context.close()
    assert problems == []
