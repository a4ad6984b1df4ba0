"""Make the film in the README and the pictures of docs/replay.md: ``make film``.

It needs a browser (``make browser`` says which).
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

from marl_pack import demo
from marl_pack.replay import command
from tests.browser.conftest import ARGUMENTS, browser_path

DOCS = Path(__file__).parent
BOXES = 60
STEPS = {"start": 1, "middle": BOXES // 2, "end": BOXES}


def main() -> None:
    """Pack the cases of the demo, film them, and take three pictures of the page."""
    with tempfile.TemporaryDirectory() as folder:
        page_path = Path(folder, "demo.html")
        assert demo.main(["--boxes", str(BOXES), "--no-open", "--out", str(page_path)]) == 0
        film = ["--title", "marl-pack demo", "--seconds", "0.3", "--out", str(DOCS / "pallet.gif")]
        assert command.main([str(page_path.with_suffix(".json")), *film]) == 0
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=browser_path(), args=list(ARGUMENTS)
            )
            for name, step in STEPS.items():
                page = browser.new_page(viewport={"width": 1280, "height": 720})
                page.goto(f"{page_path.as_uri()}#step={step}")
                page.wait_for_timeout(500)
                page.screenshot(path=DOCS / f"replay_{name}.png")
                page.close()
            browser.close()


if __name__ == "__main__":
    main()
