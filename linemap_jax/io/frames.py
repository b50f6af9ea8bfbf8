"""Where frames are over time: transforms, what is known of them, and poses in the plane between two stamps.

A transform is seven numbers, x, y, z (m) and a unit quaternion x, y, z, w, that take coordinates of one frame to those
of its parent. Between two stamps the translation is interpolated linearly and the rotation at a constant rate, which in
the plane is linear in the angle on the circle.
"""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable
from typing import Literal, Protocol

import numpy as np

Transform = tuple[float, float, float, float, float, float, float]

IDENTITY: Transform = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)

KEPT = 10.0
"""s. Transforms older than this, against the latest one, are forgotten."""

FARTHEST = 1e12
"""m. Where a coordinate is larger, float64 no longer tells millimetres, and products of several overflow."""

_SAME = 1e-4  # m, and rad: a frame that moves by less stands still


def transform_of(translation: Iterable[float], rotation: Iterable[float]) -> Transform | None:
    """A transform from a translation and a quaternion of any length; None if it is none."""
    x, y, z = map(float, translation)
    a, b, c, d = map(float, rotation)
    norm = math.sqrt(a * a + b * b + c * c + d * d)
    if not (max(abs(x), abs(y), abs(z)) <= FARTHEST and 1e-6 < norm < math.inf) or math.isnan(x + y + z):
        return None
    return x, y, z, a / norm, b / norm, c / norm, d / norm


def compose(first: Transform, second: Transform) -> Transform:
    """The transform of the frame of `second` to the parent of `first`."""
    x, y, z = _rotated(first, second[0], second[1], second[2])
    a, b, c, d = first[3:]
    e, f, g, h = second[3:]
    return (
        first[0] + x,
        first[1] + y,
        first[2] + z,
        d * e + a * h + b * g - c * f,
        d * f - a * g + b * h + c * e,
        d * g + a * f - b * e + c * h,
        d * h - a * e - b * f - c * g,
    )


def inverse(transform: Transform) -> Transform:
    """The transform of the parent to the frame."""
    x, y, z, a, b, c, d = transform
    turned = (0.0, 0.0, 0.0, -a, -b, -c, d)
    x, y, z = _rotated(turned, x, y, z)
    return -x, -y, -z, -a, -b, -c, d


def between(first: Transform, second: Transform, share: float) -> Transform:
    """The transform at a share of the way from one to another."""
    x, y, z = (p + share * (q - p) for p, q in zip(first[:3], second[:3], strict=True))
    cosine = sum(p * q for p, q in zip(first[3:], second[3:], strict=True))
    sign = -1.0 if cosine < 0 else 1.0  # q and -q are one rotation; the shorter way is meant
    angle = math.acos(min(abs(cosine), 1.0))
    if angle < 1e-6:
        weight, other = 1 - share, share
    else:
        weight, other = math.sin((1 - share) * angle) / math.sin(angle), math.sin(share * angle) / math.sin(angle)
    a, b, c, d = (weight * p + sign * other * q for p, q in zip(first[3:], second[3:], strict=True))
    norm = math.sqrt(a * a + b * b + c * c + d * d)
    return x, y, z, a / norm, b / norm, c / norm, d / norm


def planar(transform: Transform) -> tuple[float, float, float]:
    """x, y and the direction of the frame's x axis, seen from above. m, m, rad."""
    ahead = _rotated(transform, 1.0, 0.0, 0.0)
    return transform[0], transform[1], math.atan2(ahead[1], ahead[0])


def upright(transform: Transform) -> float:
    """Cosine of the angle between the frame's z axis and its parent's: 1 upright, -1 upside down."""
    _, _, _, a, b, _, _ = transform
    return 1 - 2 * (a * a + b * b)


def _rotated(by: Transform, x: float, y: float, z: float) -> tuple[float, float, float]:
    _, _, _, a, b, c, d = by
    tx, ty, tz = 2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)
    return x + d * tx + b * tz - c * ty, y + d * ty + c * tx - a * tz, z + d * tz + a * ty - b * tx


