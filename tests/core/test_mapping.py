"""Maps of a whole scene: what a scan has seen to be two lines stays two lines."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax import Capacity, LineMap, Pose, Report, Scan, SensorNoise, empty_map, update
from linemap_jax.core.settings import PoseError

BEARINGS = np.radians(np.arange(-60, 60.25, 0.5))
NOISE = SensorNoise(range_sigma=0.005, bearing_sigma=0.0005)
SIGMAS = np.array([0.05, 0.05, 0.01])
COV_POSE = np.diag(SIGMAS) ** 2
STEP = 0.1
"""m, between the two walls."""


def two_walls(pose: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Ranges to a wall at x = 3 for y > 0 and at x = 3.1 for y < 0."""
    angle = BEARINGS + pose[2]
    near, far = (3 - pose[0]) / np.cos(angle), (3 + STEP - pose[0]) / np.cos(angle)
    ranges = np.where(pose[1] + near * np.sin(angle) > 0, near, far)
    return ranges + float(NOISE.range_sigma) * random.standard_normal(len(BEARINGS))


def drive(errors: np.ndarray) -> tuple[Scan, Pose]:
    """Scans along the walls; the poses that are told differ from the true ones by the errors, [T, 3]."""
    random = np.random.default_rng(1)
    t = np.linspace(-1, 1, len(errors))
    true = np.stack([0.3 * np.cos(3 * t), 0.5 * t, 0.2 * t], -1)
    scans = [Scan.from_ranges(two_walls(pose, random), BEARINGS) for pose in true]
    cov = np.broadcast_to(COV_POSE, (len(errors), 3, 3))
    return jax.tree.map(lambda *x: jnp.stack(x), *scans), Pose(mean=jnp.asarray(true + errors), cov=jnp.asarray(cov))


@partial(jax.jit, static_argnames="pose_error")
def maps_of(line_map: LineMap, scans: Scan, poses: Pose, pose_error: PoseError) -> tuple[LineMap, Report]:
    """The map after each scan, and the reports."""

    def step(line_map: LineMap, x: tuple[Scan, Pose]) -> Any:
        line_map, report = update(line_map, *x, noise=NOISE, capacity=Capacity(8, 8), pose_error=pose_error)
        return line_map, (line_map, report)

    return jax.lax.scan(step, line_map, (scans, poses))[1]


@pytest.mark.parametrize(
    ("pose_error", "persists"),
    [("independent", True), ("persistent", True), ("unknown", True), ("independent", False), ("unknown", False)],
)
def test_two_walls_seen_side_by_side_stay_two(pose_error: PoseError, persists: bool) -> None:
    """Though the pose may be off by more than half of what lies between them."""
    random = np.random.default_rng(2)
    # An error that is new in each scan moves the scan against the map. Of two lines that are as near to one of the map
    # as the map's other one, no rule knows which is which: it stays below half of what lies between them.
    errors = np.tile(SIGMAS, (30, 1)) if persists else 0.3 * SIGMAS * random.standard_normal((30, 3))
    maps, reports = maps_of(empty_map(Capacity(16, 8)), *drive(errors), pose_error)
    assert np.all(np.sum(maps.lines.valid, 1) == 2)
    assert not reports.merged.any()
    assert reports.fused.sum() == 2 * 29
    keep = np.asarray(maps.lines.valid[-1])
    middle = (np.asarray(maps.lines.begin[-1]) + np.asarray(maps.lines.end[-1]))[keep] / 2
    low, high = middle[np.argsort(middle[:, 1])]
    # The pose error moves both walls; their distance is that of the scene.
    turn = np.asarray(maps.lines.angle[-1])[keep][0]
    distance = (low - high) @ [np.cos(turn), np.sin(turn)]
    np.testing.assert_allclose(abs(distance), STEP, atol=0.015)


