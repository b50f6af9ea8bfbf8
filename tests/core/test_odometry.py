"""Steps by wheels and gyroscope: against NumPy, derivatives three ways, errors that do not depend on the step."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax.core import frames_on_host
from linemap_jax.core.estimation.odometry import (
    GyroscopeNoise,
    Increment,
    OdometryNoise,
    cov_step,
    increment_from_poses,
    increment_from_wheels,
    jac_step_errors,
    step_from_wheels,
    step_with_errors,
    with_gyroscope,
)
from linemap_jax.core.frames import between, compose, jac_compose_pose, jac_compose_step

NOISE = OdometryNoise()
COV_STEP = jax.jit(cov_step, static_argnames="jacobians")
JAC_POSE, JAC_STEP = jax.jit(jac_compose_pose), jax.jit(jac_compose_step)


def homogeneous(pose: Any) -> np.ndarray:
    x, y, theta = np.asarray(pose, float)
    return np.array([[np.cos(theta), -np.sin(theta), x], [np.sin(theta), np.cos(theta), y], [0, 0, 1]])


def test_compose_and_between_are_products_of_rigid_motions() -> None:
    random = np.random.default_rng(0)
    before, step = random.uniform(-3, 3, (2, 50, 3))
    after = np.asarray(jax.vmap(compose)(jnp.asarray(before), jnp.asarray(step)))
    for a, s, b in zip(before, step, after, strict=True):
        np.testing.assert_allclose(homogeneous(b), homogeneous(a) @ homogeneous(s), atol=1e-13)
    back = jax.vmap(between)(jnp.asarray(before), jnp.asarray(after))
    np.testing.assert_allclose(back, step, atol=1e-13)
    assert np.all(np.abs(after[:, 2]) <= np.pi)


def test_hand_derived_jacobians_of_steps() -> None:
    """Against autodiff; at two places against what is typed."""
    random = np.random.default_rng(1)
    poses, steps = jnp.asarray(random.uniform(-3, 3, (2, 20, 3)))
    by_pose, by_step = jax.jit(jax.vmap(jax.jacfwd(compose, (0, 1))))(poses, steps)
    np.testing.assert_allclose(jax.vmap(jac_compose_pose)(poses, steps), by_pose, atol=1e-14)
    np.testing.assert_allclose(jax.vmap(jac_compose_step)(poses, steps), by_step, atol=1e-14)
    by_errors = jax.jit(jax.vmap(jax.jacfwd(lambda e, s: step_with_errors(s, e))))(jnp.zeros((20, 3)), steps)
    np.testing.assert_allclose(jax.vmap(jac_step_errors)(steps), by_errors, atol=1e-14)

    # A step of 2 m ahead and 1 m to the left, from a robot that looks along y.
    north, step = jnp.array([5.0, 6.0, np.pi / 2]), jnp.array([2.0, 1.0, 0.3])
    np.testing.assert_allclose(JAC_POSE(north, step), [[1, 0, -2], [0, 1, -1], [0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(JAC_STEP(north, step), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)


@pytest.mark.parametrize("step", [(0.5, 0.1, 0.3), (-0.4, 0.0, 0.0), (0.0, 0.0, -0.7), (0.0, 0.0, 0.0)])
def test_both_jacobians_give_one_covariance(step: tuple[float, ...]) -> None:
    """Of a step that goes back or only turns too; a robot that stands does not err, and gradients stay finite."""
    at = jnp.asarray(step)
    hand, auto = (np.asarray(COV_STEP(at, NOISE, jacobians=how)) for how in ("analytic", "autodiff"))
    np.testing.assert_allclose(hand, auto, atol=1e-15)
    assert np.all(np.linalg.eigvalsh(hand) >= -1e-15)
    assert (np.abs(hand).max() > 0) == (np.abs(step).max() > 0)
    gradient = jax.jit(jax.grad(lambda s: jnp.sum(cov_step(s, NOISE))))(at)
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("turn", [0.0, 1.2])
def test_the_error_of_a_drive_does_not_depend_on_the_number_of_its_steps(turn: float) -> None:
    """Of a straight one exactly; of an arc as its steps become short."""

    def driven(count: int) -> np.ndarray:
        cov, whole = np.zeros((3, 3)), jnp.zeros(3)
        base = 0.5
        run = jnp.asarray([3.0 - base * turn / 2, 3.0 + base * turn / 2]) / count
        step = step_from_wheels(run[0], run[1], base)
        of_step = np.asarray(COV_STEP(step, NOISE))
        for _ in range(count):
            by_pose, by_step = np.asarray(JAC_POSE(whole, step)), np.asarray(JAC_STEP(whole, step))
            cov = by_pose @ cov @ by_pose.T + by_step @ of_step @ by_step.T
            whole = compose(whole, step)
        return cov

    few, many = driven(4 if turn else 1), driven(12)
    scale = np.sqrt(np.outer(np.diag(many), np.diag(many)))
    np.testing.assert_allclose(few / scale, many / scale, atol=1e-12 if turn == 0 else 0.02)


def test_errors_of_a_straight_metre_by_hand() -> None:
    noise = OdometryNoise(
        sigma_distance_distance=0.1, sigma_side_distance=0.2, sigma_turn_distance=0.3, sigma_turn_turn=9.0
    )
    across = 0.2**2 + 0.3**2 / 4 + 0.3**2 / 12  # a third in all, as of a random walk of the heading
    expected = [[0.1**2, 0, 0], [0, across, 0.3**2 / 2], [0, 0.3**2 / 2, 0.3**2]]
    np.testing.assert_allclose(COV_STEP(jnp.array([1.0, 0.0, 0.0]), noise), expected, rtol=1e-12)


def test_wheels_and_poses_tell_the_same_step() -> None:
    """A quarter of a circle of 1 m radius to the left, on wheels half a metre apart; and straight ahead."""
    quarter = np.pi / 2
    step = increment_from_wheels(jnp.asarray(0.75 * quarter), jnp.asarray(1.25 * quarter), 0.5, NOISE)
    np.testing.assert_allclose(step.mean, [1, 1, quarter], atol=1e-14)
    start = jnp.array([3.0, -2.0, 3.0])
    same = increment_from_poses(start, compose(start, step.mean), NOISE)
    np.testing.assert_allclose(same.mean, step.mean, atol=1e-14)
    np.testing.assert_allclose(same.cov, step.cov, atol=1e-14)
    ahead = increment_from_wheels(jnp.asarray(0.7), jnp.asarray(0.7), 0.5, NOISE)
    np.testing.assert_allclose(ahead.mean, [0.7, 0, 0], atol=1e-15)


def test_gyroscope_as_a_kalman_filter_in_numpy() -> None:
    step = increment_from_poses(jnp.zeros(3), jnp.array([0.8, 0.1, 3.1]), NOISE)
    gyroscope = GyroscopeNoise(sigma_rate=0.02, sigma_bias=0.01)
    # The same turn, told on the other side of the seam.
    better = with_gyroscope(step, jnp.asarray(3.2 - 2 * np.pi), jnp.asarray(2.0), gyroscope)
    cov, seen = np.asarray(step.cov), np.array([[0.0, 0.0, 1.0]])
    variance = 0.02**2 * 2 + (0.01 * 2) ** 2
    gain = cov @ seen.T / (cov[2, 2] + variance)
    np.testing.assert_allclose(better.mean, np.asarray(step.mean) + gain[:, 0] * 0.1, atol=1e-12)
    np.testing.assert_allclose(better.cov, cov - gain @ seen @ cov, atol=1e-15)


def test_float32_stays_float32_and_batches() -> None:
    steps = np.random.default_rng(2).uniform(-1, 1, (5, 3))
    many = jax.jit(jax.vmap(lambda s: increment_from_poses(jnp.zeros_like(s), s, NOISE)))
    single: Increment = many(jnp.asarray(steps, jnp.float32))
    assert single.mean.dtype == single.cov.dtype == jnp.float32
    double: Increment = many(jnp.asarray(steps))
    np.testing.assert_allclose(single.cov, double.cov, atol=1e-8)


@pytest.mark.parametrize("turn", [0.0, 1.0, np.pi, -np.pi, 3 * np.pi, 4.0])
def test_poses_on_the_host_are_those_of_jax(turn: float) -> None:
    pose, step = np.array([1.0, -2.0, 0.0]), np.array([0.5, 0.25, turn])
    after = compose(jnp.asarray(pose), jnp.asarray(step))
    np.testing.assert_allclose(frames_on_host.compose(pose, step), after, rtol=1e-15)
    np.testing.assert_allclose(
        frames_on_host.between(pose, pose + step), between(jnp.asarray(pose), jnp.asarray(pose + step)), rtol=1e-15
    )
