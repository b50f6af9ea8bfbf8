"""The criteria of s4.3.1 on scans made by hand: each breaks where it should, and is counted."""

import dataclasses
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax import Capacity, Extraction, Rules, SensorNoise, Thresholds, extract, preset
from linemap_jax.core.extract import as_dtype, with_defaults
from linemap_jax.core.segmentation import incremental
from linemap_jax.core.sensor import points_from_scan
from linemap_jax.core.state import Pose, Scan

CAPACITY = Capacity(8, 8)
HERE = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))
N = 41
SPACING = np.radians(1.0)
BEARINGS = (np.arange(N) - 20) * SPACING
WALL = 2 / np.cos(BEARINGS)
"""A wall ahead at 2 m; its points are 3.5 cm apart, 4 cm at the ends."""
EXACT = Thresholds(line_distance=1e-3, line_sigmas=0.0, min_length=0.1)
"""Criterion 2 without noise: the first point off the line breaks."""


def extracted(
    ranges: np.ndarray, thresholds: Thresholds | None = None, noise: SensorNoise | None = None, **rules: bool
) -> Extraction:
    scan = Scan.from_ranges(ranges, BEARINGS)
    return extract(scan, HERE, thresholds=thresholds, noise=noise, capacity=CAPACITY, rules=Rules(**rules))


def counts(found: Extraction) -> dict[str, int]:
    """The criteria that turned something away, and how many."""
    named = {field.name: int(getattr(found.rejected, field.name)) for field in dataclasses.fields(found.rejected)}
    return {name: count for name, count in named.items() if count}


def beams(found: Extraction, line: int) -> list[int]:
    return np.flatnonzero(np.asarray(found.line_of_beam) == line).tolist()


def corner(at: int) -> np.ndarray:
    """A wall that turns towards the robot, by a right angle, at the beam `at`, whose point both walls hold."""
    ahead, aside = WALL, 2 * np.tan(BEARINGS[at]) / np.sin(np.where(BEARINGS > 0, BEARINGS, 1))
    return np.where(np.arange(N) <= at, ahead, aside)


def test_one_wall_is_one_line() -> None:
    found = extracted(WALL)
    assert beams(found, 0) == list(range(N))
    assert counts(found) == {}


def test_an_end_is_unsure_by_where_the_next_beam_would_have_met_the_wall() -> None:
    """The wall may end anywhere between: the variance is that of a uniform distribution."""
    found = extracted(WALL, noise=SensorNoise(range_sigma=1e-6, bearing_sigma=1e-6))
    beyond = 2 * (np.tan(BEARINGS[-1] + SPACING) - np.tan(BEARINGS[-1]))
    np.testing.assert_allclose(found.lines.var_extent[0], beyond**2 / 12, rtol=0.03)


def test_criterion_1_breaks_at_a_step() -> None:
    ranges = np.where(np.arange(N) < 20, WALL, 1.5 * WALL)
    found = extracted(ranges)
    assert (beams(found, 0), beams(found, 1)) == (list(range(20)), list(range(20, N)))
    assert counts(found) == {"gap": 1}


@pytest.mark.parametrize(("gap", "broken"), [(0.034, True), (0.036, False)])
def test_criterion_1_is_a_distance(gap: float, broken: bool) -> None:
    # Successive points are 2 (tan(a + 1 deg) - tan(a)) apart: 3.49 cm ahead of the robot.
    ranges = np.where(np.abs(np.arange(N) - 20) < 4, WALL, np.nan)
    found = extracted(ranges, Thresholds(gap_distance=gap, gap_spacings=0.0, gap_sigmas=0.0))
    assert counts(found).get("gap", 0) == (6 if broken else 0)


def test_criterion_1_widens_with_the_arc() -> None:
    # A wall that recedes: the points lie apart, since the beams graze it.
    ranges = 0.4 / np.sin(np.radians(7) + (BEARINGS - BEARINGS[0]))[::-1]
    steps = np.linalg.norm(np.diff(ranges * np.stack([np.cos(BEARINGS), np.sin(BEARINGS)]), axis=1), axis=0)
    arcs = np.minimum(ranges[1:], ranges[:-1]) * SPACING
    for spacings in (0.0, 4.0, 6.0):
        found = extracted(ranges, Thresholds(gap_spacings=spacings))
        expected = int(np.sum(steps >= np.maximum(0.15, spacings * arcs)))
        assert counts(found).get("gap", 0) == expected
    assert np.sum(steps >= 0.15) > np.sum(steps >= np.maximum(0.15, 6 * arcs))


def test_criterion_1_widens_with_the_noise() -> None:
    ranges = np.where(np.arange(N) < 20, WALL, WALL + 0.2)
    for sigma, broken in ((0.02, True), (0.03, False)):  # 5 sqrt(2) sigma: 14 cm, 21 cm
        found = extracted(ranges, Thresholds(gap_spacings=0.0, line_distance=1.0), noise=SensorNoise(range_sigma=sigma))
        assert counts(found).get("gap", 0) == broken


