"""Why a box was placed where it is: the legal placements, and what the policy computed for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.checks import real_number, whole_number
from marl_pack.items.names import check_names

MOST_LISTED = 2000
"""Largest number of legal placements that an explanation lists; the best ones stay."""
ORIENTATIONS = 6
COLUMNS = ("orientation", "x", "y", "z")
NUMBERS = ("probabilities", "values")
KEYS = ("legal", "chosen", "placements")
"""Keys that every explanation has in JSON."""
OPTIONAL = ("orientation_probabilities", *NUMBERS, "value_of", "tries", "probability_of")
PROBABILITY_OF = ("placement", "cell")
"""What the probabilities may be of."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """Why one box was placed where it is.

    Lengths are in the unit of the plan. M placements are listed; NaN stands for "not computed".

    Args:
        legal: number of legal placements, M or more.
        chosen: index of the chosen placement among those listed; -1 if it is not listed.
        orientations: int64 [M], rows of :data:`marl_pack.geometry.ORIENTATIONS`.
        positions: float64 [M, 3], low corners x, y, z.
        orientation_probabilities: float64 [6], of the orientation agent; None if there is none.
        probabilities: float64 [M], of the placement agent, given the chosen orientation; or None.
        values: float64 [M], what the policy expects of each placement; or None.
        value_of: what the values are, such as ``"score"``; "" without values.
        tries: int64 [M], number of futures behind each value; None if values are no means.
        probability_of: what has the probability: ``"placement"``, or ``"cell"`` of a grid in which
            several placements may lie.
    """

    legal: int
    chosen: int
    orientations: NDArray[np.int64]
    positions: NDArray[np.float64]
    orientation_probabilities: NDArray[np.float64] | None = None
    probabilities: NDArray[np.float64] | None = None
    values: NDArray[np.float64] | None = None
    value_of: str = ""
    tries: NDArray[np.int64] | None = None
    probability_of: str = PROBABILITY_OF[0]

    def shortened(self, most: int = MOST_LISTED) -> Explanation:
        """Return the explanation with at most ``most`` placements: the chosen and the best ones.

        The best ones have the highest value, or else the highest probability. Without either,
        every so many placements one stays.
        """
        count = len(self.orientations)
        if count <= most:
            return self
        # Of placements that are equally good, evenly spaced ones are kept.
        spaced = np.zeros(count, np.int64)
        spaced[np.linspace(0, count - 1, most).round().astype(np.int64)] = -1
        ranks: list[NDArray[Any]] = [np.arange(count), spaced]
        for numbers in (self.probabilities, self.values):
            if numbers is not None:
                ranks.append(-np.nan_to_num(numbers, nan=-np.inf))
        ranks.append(np.arange(count) != self.chosen)
        kept = np.sort(np.lexsort(ranks)[:most])
        return replace(
            self,
            chosen=int(np.searchsorted(kept, self.chosen)) if self.chosen >= 0 else -1,
            orientations=self.orientations[kept],
            positions=self.positions[kept],
            probabilities=None if self.probabilities is None else self.probabilities[kept],
            values=None if self.values is None else self.values[kept],
            tries=None if self.tries is None else self.tries[kept],
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the explanation for JSON; numbers have six digits, NaN is null."""
        positions = self.positions.T.tolist()
        columns = [self.orientations.tolist(), *([_plain(v) for v in axis] for axis in positions)]
        content: dict[str, Any] = {
            "legal": self.legal,
            "chosen": self.chosen,
            "placements": dict(zip(COLUMNS, columns, strict=True)),
        }
        for key in ("orientation_probabilities", *NUMBERS):
            numbers = getattr(self, key)
            if numbers is not None:
                content[key] = [None if v != v else float(f"{v:.6g}") for v in numbers.tolist()]
        if self.value_of:
            content["value_of"] = self.value_of
        if self.tries is not None:
            content["tries"] = self.tries.tolist()
        if self.probability_of != PROBABILITY_OF[0]:
            content["probability_of"] = self.probability_of
        return content

    @classmethod
    def of_dict(cls, content: Any, source: str) -> Explanation:
        """Return the explanation that :meth:`to_dict` made.

        Args:
            content: a value that was read from JSON.
            source: what it is, for messages.

        Raises:
            ValueError: if it is not an explanation; says what would be right.
        """
        if not isinstance(content, dict):
            raise ValueError(f"{source}: needs an object")
        check_names(content, (*KEYS, *OPTIONAL), KEYS, source, "key")
        placements = content["placements"]
        if not isinstance(placements, dict):
            raise ValueError(f"{source}: placements: needs an object")
        check_names(placements, COLUMNS, COLUMNS, f"{source}: placements", "key")
        columns = {key: _numbers(placements, key, source) for key in COLUMNS}
        count = len(columns["x"])
        if any(len(column) != count for column in columns.values()):
            raise ValueError(f"{source}: placements: needs columns of the same length")
        orientations = columns["orientation"]
        if not np.isin(orientations, np.arange(ORIENTATIONS)).all():
            raise ValueError(f"{source}: orientation: needs 0 … {ORIENTATIONS - 1}")
        legal = whole_number(content["legal"], f"{source}: legal", count)
        chosen = whole_number(content["chosen"], f"{source}: chosen", -1, count - 1)
        others: dict[str, NDArray[np.float64] | None] = {}
        lengths = {"orientation_probabilities": ORIENTATIONS} | dict.fromkeys(NUMBERS, count)
        for key, length in lengths.items():
            others[key] = _numbers(content, key, source, length) if key in content else None
        value_of = content.get("value_of", "")
        if not isinstance(value_of, str):
            raise ValueError(f"{source}: value_of: needs a text")
        probability_of = content.get("probability_of", PROBABILITY_OF[0])
        if probability_of not in PROBABILITY_OF:
            raise ValueError(f"{source}: probability_of: needs {' or '.join(PROBABILITY_OF)}")
        tries = None
        if "tries" in content:
            given = _numbers(content, "tries", source, count)
            if not ((given >= 0) & (given < 2**53) & (given == np.floor(given))).all():
                raise ValueError(f"{source}: tries: needs whole numbers ≥ 0")
            tries = given.astype(np.int64)
        positions = np.column_stack([columns[key] for key in "xyz"])
        return cls(
            legal, chosen, orientations.astype(np.int64), positions, **others, value_of=value_of,
            tries=tries, probability_of=probability_of,
        )  # fmt: skip


def _plain(value: float) -> int | float:
    """Return a whole number as int, which is shorter in JSON."""
    return int(value) if value.is_integer() else value


def _numbers(
    content: Mapping[str, Any], key: str, source: str, length: int | None = None
) -> NDArray[np.float64]:
    """Return a list of numbers in JSON as float64 [M]; null is NaN where a length is given."""
    values = content[key]
    if not isinstance(values, list) or length not in (None, len(values)):
        many = "" if length is None else f" of {length}"
        raise ValueError(f"{source}: {key}: needs a list{many} numbers")
    return np.array(
        [
            np.nan if value is None and length is not None else real_number(value, key)
            for value in values
        ],
        np.float64,
    )
