"""Section 4.2: from a range measurement and a pose to a point with a covariance, Eqs. (2)-(4).

Points are held relative to the robot's position, in the axes of the world: coordinates of the world lose the scanner's
precision in float32 a few hundred metres from the origin.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.frames import perp, rotate, unit, wrap_angle
from linemap_jax.core.propagation import propagate
from linemap_jax.core.settings import Jacobians, Mount, SensorNoise
from linemap_jax.core.slots import computed_once, rank_of_true
from linemap_jax.core.state import Pose, Scan, pytree


@pytree
class Points:
    """The returns of a scan as points, without gaps, in the order of the sweep.

    Positions are relative to the robot's, in the axes of the world.
    """

    position: Float[Array, "N 2"]
    """Points in the axes of the world, from the robot's position, m."""
    beam: Float[Array, "N 2"]
    """Unit vector along the beam."""
    range: Float[Array, " N"]
    """Measured ranges, m."""
    turn: Float[Array, " N"]
    """Angle to the beam of the point before, 0 for the first, rad."""
    valid: Bool[Array, " N"]
    """True for the returns, which stand first."""
    index: Int[Array, " N"]
    """Beam of the scan, `N` where there is no return."""
    jac_pose: Float[Array, "N 2 3"]
    """F of Eq. (4), d(point) / d(pose)."""
    jac_measurement: Float[Array, "N 2 2"]
    """G of Eq. (4), with respect to (range, bearing)."""
    laser: Float[Array, "2"]
    """The scanner, from the robot's position, m."""
    spacing: Float[Array, ""]
    """Angle between neighbouring beams, rad."""

    def per_beam(self, value: Int[Array, " N"]) -> Int[Array, " N"]:
        """`value`, a number of each point, as one of each beam of the scan, -1 for beams without a return."""
        return jnp.full(value.shape, -1, value.dtype).at[self.index].set(value, mode="drop")


def point_from_measurement(
    pose: Float[Array, "3"], measurement: Float[Array, "2"], mount: Float[Array, "3"]
) -> Float[Array, "2"]:
    """The function f of Eq. (3): a measured point in the world.

    Eq. (2), with the turn of the scanner on the robot added to the bearing (the paper's scanner looks ahead).

    Args:
      pose: (x, y, theta) of the robot. m, m, rad.
      measurement: (range, bearing). m, rad.
      mount: (x, y, theta) of the scanner on the robot. m, m, rad.

    Returns:
      The point in the world, m. Shape `[2]`.
    """
    return pose[:2] + rotate(pose[2], mount[:2]) + measurement[0] * unit(pose[2] + mount[2] + measurement[1])


def jac_point_pose(
    pose: Float[Array, "3"], measurement: Float[Array, "2"], mount: Float[Array, "3"]
) -> Float[Array, "2 3"]:
    """F of Eq. (4), derived by hand: d(point) / d(x, y, theta).

    Args:
      pose: as in `point_from_measurement`.
      measurement: as there.
      mount: as there.

    Returns:
      Without unit, and m in the last column. Shape `[2, 3]`.
    """
    return _by_pose(point_from_measurement(pose, measurement, mount) - pose[:2])


def jac_point_measurement(
    pose: Float[Array, "3"], measurement: Float[Array, "2"], mount: Float[Array, "3"]
) -> Float[Array, "2 2"]:
    """G of Eq. (4), derived by hand: d(point) / d(range, bearing).

    Args:
      pose: as in `point_from_measurement`.
      measurement: as there.
      mount: as there.

    Returns:
      Without unit, and m in the last column. Shape `[2, 2]`.
    """
    return _by_measurement(measurement[0], unit(pose[2] + mount[2] + measurement[1]))


def _by_pose(position: Float[Array, "*s 2"]) -> Float[Array, "*s 2 3"]:
    """d(point) / d(x, y, theta): a point moves with the robot and turns about it."""
    identity = jnp.broadcast_to(jnp.eye(2, dtype=position.dtype), (*position.shape, 2))
    return jnp.concatenate([identity, perp(position)[..., None]], -1)


def _by_measurement(range_: Float[Array, "*s"], beam: Float[Array, "*s 2"]) -> Float[Array, "*s 2 2"]:
    """d(point) / d(range, bearing): along the beam, and across it as far as the range is long."""
    return jnp.stack([beam, range_[..., None] * perp(beam)], -1)


