"""`linemap build` and `linemap demo`: from a log to a map, its picture and a summary."""

import dataclasses
import json
import sys
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from linemap_jax.cli.history import History
from linemap_jax.cli.logs import SCANS_EXPLAINED, chunks_of_log, mount_of, opened, progress, tell_poses, warn
from linemap_jax.cli.mapping import map_of_pieces
from linemap_jax.cli.noise import noise_of_map, states_noise, tell_noise
from linemap_jax.cli.options import LogOptions, options_of_update, own_options_first
from linemap_jax.cli.output import check_output, make_folder, say
from linemap_jax.cli.rejections import Rejections
from linemap_jax.cli.resume import differences, map_to_resume

if TYPE_CHECKING:
    from linemap_jax.core.state import LineMap, Pose, Report, Scan
    from linemap_jax.io.reading import Log

DEMO_NOISE = {"range_sigma": 0.015, "bearing_sigma": 0.0005, "pose_sigma": (0.01, 0.01, 0.002)}
"""What the demo log was made with."""

FEW_EXPLAINED = 0.6
"""Share of the returns that lie on a map, below which something is wrong: of maps of corrected logs two thirds and more
do."""

COUNTS = ("added", "fused", "merged", "trimmed", "split", "deleted")
"""The counts of a `Report`."""