def receding(shift: np.ndarray) -> np.ndarray:
    """A wall that the last beams graze, with some points moved along their beams."""
    return 0.4 / np.sin(np.radians(11) + BEARINGS[-1] - BEARINGS) + shift


def test_points_that_noise_may_have_parted_take_no_part_in_the_fit() -> None:
    last = np.arange(N) == N - 1
    for rule in (True, False):
        rules = {"leave_out_sparse": rule, "leave_out_ends": False}
        clean, moved = (extracted(receding(0.02 * last * on), **rules) for on in (0, 1))
        assert beams(clean, 0) == beams(moved, 0) == list(range(N))  # of the run they are
        assert (clean.lines.angle[0] == moved.lines.angle[0]) == rule


def test_a_run_of_such_points_is_no_line() -> None:
    ranges = np.where(np.arange(N) < N - 5, np.nan, receding(np.zeros(N)))
    assert beams(extracted(ranges, leave_out_sparse=False), 0) == list(range(N - 5, N))
    found = extracted(ranges)
    assert not found.lines.valid.any()
    assert np.all(found.line_of_beam == -1)
    assert not found.circles.valid.any()
    assert counts(found) == {"invalid": N - 5, "too_few": 5}


def test_criterion_2_breaks_at_a_corner_and_gives_the_corner_back() -> None:
    found = extracted(corner(30), EXACT, leave_out_sparse=False)
    assert (beams(found, 0), beams(found, 1)) == (list(range(30)), list(range(30, N)))
    assert counts(found) == {"distance": 1}
    np.testing.assert_allclose(found.lines.begin[1], found.lines.end[0], atol=0.05)
    np.testing.assert_allclose(found.lines.begin[1], [2, 2 * np.tan(BEARINGS[30])], atol=1e-9)


def test_criterion_2_without_giving_back() -> None:
    found = extracted(corner(30), EXACT, give_back_point=False, leave_out_sparse=False)
    assert (beams(found, 0), beams(found, 1)) == (list(range(31)), list(range(31, N)))
    assert counts(found) == {"distance": 1}


def test_a_point_given_back_keeps_bad_points_out_of_the_fit() -> None:
    wide = Thresholds(line_distance=0.25, line_sigmas=0.0)
    rules = {"leave_out_corners": False, "leave_out_ends": False}
    fits = [extracted(corner(30), wide, give_back_point=rule, **rules) for rule in (True, False)]
    errors = [np.abs(np.asarray(found.lines.angle[0])) for found in fits]
    lengths = [len(beams(found, 0)) for found in fits]
    assert lengths[0] == lengths[1] - 1
    assert errors[0] < errors[1]
    # Without its corner the fit of the longer run is as good; the run holds the points as before.
    trimmed = extracted(corner(30), wide, give_back_point=False)
    assert np.abs(trimmed.lines.angle[0]) < 1e-9 < errors[1]
    assert len(beams(trimmed, 0)) == lengths[1]


@pytest.mark.parametrize("sigmas", [0.0, 5.0])
def test_criterion_2_widens_with_the_noise(sigmas: float) -> None:
    # One point 6 cm off: outside the fixed gate of 3 cm, inside 5 sigma of 2 cm.
    ranges = WALL.copy()
    ranges[20] += 0.06
    found = extracted(ranges, Thresholds(line_sigmas=sigmas))
    assert (counts(found).get("distance", 0) > 0) == (sigmas == 0)


@pytest.mark.parametrize("n", [3, 12])
def test_criterion_2_widens_by_what_the_line_of_few_points_is_uncertain_by(n: int) -> None:
    """5 sigma sqrt(1 + 1/n + leverage): of three points the line is not known well even where the next one lies."""
    y = 2 * np.tan(BEARINGS[20 - n : 20])
    gate = 5 * 0.02 * np.sqrt(1 + 1 / n + y.mean() ** 2 / np.sum((y - y.mean()) ** 2))
    for share, broken in ((0.98, 0), (1.02, 1)):
        ranges = np.where((np.arange(N) >= 20 - n) & (np.arange(N) < 20), WALL, np.nan)
        ranges[20] = 2 + share * gate
        found = extracted(ranges, Thresholds(gap_distance=0.5))
        assert counts(found).get("distance", 0) == broken


@pytest.mark.parametrize(("missing", "broken"), [(1, 0), (2, 1)])
@pytest.mark.parametrize("where", [15, 20])
def test_criterion_3_counts_beams(missing: int, broken: int, where: int) -> None:
    ranges = WALL.copy()
    ranges[where : where + missing] = np.nan
    found = extracted(ranges)
    assert counts(found) == {"invalid": missing} | ({"bearing": 1} if broken else {})
    assert len(beams(found, 0)) == (where if broken else N - missing)


