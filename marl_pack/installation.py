"""Compile functions with Numba, and cache the compiled code on disk where possible."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile

PACKAGE = Path(__file__).parent


@cache
def compiled_sources(package: Path = PACKAGE) -> str:
    """Return a hash of the source files that compiled functions depend on.

    These are the files with compiled functions and, because of constants, all files beside them;
    in the folder of the package itself only the former.
    """
    sources = {path: path.read_bytes() for path in sorted(package.rglob("*.py"))}
    compiled = {path for path, source in sources.items() if b"njit(" in source}
    folders = {path.parent for path in compiled} - {package}
    digest = hashlib.blake2b(digest_size=16)
    for path, source in sources.items():
        if path in compiled or path.parent in folders:
            digest.update(path.relative_to(package).as_posix().encode() + b"\0" + source)
    return digest.hexdigest()


class _Cache(FunctionCache):
    """Numba's cache of one function; a full disk or a damaged file does not stop the program.

    A compiled function contains the functions that it calls. Numba compiles it again only if its
    own file has changed; here it does so if any file with compiled functions has changed.
    """

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        stamp = self._impl.locator.get_source_stamp(), compiled_sources()
        self._cache_file = IndexDataCacheFile(
            cache_path=self._cache_path, filename_base=self._impl.filename_base, source_stamp=stamp
        )

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
