"""The rows of the table, and the checks that they consist of."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from linemap_jax.core.fields import documented

Verdict = Literal["exact", "erratum", "assumption"]

EXACT = 1e-10
"""Largest difference of what is equal but for rounding."""
CENTRAL = 1e-6
"""Largest difference from central differences."""


@documented
@dataclasses.dataclass(frozen=True)
class Check:
    """One number that was computed, and what it is held against."""

    what: str
    """What was computed."""
    value: float
    """The number."""
    limit: float = EXACT
    """The most that it may be."""
    differs: bool = False
    """The formula as printed, or where its assumption fails: the value must be more than the limit."""

    @property
    def passed(self) -> bool:
        """A value that is not a number passes nowhere."""
        return bool(self.value > self.limit if self.differs else self.value <= self.limit)


@documented
@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """What there is to say of one equation. Its first check is the one to show."""

    equation: str
    """Its number, or the section that is meant."""
    title: str
    """What it is."""
    where: tuple[Callable[..., Any], ...]
    """The functions of `core` that compute it."""
    verdict: Verdict
    """Whether it holds as printed, and always."""
    sentence: str
    """Why."""
    checks: tuple[Check, ...]
    """What was computed to show it."""

    @property
    def passed(self) -> bool:
        """Whether all checks did; of what is not exact, one at least must show it."""
        shown = self.verdict == "exact" or any(check.differs for check in self.checks)
        return shown and all(check.passed for check in self.checks)

    @property
    def difference(self) -> Check:
        """The check to show."""
        return self.checks[0]

    @property
    def as_printed(self) -> Check | None:
        """The check that shows the erratum or the assumption at its worst."""
        return max((check for check in self.checks if check.differs), key=lambda check: check.value, default=None)

    @property
    def places(self) -> tuple[str, ...]:
        """Where the equation lives: module and function in `core`."""
        return tuple(place(function) for function in self.where)


def place(function: Callable[..., Any]) -> str:
    """The name of a function of `core`, with its module."""
    return f"{function.__module__.removeprefix('linemap_jax.core.')}.{function.__qualname__}"


def turn(a: Any, b: Any) -> np.ndarray:
    """The difference of the angles `a` and `b`, in [-pi, pi)."""
    return (np.asarray(a) - np.asarray(b) + np.pi) % (2 * np.pi) - np.pi


def most(x: Any) -> float:
    """The largest absolute value in `x`."""
    return float(np.max(np.abs(np.asarray(x))))
