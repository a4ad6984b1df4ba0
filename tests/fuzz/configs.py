"""Bad settings of training runs, at random: as options of the command line and as YAML."""

import random
from collections.abc import Iterator

from marl_pack.config import keys, make_parser

Case = tuple[str, list[str] | str]
"""Name, and options of the command line or the text of a YAML file."""

VALUES = (
    "null", "~", "true", "no", "[]", "{}", "''", "abc", ".nan", ".inf", "-.inf", "-1", "0", "1.5",
    "1e300", "1e-320", "99999999999999999999999999", "9" * 5000, "0x10", "1_0", "'1'", "[1]",
    "[null]", "[null, null, null]", "[1, 2]", "[1, 2, 3, 4]", "[[1], [2], [3]]", "[1.5, true, x]",
    "{a: 1}", "2020-01-01", "7,5,9", "7 5 9", "!!binary AAAA", "!!python/object:os.system x",
    "!!set {a}", "&a [*a]", "*a", "&a {b: *a}", "<<", "\x1b[31mred", "q[/z]", "../..", "/",
    "\u202e", "x" * 5000, "[" * 5000, "{a: " * 5000, "- " * 500, '"', "'", "%", "@", "`", "#", "\t",
    "?",
)  # fmt: skip
"""Values that are wrong for most keys or for all."""

LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n"
    for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)
FILES = (
    "", "\n", "- 1", "1", "null", "seed", "seed: [1", "seed:", "ppo:", "ppo: 3", "ppo: null",
    "ppo: []", "? [a]\n: 1", "? {a: 1}\n: 1", "1: 2", "null: 2", "true: 1", "'': 1",
    "seed: 1\nseed: 1", "resume: x", "config: x", "help: x", "print_config: true",
    "game: &a {bin: *a}", "game: &a\n  <<: *a", "<<: {seed: 1}", "a: &a [*a]", LAUGHS,
    "---\nseed: 1\n---\nseed: 2",
    "seed: 1\n...\nseed", "!!python/object/apply:os.system [x]", "%YAML 9.9\n---\nseed: 1",
    "seed: !!int x", "seed: !!float 1", "seed: |\n  1", "seed: \x00", "game:\n\tbin: 1",
    "seed: 1 # " + "x" * 200_000, "a: " + "[" * 100_000, "a: " + "{a: " * 3000,
    "\n".join(f"k{i}: 1" for i in range(3000)), "ppo.gamma: 0.5", "ppo: {gamma: {gamma: 1}}",
    "placement: {network: {planes: {mask: 1}}}", "game: {items: [a, b]}", "\ufeffseed: 1x",
)  # fmt: skip
"""Texts that no settings file should be."""


def as_yaml(key: str, value: str) -> str:
    """Return the YAML text of one key."""
    parts = key.split(".")
    lines = [f"{'  ' * depth}{part}:" for depth, part in enumerate(parts)]
    return "\n".join(lines) + f" {value}\n"


def cases(seed: int) -> Iterator[Case]:
    """Yield bad settings in random order: every key with every value, and broken files.

    Args:
        seed: of the order, and of the typing errors.
    """
    rng = random.Random(seed)
    every = keys(make_parser())
    pairs = [(key, value) for key in every for value in VALUES]
    plain = [*((key, value, True) for key, value in pairs), *((k, v, False) for k, v in pairs)]
    plain += [("", text, True) for text in FILES]
    rng.shuffle(plain)
    for key, value, in_file in plain:
        name = f"{key} {value[:20]!r}"
        if not key:
            yield f"file {value[:20]!r}", value
        elif in_file:
            yield f"file {name}", as_yaml(key, value)
        else:
            yield name, rng.choice(([f"--{key}={value}"], [f"--{key}", value]))
        if rng.random() < 0.1:
            yield from _typing_errors(rng, rng.choice(every))


def _typing_errors(rng: random.Random, key: str) -> Iterator[Case]:
    """Yield a key with one character wrong, and a file with one character wrong."""
    text = as_yaml(key, "1")
    at, character = rng.randrange(len(key)), rng.choice("abc.:-[]{}'\" \t\n#&*!|>%@`\x00\x1b\u00e9")
    wrong = key[:at] + character + key[at + 1 :]
    yield f"typing error {wrong!r}", [f"--{wrong}=1"]
    at = rng.randrange(len(text))
    yield f"file with {character!r} at {at}", text[:at] + character + text[at + 1 :]