class Poses(Protocol):
    """Poses in the plane over time.

    Attributes:
      description: where they come from, in words.
    """

    description: str

    def covers(self, begin: float, end: float) -> bool:
        """Whether the poses from one stamp to another are known. s."""
        ...

    def at(self, stamps: np.ndarray) -> np.ndarray:
        """Poses at stamps that are covered: x, y, theta, which goes on past pi. `[n]` s -> `[n, 3]` m, m, rad."""
        ...

    def cov_at(self, stamp: float) -> np.ndarray | None:
        """Covariance of the pose at a stamp, if it is stated. Shape `[3, 3]`."""
        ...


ROUNDED = 1e-6
"""s. Stamps in files have so many digits."""


class Trajectory:
    """Poses in the plane at given stamps, interpolated between them.

    Attributes:
      description: in words.
      pose_frame: whose poses they are.
    """

    def __init__(
        self,
        stamps: np.ndarray,
        poses: np.ndarray,
        pose_frame: Literal["robot", "laser"] = "robot",
        covs: np.ndarray | None = None,
    ) -> None:
        """A trajectory from stamps, s, and poses x, y, theta, m, m, rad.

        Args:
          stamps: finite, in any order; of equal ones the first counts. Shape `[T]`.
          poses: finite. Shape `[T, 3]`.
          pose_frame: whose poses they are.
          covs: of the poses, m^2, m rad, rad^2. Shape `[T, 3, 3]`. None if they are not stated.

        Raises:
          ValueError: if there is no pose, or if stamps, poses and covariances differ in number or are not finite.
        """
        stamps, poses = np.asarray(stamps, float), np.asarray(poses, float)
        if stamps.ndim != 1 or poses.shape != (stamps.size, 3) or stamps.size == 0:
            raise ValueError(f"a trajectory needs T stamps and [T, 3] poses, not {stamps.shape} and {poses.shape}")
        if covs is not None and covs.shape != (stamps.size, 3, 3):
            raise ValueError(f"{stamps.size} poses need covariances [T, 3, 3], not {covs.shape}")
        if not all(np.isfinite(x).all() for x in (stamps, poses, *([] if covs is None else [covs]))):
            raise ValueError("a stamp, a pose or a covariance of the trajectory is not finite")
        self.pose_frame: Literal["robot", "laser"] = pose_frame
        self.description = "of a given trajectory" + (" of the laser" if pose_frame == "laser" else "")
        self.stamps, index = np.unique(stamps, return_index=True)
        self.poses = poses[index]
        self.covs = None if covs is None else covs[index]
        self.poses[:, 2] = np.unwrap(self.poses[:, 2])
        # One step more, if there is a step.
        self._knots = np.append(self.stamps, self.stamps[-1] + np.diff(self.stamps[-2:]))
        self._poses_at_knots = np.concatenate([self.poses, self.poses[-1] + np.diff(self.poses[-2:], axis=0)])

    def covers(self, begin: float, end: float) -> bool:
        """Whether the poses from one stamp to another are known. s.

        A trajectory may have one pose for each scan, at its begin. So what begins by the last of them may end a step
        later: for so long the robot goes on as it did.
        """
        in_time = self.stamps[0] - ROUNDED <= begin <= self.stamps[-1] + ROUNDED
        return bool(in_time and end <= self._knots[-1] + ROUNDED)

    def at(self, stamps: np.ndarray) -> np.ndarray:
        """Poses at stamps that are covered. `[n]` s -> `[n, 3]` m, m, rad."""
        return _interpolated(stamps, self._knots, self._poses_at_knots)

    def cov_at(self, stamp: float) -> np.ndarray | None:
        """Covariance of the pose at a stamp, if they are stated. Shape `[3, 3]`.

        Between two poses it is interpolated: a bound of that of the pose between, however the errors hang together.
        """
        if self.covs is None:
            return None
        after = int(np.clip(np.searchsorted(self.stamps, stamp), 0, self.stamps.size - 1))
        before = max(after - 1, 0)
        step = self.stamps[after] - self.stamps[before]
        share = float(np.clip((stamp - self.stamps[before]) / step, 0, 1)) if step > 0 else 1.0
        return (1 - share) * self.covs[before] + share * self.covs[after]


