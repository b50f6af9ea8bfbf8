"""From the readings of a log to stacked scans and poses, a chunk at a time."""

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from linemap_jax.core.state import Pose, Scan
from linemap_jax.io.log import Reading


class Chunk(NamedTuple):
    """Some readings of a log, stacked. Times stay float64 on the host."""

    scans: Scan  # [T, N]
    poses: Pose  # [T]
    timestamps: np.ndarray  # [T] s


def chunks_of_readings(
    readings: Iterable[Reading],
    size: int,
    *,
    cov_pose: np.ndarray,
    range_min: float = 0.0,
    every: int = 1,
    dtype: Any = np.float32,
) -> Iterator[Chunk]:
    """Cut a log into chunks of stacked scans, masked as `Scan.from_ranges` masks them.

    Args:
      readings: the log.
      size: scans in a chunk; the last one may hold fewer.
      cov_pose: covariance of every pose, which such logs do not state. Shape `[3, 3]`.
      range_min: smallest range that counts as a return, m.
      every: take every n-th reading, from the first on.
      dtype: of the scans.

    Yields:
      The chunks, in the order of the log.
    """
    source = islice(readings, 0, None, every)
    while batch := list(islice(source, size)):
        ranges = np.stack([reading.ranges for reading in batch])
        range_max = np.array([reading.range_max for reading in batch])[:, None]
        # NaN compares false, so it is masked too.
        valid = (ranges > 0) & (ranges >= range_min) & (ranges < range_max) & np.isfinite(ranges)
        bearings = np.stack([reading.bearings for reading in batch])
        spacing = (
            np.median(np.abs(np.diff(bearings, axis=1)), axis=1) if bearings.shape[1] > 1 else np.zeros(len(batch))
        )
        with np.errstate(over="ignore"):  # a pose too large for float32 becomes infinite, and is reported as such
            mean = np.stack([reading.pose for reading in batch]).astype(dtype)
        yield Chunk(
            scans=Scan(
                ranges=jnp.asarray(np.where(valid, ranges, 0), dtype),
                bearings=jnp.asarray(bearings, dtype),
                valid=jnp.asarray(valid),
                spacing=jnp.asarray(spacing, dtype),
            ),
            poses=Pose(
                mean=jnp.asarray(mean),
                cov=jnp.asarray(np.tile(np.asarray(cov_pose, dtype), (len(batch), 1, 1))),
            ),
            timestamps=np.array([reading.timestamp for reading in batch]),
        )
