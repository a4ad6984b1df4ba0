"""Write the parts of the documentation that the code determines: ``make pages``."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields
from pathlib import Path
from typing import Any

from docstring_parser import parse

from marl_pack import env_aec, env_selection
from marl_pack.agents.networks.planes import ALWAYS_OBSERVED, PLANES
from marl_pack.exact.features import FEATURES
from marl_pack.exact.spec import ExactSpec
from marl_pack.export import OUTPUTS, example
from marl_pack.game.spec import SelectionSpec

DOCS = Path(__file__).parent


def table(*rows: tuple[str, ...]) -> str:
    """Return a Markdown table; the first row is its head."""
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def onnx_inputs() -> str:
    """Return the table of the inputs of exported agents."""
    observation = example("orientation", list(PLANES))
    owners = [("every agent", ALWAYS_OBSERVED)]
    owners += [(f"`{name}`", plane.tensors) for name, plane in PLANES.items()]
    rows = [("input", "shape", "type", "plane", "unit", "meaning")]
    for owner, meanings in owners:
        for name, meaning in meanings.items():
            tensor = observation[name]
            last = "K" if name == "mask" else str(tensor.shape[-1])
            shape = {2: f"B × {last}", 3: "B × W × D", 4: "B × A × W × D"}[tensor.dim()]
            kind = str(tensor.dtype).removeprefix("torch.")
            rows.append((f"`{name}`", shape, kind, owner, meaning.unit, meaning.text))
    return table(*rows)


def onnx_outputs() -> str:
    """Return the table of the outputs of exported agents."""
    shapes = {"action": ("B", "int64"), "probabilities": ("B × K", "float32")}
    rows = [(f"`{name}`", *shapes[name], m.unit, m.text) for name, m in OUTPUTS.items()]
    return table(("output", "shape", "type", "unit", "meaning"), *rows)


def onnx_page(page: str) -> str:
    """Return docs/onnx.md with its tables of inputs and outputs."""
    return between(between(page, "inputs", onnx_inputs()), "outputs", onnx_outputs())


def arguments_of(function: Any) -> dict[str, str]:
    """Return what a docstring says of each argument, in Markdown."""
    sentences = {p.arg_name: p.description or "" for p in parse(function.__doc__ or "").params}
    return {name: markdown(sentence) for name, sentence in sentences.items()}


def markdown(text: str) -> str:
    """Return a text of a docstring, in reStructuredText, as one line of Markdown."""
    text = re.sub(r":\w+:`(?:\w+\.)*(\w+)`", r"`\1`", text).replace("``", "`")
    return " ".join(text.split())


def environment_arguments() -> str:
    """Return the tables of the environment's arguments and of the options of its game."""
    defaults = {
        name: parameter.default
        for function in (env_aec.env, env_aec.raw_env)
        for name, parameter in inspect.signature(function).parameters.items()
    }
    options = {option.name: option.metadata["sentence"] for option in fields(SelectionSpec)}
    own = arguments_of(env_aec.raw_env) | arguments_of(env_aec.env)
    rows = [("argument", "default", "")]
    for name, sentence in own.items():
        if name in defaults and name not in options:
            rows.append((f"`{name}`", f"`{defaults[name]!r}`", sentence))
    options_rows = [("option", "default", "")]
    for option in fields(SelectionSpec):
        if option.name in defaults:
            sentence = options[option.name].replace("null", "None")
            options_rows.append((f"`{option.name}`", f"`{option.default!r}`", sentence))
    return f"{table(*rows)}\n\n{table(*options_rows)}"


def text_of(module: Any) -> str:
    """Return the docstring of a module as a part of a page, with links to the other pages."""
    return re.sub(r"`docs/(\w+)\.md`", r"[\1](\1.md)", inspect.getdoc(module) or "")


def selection_page(_: str) -> str:
    """Return docs/environment_selection.md: the docstring of the environment with selection."""
    text = text_of(env_selection)
    text = re.sub(r":mod:`marl_pack.env_aec`", "the [environment](environment.md)", text)
    return f"""# The environment with a buffer, a preview or several bins

<!-- Written by `make pages` from the docstring of marl_pack/env_selection.py: change it there. -->

{text}
"""


def environment_page(_: str) -> str:
    """Return docs/environment.md: the docstring of the environment, and its arguments."""
    text = text_of(env_aec)
    before, after = text.split("\n## Seeds and episodes\n")
    return f"""# The environment

<!-- Written by `make pages` from the docstring of marl_pack/env_aec.py and the options of
marl_pack/game/spec.py: change it there. -->

{before}
{environment_arguments()}

## Seeds and episodes
{after}
"""


def between(page: str, name: str, text: str) -> str:
    """Return a page with other text between the two comments that name a part of it."""
    pattern = rf"(<!-- {name}: [^>]*-->\n).*(<!-- end of {name} -->)"
    return re.sub(pattern, lambda part: f"{part[1]}{text}\n{part[2]}", page, flags=re.DOTALL)


def millimetres_page(page: str) -> str:
    """Return docs/millimetres.md with its tables of options and features."""
    rows = [("option", "default", "")]
    for option in fields(ExactSpec):
        sentence = option.metadata["sentence"].replace("null", "None")
        rows.append((f"`{option.name}`", f"`{option.default!r}`", sentence))
    features = [("feature", "what it is"), *((f"`{k}`", text) for k, text in FEATURES.items())]
    return between(between(page, "options", table(*rows)), "features", table(*features))


PAGES = {
    "environment.md": environment_page,
    "environment_selection.md": selection_page,
    "onnx.md": onnx_page,
    "millimetres.md": millimetres_page,
}
"""Each page that the code determines, with the function that makes it from the one before."""


def main() -> None:
    """Write every generated page of the documentation."""
    for name, make in PAGES.items():
        path = DOCS / name
        path.write_text(make(path.read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    main()
