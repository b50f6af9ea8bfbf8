"""Make the log that ships with the package: a simulated drive through a cluttered laboratory and its corridor.

The world is the kind that the paper's section 7 maps: walls, door openings, cupboards, desks, and thin legs and columns
that only circles can hold. Halfway a box is carried away and a door is opened, so that the map has something to
forget. The scanner is that of section 2: 180 degrees, a reading each 0.5 degree, up to 50 m.

The log is the same at every run, but for the last byte of rounding between machines.
"""

import argparse
import gzip
import io
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from linemap_jax.lab.check import check
from linemap_jax.lab.generators import laboratory
from linemap_jax.lab.robot import Odometry, dead_reckoning
from linemap_jax.lab.scanners import Scanner, sweep
from linemap_jax.lab.simulate import Simulation, simulate

LOG = Path(__file__).resolve().parents[1] / "linemap_jax" / "io" / "data" / "demo.log.gz"

SEED = 1996
SCANS = 300
SCAN_SECONDS = 0.6  # the paper's scanner needs about 600 ms for a scan
NO_RETURN = 81.91  # m, what such scanners report
POSE_SIGMA = (0.01, 0.01, 0.00175)  # m, m, rad (0.1 degrees); independent from scan to scan


def simulated() -> Simulation:
    """The drive, with the box and the door changed at half of it."""
    world = laboratory(jax.random.key(SEED), jitter=0.0, change=SCANS // 2)
    log = simulate(
        jax.random.key(SEED),
        world,
        Scanner(
            bearings=sweep(-np.pi / 2, np.pi / 2, 361),
            range_sigma=0.015,
            bearing_sigma=0.0005,
            dropout=0.003,
            range_max=50.0,
        ),
        count=SCANS,
        cov_pose=jnp.diag(jnp.array(POSE_SIGMA)) ** 2,
        odometry=Odometry(distance_scale=1.008, turn_scale=1.012),
    )
    check(world, log.true_poses, clearance=0.3)
    return log


def carmen_log(log: Simulation) -> str:
    """The scans as the text of a CARMEN log."""
    lines = [
        "# message formats defined: PARAM FLASER",
        "# PARAM param_name param_value",
        "# FLASER num_readings [range_readings] x y theta odom_x odom_y odom_theta",
        "# simulated: a laboratory of 18 m x 12 m with a corridor; poses of the laser, sigma 1 cm and 0.1 degrees",
        "PARAM robot_use_laser on nohost 0",
        "PARAM robot_frontlaser_offset 0.0 nohost 0",
        "PARAM robot_rearlaser_offset 0.0 nohost 0",
        "PARAM laser_front_laser_resolution 0.5 nohost 0",
    ]
    ranges = np.where(log.scans.valid, log.scans.ranges, NO_RETURN)
    odometry = np.asarray(dead_reckoning(log.true_poses[0], log.odometry))
    for i, (scan, pose, odom) in enumerate(zip(ranges, np.asarray(log.poses.mean), odometry, strict=True)):
        readings = " ".join(f"{r:.2f}" for r in scan)
        stamp = f"{i * SCAN_SECONDS:.3f}"
        place = " ".join(f"{x:.4f} {y:.4f} {theta:.5f}" for x, y, theta in (pose, odom))
        lines.append(f"FLASER {len(scan)} {readings} {place} {stamp} nohost {stamp}")
    return "\n".join(lines) + "\n"


def packed(text: str) -> bytes:
    """The text under gzip, without a time or a name in the header, so that the bytes depend on the text alone."""
    out = io.BytesIO()
    with gzip.GzipFile(filename="", mode="wb", compresslevel=9, fileobj=out, mtime=0) as file:
        file.write(text.encode("ascii"))
    return out.getvalue()


def main() -> None:
    """Write the demo log and say what it holds."""
    parser = argparse.ArgumentParser(description="Make the demo log that ships with the package.")
    parser.add_argument("-o", "--output", type=Path, default=LOG, help="default: the package's own data")
    path: Path = parser.parse_args().output

    jax.config.update("jax_enable_x64", True)
    log = simulated()
    data = packed(carmen_log(log))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    metres = np.hypot(*np.diff(np.asarray(log.true_poses)[:, :2], axis=0).T).sum()
    count, beams = log.scans.ranges.shape
    sys.stdout.write(f"{path}: {count} scans of {beams} beams along {metres:.0f} m, {len(data) / 1000:.0f} kB\n")


if __name__ == "__main__":
    main()
