"""The options of a game, each listed once: :class:`GameSpec`.

Settings files, command lines, the PettingZoo environment, checkpoints and descriptions of games use
the fields of this record. A new option needs one field here, and the code that uses it.
"""

from __future__ import annotations

import argparse
import inspect
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from numbers import Integral
from types import MappingProxyType
from typing import Any, TypedDict, TypeVar

from marl_pack import renamed
from marl_pack.checks import real_number, shown, truth_value
from marl_pack.geometry import ALL_ORIENTATIONS, check_size
from marl_pack.stability import RULES, Rule, make_rule
from marl_pack.stability.parameters import NO_OFFSET, THRESHOLDS, check_com_offset
from marl_pack.stability.rules import unknown_rule

T = TypeVar("T")
NOTHING_TAKEN: Mapping[str, str] = MappingProxyType({})


def _option(
    default: Any,
    sentence: str,
    check: Callable[[Any], Any],
    phrase: Callable[[Any], str],
    **argument: Any,
) -> Any:
    """Return the field of one option.

    Args:
        default: the default value.
        sentence: what the option does, with its range.
        check: a function that returns the value in the right type, or raises ValueError saying what
            would be right.
        phrase: a function that describes the value in a few words.
        **argument: arguments of ``argparse.add_argument`` except the name and the help; ``flag``
            is the name on the command line if it differs from the option's name.
    """
    metadata = {"sentence": sentence, "check": check, "phrase": phrase, "argument": argument}
    return field(default=default, metadata=metadata)


def _rule(value: Any) -> Any:
    if callable(value) or (isinstance(value, str) and value in RULES):
        return value
    raise unknown_rule(value)


MOST_ITEMS = 2**31 - 1
"""Largest number of items that a bin may be limited to."""


LARGEST_WEIGHT = 1e9
"""Largest weight of a part of the reward, so that squares of returns stay within float32."""


