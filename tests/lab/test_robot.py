"""How the robot drives, what its wheels count, and what it believes: shapes of paths, sizes and memory of errors."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from linemap_jax.lab.robot import (
    Odometry,
    dead_reckoning,
    drive,
    estimate_poses,
    increments,
    pose_errors,
    read_odometry,
)

KEY = jax.random.key(3)
SIGMAS = 6
DRIVE = jax.jit(drive, static_argnames=("count", "turns"))
READ = jax.jit(read_odometry)
ERRORS = jax.jit(pose_errors, static_argnames="count")
PATH = jnp.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [7.0, 7.0], [1.0, 7.0]])
COV = np.array([[4e-4, 1e-4, 2e-5], [1e-4, 9e-4, -3e-5], [2e-5, -3e-5, 1e-4]])


def lengths(poses: Any) -> np.ndarray:
    return np.hypot(*np.diff(np.asarray(poses)[:, :2], axis=0).T)


def turns(poses: Any) -> np.ndarray:
    return (np.diff(np.asarray(poses)[:, 2]) + np.pi) % (2 * np.pi) - np.pi


def test_turning_on_the_spot() -> None:
    # 4 m ahead, 90 degrees at 2/pi m a radian (1 m), 3 m to the left: with nine poses every step is 1 m, or 90 degrees.
    poses = DRIVE(PATH[:3], count=9, turn_cost=2 / np.pi)
    half = np.pi / 2
    expected = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0), (4, 0, 0), (4, 0, half), (4, 1, half), (4, 2, half)]
    np.testing.assert_allclose(poses, [*expected, (4, 3, half)], atol=1e-12)


@pytest.mark.parametrize("how", ["spot", "smooth"])
def test_a_drive_keeps_to_its_path(how: Any) -> None:
    poses = np.asarray(DRIVE(PATH, count=200, turns=how, corner=0.6))
    np.testing.assert_allclose(poses[[0, -1], :2], PATH[jnp.array([0, -1])], atol=1e-12)
    away = shapely.distance(shapely.points(poses[:, :2]), shapely.linestrings(np.asarray(PATH)))
    assert away.max() < (1e-9 if how == "spot" else 0.6 * 0.5)
    # Whoever moves looks where he goes, up to half of what he turned meanwhile.
    moves = lengths(poses) > 1e-3
    course = np.arctan2(*np.diff(poses[:, :2], axis=0).T[::-1])
    off = (course - poses[:-1, 2] + np.pi) % (2 * np.pi) - np.pi
    pure = moves & (np.abs(turns(poses)) < 1e-9)
    assert pure.sum() > 100
    np.testing.assert_allclose(off[pure], 0, atol=1e-6)
    if how == "smooth":
        assert np.all(np.abs(off) < 0.7 * np.abs(turns(poses)) + 1e-6)
    assert np.all((poses[:, 2] > -np.pi) & (poses[:, 2] <= np.pi))


def test_a_smooth_drive_has_steps_of_one_length_and_no_sudden_turns() -> None:
    poses = DRIVE(PATH, count=200, turns="smooth", corner=1.0)
    step = lengths(poses)
    np.testing.assert_allclose(step, step.mean(), rtol=2e-2)  # a chord is shorter than its arc
    # The parabola bends most in its middle: by sin(a) / cos(a)^2 a metre, with a half of the turn of 126.9 degrees.
    assert np.abs(turns(poses)).max() < 4.48 * step.mean()
    assert np.abs(turns(DRIVE(PATH, count=200))).max() < np.pi / 2


def test_smooth_without_room_for_it_is_the_path_itself() -> None:
    poses = DRIVE(PATH[:3], count=8, turns="smooth", corner=0.0)
    np.testing.assert_allclose(poses[:, :2], [[i, 0] for i in range(5)] + [[4, 1], [4, 2], [4, 3]], atol=1e-12)


@pytest.mark.parametrize("how", ["spot", "smooth"])
def test_repeated_way_points_count_once(how: Any) -> None:
    twice = PATH[jnp.array([0, 0, 1, 1, 1, 2, 3, 4, 4])]
    plain, repeated = (DRIVE(path, count=57, turns=how, corner=0.0) for path in (PATH, twice))
    np.testing.assert_allclose(repeated[:, :2], plain[:, :2], atol=1e-9)
    assert np.abs(np.sin(np.asarray(repeated - plain)[:, 2])).max() < 1e-9


@pytest.mark.parametrize("how", ["spot", "smooth"])
def test_a_path_of_one_point_is_a_place_to_stand(how: Any) -> None:
    poses = DRIVE(jnp.array([[1.0, 2.0]]), count=4, turns=how)
    np.testing.assert_array_equal(poses, np.tile([1.0, 2.0, 0.0], (4, 1)))


def test_paths_that_cannot_be_driven() -> None:
    with pytest.raises(ValueError, match="way point"):
        drive(jnp.zeros((0, 2)), count=3)
    wild: Any = "wild"
    with pytest.raises((ValueError, TypeError), match="turns"):  # whoever checks first
        drive(PATH, count=3, turns=wild)


def test_increments_and_back() -> None:
    poses = np.random.default_rng(0).uniform(-3, 3, (20, 3))
    steps = np.asarray(increments(jnp.asarray(poses)))
    for a, b, step in zip(poses[:-1], poses[1:], steps, strict=True):
        c, s = np.cos(a[2]), np.sin(a[2])
        np.testing.assert_allclose(step[:2], np.array([[c, s], [-s, c]]) @ (b - a)[:2], atol=1e-12)
    np.testing.assert_allclose(dead_reckoning(jnp.asarray(poses[0]), jnp.asarray(steps)), poses, atol=1e-12)


def test_odometry_without_errors_is_the_truth() -> None:
    poses = DRIVE(PATH, count=60, turns="smooth")
    none = Odometry(sigma_distance_distance=0, sigma_distance_turn=0, sigma_turn_distance=0, sigma_turn_turn=0)
    np.testing.assert_allclose(READ(KEY, poses, none), increments(poses), atol=1e-12)


COUNT = jax.jit(jax.vmap(read_odometry, (0, None, None)))


def counted(poses: jax.Array, odometry: Odometry, runs: int = 4000) -> np.ndarray:
    """Counted distance and turn in all, of each run, less the true ones. Shape `[runs, 2]`."""
    steps = np.asarray(COUNT(jax.random.split(KEY, runs), poses, odometry))
    distance = np.hypot(steps[..., 0], steps[..., 1]).sum(1) - lengths(poses).sum()
    return np.stack([distance, steps[..., 2].sum(1) - turns(poses).sum()], -1)


@pytest.mark.parametrize("count", [11, 41])
def test_errors_of_odometry_grow_with_the_way_whatever_the_steps(count: int) -> None:
    odometry = Odometry(
        sigma_distance_distance=0.003, sigma_distance_turn=0.002, sigma_turn_distance=0.01, sigma_turn_turn=0.02
    )
    straight = DRIVE(jnp.array([[0.0, 0.0], [4.0, 0.0]]), count=count)
    error = counted(straight, odometry).std(0)
    np.testing.assert_allclose(error, [0.003 * 2, 0.01 * 2], rtol=SIGMAS / np.sqrt(8000))

    around = jnp.stack([jnp.zeros(count), jnp.zeros(count), jnp.linspace(0, 3.0, count)], -1)
    error = counted(around, odometry)[:, 1]
    assert error.std() == pytest.approx(0.02 * np.sqrt(3), rel=SIGMAS / np.sqrt(8000))
    assert abs(error.mean()) < SIGMAS * error.std() / np.sqrt(4000)


def test_scales_of_odometry_are_the_same_in_all_steps() -> None:
    poses = DRIVE(PATH, count=100, turns="smooth")
    odometry = Odometry(
        sigma_distance_distance=0,
        sigma_distance_turn=0,
        sigma_turn_distance=0,
        sigma_turn_turn=0,
        distance_scale=1.02,
        turn_scale=0.9,
    )
    error = counted(poses, odometry, runs=4000)
    np.testing.assert_allclose(error, np.tile([0.02 * lengths(poses).sum(), -0.1 * turns(poses).sum()], (4000, 1)))


@pytest.mark.parametrize("correlation", [0.0, 0.9, 1.0])
def test_pose_errors_have_their_covariance_and_their_memory(correlation: float) -> None:
    runs = 20000
    errors = jax.jit(jax.vmap(lambda key: pose_errors(key, jnp.asarray(COV), count=6, correlation=correlation)))(
        jax.random.split(KEY, runs)
    )
    errors = np.asarray(errors)
    scale = np.sqrt(np.outer(np.diag(COV), np.diag(COV)))
    for lag in range(6):
        for k in (0, 5 - lag):
            product = np.einsum("ri,rj->ij", errors[:, k], errors[:, k + lag]) / runs
            off = np.abs(product - correlation**lag * COV) / scale
            assert off.max() < SIGMAS * np.sqrt(2 / runs)
    assert np.abs(errors.mean(0) / np.sqrt(np.diag(COV))).max() < SIGMAS / np.sqrt(runs)


def test_a_shared_error_is_one_and_the_same() -> None:
    errors = np.asarray(ERRORS(KEY, jnp.asarray(COV), count=50, correlation=1.0))
    np.testing.assert_allclose(errors, np.tile(errors[0], (50, 1)), rtol=1e-14)
    assert np.all(errors[0] != 0)


def test_a_component_may_be_known() -> None:
    errors = np.asarray(ERRORS(KEY, jnp.diag(jnp.array([0.01, 0.0, 0.04])), count=50))
    np.testing.assert_array_equal(errors[:, 1], 0)
    assert np.all(errors[:, [0, 2]] != 0)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_estimates_are_poses_of_the_core(dtype: Any) -> None:
    truth = DRIVE(PATH.astype(dtype), count=20)
    cov = jnp.asarray(COV, dtype)
    estimate = estimate_poses(KEY, truth, cov, correlation=0.5)
    assert (estimate.mean.dtype, estimate.cov.dtype) == (dtype, dtype)
    np.testing.assert_array_equal(estimate.cov, np.tile(np.asarray(cov), (20, 1, 1)))
    errors = np.asarray(ERRORS(KEY, cov, count=20, correlation=0.5))
    off = np.asarray(estimate.mean - truth) - errors
    off[:, 2] = np.sin(off[:, 2])
    np.testing.assert_allclose(off, 0, atol=1e-5 if dtype == jnp.float32 else 1e-12)
    steps = READ(KEY, truth, Odometry())
    assert steps.dtype == dtype
    assert dead_reckoning(truth[0], steps).dtype == dtype


def test_the_same_key_gives_the_same_and_another_key_another() -> None:
    poses = DRIVE(PATH, count=20)
    one, same, other = (READ(jax.random.key(k), poses, Odometry()) for k in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert np.all(one != other)
