"""A map and a trajectory from raw odometry: the host loop around tracking, loop closing and the pose graph.

Scans are tracked in chunks of one size. After each chunk its keyframes are compared with older ones that look at the
same place; where loops are closed, the graph is optimised. Memory grows with the number of keyframes, not of scans.
Scans are tracked in their own precision; the graph is float64 whatever jax is set to.
"""

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from linemap_jax.build import STATIC, build
from linemap_jax.core.estimation.adjustment import (
    CircleSightings,
    LineSightings,
    adjust,
    circles_from_sightings,
    sightings_of_scan,
    with_error_of_first,
    with_error_of_poses,
)
from linemap_jax.core.estimation.loops import Closure, LoopSettings, close_loop
from linemap_jax.core.estimation.odometry import OdometryNoise, cov_step
from linemap_jax.core.estimation.pose_graph import SURE, Closures, PoseGraph, cov_of_registration, optimise
from linemap_jax.core.estimation.registration import RegistrationSettings
from linemap_jax.core.estimation.surface import Surface, middle_of
from linemap_jax.core.estimation.tracking import Track, Tracked, TrackingSettings, begin_track, track_chunk
from linemap_jax.core.fields import documented
from linemap_jax.core.frames_on_host import between, compose
from linemap_jax.core.settings import Method, SensorNoise, Thresholds
from linemap_jax.core.state import LineMap, Pose, Scan, pad_stack

CHUNK = 64
"""Scans in one jitted call."""
NEWER = 15
"""A keyframe is not compared with so many before it, which tracking has seen."""
BESIDE = 4
"""Keyframes before and after an older one that are laid together with it."""
CANDIDATES = 2
"""Older keyframes that a keyframe is compared with, at most."""
CANDIDATES_APART = 8
"""Of these, how many keyframes lie between two."""
LOOK_APART = 2.0
"""m. Two keyframes may see the same place if the middles of what they see are no farther apart than this and twice what
the drift may be."""
FARTHEST = 12.0
"""m. The same, at most."""
CLOSED = 0.3
"""m. A closure counts as a path of this length."""

SIGMA_NEXT = (0.02, 0.02, 0.005)
"""m, m, rad. How far the pose of a keyframe may be off against the map, when its lines are looked for there."""

SIGMA_MAP = (0.05, 0.05, 0.01)
"""m, m, rad. The same while the map is made, where two passes through a place are as far apart as their loops leave."""

SIGMA_SCAN = (0.01, 0.01, 0.003)
"""m, m, rad. By how much the registration of a single scan errs."""

_AT_ONCE = np.zeros(3)  # how the scanner moves in a scan of one instant
_START = 512  # keyframes that there is room for at first
_LEAST_INFORMATION = np.diag([1.0, 1.0, 10.0])  # of a closure, beside its points: 1 m, 0.3 rad


@dataclasses.dataclass
class _Keyframes:
    """What is kept of the keyframes."""

    step: list[np.ndarray] = dataclasses.field(default_factory=list)  # [3] from the one before
    cov_step: list[np.ndarray] = dataclasses.field(default_factory=list)
    middle: list[np.ndarray] = dataclasses.field(default_factory=list)  # [2] of what it sees, in its own frame
    surface: list[Surface] = dataclasses.field(default_factory=list)
    scan: list[Scan] = dataclasses.field(default_factory=list)
    odometry: list[np.ndarray] = dataclasses.field(default_factory=list)  # [3] pose by odometry


