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
    for number, names in citations().items():
        tests = sorted({test for name in names for test in tests_of(name)})
        cited, tested = (", ".join(f"`{x}`" for x in several) for several in (names, [*tests, f"{OF_ALL}[{number}]"]))
        lines.append(f"| ({number}) | {cited} | {tested} |")
    return "\n".join([*lines, "", "</details>"])


def tests_of(name: str) -> Iterator[str]:
    """File and name of each test that names what has this name in `core`, whose modules the tests mirror.

    Or that names, or takes as a fixture, what the file makes of it: the same function compiled, or a helper around it.
    Whole modules are tested by nobody in particular.
    """
    module, _, function = name.partition(".")
    file = ROOT / f"tests/core/test_{module}.py"
    body = ast.parse(file.read_text(encoding="utf-8")).body if file.exists() else []
    tests = [item for item in body if isinstance(item, ast.FunctionDef) and item.name.startswith("test_")]
    meant = {function.rpartition(".")[2]}
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
