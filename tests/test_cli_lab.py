"""`linemap simulate`, `linemap evaluate`, `linemap trials`: from a world to a log and back to a score."""

import contextlib
import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely

from linemap_jax.cli import main, trials
from linemap_jax.cli.calibrate import _in_words as _calibrated
from linemap_jax.cli.options import MOST_SCANS, UsageError
from linemap_jax.cli.worlds import WorldKind, made_world
from linemap_jax.core.mapping import empty_map
from linemap_jax.core.settings import Capacity
from linemap_jax.core.state import LineMap
from linemap_jax.io.carmen_writer import write_carmen
from linemap_jax.io.config import read_config
from linemap_jax.io.log import open_log
from linemap_jax.io.map_file import write_map
from linemap_jax.io.table import ResultsTable
from linemap_jax.io.worlds import read_world

SCANS = 6
ROOM = [(-4.0, -3.0), (4.0, -3.0), (4.0, 3.0), (-4.0, 3.0)]
BOX = [(-0.5, 0.0), (0.5, 0.0), (0.5, 1.0), (-0.5, 1.0)]
PATH = [(-2.0, -1.0), (2.0, -1.0), (2.0, 1.5)]
SIGMA = 0.02, 0.02, 0.004


def feature(shape: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": shape, "coordinates": coordinates}, "properties": properties}


def closed(corners: list[tuple[float, float]]) -> list[list[tuple[float, float]]]:
    return [[*corners, corners[0]]]


def world_file(path: Path, *, room: Any = ROOM, box: Any = BOX, way: Any = PATH) -> Path:
    """A room, a box, a pole that is carried off before scan 3, and a path."""
    features = [
        feature("Polygon", closed(room), kind="room"),
        feature("Polygon", closed(box), kind="obstacle"),
        feature("Point", (3.0, -2.0), kind="pole", radius=0.1, vanishes=3),
    ]
    if way:
        features.append(feature("LineString", way, kind="path"))
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


@pytest.fixture(autouse=True)
def _without_a_cache(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """The command line would set up jax for its process, but leaves it as it is where the user has said."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path_factory.getbasetemp() / "cache"))
    assert jax.config.read("jax_enable_x64")


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs the command line in this process; gives the exit status, and what stands on stdout and stderr."""

    def run(*args: Any) -> tuple[int, str, str]:
        capsys.readouterr()
        status = main([str(arg) for arg in args])
        out, err = capsys.readouterr()
        return status, out, err

    return run


@pytest.fixture
def refuse(run: Callable[..., tuple[int, str, str]], tmp_path: Path) -> Callable[..., str]:
    """Runs what must be refused; gives the one sentence, once nothing is found to be left behind."""

    def refuse(*args: Any) -> str:
        before = sorted(tmp_path.rglob("*"))
        status, out, err = run(*args)
        assert (status, out) == (2, "")
        assert re.fullmatch(r"linemap: [^\n]+\n", err), err
        assert sorted(tmp_path.rglob("*")) == before
        return err.removeprefix("linemap: ").rstrip("\n")

    return refuse


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a simulated drive through the world above."""
    folder = tmp_path_factory.mktemp("lab")
    world = world_file(folder / "my.geojson")
    options = "--scans", SCANS, "--scanner", "rplidar_a1", "--pose-sigma", *SIGMA, "--pose-correlation", 1, "--seed", 5
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", str(folder / "cache"))
        args = "simulate", "--world", world, *options, "-o", folder / "out", "--quiet"
        assert main([str(arg) for arg in args]) == 0
    return folder / "out"


def true_poses(drive: Path) -> np.ndarray:
    rows = np.loadtxt(drive / "poses.tum")
    return np.column_stack([rows[:, 1:3], 2 * np.arctan2(rows[:, 6], rows[:, 7])])


# --- simulate --------------------------------------------------------------------------------------------------------


def test_the_log_is_what_was_to_be_seen(drive: Path) -> None:
    log = open_log(drive / "scans.log.gz", strict=True)
    readings = list(log)
    assert log.notes.warnings() == []
    assert len(readings) == SCANS
    poses = true_poses(drive)
    assert poses[0, :2] == pytest.approx(PATH[0])
    assert poses[-1, :2] == pytest.approx(PATH[-1])
    walls = shapely.union_all([shapely.LinearRing(ROOM), shapely.LinearRing(BOX)])
    pole = shapely.Point(3.0, -2.0).buffer(0.1, quad_segs=64).exterior
    errors = []
    for i, (reading, pose) in enumerate(zip(readings, poses, strict=True)):
        assert reading.bearings[[0, -1]] == pytest.approx(np.radians([-180, 179]))
        scene = shapely.union(walls, pole) if i < 3 else walls
        for bearing, measured in zip(reading.bearings[::7], reading.ranges[::7], strict=True):
            direction = np.array([np.cos(pose[2] + bearing), np.sin(pose[2] + bearing)])
            beam = shapely.LineString([pose[:2], pose[:2] + 20 * direction])
            exact = shapely.Point(pose[:2]).distance(scene.intersection(beam))
            if measured < reading.range_max:
                errors.append((measured - exact) / np.hypot(0.002, 0.005 * exact))
    assert len(errors) > 0.9 * SCANS * 360 / 7
    assert abs(np.median(errors)) < 0.3
    assert np.quantile(np.abs(errors), 0.9) < 2.5  # some beams come back from two things at once


def test_the_poses_of_the_log_are_off_and_all_by_the_same(drive: Path) -> None:
    off = np.stack([reading.pose for reading in open_log(drive / "scans.log.gz")]) - true_poses(drive)
    off[:, 2] = np.sin(off[:, 2])
    np.testing.assert_allclose(off, np.broadcast_to(off[0], off.shape), atol=2e-6)
    assert np.all(np.abs(off[0]) < 5 * np.array(SIGMA))
    assert np.all(np.abs(off[0]) > 1e-5)


def test_the_truth_is_the_world_that_was_given(drive: Path) -> None:
    given, told = read_world(drive.parent / "my.geojson"), read_world(drive / "world.geojson")
    jax.tree.map(np.testing.assert_array_equal, told, given)


def test_the_same_seed_gives_the_same_files_and_another_one_does_not(run, drive, tmp_path) -> None:
    for seed, is_same in ((5, True), (6, False)):
        options = "--scans", SCANS, "--scanner", "rplidar_a1", "--pose-sigma", *SIGMA, "--pose-correlation", 1
        world = drive.parent / "my.geojson"
        status, out, err = run("simulate", "--world", world, *options, "--seed", seed, "-o", tmp_path, "--overwrite")
        assert (status, err) == (0, "")
        assert f"{SCANS} scans of 360 beams along " in out
        assert "noise: --range-sigma 0.02508 --bearing-sigma 0.003 --pose-sigma 0.02 0.02 0.004\n" in out
        same = (tmp_path / "scans.log.gz").read_bytes() == (drive / "scans.log.gz").read_bytes()
        assert same == is_same


@pytest.mark.parametrize("kind", get_args(WorldKind))
def test_each_kind_of_world_has_a_path(kind: Any) -> None:
    world = jax.eval_shape(lambda key: made_world(kind, key, scans=300), jax.random.key(0))
    assert world.path.shape[0] > 1
    assert world.segments.valid.shape[0] >= 4


def test_worlds_that_cannot_be(refuse, tmp_path) -> None:
    out = "-o", tmp_path / "out", "--scans", SCANS, "--scanner", "rplidar_a1"
    file = tmp_path / "w.geojson"
    assert refuse("simulate", "--world", file, *out) == f"cannot read {file}: No such file or directory"
    file.write_text("{}")
    assert "is not a world" in refuse("simulate", "--world", file, *out)
    world_file(file, way=None)
    assert refuse("simulate", "--world", file, *out) == f"{file} has no path for the robot"
    world_file(file, room=[ROOM[i] for i in (0, 2, 1, 3)])
    assert refuse("simulate", "--world", file, *out) == f"{file}: the outline of the room that is body 0 meets itself"
    world_file(file, way=[(0.0, 0.5), *PATH[1:]])
    said = f"{file}: at scan 0 the robot stands inside the obstacle that is body 1"
    assert refuse("simulate", "--world", file, *out) == said
    world_file(file, way=[PATH[0], (2.0, 2.5), (-3.5, -1.5)])
    assert f"{file}: at scan " in (said := refuse("simulate", "--world", file, *out))
    assert "the obstacle that is body 1" in said


@pytest.mark.parametrize(
    "option",
    [
        "--scans 0",
        "--scans 20001",
        "--pose-sigma 0 -1 0",
        "--pose-sigma nan 0 0",
        "--pose-correlation 1.1",
        "--seed -1",
    ],
)
def test_numbers_that_make_no_sense(refuse, tmp_path, option) -> None:
    assert refuse("simulate", "-o", tmp_path / "out", *option.split()).startswith(option.split()[0] + " must be ")


@pytest.mark.parametrize("name", ["scans.log.gz", "world.geojson", "poses.tum"])
def test_output_that_is_there_is_kept(refuse, tmp_path, name) -> None:
    (tmp_path / name).write_text("mine")
    assert refuse("simulate", "-o", tmp_path) == f"{tmp_path / name} exists already; use --overwrite to replace it"
    assert (tmp_path / name).read_text() == "mine"


# --- evaluate --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def map_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The walls of the room, 1 cm too far out; a line of 1 m that stands for nothing; the pole; not the box."""
    empty = empty_map(Capacity(8, 1))
    corners = np.array(ROOM)
    middle = (corners + np.roll(corners, -1, 0)) / 2
    lines = dataclasses.replace(
        empty.lines,
        anchor=jnp.asarray([*middle, (-2.0, 1.0), *[(0.0, 0.0)] * 3]),
        offset=jnp.asarray([0.01] * 4 + [0.0] * 4),
        angle=jnp.asarray([-np.pi / 2, 0, np.pi / 2, np.pi, 0.3, 0, 0, 0]),
        extent=jnp.asarray([[-4, 4], [-3, 3]] * 2 + [[-0.5, 0.5]] + [[0.0, 0.0]] * 3),
        cov_independent=jnp.tile(jnp.eye(2) * 1e-4, (8, 1, 1)),
        times_detected=jnp.full(8, 3, jnp.int32),
        valid=jnp.arange(8) < 5,
    )
    circles = dataclasses.replace(
        empty.circles,
        center=jnp.asarray([[3.02, -2.0]]),
        radius=jnp.asarray([0.1]),
        times_detected=jnp.ones(1, jnp.int32),
        valid=jnp.ones(1, bool),
    )
    path = tmp_path_factory.mktemp("map") / "map.json"
    write_map(path, LineMap(lines=lines, circles=circles), {})
    return path


def test_a_map_against_the_truth(run, drive, map_file) -> None:
    world = drive / "world.geojson"
    status, out, err = run("evaluate", map_file, "--world", world, "--at", 2, "--json")
    assert (status, err) == (0, "")
    score = json.loads(out)["truth"]
    assert score["at"] == 2
    assert score["precision"] == pytest.approx(28 / 29)
    assert score["recall"] == pytest.approx(28 / 32)
    assert (score["lines"], score["phantom_lines"]) == (5, 1)
    assert (score["walls"], score["walls_held_twice"], score["fragments"]) == (8, 0, 0)
    assert score["offset_rms_m"] == pytest.approx(0.01)
    assert score["angle_rms_rad"] == pytest.approx(0, abs=1e-9)
    assert score["mean_nees"] == pytest.approx(1)
    assert (score["poles"], score["missed_poles"], score["phantom_circles"]) == (1, 0, 0)
    assert (score["gone"], score["gone_but_held"]) == (0, 0)

    status, out, err = run("evaluate", map_file, "--world", world)
    assert (status, err) == (0, "")
    assert out.splitlines() == [
        "precision 96.6% of 29.0 m of lines, within 5 cm; 1 of 5 lines are phantoms",
        "recall 87.5% of 32.0 m of walls that could be seen; 0 of 8 walls are held twice, 0 pieces are too many",
        "error 1.0 cm, 0.00 degrees (rms); mean NEES 1.00 (2 if the covariances are right)",
        "0 of 0 poles are missed, 0 held twice; 1 of 1 circles are phantoms",
        "1 of 1 things that are gone are still held",
    ]


def test_a_map_against_a_log_and_the_truth(run, drive, map_file) -> None:
    log = "--log", drive / "scans.log.gz"
    status, out, err = run(
        "evaluate", map_file, "--world", drive / "world.geojson", *log, "--json", "--distance", 0.005
    )
    assert (status, err) == (0, "")
    score = json.loads(out)
    assert score["truth"]["at"] == SCANS - 1
    assert score["truth"]["recall"] == 0  # the walls are off by more
    assert 20 < score["truth"]["seen_length_m"] < 32
    assert score["truth"]["gone"] == 1
    assert score["log"]["scans"] == SCANS
    assert 0.9 * SCANS * 360 < score["log"]["returns"] <= SCANS * 360
    assert 0.6 < score["log"]["explained"] < 0.95  # the box is not in the map
    assert score["log"]["met"] > 0.99
    assert 0.01 < score["log"]["residual_median_m"] < 0.08
    assert 0.5 < score["log"]["residual_90_m"] < 6

    status, out, err = run("evaluate", map_file, *log)
    assert (status, err) == (0, "")
    said = r"\d\d\.\d% of the returns under 20 m lie within 10 cm of the map; along the beam they are off by "
    assert re.fullmatch(said + r"\d\.\d cm \(median\), \d+\.\d cm \(90 %\)\n", out), out


def test_a_log_without_returns_says_nothing(run, map_file, tmp_path) -> None:
    nothing = np.zeros((2, 360))
    row = {"poses": np.zeros((2, 3)), "odometry": np.zeros((2, 3)), "timestamps": [0, 1]}
    bearings = np.radians(np.arange(360) - 180.0)
    write_carmen(tmp_path / "a.log", ranges=nothing, bearings=bearings, range_max=12.0, **row)
    status, out, err = run("evaluate", map_file, "--log", tmp_path / "a.log", "--json")
    assert (status, err) == (0, "")
    score = json.loads(out)["log"]
    assert score["returns"] == 0
    assert {score[name] for name in ("explained", "met", "residual_median_m", "residual_90_m")} == {None}


def test_what_cannot_be_evaluated(refuse, map_file, drive, tmp_path) -> None:
    world = "--world", drive / "world.geojson"
    assert refuse("evaluate", map_file) == "evaluate needs --world, --log, or both"
    assert refuse("evaluate", tmp_path / "no.json", *world).startswith(f"cannot read {tmp_path / 'no.json'}: ")
    assert "features[0]" in refuse("evaluate", map_file, "--world", bad_world(tmp_path))
    crossing = world_file(tmp_path / "x.geojson", room=[ROOM[i] for i in (0, 2, 1, 3)])
    assert refuse("evaluate", map_file, "--world", crossing).endswith("the room that is body 0 meets itself")
    assert refuse("evaluate", map_file, "--log", tmp_path / "no.log").startswith(
        f"{tmp_path / 'no.log'}: cannot be read"
    )
    assert refuse("evaluate", map_file, *world, "--distance", 0) == "--distance must be positive, not 0.0"
    assert refuse("evaluate", map_file, *world, "--at", -1).startswith("--at must be ")
    assert refuse("evaluate", map_file, *world, "--range-max", 0).startswith("--range-max must be ")


def bad_world(folder: Path) -> Path:
    path = folder / "bad.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature("Point", ["here"])]}))
    return path


# --- trials ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trials, "BATCH_RUNS", 2)
    monkeypatch.setattr(trials, "CHUNK_RUNS", 2)


@pytest.mark.usefixtures("small_chunks")
def test_trials_that_were_stopped_or_were_fewer_go_on_with_the_same_result(run, monkeypatch, tmp_path: Path) -> None:
    options = "--kind", "room", "--scans", 4, "--sweep", "match_nis", "--devices", 1
    args = "trials", "-o", tmp_path / "out", *options
    status, out, err = run(*args, "--runs", 1)
    assert (status, err) == (0, "linemap: compiles for 1 device (cpu), and writes every 2 drives\n")
    assert "7 drives -> " in out
    parts = sorted((tmp_path / "out").glob("*.parquet"))
    whole = [pq.read_table(part) for part in parts]
    assert [len(part) for part in whole] == [2, 2, 2, 1]
    assert set(whole[0].column("walls").to_pylist()) <= {3, 4}  # of the room, with 180 degrees
    assert {row for part in whole for row in part.column("drive").to_pylist()} == {0}

    # As if it had been killed after the first chunk; and then there shall be more
    for part in parts[1:]:
        part.unlink()
    monkeypatch.setattr(trials, "PACE", 0.0)
    status, out, err = run(*args, "--runs", 2, "--json")
    assert status == 0
    said = [f"2 of 14 drives are in {tmp_path}/out already", "compiles for 1 device (cpu), and writes every 2 drives"]
    said += [f"{n} of 14 drives" for n in range(4, 15, 2)]
    assert err.splitlines() == [f"linemap: {sentence}" for sentence in said]
    now = pq.read_table(tmp_path / "out")
    assert now[:7] == pa.concat_tables(whole)
    assert now.column("drive").to_pylist() == [0] * 7 + [1] * 7
    variants = json.loads(out)["variants"]
    assert [x["threshold"] for x in variants] == ["match_nis"] * 7
    assert [x["value"] for x in variants] == pytest.approx([9.21 * x for x in (0.25, 0.5, 0.7, 1, 1.4, 2, 4)])
    missed = [x["missed_matches"] for x in variants]
    assert missed == sorted(missed, reverse=True)


@pytest.mark.parametrize(("asked", "hosts", "of_cpu"), [(None, 1, 2), (1, 1, 2), (8, 1, 8), (9, 2, 5), (257, 1, 2)])
def test_a_processor_stands_for_as_many_devices_as_are_asked_for(asked, hosts, of_cpu, monkeypatch, tmp_path) -> None:
    told: dict[str, int] = {}
    monkeypatch.setattr(trials.os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setattr(jax.config, "update", told.__setitem__)
    monkeypatch.setattr(trials.Trials, "_connect", lambda _: None)
    with contextlib.suppress(UsageError):  # the devices of this process are counted already
        trials.Trials(output=tmp_path, devices=asked, hosts=hosts)._mesh()
    assert told == {"jax_num_cpu_devices": of_cpu}


def test_whoever_interrupts_trials_is_told_what_is_kept(run, monkeypatch, tmp_path: Path) -> None:
    def work(_: trials.Trials) -> int:
        table = ResultsTable(tmp_path, {})
        table.append(0, {"drive": np.arange(3)})
        with trials._interruptible(table, 7):
            raise KeyboardInterrupt
        raise AssertionError

    monkeypatch.setattr(trials.Trials, "run", work)
    kept = f"3 of 7 drives are in {tmp_path}; the same command goes on from there"
    assert run("trials", "-o", tmp_path) == (130, "", f"linemap: interrupted; {kept}\n")


def test_trials_that_make_no_sense_are_refused(refuse, tmp_path: Path) -> None:
    out = "-o", tmp_path / "out"
    assert refuse("trials", *out, "--runs", 0) == "--runs must be from 1 to 100000000, not 0"
    assert refuse("trials", *out, "--scans", 0) == f"--scans must be from 1 to {MOST_SCANS}, not 0"
    assert refuse("trials", *out, "--host", 1) == "--host must be from 0 to --hosts less one, not 1 of 1"
    assert "several --hosts need a --coordinator" in refuse("trials", *out, "--hosts", 2)
    assert "must be ADDRESS:PORT, not here" in refuse("trials", *out, "--hosts", 2, "--coordinator", "here")
    assert "1000 devices was asked for" in refuse("trials", *out, "--devices", 1000)
    assert refuse("trials", *out, "--config", tmp_path / "none.toml").startswith(f"cannot read {tmp_path}/none.toml")
    assert "there is no threshold 'nis': choose from gap_distance, " in refuse("trials", *out, "--sweep", "nis")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("all of it")
    assert "holds no table of results" in refuse("trials", "-o", tmp_path / "mine")


# --- calibrate -------------------------------------------------------------------------------------------------------


def test_noise_is_told_from_a_log_and_taken_by_build(run, tmp_path: Path) -> None:
    args = "--kind", "room", "--scans", 40, "--pose-sigma", 0.02, 0.02, 0.004, "--quiet"
    assert run("simulate", "-o", tmp_path / "drive", *args)[0] == 0
    log, config = tmp_path / "drive/scans.log.gz", tmp_path / "new" / "noise.toml"
    status, out, err = run("calibrate", log, "-o", config, "--json")
    assert (status, err) == (0, "linemap: 40 scans read; estimating, which takes a minute\n")
    found = json.loads(out)
    assert found["scans"] == 40
    assert found["range_m"]["sigma"] == pytest.approx(np.hypot(0.05 / 3, 0.01 / np.sqrt(12)), rel=0.1)
    for name, sigma in (("x_m", 0.02), ("y_m", 0.02), ("theta_rad", 0.004)):
        assert found[name]["from"] / 1.5 < sigma < found[name]["to"] * 1.5
    assert read_config(config)["noise"]["range_sigma"] == pytest.approx(found["range_m"]["sigma"], rel=1e-3)


def test_what_a_log_does_not_tell_is_not_proposed() -> None:
    names = "range_m", "bearing_rad", "x_m", "y_m", "theta_rad", "walls_m", "walls_rad"
    rows = {name: {"sigma": 0.01, "from": 0.009, "to": 0.011} for name in names}
    summary = {"beams": 9000, "lines": 300, "scans": 40}
    *_, proposed = _calibrated(rows, summary).splitlines()
    assert proposed == "--range-sigma 0.01 --bearing-sigma 0.01 --pose-sigma 0.01 0.01 0.01"
    rows["x_m"] = {"sigma": 1e-6, "from": 1e-9, "to": 1e-3}
    found = _calibrated(rows, summary).splitlines()
    assert found[-1] == "--range-sigma 0.01 --bearing-sigma 0.01"
    assert "  x        1e-06 m (not told by this log)" in found


def test_what_no_noise_can_be_told_from_is_refused(refuse, tmp_path: Path, drive: Path) -> None:
    assert refuse("calibrate", tmp_path / "none.log").startswith(f"{tmp_path}/none.log: cannot be read")
    log = drive / "scans.log.gz"
    assert refuse("calibrate", log, "--lag", 0).startswith("--lag must be from 1")
    assert refuse("calibrate", log, "--scans", 1).startswith("--scans must be from 2")
    assert refuse("calibrate", log, "--range-max", -1).startswith("--range-max must be positive")
    assert refuse("calibrate", log, "--laser-offset", "nan", 0, 0).startswith("--laser-offset must be finite")
    (tmp_path / "noise.toml").write_text("")
    assert "--overwrite" in refuse("calibrate", log, "-o", tmp_path / "noise.toml")
