"""CARMEN logs: one message a line, plain or compressed with gzip.

Read are the messages with a scan and a pose, in two forms:

    FLASER | RLASER  num_readings [readings] x y theta odom_x odom_y odom_theta
                     ipc_timestamp ipc_hostname logger_timestamp
    ROBOTLASER1 | 2  laser_type start_angle field_of_view angular_resolution maximum_range accuracy remission_mode
                     num_readings [readings] num_remissions [remissions]
                     laser_x laser_y laser_theta robot_x robot_y robot_theta
                     laser_tv laser_rv forward_safety_dist side_safety_dist turn_axis
                     ipc_timestamp ipc_hostname logger_timestamp

FLASER and ROBOTLASER1 are the front laser, RLASER and ROBOTLASER2 the rear one. PARAM lines go to the notes; all other
messages are passed over. Very old logs lack the last one or two fields; `ipc_timestamp` must be there.

- The first pose is the laser's and is used as it is; that of a rear laser looks backwards already, so that its bearings
  are those of a front laser. An offset of the laser (`PARAM robot_frontlaser_offset`) has no effect on it.
- The second pose is odometry's pose of the robot. In logs with corrected poses it is often a copy of the first.
- The time stamp is `ipc_timestamp`, the one of the message itself.
- `FLASER` and `RLASER` state neither bearings nor a maximum range; `assumed_sweep` and `RANGE_MAX` stand in.

Source: CARMEN, the message formats in the head of every log and its reader `readlog.c`.
"""

import gzip
import io
import math
import os
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from linemap_jax.io.frames import poses_of_sweep
from linemap_jax.io.reading import RANGE_MAX, LogError, Notes, Options, Progress, Reading

MAX_LINE = 1 << 20
"""Bytes. A longer line is no message (1 MiB holds some hundred thousand ranges) and is never held in memory."""

_MAX_PARAMS = 4096  # A log states some hundred; the bound keeps the memory constant whatever the file holds.
_HEAD = 1 << 16  # bytes looked at to recognise the format
_LINES_PER_REPORT = 64  # Some 64 kB of scans: often enough for a progress bar, too seldom to cost anything.
_TRAILING = 3  # ipc_timestamp, ipc_hostname, logger_timestamp
_OLD_TAIL = ("x", "y", "theta", "odom_x", "odom_y", "odom_theta", "ipc_timestamp")
_NEW_HEAD = ("start_angle", "field_of_view", "angular_resolution", "maximum_range")
_NEW_TAIL = (
    ("laser_x", "laser_y", "laser_theta", "robot_x", "robot_y", "robot_theta")
    + ("laser_tv", "laser_rv", "forward_safety_dist", "side_safety_dist", "turn_axis")
    + ("ipc_timestamp",)
)
_LASER_OF = {b"FLASER": "front", b"ROBOTLASER1": "front", b"RLASER": "rear", b"ROBOTLASER2": "rear"}
_NAMES = {
    word.encode(): word
    for word in (
        "FLASER RLASER ROBOTLASER1 ROBOTLASER2 LASER3 LASER4 LASER5 RAWLASER1 RAWLASER2 RAWLASER3 RAWLASER4 RAWLASER5 "
        "ODOM TRUEPOS NEFF PARAM SYNC NMEAGGA NMEARMC"
    ).split()
}
_TEXT = bytes(range(32, 127)) + bytes(range(128, 256)) + b"\t\n\v\f\r"

# Degrees: bearing of the first beam and step, by the number of beams, where the message states neither.
_SWEEPS = {
    180: (-90.0, 1.0),  # SICK LMS/PLS, 181 beams over 180 degrees; 180 is the same sweep without its last beam
    181: (-90.0, 1.0),
    360: (-90.0, 0.5),
    361: (-90.0, 0.5),
    400: (-50.0, 0.25),  # SICK LMS in its 100 degree mode, which looks ahead
    401: (-50.0, 0.25),
    540: (-135.0, 0.5),  # SICK S300 and LMS1xx, 270 degrees
    541: (-135.0, 0.5),
    682: (-340 * 360 / 1024, 360 / 1024),  # Hokuyo URG-04LX: steps 44 to 725 of 1024 a turn, step 384 looks ahead
    1080: (-135.0, 0.25),  # Hokuyo UTM-30LX and others, 270 degrees
    1081: (-135.0, 0.25),
}


_Stream = io.BufferedReader | gzip.GzipFile


class _Fault(Exception):
    """What is wrong with one line."""


