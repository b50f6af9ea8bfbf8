"""A whole log, simulated: the drive, the scans, what the wheels count, and what the robot believes."""

from typing import Literal

import jax
from jaxtyping import Array, Float

from linemap_jax.core.settings import Mount, Number
from linemap_jax.core.state import Pose, Scan, pytree
from linemap_jax.lab.robot import Odometry, drive, estimate_poses, read_odometry
from linemap_jax.lab.scanners import Scanner, Truth, simulate_scans
from linemap_jax.lab.world import World


@pytree
class Simulation:
    """A simulated log, with the truth beside it. Arrays are stacked over the `T` scans."""

    scans: Scan
    """What the scanner tells, `T` scans stacked."""
    poses: Pose
    """Poses as the robot believes them."""
    odometry: Float[Array, "S 3"]
    """`S = T - 1` increments as counted: x ahead, y to the left, turn. m, m, rad."""
    true_poses: Float[Array, "T 3"]
    """x, y, theta of the robot in truth. m, m, rad."""
    truth: Truth
    """What the beams really did."""


def simulate(
    key: Array,
    world: World,
    scanner: Scanner,
    *,
    count: int,
    cov_pose: Float[Array, "3 3"],
    correlation: Number = 0.0,
    odometry: Odometry | None = None,
    mount: Mount | None = None,
    turns: Literal["spot", "smooth"] = "smooth",
) -> Simulation:
    """A drive along the path of a world.

    Args:
      key: of all noise.
      world: with a path of one way point at least.
      scanner: the instrument.
      count: number of scans.
      cov_pose: covariance of each believed pose, in the axes of the world. m^2, m rad, rad^2.
      correlation: of the pose error, from one scan to the next; see `robot.pose_errors`.
      odometry: how well the wheels count.
      mount: of the scanner on the robot.
      turns: how the robot drives; see `robot.drive`.

    Returns:
      What a log would hold, and the truth.
    """
    of_scans, of_poses, of_odometry = jax.random.split(key, 3)
    true_poses = drive(world.path, count=count, turns=turns)
    scans, truth = simulate_scans(of_scans, world, true_poses, scanner, mount)
    return Simulation(
        scans=scans,
        poses=estimate_poses(of_poses, true_poses, cov_pose, correlation=correlation),
        odometry=read_odometry(of_odometry, true_poses, odometry or Odometry()),
        true_poses=true_poses,
        truth=truth,
    )