def _is_whole(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _number(value: Any) -> float:
    try:
        return real_number(value, "")
    except ValueError:
        raise ValueError(f"{shown(value)}: needs a finite number") from None


def _reward_weight(value: Any) -> float:
    if abs(_number(value)) > LARGEST_WEIGHT:
        raise ValueError(f"{shown(value)}: needs a number from -1e9 to 1e9")
    return float(value)


def _margin(value: Any) -> float | None:
    if value is not None and _number(value) < 0:
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
    return check_com_offset(tuple(map(_number, numbers)))


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


def _rule_name(rule: Any) -> str:
    """Return the name of a rule, given by its name or as a bound function."""
    return rule if isinstance(rule, str) else getattr(getattr(rule, "func", rule), "__name__", "?")


@dataclass(frozen=True)
class GameSpec:
    """Every option of a packing game.

    The items, the device, the seed and the automatic restart of episodes are not options of a game;
    they are arguments of :class:`marl_pack.game.packing.Packing`.

    Args:
        {options}
    """

    bin: tuple[int, int, int] = _option(
        (10, 10, 10), "size W, D, H of the bin, in cells.", check_size,
        lambda bin: f"bin {' x '.join(map(str, bin))}",
        nargs=3, type=int, metavar=("W", "D", "H"),
    )  # fmt: skip
    rule: Any = _option(  # noqa: RUF009  # the default is a name
        "hull_alpha",
        f"stability rule of the masks, one of {', '.join(RULES)} (in Python also a function).",
        _rule, lambda rule: f"rule {_rule_name(rule)}", choices=list(RULES), metavar="RULE",
    )  # fmt: skip
    margin: float | None = _option(
        None, "cells by which the support polygon is shrunk, 0 or more; null for none.", _margin,
        lambda margin: f"margin {margin:g}", type=float,
    )  # fmt: skip
    thresholds: str | None = _option(
        None,
        f"thresholds of the rule area_ratio, {' or '.join(THRESHOLDS)}; null for its default.",
        _thresholds, lambda thresholds: f"thresholds {thresholds}", choices=list(THRESHOLDS),
        metavar="NAME",
    )  # fmt: skip
    orientations: tuple[int, ...] = _option(
        ALL_ORIENTATIONS, "indices of the allowed orientations, from 0 to 5.",
        _orientations, lambda chosen: f"orientations {' '.join(map(str, chosen))}",
        nargs="+", type=int, metavar="O",
    )  # fmt: skip
    mask_orientations: bool = _option(
        True, "whether orientations without a stable cell are masked; if not, choosing one ends "
        "the episode.", lambda value: truth_value(value, "mask_orientations"),
        lambda masked: "" if masked else "no mask of orientations",
        flag="orientation-mask", action=argparse.BooleanOptionalAction,
    )  # fmt: skip
    alpha: float = _option(
        1.0, "weight of the volume gained in the reward (Eq. 5).", _reward_weight,
        lambda alpha: f"alpha {alpha:g}", type=float,
    )  # fmt: skip
    beta: float = _option(
        1.0, "weight of the space wasted in the reward (Eq. 5).", _reward_weight,
        lambda beta: f"beta {beta:g}", type=float,
    )  # fmt: skip
    com_offset: tuple[float, float, float] = _option(
        NO_OFFSET,
        "offset of the items' centre of mass from their middle, in fractions of w, d, h.",
        _com_offset,
        lambda offset: f"centre of mass off by {' '.join(f'{o:g}' for o in offset)}",
        nargs=3, type=float, metavar=("X", "Y", "Z"),
    )  # fmt: skip
    max_items: int | None = _option(
        None, "largest number of items in a bin, 1 or more; the episode ends there; null for no "
        "limit.", _max_items, lambda most: f"at most {most} items", type=int,
    )  # fmt: skip

    def __post_init__(self) -> None:
        """Check every option.

        Raises:
            ValueError: naming the option and what would be right.
        """
        for option in fields(GameSpec):
            value = getattr(self, option.name)
            try:
                object.__setattr__(self, option.name, option.metadata["check"](value))
            except (ValueError, TypeError) as error:
                named = option.name in str(error)
                raise ValueError(str(error) if named else f"{option.name} = {error}") from None
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

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> GameSpec:
        """Return the spec with the options in ``values``; other keys are ignored.

        Args:
            values: name → value, such as the section ``game`` of a run's settings.
        """
        names = {option.name for option in fields(GameSpec)}
        return GameSpec(**{key: value for key, value in values.items() if key in names})

    def with_options(
        self, options: Mapping[str, Any], taken: Mapping[str, str] = NOTHING_TAKEN
    ) -> GameSpec:
        """Return the spec with some options changed.

        Args:
            options: name → value.
            taken: for options with another name in the caller: name → the caller's name.

        Raises:
            TypeError: for a name that is not an option; the message suggests the nearest option.
            ValueError: for an impossible value, or an old name.
        """
        names = [taken.get(option.name, option.name) for option in fields(GameSpec)]
        for name in options:
            renamed.refuse_old(name, renamed.OPTIONS, "option")
            if name not in names:
                near = taken.get(name) or renamed.nearest(name, names)
                guess = renamed.did_you_mean(near)
                raise TypeError(f"unexpected option {name!r}{guess} Options: {', '.join(names)}")
        return replace(self, **options) if options else self

    def to_dict(self) -> dict[str, Any]:
        """Return name → value of all options; a bound rule is its function's name."""
        return asdict(self) | {"rule": _rule_name(self.rule)}

    def phrases(self) -> list[str]:
        """Describe the bin, the rule, and every other option that is not at its default."""
        return [
            option.metadata["phrase"](getattr(self, option.name))
            for option in fields(GameSpec)
            if option.name in ("bin", "rule") or getattr(self, option.name) != option.default
        ]

    def __str__(self) -> str:
        """Describe the game, such as ``bin 10 x 10 x 10, rule hull_alpha, margin 1``."""
        return ", ".join(self.phrases())


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


def document(indent: str) -> Callable[[T], T]:
    """Return a decorator that lists the options where a docstring says ``{options}``.

    Args:
        indent: white space before each option's name.
    """
    lines = "\n".join(
        textwrap.fill(
            f"{option.name}: {option.metadata['sentence']}", 100, initial_indent=indent,
            subsequent_indent=f"{indent}    ", break_on_hyphens=False,
        )
        for option in fields(GameSpec)
    )  # fmt: skip

    def documented(target: T) -> T:
        target.__doc__ = (target.__doc__ or "").replace("{options}", lines.strip())
        return target

    return documented


def with_options(signature: inspect.Signature, leave_out: Sequence[str] = ()) -> inspect.Signature:
    """Return a signature that names every option in place of ``**options``.

    Args:
        signature: the signature of a function or class with ``**options``.
        leave_out: options that it takes by another name.
    """
    others = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    options = [
        inspect.Parameter(
            option.name, inspect.Parameter.KEYWORD_ONLY, default=option.default,
            annotation=option.type,
        )
        for option in fields(GameSpec)
        if option.name not in leave_out
    ]  # fmt: skip
    return signature.replace(parameters=[*others, *options])


def add_arguments(parser: argparse._ActionsContainer) -> None:
    """Add every option to a command by its name, with the default None."""
    for option in fields(GameSpec):
        argument = dict(option.metadata["argument"])
        flag = argument.pop("flag", option.name.replace("_", "-"))
        sentence = option.metadata["sentence"].rstrip(".")
        parser.add_argument(f"--{flag}", dest=option.name, help=sentence, **argument)


def given_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the options that were given on a command line."""
    values = {option.name: getattr(arguments, option.name) for option in fields(GameSpec)}
    return {name: value for name, value in values.items() if value is not None}


document(" " * 8)(GameSpec)
