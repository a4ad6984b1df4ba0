"""The options of a game in millimetres, each listed once: :class:`ExactSpec`."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral
from typing import Any

import numpy as np

from marl_pack.checks import exact, shown, truth_value, whole_number
from marl_pack.exact.lengths import check_unit, in_units, to_units
from marl_pack.exact.limits import AREA_RATIO, HULL_1, MOST_UNITS, RULES, SCALE, Limits
from marl_pack.geometry import ALL_ORIENTATIONS
from marl_pack.option_record import (
    OptionRecord,
    document,
    finite_number,
    option,
    reward_weight,
)
from marl_pack.stability.parameters import THRESHOLDS, check_thresholds
from marl_pack.stability.rules import unknown_rule

ORDERS = ("file", "draw")
"""Orders in which goods come: as they are given, or drawn at random."""
MOST_BOXES = 4096
"""Largest number of boxes that a bin may have memory for."""
FINEST_SHARE = 10**6
"""Largest denominator of a share: areas times this number fit into int64."""


def listed(value: Any) -> list[Any]:
    """Return the values in a list, a tuple or an array; [] for anything else."""
    return list(value) if isinstance(value, list | tuple | np.ndarray) else []


def _size_mm(value: Any) -> tuple[float, float, float]:
    sides = listed(value)
    if len(sides) != 3:
        raise ValueError(f"{shown(value)}: needs three lengths in millimetres, W D H")
    numbers = [finite_number(side) for side in sides]
    if not all(number > 0 for number in numbers):
        raise ValueError(f"{shown(value)}: needs three lengths in millimetres > 0, W D H")
    return numbers[0], numbers[1], numbers[2]


def _rule(value: Any) -> str:
    if not isinstance(value, str) or value not in RULES:
        raise unknown_rule(value)
    return value


def _length(value: Any) -> float:
    number = finite_number(value)
    if number < 0:
        raise ValueError(f"{shown(value)}: needs a length in millimetres ≥ 0")
    return number


def _share(value: Any) -> float:
    number = finite_number(value)
    if not 0 <= number <= 1 or exact(number).denominator > FINEST_SHARE:
        raise ValueError(f"{shown(value)}: needs a share from 0 to 1, with at most 6 decimals")
    return number


def _thresholds(value: Any) -> Any:
    if value is None:
        return None
    pairs = check_thresholds(value)
    for share, _ in pairs:
        _share(share)
    return value if isinstance(value, str) else pairs


def _orientations(value: Any) -> tuple[int, ...]:
    chosen = listed(value)
    whole = all(isinstance(o, Integral) and not isinstance(o, bool) for o in chosen)
    if not chosen or not whole or not set(chosen) <= set(ALL_ORIENTATIONS):
        raise ValueError(f"{shown(value)}: need one or more of 0 … 5")
    return tuple(sorted({int(o) for o in chosen}))


def _weight_limit(value: Any) -> float | None:
    if value is None:
        return None
    number = finite_number(value)
    if not number > 0:
        raise ValueError(f"{shown(value)}: needs a weight > 0, or null for no limit")
    return number


def _share_of(value: float) -> tuple[int, int]:
    share = exact(value)
    return share.numerator, share.denominator


def _mm(name: str) -> Any:
    return lambda value: f"{name} {value:g} mm"


@dataclass(frozen=True)
class ExactSpec(OptionRecord):
    """Every option of a game in millimetres.

    Args:
        {options}
    """

    bin_mm: tuple[float, float, float] = option(
        (1200.0, 800.0, 1500.0), "inner sides W, D, H of the bin, in millimetres.", _size_mm,
        lambda size: f"bin {' x '.join(f'{side:g}' for side in size)} mm", always=True,
        nargs=3, type=float, metavar=("W", "D", "H"),
    )  # fmt: skip
    unit_mm: float = option(
        0.1, "unit of all lengths in millimetres; a finer length is refused.", check_unit,
        _mm("unit"), type=float, metavar="MM",
    )  # fmt: skip
    rule: str = option(
        "lbcp", f"stability rule, one of {', '.join(RULES)}.", _rule,
        lambda rule: f"rule {rule}", always=True, choices=list(RULES), metavar="RULE",
    )  # fmt: skip
    margin_mm: float = option(
        0.0, "distance that the centre of mass keeps from the edge of its support, in millimetres.",
        _length, _mm("margin"), type=float, metavar="MM",
    )  # fmt: skip
    margin_share: float = option(
        0.25, "the margin of a box is at most this share of the shorter side of its footprint.",
        _share, lambda share: f"margin at most {share:g} of the shorter side", type=float,
        metavar="SHARE",
    )  # fmt: skip
    margin_on_floor: bool = option(
        False, "whether the margin is asked on the floor, too.",
        lambda value: truth_value(value, "margin_on_floor"),
        lambda asked: "margin on the floor" if asked else "", action=argparse.BooleanOptionalAction,
    )  # fmt: skip
    level_tolerance_mm: float = option(
        0.0, "tops at most this much below the resting height also support a box, in millimetres; "
        "more than 0 is not sound.", _length, _mm("level tolerance"), type=float, metavar="MM",
    )  # fmt: skip
    clearance_mm: float = option(
        0.0, "gap that a box keeps to its neighbours and to the walls, in millimetres.", _length,
        _mm("clearance"), type=float, metavar="MM",
    )  # fmt: skip
    max_overhang: float = option(
        1.0, "largest share of a side of the footprint beyond the supporting boxes.", _share,
        lambda share: f"overhang at most {share:g}", type=float, metavar="SHARE",
    )  # fmt: skip
    thresholds: Any = option(  # noqa: RUF009  # the default is None
        None, f"thresholds of the rule area_ratio, {' or '.join(THRESHOLDS)}; null for its default "
        "(in Python also pairs (share, corners)).", _thresholds,
        lambda thresholds: f"thresholds {thresholds}", choices=list(THRESHOLDS), metavar="NAME",
    )  # fmt: skip
    orientations: tuple[int, ...] = option(
        ALL_ORIENTATIONS, "indices of the allowed orientations, from 0 to 5.", _orientations,
        lambda chosen: f"orientations {' '.join(map(str, chosen))}",
        nargs="+", type=int, metavar="O",
    )  # fmt: skip
    max_weight_kg: float | None = option(
        None, "largest weight of all boxes in the bin, in kilograms; null for no limit. A limit "
        "refuses boxes of unknown weight.",
        _weight_limit, lambda limit: f"at most {limit:g} kg", type=float, metavar="KG",
    )  # fmt: skip
    alpha: float = option(
        1.0, "weight of the volume gained in the reward (Eq. 5).", reward_weight,
        lambda alpha: f"alpha {alpha:g}", type=float,
    )  # fmt: skip
    beta: float = option(
        1.0, "weight of the space enclosed in the reward (Eq. 5).", reward_weight,
        lambda beta: f"beta {beta:g}", type=float,
    )  # fmt: skip
    max_boxes: int = option(
        256, f"largest number of boxes in a bin, 1 to {MOST_BOXES}; it has memory for so many, and "
        "an episode ends there.",
        lambda value: whole_number(value, "max_boxes", 1, MOST_BOXES),
        lambda most: f"at most {most} boxes", type=int, metavar="N",
    )  # fmt: skip

    def __post_init__(self) -> None:
        """Check every option, and that lengths are whole units.

        Raises:
            ValueError: naming the option and what would be right.
        """
        super().__post_init__()
        lengths: dict[str, Any] = {
            "bin_mm": self.bin_mm,
            "level_tolerance_mm": self.level_tolerance_mm,
            "clearance_mm": self.clearance_mm,
        }
        for name, value in lengths.items():
            units, wrong = to_units(value, self.unit_mm)
            if wrong.any():
                raise ValueError(
                    f"{name} = {shown(value)}: needs whole units of {self.unit_mm:g} mm (unit_mm), "
                    f"at most {MOST_UNITS} of them"
                )
            if name == "bin_mm" and 2 * units.min() <= 0:
                raise ValueError(f"bin_mm = {shown(value)}: needs sides of at least one unit")
        if self.margin_mm and RULES[self.rule] < HULL_1:
            raise ValueError(f"margin_mm: the rule {self.rule} has no margin")
        if self.thresholds is not None and RULES[self.rule] != AREA_RATIO:
            raise ValueError(f"thresholds: only the rule area_ratio has them, not {self.rule}")

    @cached_property
    def size(self) -> tuple[int, int, int]:
        """Sides W, D, H of the bin in units."""
        units, _ = to_units(self.bin_mm, self.unit_mm)
        return int(units[0]), int(units[1]), int(units[2])

    def limits(self) -> Limits:
        """Return the options that compiled code reads, in whole numbers."""
        return self._limits

    @cached_property
    def _limits(self) -> Limits:
        lattice = SCALE * in_units(self.margin_mm, self.unit_mm)
        thresholds = check_thresholds("paper" if self.thresholds is None else self.thresholds)
        return Limits(
            rule=RULES[self.rule],
            margin=min(math.ceil(lattice), MOST_UNITS * SCALE),
            margin_share=_share_of(self.margin_share),
            margin_on_floor=self.margin_on_floor,
            tolerance=int(to_units(self.level_tolerance_mm, self.unit_mm)[0]),
            clearance=int(to_units(self.clearance_mm, self.unit_mm)[0]),
            overhang=_share_of(self.max_overhang),
            thresholds=tuple((*_share_of(share), corners) for share, corners in thresholds),
        )


document(ExactSpec, " " * 8)(ExactSpec)
