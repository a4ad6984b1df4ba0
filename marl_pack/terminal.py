"""Print the output and the errors of all programs, with text from users made harmless.

Names of policies, paths, texts in checkpoints and ids of items may contain any characters. Markup
in them is not interpreted, and characters that control a terminal are printed as escapes.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
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
from rich.status import Status
from rich.text import Text

from marl_pack import renamed
from marl_pack.checks import one_line, printable, shown

PIPED_WIDTH = 1000
"""Width in columns of output that does not go to a terminal, so that no table is cut."""


class _PlainConsole(Console):
    """A console that does not interpret markup in texts."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Return the text with printable characters only, without reading markup."""
        return super().render_str(printable(text), **options)


def make_console(**options: Any) -> Console:
    """Return the console of a program; piped output is wide enough for every table."""
    console = _PlainConsole(markup=False, emoji=False, **options)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = PIPED_WIDTH
    return console


class _Name(TextColumn):
    """The column with the name of a task, in which markup is not interpreted."""

    def render(self, task: Task) -> Text:
        """Return the name with printable characters only."""
        return Text(printable(task.description))


def make_progress(console: Console) -> Progress:
    """Return a progress bar that is removed when the work is done; piped output has none."""
    return Progress(
        _Name(""), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(), TimeRemainingColumn(), console=console, transient=True,
        disable=not console.is_terminal,
    )  # fmt: skip


def announce_compiling(console: Console) -> None:
    """On a terminal, show a message if the first start compiles code, which takes seconds."""
    if console.is_terminal:
        from marl_pack.installation import announce_compiling  # imports Numba

        announce_compiling(console.print)


def make_status(console: Console, text: str) -> Status:
    """Return a line that shows ``text`` while the work goes on; piped output has none."""
    return console.status(Text(printable(text)))


def _decimal(kind: type[int] | type[float], text: str) -> float:
    """Return the number that a text is in decimal notation."""
    if "_" in text or not text.isascii():
        raise ValueError
    return kind(text)


class Parser(argparse.ArgumentParser):
    """A parser of a command's options whose errors are one printable line.

    The line suggests the name that was probably meant. Numbers must be decimal: ``1_0`` is refused,
    although Python accepts it.

    Args:
        notes: paragraphs below the options in the help; they are not wrapped.
        examples: arguments that a user may give, without the command's name.
        **options: arguments of :class:`argparse.ArgumentParser`.
    """

    def __init__(
        self, *, notes: Sequence[str] = (), examples: Sequence[str] = (), **options: Any
    ) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, **options)
        for kind in (int, float):
            self.register("type", kind, partial(_decimal, kind))
        self.epilog = below_options(self.prog, notes, examples)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse the arguments; refuse those that belong to no option."""
        parsed, unknown = super().parse_known_args(args, namespace)
        for word in unknown:
            option = word.partition("=")[0]
            if option.startswith("-"):
                guess = renamed.guess(option, self._option_string_actions)
                self.error(f"unknown option {shown(option)}{guess or '; --help lists them'}")
        if unknown:
            self.error(f"{shown(unknown[0])}: does not belong to an option")
        return parsed, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a value that is not among the choices."""
        choices = list(action.choices or [value])
        if value not in choices:
            names = list(map(str, choices))
            guess = renamed.guess(str(value), names)
            message = f"{shown(value)}: needs one of {', '.join(names)}{guess}"
            raise argparse.ArgumentError(action, message)

    def error(self, message: str) -> NoReturn:
        """End the program with status 2 and a message."""
        self.exit(2, f"{self.prog}: {message}")

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """End the program with a status and a message."""
        super().exit(status, None if message is None else f"{one_line(message)}\n")


def below_options(program: str, notes: Sequence[str], examples: Sequence[str]) -> str:
    """Return the text below the options in a command's help: notes, then examples."""
    uses = "\n".join(f"  {program} {example}" for example in examples)
    return "\n\n".join([*notes, *([f"examples:\n{uses}"] if uses else [])])


def complain(program: str, error: object) -> None:
    """Print a program's error as one line."""
    print(f"{program}: {one_line(str(error))}", file=sys.stderr)
