"""Whether the covariances of `slam` hold: simulated drives of 100 m around a block, from raw odometry alone.

Usage: python scripts/measure_slam_consistency.py [--write] [--runs N]

Each run has a corridor of its own, with boxes along its walls, and a lap and two thirds to drive. The NEES of the pose
is taken at 25, 50, 75 and 100 m, that of the lines on one wall for each run. Then all of it once more with a scanner of
few beams, and with one that sweeps while the robot drives on and wheels that count wrong. With --write the table goes
into README.
"""

import argparse
import math
from functools import partial
from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
from readme import write_part

from linemap_jax.build import build
from linemap_jax.core.frames import wrap_angle
from linemap_jax.core.state import Lines, pad_stack
from linemap_jax.io.reading import Reading
from linemap_jax.io.scans import chunks_of_readings, with_drift
from linemap_jax.lab.consistency import Walls, line_error, nees
from linemap_jax.lab.generators import ring
from linemap_jax.lab.robot import Odometry, dead_reckoning, drive, read_odometry
from linemap_jax.lab.scanners import Scanner, noise_of, pls, simulate_scan, sweep
from linemap_jax.lab.simulate import Simulation, simulate
from linemap_jax.slam import CHUNK, Slam, Slammed, poses_for_map, slam

SCANS = 400
STEPS = 50
"""In which a robot with a slow scanner goes on from scan to scan."""
SWEEP = 10
"""Of these, how many a sweep takes: 5 cm, and up to 0.14 rad at a corner."""
POOR_WHEELS = Odometry(distance_scale=0.985, turn_scale=1.02)
"""Beside their noise."""
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
    rows = [row_of_names()]
    sparse = Scanner(bearings=sweep(-math.pi, math.pi, 361)[:-1], range_sigma=0.02, bearing_sigma=0.002, range_max=10.0)
    kinds = {
        "": partial(at_once, scanner=pls()),
        ", a beam a degree": partial(at_once, scanner=sparse),
        ", slow scanner and poor wheels": swept,
    }
    for what, of_run in kinds.items():
        poses, lines, errors = [], [], []
        for seed in range(options.runs):
            truth, found = of_run(jax.random.key(seed))
            of_poses, error = poses_of(truth, found)
            poses.append(of_poses)
            errors.append(error)
            lines.append(line_of(found, seed))
            print(f"run {seed}: NEES of the pose {np.round(of_poses, 1)}, of a line {lines[-1]:.1f}", flush=True)
        rows.append(rows_of(what, np.array(poses), np.array(lines), np.array(errors)))
    table = "\n".join(rows)
    print(table)
    if options.write:
        write_part("slam-consistency", table)


def at_once(key: jax.Array, scanner: Scanner) -> tuple[np.ndarray, Slammed]:
    """The true poses of a drive whose scans are each of one instant, and what was made of it."""
    drive = simulated(key, scanner)
    steps = jnp.asarray(drive.odometry, float)
    counted = dead_reckoning(jnp.asarray(drive.true_poses[0], float), steps)
    return np.asarray(drive.true_poses, float), slam(drive.scans, counted, noise=noise_of(scanner))


@jax.jit
def simulated(key: jax.Array, scanner: Scanner) -> Simulation:
    """One drive."""
    world = ring(jax.random.fold_in(key, 1), dtype=jnp.float32)
    return simulate(key, world, scanner, count=SCANS, cov_pose=jnp.zeros((3, 3), jnp.float32))


