"""Circles: Eqs. (18)-(20), and poles that are fitted."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from linemap_jax import Capacity, Extraction, Rules, Thresholds, empty_map, extract, update
from linemap_jax.core.circles import FEW, _linearise, jac_arc_points, near_lines
from linemap_jax.core.runs import Runs
from linemap_jax.core.settings import Jacobians, SensorNoise
from linemap_jax.core.state import Circles, Pose, Scan, empty_circles, empty_lines

CAPACITY = Capacity(4, 8)
HERE = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))
SPACING = np.radians(0.25)
N = 81
BEARINGS = (np.arange(N) - 40) * SPACING
NOISE = SensorNoise(range_sigma=0.005, bearing_sigma=0.001)


def pole(center: tuple[float, float], radius: float) -> np.ndarray:
    """Ranges to a pole, NaN where the beam passes it."""
    along = center[0] * np.cos(BEARINGS) + center[1] * np.sin(BEARINGS)
    across2 = center[0] ** 2 + center[1] ** 2 - along**2
    inside = across2 < radius**2
    return np.where(inside, along - np.sqrt(np.where(inside, radius**2 - across2, 0)), np.nan)


def extracted(
    ranges: np.ndarray, fit: bool, pose: Pose = HERE, noise: SensorNoise = NOISE, jacobians: Jacobians = "analytic"
) -> Extraction:
    scan = Scan.from_ranges(ranges, BEARINGS)
    return extract(scan, pose, noise=noise, capacity=CAPACITY, rules=Rules(fit_circles=fit), jacobians=jacobians)


def only(found: Extraction) -> dict[str, Any]:
    """The one circle."""
    (slot,) = np.flatnonzero(found.circles.valid)
    names = [*(field.name for field in dataclasses.fields(found.circles)), "cov"]
    return {name: np.asarray(getattr(found.circles, name))[slot] for name in names}


def arc(ranges: np.ndarray, bearings: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Eqs. (18)-(20) to the letter."""
    angle = bearings + pose[2]
    points = ranges[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1) + pose[:2]
    center = points.mean(0)
    return np.array([*center, np.sqrt(np.sum((points - center) ** 2) / (len(points) - 1))])


@pytest.mark.parametrize("x", [0.0, 1000.0])
def test_equations_18_to_20(x: float) -> None:
    pose = Pose(mean=jnp.array([x, -3.0, 0.4]), cov=jnp.zeros((3, 3)))
    ranges = pole((2.0, 0.05), 0.12) + 0.004 * np.random.default_rng(0).standard_normal(N)
    circle = only(extracted(ranges, fit=False, pose=pose))
    hit = ~np.isnan(ranges)
    *center, radius = arc(ranges[hit], BEARINGS[hit], np.array([x, -3.0, 0.4]))
    np.testing.assert_allclose(circle["center"], center, atol=1e-11 if x == 0 else 1e-9)
    np.testing.assert_allclose(circle["radius"], radius, rtol=1e-9)
    assert not circle["fitted"]


@pytest.mark.parametrize("jacobians", ["autodiff", "analytic"])
def test_covariance_of_equations_18_to_20(jacobians: Jacobians) -> None:
    ranges = pole((2.0, 0.05), 0.12) + 0.004 * np.random.default_rng(0).standard_normal(N)
    mean, cov_pose = np.array([0.3, -3.0, 0.4]), np.diag([0.05, 0.02, 0.01]) ** 2
    pose = Pose(mean=jnp.asarray(mean), cov=jnp.asarray(cov_pose))
    found = extracted(ranges, fit=False, pose=pose, jacobians=jacobians)
    circle = only(found)
    hit = ~np.isnan(ranges)
    x = np.concatenate([ranges[hit], BEARINGS[hit], mean])
    n = hit.sum()

    def moved(i: int, h: float) -> np.ndarray:
        y = x + h * np.eye(len(x))[i]
        return arc(y[:n], y[n : 2 * n], y[2 * n :])

    jac = np.stack([(moved(i, 1e-6) - moved(i, -1e-6)) / 2e-6 for i in range(len(x))], -1)
    first_order = jac[:, : 2 * n] @ np.diag(np.repeat([0.005**2, 0.001**2], n)) @ jac[:, : 2 * n].T
    # Noise of variance v in each point widens the mean square distance from the centre by v.
    wider = np.mean(0.005**2 + (0.001 * ranges[hit]) ** 2) - first_order[2, 2]
    first_order[2, 2] += (wider / (2 * circle["radius"])) ** 2
    np.testing.assert_allclose(circle["cov_independent"], first_order, rtol=1e-6, atol=1e-14)
    by_pose = jac[:, 2 * n :] @ cov_pose @ jac[:, 2 * n :].T
    np.testing.assert_allclose(circle["cov"] - first_order, by_pose, rtol=1e-6, atol=1e-12)


