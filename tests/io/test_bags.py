"""ROS bags: what is read of them, where poses come from, and what is said of what is missing or broken."""

import contextlib
import math
import re
import sqlite3
import tracemalloc

import numpy as np
import pytest
from bags import UPSIDE_DOWN, Recording, heading, single_file
from logs import read, refused

from linemap_jax.io.bags import MAX_WAIT, covariance_in_the_plane
from linemap_jax.io.frames import Standstill, Trajectory
from linemap_jax.io.log import open_log
from linemap_jax.io.reading import RANGE_MAX, LogError

KINDS = ["bag", "bag-lz4", "bag-bz2", "db3", "db3-zstd", "mcap", "mcap-zstd"]
RANGES = [1.0, 2.0, 3.0, math.inf, -math.inf, math.nan, 0.0]
AHEAD = heading(0.1)
COV = np.diag([0.01, 0.02, 1e6, 1e6, 1e6, 0.003])


def assert_poses(found, expected) -> None:
    """Headings count on the circle."""
    difference = np.subtract(found, expected)
    difference[:, 2] = (difference[:, 2] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(difference, 0, atol=1e-6)


def drive(scans: int = 5, *, ranges=RANGES, cov=None, laser=(0.2, 0.1, 0.5), turn=AHEAD, **fields) -> Recording:
    """A robot that goes ahead at 1 m/s and turns at 0.1 rad/s, scans half-way between two odometry messages."""
    recording = Recording()
    recording.tf(100.0, "base_link", "laser", laser, turn, static=True)
    for i in range(scans + 1):
        recording.odometry(100.0 + 0.1 * i, (0.1 * i, 1.0, 3.1 + 0.1 * i), cov=cov)
    for i in range(scans):
        recording.scan(100.05 + 0.1 * i, ranges, **fields)
    return recording


# What is read


@pytest.mark.parametrize("kind", KINDS)
def test_all_formats_say_the_same(tmp_path, kind):
    path = drive(cov=COV).write(tmp_path, kind)
    readings, notes = read(path)
    assert len(readings) == notes.scans == 5
    first = readings[0]
    assert first.ranges.dtype == first.bearings.dtype == np.float64
    np.testing.assert_array_equal(first.ranges, np.float32(RANGES))
    np.testing.assert_allclose(first.bearings, np.linspace(-1, 1, 7), atol=1e-7)
    assert (first.range_min, first.range_max) == (pytest.approx(0.1), 30.0)
    assert (first.timestamp, first.where, first.pose_frame) == (pytest.approx(100.05), "scan 1", "robot")
    assert first.mount == pytest.approx((0.2, 0.1, 0.1))
    assert_poses([r.pose for r in readings], [(0.1 * i + 0.05, 1, 3.15 + 0.1 * i) for i in range(5)])
    np.testing.assert_allclose(first.cov_pose, np.diag([0.01, 0.02, 0.003]))
    assert first.sweep_poses is None
    assert notes.messages == {"/odom": 6, "/scan": 5, "/tf_static": 1}
    assert notes.types["/scan"] == "sensor_msgs/msg/LaserScan"
    assert (notes.poses, notes.mounting) == ("nav_msgs/Odometry on /odom", "tf, laser in base_link")
    assert notes.frames == ["laser in base_link (static)"]
    assert (notes.stated_covs, notes.warnings()) == (5, [])


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_single_file_of_a_ros_2_bag_is_enough(tmp_path, kind):
    folder = drive().write(tmp_path, kind)
    log = open_log(single_file(folder))
    assert sum(1 for _ in log) == 5
    assert log.format == f"ROS 2 bag, {'SQLite' if kind == 'db3' else 'MCAP'}"


def test_definitions_of_messages_need_not_be_there(tmp_path):
    path = single_file(drive().write(tmp_path, "db3"))
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    assert len(read(path)[0]) == 5


def test_a_log_is_read_again_from_the_start(tmp_path):
    log = open_log(drive().write(tmp_path))
    assert [r.timestamp for r in log] == [r.timestamp for r in log]
    assert log.notes.scans == 5
    assert next(iter(log)).where == "scan 1"


def test_progress_goes_from_the_beginning_to_the_end(tmp_path):
    told = []
    path = drive(200).write(tmp_path)
    list(open_log(path, progress=lambda read, total: told.append((read, total))))
    size = path.stat().st_size
    assert told == sorted(told)
    assert len(told) > 3
    assert (told[0][0], told[-1]) == (0, (size, size))


def test_options_go_over_what_the_log_states(tmp_path):
    path = drive(range_min=0.5, range_max=9.0).write(tmp_path)
    options = {"range_min": 0.0, "range_max": 4.0, "bearing_override": (-0.6, 0.2), "mount": (1.0, 2.0, 3.0)}
    (first, *_), _ = read(path, **options)
    assert (first.range_min, first.range_max, first.mount) == (0.0, 4.0, (1.0, 2.0, 3.0))
    np.testing.assert_allclose(first.bearings, -0.6 + 0.2 * np.arange(7))


@pytest.mark.parametrize("stated", [0.0, -1.0, math.nan])
def test_a_maximum_range_that_is_none_is_replaced(tmp_path, stated):
    (first, *_), notes = read(drive(range_min=math.nan, range_max=stated).write(tmp_path))
    assert (first.range_min, first.range_max) == (0.0, RANGE_MAX)
    assert "no maximum range" in notes.warnings()[0]


def test_a_scanner_without_a_limit_has_none(tmp_path):
    (first, *_), notes = read(drive(range_max=math.inf).write(tmp_path))
    assert first.range_max == math.inf
    assert notes.warnings() == []


def test_bearings_may_fall(tmp_path):
    (first, *_), _ = read(drive(angle_min=1.0, angle_increment=-0.25).write(tmp_path))
    np.testing.assert_allclose(first.bearings, 1 - 0.25 * np.arange(7))


def test_a_scanner_that_hangs_upside_down_is_seen_from_above(tmp_path):
    # Half a turn about an axis at 0.3 rad: the scanner looks along 0.6 rad, and its left is the robot's right.
    turn = (math.cos(0.3), math.sin(0.3), 0.0, 0.0)
    (first, *_), notes = read(drive(turn=turn, angle_min=-0.9).write(tmp_path))
    assert first.mount == pytest.approx((0.2, 0.1, 0.6))
    np.testing.assert_allclose(first.bearings, 0.9 - np.arange(7) / 3, atol=1e-7)
    assert notes.mounting == "tf, laser in base_link, upside down"
    # The offset of the user is where it sits; that it hangs is known all the same.
    (moved, *_), _ = read(tmp_path / "log.bag", mount=(0.0, 0.0, 0.0))
    np.testing.assert_array_equal(moved.bearings, first.bearings)


def test_a_tilted_scanner_is_noted(tmp_path):
    _, notes = read(drive(turn=(0.0, math.sin(0.25), 0.0, math.cos(0.25))).write(tmp_path))
    assert "tilted by 29 degrees" in " ".join(notes.warnings())


def test_the_number_of_beams_may_change(tmp_path):
    recording = drive()
    recording.scan(100.31, [1.0] * 9)
    readings, notes = read(recording.write(tmp_path))
    assert [r.ranges.size for r in readings] == [r.bearings.size for r in readings] == [7, 7, 7, 9, 7, 7]
    assert notes.warnings() == ["the number of beams varies: 1 scan with other than the 7 of the first"]


def test_scans_without_a_stamp_have_that_of_their_recording(tmp_path):
    recording = drive(scans=3)
    recording.scan(0.0, RANGES, recorded=100.12)
    readings, notes = read(recording.write(tmp_path))
    assert [r.timestamp for r in readings] == pytest.approx([100.05, 100.12, 100.15, 100.25])
    assert "without a time stamp" in notes.warnings()[0]


def test_stamps_that_step_back_are_noted_and_the_order_kept(tmp_path):
    recording = drive(scans=4)
    recording.scan(100.1, RANGES, recorded=100.3)
    readings, notes = read(recording.write(tmp_path))
    assert [r.timestamp for r in readings] == pytest.approx([100.05, 100.15, 100.25, 100.1, 100.35])
    assert notes.backward_stamps == 1
    assert "(scan 4)" in notes.warnings()[0]


def test_scans_of_nothing_but_nan_are_scans(tmp_path):
    recording = drive(scans=2)
    recording.scan(100.1, [math.nan] * 7)
    readings, notes = read(recording.write(tmp_path))
    assert [np.isnan(r.ranges).all() for r in readings] == [False, True, False]
    assert notes.warnings() == []


# Poses


@pytest.mark.parametrize(
    ("cov", "taken"),
    [
        (COV, True),
        (None, False),  # zeros
        (np.diag([0.01, 0.02, 0, 0, 0, 1e3]), False),  # the heading is not known
        (np.diag([1e6, 1e6, 0, 0, 0, 0.1]), False),  # nor the place
        (np.diag([0.01, math.nan, 0, 0, 0, 0.1]), False),
        (np.diag([0.01, -1.0, 0, 0, 0, 0.1]), False),
        (np.ones((6, 6)), False),  # of rank one
    ],
)
def test_covariances_are_taken_where_they_mean_something(cov, taken):
    found = covariance_in_the_plane(np.zeros(36) if cov is None else cov.ravel())
    assert (found is not None) == taken
    if found is not None:
        np.testing.assert_array_equal(found, cov[np.ix_([0, 1, 5], [0, 1, 5])])


def test_correlations_of_a_covariance_are_kept():
    cov = np.diag([0.04, 0.09, 0.0, 0.0, 0.0, 0.01])
    cov[0, 5] = cov[5, 0] = 0.015
    np.testing.assert_array_equal(
        covariance_in_the_plane(cov.ravel()), [[0.04, 0, 0.015], [0, 0.09, 0], [0.015, 0, 0.01]]
    )


def test_poses_of_a_map_go_before_odometry(tmp_path):
    recording = drive(scans=4)
    for i in range(6):
        recording.tf(100.0 + 0.1 * i, "odom", "base_link", (0.1 * i, 1, 0), heading(3.1 + 0.1 * i))
    for stamp, x in ((99.9, 5.0), (100.9, 6.0)):  # the map is corrected once a second
        recording.tf(stamp, "/map", "/odom", (x, 0, 0), heading(0.5), recorded=stamp - 0.2)
    path = recording.write(tmp_path)
    readings, notes = read(path)
    assert notes.poses == "tf, base_link in map"
    assert notes.mounting == "tf, laser in base_link"
    assert len(readings) == 4
    for i, reading in enumerate(readings):
        x, c, s = 0.1 * i + 0.05, math.cos(0.5), math.sin(0.5)
        expected = [5.15 + x - 0.05 + c * x - s, s * x + c, 3.65 + 0.1 * i]
        assert_poses([reading.pose], [expected])
        assert reading.cov_pose is None
    _, notes = read(path, odom_topic="odom")
    assert notes.poses == "nav_msgs/Odometry on /odom"


def test_tf_is_enough(tmp_path):
    recording = Recording()
    for i in range(5):
        stamp = 100.0 + 0.1 * i
        recording.tf(stamp, "odom", "base_footprint", (0.1 * i, 0, 0))
        recording.tf(stamp, "base_link", "laser", (0.3, 0, 0.2), UPSIDE_DOWN)  # as ROS 1 publishes what does not move
        recording.scan(stamp + 0.05, RANGES)
    recording.tf(100.0, "base_footprint", "base_link", (0, 0, 0.1), static=True)
    readings, notes = read(recording.write(tmp_path, "mcap"))
    assert notes.poses == "tf, base_footprint in odom"
    assert notes.mounting == "tf, laser in base_footprint, upside down"
    np.testing.assert_allclose([r.pose for r in readings], [(0.1 * i + 0.05, 0, 0) for i in range(4)], atol=1e-12)
    assert readings[0].mount == pytest.approx((0.3, 0, 0))
    assert notes.without_pose == 1  # the last scan, after the last pose
    assert "1 scan was left out" in notes.warnings()[0]


def test_frames_may_lie_on_different_branches(tmp_path):
    # The laser and the frame of the odometry are both children of the footprint.
    recording = drive(scans=2)
    recording.messages = [m for m in recording.messages if m[0] != "/tf_static"]
    recording.tf(100.0, "base_footprint", "base_link", (0.5, 0, 0), heading(math.pi / 2), static=True)
    recording.tf(100.0, "base_footprint", "laser", (0.5, 1.0, 0), static=True)
    (first, *_), _ = read(recording.write(tmp_path))
    assert first.mount == pytest.approx((1.0, 0.0, -math.pi / 2))


def test_a_pose_may_be_recorded_after_the_scan_that_needs_it(tmp_path):
    recording = Recording()
    for i in range(20):
        recording.odometry(100.0 + 0.1 * i, (0.1 * i, 0, 0), recorded=100.0 + 0.1 * i + 2.0)
        recording.scan(100.01 + 0.1 * i, RANGES)
    readings, notes = read(recording.write(tmp_path))
    np.testing.assert_allclose([r.pose[0] for r in readings], 0.01 + 0.1 * np.arange(19), atol=1e-7)
    assert notes.without_pose == 1


def test_scans_do_not_wait_for_ever(tmp_path):
    recording = Recording()
    for i in range(400):
        stamp = 100.0 + 0.1 * i
        if not 10 < i < 300:
            recording.odometry(stamp, (0.0, 0, 0))
        recording.scan(stamp, RANGES)
    recording.scan(1e6, RANGES, recorded=103.0)  # of another clock
    log = open_log(recording.write(tmp_path))
    stamps = np.array([reading.timestamp for reading in log])
    # Odometry is silent from 101 s to 130 s; scans that came in the last seconds of that still wait when it goes on.
    waited = 130.0 - MAX_WAIT
    assert np.all((stamps < 101.01) | (stamps > waited - 0.11))
    assert np.sum((stamps > 101.01) & (stamps < 130.0)) > 10 * MAX_WAIT - 3
    assert log.notes.without_pose == 401 - len(stamps) > 200


def test_a_clock_that_is_set_back_begins_anew(tmp_path):
    recording = Recording()
    for k in range(2):
        for i in range(5):
            recording.odometry(100.0 + 0.1 * i, (k + 0.1 * i, 0, 0), recorded=100 + 50 * k + 0.1 * i)
            recording.scan(100.0 + 0.1 * i, RANGES, recorded=100 + 50 * k + 0.1 * i + 0.01)
        recording.odometry(140.0, (k, 0, 0), recorded=110 + 50 * k)
    readings, notes = read(recording.write(tmp_path))
    np.testing.assert_allclose([r.pose[0] for r in readings], [*(0.1 * np.arange(5)), *(1 + 0.1 * np.arange(5))])
    assert notes.backward_stamps == 1


def test_poses_of_the_user_go_before_those_of_the_log(tmp_path):
    path = drive(scans=4, cov=COV).write(tmp_path)
    trajectory = Trajectory(np.array([100.4, 100.1]), np.array([[4.0, 0, -3.0], [1.0, 0, 3.0]]))
    readings, notes = read(path, poses=trajectory)
    assert [r.timestamp for r in readings] == pytest.approx([100.15, 100.25, 100.35])
    np.testing.assert_allclose([r.pose[0] for r in readings], [1.5, 2.5, 3.5], atol=1e-5)
    # The heading goes the short way round.
    np.testing.assert_allclose([r.pose[2] for r in readings], 3 + (2 * np.pi - 6) * np.array([1, 3, 5]) / 6, atol=1e-5)
    assert readings[0].cov_pose is None
    assert readings[0].mount == pytest.approx((0.2, 0.1, 0.1))
    assert (notes.poses, notes.without_pose, notes.drift) == ("of a given trajectory", 1, None)
    # A sweep that begins by the last pose may end a step later; stamps are rounded.
    assert trajectory.covers(100.1 - 5e-7, 100.4)
    assert not trajectory.covers(100.0, 100.4)
    assert trajectory.covers(100.4 + 5e-7, 100.7)
    assert not trajectory.covers(100.4, 100.71)
    assert not trajectory.covers(100.41, 100.5)
    np.testing.assert_allclose(trajectory.at(np.array([100.5]))[0, :2], [5, 0])
    alone = Trajectory(np.array([100.0]), np.ones((1, 3)))
    assert alone.covers(100.0, 100.0)
    assert not alone.covers(100.0, 100.1)
    # Those of the laser are where it is, wherever it sits on the robot.
    readings, notes = read(path, poses=Trajectory(trajectory.stamps, trajectory.poses, "laser"))
    assert (readings[0].pose_frame, readings[0].mount) == ("laser", (0, 0, 0))
    assert (notes.poses, notes.mounting) == ("of a given trajectory of the laser", "")
    with pytest.raises(ValueError, match="no mount applies"):
        read(path, poses=Trajectory(trajectory.stamps, trajectory.poses, "laser"), mount=(0.1, 0, 0))


@pytest.mark.parametrize(("frame", "drift"), [("odom", True), ("robot/odom", True), ("map", False), ("/world", False)])
def test_odometry_drifts_unless_it_is_in_a_corrected_frame(tmp_path, frame, drift):
    recording = Recording()
    for i in range(3):
        recording.odometry(100.0 + i, (i, 0, 0), frame=frame)
        recording.scan(100.0 + i, RANGES)
    assert read(recording.write(tmp_path))[1].drift == drift


def test_a_log_without_poses(tmp_path):
    recording = Recording()
    for i in range(3):
        recording.scan(100.0 + i, RANGES)
    path = recording.write(tmp_path)
    sentence = refused(path)
    assert all(word in sentence for word in ("no poses", "nav_msgs/Odometry", "tf", "--poses", "--standstill"))
    readings, notes = read(path, need_poses=False)
    assert [r.pose for r in readings] == [None] * 3
    assert notes.warnings() == []
    readings, notes = read(path, poses=Standstill())
    assert [r.pose.tolist() for r in readings] == [[0, 0, 0]] * 3
    assert (notes.poses, notes.warnings()) == ("of a robot that stands still", [])
    readings, notes = read(path, poses=Trajectory(np.array([100.0, 102.0]), np.zeros((2, 3))))
    assert len(readings) == 3
    assert "sits on the robot" in notes.warnings()[0]


def test_a_tree_that_never_moves_is_no_pose(tmp_path):
    recording = Recording()
    for i in range(3):
        recording.scan(100.0 + i, RANGES)
        recording.tf(100.0 + i, "base_link", "laser", (0.1, 0, 0))
    assert "holds no poses" in refused(recording.write(tmp_path))


def test_motion_during_a_sweep(tmp_path):
    path = drive(scans=4, time_increment=0.01).write(tmp_path)
    readings, notes = read(path)
    # The last sweep goes on past the last pose.
    assert (len(readings), notes.swept, notes.without_pose) == (3, 3, 1)
    sweep = readings[0].sweep_poses
    assert sweep.shape == (7, 3)
    np.testing.assert_allclose(sweep[:, 0], 0.05 + 0.01 * np.arange(7), atol=1e-6)
    assert_poses(sweep, np.array([0.05, 1, 3.15]) + np.arange(7)[:, None] * [0.01, 0, 0.01])
    np.testing.assert_array_equal(readings[0].pose, sweep[0])


def test_a_time_increment_out_of_reason_is_not_believed(tmp_path):
    readings, notes = read(drive(time_increment=5.0).write(tmp_path))
    assert len(readings) == 5
    assert readings[0].sweep_poses is None
    assert "time_increment of 5 s" in notes.warnings()[0]


def test_a_map_that_is_joined_to_odometry_for_good_corrects_nothing(tmp_path):
    recording = drive(scans=2, cov=COV)
    recording.tf(99.0, "map", "odom", static=True)
    for i in range(3):
        recording.tf(100.0 + 0.1 * i, "odom", "base_link", (0.1 * i, 0, 0))
    readings, notes = read(recording.write(tmp_path))
    assert notes.poses == "nav_msgs/Odometry on /odom"
    assert readings[0].cov_pose is not None


def test_tf_of_the_first_years_of_ros(tmp_path):
    recording = Recording()
    for i in range(3):
        recording.tf(100.0 + i, "/odom", "/laser", (i, 0, 0))
        recording.scan(100.0 + i, RANGES, frame="/laser")
    (tmp_path / "old").mkdir()
    readings, notes = read(recording.write(tmp_path / "old", tf_type="tf/msg/tfMessage"))
    assert notes.types["/tf"] == "tf/msg/tfMessage"
    assert [r.pose[0] for r in readings] == [0, 1, 2]


# Topics


def test_scanners_are_listed_where_there_are_several(tmp_path):
    recording = drive()
    recording.scan(100.1, [1.0, 1.0], topic="/rear/scan")
    path = recording.write(tmp_path)
    sentence = refused(path)
    assert "--scan-topic" in sentence
    assert "/rear/scan (1), /scan (5)" in sentence
    assert len(read(path, scan_topic="scan")[0]) == 5
    assert len(read(path, scan_topic="/rear/scan")[0]) == 1
    assert "no sensor_msgs/LaserScan on the topic '/front'; those are on /rear/scan, /scan" in refused(
        path, scan_topic="/front"
    )


def test_odometries_are_listed_where_there_are_several(tmp_path):
    recording = drive()
    recording.odometry(100.0, (7.0, 0, 0), topic="/wheels")
    recording.odometry(101.0, (7.0, 0, 0), topic="/wheels")
    path = recording.write(tmp_path)
    assert "--odom-topic: /odom (6), /wheels (2)" in refused(path)
    assert read(path, odom_topic="/wheels")[0][0].pose[0] == 7
    assert len(read(path, need_poses=False)[0]) == 5


def test_a_carmen_log_has_no_topics(tmp_path):
    path = tmp_path / "some.log"
    path.write_text("FLASER 1 1.0 0 0 0 0 0 0 1.0 host 1.0\n")
    assert "no topics" in refused(path, scan_topic="/scan")


# What is broken


def test_a_bag_without_scans_says_what_there_is(tmp_path):
    recording = Recording()
    recording.odometry(1.0, (0, 0, 0))
    sentence = refused(recording.write(tmp_path))
    assert "no sensor_msgs/LaserScan; its topics: /odom (nav_msgs/Odometry, 1)" in sentence


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_an_empty_bag_is_refused(tmp_path, kind):
    assert "no sensor_msgs/LaserScan, nor any other message" in refused(Recording().write(tmp_path, kind))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.02, 0.5, 0.98])
