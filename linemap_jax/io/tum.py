"""Trajectories in the format of the TUM RGB-D benchmark, which tools for comparing trajectories read and write."""

import os
import re
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from linemap_jax.io.atomic import atomic_write
from linemap_jax.io.frames import Trajectory, planar, transform_of
from linemap_jax.io.reading import LogError

_HEAD = "timestamp,x,y,theta,cov_xx,cov_xy,cov_xtheta,cov_yy,cov_ytheta,cov_thetatheta,"
"""Of a table of covariances: what its columns are; marks follow."""
ROUNDED_POSE = 1e-5
"""s, m, rad. By so much the poses of the two files may differ."""
_WHOSE = re.compile(r"#\s*poses of the (robot|laser)\b")
"""The comment by which a trajectory says whose poses it holds."""


def read_tum(path: str | os.PathLike[str]) -> Trajectory:
    """Read poses, one a line: `timestamp tx ty tz qx qy qz qw`, seen from above; lines that begin with # are comments.

    They are the robot's, unless a comment has it that they are `poses of the laser`. If a table of `write_covariances`
    lies beside the file, under its name with the ending .csv, their covariances are those.

    Args:
      path: of the file.

    Raises:
      LogError: if the file cannot be read, a line is no pose, or there is none; it names the line. If the table is of
        other poses, or damaged.
    """
    stamps, poses, pose_frame = [], [], "robot"
    try:
        with open(path, encoding="utf-8") as file:
            for number, line in enumerate(file, 1):
                fields = line.replace(",", " ").split("#", 1)[0].split()
                if not fields:
                    if told := _WHOSE.match(line):
                        pose_frame = told[1]
                    continue
                pose = _pose(fields)
                if pose is None:
                    raise LogError(path, "is no pose: timestamp tx ty tz qx qy qz qw", f"line {number}")
                stamps.append(float(fields[0]))
                poses.append(pose)
    except OSError as error:
        raise LogError(path, f"cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise LogError(path, "is no text, so not a trajectory in the format of TUM") from error
    if not stamps:
        raise LogError(path, "holds no pose")
    trajectory = np.array(stamps), np.array(poses)
    covs = _covariances_beside(Path(path).with_suffix(".csv"), *trajectory)
    return Trajectory(*trajectory, "laser" if pose_frame == "laser" else "robot", covs)


def _covariances_beside(path: Path, stamps: np.ndarray, poses: np.ndarray) -> np.ndarray | None:
    """The covariances of poses, `[T, 3, 3]`, from the table beside them; None if there is none."""
    try:
        head, *rows = path.read_text(encoding="ascii").splitlines()
    except (OSError, ValueError):  # there is none, or it is empty, or no text
        return None
    if not head.startswith(_HEAD):
        return None
    try:
        columns = _HEAD.count(",")
        table = np.array([row.split(",")[:columns] for row in rows], float).reshape(len(rows), columns)
    except ValueError as error:
        raise LogError(path, "is no table of covariances: a row holds something else than numbers") from error
    if not (len(table) == len(poses) and _are_close(table[:, :4], np.column_stack([stamps, poses]))):
        raise LogError(path, "tells the covariances of other poses than those beside it; move one of the two away")
    covs = np.zeros((len(table), 3, 3))
    covs[:, *np.triu_indices(3)] = table[:, 4:]
    covs += np.swapaxes(np.triu(covs, 1), 1, 2)
    sigmas = np.sqrt(np.maximum(np.diagonal(covs, axis1=1, axis2=2), 0))
    bound = 1.001 * sigmas[:, :, None] * sigmas[:, None]
    if not (np.isfinite(covs).all() and np.all(np.abs(covs) <= bound)):
        raise LogError(path, "holds a covariance that is none")
    return covs


def _are_close(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether stamps and poses are the same, up to the digits in which files hold them. Shape `[T, 4]` each."""
    off = one - other
    off[:, 3] = np.mod(off[:, 3] + np.pi, 2 * np.pi) - np.pi
    return bool(np.all(np.abs(off) < ROUNDED_POSE))


def _pose(fields: list[str]) -> tuple[float, float, float] | None:
    """x, y and theta of a line, if it has a time stamp and a pose."""
    try:
        stamp, *numbers = map(float, fields)
    except ValueError:
        return None
    if len(numbers) != 7 or not np.isfinite(stamp):
        return None
    transform = transform_of(numbers[:3], numbers[3:])
    return None if transform is None else planar(transform)


def write_tum(
    path: str | os.PathLike[str],
    timestamps: ArrayLike,
    poses: ArrayLike,
    *,
    pose_frame: Literal["robot", "laser"] = "robot",
    overwrite: bool = False,
) -> None:
    """Write poses in the plane, one a line: `timestamp tx ty tz qx qy qz qw`; z is up. A comment says whose they are.

    Args:
      path: of the file.
      timestamps: s. Shape `[T]`.
      poses: x, y, theta. m, m, rad. Shape `[T, 3]`.
      pose_frame: whose poses they are.
      overwrite: whether an older file may be replaced.

    Raises:
      OutputError: if the file exists and `overwrite` is false, or if it cannot be written.
    """
    x, y, theta = np.asarray(poses, float).T
    rows = zip(np.asarray(timestamps, float), x, y, np.sin(theta / 2), np.cos(theta / 2), strict=True)
    head = f"# poses of the {pose_frame}: timestamp tx ty tz qx qy qz qw\n"
    text = head + "".join(f"{t:.6f} {x:.9f} {y:.9f} 0 0 0 {qz:.12f} {qw:.12f}\n" for t, x, y, qz, qw in rows)
    with atomic_write(path, overwrite=overwrite) as temporary:
        temporary.write_text(text, encoding="ascii", newline="\n")


def write_covariances(
    path: str | os.PathLike[str],
    timestamps: ArrayLike,
    poses: ArrayLike,
    covs: ArrayLike,
    lost: ArrayLike,
    *,
    keyframes: ArrayLike | None = None,
    overwrite: bool = False,
) -> None:
    """Write what a trajectory has no place for, as a table with a head, one pose a line, fields separated by commas.

    Args:
      path: of the file.
      timestamps: s. Shape `[T]`.
      poses: x, y, theta. m, m, rad. Shape `[T, 3]`.
      covs: of the poses. m^2, m rad, rad^2. Shape `[T, 3, 3]`.
      lost: whether the pose is said to be wrong. Shape `[T]`.
      keyframes: which of them are keyframes; no such column unless given. Shape `[T]`.
      overwrite: whether an older file may be replaced.

    Raises:
      OutputError: if the file exists and `overwrite` is false, or if it cannot be written.
    """
    upper = np.asarray(covs, float)[:, *np.triu_indices(3)]
    marks = {"keyframe": keyframes} if keyframes is not None else {}
    marks |= {"lost": lost}
    head = f"{_HEAD}{','.join(marks)}\n"
    marked = np.stack([np.asarray(mark, int) for mark in marks.values()], -1)
    rows = zip(np.asarray(timestamps, float), np.asarray(poses, float), upper, marked, strict=True)
    text = "".join(
        f"{t:.6f},{','.join(f'{x:.9f}' for x in pose)},{','.join(f'{c:.9g}' for c in cov)},{','.join(map(str, mark))}\n"
        for t, pose, cov, mark in rows
    )
    with atomic_write(path, overwrite=overwrite) as temporary:
        temporary.write_text(head + text, encoding="ascii", newline="\n")
