"""Opening a log of laser scans by what its file holds, whatever its name."""

import math
import os
import stat
from pathlib import Path

from linemap_jax.io import carmen
from linemap_jax.io.frames import Poses, Trajectory
from linemap_jax.io.reading import Log, LogError, Options, Progress, printable

_BAGS = (b"#ROSBAG", b"\x89MCAP", b"SQLite format 3\0")

# Formats that a user may well hand over; naming them says more than "unknown".
_FOREIGN = {
    b"BZh": "is compressed with bzip2, unpack it first",
    b"\xfd7zXZ": "is compressed with xz, unpack it first",
    b"\x28\xb5\x2f\xfd": "is compressed with zstd: of a ROS 2 bag give the folder, anything else unpack first",
    b"PK\x03\x04": "is a zip archive, unpack it first",
    b"\x89HDF": "is an HDF5 file, which cannot be read",
}


def open_log(
    path: str | os.PathLike[str],
    *,
    strict: bool = False,
    range_min: float | None = None,
    range_max: float | None = None,
    bearing_override: tuple[float, float] | None = None,
    scan_topic: str | None = None,
    odom_topic: str | None = None,
    mount: tuple[float, float, float] | None = None,
    poses: Poses | None = None,
    need_poses: bool = True,
    progress: Progress | None = None,
) -> Log:
    """Choose the reader for a log by what the file holds. Nothing but its beginning is read yet.

    Args:
      path: the log. A CARMEN log, which may be compressed with gzip, whatever its name; a ROS 1 bag; a ROS 2 bag, as a
        folder with its `metadata.yaml` or as a single `.mcap` or `.db3` file.
      strict: refuse a log with a malformed line or message, instead of skipping and counting such.
      range_min: smallest range that is a return, m, in place of what the log states.
      range_max: the scanner's maximum range in metres, in place of what the log states or the reader would take.
      bearing_override: bearing of the first beam and step from beam to beam, both in radians, counter-clockwise, in
        place of what the log states or the reader would take.
      scan_topic: of a bag with several scanners, the one to read.
      odom_topic: of a bag, the `nav_msgs/Odometry` to take poses from.
      mount: of the laser on the robot, m, m, rad, in place of what the log states; for poses that are the robot's.
      poses: of the robot, in place of those of the log. Scans beyond them are left out and counted. Where they are the
        laser's, what carries it is the laser itself: no mount is applied.
      need_poses: whether a scan without a pose is of any use. If it is, such scans are delivered too.
      progress: called now and then while reading, with the bytes consumed and the bytes in all.

    Returns:
      The log, to iterate over.

    Raises:
      LogError: if the file is missing, no regular file, empty, unreadable, or of an unknown format.
      ValueError: if a range or the mount is not finite and positive where it must be, `bearing_override` is not a
        sweep, or a mount is given with poses of the laser.
    """
    if range_min is not None and not 0 <= range_min < math.inf:
        raise ValueError(f"range_min must be zero or positive, not {range_min}")
    if range_max is not None and not range_max > 0:
        raise ValueError(f"range_max must be positive, not {range_max}")
    if bearing_override is not None:
        first, step = bearing_override
        if not (abs(first) <= 2 * math.pi and 0 < abs(step) <= 2 * math.pi):
            raise ValueError(f"bearing_override must be a first bearing and a step in radians, not {bearing_override}")
    if mount is not None and not all(map(math.isfinite, mount)):
        raise ValueError(f"mount must be finite, not {mount}")
    pose_frame = poses.pose_frame if isinstance(poses, Trajectory) else "robot"
    if pose_frame == "laser":
        if mount is not None:
            raise ValueError("the poses are the laser's, to which no mount applies")
        mount = (0.0, 0.0, 0.0)
    options = Options(
        strict=strict,
        range_min=range_min,
        range_max=range_max,
        bearing_override=bearing_override,
        scan_topic=scan_topic,
        odom_topic=odom_topic,
        mount=mount,
        poses=poses,
        pose_frame=pose_frame,
        need_poses=need_poses,
    )
    magic = _magic(path)
    if magic is None or magic.startswith(_BAGS):
        from linemap_jax.io import bags  # Its libraries take a while to load.

        return bags.BagLog(path, options, progress=progress)
    if Path(path).name == "metadata.yaml":
        raise LogError(path, "describes a ROS 2 bag, which is its folder: give that")
    for start, what in _FOREIGN.items():
        if magic.startswith(start):
            raise LogError(path, what)
    if not carmen.recognise(path):
        raise LogError(path, "is not a CARMEN log, nor a ROS bag: no format that can be read")
    if scan_topic is not None or odom_topic is not None:
        raise LogError(path, "is a CARMEN log, which has no topics to choose from")
    return carmen.CarmenLog(path, options, progress=progress)


def _magic(path: str | os.PathLike[str]) -> bytes | None:
    """The first bytes of a file, None for the folder of a ROS 2 bag."""
    try:
        found = os.stat(path)
        if stat.S_ISDIR(found.st_mode):
            if (Path(path) / "metadata.yaml").exists():
                return None
            inside = sorted(file.name for file in Path(path).iterdir() if file.suffix in (".mcap", ".db3"))
            hint = f"; it holds {printable(inside[0])}, which can be given by itself" if inside else ""
            raise LogError(path, f"is a directory, not a log, nor a ROS 2 bag with its metadata.yaml{hint}")
        if not stat.S_ISREG(found.st_mode):
            raise LogError(path, "is not a regular file")
        if found.st_size == 0:
            raise LogError(path, "the file is empty")
        with open(path, "rb") as file:
            return file.read(16)
    except OSError as error:
        raise LogError(path, f"cannot be read: {error.strerror or error}") from error
    except ValueError as error:  # a NUL or an unencodable character in the name
        raise LogError(repr(path), f"cannot be read: {error}") from error
