"""Write every setting at its default, each below a comment that says what it means."""

from __future__ import annotations

import json
import textwrap
from dataclasses import fields, is_dataclass
from typing import Any

from docstring_parser import parse

from marl_pack.config.schema import Config

TITLE = """\
# Every setting at its default: the settings that learn best on RS. Other files hold only what they
# change. `make configs` writes this file from the code.
#   marl-pack train --config default
"""


def default_yaml() -> str:
    """Return the text of ``configs/default.yaml``: each default, with its docstring as comment."""
    return "\n".join([TITLE, *_lines(Config(), "")])


def _lines(section: Any, indent: str) -> list[str]:
    """Return the lines of a section; a section without indent has blank lines between its keys."""
    documented = parse(section.__doc__ or "").params
    sentences = {part.arg_name: part.description or "" for part in documented}
    lines: list[str] = []
    for field in fields(section):
        comment = " ".join(sentences[field.name].split())
        lines += textwrap.wrap(
            comment, 100, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ",
            break_on_hyphens=False,
        )  # fmt: skip
        value = getattr(section, field.name)
        if is_dataclass(value):
            lines += [f"{indent}{field.name}:", *_lines(value, f"{indent}  ")]
        else:
            lines.append(f"{indent}{field.name}: {_value(value)}")
        lines += [] if indent else [""]
    return lines


def _value(value: Any) -> str:
    """Return a plain value as YAML, a list on one line."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return value if isinstance(value, str) else json.dumps(value)
