"""The options of a game, each listed once: :class:`GameSpec`.

Settings files, command lines, the PettingZoo environment, checkpoints and descriptions of games use
the fields of this record. A new option needs one field here, and the code that uses it.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from numbers import Integral
from typing import Any, TypedDict

from marl_pack.checks import shown, truth_value, whole_number
from marl_pack.geometry import ALL_ORIENTATIONS, check_size
from marl_pack.option_record import (
    OptionRecord,
    document,
    finite_number,
    option,
    options_of,
    reward_weight,
)
from marl_pack.stability import RULES, Rule, make_rule
from marl_pack.stability.parameters import NO_OFFSET, THRESHOLDS, check_com_offset
from marl_pack.stability.rules import unknown_rule


def _rule(value: Any) -> Any:
    if callable(value) or (isinstance(value, str) and value in RULES):
        return value
    raise unknown_rule(value)


MOST_ITEMS = 2**31 - 1
"""Largest number of items that a bin may be limited to."""


def _is_whole(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _margin(value: Any) -> float | None:
    if value is not None and finite_number(value) < 0:
        raise ValueError(f"{value!r}: needs a number of cells ≥ 0")
    return None if value is None else float(value)


def _listed(value: Any) -> list[Any]:
    """Return the values in a list, tuple, set or array; [] for texts, bytes and mappings."""
    no_list = (str, bytes, bytearray, Mapping)
    try:
        return [] if isinstance(value, no_list) else list(value)
    except TypeError:  # a single value, as in an array without axes
        return []


def _com_offset(value: Any) -> tuple[float, float, float]:
    numbers = _listed(value)
    if len(numbers) != 3:
        raise ValueError(f"{shown(value)}: needs three fractions of the item's own sides w, d, h")
    return check_com_offset(tuple(map(finite_number, numbers)))


def _thresholds(value: Any) -> str | None:
    if value is not None and not (isinstance(value, str) and value in THRESHOLDS):
        raise ValueError(f"{shown(value)}: needs one of {', '.join(THRESHOLDS)}")
    return None if value is None else str(value)


def _orientations(value: Any) -> tuple[int, ...]:
    chosen = _listed(value)
    if not chosen or not all(map(_is_whole, chosen)) or not set(chosen) <= set(ALL_ORIENTATIONS):
        raise ValueError(f"{shown(value)}: need one or more of 0 … 5")
    return tuple(sorted({int(o) for o in chosen}))


def _max_items(value: Any) -> int | None:
    if value is not None and not (_is_whole(value) and 1 <= value <= MOST_ITEMS):
        raise ValueError(
            f"{shown(value)}: needs a whole number ≥ 1 and ≤ {MOST_ITEMS}, or none for no limit"
        )
    return None if value is None else int(value)


MOST_VISIBLE, MOST_BINS, CLOSINGS = 64, 16, 20
"""Most boxes in a buffer and in a preview, most open bins, and closings for each open bin."""


def _closings(value: Any) -> int | None:
    if value is None:
        return None
    return whole_number(value, "closings", 1, 10**6)


def _rule_name(rule: Any) -> str:
    """Return the name of a rule, given by its name or as a bound function."""
    return rule if isinstance(rule, str) else getattr(getattr(rule, "func", rule), "__name__", "?")


@dataclass(frozen=True)
class GameSpec(OptionRecord):
    """Every option of a packing game.

    The items, the device, the seed and the automatic restart of episodes are not options of a game;
    they are arguments of :class:`marl_pack.game.packing.Packing`.

    Args:
        {options}
    """

    bin: tuple[int, int, int] = option(
        (10, 10, 10), "size W, D, H of the bin, in cells.", check_size,
        lambda bin: f"bin {' x '.join(map(str, bin))}",
        always=True, nargs=3, type=int, metavar=("W", "D", "H"),
    )  # fmt: skip
    rule: Any = option(  # noqa: RUF009  # the default is a name
        "hull_alpha",
        f"stability rule of the masks, one of {', '.join(RULES)} (in Python also a function).",
        _rule, lambda rule: f"rule {_rule_name(rule)}", always=True, choices=list(RULES),
        metavar="RULE",
    )  # fmt: skip
    margin: float | None = option(
        None, "cells by which the support polygon is shrunk, 0 or more; null for none.", _margin,
        lambda margin: f"margin {margin:g}", type=float,
    )  # fmt: skip
    thresholds: str | None = option(
        None,
        f"thresholds of the rule area_ratio, {' or '.join(THRESHOLDS)}; null for its default.",
        _thresholds, lambda thresholds: f"thresholds {thresholds}", choices=list(THRESHOLDS),
        metavar="NAME",
    )  # fmt: skip
    orientations: tuple[int, ...] = option(
        ALL_ORIENTATIONS, "indices of the allowed orientations, from 0 to 5.",
        _orientations, lambda chosen: f"orientations {' '.join(map(str, chosen))}",
        nargs="+", type=int, metavar="O",
    )  # fmt: skip
    mask_orientations: bool = option(
        True, "whether orientations without a stable cell are masked; if not, choosing one ends "
        "the episode.", lambda value: truth_value(value, "mask_orientations"),
        lambda masked: "" if masked else "no mask of orientations",
        flag="orientation-mask", action=argparse.BooleanOptionalAction,
    )  # fmt: skip
    alpha: float = option(
        1.0, "weight of the volume gained in the reward (Eq. 5).", reward_weight,
        lambda alpha: f"alpha {alpha:g}", type=float,
    )  # fmt: skip
    beta: float = option(
        1.0, "weight of the space wasted in the reward (Eq. 5).", reward_weight,
        lambda beta: f"beta {beta:g}", type=float,
    )  # fmt: skip
    com_offset: tuple[float, float, float] = option(
        NO_OFFSET,
        "offset of the items' centre of mass from their middle, in fractions of w, d, h.",
        _com_offset,
        lambda offset: f"centre of mass off by {' '.join(f'{o:g}' for o in offset)}",
        nargs=3, type=float, metavar=("X", "Y", "Z"),
    )  # fmt: skip
    max_items: int | None = option(
        None, "largest number of items in a bin, 1 or more; the episode ends there; null for no "
        "limit.", _max_items, lambda most: f"at most {most} items", type=int,
    )  # fmt: skip

    def __post_init__(self) -> None:
        """Check every option, and the rule with its parameters."""
        super().__post_init__()
        self.make_rule()

    def make_rule(self) -> Rule:
        """Return the stability rule with its parameters bound.

        Raises:
            ValueError: for a parameter that the rule does not take.
        """
        bound = {"margin": self.margin, "thresholds": self.thresholds}
        parameters = {name: value for name, value in bound.items() if value is not None}
        if isinstance(self.rule, str):
            return make_rule(self.rule, **parameters)
        if parameters:
            raise ValueError(f"{', '.join(parameters)}: needs the name of a rule, not a function")
        rule: Rule = self.rule
        return rule

    def to_dict(self) -> dict[str, Any]:
        """Return name → value of all options; a bound rule is its function's name."""
        return asdict(self) | {"rule": _rule_name(self.rule)}


