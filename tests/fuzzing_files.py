"""Cases of all that reads a file: sound files that somebody has damaged, and files made up of what should not be there.

A reader gives what can be worked with, or refuses the file in one sentence. What can be worked with is finite, and goes
through what comes next: a map can be written and drawn, a log made into scans.
"""

import contextlib
import copy
import dataclasses
import functools
import gzip
import io
import json
import math
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from bags import Recording, single_file
from fuzzing import Target
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy
from maps import random_map

from linemap_jax.cli import main
from linemap_jax.core.extract import as_dtype
from linemap_jax.core.settings import Persistence, Rules, SensorNoise, Thresholds
from linemap_jax.io.config import SECTIONS, ConfigError, config_text, read_config
from linemap_jax.io.exports import FORMATS, LOG_NEEDED, Content
from linemap_jax.io.frames import Standstill
from linemap_jax.io.log import open_log
from linemap_jax.io.map_file import MapFileError, read_map, write_map
from linemap_jax.io.reading import LogError
from linemap_jax.io.scans import chunks_of_readings
from linemap_jax.io.survey import describe
from linemap_jax.io.table import ResultsTable, TableError
from linemap_jax.io.tum import read_tum
from linemap_jax.io.worlds import WorldFileError, read_world, write_world
from linemap_jax.lab.check import WorldError, check
from linemap_jax.lab.world import world_from_arrays

LONGEST_SENTENCE = 2000

# Damage

TOKENS = (
    b"nan NaN Infinity -Infinity -inf 1e400 -1e400 1e308 3.5e38 1e30 1e-320 -0 0 -1 2 1.5 9007199254740993 99999999999 "
    b'1_0 0x10 true false null [] {} [[1]] [[1],2] text \'text\' "text" "\\ud800" " \\u0000 \xff , # = \n \r \x1b[2J'
).split(b" ") + [b"9" * 5000, b"[" * 3000, b"0x" + b"f" * 5000, b"", b" "]
NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")

Edit = tuple[str, int, int, bytes]
"""What is done, at which place, how far it reaches, and what is put there."""


def edits(*, text: bool, most: int = 4) -> SearchStrategy[list[Edit]]:
    """Damage to a file: to its bytes, and of a text to its lines and numbers."""
    whats = ["flip", "cut", "double", "end", "put"] + 3 * ["number", "number", "drop", "again", "swap"] * text
    place = st.integers(0, 2**16) | st.integers(0, 2**24)
    put = st.sampled_from(TOKENS) | st.binary(max_size=8)
    return st.lists(st.tuples(st.sampled_from(whats), place, st.integers(0, 300), put), min_size=0, max_size=most)


def edited(content: bytes, damage: list[Edit]) -> bytes:
    """The content with the damage done; places beyond its end wrap around."""
    for what, at, reach, put in damage:
        if what in ("drop", "again", "swap"):
            lines = content.splitlines(keepends=True)
            if lines:
                at, to = at % len(lines), (at + reach) % len(lines)
                if what == "swap":
                    lines[at], lines[to] = lines[to], lines[at]
                else:
                    lines[at : at + 1] = [] if what == "drop" else 2 * [lines[at]]
            content = b"".join(lines)
        elif what == "number":
            found = [match.span() for match in NUMBER.finditer(content)]
            if found:
                begin, end = found[at % len(found)]
                content = content[:begin] + put + content[end:]
        elif content:
            at %= len(content)
            head, piece, tail = content[:at], content[at : at + reach], content[at + reach :]
            if what == "flip":
                content = head + bytes([content[at] ^ (reach % 255 + 1)]) + content[at + 1 :]
            else:
                content = {"cut": head + tail, "double": head + 2 * piece + tail, "end": head}.get(
                    what, head + put + content[at:]
                )
    return content


STRANGE: SearchStrategy[Any] = st.sampled_from(
    [None, True, [], {}, [[]], [0.0], [[1, 2], [3]], {"a": 1}, "", "text", "wall", "\ud800", "a\nb", "$\\frac$"]
    + [0, -1, 1, 2, 10**400, 2**31, 1e308, -1e308, 3.5e38, 1e20, 1e-320, 1e-30, -0.0, 0.5, math.inf, math.nan]
)
"""What may stand in a document in place of something else."""