class CarmenLog:
    """A CARMEN log, with the interface of `linemap_jax.io.reading.Log`.

    A malformed line (a pose or time stamp that is not finite, a field that is not a number, too few or too many
    fields, no ranges at all, another number of beams than the first scan) is skipped and counted in the notes; a
    `strict` reader refuses it. Ranges that are NaN, infinite, zero or negative are no fault. If the log has the scans
    of one laser in both forms, the form that comes first is delivered and the other one counted. A damaged gzip stream
    is always an error: half a log is not a log.

    Attributes:
      path: the file.
      format: what it is, in words.
      notes: what was noticed in the latest pass over the file.
      progress: called now and then with the bytes consumed and the bytes in all, as they lie on the disk.
    """

    format = "CARMEN log"

    def __init__(self, path: str | os.PathLike[str], options: Options, *, progress: Progress | None = None) -> None:
        """A reader of the file `path`; the options are those of `linemap_jax.io.log.open_log`."""
        self.path = Path(path)
        self.notes = Notes()
        self.progress: Progress | None = progress
        self._options = options

    def __iter__(self) -> Iterator[Reading]:
        """Stream the scans in the order of the file.

        Raises:
          LogError: if the file cannot be read, its gzip stream is damaged, or it holds no scan; if `strict`, at the
            first malformed line.
        """
        notes = self.notes = Notes()
        given = self._options.poses
        notes.poses = "of the laser, as the log states them" if given is None else given.description
        parser = _Parser(notes, self._options)
        with _opened(self.path) as (file, stream):
            size = os.fstat(file.fileno()).st_size
            reported = -1
            for number, line in _numbered_lines(self.path, stream):
                notes.lines = number
                if self.progress is not None and number % _LINES_PER_REPORT == 0 and file.tell() != reported:
                    reported = file.tell()
                    self.progress(reported, size)
                try:
                    reading = parser.reading(number, line)
                except _Fault as fault:
                    if self._options.strict:
                        raise LogError(self.path, str(fault), f"line {number}") from None
                    notes.skip(number, str(fault))
                    continue
                if reading is not None and reading.pose is None and self._options.need_poses:
                    notes.without_pose += 1
                elif reading is not None:
                    notes.deliver(number, reading.timestamp, reading.ranges.size)
                    notes.stated_covs += reading.cov_pose is not None
                    yield reading
            if self.progress is not None:
                self.progress(size, size)
        if notes.scans == 0:
            raise LogError(self.path, _no_scan(notes))


def recognise(path: str | os.PathLike[str]) -> bool:
    """Whether a file can be a CARMEN log: its beginning, unpacked if need be, has a line of one, or is text at least.

    Raises:
      LogError: if the file cannot be read, or nothing comes out of its gzip stream.
    """
    head = b""
    with _opened(path) as (_, stream):
        try:
            for _, line in _numbered_lines(path, stream):
                if line.split(None, 1)[:1] and line.split(None, 1)[0] in _NAMES:
                    return True
                head += line
                if len(head) > _HEAD:
                    break
        except LogError:
            # Damage further on is told by whoever reads that far, and can say how far that was.
            if not head:
                raise
    if not head:
        raise LogError(path, "the gzip stream is empty")
    return not head.translate(None, _TEXT)


def assumed_sweep(beams: int) -> tuple[float, float]:
    """Bearing of the first beam and step, in radians, of a scan that states neither.

    180 and 181 beams are 1 degree apart, 360 and 361 half a degree, both from -90 degrees: scanners step in whole
    fractions of a degree, and an even number is the sweep without its last beam, not one of pi / (beams - 1). Known
    as well are 400/401 (0.25 degrees from -50), 540/541 (0.5 from -135), 682 (360/1024 from -119.53) and 1080/1081
    (0.25 from -135). Any other number is spread over 180 degrees, from -90 to 90; a single beam looks ahead.

    Source: `readlog.c` of CARMEN for 180 to 401 beams, save that it begins the 100 degrees of 400/401 at -90 where
    the scanner's own begin at -50; the data sheets of the scanners for the others.
    """
    if beams == 1:
        return 0.0, 0.0
    first, step = _SWEEPS.get(beams) or (-90.0, 180.0 / (beams - 1))
    return math.radians(first), math.radians(step)


