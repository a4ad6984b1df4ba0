"""Print on the terminal: every program's output and errors, with foreign text made harmless.

Names of policies, paths, texts of checkpoints and identifiers of items may hold anything. They are
printed as they are: markup is not read, and characters that control a terminal show as escapes.
"""

from __future__ import annotations

import argparse
import os
import sys
from functools import partial
from typing import Any, NoReturn

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from marl_pack.checks import one_line, printable

PIPED_WIDTH = 1000
"""Columns of output that is not a terminal's, so that no table is cut."""


class _PlainConsole(Console):
    """A console that shows every text as it is."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Return the text with printable characters only, without reading markup."""
        return super().render_str(printable(text), **options)


def make_console(**options: Any) -> Console:
    """Return the console of a program; piped output is as wide as it needs to be."""
    console = _PlainConsole(markup=False, emoji=False, **options)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = PIPED_WIDTH
    return console


class _Name(TextColumn):
    """The name of a task, as it is."""

    def render(self, task: Task) -> Text:
        """Return the name with printable characters only."""
        return Text(printable(task.description))


def make_progress(console: Console) -> Progress:
    """Return a progress bar that is removed when the work is done."""
    return Progress(
        _Name(""), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(), TimeRemainingColumn(), console=console, transient=True,
    )  # fmt: skip


def _decimal(kind: type[int] | type[float], text: str) -> float:
    """Return the number that a text is in decimal notation."""
    if "_" in text or not text.isascii():
        raise ValueError
    return kind(text)


class Parser(argparse.ArgumentParser):
    """A parser of a command's options whose errors are one printable line.

    Numbers are decimal: Python's ``1_0`` is none.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        for kind in (int, float):
            self.register("type", kind, partial(_decimal, kind))

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """End the program with a status and a message."""
        super().exit(status, None if message is None else f"{one_line(message)}\n")


def complain(program: str, error: object) -> None:
    """Print a program's error as one line."""
    print(f"{program}: {one_line(str(error))}", file=sys.stderr)
