"""`linemap slam`: from raw odometry and scans to a map and a trajectory."""

import dataclasses
import json
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from linemap_jax.cli.logs import SCANS_EXPLAINED, chunks_of_log, mount_of_odometry, odometry_of, opened, progress, warn
from linemap_jax.cli.mapping import map_of_pieces
from linemap_jax.cli.noise import states_noise, tell_noise
from linemap_jax.cli.options import POSE_SIGMA, LogOptions, UsageError, options_of_update, own_options_first
from linemap_jax.cli.output import check_output, make_folder, say

if TYPE_CHECKING:
    import numpy as np

    from linemap_jax.core.settings import Mount
    from linemap_jax.core.state import LineMap, Pose, Scan
    from linemap_jax.io.reading import Log
    from linemap_jax.slam import Slam as Slammed

DOUBTFUL = 0.4
"""Scans of which fewer points than this share agree with what was seen before are told of."""


@own_options_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Slam(LogOptions):
    """Build a map and a trajectory from a log with raw odometry: writes map.json, map.png, trajectory.tum and .csv."""

    log: tyro.conf.Positional[Path]
    """CARMEN log, plain or .gz; ROS 1 .bag; ROS 2 bag: its folder, .mcap or .db3."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder for the map and the trajectory; made if it is not there."""
    trajectory_frame: Literal["laser", "base"] = "laser"
    """Whose poses trajectory.tum and .csv hold: the laser's, or the robot's."""
    json: bool = False
    """Print the summary as JSON."""
    pose_sigma: tyro.conf.Suppress[tuple[float, float, float]] = POSE_SIGMA  # of no effect here

    def run(self) -> int:
        """Track, close loops, map, adjust; and give the exit status."""
        options: dict[str, Any] = options_of_update(self) | {"pose_error": "unknown"}
        import numpy as np

        from linemap_jax.core.settings import Mount
        from linemap_jax.io.map_file import write_map
        from linemap_jax.io.plot import plot_map
        from linemap_jax.io.tum import write_covariances, write_tum

        files = [self.output / name for name in ("map.json", "map.png", "trajectory.tum", "trajectory.csv")]
        check_output(self.output, *files, overwrite=self.overwrite)
        log = opened(self, self.log)
        mount = mount_of_odometry(self, log)
        started = time.perf_counter()
        with progress(log, quiet=self.quiet):
            slammed, stamps, to_first, interrupted = _tracked(self, log, mount)
        warn(log, quiet=self.quiet)
        _tell_doubts(slammed, log, quiet=self.quiet)

        say("the trajectory stands; mapping", quiet=self.quiet)
        at_laser = options | {"mount": Mount()}
        again, drift = opened(self, self.log), _of_robot(slammed.drift(stamps), mount)
        with progress(again, quiet=self.quiet):
            pieces = _seen_again(slammed, _at_poses(self, again, slammed.trajectory(), drift))
            mapped = map_of_pieces(pieces, at_laser)
        of_map = ("mount", "persistence", "pose_error")
        of_extract = {name: option for name, option in options.items() if name not in of_map}
        line_map, cov_keyframes = slammed.adjust(mapped.line_map, **of_extract)
        interrupted |= mapped.interrupted
        seconds = time.perf_counter() - started
        trajectory = slammed.trajectory()

        make_folder(self.output)
        settings = {
            "log": self.log.name,
            "preset": self.preset,
            "slam": {
                "keyframes": len(slammed.keyframes),
                "loops": slammed.closures,
                "unit_variance": slammed.unit_variance,
                "laser_offset": self.laser_offset,  # to read the log once more at the trajectory
            },
            **at_laser,
        }
        write_map(files[0], line_map, settings, overwrite=self.overwrite)
        plot_map(files[1], line_map, trajectory[:, :2], title=self.log.name, overwrite=self.overwrite)
        poses, covs = trajectory, slammed.cov_trajectory(cov_keyframes)
        if self.trajectory_frame == "base":
            poses, covs = _of_base(trajectory, covs, mount)
        whose = "robot" if self.trajectory_frame == "base" else "laser"
        write_tum(files[2], stamps, poses, pose_frame=whose, overwrite=self.overwrite)
        is_keyframe = np.isin(np.arange(len(stamps)), slammed.scan_of_keyframe)
        write_covariances(
            files[3], stamps, poses, covs, _doubtful(slammed), keyframes=is_keyframe, overwrite=self.overwrite
        )
        if interrupted:
            print(f"linemap: interrupted; map and trajectory so far are in {self.output}", file=sys.stderr)
            return 130
        pace = _pace(stamps, seconds, to_first + mapped.seconds[0][0])
        noise = {"noise": tell_noise(options["noise"], stated=states_noise(self))}
        summary = _summary(self, slammed, line_map, trajectory, drift, files) | noise | pace
        print(json.dumps(summary, indent=2) if self.json else _in_words(summary))
        return 0


