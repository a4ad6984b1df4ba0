"""Check the form of a file's content: plain values and tensors of known types and shapes.

The module :mod:`marl_pack.agents.learning.checkpoint` knows the meaning of the values.
"""

from __future__ import annotations

import math
import unicodedata
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from marl_pack.checks import TYPE_NAMES, described, shown

MOST_VALUES, DEEPEST, LONGEST_TEXT = 1 << 18, 32, 4096
"""Limits of a file: number of values, depth of nesting, and characters in a text."""
LONGEST_NAME = 60
"""Length of the longest key that a message shows as it is."""
LARGEST_WHOLE = 1 << 64
"""Whole numbers are smaller than this."""

NAMES = TYPE_NAMES | {Tensor: "a tensor", dict: "a mapping", list: "a list"}
"""Names of types in messages."""


class Plain:
    """A copier of untrusted values that lets only plain values and ordinary tensors pass.

    Mappings become dicts, and subclasses of tensors become tensors. Values may be shared, so a
    small file can describe very many: their number, depth and memory are limited.

    Args:
        most_bytes: largest memory of all tensors together.
    """

    def __init__(self, most_bytes: int) -> None:
        self.bytes, self.values = most_bytes, MOST_VALUES

    def copy(self, value: Any, where: str = "", depth: int = 0) -> Any:
        """Return the copy of a value.

        Args:
            value: the value to copy.
            where: name of the value, for messages.
            depth: how deep it is nested.

        Raises:
            ValueError: if a value is not plain or not finite, or exceeds a limit.
        """
        self.values -= 1
        if self.values < 0 or depth > DEEPEST:
            raise ValueError(f"{where}: too many values, or nested too deeply")
        if isinstance(value, Tensor):
            return self._tensor(value, where)
        if isinstance(value, Mapping):
            return {
                self._key(key, where): self.copy(item, _path_to(where, key), depth + 1)
                for key, item in value.items()
            }
        if type(value) in (list, tuple):
            return type(value)(
                [self.copy(item, f"{where}.{k}", depth + 1) for k, item in enumerate(value)]
            )
        return self._single(value, where)

    def _key(self, key: Any, where: str) -> Any:
        """Return the key of a mapping, which must be a text or a whole number."""
        if type(key) not in (str, int):
            raise ValueError(f"{where}: has a key that is neither a text nor a whole number")
        return self._single(key, f"{where}: a key")

    @staticmethod
    def _single(value: Any, where: str) -> Any:
        """Return a value that must be plain and contain no other values."""
        if type(value) is str:
            if len(value) > LONGEST_TEXT:
                raise ValueError(f"{where}: a text of more than {LONGEST_TEXT} characters")
            if any(unicodedata.category(character) in ("Cc", "Cs") for character in value):
                raise ValueError(f"{where}: a text with control characters, {shown(value)}")
        elif type(value) is int:
            if abs(value) >= LARGEST_WHOLE:
                raise ValueError(f"{where}: {shown(value)} is too large, needs at most 64 bits")
        elif type(value) is float:
            if not math.isfinite(value):
                raise ValueError(f"{where}: is {value}, needs a finite number")
        elif value is not None and type(value) is not bool:
            raise ValueError(f"{where}: a {type(value).__name__}, needs a tensor or a plain value")
        return value

    def _tensor(self, value: Tensor, where: str) -> Tensor:
        """Return an ordinary dense tensor with the same numbers."""
        if value.layout != torch.strided or value.is_quantized or value.is_meta:
            raise ValueError(f"{where}: needs an ordinary dense tensor")
        self.bytes -= value.numel() * value.element_size()
        if self.bytes < 0:
            raise ValueError(f"{where}: the tensors take more memory than the file")
        tensor = value.detach().as_subclass(Tensor).resolve_conj().resolve_neg()
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{where}: has numbers that are not finite")
        return tensor


def _path_to(where: str, key: object) -> str:
    """Return the name of the value ``key`` in the value ``where``, for messages."""
    name = key if type(key) is str and len(key) <= LONGEST_NAME else shown(key)
    return f"{where}.{name}" if where else name


Form = Any
"""The form of a value: a type or a tuple of possible types; a dict from keys (or a type of keys) to
forms; a list with one form for all entries, or with a form for each entry."""


def check_form(value: Any, form: Form, where: str) -> None:
    """Refuse a value that has another form; keys that the form does not name are not checked.

    Raises:
        ValueError: the message names the first wrong value and says what it needs to be.
    """
    if isinstance(form, dict):
        _check_type(value, dict, where)
        for key, item in value.items():
            form_of_item = form.get(key, form.get(type(key)))
            if form_of_item is not None:
                check_form(item, form_of_item, _path_to(where, key))
            elif str not in form and int in form:
                raise ValueError(f"{where}: has the key {shown(key)}, needs whole numbers")
    elif isinstance(form, list):
        _check_type(value, list, where)
        if len(form) > 1 and len(value) != len(form):
            raise ValueError(f"{where}: has {len(value)} entries, needs {len(form)}")
        for k, item in enumerate(value):
            check_form(item, form[k if len(form) > 1 else 0], _path_to(where, k))
    else:
        _check_type(value, form, where)


def check_no_tensors(value: Any, where: str) -> None:
    """Refuse a tensor in nested values.

    Raises:
        ValueError: the message names the first tensor.
    """
    if isinstance(value, Tensor):
        raise ValueError(f"{where}: is a tensor, needs a plain value")
    if isinstance(value, Mapping):
        for key, item in value.items():
            check_no_tensors(item, _path_to(where, key))
    elif isinstance(value, list | tuple):
        for k, item in enumerate(value):
            check_no_tensors(item, _path_to(where, k))


def _check_type(value: Any, form: type | tuple[type, ...], where: str) -> None:
    """Refuse a value of another type; whole numbers count as numbers, tuples as lists."""
    types = form if isinstance(form, tuple) else (form,)
    accepted = {float: (float, int), list: (list, tuple), dict: (dict, OrderedDict)}
    if not any(type(value) in accepted.get(t, (t,)) for t in types):
        needs = " or ".join(NAMES[t] for t in types)
        raise ValueError(f"{where}: needs {needs}, not {described(value)}")


def check_alike(value: Any, own: Any, where: str) -> None:
    """Refuse a value that differs from another in keys, types, dtypes or shapes.

    Args:
        value: the value to check.
        own: a value of the right form; its numbers do not matter.
        where: name of the value, for messages.

    Raises:
        ValueError: the message names the first wrong value and says what it needs to be.
    """
    if isinstance(own, Tensor):
        if not isinstance(value, Tensor) or (value.dtype, value.shape) != (own.dtype, own.shape):
            raise ValueError(f"{where}: is {described(value)}, needs {described(own)}")
    elif isinstance(own, Mapping):
        _check_type(value, dict, where)
        check_keys(value, list(own), where)
        for key, item in own.items():
            check_alike(value[key], item, _path_to(where, key))
    else:
        _check_type(value, float if type(own) is int else type(own), where)


def check_keys(
    value: Mapping[Any, Any], keys: Sequence[Any], where: str, also: Sequence[Any] = ()
) -> None:
    """Refuse a mapping that lacks one of ``keys`` or has a key in neither ``keys`` nor ``also``.

    Raises:
        ValueError: the message names the first key that is missing or unknown.
    """
    for key in keys:
        if key not in value:
            raise ValueError(f"{_path_to(where, key)} is missing")
    for key in value:
        if key not in keys and key not in also:
            raise ValueError(f"{_path_to(where, key)} is unknown")
