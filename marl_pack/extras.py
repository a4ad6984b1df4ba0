"""Say how a package that only some commands need is installed."""

from __future__ import annotations


def missing(error: ModuleNotFoundError, what: str, extra: str) -> ModuleNotFoundError:
    """Return the error that an optional package is missing, with the command that installs it.

    Args:
        error: of the import.
        what: names what needs the package, and the package.
        extra: of ``pyproject.toml`` that has it.
    """
    return ModuleNotFoundError(
        f'{error}: {what}; run pip install -e ".[{extra}]" in marl_pack\'s source'
    )
