"""Extractions as JSON lines, one a scan."""

import json
import math
from collections.abc import Iterator

import jax
import numpy as np

from linemap_jax.core.lines import rho_theta
from linemap_jax.core.state import Extraction, Pose

ROUNDING = 32
"""Units in the last place by which a vertex of two lines may differ."""


def lines_of_extraction(timestamps: np.ndarray, poses: Pose, found: Extraction) -> Iterator[str]:
    """One JSON object a scan: `timestamp`, `pose`, `lines`, `circles`; the pose is null where the log has none.

    A line has `rho`, `theta`, `cov` of both, `begin`, `end`; a circle `center`, `radius`, `cov` of (x, y, radius), and
    `fitted`, whether it is the pole itself or the visible points alone. SI units, radians, counter-clockwise.

    Args:
      timestamps: seconds. Shape `[T]`.
      poses: as the log has them, stacked `[T]`; NaN where it has none.
      found: the extractions, stacked `[T]`, in the frame of the sensor.

    Yields:
      `T` strings without line ends.
    """
    rho, theta, cov = jax.vmap(rho_theta)(found.lines)
    begin = one_vertex(np.asarray(found.lines.begin), np.asarray(found.lines.end))
    lines = {"rho": rho, "theta": theta, "cov": cov, "begin": begin, "end": found.lines.end}
    circles = {name: getattr(found.circles, name) for name in ("center", "radius", "cov", "fitted")}
    lines, circles = ({name: np.asarray(x).tolist() for name, x in d.items()} for d in (lines, circles))
    has_line, has_circle = map(np.asarray, (found.lines.valid, found.circles.valid))
    for t, (stamp, pose) in enumerate(zip(timestamps.tolist(), np.asarray(poses.mean).tolist(), strict=True)):
        yield json.dumps(
            {
                "timestamp": stamp,
                "pose": None if any(map(math.isnan, pose)) else pose,
                "lines": [{name: x[t][k] for name, x in lines.items()} for k in np.flatnonzero(has_line[t])],
                "circles": [{name: x[t][k] for name, x in circles.items()} for k in np.flatnonzero(has_circle[t])],
            },
            allow_nan=False,
        )


def one_vertex(begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Begin points that are equal, to the last digit, to the end points with which lines share them.

    Either is computed from its own line, and rounded on the way.

    Args:
      begin: metres. Shape `[T, K, 2]`.
      end: metres. Shape `[T, K, 2]`.

    Returns:
      The begin points; where one lies within rounding of an end point of its scan, that. Shape `[T, K, 2]`.
    """
    apart = np.abs(begin[:, :, None] - end[:, None]).max(-1)
    size = np.maximum(np.abs(begin).max(-1), 1)[..., None]
    nearest = apart.argmin(-1)
    shared = np.take_along_axis(apart, nearest[..., None], -1) < ROUNDING * np.finfo(begin.dtype).eps * size
    return np.where(shared, np.take_along_axis(end, nearest[..., None], 1), begin)
