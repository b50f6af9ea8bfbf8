"""The command line: its contract, and what it says about bad input."""

import gzip
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import Recording

from linemap_jax import PAPER_RULES, PAPER_THRESHOLDS, Rules, Thresholds
from linemap_jax.cli import main
from linemap_jax.cli.build import Build
from linemap_jax.cli.extract import Extract
from linemap_jax.io.config import read_config

BEAMS = 361  # as many as in the log of the demo, and one number in the whole file: each other would be compiled anew
SCANS = 10
BEARINGS = np.deg2rad(np.arange(BEAMS) / 2 - 90.0)
WEST, SOUTH, EAST, NORTH = -2.0, -3.0, 6.0, 3.0  # m: a room
POLE = np.array([3.0, 1.0, 0.13])  # m: x, y, radius

pytestmark = pytest.mark.usefixtures("jax_as_it_was")


def ranges_at(x: float, y: float, rng: np.random.Generator) -> np.ndarray:
    """What a scanner sees that looks east."""
    cos, sin = np.cos(BEARINGS), np.sin(BEARINGS)
    with np.errstate(divide="ignore"):
        wall = np.minimum((EAST - x) / cos, np.where(sin > 0, NORTH - y, SOUTH - y) / sin)
    step = POLE[:2] - (x, y)
    ahead, aside = cos * step[0] + sin * step[1], cos * step[1] - sin * step[0]
    with np.errstate(invalid="ignore"):
        pole = ahead - np.sqrt(POLE[2] ** 2 - aside**2)
    return np.fmin(wall, pole) + rng.normal(0, 0.01, BEAMS)


def flaser(ranges: Any, pose: tuple[Any, ...] = (0, 0, 0), stamp: Any = 1.0) -> str:
    numbers = " ".join(f"{r:.3f}" for r in ranges)
    return f"FLASER {len(ranges)} {numbers} {' '.join(map(str, pose * 2))} {stamp} robot 0.5"


def drive(count: int = SCANS) -> list[str]:
    rng = np.random.default_rng(5)
    xs = np.linspace(0.0, 0.9, count)
    return [flaser(ranges_at(x, 0.0, rng), (round(x, 3), 0, 0), 100 + i) for i, x in enumerate(xs)]


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def write(*lines: str, name: str = "some.log") -> Path:
        path = tmp_path / name
        path.write_text("".join(line + "\n" for line in lines))
        return path

    return write


