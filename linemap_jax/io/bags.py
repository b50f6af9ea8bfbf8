"""ROS bags, through the `rosbags` library: ROS 1 `.bag`, ROS 2 folders with their `metadata.yaml`, `.mcap`, `.db3`.

Read are the `sensor_msgs/LaserScan` of one topic. Definitions of messages are not needed: those that are read here are
the same in every distribution.

- The time stamp of a scan is that of its header, which is when its first beam was measured. Where it is zero, the time
  at which the message was recorded stands in.
- Poses come from tf if it knows the laser in a fixed frame `map` (or `world`), since somebody has corrected them; else
  from `nav_msgs/Odometry`, with its covariance where that means something; else from tf with any other fixed frame.
  They are interpolated to the time of the scan, and of each beam where the scan states a time between beams. A message
  with a pose may stand behind the scan that needs it: scans wait, for `MAX_WAIT` at most.
- How the laser sits on the robot comes from tf. A laser that hangs upside down has its bearings reversed. Transforms
  are in space, poses are what is seen of them from above.
- `range_max` is obeyed; where it is not positive, `RANGE_MAX` stands in.

Memory does not grow with the log, save for the index that the library keeps of a ROS 1 bag, some 200 bytes a message.
"""

import math
import os
from collections import deque
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Connection

from linemap_jax.io.bag_file import ODOMETRY, SCAN, TF, BagFile, Fault, plain
from linemap_jax.io.frames import (
    Chain,
    FrameTree,
    Poses,
    Standstill,
    Track,
    compose,
    planar,
    poses_of_sweep,
    transform_of,
    upright,
)
from linemap_jax.io.reading import RANGE_MAX, LogError, Notes, Options, Progress, Reading

MAX_WAIT = 5.0
"""s. A scan waits so long, by the time of recording, for the poses that it needs."""

MAX_PENDING = 2000
"""Scans that wait at most: a bound on memory where the time of recording does not pass."""

MAX_SWEEP = 2.0
"""s. No scanner takes longer for a sweep; a time between beams that says so is not believed."""

MAX_BEARING = 4 * math.pi
"""rad. What goes around more than twice, or begins there, is no sweep."""

MAX_SIGMA = (100.0, 100.0, math.pi)
"""m, m, rad. Covariances of more than this say that the pose is not known, and are not taken for its noise."""

FIXED = ("map", "world", "odom")
"""Names of frames that do not move with the robot, the most trusted first."""

CORRECTED = FIXED[:2]
"""Those in which somebody has corrected the odometry."""

ROBOT = ("base_footprint", "base_link")
"""Names of the robot's frame, where no message says which it is."""

_PROBED = 300  # messages of tf looked at, at the beginning, in the middle and towards the end
_MOST_STATIC = 10_000  # messages of tf_static looked at
_TILTED = math.cos(math.radians(10.0))
_MOVED = 1e-3  # m, and rad: the laser sits somewhere else on the robot


class BagLog:
    """A ROS bag, with the interface of `linemap_jax.io.reading.Log`.

    A malformed scan (one that cannot be taken apart, has no ranges, or angles that are not finite) is skipped and
    counted; a `strict` reader refuses it. Scans for whose time no pose is known are left out and counted, unless poses
    are not needed. A damaged bag is always an error: half a log is not a log.

    Attributes:
      path: the file or folder.
      format: what it is, in words.
      notes: what was noticed in the latest pass.
      progress: called now and then with the bytes consumed, by the time that has passed, and the bytes in all.
    """

    def __init__(self, path: str | os.PathLike[str], options: Options, *, progress: Progress | None = None) -> None:
        """A reader of `path`; the options are those of `linemap_jax.io.log.open_log`."""
        self.path = Path(path)
        self.format = "ROS bag"
        self.notes = Notes(unit="scan")
        self.progress: Progress | None = progress
        self._options = options

    def __iter__(self) -> Iterator[Reading]:
        """Stream the scans in the order in which they were recorded.

        Raises:
          LogError: if the bag cannot be read or is damaged; if it holds no scans, those of several scanners, or no
            poses where they are needed; if `strict`, at the first malformed scan.
        """
        notes = self.notes = Notes(unit="scan")
        with closing(BagFile(self.path)) as bag:
            self.format = bag.format
            notes.messages, notes.types = dict(bag.counts), dict(bag.types)
            plan = _Plan(bag, self._options, notes)
            pending: deque[_Pending] = deque()
            number = 0
            for connection, recorded, raw in bag.messages(plan.connections):
                if self.progress is not None and number % 64 == 0:
                    self.progress(*bag.progress(recorded))
                if connection.topic == plan.scan_topic:
                    number += 1
                    notes.lines = number
                    try:
                        pending.append(plan.scan(bag.message(connection, raw), number, recorded))
                    except Fault as fault:
                        if self._options.strict:
                            raise LogError(self.path, str(fault), f"scan {number}") from None
                        notes.skip(number, str(fault))
                else:
                    plan.note(connection, bag, raw)
                while pending:
                    known = plan.pose_of(pending[0])
                    late = recorded - pending[0].recorded > MAX_WAIT or len(pending) > MAX_PENDING
                    if known is None and plan.poses is not None and not late:
                        break
                    if (reading := plan.reading(pending.popleft(), known)) is not None:
                        yield reading
            while pending:
                first = pending.popleft()
                if (reading := plan.reading(first, plan.pose_of(first))) is not None:
                    yield reading
            if self.progress is not None:
                self.progress(bag.size, bag.size)
            if notes.scans == 0:
                raise LogError(self.path, plan.no_scan())


