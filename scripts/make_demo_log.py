"""Make the log that ships with the package: a simulated drive through a cluttered laboratory and its corridor.

The world is the kind that the paper's section 7 maps: walls, door openings, cupboards, desks, and thin legs and columns
that only circles can hold. Halfway a box is carried away and a door is opened, so that the map has something to
forget. The scanner is that of section 2: 180 degrees, a reading each 0.5 degree, up to 50 m.

The log is the same at every run, but for the last byte of rounding between machines.
"""

import argparse
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from linemap_jax.io.carmen_writer import write_carmen
from linemap_jax.lab.check import check
from linemap_jax.lab.generators import laboratory
from linemap_jax.lab.robot import Odometry, dead_reckoning
from linemap_jax.lab.scanners import Scanner, sweep
from linemap_jax.lab.simulate import Simulation, simulate

LOG = Path(__file__).resolve().parents[1] / "linemap_jax" / "io" / "data" / "demo.log.gz"

SEED = 1996
SCANS = 300
SCAN_SECONDS = 0.6  # the paper's scanner needs about 600 ms for a scan
RANGE_MAX = 50.0  # m
POSE_SIGMA = (0.01, 0.01, 0.00175)  # m, m, rad (0.1 degrees); independent from scan to scan


def simulated() -> Simulation:
    """The drive, with the box and the door changed at half of it."""
    world = laboratory(jax.random.key(SEED), scans=SCANS, jitter=0.0)
    log = simulate(
        jax.random.key(SEED),
        world,
        Scanner(
            bearings=sweep(-np.pi / 2, np.pi / 2, 361),
            range_sigma=0.015,
            bearing_sigma=0.0005,
            step=0.01,
            dropout=0.003,
            range_max=RANGE_MAX,
        ),
        count=SCANS,
        cov_pose=jnp.diag(jnp.array(POSE_SIGMA)) ** 2,
        odometry=Odometry(distance_scale=1.008, turn_scale=1.012),
    )
    check(world, log.true_poses, clearance=0.3)
    return log


def main() -> None:
    """Write the demo log and say what it holds."""
    parser = argparse.ArgumentParser(description="Make the demo log that ships with the package.")
    parser.add_argument("-o", "--output", type=Path, default=LOG, help="default: the package's own data")
    path: Path = parser.parse_args().output

    jax.config.update("jax_enable_x64", True)
    log = simulated()
    count, beams = log.scans.ranges.shape
    write_carmen(
        path,
        ranges=np.where(log.scans.valid, log.scans.ranges, np.nan),
        bearings=log.scans.bearings[0],
        range_max=RANGE_MAX,
        poses=log.poses.mean,
        odometry=dead_reckoning(log.true_poses[0], log.odometry),
        timestamps=SCAN_SECONDS * np.arange(count),
        comments=["simulated: a laboratory of 18 m x 12 m with a corridor; poses with sigma 1 cm and 0.1 degrees"],
        overwrite=True,
    )
    metres = np.hypot(*np.diff(np.asarray(log.true_poses)[:, :2], axis=0).T).sum()
    size = path.stat().st_size / 1000
    sys.stdout.write(f"{path}: {count} scans of {beams} beams along {metres:.0f} m, {size:.0f} kB\n")


if __name__ == "__main__":
    main()