@pytest.fixture
def log(write: Callable[..., Path]) -> Path:
    return write(*drive())


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs the command line in this process; gives the exit status, and what stands on stdout and stderr."""

    def run(*args: Any) -> tuple[int, str, str]:
        capsys.readouterr()
        try:
            status = main([str(arg) for arg in args])
        except SystemExit as stop:  # of the parser
            status = int(stop.code or 0)
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def refuse(run: Callable[..., tuple[int, str, str]], tmp_path: Path) -> Callable[..., str]:
    """Runs what must be refused; gives the one sentence, once nothing is found to be left behind."""

    def refuse(*args: Any) -> str:
        before = tree(tmp_path)
        status, out, err = run(*args)
        assert status == 2
        assert out == ""
        assert re.fullmatch(r"linemap: [^\n]+\n", err), err
        assert tree(tmp_path) == before
        return err.removeprefix("linemap: ").rstrip("\n")

    return refuse


def tree(folder: Path) -> dict[str, bytes | None]:
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def sides(lines: list[dict[str, Any]]) -> set[str]:
    """The walls of the room that the lines of a map lie on; "none" for a line that lies on no wall."""
    walls = {"north": (NORTH, np.pi / 2), "east": (EAST, 0.0), "south": (-SOUTH, -np.pi / 2)}

    def side(line: dict[str, Any]) -> str:
        near = [name for name, wall in walls.items() if np.allclose((line["rho"], line["theta"]), wall, atol=0.1)]
        return near[0] if near else "none"

    return {side(line) for line in lines}


def command(*args: Any, **environment: str) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "linemap_jax.cli", *map(str, args)],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


# --- What it does ----------------------------------------------------------------------------------------------------


def test_build_writes_a_map_and_a_picture_and_says_what_it_found(run, log, tmp_path):
    status, out, err = run("build", log, "-o", tmp_path / "out")

    assert (status, err) == (0, "")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["map.json", "map.png"]
    assert (tmp_path / "out/map.png").read_bytes().startswith(b"\x89PNG")
    document = json.loads((tmp_path / "out/map.json").read_text())
    assert (document["format"], document["version"]) == ("linemap", 1)
    assert document["settings"]["preset"] == "default"
    assert sides(document["lines"]) == {"north", "east", "south"}
    assert len(document["circles"]) == 1
    assert document["circles"][0]["center"] == pytest.approx(POLE[:2], abs=0.1)
    for line in document["lines"]:
        assert {"rho", "theta", "cov", "begin", "end", "times_detected"} <= line.keys()
    # East is seen in two pieces, beside the pole: the shorter one is too short for a line in some of the scans.
    pieces = [sides([line]) for line in document["lines"]]
    assert (len(pieces), pieces.count({"east"})) == (4, 2)
    assert sorted(line["times_detected"] for line in document["lines"]) == [SCANS - 2, SCANS, SCANS, SCANS]
    assert f"{SCANS} scans -> {len(document['lines'])} lines, 1 circles" in out
    assert re.search(r"\d s to compile, too few scans to time\n", out)
    assert str(tmp_path / "out/map.json") in out


def test_build_as_json(run, log, tmp_path):
    status, out, err = run("build", log, "-o", tmp_path / "out", "--json")

    assert (status, err) == (0, "")
    summary = json.loads(out)
    document = json.loads((tmp_path / "out/map.json").read_text())
    found = SCANS, len(document["lines"]), len(document["circles"])
    assert (summary["scans"], summary["lines"], summary["circles"]) == found
    assert 0.9 < summary["explained"] <= 1
    assert summary["duplicates"] == 0
    assert summary["us_per_scan"] is None  # there is but one chunk, and in it the compilation
    assert summary["seconds_to_first_chunk"] > 0
    assert summary["counts"]["added"] >= 4
    assert summary["map"] == str(tmp_path / "out/map.json")


def test_extract_writes_one_line_a_scan_in_the_frame_of_the_sensor(run, log, tmp_path):
    status, out, err = run("extract", log, "-o", tmp_path / "found.jsonl")

    assert (status, out) == (0, "")
    assert err == f"linemap: {SCANS} scans -> {tmp_path / 'found.jsonl'}\n"
    scans = [json.loads(line) for line in (tmp_path / "found.jsonl").read_text().splitlines()]
    assert [scan["timestamp"] for scan in scans] == [100 + i for i in range(SCANS)]
    for i, scan in enumerate(scans):
        assert scan.keys() == {"timestamp", "pose", "lines", "circles"}
        x = 0.1 * i
        assert scan["pose"] == pytest.approx([x, 0, 0])
        # The east wall comes nearer as the robot drives towards it.
        assert min(abs(line["rho"] - (EAST - x)) for line in scan["lines"]) < 0.02
        assert min(abs(np.array(circle["center"]) - (POLE[:2] - (x, 0))).max() for circle in scan["circles"]) < POLE[2]
        for line in scan["lines"]:
            assert line.keys() == {"rho", "theta", "cov", "begin", "end"}

    # The covariances are of the sensor alone: those of poses and mounting are not in them.
    others = "--pose-sigma", 9, 9, 9, "--laser-offset", 1, 2, 3
    assert run("extract", log, "-o", tmp_path / "others.jsonl", *others)[0] == 0
    assert (tmp_path / "others.jsonl").read_text() == (tmp_path / "found.jsonl").read_text()


def test_every_nth_scan(run, log, tmp_path):
    assert run("extract", log, "-o", tmp_path / "found.jsonl", "--every", 3, "--quiet") == (0, "", "")
    stamps = [json.loads(line)["timestamp"] for line in (tmp_path / "found.jsonl").read_text().splitlines()]
    assert stamps == [100, 103, 106, 109]


def test_config_goes_over_the_preset_and_options_over_both(run, log, tmp_path):
    config = tmp_path / "settings.toml"
    config.write_text("[thresholds]\nmin_length = 7.0\n[noise]\nrange_sigma = 0.5\nbearing_sigma = 0.002\n")
    status, _, err = run("build", log, "-o", tmp_path / "out", "--config", config, "--range-sigma", 0.03)

    assert (status, err) == (0, "")
    document = json.loads((tmp_path / "out/map.json").read_text())
    assert document["settings"]["thresholds"]["min_length"] == 7.0
    assert document["settings"]["noise"] == {"range_sigma": 0.03, "bearing_sigma": 0.002}
    assert document["lines"] == []  # the longest wall has 6 m


def test_the_settings_come_as_a_file_that_is_read_back(run, refuse, tmp_path):
    status, text, _ = run("config", "--preset", "paper", "--scanner", "pls")
    assert status == 0
    # 5 cm / 3, and rounding to 1 cm
    assert re.search(r"^\[noise\]\n# Of a range, m\.(.*\n# )*.*\nrange_sigma = 0\.0169\n", text, re.MULTILINE)
    (tmp_path / "settings.toml").write_text(text)
    options = read_config(tmp_path / "settings.toml")
    assert Thresholds(**options["thresholds"]) == PAPER_THRESHOLDS
    assert Rules(**options["rules"]) == PAPER_RULES
    assert run("config", "--config", tmp_path / "settings.toml") == (0, text, "")
    (tmp_path / "settings.toml").write_text(text.replace("gap_beams", "gap_beam"))
    assert "did you mean 'gap_beams'?" in refuse("config", "--config", tmp_path / "settings.toml")


def test_the_paper_preset_in_float64_with_two_rules_switched(run, log, tmp_path):
    config = tmp_path / "settings.toml"
    config.write_text("[rules]\nfit_circles = true\nweigh_circles = true\n")
    args = "--preset", "paper", "--dtype", "float64", "--config", config, "--range-sigma", 0.01
    status, _, err = run("build", log, "-o", tmp_path / "out", *args)

    assert (status, err) == (0, "")
    document = json.loads((tmp_path / "out/map.json").read_text())
    assert document["dtype"] == "float64"
    assert document["settings"]["covariance"] == "printed"
    rules = document["settings"]["rules"]
    assert [name for name, is_on in rules.items() if is_on] == ["fit_circles", "weigh_circles"]
    assert len(document["lines"]) >= 3
    assert any("cov" in circle for circle in document["circles"])


def test_all_options_of_the_contract_are_there():
    given = {name.replace("_", "-") for kind in (Build, Extract) for name in kind.__dataclass_fields__}
    assert {
        *("preset", "range-sigma", "bearing-sigma", "pose-sigma", "range-min", "range-max", "laser-offset"),
        *("covariance", "jacobians", "segmentation", "every", "config", "dtype", "strict", "overwrite", "quiet"),
    } <= given


def test_ranges_can_be_cut_off(run, log, tmp_path):
    args = "--range-min", 2.9, "--range-max", 5.0
    assert run("extract", log, "-o", tmp_path / "found.jsonl", "--quiet", *args)[0] == 0
    for line in (tmp_path / "found.jsonl").read_text().splitlines():
        ends = [point for found in json.loads(line)["lines"] for point in (found["begin"], found["end"])]
        assert all(2.8 < np.hypot(*point) < 5.1 for point in ends)


def test_an_offset_of_the_laser_has_no_effect_on_poses_of_the_laser(run, log, tmp_path):
    for name, args in (("out", ()), ("moved", ("--laser-offset", 1, 0, 0.5))):
        status, _, err = run("build", log, "-o", tmp_path / name, *args)
        assert status == 0
    assert re.fullmatch(r"linemap: warning: [^\n]*--laser-offset has no effect\n", err), err
    maps = [json.loads((tmp_path / name / "map.json").read_text()) for name in ("out", "moved")]
    assert maps[0] == maps[1]


def test_demo_is_quiet_and_ends_well(tmp_path):
    done = command("demo", "-o", tmp_path / "out")

    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert re.match(r"\d+ scans -> \d+ lines, \d+ circles", done.stdout)
    assert re.search(r"\d s to compile, then \d+ us a scan\n", done.stdout)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["map.json", "map.png"]
    document = json.loads((tmp_path / "out/map.json").read_text())
    assert len(document["lines"]) > 40
    assert len(document["circles"]) > 10


def test_a_real_log(run, data, tmp_path):
    log = data("carmen/intel-corrected.log.gz")
    status, out, _ = run("build", log, "-o", tmp_path / "out", "--every", 20, "--json")

    assert status == 0
    summary = json.loads(out)
    assert summary["scans"] == 46
    assert summary["lines"] > 50
    assert summary["explained"] > 0.5


# --- Odd input that is read all the same -----------------------------------------------------------------------------


def test_malformed_lines_are_skipped_and_counted(run, write, tmp_path):
    lines = drive()
    lines[2] = lines[2].replace(" ", " x", 2)
    lines[5] = lines[5][:300]
    status, out, err = run("build", write(*lines), "-o", tmp_path / "out")

    assert status == 0
    assert f"{SCANS - 2} scans -> " in out
    assert re.fullmatch(r"linemap: warning: [^\n]*2 malformed lines were skipped \(lines 3, 6\)[^\n]*\n", err), err


def test_malformed_lines_are_refused_if_strict(refuse, write, tmp_path):
    lines = drive()
    lines[2] = lines[2].replace(" ", " x", 2)
    path = write(*lines)
    assert refuse("build", path, "-o", tmp_path / "out", "--strict").startswith(f"{path}, line 3: ")
    assert refuse("extract", path, "-o", tmp_path / "found.jsonl", "--strict").startswith(f"{path}, line 3: ")


def test_another_number_of_beams_in_mid_log(run, refuse, write, tmp_path):
    lines = drive()
    lines[4] = flaser(np.full(90, 3.0))
    path = write(*lines)
    told = f"the FLASER message has 90 beams, the first scan of the log {BEAMS}"
    status, out, err = run("build", path, "-o", tmp_path / "out")
    assert status == 0
    assert f"{SCANS - 1} scans -> " in out
    assert "line 5" in err
    assert told in err
    assert refuse("build", path, "-o", tmp_path / "strict", "--strict") == f"{path}, line 5: {told}"


def test_a_pose_that_is_not_finite(run, refuse, write, tmp_path):
    lines = drive()
    lines[4] = flaser(np.full(BEAMS, 3.0), ("nan", 0, 0))
    path = write(*lines)
    status, out, err = run("build", path, "-o", tmp_path / "out")
    assert status == 0
    assert f"{SCANS - 1} scans -> " in out
    assert "line 5: the laser pose of the FLASER message is not finite" in err
    assert refuse("build", path, "-o", tmp_path / "strict", "--strict").startswith(f"{path}, line 5: the laser pose")


def test_readings_that_are_no_returns_change_nothing_else(run, write, tmp_path):
    lines = drive()
    broken = [field.split(" ") for field in lines]
    for fields in broken:
        for beam, reading in zip(
            range(20, 160, 10), ["nan", "inf", "-inf", "-1.0", "0", "81.83", "1e400"] * 2, strict=True
        ):
            fields[2 + beam] = reading
    path = write(*(" ".join(fields) for fields in broken))
    status, out, err = run("build", path, "-o", tmp_path / "out", "--strict")
    assert (status, err) == (0, "")
    document = json.loads((tmp_path / "out/map.json").read_text())
    assert sides(document["lines"]) == {"north", "east", "south"}
    assert len(document["circles"]) == 1


EMPTY_SCANS = {
    "no return": np.full(BEAMS, 81.83),
    "one return": np.where(np.arange(BEAMS) == 180, 2.0, 81.83),
    "all at the scanner": np.full(BEAMS, 0.0),
    "all points nearly equal": np.full(BEAMS, 0.001),
}


@pytest.mark.parametrize("kind", EMPTY_SCANS)
def test_scans_that_hold_nothing(run, write, tmp_path, kind):
    path = write(*[flaser(EMPTY_SCANS[kind], (0, 0, 0), 100 + i) for i in range(3)])
    status, out, err = run("build", path, "-o", tmp_path / "out")
    assert status == 0
    document = json.loads((tmp_path / "out/map.json").read_text())
    assert document["lines"] == []
    assert len(document["circles"]) <= 1
    if not document["circles"]:
        said = re.fullmatch(
            rf"linemap: warning: \S+: nothing was found in {3 * BEAMS} beams: (\d+) gave no return.*\n", err
        )
        assert said is not None, err
        assert int(said[1]) == 3 * np.sum(~((EMPTY_SCANS[kind] > 0) & (EMPTY_SCANS[kind] < 50)))
        assert run("extract", path, "-o", tmp_path / "again.jsonl")[2].startswith(err)
    else:
        assert err == ""
    assert run("extract", path, "-o", tmp_path / "found.jsonl", "--quiet") == (0, "", "")
    assert len((tmp_path / "found.jsonl").read_text().splitlines()) == 3


def test_a_scan_without_returns_among_others_changes_nothing(run, write, tmp_path):
    lines = drive()
    run("build", write(*lines), "-o", tmp_path / "full")
    lines.insert(4, flaser(np.full(BEAMS, 81.83), (50, 50, 1)))
    run("build", write(*lines), "-o", tmp_path / "with")
    full, others = (json.loads((tmp_path / name / "map.json").read_text()) for name in ("full", "with"))
    assert full["lines"] == others["lines"]
    assert full["circles"] == others["circles"]


def test_time_stamps_that_jump(run, write, tmp_path):
    rng = np.random.default_rng(5)
    stamps = [100.0, 101.0, 50.0, 1e9, 1e9 + 1]
    path = write(*[flaser(ranges_at(0, 0, rng), (0, 0, 0), stamp) for stamp in stamps])
    status, out, err = run("extract", path, "-o", tmp_path / "found.jsonl", "--strict")
    assert status == 0
    assert "the time stamp steps back at 1 scan (line 3)" in err
    assert "1 scan came more than 60 s after the scan before (line 4)" in err
    found = [json.loads(line)["timestamp"] for line in (tmp_path / "found.jsonl").read_text().splitlines()]
    assert found == stamps  # in the order of the file, and in float64


# --- Input that is refused -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "cause"),
    [
        (None, "No such file"),
        (b"", "empty"),
        (bytes(range(256)) * 20, "is not a CARMEN log"),
        (gzip.compress("\n".join(drive()).encode())[:-2000], "the gzip stream ends early after line"),
        (b"# a comment\nODOM 0 0 0 0 0 0 1.0 robot 0.5\n", "no laser scan found"),
        (b"#ROSBAG V2.0\n", "ROS bag"),
    ],
    ids=["missing", "empty", "binary", "truncated gzip", "no scan", "bag"],
)
def test_logs_that_cannot_be_used(refuse, tmp_path, content, cause):
    path = tmp_path / "bad.log"
    if content is not None:
        path.write_bytes(content)
    for args in (("build", path, "-o", tmp_path / "out"), ("extract", path, "-o", tmp_path / "found.jsonl")):
        told = refuse(*args)
        assert told.startswith(str(path))
        assert cause in told


def test_a_folder_is_not_a_log(refuse, tmp_path):
    assert refuse("build", tmp_path, "-o", tmp_path / "out") == (
        f"{tmp_path}: is a directory, not a log, nor a ROS 2 bag with its metadata.yaml"
    )
    (tmp_path / "drive_0.mcap").touch()
    assert refuse("build", tmp_path, "-o", tmp_path / "out").endswith(
        "its metadata.yaml; it holds drive_0.mcap, which can be given by itself"
    )
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    assert refuse("build", tmp_path / "metadata.yaml", "-o", tmp_path / "out") == (
        f"{tmp_path / 'metadata.yaml'}: describes a ROS 2 bag, which is its folder: give that"
    )


def test_the_help_of_a_command_begins_with_its_own_options(capsys):
    with pytest.raises(SystemExit):
        main(["localize", "--help"])
    told = capsys.readouterr().out
    order = [told.index(f"--{name}") for name in ("start", "preset", "range-min")]  # its own, the method's, the log's
    assert order == sorted(order)


def test_help_that_nobody_reads_ends_quietly():
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-m", "linemap_jax.cli", "build", "--help"], stdout=write, stderr=subprocess.PIPE, check=False
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (1, b"")


def test_the_output_folder_is_a_file(refuse, log, tmp_path):
    (tmp_path / "file").write_text("mine")
    for folder in ("file", "file/below"):
        assert refuse("build", log, "-o", tmp_path / folder).endswith(f"{tmp_path / 'file'} is not a folder")
    assert refuse("extract", log, "-o", tmp_path / "file/below.jsonl").startswith("cannot write")


def test_the_folder_of_the_output_file_is_missing(refuse, log, tmp_path):
    assert f"the folder {tmp_path / 'none'} does not exist" in refuse("extract", log, "-o", tmp_path / "none/a.jsonl")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_the_output_folder_cannot_be_written(refuse, log, tmp_path):
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o555)
    for args in (("build", log, "-o", folder), ("build", log, "-o", folder / "new")):
        assert re.search("permission denied", refuse(*args), re.IGNORECASE)


def test_output_that_is_there_is_kept(refuse, run, log, tmp_path):
    (tmp_path / "out").mkdir()
    for name in ("map.json", "map.png"):
        old = tmp_path / "out" / name
        old.write_text("old")
        told = refuse("build", log, "-o", tmp_path / "out")
        assert told == f"{old} exists already; use --overwrite to replace it"
        old.unlink()
    (tmp_path / "found.jsonl").write_text("old")
    assert "--overwrite" in refuse("extract", log, "-o", tmp_path / "found.jsonl")

    (tmp_path / "out/map.json").write_text("old")
    assert run("build", log, "-o", tmp_path / "out", "--overwrite")[0] == 0
    assert json.loads((tmp_path / "out/map.json").read_text())["format"] == "linemap"
    assert run("extract", log, "-o", tmp_path / "found.jsonl", "--overwrite")[0] == 0


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("[thresholds]\nmin_lenght = 1.0\n", "no key 'min_lenght' in [thresholds]; did you mean 'min_length'?"),
        ("[threshold]\nmin_length = 1.0\n", "no table [threshold]; did you mean 'thresholds'?"),
        ("[noise]\nrange_sigma = -1.0\n", "range_sigma in [noise] must be"),
        ("[noise]\nrange_sigma = 0\n", "range_sigma in [noise] must be positive"),
        ("[noise]\nrange_sigma = nan\n", "range_sigma in [noise] must be"),
        ("[noise]\nrange_sigma = '1'\n", "range_sigma in [noise] must be a number, not '1'"),
        (f"[noise]\nrange_sigma = 0x{'f' * 5000}\n", "range_sigma in [noise] must be at most 1e+15, not what it is"),
        (f"[noise]\nrange_sigma = {'9' * 5000}\n", "is not a TOML file"),
        ("[noise]\nrange_sigma = 1e300\n", "range_sigma in [noise] must be at most 1e+15, not 1e+300"),
        (f"x = {'[' * 5000}\n", "is not a TOML file"),
        ('["a\\nb"]\n', "no table [a\\nb]"),
        ("[rules]\nmerge = 1\n", "merge in [rules] must be true or false, not 1"),
        ("noise = 1\n", "noise must be a table, [noise]"),
        ("[noise\n", "is not a TOML file"),
        (None, "cannot read"),
    ],
)
def test_settings_files_that_are_wrong(refuse, log, tmp_path, content, told):
    config = tmp_path / "settings.toml"
    if content is not None:
        config.write_text(content)
    said = refuse("build", log, "-o", tmp_path / "out", "--config", config)
    assert str(config) in said
    assert told in said


@pytest.mark.parametrize(
    "option",
    [
        "--range-sigma -1",
        "--range-sigma 0",
        "--range-sigma nan",
        "--range-sigma inf",
        "--bearing-sigma -1",
        "--pose-sigma 0.1 -0.1 0",
        "--pose-sigma 0.1 0.1 nan",
        "--range-min -1",
        "--range-min inf",
        "--range-max 0",
        "--range-max nan",
        "--range-min 3 --range-max 2",
        "--laser-offset 0 0 inf",
        "--every 0",
        "--max-vertices 10",
        "--segmentation optimal --max-vertices 1",
        "--every -2",
    ],
)
def test_numbers_that_make_no_sense(refuse, log, tmp_path, option):
    name = option.split()[-2] if option.count("--") == 2 else option.split()[0]
    assert refuse("build", log, "-o", tmp_path / "out", *option.split()).startswith(name)


@pytest.mark.parametrize(
    "args",
    [
        [],
        ["biuld"],
        ["build"],
        ["build", "a.log"],
        ["build", "a.log", "-o", "out", "--evry", "3"],
        ["build", "a.log", "-o", "out", "--every", "x"],
        ["build", "a.log", "-o", "out", "--preset", "papre"],
        ["build", "a.log", "-o", "out", "--pose-sigma", "1"],
    ],
)
def test_commands_that_are_not_understood(run, args):
    status, out, err = run(*args)
    assert (status, out) == (2, "")
    assert err != ""


# --- Interrupts ------------------------------------------------------------------------------------------------------


def interrupted_after(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on somebody presses Ctrl-C while a log is read, after so many chunks."""
    from linemap_jax.io import scans

    chunks_of_readings = scans.chunks_of_readings

    def chunks(*args: Any, **options: Any) -> Iterator[Any]:
        for i, chunk in enumerate(chunks_of_readings(*args, **options)):
            if i == count:
                break
            yield chunk
        raise KeyboardInterrupt

    monkeypatch.setattr(scans, "chunks_of_readings", chunks)


