"""Imports run one way: from the programs down to the state of bins."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "marl_pack"

# A module may import from its own layer and from those before it.
LAYERS = (
    ("bins", "files", "items", "render"),
    ("stability", "sapien_check"),
    ("agents.afterstates.afterstates", "agents.afterstates.bitboards", "agents.afterstates"),
    ("game",),
    ("env_aec", "vec_env", "agents"),
    ("config", "evaluate", "export", "integrations", "options", "play", "train"),
    ("sapien_check.__main__", "sapien_check.table1", "sapien_check.controls"),
)


def layer_of(module: str) -> int:
    name = module.removeprefix("marl_pack.")
    names = {prefix: layer for layer, prefixes in enumerate(LAYERS) for prefix in prefixes}
    while name not in names:
        assert "." in name, f"{module} is in no layer: add it to LAYERS"
        name = name.rpartition(".")[0]
    return names[name]


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            if node.module == "marl_pack":
                names |= {f"marl_pack.{alias.name}" for alias in node.names}
            else:
                names.add(node.module)
    return {name for name in names if name.startswith("marl_pack.")}


def test_imports_run_one_way() -> None:
    for path in PACKAGE.rglob("*.py"):
        module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
        if path == PACKAGE / "__init__.py":
            assert imported(path) == set()
            continue
        module = module.removesuffix(".__init__")
        for other in imported(path):
            if module == "marl_pack.agents.afterstates.critic":
                continue
            assert layer_of(other) <= layer_of(module), f"{module} imports {other}"
