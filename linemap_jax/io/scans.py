"""From the readings of a log to stacked scans and poses, a chunk at a time.

This is the one place where a reading is judged and straightened. REP 117 has it that -inf is too close, NaN is no
measurement and +inf is no return; none of them is a point, nor is what lies outside of the scanner's ranges. What was
measured while the robot moved is brought to the pose at the scan's time stamp, and a sweep that closes on itself begins
where the surface breaks.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from linemap_jax.core.frames_on_host import between, compose
from linemap_jax.core.state import Pose, Scan
from linemap_jax.core.sweep import close_sweep
from linemap_jax.io.reading import Reading

_WIDTHS = 64  # Beams are filled up to a multiple of this where their number varies: each width is compiled anew.


class Chunk(NamedTuple):
    """Some readings of a log, stacked. Times stay float64 on the host."""

    scans: Scan  # [T, N]
    poses: Pose  # [T]; NaN where the log has none
    timestamps: np.ndarray  # [T] s
    odometry: np.ndarray  # [T, 3] m, m, rad; odometry's poses of the robot, NaN where the log has none beside its poses
    last_beam: np.ndarray  # [T, 3] m, m, rad; pose of the robot at the last beam, seen from that at the first


def chunks_of_readings(
    readings: Iterable[Reading],
    size: int,
    *,
    cov_pose: np.ndarray,
    every: int = 1,
    dtype: Any = np.float32,
) -> Iterator[Chunk]:
    """Cut a log into chunks of stacked scans, masked as `Scan.from_ranges` masks them.

    Args:
      readings: the log.
      size: scans in a chunk; the last one may hold fewer.
      cov_pose: covariance of every pose for which the log states none. Shape `[3, 3]`.
      every: take every n-th reading, from the first on.
      dtype: of the scans.

    Yields:
      The chunks, in the order of the log. Where the number of beams varies, scans are filled up with beams that did
      not return.
    """
    source, width = islice(readings, 0, None, every), 0
    while batch := list(islice(source, size)):
        most = max(reading.ranges.size for reading in batch)
        if width < most:
            alike = width == 0 and all(reading.ranges.size == most for reading in batch)
            width = most if alike else -(-most // _WIDTHS) * _WIDTHS
        with np.errstate(over="ignore"):  # a pose too large for float32 becomes infinite, and is reported as such
            mean = np.stack([np.full(3, np.nan) if r.pose is None else r.pose for r in batch]).astype(dtype)
        cov = np.stack([cov_pose if reading.cov_pose is None else reading.cov_pose for reading in batch])
        yield Chunk(
            scans=_scans(batch, width, dtype),
            poses=Pose(mean=jnp.asarray(mean), cov=jnp.asarray(cov.astype(dtype))),
            timestamps=np.array([reading.timestamp for reading in batch]),
            odometry=np.stack([np.full(3, np.nan) if r.odometry is None else r.odometry for r in batch]),
            last_beam=np.stack([_moved(reading) for reading in batch]),
        )


def with_drift(readings: Iterable[Reading], rates: np.ndarray, every: int = 1) -> Iterator[Reading]:
    """Readings whose sweeps moved as the poses say and, beside that, drifted.

    Args:
      readings: the log.
      rates: of the robot in its own frame, for each scan that is taken; the others, and those of one instant, stay as
        they are. m/s, m/s, rad/s. Shape `[T, 3]`.
      every: every n-th reading is taken.

    Yields:
      The readings, in the order of the log.
    """
    for number, reading in enumerate(readings):
        scan, left_out = divmod(number, every)
        if reading.sweep_poses is not None and not left_out and scan < len(rates):
            seconds = reading.time_increment * np.arange(len(reading.sweep_poses))
            drifted = compose(reading.sweep_poses, seconds[:, None] * rates[scan])
            reading = dataclasses.replace(reading, sweep_poses=drifted)
        yield reading


def _scans(batch: list[Reading], width: int, dtype: Any) -> Scan:
    """The scans of some readings, filled up to one number of beams."""
    ranges = np.stack([_filled(reading.ranges, width, 0.0) for reading in batch])
    # What fills up lies a full turn away, where a sweep that closes on itself has ended.
    bearings = np.stack([_filled(reading.bearings, width, reading.bearings[0] + 2 * np.pi) for reading in batch])
    range_min, range_max = (
        np.array([getattr(reading, name) for reading in batch])[:, None] for name in ("range_min", "range_max")
    )
    # NaN compares false, so it is masked too.
    valid = (ranges > 0) & (ranges >= range_min) & (ranges < range_max) & np.isfinite(ranges)
    spacing = np.array([_spacing(reading.bearings) for reading in batch])
    ranges = np.where(valid, ranges, 0)
    for row, reading in enumerate(batch):
        if reading.sweep_poses is not None:
            beams = reading.ranges.size
            ranges[row, :beams], bearings[row, :beams] = at_first_beam(
                ranges[row, :beams], bearings[row, :beams], reading.sweep_poses, reading.mount or (0.0, 0.0, 0.0)
            )
    with np.errstate(over="ignore"):  # what is too large or too small for float32 is no point
        ranges, bearings, spacing = (x.astype(dtype) for x in (ranges, bearings, spacing))
    valid &= (ranges > 0) & np.isfinite(ranges)
    valid, first = close_sweep(ranges, bearings, valid, spacing)
    return Scan(
        ranges=jnp.asarray(np.where(valid, ranges, 0)),
        bearings=jnp.asarray(bearings),
        valid=jnp.asarray(valid),
        spacing=jnp.asarray(spacing),
        first=jnp.asarray(first.astype(np.int32)),
    )


def at_first_beam(
    ranges: np.ndarray, bearings: np.ndarray, poses: np.ndarray, mount: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """What the laser would have measured, had it stood still at the pose of its first beam.

    Args:
      ranges: of the beams, m. Shape `[N]`.
      bearings: rad. Shape `[N]`.
      poses: of the robot when each beam was measured. Shape `[N, 3]`.
      mount: of the laser on the robot. m, m, rad.

    Returns:
      Ranges and bearings, the latter within half a turn of what they were. Both `[N]`.
    """
    x, y, theta = poses.T
    c, s = np.cos(theta), np.sin(theta)
    angle = theta + mount[2] + bearings
    at_x = x + mount[0] * c - mount[1] * s
    at_y = y + mount[0] * s + mount[1] * c
    dx, dy = at_x - at_x[0] + ranges * np.cos(angle), at_y - at_y[0] + ranges * np.sin(angle)
    turned = np.arctan2(dy, dx) - theta[0] - mount[2] - bearings
    # A beam without a return has no point; its direction alone is turned.
    turned = np.where(ranges > 0, turned, theta - theta[0])
    return np.where(ranges > 0, np.hypot(dx, dy), 0), bearings + turned - 2 * np.pi * np.round(turned / (2 * np.pi))


def _moved(reading: Reading) -> np.ndarray:
    poses = reading.sweep_poses
    return np.zeros(3) if poses is None else between(poses[0], poses[-1])


def _filled(values: np.ndarray, width: int, value: float) -> np.ndarray:
    return values if values.size == width else np.pad(values, (0, width - values.size), constant_values=value)


def _spacing(bearings: np.ndarray) -> float:
    return float(np.median(np.abs(np.diff(bearings)))) if bearings.size > 1 else 0.0
