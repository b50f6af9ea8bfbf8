"""The command line: reads the options, and hands on between files, the build and the pictures."""

import contextlib
import dataclasses
import json
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
    from linemap_jax.core.state import LineMap, Report
    from linemap_jax.io.log import Log
    from linemap_jax.io.scans import Chunk


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


DEMO_NOISE = {"range_sigma": 0.015, "bearing_sigma": 0.0005, "pose_sigma": (0.01, 0.01, 0.002)}
"""What the demo log was made with."""

SCANS_EXPLAINED = 500
"""The share of returns that the map explains is taken over so many scans at most."""

START_CAPACITY = (512, 256)
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

    try:
        if isinstance(command, Verify):
            return _verify(command)
        if isinstance(command, Extract):
            return _extract(command)
        return _build(_of_demo(command) if isinstance(command, Demo) else command)
    except (LogError, OutputError, MapFileError, ConfigError, UsageError) as error:
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
    _keep_compilations()
    from linemap_jax.core.settings import Mount, Persistence, SensorNoise, preset
    from linemap_jax.io.config import read_config

    options = preset(command.preset) | {"noise": SensorNoise(), "mount": Mount(), "persistence": Persistence()}
    for section, fields in (read_config(command.config) if command.config else {}).items():
        options[section] = dataclasses.replace(options[section], **fields)
    sigmas = {"range_sigma": command.range_sigma, "bearing_sigma": command.bearing_sigma}
    given = {name: sigma for name, sigma in sigmas.items() if sigma is not None}
    options["noise"] = dataclasses.replace(options["noise"], **given)
    if command.laser_offset is not None:
        options["mount"] = Mount(*command.laser_offset)
    if command.covariance is not None:
        options["covariance"] = command.covariance
    return options | {"jacobians": command.jacobians, "segmentation": command.segmentation}


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
    if command.laser_offset is not None and not all(-inf < x < inf for x in command.laser_offset):
        raise UsageError(f"--laser-offset must be finite, not {command.laser_offset}")


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
def _progress(command: LogOptions | Build, log: "Log") -> Iterator[None]:
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


def _warn(command: LogOptions, log: "Log") -> None:
    for warning in log.notes.warnings():
        _say(command, f"warning: {log.path}: {warning}")


def _say(command: LogOptions, sentence: str) -> None:
    if not command.quiet:
        print(f"linemap: {sentence}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
