"""Some of the cases of scripts/fuzz.py: five hundred in all."""

import math

import fuzzing
import fuzzing_files
import fuzzing_scans
import pytest
from hypothesis.errors import HypothesisException

CASES = 500
# One program for a map step: each takes longer to compile than all cases to run.
TARGETS = [*fuzzing_files.TARGETS, fuzzing_scans.USERS.target(3.0)]
WEIGHTS = sum(target.weight for target in TARGETS)


@pytest.mark.usefixtures("jax_as_it_was")
@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_no_case_fails(target: fuzzing.Target) -> None:
    cases = math.ceil(CASES * target.weight / WEIGHTS)
    outcome = fuzzing.run(target, cases, seed=0)
    for failure in outcome.failures:
        raise failure
    assert outcome.cases >= cases


def test_what_fails_is_told_with_the_smallest_case() -> None:
    target = fuzzing.Target("too large", lambda: fuzzing_files.st.integers(0, 1000), lambda case: _fail_from(17, case))
    (failure,) = fuzzing.run(target, 100, seed=0).failures
    assert not isinstance(failure, HypothesisException)
    assert "case=17" in "".join(failure.__notes__)


def _fail_from(least: int, case: int) -> None:
    assert case < least, "is too large"


def test_what_hangs_is_a_failure() -> None:
    def hang() -> None:
        while True:
            pass

    with pytest.raises(AssertionError, match=r"took longer than 0\.05 s"), fuzzing.deadline(0.05):
        hang()
