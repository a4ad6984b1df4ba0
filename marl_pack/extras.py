"""Tell users how to install a package that only some commands need."""

from __future__ import annotations


def missing(error: ModuleNotFoundError, what: str, extra: str) -> ModuleNotFoundError:
    """Return the error that an optional package is missing, with the command that installs it.

    Args:
        error: the error that the import raised.
        what: says which feature needs which package, for the message.
        extra: the extra in ``pyproject.toml`` that contains the package.
    """
    return ModuleNotFoundError(
        f'{error}: {what}; run pip install -e ".[{extra}]" in marl_pack\'s source'
    )
