"""Write the file of all settings with their defaults, each below a comment with its meaning."""

from __future__ import annotations

import json
import textwrap
from dataclasses import fields, is_dataclass
from typing import Any

from docstring_parser import parse

from marl_pack.config.schema import Config

TITLE = """\
# All settings with their defaults, which learn best on RS. Other files contain only settings that
# differ. `make configs` writes this file from the code.
#   marl-pack train --config default
"""


def default_yaml() -> str:
    """Return the text of ``configs/default.yaml``: each default below a comment, its docstring."""
    return "\n".join([TITLE, *_lines(Config(), "")])


def _lines(section: Any, indent: str) -> list[str]:
    """Return the lines of a section; blank lines separate the keys if there is no indent."""
    documented = parse(section.__doc__ or "").params
    descriptions = {param.arg_name: param.description or "" for param in documented}
    lines: list[str] = []
    for field in fields(section):
        comment = " ".join(descriptions[field.name].split())
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
    """Return a plain value as YAML on one line."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return value if isinstance(value, str) else json.dumps(value)