class _Pending(NamedTuple):
    """A scan that has no pose yet."""

    number: int  # among the scans of its topic
    recorded: float  # s
    stamp: float  # s
    time_increment: float  # s
    message: Any


class _Plan:
    """What is read of a bag, and what one pass has to remember. Made from a look at parts of the bag."""

    def __init__(self, bag: BagFile, options: Options, notes: Notes) -> None:
        self._options = options
        self._notes = notes
        self.scan_topic = _scan_topic(bag, options, notes)
        self._tree = _look_at_frames(bag)
        self._laser = _first(bag, self.scan_topic, lambda message: _frame(message.header.frame_id))
        self._odometry: Track | None = None
        self._odometry_topic: str | None = None
        self.poses, self._robot = self._chosen_poses(bag)
        self._mount: tuple[float, float, float] | None = None
        self._hangs = False
        self._mounted = False
        robot = self._robot
        self._mount_chain = None if robot is None else self._tree.chain(self._laser, robot)
        self._cov_cache: tuple[bytes, np.ndarray | None] = (b"", None)
        self._bearings_cache: tuple[tuple[float, float, int, bool], np.ndarray] | None = None
        self._first_stamp = self._last_stamp = math.nan
        self.connections = bag.of_topic(self.scan_topic)
        if self._odometry_topic is not None:
            self.connections += bag.of_topic(self._odometry_topic)
        chains = [chain for chain in (self.poses, self._mount_chain) if isinstance(chain, Chain)]
        told = {id(self._odometry), *(id(self._tree.tracks[name]) for name in self._tree.static)}
        if any(id(track) not in told for chain in chains for track in (*chain.up, *chain.down)):
            self.connections += [c for c in bag.of_types(*TF) if not _is_static(c)]
        for name, track in self._tree.tracks.items():
            how = "static" if name in self._tree.static else "moves" if track.moves else "has not moved"
            notes.frames.append(f"{name} in {track.parent} ({how})")
            if name not in self._tree.static:
                track.clear()

    def _chosen_poses(self, bag: BagFile) -> tuple[Poses | None, str | None]:
        """Where the poses come from, if there are any, and the name of the frame that they are the poses of."""
        options, notes, tree = self._options, self._notes, self._tree
        topics = sorted({connection.topic for connection in bag.of_types(ODOMETRY)})
        if options.odom_topic is not None:
            topics = [_chosen(bag, options.odom_topic, ODOMETRY, topics)]
        ancestors = tree.ancestors(self._laser)
        if options.poses is not None:
            notes.poses = options.poses.description
            return options.poses, _robot_frame(bag, topics, ancestors)
        fixed = _fixed_frame(tree, ancestors)
        below = [] if fixed is None else ancestors[: ancestors.index(fixed)]
        # Simulators and others join map and odom once and for all: nobody corrects anything then.
        corrected = fixed is not None and _last_part(fixed) in CORRECTED and below[-1] not in tree.static
        if len(topics) == 1 and (options.odom_topic is not None or not corrected):
            self._odometry_topic = topics[0]
            parent, child = _first(bag, topics[0], lambda m: (_frame(m.header.frame_id), _frame(m.child_frame_id)))
            self._odometry = Track(parent, moves=True)
            notes.poses = f"nav_msgs/Odometry on {topics[0]}"
            notes.drift = _last_part(parent) not in CORRECTED
            return Chain([self._odometry], []), child or _robot_frame(bag, [], ancestors)
        if fixed is not None:
            robot = next((name for name in below if tree.tracks[name].moves), self._laser)
            notes.poses = f"tf, {robot} in {fixed}"
            notes.drift = not corrected if _last_part(fixed) in FIXED else None
            return tree.chain(robot, fixed), robot
        if not options.need_poses:
            notes.poses = "none"
            return None, _robot_frame(bag, topics, ancestors)
        if topics:
            listed = ", ".join(f"{topic} ({bag.counts[topic]})" for topic in topics)
            raise LogError(bag.path, f"holds several odometries, choose one by --odom-topic: {listed}")
        raise LogError(
            bag.path,
            f"holds no poses, neither nav_msgs/Odometry nor tf from a fixed frame to the laser {self._laser!r}; give "
            "those of the robot by --poses FILE.tum, or say by --standstill that it stood still (`extract` needs none)",
        )

    def note(self, connection: Connection, bag: BagFile, raw: bytes) -> None:
        """Take in a message of odometry or tf. One that is malformed says nothing, and is passed over."""
        try:
            message = bag.message(connection, raw)
        except Fault as fault:
            self._notes.assume(f"a message of {connection.topic} was passed over: {fault}")
            return
        if connection.msgtype == ODOMETRY and self._odometry is not None:
            pose = message.pose.pose
            transform = _transform(pose.position, pose.orientation)
            if transform is not None:
                self._odometry.add(_seconds(message.header.stamp), transform, self._cov(message.pose.covariance))
        elif connection.msgtype in TF:
            _add_transforms(self._tree, message, static=False)

    def _cov(self, stated: np.ndarray) -> np.ndarray | None:
        """The covariance of x, y and yaw, if it means something; that of the message before is not judged again."""
        cache = stated.tobytes()
        if cache != self._cov_cache[0]:
            self._cov_cache = cache, covariance_in_the_plane(stated)
        return self._cov_cache[1]

    def scan(self, message: Any, number: int, recorded: float) -> _Pending:
        """A scan, if it can be one."""
        beams = len(message.ranges)
        angles = (message.angle_min, message.angle_increment)
        if beams == 0:
            raise Fault("the LaserScan has no ranges")
        if not all(map(math.isfinite, angles)) or (angles[1] == 0 and beams > 1) or abs(angles[0]) > MAX_BEARING:
            raise Fault(f"angle_min {angles[0]:g} and angle_increment {angles[1]:g} of {beams} beams are no sweep")
        if self._options.bearing_override is None and abs(angles[1]) * (beams - 1) > MAX_BEARING:
            raise Fault(f"{beams} beams at an angle_increment of {angles[1]:g} rad go around more than twice")
        stamp = _seconds(message.header.stamp)
        if stamp == 0:
            self._notes.assume("scans without a time stamp have that of their recording")
            stamp = recorded
        increment = message.time_increment
        if not abs(increment) * beams <= MAX_SWEEP:  # NaN compares false
            self._notes.assume(
                f"the time_increment of {increment:g} s is not believed, scans are taken as of one instant"
            )
            increment = 0.0
        if math.isnan(self._first_stamp):
            self._first_stamp = stamp
        self._last_stamp = stamp
        return _Pending(number, recorded, stamp, increment, message)

    def pose_of(self, scan: _Pending) -> tuple[np.ndarray, np.ndarray | None] | None:
        """The pose of a scan and those of its beams, None if they are not known (yet)."""
        if self.poses is None:
            return None
        return poses_of_sweep(self.poses, scan.stamp, scan.time_increment, len(scan.message.ranges))

    def reading(self, scan: _Pending, known: tuple[np.ndarray, np.ndarray | None] | None) -> Reading | None:
        """A scan with what is known of its pose; None, and noted, if it is of no use."""
        notes, options, message = self._notes, self._options, scan.message
        if known is None and options.need_poses:
            notes.without_pose += 1
            return None
        self._look_at_mount(scan.stamp)
        pose, sweep = known or (None, None)
        cov = self.poses.cov_at(scan.stamp) if self.poses is not None and known is not None else None
        range_min = message.range_min if 0 <= message.range_min < math.inf else 0.0
        range_max = message.range_max
        if not range_max > 0:
            range_max = RANGE_MAX
            if options.range_max is None:
                notes.assume(f"the scans state no maximum range that is positive, {RANGE_MAX:g} m was taken")
        ranges = np.asarray(message.ranges, np.float64)
        notes.deliver(scan.number, scan.stamp, ranges.size)
        notes.stated_covs += cov is not None
        notes.swept += sweep is not None
        return Reading(
            timestamp=scan.stamp,
            ranges=ranges,
            bearings=self._bearings(message.angle_min, message.angle_increment, ranges.size),
            range_min=float(range_min if options.range_min is None else options.range_min),
            range_max=float(range_max if options.range_max is None else options.range_max),
            pose=pose,
            cov_pose=cov,
            time_increment=scan.time_increment,
            sweep_poses=sweep,
            pose_frame=options.pose_frame,
            odometry=None,
            mount=self._mount,
            where=f"scan {scan.number}",
        )

    def _bearings(self, first: float, step: float, beams: int) -> np.ndarray:
        first, step = self._options.bearing_override or (first, step)
        name = (first, step, beams, self._hangs)
        if self._bearings_cache is None or self._bearings_cache[0] != name:
            bearings = first + step * np.arange(beams)
            bearings = -bearings if self._hangs else bearings
            bearings.setflags(write=False)
            self._bearings_cache = name, bearings
        return self._bearings_cache[1]

    def _look_at_mount(self, stamp: float) -> None:
        """Find out, at the first scan, how the laser sits on the robot; and later on whether it still does."""
        notes, chain = self._notes, self._mount_chain
        if self._mounted:
            if chain is not None and chain.moves and self._options.mount is None and self._mount is not None:
                if np.abs(np.subtract(planar(chain.transform_at(stamp)), self._mount)).max() > _MOVED:
                    notes.assume("tf moves the laser on the robot; it was taken to stay where it was at the first scan")
            return
        self._mounted = True
        if chain is not None:
            transform = chain.transform_at(stamp)
            self._mount = planar(transform)
            poses = self.poses
            above = transform
            if isinstance(poses, Chain) and poses.known:
                above = compose(poses.transform_at(stamp), transform)
            cosine = upright(above)
            self._hangs = cosine < 0
            notes.mounting = f"tf, {self._laser} in {self._robot}{', upside down' if self._hangs else ''}"
            if abs(cosine) < _TILTED:
                tilt = math.degrees(math.acos(min(abs(cosine), 1.0)))
                notes.assume(f"the laser is tilted by {tilt:.0f} degrees; its scans were taken as if it were level")
        if self._options.pose_frame == "laser":
            self._mount, notes.mounting = self._options.mount, ""
        elif self._options.mount is not None:
            self._mount, notes.mounting = self._options.mount, "given"
        elif chain is None and self.poses is not None and not isinstance(self.poses, Standstill):
            notes.mounting = "not known"
            notes.assume(
                f"tf does not say where the laser {self._laser!r} sits on the robot"
                f"{'' if self._robot is None else f' {self._robot!r}'}; it was taken to sit at its centre and to look "
                "ahead (--laser-offset)"
            )

    def no_scan(self) -> str:
        """Why no scan was delivered."""
        notes = self._notes
        if notes.without_pose:
            return (
                f"none of its {notes.without_pose} scans, from {self._first_stamp:.3f} s to {self._last_stamp:.3f} s, "
                f"lies in the time that the poses cover (poses: {notes.poses})"
            )
        return f"no scan on {self.scan_topic} could be read; the first fault, {notes.first_fault or 'there is none'}"