def test_an_interrupt_before_the_first_result_leaves_nothing(run, log, tmp_path, monkeypatch):
    interrupted_after(0, monkeypatch)
    before = tree(tmp_path)
    for args in (("build", log, "-o", tmp_path / "out"), ("extract", log, "-o", tmp_path / "found.jsonl")):
        assert run(*args) == (130, "", "linemap: interrupted\n")
        assert tree(tmp_path) == before


def test_an_interrupted_extract_leaves_nothing(run, log, tmp_path, monkeypatch):
    interrupted_after(1, monkeypatch)
    (tmp_path / "found.jsonl").write_text("old")
    before = tree(tmp_path)
    args = "extract", log, "-o", tmp_path / "found.jsonl", "--overwrite"
    assert run(*args) == (130, "", "linemap: interrupted\n")
    assert tree(tmp_path) == before


def test_an_interrupted_build_writes_the_map_so_far_and_says_so(run, log, tmp_path, monkeypatch):
    interrupted_after(1, monkeypatch)
    status, _, err = run("build", log, "-o", tmp_path / "out")
    assert (status, err) == (130, f"linemap: interrupted; the map so far is in {tmp_path / 'out'}\n")
    assert sides(json.loads((tmp_path / "out/map.json").read_text())["lines"]) == {"north", "east", "south"}
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["map.json", "map.png"]