def _tracked(command: Slam, log: "Log", mount: "Mount") -> tuple["Slammed", "np.ndarray", float, bool]:
    """The log run through, the time stamps of its scans, the seconds to the first chunk, and whether interrupted."""
    import numpy as np

    from linemap_jax import slam
    from linemap_jax.core.frames_on_host import between, compose

    slammed, stamps, to_first, interrupted = slam.Slam(), [], 0.0, False
    started = time.perf_counter()
    on_robot = np.array([mount.x, mount.y, mount.theta], float)
    try:
        for chunk in chunks_of_log(command, log, slam.CHUNK):
            odometry = odometry_of(command, chunk)
            if not np.isfinite(odometry).all():
                raise UsageError(
                    f"{log.path}: has scans without odometry; --standstill does without, --poses takes it from a file"
                )
            stamps.append(chunk.timestamps)
            last_beam = between(on_robot, compose(chunk.last_beam, on_robot))
            slammed.add(chunk.scans, compose(odometry, on_robot), last_beam)
            to_first = to_first or time.perf_counter() - started
    except KeyboardInterrupt:
        if len(slammed.keyframes) == 0:
            raise
        interrupted = True
        print(f"linemap: interrupted; mapping the {len(slammed.trajectory())} scans so far", file=sys.stderr)
    return slammed, np.concatenate(stamps)[: len(slammed.trajectory())], to_first, interrupted


def _at_poses(
    command: LogOptions, log: "Log", trajectory: "np.ndarray", drift: "np.ndarray", every: int = 1
) -> Iterator[tuple["Scan", "Pose"]]:
    """The scans of the log, as far as the trajectory goes, at its poses; swept as odometry has it, and its drift."""
    import jax

    from linemap_jax.build import CHUNK
    from linemap_jax.slam import poses_for_map

    begin = 0
    seldom = dataclasses.replace(command, every=command.every * every)
    for chunk in chunks_of_log(seldom, log, CHUNK, drift[::every]):
        poses = trajectory[begin * every :: every][: len(chunk.timestamps)]
        begin += len(poses)
        if not len(poses):
            return
        scans = jax.tree.map(partial(_first, len(poses)), chunk.scans)
        yield scans, poses_for_map(poses, scans.ranges.dtype)


def _seen_again(slammed: "Slammed", pieces: Iterator[tuple["Scan", "Pose"]]) -> Iterator[tuple["Scan", "Pose"]]:
    """The pieces; the keyframes take their scans from them."""
    begin = 0
    for scans, poses in pieces:
        slammed.see_again(begin, scans)
        begin += len(scans.ranges)
        yield scans, poses


def _of_robot(velocity: "np.ndarray", mount: "Mount") -> "np.ndarray":
    """The velocity of the robot, in its own frame, that carries the laser at the given one. Shape `[T, 3]`."""
    import numpy as np

    from linemap_jax.core.frames_on_host import compose

    turned = compose([0.0, 0.0, float(mount.theta)], velocity)[:, :2]
    way = velocity[:, 2:] * np.array([mount.y, -mount.x], float)
    return np.concatenate([turned + way, velocity[:, 2:]], -1)


def _first(count: int, x: Any) -> Any:
    return x[:count]


def _of_base(trajectory: "np.ndarray", covs: "np.ndarray", mount: "Mount") -> tuple["np.ndarray", "np.ndarray"]:
    """The poses of the robot that carries the laser, and their covariances."""
    import numpy as np

    from linemap_jax.core.frames_on_host import between, compose

    laser = np.array([mount.x, mount.y, mount.theta], float)
    base = compose(trajectory, between(laser, np.zeros(3)))
    # What turns the laser carries the robot around it: d base / d theta is the way from laser to robot, turned left.
    jac = np.tile(np.eye(3), (len(base), 1, 1))
    jac[:, 0, 2], jac[:, 1, 2] = trajectory[:, 1] - base[:, 1], base[:, 0] - trajectory[:, 0]
    return base, jac @ covs @ np.swapaxes(jac, 1, 2)


