"""The settings of the search with a time budget (``--plan budget=100ms``)."""

from __future__ import annotations

import re
from dataclasses import dataclass

from marl_pack.agents.selection.beam_settings import MOST_WIDTH
from marl_pack.checks import whole_number
from marl_pack.settings_text import check_budget, count, milliseconds, settings_in

MOST_DRAWS = 1 << 20
"""Largest number of draws in one decision."""
NEEDS = "needs budget=100ms, draws=N or width=W"


@dataclass(frozen=True)
class BudgetSettings:
    """How long a search may take before each placement, and how much it tries.

    Args:
        budget_ms: milliseconds for a decision; None for no limit, which needs ``draws``.
        draws: largest mean number N of drawn futures of a candidate. With a number and no budget,
            the search does not depend on the speed of the machine. None: as many as there is time
            for.
        width: number of nodes that are kept at each depth among the known boxes.
    """

    budget_ms: float | None = None
    draws: int | None = None
    width: int = 16

    def __post_init__(self) -> None:
        if self.budget_ms is None and self.draws is None:
            raise ValueError("plan: needs a budget, a number of draws, or both")
        if self.budget_ms is not None:
            check_budget(self.budget_ms)
        if self.draws is not None:
            whole_number(self.draws, "draws", 1, MOST_DRAWS)
        whole_number(self.width, "width", 1, MOST_WIDTH)

    def __str__(self) -> str:
        words = [] if self.budget_ms is None else [f"budget={self.budget_ms:g}ms"]
        words += [] if self.draws is None else [f"draws={self.draws}"]
        return ",".join([*words, f"width={self.width}"])

    @staticmethod
    def are_in(text: str) -> bool:
        """Return whether a text of ``--plan`` has these settings: a budget or draws."""
        return re.search(r"\b(budget|draws)\b", text) is not None

    @classmethod
    def parse(cls, text: str) -> BudgetSettings:
        """Read settings such as ``"budget=100ms"`` or ``"draws=40,width=16"``.

        Raises:
            ValueError: if the text has another form; the message says which form is needed.
        """
        readers = {"budget": milliseconds, "draws": count, "width": count}
        values = settings_in(text, readers, NEEDS)
        return cls(values.pop("budget", None), **values)
