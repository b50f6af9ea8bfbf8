import gzip
import math
import os
import pickle
import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from logs import read, refused

from linemap_jax.io.carmen import MAX_LINE, assumed_sweep
from linemap_jax.io.frames import Trajectory
from linemap_jax.io.log import open_log
from linemap_jax.io.reading import RANGE_MAX, LogError, Notes

DATA = Path(os.environ.get("LINEMAP_DATA", Path(__file__).parents[2] / "../shared/data")) / "carmen"
POSE = (1.0, 2.0, 0.5)
ODOMETRY = (1.5, 2.5, 0.25)


def text(*values) -> str:
    return " ".join(map(str, values))


def flaser(ranges=(1.0, 2.0, 3.0), pose=POSE, odometry=ODOMETRY, trailing="10.0 host 0.5", word="FLASER", count=None):
    ranges = list(ranges)
    return text(word, len(ranges) if count is None else count, *ranges, *pose, *odometry, trailing)


def robotlaser(
    ranges=(1.0, 2.0, 3.0),
    sweep=(-1.2, 0.6),
    range_max=20.0,
    remissions=(),
    pose=POSE,
    odometry=ODOMETRY,
    trailing="10.0 host 0.5",
    word="ROBOTLASER1",
):
    head = text(word, 0, sweep[0], 3.14, sweep[1], range_max, 0.01, 0, len(ranges), *ranges, len(remissions))
    return text(head, *remissions, *pose, *odometry, 0.1, 0.2, 0.3, 0.4, 0.5, trailing)


@pytest.fixture
def write(tmp_path):
    def write(*lines: str | bytes, name="some.log", packed=False) -> Path:
        content = b"".join((line.encode() if isinstance(line, str) else line) + b"\n" for line in lines)
        path = tmp_path / name
        path.write_bytes(gzip.compress(content) if packed else content)
        return path

    return write


def told(notes: Notes) -> list[str]:
    """The warnings, without the one that the few beams of these tests have no known sweep."""
    return [warning for warning in notes.warnings() if warning not in notes.assumptions]


# The message forms


