"""The documentation says what the code does, and its links lead somewhere."""

import re
from pathlib import Path

import pytest

import marl_pack
from docs.pages import DOCS, PAGES

ROOT = DOCS.parent
TEXTS = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md"), ROOT / "models" / "README.md"])


def anchors(path: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    prose = re.sub(r"```.*?```", "", path.read_text("utf-8"), flags=re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_what_the_code_determines(name: str) -> None:
    page = (DOCS / name).read_text("utf-8")
    assert PAGES[name](page) == page, "run make pages"


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_leads_somewhere(path: Path) -> None:
    for link in re.findall(r"\]\(([^)]+)\)", path.read_text("utf-8")):
        name, _, anchor = link.partition("#")
        if "://" in link or name.startswith("<"):
            continue
        target = path.parent / name if name else path
        assert target.exists(), f"{link}: no such file"
        assert not anchor or anchor in anchors(target), f"{link}: no such heading"


def test_the_reference_has_every_public_name() -> None:
    page = (DOCS / "api.rst").read_text("utf-8")
    kinds = "class|function|data"
    entries = re.findall(rf"^\.\. auto(?:{kinds}):: [\w.]*?(\w+)$", page, re.MULTILINE)
    assert sorted(entries) == sorted(set(marl_pack.__all__) - {"__version__"})
