"""Noise comes back from simulated scans, and the likelihoods are those of dense linear algebra."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from linemap_jax import Capacity, SensorNoise
from linemap_jax.lab import calibration, generators
from linemap_jax.lab.calibration import Estimate, Innovations, Residuals
from linemap_jax.lab.scanners import pls, sweep
from linemap_jax.lab.simulate import Simulation, simulate

SCANS = 120
POSE_SIGMA = np.array([0.02, 0.03, 0.006])
SCANNER = dataclasses.replace(pls(), bearings=sweep(-np.pi / 2, np.pi / 2, 181), step=0.0, bearing_sigma=0.002)
CAPACITY = Capacity(16, 16)


@pytest.fixture(scope="module")
def drive() -> Simulation:
    world = generators.laboratory(jax.random.key(3), scans=SCANS)
    run = jax.jit(simulate, static_argnames="count")
    return run(jax.random.key(0), world, SCANNER, count=SCANS, cov_pose=jnp.diag(jnp.asarray(POSE_SIGMA) ** 2))


def assert_comes_back(estimate: Estimate, truth: np.ndarray) -> None:
    """Within 5 %, or three standard deviations where these are more."""
    error = np.abs(np.log(estimate.sigma[: len(truth)] / truth))
    deviation = np.log(estimate.interval[:, 1] / estimate.interval[:, 0])[: len(truth)] / (2 * 1.96)
    assert np.all(error < np.maximum(0.05, 3 * deviation)), (estimate, truth)
    assert np.all(deviation < 0.2)


def test_the_noise_of_the_sensor_comes_back(drive):
    # From a belief that is far off
    start = SensorNoise(range_sigma=0.03, bearing_sigma=0.0005)
    estimate = calibration.sensor_noise(drive.scans, start, capacity=CAPACITY)
    assert_comes_back(estimate, np.array([SCANNER.range_sigma, SCANNER.bearing_sigma], float))
    assert estimate.used > 20 * SCANS


def test_the_noise_of_the_poses_comes_back(drive):
    noise = SensorNoise(range_sigma=SCANNER.range_sigma, bearing_sigma=SCANNER.bearing_sigma)
    estimate = calibration.pose_noise(drive.scans, drive.poses.mean, noise, capacity=CAPACITY)
    assert_comes_back(estimate, POSE_SIGMA)
    assert np.all(estimate.sigma[3:] < 0.01)  # walls are straight there


def test_too_few_lines_are_said(drive):
    blind = dataclasses.replace(drive.scans, valid=jnp.zeros_like(drive.scans.valid))
    with pytest.raises(ValueError, match="only 0 beams lie inside of lines"):
        calibration.sensor_noise(blind, capacity=CAPACITY)
    with pytest.raises(ValueError, match="only 0 lines are seen by both scans"):
        calibration.pose_noise(blind, drive.poses.mean, SensorNoise(), capacity=CAPACITY)
    with pytest.raises(ValueError, match=f"a pair of scans is {SCANS} apart, and there are {SCANS} scans"):
        calibration.pose_noise(drive.scans, drive.poses.mean, SensorNoise(), lag=SCANS, capacity=CAPACITY)


def test_the_restricted_likelihood_is_that_of_contrasts():
    """Of the residuals' part that no line can explain, by a basis of it; the same but for a constant."""
    random = np.random.default_rng(0)
    sizes = (7, 5)
    line = np.concatenate([np.full(7, 0), np.full(2, -1), np.full(5, 2)])
    used = line >= 0
    by_line, along = random.standard_normal((len(line), 2)) * used[:, None], random.standard_normal(len(line)) * used
    sway = random.standard_normal(len(line)) * used
    residuals = Residuals(
        along=jnp.asarray(along), by_line=jnp.asarray(by_line), sway=jnp.asarray(sway), line=jnp.asarray(line)
    )

    def dense(log_sigma: np.ndarray) -> float:
        total = 0.0
        for slot, size in zip((0, 2), sizes, strict=True):
            mine = line == slot
            basis = np.linalg.svd(by_line[mine])[0][:, 2:]
            variance = np.exp(2 * log_sigma[0]) + np.exp(2 * log_sigma[1]) * sway[mine] ** 2
            cov = basis.T @ np.diag(variance) @ basis
            total += stats.multivariate_normal(np.zeros(size - 2), cov).logpdf(basis.T @ along[mine])
        return total

    points = [np.log([0.5, 0.7]), np.log([1.5, 0.2]), np.log([0.1, 1.0])]
    mine = [float(calibration.restricted_likelihood(jnp.asarray(x), residuals, 4)) for x in points]
    theirs = [dense(x) for x in points]
    np.testing.assert_allclose(np.diff(mine), np.diff(theirs), rtol=1e-10)


def test_the_likelihood_of_innovations_is_that_of_one_normal_vector():
    random = np.random.default_rng(1)
    half = random.standard_normal((3, 2, 2))
    cov = half @ np.swapaxes(half, 1, 2)
    first, second, change = (random.standard_normal(shape) for shape in ((3, 2, 3), (3, 2, 3), (3, 2)))
    valid = np.array([True, False, True])
    cov[1], first[1], second[1], change[1] = np.eye(2), 0, 0, 0
    arrays = {"change": change, "cov": cov, "by_first": first, "by_second": second, "valid": valid}
    innovations = Innovations(**jax.tree.map(jnp.asarray, arrays))

    def dense(log_sigma: np.ndarray) -> float:
        kept, pose, walls = [0, 2], np.diag(np.exp(2 * log_sigma[:3])), np.diag(np.exp(2 * log_sigma[3:]))
        a, b = (x[kept].reshape(4, 3) for x in (first, second))
        whole = a @ pose @ a.T + b @ pose @ b.T
        for i, k in enumerate(kept):
            whole[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += cov[k] + walls
        return stats.multivariate_normal(np.zeros(4), whole).logpdf(change[kept].ravel())

    points = [np.log([0.5, 0.7, 0.1, 0.3, 0.2]), np.log([1.5, 0.2, 0.4, 0.1, 0.6]), np.log([0.1, 1.0, 2.0, 1.0, 0.1])]
    mine = [float(calibration.innovation_likelihood(jnp.asarray(x), innovations)) for x in points]
    theirs = [dense(x) for x in points]
    np.testing.assert_allclose(np.diff(mine), np.diff(theirs), rtol=1e-9)
