"""The rows of `verify` as tables, and which parts of `core` cite which equation."""

import importlib
import inspect
import math
import pkgutil
import re
import textwrap
from collections.abc import Iterable, Iterator
from typing import Any

import linemap_jax.core
from linemap_jax.lab.verification.rows import Check, Row

CORE = linemap_jax.core.__name__


def as_text(rows: Iterable[Row], *, width: int = 100) -> str:
    """The table for a terminal: the numbers of each equation, and below them where it lives and the sentence.

    Args:
      rows: of `verify`.
      width: of the terminal, in characters.

    Returns:
      The table, over several lines.
    """
    lines = [f"{'equation':10}{'verdict':12}{'difference':>12}{'as printed':>12}  what it is"]
    for row in rows:
        printed = "" if row.as_printed is None else f"{row.as_printed.value:.2g}"
        verdict = row.verdict if row.passed else "FAILED"
        lines.append(f"{label(row):10}{verdict:12}{row.difference.value:12.1e}{printed:>12}  {row.title}")
        below = f"{', '.join(row.places)}: {row.sentence}"
        lines += textwrap.wrap(below, width, initial_indent=" " * 10, subsequent_indent=" " * 10)
        lines += [f"{'':10}failed: {in_words(check)}" for check in row.checks if not check.passed]
    return "\n".join(lines)


def as_markdown(rows: Iterable[Row]) -> str:
    """The table for a page. Its numbers are bounds, so that it is the same on every machine.

    Args:
      rows: of `verify`.

    Returns:
      The table in Markdown.
    """
    lines = [
        "| equation | what it is | where it lives | difference | as printed | verdict | in a sentence |",
        "| --- | --- | --- | ---: | ---: | --- | --- |",
    ]
    for row in rows:
        limit = row.difference.limit
        cells = [
            label(row),
            row.title,
            ", ".join(f"`{name}`" for name in row.places),
            f"< {limit:g}" if limit > 0 else "0",
            "" if row.as_printed is None else f"> {10.0 ** math.floor(math.log10(row.as_printed.value)):g}",
            row.verdict,
            row.sentence,
        ]
        lines.append(f"| {' | '.join(cells)} |".replace("|  |", "| |"))
    return "\n".join(lines)


def as_dict(row: Row) -> dict[str, Any]:
    """One row for machines, with all its checks.

    Args:
      row: of `verify`.

    Returns:
      Numbers and words for JSON.
    """
    printed = row.as_printed
    return {
        "equation": row.equation,
        "title": row.title,
        "where": list(row.places),
        "difference": row.difference.value,
        "as_printed": None if printed is None else printed.value,
        "verdict": row.verdict,
        "sentence": row.sentence,
        "passed": row.passed,
        "checks": [
            {
                "what": check.what,
                "value": check.value,
                "must_be": "more" if check.differs else "at most",
                "limit": check.limit,
                "passed": check.passed,
            }
            for check in row.checks
        ],
    }


def label(row: Row) -> str:
    """The number of an equation in parentheses; other places as they are."""
    return f"({row.equation})" if row.equation.isdigit() else row.equation


def in_words(check: Check) -> str:
    """What was found, and what should have been."""
    return f"{check.what} is {check.value:.3g}, must be {'more than' if check.differs else 'at most'} {check.limit:g}"


def citations() -> dict[int, tuple[str, ...]]:
    """For each equation the functions, classes and modules of `core` whose docstring cites it as `Eq. (n)`."""
    found: dict[int, list[str]] = {}
    for name, docstring in _docstrings():
        for number in cited(docstring):
            found.setdefault(number, []).append(name)
    return {number: tuple(sorted(found[number])) for number in sorted(found)}


def cited(text: str) -> set[int]:
    """The numbers of the equations that a text cites: `Eq. (12)`, `Eqs. (5)-(8)`, `Eqs. (9), (10)`."""
    numbers = set()
    for several in re.findall(r"Eqs?\.\s+((?:\(\d+\)(?:-|,\s+|\s+and\s+)?)+)", text):
        for first, last in re.findall(r"\((\d+)\)(?:-\((\d+)\))?", several):
            numbers.update(range(int(first), int(last or first) + 1))
    return numbers


def _docstrings() -> Iterator[tuple[str, str]]:
    """Names within `core`, and their docstrings."""
    for info in pkgutil.walk_packages(linemap_jax.core.__path__, f"{CORE}."):
        module = importlib.import_module(info.name)
        name = info.name.removeprefix(f"{CORE}.")
        yield name, module.__doc__ or ""
        for item in vars(module).values():
            if getattr(item, "__module__", None) != info.name or not hasattr(item, "__qualname__"):
                continue
            yield f"{name}.{item.__qualname__}", item.__doc__ or ""
            if inspect.isclass(item):
                methods = (method for method in vars(item).values() if inspect.isfunction(method))
                yield from ((f"{name}.{method.__qualname__}", method.__doc__ or "") for method in methods)