class _Parser:
    """Lines to readings; holds what one pass over a log has to remember."""

    def __init__(self, notes: Notes, options: Options) -> None:
        self._notes = notes
        self._options = options
        self._form: dict[str, bytes] = {}  # by laser: the form whose scans are delivered
        self._trailing: dict[str, int] = {}  # by form: how many of the three trailing fields its lines have
        self._sweep: tuple[float, float, int] | None = None
        self._bearings = np.empty(0)

    def reading(self, number: int, line: bytes) -> Reading | None:
        """The scan of a line, None for a line without one; raises `_Fault` for a malformed one."""
        notes = self._notes
        if number == 1:
            line = line.removeprefix(b"\xef\xbb\xbf")
        words = line[:32].split(None, 1)  # longer than any name; splitting whole lines would double the time
        word = words[0] if words else b""
        name = _NAMES.get(word) or ("comment" if word.startswith(b"#") else "other" if word else "blank")
        notes.messages[name] = notes.messages.get(name, 0) + 1
        laser = _LASER_OF.get(word)
        if laser is None:
            if word == b"PARAM":
                self._remember_param(line)
            return None
        if self._form.get(laser, word) != word:
            notes.duplicates[name] = notes.duplicates.get(name, 0) + 1
            return None
        if len(line) > MAX_LINE:
            raise _Fault(f"the {name} message is longer than {MAX_LINE} bytes")
        fields = line.split()[1:]
        reading = self._old(number, name, fields) if word in (b"FLASER", b"RLASER") else self._new(number, name, fields)
        self._form[laser] = word
        return reading

    def _old(self, number: int, name: str, fields: list[bytes]) -> Reading:
        beams = self._beams(name, fields, 0, 1 + len(_OLD_TAIL))
        ranges = _numbers(fields[1 : 1 + beams], "range")
        tail = self._tail(name, fields[1 + beams :], _OLD_TAIL)
        if self._options.bearing_override is None and beams not in _SWEEPS:
            self._notes.assume(
                f"the log does not state the bearings of its {beams} beams, they were spread over 180 degrees"
                if beams > 1
                else "the log does not state the bearing of its single beam, it was taken to look ahead"
            )
        return self._made(number, ranges, assumed_sweep(beams), RANGE_MAX, tail)

    def _new(self, number: int, name: str, fields: list[bytes]) -> Reading:
        beams = self._beams(name, fields, 7, 8 + 1 + len(_NEW_TAIL))
        start, _, step, range_max = _numbers(fields[1:5], "field", _NEW_HEAD).tolist()
        ranges = _numbers(fields[8 : 8 + beams], "range")
        remissions = _count(fields[8 + beams], "num_remissions")
        if len(fields) < 9 + beams + remissions + len(_NEW_TAIL):
            raise _Fault(f"the {name} message has too few fields for the {remissions} remissions that it states")
        tail = self._tail(name, fields[9 + beams + remissions :], _NEW_TAIL)
        if self._options.bearing_override is None and not _is_sweep(start, step, beams):
            raise _Fault(
                f"start_angle {start:g} and angular_resolution {step:g} of {beams} beams are no sweep in radians"
            )
        if not range_max > 0:
            range_max = RANGE_MAX
            if self._options.range_max is None:
                self._notes.assume(f"the log states no maximum range that is positive, {RANGE_MAX:g} m was taken")
        return self._made(number, ranges, (start, step), range_max, tail)

    def _beams(self, name: str, fields: list[bytes], at: int, others: int) -> int:
        """The number of beams, stated in `fields[at]`, if the line can hold them and the `others` that it must have."""
        if len(fields) <= at:
            raise _Fault(f"the {name} message ends before num_readings")
        beams = _count(fields[at], "num_readings")
        if beams == 0:
            raise _Fault(f"the {name} message has no ranges")
        if len(fields) < beams + others:
            raise _Fault(
                f"the {name} message has {len(fields)} fields, too few for the {_told(fields[at])} ranges that it "
                "states, the poses and the time stamp"
            )
        if self._notes.beam_count not in (None, beams):
            raise _Fault(f"the {name} message has {beams} beams, the first scan of the log {self._notes.beam_count}")
        return beams

    def _tail(self, name: str, fields: list[bytes], names: Sequence[str]) -> np.ndarray:
        """The numbers behind the ranges, up to and with the time stamp: poses, velocities, ipc_timestamp."""
        trailing = len(fields) - len(names) + 1
        if trailing > _TRAILING:
            raise _Fault(
                f"the {name} message has {len(fields)} fields after its ranges, at most "
                f"{len(names) - 1 + _TRAILING} are possible"
            )
        numbers = _numbers(fields[: len(names)], "field", names)
        # A line that was cut off inside its time stamp would still parse, with a wrong stamp; so would one with a range
        # too many, with a wrong pose, unless the name of a host stands in the way.
        earlier = self._trailing.get(name, trailing)
        if trailing < earlier:
            raise _Fault(f"the {name} message lacks trailing fields that earlier ones have")
        if trailing > earlier and all(map(_is_number, fields[len(names) :])):
            raise _Fault(f"the {name} message has more fields after its ranges than earlier ones")
        if trailing == _TRAILING:
            _numbers(fields[-1:], "field", ("logger_timestamp",))
        for what, values in (("laser pose", numbers[:3]), ("robot pose", numbers[3:6]), ("time stamp", numbers[-1:])):
            if not all(map(math.isfinite, values.tolist())):
                raise _Fault(f"the {what} of the {name} message is not finite")
        self._trailing[name] = trailing
        return numbers

    def _made(
        self, number: int, ranges: np.ndarray, sweep: tuple[float, float], range_max: float, tail: np.ndarray
    ) -> Reading:
        options = self._options
        first, step = options.bearing_override or sweep
        if self._sweep != (first, step, ranges.size):
            self._sweep = (first, step, ranges.size)
            self._bearings = first + step * np.arange(ranges.size)
            self._bearings.setflags(write=False)
        stamp, pose, cov = float(tail[-1]), tail[:3].copy(), None
        if options.poses is not None:
            known = poses_of_sweep(options.poses, stamp, 0.0, ranges.size)
            pose = None if known is None else known[0]
            cov = None if known is None else options.poses.cov_at(stamp)
        return Reading(
            timestamp=stamp,
            ranges=ranges,
            bearings=self._bearings,
            range_min=options.range_min or 0.0,
            range_max=range_max if options.range_max is None else float(options.range_max),
            pose=pose,
            cov_pose=cov,
            time_increment=0.0,
            sweep_poses=None,
            pose_frame="laser" if options.poses is None else options.pose_frame,
            odometry=tail[3:6].copy(),
            mount=None if options.poses is None else options.mount,
            where=f"line {number}",
        )

    def _remember_param(self, line: bytes) -> None:
        fields = line[:1024].split(None, 3)
        if len(fields) < 3:
            return
        name, value = (f.decode("utf-8", "replace") for f in fields[1:3])
        if name in self._notes.params or len(self._notes.params) < _MAX_PARAMS:
            self._notes.params[name] = value


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[tuple[io.BufferedReader, _Stream]]:
    """The file as it lies on the disk, and the stream of what it holds; its first bytes decide about gzip."""
    try:
        file = open(path, "rb")
        packed = file.peek(2)[:2] == b"\x1f\x8b"
    except OSError as error:
        raise LogError(path, f"cannot be read: {error.strerror or error}") from error
    with file:
        if packed:
            with gzip.GzipFile(fileobj=file) as stream:
                yield file, stream
        else:
            yield file, file