class Slam:
    """Simultaneous localisation and mapping, chunk by chunk.

    The trajectory is given in the frame in which odometry began. Its poses are those of the scanner. `unit_variance` is
    what the last `adjust` found; before, it is 1.
    """

    def __init__(
        self,
        *,
        odometry_noise: OdometryNoise = OdometryNoise(),
        tracking: TrackingSettings = TrackingSettings(),
        registration: RegistrationSettings = RegistrationSettings(),
        loops: LoopSettings = LoopSettings(),
    ) -> None:
        """An empty one.

        Args:
          odometry_noise: how well the wheels count.
          tracking: keyframes, and trust in odometry.
          registration: of scans onto what has been seen.
          loops: which closures are looked for and believed.
        """
        self._noise = odometry_noise
        self._track = partial(_jit_track, noise=odometry_noise, settings=tracking, registration=registration)
        self._loops = loops
        self._close = partial(_jit_close, settings=loops, registration=registration)
        self._state: Track | None = None
        self._first = np.zeros(3)  # pose of odometry
        self._keyframes = _Keyframes()
        self._poses = np.zeros((0, 3))  # of the keyframes, by the graph
        self._closures: list[tuple[int, int, np.ndarray, np.ndarray]] = []
        self._weight = np.zeros(0)
        self._keyframe_of_scan: list[np.ndarray] = []
        self._seen_from_keyframe: list[np.ndarray] = []
        self._swept: list[np.ndarray] = []
        self.shares: list[np.ndarray] = []
        self.unit_variance = 1.0

    def add(self, scans: Scan, odometry: ArrayLike, swept: ArrayLike = _AT_ONCE) -> None:
        """Go on by some scans.

        Args:
          scans: at most `CHUNK`, stacked.
          odometry: poses of the scanner by the robot's odometry. m, m, rad. Shape `[T, 3]`.
          swept: how the scanner moved, by the same, while it swept: the pose at the last beam seen from that at the
            first, to which the scan is brought. Nothing for scans of one instant. m, m, rad. Shape `[T, 3]`.
        """
        count, counted = scans.ranges.shape[0], np.asarray(odometry, float)
        if self._state is None:
            self._first = counted[0]
        # From where it began, so that float32 resolves its steps in a frame of any country.
        poses = jnp.asarray(counted - [*self._first[:2], 0], scans.ranges.dtype)
        if self._state is None:
            self._state = begin_track(poses[0], jax.tree.map(lambda x: x[0], scans))
        self._state, said = self._track(
            self._state, pad_stack(scans, CHUNK), pad_stack(poses, CHUNK), jnp.arange(CHUNK) < count
        )
        said = jax.tree.map(lambda x: np.asarray(x)[:count], said)
        self.shares.append(said.share)
        self._swept.append(np.broadcast_to(np.asarray(swept, float), (count, 3)))
        begin = len(self._keyframes.step)
        self._take(said, jax.tree.map(np.asarray, scans), counted)
        if self._close_loops(begin):
            self._optimise()

    def _take(self, said: Tracked, scans: Scan, odometry: np.ndarray) -> None:
        """Keep the keyframes of a chunk, and where its scans lie against them."""
        kept = self._keyframes
        prior = np.diag([1 / 0.3**2, 1 / 0.3**2, 1 / 0.15**2])  # what odometry says at least, over one step
        middles = np.asarray(_jit_middles(said.surface))
        covs = _cov_of_registration(said.information, said.share, np.tile(prior, (len(middles), 1, 1)))
        owner, seen = np.zeros(len(middles), int), np.zeros((len(middles), 3))
        for i in range(len(middles)):
            if said.is_keyframe[i]:
                first = not kept.step
                kept.step.append(np.zeros(3) if first else np.asarray(said.step[i], float))
                kept.cov_step.append(covs[i])
                kept.middle.append(middles[i])
                kept.surface.append(jax.tree.map(lambda x, i=i: x[i], said.surface))
                kept.scan.append(jax.tree.map(lambda x, i=i: x[i], scans))
                kept.odometry.append(odometry[i])
                pose = self._first if first else compose(self._poses[-1], kept.step[-1])
                self._poses = np.concatenate([self._poses, pose[None]])
            else:
                seen[i] = said.step[i]
            owner[i] = len(kept.step) - 1
        self._keyframe_of_scan.append(owner)
        self._seen_from_keyframe.append(seen)

    def _close_loops(self, begin: int) -> bool:
        """Compare the keyframes from `begin` on with older ones; whether that closed a loop."""
        kept, poses = self._keyframes, self._poses
        middles = np.array([compose(pose, [*middle, 0])[:2] for pose, middle in zip(poses, kept.middle, strict=True)])
        found = []
        for i in range(max(begin, NEWER + 1), len(poses)):
            path = self._shortest_paths(i, found)[: i - NEWER]
            drift = self._loops.least_drift + self._loops.drift_per_metre * path
            apart = np.hypot(*(middles[: i - NEWER] - middles[i]).T)
            near = apart < np.minimum(LOOK_APART + 2 * drift, FARTHEST)
            for j in _spread(np.argsort(np.where(near, apart, np.inf))[: near.sum()]):
                closure = self._compare(i, j, path[j])
                if closure.believed:
                    cov = _cov_of_registration(closure.information, closure.share, _LEAST_INFORMATION)
                    found.append((j, i, np.asarray(closure.step, float), cov))
        self._closures += found
        self._weight = np.concatenate([self._weight, np.ones(len(found))])
        return bool(found)

    def _compare(self, i: int, j: int, path: float) -> Closure:
        """Lay a keyframe onto an older one and its neighbours, at fixed shapes."""
        kept, poses = self._keyframes, self._poses
        dtype = kept.surface[i].position.dtype
        around = np.arange(j - BESIDE, j + BESIDE + 1)
        valid = (around >= 0) & (around <= i - NEWER + BESIDE)
        around = np.clip(around, 0, len(poses) - 1)
        surfaces = jax.tree.map(lambda *x: np.stack(x), *(kept.surface[k] for k in around))
        seen = np.array([between(poses[j], poses[k]) for k in around]).astype(dtype)
        guess = between(poses[j], poses[i]).astype(dtype)
        return jax.device_get(self._close(kept.surface[i], surfaces, seen, valid, guess, np.asarray(path, dtype)))

    def _shortest_paths(self, i: int, found: list[Any]) -> np.ndarray:
        """Length of the shortest path from keyframe `i` to each, over the chain and the closures that are believed."""
        steps = np.array(self._keyframes.step)
        closures = [c for c, w in zip(self._closures, self._weight, strict=True) if w > SURE] + found
        begin = np.concatenate([np.arange(len(steps) - 1), [c[0] for c in closures]]).astype(int)
        end = np.concatenate([np.arange(1, len(steps)), [c[1] for c in closures]]).astype(int)
        length = np.concatenate([np.hypot(steps[1:, 0], steps[1:, 1]) + 0.01, np.full(len(closures), CLOSED)])
        graph = csr_array((length, (begin, end)), shape=(len(steps), len(steps)))
        return dijkstra(graph, directed=False, indices=i)

    def _optimise(self) -> None:
        """Let the graph settle."""
        with jax.enable_x64(True):
            graph = _jit_optimise(self.graph())
        self._poses = np.asarray(graph.poses)[: len(self._poses)]
        self._weight = np.asarray(graph.closures.weight)[: len(self._closures)]

    def graph(self, room: Callable[[int], int] | None = None) -> PoseGraph:
        """Keyframes and closures, padded: to powers of two, or to what `room` gives for their number.

        Args:
          room: how many slots for so many keyframes or closures; a power of two unless given.

        Returns:
          The graph.
        """
        kept, count = self._keyframes, len(self._poses)
        n = (room or _room)(count)
        e = (room or _room)(len(self._closures))
        begin, end, step, cov = zip(*self._closures, strict=True) if self._closures else ([], [], [], [])
        identity = np.eye(3)
        closures = Closures(
            begin=_filled(begin, e, (), int),
            end=_filled(end, e, (), int),
            step=_filled(step, e, (3,)),
            cov=_filled(cov, e, (3, 3), fill=identity),
            weight=_filled(self._weight, e, ()),
            valid=_filled(np.ones(len(begin)), e, (), bool),
        )
        return PoseGraph(
            poses=_filled(self._poses, n, (3,)),
            step=_filled(kept.step, n, (3,)),
            cov_step=_filled(kept.cov_step, n, (3, 3), fill=identity),
            valid=_filled(np.ones(count), n, (), bool),
            closures=closures,
        )

    def adjust(
        self,
        line_map: LineMap,
        *,
        thresholds: Thresholds = Thresholds(),
        noise: SensorNoise = SensorNoise(),
        **method: Unpack[Method],
    ) -> tuple[LineMap, Float[np.ndarray, "N 3 3"]]:
        """Let poses and lines settle together; from then on the trajectory is that of the adjustment.

        Args:
          line_map: made from the scans at the poses of the trajectory.
          thresholds: of extraction and matching.
          noise: of the scanner.
          **method: as for `extract`: how the map was made.

        Returns:
          The map, whose covariances now hold what the poses are uncertain by, too; and the covariances of the
          keyframes' poses.
        """
        count, dtype = len(self._poses), line_map.lines.offset.dtype
        numbers, pieces = np.arange(count), []
        width = max(scan.ranges.size for scan in self._keyframes.scan)
        cov_sweeps = self._cov_of_sweeps()[self.scan_of_keyframe]
        for i in range(0, count, CHUNK):
            scans = _stacked(self._keyframes.scan[i : i + CHUNK], width)
            size = len(scans.ranges)
            poses = _uncertain(self._poses[i : i + CHUNK], SIGMA_NEXT, dtype)
            piece = pad_stack((scans, poses, numbers[i : i + CHUNK], cov_sweeps[i : i + CHUNK]), CHUNK)
            found = _jit_sightings(*piece, line_map, thresholds=thresholds, noise=noise, **method)
            pieces.append(jax.tree.map(partial(_flat, size), found))
        found = jax.tree.map(lambda *x: np.concatenate(x), *pieces)
        seen, circles_seen = (jax.tree.map(lambda x, kind=kind: x[kind.valid], kind) for kind in found)
        used = np.flatnonzero(np.asarray(line_map.lines.valid))
        place = np.zeros(line_map.lines.valid.shape[0], int)
        place[used] = np.arange(len(used))
        m, k = _tight(len(seen.valid)), _tight(len(used))
        with jax.enable_x64(True):
            sightings = LineSightings(
                keyframe=_filled(seen.keyframe, m, (), int),
                line=_filled(place[seen.line], m, (), int),
                anchor=_filled(seen.anchor, m, (2,)),
                angle=_filled(seen.angle, m, ()),
                cov=_filled(seen.cov, m, (2, 2), fill=np.eye(2)),
                valid=_filled(seen.valid, m, (), bool),
            )
            lines = jax.tree.map(lambda x: _filled(np.asarray(x)[used], k, x.shape[1:], _wide(x.dtype)), line_map.lines)
            done = _jit_adjust(self.graph(_tight), lines, sightings)
            done = _jit_error_of_first(done, _turned(cov_sweeps[:1], self._poses[:1, 2])[0])
        self._poses = np.asarray(done.poses)[:count]
        self.unit_variance = float(done.unit_variance)
        covs = np.asarray(done.cov_poses)[:count] + _turned(cov_sweeps, self._poses[:, 2])
        moved = jax.tree.map(
            lambda old, new: jnp.asarray(_put(np.asarray(old), used, np.asarray(new)[: len(used)]), old.dtype),
            line_map.lines,
            done.lines,
        )
        seen = _put(np.zeros(place.shape, bool), used, np.asarray(done.seen)[: len(used)])
        with jax.enable_x64(True):
            m = _tight(len(circles_seen.valid))
            of_circles = jax.tree.map(lambda x: _filled(x, m, x.shape[1:], _wide(x.dtype)), circles_seen)
            of_circles = dataclasses.replace(of_circles, cov=_filled(circles_seen.cov, m, (3, 3), fill=np.eye(3)))
            circles = jax.tree.map(lambda x: jnp.asarray(x, _wide(x.dtype)), line_map.circles)
            circles = _jit_circles(circles, done.poses, done.cov_poses, of_circles)
            circles = jax.tree.map(lambda new, old: new.astype(old.dtype), circles, line_map.circles)
            return _jit_error_of_poses(LineMap(lines=moved, circles=circles), seen, self._poses, covs), covs

    def drift(self, stamps: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T 3"]:
        """How fast odometry goes astray at each scan, by the trajectory so far: evenly from keyframe to keyframe.

        While a scanner sweeps, its beams are brought together by odometry alone. The trajectory knows better.

        Args:
          stamps: of the scans, s. Shape `[T]`.

        Returns:
          The velocity of the scanner, in its own frame, that odometry lacks; zero after the last keyframe. m/s, m/s,
          rad/s. Shape `[T, 3]`.
        """
        counted = np.array(self._keyframes.odometry)
        astray = between(between(counted[:-1], counted[1:]), between(self._poses[:-1], self._poses[1:]))
        seconds = np.diff(stamps[self.scan_of_keyframe])[:, None]
        rate = np.where(seconds > 0, astray / np.where(seconds > 0, seconds, 1), 0)
        return np.concatenate([rate, np.zeros((1, 3))])[np.concatenate(self._keyframe_of_scan)]

    def see_again(self, begin: int, scans: Scan) -> None:
        """Take some scans anew, for `adjust`, now that it is known how the scanner moved in their sweeps.

        Args:
          begin: number of the first.
          scans: stacked.
        """
        seen = jax.tree.map(np.asarray, scans)
        for keyframe, number in enumerate(self.scan_of_keyframe - begin):
            if 0 <= number < len(seen.ranges):
                self._keyframes.scan[keyframe] = jax.tree.map(lambda x, i=number: x[i], seen)

    @property
    def closures(self) -> int:
        """Loops that are believed to be closed."""
        return int((self._weight > SURE).sum())

    @property
    def keyframes(self) -> Float[np.ndarray, "N 3"]:
        """Poses of the keyframes. m, m, rad."""
        return self._poses

    @property
    def scan_of_keyframe(self) -> Int[np.ndarray, " N"]:
        """Number of the scan that each keyframe is."""
        return np.unique(np.concatenate(self._keyframe_of_scan), return_index=True)[1]

    def trajectory(self) -> Float[np.ndarray, "T 3"]:
        """The pose of the scanner at each scan so far. m, m, rad."""
        owner, seen = np.concatenate(self._keyframe_of_scan), np.concatenate(self._seen_from_keyframe)
        return compose(self._poses[owner], seen)

    def cov_trajectory(self, cov_keyframes: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "T 3 3"]:
        """Covariances of these, from those of the keyframes; m^2, m rad, rad^2.

        A scan between two keyframes errs as the one before it, by its own registration, and by odometry in its sweep.

        Args:
          cov_keyframes: of their poses, from `adjust`: m^2, m rad, rad^2. Shape `[N, 3, 3]`.

        Returns:
          Shape `[T, 3, 3]`.
        """
        owner, seen = np.concatenate(self._keyframe_of_scan), np.concatenate(self._seen_from_keyframe)
        theta = self._poses[owner, 2]
        jac = np.tile(np.eye(3), (len(owner), 1, 1))
        jac[:, 0, 2] = -np.sin(theta) * seen[:, 0] - np.cos(theta) * seen[:, 1]
        jac[:, 1, 2] = np.cos(theta) * seen[:, 0] - np.sin(theta) * seen[:, 1]
        between_keyframes = (seen != 0).any(1)[:, None, None]
        of_sweep = _turned(self._cov_of_sweeps(), theta + seen[:, 2])
        own = between_keyframes * (np.diag(np.square(SIGMA_SCAN)) + of_sweep)
        return jac @ cov_keyframes[owner] @ np.swapaxes(jac, 1, 2) + own

    def _cov_of_sweeps(self) -> Float[np.ndarray, "T 3 3"]:
        """What each scan, as a whole, errs by, since odometry brought its beams to the pose of the first one.

        Odometry errs at random along the way, and on the mean over a sweep by a third of the variance that it has at
        the end; by as much the parts of a sweep differ from its mean, at most. It errs as the noise says, but for
        factors along x, y and theta: those by which it fits the trajectory from keyframe to keyframe, but for what is
        in proportion to the motion, which `drift` holds. In the frame of the scanner.
        """
        swept = np.concatenate(self._swept)
        if not swept.any():
            return np.zeros((len(swept), 3, 3))
        counted = np.array(self._keyframes.odometry)
        steps = between(counted[:-1], counted[1:])
        with jax.enable_x64(True):
            said, in_sweep = (np.asarray(_jit_cov_steps(x, self._noise)) for x in (steps, swept))
        astray = between(steps, between(self._poses[:-1], self._poses[1:]))
        rest = astray - steps @ np.linalg.lstsq(steps, astray)[0]
        variance = np.sum(np.diagonal(said, axis1=1, axis2=2), 0) * max(1 - 3 / max(len(steps), 1), 0.1)
        factor = np.sqrt(np.sum(rest**2, 0) / np.where(variance > 0, variance, 1) / 3)
        return in_sweep * factor[:, None] * factor


@documented
class Slammed(NamedTuple):
    """A log whose poses were not known."""

    line_map: LineMap
    """The map."""
    trajectory: Float[np.ndarray, "T 3"]
    """Poses of the scanner at each scan. m, m, rad."""
    cov: Float[np.ndarray, "T 3 3"]
    """Covariances of these: m^2, m rad, rad^2."""
    state: Slam
    """From which it can go on."""


def slam(
    scans: Scan,
    odometry: ArrayLike,
    *,
    thresholds: Thresholds = Thresholds(),
    noise: SensorNoise = SensorNoise(),
    odometry_noise: OdometryNoise = OdometryNoise(),
    tracking: TrackingSettings = TrackingSettings(),
    registration: RegistrationSettings = RegistrationSettings(),
    loops: LoopSettings = LoopSettings(),
) -> Slammed:
    """Map and trajectory of a whole log.

    Args:
      scans: `T`, stacked.
      odometry: poses of the scanner by the robot's odometry. m, m, rad. Shape `[T, 3]`.
      thresholds: of the map.
      noise: of the scanner.
      odometry_noise: how well the wheels count.
      tracking: keyframes, and trust in odometry.
      registration: of scans onto what has been seen.
      loops: which closures are looked for and believed.

    Returns:
      The map, the trajectory with its covariances, and the state, from which it can go on.

    Raises:
      ValueError: if there is not one pose of odometry for each scan.
    """
    state = Slam(odometry_noise=odometry_noise, tracking=tracking, registration=registration, loops=loops)
    count, places = scans.ranges.shape[0], np.asarray(odometry)
    if places.shape != (count, 3):
        raise ValueError(f"odometry must have one pose for each scan, shape {(count, 3)}, not {places.shape}")
    for i in range(0, count, CHUNK):
        state.add(_part(scans, i), places[i : i + CHUNK])
    poses = poses_for_map(state.trajectory(), scans.ranges.dtype)
    line_map, _ = build(scans, poses, thresholds=thresholds, noise=noise, pose_error="unknown")
    line_map, cov_keyframes = state.adjust(line_map, thresholds=thresholds, noise=noise)
    return Slammed(line_map, state.trajectory(), state.cov_trajectory(cov_keyframes), state)


def poses_for_map(trajectory: Float[np.ndarray, "T 3"], dtype: Any) -> Pose:
    """The poses of a trajectory as a map is to be made from: as uncertain as they are against each other.

    What the whole of it is uncertain by, and the map with it, comes from `Slam.adjust`.

    Args:
      trajectory: poses of the scanner. m, m, rad.
      dtype: of the scans.

    Returns:
      The poses, stacked.
    """
    return _uncertain(trajectory, SIGMA_MAP, dtype)


def _uncertain(poses: np.ndarray, sigmas: tuple[float, float, float], dtype: Any) -> Pose:
    cov = np.tile(np.diag(np.square(sigmas)), (len(poses), 1, 1))
    return Pose(mean=jnp.asarray(poses, dtype), cov=jnp.asarray(cov, dtype))


def _part(scans: Scan, begin: int) -> Scan:
    return jax.tree.map(lambda x: np.asarray(x)[begin : begin + CHUNK], scans)


_jit_track = jax.jit(track_chunk)
_jit_close = jax.jit(close_loop)
_jit_optimise = jax.jit(optimise)
_jit_adjust = jax.jit(adjust)
_jit_cov_steps = jax.jit(jax.vmap(cov_step, (0, None)))
_jit_cov = jax.jit(cov_of_registration)
_jit_circles = jax.jit(circles_from_sightings)
_jit_error_of_first = jax.jit(with_error_of_first)
_jit_error_of_poses = jax.jit(with_error_of_poses)
_jit_middles = jax.jit(jax.vmap(middle_of))


@partial(jax.jit, static_argnames=STATIC)
def _jit_sightings(
    scans: Scan,
    poses: Pose,
    numbers: Array,
    cov_sweeps: Array,
    line_map: LineMap,
    *,
    thresholds: Thresholds,
    noise: SensorNoise,
    **method: Unpack[Method],
) -> tuple[LineSightings, CircleSightings]:
    def of_scan(x: tuple[Scan, Pose, Array, Array]) -> tuple[LineSightings, CircleSightings]:
        scan, pose, number, cov_sweep = x
        return sightings_of_scan(scan, pose, line_map, number, cov_sweep, thresholds=thresholds, noise=noise, **method)

    return jax.lax.map(of_scan, (scans, poses, numbers, cov_sweeps.astype(scans.ranges.dtype)))


def _cov_of_registration(information: Any, share: Any, prior: np.ndarray) -> np.ndarray:
    """In float64, on NumPy arrays."""
    with jax.enable_x64(True):
        return np.asarray(_jit_cov(*(np.asarray(x, float) for x in (information, share, prior))))


def _stacked(scans: list[Scan], width: int) -> Scan:
    """Scans of at most `width` beams, filled up with beams that did not return."""

    def fill(*x: np.ndarray) -> np.ndarray:
        return np.stack([np.pad(each, (0, width - each.size)) if each.ndim else each for each in x])

    return jax.tree.map(fill, *scans)


def _flat(count: int, stacked: Array) -> np.ndarray:
    """The first few items of a stack, one after the other."""
    return np.asarray(stacked)[:count].reshape(-1, *stacked.shape[2:])


def _wide(dtype: Any) -> Any:
    return float if np.dtype(dtype).kind == "f" else dtype


def _put(old: np.ndarray, where: np.ndarray, new: np.ndarray) -> np.ndarray:
    old = old.copy()
    old[where] = new
    return old


def _room(count: int) -> int:
    """The next power of two: each size is compiled once."""
    return max(_START, 1 << max(count - 1, 0).bit_length())


def _tight(count: int) -> int:
    """The next multiple of 128: time grows with the cube of it."""
    return 128 * max(1, -(-count // 128))


def _turned(cov: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Covariances of poses in axes that are turned by an angle. Shape `[N, 3, 3]`."""
    turn = np.tile(np.eye(3), (len(cov), 1, 1))
    c, s = np.cos(angle), np.sin(angle)
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = c, -s, s, c
    return turn @ cov @ np.swapaxes(turn, 1, 2)


def _filled(values: Any, size: int, shape: tuple[int, ...], dtype: Any = float, *, fill: Any = 0) -> Array:
    filled = np.empty((size, *shape), dtype)
    filled[:] = fill
    if len(values):
        filled[: len(values)] = values
    return jnp.asarray(filled)


def _spread(order: np.ndarray) -> Iterator[int]:
    """The first few that do not stand close together."""
    taken: list[int] = []
    for j in order.tolist():
        if len(taken) == CANDIDATES:
            return
        if all(abs(j - k) > CANDIDATES_APART for k in taken):
            taken.append(j)
            yield j
