"""The command line: reads the options, and hands on between files, the build and the pictures."""

import contextlib
import dataclasses
import json
import math
import os
import shutil
import sys
import time
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from jax import Array
    from jax.sharding import Mesh

    from linemap_jax.core.state import LineMap, Report
    from linemap_jax.io.log import Log
    from linemap_jax.io.scans import Chunk
    from linemap_jax.lab.world import World


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogOptions:
    """Options of all commands that read a log."""

    preset: Literal["default", "paper"] = "default"
    """The method: `paper` is the literal reading of 1996, `default` the same with its known faults mended."""
    config: Path | None = None
    """TOML file with tables [thresholds], [noise], [rules], [persistence]; goes over the preset. Options given here go
    over both."""
    range_sigma: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Standard deviation of a range, m. 0.02 unless given."""
    bearing_sigma: Annotated[float | None, tyro.conf.arg(metavar="RAD")] = None
    """Standard deviation of a bearing, rad. 0.001 unless given."""
    pose_sigma: Annotated[tuple[float, float, float], tyro.conf.arg(metavar="X Y THETA")] = (0.05, 0.05, 0.01)
    """Standard deviations of every pose, m m rad: logs do not state them."""
    range_min: Annotated[float, tyro.conf.arg(metavar="M")] = 0.0
    """Smallest range that counts as a return, m."""
    range_max: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Ranges from here on are no-returns, m. What the log states, or 50, unless given."""
    laser_offset: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y THETA")] = None
    """Pose of the laser on the robot, m m rad. Used only with poses that are the robot's."""
    covariance: Literal["exact", "printed"] | None = None
    """`exact` to first order, or eq. 12 as `printed`. That of the preset unless given."""
    jacobians: Literal["autodiff", "analytic"] = "analytic"
    """Derivatives by autodiff through the estimate, or the hand-derived ones; the maps are the same."""
    segmentation: Literal["incremental"] = "incremental"
    """How points are divided into lines."""
    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Take every N-th scan."""
    dtype: Literal["float32", "float64"] = "float32"
    """Precision of all numbers."""
    strict: bool = False
    """Refuse a log with malformed lines, instead of skipping and counting them."""
    overwrite: bool = False
    """Replace output that is there already."""
    quiet: bool = False
    """No progress, no warnings."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Build(LogOptions):
    """Build a map from a log: writes map.json and map.png, and prints a summary."""

    log: tyro.conf.Positional[Path]
    """CARMEN log, plain or .gz."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder for the map; made if it is not there."""
    pose_error: Literal["independent", "persistent", "unknown"] = "unknown"
    """How the errors of the poses hang together from scan to scan; `persistent` by [persistence] of the settings file.
    With `unknown` covariances are bounds that hold in any case."""
    json: bool = False
    """Print the summary as JSON."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Extract(LogOptions):
    """Extract lines and circles scan by scan: one JSON line a scan, in the frame of the sensor."""

    log: tyro.conf.Positional[Path]
    """CARMEN log, plain or .gz."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE.jsonl")]
    """File to write."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demo:
    """Build a map from the log that ships with the package: a cluttered laboratory with poles."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")] = Path("linemap-demo")
    """Folder for the map; made if it is not there."""
    overwrite: bool = False
    """Replace output that is there already."""
    quiet: bool = False
    """No progress, no warnings."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verify:
    """Check the paper, equation by equation: derivatives by hand and by autodiff, and where the print is wrong."""

    json: bool = False
    """Print the table, with every single check, as JSON."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Simulate:
    """Simulate a drive: writes a CARMEN log, scans.log.gz, and the truth, world.geojson and poses.tum."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder for the log and the truth; made if it is not there."""
    world: Annotated[Path | None, tyro.conf.arg(metavar="FILE.geojson")] = None
    """World to drive through, with a path; in place of --kind."""
    kind: Literal["laboratory", "corridor", "room", "free_room", "rectilinear_room", "changing_room"] = "laboratory"
    """World to make."""
    scans: Annotated[int, tyro.conf.arg(metavar="N")] = 300
    """Number of scans along the path."""
    scanner: Literal["pls", "lms200", "utm30lx", "rplidar_a1"] = "pls"
    """The instrument."""
    pose_sigma: Annotated[tuple[float, float, float], tyro.conf.arg(metavar="X Y THETA")] = (0.01, 0.01, 0.002)
    """Standard deviations of every pose of the log, m m rad."""
    pose_correlation: Annotated[float, tyro.conf.arg(metavar="A")] = 0.0
    """Of the pose errors, from one scan to the next: 0 for independent ones, 1 for one error that stays."""
    turns: Literal["smooth", "spot"] = "smooth"
    """How the robot takes the corners of its path: cut by arcs, or turning on the spot."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Decides everything that is left to chance."""
    overwrite: bool = False
    """Replace output that is there already."""
    quiet: bool = False
    """No summary."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Score a map: against a true world, or against a log, or both."""

    map: tyro.conf.Positional[Path]
    """map.json of `build`."""
    world: Annotated[Path | None, tyro.conf.arg(metavar="FILE.geojson")] = None
    """The truth. With a log, only what its beams met can be missed; without, all of it."""
    log: Annotated[Path | None, tyro.conf.arg(metavar="LOG")] = None
    """CARMEN log, plain or .gz: how much of it the map explains."""
    at: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """The truth is what is there at scan N. The last one of the log, or else after all changes, unless given."""
    distance: Annotated[float, tyro.conf.arg(metavar="M")] = 0.05
    """How far a line may lie from a wall, and the centre of a circle outside of a pole, m."""
    range_max: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Ranges from here on are no-returns, m. What the log states, or 50, unless given."""
    strict: bool = False
    """Refuse a log with malformed lines, instead of skipping and counting them."""
    quiet: bool = False
    """No progress, no warnings."""
    json: bool = False
    """Print the scores as JSON."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trials:
    """Simulate, map and score many drives, each in a world of its own; a run that was stopped goes on."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder for the results, a Parquet table with one row a drive. Goes on with one of the same trials."""
    kind: Literal["laboratory", "corridor", "room", "free_room", "rectilinear_room", "changing_room"] = "changing_room"
    """Worlds to drive through."""
    runs: Annotated[int, tyro.conf.arg(metavar="N")] = 1000
    """Number of drives."""
    scans: Annotated[int, tyro.conf.arg(metavar="N")] = 50
    """Number of scans of each."""
    scanner: Literal["pls", "lms200", "utm30lx", "rplidar_a1"] = "pls"
    """The instrument; the map builder knows its noise."""
    preset: Literal["default", "paper"] = "default"
    """The method."""
    config: Path | None = None
    """TOML file with tables [thresholds], [noise], [rules], [persistence]; goes over the preset."""
    pose_sigma: Annotated[tuple[float, float, float], tyro.conf.arg(metavar="X Y THETA")] = (0.01, 0.01, 0.002)
    """Standard deviations of every pose, m m rad."""
    pose_correlation: Annotated[float, tyro.conf.arg(metavar="A")] = 0.0
    """Of the pose errors, from one scan to the next: 0 for independent ones, 1 for one error that stays."""
    pose_error: Literal["independent", "persistent", "unknown"] = "unknown"
    """What the map builder believes of that."""
    sweep: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME ...]")] = ()
    """Thresholds to vary, one at a time, in the same drives: each from a quarter to four times its value."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Decides everything that is left to chance."""
    devices: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Processors, or accelerators, that share the work. All of them unless given."""
    quiet: bool = False
    """No progress."""
    json: bool = False
    """Print the summary as JSON."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Calibrate:
    """Tell the noise of the scanner and of the poses from a log."""

    log: tyro.conf.Positional[Path]
    """CARMEN log, plain or .gz."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE.toml")] = None
    """Settings file for --config of the other commands, with the noise of the scanner."""
    scans: Annotated[int, tyro.conf.arg(metavar="N")] = 1000
    """Number of scans that are used at most, from the first on."""
    lag: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Poses are compared with those N scans later: errors that last longer are not seen."""
    range_max: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Ranges from here on are no-returns, m. What the log states, or 50, unless given."""
    laser_offset: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y THETA")] = None
    """Pose of the laser on the robot, m m rad. Used only with poses that are the robot's."""
    strict: bool = False
    """Refuse a log with malformed lines, instead of skipping and counting them."""
    overwrite: bool = False
    """Replace output that is there already."""
    quiet: bool = False
    """No warnings."""
    json: bool = False
    """Print the result as JSON."""


