"""Foreign text on the terminal: as it is, without markup and without control characters."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.table import Table

from marl_pack.terminal import (
    Parser,
    complain,
    make_console,
    make_progress,
    make_status,
    printable,
)

NASTY = [
    "q[/z]",
    "[bold]x",
    ":smile:",
    "\x1b[31mred\x1b]0;title\x07",
    "\u202egnp.exe",
    "\udc80",
    "\x00",
]


@pytest.mark.parametrize("text", NASTY)
def test_names_are_printed_as_they_are_everywhere(
    text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = printable(text)
    assert shown.isprintable()
    assert shown == text or not text.isprintable()
    for terminal in (False, True):
        output = io.StringIO()
        console = make_console(file=output, force_terminal=terminal, width=200, color_system=None)
        table = Table(title=text)
        table.add_column(text)
        table.add_row(text)
        with make_progress(console) as bar:
            bar.add_task(f"{text}: episodes", total=1)
            bar.refresh()
            console.print(text, soft_wrap=True)
            console.print(table)
        assert output.getvalue().count(shown) >= 4
        assert not any(bad in output.getvalue() for bad in ("\x1b]", "\x1b[31m", "\u202e", "\x00"))
    complain("program", f"{text}\nsecond line")
    with pytest.raises(SystemExit):
        Parser(prog="program").exit(2, f"program: {text}\nsecond line")
    assert capsys.readouterr().err == f"program: {shown} second line\n" * 2


def test_progress_is_shown_on_a_terminal_alone() -> None:
    for terminal in (False, True):
        output = io.StringIO()
        console = make_console(file=output, force_terminal=terminal, width=80)
        with make_status(console, "loading \x1b[31m"):
            pass
        with make_progress(console) as bar:
            bar.add_task("episodes", total=1)
            bar.refresh()
        assert ("episodes" in output.getvalue()) == terminal
        assert (printable("loading \x1b[31m") in output.getvalue()) == terminal


def test_the_first_start_says_once_that_it_compiles(tmp_path: Path) -> None:
    code = (
        "import numpy\n"
        "from marl_pack.terminal import announce_compiling, make_console\n"
        "from marl_pack.items.random_numbers import draw\n"
        "announce_compiling(make_console(force_terminal=True, width=200))\n"
        "draw(numpy.array([1], numpy.uint64), 10)\n"
    )
    for times in (1, 0):
        output = subprocess.check_output(
            [sys.executable, "-c", code], text=True,
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
        )  # fmt: skip
        assert output.count("compiling") == times


def test_piped_tables_are_not_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    output = io.StringIO()
    table = Table("policy", *(f"column {k}" for k in range(12)))
    table.add_row("models/a_long_name_of_a_policy.pt, plan rollouts=16,top=8", *["1"] * 12)
    make_console(file=output).print(table)
    assert "models/a_long_name_of_a_policy.pt, plan rollouts=16,top=8" in output.getvalue()
    assert "column 11" in output.getvalue()
