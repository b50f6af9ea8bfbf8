"""What a log of laser scans is, whatever its format: a stream of `Reading`s, and notes about what was odd.

A reader of one format is a class with the interface `Log`. It streams (its memory does not grow with the log), keeps
the order of the file, and leaves the judging of single ranges (NaN, infinity, no-returns) to the scan that is made of
them.
"""

import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from linemap_jax.io.frames import Poses

Progress = Callable[[int, int], None]
"""Called with the bytes of the file consumed so far and the bytes in all, as they lie on the disk; of a bag by the time
that has passed in it."""

MAX_LISTED = 20
"""Notes list this many places of one kind; the count goes on."""

MAX_GAP = 60.0
"""s. A longer gap between two scans is noted: the robot may have been carried meanwhile."""

RANGE_MAX = 50.0
"""m, where a log states no maximum range: below the no-return values seen in such logs (50.0 to 81.91 m)."""


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
    time_increment: float  # s, from beam to beam; 0 if all were measured at once
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


def _list(places: list[Any], place: Any) -> None:
    if len(places) < MAX_LISTED:
        places.append(place)


def _scans(count: int) -> str:
    return f"{count} scan{'' if count == 1 else 's'}"