@own_options_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Build(LogOptions):
    """Build a map from a log: writes map.json and map.png, and prints a summary."""

    log: tyro.conf.Positional[Path]
    """CARMEN log, plain or .gz; ROS 1 .bag; ROS 2 bag: its folder, .mcap or .db3."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder for the map; made if it is not there."""
    pose_error: Literal["independent", "persistent", "unknown"] = "unknown"
    """How the errors of the poses hang together from scan to scan; `persistent` by [persistence] of the settings file.
    With `unknown` covariances are bounds that hold in any case."""
    json: bool = False
    """Print the summary as JSON."""
    resume_from: Annotated[Path | None, tyro.conf.arg(metavar="MAP")] = None
    """Map to go on from, in the frame of the log, as if its log and this one were one drive. The noise is that of this
    map, unless it is stated."""
    html: bool = False
    """Write map.html too: a page to explore, with a slider over the map on the way."""

    def run(self) -> int:
        """Build the map, and give the exit status."""
        options: dict[str, Any] = options_of_update(self) | {"pose_error": self.pose_error}
        import jax
        import numpy as np

        from linemap_jax.core.state import Status
        from linemap_jax.io.map_file import write_map
        from linemap_jax.io.plot import plot_map

        map_file, picture, page = (self.output / f"map.{ending}" for ending in ("json", "png", "html"))
        check_output(self.output, map_file, picture, *([page] if self.html else []), overwrite=self.overwrite)
        before = map_to_resume(self.resume_from, self.dtype, self.pose_error) if self.resume_from else None
        if before is not None and not states_noise(self):
            options["noise"] = noise_of_map(before.settings) or options["noise"]
        log = opened(self, self.log)
        options["mount"] = mount_of(self, log, quiet=self.quiet)
        if log.notes.drift:
            say(
                f"warning: {log.path}: its poses are raw odometry ({log.notes.poses}), which drifts; `linemap slam` "
                "corrects it, `build` does not",
                quiet=self.quiet,
            )
        settings = {
            "log": self.log.name,
            "preset": self.preset,
            "pose_sigma": self.pose_sigma,
            **options,
        }
        if before is not None:
            if told := differences(before.settings, settings):
                say(f"warning: {self.resume_from} was built with other settings: {told}", quiet=self.quiet)
            settings["resumed_from"] = str(before.settings.get("log", self.resume_from))
        history = History(options["mount"]) if self.html else None
        with progress(log, quiet=self.quiet):
            positions: list[tuple[float, float]] = []
            pieces = _driven(self, log, history, positions)
            line_map, report, seconds, interrupted = map_of_pieces(
                pieces, options, before.line_map if before else None, history.add if history else None
            )
        warn(log, quiet=self.quiet)
        lost = sum(bool(status & Status.POSE_NOT_FINITE) for status in report.status.tolist())
        if lost:
            say(
                f"warning: {log.path}: {lost} scans were left out: their poses are not finite in {self.dtype}",
                quiet=self.quiet,
            )

        # On the host, where nothing has to be compiled.
        line_map = jax.tree.map(np.asarray, line_map)
        if not line_map.lines.valid.any() and not line_map.circles.valid.any():
            say(f"warning: {log.path}: {_rejections(self, log, options)}", quiet=self.quiet)
        make_folder(self.output)
        write_map(map_file, line_map, settings, overwrite=self.overwrite)
        plot_map(picture, line_map, positions, title=self.log.name, overwrite=self.overwrite)
        if history is not None:
            from linemap_jax.io.html import Moment, write_html

            moments = [*(Moment(*kept) for kept in history.kept), Moment(line_map, len(positions))]
            write_html(page, moments, positions, history.points, title=self.log.name, overwrite=self.overwrite)
        if interrupted:
            print(f"linemap: interrupted; the map so far is in {self.output}", file=sys.stderr)
            return 130
        files = {"map": str(map_file), "picture": str(picture)} | ({"page": str(page)} if self.html else {})
        stated = states_noise(self) or (before is not None and noise_of_map(before.settings) is not None)
        told = {"poses": tell_poses(self, log), "noise": tell_noise(options["noise"], stated=stated)}
        summary = _summary(self, line_map, report, options, seconds) | told | files
        print(json.dumps(summary, indent=2) if self.json else _in_words(summary))
        share = float(summary["explained"])
        if summary["lines"] and share < FEW_EXPLAINED:
            say(
                f"warning: {log.path}: only {share:.0%} of its returns lie on the map: do its poses "
                "drift (`linemap slam` corrects them), does the laser sit elsewhere (--laser-offset), or is the noise "
                "larger (--range-sigma, --pose-sigma)?",
                quiet=self.quiet,
            )
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demo:
    """Build a map from the log that ships with the package: a cluttered laboratory with poles."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")] = Path("linemap-demo")
    """Folder for the map; made if it is not there."""
    overwrite: bool = False
    """Replace output that is there already."""
    quiet: bool = False
    """No progress, no warnings."""

    def run(self) -> int:
        """Build the map, and give the exit status."""
        log = resources.files("linemap_jax.io").joinpath("data", "demo.log.gz")
        with resources.as_file(log) as path:
            build = Build(log=path, output=self.output, overwrite=self.overwrite, quiet=self.quiet, **DEMO_NOISE)
            return build.run()


def _driven(
    command: Build, log: "Log", history: History | None, positions: list[tuple[float, float]]
) -> Iterator[tuple["Scan", "Pose"]]:
    """The log in pieces; the positions of the robot are kept on the way."""
    import numpy as np

    from linemap_jax.build import CHUNK

    for chunk in chunks_of_log(command, log, CHUNK):
        positions.extend(map(tuple, np.asarray(chunk.poses.mean)[:, :2].tolist()))
        if history is None:
            yield chunk.scans, chunk.poses
        else:
            yield from history.pieces(chunk.scans, chunk.poses)


def _rejections(command: Build, log: "Log", options: dict[str, Any]) -> Rejections:
    """Why the scans of a log gave nothing: they are extracted once more, which the map has no use for otherwise."""
    from linemap_jax.build import CHUNK, extract_chunk
    from linemap_jax.core.settings import SCAN_CAPACITY

    rejections, capacity = Rejections(), SCAN_CAPACITY
    of_map = ("mount", "persistence", "pose_error")
    options = {name: option for name, option in options.items() if name not in of_map}
    for chunk in chunks_of_log(command, log, CHUNK):
        found, capacity = extract_chunk(chunk.scans, capacity=capacity, **options)
        rejections.add(found)
    return rejections


def _summary(
    command: Build, line_map: "LineMap", report: "Report", options: dict[str, Any], seconds: list[tuple[float, int]]
) -> dict[str, Any]:
    """What `build` says about its map; for machines as JSON, for people in words."""
    import numpy as np

    from linemap_jax.build import CHUNK
    from linemap_jax.lab.evaluation import duplicates, explained_share

    # Evenly spread scans are enough for a share, and on a long log save a third of the time.
    scans = int(report.status.shape[0])
    seldom = dataclasses.replace(command, every=command.every * -(-scans // SCANS_EXPLAINED))
    log = opened(command, command.log)
    chunks = ((chunk.scans, chunk.poses) for chunk in chunks_of_log(seldom, log, CHUNK))
    share = explained_share(line_map, chunks, options["mount"], chunk=CHUNK)
    lines = line_map.lines
    length = lines.length[lines.valid]
    return {
        "log": str(command.log),
        "preset": command.preset,
        "scans": scans,
        "lines": int(lines.valid.sum()),
        "circles": int(line_map.circles.valid.sum()),
        "explained": share,
        "median_line_length_m": float(np.median(length)) if length.size else 0.0,
        "duplicates": int(np.asarray(duplicates(lines)).sum()),
        # The first piece holds the compilation: a log of one piece does not tell.
        "us_per_scan": 1e6 * float(np.median([t / count for t, count in seconds[1:]])) if len(seconds) > 1 else None,
        "seconds_to_first_chunk": seconds[0][0],
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
        f"poses:   {summary['poses']}\n"
        f"noise:   {summary['noise']}\n"
        f"map:     {summary['map']}\n"
        f"picture: {summary['picture']}" + (f"\npage:    {summary['page']}" if "page" in summary else "")
    )