@st.composite
def changed(draw: Any, document: Any, *, most: int = 3) -> Any:
    """A document with some of its values replaced, left out or told twice."""
    document = copy.deepcopy(document)
    for _ in range(draw(st.integers(0, most))):
        node, depth = document, draw(st.integers(1, 7))
        while True:
            names = list(node) if isinstance(node, dict) else list(range(len(node)))
            if not names:
                break
            name = draw(st.sampled_from(names))
            depth -= 1
            if depth > 0 and isinstance(node[name], dict | list):
                node = node[name]
                continue
            what = draw(st.sampled_from(["replace", "replace", "replace", "drop", "again"]))
            if what == "replace":
                node[name] = copy.deepcopy(draw(STRANGE))
            elif what == "drop":
                del node[name]
            elif isinstance(node, list):
                node.append(copy.deepcopy(node[name]))
            break
    return document


# Files


@functools.cache
def folder() -> Path:
    """A place for the files of the cases, which goes with the process."""
    made = tempfile.TemporaryDirectory(prefix="linemap-fuzz-")
    _kept.append(made)
    return Path(made.name)


_kept: list[Any] = []


def written(name: str, content: bytes) -> Path:
    """The file of a case."""
    path = folder() / name
    path.write_bytes(content)
    return path


@contextlib.contextmanager
def refused_or_sound(error: type[Exception], path: Path) -> Iterator[None]:
    """What is done in here is done to the end, or refused by one kind of error whose sentence names the file."""
    try:
        yield
    except error as refusal:
        is_sentence(str(refusal), path)


def is_sentence(said: str, path: Path) -> None:
    """Whether something is one sentence about a file."""
    assert str(path) in said, f"does not name the file: {said!r}"
    assert said.isprintable(), f"is no line of text: {said!r}"
    assert len(said) < LONGEST_SENTENCE, f"is no sentence, with {len(said)} characters"


def is_refusal_of_command(args: list[str], path: Path, output: Path | None = None) -> bool:
    """Run a command; whether it refused its input, and then in one sentence and without a file written."""
    out, err = io.StringIO(), io.StringIO()
    if output is not None:
        shutil.rmtree(output, ignore_errors=True)
        output.mkdir()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(args)
    said = err.getvalue()
    assert status in (0, 2), f"status {status}"
    if status == 0:
        return False
    assert said.startswith("linemap: ")
    assert said.endswith("\n")
    is_sentence(said[:-1], path)
    assert out.getvalue() == ""
    assert output is None or list(output.iterdir()) == []
    return True


# Logs


def is_sound_log(path: Path, *, strict: bool = False, **options: Any) -> None:
    """Read a log in all the ways that it is read."""
    with refused_or_sound(LogError, path):
        told = describe(open_log(path, strict=strict, need_poses=False, **options))
        text = json.dumps(told, allow_nan=False)
        assert all(map(str.isprintable, told.get("warnings", [])))
        assert text.isprintable()
    with refused_or_sound(LogError, path):
        log = open_log(path, strict=strict, **options)
        readings = []
        for reading in log:
            assert reading.ranges.shape == reading.bearings.shape
            assert reading.ranges.size > 0
            assert 0 <= reading.range_min < math.inf
            assert reading.range_max > 0
            assert math.isfinite(reading.timestamp)
            for known in (reading.pose, reading.odometry, reading.mount, reading.bearings, reading.sweep_poses):
                assert known is None or np.isfinite(known).all()
            assert reading.pose is not None
            if reading.cov_pose is not None:
                assert np.linalg.eigvalsh(reading.cov_pose)[0] > 0
            readings.append(reading)
        assert log.notes.scans == len(readings) > 0
        assert not (strict and log.notes.skipped)
        assert all(map(str.isprintable, log.notes.warnings()))
        for chunk in chunks_of_readings(readings, 64, cov_pose=np.eye(3)):
            scans = chunk.scans
            for x in (scans.ranges, scans.bearings, scans.spacing):
                assert np.isfinite(x).all()
            ranges, bearings, valid, first = map(np.asarray, (scans.ranges, scans.bearings, scans.valid, scans.first))
            assert (ranges[valid] > 0).all()
            assert (ranges[~valid] == 0).all()
            assert ((first >= 0) & (first < valid.shape[1])).all()
            assert np.abs(bearings).max() < 100


