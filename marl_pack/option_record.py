"""Records of options: each option is listed once, with its check, its sentence and its argument.

:class:`marl_pack.game.spec.GameSpec` and :class:`marl_pack.exact.spec.ExactSpec` are such records.
Command lines, signatures, docstrings and descriptions of games derive from their fields.
"""

from __future__ import annotations

import argparse
import inspect
import textwrap
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any, Self, TypeVar

from marl_pack import renamed
from marl_pack.checks import real_number, shown

T = TypeVar("T")
NOTHING_TAKEN: Mapping[str, str] = MappingProxyType({})


def option(
    default: Any,
    sentence: str,
    check: Callable[[Any], Any],
    phrase: Callable[[Any], str],
    *,
    always: bool = False,
    **argument: Any,
) -> Any:
    """Return the field of one option.

    Args:
        default: the default value.
        sentence: what the option does, with its range.
        check: a function that returns the value in the right type, or raises ValueError saying what
            would be right.
        phrase: a function that describes the value in a few words.
        always: whether a description names the option although it is at its default.
        **argument: arguments of ``argparse.add_argument`` except the name and the help; ``flag``
            is the name on the command line if it differs from the option's name.
    """
    metadata = {
        "sentence": sentence, "check": check, "phrase": phrase, "always": always,
        "argument": argument,
    }  # fmt: skip
    return field(default=default, metadata=metadata)


LARGEST_WEIGHT = 1e9
"""Largest weight of a part of the reward, so that squares of returns stay within float32."""


def finite_number(value: Any) -> float:
    """Check the number of an option and return it.

    Raises:
        ValueError: unless it is a finite number.
    """
    try:
        return real_number(value, "")
    except ValueError:
        raise ValueError(f"{shown(value)}: needs a finite number") from None


def reward_weight(value: Any) -> float:
    """Check the weight of a part of the reward and return it.

    Raises:
        ValueError: unless it is a number from -1e9 to 1e9.
    """
    number = finite_number(value)
    if abs(number) > LARGEST_WEIGHT:
        raise ValueError(f"{shown(value)}: needs a number from -1e9 to 1e9")
    return number


def options_of(record: Any) -> list[Field[Any]]:
    """Return the options of a record or of its class; other fields are left out."""
    return [each for each in fields(record) if "check" in each.metadata]


@dataclass(frozen=True)
class OptionRecord:
    """The base of records of options; the options are the fields made by :func:`option`."""

    def __post_init__(self) -> None:
        """Check every option.

        Raises:
            ValueError: naming the option and what would be right.
        """
        for each in options_of(self):
            value = getattr(self, each.name)
            try:
                object.__setattr__(self, each.name, each.metadata["check"](value))
            except (ValueError, TypeError) as error:
                named = each.name in str(error)
                raise ValueError(str(error) if named else f"{each.name} = {error}") from None

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Return the record with the options in ``values``; other keys are ignored.

        Args:
            values: name → value, such as the section ``game`` of a run's settings.
        """
        names = {each.name for each in options_of(cls)}
        return cls(**{key: value for key, value in values.items() if key in names})

    def with_options(
        self, options: Mapping[str, Any], taken: Mapping[str, str] = NOTHING_TAKEN
    ) -> Self:
        """Return the record with some options changed.

        Args:
            options: name → value.
            taken: for options with another name in the caller: name → the caller's name.

        Raises:
            TypeError: for a name that is not an option; the message suggests the nearest option.
            ValueError: for an impossible value, or an old name.
        """
        names = [taken.get(each.name, each.name) for each in options_of(self)]
        for name in options:
            renamed.refuse_old(name, renamed.OPTIONS, "option")
            if name not in names:
                near = taken.get(name) or renamed.nearest(name, names)
                guess = renamed.did_you_mean(near)
                raise TypeError(f"unexpected option {name!r}{guess} Options: {', '.join(names)}")
        return replace(self, **options) if options else self

    def phrases(self) -> list[str]:
        """Describe the options that are always named, and those that are not at their default."""
        return [
            each.metadata["phrase"](getattr(self, each.name))
            for each in options_of(self)
            if each.metadata["always"] or getattr(self, each.name) != each.default
        ]

    def __str__(self) -> str:
        """Describe the game, such as ``bin 10 x 10 x 10, rule hull_alpha, margin 1``."""
        return ", ".join(self.phrases())


def document(record: type[OptionRecord], indent: str) -> Callable[[T], T]:
    """Return a decorator that lists the options where a docstring says ``{options}``.

    Args:
        record: the record with the options.
        indent: white space before each option's name.
    """
    lines = "\n".join(
        textwrap.fill(
            f"{each.name}: {each.metadata['sentence']}", 100, initial_indent=indent,
            subsequent_indent=f"{indent}    ", break_on_hyphens=False,
        )
        for each in options_of(record)
    )  # fmt: skip

    def documented(target: T) -> T:
        target.__doc__ = (target.__doc__ or "").replace("{options}", lines.strip())
        return target

    return documented


def with_options(
    record: type[OptionRecord], signature: inspect.Signature, leave_out: Sequence[str] = ()
) -> inspect.Signature:
    """Return a signature that names every option in place of ``**options``.

    Args:
        record: the record with the options.
        signature: the signature of a function or class with ``**options``.
        leave_out: options that it takes by another name.
    """
    others = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    options = [
        inspect.Parameter(
            each.name, inspect.Parameter.KEYWORD_ONLY, default=each.default, annotation=each.type
        )
        for each in options_of(record)
        if each.name not in leave_out
    ]
    return signature.replace(parameters=[*others, *options])


def add_arguments(
    parser: argparse._ActionsContainer,
    record: type[OptionRecord],
    leave_out: Collection[str] = (),
) -> None:
    """Add every option of a record to a command by its name, with the default None.

    Args:
        parser: the command's parser, or a group of its options.
        record: the record with the options.
        leave_out: options that the command has already.
    """
    for each in options_of(record):
        if each.name in leave_out:
            continue
        argument = dict(each.metadata["argument"])
        flag = argument.pop("flag", each.name.replace("_", "-"))
        sentence = each.metadata["sentence"].rstrip(".")
        parser.add_argument(f"--{flag}", dest=each.name, help=sentence, **argument)


def given_options(arguments: argparse.Namespace, record: type[OptionRecord]) -> dict[str, Any]:
    """Return the options of a record that were given on a command line."""
    values = {each.name: getattr(arguments, each.name, None) for each in options_of(record)}
    return {name: value for name, value in values.items() if value is not None}
