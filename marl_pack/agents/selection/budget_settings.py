"""The settings of the search with a time budget (``--plan budget=100ms``)."""

from __future__ import annotations

import re
from dataclasses import dataclass

from marl_pack.agents.selection.beam_settings import MOST_WIDTH
from marl_pack.checks import real_number, whole_number

MOST_DRAWS = 1 << 20
"""Largest number of draws in one decision."""
NEEDS = "needs budget=100ms, draws=N or width=W"


@dataclass(frozen=True)
class BudgetSettings:
    """How long a search may take before each placement, and how much it tries.

    Args:
        budget_ms: milliseconds for a decision; None for no limit, which needs ``draws``.
        draws: largest number N of drawn futures for each decision. With a number and no budget, the
            search does not depend on the speed of the machine. None: as many as there is time for.
        width: number of nodes that are kept at each depth among the known boxes.
    """

    budget_ms: float | None = None
    draws: int | None = None
    width: int = 16

    def __post_init__(self) -> None:
        if self.budget_ms is None and self.draws is None:
            raise ValueError("plan: needs a budget, a number of draws, or both")
        if self.budget_ms is not None:
            budget = real_number(self.budget_ms, "budget")
            if not 0 < budget <= 1e9:
                raise ValueError(f"budget {budget:g} ms: needs more than 0 ms, at most 1e9 ms")
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
        values: dict[str, float | int] = {}
        for part in text.split(","):
            key, _, value = (word.strip() for word in part.partition("="))
            name = "budget_ms" if key == "budget" else key
            if name in values:
                raise ValueError(f"plan {text!r}: {key} is given twice")
            if key == "budget" and (match := re.fullmatch(r"(\d{1,9}(?:\.\d{1,6})?)(ms|s)", value)):
                values[name] = float(match[1]) * (1000 if match[2] == "s" else 1)
            elif key in ("draws", "width") and re.fullmatch("[0-9]{1,9}", value):
                values[name] = int(value)
            else:
                raise ValueError(f"plan {text!r}: {part!r}: {NEEDS}")
        return cls(**values)  # type: ignore[arg-type]  # the keys are those of the settings
