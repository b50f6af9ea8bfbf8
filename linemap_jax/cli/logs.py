"""Reading a log for a command: chunk by chunk, with a progress bar, and warnings about what was skipped."""

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from linemap_jax.cli.options import LogInput, LogOptions, UsageError
from linemap_jax.cli.output import say

if TYPE_CHECKING:
    import numpy as np

    from linemap_jax.core.settings import Mount
    from linemap_jax.core.state import Pose, Scan
    from linemap_jax.io.reading import Log
    from linemap_jax.io.scans import Chunk

SCANS_EXPLAINED = 250
"""What a log says of a map is taken over so many of its scans at most."""


def opened(command: LogInput, path: Path, *, need_poses: bool = True) -> "Log":
    """A log, to be read as the options want it."""
    from linemap_jax.io.frames import Standstill
    from linemap_jax.io.log import open_log
    from linemap_jax.io.tum import read_tum

    poses = Standstill() if command.standstill else None
    if command.poses is not None:
        poses = read_tum(command.poses)
        if poses.pose_frame == "laser" and command.laser_offset is not None:
            raise UsageError(f"{command.poses} holds poses of the laser, to which --laser-offset does not apply")
    return open_log(
        path,
        strict=command.strict,
        range_min=command.range_min,
        range_max=command.range_max,
        bearing_override=command.bearings,
        scan_topic=command.scan_topic,
        odom_topic=command.odom_topic,
        mount=command.laser_offset,
        poses=poses,
        need_poses=need_poses,
    )


def mount_of(command: LogInput, log: "Log", *, quiet: bool) -> "Mount":
    """How the laser sits on the robot. The log is read up to its first scan."""
    from linemap_jax.core.settings import Mount

    reading = next(iter(log))
    if command.laser_offset is not None and reading.pose_frame == "laser":
        say(f"warning: {log.path}: its poses are the laser's, so that --laser-offset has no effect", quiet=quiet)
    return Mount(*(reading.mount or (0.0, 0.0, 0.0)))


def mount_of_odometry(command: LogInput, log: "Log") -> "Mount":
    """How the laser sits on the robot, whose odometry it is. The log is read up to its first scan."""
    from linemap_jax.core.settings import Mount

    return Mount(*(command.laser_offset or next(iter(log)).mount or (0.0, 0.0, 0.0)))


def chunks_of_log(command: LogOptions, log: "Log", size: int, drift: "np.ndarray | None" = None) -> Iterator["Chunk"]:
    """Scans and poses as the options want them; their sweeps with a drift beside the poses' motion, if there is one."""
    import numpy as np

    from linemap_jax.io.scans import chunks_of_readings, with_drift

    cov_pose = np.diag(np.square(command.pose_sigma))
    readings = log if drift is None else with_drift(log, drift, command.every)
    return chunks_of_readings(readings, size, cov_pose=cov_pose, every=command.every, dtype=command.dtype)


def odometry_of(command: LogOptions, chunk: "Chunk") -> "np.ndarray":
    """Odometry's poses of the robot: those given, else the log's own, else its poses, which come from odometry."""
    import numpy as np

    poses = np.asarray(chunk.poses.mean, float)
    if command.poses is not None or command.standstill:
        return poses
    return np.where(np.isfinite(chunk.odometry), chunk.odometry, poses)


def plain_chunks(log: "Log", every: int = 1) -> Iterator[tuple["Scan", "Pose"]]:
    """Scans and poses of a log as they are."""
    import numpy as np

    from linemap_jax.build import CHUNK
    from linemap_jax.io.scans import chunks_of_readings

    for chunk in chunks_of_readings(log, CHUNK, cov_pose=np.zeros((3, 3)), every=every, dtype="float64"):
        yield chunk.scans, chunk.poses


@contextlib.contextmanager
def progress(log: "Log", *, quiet: bool) -> Iterator[None]:
    """A progress bar over the bytes of the log, where somebody watches."""
    if quiet or not sys.stderr.isatty():
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


def tell_poses(command: LogOptions, log: "Log") -> str:
    """Where the poses of a log that has been read came from, and what is taken for their noise."""
    notes = log.notes
    stated, scans = notes.stated_covs, notes.scans
    sigma = "--pose-sigma " + " ".join(f"{x:g}" for x in command.pose_sigma)
    by_whom = "as the log states it" if command.poses is None else "as the table beside the poses states it"
    if stated == scans:
        noise = by_whom
    elif stated == 0:
        noise = sigma
    else:
        noise = f"{by_whom} for {stated} of {scans} scans, {sigma} for the others"
    mounting = f"; laser on the robot: {notes.mounting}" if notes.mounting else ""
    return f"{notes.poses}; noise: {noise}{mounting}"


def warn(log: "Log", *, quiet: bool) -> None:
    """Say what the reader of the log has noticed so far."""
    for warning in log.notes.warnings():
        say(f"warning: {log.path}: {warning}", quiet=quiet)
