"""What is written is read back: by our reader, and word by word."""

import gzip
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from linemap_jax.io.atomic import OutputError
from linemap_jax.io.carmen_writer import write_carmen
from linemap_jax.io.log import open_log
from linemap_jax.io.reading import Reading
from linemap_jax.io.tum import write_tum

HALF_TURN = np.radians(np.arange(361) / 2 - 90)
AROUND = np.radians(np.arange(360) - 180.0)
POSES = np.array([[1.0, -2.0, 0.5], [1.1, -2.25, -3.1]])
ODOMETRY = np.array([[0.0, 0.0, 0.0], [0.125, 0.0, 0.01]])
STAMPS = np.array([0.0, 0.25])


def readings(bearings: np.ndarray, range_max: float) -> np.ndarray:
    """Whole centimetres, some quarters of a millimetre, and what is not a return."""
    rng = np.random.default_rng(0)
    ranges = rng.integers(10, int(99 * range_max), (2, bearings.size)) / 100
    ranges[:, 1] = 1.23475
    ranges[:, 2:6] = [0, math.nan, math.inf, range_max]
    return ranges


def written(path: Path, bearings: np.ndarray, range_max: float, **options: Any) -> list[Reading]:
    write_carmen(
        path,
        ranges=readings(bearings, range_max),
        bearings=bearings,
        range_max=range_max,
        poses=POSES,
        odometry=ODOMETRY,
        timestamps=STAMPS,
        **options,
    )
    return list(open_log(path, strict=True))


@pytest.mark.parametrize(
    ("bearings", "range_max", "message"),
    [
        (HALF_TURN, 50.0, "FLASER"),
        (HALF_TURN[:-1], 8.0, "FLASER"),
        (HALF_TURN[::2], 30.0, "FLASER"),
        (HALF_TURN, 80.0, "ROBOTLASER1"),  # readers of the other form stop at 50 m
        (HALF_TURN[::-1], 50.0, "ROBOTLASER1"),
        (HALF_TURN[:-20], 50.0, "ROBOTLASER1"),
        (HALF_TURN + 0.01, 50.0, "ROBOTLASER1"),
        (AROUND, 12.0, "ROBOTLASER1"),
        (np.radians(np.arange(1081) / 4 - 135), 30.0, "ROBOTLASER1"),
    ],
)
def test_what_is_written_is_read_back(tmp_path, bearings, range_max, message):
    path = tmp_path / "a.log"
    found = written(path, bearings, range_max)
    log = open_log(path)
    list(log)
    assert log.notes.warnings() == []
    assert log.notes.messages[message] == 2

    expected = readings(bearings, range_max)
    returned = (expected > 0) & (expected < range_max)
    assert returned[:, 1].all()
    assert not returned[:, 2:6].any()
    for reading, ranges, is_return, pose, odometry, stamp in zip(
        found, expected, returned, POSES, ODOMETRY, STAMPS, strict=True
    ):
        np.testing.assert_allclose(reading.bearings, bearings, atol=1e-9)
        np.testing.assert_array_equal(reading.ranges[is_return], ranges[is_return])
        assert (reading.ranges < reading.range_max)[is_return].all()
        assert (reading.ranges >= range_max)[~is_return].all()
        if message == "ROBOTLASER1":
            assert reading.range_max == range_max
        np.testing.assert_allclose(reading.pose, pose, atol=1e-6)
        np.testing.assert_allclose(reading.odometry, odometry, atol=1e-6)
        assert reading.timestamp == stamp


def test_the_words_of_a_message(tmp_path):
    path = tmp_path / "a.log"
    row = {"poses": [[1, 2, 0.5]], "odometry": [[0, 0, 0]], "timestamps": [3]}
    write_carmen(
        path, ranges=[[1.5, 0, 2.25]], bearings=[-0.5, 0.0, 0.5], range_max=9.0, comments=["one", "two"], **row
    )
    assert path.read_text().splitlines() == [
        "# one",
        "# two",
        "# message formats defined: ROBOTLASER1",
        "ROBOTLASER1 0 -0.5 1.0 0.5 9.0 0.01 0 3 1.5 9.0 2.25 0 "
        "1.000000 2.000000 0.500000 0.000000 0.000000 0.000000 0 0 0 0 0 3.000000 nohost 3.000000",
    ]


def test_packed_bytes_depend_on_the_content_alone(tmp_path, monkeypatch):
    written(tmp_path / "a.log", AROUND, 12.0)
    first = written(tmp_path / "a.log.gz", AROUND, 12.0)
    monkeypatch.setattr("time.time", lambda: 1e9)
    written(tmp_path / "b.log.gz", AROUND, 12.0)
    assert (tmp_path / "a.log.gz").read_bytes() == (tmp_path / "b.log.gz").read_bytes()
    assert gzip.decompress((tmp_path / "a.log.gz").read_bytes()) == (tmp_path / "a.log").read_bytes()
    assert len(first) == 2


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"bearings": HALF_TURN[:-1]}, "differ in number"),
        ({"poses": POSES[:1]}, "differ in number"),
        ({"timestamps": STAMPS[:1]}, "differ in number"),
        ({"poses": POSES * math.nan}, "not finite"),
        ({"odometry": ODOMETRY + math.inf}, "not finite"),
        ({"range_max": math.inf}, "must be positive and finite"),
        ({"bearings": HALF_TURN**3}, "not at equal steps"),
    ],
)
def test_what_cannot_be_written(tmp_path, change, said):
    right: dict[str, Any] = {
        "ranges": readings(HALF_TURN, 50.0),
        "bearings": HALF_TURN,
        "range_max": 50.0,
        "poses": POSES,
        "odometry": ODOMETRY,
        "timestamps": STAMPS,
    }
    with pytest.raises(ValueError, match=said):
        write_carmen(tmp_path / "a.log", **right | change)
    assert list(tmp_path.iterdir()) == []


def test_an_older_file_is_kept(tmp_path):
    path = tmp_path / "a.log"
    path.write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        written(path, AROUND, 12.0)
    assert path.read_text() == "mine"
    assert len(written(path, AROUND, 12.0, overwrite=True)) == 2


def test_a_trajectory(tmp_path):
    path = tmp_path / "poses.tum"
    write_tum(path, STAMPS, POSES)
    rows = np.loadtxt(path)
    np.testing.assert_allclose(rows[:, 0], STAMPS)
    np.testing.assert_allclose(rows[:, 1:3], POSES[:, :2])
    np.testing.assert_array_equal(rows[:, 3:6], 0)
    np.testing.assert_allclose(2 * np.arctan2(rows[:, 6], rows[:, 7]), POSES[:, 2], atol=1e-9)
    with pytest.raises(OutputError, match="exists already"):
        write_tum(path, STAMPS, POSES)