def test_an_interrupt_while_writing_leaves_nothing_half(run, log, tmp_path, monkeypatch):
    from linemap_jax.io import map_file

    def interrupt(*args: Any) -> str:
        raise KeyboardInterrupt

    (tmp_path / "out").mkdir()
    (tmp_path / "out/map.json").write_text("old")
    before = tree(tmp_path)
    monkeypatch.setattr(map_file, "_text", interrupt)
    assert run("build", log, "-o", tmp_path / "out", "--overwrite") == (130, "", "linemap: interrupted\n")
    assert tree(tmp_path) == before


# --- The process -----------------------------------------------------------------------------------------------------


def test_a_second_start_says_nothing_about_the_cache(log, tmp_path, monkeypatch):
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL", raising=False)
    for name in ("first", "second"):
        done = command("extract", log, "-o", tmp_path / f"{name}.jsonl", "--quiet")
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_bad_input_to_the_real_command(tmp_path):
    done = command("build", tmp_path / "none.log", "-o", tmp_path / "out")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == f"linemap: {tmp_path / 'none.log'}: cannot be read: No such file or directory\n"
    assert list(tmp_path.iterdir()) == []


def test_importing_the_package_loads_neither_plotting_nor_readers():
    heavy = "matplotlib", "tyro", "tqdm", "linemap_jax.io", "linemap_jax.lab", "linemap_jax.cli"
    code = f"import sys, linemap_jax; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


