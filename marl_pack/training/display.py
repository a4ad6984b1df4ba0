"""Show the progress of a training run on the terminal."""

from __future__ import annotations

import datetime
import math
import time
from collections.abc import Mapping
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.text import Text

from marl_pack.agents.learning.logging import Progress
from marl_pack.evaluation.statistics import spread

QUIET_SECONDS = 30.0  # between two lines of progress if the output is not a terminal


class Display:
    """The progress of a run: a bar on a terminal; without a terminal, a line every 30 seconds."""

    def __init__(self, console: Console, total: int, done: int) -> None:
        self.console, self.total = console, total
        self.live = console.is_terminal
        self.bar = Bar(
            TextColumn("iteration {task.completed:.0f}/{task.total:.0f}"), BarColumn(20),
            TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), console=console,
        )  # fmt: skip
        self.text = Text()
        self.figures = ""  # the text for the last iteration
        self.view = Live(Group(self.bar, self.text), console=console, refresh_per_second=2)
        self.task = self.bar.add_task("", total=total, completed=done)
        self.shown_at = 0.0

    def show(self, progress: Progress) -> None:
        """Show the figures of one iteration."""
        lines = self.lines(progress)
        self.bar.update(self.task, completed=progress.iteration)
        self.text.plain = self.figures = "\n".join(lines)
        now = time.monotonic()
        final = progress.iteration == self.total
        if not self.live and (final or now - self.shown_at > QUIET_SECONDS):
            self.shown_at = now
            left = (self.total - progress.iteration) * progress.seconds / progress.iteration
            self.console.print(
                f"iteration {progress.iteration}/{self.total}  {'  '.join(lines)}  "
                f"left {datetime.timedelta(seconds=round(left))}",
                soft_wrap=True,
            )

    @staticmethod
    def lines(progress: Progress) -> list[str]:
        """Return two lines: speed, utilization and reward; entropies and KLs of the agents."""
        figures = [f"{progress.items_per_second:,.0f} items/s"]
        if not math.isnan(progress.utilization):
            figures.append(f"util {100 * progress.utilization:.1f} %")
        if not math.isnan(progress.reward):
            figures.append(f"reward {progress.reward:.3f}")
        learners = []
        for name in dict.fromkeys(key.partition("/")[0] for key in progress.losses if "/" in key):
            entropy, kl = (progress.losses[f"{name}/{loss}"] for loss in ("entropy", "kl"))
            learners.append(f"{name} entropy {entropy:.3f} KL {kl:.3f}")
        return ["  ".join(figures), "  ".join(learners)]

    def evaluating(self) -> None:
        """Show that an evaluation is running."""
        self.text.plain = f"{self.figures}\nevaluating on held-out sequences"

    def evaluated(self, row: Mapping[str, Any]) -> None:
        """Show the result of one evaluation."""
        self.text.plain = self.figures
        bounds = None if row["low"] is None else (row["low"], row["high"])
        self.console.print(
            f"evaluation after {row['iteration']} iterations, {row['items']:,} items, "
            f"{row['seconds'] / 60:.1f} min: utilization {100 * row['utilization']:.2f}"
            f"{spread(row['utilization'], bounds)} "
            f"% over {row['episodes']} episodes",
            soft_wrap=True,
        )