def cov_measurement(noise: SensorNoise) -> Float[Array, "2 2"]:
    """C_s of Eq. (4), from the `noise` of the sensor: range and bearing are not correlated. m^2, rad^2."""
    return jnp.diag(jnp.stack([jnp.asarray(noise.range_sigma), jnp.asarray(noise.bearing_sigma)]) ** 2)


def cov_point(
    jac_pose: Float[Array, "*s 2 3"],
    jac_measurement: Float[Array, "*s 2 2"],
    cov_pose: Float[Array, "3 3"],
    noise: SensorNoise,
) -> Float[Array, "*s 2 2"]:
    """C_p of Eq. (4). It holds the pose error that all points of the scan share.

    Args:
      jac_pose: F of each point. Shape `[*s, 2, 3]`.
      jac_measurement: G of each point. Shape `[*s, 2, 2]`.
      cov_pose: of (x, y, theta): m^2, m rad, rad^2. Shape `[3, 3]`.
      noise: of the sensor, m and rad.

    Returns:
      Of (x, y) of each point, m^2. Shape `[*s, 2, 2]`.
    """
    return propagate(jac_pose, cov_pose) + propagate(jac_measurement, cov_measurement(noise))


def points_from_scan(scan: Scan, pose: Pose, mount: Mount, *, jacobians: Jacobians) -> Points:
    """The returns of a scan as points, with F and G of Eq. (4).

    Args:
      scan: `N` beams.
      pose: of the robot, in the world.
      mount: of the scanner, on the robot.
      jacobians: "autodiff" or "analytic".

    Returns:
      `N` points; those that are not valid stand last.

    Raises:
      ValueError: at trace time, for `jacobians` that do not exist.
    """
    # The position of the robot is left out: it adds nothing to the derivatives, and takes digits from the points.
    here = pose.mean.at[:2].set(0)
    at = jnp.stack([jnp.asarray(mount.x), jnp.asarray(mount.y), jnp.asarray(mount.theta)]).astype(here.dtype)

    n = scan.ranges.shape[0]
    order = _in_order(scan)
    valid = order < n

    def of_beam(index: Int[Array, " M"]) -> tuple[Array, Array, Array]:
        range_, bearing = (jnp.where(index < n, x[index], 0) for x in (scan.ranges, scan.bearings))
        return range_, bearing, unit(here[2] + at[2] + bearing)

    range_, bearing, beam = computed_once(of_beam, order)
    laser = rotate(here[2], at[:2])
    position = laser[None] + range_[:, None] * beam
    if jacobians == "analytic":
        # As `jac_point_pose` and `jac_point_measurement`, with the beams as they are known already.
        jac_pose, jac_measurement = _by_pose(position), _by_measurement(range_, beam)
    elif jacobians == "autodiff":
        measurement = jnp.stack([range_, bearing], -1)
        jac_pose, jac_measurement = jax.vmap(jax.jacfwd(point_from_measurement, (0, 1)), (None, 0, None))(
            here, measurement, at
        )
    else:
        raise ValueError(f"jacobians must be 'autodiff' or 'analytic', not {jacobians!r}")
    return Points(
        position=position,
        beam=beam,
        range=range_,
        turn=jnp.abs(wrap_angle(bearing - jnp.concatenate([bearing[:1], bearing[:-1]]))),
        valid=valid,
        index=order,
        jac_pose=jac_pose,
        jac_measurement=jac_measurement,
        laser=laser,
        spacing=scan.spacing,
    )


def _in_order(scan: Scan) -> Int[Array, " N"]:
    """The beams that returned, from the first one of the sweep on, counter-clockwise; `N` where there are no more.

    So a line begins at its right end, as the scanner sees it, and its normal points away from there.
    """
    n = scan.valid.shape[0]
    both = scan.valid[1:] & scan.valid[:-1]
    falling = jnp.sum(jnp.where(both, jnp.sign(wrap_angle(jnp.diff(scan.bearings))), 0)) < 0
    rank, count = rank_of_true(scan.valid), jnp.sum(scan.valid, dtype=jnp.int32)
    rank = rank - rank[scan.first]
    rank = jnp.where(rank < 0, rank + count, rank)
    place = jnp.where(scan.valid, jnp.where(falling, count - 1 - rank, rank), n)
    return jnp.full(n, n, jnp.int32).at[place].set(jnp.arange(n, dtype=jnp.int32), mode="drop")