def test_flaser_is_read_as_it_stands(write):
    (reading,), notes = read(write("# message formats defined: FLASER", flaser()))
    assert reading.ranges.dtype == np.float64
    np.testing.assert_array_equal(reading.ranges, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(reading.pose, POSE)
    np.testing.assert_array_equal(reading.odometry, ODOMETRY)
    assert reading.pose_frame == "laser"
    assert reading.mount is None
    assert reading.timestamp == 10.0
    assert reading.range_max == RANGE_MAX == 50.0
    assert reading.where == "line 2"
    assert (notes.scans, notes.beam_count, notes.skipped, notes.lines) == (1, 3, 0, 2)
    assert notes.messages == {"comment": 1, "FLASER": 1}


@pytest.mark.parametrize("trailing", ["10.0 host 0.5", "10.0 host", "10.0 0.5", "10.0"])
@pytest.mark.parametrize("message", [flaser, robotlaser])
def test_trailing_fields_may_be_missing_but_not_the_time_stamp(write, message, trailing):
    (reading,), _ = read(write(message(trailing=trailing)), strict=True)
    assert reading.timestamp == 10.0
    np.testing.assert_array_equal(reading.pose, POSE)


@pytest.mark.parametrize("message", [flaser, robotlaser])
def test_a_line_without_a_time_stamp_is_malformed(write, message):
    assert "line 1: " in refused(write(message(trailing="")), strict=True)


@pytest.mark.parametrize("message", [flaser, robotlaser])
def test_a_line_cut_off_in_its_trailing_fields_is_malformed(write, message):
    readings, notes = read(write(message(), message(trailing="1")))
    assert [r.timestamp for r in readings] == [10.0]
    assert notes.skipped_lines == [2]


def test_a_range_too_many_is_noticed_where_the_log_has_no_host(write):
    # Without a host every trailing field is a number, and the shifted line would parse: with a wrong pose.
    for trailing in ("10.0 0.5", "10.0"):
        bad = flaser((1, 2, 3, 4), trailing=trailing, count=3)
        _, notes = read(write(flaser(trailing=trailing), bad))
        assert notes.skipped_lines == [2]
    assert len(read(write(flaser(trailing="10.0 0.5"), flaser()), strict=True)[0]) == 2


def test_robotlaser_states_its_sweep_and_is_obeyed(write):
    (reading,), _ = read(write(robotlaser(remissions=(7, 8))), strict=True)
    np.testing.assert_allclose(reading.bearings, [-1.2, -0.6, 0.0], atol=1e-12)
    np.testing.assert_array_equal(reading.ranges, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(reading.pose, POSE)
    np.testing.assert_array_equal(reading.odometry, ODOMETRY)
    assert (reading.range_max, reading.timestamp, reading.pose_frame) == (20.0, 10.0, "laser")


@pytest.mark.parametrize("word", ["RLASER", "ROBOTLASER2"])
def test_a_rear_laser_has_its_own_pose(write, word):
    behind = (*POSE[:2], POSE[2] + math.pi)
    line = flaser(pose=behind, word=word) if word == "RLASER" else robotlaser(pose=behind, word=word)
    (reading,), _ = read(write(line), strict=True)
    np.testing.assert_array_equal(reading.pose, behind)
    assert reading.pose_frame == "laser"


def test_front_and_rear_laser_are_both_delivered_in_the_order_of_the_file(write):
    lines = [flaser(), flaser(word="RLASER"), flaser(), robotlaser(word="ROBOTLASER2")]
    readings, notes = read(write(*lines))
    assert [r.where for r in readings] == ["line 1", "line 2", "line 3"]
    assert notes.duplicates == {"ROBOTLASER2": 1}


@pytest.mark.parametrize("first", ["FLASER", "ROBOTLASER1"])
def test_a_scan_in_both_forms_is_delivered_once(write, first):
    pair = [flaser(), robotlaser()] if first == "FLASER" else [robotlaser(), flaser()]
    readings, notes = read(write(*pair, *pair), strict=True)
    assert [r.where for r in readings] == ["line 1", "line 3"]
    (warning,) = told(notes)
    assert "2 " in warning


def test_a_malformed_scan_does_not_choose_the_form(write):
    readings, notes = read(write(flaser(pose=("nan", 0, 0)), robotlaser(), robotlaser()))
    assert [r.where for r in readings] == ["line 2", "line 3"]
    assert notes.skipped_lines == [1]


def test_parameters_are_noted_and_move_no_pose(write):
    lines = [
        "PARAM robot_frontlaser_offset -0.04 nohost 0",
        "PARAM robot_use_laser on 1.0 host 1.0",
        "PARAM",
        "PARAM x",
    ]
    (reading,), notes = read(write(*lines, flaser()), strict=True)
    assert notes.params == {"robot_frontlaser_offset": "-0.04", "robot_use_laser": "on"}
    np.testing.assert_array_equal(reading.pose, POSE)


def test_other_messages_are_passed_over(write):
    lines = ["", "# FLASER 1 2", "NEFF 30", "SYNC tag", "ODOM nonsense", "FLASERS 1", "  \t", "RAWLASER1 0 0", flaser()]
    readings, notes = read(write(*lines), strict=True)
    assert len(readings) == 1
    assert notes.messages["blank"] == 2
    assert notes.messages["other"] == 1
    assert told(notes) == []


def test_line_endings_and_marks_of_other_systems(write):
    readings, _ = read(write(b"\xef\xbb\xbf" + flaser().encode() + b"\r", "  " + flaser() + "\t\r"), strict=True)
    assert len(readings) == 2


def test_a_last_line_without_an_end_counts(tmp_path):
    path = tmp_path / "open.log"
    path.write_text(flaser())
    assert len(read(path, strict=True)[0]) == 1


# Bearings and maximum range


@pytest.mark.parametrize(
    ("beams", "first", "last", "step"),
    [
        (180, -90, 89, 1),
        (181, -90, 90, 1),
        (360, -90, 89.5, 0.5),
        (361, -90, 90, 0.5),
        (400, -50, 49.75, 0.25),
        (401, -50, 50, 0.25),
        (540, -135, 134.5, 0.5),
        (541, -135, 135, 0.5),
        (682, -119.53125, 119.8828125, 0.3515625),
        (1080, -135, 134.75, 0.25),
        (1081, -135, 135, 0.25),
        (91, -90, 90, 2),
        (2, -90, 90, 180),
        (1, 0, 0, 0),
    ],
)
def test_bearings_that_the_log_does_not_state(write, beams, first, last, step):
    np.testing.assert_allclose(np.degrees(assumed_sweep(beams)), [first, step])
    (reading,), notes = read(write(flaser(np.ones(beams))))
    assert reading.bearings.shape == (beams,)
    np.testing.assert_allclose(np.degrees(reading.bearings[[0, -1]]), [first, last], atol=1e-9)
    assert len(notes.warnings()) == (beams in (91, 2, 1))


@pytest.mark.parametrize("message", [flaser, robotlaser])
def test_the_user_overrides_bearings_and_maximum_range(write, message):
    (reading,), notes = read(write(message()), range_max=8, bearing_override=(0.3, -0.1))
    np.testing.assert_allclose(reading.bearings, [0.3, 0.2, 0.1])
    assert reading.range_max == 8.0
    assert notes.warnings() == []


@pytest.mark.parametrize("sweep", [("nan", 0.1), (0, "inf"), (0, 0), (-90, 1), (-1.57, 180)])
def test_a_sweep_that_is_none_is_malformed_unless_overridden(write, sweep):
    path = write(robotlaser(sweep=sweep))
    assert "no sweep in radians" in refused(path, strict=True)
    assert len(read(path, bearing_override=(0, 0.1))[0]) == 1


@pytest.mark.parametrize("stated", [0, -1, "nan"])
def test_a_maximum_range_that_is_none_is_replaced_and_told(write, stated):
    (reading,), notes = read(write(robotlaser(range_max=stated)), strict=True)
    assert reading.range_max == RANGE_MAX
    assert len(notes.warnings()) == 1
    assert read(write(robotlaser(range_max=stated)), range_max=9)[1].warnings() == []


def test_bearings_are_shared_and_cannot_be_written_to(write):
    readings, _ = read(write(flaser(), flaser()))
    assert readings[0].bearings is readings[1].bearings
    with pytest.raises(ValueError, match="read-only"):
        readings[0].bearings[0] = 0


def test_a_changed_sweep_is_obeyed(write):
    readings, _ = read(write(robotlaser(), robotlaser(sweep=(0, 0.1))), strict=True)
    np.testing.assert_allclose(readings[1].bearings, [0, 0.1, 0.2])


@pytest.mark.parametrize("options", [{"range_max": 0}, {"range_max": math.nan}, {"bearing_override": (0, 0)}])
@pytest.mark.parametrize("more", [{}, {"bearing_override": (-90, 1)}, {"bearing_override": (math.nan, 1)}])
def test_options_that_make_no_sense_are_refused(write, options, more):
    with pytest.raises(ValueError, match="must be"):
        open_log(write(flaser()), **(options | more))


# Faults of a line

FAULTS = {
    "pose nan": (flaser(pose=(1, "nan", 2)), "laser pose"),
    "pose infinite": (flaser(pose=(1, 2, "1e999")), "laser pose"),
    "odometry nan": (flaser(odometry=(1, 2, "nan")), "robot pose"),
    "stamp nan": (flaser(trailing="nan host 1"), "time stamp"),
    "range no number": (flaser((1, "x1", 3)), "range 2 is 'x1', not a number"),
    "range with underscore": (flaser((1, "1_0", 3)), "range 2 is '1_0', not a number"),
    "decimal comma": (flaser(pose=("1,5", 2, 3)), "field x is '1,5', not a number"),
    "no count": (flaser(count="three"), "num_readings is 'three', not a count"),
    "broken count": (flaser(count="3.0"), "not a count"),
    "negative": (flaser(count=-3), "not a count"),
    "no beams": (flaser(()), "no ranges"),
    "too few": (flaser(count=6), "too few"),
    "too few by one": (flaser((1, 2), count=3), "field ipc_timestamp is 'host', not a number"),
    "too many": (flaser((1, 2, 3, 4), count=3), "at most"),
    "huge": (flaser(count=10**12), "'1000000000000' ranges"),
    "huger": (flaser(count="9" * 5000), "too few"),
    "nothing": ("FLASER", "ends before"),
    "cut": (flaser()[:12], "too few"),
    "other beam count": (flaser((1, 2)), "2 beams, the first scan of the log 3"),
    "rear laser with another beam count": (flaser((1, 2), word="RLASER"), "2 beams, the first scan of the log 3"),
    "text for the logger": (flaser(trailing="1 host x"), "logger_timestamp"),
    "not utf-8": (flaser().encode().replace(b"2.0", b"\xff\xfe", 1), "not a number"),
    "line too long": ("FLASER 3 " + "1 " * MAX_LINE, "longer than"),
}
NEW_FAULTS = {
    "pose nan": (robotlaser(pose=(1, "nan", 2)), "laser pose"),
    "start no number": (robotlaser(sweep=("x", 1)), "start_angle"),
    "remissions no count": (robotlaser().replace(" 3.0 0 ", " 3.0 x ", 1), "num_remissions"),
    "remissions huge": (robotlaser().replace(" 3.0 0 ", " 3.0 1000000000000 ", 1), "remissions"),
    "no beams": (robotlaser(()), "no ranges"),
    "too few": (" ".join(robotlaser().split()[:-6]), "too few"),
    "too many": (robotlaser() + " 1", "at most"),
    "nothing": ("ROBOTLASER1 0 1", "ends before"),
}


@pytest.mark.parametrize(
    ("good", "bad", "cause"),
    [pytest.param(flaser(), *fault, id=name) for name, fault in FAULTS.items()]
    + [pytest.param(robotlaser(), *fault, id=f"new, {name}") for name, fault in NEW_FAULTS.items()],
)
def test_a_malformed_line_is_skipped_and_counted_or_refused(write, good, bad, cause):
    path = write(good, bad, "NEFF 1", good)
    readings, notes = read(path)
    assert [r.where for r in readings] == ["line 1", "line 4"]
    assert (notes.skipped, notes.skipped_lines) == (1, [2])
    assert cause in notes.first_fault
    (warning,) = told(notes)
    assert "1 malformed line was skipped (line 2)" in warning
    sentence = refused(path, strict=True)
    assert f"{path}, line 2: " in sentence
    assert cause in sentence
    assert len(sentence) < len(str(path)) + 200


def test_strict_delivers_what_comes_before_the_fault(write):
    scans = iter(open_log(write(flaser(), "FLASER 3 1"), strict=True))
    assert next(scans).where == "line 1"
    with pytest.raises(LogError, match="line 2"):
        next(scans)


def test_skipped_lines_are_all_counted_and_the_first_listed(write):
    _, notes = read(write(flaser(), *["FLASER 3 1"] * 50))
    assert notes.skipped == 50
    assert notes.skipped_lines == list(range(2, 22))
    assert notes.warnings()[0].count("...") == 1


def test_ranges_that_are_no_returns_are_no_fault(write):
    (reading,), notes = read(write(flaser(("nan", "-inf", 0, -1, 81.91, "1e999"))), strict=True)
    np.testing.assert_array_equal(reading.ranges, [math.nan, -math.inf, 0, -1, 81.91, math.inf])
    assert notes.skipped == 0


def test_bytes_that_are_no_text_do_no_harm_where_nothing_is_read(write):
    lines = [b"# M\xfcnchen \x00", b"PARAM robot_name \xff\xfe host 0", b"\xff\xff\x00 1", flaser(trailing="1 h 2")]
    readings, notes = read(write(*lines, flaser().encode().replace(b"host", b"m\xfcller")), strict=True)
    assert len(readings) == 2
    assert notes.params == {"robot_name": "\ufffd\ufffd"}


def test_an_error_of_a_file_survives_pickling(write):
    with pytest.raises(LogError) as caught:
        list(open_log(write("FLASER"), strict=True))
    again = pickle.loads(pickle.dumps(caught.value))
    assert str(again) == str(caught.value)
    assert (again.path, again.where) == (caught.value.path, "line 1")


# Time stamps


def stamped(*stamps: float) -> list[str]:
    return [flaser(trailing=f"{stamp} host 0") for stamp in stamps]


def test_backward_stamps_are_counted_and_not_reordered(write):
    readings, notes = read(write(*stamped(5, 4, 4, 6, 1)), strict=True)
    assert [r.timestamp for r in readings] == [5, 4, 4, 6, 1]
    assert (notes.backward_stamps, notes.backward_lines) == (2, [2, 5])
    assert "2 scans (lines 2, 5)" in notes.warnings()[0]


def test_jumps_are_gaps_of_more_than_a_minute(write):
    _, notes = read(write(*stamped(1e9, 1e9 + 60, 1e9 + 121)))
    assert (notes.jumps, notes.jump_lines) == (1, [3])
    (warning,) = told(notes)
    assert "more than 60 s" in warning


def test_a_log_in_order_gives_no_warning(write):
    log = open_log(write(*[flaser(np.ones(180), trailing=f"{i} host 0") for i in range(3)]))
    assert len(list(log)) == 3
    assert log.notes.warnings() == []


# Files


@pytest.mark.parametrize("name", ["plain.log", "misnamed.gz"])
@pytest.mark.parametrize("packed", [True, False])
def test_content_decides_about_gzip(write, name, packed):
    assert len(read(write(flaser(), flaser(), name=name, packed=packed))[0]) == 2


def test_gzip_streams_one_after_the_other(write, tmp_path):
    part = write(flaser(), packed=True).read_bytes()
    (tmp_path / "two.gz").write_bytes(part + part)
    assert len(read(tmp_path / "two.gz")[0]) == 2


def test_a_log_can_be_read_again(write):
    log = open_log(write(flaser(), "FLASER"))
    assert len(list(log)) == len(list(log)) == 1
    assert (log.notes.scans, log.notes.skipped, log.notes.lines) == (1, 1, 2)


def test_files_that_are_no_log(tmp_path):
    assert "cannot be read" in refused(tmp_path / "missing.log")
    assert "is a directory" in refused(tmp_path)
    (tmp_path / "empty.log").touch()
    assert "is empty" in refused(tmp_path / "empty.log")
    (tmp_path / "empty.gz").write_bytes(gzip.compress(b""))
    assert "is empty" in refused(tmp_path / "empty.gz")
    os.mkfifo(tmp_path / "pipe")
    assert "regular file" in refused(tmp_path / "pipe")
    with pytest.raises(LogError, match="cannot be read"):
        open_log("a\0b")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_without_permission(write):
    path = write(flaser())
    path.chmod(0)
    assert "cannot be read" in refused(path)


@pytest.mark.parametrize(
    ("content", "cause"),
    [
        (b"#ROSBAG V2.0\n", "ROS bag"),
        (b"\x89MCAP0\r\n", "ROS 2 bag"),
        (b"SQLite format 3\0", "ROS 2 bag"),
        (b"BZh91AY", "bzip2"),
        (b"\xfd7zXZ\0", "xz"),
        (b"PK\x03\x04", "zip"),
        (bytes(range(256)) * 100, "not a CARMEN log"),
        (gzip.compress(bytes(range(256)) * 100), "not a CARMEN log"),
        (b"\0" * 300_000, "not a CARMEN log"),
        (b"\x1f\x8b", "ends early"),
        (b"\x1f\x8b\x07" + b"\0" * 30, "damaged"),
        (b"\x1f\x8b\x08" + b"\0" * 30, "damaged|ends early"),
    ],
)
def test_contents_of_other_kinds(tmp_path, content, cause):
    path = tmp_path / "x.log"
    path.write_bytes(content)
    assert re.search(cause, refused(path))


def test_a_log_without_a_scan_says_what_it_holds(write):
    sentence = refused(write("# a comment", "ODOM 0 0 0", "ODOM 0 0 0", "hello"))
    assert "no laser scan found" in sentence
    assert "1 comment, 2 ODOM, 1 other" in sentence


def test_a_log_with_malformed_scans_alone_says_what_is_wrong(write):
    sentence = refused(write("FLASER 0 1", "FLASER x"))
    assert "2 of them malformed, the first fault in line 1: " in sentence


@pytest.mark.parametrize("strict", [True, False])
def test_a_gzip_stream_that_ends_early_is_an_error(write, strict):
    rng = np.random.default_rng(0)
    whole = write(*[flaser(rng.random(180).round(3)) for _ in range(200)], packed=True)
    content = whole.read_bytes()
    whole.write_bytes(content[: len(content) // 2])
    log = open_log(whole, strict=strict)
    with pytest.raises(LogError) as caught:
        list(log)
    assert 50 < log.notes.scans < 150
    assert str(caught.value) == f"{whole}: the gzip stream ends early after line {log.notes.scans}"


@pytest.mark.parametrize("end", [3, 12, -1, -8])
def test_a_short_gzip_stream_that_ends_early_is_an_error(write, end):
    path = write(flaser(), packed=True)
    path.write_bytes(path.read_bytes()[:end])
    assert "the gzip stream ends early after line" in refused(path)


def test_a_damaged_gzip_stream_is_an_error(write):
    path = write(*[flaser(np.arange(180) * 1.37 + i) for i in range(100)], packed=True)
    content = bytearray(path.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 40] = bytes(40)
    path.write_bytes(content)
    assert "the gzip stream is damaged after line" in refused(path)
    path.write_bytes(gzip.compress(flaser().encode() + b"\n") + b"garbage")
    assert "the gzip stream is damaged after line 1" in refused(path)


@pytest.mark.parametrize("packed", [True, False])
def test_progress_counts_the_bytes_on_disk(write, packed):
    path = write(*[flaser(np.arange(180) * 0.0123 + i) for i in range(300)], packed=packed)
    calls = []
    list(open_log(path, progress=lambda *call: calls.append(call)))
    consumed, total = zip(*calls, strict=True)
    assert set(total) == {path.stat().st_size}
    assert list(consumed) == sorted(consumed)
    assert 0 < consumed[0] < consumed[-1] == path.stat().st_size
    assert len(calls) > 2


def test_leaving_early_closes_the_file(write):
    # A file left open would be a ResourceWarning, which is an error here.
    scans = iter(open_log(write(flaser(), flaser(), packed=True)))
    next(scans)
    del scans


def peak_memory(path: Path) -> int:
    log = open_log(path)
    tracemalloc.start()
    try:
        for _ in log:
            pass
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_with_the_log(write):
    line = flaser(np.ones(180), trailing="1 host 1")
    short = peak_memory(write(*[line] * 100, packed=True))
    assert peak_memory(write(*[line] * 1000, packed=True)) < 1.3 * short + 10_000


def test_memory_does_not_grow_with_a_line_without_end(write):
    path = write(flaser(), b"FLASER 1000000000000 " + b"1" * (40 * MAX_LINE), flaser(), packed=True)
    assert peak_memory(path) < 8 * MAX_LINE


# Whatever the bytes

FIELDS = st.sampled_from(
    b"FLASER RLASER ROBOTLASER1 ROBOTLASER2 ODOM PARAM # 0 1 2 3 1.5 -1 nan inf -inf 1e999 1e308 1e12 999999999999 "
    b"host \xff \x00 1_0 \xd9\xa3 0x1p3 + . \r".split(b" ")
)
SOUP = st.lists(FIELDS, max_size=30).map(b" ".join)
GOOD = st.sampled_from([flaser().encode(), robotlaser().encode(), robotlaser(remissions=(1,)).encode()])


@st.composite
def mutated(draw) -> bytes:
    """A good line with a few fields replaced, doubled or cut out."""
    fields = draw(GOOD).split(b" ")
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, len(fields) - 1))
        fields[at : at + draw(st.integers(0, 2))] = draw(st.lists(FIELDS, max_size=2))
        fields = fields or [b""]
    return b" ".join(fields)


@given(
    lines=st.lists(st.one_of(GOOD, mutated(), SOUP, st.binary(max_size=40)), max_size=8),
    packed=st.booleans(),
    strict=st.booleans(),
    end=st.none() | st.integers(0, 400),
)
@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_bytes_lead_to_anything_but_a_log_error(tmp_path, lines, packed, strict, end):
    content = b"\n".join(lines)
    path = tmp_path / "fuzz.log"
    path.write_bytes((gzip.compress(content, 1) if packed else content)[:end])
    refusal, log, readings = None, None, []
    try:
        log = open_log(path, strict=strict)
        readings = list(log)
    except LogError as error:
        refusal = str(error)
    if refusal is not None or log is None:
        assert refusal is not None
        assert str(path) in refusal
        assert refusal.isprintable()
        return
    assert log.notes.scans == len(readings) > 0
    assert not (strict and log.notes.skipped)
    for reading in readings:
        assert reading.ranges.shape == reading.bearings.shape == (log.notes.beam_count,)
        assert reading.range_max > 0
        assert reading.odometry is not None
        for known in (reading.pose, reading.odometry, reading.bearings):
            assert np.isfinite(known).all()
        assert math.isfinite(reading.timestamp)
    for warning in log.notes.warnings():
        assert warning.isprintable()


# Real logs


@pytest.mark.parametrize(
    ("name", "scans", "beams", "backward", "jumps"),
    [
        ("intel", 910, 180, 4, 0),
        ("aces", 440, 180, 0, 0),
        ("fhw", 488, 180, 0, 6),
        ("freiburg-079", 4791, 360, 0, 0),
    ],
)
def test_real_logs(name, scans, beams, backward, jumps):
    path = DATA / f"{name}-corrected.log.gz"
    if not path.exists():
        pytest.skip(f"{path} is not there: the reader is not tested on the log {name}")
    log = open_log(path, strict=True)
    step = math.pi / 180 if beams == 180 else math.pi / 360
    stamps, last = [], None
    for reading in log:
        stamps.append(reading.timestamp)
        assert reading.ranges.shape == (beams,)
        last = reading
        assert reading.bearings[-1] == pytest.approx(-math.pi / 2 + (beams - 1) * step)
    assert len(stamps) == scans
    # The last scan once more, by the plainest route.
    fields = gzip.decompress(path.read_bytes()).decode().rpartition("FLASER")[2].partition("\n")[0].split()
    assert last is not None
    np.testing.assert_array_equal(last.ranges, [float(f) for f in fields[1 : 1 + beams]])
    np.testing.assert_array_equal(last.pose, [float(f) for f in fields[-9:-6]])
    assert last.timestamp == float(fields[-3])
    assert np.sum(np.diff(stamps) < 0) == log.notes.backward_stamps == backward
    assert log.notes.jumps == jumps
    assert (log.notes.beam_count, log.notes.skipped, log.notes.duplicates) == (beams, 0, {})
    assert len(log.notes.warnings()) == (backward > 0) + (jumps > 0)


# Poses that somebody gives


def test_given_poses_are_the_robots_and_scans_beyond_them_are_left_out(write):
    lines = [flaser(trailing=f"{stamp} host 0.5") for stamp in (9.0, 10.0, 10.5, 11.0)]
    poses = Trajectory(np.array([10.0, 11.0]), np.array([[0.0, 0.0, 3.0], [1.0, 2.0, -3.0]]))
    readings, notes = read(write(*lines), poses=poses, mount=(0.1, 0.2, 0.3), range_min=1.5)
    assert [r.timestamp for r in readings] == [10.0, 10.5, 11.0]
    np.testing.assert_allclose(readings[1].pose, [0.5, 1.0, math.pi])
    assert (readings[0].pose_frame, readings[0].mount, readings[0].range_min) == ("robot", (0.1, 0.2, 0.3), 1.5)
    assert notes.without_pose == 1
    of_laser = Trajectory(poses.stamps, poses.poses, "laser")
    assert (read(write(*lines), poses=of_laser)[0][0].pose_frame, notes.drift) == ("laser", None)
    readings, _ = read(write(*lines), poses=poses, need_poses=False)
    assert [r.pose is None for r in readings] == [True, False, False, False]
    late = Trajectory(np.array([1e3]), np.zeros((1, 3)))
    assert "none of its 4 scans lies in the time that the given poses cover" in refused(write(*lines), poses=late)