def _flaser(ranges: int = 6, stamp: float = 1.0) -> str:
    return f"FLASER {ranges} " + "1.25 " * ranges + f"0.5 -0.25 0.1 0.5 -0.25 0.1 {stamp} host {stamp}"


def _robotlaser(ranges: int = 6, stamp: float = 1.0) -> str:
    head = f"ROBOTLASER1 0 -1.5 3.0 0.25 30.0 0.1 0 {ranges} " + "1.25 " * ranges + "0 "
    return head + f"0.5 -0.25 0.1 0.5 -0.25 0.1 0 0 1 1 1 {stamp} host {stamp}"


CARMEN = {
    form.__name__: "\n".join(
        ["# a log", "PARAM robot_length 0.5", *(form(stamp=0.1 * i) for i in range(5)), "ODOM 0 0 0 0 0 0 1 h 1\n"]
    ).encode()
    for form in (_flaser, _robotlaser)
}


def carmen_cases() -> SearchStrategy[Any]:
    return st.tuples(
        st.sampled_from(sorted(CARMEN)), edits(text=True), st.booleans(), edits(text=False, most=1), st.booleans()
    )


def check_carmen(case: Any) -> None:
    form, damage, packed, damage_packed, strict = case
    content = edited(CARMEN[form], damage)
    if packed:
        content = edited(gzip.compress(content, 1, mtime=0), damage_packed)
    is_sound_log(written("fuzz.log", content), strict=strict)


def _sound_recording() -> Recording:
    log = Recording()
    log.tf(0.0, "base_link", "laser", (0.2, 0.0, 0.1), static=True)
    for i in range(6):
        log.odometry(0.1 * i + 1.0, (0.1 * i, 0.0, 0.05 * i), cov=np.eye(6) * 1e-3)
        log.tf(0.1 * i + 1.0, "odom", "base_link", (0.1 * i, 0.0, 0.0))
        if i < 5:
            log.scan(0.1 * i + 1.05, np.linspace(1, 2, 8), time_increment=0.001)
    return log


@functools.cache
def bag_of(kind: str) -> tuple[str, bytes]:
    """The ending and the content of a sound bag."""
    path = _sound_recording().write(Path(tempfile.mkdtemp(dir=folder())), kind)
    if path.is_dir():
        path = single_file(path)
    return path.suffix, path.read_bytes()


def damaged_bag_cases(*kinds: str) -> SearchStrategy[Any]:
    return st.tuples(st.sampled_from(kinds), edits(text=False, most=3), st.booleans())


def check_damaged_bag(case: Any) -> None:
    kind, damage, strict = case
    ending, content = bag_of(kind)
    is_sound_log(written(f"fuzz{ending}", edited(content, damage)), strict=strict)


FLOATS32 = [0.0, -0.0, 0.5, -0.5, 1.0, 3.0, 1e-40, 1e-30, 1e-7, 10.0, -10.0, 1e4, -1e4, 1e20, 3e38, -3e38]
FLOATS32 += [math.inf, -math.inf, math.nan]
FLOATS64 = [*FLOATS32, 1e6, -1e6, 1e-300, 1e154, 1e300, -1e300, 1.7e308, -1.7e308]
STAMPS = [0.0, 1e-9, 1.0, 1.05, 1.1, 1.1000001, 2.0, 5.0, 61.0, 1e6, 2147483646.0]
FRAMES = ["laser", "base_link", "odom", "map", "", "/laser", "world", "a\nb", "\x1b", "é"]


