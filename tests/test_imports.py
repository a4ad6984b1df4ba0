"""Imports run one way: from the programs to the state of bins, without cycles."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "marl_pack"

# A module may import from its own layer and from those before it.
LAYERS = (
    ("backend", "checks", "extras", "files", "inputs", "installation", "option_record", "published",
     "renamed", "settings_text", "terminal"),
    ("geometry",),
    ("bins", "explanation", "items", "plan", "plan_archive", "plan_columns", "render"),
    ("stability", "sapien_check"),
    ("exact",),
    ("game",),
    ("env_aec", "env_cells", "env_mm", "env_selection", "env_turns", "vec_env", "agents"),
    ("packer", "replay"),
    ("service",),
    ("evaluation",),
    # The programs, and what only they use.
    ("cli", "compile", "config", "demo", "evaluate", "export", "feed", "integrations", "options",
     "pack", "physics", "play", "players", "players_mm", "serve", "train", "training", "tune"),
)  # fmt: skip

# What the judge and the environment must not need.
ONLY = {
    "sapien_check": {"bins", "checks", "extras", "files", "geometry", "plan", "sapien_check"},
    "env_aec": {"bins", "env_cells", "env_mm", "env_selection", "env_turns", "game", "geometry",
                "items", "option_record", "render"},
    "env_cells": {"checks", "env_turns", "game", "installation", "plan", "render"},
    "env_selection": {"env_cells", "env_turns", "game", "geometry", "items", "option_record",
                      "render"},
    "env_mm": {"checks", "env_turns", "exact", "geometry", "option_record", "plan", "render"},
    "env_turns": {"checks", "game"},
    "exact": {"checks", "exact", "explanation", "extras", "geometry", "inputs", "installation",
              "items", "option_record", "plan", "renamed", "sapien_check", "settings_text",
              "stability"},
    "game": {"backend", "bins", "checks", "game", "geometry", "installation", "items", "plan",
             "option_record", "renamed", "stability"},
    "render": {"bins", "extras", "files", "geometry", "plan", "render"},
    "replay": {"checks", "files", "geometry", "plan", "plan_archive", "render", "replay",
               "terminal"},
}  # fmt: skip


def modules() -> dict[str, Path]:
    """Every module by its dotted name below marl_pack; a package by the name of its folder.

    ``__main__`` is the program of its package: nobody imports it, and it may import any program.
    """
    paths = {}
    for path in PACKAGE.rglob("*.py"):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        if path.stem != "__main__" and name != "__init__":
            paths[name.removesuffix(".__init__")] = path
    return paths


MODULES = modules()


def imported(path: Path) -> set[str]:
    """The modules of marl_pack that a file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    own = {name.removeprefix("marl_pack.") for name in names if name.startswith("marl_pack.")}
    return {name for name in own if name in MODULES}


def graph() -> dict[str, set[str]]:
    return {name: imported(path) - {name} for name, path in MODULES.items()}


def package_of(module: str) -> str:
    """The package of a module: within ``agents`` its own packages count."""
    parts = module.split(".")
    if parts[0] == "agents" and (PACKAGE / "agents" / "/".join(parts[1:2])).is_dir():
        return ".".join(parts[:2])
    return parts[0] if parts[0] != "agents" else module


def test_imports_run_one_way() -> None:
    layer = {name: k for k, names in enumerate(LAYERS) for name in names}
    for module, others in graph().items():
        assert module.split(".")[0] in layer, f"{module} is in no layer: add it to LAYERS"
        for other in others:
            own, its = layer[module.split(".")[0]], layer[other.split(".")[0]]
            assert its <= own, f"{module} imports {other}"


def test_no_packages_import_each_other() -> None:
    edges: dict[str, set[str]] = {}
    for module, others in graph().items():
        package = package_of(module)
        edges.setdefault(package, set()).update({package_of(other) for other in others} - {package})
    TopologicalSorter(edges).prepare()  # raises CycleError, naming the circle
    own = {m: {o for o in others if not m.startswith(f"{o}.") and not o.startswith(f"{m}.")}
           for m, others in graph().items()}  # fmt: skip
    TopologicalSorter(own).prepare()


def test_the_judge_the_environment_and_the_game_import_only_what_they_need() -> None:
    for module, others in graph().items():
        allowed = ONLY.get(module.split(".")[0])
        for other in others if allowed else ():
            assert other.split(".")[0] in allowed, f"{module} imports {other}"


def test_the_package_itself_imports_no_module() -> None:
    assert not imported(PACKAGE / "__init__.py")
