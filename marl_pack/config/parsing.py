"""Read settings from YAML files, the command line and checkpoints."""

from __future__ import annotations

import contextlib
import difflib
import re
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from jsonargparse import ArgumentError, ArgumentParser, Namespace

from marl_pack import renamed
from marl_pack.config.checks import ConfigError, check
from marl_pack.config.schema import Config


def make_parser() -> ArgumentParser:
    """Return the options of ``python -m marl_pack.train``: every key of :class:`Config`."""
    parser = ArgumentParser(
        prog="python -m marl_pack.train",
        description="Train the orientation and the placement agent.",
        exit_on_error=False,
        allow_abbrev=False,
    )
    parser.add_argument("--config", action="config", help="YAML file of settings; may be repeated")
    parser.add_argument(
        "--resume", metavar="RUN", default=None,
        help="continue the run in this folder exactly; only output.*, evaluation.* and "
        "ppo.max_iterations may be given beside it",
    )  # fmt: skip
    parser.add_class_arguments(Config, None)
    return parser


def parse(arguments: Sequence[str] | None = None) -> tuple[Config, Namespace]:
    """Read the settings from the command line and the files that it names.

    Args:
        arguments: of the command line.

    Returns:
        The checked settings, and the options before they were checked.

    Raises:
        ConfigError: for an unknown key, a wrong type or an impossible value.
    """
    words = sys.argv[1:] if arguments is None else arguments
    for before, option in pairwise(("", *words)):
        path = option if before == "--config" else option.removeprefix("--config=")
        if "\n" in path:  # the settings themselves, not a file's name
            continue
        if (before == "--config" or path != option) and Path(path).is_file():
            check_file(Path(path))
    parser = make_parser()
    with _explained(parser):
        options = parser.parse_args(words)
        return build(parser, options), options


def check_file(path: Path) -> None:
    """Refuse mistakes in a file that the parser would accept or report without their line.

    Raises:
        ConfigError: for a file that is no YAML mapping, or has a key twice or an empty section.
    """
    try:
        root = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text in UTF-8 ({error.reason})") from None
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(root, yaml.MappingNode):
        raise ConfigError(f"{path}: needs keys and values, as configs/rs.yaml has them")
    sections = {key.rpartition(".")[0] for key in keys(make_parser())} - {""}

    def check_section(node: yaml.MappingNode, prefix: str) -> None:
        names = set()
        for name, value in node.value:
            key, where = f"{prefix}{name.value}", f"{path}, line {name.start_mark.line + 1}"
            if key in names:
                raise ConfigError(f"{where}: {key} is given twice")
            if key == "resume":
                raise ConfigError(f"{where}: --resume needs to be on the command line")
            names.add(key)
            if isinstance(value, yaml.MappingNode):
                check_section(value, f"{key}.")
            elif key in sections:
                raise ConfigError(f"{where}: {key} is a section; its keys go below it, indented")

    check_section(root, "")


def build(parser: ArgumentParser, options: Namespace) -> Config:
    """Return the checked :class:`Config` of parsed options."""
    built = parser.instantiate(options)
    config = Config(**{name: built[name] for name in Config.__dataclass_fields__})
    check(config)
    return config


def from_dict(settings: dict[str, Any]) -> Config:
    """Return the settings that a checkpoint holds.

    Raises:
        ConfigError: if they are not settings of this version.
    """
    parser = make_parser()
    with _explained(parser):
        return build(parser, parser.parse_object(settings))


@contextlib.contextmanager
def _explained(parser: ArgumentParser) -> Iterator[None]:
    """Raise the errors of the parser and of the settings' own checks as ConfigError."""
    try:
        yield
    except ConfigError:
        raise
    except ArgumentError as error:
        raise ConfigError(explain(parser, str(error))) from None
    except (ValueError, TypeError) as error:
        raise ConfigError(str(error)) from None


def keys(parser: ArgumentParser) -> list[str]:
    """Return every key of the settings, with dots between sections."""
    return [
        key for key in parser.get_defaults().keys(branches=False) if key not in ("config", "resume")
    ]


def explain(parser: ArgumentParser, message: str) -> str:
    """Return the parser's message, with the nearest and all valid keys where one is unknown."""
    message = re.sub(r"\s*\n\s*", " ", message).strip()
    message = re.sub(r"Expected a typing\.Literal\[(.*?)\]", r"Expected one of \1", message)
    message = re.sub(r"Expected a <class '(\w+)'>", r"Expected \1", message)
    inside = re.search(r"Group '([\w.]+)' does not accept option '([\w.]+)'", message)
    beside = re.search(r"unrecognized arguments: --([\w.]+)", message)
    if inside is not None:
        key = f"{inside[1]}.{inside[2]}"
    elif beside is not None:
        key = beside[1]
    else:
        alone = re.search(r"Option '([\w.]+)' is not accepted", message)
        if alone is None:
            return message
        key = alone[1]
    section, _, last = key.rpartition(".")
    if last in renamed.AGENT_KEYS:
        return f"unknown key {key}: it is now called {section}.{renamed.AGENT_KEYS[last]}"
    every_key = keys(parser)
    section = key.rpartition(".")[0]
    while section and not any(name.startswith(section + ".") for name in every_key):
        section = section.rpartition(".")[0]
    prefix = f"{section}." if section else ""
    valid = {n[len(prefix) :].partition(".")[0] for n in every_key if n.startswith(prefix)}
    near = difflib.get_close_matches(key, every_key, 1)
    guess = f" Did you mean {near[0]}?" if near else ""
    where = f" in {section}" if section else ""
    return f"unknown key {key}.{guess} Keys{where}: {', '.join(sorted(valid))}"
