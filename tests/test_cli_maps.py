"""`linemap export`, `merge`, `compare`, and `build` that goes on from a map or draws a page: maps in and out."""

import dataclasses
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from PIL import Image

from linemap_jax.cli import main
from linemap_jax.cli.compare import _in_words
from linemap_jax.cli.resume import differences, map_to_resume
from linemap_jax.core.settings import PAPER_RULES, Rules, SensorNoise
from linemap_jax.io.exports import FORMATS
from linemap_jax.lab.comparison import Change, Comparison

BEAMS, SCANS = 181, 12  # so many beams as in test_cli.py: another number would be compiled anew
BEARINGS = np.deg2rad(np.arange(BEAMS) - 90.0)
BOX = np.array([(1.0, -1.0), (2.0, -1.0), (2.0, 0.0), (1.0, 0.0)])
ROOM = np.array([(-3.0, -3.0), (4.0, -3.0), (4.0, 3.0), (-3.0, 3.0)])
JAX_SETTINGS = "jax_enable_x64", "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"


@pytest.fixture(scope="module", autouse=True)
def _as_it_was(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The command line sets up jax for its process; and its cache of compilations is not the user's."""
    before = {name: getattr(jax.config, name) for name in JAX_SETTINGS}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
        yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs the command line in this process; gives the exit status, and what stands on stdout and stderr."""

    def run(*args: Any) -> tuple[int, str, str]:
        capsys.readouterr()
        return main([str(arg) for arg in args]), *capsys.readouterr()

    return run


@pytest.fixture
def refuse(run: Callable[..., tuple[int, str, str]], tmp_path: Path) -> Callable[..., str]:
    """Runs what must be refused; gives the one sentence, once nothing is found to be left behind."""

    def refuse(*args: Any) -> str:
        before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        status, out, err = run(*args)
        assert (status, out) == (2, "")
        assert re.fullmatch(r"linemap: [^\n]+\n", err), err
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
        return err.removeprefix("linemap: ").rstrip("\n")

    return refuse


def log_of(path: Path, box: np.ndarray, seed: int, scans: range = range(SCANS)) -> Path:
    """A drive along a wall of the room, looking at the box from one side and then the other."""
    corners = [ROOM, box]
    begin = np.concatenate(corners)
    end = np.concatenate([np.roll(part, -1, 0) for part in corners])
    rows = []
    for i in scans:
        rng = np.random.default_rng([seed, i])
        x, y, theta = (-1.0 + 0.1 * i, -2.0, 0.4) if i % 2 else (0.5 + 0.1 * i, 1.5, -1.0)
        way = np.stack([np.cos(theta + BEARINGS), np.sin(theta + BEARINGS)], -1)[:, None]
        step, edge = begin - (x, y), end - begin
        cross = way[..., 0] * edge[:, 1] - way[..., 1] * edge[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            far = (step[:, 0] * edge[:, 1] - step[:, 1] * edge[:, 0]) / cross
            along = (step[:, 0] * way[..., 1] - step[:, 1] * way[..., 0]) / cross
        ranges = np.where((far > 0) & (along >= 0) & (along <= 1), far, np.inf).min(1) + rng.normal(0, 0.01, BEAMS)
        pose = f"{x:.4f} {y:.4f} {theta:.4f}"
        rows.append(f"FLASER {BEAMS} {' '.join(f'{r:.3f}' for r in ranges)} {pose} {pose} {100 + i} robot 0.5\n")
    path.write_text("".join(rows))
    return path


OPTIONS = "--range-sigma", "0.01", "--pose-sigma", "0.005", "0.005", "0.002"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two drives and their maps: `a` with a page, and `b`, when the box stood 30 cm farther."""
    folder = tmp_path_factory.mktemp("maps")
    for name, box, seed, more in (("a", BOX, 0, ["--html"]), ("b", BOX + (0.3, 0), 1, [])):
        log = log_of(folder / f"{name}.log", box, seed)
        assert main(["build", str(log), "-o", str(folder / name), *OPTIONS, "--quiet", *more]) == 0
    return folder


def document(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def test_build_draws_a_page_with_the_map_on_the_way(built: Path) -> None:
    assert sorted(path.name for path in (built / "a").iterdir()) == ["map.html", "map.json", "map.png"]
    assert [path.name for path in (built / "b").iterdir() if path.suffix == ".html"] == []
    page = (built / "a/map.html").read_text()
    assert re.findall(r'"label":"(\d+)"', page) == ["8", "12"]
    assert page.count('"name":"raw points"') == 1


def test_resumed_it_is_the_map_of_one_drive(built: Path, run: Any, tmp_path: Path) -> None:
    first, second = (
        log_of(tmp_path / f"{name}.log", BOX, 0, part) for name, part in (("one", range(6)), ("two", range(6, SCANS)))
    )
    assert run("build", first, "-o", tmp_path / "one", *OPTIONS)[0] == 0
    # The noise of the scanner is that of the first map.
    others = OPTIONS[2:]
    status, _, err = run("build", second, "-o", tmp_path / "two", *others, "--resume-from", tmp_path / "one/map.json")
    assert (status, err) == (0, "")
    whole, resumed = document(built / "a/map.json"), document(tmp_path / "two/map.json")
    for kind in ("lines", "circles"):  # the slots may differ
        assert sorted(map(json.dumps, resumed[kind])) == sorted(map(json.dumps, whole[kind]))
    assert resumed["settings"]["resumed_from"] == "one.log"


def test_what_persists_is_another_error_in_the_map_of_another_model(built: Path) -> None:
    kept, taken = (
        map_to_resume(built / "a/map.json", "float32", model).line_map.lines for model in ("unknown", "persistent")
    )
    assert np.any(kept.sqrt_persistent)
    assert not np.any(taken.sqrt_persistent)
    np.testing.assert_allclose(taken.cov, kept.cov, rtol=1e-6)


def test_other_settings_are_told() -> None:
    noise = SensorNoise(range_sigma=0.01)
    before = {"preset": "paper", "noise": noise, "pose_sigma": [0.05, 0.05, 0.01], "rules": Rules(merge=False)}
    now = {"preset": "default", "noise": SensorNoise(), "pose_sigma": (0.05, 0.05, 0.01), "rules": Rules()}
    told = "preset paper (now default), noise.range_sigma 0.01 (now 0.02), rules.merge False (now True)"
    assert differences(before, now) == told
    assert differences(now, now) == ""
    assert differences({"merged": []}, now) == ""
    mounts = [{"mount": {"x": x, "y": 0.0, "theta": 0.0}} for x in (0.0, 0.18)]
    assert differences(*mounts) == "mount.x 0.0 (now 0.18)"
    assert differences({"slam": {}} | mounts[0], mounts[1]) == ""
    assert differences(before | {"rules": PAPER_RULES}, now).endswith(
        "rules.maximum_likelihood False (now True) and 14 more"
    )


def test_every_format_by_its_ending(built: Path, run: Any, tmp_path: Path) -> None:
    for name, format in FORMATS.items():
        path = tmp_path / f"map{format.ending}"
        status, out, err = run("export", built / "a/map.json", "-o", path, "--log", built / "a.log")
        assert (status, out, err) == (0, "", f"linemap: {built / 'a/map.json'} -> {path} ({name})\n")
        assert path.stat().st_size > 100
    assert (tmp_path / "map.tum").read_text().startswith("# poses of the laser: ")
    # GeoJSON is a map to all commands, and the way back loses nothing
    assert run("export", tmp_path / "map.geojson", "--to", "json", "-o", tmp_path / "back", "--quiet") == (0, "", "")
    assert (tmp_path / "back").read_bytes() == (built / "a/map.json").read_bytes()
    # Whoever names the picture means both files
    assert (
        run("export", built / "a/map.json", "--to", "nav2", "-o", tmp_path / "m.pgm", "--log", built / "a.log")[0] == 0
    )
    assert (tmp_path / "m.pgm").read_bytes() == (tmp_path / "map.pgm").read_bytes()
    assert 'image: "m.pgm"' in (tmp_path / "m.yaml").read_text()
    grid = np.asarray(Image.open(tmp_path / "map.pgm"))
    assert set(np.unique(grid)) == {0, 205, 254}
    # the room is larger than the part of it that is drawn black
    assert (grid == 254).sum() * 0.05**2 == pytest.approx(7 * 6 - 1, rel=0.2)
    stamps = np.loadtxt(tmp_path / "map.tum")[:, 0]
    assert stamps.tolist() == [100 + i for i in range(SCANS)]


def test_what_was_detected_too_seldom_is_left_out(built: Path, run: Any, tmp_path: Path) -> None:
    whole = document(built / "a/map.json")
    times = sorted(x["times_detected"] for x in whole["lines"] + whole["circles"])
    least = times[len(times) // 2]
    assert times[0] < least
    options = ["--at-least", str(least), "--quiet"]
    assert run("export", built / "a/map.json", "-o", tmp_path / "map.json", *options) == (0, "", "")
    found = document(tmp_path / "map.json")
    for kind in ("lines", "circles"):
        assert found[kind] == [x for x in whole[kind] if x["times_detected"] >= least]
    assert found["settings"] == whole["settings"] | {"at_least": least}


def test_a_map_may_be_given_by_its_folder_and_a_folder_for_the_file_is_made(
    built: Path, run: Any, tmp_path: Path
) -> None:
    assert run("export", built / "a", "-o", tmp_path / "new/map.json", "--quiet") == (0, "", "")
    assert (tmp_path / "new/map.json").read_bytes() == (built / "a/map.json").read_bytes()


def test_a_log_that_is_not_in_the_frame_of_the_map_is_told(built: Path, run: Any, tmp_path: Path) -> None:
    away = tmp_path / "away.tum"
    away.write_text("".join(f"{stamp} 1 2 0 0 0 0.6 0.8\n" for stamp in (0, 1000)))
    status, _, err = run("export", built / "a", "-o", tmp_path / "m.tum", "--log", built / "a.log", "--poses", away)
    assert status == 0
    assert re.search(r"warning: only \d+% of the returns of \S+a\.log lie within 10 cm of \S+/a: are its poses in", err)
    away.write_text("# poses of the laser\n" + away.read_text())
    options = "--log", built / "a.log", "--poses", away, "--laser-offset", 0, 0, 0
    status, _, err = run("export", built / "a", "-o", tmp_path / "n.tum", *options)
    assert (status, err) == (
        2,
        f"linemap: {away} holds poses of the laser, to which --laser-offset does not apply\n",
    )


def test_maps_are_merged(built: Path, run: Any, tmp_path: Path) -> None:
    maps = built / "a/map.json", built / "b/map.json"
    status, out, err = run("merge", *maps, "-o", tmp_path / "ab", "--json")
    assert status == 0
    summary, merged = json.loads(out), document(tmp_path / "ab/map.json")
    assert (
        summary["lines"]
        == len(merged["lines"])
        == summary["a"]["lines"] + summary["b"]["lines"] - summary["lines_joined"]
    )
    assert summary["lines_joined"] >= 4
    assert [each["log"] for each in merged["settings"]["merged"]] == ["a.log", "b.log"]
    east = [line for line in merged["lines"] if line["rho"] == pytest.approx(4, abs=0.05) and abs(line["theta"]) < 0.05]
    assert [line["times_detected"] for line in east] == [2 * SCANS]
    assert (tmp_path / "ab/map.png").is_file()

    # What has moved is told; it stands where it was, too, unless the second map is said to be of a later drive.
    moved = json.loads(run("compare", *maps, "--json")[1])["moved"]
    told = Counter(change["kind"] for change in moved)
    assert told["line"] >= 2
    assert (summary["lines_moved"], summary["circles_moved"]) == (told["line"], told["circle"])
    assert f"{told['line']} lines and {told['circle']} circles have moved from {maps[0]} to {maps[1]}" in err
    status, out, err = run("merge", *maps, "-o", tmp_path / "later", "--json", "--later")
    assert (status, err, json.loads(out)["lines_moved"]) == (0, "", told["line"])
    was, now = (document(path / "map.json") for path in (tmp_path / "ab", tmp_path / "later"))
    old = np.array([change["begin"] for change in moved if change["kind"] == "line"])
    places = (np.array([line["begin"] for line in found["lines"]]) for found in (was, now))
    stands = [(np.abs(old[:, None] - place[None]).max(-1) < 1e-6).any(1) for place in places]
    assert (stands[0].any(), stands[1].any()) == (True, False)
    assert now["lines"][-3:] == document(maps[1])["lines"][2:4] + document(maps[1])["lines"][-1:]

    far = document(built / "b/map.json")
    for line in far["lines"]:
        for point in (line["anchor"], line["begin"], line["end"]):
            point[0] += 100
    (tmp_path / "far.json").write_text(json.dumps(far))
    _, out, err = run("merge", built / "a/map.json", tmp_path / "far.json", "-o", tmp_path / "far")
    assert "0 lines and 0 circles were fused into others" in out
    assert "only 0.0 m agree: are both in one frame" in err


def test_what_is_in_another_frame_has_not_moved(built: Path, run: Any, tmp_path: Path) -> None:
    """Of maps that do not agree it is told that they do not; no change is."""
    beside = document(built / "a/map.json")
    for line in beside["lines"]:
        for point in (line["anchor"], line["begin"], line["end"]):
            point[0] += 0.3
            point[1] -= 0.3
    (tmp_path / "beside.json").write_text(json.dumps(beside))
    maps = built / "a/map.json", tmp_path / "beside.json"
    status, out, err = run("merge", *maps, "-o", tmp_path / "both")
    assert status == 0
    assert "are both in one frame" in err
    assert "--later" not in err
    status, out, err = run("compare", *maps)
    assert status == 0
    assert "are both in one frame" in err
    assert [line.split(":")[0] for line in out.splitlines()[1:]] == ["moved", "vanished", "appeared"]
    assert int(out.splitlines()[1].split()[1]) >= 2


def test_maps_are_compared(built: Path, run: Any) -> None:
    maps = built / "a/map.json", built / "b/map.json"
    status, out, err = run("compare", *maps, "--json", "--log-b", built / "b.log")
    assert (status, err) == (0, "")
    found = json.loads(out)
    assert found["agreeing_m"] > 0.8 * found["overlap_m"] > 15
    assert len(found["moved"]) >= 2
    for change in found["moved"]:
        assert change["shift_m"] == pytest.approx([0.3, 0.0], abs=0.05)
        assert change["p_holm"] < 1e-4
        assert change["times_detected"] >= 3
    assert found["same_lines"] >= 4
    for change in found["vanished"]:
        assert change["passed"] + change["met"] >= 0
    status, out, _ = run("compare", *maps)
    assert status == 0
    assert re.search(r"moved: \d lines or pieces of lines, 0 circles\n  line of .* by 0\.\d{3} ± 0\.\d{3} m", out)
    assert json.loads(run("compare", maps[0], maps[0], "--json")[1])["moved"] == []


def test_which_log_would_tell_more_is_told_once() -> None:
    gone = [
        Change(
            what="vanished", kind="line", slot_a=i, slot_b=None, begin=(0, i), end=(1, i), radius=None, times_detected=5
        )
        for i in range(3)
    ]
    new = dataclasses.replace(gone[0], what="appeared", passed=4, met=0)
    told = _in_words(Comparison([*gone, new], 0, 0, 0))
    assert told.count("--log-b tells what is gone from what the second drive did not look at") == 1
    assert "--log-a" not in told  # that log has been asked
    assert "--log-b" not in _in_words(Comparison([new], 0, 0, 0))


def test_what_the_beams_do_not_bear_out_is_counted_alone() -> None:
    line = Change(
        what="appeared", kind="line", slot_a=None, slot_b=0, begin=(0, 0), end=(1, 0), radius=None, times_detected=5
    )
    circle = dataclasses.replace(line, kind="circle", end=(0, 0), radius=0.1)
    for change, passed, met, passed_own, met_own, sure in (
        (line, 6, 5, 5, 5, True),
        (line, 5, 5, 0, 9, False),
        (line, 6, 5, 6, 5, False),  # its own beams went through as well
        (circle, 46, 5, 0, 9, True),
        (circle, 45, 5, 0, 9, False),
        (circle, 46, 5, 10, 9, False),
        (circle, 46, 5, None, None, True),
    ):
        asked = dataclasses.replace(change, passed=passed, met=met, passed_own=passed_own, met_own=met_own)
        told = _in_words(Comparison([asked], 0, 0, 0))
        assert ("beams of the other drive went through" in told) == sure
        assert ("1 more are in one map only" in told) == (not sure)


def test_what_is_refused(built: Path, refuse: Any, tmp_path: Path) -> None:
    good, log, to = built / "a/map.json", built / "a.log", tmp_path / "map.svg"
    assert "its ending tells no format; give --to, or one of .json, " in refuse(
        "export", good, "-o", tmp_path / "map.xyz"
    )
    for name in ("nav2", "tum"):
        assert refuse("export", good, "-o", tmp_path / "map", "--to", name) == (
            f"{name} is made from the scans of a log; give --log"
        )
    assert "--at-least must be 1 or more, not 0" in refuse("export", good, "-o", to, "--at-least", 0)
    assert "--resolution must be positive" in refuse("export", good, "-o", to, "--resolution", 0)
    assert "million cells" in refuse("export", good, "-o", tmp_path / "m.yaml", "--log", log, "--resolution", 1e-4)
    assert "cannot be read: No such file" in refuse("export", good, "-o", to, "--log", tmp_path / "none.log")
    told = refuse("compare", good, good, "--log-a", log, "--poses-b", to)
    assert told == "--poses-b is for --log-b, which is not given"

    broken = document(good)
    broken["lines"][0]["cov_independent"][0][0] = -1.0
    (tmp_path / "broken.json").write_text(json.dumps(broken))
    (tmp_path / "newer.json").write_text(json.dumps(broken | {"version": 2}))
    for bad, cause in (
        ("broken.json", "lines[0].cov_independent is not symmetric positive definite"),
        ("newer.json", "has version 2; this program reads version 1"),
        ("none.json", "No such file"),
    ):
        path = tmp_path / bad
        assert cause in refuse("export", path, "-o", to)
        assert cause in refuse("merge", good, path, "-o", tmp_path / "out")
        assert cause in refuse("compare", path, good)
        assert cause in refuse("build", log, "-o", tmp_path / "out", "--resume-from", path)
    assert "--alpha must be between 0 and 1" in refuse("compare", good, good, "--alpha", 0)
    assert "--at-least must be 1 or more" in refuse("compare", good, good, "--at-least", 0)
    assert "--within must be positive" in refuse("compare", good, good, "--within", -1)
    (tmp_path / "out").mkdir()
    (tmp_path / "out/map.html").write_text("old")
    assert "map.html exists already" in refuse("build", log, "-o", tmp_path / "out", "--html")