@st.composite
def messages(draw: Any) -> tuple[str, dict[str, Any]]:
    """A call of a method of `Recording`, with numbers that nobody would send."""
    f32, f64 = st.sampled_from(FLOATS32), st.sampled_from(FLOATS64)
    frame = st.sampled_from(FRAMES[:3]) | st.sampled_from(FRAMES)
    what = draw(st.sampled_from(["scan", "scan", "odometry", "tf"]))
    fields: dict[str, Any] = {"stamp": draw(st.sampled_from(STAMPS) | st.floats(0.9, 2.0))}
    fields |= {"recorded": draw(st.sampled_from([1.0, 1.2, 1.5, 2.0, 1e9]))}
    if what == "scan":
        names = "angle_min angle_max angle_increment time_increment scan_time range_min range_max".split()
        fields |= draw(st.fixed_dictionaries({}, optional=dict.fromkeys(names, f32)))
        fields |= {"ranges": draw(st.lists(f32, max_size=12)), "frame": draw(frame)}
        fields |= {"topic": draw(st.sampled_from(["/scan", "/scan", "/scan", "/scan", "/other", "a\nb"]))}
    elif what == "odometry":
        cov = st.sampled_from(FLOATS64)
        fields |= {"pose": (draw(f64), draw(f64), draw(st.sampled_from([0.0, 1.0, -3.1, math.nan])))}
        fields |= {"cov": draw(st.none() | cov.map(lambda x: np.diag(np.full(6, x))) | cov.map(lambda x: [x] * 36))}
        fields |= {"frame": draw(frame), "child": draw(frame)}
    else:
        turn = st.just((0.0, 0.0, 0.0, 1.0)) | st.tuples(f64, f64, f64, f64)
        fields |= {"translation": draw(st.tuples(f64, f64, f64)), "rotation": draw(turn)}
        fields |= {"parent": draw(frame), "child": draw(frame), "static": draw(st.booleans())}
    return what, fields


def recorded_cases() -> SearchStrategy[Any]:
    offset = st.none() | st.tuples(*[st.sampled_from([0.0, 1.0, -1e6, 1e300])] * 3)
    kind = st.sampled_from(5 * ["bag"] + 2 * ["mcap"] + ["db3"])  # SQLite waits for the disk
    return st.tuples(kind, st.booleans(), st.lists(messages(), max_size=5), st.booleans(), st.booleans(), offset)


def check_recorded(case: Any) -> None:
    kind, after_sound, calls, strict, still, offset = case
    path = folder() / ("log.bag" if kind == "bag" else "log")
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    recording = _sound_recording() if after_sound else Recording()
    for name, fields in calls:
        getattr(recording, name)(**fields)
    is_sound_log(recording.write(folder(), kind), strict=strict, poses=Standstill() if still else None, mount=offset)


# Poses

TUM = "".join(f"{0.1 * i:.1f} {i} 0.5 0 0 0 0.1 0.99\n" for i in range(6)).encode()


def tum_cases() -> SearchStrategy[Any]:
    made = st.lists(
        st.lists(st.sampled_from(["0", "1", "0.5", "-1", "1e308", "-1e308", "1e200", "1e-200", "nan", "#", ","]))
        | st.tuples(*[st.sampled_from(["0", "1", "0.3", "-1e308", "1e308", "1e160", "1e-160"])] * 8).map(list),
        max_size=5,
    ).map(lambda lines: "\n".join(map(" ".join, lines)).encode())
    return st.tuples(st.just(TUM) | made, edits(text=True))


def check_tum(case: Any) -> None:
    content, damage = case
    path = written("fuzz.tum", edited(content, damage))
    with refused_or_sound(LogError, path):
        poses = read_tum(path)
        assert np.isfinite(poses.stamps).all()
        stamps = np.concatenate([poses.stamps, (poses.stamps[1:] + poses.stamps[:-1]) / 2])
        stamps = stamps[[poses.covers(stamp, stamp) for stamp in stamps.tolist()]]
        assert np.isfinite(poses.at(stamps)).all()


# Settings

CONFIG = config_text(
    {"thresholds": Thresholds(), "noise": SensorNoise(), "rules": Rules(), "persistence": Persistence()}
).encode()


def config_cases() -> SearchStrategy[Any]:
    numbers = st.sampled_from(["0", "1", "0.5", "1e-30", "1e-300", "1e30", "3e38", "1e300", "true", "inf", "nan", "{}"])
    key = st.sampled_from([field.name for cls in SECTIONS.values() for field in dataclasses.fields(cls)])
    table = st.tuples(st.sampled_from([*SECTIONS, "nose"]), st.lists(st.tuples(key, numbers), max_size=3))
    made = st.lists(table, max_size=3).map(
        lambda tables: "\n".join(
            line for name, keys in tables for line in (f"[{name}]", *(f"{key} = {value}" for key, value in keys))
        ).encode()
    )
    return st.tuples(st.just(CONFIG) | made, edits(text=True))