def test_a_bag_that_is_cut_off_is_refused(tmp_path, kind, share):
    path = drive(60).write(tmp_path, kind)
    path = path if path.is_file() else single_file(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert refused(path if kind != "db3-zstd" else path.parent)[0] == "/"


@pytest.mark.parametrize("kind", KINDS)
def test_damage_in_the_middle_never_ends_in_anything_but_a_sentence(tmp_path, kind):
    folder = drive(60).write(tmp_path, kind)
    path = folder if folder.is_file() else single_file(folder)
    content, random = path.read_bytes(), np.random.default_rng(0)
    for _ in range(6):
        damaged = bytearray(content)
        at = random.integers(16, len(content) - 64)
        damaged[at : at + 48] = random.bytes(48)
        path.write_bytes(damaged)
        with contextlib.suppress(LogError):
            assert len(read(folder)[0]) <= 60


def test_other_things_in_place_of_a_bag(tmp_path):
    other = tmp_path / "other.db3"
    with sqlite3.connect(other) as database:
        database.execute("CREATE TABLE notes(text)")
    database.close()
    assert "cannot be read as a ROS bag" in refused(other)
    misnamed = single_file(drive().write(tmp_path, "mcap")).rename(tmp_path / "some.rosbag")
    assert "neither in .mcap nor in .db3" in refused(misnamed)
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty/metadata.yaml").write_text("nonsense: [")
    assert "metadata" in refused(tmp_path / "empty")


def test_another_definition_of_the_message_is_refused(tmp_path):
    path = drive().write(tmp_path)
    content = path.read_bytes()
    md5 = b"90c7ef2dc6895d81024acba2ac42f369"
    assert md5 in content
    path.write_bytes(content.replace(md5, b"0" * 32))
    assert "another definition of sensor_msgs/LaserScan" in refused(path)


@pytest.mark.parametrize(
    ("fields", "fault"),
    [
        ({"ranges": []}, "has no ranges"),
        ({"angle_increment": 0.0}, "are no sweep"),
        ({"angle_min": math.nan}, "are no sweep"),
        ({"angle_min": 1e30}, "are no sweep"),
        ({"angle_increment": 3.0}, "more than twice"),
    ],
)
def test_malformed_scans_are_skipped_and_counted(tmp_path, fields, fault):
    recording = drive(scans=3)
    recording.scan(100.06, **({"ranges": RANGES} | fields))
    path = recording.write(tmp_path)
    readings, notes = read(path)
    assert len(readings) == 3
    assert notes.skipped == 1
    assert re.match(
        rf"1 malformed scan was skipped \(scan 2\); the first fault, scan 2: .*{fault}", notes.warnings()[0]
    )
    assert fault in refused(path, strict=True)
    only = Recording()
    only.scan(1.0, **({"ranges": RANGES} | fields))
    only.odometry(1.0, (0, 0, 0))
    assert fault in refused(only.write(tmp_path, name="only"))


def test_poses_that_are_none_are_passed_over(tmp_path):
    recording = drive(scans=2)
    recording.odometry(100.04, (math.nan, 0, 0))
    recording.tf(100.0, "base_link", "camera", (0, 0, 0), (0, 0, 0, 0))  # no rotation
    readings, _ = read(recording.write(tmp_path))
    np.testing.assert_allclose([r.pose[0] for r in readings], [0.05, 0.15], atol=1e-7)


def test_translations_beyond_all_measure_are_passed_over(tmp_path):
    recording = drive(scans=2)
    recording.odometry(100.04, (1.7e308, 0, 0))
    recording.odometry(100.06, (-1.7e308, 0, 0))
    readings, _ = read(recording.write(tmp_path))
    np.testing.assert_allclose([r.pose[0] for r in readings], [0.05, 0.15], atol=1e-7)


def test_scans_are_described_where_odometry_says_nothing(tmp_path):
    recording = Recording()
    recording.scan(1.0, RANGES)
    recording.odometry(1.0, (math.nan, 0, 0))
    (reading,), _ = read(recording.write(tmp_path), need_poses=False)
    assert reading.pose is None


def test_names_of_topics_do_not_break_the_sentence(tmp_path):
    recording = Recording()
    for topic in ("/a\nb", "/c"):
        recording.scan(1.0, RANGES, topic=topic)
    assert "/a\\nb (1), /c (1)" in refused(recording.write(tmp_path))


def test_poses_of_another_time_are_no_poses(tmp_path):
    recording = Recording()
    for i in range(3):
        recording.scan(100.0 + i, RANGES)
        recording.odometry(5.0 + i, (0, 0, 0), recorded=100.0 + i)
    sentence = refused(recording.write(tmp_path))
    assert "none of its 3 scans, from 100.000 s to 102.000 s, lies in the time that the poses cover" in sentence


# How well


def test_memory_does_not_grow_with_the_log(tmp_path):
    def peak(scans: int) -> int:
        path = drive(scans, ranges=np.ones(10_000)).write(tmp_path, "mcap-zstd", name=f"of{scans}")
        assert next(iter(open_log(path))).where == "scan 1"  # loads what is loaded once
        tracemalloc.start()
        for _ in open_log(path):
            pass
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    # The scans alone take 4 MB and 16 MB.
    assert peak(400) < 1.2 * peak(100)


def test_real_bags(data):
    readings, notes = read(data("freiburg/fr079.sort.bag"))
    # The first scan lies before the first odometry.
    assert (len(readings), notes.without_pose, notes.stated_covs) == (4933, 1, 0)
    assert notes.poses == "nav_msgs/Odometry on /odom"
    assert readings[0].mount == pytest.approx((0.04, 0, 0))
    first = next(iter(open_log(data("freiburg/aces.sort.bag"))))
    assert (first.ranges.size, first.range_max, first.mount) == (180, 50.0, (0, 0, 0))