def covariance_in_the_plane(stated: np.ndarray) -> np.ndarray | None:
    """The covariance of x, y and yaw out of that of a pose in space, `[36]`; None unless it means something.

    It must be finite and positive definite, and no standard deviation may exceed `MAX_SIGMA`: zeros say that nothing is
    stated, and drivers state huge numbers for what they do not know. Shape `[3, 3]`.
    """
    cov = np.asarray(stated, float).reshape(6, 6)[np.ix_((0, 1, 5), (0, 1, 5))]
    if not np.isfinite(cov).all():
        return None
    cov = (cov + cov.T) / 2
    variances = np.diag(cov)
    if not (np.all(variances > 0) and np.all(variances <= np.square(MAX_SIGMA))):
        return None
    # Of the correlations: whether it is positive definite is no matter of units.
    sigmas = np.sqrt(variances)
    return cov if np.linalg.eigvalsh(cov / np.outer(sigmas, sigmas))[0] > 1e-9 else None


def _scan_topic(bag: BagFile, options: Options, notes: Notes) -> str:
    """The topic of the scans to read."""
    topics = sorted({connection.topic for connection in bag.of_types(SCAN)})
    notes.scan_topics = topics
    if options.scan_topic is not None:
        return _chosen(bag, options.scan_topic, SCAN, topics)
    if len(topics) == 1:
        return topics[0]
    if topics:
        listed = ", ".join(f"{topic} ({bag.counts[topic]})" for topic in topics)
        raise LogError(bag.path, f"holds the scans of several scanners, choose one by --scan-topic: {listed}")
    listed = ", ".join(f"{topic} ({plain(type_)}, {bag.counts[topic]})" for topic, type_ in bag.types.items())
    told = f"; its topics: {listed}" if listed else ", nor any other message"
    raise LogError(bag.path, f"holds no sensor_msgs/LaserScan{told}")


