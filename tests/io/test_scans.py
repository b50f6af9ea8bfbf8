"""From readings to scans: what is masked, what is moved, and what is filled up."""

import math

import numpy as np
import pytest

from linemap_jax.core.frames_on_host import compose
from linemap_jax.core.state import Scan
from linemap_jax.io.reading import Reading
from linemap_jax.io.scans import at_first_beam, chunks_of_readings, with_drift

COV = np.diag([0.1, 0.2, 0.3])


def reading(ranges, bearings=None, **fields) -> Reading:
    ranges = np.asarray(ranges, float)
    values = {
        "timestamp": 1.0,
        "bearings": np.linspace(-1.0, 1.0, ranges.size) if bearings is None else np.asarray(bearings),
        "range_min": 0.0,
        "range_max": 10.0,
        "pose": np.array([1.0, 2.0, 3.0]),
        "cov_pose": None,
        "time_increment": 0.0,
        "sweep_poses": None,
        "pose_frame": "robot",
        "odometry": None,
        "mount": None,
        "where": "scan 1",
    }
    return Reading(ranges=ranges, **(values | fields))


def chunk_of(*readings: Reading):
    (chunk,) = chunks_of_readings(readings, 8, cov_pose=COV, dtype="float64")
    return chunk


def test_rep_117_and_what_drivers_make_of_it():
    # Too close, no return, invalid; zero and the maximum range or more for no return; below the minimum.
    ranges = [-math.inf, math.inf, math.nan, 0.0, -1.0, 10.0, 11.0, 0.2, 0.5, 9.99]
    scans = chunk_of(reading(ranges, range_min=0.5)).scans
    assert np.flatnonzero(scans.valid[0]).tolist() == [8, 9]
    np.testing.assert_array_equal(scans.ranges[0], [0] * 8 + [0.5, 9.99])
    assert np.flatnonzero(chunk_of(reading(ranges, range_max=math.inf)).scans.valid[0]).tolist() == [5, 6, 7, 8, 9]


@pytest.mark.parametrize("step", [2 * np.pi / 90, -2 * np.pi / 90, 0.01])
def test_scans_are_those_of_from_ranges(step):
    random = np.random.default_rng(1)
    ranges = random.uniform(0.1, 12.0, 91)
    ranges[random.integers(0, 91, 9)] = np.nan
    bearings = -3 + step * np.arange(91)
    scans = chunk_of(reading(ranges, bearings, range_min=0.3)).scans
    alone = Scan.from_ranges(ranges, bearings, range_min=0.3, range_max=10.0)
    for name in ("ranges", "bearings", "valid", "spacing", "first"):
        np.testing.assert_allclose(getattr(scans, name)[0], getattr(alone, name), rtol=1e-15, err_msg=name)
    assert (int(alone.first) > 0) == (abs(step) > 0.02)


def test_poses_have_the_covariance_of_the_log_or_else_the_one_given():
    stated = np.eye(3)
    poses = chunk_of(reading([1.0]), reading([1.0], cov_pose=stated), reading([1.0], pose=None)).poses
    np.testing.assert_array_equal(poses.cov, [COV, stated, COV])
    np.testing.assert_array_equal(poses.mean[:2], [[1, 2, 3]] * 2)
    assert np.isnan(poses.mean[2]).all()


def test_where_the_number_of_beams_varies_scans_are_filled_up():
    scans = chunk_of(reading(np.ones(70)), reading(np.ones(90)), reading(np.ones(1))).scans
    assert scans.ranges.shape == (3, 128)
    assert scans.valid.sum(1).tolist() == [70, 90, 1]
    np.testing.assert_allclose(scans.spacing, [2 / 69, 2 / 89, 0])
    assert np.isfinite(scans.bearings).all()
    # As many as there are where it does not vary, and never fewer than before.
    sizes = (3, 3, 5, 4)
    chunks = chunks_of_readings([reading(np.ones(n)) for n in sizes], 2, cov_pose=COV)
    assert [chunk.scans.ranges.shape for chunk in chunks] == [(2, 3), (2, 64)]


def test_a_sweep_all_around_is_closed_whatever_fills_it_up():
    # A room without a corner or a jump but behind the scanner, where the wall is far: there the sweep begins.
    bearings = np.arange(100) * 2 * np.pi / 100
    ranges = np.where(np.abs(bearings - 1.0) < 0.5, 8.0, 1.0)
    first = chunk_of(reading(ranges, bearings), reading(np.ones(120))).scans.first
    alone = chunk_of(reading(ranges, bearings)).scans.first
    assert first[0] == alone[0] in (np.argmax(ranges == 8.0), np.argmax(ranges == 8.0) + np.sum(ranges == 8.0))