def test_a_gap_that_breaks_by_two_criteria_counts_as_distance() -> None:
    ranges = np.where(np.arange(N) < 20, WALL, 1.5 * WALL)
    ranges[18:22] = np.nan
    assert counts(extracted(ranges, Thresholds(gap_spacings=0.0))) == {"gap": 1, "invalid": 4}


@pytest.mark.parametrize(("n", "is_line"), [(1, False), (2, False), (3, True)])
def test_three_points_make_a_line(n: int, is_line: bool) -> None:
    """Unless the first and the last of them are left out of the fit."""
    ranges = np.full(N, np.nan)
    ranges[18 : 18 + n] = WALL[18 : 18 + n]
    found = extracted(ranges, Thresholds(min_length=0.05), leave_out_ends=False)
    assert bool(found.lines.valid[0]) == is_line
    assert counts(found).get("too_few", 0) == (0 if is_line else n)
    assert counts(found).get("lone", 0) == (1 if n == 1 else 0)


@pytest.mark.parametrize(("length", "is_line"), [(0.29, False), (0.31, True)])
def test_lines_shorter_than_30_cm_are_not_modelled(length: float, is_line: bool) -> None:
    low = np.arctan(length / 2 / 2)
    bearings = np.linspace(-low, low, N)
    scan = Scan.from_ranges(2 / np.cos(bearings), bearings)
    found = extract(scan, HERE, capacity=CAPACITY, thresholds=Thresholds(), rules=Rules())
    assert bool(found.lines.valid[0]) == is_line
    assert counts(found).get("too_short", 0) == (0 if is_line else N)
    if is_line:
        np.testing.assert_allclose(found.lines.length[0], length, atol=1e-9)
    else:
        assert found.circles.valid.any() == (np.asarray(found.circle_of_beam) >= 0).any()


@pytest.mark.parametrize("angle", [0.0, 0.7, np.pi / 2, 2.2])
def test_the_30_cm_rule_does_not_depend_on_the_direction(angle: float) -> None:
    pose = Pose(mean=jnp.array([0.0, 0.0, angle]), cov=jnp.zeros((3, 3)))
    for length in (0.299, 0.301):
        low = np.arctan(length / 2 / 2)
        bearings = np.linspace(-low, low, N)
        scan = Scan.from_ranges(2 / np.cos(bearings), bearings)
        found = extract(scan, pose, capacity=CAPACITY, thresholds=Thresholds(), rules=Rules())
        assert bool(found.lines.valid[0]) == (length > 0.3)


def test_the_readings_differ_where_they_should() -> None:
    # One beam missing breaks a line by the paper's 1.5 spacings, not by 2.5.
    ranges = WALL.copy()
    ranges[20] = np.nan
    scan = Scan.from_ranges(ranges, BEARINGS)
    both: dict[str, Any] = {
        name: extract(scan, HERE, capacity=CAPACITY, **preset(name)) for name in ("default", "paper")
    }
    assert (both["default"].lines.valid.sum(), both["paper"].lines.valid.sum()) == (1, 2)
    assert (counts(both["default"]), counts(both["paper"])) == ({"invalid": 1}, {"invalid": 1, "bearing": 1})

    # A step of 40 cm passes the paper's gap of 50 cm; there criterion 2 has to break the line.
    ranges = np.where(np.arange(N) < 20, WALL, 1.2 * WALL)
    scan = Scan.from_ranges(ranges, BEARINGS)
    both = {name: extract(scan, HERE, capacity=CAPACITY, **preset(name)) for name in ("default", "paper")}
    assert (counts(both["default"]), counts(both["paper"])) == ({"gap": 1}, {"distance": 1})


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_loop_over_the_points_is_one_kernel(dtype: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The compiler marks a loop that it makes one kernel of: a tenth of the time."""
    scan = Scan.from_ranges(np.full(361, 4, dtype), np.linspace(-1.5, 1.5, 361).astype(dtype))
    pose = as_dtype(HERE, scan.ranges.dtype)
    thresholds, noise, mount = with_defaults(None, None, None, scan.ranges.dtype)
    points = points_from_scan(scan, pose, mount, jacobians="analytic")

    def loops() -> tuple[int, int]:
        """How many loops the compiled program has, and how many of them are a kernel."""
        compiled = jax.jit(lambda *x: incremental.segment(*x, Rules())).lower(points, thresholds, noise).compile()
        text = compiled.as_text()
        return len(re.findall(r" while\(", text)), len(re.findall(r'xla_cpu_small_call="true"', text))

    assert loops() == (1, 1)

    # A body that writes four times as much is one too large.
    scan_over = jax.lax.scan

    def larger(body: Any, init: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        def repeated(carry: jax.Array, row: jax.Array) -> tuple[jax.Array, jax.Array]:
            carry, out = body(carry, row)
            return carry, jnp.concatenate([out] * 4)

        carry, out = scan_over(repeated, init, rows)
        return carry, out[:, : init.shape[0]]

    monkeypatch.setattr(jax.lax, "scan", larger)
    assert loops() == (1, 0)
