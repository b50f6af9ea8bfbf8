"""CARMEN logs, written: what `linemap_jax.io.carmen` reads back."""

import gzip
import math
import os
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from linemap_jax.io.atomic import atomic_write
from linemap_jax.io.carmen import assumed_sweep
from linemap_jax.io.reading import RANGE_MAX

NO_RETURN = 81.91
"""m, what scanners report in `FLASER` messages where nothing was seen."""

_HALF_TURNS = (180, 181, 360, 361)  # beams of a sweep over 180 degrees, by which every reader knows it

Floats = NDArray[np.float64]


def write_carmen(
    path: str | os.PathLike[str],
    *,
    ranges: ArrayLike,
    bearings: ArrayLike,
    range_max: float,
    poses: ArrayLike,
    odometry: ArrayLike,
    timestamps: ArrayLike,
    comments: Sequence[str] = (),
    overwrite: bool = False,
) -> None:
    """Write a log of one laser.

    The messages are `FLASER` if readers know what they do not state: a sweep of 180 degrees at 1 or half a degree, and
    nothing farther than 50 m. Else they are `ROBOTLASER1`, which state their sweep and their maximum range. Ranges are
    written to 0.01 mm, poses to 0.001 mm and 1e-6 rad.

    Args:
      path: of the file; compressed with gzip if its name ends in ".gz". The bytes depend on the content alone.
      ranges: m; what is not a positive number below `range_max` is written as a no-return. Shape `[T, N]`.
      bearings: of the beams, at equal steps, in the frame of the laser, rad. Shape `[N]`.
      range_max: ranges from here on are no-returns, m.
      poses: of the laser, x, y, theta. m, m, rad. Shape `[T, 3]`.
      odometry: odometry's poses of the robot. Shape `[T, 3]`.
      timestamps: s. Shape `[T]`.
      comments: lines for the head of the file.
      overwrite: whether an older file may be replaced.

    Raises:
      ValueError: if the arrays do not fit together, the bearings are not at equal steps, or a pose, a time stamp or the
        maximum range is not finite.
      OutputError: if the file exists and `overwrite` is false, or if it cannot be written.
    """
    readings, sweep = np.asarray(ranges, float), np.asarray(bearings, float)
    places, counted, stamps = (np.asarray(x, float) for x in (poses, odometry, timestamps))
    count, beams = readings.shape
    if sweep.shape != (beams,) or places.shape != (count, 3) or counted.shape != (count, 3) or stamps.shape != (count,):
        raise ValueError("ranges, bearings, poses, odometry and time stamps differ in number")
    if not (np.isfinite(places).all() and np.isfinite(counted).all() and np.isfinite(stamps).all()):
        raise ValueError("a pose or a time stamp is not finite")
    if not 0 < range_max < math.inf:
        raise ValueError(f"the maximum range must be positive and finite, not {range_max}")
    first, step = float(sweep[0]), float(sweep[-1] - sweep[0]) / max(beams - 1, 1)
    if not np.allclose(sweep, first + step * np.arange(beams), rtol=0, atol=1e-5):
        raise ValueError("the bearings are not at equal steps")

    known = beams in _HALF_TURNS and np.allclose((first, step * beams), _assumed(beams), rtol=0, atol=1e-5)
    states_nothing = known and range_max <= RANGE_MAX
    no_return = NO_RETURN if states_nothing else range_max
    returned = (readings > 0) & (readings < range_max)  # false for NaN
    rows = zip(np.where(returned, readings, no_return), places, counted, stamps.tolist(), strict=True)
    head = f"0 {first!r} {step * (beams - 1)!r} {step!r} {range_max!r} 0.01 0"

    def lines() -> Iterator[str]:
        name = "FLASER" if states_nothing else "ROBOTLASER1"
        yield from (f"# {comment}" for comment in comments)
        yield f"# message formats defined: {name}"
        for row, pose, odom, stamp in rows:
            message = f"{beams} {' '.join(map(repr, row.round(5).tolist()))}"
            where = f"{_pose(pose)} {_pose(odom)}"
            if not states_nothing:
                message, where = f"{head} {message} 0", f"{where} 0 0 0 0 0"
            yield f"{name} {message} {where} {stamp:.6f} nohost {stamp:.6f}"

    with atomic_write(path, overwrite=overwrite) as temporary, temporary.open("wb") as raw:
        if os.fspath(path).endswith(".gz"):
            # Neither a name nor a time in the header: they would differ from run to run.
            with gzip.GzipFile(filename="", mode="wb", fileobj=raw, mtime=0) as file:
                file.writelines(f"{line}\n".encode() for line in lines())
        else:
            raw.writelines(f"{line}\n".encode() for line in lines())


def _assumed(beams: int) -> tuple[float, float]:
    """What readers take the bearing of the first beam for, and the step times the beams."""
    first, step = assumed_sweep(beams)
    return first, step * beams


def _pose(pose: Floats) -> str:
    return " ".join(f"{x:.6f}" for x in pose)
