"""A whole simulated log: its parts agree with one another, and with the mapper."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from linemap_jax.core.frames import unit
from linemap_jax.core.settings import Mount
from linemap_jax.core.state import Pose, Scan
from linemap_jax.lab.generators import room
from linemap_jax.lab.raycast import cast
from linemap_jax.lab.robot import Odometry, dead_reckoning
from linemap_jax.lab.scanners import Scanner
from linemap_jax.lab.simulate import Simulation, simulate
from linemap_jax.lab.world import World, join, poles

COUNT = 12
COV = jnp.diag(jnp.array([0.02, 0.03, 0.01])) ** 2
BEARINGS = jnp.linspace(-2.0, 2.0, 61)
EXACT = Odometry(sigma_distance_distance=0, sigma_distance_turn=0, sigma_turn_distance=0, sigma_turn_turn=0)


WORLD = dataclasses.replace(
    join(room(6.0, 4.0, 0.2), poles(jnp.array([[1.0, 1.0]]), 0.2, appears=5)),
    path=jnp.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 0.0], [-1.0, 0.5]]),
)


def simulated(key: jax.Array, world: World) -> tuple[Simulation, Simulation]:
    noisy = Scanner(bearings=BEARINGS, range_sigma=0.02, bearing_sigma=0.001, beam_width=0.004)
    exact = simulate(key, world, Scanner(bearings=BEARINGS), count=COUNT, cov_pose=COV, odometry=EXACT, turns="spot")
    return exact, simulate(key, world, noisy, count=COUNT, cov_pose=COV, correlation=1.0, mount=Mount(x=0.2))


def test_the_parts_belong_together() -> None:
    exact, noisy = jax.jit(simulated)(jax.random.key(0), WORLD)
    for k in (0, COUNT // 2, COUNT - 1):
        pose = exact.true_poses[k]
        expected = cast(WORLD, pose[:2], unit(pose[2] + BEARINGS), scan_index=k)
        np.testing.assert_allclose(exact.scans.ranges[k], expected.ranges, rtol=1e-12)
        np.testing.assert_array_equal(exact.truth.thing[k], expected.thing)
    np.testing.assert_allclose(dead_reckoning(exact.true_poses[0], exact.odometry), exact.true_poses, atol=1e-12)

    assert isinstance(noisy.scans, Scan)
    assert isinstance(noisy.poses, Pose)
    assert noisy.scans.ranges.shape == (COUNT, 61)
    errors = np.array(noisy.poses.mean - noisy.true_poses)
    errors[:, 2] = np.sin(errors[:, 2])
    np.testing.assert_allclose(errors, np.broadcast_to(errors[0], errors.shape), atol=1e-7)  # one error for all
    assert np.all(np.abs(errors[0]) > 1e-6)
    assert np.all(np.abs(np.asarray(noisy.scans.ranges - noisy.truth.ranges)) < 0.02 * 6)
    of_pole = np.asarray(exact.truth.thing == 4).any(1)
    assert of_pole[5:].any()
    assert not of_pole[:5].any()
