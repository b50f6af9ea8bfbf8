"""Whether the paper's equations hold: the tables in README, made from what `linemap verify` computes.

Usage: python scripts/write_equation_table.py [--write]

With --write the tables go into README, between their markers, provided that every check has passed.
"""

import ast
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from readme import write_part

from linemap_jax.lab.verification import Row, as_markdown, as_text, citations, verify
from linemap_jax.lab.verification.tables import label

ROOT = Path(__file__).resolve().parents[1]
OF_ALL = "test_verification::test_equation"
NAMES = {ast.Name: "id", ast.Attribute: "attr", ast.arg: "arg"}


def main() -> int:
    """Print the table, and write it where that is asked for."""
    rows = verify()
    print(as_text(rows))
    if not all(row.passed for row in rows):
        print("README stays as it is: not all checks have passed", file=sys.stderr)
        return 1
    if "--write" in sys.argv[1:]:
        write_part("equations", part_of_readme(rows))
    return 0


def part_of_readme(rows: Iterable[Row]) -> str:
    """What stands between the markers: the equations, and below them who cites them and where that is tested."""
    lines = [as_markdown(rows), "", "<details><summary>Equation, functions that cite it, tests of these</summary>", ""]
    lines += ["| equation | cited in | tested by |", "| --- | --- | --- |"]
    found = {str(number): names for number, names in citations().items()}
    for row in rows:
        names = found.get(row.equation, row.places)
        tests = sorted({test for name in names for test in tests_of(name)})
        several = names, [*tests, f"{OF_ALL}[{row.equation}]"]
        cells = label(row), *(", ".join(f"`{x}`" for x in of_cell) for of_cell in several)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", "</details>"])


def tests_of(name: str) -> Iterator[str]:
    """File and name of each test that names what has this name in `core`, whose modules and packages the tests mirror.

    Or that names, or takes as a fixture, what the file makes of it: the same function compiled, or a helper around it.
    Whole modules are tested by nobody in particular.
    """
    *within, function = name.split(".")
    files = [ROOT / f"tests/core/test_{module}.py" for module in within]
    for file in files:
        if file.exists():
            yield from _tests_in(file, function)


def _tests_in(file: Path, function: str) -> Iterator[str]:
    body = ast.parse(file.read_text(encoding="utf-8")).body
    tests = [item for item in body if isinstance(item, ast.FunctionDef) and item.name.startswith("test_")]
    meant = {function}
    for item in body:
        if isinstance(item, ast.Assign) and meant & names_in(item.value):
            meant |= names_in(*item.targets)
        elif isinstance(item, ast.FunctionDef) and item not in tests and meant & names_in(item):
            meant.add(item.name)
    yield from (f"{file.stem}::{test.name}" for test in tests if meant & names_in(test))


def names_in(*nodes: ast.AST) -> set[str]:
    """All names, attributes and parameters in pieces of a program."""
    parts = (part for node in nodes for part in ast.walk(node))
    return {getattr(part, NAMES[type(part)]) for part in parts if type(part) in NAMES}


if __name__ == "__main__":
    sys.exit(main())
