"""Fuzzing: cases drawn by hypothesis, run against what must hold of each of them.

`fuzzing_files` has the cases of all that reads a file, `fuzzing_scans` those of all that computes with a scan;
tests/test_fuzz.py runs some of them, scripts/fuzz.py very many.
"""

import dataclasses
import signal
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import hypothesis
from hypothesis import HealthCheck, Phase
from hypothesis.strategies import SearchStrategy

LONGEST = 20.0
"""s that a case may take; compilation is not counted, see `Target.prepare`."""


@dataclasses.dataclass(frozen=True)
class Target:
    """Something to run cases against.

    Attributes:
      name: of the target.
      cases: a strategy that draws them.
      check: raises what is wrong with a case.
      weight: how many of all cases are its own.
      prepare: does beforehand what is slow the first time.
    """

    name: str
    cases: Callable[[], SearchStrategy[Any]]
    check: Callable[[Any], None]
    weight: float = 1.0
    prepare: Callable[[], Any] = lambda: None


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What came of the cases of a target."""

    cases: int  # that were run until nothing more failed, or the failure could not be made smaller
    failures: list[BaseException]  # one for each kind of failure; the smallest case stands in its notes
    seconds: float


class _Hang(BaseException):
    """No `except Exception` may take it for an error of a file."""


def run(target: Target, cases: int, *, seed: int) -> Outcome:
    """Draw cases, and run them until one fails; then look for the smallest that does."""
    target.prepare()
    done = 0

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=cases,
        database=None,
        deadline=None,  # would be looked at after the fact, which a case that hangs does not reach
        phases=(Phase.generate, Phase.shrink),
        print_blob=False,
        suppress_health_check=list(HealthCheck),
    )
    @hypothesis.given(target.cases())
    def run_all(case: Any) -> None:
        nonlocal done
        done += 1
        with deadline(LONGEST), warnings.catch_warnings():
            warnings.simplefilter("error")  # nobody who runs a command wants to read them
            target.check(case)

    started = time.perf_counter()
    failures: list[BaseException] = []
    try:
        run_all()
    except BaseExceptionGroup as group:
        failures = list(group.exceptions)
    except Exception as failure:
        failures = [failure]
    return Outcome(done, failures, time.perf_counter() - started)


@contextmanager
def deadline(seconds: float) -> Iterator[None]:
    """Fail what takes longer, wherever in Python it hangs. To be used in the main thread."""

    def ring(*_: Any) -> None:
        raise _Hang

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    except _Hang:
        raise AssertionError(f"took longer than {seconds:g} s") from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
