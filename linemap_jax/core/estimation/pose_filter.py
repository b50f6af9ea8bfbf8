"""Section 3: the pose of the robot by a Kalman filter, from its odometry and from beacons of known position.

The paper gives no equations for it and cites [11]; this is the extended Kalman filter for the pose (x, y, theta), whose
errors are additive in the axes of the world.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.estimation.odometry import Increment
from linemap_jax.core.frames import compose, dot, jac_compose_pose, jac_compose_step, perp, rotate, wrap_angle
from linemap_jax.core.propagation import apply, inverse, jacobian, product, propagate, quadratic, safe_sqrt
from linemap_jax.core.sensor import cov_measurement
from linemap_jax.core.settings import Jacobians, Mount, Number, SensorNoise
from linemap_jax.core.slots import least
from linemap_jax.core.state import Pose, pytree

GATE_2D = 9.21
"""99 % of chi-square with 2 degrees of freedom."""


@pytree
class Beacons:
    """Beacons in the world, and where they are."""

    position: Float[Array, "B 2"]
    """Places in the world, m."""
    valid: Bool[Array, " B"]
    """Which slots are in use."""


@pytree
class BeaconReadings:
    """What a sensor on the robot measured of beacons."""

    measurement: Float[Array, "R 2"]
    """Range and bearing, in the frame of the sensor; m, rad."""
    beacon: Int[Array, " R"]
    """Which beacon it is, -1 where that is not known."""
    valid: Bool[Array, " R"]
    """Which slots are in use."""


@pytree
class BeaconReport:
    """What became of each reading."""

    beacon: Int[Array, " R"]
    """Beacon that it was used for, -1 if it was not used."""
    nis: Float[Array, " R"]
    """Normalised innovation squared of the best candidate, before the gate; 0 for none."""
    dof: Int[Array, " R"]
    """Degrees of freedom: 2, or 0 where nothing was compared."""


def predict(pose: Pose, increment: Increment, *, jacobians: Jacobians = "analytic") -> Pose:
    """The pose after a step, whose error is independent of that of the pose.

    Args:
      pose: before the step.
      increment: the step, seen from that pose.
      jacobians: "autodiff" or "analytic".

    Returns:
      The pose after the step, with a larger covariance.
    """
    by_pose = jacobian(lambda x: compose(x, increment.mean), lambda x: jac_compose_pose(x, increment.mean), jacobians)
    by_step = jacobian(lambda x: compose(pose.mean, x), lambda x: jac_compose_step(pose.mean, x), jacobians)
    return Pose(
        mean=compose(pose.mean, increment.mean),
        cov=propagate(by_pose(pose.mean), pose.cov) + propagate(by_step(increment.mean), increment.cov),
    )


def beacon_from_pose(pose: Float[Array, "3"], beacon: Float[Array, "2"], mount: Float[Array, "3"]) -> Float[Array, "2"]:
    """Range and bearing of a beacon, as a sensor on the robot measures them.

    Args:
      pose: x, y, theta of the robot. m, m, rad.
      beacon: its position in the world, m.
      mount: x, y, theta of the sensor on the robot. m, m, rad.

    Returns:
      m, and rad in (-pi, pi]; at the beacon itself both are zero, with derivatives of zero.
    """
    ray = rotate(-pose[2], beacon - pose[:2]) - mount[:2]
    there = dot(ray, ray) > 0
    ray = jnp.where(there, ray, jnp.asarray([1.0, 0.0], ray.dtype))
    seen = jnp.stack([safe_sqrt(dot(ray, ray)), wrap_angle(jnp.arctan2(ray[1], ray[0]) - mount[2])])
    return jnp.where(there, seen, 0)


def jac_beacon_pose(
    pose: Float[Array, "3"], beacon: Float[Array, "2"], mount: Float[Array, "3"]
) -> Float[Array, "2 3"]:
    """The derivative of `beacon_from_pose` by the pose, derived by hand.

    With the ray from the sensor to the beacon, r its length and e its direction in the world: the range falls by e when
    the sensor moves, and the bearing by perp(e) / r; a turn of the robot moves the sensor by its turned mount.

    Args:
      pose: (x, y, theta) of the robot. m, m, rad. Shape `[3]`.
      beacon: its position in the world, m. Shape `[2]`.
      mount: (x, y, theta) of the sensor on the robot. m, m, rad. Shape `[3]`.

    Returns:
      d(range, bearing) / d(x, y, theta). Shape `[2, 3]`.
    """
    lever = rotate(pose[2], mount[:2])
    ray = beacon - pose[:2] - lever
    reach = safe_sqrt(dot(ray, ray))
    there = reach > 0
    scale = jnp.where(there, 1 / jnp.where(there, reach, 1), 0)
    towards = ray * scale
    across = perp(towards) * scale
    moved = perp(lever)
    return jnp.stack(
        [
            jnp.concatenate([-towards, -dot(towards, moved)[None]]),
            jnp.concatenate([-across, (-dot(across, moved) - jnp.where(there, 1, 0))[None]]),
        ]
    )


def update(
    pose: Pose, innovation: Float[Array, "2"], jac: Float[Array, "2 3"], cov: Float[Array, "2 2"]
) -> tuple[Pose, Float[Array, ""]]:
    """The pose after a measurement of two numbers, and its normalised innovation squared.

    Args:
      pose: before.
      innovation: measured minus predicted.
      jac: of the prediction, by the pose.
      cov: of the measurement; positive definite.

    Returns:
      The pose, its covariance in Joseph's form, which stays positive semidefinite under rounding; and the NIS.
    """
    information = inverse(propagate(jac, pose.cov) + cov)
    gain = product(product(pose.cov, jac.T), information)
    mean = pose.mean + apply(gain, innovation)
    kept = jnp.eye(3, dtype=mean.dtype) - product(gain, jac)
    after = Pose(
        mean=mean.at[2].set(wrap_angle(mean[2])),
        cov=propagate(kept, pose.cov) + propagate(gain, cov.astype(mean.dtype)),
    )
    return after, quadratic(innovation, information)


def update_by_beacons(
    pose: Pose,
    readings: BeaconReadings,
    beacons: Beacons,
    noise: SensorNoise,
    mount: Mount,
    *,
    gate: Number = GATE_2D,
    jacobians: Jacobians = "analytic",
) -> tuple[Pose, BeaconReport]:
    """The pose after all readings of beacons, one after the other.

    A reading that does not say which beacon it is of, is taken for the one of the least normalised distance. It is left
    out if a second one passes the gate too: a wrong beacon does more harm than one that is missed.

    Args:
      pose: before.
      readings: `R` of them.
      beacons: `B` of them.
      noise: of the sensor's ranges and bearings.
      mount: of the sensor on the robot.
      gate: largest normalised innovation squared of a reading that is used.
      jacobians: "autodiff" or "analytic".

    Returns:
      The pose after all of them, and which beacon each reading was used for.
    """
    dtype = pose.mean.dtype
    at = jnp.stack([jnp.asarray(mount.x), jnp.asarray(mount.y), jnp.asarray(mount.theta)]).astype(dtype)
    cov = cov_measurement(noise).astype(dtype)
    index = jnp.arange(beacons.valid.shape[0])

    def step(pose: Pose, x: tuple[Array, Array, Array]) -> tuple[Pose, tuple[Array, Array, Array]]:
        measurement, name, valid = x

        def compare(beacon: Float[Array, "2"]) -> tuple[Pose, Array]:
            change = measurement - beacon_from_pose(pose.mean, beacon, at)
            jac = jacobian(
                lambda p: beacon_from_pose(p, beacon, at), lambda p: jac_beacon_pose(p, beacon, at), jacobians
            )
            return update(pose, change.at[1].set(wrap_angle(change[1])), jac(pose.mean), cov)

        after, nis = jax.vmap(compare)(beacons.position)
        meant = valid & beacons.valid & ((name < 0) | (index == name))
        nis = jnp.where(meant, nis, jnp.inf)
        best, value = least(nis[None])
        alone = jnp.sum(nis < gate) == 1
        compared = jnp.isfinite(value[0])
        report = jnp.where(alone, best[0], -1), jnp.where(compared, value[0], 0), jnp.where(compared, 2, 0)
        return jax.tree.map(lambda a, b: jnp.where(alone, a[best[0]], b), after, pose), report

    pose, (used, nis, dof) = jax.lax.scan(step, pose, (readings.measurement, readings.beacon, readings.valid))
    return pose, BeaconReport(beacon=used.astype(jnp.int32), nis=nis, dof=dof.astype(jnp.int32))