def test_jacobians_of_arcs_are_interchangeable_and_finite() -> None:
    random = np.random.default_rng(2)
    position = jnp.asarray(np.concatenate([random.normal(0, 0.1, (12, 2)) + 3, np.ones((3, 2)), [[7, 7]]]))
    first, last = jnp.array([0, 5, 12, 0]), jnp.array([4, 11, 14, 0])
    of_point = jnp.array([0] * 5 + [1] * 7 + [2] * 3 + [-1])
    runs = Runs(first=first, last=last, valid=jnp.array([True, True, True, False]), of_point=of_point)
    both = [jax.jit(partial(jac_arc_points, jacobians=kind))(position, runs) for kind in ("autodiff", "analytic")]
    assert np.isfinite(both).all()
    np.testing.assert_allclose(both[0], both[1], atol=1e-12)
    assert not np.any(both[1][12:15, 2])  # equal points have no radius
    assert not np.any(both[1][15])


def test_a_pole_is_fitted_exactly_without_noise() -> None:
    found = extracted(pole((2.0, 0.0), 0.15), fit=True, noise=SensorNoise(range_sigma=1e-5, bearing_sigma=1e-7))
    circle = only(found)
    assert circle["fitted"]
    np.testing.assert_allclose(circle["center"], [2, 0], atol=1e-7)
    np.testing.assert_allclose(circle["radius"], 0.15, atol=1e-7)
    hit = ~np.isnan(pole((2.0, 0.0), 0.15))
    np.testing.assert_array_equal(np.asarray(found.circle_of_beam) >= 0, hit)


@pytest.mark.parametrize("seed", range(5))
def test_a_fit_is_the_most_likely_pole(seed: int) -> None:
    # Away from the rim, and without noise of the bearing, the likelihood of a range needs no more than its formula.
    center, radius, sigma = np.array([2.0, 0.1]), 0.2, 0.002
    ranges = pole((2.0, 0.1), radius)
    across = center[1] * np.cos(BEARINGS) - center[0] * np.sin(BEARINGS)
    ranges = np.where(np.abs(across) < 0.8 * radius, ranges, np.nan)
    ranges = ranges + sigma * np.random.default_rng(seed).standard_normal(N)
    hit = ~np.isnan(ranges)

    def residual(x: np.ndarray) -> np.ndarray:
        along = x[0] * np.cos(BEARINGS[hit]) + x[1] * np.sin(BEARINGS[hit])
        aside = x[1] * np.cos(BEARINGS[hit]) - x[0] * np.sin(BEARINGS[hit])
        return (ranges[hit] - along + np.sqrt(x[2] ** 2 - aside**2)) / sigma

    best = optimize.least_squares(residual, [*center, radius], xtol=1e-14, ftol=1e-14)
    cov = np.linalg.inv(best.jac.T @ best.jac)
    circle = only(extracted(ranges, fit=True, noise=SensorNoise(range_sigma=sigma, bearing_sigma=0.0)))
    assert circle["fitted"]
    error = np.array([*circle["center"], circle["radius"]]) - best.x
    assert error @ np.linalg.solve(cov, error) < 0.1**2
    np.testing.assert_allclose(circle["cov"], cov, atol=0.05 * cov.max())


