"""Extractions as JSON lines, one a scan."""

import json
import math
from collections.abc import Iterator

import jax
import numpy as np

from linemap_jax.core.lines import rho_theta
from linemap_jax.core.state import Extraction, Pose


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
    lines = {"rho": rho, "theta": theta, "cov": cov, "begin": found.lines.begin, "end": found.lines.end}
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
