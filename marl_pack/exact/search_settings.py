"""The settings of the search in millimetres (``--plan budget=500ms``)."""

from __future__ import annotations

from dataclasses import dataclass

from marl_pack.checks import whole_number
from marl_pack.settings_text import check_budget, count, milliseconds, settings_in

MOST_TOP = 256
"""Largest number of moves to try."""
NEEDS = "needs budget=500ms, top=M or futures=K"


@dataclass(frozen=True)
class ExactSearchSettings:
    """How long a search may take before each placement, and what it tries.

    Args:
        budget_ms: milliseconds for a decision. The search stops after the future in which they end;
            listing the moves is counted.
        top: number M of moves to try, the best ones by the linear score; fewer if there is too
            little time for so many.
        futures: number K of futures for each move, on average; the search ends earlier when they
            are played. None: as many as there is time for. With a number and a long time, the
            search does not depend on the speed of the machine.
    """

    budget_ms: float = 500.0
    top: int = 6
    futures: int | None = None

    def __post_init__(self) -> None:
        check_budget(self.budget_ms)
        whole_number(self.top, "top", 1, MOST_TOP)
        if self.futures is not None:
            whole_number(self.futures, "futures", 1, 1 << 20)

    def tries(self, k: int, rounds: int, survivors: int) -> float:
        """Return how many futures round ``k`` plays at most."""
        if self.futures is None:
            return float("inf")
        return max(1, round(self.futures * self.top / rounds / survivors))

    def __str__(self) -> str:
        words = [f"budget={self.budget_ms:g}ms", f"top={self.top}"]
        if self.futures is not None:
            words.append(f"futures={self.futures}")
        return ",".join(words)

    @classmethod
    def parse(cls, text: str) -> ExactSearchSettings:
        """Read settings such as ``"budget=500ms,top=8"``; missing settings get defaults.

        Raises:
            ValueError: if the text has another form; the message says which form is needed.
        """
        values = settings_in(text, {"budget": milliseconds, "top": count, "futures": count}, NEEDS)
        return cls(values.pop("budget", cls.budget_ms), **values)