def _chosen(bag: BagFile, wanted: str, type_: str, topics: list[str]) -> str:
    """The topic that somebody asked for, with or without the slash before it."""
    name = "/" + wanted.strip("/")
    for topic in topics:
        if name == "/" + topic.strip("/"):
            return topic
    listed = f"; those are on {', '.join(topics)}" if topics else "; there are none"
    raise LogError(bag.path, f"holds no {plain(type_)} on the topic {wanted!r}{listed}")


def _look_at_frames(bag: BagFile) -> FrameTree:
    """The frames that tf knows: all of tf_static, and parts of tf."""
    tree = FrameTree()
    connections = bag.of_types(*TF)
    static = [connection for connection in connections if _is_static(connection)]
    moving = [connection for connection in connections if not _is_static(connection)]
    begin, end = bag.span
    for chosen, start, most, is_static in (
        (static, None, _MOST_STATIC, True),
        *((moving, begin + int(share * (end - begin)), _PROBED, False) for share in (0.0, 0.5, 0.95)),
    ):
        for _, (connection, _, raw) in zip(range(most), bag.messages(chosen, start=start), strict=False):
            try:
                _add_transforms(tree, bag.message(connection, raw), static=is_static)
            except Fault:
                continue  # told when the log is read
    return tree


def _add_transforms(tree: FrameTree, message: Any, *, static: bool) -> None:
    for stamped in message.transforms:
        transform = _transform(stamped.transform.translation, stamped.transform.rotation)
        child, parent = _frame(stamped.child_frame_id), _frame(stamped.header.frame_id)
        if transform is not None and child and parent and child != parent:
            tree.add(child, parent, _seconds(stamped.header.stamp), transform, static=static)


