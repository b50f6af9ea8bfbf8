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

Progress = Callable[[int, int], None]
"""Called with the bytes of the file consumed so far and the bytes in all, both as they lie on the disk."""

MAX_LISTED = 20
"""Notes list this many places of one kind; the count goes on."""

MAX_GAP = 60.0
"""s. A longer gap between two scans is noted: the robot may have been carried meanwhile."""

# Formats that a user may well hand over; naming them says more than "unknown".
_FOREIGN = {
    b"#ROSBAG": "is a ROS bag, which cannot be read",
    b"\x89MCAP": "is an MCAP file, which cannot be read",
    b"SQLite format 3\0": "is an SQLite database (perhaps of a ROS 2 bag), which cannot be read",
    b"BZh": "is compressed with bzip2, unpack it first",
    b"\xfd7zXZ": "is compressed with xz, unpack it first",
    b"\x28\xb5\x2f\xfd": "is compressed with zstd, unpack it first",
    b"PK\x03\x04": "is a zip archive, unpack it first",
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
        return f"{self.path}{'' if self.where is None else f', {self.where}'}: {self.cause}"


@dataclass(frozen=True, eq=False, slots=True)
class Reading:
    """One scan of a log, as the log has it: nothing is masked, moved or sorted.

    The arrays are float64. `bearings` is shared between readings and cannot be written to.
    """

    timestamp: float  # s, of the message
    ranges: np.ndarray  # [N] m; may hold NaN, infinity, zero, negative and no-return values
    bearings: np.ndarray  # [N] rad, counter-clockwise, in the frame of the laser; finite
    range_max: float  # m; ranges from here on are no-returns
    pose: np.ndarray  # [3] x, y in m, theta in rad, in the world; finite
    pose_frame: Literal["laser", "robot"]  # whose pose it is
    odometry: np.ndarray | None  # [3] x, y in m, theta in rad: odometry's pose of the robot, if the log has it
    mount: tuple[float, float, float] | None  # m, m, rad: the laser on the robot, for a robot pose
    where: str  # place in the file, such as "line 412"


@dataclass
class Notes:
    """What a reader noticed while reading. The counts are complete only once the log has been read to its end.

    Lines are counted from 1; a format without lines counts its messages.
    """

    lines: int = 0  # read so far
    messages: dict[str, int] = field(default_factory=dict)  # lines by kind of message
    scans: int = 0  # delivered
    beam_count: int | None = None  # beams of every delivered scan
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
            self.first_fault = f"line {line}: {fault}"
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
        self.beam_count = beams
        self.scans += 1

    def assume(self, sentence: str) -> None:
        """Note, once, what the log leaves open and what was taken instead."""
        if sentence not in self.assumptions:
            _list(self.assumptions, sentence)

    def warnings(self) -> list[str]:
        """One sentence for each kind of thing that was odd; none if nothing was."""
        said = []
        if self.skipped:
            lines = "line was" if self.skipped == 1 else "lines were"
            said.append(
                f"{self.skipped} malformed {lines} skipped ({_places(self.skipped_lines, self.skipped)}); "
                f"the first fault, {self.first_fault}"
            )
        if self.backward_stamps:
            said.append(
                f"the time stamp steps back at {_scans(self.backward_stamps)} "
                f"({_places(self.backward_lines, self.backward_stamps)}); the order of the file was kept"
            )
        if self.jumps:
            said.append(
                f"{_scans(self.jumps)} came more than {MAX_GAP:g} s after the scan before "
                f"({_places(self.jump_lines, self.jumps)})"
            )
        for kind, count in self.duplicates.items():
            said.append(f"{count} {kind} lines were left out: the log has the scans of this laser in another form too")
        return said + self.assumptions


class Log(Protocol):
    """A log of scans: iterate over it to read it, as often as needed, each time from the start.

    Attributes:
      path: the file.
      notes: what was noticed in the latest pass over the file; a new pass begins new notes.
      progress: called now and then while reading; may be set at any time before a pass.
    """

    path: Path
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
    range_max: float | None = None,
    bearing_override: tuple[float, float] | None = None,
    progress: Progress | None = None,
) -> Log:
    """Choose the reader for a log by what the file holds. Nothing but its beginning is read yet.

    Args:
      path: the log. A CARMEN log may be compressed with gzip, whatever its name.
      strict: refuse a log with a malformed line, instead of skipping and counting such lines.
      range_max: the scanner's maximum range in metres, in place of what the log states or the reader would take.
      bearing_override: bearing of the first beam and step from beam to beam, both in radians, counter-clockwise, in
        place of what the log states or the reader would take.
      progress: called now and then while reading, with the bytes consumed and the bytes in all.

    Returns:
      The log, to iterate over.

    Raises:
      LogError: if the file is missing, no regular file, empty, unreadable, or of an unknown format.
      ValueError: if `range_max` is not positive or `bearing_override` is not a sweep.
    """
    from linemap_jax.io import carmen  # The readers build on this module.

    if range_max is not None and not range_max > 0:
        raise ValueError(f"range_max must be positive, not {range_max}")
    if bearing_override is not None:
        first, step = bearing_override
        if not (abs(first) <= 2 * math.pi and 0 < abs(step) <= 2 * math.pi):
            raise ValueError(f"bearing_override must be a first bearing and a step in radians, not {bearing_override}")
    try:
        found = os.stat(path)
        if stat.S_ISDIR(found.st_mode):
            raise LogError(path, "is a directory, not a log")
        if not stat.S_ISREG(found.st_mode):
            raise LogError(path, "is not a regular file")
        if found.st_size == 0:
            raise LogError(path, "the file is empty")
        with open(path, "rb") as file:
            magic = file.read(16)
    except OSError as error:
        raise LogError(path, f"cannot be read: {error.strerror or error}") from error
    except ValueError as error:  # a NUL or an unencodable character in the name
        raise LogError(repr(path), f"cannot be read: {error}") from error
    for start, what in _FOREIGN.items():
        if magic.startswith(start):
            raise LogError(path, what)
    if not carmen.recognise(path):
        raise LogError(path, "is not a CARMEN log, nor of another format that can be read")
    return carmen.CarmenLog(
        path, strict=strict, range_max=range_max, bearing_override=bearing_override, progress=progress
    )


def _list(places: list[Any], place: Any) -> None:
    if len(places) < MAX_LISTED:
        places.append(place)


def _places(listed: list[int], count: int) -> str:
    lines = "line" if count == 1 else "lines"
    return f"{lines} {', '.join(map(str, listed))}{', ...' if count > len(listed) else ''}"


def _scans(count: int) -> str:
    return f"{count} scan{'' if count == 1 else 's'}"
