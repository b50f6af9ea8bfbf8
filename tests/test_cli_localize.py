"""`linemap localize`: a drive through a room that the map knows, and on into one that it does not."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from maps import lines_between, poles_at

from linemap_jax.cli import main
from linemap_jax.cli.localize import Localize
from linemap_jax.cli.noise import noise_of_map, states_noise
from linemap_jax.core.settings import SensorNoise
from linemap_jax.core.state import LineMap
from linemap_jax.io.carmen_writer import write_carmen
from linemap_jax.io.map_file import read_map, write_map
from linemap_jax.io.tum import read_tum

BEAMS, KNOWN, UNKNOWN = 181, 24, 12
BEARINGS = np.deg2rad(np.arange(BEAMS) - 90.0)
# An L-shaped room with a box, m
CORNERS = np.array([(0, 0), (7, 0), (7, 3), (4, 3), (4, 6), (0, 6)], float)
BOX = np.array([(5.5, 0.8), (6.2, 0.8), (6.2, 1.5), (5.5, 1.5)])
HALL = np.array([(-5, -9), (9, -11), (13, 2), (6, 12), (-5, 10)], float)

pytestmark = pytest.mark.usefixtures("jax_as_it_was")


def walls(*polygons: np.ndarray) -> np.ndarray:
    return np.concatenate([np.stack([p, np.roll(p, -1, 0)], 1) for p in polygons])


def ranges_from(pose: np.ndarray, segments: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Cramer's rule for each beam and wall."""
    angle = pose[2] + BEARINGS[:, None]
    c, s = np.cos(angle), np.sin(angle)
    a, d = segments[:, 0] - pose[:2], segments[:, 1] - segments[:, 0]
    det = c * d[:, 1] - s * d[:, 0]
    reach = (a[:, 0] * d[:, 1] - a[:, 1] * d[:, 0]) / det
    along = (a[:, 0] * s - a[:, 1] * c) / det
    met = (reach > 0) & (along >= 0) & (along <= 1)
    return np.min(np.where(met, reach, np.inf), 1) + random.normal(0, 0.015, BEAMS)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The map and the log; the true poses."""
    folder, random = tmp_path_factory.mktemp("room"), np.random.default_rng(11)
    count = KNOWN + UNKNOWN
    t = np.arange(count)
    truth = np.stack([1 + 0.12 * t, 1.2 + 0.3 * np.sin(t / 8), 0.3 * np.cos(t / 8)], -1)
    known, other = walls(CORNERS, BOX), walls(HALL)
    ranges = [
        ranges_from(p, known, random) if i < KNOWN else ranges_from(np.array([0.1 * (i - KNOWN), 0, 0]), other, random)
        for i, p in enumerate(truth)
    ]
    # Odometry in a frame of its own, that counts 3 % too much and drifts by half a degree a step.
    odometry = np.zeros((count, 3))
    for i in range(1, count):
        step, theta = truth[i] - truth[i - 1], truth[i - 1, 2]
        turn = odometry[i - 1, 2] - theta
        move = 1.03 * np.array(
            [np.cos(turn) * step[0] - np.sin(turn) * step[1], np.sin(turn) * step[0] + np.cos(turn) * step[1]]
        )
        odometry[i] = odometry[i - 1] + [*move, step[2] + 0.009]
    write_carmen(
        folder / "drive.log",
        ranges=ranges,
        bearings=BEARINGS,
        range_max=40.0,
        poses=odometry,
        odometry=odometry,
        timestamps=100.0 + 0.2 * t,
    )
    line_map = LineMap(
        lines=lines_between(known, sigma=(0.02, 0.004), room=16, dtype="float32"), circles=poles_at([], dtype="float32")
    )
    write_map(folder / "map.json", line_map, {})
    few = (folder / "drive.log").read_text().splitlines(keepends=True)
    (folder / "few.log").write_text("".join(few[: len(few) // 6]))
    return {
        "log": folder / "drive.log",
        "few": folder / "few.log",
        "map": folder / "map.json",
        "truth": truth,
        "folder": folder,
    }


def test_the_way_through_a_room_and_out_of_the_map(room: dict[str, Any], capsys: Any) -> None:
    out = room["folder"] / "way"
    start = room["truth"][0] + [0.3, -0.3, 0.15]
    options = ["--start", *map(str, start.tolist()), "--jacobians", "analytic", "--json"]
    assert main(["localize", str(room["map"]), str(room["log"]), "-o", str(out), *options]) == 0
    captured = capsys.readouterr()
    summary = json.loads(captured.out)
    assert summary["scans"] == KNOWN + UNKNOWN
    assert summary["used"] == KNOWN
    assert summary["lost_at_the_end"]
    assert "lost in" in captured.err
    assert "was not found again" in captured.err
    assert (out / "trajectory.png").stat().st_size > 10_000

    trajectory = read_tum(out / "trajectory.tum")
    np.testing.assert_allclose(trajectory.stamps, 100 + 0.2 * np.arange(KNOWN + UNKNOWN), atol=1e-6)
    table = np.genfromtxt(out / "trajectory.csv", delimiter=",", names=True)
    found = np.stack([table[name] for name in ("x", "y", "theta")], -1)
    assert np.isfinite(found).all()
    error = np.abs(found - room["truth"])[:KNOWN]
    assert np.all(error < [0.05, 0.05, 0.01])
    # The stated sigmas: no better than the map's, and none is left where the robot is lost.
    sigma = np.sqrt(np.stack([table["cov_xx"], table["cov_yy"], table["cov_thetatheta"]], -1))
    assert np.all(sigma[1:KNOWN] < [0.05, 0.05, 0.01])
    assert np.all(sigma[1:KNOWN, :2] > 0.02 / np.sqrt(10))
    assert np.mean((error / sigma[:KNOWN]) ** 2) < 3
    assert not table["lost"][:KNOWN].any()
    assert table["lost"][-UNKNOWN // 2 :].all()
    assert np.all(sigma[-1] > [0.5, 0.5, 0.3])
    assert np.all(np.diff(sigma[KNOWN:, 0]) > 0)


def test_where_it_begins_is_told(room: dict[str, Any], tmp_path: Path, capsys: Any) -> None:
    for options, told in (([], True), (["--start", "1", "1.2", "0.3"], False)):
        path = tmp_path / f"{len(options)}.tum"
        assert main(["localize", str(room["map"]), str(room["few"]), "-o", str(path), *options]) == 0
        sentence = "linemap: without --start the first pose of the log is taken: 0.00 0.00 0.00\n"
        assert (sentence in capsys.readouterr().err) == told


def test_noise_that_is_not_stated_is_the_maps(tmp_path: Path) -> None:
    log, out, config = Path("a.log"), Path("a.tum"), tmp_path / "noise.toml"
    command = Localize(map=Path("map.json"), log=log, output=out)
    assert not states_noise(command)
    config.write_text("[thresholds]\nmin_length = 0.3\n")
    assert not states_noise(dataclasses.replace(command, config=config))
    config.write_text("[noise]\nrange_sigma = 0.03\n")
    for stated in ({"config": config}, {"scanner": "pls"}, {"range_sigma": 0.01}, {"bearing_sigma": 0.0}):
        assert states_noise(dataclasses.replace(command, **stated))

    one, other = ({"noise": {"range_sigma": sigma, "bearing_sigma": 0.002}} for sigma in (0.01, 0.02))
    assert noise_of_map(one) == SensorNoise(range_sigma=0.01, bearing_sigma=0.002)
    assert noise_of_map({"merged": [one, {"merged": [one, one]}]}) == noise_of_map(one)
    for settings in ({}, {"merged": [one, other]}, {"merged": [one, 3]}, {"merged": []}):
        assert noise_of_map(settings) is None
    for noise in (1, {"range_sigma": 0.01}, {"range_sigma": "much", "bearing_sigma": 0.0}):
        assert noise_of_map({"noise": noise}) is None


def test_the_noise_of_the_map_counts(room: dict[str, Any], tmp_path: Path) -> None:
    """As if it were stated; and what is stated goes before it."""
    line_map, _ = read_map(room["map"], dtype="float32")
    write_map(tmp_path / "map.json", line_map, {"noise": {"range_sigma": 0.05, "bearing_sigma": 0.001}})
    way = {}
    for name, of_map, options in (
        ("map", tmp_path / "map.json", []),
        ("stated", room["map"], ["--range-sigma", "0.05"]),
        ("other", tmp_path / "map.json", ["--range-sigma", "0.02"]),
    ):
        path = tmp_path / f"{name}.tum"
        assert main(["localize", str(of_map), str(room["few"]), "-o", str(path), "--quiet", *options]) == 0
        way[name] = path.with_suffix(".csv").read_text()
    assert way["map"] == way["stated"] != way["other"]


def test_what_is_refused(room: dict[str, Any], tmp_path: Path, capsys: Any) -> None:
    log, here = str(room["log"]), str(room["map"])
    empty = LineMap(lines=lines_between([], room=2), circles=poles_at([]))
    write_map(tmp_path / "empty.json", empty, {})
    (tmp_path / "there.tum").write_text("")
    for args, told in (
        ([str(tmp_path / "empty.json"), log, "-o", str(tmp_path / "a.tum")], "holds no line"),
        ([here, log, "-o", str(tmp_path / "a.tum"), "--start", "nan", "0", "0"], "--start must be finite"),
        ([here, log, "-o", str(tmp_path / "a.tum"), "--start-sigma", "-1", "0", "0"], "--start-sigma"),
        ([here, log, "-o", str(tmp_path / "a.tum"), "--odometry-noise", "0"], "--odometry-noise must be positive"),
        ([here, log, "-o", str(tmp_path / "there.tum")], "exists already"),
        ([log, log, "-o", str(tmp_path / "a.tum")], "drive.log"),
        ([log, here, "-o", str(tmp_path / "a.tum")], "the map comes first, then the log"),
    ):
        assert main(["localize", *args]) == 2
        assert told in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"empty.json", "there.tum"}
