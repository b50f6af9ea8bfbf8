"""Trajectories in the format of the TUM RGB-D benchmark, which tools for comparing trajectories read."""

import os

import numpy as np
from numpy.typing import ArrayLike

from linemap_jax.io.atomic import atomic_write


def write_tum(
    path: str | os.PathLike[str], timestamps: ArrayLike, poses: ArrayLike, *, overwrite: bool = False
) -> None:
    """Write poses in the plane, one a line: `timestamp tx ty tz qx qy qz qw`; z is up.

    Args:
      path: of the file.
      timestamps: s. Shape `[T]`.
      poses: x, y, theta. m, m, rad. Shape `[T, 3]`.
      overwrite: whether an older file may be replaced.

    Raises:
      OutputError: if the file exists and `overwrite` is false, or if it cannot be written.
    """
    x, y, theta = np.asarray(poses, float).T
    rows = zip(np.asarray(timestamps, float), x, y, np.sin(theta / 2), np.cos(theta / 2), strict=True)
    text = "".join(f"{t:.6f} {x:.9f} {y:.9f} 0 0 0 {qz:.12f} {qw:.12f}\n" for t, x, y, qz, qw in rows)
    with atomic_write(path, overwrite=overwrite) as temporary:
        temporary.write_text(text, encoding="ascii", newline="\n")