class Standstill:
    """The pose of a robot that stays at the origin."""

    description = "of a robot that stands still"

    def covers(self, begin: float, end: float) -> bool:
        """Always."""
        return True

    def at(self, stamps: np.ndarray) -> np.ndarray:
        """The origin, `[n, 3]`."""
        return np.zeros((len(stamps), 3))

    def cov_at(self, stamp: float) -> None:
        """None: nothing is stated."""


class Track:
    """The transform of one frame to its parent, as it comes in; what is older than `KEPT` is forgotten.

    Attributes:
      parent: name of the parent frame.
      moves: whether it ever changed. One that did not is taken to hold at any time: such transforms are published
        seldom, or once.
    """

    def __init__(self, parent: str, *, moves: bool = False) -> None:
        """A track of which nothing is known yet."""
        self.parent = parent
        self.moves = moves
        self._stamps: list[float] = []
        self._transforms: list[Transform] = []
        self._covs: list[np.ndarray | None] = []
        self._first: Transform | None = None
        self._latest: Transform | None = None

    def add(self, stamp: float, transform: Transform, cov: np.ndarray | None = None) -> None:
        """Note a transform, and the covariance of its pose in the plane. A stamp that is there already is passed over.

        A stamp that steps back by more than `KEPT` begins anew: a clock was set, or a recording starts over.
        """
        stamps = self._stamps
        self._first = self._first or transform
        self.moves = self.moves or _differ(self._first, transform)
        self._latest = transform
        if stamps and stamp < stamps[-1] - KEPT:
            self.clear()
        at = bisect_left(stamps, stamp)
        if at < len(stamps) and stamps[at] == stamp:
            return
        stamps.insert(at, stamp)
        self._transforms.insert(at, transform)
        self._covs.insert(at, cov)
        # Now and then: to forget one at a time would move the rest each time.
        if len(stamps) > 64 and stamps[len(stamps) // 2] < stamps[-1] - KEPT:
            old = bisect_left(stamps, stamps[-1] - KEPT)
            del stamps[:old], self._transforms[:old], self._covs[:old]

    @property
    def known(self) -> bool:
        """Whether it was told at all."""
        return self._latest is not None

    def clear(self) -> None:
        """Forget all stamps; a transform that never changed still holds."""
        self._stamps.clear()
        self._transforms.clear()
        self._covs.clear()

    def covers(self, begin: float, end: float) -> bool:
        """Whether it is known from one stamp to another. s."""
        if not self.moves:
            return self.known
        return bool(self._stamps) and self._stamps[0] <= begin and end <= self._stamps[-1]

    def at(self, stamp: float) -> Transform:
        """The transform at a stamp; beyond what is known, the nearest."""
        stamps, after = self._stamps, bisect_right(self._stamps, stamp)
        if not self.moves or not stamps:
            assert self._latest is not None
            return self._latest
        if after == 0 or after == len(stamps):
            return self._transforms[max(after - 1, 0)]
        share = (stamp - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        return between(self._transforms[after - 1], self._transforms[after], share)

    def cov_at(self, stamp: float) -> np.ndarray | None:
        """The covariance that came with the latest transform up to a stamp."""
        after = bisect_right(self._stamps, stamp)
        return self._covs[max(after - 1, 0)] if self._covs else None

    def stamps_inside(self, begin: float, end: float) -> list[float]:
        """The stamps between two others. s."""
        return self._stamps[bisect_right(self._stamps, begin) : bisect_left(self._stamps, end)] if self.moves else []


class Chain:
    """The pose of a frame in another one, over tracks that lead up from it and down to it."""

    description = "of frames"

    def __init__(self, up: list[Track], down: list[Track]) -> None:
        """The tracks from the frame up to a common ancestor, and from the other frame up to it."""
        self.up = up
        self.down = down

    @property
    def moves(self) -> bool:
        """Whether any track has ever changed."""
        return any(track.moves for track in (*self.up, *self.down))

    @property
    def known(self) -> bool:
        """Whether every track was told at all."""
        return all(track.known for track in (*self.up, *self.down))

    def covers(self, begin: float, end: float) -> bool:
        """Whether the poses from one stamp to another are known. s."""
        return all(track.covers(begin, end) for track in (*self.up, *self.down))

    def transform_at(self, stamp: float) -> Transform:
        """The transform from the one frame to the other at a stamp."""
        result = IDENTITY
        for track in self.up:
            result = compose(track.at(stamp), result)
        for track in reversed(self.down):
            result = compose(inverse(track.at(stamp)), result)
        return result

    def at(self, stamps: np.ndarray) -> np.ndarray:
        """Poses at stamps that are covered. `[n]` s -> `[n, 3]` m, m, rad."""
        if len(stamps) == 1:
            return np.array([planar(self.transform_at(float(stamps[0])))])
        begin, end = float(np.min(stamps)), float(np.max(stamps))
        inside = {stamp for track in (*self.up, *self.down) for stamp in track.stamps_inside(begin, end)}
        knots = np.array([begin, *sorted(inside), end])
        poses = np.array([planar(self.transform_at(knot)) for knot in knots.tolist()])
        poses[:, 2] = np.unwrap(poses[:, 2])
        return _interpolated(stamps, knots, poses)

    def cov_at(self, stamp: float) -> np.ndarray | None:
        """The covariance that came with the pose, if the chain is a single track."""
        return self.up[0].cov_at(stamp) if len(self.up) == 1 and not self.down else None


class FrameTree:
    """Frames and their parents, by name."""

    def __init__(self) -> None:
        """A tree without a frame."""
        self.tracks: dict[str, Track] = {}
        self.static: set[str] = set()  # frames whose transform was stated for all time

    def add(self, child: str, parent: str, stamp: float, transform: Transform, *, static: bool) -> None:
        """Note where a frame is in its parent. What is static stays so."""
        if child in self.static and not static:
            return
        if static:
            self.static.add(child)
        track = self.tracks.get(child)
        if track is None or track.parent != parent:
            track = self.tracks[child] = Track(parent)
        if not static:
            track.add(stamp, transform)
        elif not track.covers(0, 0):
            track.add(0.0, transform)

    def ancestors(self, frame: str) -> list[str]:
        """A frame, its parent, and so on up to the root."""
        names = [frame]
        while (track := self.tracks.get(names[-1])) is not None and track.parent not in names:
            names.append(track.parent)
        return names

    def chain(self, frame: str, other: str) -> Chain | None:
        """What leads from a frame to another one; None if nothing does."""
        ups, downs = self.ancestors(frame), self.ancestors(other)
        common = next((name for name in ups if name in downs), None)
        if common is None:
            return None
        up, down = (names[: names.index(common)] for names in (ups, downs))
        return Chain([self.tracks[name] for name in up], [self.tracks[name] for name in down])


def _interpolated(stamps: np.ndarray, knots: np.ndarray, poses: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(stamps, knots, poses[:, i]) for i in range(3)], -1)


def _differ(a: Transform, b: Transform) -> bool:
    moved = max(abs(p - q) for p, q in zip(a[:3], b[:3], strict=True))
    turned = min(max(abs(p - sign * q) for p, q in zip(a[3:], b[3:], strict=True)) for sign in (1, -1))
    return moved > _SAME or turned > _SAME / 2


def poses_of_sweep(
    poses: Poses, stamp: float, time_increment: float, beams: int
) -> tuple[np.ndarray, np.ndarray | None] | None:
    """The pose at the time of a scan's first beam, and those of all its beams.

    Args:
      poses: over time.
      stamp: of the first beam, s.
      time_increment: from beam to beam, s; 0 if all were measured at once.
      beams: number of them, `N`.

    Returns:
      A pose `[3]`, and poses `[N, 3]` or None if they are all the same; None if the poses do not cover the sweep.
    """
    end = stamp + time_increment * (beams - 1)
    if not poses.covers(min(stamp, end), max(stamp, end)):
        return None
    if time_increment == 0:
        return poses.at(np.array([stamp]))[0], None
    every = poses.at(stamp + time_increment * np.arange(beams))
    return every[0], every if np.any(every != every[:1]) else None
