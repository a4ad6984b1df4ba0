"""Check single values, and describe values in messages."""

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
LONGEST_LINE = 1000
"""Number of characters of a whole message."""

LARGEST_SEED = 2**63 - 1
"""The largest seed that a user may give."""

TYPE_NAMES = {
    bool: "true or false", int: "a whole number", float: "a number", str: "a text",
    type(None): "null",
}  # fmt: skip
"""The names of types in messages."""


def truth_value(value: Any, what: str) -> bool:
    """Return a truth value as a bool; accept a bool or a NumPy bool, but no number or text.

    Args:
        value: the value to check.
        what: the name of the value, for the message.

    Raises:
        ValueError: naming the value and what it needs to be.
    """
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{what} = {shown(value)}: needs {TYPE_NAMES[bool]}")
    return bool(value)


def whole_number(value: Any, what: str, low: int, high: int | None = None) -> int:
    """Return a whole number as an int; accept an int or a NumPy integer, no bool, float or text.

    Args:
        value: the value to check.
        what: the name of the value, for the message.
        low: the smallest number allowed.
        high: the largest number allowed; None if there is none.

    Raises:
        ValueError: naming the value and what it needs to be.
    """
    whole = type(value) is int or (not isinstance(value, bool) and isinstance(value, Integral))
    if not whole or value < low or (high is not None and value > high):
        limits = f">= {low}" if high is None else f"from {low} to {high}"
        raise ValueError(f"{what}: needs a whole number {limits}, not {shown(value)}")
    return int(value)


def real_number(value: Any, what: str) -> float:
    """Return a finite number as a float; accept a Python or NumPy number, but no bool or text.

    A NumPy number of any width stands for the decimal number that it is printed as, like a float.

    Args:
        value: the value to check.
        what: the name of the value, for the message.

    Raises:
        ValueError: naming the value and what it needs to be.
    """
    if type(value) is int and abs(value) < LARGEST_SEED:  # the usual cases, quickly
        return float(value)
    if type(value) is float and math.isfinite(value):
        return value
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
    """Return numbers of any width as float64; each stands for the decimal it is printed as."""
    if numbers.dtype.kind == "f" and numbers.dtype != np.float64:
        numbers = numbers.astype(str)
    return numbers.astype(np.float64)


def exact(value: float | Fraction) -> Fraction:
    """Return a number as a fraction; a float means its shortest decimal, as ``str`` writes it.

    Raises:
        ValueError: for NaN and infinity.
    """
    return value if isinstance(value, Fraction) else _decimal(float(value))


@lru_cache(maxsize=1 << 14)  # the same weights and centres occur often
def _decimal(value: float) -> Fraction:
    """Return the fraction that the shortest decimal of a float stands for."""
    return Fraction(str(value))


@lru_cache(maxsize=1 << 14)  # the cells of a table repeat
def number_in(text: str) -> float:
    """Return the number that a text contains in decimal notation; an int if it has only digits.

    Raises:
        ValueError: for other text, such as ``1_0``, digits of other scripts, ``nan`` or spaces.
    """
    try:
        if DECIMAL.issuperset(text):  # so float() reads only plain decimals
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
    return one_line(text, LONGEST_TEXT)


def described(value: Any) -> str:
    """Describe a value in a few words: an array or a tensor by its type and shape."""
    if isinstance(value, np.generic) or not hasattr(value, "dtype"):
        return shown(value)
    kind = "a NumPy array of " if isinstance(value, np.ndarray) else ""
    return f"{kind}{str(value.dtype).removeprefix('torch.')} {list(value.shape)}"


def printable(text: str) -> str:
    """Return a text in which characters that cannot be printed are replaced by escapes."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


def one_line(text: str, longest: int = LONGEST_LINE) -> str:
    """Return a text as one line of at most ``longest`` printable characters."""
    line = printable(" ".join(text.split()))
    return line if len(line) <= longest else f"{line[: longest - 3]}..."