def test_the_mean_of_what_a_noisy_beam_says_of_a_pole() -> None:
    """Of the distance of its point from the circle, by quadrature: a beam that sways meets a pole farther on its side.

    Away from the rim, where second order is enough.
    """
    center, radius, noise = np.array([2.0, 0.0]), 0.2, SensorNoise(range_sigma=0.01, bearing_sigma=0.01)
    bearings = np.arcsin(np.array([-0.5, -0.25, 0.0, 0.3, 0.55]) * radius / center[0])
    beams = np.stack([np.cos(bearings), np.sin(bearings)], -1)

    def met(bearings: np.ndarray) -> np.ndarray:
        return center[0] * np.cos(bearings) - np.sqrt(radius**2 - (center[0] * np.sin(bearings)) ** 2)

    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    sway, of_range = np.meshgrid(0.01 * nodes, 0.01 * nodes, indexing="ij")
    ranges = met(bearings[:, None, None] + sway) + of_range
    off = np.linalg.norm(ranges[..., None] * beams[:, None, None] - center, axis=-1) - radius
    mean = np.einsum("nij,i,j->n", off, weights, weights) / weights.sum() ** 2
    at = np.broadcast_to([*center, radius], (5, 3))
    exact = met(bearings)[:, None] * beams
    found = _linearise(*(jnp.asarray(x) for x in (exact, beams, at, np.zeros((5, 2)))), noise)
    np.testing.assert_allclose(found.residual, -mean, rtol=0.2)


def test_the_papers_circle_lies_before_the_pole() -> None:
    circle = only(extracted(pole((2.0, 0.0), 0.15), fit=False))
    assert 0.6 * 0.15 < 2 - circle["center"][0] < 0.15
    assert 0.4 * 0.15 < circle["radius"] < 0.75 * 0.15
    # and from the other side, before it again: 20 cm away from where it was
    there = Pose(mean=jnp.array([4.0, 0.0, jnp.pi]), cov=jnp.zeros((3, 3)))
    other = only(extracted(pole((2.0, 0.0), 0.15), fit=False, pose=there))
    assert other["center"][0] - circle["center"][0] > 0.18


def test_a_noisy_pole_is_found_where_it_is_and_its_covariance_says_how_well() -> None:
    clean = pole((2.0, 0.0), 0.15)
    random = np.random.default_rng(1)
    scans = jax.tree.map(
        lambda *x: jnp.stack(x),
        *(Scan.from_ranges(clean + 0.005 * random.standard_normal(N), BEARINGS) for _ in range(200)),
    )
    fit = lambda scan: extract(  # noqa: E731
        scan, HERE, noise=dataclasses.replace(NOISE, bearing_sigma=0.0), capacity=CAPACITY, rules=Rules()
    )
    circles = jax.tree.map(np.asarray, jax.jit(jax.vmap(fit))(scans).circles)
    fitted = circles.fitted & circles.valid
    assert np.mean(fitted.any(1)) > 0.9
    error = np.concatenate([circles.center[fitted] - [2, 0], circles.radius[fitted, None] - 0.15], 1)
    assert np.median(np.linalg.norm(error[:, :2], axis=1)) < 0.005
    assert np.all(np.linalg.norm(error[:, :2], axis=1) < 0.04)
    nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(circles.cov[fitted]), error)
    # The median of chi-square with 3 degrees of freedom is 2.37; that of 200 spreads by 0.2.
    assert 1.5 < np.median(nees) < 3.2


def test_covariance_of_a_fit_holds_the_pose() -> None:
    cov = jnp.diag(jnp.array([0.05, 0.02, 0.01])) ** 2
    ranges = pole((2.0, 0.0), 0.15)
    circle = only(extracted(ranges, fit=True, pose=Pose(mean=jnp.zeros(3), cov=cov)))
    alone, with_pose = only(extracted(ranges, fit=True))["cov"], circle["cov"]
    # The pole is 2 m ahead: the heading moves it sideways by 2 m times as much; its radius stays.
    away = circle["center"][0]
    assert away == pytest.approx(2, abs=2e-3)
    np.testing.assert_allclose(with_pose - alone, np.diag([0.05**2, 0.02**2 + (0.01 * away) ** 2, 0]), atol=1e-12)
    assert np.all(np.linalg.eigvalsh(alone) > 0)
    # Only the sensor's part is the scan's own.
    np.testing.assert_allclose(circle["cov_independent"], alone, atol=1e-12)


