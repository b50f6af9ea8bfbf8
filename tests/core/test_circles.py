"""Circles: Eqs. (18)-(20), and poles that are fitted."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax import Capacity, Extraction, Rules, Thresholds, extract
from linemap_jax.core.circles import near_lines
from linemap_jax.core.settings import SensorNoise
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


def extracted(ranges: np.ndarray, fit: bool, pose: Pose = HERE) -> Extraction:
    scan = Scan.from_ranges(ranges, BEARINGS)
    return extract(scan, pose, noise=NOISE, thresholds=Thresholds(), capacity=CAPACITY, rules=Rules(fit_circles=fit))


def only(found: Extraction) -> dict[str, Any]:
    """The one circle."""
    (slot,) = np.flatnonzero(found.circles.valid)
    names = [*(field.name for field in dataclasses.fields(found.circles)), "cov"]
    return {name: np.asarray(getattr(found.circles, name))[slot] for name in names}


@pytest.mark.parametrize("x", [0.0, 1000.0])
def test_equations_18_to_20(x: float) -> None:
    pose = Pose(mean=jnp.array([x, -3.0, 0.4]), cov=jnp.zeros((3, 3)))
    ranges = pole((2.0, 0.05), 0.12) + 0.004 * np.random.default_rng(0).standard_normal(N)
    circle = only(extracted(ranges, fit=False, pose=pose))
    hit = ~np.isnan(ranges)
    angle = BEARINGS[hit] + 0.4
    points = ranges[hit, None] * np.stack([np.cos(angle), np.sin(angle)], -1) + np.array([x, -3.0])
    center = points.mean(0)
    radius = np.sqrt(np.sum((points - center) ** 2) / (len(points) - 1))
    np.testing.assert_allclose(circle["center"], center, atol=1e-11 if x == 0 else 1e-9)
    np.testing.assert_allclose(circle["radius"], radius, rtol=1e-9)
    assert not circle["fitted"]
    assert not circle["cov"].any()


def test_a_pole_is_fitted_exactly_without_noise() -> None:
    found = extracted(pole((2.0, 0.0), 0.15), fit=True)
    circle = only(found)
    assert circle["fitted"]
    np.testing.assert_allclose(circle["center"], [2, 0], atol=1e-9)
    np.testing.assert_allclose(circle["radius"], 0.15, atol=1e-9)
    hit = ~np.isnan(pole((2.0, 0.0), 0.15))
    np.testing.assert_array_equal(np.asarray(found.circle_of_beam) >= 0, hit)


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
    np.testing.assert_allclose(with_pose - alone, np.diag([0.05**2, 0.02**2 + 0.02**2, 0]), atol=1e-10)
    assert np.all(np.linalg.eigvalsh(alone) > 0)
    # Only the sensor's part is the scan's own.
    np.testing.assert_allclose(circle["cov_independent"], alone, atol=1e-12)


def test_too_few_points_are_not_fitted() -> None:
    ranges = pole((2.0, 0.0), 0.15)
    for n, fitted in ((4, False), (30, True)):
        some = np.where(np.abs(np.arange(N) - 40) <= n // 2, ranges, np.nan)
        some[40 + n // 2 :] = np.nan
        assert only(extracted(some, fit=True))["fitted"] == fitted


def test_an_inside_corner_is_no_pole() -> None:
    # Seen from inside, the arc bends the other way.
    bowl = 2.0 + 0.15 - (pole((2.0, 0.0), 0.15) - 1.85)
    assert not only(extracted(bowl, fit=True))["fitted"]


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
    assert bool(near_lines(circle_at(x, y, radius, fitted), line, thresholds)[0]) == near


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