DEMO_NOISE = {"range_sigma": 0.015, "bearing_sigma": 0.0005, "pose_sigma": (0.01, 0.01, 0.002)}
"""What the demo log was made with."""

SCANS_EXPLAINED = 500
"""What a log says of a map is taken over so many of its scans at most."""

MOST_SCANS = 20_000
"""Of a simulated drive, which is held in memory as a whole."""

MOST_RUNS = 10**8
"""Of trials."""

BATCH_RUNS = 32
"""Drives that one device simulates side by side."""

CHUNK_RUNS = 256
"""Drives after which the results are written, of all devices together."""

SCAN_SECONDS = 0.2
"""Between two simulated scans."""

START_CAPACITY = (1024, 512)
"""Slots for lines and circles to begin with. To grow costs a compilation, and most buildings fit into these."""

COUNTS = ("added", "fused", "merged", "trimmed", "split", "deleted")
"""The counts of a `Report`."""


class UsageError(Exception):
    """What is wrong with the command, in one sentence."""


def main(args: list[str] | None = None) -> int:
    """Run the command line.

    Args:
      args: the arguments; those of the process unless given.

    Returns:
      The exit status: 0; 1 if `verify` found a check that fails; 2 for bad input, about which one sentence has been
      printed; 130 for an interrupt.
    """
    command = tyro.cli(
        Annotated[Demo, tyro.conf.subcommand("demo")]
        | Annotated[Build, tyro.conf.subcommand("build")]
        | Annotated[Extract, tyro.conf.subcommand("extract")]
        | Annotated[Simulate, tyro.conf.subcommand("simulate")]
        | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
        | Annotated[Trials, tyro.conf.subcommand("trials")]
        | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
        | Annotated[Verify, tyro.conf.subcommand("verify")],
        prog="linemap",
        description="Maps of line segments and circles from 2D range scans, with covariances that can be believed.",
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
        args=args,
    )
    # What follows loads jax, which takes a second: not before the options are known to be right.
    from linemap_jax.io.atomic import OutputError
    from linemap_jax.io.config import ConfigError
    from linemap_jax.io.log import LogError
    from linemap_jax.io.map_file import MapFileError
    from linemap_jax.io.table import TableError
    from linemap_jax.io.worlds import WorldFileError

    try:
        if isinstance(command, Verify):
            return _verify(command)
        if isinstance(command, Simulate):
            return _simulate(command)
        if isinstance(command, Evaluate):
            return _evaluate(command)
        if isinstance(command, Trials):
            return _trials(command)
        if isinstance(command, Calibrate):
            return _calibrate(command)
        if isinstance(command, Extract):
            return _extract(command)
        return _build(_of_demo(command) if isinstance(command, Demo) else command)
    except (LogError, OutputError, MapFileError, TableError, WorldFileError, ConfigError, UsageError) as error:
        print(f"linemap: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("linemap: interrupted", file=sys.stderr)
        return 130


def _of_demo(demo: Demo) -> Build:
    log = resources.files("linemap_jax.io").joinpath("data", "demo.log.gz")
    with resources.as_file(log) as path:
        return Build(log=path, output=demo.output, overwrite=demo.overwrite, quiet=demo.quiet, **DEMO_NOISE)


def _build(command: Build) -> int:
    options = _options(command) | {"pose_error": command.pose_error}
    from linemap_jax.core.settings import Mount
    from linemap_jax.core.state import Status
    from linemap_jax.io.map_file import write_map
    from linemap_jax.io.plot import plot_map

    map_file, picture = command.output / "map.json", command.output / "map.png"
    _check_output(command.output, map_file, picture, overwrite=command.overwrite)
    log = _open(command)
    if command.laser_offset is not None and next(iter(log)).pose_frame == "laser":
        options["mount"] = Mount()
        _say(command, f"warning: {log.path}: its poses are the laser's, so that --laser-offset has no effect")
    with _progress(command, log):
        line_map, report, positions, seconds, interrupted = _map_of_log(command, log, options)
    _warn(command, log)
    lost = sum(bool(status & Status.POSE_NOT_FINITE) for status in report.status.tolist())
    if lost:
        _say(command, f"warning: {log.path}: {lost} scans were left out: their poses are not finite in {command.dtype}")

    settings = {
        "log": command.log.name,
        "preset": command.preset,
        "pose_sigma": command.pose_sigma,
        **{name: option for name, option in options.items() if name != "segmentation"},
    }
    _make_folder(command.output)
    write_map(map_file, line_map, settings, overwrite=command.overwrite)
    plot_map(picture, line_map, positions, title=command.log.name, overwrite=command.overwrite)
    if interrupted:
        print(f"linemap: interrupted; the map so far is in {command.output}", file=sys.stderr)
        return 130
    summary = _summary(command, line_map, report, options, seconds) | {"map": str(map_file), "picture": str(picture)}
    print(json.dumps(summary, indent=2) if command.json else _in_words(summary))
    return 0


def _map_of_log(
    command: Build, log: "Log", options: dict[str, Any]
) -> tuple["LineMap", "Report", list[tuple[float, float]], list[float], bool]:
    """The map, the reports, the positions of the robot, the seconds that each chunk took, reading included.

    And whether somebody interrupted it: then the map is the one so far.
    """
    import numpy as np

    from linemap_jax.build import CHUNK, build_chunks, join_reports
    from linemap_jax.core.settings import Capacity

    start = Capacity(*START_CAPACITY)
    positions, reports, seconds = [], [], []

    def driven() -> Iterator[Any]:
        for chunk in _chunks(command, log, CHUNK):
            positions.extend(map(tuple, np.asarray(chunk.poses.mean)[:, :2].tolist()))
            yield chunk.scans, chunk.poses

    line_map, interrupted = None, False
    started = time.perf_counter()
    try:
        for grown, report in build_chunks(driven(), map_capacity=start, chunk=CHUNK, **options):
            line_map = grown
            reports.append(report)
            seconds.append(time.perf_counter() - started)
            started = time.perf_counter()
    except KeyboardInterrupt:
        if line_map is None:
            raise
        interrupted = True
    assert line_map is not None  # a log without a scan has been refused by its reader
    return line_map, join_reports(reports), positions, seconds, interrupted


def _summary(
    command: Build, line_map: "LineMap", report: "Report", options: dict[str, Any], seconds: list[float]
) -> dict[str, Any]:
    """What `build` says about its map; for machines as JSON, for people in words."""
    import numpy as np

    from linemap_jax.build import CHUNK
    from linemap_jax.lab.evaluation import duplicates, explained_share

    # Evenly spread scans are enough for a share, and on a long log save a third of the time.
    scans = int(report.status.shape[0])
    seldom = dataclasses.replace(command, every=command.every * -(-scans // SCANS_EXPLAINED))
    chunks = ((chunk.scans, chunk.poses) for chunk in _chunks(seldom, _open(command), CHUNK))
    share = explained_share(line_map, chunks, options["mount"], chunk=CHUNK)
    lines = line_map.lines
    length = np.asarray(lines.length)[np.asarray(lines.valid)]
    return {
        "log": str(command.log),
        "preset": command.preset,
        "scans": scans,
        "lines": int(np.asarray(lines.valid).sum()),
        "circles": int(np.asarray(line_map.circles.valid).sum()),
        "explained": share,
        "median_line_length_m": float(np.median(length)) if length.size else 0.0,
        "duplicates": int(duplicates(lines).sum()),
        # The first chunk holds the compilation: a log of one chunk does not tell.
        "us_per_scan": 1e6 * float(np.median(seconds[1:])) / CHUNK if len(seconds) > 1 else None,
        "seconds_to_first_chunk": seconds[0],
        "counts": {name: int(np.asarray(getattr(report, name)).sum()) for name in COUNTS},
    }


def _in_words(summary: dict[str, Any]) -> str:
    counts = ", ".join(f"{number} {what}" for what, number in summary["counts"].items())
    pace = summary["us_per_scan"]
    then = "too few scans to time" if pace is None else f"then {pace:.0f} us a scan"
    return (
        f"{summary['scans']} scans -> {summary['lines']} lines, {summary['circles']} circles ({counts})\n"
        f"{summary['explained']:.1%} of the returns under 20 m lie within 10 cm of them; "
        f"median line {summary['median_line_length_m']:.2f} m, {summary['duplicates']} duplicate lines\n"
        f"{summary['seconds_to_first_chunk']:.1f} s to compile, {then}\n"
        f"map:     {summary['map']}\n"
        f"picture: {summary['picture']}"
    )


def _extract(command: Extract) -> int:
    options = _options(command)
    from linemap_jax.build import CHUNK, extract_chunk
    from linemap_jax.core.settings import SCAN_CAPACITY
    from linemap_jax.io.atomic import atomic_write
    from linemap_jax.io.jsonl import lines_of_extraction

    del options["mount"], options["persistence"]  # the result stands in the frame of the sensor
    log = _open(command)
    capacity, written = SCAN_CAPACITY, 0
    with atomic_write(command.output, overwrite=command.overwrite) as path, path.open("w", encoding="utf-8") as file:
        with _progress(command, log):
            for chunk in _chunks(command, log, CHUNK):
                found, capacity = extract_chunk(chunk.scans, capacity=capacity, **options)
                for line in lines_of_extraction(chunk.timestamps, chunk.poses, found):
                    file.write(line + "\n")
                    written += 1
    _warn(command, log)
    _say(command, f"{written} scans -> {command.output}")
    return 0


def _simulate(command: Simulate) -> int:
    _check_simulate(command)
    import jax

    jax.config.update("jax_enable_x64", True)
    _keep_compilations()
    import jax.numpy as jnp
    import numpy as np

    from linemap_jax.io.carmen_writer import write_carmen
    from linemap_jax.io.tum import write_tum
    from linemap_jax.io.worlds import write_world
    from linemap_jax.lab.check import WorldError, check
    from linemap_jax.lab.robot import dead_reckoning
    from linemap_jax.lab.scanners import PRESETS, noise_of
    from linemap_jax.lab.simulate import simulate
    from linemap_jax.lab.world import arrays_from_world

    files = log_file, world_file, poses_file = [
        command.output / name for name in ("scans.log.gz", "world.geojson", "poses.tum")
    ]
    _check_output(command.output, *files, overwrite=command.overwrite)
    of_world, of_drive = jax.random.split(jax.random.key(command.seed))
    name, scanner = str(command.world or command.kind), PRESETS[command.scanner]()
    world = _read_world(command.world) if command.world else _made_world(command, of_world)
    if not world.path.shape[0]:
        raise UsageError(f"{name} has no path for the robot")
    try:
        check(world)
        run = jax.jit(simulate, static_argnames=("count", "turns"))
        log = run(
            of_drive,
            world,
            scanner,
            count=command.scans,
            cov_pose=jnp.diag(jnp.square(jnp.asarray(command.pose_sigma))),
            correlation=command.pose_correlation,
            turns=command.turns,
        )
        check(world, log.true_poses)
    except WorldError as error:
        raise UsageError(f"{name}: {error}") from error

    stamps = SCAN_SECONDS * np.arange(command.scans)
    given = f"{command.scanner}, pose sigma {command.pose_sigma}, correlation {command.pose_correlation}"
    _make_folder(command.output)
    write_carmen(
        log_file,
        ranges=np.where(log.scans.valid, log.scans.ranges, 0),
        bearings=scanner.bearings,
        range_max=float(scanner.range_max),
        poses=log.poses.mean,
        odometry=dead_reckoning(log.true_poses[0], log.odometry),
        timestamps=stamps,
        comments=[f"simulated by linemap: {ascii(name)}, {given}, seed {command.seed}"],
        overwrite=command.overwrite,
    )
    write_world(world_file, arrays_from_world(world), overwrite=command.overwrite)
    write_tum(poses_file, stamps, log.true_poses, overwrite=command.overwrite)
    if not command.quiet:
        metres = np.hypot(*np.diff(np.asarray(log.true_poses)[:, :2], axis=0).T).sum()
        noise = noise_of(scanner)
        sigmas = " ".join(f"{sigma:g}" for sigma in command.pose_sigma)
        print(
            f"{command.scans} scans of {len(scanner.bearings)} beams along {metres:.1f} m -> {log_file}\n"
            f"truth: {world_file}, {poses_file}\n"
            f"noise: --range-sigma {float(noise.range_sigma):.4g} --bearing-sigma {float(noise.bearing_sigma):g} "
            f"--pose-sigma {sigmas}"
        )
    return 0


def _check_simulate(command: Simulate | Trials) -> None:
    """Refuse numbers that make no sense."""
    if not 1 <= command.scans <= MOST_SCANS:
        raise UsageError(f"--scans must be from 1 to {MOST_SCANS}, not {command.scans}")
    if not all(0 <= x < float("inf") for x in command.pose_sigma):
        raise UsageError(f"--pose-sigma must be zero or positive, not {command.pose_sigma}")
    if not 0 <= command.pose_correlation <= 1:
        raise UsageError(f"--pose-correlation must be from 0 to 1, not {command.pose_correlation}")
    if not 0 <= command.seed < 2**63:
        raise UsageError(f"--seed must be from 0 to 2^63 - 1, not {command.seed}")


def _made_world(command: Simulate | Trials, key: "Array") -> "World":
    """The world of `--kind`."""
    import jax.numpy as jnp

    from linemap_jax.lab import generators

    if command.kind == "laboratory":
        return generators.laboratory(key, change=command.scans // 2)
    if command.kind == "changing_room":
        return generators.changing_room(key, scans=command.scans)
    if command.kind == "corridor":
        return generators.corridor(key)
    if command.kind == "free_room":
        return generators.free_room(key, vertices=12)
    if command.kind == "rectilinear_room":
        return generators.rectilinear_room(key, vertices=24)
    around = jnp.asarray([[-2.0, -1.0], [2.0, -1.0], [2.0, 1.0], [-2.0, 1.0], [-2.0, -1.0]])
    return dataclasses.replace(generators.room(8.0, 6.0), path=around)


def _read_world(path: Path) -> "World":
    from linemap_jax.io.worlds import read_world
    from linemap_jax.lab.world import world_from_arrays

    return world_from_arrays(read_world(path, dtype="float64"))


def _evaluate(command: Evaluate) -> int:
    if command.world is None and command.log is None:
        raise UsageError("evaluate needs --world, --log, or both")
    if not 0 < command.distance < float("inf"):
        raise UsageError(f"--distance must be positive, not {command.distance}")
    if command.at is not None and not 0 <= command.at < 2**31 - 1:
        raise UsageError(f"--at must be from 0 to 2^31 - 2, not {command.at}")
    _check_range_max(command.range_max)
    import jax

    jax.config.update("jax_enable_x64", True)
    _keep_compilations()
    from linemap_jax.io.map_file import read_map

    line_map, _ = read_map(command.map, dtype="float64")
    scores: dict[str, Any] = {"map": str(command.map)}
    if command.world is not None:
        scores["truth"] = _against_world(command, command.world, line_map)
    if command.log is not None:
        scores["log"] = _against_log(command, command.log, line_map)
    print(json.dumps(scores, indent=2, allow_nan=False) if command.json else _scores_in_words(scores))
    return 0


def _against_world(command: Evaluate, path: Path, line_map: "LineMap") -> dict[str, Any]:
    """The score of a map against the truth, in numbers; None where there is nothing to tell of."""
    import numpy as np

    from linemap_jax.build import CHUNK
    from linemap_jax.lab.check import WorldError, check
    from linemap_jax.lab.evaluation import seen_in_log
    from linemap_jax.lab.scoring import GONE, Gates, evaluate, times_of_objects
    from linemap_jax.lab.world import NEVER

    world = _read_world(path)
    try:
        check(world, world.path[:0])  # where the robot was is no matter
    except WorldError as error:
        raise UsageError(f"{path}: {error}") from error
    seen, at = None, NEVER - 1
    if command.log is not None:
        log = _open_plain(command, command.log)
        with _progress(command, log):
            seen, scans = seen_in_log(world, _plain_chunks(log), chunk=CHUNK)
        at = scans - 1
    at = at if command.at is None else command.at
    score = evaluate(line_map, world, seen, scan_index=at, gates=Gates(distance=command.distance))
    _, vanishes, exists = (np.asarray(x) for x in times_of_objects(world))
    gone = exists & (vanishes <= at)
    offset, angle = (_or_none(x) for x in np.asarray(score.error))
    return {
        "world": str(path),
        "at": None if at == NEVER - 1 else at,
        "distance_m": command.distance,
        "precision": _or_none(score.precision),
        "recall": _or_none(score.recall),
        "line_length_m": float(score.line_length),
        "seen_length_m": float(score.wall_seen.sum()),
        "lines": int(line_map.lines.valid.sum()),
        "phantom_lines": int(score.phantom_line.sum()),
        "walls": int((score.wall_seen > 0).sum()),
        "walls_held_twice": int(score.duplicates),
        "fragments": int(score.fragments),
        "offset_rms_m": offset,
        "angle_rms_rad": angle,
        "mean_nees": _or_none(score.nees),
        "circles": int(line_map.circles.valid.sum()),
        "phantom_circles": int(score.phantom_circle.sum()),
        "poles": int(((score.circles_of_pole > 0) | score.missed_pole).sum()),
        "missed_poles": int(score.missed_pole.sum()),
        "poles_held_twice": int((score.circles_of_pole > 1).sum()),
        "gone": int(gone.sum()),
        "gone_but_held": int((gone & (np.asarray(score.object_held) >= GONE)).sum()),
    }


def _against_log(command: Evaluate, path: Path, line_map: "LineMap") -> dict[str, Any]:
    """What a log says of a map, in numbers; None where there is nothing to tell of."""
    from linemap_jax.build import CHUNK
    from linemap_jax.lab.evaluation import evaluate_log

    log = _open_plain(command, path)
    scans = sum(1 for _ in log)
    _warn(command, log)
    with _progress(command, log):
        score = evaluate_log(line_map, _plain_chunks(log, every=-(-scans // SCANS_EXPLAINED)), chunk=CHUNK)
    return {
        "log": str(path),
        "scans": scans,
        "returns": score.returns,
        "explained": _or_none(score.explained),
        "met": _or_none(score.met),
        "residual_median_m": _or_none(score.residual_median),
        "residual_90_m": _or_none(score.residual_90),
    }


def _open_plain(command: Evaluate | Calibrate, path: Path) -> "Log":
    from linemap_jax.io.log import open_log

    return open_log(path, strict=command.strict, range_max=command.range_max)


def _plain_chunks(log: "Log", every: int = 1) -> Iterator[Any]:
    """Scans and poses of a log as they are."""
    import numpy as np

    from linemap_jax.build import CHUNK
    from linemap_jax.io.scans import chunks_of_readings

    for chunk in chunks_of_readings(log, CHUNK, cov_pose=np.zeros((3, 3)), every=every, dtype="float64"):
        yield chunk.scans, chunk.poses


def _or_none(number: Any) -> float | None:
    return float(number) if math.isfinite(number) else None


def _scores_in_words(scores: dict[str, Any]) -> str:
    def told(value: float | None, form: str, scale: float = 1.0) -> str:
        return "-" if value is None else format(scale * value, form)

    said = []
    if (score := scores.get("truth")) is not None:
        near = f"{100 * score['distance_m']:g} cm"
        offset, angle = told(score["offset_rms_m"], ".1f", 100), told(score["angle_rms_rad"], ".2f", 180 / math.pi)
        said += [
            f"precision {told(score['precision'], '.1%')} of {score['line_length_m']:.1f} m of lines, within {near}; "
            f"{score['phantom_lines']} of {score['lines']} lines are phantoms",
            f"recall {told(score['recall'], '.1%')} of {score['seen_length_m']:.1f} m of walls that could be seen; "
            f"{score['walls_held_twice']} of {score['walls']} walls are held twice, "
            f"{score['fragments']} pieces are too many",
            f"error {offset} cm, {angle} degrees (rms); mean NEES {told(score['mean_nees'], '.2f')} "
            "(2 if the covariances are right)",
            f"{score['missed_poles']} of {score['poles']} poles are missed, {score['poles_held_twice']} held twice; "
            f"{score['phantom_circles']} of {score['circles']} circles are phantoms",
            f"{score['gone_but_held']} of {score['gone']} things that are gone are still held",
        ]
    if (score := scores.get("log")) is not None:
        median, most = (told(score[f"residual_{name}_m"], ".1f", 100) for name in ("median", "90"))
        said += [
            f"{told(score['explained'], '.1%')} of the returns under 20 m lie within 10 cm of the map; "
            f"along the beam they are off by {median} cm (median), {most} cm (90 %)"
        ]
    return "\n".join(said)


def _trials(command: Trials) -> int:
    _check_simulate(command)
    if not 1 <= command.runs <= MOST_RUNS:
        raise UsageError(f"--runs must be from 1 to {MOST_RUNS}, not {command.runs}")
    options = _method(command)
    mesh = _devices(command.devices)
    import jax
    import jax.numpy as jnp
    import numpy as np
    from tqdm import tqdm

    from linemap_jax.io.table import ResultsTable
    from linemap_jax.lab.batch import run_chunks
    from linemap_jax.lab.scanners import PRESETS
    from linemap_jax.lab.trials import Conditions, Trial, columns_of, recommend, summary, sweep, trial

    thresholds, noise = options.pop("thresholds"), options.pop("noise")
    conditions = Conditions(
        scanner=PRESETS[command.scanner](),
        cov_pose=jnp.diag(jnp.square(jnp.asarray(command.pose_sigma))),
        correlation=command.pose_correlation,
    )

    known = [field.name for field in dataclasses.fields(thresholds)]
    for name in command.sweep:
        if name not in known:
            raise UsageError(f"--sweep: there is no threshold {name!r}: choose from {', '.join(known)}")
    varied, variants = sweep(thresholds, command.sweep)

    def experiment(run: Any, *common: Any) -> Any:
        noise, conditions = common
        of_world, of_drive = jax.random.split(run["key"])
        of_run = Trial(key=of_drive, world=_made_world(command, of_world), thresholds=run["thresholds"], noise=noise)
        return trial(of_run, conditions, scans=command.scans, pose_error=command.pose_error, **options)

    batches = max(1, CHUNK_RUNS // (BATCH_RUNS * mesh.size))
    chunk = BATCH_RUNS * batches * mesh.size
    told = {k: v for k, v in dataclasses.asdict(command).items() if k not in ("output", "devices", "quiet", "json")}
    told |= {"config": command.config and command.config.read_text(encoding="utf-8")}
    table = ResultsTable(command.output, told)
    total, done = command.runs * len(varied), table.rows
    if done % chunk and done < total:
        raise UsageError(f"{command.output} holds {done} drives, which are no chunks of {chunk}: give --devices")
    # All variants of one drive stand side by side.
    drive, variant = np.divmod(np.arange(total), len(varied))
    runs = {
        "key": jax.random.split(jax.random.key(command.seed), command.runs)[drive],
        "thresholds": jax.tree.map(lambda x: x[variant], variants),
    }
    started = time.perf_counter()
    with tqdm(
        total=total, initial=done, unit="drive", disable=True if command.quiet else None, file=sys.stderr
    ) as progress:
        common = (noise, conditions)
        chunks = run_chunks(experiment, runs, *common, mesh=mesh, batch=BATCH_RUNS, batches=batches, start=done)
        for first, rows in chunks if done < total else ():
            here = slice(first, first + len(rows.lines))
            which = [varied[i] for i in variant[here]]
            columns: dict[str, Any] = {"drive": drive[here]}
            if command.sweep:
                columns |= {"threshold": [name for name, _ in which], "value": [value for _, value in which]}
            table.append(first, columns | columns_of(rows))
            progress.update(len(rows.lines))
    seconds = time.perf_counter() - started
    results = table.read()
    speed = {"seconds": seconds, "drives_per_second": (total - done) / seconds}
    if command.sweep:
        of_variants = [{name: column[i :: len(varied)] for name, column in results.items()} for i in range(len(varied))]
        advice = recommend(varied, of_variants)
        costs, differences, errors = (
            np.concatenate([getattr(one, name) for one in advice]).tolist()
            for name in ("costs", "differences", "errors")
        )
        scores = [
            {"threshold": name, "value": value, "cost": costs[i], "difference": differences[i], "error": errors[i]}
            | summary(of_variants[i])
            for i, (name, value) in enumerate(varied)
        ]
        recommended = {one.threshold: one.value for one in advice}
        document = {"variants": scores, "recommended": recommended, **speed}
        print(json.dumps(document, indent=2) if command.json else _sweep_in_words(scores, recommended))
    else:
        score = summary(results) | speed
        print(json.dumps(score, indent=2) if command.json else _trials_in_words(score))
    if not command.json:
        print(f"{total} drives -> {command.output}")
    return 0


def _sweep_in_words(scores: list[dict[str, Any]], recommended: dict[str, float]) -> str:
    names = ("cost", "precision", "recall", "duplicates", "false_matches", "missed_matches", "gone", "noticed")
    lines = [f"{'threshold':22s} {'value':>8s} " + " ".join(f"{name:>14s}" for name in names)]
    for score in scores:
        cells = ["-" if score[name] is None else f"{score[name]:.2%}" for name in names]
        mark = " <-" if score["value"] == recommended[score["threshold"]] else ""
        cells = " ".join(f"{cell:>14s}" for cell in cells)
        lines.append(f"{score['threshold']:22s} {score['value']:8.4g} {cells}{mark}")
    lines.append("cost: the sum of the shares of all mistakes; <- recommended: the least cost if that is sure")
    return "\n".join(lines)


def _trials_in_words(score: dict[str, Any]) -> str:
    def share(name: str) -> str:
        return "-" if score[name] is None else f"{score[name]:.2%}"

    def number(name: str, scale: float = 1.0) -> str:
        return "-" if score[name] is None else f"{scale * score[name]:.2f}"

    return "\n".join(
        [
            f"length within 5 cm: precision {share('precision')}, recall {share('recall')}",
            f"{share('duplicates')} of {score['walls']} walls are held twice, {score['fragments']} pieces are too "
            f"many; {share('phantom_lines')} of {score['lines']} lines are phantoms",
            f"error {number('offset_rms_m', 100)} cm, {number('angle_rms_rad', 180 / math.pi)} degrees (rms); "
            f"mean NEES {number('mean_nees')}, {share('covered')} inside the 95 % ellipse",
            f"{share('missed_poles')} of {score['poles']} poles are missed, {share('phantom_circles')} of "
            f"{score['circles']} circles are phantoms",
            f"matches: {share('false_matches')} false, {share('missed_matches')} missed of {score['matches']}",
            f"{share('gone')} of {score['vanished']} vanished things are gone after three scans that could tell, "
            f"{share('noticed')} of {score['appeared']} new ones are there",
        ]
    )


def _calibrate(command: Calibrate) -> int:
    if not 2 <= command.scans <= MOST_SCANS:
        raise UsageError(f"--scans must be from 2 to {MOST_SCANS}, not {command.scans}")
    if not 1 <= command.lag < command.scans:
        raise UsageError(f"--lag must be from 1 to less than the number of scans, not {command.lag}")
    _check_range_max(command.range_max)
    _check_offset(command.laser_offset)
    if command.output:
        _check_output(command.output.parent, command.output, overwrite=command.overwrite)
    import jax

    jax.config.update("jax_enable_x64", True)
    _keep_compilations()
    import numpy as np

    from linemap_jax.core.settings import Mount, SensorNoise
    from linemap_jax.io.atomic import atomic_write
    from linemap_jax.io.scans import chunks_of_readings
    from linemap_jax.lab.calibration import pose_noise, sensor_noise

    log = _open_plain(command, command.log)
    chunk = next(chunks_of_readings(log, command.scans, cov_pose=np.zeros((3, 3)), dtype="float64"))
    _warn(command, log)
    mount = Mount(*command.laser_offset) if command.laser_offset else Mount()
    try:
        sensor = sensor_noise(chunk.scans)
        noise = SensorNoise(range_sigma=float(sensor.sigma[0]), bearing_sigma=float(sensor.sigma[1]))
        poses = pose_noise(chunk.scans, chunk.poses.mean, noise, mount, lag=command.lag)
    except ValueError as error:
        raise UsageError(f"{command.log}: {error}") from error
    rows = {
        name: {"sigma": sigma, "from": low, "to": high}
        for estimate, names in (
            (sensor, ("range_m", "bearing_rad")),
            (poses, ("x_m", "y_m", "theta_rad", "walls_m", "walls_rad")),
        )
        for name, sigma, (low, high) in zip(names, estimate.sigma.tolist(), estimate.interval.tolist(), strict=True)
    }
    if command.output:
        text = f"[noise]\nrange_sigma = {noise.range_sigma:.4g}\nbearing_sigma = {noise.bearing_sigma:.4g}\n"
        _make_folder(command.output.parent)
        with atomic_write(command.output, overwrite=command.overwrite) as path:
            path.write_text(text, encoding="utf-8")
    if command.json:
        print(json.dumps(rows | {"beams": sensor.used, "lines": poses.used, "scans": len(chunk.timestamps)}, indent=2))
        return 0
    sigmas = {name: f"{row['sigma']:.3g}" for name, row in rows.items()}
    print(f"from {sensor.used} beams and {poses.used} pairs of lines in {len(chunk.timestamps)} scans, 95 % intervals:")
    for name, row in rows.items():
        what, unit = name.split("_")
        told = f"{row['from']:.3g} to {row['to']:.3g}" if row["to"] < 100 * row["from"] else "not told by this log"
        print(f"  {what:8s} {sigmas[name]} {unit} ({told})")
    print(
        f"--range-sigma {sigmas['range_m']} --bearing-sigma {sigmas['bearing_rad']} "
        f"--pose-sigma {sigmas['x_m']} {sigmas['y_m']} {sigmas['theta_rad']}"
    )
    return 0


def _devices(count: int | None) -> "Mesh":
    """So many devices in a row; of processors, as many as the machine has."""
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    import jax

    # Without effect where jax has counted its devices already, or where they are accelerators.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", processors)
    from linemap_jax.lab.batch import mesh_of_devices

    try:
        return mesh_of_devices(count)
    except ValueError as error:
        raise UsageError(f"--devices: {error}") from error


def _verify(command: Verify) -> int:
    _keep_compilations()
    from linemap_jax.lab.verification import as_dict, as_text, verify

    if sys.stderr.isatty():
        print("linemap: compiles for some 20 s, the first time", file=sys.stderr)
    rows = verify()
    if command.json:
        print(json.dumps([as_dict(row) for row in rows], indent=2))
    else:
        print(as_text(rows, width=min(shutil.get_terminal_size().columns, 120)))
    return 0 if all(row.passed for row in rows) else 1


def _options(command: LogOptions) -> dict[str, Any]:
    """The keyword arguments of `update`: preset, then the settings file, then the options of the command line."""
    _check(command)
    import jax

    jax.config.update("jax_enable_x64", command.dtype == "float64")
    from linemap_jax.core.settings import Mount, SensorNoise

    options = _method(command)
    options |= {"mount": Mount(), "noise": options["noise"] or SensorNoise()}
    sigmas = {"range_sigma": command.range_sigma, "bearing_sigma": command.bearing_sigma}
    given = {name: sigma for name, sigma in sigmas.items() if sigma is not None}
    options["noise"] = dataclasses.replace(options["noise"], **given)
    if command.laser_offset is not None:
        options["mount"] = Mount(*command.laser_offset)
    if command.covariance is not None:
        options["covariance"] = command.covariance
    return options | {"jacobians": command.jacobians, "segmentation": command.segmentation}


def _method(command: LogOptions | Trials) -> dict[str, Any]:
    """The preset, and the settings file over it; no noise unless the file states it."""
    _keep_compilations()
    from linemap_jax.core.settings import Persistence, SensorNoise, preset
    from linemap_jax.io.config import read_config

    options = preset(command.preset) | {"noise": None, "persistence": Persistence()}
    for section, fields in (read_config(command.config) if command.config else {}).items():
        options[section] = dataclasses.replace(options[section] or SensorNoise(), **fields)
    return options


def _check_range_max(range_max: float | None) -> None:
    if range_max is not None and not range_max > 0:
        raise UsageError(f"--range-max must be positive, not {range_max}")


def _check_offset(offset: tuple[float, float, float] | None) -> None:
    if offset is not None and not all(map(math.isfinite, offset)):
        raise UsageError(f"--laser-offset must be finite, not {offset}")


def _check(command: LogOptions) -> None:
    """Refuse numbers that make no sense."""
    inf = float("inf")
    if not 1 <= command.every <= 10**9:
        raise UsageError(f"--every must be from 1 to 10^9, not {command.every}")
    if not 0 <= command.range_min < inf:
        raise UsageError(f"--range-min must be zero or positive, not {command.range_min}")
    if command.range_max is not None and not command.range_min < command.range_max:
        raise UsageError(f"--range-max must be more than --range-min, not {command.range_max}")
    if command.range_sigma is not None and not 0 < command.range_sigma < inf:
        raise UsageError(f"--range-sigma must be positive, not {command.range_sigma}")
    if command.bearing_sigma is not None and not 0 <= command.bearing_sigma < inf:
        raise UsageError(f"--bearing-sigma must be zero or positive, not {command.bearing_sigma}")
    if not all(0 <= x < inf for x in command.pose_sigma):
        raise UsageError(f"--pose-sigma must be zero or positive, not {command.pose_sigma}")
    _check_offset(command.laser_offset)


def _open(command: Build | Extract) -> "Log":
    from linemap_jax.io.log import open_log

    return open_log(command.log, strict=command.strict, range_max=command.range_max)


def _chunks(command: LogOptions, log: "Log", size: int) -> Iterator["Chunk"]:
    import numpy as np

    from linemap_jax.io.scans import chunks_of_readings

    cov_pose = np.diag(np.square(command.pose_sigma))
    return chunks_of_readings(
        log, size, cov_pose=cov_pose, range_min=command.range_min, every=command.every, dtype=command.dtype
    )


def _check_output(folder: Path, *files: Path, overwrite: bool) -> None:
    """Refuse before the work what would be refused after it. Nothing is made yet: the log may be refused too."""
    from linemap_jax.io.atomic import OutputError

    try:
        for file in files:
            if file.exists() and not overwrite:
                raise OutputError(f"{file} exists already; use --overwrite to replace it")
        lowest = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    except PermissionError as error:
        raise OutputError(f"cannot write to the folder {folder}: {error.strerror}") from error
    if not lowest.is_dir():
        raise OutputError(f"cannot write to {folder}: {lowest} is not a folder")
    if not os.access(lowest, os.W_OK | os.X_OK):
        raise OutputError(f"cannot write to the folder {lowest}: permission denied")


def _make_folder(folder: Path) -> None:
    from linemap_jax.io.atomic import OutputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder {folder}: {error.strerror}") from error


def _keep_compilations() -> None:
    """What is compiled is kept for the next run of the command line."""
    import jax

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # else the user has said where
        jax.config.update("jax_compilation_cache_dir", str(_cache_folder()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "linemap_jax"


@contextlib.contextmanager
def _progress(command: LogOptions | Evaluate, log: "Log") -> Iterator[None]:
    """A progress bar over the bytes of the log, where somebody watches."""
    if command.quiet or not sys.stderr.isatty():
        yield
        return
    from tqdm import tqdm

    with tqdm(unit="B", unit_scale=True, leave=False) as bar:

        def show(read: int, total: int) -> None:
            bar.total = total
            bar.update(read - bar.n)

        log.progress = show
        yield
        log.progress = None


def _warn(command: LogOptions | Evaluate | Calibrate, log: "Log") -> None:
    for warning in log.notes.warnings():
        _say(command, f"warning: {log.path}: {warning}")


def _say(command: LogOptions | Evaluate | Calibrate, sentence: str) -> None:
    if not command.quiet:
        print(f"linemap: {sentence}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