# --- ROS bags --------------------------------------------------------------------------------------------------------


def bag_of(drive: list[str], *, cov: Any = None) -> Recording:
    """The drive of a CARMEN log as a bag."""
    recording = Recording()
    recording.tf(99.0, "base_link", "laser", (0, 0, 0.3), static=True)
    for line in drive:
        fields = [float(field) for field in line.split()[1:-2]]
        ranges, (x, y, theta), stamp = fields[1 : 1 + BEAMS], fields[1 + BEAMS : 4 + BEAMS], fields[-1]
        recording.odometry(stamp, (x, y, theta), cov=cov)
        recording.scan(stamp, ranges, angle_min=-np.pi / 2, angle_increment=np.deg2rad(0.5), range_max=50.0)
    return recording


def test_a_bag_gives_the_map_of_the_carmen_log(run, log, tmp_path):
    # The covariance that the bag states is that which --pose-sigma takes where a log states none.
    bag = bag_of(drive(), cov=np.diag([0.05**2, 0.05**2, 0, 0, 0, 0.01**2])).write(tmp_path, "mcap")
    maps, said = [], []
    for name, path in (("carmen", log), ("ros", bag)):
        status, out, err = run("build", path, "-o", tmp_path / name)
        assert status == 0
        said.append((out, err))
        maps.append(json.loads((tmp_path / name / "map.json").read_text())["lines"])
    assert "poses:   of the laser, as the log states them; noise: --pose-sigma 0.05 0.05 0.01\n" in said[0][0]
    assert "poses:   nav_msgs/Odometry on /odom; noise: as the log states it; laser on the robot: tf," in said[1][0]
    assert said[0][1] == ""
    drifts = f"{bag}: its poses are raw odometry (nav_msgs/Odometry on /odom), which drifts"
    assert said[1][1] == f"linemap: warning: {drifts}; `linemap slam` corrects it, `build` does not\n"
    assert len(maps[0]) == len(maps[1]) >= 3
    for a, b in zip(*maps, strict=True):  # bearings of a bag have seven digits
        np.testing.assert_allclose([a["rho"], a["theta"]], [b["rho"], b["theta"]], atol=1e-4)
        np.testing.assert_allclose([a["begin"], a["end"]], [b["begin"], b["end"]], atol=1e-3)
        np.testing.assert_allclose(a["cov"], b["cov"], atol=1e-6)