@dataclass(frozen=True)
class SelectionSpec(GameSpec):
    """Every option of a game in which a box and a bin may be selected first.

    Args:
        {options}
    """

    buffer: int = option(
        1, f"number of visible boxes, any of which may be placed next, 1 to {MOST_VISIBLE}.",
        lambda n: whole_number(n, "buffer", 1, MOST_VISIBLE), lambda n: f"buffer {n}", type=int,
        metavar="K",
    )  # fmt: skip
    preview: int = option(
        0, f"number of boxes after the visible ones that are seen, 0 to {MOST_VISIBLE}.",
        lambda n: whole_number(n, "preview", 0, MOST_VISIBLE), lambda n: f"preview {n}", type=int,
        metavar="P",
    )  # fmt: skip
    bins: int = option(
        1, f"number of bins that are open at once, 1 to {MOST_BINS}.",
        lambda n: whole_number(n, "bins", 1, MOST_BINS), lambda n: f"{n} open bins", type=int,
        metavar="B",
    )  # fmt: skip
    closings: int | None = option(
        None, "number of bins that are closed in an episode, 1 or more; null for 1 with one open "
        f"bin, and {CLOSINGS} times the open bins with several.", _closings,
        lambda n: f"{n} closing{'s' * (n > 1)}", type=int, metavar="C",
    )  # fmt: skip

    def __post_init__(self) -> None:
        """Check every option, and that they go together."""
        super().__post_init__()
        if self.selects and (not self.mask_orientations or any(self.com_offset)):
            raise ValueError(
                "buffer, preview, bins, closings: need mask_orientations = true and no com_offset"
            )

    @property
    def most_closings(self) -> int:
        """Number of bins that are closed in an episode."""
        default = 1 if self.bins == 1 else CLOSINGS * self.bins
        return default if self.closings is None else self.closings

    @property
    def selects(self) -> bool:
        """Whether a box or a bin is selected before it is placed, or more boxes are seen."""
        return (self.buffer, self.preview, self.bins, self.most_closings) != (1, 0, 1, 1)

    def of_one_box(self) -> GameSpec:
        """Return the game of one visible box and one bin with the same other options."""
        return GameSpec(**{each.name: getattr(self, each.name) for each in options_of(GameSpec)})


class GameOptions(TypedDict, total=False):
    """The options of :class:`GameSpec` except the bin, as typed keyword arguments."""

    rule: str | Rule
    margin: float | None
    thresholds: str | None
    orientations: Sequence[int]
    mask_orientations: bool
    alpha: float
    beta: float
    com_offset: Sequence[float]
    max_items: int | None


class SelectionOptions(GameOptions, total=False):
    """The options of :class:`SelectionSpec` except the bin, as typed keyword arguments."""

    buffer: int
    preview: int
    bins: int
    closings: int | None


def added_options() -> tuple[str, ...]:
    """Return the names of the options that :class:`SelectionSpec` adds to :class:`GameSpec`."""
    known = {each.name for each in options_of(GameSpec)}
    return tuple(each.name for each in options_of(SelectionSpec) if each.name not in known)


document(GameSpec, " " * 8)(GameSpec)
document(SelectionSpec, " " * 8)(SelectionSpec)
