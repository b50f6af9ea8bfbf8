"""The pose filter against NumPy, derivatives three ways, and what its gates let through."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from linemap_jax.core.estimation.odometry import Increment
from linemap_jax.core.estimation.pose_filter import (
    BeaconReadings,
    Beacons,
    beacon_from_pose,
    jac_beacon_pose,
    predict,
    update_by_beacons,
)
from linemap_jax.core.settings import Mount, SensorNoise
from linemap_jax.core.state import Pose

POSE = Pose(mean=jnp.array([1.0, -2.0, 3.0]), cov=jnp.diag(jnp.array([0.2, 0.1, 0.05])) ** 2)
MOUNT = Mount(x=0.3, y=-0.1, theta=0.4)
AT = np.array([0.3, -0.1, 0.4])
NOISE = SensorNoise(range_sigma=0.05, bearing_sigma=0.01)
POSITIONS = np.array([[4.0, 1.0], [-3.0, -2.5], [-3.0, -2.2], [0.0, 0.0]])
UPDATE = jax.jit(update_by_beacons, static_argnames="jacobians")


def measured(pose: Any, beacon: np.ndarray) -> np.ndarray:
    """Range and bearing, by complex numbers."""
    x, y, theta = np.asarray(pose)
    sensor = complex(x, y) + complex(*AT[:2]) * np.exp(1j * theta)
    ray = (complex(*beacon) - sensor) * np.exp(-1j * (theta + AT[2]))
    return np.array([abs(ray), np.angle(ray)])


def central(pose: np.ndarray, beacon: np.ndarray) -> np.ndarray:
    step = 1e-6
    change = np.stack([measured(pose + d, beacon) - measured(pose - d, beacon) for d in step * np.eye(3)], -1)
    change[1] = (change[1] + np.pi) % (2 * np.pi) - np.pi
    return change / (2 * step)


def test_what_is_measured_of_a_beacon_and_its_derivative() -> None:
    random = np.random.default_rng(0)
    poses, beacons = random.uniform(-3, 3, (20, 3)), random.uniform(-5, 5, (20, 2))
    seen = jax.vmap(beacon_from_pose, (0, 0, None))(jnp.asarray(poses), jnp.asarray(beacons), jnp.asarray(AT))
    by_hand = jax.vmap(jac_beacon_pose, (0, 0, None))(jnp.asarray(poses), jnp.asarray(beacons), jnp.asarray(AT))
    by_jax = jax.vmap(jax.jacrev(beacon_from_pose), (0, 0, None))(
        jnp.asarray(poses), jnp.asarray(beacons), jnp.asarray(AT)
    )
    np.testing.assert_allclose(by_hand, by_jax, atol=1e-13)
    for pose, beacon, found, jac in zip(poses, beacons, seen, by_hand, strict=True):
        np.testing.assert_allclose(found, measured(pose, beacon), atol=1e-12)
        np.testing.assert_allclose(jac, central(pose, beacon), atol=1e-8)


def test_at_the_beacon_itself_nothing_is_infinite() -> None:
    place = jnp.array([1.0, 2.0])
    at = jnp.array([1.0, 2.0, 0.5])
    np.testing.assert_array_equal(beacon_from_pose(at, place, jnp.zeros(3)), 0)
    np.testing.assert_array_equal(jac_beacon_pose(at, place, jnp.zeros(3)), 0)
    np.testing.assert_array_equal(jax.jit(jax.jacrev(beacon_from_pose))(at, place, jnp.zeros(3)), 0)


def test_a_prediction_by_both_jacobians() -> None:
    step = Increment(mean=jnp.array([0.5, 0.1, 0.3]), cov=jnp.diag(jnp.array([1e-3, 2e-3, 3e-3])))
    hand, auto = (predict(POSE, step, jacobians=how) for how in ("analytic", "autodiff"))
    np.testing.assert_allclose(hand.mean, auto.mean, atol=1e-15)
    np.testing.assert_allclose(hand.cov, auto.cov, atol=1e-16)
    # Once more by hand: what the heading does to the step, and the step's own error, turned.
    c, s = np.cos(3.0), np.sin(3.0)
    f = np.array([[1, 0, -(0.5 * s + 0.1 * c)], [0, 1, 0.5 * c - 0.1 * s], [0, 0, 1]])
    g = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    expected = f @ np.asarray(POSE.cov) @ f.T + g @ np.asarray(step.cov) @ g.T
    np.testing.assert_allclose(hand.cov, expected, atol=1e-15)


def readings(truth: np.ndarray, which: list[int], *, names: list[int], off: float = 0.0) -> BeaconReadings:
    seen = np.stack([measured(truth, POSITIONS[i]) for i in which])
    seen[:, 0] += off
    return BeaconReadings(
        measurement=jnp.asarray(seen), beacon=jnp.asarray(names, jnp.int32), valid=jnp.ones(len(which), bool)
    )


BEACONS = Beacons(position=jnp.asarray(POSITIONS), valid=jnp.array([True, True, True, False]))
TRUTH = np.array([1.1, -2.1, 3.03])


def test_an_update_is_that_of_a_kalman_filter_in_numpy() -> None:
    after, report = UPDATE(POSE, readings(TRUTH, [0, 1], names=[0, 1]), BEACONS, NOISE, MOUNT)
    mean, cov, r = np.asarray(POSE.mean), np.asarray(POSE.cov), np.diag([0.05, 0.01]) ** 2
    for i, nis in zip((0, 1), report.nis, strict=True):
        h = central(mean, POSITIONS[i])
        change = measured(TRUTH, POSITIONS[i]) - measured(mean, POSITIONS[i])
        change[1] = (change[1] + np.pi) % (2 * np.pi) - np.pi
        s = h @ cov @ h.T + r
        np.testing.assert_allclose(nis, change @ np.linalg.solve(s, change), rtol=1e-6)
        gain = cov @ h.T @ np.linalg.inv(s)
        mean, cov = mean + gain @ change, cov - gain @ h @ cov
    np.testing.assert_allclose(after.mean[:2], mean[:2], atol=1e-7)
    np.testing.assert_allclose(np.exp(1j * after.mean[2]), np.exp(1j * mean[2]), atol=1e-7)
    np.testing.assert_allclose(after.cov, cov, atol=1e-9)
    auto, _ = UPDATE(POSE, readings(TRUTH, [0, 1], names=[0, 1]), BEACONS, NOISE, MOUNT, jacobians="autodiff")
    np.testing.assert_allclose(auto.cov, after.cov, atol=1e-15)


def test_which_readings_are_used() -> None:
    # Told by nobody: the lone beacon is found, one of two neighbours is not chosen, one that is not valid is not there.
    _, told = UPDATE(POSE, readings(TRUTH, [0, 1, 3], names=[-1, -1, -1]), BEACONS, NOISE, MOUNT)
    np.testing.assert_array_equal(told.beacon, [0, -1, -1])
    np.testing.assert_array_equal(told.dof, [2, 2, 2])
    # 2 m too far: turned away by the gate, and the pose stays.
    after, told = UPDATE(POSE, readings(TRUTH, [0], names=[0], off=2.0), BEACONS, NOISE, MOUNT)
    assert told.beacon[0] == -1
    assert told.nis[0] > 9.21
    np.testing.assert_array_equal(after.mean, POSE.mean)
    # One that is not valid says nothing, whatever it holds.
    nonsense = readings(TRUTH, [0], names=[0])
    nonsense = BeaconReadings(measurement=jnp.full((1, 2), jnp.nan), beacon=nonsense.beacon, valid=jnp.zeros(1, bool))
    after, told = UPDATE(POSE, nonsense, BEACONS, NOISE, MOUNT)
    np.testing.assert_array_equal(after.cov, POSE.cov)
    assert told.dof[0] == 0


def test_the_filter_knows_how_good_it_is() -> None:
    """2000 robots that drive 10 steps past beacons: the mean NEES of the pose is that of 3 degrees of freedom."""
    runs, steps = 2000, 10
    random = np.random.default_rng(7)
    cov_step = np.diag([0.02, 0.01, 0.01]) ** 2
    truth = np.asarray(POSE.mean) + random.standard_normal((runs, 3)) * np.sqrt(np.diag(np.asarray(POSE.cov)))
    pose = Pose(mean=jnp.tile(POSE.mean, (runs, 1)), cov=jnp.tile(POSE.cov, (runs, 1, 1)))

    @jax.jit
    @jax.vmap
    def look(pose: Pose, move: Any, seen: Any) -> Pose:
        pose = predict(pose, Increment(mean=move, cov=jnp.asarray(cov_step)))
        told = BeaconReadings(measurement=seen, beacon=jnp.arange(2), valid=jnp.ones(2, bool))
        return update_by_beacons(pose, told, BEACONS, NOISE, MOUNT, gate=jnp.inf)[0]

    for _ in range(steps):
        move = np.tile([0.2, 0.0, 0.1], (runs, 1))
        real = move + random.standard_normal((runs, 3)) * np.sqrt(np.diag(cov_step))
        c, s = np.cos(truth[:, 2]), np.sin(truth[:, 2])
        turned = [c * real[:, 0] - s * real[:, 1], s * real[:, 0] + c * real[:, 1], real[:, 2]]
        truth = truth + np.stack(turned, -1)
        seen = np.stack([[measured(t, POSITIONS[i]) for i in (0, 1)] for t in truth])
        seen += random.standard_normal(seen.shape) * [0.05, 0.01]
        pose = look(pose, jnp.asarray(move), jnp.asarray(seen))
    error = np.asarray(pose.mean) - truth
    error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
    nees = np.mean(np.einsum("ti,tij,tj->t", error, np.linalg.inv(np.asarray(pose.cov)), error))
    # Six sigma of the mean of chi-square, and what the first order leaves out.
    assert abs(nees - 3) < 6 * np.sqrt(6 / runs)