def test_a_map_on_which_few_returns_lie_is_told(run, log, tmp_path, monkeypatch):
    for share, told in ((0.61, ""), (0.41, f"linemap: warning: {log}: only 41% of its returns lie on the map: do its")):
        monkeypatch.setattr("linemap_jax.lab.evaluation.explained_share", lambda *_, share=share, **__: share)
        status, _, err = run("build", log, "-o", tmp_path / str(share))
        assert (status, err[: len(told) or None]) == (0, told)


def test_a_bag_without_poses_can_be_extracted_but_not_mapped(run, refuse, tmp_path):
    recording = bag_of(drive())
    recording.messages = [message for message in recording.messages if message[0] != "/odom"]
    bag = recording.write(tmp_path)
    assert "holds no poses" in refuse("build", bag, "-o", tmp_path / "out")
    assert "exclude one another" in refuse("build", bag, "-o", tmp_path / "out", "--standstill", "--poses", bag)
    status, _, err = run("extract", bag, "-o", tmp_path / "found.jsonl", "--quiet")
    assert (status, err) == (0, "")
    found = [json.loads(line) for line in (tmp_path / "found.jsonl").read_text().splitlines()]
    assert [one["pose"] for one in found] == [None] * SCANS
    assert all(len(one["lines"]) >= 3 for one in found)


