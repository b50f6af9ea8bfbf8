"""Whether the paper's equations hold: the tables in README, made from what `linemap verify` computes.

Usage: python scripts/write_equation_table.py [--write]

With --write the tables go into README, between their markers, provided that every check has passed.
"""

import sys
from collections.abc import Iterable
from pathlib import Path

from readme import write_part

from linemap_jax.lab.verification import Row, as_markdown, as_text, citations, verify

ROOT = Path(__file__).resolve().parents[1]
OF_ALL = "tests/lab/test_verification.py"


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
    lines += ["| equation | cited in | tested in |", "| --- | --- | --- |"]
    for number, names in citations().items():
        tests = sorted({test for name in names if (ROOT / (test := test_of(name))).exists()})
        cited, tested = (", ".join(f"`{x}`" for x in several) for several in (names, [*tests, OF_ALL]))
        lines.append(f"| ({number}) | {cited} | {tested} |")
    return "\n".join([*lines, "", "</details>"])


def test_of(name: str) -> str:
    """The test file of what has this name in `core`, whose parts the tests mirror."""
    return f"tests/core/test_{name.split('.')[0]}.py"


if __name__ == "__main__":
    sys.exit(main())
