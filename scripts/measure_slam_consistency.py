"""Whether the covariances of `slam` hold: simulated drives of 100 m around a block, from raw odometry alone.

Usage: python scripts/measure_slam_consistency.py [--write] [--runs N]

Each run has a corridor of its own, with boxes along its walls, and a lap and two thirds to drive. The NEES of the pose
is taken at 25, 50, 75 and 100 m, that of the lines on one wall for each run. With --write the table goes into README.
"""

import argparse
import math
from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
from readme import write_part

from linemap_jax.core.frames import compose, wrap_angle
from linemap_jax.core.state import Lines, pad_stack
from linemap_jax.lab.consistency import Walls, line_error, nees
from linemap_jax.lab.generators import ring
from linemap_jax.lab.scanners import noise_of, pls
from linemap_jax.lab.simulate import Simulation, simulate
from linemap_jax.slam import Slammed, slam

SCANS = 400
PLACES = (25.0, 50.0, 75.0, 100.0)
WALLS = Walls(
    point=jnp.asarray(
        [[0.0, 7.0], [0.0, -7.0], [12.0, 0.0], [-12.0, 0.0], [0.0, 3.0], [0.0, -3.0], [8.0, 0], [-8.0, 0]]
    ),
    angle=jnp.asarray([math.pi / 2, math.pi / 2, 0.0, 0.0, math.pi / 2, math.pi / 2, 0.0, 0.0]),
)
"""Of the corridor and its block."""


def main() -> None:
    """Drive, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)  # for the NEES
    poses, lines, errors = [], [], []
    for seed in range(options.runs):
        drive = simulated(jax.random.key(seed))
        found = slam(drive.scans, counted(drive), noise=noise_of(pls()))
        of_poses, error = poses_of(drive, found)
        poses.append(of_poses)
        errors.append(error)
        lines.append(line_of(found, seed))
        print(f"run {seed}: NEES of the pose {np.round(of_poses, 1)}, of a line {lines[-1]:.1f}", flush=True)
    table = table_of(np.array(poses), np.array(lines), np.array(errors))
    print(table)
    if options.write:
        write_part("slam-consistency", table)


@jax.jit
def simulated(key: jax.Array) -> Simulation:
    """One drive."""
    world = ring(jax.random.fold_in(key, 1), dtype=jnp.float32)
    return simulate(key, world, pls(), count=SCANS, cov_pose=jnp.zeros((3, 3), jnp.float32))


def counted(drive: Simulation) -> np.ndarray:
    """Where the wheels say that the robot is."""

    def step(pose: jax.Array, increment: jax.Array) -> tuple[jax.Array, jax.Array]:
        pose = compose(pose, increment)
        return pose, pose

    first = jnp.asarray(drive.true_poses[0], float)
    return np.concatenate([first[None], jax.lax.scan(step, first, jnp.asarray(drive.odometry, float))[1]])


def poses_of(drive: Simulation, found: Slammed) -> tuple[list[float], list[float]]:
    """NEES of the keyframes nearest to the places, and the errors there, m."""
    truth = np.asarray(drive.true_poses, float)
    driven = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    at = [
        found.state.scan_of_keyframe[np.argmin(abs(driven[found.state.scan_of_keyframe] - place))] for place in PLACES
    ]
    off = found.trajectory[at] - truth[at]
    off[:, 2] = wrap_angle(jnp.asarray(off[:, 2]))
    values = nees(jnp.asarray(off), jnp.asarray(found.cov[at]))
    return np.asarray(values).tolist(), np.hypot(off[:, 0], off[:, 1]).tolist()


def line_of(found: Slammed, run: int) -> float:
    """NEES of the longest line of the map on one of the walls; NaN if there is none."""
    lines = jax.tree.map(lambda x: jnp.asarray(x, float) if x.dtype.kind == "f" else x, found.line_map.lines)
    wall = jax.tree.map(lambda x: x[run % len(WALLS.angle)], WALLS)
    lines = pad_stack(lines, lines.offset.shape[0])
    off = np.asarray(error_of(lines, wall))
    on_wall = np.asarray(lines.valid) & (abs(off[:, 0]) < 0.15) & (abs(off[:, 1]) < 0.05)
    best = np.argmax(np.where(on_wall, np.asarray(lines.length), 0))
    return float(nees(jnp.asarray(off), lines.cov)[best]) if on_wall.any() else math.nan


def error_of(lines: Lines, wall: Walls) -> jax.Array:
    """Of all lines against one wall."""
    return jax.vmap(line_error, (0, None))(lines, wall)


def band(runs: int, dof: int) -> tuple[float, float]:
    """The 99 % band of the mean NEES, by the approximation of Wilson and Hilferty."""
    of_sum = dof * runs
    quantiles = (NormalDist().inv_cdf(p) for p in (0.005, 0.995))
    low, high = (of_sum * (1 - 2 / (9 * of_sum) + z * math.sqrt(2 / (9 * of_sum))) ** 3 / runs for z in quantiles)
    return low, high


def table_of(poses: np.ndarray, lines: np.ndarray, errors: np.ndarray) -> str:
    """In the form of README."""
    rows = ["| what | mean NEES | 99 % band | inside 95 % | error, rms |", "| --- | ---: | ---: | ---: | ---: |"]
    low, high = band(len(poses), 3)
    for place, values, error in zip(PLACES, poses.T, errors.T, strict=True):
        inside = f"{(values < 7.815).mean():.0%}"
        rms = f"{1e3 * math.sqrt((error**2).mean()):.1f} mm"
        rows.append(f"| pose after {place:.0f} m | {values.mean():.2f} | {low:.2f} to {high:.2f} | {inside} | {rms} |")
    seen = lines[np.isfinite(lines)]
    low, high = band(len(seen), 2)
    rows.append(
        f"| a wall, {len(seen)} runs | {seen.mean():.2f} | {low:.2f} to {high:.2f} | {(seen < 5.991).mean():.0%} | |"
    )
    return "\n".join(rows)


if __name__ == "__main__":
    main()
