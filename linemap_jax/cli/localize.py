"""`linemap localize`: the robot's way through a map, from raw odometry and scans."""

import dataclasses
import json
import math
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from linemap_jax.cli.compilations import cache_folder
from linemap_jax.cli.logs import chunks_of_log, mount_of_odometry, odometry_of, opened, progress, warn
from linemap_jax.cli.noise import noise_of_map, states_noise
from linemap_jax.cli.options import POSE_SIGMA, LogOptions, UsageError, options_of_update, own_options_first
from linemap_jax.cli.output import check_output, make_folder, say

if TYPE_CHECKING:
    import numpy as np

    from linemap_jax.core.state import LineMap
    from linemap_jax.io.reading import Log

CHUNK = 64
"""Scans in one jitted call."""
GAP_SIGMA = (1.0, 1.0, 0.5)
"""Added to a step over a gap in the log, m m rad: the robot may have been pushed meanwhile."""


@own_options_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Localize(LogOptions):
    """Find the robot's way through a map, from odometry and scans: writes a trajectory, and covariances beside it.

    Where no noise is stated, neither here nor by a settings file, that counts which the map was built with.
    """

    map: tyro.conf.Positional[Path]
    """map.json of `build`, or its GeoJSON."""
    log: tyro.conf.Positional[Path]
    """Log with scans and odometry, of the place of the map."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")]
    """FILE.tum, with FILE.csv beside it; or a folder for trajectory.tum, trajectory.csv and trajectory.png."""
    start: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y THETA")] = None
    """Pose of the robot in the map at the first scan, m m rad. The first pose of the log unless given."""
    start_sigma: Annotated[tuple[float, float, float], tyro.conf.arg(metavar="X Y THETA")] = (0.25, 0.25, 0.09)
    """Standard deviations of that pose, m m rad: it is looked for within three of them."""
    odometry_noise: Annotated[float, tyro.conf.arg(metavar="FACTOR")] = 1.0
    """How much worse the wheels count than is usual indoors; a factor of all their standard deviations."""
    json: bool = False
    """Print the summary as JSON."""
    pose_sigma: tyro.conf.Suppress[tuple[float, float, float]] = POSE_SIGMA  # of no effect here

    def run(self) -> int:
        """Localise, and give the exit status."""
        options: dict[str, Any] = options_of_update(self)
        del options["persistence"]
        _check(self)
        from linemap_jax.io.map_file import MapFileError, map_in, read_map
        from linemap_jax.io.plot import plot_map
        from linemap_jax.io.tum import write_covariances, write_tum

        in_folder = self.output.suffix != ".tum"
        tum = self.output / "trajectory.tum" if in_folder else self.output
        beside, picture = tum.with_suffix(".csv"), tum.with_suffix(".png")
        files = [tum, beside, *([picture] if in_folder else [])]
        check_output(tum.parent, *files, overwrite=self.overwrite)
        try:
            line_map, of_map = read_map(self.map, dtype=self.dtype)
        except MapFileError as error:
            swapped = map_in(self.log)
            if self.map.exists() and swapped.exists() and swapped.suffix in (".json", ".geojson"):
                raise UsageError(f"{error}; the map comes first, then the log") from error
            raise
        if not states_noise(self):
            options["noise"] = noise_of_map(of_map) or options["noise"]
        if not _tells_sides(of_map):
            options["rules"] = dataclasses.replace(options["rules"], tell_sides=False)
        if not line_map.lines.valid.any():
            raise UsageError(f"{self.map} holds no line: there is nothing to find the robot by")
        log = opened(self, self.log)
        options["mount"] = mount_of_odometry(self, log)
        with progress(log, quiet=self.quiet):
            way = _way_through(self, log, line_map, options)
        warn(log, quiet=self.quiet)
        _warn_of(way, log, quiet=self.quiet)
        make_folder(tum.parent)
        write_tum(tum, way.timestamps, way.means, overwrite=self.overwrite)
        write_covariances(beside, way.timestamps, way.means, way.covs, way.lost, overwrite=self.overwrite)
        if in_folder:
            path, title = way.means[:, :2], self.log.name
            plot_map(picture, line_map, path, lost=path[way.lost], title=title, overwrite=self.overwrite)
        if way.interrupted:
            print(f"linemap: interrupted; the trajectory so far is in {tum}", file=sys.stderr)
            return 130
        summary = _summary(way, log) | {"trajectory": str(tum), "covariances": str(beside)}
        summary |= {"picture": str(picture)} if in_folder else {}
        print(json.dumps(summary, indent=2) if self.json else _in_words(summary))
        return 0


@dataclasses.dataclass
class Way:
    """What the filter has said of all scans."""

    timestamps: "np.ndarray"  # [T] s
    means: "np.ndarray"  # [T, 3] m, m, rad
    covs: "np.ndarray"  # [T, 3, 3]
    status: "np.ndarray"  # [T]
    used: "np.ndarray"  # [T] whether the scan was
    still: bool  # the odometry has never changed
    seconds: list[tuple[float, int]]  # and scans of each piece
    interrupted: bool

    @property
    def lost(self) -> "np.ndarray":
        """Shape `[T]`."""
        from linemap_jax.core.state import Status

        return self.status & Status.LOST > 0


def _check(command: Localize) -> None:
    if command.start is not None and not all(map(math.isfinite, command.start)):
        raise UsageError(f"--start must be finite, not {command.start}")
    if not all(0 <= x < math.inf for x in command.start_sigma):
        raise UsageError(f"--start-sigma must be zero or positive, not {command.start_sigma}")
    if not 0 < command.odometry_noise < math.inf:
        raise UsageError(f"--odometry-noise must be positive, not {command.odometry_noise}")


def _tells_sides(settings: Mapping[str, Any]) -> bool:
    """Whether a map says from where its lines were seen. What this package builds does, a drawing not."""
    merged, rules = settings.get("merged"), settings.get("rules")
    if isinstance(merged, list):
        return all(isinstance(each, Mapping) and _tells_sides(each) for each in merged)
    return isinstance(rules, Mapping) and rules.get("tell_sides") is True


def _way_through(command: Localize, log: "Log", line_map: "LineMap", options: dict[str, Any]) -> Way:
    """Chunk after chunk through the filter; what is kept of each are its poses."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from linemap_jax.build import COMPILER_OPTIONS, STATIC
    from linemap_jax.core.estimation.likelihood_field import field_of_map, field_size
    from linemap_jax.core.estimation.localization import believe, localize
    from linemap_jax.core.estimation.odometry import OdometryNoise
    from linemap_jax.core.state import Pose, pad_stack
    from linemap_jax.io.programs import kept_program

    run = kept_program(localize, cache_folder(), static_argnames=STATIC, compiler_options=COMPILER_OPTIONS)
    field = jax.jit(field_of_map, static_argnums=1)(line_map, field_size(line_map))
    noise = jax.tree.map(lambda sigma: command.odometry_noise * sigma, OdometryNoise())
    belief, last, stamps, said, seconds = None, None, [], [], []
    still, interrupted = True, False
    started = time.perf_counter()
    try:
        for chunk in chunks_of_log(command, log, CHUNK):
            counted = odometry_of(command, chunk)
            if belief is None:
                start = np.asarray(chunk.poses.mean[0] if command.start is None else command.start, command.dtype)
                cov = np.diag(np.square(np.asarray(command.start_sigma, command.dtype)))
                if command.start is None:
                    pose = " ".join(f"{x:.2f}" for x in start.tolist())
                    say(f"without --start the first pose of the log is taken: {pose}", quiet=command.quiet)
                belief = believe(Pose(mean=jnp.asarray(start), cov=jnp.asarray(cov)), line_map)
                last = (counted[0], float(chunk.timestamps[0]))
            assert last is not None
            steps, extra = _steps(last, counted, chunk.timestamps)
            still = still and not np.any(steps)
            last = (counted[-1], float(chunk.timestamps[-1]))
            count = len(counted)
            filled = pad_stack((chunk.scans, *(jnp.asarray(x.astype(command.dtype)) for x in (steps, extra))), CHUNK)
            active = jnp.asarray(np.arange(CHUNK) < count)
            belief, located = run(belief, *filled, active, line_map, field, odometry=noise, **options)
            stamps.append(chunk.timestamps)
            said.append(jax.tree.map(lambda x, n=count: np.asarray(x)[:n], located))
            seconds.append((time.perf_counter() - started, count))
            started = time.perf_counter()
    except KeyboardInterrupt:
        if not said:
            raise
        interrupted = True
    whole = jax.tree.map(lambda *x: np.concatenate(x), *said)
    return Way(
        timestamps=np.concatenate(stamps)[: len(whole.fit)],
        means=whole.pose.mean,
        covs=whole.pose.cov,
        status=whole.status,
        used=whole.dof > 0,
        still=still,
        seconds=seconds,
        interrupted=interrupted,
    )


