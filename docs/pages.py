"""Write the parts of the documentation that the code determines: ``make pages``."""

from __future__ import annotations

import re
from pathlib import Path

from marl_pack.agents.networks.planes import ALWAYS_OBSERVED, PLANES
from marl_pack.export import OUTPUTS, example

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


def between(page: str, name: str, text: str) -> str:
    """Return a page with other text between the two comments that name a part of it."""
    pattern = rf"(<!-- {name}: [^>]*-->\n).*(<!-- end of {name} -->)"
    return re.sub(pattern, lambda part: f"{part[1]}{text}\n{part[2]}", page, flags=re.DOTALL)


PAGES = {"onnx.md": onnx_page}
"""Each page that the code determines, with the function that makes it from the one before."""


def main() -> None:
    """Write every page."""
    for name, make in PAGES.items():
        path = DOCS / name
        path.write_text(make(path.read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    main()