def _doubtful(slammed: "Slammed") -> "np.ndarray":
    """Scans of which few points agree with what was seen before; before the first one nothing was. Shape `[T]`."""
    import numpy as np

    doubtful = np.concatenate(slammed.shares)[: len(slammed.trajectory())] < DOUBTFUL
    doubtful[:1] = False
    return doubtful


def _tell_doubts(slammed: "Slammed", log: "Log", *, quiet: bool) -> None:
    """Say where the trajectory rests on odometry."""
    doubtful = _doubtful(slammed)
    if doubtful.any():
        say(
            f"warning: {log.path}: of {doubtful.sum()} of {len(doubtful)} scans few points agree with what was seen "
            "before; there the trajectory rests on odometry",
            quiet=quiet,
        )


def _pace(stamps: "np.ndarray", seconds: float, to_first: float) -> dict[str, float | None]:
    """Time, without that to the first chunks, which hold most of the compilation; closing loops and adjusting is in it.

    A mean over all scans, since loops do not close evenly. A log of one chunk does not tell.
    """
    import numpy as np

    from linemap_jax.slam import CHUNK

    pace = (seconds - to_first) / len(stamps) if len(stamps) > CHUNK else None
    return {
        "us_per_scan": None if pace is None else 1e6 * pace,
        "times_real_time": None if pace is None else float(np.ptp(stamps)) / (pace * len(stamps)),
        "seconds_to_first_chunk": to_first,
    }


def _summary(
    command: Slam,
    slammed: "Slammed",
    line_map: "LineMap",
    trajectory: "np.ndarray",
    drift: "np.ndarray",
    files: list[Path],
) -> dict[str, Any]:
    """What `slam` says of its work."""
    import numpy as np

    from linemap_jax.build import CHUNK
    from linemap_jax.core.settings import Mount
    from linemap_jax.lab.evaluation import explained_share

    seldom = -(-len(trajectory) // SCANS_EXPLAINED)
    pieces = _at_poses(command, opened(command, command.log), trajectory, drift, seldom)
    driven = np.hypot(*np.diff(trajectory[:, :2], axis=0).T).sum()
    return {
        "log": str(command.log),
        "scans": len(trajectory),
        "keyframes": len(slammed.keyframes),
        "loops": slammed.closures,
        "unit_variance": slammed.unit_variance,
        "driven_m": float(driven),
        "lines": int(np.asarray(line_map.lines.valid).sum()),
        "circles": int(np.asarray(line_map.circles.valid).sum()),
        "explained": explained_share(line_map, pieces, Mount(), chunk=CHUNK),
        **dict(zip(("map", "picture", "trajectory", "covariances"), map(str, files), strict=True)),
    }


def _in_words(summary: dict[str, Any]) -> str:
    pace = summary["us_per_scan"]
    then = f"then {pace / 1000:.1f} ms a scan on the whole, " if pace else ""
    then += f"{summary['times_real_time']:.0f} times as fast as recorded" if pace else ""
    return (
        f"{summary['scans']} scans over {summary['driven_m']:.0f} m -> {summary['keyframes']} keyframes, "
        f"{summary['loops']} loops closed\n"
        f"{summary['lines']} lines, {summary['circles']} circles; {summary['explained']:.1%} of the returns under 20 m "
        "lie within 10 cm of them\n"
        f"variance of unit weight of the adjustment: {summary['unit_variance']:.2f}"
        f"{', by which the covariances are widened' if summary['unit_variance'] > 1 else ''}\n"
        f"{summary['seconds_to_first_chunk']:.1f} s to compile, {then or 'too few scans to time'}\n"
        f"noise:       {summary['noise']}\n"
        f"map:         {summary['map']}\n"
        f"picture:     {summary['picture']}\n"
        f"trajectory:  {summary['trajectory']}\n"
        f"covariances: {summary['covariances']}"
    )