def test_both_faces_of_a_partition_are_held_whatever_the_sweep() -> None:
    """A wall 4 cm thick that the robot sees from both sides, by turns, with a scanner of either direction."""
    random = np.random.default_rng(4)
    scans, poses = [], []
    for k in range(12):
        front, y = k % 2 == 0, random.uniform(-1, 1)
        pose = np.array([0.0, y, 0.0] if front else [4.0, y, np.pi])
        ranges = 1.98 / np.cos(BEARINGS) + float(NOISE.range_sigma) * random.standard_normal(len(BEARINGS))
        order = slice(None, None, -1 if k % 4 > 1 else 1)
        scans.append(Scan.from_ranges(ranges[order], BEARINGS[order]))
        poses.append(pose)
    at = Pose(mean=jnp.asarray(np.array(poses)), cov=jnp.asarray(np.tile(COV_POSE, (12, 1, 1))))
    line_map = empty_map(Capacity(16, 8))
    for k in range(12):
        here = jax.tree.map(lambda x, k=k: x[k], at)
        line_map, report = ONE(line_map, scans[k], here)
        assert int(report.fused) == (k > 1)
    lines = jax.tree.map(lambda x: np.asarray(x)[np.asarray(line_map.lines.valid)], line_map.lines)
    assert lines.times_detected.tolist() == [6, 6]
    np.testing.assert_allclose(lines.normal[:, 0], [1, -1], atol=0.01)
    np.testing.assert_allclose(lines.anchor[:, 0] + lines.offset * lines.normal[:, 0], [1.98, 2.02], atol=0.005)


ONE = jax.jit(partial(update, noise=NOISE, capacity=Capacity(8, 8)))


def overlapping() -> LineMap:
    """The two walls, each held to reach a metre past where the other one begins, with the pose error of a scan."""
    empty = empty_map(Capacity(16, 8))
    lines = dataclasses.replace(
        empty.lines,
        anchor=empty.lines.anchor.at[:2].set(jnp.array([[3.0, 1.0], [3 + STEP, -1.0]])),
        cov_independent=empty.lines.cov_independent.at[:2].set(jnp.diag(jnp.array([1e-6, 1e-6]))),
        sqrt_persistent=empty.lines.sqrt_persistent.at[:2, 0, 0].set(0.05).at[:2, 1, 2].set(0.01),
        extent=empty.lines.extent.at[:2].set(jnp.array([-2.0, 2.0])),
        var_extent=empty.lines.var_extent.at[:2].set(1e-4),
        times_detected=empty.lines.times_detected.at[:2].set(1),
        valid=empty.lines.valid.at[:2].set(True),
    )
    return dataclasses.replace(empty, lines=lines)


def test_lines_of_the_map_are_merged_unless_a_scan_saw_them_apart() -> None:
    scans, poses = drive(np.zeros((30, 3)))
    _, reports = maps_of(overlapping(), scans, poses, "unknown")
    assert not reports.merged.any()
    # They overlap and agree, by their covariances, and one of them alone says nothing of the other.
    above = dataclasses.replace(scans, valid=scans.valid & (scans.bearings > 0.3))
    _, reports = maps_of(overlapping(), above, poses, "unknown")
    assert reports.merged.tolist() == [1] + [0] * 29


def test_an_error_that_persists_goes_over_into_what_is_independent() -> None:
    """By u[k+1] = a u[k] + sqrt(1 - a^2) w, of a line that no scan sees; a is 0.99 unless given."""
    behind = overlapping()
    lines = dataclasses.replace(behind.lines, valid=behind.lines.valid.at[1].set(False))
    lines = dataclasses.replace(lines, anchor=lines.anchor.at[0].set(jnp.array([20.0, 1.0])))
    maps, _ = maps_of(dataclasses.replace(behind, lines=lines), *drive(np.zeros((30, 3))), "persistent")
    scans = np.arange(1, 31)[:, None, None]
    np.testing.assert_allclose(
        maps.lines.sqrt_persistent[:, 0], 0.99**scans * np.asarray(lines.sqrt_persistent[0]), rtol=1e-9
    )
    np.testing.assert_allclose(maps.lines.cov[:, 0], np.tile(lines.cov[0], (30, 1, 1)), rtol=1e-9)
