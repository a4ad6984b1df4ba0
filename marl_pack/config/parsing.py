"""Read settings from YAML files, the command line and checkpoints."""

from __future__ import annotations

import contextlib
import re
import sys
import types
from argparse import RawDescriptionHelpFormatter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import yaml
from jsonargparse import ArgumentError, ArgumentParser, DefaultHelpFormatter, Namespace

from marl_pack import published, renamed
from marl_pack.checks import TYPE_NAMES, one_line, shown
from marl_pack.config.checks import ConfigError, check
from marl_pack.config.schema import Config
from marl_pack.terminal import below_options

MOST_BYTES = 100_000
"""Largest size of a file of settings."""
LONGEST_VALUE = 4096
"""Largest number of characters of one value, such as a path."""
DEEPEST = 20
"""Largest number of levels of lists and sections in settings; real settings have far fewer."""
NOT_DECIMAL = re.compile(r"[-+]?(0[\dxob]|\d[\d.]*[_:])")
"""Numbers that YAML does not read as decimal."""
MOST_NODES = 10_000
"""Largest number of values in settings, including those that anchors repeat."""


YAML = "tag:yaml.org,2002:"
NULL_TAG = f"{YAML}null"
KEY_TAGS = (f"{YAML}str", f"{YAML}merge")
"""YAML tags of the names of keys, and of ``<<``."""
KINDS = ("bool", "float", "int", "null", "seq", "str", "timestamp")
VALUE_TAGS = {f"{YAML}{kind}" for kind in KINDS}
"""YAML tags that follow from how a value is written, without an explicit tag."""
NULLS = (None, "null", "Null", "NULL", "~")
"""Values that mean null; on the command line each may be given as text."""


PROGRAM = "python -m marl_pack.train"
EXAMPLES = (
    "--config quick --output.name NAME",
    "--config my.yaml --game.bin=[12,10,14] --seed 1",
    "--resume runs/NAME --ppo.max_iterations 5000",
)


class _Help(DefaultHelpFormatter, RawDescriptionHelpFormatter):
    """A formatter of --help that does not wrap the examples."""


def make_parser(program: str = PROGRAM) -> ArgumentParser:
    """Return the parser of the command ``train``, with every key of :class:`Config` as option."""
    parser = ArgumentParser(
        prog=program,
        usage=f"{program} [--config NAME] [--KEY VALUE ...]",
        description="Train the orientation and the placement agent.",
        epilog=below_options(program, (), EXAMPLES),
        formatter_class=_Help,
        exit_on_error=False,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--config", action="config",
        help=f"one of {', '.join(published.configs())}, or a YAML file of settings; may be "
        "repeated",
    )  # fmt: skip
    parser.add_argument(
        "--resume", metavar="RUN", default=None,
        help="continue the run in this folder exactly; with it only output.*, evaluation.* and "
        "ppo.max_iterations may be changed",
    )  # fmt: skip
    parser.add_class_arguments(Config, None)
    return parser


def parse(
    arguments: Sequence[str] | None = None, program: str = PROGRAM
) -> tuple[Config, Namespace]:
    """Read the settings from the command line and the files that it names.

    Args:
        arguments: the words of the command line; by default those of this process.
        program: name of the command, for its help.

    Returns:
        The checked settings, and the parsed options before the check.

    Raises:
        ConfigError: for an unknown key, a wrong type or an impossible value.
    """
    words = list(_with_paths(sys.argv[1:] if arguments is None else arguments))
    parser = make_parser(program)
    for option, source in check_words(words, ["config", *sections()]):
        check_source(source, option)
    with _explained(parser):
        options = parser.parse_args(words)
        return build(parser, options), options


def _with_paths(words: Sequence[str]) -> Iterator[str]:
    """Yield the words of a command line, with the names of published settings replaced by paths.

    Raises:
        ConfigError: for a name that no published settings have.
    """
    for before, word in pairwise(("", *words)):
        option, equals, value = word.partition("=")
        try:
            if before == "--config" and not is_text(word):
                yield str(published.config(word))
            elif option == "--config" and equals and not is_text(value):
                yield f"--config={published.config(value)}"
            else:
                yield word
        except ValueError as error:
            raise ConfigError(f"--config {error}") from None


def is_text(source: str) -> bool:
    """Return whether a source of settings is a YAML text, and not the path of a file."""
    return "\n" in source or source.lstrip()[:1] == "{"


def sections() -> set[str]:
    """Return the names of all sections: the keys that contain other keys."""
    return {key.rpartition(".")[0] for key in TYPES} - {""}