def test_info_of_a_carmen_log(run, log):
    status, out, err = run("info", log, "--json")
    assert (status, err) == (0, "")
    told = json.loads(out)
    assert (told["format"], told["scans"], told["beams"], told["rate_hz"]) == ("CARMEN log", SCANS, BEAMS, 1.0)
    assert told["messages"] == [{"name": "FLASER", "type": None, "count": SCANS}]
    np.testing.assert_allclose(told["bearings_rad"], [-np.pi / 2, np.pi / (BEAMS - 1), np.pi / 2])
    assert told["shares"]["returns"] > 0.99
    assert sum(told["shares"].values()) == pytest.approx(1)
    words = f"{log}: CARMEN log\n        10 FLASER\nscans:    10 in 9.0 s, 1.0 a second\n"
    said = run("info", log)[1]
    assert said.startswith(words)
    assert said.endswith(f"\nnext:     linemap build {log} -o my-map (or `slam`, if nobody has corrected the poses)\n")


def test_info_of_a_bag(run, tmp_path):
    recording = Recording()
    for i in range(4):
        recording.scan(10.0 + 0.5 * i, [1.0, 2.0, np.nan, np.inf, -np.inf, 0.0, 30.0, 3.0])
    status, out, _ = run("info", recording.write(tmp_path, "db3"))
    assert status == 0
    for words in (
        "ROS 2 bag, SQLite\n         4 /scan (sensor_msgs/msg/LaserScan)\n",
        "scans:    4 in 1.5 s, 2.0 a second",
        "37.50% returns",
        "12.50% invalid (NaN)",
        "12.50% no return (beyond the maximum range)",
        "would refuse it: it holds no poses",
    ):
        assert words in out