def test_too_few_points_are_not_fitted() -> None:
    ranges = pole((2.0, 0.0), 0.15)
    for n, fitted in ((4, False), (30, True)):
        some = np.where(np.abs(np.arange(N) - 40) <= n // 2, ranges, np.nan)
        some[40 + n // 2 :] = np.nan
        assert only(extracted(some, fit=True))["fitted"] == fitted


def test_the_largest_radius_may_seem_larger_by_three_sigma() -> None:
    """Else poles of just that radius would be kept where they seem too small, and come out too small."""
    ranges = np.where(np.abs(BEARINGS) < np.radians(6), pole((2.2, 0.0), 0.32), np.nan)  # else it makes two clusters
    found = {
        sigma: only(extracted(ranges, fit=True, noise=SensorNoise(range_sigma=sigma, bearing_sigma=1e-4)))
        for sigma in (0.001, 0.01)
    }
    assert [circle["fitted"] for circle in found.values()] == [False, True]
    assert found[0.01]["radius"] == pytest.approx(0.32, abs=0.01)
    assert np.sqrt(found[0.01]["cov"][2, 2]) > 0.02 / 3


def test_an_inside_corner_is_no_pole() -> None:
    # Seen from inside, the arc bends the other way.
    bowl = 2.0 + 0.15 - (pole((2.0, 0.0), 0.15) - 1.85)
    assert not only(extracted(bowl, fit=True))["fitted"]


def test_poles_of_few_beams_are_fitted_as_those_of_many() -> None:
    """By other ways: by none where nothing is to be fitted, by the points of the poles alone where these are few."""
    noise = 0.003 * np.random.default_rng(5).standard_normal(N)
    ranges = [np.full(N, np.nan), pole((4.0, 0.3), 0.15) + noise, pole((2.0, 0.0), 0.15) + noise]
    assert [int(np.isfinite(r).sum() > 0) + int(np.isfinite(r).sum() > N / FEW) for r in ranges] == [0, 1, 2]
    alone = [extracted(r, fit=True).circles for r in ranges]
    scans = jax.tree.map(lambda *x: jnp.stack(x), *(Scan.from_ranges(r, BEARINGS) for r in ranges))

    def fit(scan: Scan) -> Circles:
        return extract(scan, HERE, noise=NOISE, capacity=CAPACITY, jacobians="analytic").circles

    # A batch goes one way, that of the scan which needs most.
    together = jax.jit(jax.vmap(fit))(scans)
    assert [int(circles.fitted.sum()) for circles in alone] == [0, 1, 1]
    for name in ("valid", "fitted", "center", "radius", "cov_independent"):
        expected = np.stack([getattr(circles, name) for circles in alone])
        np.testing.assert_allclose(getattr(together, name), expected, rtol=1e-9, atol=1e-15, err_msg=name)
    assert "cond[" in str(jax.make_jaxpr(jax.vmap(fit))(scans)), "all ways are gone by all"


def test_some_runs_moved_together_have_the_same_sums() -> None:
    """Also where there is no place to spare, and a run that is left out comes last."""
    of_point = jnp.array([-1, 0, 0, -1, 1, 1, 1, 2, 2, -1, 3, 3])
    first, last = jnp.array([1, 4, 7, 10, 0]), jnp.array([2, 6, 8, 11, 0])
    runs = Runs(first=first, last=last, valid=jnp.arange(5) < 4, of_point=of_point)
    per_point = jnp.arange(1.0, 13.0)
    for chosen in ([0, 1], [1], [0, 2, 3], [1, 3]):
        which = jnp.isin(of_point, jnp.array(chosen))
        for spare in (0, 3):
            index, some = runs.only(which, int(which.sum()) + spare)
            expected = [float(per_point[of_point == k].sum()) if k in chosen else 0.0 for k in range(5)]
            assert some.sum(per_point[index]).tolist() == expected
            assert some.valid.tolist() == [k in chosen for k in range(5)]


def test_clusters_of_one_point_are_no_circles() -> None:
    ranges = np.full(N, np.nan)
    ranges[[10, 40]] = 2.0, 4.0
    found = extracted(ranges, fit=True)
    assert not found.circles.valid.any()
    assert found.rejected.lone == 2


def test_a_far_point_begins_a_cluster() -> None:
    ranges = np.full(N, np.nan)
    ranges[[20, 24, 28, 60, 64]] = [2.0, 2.02, 1.98, 2.6, 2.62]
    found = extracted(ranges, fit=True)
    assert int(found.circles.valid.sum()) == 2
    slot = np.asarray(found.circle_of_beam)
    assert slot[20] == slot[24] == slot[28] != slot[60] == slot[64]


def test_only_a_pole_has_a_covariance_in_the_map() -> None:
    ranges = pole((2.0, 0.0), 0.15)
    scan = Scan.from_ranges(ranges, BEARINGS)
    pose = Pose(mean=jnp.zeros(3), cov=jnp.diag(jnp.array([0.05, 0.02, 0.01])) ** 2)
    for fit in (True, False):
        line_map = empty_map(Capacity(4, 4))
        for times in (1, 2):
            rules = Rules(fit_circles=fit)
            line_map, _ = update(
                line_map, scan, pose, noise=NOISE, rules=rules, capacity=CAPACITY, jacobians="analytic"
            )
            circles = line_map.circles
            assert (int(circles.times_detected[0]), bool(circles.fitted[0])) == (times, fit)
            assert bool(circles.cov_independent[0].any()) == fit
            assert bool(circles.sqrt_persistent[0].any()) == fit


def circle_at(x: float, y: float, radius: float, fitted: bool) -> Circles:
    return dataclasses.replace(
        empty_circles(1),
        center=jnp.array([[x, y]]),
        radius=jnp.array([radius]),
        fitted=jnp.array([fitted]),
        valid=jnp.ones(1, bool),
    )


@pytest.mark.parametrize(
    ("x", "y", "radius", "fitted", "near"),
    [
        (0.0, 0.14, 0.0, False, True),
        (0.0, 0.16, 0.0, False, False),
        (0.0, -0.14, 0.1, False, True),
        (0.0, 0.16, 0.1, False, False),  # the radius of an unfitted one does not count
        (0.0, 0.24, 0.1, True, True),  # the rim of a fitted one does
        (0.0, 0.26, 0.1, True, False),
        (1.14, 0.0, 0.0, False, True),  # beyond the end
        (1.16, 0.0, 0.0, False, False),
        (1.1, 0.1, 0.0, False, True),
        (1.11, 0.11, 0.0, False, False),
    ],
)
def test_near_a_line(x: float, y: float, radius: float, fitted: bool, near: bool) -> None:
    line = dataclasses.replace(
        empty_lines(2),
        anchor=jnp.array([[0.5, 1.0], [0.0, 0.0]]),
        offset=jnp.array([-1.0, 0.0]),
        angle=jnp.array([jnp.pi / 2, 0.0]),
        extent=jnp.array([[-0.5, 1.5], [-9.0, 9.0]]),  # along -x from (0.5, 0): from x = 1 to x = -1
        valid=jnp.array([True, False]),
    )
    thresholds = Thresholds(circle_line_distance=0.15)
    assert bool(near_lines(circle_at(x, y, radius, fitted), line, thresholds, Rules())[0]) == near


@pytest.mark.parametrize(("of_circle", "of_line", "counts"), [(1, 1, True), (5, 4, False), (5, 5, True), (5, 6, True)])
def test_a_line_seen_more_seldom_takes_no_place(of_circle: int, of_line: int, counts: bool) -> None:
    line = dataclasses.replace(
        empty_lines(1), extent=jnp.array([[-1.0, 1.0]]), times_detected=jnp.array([of_line]), valid=jnp.array([True])
    )
    circle = dataclasses.replace(circle_at(0.0, 0.0, 0.05, True), times_detected=jnp.array([of_circle]))
    assert bool(near_lines(circle, line, Thresholds(), Rules())[0]) == counts
    assert bool(near_lines(circle, line, Thresholds(), Rules(weigh_circles=False))[0])


def test_circles_near_a_line_are_dropped_and_counted() -> None:
    # A wall at 2 m with a slot in it, and something small just before the wall, or well before it.
    wall = 2 / np.cos(BEARINGS)
    wall[36:45] = np.nan
    for depth, kept in ((0.05, False), (0.5, True)):
        ranges = wall.copy()
        ranges[39:42] = 2 - depth
        found = extracted(ranges, fit=True)
        assert int(found.lines.valid.sum()) == 2
        assert bool(found.circles.valid.any()) == kept
        assert int(found.rejected.near_line) == (0 if kept else 3)
        np.testing.assert_array_equal(
            np.flatnonzero(np.asarray(found.circle_of_beam) >= 0), [39, 40, 41] if kept else []
        )