def check_words(words: Sequence[str], files: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Check the values on a command line as YAML; yield the options whose values may be files.

    Args:
        words: the words of the command line.
        files: the options whose values may be files of settings.

    Raises:
        ConfigError: for a value that is too deep or too large, or a number in another notation.
    """
    for before, word in pairwise(("", *words)):
        option, equals, value = word.partition("=")
        option, value = (option, value) if equals and word[:2] == "--" else (before, word)
        if option.removeprefix("--") in files:
            yield option, value
        else:
            with contextlib.suppress(yaml.YAMLError):  # the value is a text that is not YAML
                check_numbers(compose(value, option), option.removeprefix("--"))


def check_source(source: str, option: str) -> None:
    """Refuse mistakes in settings that the parser would accept, or report without the line number.

    Args:
        source: the path of a YAML file, or a YAML text.
        option: the option of the command line that has this value.

    Raises:
        ConfigError: for a file that is not a YAML mapping, or has a key twice or an empty section.
    """
    path = source
    try:
        if is_text(source):
            text, path = source, option
        elif "\0" in source or not Path(source).is_file():
            raise ConfigError(f"{option} {shown(source)}: there is no such file of settings")
        elif Path(source).stat().st_size > MOST_BYTES:
            raise ConfigError(f"{source}: settings need {MOST_BYTES:,} bytes at most")
        else:
            text = Path(source).read_text(encoding="utf-8")
        root = compose(text, path)
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text in UTF-8 ({error.reason})") from None
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not YAML: {one_line(str(error))}") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    if not isinstance(root, yaml.MappingNode):
        raise ConfigError(f"{path}: needs keys and values, as configs/default.yaml has them")
    section_names = sections()

    def check_section(node: yaml.MappingNode, prefix: str) -> None:
        names = set()
        for name, value in node.value:
            where = f"{path}, line {name.start_mark.line + 1}"
            if name.tag not in KEY_TAGS:
                raise ConfigError(f"{where}: needs the name of a key")
            key = f"{prefix}{name.value}"
            if key in names:
                raise ConfigError(f"{where}: {key} is given twice")
            if key == "resume":
                raise ConfigError(f"{where}: --resume needs to be on the command line")
            if key == "config":
                raise ConfigError(f"{where}: --config needs to be on the command line")
            names.add(key)
            if isinstance(value, yaml.MappingNode):
                check_section(value, f"{key}.")
            elif key in section_names:
                raise ConfigError(f"{where}: {key} is a section; its keys go below it, indented")
            elif key in TYPES:
                check_value(value, key, where)

    def check_value(value: yaml.Node, key: str, where: str) -> None:
        if value.tag == NULL_TAG and not may_be_null(key):
            raise ConfigError(f"{key} = null: needs {in_words(key)}")
        for node in value.value if isinstance(value, yaml.SequenceNode) else [value]:
            if node.tag not in VALUE_TAGS:
                raise ConfigError(f"{where}: {key}: needs {in_words(key)}, without a tag")
        check_numbers(value, key, f"{where}: ")

    check_section(root, "")


def check_numbers(value: yaml.Node | None, key: str, where: str = "") -> None:
    """Refuse numbers in quotes, and numbers that YAML does not read as decimal: 1_0, 010, 1:30.

    Args:
        value: the value of the key, or a list of values.
        key: name of the key; keys whose value is a text are not checked.
        where: the file and line, if the value comes from a file.

    Raises:
        ConfigError: naming the key.
    """
    kind = TYPES.get(key, str)
    if kind is Any or str in (kind, *get_args(kind)):
        return
    for node in value.value if isinstance(value, yaml.SequenceNode) else [value]:
        if where and getattr(node, "style", None) in ("'", '"'):
            raise ConfigError(f"{where}{key}: needs {in_words(key)}, without quotes")
        if isinstance(node, yaml.ScalarNode) and NOT_DECIMAL.match(node.value):
            raise ConfigError(
                f"{where}{key} = {shown(node.value)}: needs {in_words(key)}, in decimal notation"
            )


def compose(text: str, name: str) -> yaml.Node | None:
    """Return the nodes of a YAML text of limited size, depth and repetition.

    Raises:
        ConfigError: if the text is beyond one of the limits; the message has ``name``.
        yaml.YAMLError: if it is not YAML.
    """
    if len(text) > MOST_BYTES:
        raise ConfigError(f"{name}: settings need {MOST_BYTES:,} characters at most")
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > LONGEST_VALUE:
            raise ConfigError(f"{name}: a value needs {LONGEST_VALUE:,} characters at most")
        if depth > DEEPEST:
            raise ConfigError(f"{name}: settings need {DEEPEST} levels at most")
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    counts: dict[int, int] = {}  # nodes below each node; 0 while they are counted

    def count(node: yaml.Node) -> int:
        if id(node) not in counts:
            counts[id(node)] = 0
            below = [] if isinstance(node, yaml.ScalarNode) else node.value
            parts = [
                part for each in below for part in (each if isinstance(each, tuple) else [each])
            ]
            counts[id(node)] = 1 + sum(map(count, parts))
        elif counts[id(node)] == 0:
            raise ConfigError(f"{name}: an anchor contains itself")
        if counts[id(node)] > MOST_NODES:
            raise ConfigError(f"{name}: settings need {MOST_NODES:,} values at most")
        return counts[id(node)]

    if root is not None:
        count(root)
    return root


def build(parser: ArgumentParser, options: Namespace) -> Config:
    """Return the :class:`Config` that parsed options describe, after checking it."""
    for key in TYPES:
        if options[key] in NULLS and not may_be_null(key):
            raise ConfigError(f"{key} = null: needs {in_words(key)}")
        if options[key] == "":
            raise ConfigError(f"{key} = '': needs {in_words(key)}")
    built = parser.instantiate(options)
    config = Config(**{name: built[name] for name in Config.__dataclass_fields__})
    check(config)
    return config


def from_dict(settings: dict[str, Any]) -> Config:
    """Return the settings that a checkpoint contains as a dict.

    Raises:
        ConfigError: if they are not settings of this version.
    """
    parser = make_parser()
    with _explained(parser):
        try:
            return build(parser, parser.parse_object(settings))
        except KeyError as error:  # a section is not a mapping
            raise ConfigError(f"settings: {error.args[0]}") from None


@contextlib.contextmanager
def _explained(parser: ArgumentParser) -> Iterator[None]:
    """Raise the errors of the parser and of the settings' own checks as ConfigError."""
    try:
        yield
    except ConfigError:
        raise
    except ArgumentError as error:
        raise ConfigError(explain(parser, str(error))) from None
    except (ValueError, TypeError, OverflowError) as error:
        raise ConfigError(one_line(str(error))) from None


def keys(parser: ArgumentParser) -> list[str]:
    """Return every key of the settings, with dots between sections."""
    return [
        key for key in parser.get_defaults().keys(branches=False) if key not in ("config", "resume")
    ]


def _types(owner: type, prefix: str = "") -> dict[str, Any]:
    """Return the type of every key below a section."""
    kinds: dict[str, Any] = {}
    for name, kind in get_type_hints(owner).items():
        key = prefix + name
        kinds |= _types(kind, f"{key}.") if is_dataclass(kind) else {key: kind}  # type: ignore[arg-type]  # a dataclass is a type here
    return kinds


TYPES = _types(Config)
"""The type of every key."""
WORDS = TYPE_NAMES | {Any: "the name of a rule"}


def may_be_null(key: str) -> bool:
    """Return whether a key may have no value."""
    return type(None) in get_args(TYPES[key])


def in_words(key: str) -> str:
    """Describe the values that a key takes, such as ``a number or null``."""
    kind = TYPES[key]
    if get_origin(kind) not in (list, tuple):
        return _in_words(kind)
    parts = [part for part in get_args(kind) if part is not Ellipsis]
    number = f"{len(parts)} " if len(parts) > 1 else ""
    example = ", ".join(map(str, Config().flat()[key]))
    return f"a list of {number}{WORDS[parts[0]].removeprefix('a ')}s, such as [{example}]"


def _in_words(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return f"one of {', '.join(get_args(kind))}"
    if get_origin(kind) in (Union, types.UnionType):
        return " or ".join(map(_in_words, get_args(kind)))
    return WORDS[kind]


def explain(parser: ArgumentParser, message: str) -> str:
    """Rewrite a message of the parser so that it says what would be right."""
    message = one_line(message)
    invalid = re.match(r'Parser key "([\w.]+)": ', message)
    if invalid is not None and invalid[1] in TYPES:
        value = re.search(r".*(?:Got|Given) value: (.*)$", message)
        text = shown(value[1])[1:-1] if value else "a value"
        return f"{invalid[1]} = {'null' if text == 'None' else text}: needs {in_words(invalid[1])}"
    in_section = re.search(r"Group '([\w.]+)' does not accept option '([^']*)'", message)
    unknown = re.search(r"[Uu]nrecognized arguments: (.*)", message)
    not_accepted = re.search(r"Option '([^']*)' is not accepted", message)
    if in_section is not None:
        key = f"{in_section[1]}.{in_section[2]}"
    elif not_accepted is not None:
        key = not_accepted[1]
    elif unknown is not None and unknown[1].startswith("--"):
        key = re.split(r"[ =]", unknown[1][2:])[0]
    elif unknown is not None:
        return f"{unknown[1]}: no key takes this; a list is one word, such as --game.bin=[10,10,10]"
    else:
        return message
    section, _, last = key.rpartition(".")
    if last in renamed.AGENT_KEYS:
        return f"unknown key {key}: it is now called {section}.{renamed.AGENT_KEYS[last]}"
    if removed := renamed.removed(key):
        return f"{key} was removed: {removed.now}; leave it out"
    every_key = keys(parser)
    while section and not any(name.startswith(section + ".") for name in every_key):
        section = section.rpartition(".")[0]
    prefix = f"{section}." if section else ""
    valid = {n[len(prefix) :].partition(".")[0] for n in every_key if n.startswith(prefix)}
    guess = renamed.did_you_mean(renamed.nearest(key, [*every_key, "config", "resume"]))
    where = f" in {section}" if section else ""
    return f"unknown key {shown(key)}{guess} Keys{where}: {', '.join(sorted(valid))}"
