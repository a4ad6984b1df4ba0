"""Read the settings of ``--plan`` from text such as ``budget=500ms,top=8``."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from marl_pack.checks import real_number


def settings_in(
    text: str, readers: Mapping[str, Callable[[str], float | None]], needs: str
) -> dict[str, Any]:
    """Read the settings in a text of ``--plan``.

    Args:
        text: pairs ``NAME=VALUE``, separated by commas.
        readers: a function for each name, which returns the value, or None if it is no such value.
        needs: what the text has to look like, for messages.

    Raises:
        ValueError: if the text has another form, or a name twice.
    """
    values: dict[str, Any] = {}
    for part in text.split(","):
        name, _, word = (each.strip() for each in part.partition("="))
        value = readers[name](word) if name in readers else None
        if value is None:
            raise ValueError(f"plan {text!r}: {part!r}: {needs}")
        if name in values:
            raise ValueError(f"plan {text!r}: {name} is given twice")
        values[name] = value
    return values


def count(word: str) -> int | None:
    """Read a whole number such as ``16``."""
    return int(word) if re.fullmatch("[0-9]{1,18}", word) else None


def milliseconds(word: str) -> float | None:
    """Read a time such as ``500ms`` or ``1.5s``, in milliseconds."""
    match = re.fullmatch(r"([0-9]{1,9}(?:\.[0-9]{1,6})?)(ms|s)", word)
    return float(match[1]) * (1000 if match[2] == "s" else 1) if match else None


def check_budget(budget_ms: float) -> None:
    """Raise ValueError unless a time for a decision is possible."""
    budget = real_number(budget_ms, "budget")
    if not 0 < budget <= 1e9:
        raise ValueError(f"budget {budget:g} ms: needs more than 0 ms, at most 1e9 ms")
