"""Lines from runs of points: estimate, Jacobians and covariances, each by an independent route."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax.core.extract import extract
from linemap_jax.core.frames import reanchor
from linemap_jax.core.lines import (
    choose_points,
    jac_line_points,
    line_from_regression,
    measure_lines,
    regress,
    rho_theta,
)
from linemap_jax.core.runs import Runs
from linemap_jax.core.sensor import points_from_scan
from linemap_jax.core.settings import Mount, Rules, SensorNoise, Thresholds
from linemap_jax.core.state import Lines, Pose, Scan, empty_lines

BEFORE, AFTER, SIZE = 3, 2, 310
"""Points of no run before and after each run; all cases have one shape, and compile once."""


def runs_at(size: int, *spans: tuple[int, int], free: int = 1) -> Runs:
    """Runs over some spans of points (ends included), and free slots after them."""
    of_point = np.full(size, -1, np.int32)
    for slot, (first, last) in enumerate(spans):
        of_point[first : last + 1] = slot
    first, last = (np.array([*(span[i] for span in spans), *[0] * free], np.int32) for i in (0, 1))
    valid = np.arange(len(first)) < len(spans)
    return Runs(
        first=jnp.asarray(first), last=jnp.asarray(last), valid=jnp.asarray(valid), of_point=jnp.asarray(of_point)
    )


def on_a_line(n: int, angle: float, middle: Any, length: float, noise: float, seed: int = 0) -> np.ndarray:
    """Points in order along a line through `middle` in direction `angle`, unevenly spaced."""
    random = np.random.default_rng(seed)
    along = np.sort(random.uniform(-length / 2, length / 2, n))
    across = noise * random.standard_normal(n)
    tangent = np.array([np.cos(angle), np.sin(angle)])
    normal = np.array([-tangent[1], tangent[0]])
    return np.asarray(middle, float) + along[:, None] * tangent + across[:, None] * normal


def exactly_45(n: int) -> np.ndarray:
    """Points on y = x + 2 in coordinates without rounding, so that N_1 = N_2."""
    x = np.sort(np.random.default_rng(1).choice(1024, n, replace=False)) / 256
    return np.stack([x, x + 2], -1)


CASES = {
    **{f"random {i}": on_a_line(20, 1.3 * i + 0.2, [2 * i - 5, 3 - i], 0.4 * i + 0.5, 0.02, i) for i in range(6)},
    "horizontal": on_a_line(30, 0.0, [1, 2], 3, 0.02),
    "horizontal, exactly": on_a_line(30, 0.0, [1, 2], 3, 0.0),
    "vertical": on_a_line(30, np.pi / 2, [1, 2], 3, 0.02),
    "vertical, exactly, downwards": np.stack([np.full(9, 1.5), np.linspace(2, -1, 9)], -1),
    "45 degrees": exactly_45(25),
    "through the origin": on_a_line(25, 2.4, [1e-9, -1e-9], 2, 0.0),
    "near the origin": on_a_line(25, -0.6, [1e-3, 2e-3], 2, 0.01),
    "10 km away": on_a_line(25, -2.1, [1e4, -7e3], 2, 0.01),
    "three points": on_a_line(3, 1.1, [1, -2], 0.4, 0.01),
    "300 points": on_a_line(300, 2.9, [4, -2], 6, 0.03),
}


def fit_by_numpy(points: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """Offset and angle at an anchor from `np.polyfit`, in the axis that the points spread along more."""
    centred = points - points.mean(0)
    if centred[:, 0].var() >= centred[:, 1].var():
        slope, level = np.polyfit(centred[:, 0], centred[:, 1], 1)
        tangent, through = np.array([1, slope]), points.mean(0) + [0, level]
    else:
        slope, level = np.polyfit(centred[:, 1], centred[:, 0], 1)
        tangent, through = np.array([slope, 1]), points.mean(0) + [level, 0]
    tangent = tangent / np.hypot(*tangent)
    if tangent @ (points[-1] - points[0]) < 0:
        tangent = -tangent
    normal = np.array([tangent[1], -tangent[0]])
    return np.array([normal @ (through - anchor), np.arctan2(normal[1], normal[0])])


def turn_between(a: Any, b: Any) -> np.ndarray:
    """Absolute difference of angles."""
    return np.abs((np.asarray(a) - np.asarray(b) + np.pi) % (2 * np.pi) - np.pi)


def padded(points: np.ndarray) -> tuple[jax.Array, Runs]:
    """The points as one run among points of no run."""
    position = np.random.default_rng(9).uniform(-9, 9, (SIZE, 2))
    last = BEFORE + len(points) - 1
    position[BEFORE : last + 1] = points
    return jnp.asarray(position), runs_at(SIZE, (BEFORE, last))


def estimate(position: jax.Array, runs: Runs, anchor: jax.Array) -> jax.Array:
    return line_from_regression(regress(position, runs), anchor)


estimate_jit = jax.jit(estimate)
jac_jit = {how: jax.jit(partial(jac_line_points, jacobians=how)) for how in ("autodiff", "analytic")}
jac_forward = jax.jit(jax.jacfwd(estimate))


@pytest.mark.parametrize("case", CASES)
def test_estimate_is_that_of_polyfit(case: str) -> None:
    points = CASES[case]
    position, runs = padded(points)
    anchor = points.mean(0) + [0.3, -0.2]
    offset, angle = np.asarray(estimate_jit(position, runs, jnp.asarray([anchor, anchor])))[:, 0]
    expected = fit_by_numpy(points, anchor)
    assert abs(offset - expected[0]) < (1e-8 if "km" in case else 1e-10)
    assert turn_between(angle, expected[1]) < 1e-9
    fit = jax.tree.map(np.asarray, regress(position, runs))
    spread = points.var(0)
    assert bool(fit.steep[0]) == (spread[0] < spread[1] and case != "45 degrees")
    np.testing.assert_allclose(fit.origin[0] + fit.centroid[0], points.mean(0), rtol=1e-12, atol=1e-12)
    # Eq. (6): N is n^2 times the variance of the regressor
    np.testing.assert_allclose(fit.width[0], len(points) ** 2 * spread.max(), rtol=1e-6 if "km" in case else 1e-10)


@pytest.mark.parametrize("case", CASES)
def test_jacobian_four_ways(case: str) -> None:
    points = CASES[case]
    n = len(points)
    position, runs = padded(points)
    at = points.mean(0) + [0.1, 0.05]
    anchor = jnp.asarray([at, at])
    autodiff, analytic = (np.asarray(jac_jit[how](position, runs, anchor)) for how in ("autodiff", "analytic"))
    forward = np.asarray(jac_forward(position, runs, anchor))[:, 0].transpose(1, 0, 2)
    norm = np.linalg.norm(forward, axis=(0, 2))[None, :, None]
    assert np.all(np.abs(autodiff - forward) <= 1e-9 * norm)
    assert np.all(np.abs(analytic - forward) <= 1e-9 * norm)
    outside = np.asarray(runs.of_point) < 0
    assert not autodiff[outside].any()
    assert not analytic[outside].any()

    # A power of two, so that no step is rounded even 10 km away
    step = 2.0**-22
    some = range(n) if n < 50 else (0, 1, n // 2, n - 1)
    for i in some:
        for axis in (0, 1):
            there, back = points.copy(), points.copy()
            there[i, axis] += step
            back[i, axis] -= step
            change = fit_by_numpy(there - at, np.zeros(2)) - fit_by_numpy(back - at, np.zeros(2))
            change[1] = (change[1] + np.pi) % (2 * np.pi) - np.pi
            np.testing.assert_array_less(
                np.abs(autodiff[BEFORE + i, :, axis] - change / (2 * step)), (1e-6 * norm + 1e-7)[0, :, 0]
            )


POSE = Pose(
    mean=jnp.array([3.0, -2.0, 0.7]), cov=jnp.array([[4e-3, 1e-3, 2e-4], [1e-3, 3e-3, -1e-4], [2e-4, -1e-4, 2e-4]])
)
NOISE = SensorNoise(range_sigma=0.015, bearing_sigma=0.002)
SPANS = ((2, 15), (18, 20), (21, 38))


@pytest.fixture(scope="module")
def measured() -> dict[str, Any]:
    """The same three runs by both Jacobians and both covariances."""
    random = np.random.default_rng(4)
    bearings = np.radians(np.arange(40) * 2.0 - 40)
    normals, distances = np.array([0.2, -0.5, 0.9]), np.array([3.0, 2.0, 4.0])
    wall = np.digitize(np.arange(40), [17, 21])
    ranges = distances[wall] / np.cos(bearings - normals[wall]) + 0.01 * random.standard_normal(40)
    scan = Scan.from_ranges(ranges, bearings)
    points = points_from_scan(scan, POSE, Mount(x=0.2, y=-0.1, theta=0.3), jacobians="analytic")
    runs = runs_at(40, *SPANS)
    measure = jax.jit(measure_lines, static_argnames=("maximum_likelihood", "covariance", "jacobians"))
    results = {
        (covariance, jacobians): jax.tree.map(
            np.asarray,
            measure(points, POSE, runs, NOISE, maximum_likelihood=False, covariance=covariance, jacobians=jacobians),
        )
        for covariance in ("exact", "printed")
        for jacobians in ("autodiff", "analytic")
    }
    return {"points": jax.tree.map(np.asarray, points), "runs": runs, "lines": results}


def brute_jacobian(points: Any, runs: Runs, anchor: np.ndarray) -> np.ndarray:
    """d(offset, angle) of each line by all coordinates of all points, shape [K, 2, 2 N]."""
    jac = jax.jit(jax.jacfwd(estimate))(jnp.asarray(points.position), runs, jnp.asarray(anchor))
    return np.asarray(jac).transpose(1, 0, 2, 3).reshape(anchor.shape[0], 2, -1)


@pytest.mark.parametrize("jacobians", ["autodiff", "analytic"])
def test_exact_covariance_is_that_of_all_points_together(measured: dict[str, Any], jacobians: str) -> None:
    points, runs = measured["points"], measured["runs"]
    lines, jac_pose, cov_measurement = measured["lines"]["exact", jacobians]
    n = len(points.range)
    f = points.jac_pose.reshape(2 * n, 3)
    joint = f @ np.asarray(POSE.cov) @ f.T
    c_s = np.diag([NOISE.range_sigma**2, NOISE.bearing_sigma**2])
    for i, g in enumerate(points.jac_measurement):
        joint[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += g @ c_s @ g.T
    jac = brute_jacobian(points, runs, lines.anchor - np.asarray(POSE.mean[:2]))
    for k in range(len(SPANS)):
        expected = jac[k] @ joint @ jac[k].T
        np.testing.assert_allclose(lines.cov[k], expected, rtol=1e-9, atol=1e-9 * np.linalg.norm(expected))
        np.testing.assert_allclose(jac_pose[k], jac[k] @ f, atol=1e-9)
        parts = cov_measurement[k] + jac_pose[k] @ np.asarray(POSE.cov) @ jac_pose[k].T
        np.testing.assert_allclose(lines.cov[k], parts, rtol=1e-12, atol=1e-15)
        # What the pose adds stands apart, in units of the pose's sigmas.
        root = jac_pose[k] @ np.linalg.cholesky(np.asarray(POSE.cov))
        np.testing.assert_allclose(lines.sqrt_persistent[k], root, rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(lines.cov_independent[k], cov_measurement[k])
    np.testing.assert_array_equal(lines.valid, [True] * 3 + [False])


@pytest.mark.parametrize("jacobians", ["autodiff", "analytic"])
def test_printed_covariance_is_a_sum_of_independent_points(measured: dict[str, Any], jacobians: str) -> None:
    points, runs = measured["points"], measured["runs"]
    lines, jac_pose, cov_measurement = measured["lines"]["printed", jacobians]
    jac = brute_jacobian(points, runs, lines.anchor - np.asarray(POSE.mean[:2]))
    c_s = np.diag([NOISE.range_sigma**2, NOISE.bearing_sigma**2])
    for k in range(len(SPANS)):
        expected = np.zeros((2, 2))
        for i, (f, g) in enumerate(zip(points.jac_pose, points.jac_measurement, strict=True)):
            j = jac[k][:, 2 * i : 2 * i + 2]
            expected += j @ (f @ np.asarray(POSE.cov) @ f.T + g @ c_s @ g.T) @ j.T
        np.testing.assert_allclose(lines.cov[k], expected, rtol=1e-9, atol=1e-9 * np.linalg.norm(expected))
        np.testing.assert_allclose(cov_measurement[k], expected, rtol=1e-9, atol=1e-9 * np.linalg.norm(expected))
    assert not jac_pose.any()
    assert not lines.sqrt_persistent.any()
    # To count the pose error once for each point is to believe too much.
    assert np.all(lines.cov[:3, 0, 0] < measured["lines"]["exact", jacobians][0].cov[:3, 0, 0])


def test_mean_and_end_points_in_the_world(measured: dict[str, Any]) -> None:
    points = measured["points"]
    lines = measured["lines"]["exact", "autodiff"][0]
    world = points.position + np.asarray(POSE.mean[:2])
    for k, (first, last) in enumerate(SPANS):
        offset, angle = fit_by_numpy(world[first : last + 1], lines.anchor[k])
        assert abs(lines.offset[k] - offset) < 1e-12
        assert turn_between(lines.angle[k], angle) < 1e-12
        for end, point in ((lines.begin[k], world[first]), (lines.end[k], world[last])):
            normal = np.array([np.cos(angle), np.sin(angle)])
            foot = point - normal * (normal @ (point - lines.anchor[k]) - offset)
            np.testing.assert_allclose(end, foot, atol=1e-12)
        assert lines.extent[k, 0] < lines.extent[k, 1]
        assert np.all(lines.var_extent[k] > 0)


@pytest.fixture(scope="module")
def lines() -> Lines:
    """Random lines, a third of them with the origin on the far side."""
    random = np.random.default_rng(5)
    k = 60
    half = random.standard_normal((k, 2, 2))
    return dataclasses.replace(
        empty_lines(k),
        anchor=jnp.asarray(random.uniform(-20, 20, (k, 2))),
        offset=jnp.asarray(random.uniform(-0.1, 0.1, k)),
        angle=jnp.asarray(random.uniform(-np.pi, np.pi, k)),
        cov_independent=jnp.asarray(1e-3 * half @ half.transpose(0, 2, 1) + 1e-4 * np.eye(2)),
        sqrt_persistent=jnp.asarray(0.03 * random.standard_normal((k, 2, 3))),
        extent=jnp.asarray(np.sort(random.uniform(-3, 3, (k, 2)), 1)),
        valid=jnp.ones(k, bool),
    )


def test_rho_theta_view(lines: Lines) -> None:
    rho, theta, cov = (np.asarray(x) for x in rho_theta(lines))
    assert np.all(rho >= 0)
    assert np.all((theta > -np.pi) & (theta <= np.pi))
    normal = np.stack([np.cos(theta), np.sin(theta)], -1)
    for end in (lines.begin, lines.end):
        np.testing.assert_allclose(np.sum(normal * np.asarray(end), 1), rho, atol=1e-12)

    def view(estimate: jax.Array, anchor: jax.Array) -> jax.Array:
        offset, angle = estimate
        rho = offset + jnp.cos(angle) * anchor[0] + jnp.sin(angle) * anchor[1]
        return jnp.where(rho < 0, jnp.stack([-rho, angle + jnp.pi]), jnp.stack([rho, angle]))

    jac = np.asarray(jax.vmap(jax.jacfwd(view))(jnp.stack([lines.offset, lines.angle], -1), lines.anchor))
    assert 0.2 < np.mean(jac[:, 0, 0] < 0) < 0.8
    expected = jac @ np.asarray(lines.cov) @ jac.transpose(0, 2, 1)
    np.testing.assert_allclose(cov, expected, rtol=1e-10, atol=1e-12)


def test_theta_of_a_line_behind_stays_in_its_range() -> None:
    line = dataclasses.replace(
        empty_lines(2), anchor=jnp.array([[1.0, 0.0], [-1.0, 0.0]]), angle=jnp.array([jnp.pi, 0])
    )
    rho, theta, _ = rho_theta(line)
    np.testing.assert_allclose(rho, [1, 1])
    np.testing.assert_allclose(theta, [0, np.pi], atol=1e-15)


def test_reanchor_leaves_the_line_where_it_is(lines: Lines) -> None:
    shift = jnp.asarray(np.random.default_rng(6).uniform(-5, 5, (60, 2)))
    moved = reanchor(lines, lines.anchor + shift)
    assert np.max(np.abs(moved.offset - lines.offset)) > 1
    np.testing.assert_allclose(moved.begin, lines.begin, atol=1e-12)
    np.testing.assert_allclose(moved.end, lines.end, atol=1e-12)
    for after, before in zip(rho_theta(moved), rho_theta(lines), strict=True):
        np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-11)
    back = reanchor(moved, lines.anchor)
    np.testing.assert_allclose(back.cov_independent, lines.cov_independent, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(back.sqrt_persistent, lines.sqrt_persistent, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize(("first", "last", "keeps_from"), [(16, 32, 21), (12, 32, 21), (4, 26, 4)])
def test_a_line_that_began_on_the_wall_beside_leaves_its_points_out(first: int, last: int, keeps_from: int) -> None:
    """At a corner as below, which the second run passes at point 20; unless less than a third of the run were left."""
    bearings = np.radians(np.arange(-20.0, 21.0))
    scan = Scan.from_ranges(3 / (np.cos(bearings) + np.abs(np.sin(bearings))), bearings)
    points = points_from_scan(scan, Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3))), Mount(), jacobians="analytic")
    noise = SensorNoise(range_sigma=0.02, bearing_sigma=0.0)
    rules = Rules(leave_out_sparse=False, check_ends=False, leave_out_ends=False)
    choose = jax.jit(choose_points, static_argnames="rules")
    _, found = choose(points, runs_at(41, (0, first - 1), (first, last)), Thresholds(), noise, rules=rules)
    np.testing.assert_array_equal(np.flatnonzero(np.asarray(found.of_point) == 1), range(keeps_from, last + 1))
    assert found.valid[1]


def test_points_that_noise_may_have_brought_from_the_wall_beside_are_left_out() -> None:
    """At a right-angled corner 3 m ahead: those within 3 sigma of the line of the other wall, on both sides."""
    bearings = np.radians(np.arange(-20.0, 21.0))
    scan = Scan.from_ranges(3 / (np.cos(bearings) + np.abs(np.sin(bearings))), bearings)
    here = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))
    points = points_from_scan(scan, here, Mount(), jacobians="analytic")
    noise = SensorNoise(range_sigma=0.05, bearing_sigma=0.0)
    rules = Rules(leave_out_sparse=False, leave_out_ends=False)
    choose = jax.jit(choose_points, static_argnames="rules")
    _, kept = choose(points, runs_at(41, (0, 20), (21, 40)), Thresholds(), noise, rules=rules)
    x, y = np.asarray(points.position).T
    beside = np.abs(3 - x + np.where(np.arange(41) <= 20, -y, y)) / np.sqrt(2)
    unsure = beside < 3 * 0.05 * np.cos(np.pi / 4 + np.abs(bearings))
    assert np.flatnonzero(unsure).tolist() == [19, 20, 21]
    np.testing.assert_array_equal(np.asarray(kept.of_point) < 0, unsure)


@pytest.mark.parametrize("moved", [None, 0, 6])
@pytest.mark.parametrize("off", [0.05, 0.12])
def test_a_point_at_the_end_that_the_others_disagree_with_is_left_out(moved: int | None, off: float) -> None:
    """A wall 10 m ahead, seen with seven points; by 5 sigma of a prediction from six, which is 8 to 9 cm."""
    bearings = np.radians(np.arange(-3.0, 4.0))
    ranges = 10 / np.cos(bearings)
    if moved is not None:
        ranges[moved] += off
    here = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))
    points = points_from_scan(Scan.from_ranges(ranges, bearings), here, Mount(), jacobians="analytic")
    sigma = 0.012
    choose = jax.jit(choose_points, static_argnames="rules")
    noise = SensorNoise(range_sigma=sigma, bearing_sigma=0.0)
    _, found = choose(points, runs_at(7, (0, 6)), Thresholds(), noise, rules=Rules(leave_out_ends=False))
    others = np.delete(np.arange(7), moved or 0)
    u = 10 * np.tan(bearings)
    predicted = sigma * np.sqrt(
        1 + 1 / 6 + (u[moved or 0] - u[others].mean()) ** 2 / np.sum((u[others] - u[others].mean()) ** 2)
    )
    assert 0.05 < 5 * predicted < 0.12
    left_out = [moved] if moved is not None and off > 5 * predicted else []
    np.testing.assert_array_equal(np.flatnonzero(np.asarray(found.of_point) < 0), left_out)


def test_three_points_of_two_walls_are_no_line() -> None:
    """Nothing but three points, the first of a wall that stands across: the other two alone are too few for a line."""
    bearings = np.radians([-3.0, 0.0, 3.0])
    for off, rule, a_line in ((0.0, True, True), (0.3, False, True), (0.3, True, False)):
        scan = Scan.from_ranges(10 / np.cos(bearings) - np.array([off, 0, 0]), bearings)
        rules = Rules(leave_out_sparse=False, check_ends=rule, leave_out_ends=False)
        found = extract(scan, Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3))), rules=rules)
        assert bool(found.lines.valid[0]) == a_line


def front(radius: float, bearings: np.ndarray, distance: float = 2.0) -> np.ndarray:
    """Ranges to a pole ahead; beams past it see nothing."""
    aside = distance * np.sin(bearings)
    met = np.abs(aside) < radius
    return np.where(met, distance * np.cos(bearings) - np.sqrt(np.where(met, radius**2 - aside**2, 0)), np.nan)


@pytest.mark.parametrize("rule", [True, False])
def test_the_front_of_a_pole_is_no_line(rule: bool) -> None:
    """Of 25 cm with 3 cm of noise, beams a degree apart: each point passes criterion 2, but all of them make an arc."""
    bearings = np.radians(np.arange(-20.0, 21.0))
    ranges = front(0.25, bearings)
    noise = SensorNoise(range_sigma=0.03, bearing_sigma=0.0)
    here = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))
    find = partial(extract, pose=here, noise=noise, rules=Rules(leave_out_arcs=rule))
    for scan in (Scan.from_ranges(ranges, bearings), Scan.from_ranges(ranges[::-1], bearings[::-1])):
        found = find(scan)
        assert int(found.circles.fitted.sum()) == rule
        if rule:
            assert not found.lines.valid.any()
            np.testing.assert_allclose(found.circles.radius[0], 0.25, atol=0.02)
    # What bends away from the scanner, or hardly, is a line; and so is what bends by no more than noise does.
    hollow = 2 * (2 - 0.25) - ranges
    flat = front(2.0, bearings, 4.0)
    flat = np.where(np.abs(bearings) < np.radians(8), flat, np.nan)
    for ranges_of, sigma in ((hollow, 0.03), (flat, 0.003), (ranges, 0.3)):
        scan = Scan.from_ranges(ranges_of, bearings)
        assert not is_left_out(scan, SensorNoise(range_sigma=sigma, bearing_sigma=0.0))
    assert is_left_out(Scan.from_ranges(ranges, bearings), noise)


def is_left_out(scan: Scan, noise: SensorNoise) -> bool:
    """Whether all points of a scan, as one run, are left to the circles."""
    here = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))
    points = points_from_scan(scan, here, Mount(), jacobians="analytic")
    count = int(points.valid.sum())
    assert count > 5
    left, _ = choose_points(points, runs_at(scan.ranges.shape[0], (0, count - 1)), Thresholds(), noise, Rules())
    np.testing.assert_array_equal(left.of_point[:count], 0 if left.valid[0] else -1)
    return not left.valid[0]


@pytest.mark.parametrize("count", [3, 4])
def test_too_few_points_to_leave_out_the_ends_are_no_line(count: int) -> None:
    bearings = np.radians(np.arange(count) - (count - 1) / 2)
    here = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))
    for rule, a_line in ((False, True), (True, False)):
        rules = Rules(leave_out_sparse=False, leave_out_ends=rule)
        found = extract(Scan.from_ranges(20 / np.cos(bearings), bearings), here, rules=rules)
        assert bool(found.lines.valid[0]) == a_line
        assert int(found.rejected.too_few) == (0 if a_line else count)


@pytest.mark.parametrize(
    ("count", "spacing", "left_out"),
    [
        (5, 0.1, [0, 4]),  # 1.7 cm between points: three are left
        (6, 0.1, [0, 5]),
        (7, 0.1, [0, 1, 5, 6]),
        (7, 1.0, [0, 6]),  # 17 cm between points: no other is near
        (15, 0.1, [*range(5), *range(10, 15)]),  # a third is left
        (61, 0.1, [*range(9), *range(52, 61)]),  # those within 15 cm, which are 7.5 sigma
    ],
)
def test_points_near_the_ends_are_left_out_where_enough_are_left(
    count: int, spacing: float, left_out: list[int]
) -> None:
    """A wall 10 m ahead, seen from -3 to 3 degrees at most."""
    bearings = np.radians(spacing * (np.arange(count) - (count - 1) / 2))
    here = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))
    points = points_from_scan(Scan.from_ranges(10 / np.cos(bearings), bearings), here, Mount(), jacobians="analytic")
    noise = SensorNoise(range_sigma=0.02, bearing_sigma=0.0)
    choose = jax.jit(choose_points, static_argnames="rules")
    rules = Rules(leave_out_sparse=False)
    _, found = choose(points, runs_at(count, (0, count - 1)), Thresholds(), noise, rules=rules)
    assert found.valid[0]
    np.testing.assert_array_equal(np.flatnonzero(np.asarray(found.of_point) < 0), left_out)


def test_the_end_face_of_a_partition_turns_no_line() -> None:
    """Seen from one side fifty scans would all err alike: 10 cm that stand across a wall, with 2 cm of noise."""
    bearings = np.radians(np.arange(-60.0, -20.0, 0.5))
    y = 2 * np.tan(bearings)
    to_end = -1 / np.sin(bearings)  # the face runs to (2, -1) m, and the end face on to (2.1, -1)
    on_end = (y > -1) & (to_end * np.cos(bearings) < 2.1)
    ranges = np.where((y > -2.2) & (y < -1), 2 / np.cos(bearings), np.where(on_end, to_end, np.nan))
    assert on_end.sum() == 3
    here, noise = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3))), SensorNoise(range_sigma=0.02, bearing_sigma=0.0)
    errors = []
    for rule in (False, True):
        found = extract(Scan.from_ranges(ranges, bearings), here, noise=noise, rules=Rules(leave_out_ends=rule))
        assert int(found.lines.valid.sum()) == 1
        errors.append(abs(float(found.lines.angle[0])) / float(np.sqrt(found.lines.cov[0, 1, 1])))
    assert errors[1] < 0.01 < 1 < errors[0]


@pytest.mark.parametrize("end", [0, 8])
@pytest.mark.parametrize(("off", "on_line"), [(0.0, True), (0.029, True), (0.031, False)])
def test_a_point_that_was_left_out_ends_a_line_only_if_it_lies_on_it(end: int, off: float, on_line: bool) -> None:
    """Of nine points of a wall 10 m ahead three at one end are not fitted; by 3 sigma, which is 3 cm across it."""
    bearings = np.radians(np.arange(-4.0, 5.0))
    ranges = 10 / np.cos(bearings)
    ranges[end] += off / np.cos(bearings[end])
    here = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))
    points = points_from_scan(Scan.from_ranges(ranges, bearings), here, Mount(), jacobians="analytic")
    fitted = np.abs(np.arange(9) - end) > 2
    runs = runs_at(9, (0, 8))
    runs = dataclasses.replace(runs, of_point=jnp.where(fitted, runs.of_point, -1))
    noise = SensorNoise(range_sigma=0.01 / np.cos(bearings[end]), bearing_sigma=0.0)
    measure = partial(measure_lines, maximum_likelihood=True, covariance="exact", jacobians="analytic")
    lines, _, _ = measure(points, here, runs, noise)
    ends = np.stack([lines.begin[0], lines.end[0]])
    y = 10 * np.tan(bearings)
    y[end] *= 1 + off / 10
    outermost = end if on_line else abs(end - 1)  # the next one lies on the line, fitted or not
    expected = [y[outermost], y[8]] if end == 0 else [y[0], y[outermost]]
    np.testing.assert_allclose(ends, np.stack([[10.0, 10.0], expected], -1), atol=1e-9)
    # What is too short by then is none.
    length = expected[1] - expected[0]
    for least, is_line in ((length - 1e-6, True), (length + 1e-6, False)):
        found, by_pose, cov = measure(points, here, runs, noise, min_length=least)
        assert bool(found.valid[0]) == is_line
        assert bool(np.any(by_pose)) == bool(np.any(cov)) == is_line
