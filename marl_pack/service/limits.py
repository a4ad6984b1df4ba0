"""The limits of the service, each listed once: :class:`ServiceLimits`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

from marl_pack.checks import real_number, whole_number
from marl_pack.exact.spec import MOST_BOXES
from marl_pack.option_record import OptionRecord, document, option

LONGEST_ID = 64
"""Characters of a bin's id."""
LONGEST_KEY = 200
"""Characters of an idempotency key."""
LONGEST_TEXT = 200
"""Characters of a box's id, and of the name of an order."""


def _whole(name: str, high: int) -> Any:
    return partial(whole_number, what=name, low=1, high=high)


def _budget(value: Any) -> float:
    number = real_number(value, "max_budget_ms")
    if not 0 < number <= 1e6:
        raise ValueError(f"{number:g}: needs milliseconds > 0, at most 1e6")
    return number


@dataclass(frozen=True)
class ServiceLimits(OptionRecord):
    """How much the clients of the service may ask for.

    Args:
        {options}
    """

    max_bins: int = option(
        10_000, "largest number of open bins.", _whole("max_bins", 10**7),
        lambda n: f"{n} open bins", type=int, metavar="N",
    )  # fmt: skip
    max_boxes: int = option(
        256, f"largest number of boxes in a bin, at most {MOST_BOXES}.",
        _whole("max_boxes", MOST_BOXES), lambda n: f"{n} boxes a bin", type=int, metavar="N",
    )  # fmt: skip
    max_steps: int = option(
        10_000, "largest number of changes of a bin: boxes placed, undone and reported.",
        _whole("max_steps", 10**7), lambda n: f"{n} changes a bin", type=int, metavar="N",
    )  # fmt: skip
    max_body: int = option(
        1 << 18, "largest body of a request in bytes.", _whole("max_body", 1 << 30),
        lambda n: f"{n} bytes a request", type=int, metavar="BYTES",
    )  # fmt: skip
    max_budget_ms: float = option(
        1000.0, "largest time budget of a search in milliseconds.", _budget,
        lambda ms: f"searches of {ms:g} ms", type=float, metavar="MS",
    )  # fmt: skip
    in_memory: int = option(
        1000, "number of bins that are kept in memory, those used last; others are read from the "
        "data when they are needed.", _whole("in_memory", 10**6),
        lambda n: f"{n} bins in memory", type=int, metavar="N",
    )  # fmt: skip


document(ServiceLimits, " " * 8)(ServiceLimits)
