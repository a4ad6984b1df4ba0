"""Measure how long a replay page takes to open: ``python -m benchmarks.page``.

The time is that from the start of the navigation to the first picture of the bins, in a headless
browser that draws on the CPU. Every box has its explanation. ``make browser`` says which browser is
used.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from playwright.sync_api import Browser, sync_playwright

from benchmarks.record import Measurements
from marl_pack.demo import BIN_MM, MARGIN_MM, draw_cases
from marl_pack.packer.packer import Packer
from marl_pack.replay.command import write_page
from tests.browser.conftest import ARGUMENTS, browser_path

SEED = 0
BOXES = (60, 200, 1000)
OPENINGS = 7
FIRST = "performance.getEntriesByName('first picture')[0]?.startTime ?? null"


def opening_ms(browser: Browser, url: str) -> float:
    """Open a page in a new window and return the milliseconds until its first picture."""
    context = browser.new_context(viewport={"width": 1280, "height": 720})
    page = context.new_page()
    page.goto(url)
    while (first := page.evaluate(FIRST)) is None:
        page.wait_for_timeout(20)
    context.close()
    return float(first)


def main() -> None:
    """Measure pages of different numbers of boxes."""
    measured = Measurements("page", __doc__, seed=SEED)
    measured.parse()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browser_path(), args=list(ARGUMENTS))
        for boxes in BOXES:
            packer = Packer(BIN_MM, "linear", margin_mm=MARGIN_MM, bins=None, explain=True)
            for case in draw_cases(boxes, SEED):
                packer.place(**case)
            path = Path(folder, f"{boxes}.html")
            write_page(path, packer.plan, f"{boxes} boxes")
            times = [opening_ms(browser, path.as_uri()) for _ in range(OPENINGS)]
            measured.keep(
                f"{boxes} boxes", boxes=boxes, bins=packer.state.bins,
                kilobytes=path.stat().st_size / 1000,
                median_ms=float(np.median(times)), slowest_ms=max(times),
            )  # fmt: skip
        browser.close()


if __name__ == "__main__":
    main()