def _steps(
    last: tuple["np.ndarray", float], poses: "np.ndarray", timestamps: "np.ndarray"
) -> tuple["np.ndarray", "np.ndarray"]:
    """Each pose of odometry seen from the one before, and what variances to add. In float64, however far they are."""
    import numpy as np

    from linemap_jax.core.frames_on_host import between
    from linemap_jax.io.reading import MAX_GAP

    places = np.concatenate([last[0][None], poses])
    steps = between(places[:-1], places[1:])
    gap = np.diff(np.concatenate([[last[1]], timestamps])) > MAX_GAP
    return steps, gap[:, None] * np.square(GAP_SIGMA)


def _warn_of(way: Way, log: "Log", *, quiet: bool) -> None:
    """What nobody should overlook."""
    import numpy as np

    from linemap_jax.core.state import Status

    lost, scans = way.lost, len(way.status)
    if lost.any():
        first = way.timestamps[np.argmax(lost)]
        back = "and was found again" if not lost[-1] else "and was not found again"
        told = f"lost in {lost.sum()} of {scans} scans, first at {first:.3f} s, {back}"
        why = "" if lost.mean() < 0.5 else ": is it the map of this place, and is --start right?"
        say(f"warning: {log.path}: the robot is {told}{why}", quiet=quiet)
    bad = int(np.sum(way.status & Status.POSE_NOT_FINITE > 0))
    if bad:
        say(f"warning: {log.path}: odometry is not finite at {bad} scans; no step was taken there", quiet=quiet)
    if way.still and scans > 1:
        say(f"warning: {log.path}: its odometry never changes: the log may have none", quiet=quiet)