def wall(pose: np.ndarray, mount: np.ndarray, bearing: float) -> float:
    """Range of one beam to the wall x = 5, from a laser on a robot."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x = pose[0] + c * mount[0] - s * mount[1]
    return (5 - x) / math.cos(pose[2] + mount[2] + bearing)


@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.4)])
def test_what_is_seen_while_moving_is_brought_to_the_first_beam(mount):
    # An exact sweep: a robot that drives an arc at 1 m/s and 0.8 rad/s, and is simulated beam by beam.
    bearings = np.linspace(-0.9, 0.4, 181)
    times = 0.1 * np.arange(181) / 180
    poses = np.stack([np.sin(0.8 * times) / 0.8, (1 - np.cos(0.8 * times)) / 0.8, 0.8 * times], -1) + [1e4, 0, 3e-2]
    offset = np.array(mount)
    ranges = np.array(
        [wall(pose - [1e4, 0, 0], offset, bearing) for pose, bearing in zip(poses, bearings, strict=True)]
    )
    ranges[50] = np.nan
    scan = chunk_of(reading(ranges, bearings, pose=poses[0], sweep_poses=poses, mount=mount)).scans
    found, at = np.asarray(scan.ranges[0]), np.asarray(scan.bearings[0])
    valid = np.asarray(scan.valid[0])
    assert np.flatnonzero(~valid).tolist() == [50]
    still = [wall(poses[0] - [1e4, 0, 0], offset, bearing) for bearing in at]
    np.testing.assert_allclose(found[valid], np.array(still)[valid], atol=1e-9)
    assert np.abs(found - np.nan_to_num(ranges)).max() > 0.05  # as it was measured it is off by far more
    assert np.all(np.abs(at - bearings) < 0.2)


def test_a_drift_beside_what_the_wheels_count():
    """Wheels that miss some of the motion: with it, the beams come to where they were measured from."""
    bearings = np.linspace(-0.9, 0.4, 181)
    times = 0.1 * np.arange(181) / 180
    still, rate = np.zeros(3), np.array([0.3, -0.1, 0.5])
    poses = compose(np.array([0.0, 0.0, 0.03]), times[:, None] * rate)
    ranges = np.array([wall(pose, still, bearing) for pose, bearing in zip(poses, bearings, strict=True)])
    counted = np.tile(poses[0], (181, 1))
    counted[:, 0] += 1e-9 * np.arange(181)  # else the reader would have said that it makes no difference
    swept = reading(ranges, bearings, pose=poses[0], sweep_poses=counted, time_increment=0.1 / 180)
    at_once = reading(ranges, bearings)
    # Every second reading is taken, and of those only two have a drift.
    readings = list(with_drift([swept, swept, swept, at_once, swept], np.array([rate, -rate]), every=2))
    assert [r is swept for r in readings] == [False, True, False, False, True]
    assert readings[3] is at_once
    np.testing.assert_allclose(readings[0].sweep_poses, poses, atol=1e-6)
    np.testing.assert_allclose(readings[2].sweep_poses, compose(poses[0], -times[:, None] * rate), atol=1e-6)
    chunk = chunk_of(readings[0], at_once)
    ahead = [wall(poses[0], still, bearing) for bearing in np.asarray(chunk.scans.bearings[0])]
    np.testing.assert_allclose(chunk.scans.ranges[0], ahead, atol=1e-6)
    np.testing.assert_allclose(chunk.last_beam, [0.1 * rate, [0, 0, 0]], atol=1e-6)


def test_a_robot_that_stands_changes_nothing():
    bearings = np.linspace(-3, 3, 50)
    ranges = np.linspace(1, 2, 50)
    found = at_first_beam(ranges, bearings, np.tile([4.0, 5.0, -3.0], (50, 1)), (0.1, 0.2, 3.0))
    np.testing.assert_allclose(found, (ranges, bearings), atol=1e-12)


def test_a_full_turn_while_turning_sees_nothing_twice():
    # The scanner turns with the robot: of 360 beams the last ones come round to where the first had been.
    bearings = np.arange(360) * 2 * np.pi / 360
    poses = np.stack([np.zeros(360), np.zeros(360), 0.1 * np.arange(360) / 360], -1)
    scan = chunk_of(reading(np.full(360, 2.0), bearings, sweep_poses=poses)).scans
    seen = np.sort(np.asarray(scan.bearings[0])[np.asarray(scan.valid[0])])
    assert len(seen) < 356
    assert seen[-1] - seen[0] < 2 * np.pi


def test_what_is_too_large_or_too_small_for_float32_is_no_point():
    moving = np.tile([0.0, 0.0, 0.0], (4, 1))
    moving[:, 2] = [0.0, 0.1, 0.2, 0.3]
    first = reading([1.0, 1e-46, 1e39, 2.0], range_max=math.inf)
    second = reading([1.0, 1.0, 1.0, 1.0], sweep_poses=moving, mount=(1e300, 0.0, 0.0))
    (chunk,) = chunks_of_readings([first, second], 8, cov_pose=COV)
    assert chunk.scans.valid[0].tolist() == [True, False, False, True]
    assert not chunk.scans.valid[1, 1:].any()
    assert all(np.isfinite(x).all() for x in (chunk.scans.ranges, chunk.scans.bearings))
