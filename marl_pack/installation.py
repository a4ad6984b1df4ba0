"""Compile functions with Numba, and cache the compiled code on disk where possible."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pickle import UnpicklingError
from typing import Any

import numba
from numba.core.caching import FunctionCache


class _Cache(FunctionCache):
    """Numba's cache of one function; a full disk or a damaged file does not stop the program."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled function; None if it is not in the cache or cannot be read."""
        try:
            compiled = super().load_overload(sig, target_context)
        except (OSError, EOFError, UnpicklingError) as error:
            _Uncached.warn(error)
            compiled = None
        if compiled is None:
            _Compiling.announce()
        return compiled

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write the compiled function if that is possible."""
        try:
            super().save_overload(sig, data)
        except (OSError, EOFError, UnpicklingError) as error:
            _Uncached.warn(error)


class _Compiling:
    """The message, shown once a process, that code is compiled because it is not in the cache."""

    say: Callable[[str], object] | None = None

    @classmethod
    def announce(cls) -> None:
        """Show the message unless it was shown before."""
        if cls.say is not None:
            cls.say(
                "compiling code: this takes about 20 seconds, at the first start only "
                "(marl-pack compile does it ahead of time)"
            )
            cls.say = None


def announce_compiling(say: Callable[[str], object]) -> None:
    """Set the function that shows a message before code is compiled for the first time."""
    _Compiling.say = say


class _Uncached:
    """The warning, shown once a process, that compiled code is not cached."""

    warned = False

    @classmethod
    def warn(cls, reason: Exception) -> None:
        """Show the warning unless it was shown before."""
        if not cls.warned:
            cls.warned = True
            warnings.warn(
                "compiled code cannot be cached, so each process compiles it again; set "
                f"NUMBA_CACHE_DIR to a writable folder ({reason})",
                stacklevel=2,
            )


def njit(*, cache: bool = False, **options: Any) -> Callable[[Any], Any]:
    """Return numba.njit's decorator, which compiles in memory where no cache can be written.

    Args:
        cache: whether to cache the compiled code on disk if that is possible.
        **options: other options of ``numba.njit``.
    """

    def decorate(function: Any) -> Any:
        compiled = numba.njit(**options)(function)
        if cache and hasattr(compiled, "enable_caching"):  # not under NUMBA_DISABLE_JIT
            try:
                compiled._cache = _Cache(function)  # what enable_caching() does, with our class
            except (RuntimeError, OSError) as error:
                _Uncached.warn(error)
        return compiled

    return decorate