def _summary(way: Way, log: "Log") -> dict[str, Any]:
    import numpy as np

    sigma = np.sqrt(np.median(np.diagonal(way.covs, axis1=1, axis2=2), axis=0))
    recorded = float(np.ptp(way.timestamps))
    pace = float(np.median([t / n for t, n in way.seconds[1:]])) if len(way.seconds) > 1 else None
    return {
        "log": str(log.path),
        "scans": len(way.status),
        "used": int(way.used.sum()),
        "lost": int(way.lost.sum()),
        "lost_at_the_end": bool(way.lost[-1]),
        "median_sigma": sigma.tolist(),
        "us_per_scan": None if pace is None else 1e6 * pace,
        "times_real_time": None if pace is None else recorded / (pace * len(way.status)),
        "seconds_to_first_chunk": way.seconds[0][0],
    }


def _in_words(summary: dict[str, Any]) -> str:
    x, y, theta = summary["median_sigma"]
    pace = summary["us_per_scan"]
    then = f"then {pace:.0f} us a scan, {summary['times_real_time']:.0f} times as fast as recorded" if pace else ""
    picture = f"\npicture:     {summary['picture']}" if "picture" in summary else ""
    return (
        f"{summary['scans']} scans, {summary['used']} of them used, lost in {summary['lost']}; "
        f"median sigma {x:.3f} m, {y:.3f} m, {theta:.4f} rad\n"
        f"{summary['seconds_to_first_chunk']:.1f} s to compile, {then or 'too few scans to time'}\n"
        f"trajectory:  {summary['trajectory']}\n"
        f"covariances: {summary['covariances']}{picture}"
    )
