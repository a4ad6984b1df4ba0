"""The order of the house: imports run one way, and no module is out of bounds."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "marl_pack"

# The judge takes boxes and gives verdicts; what plays games to have boxes is a program of its own.
PROGRAMS = ("sapien_check.__main__", "sapien_check.table1", "sapien_check.controls")

# A module may import from its own floor and from those before it.
FLOORS = (
    ("bins", "files", "items", "render", "sapien_check"),
    ("stability",),
    ("packing",),
    ("env_aec", "vec_env", "agents"),
    ("config", "evaluate", "export", "integrations", "options", "play", "train"),
)


def floor_of(module: str) -> int:
    if module.removeprefix("marl_pack.") in PROGRAMS:
        return len(FLOORS) - 1
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
    for name in ("bins", "files", "render"):
        assert imported(PACKAGE / f"{name}.py") <= {"marl_pack.bins"}
    for path in (PACKAGE / "items").glob("*.py"):
        assert all(o.startswith(("marl_pack.bins", "marl_pack.items")) for o in imported(path))
    own = {f"marl_pack.sapien_check.{name}" for name in ("stack", "judge", "packings")}
    for name in own:
        path = PACKAGE.parent / f"{name.replace('.', '/')}.py"
        assert imported(path) <= own | {"marl_pack.sapien_check.judge"}
