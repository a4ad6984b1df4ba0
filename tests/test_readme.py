"""The examples of the README and of the docs run without changes."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DOCS = (
    "buffer",
    "physics",
    "environment",
    "environment_selection",
    "items",
    "many_bins",
    "millimetres",
    "packer",
    "stability",
)
PAGES = ("README.md", *(f"docs/{page}.md" for page in DOCS))
EXAMPLES = [
    code
    for page in PAGES
    for code in re.findall(r"```python\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)
]


@pytest.mark.parametrize("code", EXAMPLES)
def test_an_example_runs(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "example", "exec"), {})
    printed = capsys.readouterr().out.strip()
    promised = re.search(r"print\(.*\)  # ([^:\n]*)", code)
    if promised:
        assert printed == promised[1]
    else:
        assert bool(printed) == ("print(" in code)


def test_every_page_with_examples_has_them_read() -> None:
    pages = {page for page in PAGES if "```python" in (ROOT / page).read_text("utf-8")}
    assert pages == set(PAGES)
