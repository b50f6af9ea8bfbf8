"""From measurements to points: Eqs. (2)-(4), the mount, and what becomes of beams that returned nothing."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax import Capacity, empty_map, extract, preset, update
from linemap_jax.core.extract import usable
from linemap_jax.core.sensor import (
    cov_measurement,
    cov_point,
    jac_point_measurement,
    jac_point_pose,
    point_from_measurement,
    points_from_scan,
)
from linemap_jax.core.settings import Mount, SensorNoise
from linemap_jax.core.state import LEFT_OUT, Pose, Scan, Status

CAPACITY, MAP = Capacity(8, 8), Capacity(16, 16)
ORIGIN = Pose(mean=jnp.zeros(3), cov=jnp.diag(jnp.array([1e-3, 1e-3, 1e-4])))


def room(n: int = 61, seed: int = 0) -> Scan:
    """A wall ahead at 2 m with noise, a near box on the left, some beams without a return."""
    bearings = np.radians(np.linspace(-60, 60, n))
    ranges = 2 / np.cos(bearings) + 0.005 * np.random.default_rng(seed).standard_normal(n)
    ranges[45:52] = 0.9
    ranges[[3, 20, 55]] = np.nan
    return Scan.from_ranges(ranges, bearings, range_max=10.0)


def assert_same(a: Any, b: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_f_and_g_as_typed_from_equation_4() -> None:
    # theta + bearing = 0.75; 2 cos(0.75) = 1.463377737747642, 2 sin(0.75) = 1.363277520046668
    pose, measurement, mount = jnp.array([3.0, 4.0, 0.5]), jnp.array([2.0, 0.25]), jnp.zeros(3)
    point = point_from_measurement(pose, measurement, mount)
    np.testing.assert_allclose(point, [4.463377737747642, 5.363277520046668], rtol=1e-14)
    f = [[1, 0, -1.363277520046668], [0, 1, 1.463377737747642]]
    g = [[0.731688868873821, -1.363277520046668], [0.681638760023334, 1.463377737747642]]
    np.testing.assert_allclose(jac_point_pose(pose, measurement, mount), f, rtol=1e-14)
    np.testing.assert_allclose(jac_point_measurement(pose, measurement, mount), g, rtol=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_f_and_g_are_the_derivatives(seed: int) -> None:
    random = np.random.default_rng(seed)
    pose = jnp.asarray(random.uniform(-3, 3, 3))
    measurement = jnp.asarray([random.uniform(0.1, 30), random.uniform(-3, 3)])
    mount = jnp.asarray(random.uniform(-1, 1, 3))
    f, g = jax.jacfwd(point_from_measurement, (0, 1))(pose, measurement, mount)
    np.testing.assert_allclose(jac_point_pose(pose, measurement, mount), f, atol=1e-13)
    np.testing.assert_allclose(jac_point_measurement(pose, measurement, mount), g, atol=1e-13)
    for analytic, at, call in (
        (f, pose, lambda x: point_from_measurement(x, measurement, mount)),
        (g, measurement, lambda x: point_from_measurement(pose, x, mount)),
    ):
        steps = 1e-6 * np.eye(len(at))
        numeric = np.stack([(call(at + step) - call(at - step)) / 2e-6 for step in steps], -1)
        np.testing.assert_allclose(analytic, numeric, atol=1e-7)


def test_covariance_of_a_point_along_a_beam() -> None:
    # A beam straight ahead: the range is along x, bearing and heading turn into y at 2 m.
    here, measurement, none = jnp.zeros(3), jnp.array([2.0, 0.0]), jnp.zeros(3)
    noise = SensorNoise(range_sigma=0.03, bearing_sigma=0.005)
    f, g = jac_point_pose(here, measurement, none), jac_point_measurement(here, measurement, none)
    cov = cov_point(f, g, jnp.diag(jnp.array([0.1, 0.2, 0.01])) ** 2, noise)
    np.testing.assert_allclose(cov, np.diag([0.1**2 + 0.03**2, 0.2**2 + 0.02**2 + 0.01**2]), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(cov_measurement(noise), np.diag([9e-4, 2.5e-5]), rtol=1e-12)


@pytest.mark.parametrize("jacobians", ["autodiff", "analytic"])
def test_mount_is_one_more_frame(jacobians: Any) -> None:
    scan, mount = room(), Mount(x=0.4, y=-0.3, theta=2.0)
    pose = Pose(mean=jnp.array([5.0, 6.0, -0.8]), cov=ORIGIN.cov)
    points = points_from_scan(scan, pose, mount, jacobians=jacobians)

    def homogeneous(x: float, y: float, theta: float) -> np.ndarray:
        return np.array([[np.cos(theta), -np.sin(theta), x], [np.sin(theta), np.cos(theta), y], [0, 0, 1]])

    valid = np.asarray(scan.valid)
    r, b = np.asarray(scan.ranges)[valid], np.asarray(scan.bearings)[valid]
    chain = homogeneous(5.0, 6.0, -0.8) @ homogeneous(0.4, -0.3, 2.0)
    world = (chain @ np.stack([r * np.cos(b), r * np.sin(b), np.ones_like(r)]))[:2].T
    n = len(r)
    np.testing.assert_allclose(points.position[:n] + pose.mean[None, :2], world, atol=1e-12)
    np.testing.assert_allclose(points.laser + pose.mean[:2], chain[:2, 2], atol=1e-12)
    ends = np.asarray(points.laser)[None] + np.asarray(points.range)[:, None] * np.asarray(points.beam)
    np.testing.assert_allclose(points.position[:n], ends[:n], atol=1e-12)
    # The lever of the heading starts at the robot, not at the scanner.
    lever = np.stack([-points.position[:n, 1], points.position[:n, 0]], -1)
    np.testing.assert_allclose(points.jac_pose[:n, :, 2], lever, atol=1e-12)


def test_jacobians_agree_on_a_scan() -> None:
    pose = Pose(mean=jnp.array([5.0, 6.0, -0.8]), cov=ORIGIN.cov)
    both = [points_from_scan(room(), pose, Mount(x=0.2), jacobians=how) for how in ("autodiff", "analytic")]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-13), *both)


def test_returns_stand_first_and_in_order() -> None:
    scan = Scan.from_ranges(np.array([np.nan, 1.0, np.inf, 2.0, 0.0, 3.0]), np.arange(6) * 0.1)
    points = points_from_scan(scan, ORIGIN, Mount(), jacobians="analytic")
    np.testing.assert_array_equal(points.valid, [True] * 3 + [False] * 3)
    np.testing.assert_array_equal(points.index, [1, 3, 5, 6, 6, 6])
    np.testing.assert_array_equal(points.range[:3], [1, 2, 3])
    np.testing.assert_allclose(points.turn[:3], [0, 0.2, 0.2])
    assert np.all(np.isfinite(points.position))
    np.testing.assert_array_equal(points.per_beam(jnp.arange(6) + 10), [-1, 10, -1, 11, -1, 12])


@pytest.mark.parametrize("first", [0, 17, 61])
def test_points_run_counter_clockwise_whatever_the_sweep(first: int) -> None:
    """A scanner that turns the other way, or begins anywhere: the same points in the same order."""
    scan = room()
    there = points_from_scan(scan, ORIGIN, Mount(), jacobians="analytic")
    back = Scan.from_ranges(scan.ranges[::-1], scan.bearings[::-1], range_max=10.0)
    seen = points_from_scan(back, ORIGIN, Mount(), jacobians="analytic")
    count = int(there.valid.sum())
    assert_same(seen.position[:count], there.position[:count])
    assert_same(seen.index[:count], 60 - there.index[:count])
    # A scanner all around, whose driver begins elsewhere.
    bearings = np.radians(np.roll(np.arange(0, 360, 6), -first))
    around = Scan.from_ranges(np.full(60, 3.0) + np.arange(60) / 100, bearings)
    points = [
        points_from_scan(s, ORIGIN, Mount(), jacobians="analytic").position[:60]
        for s in (around, Scan.from_ranges(around.ranges[::-1], bearings[::-1]))
    ]
    turns = [np.diff(np.unwrap(np.arctan2(p[:, 1], p[:, 0]))) for p in points]
    assert all((turn > 0).all() for turn in turns)


def test_the_normal_of_a_line_points_away_from_who_sees_it() -> None:
    for turned in (slice(None), slice(None, None, -1)):
        scan = room()
        scan = Scan.from_ranges(scan.ranges[turned], scan.bearings[turned], range_max=10.0)
        lines = extract(scan, ORIGIN, capacity=CAPACITY).lines
        away = jnp.sum(lines.anchor * lines.normal, -1) + lines.offset
        assert int(lines.valid.sum()) >= 2
        assert bool(jnp.all(away[lines.valid] > 0))


def test_masked_beams_may_hold_anything() -> None:
    scan = room()
    before = extract(scan, ORIGIN, capacity=CAPACITY)
    assert int(before.lines.valid.sum()) >= 1
    for garbage in (np.nan, np.inf, -1e30, 1.0):
        ranges, bearings = (jnp.where(scan.valid, x, garbage) for x in (scan.ranges, scan.bearings))
        assert_same(
            before, extract(dataclasses.replace(scan, ranges=ranges, bearings=bearings), ORIGIN, capacity=CAPACITY)
        )


def test_a_scan_without_returns_holds_nothing() -> None:
    scan = dataclasses.replace(room(), valid=jnp.zeros(61, bool))
    found = extract(scan, ORIGIN, capacity=CAPACITY)
    assert not found.lines.valid.any()
    assert not found.circles.valid.any()
    assert found.status == Status.OK
    assert found.rejected.invalid == 61
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(found))


def test_a_single_return_is_a_lone_point() -> None:
    scan = dataclasses.replace(room(), valid=jnp.arange(61) == 30)
    found = extract(scan, ORIGIN, capacity=CAPACITY)
    assert not found.lines.valid.any()
    assert not found.circles.valid.any()
    assert (found.rejected.too_few, found.rejected.lone, found.rejected.invalid) == (1, 1, 60)


@pytest.mark.parametrize("fit", [True, False])
def test_equal_points_are_no_line(fit: bool) -> None:
    scan = Scan(
        ranges=jnp.full(61, 2.0),
        bearings=jnp.full(61, 0.3),
        valid=jnp.ones(61, bool),
        spacing=jnp.array(0.01),
        first=jnp.array(0),
    )
    found = extract(scan, ORIGIN, capacity=CAPACITY, **preset("default" if fit else "paper"))
    assert not found.lines.valid.any()
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(found))
    (which,) = np.flatnonzero(found.circles.valid)
    np.testing.assert_allclose(found.circles.center[which], 2 * np.array([np.cos(0.3), np.sin(0.3)]), atol=1e-12)
    assert found.circles.radius[which] == 0


@pytest.mark.parametrize(
    ("field", "bad"), [(field, bad) for field in ("mean", "cov") for bad in (np.nan, np.inf, 1e10)] + [("cov", -1.0)]
)
def test_a_pose_that_is_not_finite_changes_nothing(field: str, bad: float) -> None:
    scan = room()
    line_map, report = update(empty_map(MAP), scan, ORIGIN, capacity=CAPACITY)
    assert report.added > 0
    value = getattr(ORIGIN, field)
    broken = dataclasses.replace(ORIGIN, **{field: value.at[(0,) * value.ndim].set(bad)})
    found = extract(scan, broken, capacity=CAPACITY)
    assert found.status == Status.POSE_NOT_FINITE
    assert not found.lines.valid.any()
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(found))
    after, report = update(line_map, scan, broken, capacity=CAPACITY)
    assert_same(after, line_map)
    assert report.status == Status.POSE_NOT_FINITE
    assert np.all(np.asarray(report.line_slot) == LEFT_OUT)
    counts = (report.added, report.fused, report.merged, report.trimmed, report.split, report.deleted)
    assert not any(int(count) for count in counts)


@pytest.mark.parametrize(
    ("mean", "cov", "told"),
    [
        (jnp.zeros(3), jnp.ones(3), r"pose.cov must have shape \(3, 3\), not \(3,\)"),
        (jnp.zeros(2), jnp.eye(3), r"pose.mean must have shape \(3,\), not \(2,\)"),
    ],
)
def test_a_pose_of_another_shape_is_refused(mean: Any, cov: Any, told: str) -> None:
    """Before anything of jax complains; without the checks of types that the tests switch on."""
    pose = object.__new__(Pose)
    object.__setattr__(pose, "mean", mean)
    object.__setattr__(pose, "cov", cov)
    with pytest.raises(ValueError, match=told):
        usable(room(), pose)


def test_several_scans_are_refused_where_one_is_asked_for() -> None:
    scans = object.__new__(Scan)
    for name, x in vars(room()).items():
        object.__setattr__(scans, name, jnp.stack([x, x]))
    with pytest.raises(ValueError, match=r"one scan has ranges \[N\], not \[2, 61\]: jax.vmap or"):
        usable(scans, ORIGIN)


def test_an_empty_scan_changes_no_map() -> None:
    line_map, _ = update(empty_map(MAP), room(), ORIGIN, capacity=CAPACITY)
    nothing = dataclasses.replace(room(), valid=jnp.zeros(61, bool))
    after, report = update(line_map, nothing, ORIGIN, capacity=CAPACITY)
    assert_same(after, line_map)
    assert report.status == Status.OK