def _numbered_lines(path: str | os.PathLike[str], stream: _Stream) -> Iterator[tuple[int, bytes]]:
    """Lines, counted from 1. Of a line longer than `MAX_LINE` only the beginning is given, one byte more than that."""
    number = 0
    try:
        while line := stream.readline(MAX_LINE + 1):
            number += 1
            yield number, line
            while len(line) > MAX_LINE and not line.endswith(b"\n"):
                line = stream.readline(MAX_LINE + 1)
    except EOFError as error:
        raise LogError(path, f"the gzip stream ends early after line {number}") from error
    except (zlib.error, gzip.BadGzipFile) as error:
        raise LogError(path, f"the gzip stream is damaged after line {number} ({error})") from error
    except OSError as error:
        raise LogError(path, f"cannot be read after line {number}: {error.strerror or error}") from error


def _numbers(fields: list[bytes], what: str, names: Sequence[str] | None = None) -> np.ndarray:
    """Fields as numbers. Shape `[len(fields)]`, float64."""
    try:
        # Python reads 1_000 as a number; in a log it is a fault.
        if b"_" not in b"".join(fields):
            return np.fromiter(map(float, fields), np.float64, len(fields))
    except ValueError:
        pass
    for i, text in enumerate(fields):
        if b"_" in text or not _is_number(text):
            raise _Fault(f"{what} {names[i] if names else i + 1} is {_told(text)}, not a number")
    raise AssertionError("unreachable: one of the fields is not a number")


def _is_number(text: bytes) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _count(text: bytes, what: str) -> int:
    if not text.isdigit():
        raise _Fault(f"{what} is {_told(text)}, not a count")
    # No line holds a thousand million fields; the digits beyond need not be converted.
    return int(text) if len(text) < 10 else 10**9


def _is_sweep(first: float, step: float, beams: int) -> bool:
    """Whether two angles are finite, in radians by their size, and tell the beams apart."""
    turn = 2 * math.pi + 1e-3  # rad; logs round pi to few digits
    return abs(first) <= turn and abs(step) * (beams - 1) <= turn and (step != 0 or beams == 1)


def _told(text: bytes) -> str:
    """A field of the file as it may stand in a message."""
    shown = text[:40].decode("ascii", "backslashreplace")
    return "'" + "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in shown) + ("...'" if text[40:] else "'")


def _no_scan(notes: Notes) -> str:
    if notes.without_pose:
        return f"none of its {notes.without_pose} scans lies in the time that the given poses cover"
    seen = ", ".join(f"{count} {name}" for name, count in notes.messages.items())
    fault = f"; {notes.skipped} of them malformed, the first fault in {notes.first_fault}" if notes.skipped else ""
    return f"no laser scan found (FLASER, RLASER, ROBOTLASER1 or ROBOTLASER2), lines seen: {seen}{fault}"