def swept(key: jax.Array) -> tuple[np.ndarray, Slammed]:
    """The same for a scanner that sweeps while the robot drives on, as `linemap slam` does it with a log."""
    truth, counted, scans = (np.asarray(x) for x in simulated_sweeps(key))
    bearings, noise = np.asarray(pls().bearings, float), noise_of(pls())
    readings = [
        Reading(
            timestamp=float(i),
            ranges=np.asarray(ranges, float),
            bearings=bearings,
            range_min=0.0,
            range_max=50.0,
            pose=poses[0],
            cov_pose=None,
            time_increment=SWEEP / STEPS / len(bearings),
            sweep_poses=poses[step_of_beam(len(bearings))],
            pose_frame="laser",
            odometry=None,
            mount=None,
            where="",
        )
        for i, (ranges, poses) in enumerate(zip(scans, counted, strict=True))
    ]
    state = Slam()
    for chunk in chunks_of_readings(readings, CHUNK, cov_pose=np.zeros((3, 3))):
        state.add(chunk.scans, chunk.poses.mean, chunk.last_beam)
    again = list(
        chunks_of_readings(with_drift(readings, state.drift(np.arange(SCANS))), SCANS, cov_pose=np.zeros((3, 3)))
    )
    state.see_again(0, again[0].scans)
    poses = poses_for_map(state.trajectory(), np.float32)
    line_map, _ = build(again[0].scans, poses, noise=noise, pose_error="unknown")
    line_map, cov_keyframes = state.adjust(line_map, noise=noise)
    found = state.trajectory()
    return truth, Slammed(line_map, found, state.cov_trajectory(cov_keyframes), state)


def step_of_beam(beams: int) -> np.ndarray:
    """In which step of the sweep each beam is measured."""
    return np.arange(beams) * SWEEP // beams


@jax.jit
def simulated_sweeps(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """True poses at the first beams `[T, 3]`, the counted ones in each sweep `[T, SWEEP, 3]`, ranges `[T, N]`."""
    world = ring(jax.random.fold_in(key, 1), dtype=jnp.float32)
    of_scans, of_wheels = jax.random.split(key)
    path = drive(world.path, count=SCANS * STEPS, turns="smooth")
    counted = dead_reckoning(path[0].astype(float), read_odometry(of_wheels, path, POOR_WHEELS).astype(float))
    beams = pls().bearings.shape[0]

    def measured(x: tuple[jax.Array, jax.Array]) -> jax.Array:
        of_step = jax.vmap(lambda key, pose: simulate_scan(key, world, pose, pls())[0])(*x)
        ranges = jnp.where(of_step.valid, of_step.ranges, jnp.inf)
        return ranges[step_of_beam(beams), jnp.arange(beams)]

    truth, counted = (x.reshape(SCANS, STEPS, 3)[:, :SWEEP] for x in (path, counted))
    keys = jax.random.split(of_scans, (SCANS, SWEEP))
    return truth[:, 0].astype(float), counted, jax.lax.map(measured, (keys, truth), batch_size=20)


def poses_of(truth: np.ndarray, found: Slammed) -> tuple[list[float], list[float]]:
    """NEES of the keyframes nearest to the places, and the errors there, m."""
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


def row_of_names() -> str:
    """In the form of README."""
    return "| what | mean NEES | 99 % band | inside 95 % | error, rms |\n| --- | ---: | ---: | ---: | ---: |"


def rows_of(of_what: str, poses: np.ndarray, lines: np.ndarray, errors: np.ndarray) -> str:
    """In the form of README."""
    rows = []
    low, high = band(len(poses), 3)
    for place, values, error in zip(PLACES, poses.T, errors.T, strict=True):
        mean, inside, rms = values.mean(), f"{(values < 7.815).mean():.0%}", 1e3 * math.sqrt((error**2).mean())
        name = f"pose after {place:.0f} m{of_what}"
        rows.append(f"| {name} | {mean:.2f} | {low:.2f} to {high:.2f} | {inside} | {rms:.1f} mm |")
    seen = lines[np.isfinite(lines)]
    low, high = band(len(seen), 2)
    mean, inside = seen.mean(), f"{(seen < 5.991).mean():.0%}"
    rows.append(f"| a wall{of_what}, {len(seen)} runs | {mean:.2f} | {low:.2f} to {high:.2f} | {inside} | |")
    return "\n".join(rows)


if __name__ == "__main__":
    main()