def test_info_of_a_bag_with_two_scanners_tells_of_both(run, tmp_path):
    recording = bag_of(drive(3))
    recording.scan(100.5, [1.0] * 5, topic="/rear")
    bag = recording.write(tmp_path)
    status, out, _ = run("info", bag)
    assert status == 0
    assert "would refuse it: it holds the scans of several scanners, choose one by --scan-topic: /rear (1)," in out
    assert "with --scan-topic /rear:\n  frames:   laser in base_link (static)\n  scans:    1 in 0.0 s\n" in out
    assert "  laser on the robot: tf, laser in base_link; x 0.000 m, y 0.000 m, yaw 0.0 degrees\n" in out
    assert (
        f"  next:     linemap slam {bag} -o my-map --scan-topic /rear (the poses are odometry's, which drifts)\n" in out
    )
    told = json.loads(run("info", bag, "--json")[1])
    assert {topic: of["scans"] for topic, of in told["scanners"].items()} == {"/rear": 1, "/scan": 3}
    assert told["scanners"]["/scan"]["mount_m_rad"] == [0, 0, 0]
    rear = run("info", bag, "--scan-topic", "/rear", "--laser-offset", 0.2, -0.1, 0.3)[1]
    assert "\nlaser on the robot: given; x 0.200 m, y -0.100 m, yaw 17.2 degrees\n" in rear
    assert json.loads(run("info", bag, "--json", "--scan-topic", "/rear")[1])["beams"] == 5


def test_info_of_a_bag_without_scans_tells_the_rest(run, refuse, tmp_path):
    recording = Recording()
    recording.odometry(1.0, (0, 0, 0))
    bag = recording.write(tmp_path)
    status, out, _ = run("info", bag)
    assert status == 0
    assert "1 /odom (nav_msgs/msg/Odometry)" in out
    assert "it holds no sensor_msgs/LaserScan" in out
    bag.write_bytes(bag.read_bytes()[:300])
    assert "is cut off or damaged" in refuse("info", bag)


# --- Slips of the pen ------------------------------------------------------------------------------------------------


def test_a_command_that_there_is_not(run):
    assert run("localise", "a", "b") == (2, "", "linemap: there is no command 'localise'; did you mean localize?\n")
    assert run("xyz")[2].startswith("linemap: there is no command 'xyz'; there are demo, build, slam, ")


@pytest.mark.parametrize(
    ("option", "told"),
    [
        (["--range-sigma", "0.02m"], "--range-sigma: '0.02m' is not a number"),
        (["--pose-sigma", "1", "2", "c"], "--pose-sigma: 'c' is not a number"),
        (["--every", "2.5"], "--every: '2.5' is not a whole number"),
    ],
)
def test_what_is_no_number_is_told_in_plain_words(option, told, capsys):
    with pytest.raises(SystemExit) as caught:
        main(["build", "my.log", "-o", "out", *option])
    assert caught.value.code == 2
    assert told in capsys.readouterr().err
