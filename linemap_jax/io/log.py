"""Logs of laser scans, whatever their format: a stream of `Reading`s, and notes about what was odd.

A reader of one format is a class with the interface `Log`; `open_log` chooses it by what the file holds. A reader
streams (its memory does not grow with the log), keeps the order of the file, and leaves the judging of single ranges
(NaN, infinity, no-returns) to the scan that is made of them.
"""

import math
import os
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from linemap_jax.io.frames import Poses, Trajectory

Progress = Callable[[int, int], None]
"""Called with the bytes of the file consumed so far and the bytes in all, as they lie on the disk; of a bag by the time
that has passed in it."""

MAX_LISTED = 20
"""Notes list this many places of one kind; the count goes on."""

MAX_GAP = 60.0
"""s. A longer gap between two scans is noted: the robot may have been carried meanwhile."""

RANGE_MAX = 50.0
"""m, where a log states no maximum range: below the no-return values seen in such logs (50.0 to 81.91 m)."""

_BAGS = (b"#ROSBAG", b"\x89MCAP", b"SQLite format 3\0")

# Formats that a user may well hand over; naming them says more than "unknown".
_FOREIGN = {
    b"BZh": "is compressed with bzip2, unpack it first",
    b"\xfd7zXZ": "is compressed with xz, unpack it first",
    b"\x28\xb5\x2f\xfd": "is compressed with zstd: of a ROS 2 bag give the folder, anything else unpack first",
    b"PK\x03\x04": "is a zip archive, unpack it first",
    b"\x89HDF": "is an HDF5 file, which cannot be read",
}


class LogError(Exception):
    """What is wrong with a log; `str()` is one sentence that names the file, the place if there is one, and the cause.

    Attributes:
      path: the file.
      cause: what is wrong with it.
      where: the place in the file, such as "line 412"; None if the file as a whole is meant.
    """

    def __init__(self, path: str | os.PathLike[str], cause: str, where: str | None = None) -> None:
        """The error of the file `path`, for the reason `cause`, at the place `where`."""
        super().__init__(path, cause, where)
        self.path = Path(path)
        self.cause = cause
        self.where = where

    def __str__(self) -> str:
        """One sentence: file, place, cause."""
        return f"{self.path}{'' if self.where is None else f', {self.where}'}: {printable(self.cause)}"


def printable(text: str) -> str:
    """Text on one line, whatever names a log has for its topics and frames: what is no print stands as its escape."""
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


@dataclass(frozen=True, eq=False, slots=True)
class Reading:
    """One scan of a log, as the log has it: nothing is masked, moved or sorted.

    The arrays are float64. `bearings` is shared between readings and cannot be written to.
    """

    timestamp: float  # s, of the first beam
    ranges: np.ndarray  # [N] m; may hold NaN, infinity, zero, negative and no-return values
    bearings: np.ndarray  # [N] rad, counter-clockwise, in the frame of the laser, upright; finite
    range_min: float  # m; ranges below are no-returns
    range_max: float  # m; ranges from here on are no-returns
    pose: np.ndarray | None  # [3] x, y in m, theta in rad, in the world, at the time stamp; finite. None if not known
    cov_pose: np.ndarray | None  # [3, 3] of `pose`; positive definite. None if the log does not state it
    sweep_poses: np.ndarray | None  # [N, 3] poses when each beam was measured; None if that makes no difference
    pose_frame: Literal["laser", "robot"]  # whose pose it is
    odometry: np.ndarray | None  # [3] x, y in m, theta in rad: odometry's pose of the robot, if the log has it
    mount: tuple[float, float, float] | None  # m, m, rad: the laser on the robot, for a robot pose; None if not known
    where: str  # place in the file, such as "line 412"


