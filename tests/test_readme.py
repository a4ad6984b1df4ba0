"""The examples of the README and of the docs run without changes."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = [
    code
    for name in ("README.md", "docs/physics.md", "docs/environment.md")
    for code in re.findall(r"```python\n(.*?)```", (ROOT / name).read_text("utf-8"), re.DOTALL)
]


@pytest.mark.parametrize("code", EXAMPLES)
def test_an_example_runs(code: str, capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(code, "example", "exec"), {})
    printed = capsys.readouterr().out.strip()
    promised = re.search(r"print\(.*\)  # ([^:\n]*)", code)
    assert printed == promised[1] if promised else printed
    assert len(EXAMPLES) == 6
