"""Data flows one way: what each floor may import, and that no modules import each other in a circle."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import linemap_jax

PACKAGE = Path(linemap_jax.__file__).parent
MAY_IMPORT = {
    "core": {"core"},
    "lab": {"core", "lab"},
    "io": {"core", "io"},
    "build": {"core"},
    "slam": {"core", "build"},
    "cli": {"core", "lab", "io", "build", "slam", "cli"},
}


def imports_of(file: Path) -> set[str]:
    """The modules of the package that a file imports, within functions too."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return {name for name in names if name in MODULES}


def name_of(file: Path) -> str:
    return ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


MODULES = {name_of(file): file for file in PACKAGE.rglob("*.py")}


def test_each_floor_imports_from_those_below_it() -> None:
    upwards = []
    for module, file in MODULES.items():
        floor = module.split(".")[1:2]
        for imported in imports_of(file) - {"linemap_jax"} if floor else ():
            if imported.split(".")[1] not in MAY_IMPORT[floor[0]]:
                upwards.append((module, imported))
    assert upwards == []


def test_no_modules_import_each_other_in_a_circle() -> None:
    # A package itself imports nothing but what it offers.
    graph = {module: imports_of(file) - {module} for module, file in MODULES.items() if file.name != "__init__.py"}
    order = list(TopologicalSorter(graph).static_order())
    assert len(order) >= len(graph) > 80