@dataclass
class Notes:
    """What a reader noticed while reading. The counts are complete only once the log has been read to its end.

    Lines are counted from 1; a format without lines counts its scans.
    """

    unit: str = "line"  # what is counted
    lines: int = 0  # read so far
    messages: dict[str, int] = field(default_factory=dict)  # lines by kind of message, or messages by topic
    types: dict[str, str] = field(default_factory=dict)  # of the messages of each topic
    scan_topics: list[str] = field(default_factory=list)  # all that hold scans
    frames: list[str] = field(default_factory=list)  # where frames are: "laser in base_link (static)"
    poses: str = ""  # where the poses come from, in words
    drift: bool | None = None  # whether the poses are odometry's, which nobody has corrected; None if nothing says so
    mounting: str = ""  # how the laser sits on the robot, in words
    stated_covs: int = 0  # delivered scans whose pose comes with a covariance
    swept: int = 0  # delivered scans whose beams were measured at different poses
    scans: int = 0  # delivered
    beam_count: int | None = None  # beams of the first delivered scan
    other_beam_counts: int = 0  # delivered scans with another number of beams
    without_pose: int = 0  # scans left out: no pose is known for their time
    params: dict[str, str] = field(default_factory=dict)  # parameters that the log states; the latest value of each
    skipped: int = 0  # malformed lines, left out
    skipped_lines: list[int] = field(default_factory=list)  # the first of them
    first_fault: str = ""  # a sentence about the first of them
    backward_stamps: int = 0  # scans with an earlier time stamp than the scan before
    backward_lines: list[int] = field(default_factory=list)
    jumps: int = 0  # scans more than `MAX_GAP` later than the scan before
    jump_lines: list[int] = field(default_factory=list)
    duplicates: dict[str, int] = field(default_factory=dict)  # scans left out: a second record of the same laser
    assumptions: list[str] = field(default_factory=list)  # sentences: what the log leaves open, and what was taken
    last_stamp: float = math.nan  # s, of the scan delivered last

    def skip(self, line: int, fault: str) -> None:
        """Note a malformed line; `fault` says what is wrong with it."""
        if self.skipped == 0:
            self.first_fault = f"{self.unit} {line}: {fault}"
        self.skipped += 1
        _list(self.skipped_lines, line)

    def deliver(self, line: int, timestamp: float, beams: int) -> None:
        """Note a scan that is about to be delivered; `timestamp` is in seconds."""
        if timestamp < self.last_stamp:
            self.backward_stamps += 1
            _list(self.backward_lines, line)
        elif timestamp - self.last_stamp > MAX_GAP:
            self.jumps += 1
            _list(self.jump_lines, line)
        self.last_stamp = timestamp
        if self.beam_count is None:
            self.beam_count = beams
        self.other_beam_counts += beams != self.beam_count
        self.scans += 1

    def assume(self, sentence: str) -> None:
        """Note, once, what the log leaves open and what was taken instead."""
        if sentence not in self.assumptions:
            _list(self.assumptions, sentence)

    def warnings(self) -> list[str]:
        """One sentence for each kind of thing that was odd; none if nothing was."""
        said = []
        if self.skipped:
            lines = f"{self.unit} was" if self.skipped == 1 else f"{self.unit}s were"
            said.append(
                f"{self.skipped} malformed {lines} skipped ({self._places(self.skipped_lines, self.skipped)}); "
                f"the first fault, {self.first_fault}"
            )
        if self.without_pose:
            were, their = ("was", "its") if self.without_pose == 1 else ("were", "their")
            said.append(f"{_scans(self.without_pose)} {were} left out: no pose is known for {their} time")
        if self.backward_stamps:
            said.append(
                f"the time stamp steps back at {_scans(self.backward_stamps)} "
                f"({self._places(self.backward_lines, self.backward_stamps)}); the order of the file was kept"
            )
        if self.jumps:
            said.append(
                f"{_scans(self.jumps)} came more than {MAX_GAP:g} s after the scan before "
                f"({self._places(self.jump_lines, self.jumps)})"
            )
        for kind, count in self.duplicates.items():
            said.append(f"{count} {kind} lines were left out: the log has the scans of this laser in another form too")
        if self.other_beam_counts:
            others = f"{_scans(self.other_beam_counts)} with other than the {self.beam_count} of the first"
            said.append(f"the number of beams varies: {others}")
        return [printable(sentence) for sentence in said + self.assumptions]

    def _places(self, listed: list[int], count: int) -> str:
        return f"{self.unit}{'' if count == 1 else 's'} {', '.join(map(str, listed))}{', ...' * (count > len(listed))}"


@dataclass(frozen=True, kw_only=True)
class Options:
    """How a log is to be read: the arguments of `open_log`."""

    strict: bool = False
    range_min: float | None = None
    range_max: float | None = None
    bearing_override: tuple[float, float] | None = None
    scan_topic: str | None = None
    odom_topic: str | None = None
    mount: tuple[float, float, float] | None = None
    poses: Poses | None = None
    pose_frame: Literal["laser", "robot"] = "robot"  # whose poses those are
    need_poses: bool = True


class Log(Protocol):
    """A log of scans: iterate over it to read it, as often as needed, each time from the start.

    Attributes:
      path: the file, or the folder.
      format: what it is, in words.
      notes: what was noticed in the latest pass over the file; a new pass begins new notes.
      progress: called now and then while reading; may be set at any time before a pass.
    """

    path: Path
    format: str
    notes: Notes
    progress: Progress | None

    def __iter__(self) -> Iterator[Reading]:
        """Stream the scans in the order of the file.

        Raises:
          LogError: if the file cannot be read, is damaged, or holds no scan; if `strict`, at the first malformed line.
        """
        ...


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
    from linemap_jax.io import carmen  # The readers build on this module.

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
            raise LogError(path, "is a directory, not a log, nor a ROS 2 bag with its metadata.yaml")
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


def _list(places: list[Any], place: Any) -> None:
    if len(places) < MAX_LISTED:
        places.append(place)


def _scans(count: int) -> str:
    return f"{count} scan{'' if count == 1 else 's'}"
