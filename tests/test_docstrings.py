"""What `help` says is complete: arguments and results of functions, fields of classes, modules of packages."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import linemap_jax
from linemap_jax.core.fields import meanings_of
from linemap_jax.lab import verification

PACKAGE = Path(linemap_jax.__file__).parent
FILES = [PACKAGE / "build.py", PACKAGE / "slam.py", *PACKAGE.glob("core/**/*.py"), *PACKAGE.glob("lab/**/*.py")]
PARTS = r"\n(Args|Returns|Yields|Raises|Attributes):\n"


def is_public(name: str, file: Path) -> bool:
    """By its name; of the verification, whose modules are its own affair, what the package names."""
    return not name.startswith("_") and (file.parent.name != "verification" or name in verification.__all__)


def public(kind: type) -> Iterator[tuple[str, ast.AST]]:
    """Name and definition of all public functions or classes, methods included."""
    for file in sorted(FILES):
        for item in ast.parse(file.read_text(encoding="utf-8")).body:
            if not is_public(getattr(item, "name", "_"), file):
                continue
            where = f"{file.relative_to(PACKAGE)}: {item.name}"
            if isinstance(item, kind):
                yield where, item
            if isinstance(item, ast.ClassDef) and kind is ast.FunctionDef:
                methods = (method for method in item.body if isinstance(method, kind) and method.name[0] != "_")
                yield from ((f"{where}.{method.name}", method) for method in methods)


def lacking(function: ast.FunctionDef) -> set[str]:
    """What its docstring does not say.

    A short function says all in a sentence: what it gives, out of which `argument`. Others have sections.
    """
    takes = function.args
    every = [*takes.posonlyargs, *takes.args, *takes.kwonlyargs, takes.vararg, takes.kwarg]
    is_class_method = "classmethod" in map(ast.unparse, function.decorator_list)
    names = {one.arg for one in every if one is not None} - {"cls" if is_class_method else "self"}
    text, *parts = re.split(PARTS, ast.get_docstring(function) or "")
    sections = dict(zip(parts[::2], parts[1::2], strict=True))
    told = set(re.findall(r"^  \**(\w+): \S", sections.get("Args", ""), re.MULTILINE))
    if not sections.keys() & {"Args", "Returns", "Yields"}:
        told, sections = (
            {name for name in names if re.search(rf"`[^`]*\b{name}\b[^`]*`", text)},
            {"Returns": text, **sections},
        )
    lacks = {*(names - told), *(f"{name}, which is no argument" for name in told - names)}
    is_none = isinstance(function.returns, ast.Constant) and function.returns.value is None
    if names and not is_none and not sections.keys() & {"Returns", "Yields"}:
        lacks.add("Returns")
    if any(isinstance(node, ast.Raise) and node.exc for node in ast.walk(function)) and "Raises" not in sections:
        lacks.add("Raises")
    return lacks


def test_every_public_function_tells_its_arguments_what_it_returns_and_what_it_raises() -> None:
    functions = dict(public(ast.FunctionDef))
    assert len(functions) > 250
    assert {name: lacks for name, function in functions.items() if (lacks := lacking(function))} == {}


@pytest.mark.parametrize(
    ("docstring", "lacks"),
    [
        ("", {"a", "b", "Raises"}),
        ("The sum of `a` and `b`.", {"Raises"}),
        ("The sum of `a` and b.", {"b", "Raises"}),
        ("The sum.\n\nArgs:\n  a: m.\n  b: m.\n\nRaises:\n  ValueError: never.\n", {"Returns"}),
        ("The sum.\n\nArgs:\n  a: m.\n  c: m.\n\nReturns:\n  m.\n", {"b", "c, which is no argument", "Raises"}),
    ],
)
def test_what_is_lacking_is_found(docstring: str, lacks: set[str]) -> None:
    (function,) = ast.parse(f"def f(a: int, *, b: int) -> int:\n    {docstring!r}\n    raise ValueError\n").body
    assert isinstance(function, ast.FunctionDef)
    assert lacking(function) == lacks


def test_every_field_of_a_public_class_says_what_it_means() -> None:
    silent = []
    for where, item in public(ast.ClassDef):
        for field, below in zip(item.body, [*item.body[1:], None], strict=True):
            is_told = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
            if isinstance(field, ast.AnnAssign) and not is_told:
                silent.append(f"{where}.{ast.unparse(field.target)}")
    assert silent == []


def test_help_shows_meaning_shape_and_unit_of_each_field() -> None:
    for cls in (linemap_jax.Scan, linemap_jax.Pose, linemap_jax.Lines, linemap_jax.Thresholds, linemap_jax.Rules):
        assert cls.__doc__ is not None
        text, fields = cls.__doc__.split("\nAttributes:\n")
        assert text.strip()
        assert re.findall(r"^  (\w+) \(", fields, re.MULTILINE) == list(meanings_of(cls))
    told = " ".join((linemap_jax.Pose.__doc__ or "").split())
    assert "cov (Float[Array, '3 3']): Covariance of (x, y, theta) in the axes of the world" in told
    assert "m^2, m rad, rad^2. Symmetric and positive semidefinite" in told
    # Not of the class that it is made of
    assert "unit_normal" not in (linemap_jax.Lines.__doc__ or "")


def test_fields_of_a_class_without_its_source_are_left_out() -> None:
    space: dict[str, type] = {}
    exec("from linemap_jax.core.state import pytree\n@pytree\nclass A:\n    'A.'\n    x: int", space)
    assert space["A"].__doc__ == "A."


@pytest.mark.parametrize("package", ["core", "core/segmentation", "core/estimation", "lab", "lab/verification", "io"])
def test_each_floor_names_its_modules(package: str) -> None:
    folder = PACKAGE / package
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))) or ""
    modules = {path.stem for path in folder.glob("*.py")} | {path.parent.name for path in folder.glob("*/__init__.py")}
    assert {name for name in modules - {"__init__"} if not re.search(rf"\b{name}\b", text)} == set()
