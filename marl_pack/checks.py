"""Check single values: whole numbers and real numbers are what they say, and nothing else."""

from __future__ import annotations

import math
from fractions import Fraction
from functools import lru_cache
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

DECIMAL = frozenset("0123456789+-.eE")
"""Characters of a number in decimal notation."""

LONGEST_TEXT = 60
"""Number of characters of a value that a message shows."""


def whole_number(value: Any, what: str, low: int, high: int | None = None) -> int:
    """Return a whole number as an int: an int or a NumPy integer, no bool, float or text.

    Args:
        value: to check.
        what: names the value, for the message.
        low: the smallest number allowed.
        high: the largest number allowed; None if there is none.

    Raises:
        ValueError: naming the value and what it needs to be.
    """
    whole = not isinstance(value, bool) and isinstance(value, Integral)
    if not whole or value < low or (high is not None and value > high):
        limits = f">= {low}" if high is None else f"from {low} to {high}"
        raise ValueError(f"{what}: needs a whole number {limits}, not {shown(value)}")
    return int(value)


def real_number(value: Any, what: str) -> float:
    """Return a finite number as a float: a Python or NumPy number, no bool or text.

    A NumPy number of any width means the decimal that it shows as, as a float does.

    Args:
        value: to check.
        what: names the value, for the message.

    Raises:
        ValueError: naming the value and what it needs to be.
    """
    decimal = str(value) if isinstance(value, np.floating) else value
    if not isinstance(value, bool) and isinstance(value, Real):
        try:
            number = float(decimal)
        except OverflowError:  # an int beyond float64
            number = math.inf
        if isinstance(value, Fraction) and math.isfinite(number) and Fraction(str(number)) != value:
            raise ValueError(f"{what}: needs a decimal number, not {shown(value)}")
        if math.isfinite(number):
            return number
    raise ValueError(f"{what}: needs a finite number, not {shown(value)}")


def decimals(numbers: NDArray[Any]) -> NDArray[np.float64]:
    """Return numbers of any width as float64; each means the decimal that it shows as."""
    if numbers.dtype.kind == "f" and numbers.dtype != np.float64:
        numbers = numbers.astype(str)
    return numbers.astype(np.float64)


@lru_cache(maxsize=1 << 14)  # the cells of a table repeat
def number_in(text: str) -> float:
    """Return the number that a text is in decimal notation, an int if it has only digits.

    Raises:
        ValueError: for other text, such as ``1_0``, digits of other scripts, ``nan`` or spaces.
    """
    try:
        if DECIMAL.issuperset(text):  # so float() reads plain decimals alone
            return int(text) if text.lstrip("+-").isdigit() and len(text) < 20 else float(text)
    except ValueError:
        pass
    raise ValueError(f"{shown(text)} is not a number")


def shown(value: Any) -> str:
    """Return the text of a value for a message: one line of limited length."""
    try:
        text = repr(value.item() if isinstance(value, np.generic) else value)
    except (ValueError, RecursionError):  # an int of more digits than Python writes
        text = f"a {type(value).__name__} that is too long to show"
    return one_line(text)


def one_line(text: str, longest: int = LONGEST_TEXT) -> str:
    """Return a text in one line, cut off after ``longest`` characters."""
    line = " ".join(text.split())
    return line if len(line) <= longest else f"{line[: longest - 3]}..."