def check_config(case: Any) -> None:
    content, damage = case
    path = written("fuzz.toml", edited(content, damage))
    with refused_or_sound(ConfigError, path):
        tables = read_config(path)
        for section, fields in tables.items():
            made = SECTIONS[section](**fields)
            if section != "rules":
                numbers = jax.tree.leaves(as_dtype(made, "float32"))
                assert all(math.isfinite(x) and x >= 0 for x in numbers), f"{made} is not finite in float32"
        config_text({section: SECTIONS[section](**fields) for section, fields in tables.items()})


# Maps

FILE_SETTINGS = {"log": "my.log", "preset": "default", "pose_sigma": [0.05, 0.05, 0.01]}


@functools.cache
def map_file(geojson: bool) -> bytes:
    """A sound map file."""
    path = folder() / "sound.json"
    write_map(path, random_map("float32", 3, 2), FILE_SETTINGS, geojson=geojson, overwrite=True)
    return path.read_bytes()


def map_cases(geojson: bool) -> SearchStrategy[Any]:
    document = json.loads(map_file(geojson))
    structured = changed(document).map(lambda changes: json.dumps(changes).encode())
    return st.tuples(structured | st.just(map_file(geojson)), edits(text=True, most=2))


def check_map(case: Any) -> None:
    content, damage = case
    path = written("fuzz.json", edited(content, damage))
    with refused_or_sound(MapFileError, path):
        line_map, settings = read_map(path)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(line_map))
        # What has been read can be written, read again, and drawn.
        again = folder() / "again.json"
        write_map(again, line_map, settings, overwrite=True)
        read, _ = read_map(again)
        jax.tree.map(np.testing.assert_array_equal, read, line_map)


def drawn_cases() -> SearchStrategy[Any]:
    formats = [name for name in FORMATS if name not in (*LOG_NEEDED, "json", "geojson")]
    return st.tuples(changed(json.loads(map_file(False)), most=2), st.sampled_from(formats))


def check_drawn(case: Any) -> None:
    document, name = case
    path = written("fuzz.json", json.dumps(document).encode())
    try:
        line_map, settings = read_map(path)
    except MapFileError:
        return
    output = folder() / f"drawn{FORMATS[name].ending}"
    output.unlink(missing_ok=True)
    content = Content(line_map=line_map, settings=settings, title=str(settings.get("log", "map")))
    FORMATS[name].write(output, content, False)
    assert output.stat().st_size > 0


# Worlds

WORLD = {
    "type": "FeatureCollection",
    "format": "linemap-world",
    "version": 1,
    "dtype": "float64",
    "features": [
        {"type": "Feature", "properties": properties, "geometry": {"type": shape, "coordinates": coordinates}}
        for shape, coordinates, properties in (
            ("Polygon", [[[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]]], {"kind": "room"}),
            ("Polygon", [[[1, 1], [1.5, 1], [1.5, 2], [1, 1]]], {"kind": "obstacle", "appears": 2, "vanishes": 9}),
            ("LineString", [[3, 1], [3, 2]], {}),
            ("Point", [2, 0.5], {"radius": 0.1}),
            ("LineString", [[0.5, 0.5], [0.5, 2.5]], {"kind": "path"}),
        )
    ],
}


def world_cases() -> SearchStrategy[Any]:
    structured = changed(WORLD).map(lambda changes: json.dumps(changes).encode())
    return st.tuples(structured | st.just(json.dumps(WORLD, indent=1).encode()), edits(text=True, most=2))


def check_world(case: Any) -> None:
    content, damage = case
    path = written("fuzz.geojson", edited(content, damage))
    with refused_or_sound(WorldFileError, path):
        arrays = read_world(path)
        again = folder() / "again.geojson"
        write_world(again, arrays, overwrite=True)
        read = read_world(again)
        np.testing.assert_array_equal(read["path"], arrays["path"])
        assert all(len(read[name]["valid"]) == len(arrays[name]["valid"]) for name in ("segments", "poles"))
        with contextlib.suppress(WorldError):
            check(world_from_arrays(read_world(path, dtype="float64")))


# Tables of trials

ABOUT = {"kind": "room", "runs": 6}