def _fixed_frame(tree: FrameTree, ancestors: list[str]) -> str | None:
    """The frame of the world, among those above the laser, if tf tells where the laser is in it."""

    def told(frame: str) -> list[str]:
        return [name for name in ancestors[: ancestors.index(frame)] if name not in tree.static]

    for name in FIXED:
        for frame in ancestors:
            if _last_part(frame) == name and told(frame):
                return frame
    root = ancestors[-1]
    return root if any(tree.tracks[name].moves for name in told(root)) else None


def _robot_frame(bag: BagFile, topics: list[str], ancestors: list[str]) -> str | None:
    """The robot's frame: of odometry, or by its name."""
    if topics and (child := _first(bag, topics[0], lambda message: _frame(message.child_frame_id))):
        return child
    return next((frame for name in ROBOT for frame in ancestors if _last_part(frame) == name), None)


def _first(bag: BagFile, topic: str, field: Any) -> Any:
    """A field of the first message of a topic that can be taken apart."""
    fault = None
    for connection, _, raw in bag.messages(bag.of_topic(topic)):
        try:
            return field(bag.message(connection, raw))
        except Fault as caught:
            fault = caught
    raise LogError(bag.path, f"no message on {topic} can be read: {fault}")


def _is_static(connection: Connection) -> bool:
    return connection.topic.rsplit("/", 1)[-1] == "tf_static"


def _frame(name: str) -> str:
    """A frame without the slash that ROS 1 may put before it."""
    return name.lstrip("/")


def _last_part(frame: str) -> str:
    return frame.rsplit("/", 1)[-1]


def _transform(translation: Any, rotation: Any) -> Any:
    return transform_of((translation.x, translation.y, translation.z), (rotation.x, rotation.y, rotation.z, rotation.w))


def _seconds(stamp: Any) -> float:
    return stamp.sec + 1e-9 * stamp.nanosec
