"""The order of the house: imports run one way, and no module is out of bounds."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "marl_pack"

# A module may import from its own floor and from those before it.
FLOORS = (
    ("bins", "files", "item_files", "items", "render"),
    ("stability",),
    ("packing",),
    ("env_aec", "vec_env", "agents"),
    ("config", "evaluate", "export", "play", "train"),
)


def floor_of(module: str) -> int:
    for floor, names in enumerate(FLOORS):
        if module.split(".")[1] in names:
            return floor
    raise AssertionError(f"{module} stands on no floor: add it to FLOORS")


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
        for other in imported(path):
            assert floor_of(other) <= floor_of(module), f"{module} imports {other}"


def test_the_ground_floor_knows_no_game() -> None:
    for name in FLOORS[0]:
        assert imported(PACKAGE / f"{name}.py") <= {"marl_pack.bins", "marl_pack.item_files"}