@functools.cache
def table_files() -> dict[str, bytes]:
    """The files of a sound table."""
    place = folder() / "sound-table"
    table = ResultsTable(place, ABOUT)
    for first in (0, 3):
        rows = np.arange(first, first + 3)
        table.append(first, {"drive": rows, "error": rows * 0.5, "list": rows[:, None] * np.ones(2), "lost": rows > 2})
    return {path.name: path.read_bytes() for path in sorted(place.iterdir())}


NAMES = ["_about.json", "rows-000000000-000000003.parquet", "rows-000000003-000000003.parquet"]
OTHER_NAMES = [*NAMES, "rows-000000006-000000003.parquet", "rows-000000000-000000000.parquet", "other.txt"]


def table_cases() -> SearchStrategy[Any]:
    moved = st.lists(st.tuples(st.sampled_from(NAMES), st.sampled_from(OTHER_NAMES)), max_size=1)
    return st.tuples(st.sampled_from(NAMES), edits(text=False, most=2), moved)


def check_table(case: Any) -> None:
    name, damage, moved = case
    files = dict(table_files())
    files[name] = edited(files[name], damage)
    for before, after in moved:
        files[after] = files.pop(before)
    place = folder() / "table"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    for each, content in files.items():
        (place / each).write_bytes(content)
    with refused_or_sound(TableError, place):
        table = ResultsTable(place, ABOUT)
        columns = table.read()
        assert {len(column) for column in columns.values()} <= {table.rows}
        if table.rows == 6:
            assert sorted(columns) == ["drive", "error", "list", "lost"]
            assert columns["drive"].tolist() == list(range(6))
            assert columns["error"].tolist() == [0.5 * i for i in range(6)]


# Commands


def command_cases() -> SearchStrategy[Any]:
    return st.one_of(
        st.tuples(st.just("config"), config_cases()),
        st.tuples(st.just("info"), carmen_cases()),
        st.tuples(st.just("info of a bag"), damaged_bag_cases("bag", "mcap", "db3")),
        st.tuples(st.just("info with poses"), tum_cases()),
        st.tuples(st.just("export"), map_cases(False)),
        st.tuples(st.just("export"), map_cases(True)),
    )


def check_command(case: Any) -> None:
    name, (content, damage, *rest) = case
    output = folder() / "output"
    if name == "config":
        path = written("fuzz.toml", edited(content, damage))
        is_refusal_of_command(["config", "--config", str(path)], path)
    elif name == "export":
        path = written("fuzz.json", edited(content, damage))
        args = ["export", str(path), "-o", str(output / "map.svg"), "--quiet"]
        is_refusal_of_command(args, path, output)
    elif name == "info with poses":
        path = written("fuzz.tum", edited(content, damage))
        log = written("sound.log", CARMEN["_flaser"])
        is_refusal_of_command(["info", str(log), "--poses", str(path), "--json"], path)
    else:
        ending, sound = (".log", CARMEN[content]) if name == "info" else bag_of(content)
        path = written(f"fuzz{ending}", edited(sound, damage))
        is_refusal_of_command(["info", str(path), "--json"], path)


def _map_target(name: str, geojson: bool) -> Target:
    return Target(name, functools.partial(map_cases, geojson), check_map, 1.0)


def _bag_target(name: str, *kinds: str) -> Target:
    return Target(name, functools.partial(damaged_bag_cases, *kinds), check_damaged_bag, 0.8)


TARGETS: list[Target] = [
    Target("CARMEN, plain and gzip", carmen_cases, check_carmen, 1.5),
    _bag_target("ROS 1 bag, damaged", "bag", "bag-lz4", "bag-bz2"),
    _bag_target("ROS 2 db3, damaged", "db3", "db3-zstd"),
    _bag_target("ROS 2 mcap, damaged", "mcap", "mcap-zstd"),
    Target("ROS messages", recorded_cases, check_recorded, 1.5),
    Target("poses (TUM)", tum_cases, check_tum, 1.0),
    Target("settings (TOML)", config_cases, check_config, 1.0),
    _map_target("map.json", False),
    _map_target("map.geojson", True),
    Target("maps drawn", drawn_cases, check_drawn, 0.5),
    Target("worlds", world_cases, check_world, 1.0),
    Target("tables of trials", table_cases, check_table, 0.8),
    Target("commands", command_cases, check_command, 0.6),
]
