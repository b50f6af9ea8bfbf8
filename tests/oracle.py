"""An oracle: the mapper once more, in plain NumPy and float64, to hold the package against.

It shares no computation with the package. From there come only the settings, the status bits and the two codes of a
report. It is written to be read: loops over lines and runs, arrays without padding (but for the slots of a map, which
are compared one by one), every Jacobian by hand.

The letters, in the frame of the world unless said otherwise: `p` is the position of the robot, `laser` the position
of the scanner relative to it, `o` a measured point relative to it, `u` the direction of a beam; `normal` has the
direction `angle`, `tangent` is the normal turned by +90 degrees. Points are taken relative to the robot, so that
nothing depends on how far away the origin of the world is.

The error of a line, (offset, angle), or of a fitted circle, (x, y, radius), has two parts: one that is independent from
scan to scan, with covariance `c`, and `a @ u`, where u holds three numbers of variance one that the scan's pose error
may share with those of other scans. Its covariance is `c + a a^T`.
"""

import dataclasses
import math
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np

from linemap_jax.core.settings import PoseError
from linemap_jax.core.state import LEFT_OUT, NEW, Status

# A beam that is closer than this to parallel to a line (cosine of the angle to its normal) does not cross it.
PARALLEL = 1e-6
# A laser closer than this to a line (m) sees it edge on: "so much behind the line" has no meaning.
EDGE_ON = 1e-3
# The end of a grazed line is uncertain by at most this much of a beam: the smallest |normal . u| that is used.
GRAZING = 0.1
GAUSS_NEWTON_STEPS = 5
# How near to the rim a beam is taken to meet a pole at least, in sigmas.
RIM = 0.5
FEWEST_CIRCLE_POINTS = 5
# Points closer than this (sigmas) to the line beside their own may be that line's.
UNSURE_SIGMAS = 3.0
# A beam more grazing than this (cosine of the incidence) does not say where it meets a line.
SHALLOW = 0.02
# What a scan says of a pose error that persists is known to this part: it depends on the pose.
JACOBIAN_ERROR = 0.005
# Points whose scatter is flatter than this have no circle: determinant of the scatter over its squared trace.
FLAT = 1e-6


@dataclasses.dataclass
class Lines:
    """Line segments; the fields of `linemap_jax.core.state.Lines`."""

    anchor: np.ndarray  # [K, 2]
    offset: np.ndarray  # [K]
    angle: np.ndarray  # [K]
    cov_independent: np.ndarray  # [K, 2, 2]
    sqrt_persistent: np.ndarray  # [K, 2, 3]
    first_angle: np.ndarray  # [K]
    extent: np.ndarray  # [K, 2]
    var_extent: np.ndarray  # [K, 2]
    times_detected: np.ndarray  # [K]
    times_contradicted: np.ndarray  # [K]
    valid: np.ndarray  # [K]

    @property
    def cov(self) -> np.ndarray:
        """Covariances of (offset, angle). Shape `[K, 2, 2]`."""
        return self.cov_independent + squared(self.sqrt_persistent)

    @property
    def normal(self) -> np.ndarray:
        """Unit normals. Shape `[K, 2]`."""
        return np.stack([np.cos(self.angle), np.sin(self.angle)], -1)

    @property
    def tangent(self) -> np.ndarray:
        """Unit tangents, from begin to end. Shape `[K, 2]`."""
        return np.stack([-np.sin(self.angle), np.cos(self.angle)], -1)

    @property
    def length(self) -> np.ndarray:
        """Lengths, m. Shape `[K]`."""
        return self.extent[:, 1] - self.extent[:, 0]

    @property
    def begin(self) -> np.ndarray:
        """Begin points in the world, m. Shape `[K, 2]`."""
        return self.point_at(self.extent[:, 0])

    @property
    def end(self) -> np.ndarray:
        """End points in the world, m. Shape `[K, 2]`."""
        return self.point_at(self.extent[:, 1])

    def point_at(self, along: np.ndarray) -> np.ndarray:
        """The points that lie `along` metres from the foot of the anchor. Shape `[K, 2]`."""
        return self.anchor + self.offset[:, None] * self.normal + along[:, None] * self.tangent

    def take(self, index: Any) -> "Lines":
        """The lines at `index` (a list or an array of slots)."""
        index = np.atleast_1d(np.asarray(index, int))
        return Lines(**{field.name: getattr(self, field.name)[index] for field in dataclasses.fields(self)})


@dataclasses.dataclass
class Circles:
    """Circles; the fields of `linemap_jax.core.state.Circles`."""

    center: np.ndarray  # [K, 2]
    radius: np.ndarray  # [K]
    cov_independent: np.ndarray  # [K, 3, 3]
    sqrt_persistent: np.ndarray  # [K, 3, 3]
    fitted: np.ndarray  # [K]
    times_detected: np.ndarray  # [K]
    times_contradicted: np.ndarray  # [K]
    valid: np.ndarray  # [K]

    @property
    def cov(self) -> np.ndarray:
        """Covariances of (x, y, radius). Shape `[K, 3, 3]`."""
        return self.cov_independent + squared(self.sqrt_persistent)


@dataclasses.dataclass
class OracleMap:
    """A map in padded slots, those of the package one by one. A slot that is not valid holds neutral values."""

    lines: Lines
    circles: Circles


@dataclasses.dataclass
class Extraction:
    """What one scan holds; nothing is padded."""

    lines: Lines  # [n]
    circles: Circles  # [m]
    jac_line_pose: np.ndarray  # [n, 2, 3]
    cov_measurement: np.ndarray  # [n, 2, 2]
    line_of_beam: np.ndarray  # [N]
    circle_of_beam: np.ndarray  # [N]
    rejected: dict[str, int]
    status: int
    deciding_margin: float
    """How close the closest decision of this scan was to its threshold, m or rad (for the shape of a circle: a plain
    number): two implementations may differ where this is of the size of their rounding."""


@dataclasses.dataclass
class Report:
    """What one scan did to the map; the fields of `linemap_jax.core.state.Report`, not padded."""

    line_slot: np.ndarray  # [n]
    line_nis: np.ndarray  # [n]
    line_dof: np.ndarray  # [n]
    circle_slot: np.ndarray  # [m]
    circle_nis: np.ndarray  # [m]
    circle_dof: np.ndarray  # [m]
    added: int = 0
    fused: int = 0
    merged: int = 0
    trimmed: int = 0
    split: int = 0
    deleted: int = 0
    status: int = 0
    tie_margin: float = math.inf
    """By how much (NIS) the choice closest to a tie was decided. Without merging, the fragments of a line that wiping
    has split have one NIS but for rounding, so that two implementations may differ where this is of that size."""


class Sweep(NamedTuple):
    """The valid beams of a scan, counter-clockwise, with all that one needs to know about them."""

    beam: np.ndarray  # [n], index in the scan
    r: np.ndarray  # [n]
    bearing: np.ndarray  # [n]
    u: np.ndarray  # [n, 2]
    o: np.ndarray  # [n, 2]
    p: np.ndarray  # [2]
    laser: np.ndarray  # [2]
    cov_pose: np.ndarray  # [3, 3]
    spacing: float
    sr: float  # range_sigma
    sa: float  # bearing_sigma


class Margin:
    """Keeps the smallest distance of a decision from its threshold."""

    def __init__(self) -> None:
        """Start with no decision at all."""
        self.smallest = math.inf

    def below(self, value: float, threshold: float) -> bool:
        """Whether `value < threshold`, noting how clear that is."""
        self.smallest = min(self.smallest, abs(value - threshold))
        return bool(value < threshold)


# ---------------------------------------------------------------------------------------------------------------------
# Small geometry


def wrap(angle: Any) -> Any:
    """The angle in (-pi, pi]; an angle that is there already is returned as it is."""
    return angle - 2 * np.pi * np.ceil((angle - np.pi) / (2 * np.pi))


def perp(v: np.ndarray) -> np.ndarray:
    """The vectors turned by +90 degrees. Shape `[..., 2]`."""
    return np.stack([-v[..., 1], v[..., 0]], -1)


def dot(a: np.ndarray, b: np.ndarray) -> Any:
    """Dot products along the last axis."""
    return (a * b).sum(-1)


def jac_point_pose(o: np.ndarray) -> np.ndarray:
    """F of Eq. (4), d(point) / d(x, y, theta), from the point relative to the robot. Shape `[..., 2, 3]`."""
    eye = np.broadcast_to(np.eye(2), (*o.shape[:-1], 2, 2))
    return np.concatenate([eye, perp(o)[..., None]], -1)


def jac_point_measurement(r: np.ndarray, u: np.ndarray) -> np.ndarray:
    """G of Eq. (4), d(point) / d(range, bearing). Shape `[..., 2, 2]`."""
    return np.stack([u, r[..., None] * perp(u)], -1)


def lever_matrix(lever: Any) -> np.ndarray:
    """S = d(offset, angle) / d(offset, angle) from one anchor to another. Shape `[..., 2, 2]`."""
    lever = np.asarray(lever, float)
    s = np.zeros((*lever.shape, 2, 2))
    s[..., 0, 0] = s[..., 1, 1] = 1.0
    s[..., 0, 1] = lever
    return s


def sandwich(a: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """`a cov a^T`."""
    return a @ cov @ np.swapaxes(a, -1, -2)


def symmetric(a: np.ndarray) -> np.ndarray:
    """The symmetric part: what rounding leaves beside it would grow from fusion to fusion."""
    return 0.5 * (a + np.swapaxes(a, -1, -2))


def squared(a: np.ndarray) -> np.ndarray:
    """`a a^T`."""
    return a @ np.swapaxes(a, -1, -2)


def lower_root(a: np.ndarray) -> np.ndarray:
    """The lower triangular root of a positive semidefinite matrix; a pivot of zero gives a column of zeros."""
    rest, root = np.array(a, float), np.zeros(a.shape)
    for j in range(len(a)):
        if rest[j, j] > 0:
            root[j:, j] = rest[j:, j] / math.sqrt(rest[j, j])
            rest -= np.outer(root[:, j], root[:, j])
    return root


def distance_to_segments(point: np.ndarray, lines: Lines) -> np.ndarray:
    """Distances of one point from segments, m. Shape `[K]`."""
    s = np.clip(dot(point - lines.anchor, lines.tangent), lines.extent[:, 0], lines.extent[:, 1])
    return np.hypot(*(point - lines.point_at(s)).T)


def seen_from(lines: Any, anchor: np.ndarray, keep: np.ndarray) -> Lines:
    """The lines of the package at `keep`, relative to other anchors, in float64. `anchor` has the shape `[K, 2]`."""
    fields = {field.name: np.asarray(getattr(lines, field.name))[keep] for field in dataclasses.fields(Lines)}
    here = Lines(**{name: x.astype(float) if x.dtype.kind == "f" else x for name, x in fields.items()})
    step = here.anchor - anchor
    along = dot(here.tangent, step)
    s = lever_matrix(along)
    return dataclasses.replace(
        here,
        anchor=anchor,
        offset=here.offset + dot(here.normal, step),
        cov_independent=sandwich(s, here.cov_independent),
        sqrt_persistent=s @ here.sqrt_persistent,
        extent=here.extent + along[:, None],
    )


def differences(mine: Any, theirs: Lines, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far lines of the package are from those of the oracle, at the oracle's anchors.

    Args:
      mine: lines of the package.
      theirs: lines of the oracle. Length `K`.
      keep: which of the package's these are.

    Returns:
      The larger difference of offset (m) and angle (rad), shape `[K]`; and the differences of both parts of the
      covariance, relative to the whole of it (Frobenius), shape `[2, K]`.
    """
    moved = seen_from(mine, theirs.anchor, keep)
    turn = np.abs(wrap(moved.angle - theirs.angle))
    estimate = np.maximum(np.abs(moved.offset - theirs.offset), turn)
    independent = moved.cov_independent - theirs.cov_independent
    persistent = squared(moved.sqrt_persistent) - squared(theirs.sqrt_persistent)
    scale = np.linalg.norm(theirs.cov, axis=(1, 2))
    return estimate, np.stack([np.linalg.norm(part, axis=(1, 2)) / scale for part in (independent, persistent)])


def without_counterpart(lines: Lines, others: Lines, *, within: float = 0.05, share: float = 0.5) -> np.ndarray:
    """Which valid lines of one map the other map does not hold. Shape `[K]`, of the valid lines alone.

    A line has a counterpart if there is one line of the other map that runs along at least this share of it, nowhere
    farther away than `within` (m).
    """
    mine, theirs = lines.take(np.flatnonzero(lines.valid)), others.take(np.flatnonzero(others.valid))
    alone = np.ones(len(mine.offset), bool)
    for i in range(len(alone)):
        ends = np.stack([theirs.begin, theirs.end], 1) - mine.anchor[i]
        s, d = ends @ mine.tangent[i], ends @ mine.normal[i] - mine.offset[i]
        # The stretch of mine beside each of theirs, and how far away theirs is at both of its ends.
        stretch = np.clip(s, *mine.extent[i])
        length = np.abs(stretch[:, 1] - stretch[:, 0])
        run = s[:, 1] - s[:, 0]
        slope = (d[:, 1] - d[:, 0]) / np.where(run == 0, 1.0, run)
        away = np.abs(d[:, :1] + slope[:, None] * (stretch - s[:, :1])).max(-1)
        alone[i] = not ((length >= share * (mine.extent[i, 1] - mine.extent[i, 0])) & (away <= within)).any()
    return alone


def _numbers(settings: Any) -> Any:
    """The fields of a settings object as plain floats, which are many times faster than arrays of one number."""
    return SimpleNamespace(**{f.name: float(getattr(settings, f.name)) for f in dataclasses.fields(settings)})


# ---------------------------------------------------------------------------------------------------------------------
# Extraction: points and runs


def sweep_of(
    ranges: np.ndarray,
    bearings: np.ndarray,
    valid: np.ndarray,
    spacing: float,
    pose_mean: np.ndarray,
    pose_cov: np.ndarray,
    *,
    noise: Any,
    mount: Any,
) -> Sweep:
    """The points of a scan, Eqs. (2)-(3), counter-clockwise. The pose must be finite."""
    noise, mount = _numbers(noise), _numbers(mount)
    pose_mean, pose_cov = np.asarray(pose_mean, float), np.asarray(pose_cov, float)
    beam = np.flatnonzero(np.asarray(valid, bool))
    neighbours = beam[1:][np.diff(beam) == 1]
    steps = wrap(np.asarray(bearings, float)[neighbours] - np.asarray(bearings, float)[neighbours - 1])
    if np.sum(steps < 0) > np.sum(steps > 0):
        beam = beam[::-1]  # counter-clockwise, however the scanner turns
    r, bearing = np.asarray(ranges, float)[beam], np.asarray(bearings, float)[beam]
    theta = pose_mean[2]
    c, s = math.cos(theta), math.sin(theta)
    laser = np.array([c * mount.x - s * mount.y, s * mount.x + c * mount.y])
    phi = theta + mount.theta + bearing
    u = np.stack([np.cos(phi), np.sin(phi)], -1)
    return Sweep(
        beam=beam,
        r=r,
        bearing=bearing,
        u=u,
        o=laser + r[:, None] * u,
        p=pose_mean[:2],
        laser=laser,
        cov_pose=pose_cov,
        spacing=float(spacing),
        sr=noise.range_sigma,
        sa=noise.bearing_sigma,
    )


def _gap_gate(arc: float, thresholds: Any, sr: float) -> float:
    """Criterion 1: the largest distance of successive points, m, by the arc between their beams."""
    t = thresholds
    return max(t.gap_distance, t.gap_spacings * arc, t.gap_sigmas * math.sqrt(2) * sr)


def compact(of_beam: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """The slots of the core as they are numbered here, where no free one stands between others."""
    return np.append(np.cumsum(valid) - 1, -1)[of_beam]


def segment(sweep: Sweep, *, thresholds: Any, rules: Any, margin: Margin) -> tuple[list[list[int]], dict[str, int]]:
    """Cut the sweep into runs of points that may be lines, s4.3.1.

    Args:
      sweep: the valid beams.
      thresholds: the criteria.
      rules: `give_back_point` is obeyed.
      margin: notes how clear the decisions were.

    Returns:
      The runs, each a list of positions in the sweep, and how many of them each criterion has ended.
    """
    t = _numbers(thresholds)
    breaks = {"gap": 0, "distance": 0, "bearing": 0}
    runs: list[list[int]] = []
    if not len(sweep.r):
        return runs, breaks
    r, bearing = sweep.r.tolist(), sweep.bearing.tolist()
    xs, ys, us = sweep.o[:, 0].tolist(), sweep.o[:, 1].tolist(), sweep.u.tolist()
    var_range, var_bearing = sweep.sr**2, sweep.sa**2

    run = [0]
    x0, y0 = xs[0], ys[0]
    rx = ry = rxx = ryy = rxy = 0.0
    for i in range(1, len(r)):
        x, y = xs[i] - x0, ys[i] - y0
        broken_by = None

        da = abs(bearing[i] - bearing[i - 1])
        gap = math.hypot(xs[i] - xs[i - 1], ys[i] - ys[i - 1])
        if not margin.below(gap, _gap_gate(min(r[i], r[i - 1]) * da, t, sweep.sr)):
            broken_by = "gap"
        elif not margin.below(da, t.gap_beams * sweep.spacing):
            broken_by = "bearing"
        elif len(run) >= 3:
            n = len(run)
            n1, n2, tt = n * rxx - rx * rx, n * ryy - ry * ry, n * rxy - rx * ry
            # Which regression it is decides, too: the spread along x and along y, in metres.
            margin.below(math.sqrt(max(n1, 0.0)) / n, math.sqrt(max(n2, 0.0)) / n)
            if n1 >= n2:
                width, nu, p = n1, (-tt, n1), n * x - rx
                e = (n * y - ry) * n1 - tt * p
            else:
                width, nu, p = n2, (n2, -tt), n * y - ry
                e = (n * x - rx) * n2 - tt * p
            if width > 0:
                d2 = width * width + tt * tt
                cos2 = (us[i][0] * nu[0] + us[i][1] * nu[1]) ** 2 / d2
                spread2 = (var_range * cos2 + r[i] ** 2 * var_bearing * (1 - cos2)) * (1 + 1 / n + p * p / (n * width))
                reach = max(t.line_distance, t.line_sigmas * math.sqrt(spread2))
                if not margin.below(abs(e) / (n * math.sqrt(d2)), reach):
                    broken_by = "distance"
            else:
                broken_by = "distance"

        if broken_by is None:
            run.append(i)
        else:
            breaks[broken_by] += 1
            if broken_by == "distance" and rules.give_back_point:
                start = [run.pop(), i]
            else:
                start = [i]
            runs.append(run)
            run = start
            x0, y0 = xs[run[0]], ys[run[0]]
            rx = ry = rxx = ryy = rxy = 0.0
            x, y = xs[i] - x0, ys[i] - y0
        rx, ry = rx + x, ry + y
        rxx, ryy, rxy = rxx + x * x, ryy + y * y, rxy + x * y
    runs.append(run)
    return runs, breaks


# ---------------------------------------------------------------------------------------------------------------------
# Extraction: lines


class Regression(NamedTuple):
    """A line through points: y = slope x + ..., or x = slope y + ... if `steep`; `sign` turns it to the last point."""

    steep: bool
    slope: float
    sign: float
    centroid: np.ndarray  # [2]

    @property
    def angle(self) -> float:
        """Direction of the normal, rad."""
        along = (self.slope, 1.0) if self.steep else (1.0, self.slope)
        return float(wrap(math.atan2(self.sign * along[1], self.sign * along[0]) - math.pi / 2))


def regression(points: np.ndarray, towards: np.ndarray | None = None) -> Regression:
    """Eqs. (5)-(8), with sums relative to the first point. The points have shape `[n, 2]`.

    The line runs `towards` a direction, from the first to the last point unless given.
    """
    n = len(points)
    x, y = (points - points[0]).T
    rx, ry, rxx, ryy, rxy = x.sum(), y.sum(), (x * x).sum(), (y * y).sum(), (x * y).sum()
    n1, n2, tt = n * rxx - rx**2, n * ryy - ry**2, n * rxy - rx * ry
    steep = n1 < n2
    width = n2 if steep else n1
    slope = tt / width if width > 0 else 0.0
    direction = (slope, 1.0) if steep else (1.0, slope)
    sign = 1.0 if direction @ (points[-1] - points[0] if towards is None else towards) >= 0 else -1.0
    return Regression(bool(steep), float(slope), sign, points[0] + np.array([rx, ry]) / n)


def line_from_points(points: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """(offset, angle) of the regression line, which `jac_line_points` is the Jacobian of.

    The offset is that from `anchor`, which is in the frame of the points.
    """
    line = regression(points)
    normal = np.array([math.cos(line.angle), math.sin(line.angle)])
    return np.array([normal @ (line.centroid - anchor), line.angle])


def jac_line_points(points: np.ndarray, anchor: np.ndarray, towards: np.ndarray | None = None) -> np.ndarray:
    """J, d(offset, angle) / d(point) for each point at a fixed anchor; Eqs. (11)-(17) without their misprints.

    With x, y relative to the anchor, w = sqrt(1 + slope^2), and a bar for a mean, the line is

      y = m x + q, tangent sign (1, m) / w, normal sign (m, -1) / w: offset = -sign q / w, angle = atan(m) + const;
      x = s y + t, tangent sign (s, 1) / w, normal sign (1, -s) / w: offset = sign t / w, angle = -atan(s) + const.

    The paper prints only the first case, and for rho >= 0.

    Args:
      points: the points of the run. Shape `[n, 2]`.
      anchor: a point in the same frame. Shape `[2]`.
      towards: as for `regression`.

    Returns:
      The Jacobians. Shape `[n, 2, 2]`.
    """
    line = regression(points, towards)
    n, k, sign = len(points), line.slope, line.sign
    w = math.sqrt(1 + k * k)
    x_bar, y_bar = line.centroid - anchor
    x, y = (points - line.centroid).T
    slope_by, const_by = np.zeros((n, 2)), np.zeros((n, 2))  # d(m or s), d(q or t) by (x_i, y_i)
    if not line.steep:
        width = (x * x).sum()
        slope_by[:, 0] = (y - 2 * k * x) / width
        slope_by[:, 1] = x / width
        # q = y_bar - m x_bar
        const = y_bar - k * x_bar
        const_by[:, 0] = -k / n - x_bar * slope_by[:, 0]
        const_by[:, 1] = 1 / n - x_bar * slope_by[:, 1]
        h = np.array([[sign * const * k / w**3, -sign / w], [1 / w**2, 0.0]])
    else:
        width = (y * y).sum()
        slope_by[:, 0] = y / width
        slope_by[:, 1] = (x - 2 * k * y) / width
        # t = x_bar - s y_bar
        const = x_bar - k * y_bar
        const_by[:, 0] = 1 / n - y_bar * slope_by[:, 0]
        const_by[:, 1] = -k / n - y_bar * slope_by[:, 1]
        h = np.array([[-sign * const * k / w**3, sign / w], [-1 / w**2, 0.0]])
    return h @ np.stack([slope_by, const_by], 1)


def length_of_run(points: np.ndarray) -> float:
    """From the foot of the first point to that of the last one on their line, m. The points have shape `[n, 2]`."""
    angle = regression(points).angle
    return float(np.array([-math.sin(angle), math.cos(angle)]) @ (points[-1] - points[0]))


def bends(sweep: Sweep, run: list[int], thresholds: Any, margin: Margin) -> bool:
    """Whether a run bulges towards the scanner as a pole does: surely, and no flatter than twice the largest one.

    Args:
      sweep: the valid beams.
      run: positions in the sweep.
      thresholds: `cluster_distance`.
      margin: notes how clear the decisions were.
    """
    line = regression(sweep.o[run])
    normal = np.array([math.cos(line.angle), math.sin(line.angle)])
    if normal @ (line.centroid - sweep.laser) < 0:
        normal = -normal
    from_middle = sweep.o[run] - line.centroid
    along, depth = from_middle @ np.array([-normal[1], normal[0]]), from_middle @ normal
    # What is left of the parabola when a straight line has been taken out of it
    design = np.stack([np.ones_like(along), along], -1)
    parabola = along**2 - design @ np.linalg.lstsq(design, along**2, rcond=None)[0]
    spread = float(parabola @ parabola)
    curvature, halfway = 2 * float(parabola @ depth), run[(len(run) - 1) // 2]
    cos2 = float(sweep.u[halfway] @ normal) ** 2
    variance = sweep.sr**2 * cos2 + (sweep.r[halfway] * sweep.sa) ** 2 * (1 - cos2)
    surely = margin.below(2 * UNSURE_SIGMAS * math.sqrt(variance * spread), curvature)
    return surely and margin.below(spread, 2 * float(thresholds.cluster_distance) * curvature)


def without_corners(sweep: Sweep, runs: list[list[int]], arcs: list[list[int]], margin: Margin) -> list[list[int]]:
    """The points of each run that no line beside it can claim.

    At an end of a run, points may be the next line's that still passed criterion 2. They are left out up to the first
    one that is surely none, unless that leaves less than a third of the run, or fewer than three.

    Args:
      sweep: the valid beams.
      runs: those that are lines, in their order, each a list of positions in the sweep.
      arcs: those of them that are none after all.
      margin: notes how clear the decisions were.
    """
    lines = [regression(sweep.o[run]) for run in runs]
    result = []
    for k, run in enumerate(runs):
        begin, end = 0, len(run)
        for side in (-1, 1):
            if not 0 <= k + side < len(runs) or runs[k + side] in arcs:
                continue
            beside = lines[k + side]
            normal = np.array([math.cos(beside.angle), math.sin(beside.angle)])
            cos2 = (sweep.u[run] @ normal) ** 2
            sigma = np.sqrt(sweep.sr**2 * cos2 + (sweep.r[run] * sweep.sa) ** 2 * (1 - cos2))
            across = np.abs((sweep.o[run] - beside.centroid) @ normal)
            own = [i for i in range(len(run)) if margin.below(UNSURE_SIGMAS * float(sigma[i]), float(across[i]))]
            beyond = (own[0] if side < 0 else len(run) - 1 - own[-1]) if own else len(run)
            if _are_enough(len(run) - beyond, run):
                begin, end = (beyond, end) if side < 0 else (begin, len(run) - beyond)
        result.append(run[begin:end])
    return result


def without_sparse(
    sweep: Sweep, runs: list[list[int]], kept: list[list[int]], thresholds: Any, margin: Margin
) -> list[list[int]]:
    """The points of each run that are surely near enough to their neighbours for criterion 1.

    Args:
      sweep: the valid beams.
      runs: those that are lines, each a list of positions in the sweep.
      kept: of each run the points that have not been left out before.
      thresholds: of criterion 1.
      margin: notes how clear the decisions were.
    """
    result = []
    for run, mine in zip(runs, kept, strict=True):
        angle = regression(sweep.o[run]).angle
        normal = np.array([math.cos(angle), math.sin(angle)])
        dense = []
        for i in mine:
            incidence = math.acos(min(max(abs(float(normal @ sweep.u[i])), 0.01), 1.0))
            arc = float(sweep.r[i] * sweep.spacing)
            noise = math.hypot(sweep.sr, sweep.r[i] * sweep.sa * math.tan(incidence))
            farthest = arc / math.cos(incidence) + UNSURE_SIGMAS * math.sqrt(2) * noise
            if margin.below(farthest, _gap_gate(arc, thresholds, sweep.sr)):
                dense.append(i)
        result.append(dense)
    return result


def without_strange_ends(
    sweep: Sweep, runs: list[list[int]], kept: list[list[int]], thresholds: Any, margin: Margin
) -> list[list[int]]:
    """The points of each run without a first or last one that criterion 2 would turn away from the line of the others.

    Args:
      sweep: the valid beams.
      runs: those that are lines, each a list of positions in the sweep.
      kept: of each run the points that have not been left out before.
      thresholds: of criterion 2.
      margin: notes how clear the decisions were.
    """
    result = []
    for run, mine in zip(runs, kept, strict=True):
        line = regression(sweep.o[run])
        u, w = sweep.o[run].T[::-1] if line.steep else sweep.o[run].T
        normal = np.array([math.cos(line.angle), math.sin(line.angle)])
        strange = []
        for end in (0, len(run) - 1):
            others = np.delete(np.arange(len(run)), end)
            spread = u[others] - u[others].mean()
            slope = (spread @ w[others]) / (spread @ spread)
            lever = u[end] - u[others].mean()
            distance = abs(w[end] - w[others].mean() - slope * lever) / math.hypot(1, line.slope)
            cos2 = float(normal @ sweep.u[run[end]]) ** 2
            variance = sweep.sr**2 * cos2 + (sweep.r[run[end]] * sweep.sa) ** 2 * (1 - cos2)
            variance *= 1 + 1 / len(others) + lever**2 / (spread @ spread)
            gate = max(float(thresholds.line_distance), float(thresholds.line_sigmas) * math.sqrt(variance))
            if margin.below(gate, float(distance)):
                strange.append(run[end])
        result.append([i for i in mine if i not in strange])
    return result


def without_near_ends(
    sweep: Sweep, runs: list[list[int]], kept: list[list[int]], thresholds: Any, margin: Margin
) -> list[list[int]]:
    """The points of each run without its first and last one, and without others near them as long as enough are left.

    Args:
      sweep: the valid beams.
      runs: those that are lines, each a list of positions in the sweep.
      kept: of each run the points that have not been left out before.
      thresholds: of criterion 2.
      margin: notes how clear the decisions were.
    """
    result = []
    for run, mine in zip(runs, kept, strict=True):
        spare = 1
        while _are_enough(len(run) - 2 * (spare + 1), run):
            spare += 1
        left_out = {run[0], run[-1]}
        for i in {*run[:spare], *run[-spare:]} - left_out:
            gate = float(thresholds.line_sigmas) * math.hypot(sweep.sr, sweep.r[i] * sweep.sa)
            gate = 1.5 * max(float(thresholds.line_distance), gate)
            if any(margin.below(math.dist(sweep.o[i], sweep.o[end]), gate) for end in (run[0], run[-1])):
                left_out.add(i)
        result.append([i for i in mine if i not in left_out])
    return result


def _are_enough(count: int, run: list[int]) -> bool:
    """Whether so many of the points of a run make a line."""
    return count >= 3 and 3 * count >= len(run)


def likeliest_line(
    points: np.ndarray,
    u: np.ndarray,
    r: np.ndarray,
    anchor: np.ndarray,
    line: tuple[float, float],
    *,
    laser: np.ndarray,
    sr: float,
    sa: float,
) -> tuple[tuple[float, float], np.ndarray]:
    """One Gauss-Newton step towards the most likely line: noise lies along the beams, and a little across them.

    Args:
      points: the points. Shape `[n, 2]`.
      u: directions of their beams. Shape `[n, 2]`.
      r: ranges, m. Shape `[n]`.
      anchor: in the frame of the points. Shape `[2]`.
      line: offset and angle, to start from.
      laser: the scanner in the same frame. Shape `[2]`.
      sr: sigma of a range, m.
      sa: sigma of a bearing, rad.

    Returns:
      Offset and angle, and their Jacobians by the points, shape `[n, 2, 2]`.
    """
    offset, angle = line
    normal = np.array([math.cos(angle), math.sin(angle)])
    tangent = np.array([-normal[1], normal[0]])
    information, vector, weighted = np.zeros((2, 2)), np.zeros(2), []
    for point, beam, reach in zip(points, u, r, strict=True):
        cos = float(normal @ beam)
        # Where the beam meets the line, not where its noise has put the point.
        rho = (offset + normal @ (anchor - laser)) / cos if abs(cos) > SHALLOW else reach
        s = tangent @ (laser + rho * beam - anchor)
        cos2 = max(cos**2, SHALLOW**2)
        row = np.array([1.0, -s])
        weighted.append(row / (sr**2 * cos2 + (rho * sa) ** 2 * (1 - cos2)))
        information += np.outer(weighted[-1], row)
        vector += weighted[-1] * (normal @ (point - anchor) - offset)
    change = np.linalg.solve(information, vector)
    gain = np.linalg.solve(information, np.array(weighted).T).T
    return (offset + change[0], float(wrap(angle + change[1]))), gain[:, :, None] * normal


def _line_of_run(
    sweep: Sweep, run: list[int], kept: list[int], *, covariance: str, rules: Any, margin: Margin
) -> dict[str, Any]:
    """The fields of one line from its points: estimate, end points, covariance; s4.2.3-4.2.5.

    The ends are those of the run if they lie on the line, and the rest comes from the points that are kept.
    """
    first, last = sweep.o[run[0]], sweep.o[run[-1]]
    o, r, u = sweep.o[kept], sweep.r[kept], sweep.u[kept]
    fit = regression(o, last - first)
    anchor = sweep.p + fit.centroid
    # What the rounded anchor misses of the centroid goes into the offset.
    here = anchor - sweep.p
    angle = fit.angle
    offset = float(np.array([math.cos(angle), math.sin(angle)]) @ (fit.centroid - here))
    if rules.maximum_likelihood:
        sensor = {"laser": sweep.laser, "sr": sweep.sr, "sa": sweep.sa}
        (offset, angle), j = likeliest_line(o, u, r, here, (offset, angle), **sensor)
    else:
        j = jac_line_points(o, here, last - first)
    normal = np.array([math.cos(angle), math.sin(angle)])
    tangent = np.array([-normal[1], normal[0]])
    ends = []
    for inward, of_fit in ((run, kept[0]), (run[::-1], kept[-1])):
        # The outermost that lies on the line, of those which are farther out than what was fitted.
        for k in inward[: min(4, inward.index(of_fit))]:
            cos2 = float(normal @ sweep.u[k]) ** 2
            sigma = math.sqrt(sweep.sr**2 * cos2 + (sweep.r[k] * sweep.sa) ** 2 * (1 - cos2))
            beside = abs(float(normal @ (sweep.o[k] - here)) - offset)
            if not margin.below(UNSURE_SIGMAS * sigma, beside):
                ends.append(k)
                break
        else:
            ends.append(of_fit)
    extent = np.array([tangent @ (sweep.o[k] - here) for k in ends])

    f, g = jac_point_pose(o), jac_point_measurement(r, u)
    c_s = np.diag([sweep.sr**2, sweep.sa**2])
    if covariance == "printed":
        # Departure that the paper makes, not we: Eq. (12) sums the pose error as if each point had its own.
        cov_points = sandwich(f, sweep.cov_pose) + sandwich(g, c_s)
        cov_measurement = symmetric(sandwich(j, cov_points).sum(0))
        jac_line_pose = np.zeros((2, 3))
    else:
        cov_measurement = symmetric(sandwich(j, sandwich(g, c_s)).sum(0))
        jac_line_pose = (j @ f).sum(0)

    var_extent = np.zeros(2)
    for side, k in enumerate(ends):
        cov = sandwich(jac_point_pose(sweep.o[k]), sweep.cov_pose)
        cov = cov + sandwich(jac_point_measurement(sweep.r[k], sweep.u[k]), c_s)
        beam_on_line = sweep.spacing * sweep.r[k] / max(abs(normal @ sweep.u[k]), GRAZING)
        var_extent[side] = tangent @ cov @ tangent + beam_on_line**2 / 12
    return {
        "anchor": anchor,
        "offset": offset,
        "angle": angle,
        "cov_independent": cov_measurement,
        "sqrt_persistent": jac_line_pose @ lower_root(sweep.cov_pose),
        "first_angle": angle,
        "extent": extent,
        "var_extent": var_extent,
        "cov_measurement": cov_measurement,
        "jac_line_pose": jac_line_pose,
    }


# ---------------------------------------------------------------------------------------------------------------------
# Extraction: circles


def clusters_of(sweep: Sweep, in_line: np.ndarray, *, thresholds: Any, margin: Margin) -> list[list[int]]:
    """Groups of consecutive points near their mean, of points that are in no line; s4.3.1 (circles)."""
    reach = float(thresholds.cluster_distance)
    clusters: list[list[int]] = []
    cluster: list[int] = []
    x0 = y0 = sx = sy = 0.0
    for i, (x, y) in enumerate(sweep.o.tolist()):
        if in_line[i]:
            if cluster:
                clusters.append(cluster)
            cluster = []
            continue
        if cluster:
            n = len(cluster)
            if margin.below(math.hypot(x - x0 - sx / n, y - y0 - sy / n), reach):
                cluster.append(i)
                sx, sy = sx + x - x0, sy + y - y0
                continue
            clusters.append(cluster)
        cluster = [i]
        x0, y0, sx, sy = x, y, 0.0, 0.0
    if cluster:
        clusters.append(cluster)
    return clusters


class CircleFit(NamedTuple):
    """A circle fitted to points, and how well it fits."""

    center: np.ndarray  # [2], relative to the centroid
    radius: float
    cov: np.ndarray  # [3, 3], of the sensor's noise
    chi2: float


def fit_circle(
    z: np.ndarray, u: np.ndarray, laser: np.ndarray, *, sr: float, sa: float, margin: Margin
) -> CircleFit | None:
    """The most likely circle of points about their centroid: Kasa's start, then Gauss-Newton on the likelihood.

    Not in the paper, whose Eqs. (18)-(20) describe the visible arc.

    Args:
      z: points relative to their centroid. Shape `[n, 2]`.
      u: directions of their beams. Shape `[n, 2]`.
      laser: relative to the centroid. Shape `[2]`.
      sr: sigma of a range, m.
      sa: sigma of a bearing, rad.
      margin: notes how clear the decisions were.

    Returns:
      The fit, or None where there is none.
    """
    if len(z) < FEWEST_CIRCLE_POINTS:
        return None
    x, y = z.T
    w = x * x + y * y
    sxx, sxy, syy = (x * x).sum(), (x * y).sum(), (y * y).sum()
    bx, by = (x * w).sum() / 2, (y * w).sum() / 2
    det = sxx * syy - sxy**2
    if sxx + syy == 0 or not margin.below(FLAT, det / (sxx + syy) ** 2):
        return None
    c = np.array([bx * syy - by * sxy, by * sxx - bx * sxy]) / det
    state = np.array([*c, math.sqrt(w.mean() + c @ c)])
    # A step may run away; then it is not taken, and there is no need for a warning.
    with np.errstate(all="ignore"):
        try:
            for _ in range(GAUSS_NEWTON_STEPS):
                information, gradient, _ = _circle_likelihood(z, u, laser, state, sr=sr, sa=sa)
                improved = state + np.linalg.solve(information, gradient)
                if np.isfinite(improved).all() and improved[2] > 0:
                    state = improved
            information, _, chi2 = _circle_likelihood(z, u, laser, state, sr=sr, sa=sa)
            cov = symmetric(np.linalg.inv(information))
        except np.linalg.LinAlgError:
            return None
    if not (np.isfinite(state).all() and np.isfinite(cov).all() and math.isfinite(chi2)):
        return None
    if not (np.diag(cov) > 0).all():
        return None
    return CircleFit(state[:2], float(state[2]), cov, chi2)


def _circle_likelihood(
    z: np.ndarray, u: np.ndarray, laser: np.ndarray, state: np.ndarray, *, sr: float, sa: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Information, gradient and misfit of the points, beam by beam; each beam is known to have met the pole."""
    c, radius = state[:2], float(state[2])
    information, gradient, chi2 = np.zeros((3, 3)), np.zeros(3), 0.0
    for point, beam in zip(z, u, strict=True):
        across = np.array([-beam[1], beam[0]])
        ahead, aside = float(beam @ (c - laser)), float(-across @ (c - laser))
        sway = abs(ahead) * sa
        # Mean and variance of a normal sway that has not carried the beam over the rim
        t = max((radius - abs(aside)) / sway, -4.0) if sway > 0 else 9.0
        hazard = math.exp(-t * t / 2) / math.sqrt(2 * math.pi) / (math.erfc(-t / math.sqrt(2)) / 2)
        inward, spread = sway * hazard, 1 - hazard * (t + hazard)
        sine = min(max((abs(aside) - inward) / radius, 0.0), 1.0)
        cos2 = max(1 - sine**2, min(2 * RIM * (sr + sway) / radius, 1.0))
        cos, sine = math.sqrt(cos2), math.sqrt(1 - cos2)
        normal = -cos * beam + math.copysign(sine, aside) * across
        var_sway = ((ahead - radius * cos) * sa) ** 2
        mean = sine * inward + ((1 - cos2) * sr**2 - (2 - cos2) * var_sway) / (2 * radius)
        weight = 1 / (cos2 * sr**2 + (1 - cos2) * spread * var_sway)
        row = np.array([*normal, 1.0]) * (1 - sine * (1 - spread))
        residual = float(np.hypot(*(point - c))) - radius - mean
        information += weight * np.outer(row, row)
        gradient += weight * residual * row
        chi2 += weight * residual**2
    return information, gradient, chi2


def _circle_of_cluster(
    sweep: Sweep, cluster: list[int], *, thresholds: Any, rules: Any, margin: Margin
) -> dict[str, Any]:
    """The fields of one circle from its points: a fitted pole if that is believable, else Eqs. (18)-(20)."""
    o, r, u = sweep.o[cluster], sweep.r[cluster], sweep.u[cluster]
    n = len(cluster)
    centroid = o[0] + (o - o[0]).mean(0)
    z = o - centroid
    radius = math.sqrt((z**2).sum() / (n - 1))
    plain = {
        "center": sweep.p + centroid,
        "radius": radius,
        "cov_independent": _cov_of_arc(z, radius, jac_point_measurement(r, u), sr=sweep.sr, sa=sweep.sa),
        "sqrt_persistent": _jac_circle_pose(centroid) @ lower_root(sweep.cov_pose),
        "fitted": False,
    }
    if not rules.fit_circles:
        return plain
    fit = fit_circle(z, u, sweep.laser - centroid, sr=sweep.sr, sa=sweep.sa, margin=margin)
    if fit is None:
        return plain
    sight = (centroid - sweep.laser) / np.hypot(*(centroid - sweep.laser))
    good = (
        not margin.below(fit.radius + 3 * math.sqrt(fit.cov[2, 2]), 5 * sweep.sr)
        and margin.below(fit.radius - 3 * math.sqrt(fit.cov[2, 2]), float(thresholds.cluster_distance))
        and margin.below(0.0, sight @ fit.center)
        and not margin.below(n - 3 + 3 * math.sqrt(2 * (n - 3)), fit.chi2)
        and margin.below(math.sqrt(fit.cov[2, 2]), fit.radius / 3)
    )
    if not good:
        return plain
    center = centroid + fit.center
    return {
        "center": sweep.p + center,
        "radius": fit.radius,
        "cov_independent": fit.cov,
        "sqrt_persistent": _jac_circle_pose(center) @ lower_root(sweep.cov_pose),
        "fitted": True,
    }


def _cov_of_arc(z: np.ndarray, radius: float, g: np.ndarray, *, sr: float, sa: float) -> np.ndarray:
    """Covariance of Eqs. (18)-(20) from the sensor's noise, and the square of what noise adds to the radius."""
    n, c_s = len(z), np.diag([sr**2, sa**2])
    cov, of_points = np.zeros((3, 3)), 0.0
    for point, g_i in zip(z, g, strict=True):
        of_point = g_i @ c_s @ g_i.T
        by_radius = point / ((n - 1) * radius) if radius > 0 else np.zeros(2)
        j = np.vstack([np.eye(2) / n, by_radius])
        cov += j @ of_point @ j.T
        of_points += np.trace(of_point) / n
    if radius > 0:
        cov[2, 2] += (max(of_points - cov[2, 2], 0.0) / (2 * radius)) ** 2
    return symmetric(cov)


def _jac_circle_pose(center: np.ndarray) -> np.ndarray:
    """d(x, y, radius) / d(pose) of a circle, relative to the robot."""
    q = np.zeros((3, 3))
    q[:2] = jac_point_pose(center)
    return q


# ---------------------------------------------------------------------------------------------------------------------
# Extraction: the whole


def extract(
    ranges: np.ndarray,
    bearings: np.ndarray,
    valid: np.ndarray,
    spacing: float,
    pose_mean: np.ndarray,
    pose_cov: np.ndarray,
    *,
    thresholds: Any,
    noise: Any,
    mount: Any,
    rules: Any,
    covariance: Literal["exact", "printed"],
    capacity: Any,
) -> Extraction:
    """The lines and circles of one scan, in the frame of the world.

    Args:
      ranges: ranges in metres, in the order of the sweep. Shape `[N]`.
      bearings: bearings in radians, relative to the scanner. Shape `[N]`.
      valid: which beams are returns. Shape `[N]`.
      spacing: angle between neighbouring beams, rad.
      pose_mean: pose of the robot in the world: x, y in m, theta in rad. Shape `[3]`.
      pose_cov: its covariance. Shape `[3, 3]`.
      thresholds: a `settings.Thresholds`.
      noise: a `settings.SensorNoise`.
      mount: a `settings.Mount`.
      rules: a `settings.Rules`.
      covariance: `exact`, or Eq. (12) as `printed`.
      capacity: a `settings.Capacity`: how many lines and circles are kept.

    Returns:
      The extraction.
    """
    total = len(ranges)
    status = Status.OK
    if not (np.isfinite(pose_mean).all() and np.isfinite(pose_cov).all()):
        status |= Status.POSE_NOT_FINITE
        valid, pose_mean, pose_cov = np.zeros(total, bool), np.zeros(3), np.eye(3)
    sweep = sweep_of(ranges, bearings, valid, spacing, pose_mean, pose_cov, noise=noise, mount=mount)
    margin = Margin()
    runs, breaks = segment(sweep, thresholds=thresholds, rules=rules, margin=margin)
    rejected = {"invalid": total - len(sweep.beam), **breaks, "too_few": 0, "too_short": 0, "lone": 0, "near_line": 0}

    line_of_beam, circle_of_beam = np.full(total, -1), np.full(total, -1)
    in_line = np.zeros(len(sweep.beam), bool)
    of_lines: list[list[int]] = []
    for run in runs:
        if len(run) < 3:
            rejected["too_few"] += len(run)
        elif not margin.below(float(thresholds.min_length), length_of_run(sweep.o[run])):
            rejected["too_short"] += len(run)
        elif len(of_lines) == capacity.lines:
            status |= Status.SCAN_LINES_FULL
        else:
            in_line[run] = True
            of_lines.append(run)
    arcs = [run for run in of_lines if rules.leave_out_arcs and bends(sweep, run, thresholds, margin)]
    for run in arcs:
        in_line[run] = False
    kept_points = without_corners(sweep, of_lines, arcs, margin) if rules.leave_out_corners else of_lines
    if rules.leave_out_sparse:
        kept_points = without_sparse(sweep, of_lines, kept_points, thresholds, margin)
    if rules.check_ends:
        kept_points = without_strange_ends(sweep, of_lines, kept_points, thresholds, margin)
    if rules.leave_out_ends:
        kept_points = without_near_ends(sweep, of_lines, kept_points, thresholds, margin)
    found = []
    for run, points in zip(of_lines, kept_points, strict=True):
        if run in arcs:
            continue
        if not _are_enough(len(points), run):
            rejected["too_few"] += len(run)
            continue
        line = _line_of_run(sweep, run, points, covariance=covariance, rules=rules, margin=margin)
        if margin.below(float(np.diff(line["extent"])[0]), float(thresholds.min_length)):
            rejected["too_short"] += len(run)
            continue
        line_of_beam[sweep.beam[run]] = len(found)
        found.append(line)
    lines = Lines(
        anchor=_stack(found, "anchor", (2,)),
        offset=_stack(found, "offset", ()),
        angle=_stack(found, "angle", ()),
        cov_independent=_stack(found, "cov_independent", (2, 2)),
        sqrt_persistent=_stack(found, "sqrt_persistent", (2, 3)),
        first_angle=_stack(found, "first_angle", ()),
        extent=_stack(found, "extent", (2,)),
        var_extent=_stack(found, "var_extent", (2,)),
        times_detected=np.ones(len(found), int),
        times_contradicted=np.zeros(len(found), int),
        valid=np.ones(len(found), bool),
    )

    kept: list[dict[str, Any]] = []
    for cluster in clusters_of(sweep, in_line, thresholds=thresholds, margin=margin):
        if len(cluster) == 1:
            rejected["lone"] += 1
            continue
        circle = _circle_of_cluster(sweep, cluster, thresholds=thresholds, rules=rules, margin=margin)
        nearest = distance_to_segments(circle["center"], lines).min(initial=math.inf)
        rim = circle["radius"] if circle["fitted"] else 0.0
        if margin.below(nearest, float(thresholds.circle_line_distance) + rim):
            rejected["near_line"] += len(cluster)
            continue
        if len(kept) == capacity.circles:
            status |= Status.SCAN_CIRCLES_FULL
            continue
        circle_of_beam[sweep.beam[cluster]] = len(kept)
        kept.append(circle)
    circles = Circles(
        center=_stack(kept, "center", (2,)),
        radius=_stack(kept, "radius", ()),
        cov_independent=_stack(kept, "cov_independent", (3, 3)),
        sqrt_persistent=_stack(kept, "sqrt_persistent", (3, 3)),
        fitted=_stack(kept, "fitted", ()).astype(bool),
        times_detected=np.ones(len(kept), int),
        times_contradicted=np.zeros(len(kept), int),
        valid=np.ones(len(kept), bool),
    )
    return Extraction(
        lines=lines,
        circles=circles,
        jac_line_pose=_stack(found, "jac_line_pose", (2, 3)),
        cov_measurement=_stack(found, "cov_measurement", (2, 2)),
        line_of_beam=line_of_beam,
        circle_of_beam=circle_of_beam,
        rejected=rejected,
        status=int(status),
        deciding_margin=margin.smallest,
    )


def _stack(items: list[dict[str, Any]], key: str, shape: tuple[int, ...]) -> np.ndarray:
    """One field of all items; of the right shape where there are none."""
    return np.array([item[key] for item in items], float).reshape(len(items), *shape)


# ---------------------------------------------------------------------------------------------------------------------
# The map and its slots


def empty_map(capacity: Any) -> OracleMap:
    """A map with as many free slots as `capacity` (a `settings.Capacity`) says."""
    k, c = capacity.lines, capacity.circles
    return OracleMap(
        lines=Lines(
            anchor=np.zeros((k, 2)),
            offset=np.zeros(k),
            angle=np.zeros(k),
            cov_independent=np.tile(np.eye(2), (k, 1, 1)),
            sqrt_persistent=np.zeros((k, 2, 3)),
            first_angle=np.zeros(k),
            extent=np.zeros((k, 2)),
            var_extent=np.ones((k, 2)),
            times_detected=np.zeros(k, int),
            times_contradicted=np.zeros(k, int),
            valid=np.zeros(k, bool),
        ),
        circles=Circles(
            center=np.zeros((c, 2)),
            radius=np.zeros(c),
            cov_independent=np.zeros((c, 3, 3)),
            sqrt_persistent=np.zeros((c, 3, 3)),
            fitted=np.zeros(c, bool),
            times_detected=np.zeros(c, int),
            times_contradicted=np.zeros(c, int),
            valid=np.zeros(c, bool),
        ),
    )


def _copy(slots: Any) -> Any:
    return type(slots)(**{field.name: getattr(slots, field.name).copy() for field in dataclasses.fields(slots)})


def _put(slots: Any, slot: int, **values: Any) -> None:
    """Write some fields of one slot."""
    for name, value in values.items():
        getattr(slots, name)[slot] = value


def _free(slots: Any, slot: int) -> None:
    """Make a slot free, with the neutral values of an empty map."""
    empty = empty_map(SimpleNamespace(lines=1, circles=1))
    neutral = empty.lines if isinstance(slots, Lines) else empty.circles
    _put(slots, slot, **{field.name: getattr(neutral, field.name)[0] for field in dataclasses.fields(slots)})


def _lowest_free(slots: Any) -> int | None:
    free = np.flatnonzero(~slots.valid)
    return int(free[0]) if len(free) else None


# ---------------------------------------------------------------------------------------------------------------------
# Errors in two parts

Slots = TypeVar("Slots", Lines, Circles)


class Error(NamedTuple):
    """What is known of the error of one line or circle."""

    c: np.ndarray  # [n, n], covariance of the independent part
    a: np.ndarray  # [n, 3], square root of the persisting part
    times: int  # how many scans it rests on


def _error_of(slots: Any, i: int) -> Error:
    return Error(slots.cov_independent[i], slots.sqrt_persistent[i], int(slots.times_detected[i]))


def forget(slots: Slots, share: float) -> Slots:
    """The same lines or circles, of whose persisting errors only this share goes on; the rest is independent."""
    rest = (1 - share) * squared(slots.sqrt_persistent)
    return dataclasses.replace(
        slots,
        cov_independent=slots.cov_independent + rest,
        sqrt_persistent=math.sqrt(share) * slots.sqrt_persistent,
    )


def cov_shared(a_new: np.ndarray, a_old: np.ndarray, pose_error: PoseError) -> np.ndarray:
    """What the persisting parts add to the covariance of new minus old.

    If they persist by a known model, both are of one u, and what they have in common cancels.
    """
    if pose_error == "persistent":
        return squared(a_new - a_old)
    return squared(a_new) + squared(a_old)


def combine(old: Error, new: Error, pose_error: PoseError) -> tuple[np.ndarray, Error]:
    """The static Kalman filter of Eq. (23) for errors in two parts.

    "independent" and "persistent": u is a state that both share and that is not estimated (Schmidt); in "persistent"
    what the new estimate says of u is not taken at its word. "unknown": each
    persisting part counts as if it were larger, by the inverse of its weight, which is its number of scans; and the
    covariance of their sum is bounded for every correlation, by (x + y)(x + y)^T <= (1 + b/a) x x^T + (1 + a/b) y y^T.

    Args:
      old: of the estimate so far.
      new: of an estimate of the same numbers.
      pose_error: what is known of the persisting parts.

    Returns:
      The gain of the new estimate, and the error of the result.
    """
    one = np.eye(len(old.c))
    if pose_error == "persistent":
        new = new._replace(c=new.c + JACOBIAN_ERROR**2 * squared(new.a))
    if pose_error != "unknown":
        apart = new.a - old.a
        gain = (old.c - old.a @ apart.T) @ np.linalg.inv(old.c + new.c + squared(apart))
        a = (one - gain) @ old.a + gain @ new.a
    else:
        weight = old.times / (old.times + new.times)
        p_old, p_new = old.c + squared(old.a) / weight, new.c + squared(new.a) / (1 - weight)
        metric = np.linalg.inv(p_old + p_new)
        gain = p_old @ metric
        from_old, from_new = squared((one - gain) @ old.a), squared(gain @ new.a)
        size_old, size_new = (math.sqrt(np.trace(part @ metric)) for part in (from_old, from_new))
        if size_old > 0 and size_new > 0:
            bound = from_old * (1 + size_new / size_old) + from_new * (1 + size_old / size_new)
        else:
            bound = from_old + from_new
        a = np.zeros(old.a.shape)
        a[:, : len(one)] = lower_root(bound)
    c = symmetric(sandwich(one - gain, old.c) + sandwich(gain, new.c))
    return gain, Error(c, a, old.times + new.times)


# ---------------------------------------------------------------------------------------------------------------------
# Matching of lines


class Gates(NamedTuple):
    """New lines against lines of the map, pair by pair."""

    sign: np.ndarray  # [K], -1 where the new line runs the other way
    residual: np.ndarray  # [K, 2], (offset, angle) of the new line minus that of the map, at the new line's anchor
    lever: np.ndarray  # [K], of the new line's anchor
    nis: np.ndarray  # [K], Eq. (21)
    gap: np.ndarray  # [K], m, along the map's line; negative where the two overlap
    covered: np.ndarray  # [K], m, of the map's line
    same_line: np.ndarray  # [K], by the end points
    collinear: np.ndarray  # [K], the same line, were it boundless
    geometric: np.ndarray  # [K]
    statistical: np.ndarray  # [K], Eq. (22)


def gates(new: Lines, old: Lines, *, thresholds: Any, pose_error: PoseError) -> Gates:
    """All gates of s5.1.1, for lines of equal number, or one against many.

    Both lines are compared at the anchor of the new one. All gates ask for the covariance of their difference there.
    """
    t = _numbers(thresholds)
    d = wrap(new.angle - old.angle)
    reverse = np.cos(d) < 0
    sign = np.where(reverse, -1.0, 1.0)
    turn = np.where(reverse, wrap(d + np.pi), d)
    shift = old.anchor - new.anchor
    lever = dot(old.tangent, shift)
    residual = np.stack([sign * new.offset - (old.offset + dot(old.normal, shift)), turn], -1)

    s, flip = lever_matrix(lever), sign_matrix(sign)
    cov = sandwich(flip, new.cov_independent) + sandwich(s, old.cov_independent)
    cov = cov + cov_shared(flip @ new.sqrt_persistent, s @ old.sqrt_persistent, pose_error)
    nis = dot(residual, np.linalg.solve(cov, residual[..., None])[..., 0])

    same_direction = turn**2 < np.maximum(t.match_angle**2, t.match_sigmas**2 * cov[:, 1, 1])

    ends = np.stack([new.begin, new.end], 1)
    distance = dot(ends - old.anchor[:, None], old.normal[:, None]) - old.offset[:, None]
    # With the tangent at +90 degrees a point of the line moves by d offset - u d angle across it.
    u = dot(ends - new.anchor[:, None], old.tangent[:, None])
    var = cov[:, None, 0, 0] - 2 * u * cov[:, None, 0, 1] + u**2 * cov[:, None, 1, 1]
    same_line = (distance**2 < np.maximum(t.match_distance**2, t.match_sigmas**2 * var)).all(-1)

    along = dot(ends - old.anchor[:, None], old.tangent[:, None])
    gap = np.maximum(along.min(-1) - old.extent[:, 1], old.extent[:, 0] - along.max(-1))
    covered = np.minimum(along.max(-1), old.extent[:, 1]) - np.maximum(along.min(-1), old.extent[:, 0])
    collinear = same_direction & same_line & new.valid & old.valid
    return Gates(
        sign=sign,
        residual=residual,
        lever=lever,
        nis=nis,
        gap=gap,
        covered=covered,
        same_line=same_line & new.valid & old.valid,
        collinear=collinear,
        geometric=collinear & (gap < t.match_gap),
        statistical=nis < t.match_nis,
    )


def sign_matrix(sign: Any) -> np.ndarray:
    """What turns (offset, angle) into (sign offset, angle). Shape `[..., 2, 2]`."""
    m = np.zeros((*np.shape(sign), 2, 2))
    m[..., 0, 0], m[..., 1, 1] = sign, 1.0
    return m


def closest(g: Gates, good: np.ndarray, ties: Margin) -> int | None:
    """Which of the good candidates is the best match, the first of equals; None if none is good.

    The one with the least NIS; a metre more of overlap counts as a thousandth, which decides between fragments of a
    line that was cut, whose NIS is the same.
    """
    candidates = np.flatnonzero(good)
    if not len(candidates):
        return None
    score = g.nis + 1e-3 * g.gap
    order = candidates[np.argsort(score[candidates], kind="stable")]
    if len(order) > 1:
        ties.below(float(score[order[0]]), float(score[order[1]]))
    return int(order[0])


class Match(NamedTuple):
    """What the map says of one new line or circle."""

    slot: int  # -1: none
    suspect: int  # what it may be but for the statistical gate, -1: none
    nis: float
    dof: int


NO_MATCH = Match(-1, -1, 0.0, 0)


def match_line(
    new: Lines, lines: Lines, slots: np.ndarray, *, thresholds: Any, rules: Any, pose_error: PoseError, ties: Margin
) -> Match:
    """The line of the map, of those in the given slots, that one new line (of length 1) is."""
    if not len(slots):
        return NO_MATCH
    g = gates(new, lines.take(slots), thresholds=thresholds, pose_error=pose_error)
    best = closest(g, g.geometric & ((g.sign > 0) | (not rules.tell_sides)), ties)
    if best is None:
        return NO_MATCH
    slot = int(slots[best])
    matched = bool(g.statistical[best])
    return Match(slot if matched else -1, -1 if matched else slot, float(g.nis[best]), 2)


def pairs_of(lines: Lines, *, thresholds: Any) -> list[Gates]:
    """Each line of a scan against all of them: one and the same pose error moves them all."""
    n = len(lines.offset)
    return [gates(lines.take(i), lines, thresholds=thresholds, pose_error="persistent") for i in range(n)]


def part(matches: list[Match], pairs: list[Gates]) -> list[Match]:
    """Take from lines of the map what the scan has seen beside them.

    Of the new lines that match a line of the map the one with the least NIS is that line. The others are it only where
    the scan itself, whose pose error is no matter between its lines, does not say that they are another one.
    """
    result = list(matches)
    for slot in {match.slot for match in matches if match.slot >= 0}:
        leader = min((match.nis, k) for k, match in enumerate(matches) if match.slot == slot)[1]
        for i, match in enumerate(matches):
            if slot in (match.slot, match.suspect) and not pairs[i].collinear[leader]:
                result[i] = NO_MATCH
    return result


def group_new(pairs: list[Gates], unmatched: list[int], ties: Margin) -> dict[int, list[int]]:
    """New lines that are no line of the map, with those that continue them: root -> pieces, the root first."""
    groups: dict[int, list[int]] = {}
    for i in unmatched:
        g = pairs[i]
        is_root = np.isin(np.arange(len(pairs)), list(groups))
        best = closest(g, g.geometric & g.statistical & is_root, ties)
        if best is None:
            groups[i] = [i]
        else:
            groups[best].append(i)
    return groups


# ---------------------------------------------------------------------------------------------------------------------
# Fusion of lines


class Viewpoint(NamedTuple):
    """Where a scan was taken."""

    robot: np.ndarray  # m. Shape `[2]`
    cov: np.ndarray  # of the pose. Shape `[3, 3]`


def moved_by_pose(anchor: np.ndarray, angle: float, view: Viewpoint) -> np.ndarray:
    """The square root of what a pose's error does to (offset, angle) of a line that moves with the robot, `[2, 3]`."""
    normal, tangent = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    return np.array([[*normal, tangent @ (view.robot - anchor)], [0, 0, 1]]) @ lower_root(view.cov)


def observe(
    target: Lines, pieces: Lines, *, share: float, thresholds: Any, view: Viewpoint | None = None
) -> tuple[np.ndarray, Error]:
    """What pieces that one scan has seen of a line say of it together: least squares at the anchor of the target.

    The scan moves all of its pieces by one pose error, which is no noise between them.

    Args:
      target: the line (of length 1) where the equations are linearised.
      pieces: what was seen of it, with all of the pose error in the persisting part.
      share: how much of that may persist.
      thresholds: for the gates, which yield the residuals.
      view: if given, what the pose's error does is reckoned for the direction that the target had at first.

    Returns:
      What to add to (offset, angle) of the target, and the error of that.
    """
    g = gates(pieces, target, thresholds=thresholds, pose_error="persistent")
    information, of_pose, vector = np.zeros((2, 2)), np.zeros((2, 3)), np.zeros(2)
    for i in range(len(pieces.offset)):
        s, flip = lever_matrix(g.lever[i]), sign_matrix(g.sign[i])
        weight = s.T @ np.linalg.inv(sandwich(flip, pieces.cov_independent[i]))
        information += weight @ s
        a = flip @ pieces.sqrt_persistent[i]
        if view is not None and a.any():
            a = moved_by_pose(pieces.anchor[i], target.first_angle[0], view)
        of_pose += weight @ a
        vector += weight @ g.residual[i]
    c = np.linalg.inv(information)
    a = c @ of_pose
    kept = Error(symmetric(c + (1 - share) * squared(a)), math.sqrt(share) * a, int(pieces.times_detected.max()))
    return c @ vector, kept


def seen_extent(anchor: np.ndarray, angle: float, pieces: Lines) -> tuple[np.ndarray, np.ndarray]:
    """The outermost end points of the pieces along a tangent, and their variances. Shapes `[2]`, `[2]`."""
    tangent = np.array([-math.sin(angle), math.cos(angle)])
    s = (np.concatenate([pieces.begin, pieces.end]) - anchor) @ tangent
    var = np.concatenate([pieces.var_extent[:, 0], pieces.var_extent[:, 1]])
    lo, hi = int(np.argmin(s)), int(np.argmax(s))
    return s[[lo, hi]], var[[lo, hi]]


def fuse_extent(
    extent: np.ndarray, var: np.ndarray, seen: np.ndarray, var_seen: np.ndarray, *, estimate: bool, sigmas: float
) -> tuple[np.ndarray, np.ndarray]:
    """The end points after matching, s5.1.2.

    Args:
      extent: begin and end so far, m. Shape `[2]`.
      var: their variances. Shape `[2]`.
      seen: begin and end that were seen. Shape `[2]`.
      var_seen: their variances. Shape `[2]`.
      estimate: average ends that agree; otherwise the line can only become longer, as in the paper.
      sigmas: how far ends may lie apart to agree.

    Returns:
      The new extent and its variances.
    """
    extent, var = extent.copy(), var.copy()
    for side, outward in ((0, -1.0), (1, 1.0)):
        x, v_x, e, v_e = seen[side], var_seen[side], extent[side], var[side]
        beyond = outward * (x - e)
        band = sigmas * math.sqrt(v_x + v_e) if estimate else 0.0
        if beyond > band:
            extent[side], var[side] = x, v_x
        elif estimate and beyond >= -band:
            extent[side], var[side] = (e * v_x + x * v_e) / (v_x + v_e), v_x * v_e / (v_x + v_e)
    return extent, var


def _write(lines: Lines, slot: int, delta: np.ndarray, error: Error) -> None:
    """Move a line by (offset, angle), and note its error."""
    _put(lines, slot, offset=lines.offset[slot] + delta[0], angle=wrap(lines.angle[slot] + delta[1]))
    _put(lines, slot, cov_independent=error.c, sqrt_persistent=error.a, times_detected=error.times)


def _fuse_into(
    lines: Lines,
    slot: int,
    pieces: Lines,
    *,
    thresholds: Any,
    pose_error: PoseError,
    share: float,
    estimate_ends: bool,
    view: Viewpoint | None = None,
) -> None:
    """Improve the line in a slot by what was seen of it."""
    view = view if pose_error == "persistent" else None
    delta, seen = observe(lines.take(slot), pieces, share=share, thresholds=thresholds, view=view)
    gain, error = combine(_error_of(lines, slot), seen, pose_error)
    _write(lines, slot, gain @ delta, error)
    outermost, var_outermost = seen_extent(lines.anchor[slot], lines.angle[slot], pieces)
    extent, var_extent = fuse_extent(
        lines.extent[slot],
        lines.var_extent[slot],
        outermost,
        var_outermost,
        estimate=estimate_ends,
        sigmas=float(thresholds.end_sigmas),
    )
    _put(lines, slot, extent=extent, var_extent=var_extent)


def _add(lines: Lines, slot: int, pieces: Lines, *, share: float, thresholds: Any, view: Viewpoint | None) -> None:
    """Put a new line into a free slot; the first of its pieces is the root."""
    root = pieces.take(0)
    delta, error = observe(root, pieces, share=share, thresholds=thresholds, view=view)
    _put(lines, slot, anchor=root.anchor[0], offset=root.offset[0], angle=root.angle[0], valid=True)
    _put(lines, slot, first_angle=root.first_angle[0])
    _write(lines, slot, delta, error)
    extent, var_extent = seen_extent(root.anchor[0], lines.angle[slot], pieces)
    _put(lines, slot, extent=extent, var_extent=var_extent)


# ---------------------------------------------------------------------------------------------------------------------
# Merging


def _merge(
    lines: Lines,
    targets: np.ndarray,
    pairs: list[Gates],
    *,
    thresholds: Any,
    rules: Any,
    pose_error: PoseError,
    ties: Margin,
) -> dict[int, int]:
    """Join lines of the map that this scan has shown to be one.

    Args:
      lines: lines of the map.
      targets: for each new line the slot of the line that it is part of, -1 for none. Shape `[n]`.
      pairs: the new lines against each other: what the scan has seen side by side is not joined.
      thresholds: the gates.
      rules: whether lines have sides.
      pose_error: what is known of the persisting parts.
      ties: notes how clear the choices were.

    Returns:
      The freed slots and where each went.
    """
    candidates: list[tuple[float, int, int, int]] = []  # NIS, new line, lower slot, higher slot
    for i, g in enumerate(targets):
        if g < 0 or g in targets[:i]:
            continue
        beside = {int(k) for k, collinear in zip(targets, pairs[i].collinear, strict=True) if not collinear}
        others = np.array([k for k in np.flatnonzero(lines.valid).tolist() if k != g and k not in beside], int)
        if not len(others):
            continue
        against = gates(lines.take(int(g)), lines.take(others), thresholds=thresholds, pose_error=pose_error)
        faces = (against.sign > 0) | (not rules.tell_sides)
        best = closest(against, against.geometric & (against.gap < 0) & faces, ties)
        if best is not None and against.statistical[best]:
            other = int(others[best])
            candidates.append((float(against.nis[best]), i, min(int(g), other), max(int(g), other)))

    freed: dict[int, int] = {}
    for candidate in candidates:
        _, _, low, high = candidate
        # Equal pairs, found from both sides, differ in the new line: tuples compare by NIS, then by that.
        if all(candidate[:2] <= c[:2] for c in candidates if {low, high} & set(c[2:])):
            freed[high] = low
    for high, low in freed.items():
        times = max(lines.times_detected[low], lines.times_detected[high])
        options = {"thresholds": thresholds, "pose_error": pose_error}
        _fuse_into(lines, low, lines.take(high), **options, share=1.0, estimate_ends=False)
        _put(lines, low, times_detected=times)
        _free(lines, high)
    return freed


# ---------------------------------------------------------------------------------------------------------------------
# Giving way


def _contradicted(found: Lines, before: Lines, *, thresholds: Any, rules: Any, pose_error: PoseError) -> set[int]:
    """Slots of lines whose middle a line of the scan passes nearest that covers half of them, but fails Eq. (22)."""
    denied = set()
    for slot in np.flatnonzero(before.valid).tolist():
        line = before.take(slot)
        middle = (line.begin + line.end) / 2 - found.anchor
        along, across = dot(middle, found.tangent), np.abs(dot(middle, found.normal) - found.offset)
        passes = (found.extent[:, 0] < along) & (along < found.extent[:, 1])
        faces = (dot(found.normal, line.normal) > 0) | (not rules.tell_sides)
        if not (passes & faces).any():
            continue
        nearest = int(np.argmin(np.where(passes & faces, across, np.inf)))
        g = gates(found.take(nearest), line, thresholds=thresholds, pose_error=pose_error)
        if g.same_line[0] and not g.statistical[0] and 2 * g.covered[0] > line.length[0]:
            denied.add(slot)
    return denied


def _balance(slots: Any, size: np.ndarray, borne_out: set[int], denied: set[int]) -> float:
    """What a scan bears out less what it denies, each by its size and by how often it was seen."""
    weight = size * slots.times_detected
    return float(weight[sorted(borne_out)].sum() - weight[sorted(denied - borne_out)].sum())


def _give_way(slots: Any, against: set[int], borne_out: set[int], thresholds: Any) -> set[int]:
    """Free what was contradicted too often, as Page's cumulated sum has it; which went."""
    gone = set()
    for slot in borne_out:
        slots.times_contradicted[slot] = max(slots.times_contradicted[slot] - 1, 0)
    for slot in against - borne_out:
        slots.times_contradicted[slot] += 1
        times = slots.times_contradicted[slot]
        if times > slots.times_detected[slot] or times >= float(thresholds.contradictions):
            _free(slots, slot)
            gone.add(slot)
    return gone


# ---------------------------------------------------------------------------------------------------------------------
# Wiping


Cuts = dict[int, list[tuple[float, float]]]
"""For slots of lines: the intervals along the tangent that are to go."""


def beam_cuts(
    lines: Lines, sweep: Sweep, found: Extraction, own: np.ndarray, targets: np.ndarray, *, thresholds: Any, rules: Any
) -> Cuts:
    """What the beams of a scan have passed through, in place of the wipe triangle of s6.2.

    Args:
      lines: lines of the map.
      sweep: the valid beams.
      found: what was extracted from them.
      own: for each new line the slot of the line that it was taken for, -1 for none. Shape `[n]`.
      targets: for each new line the slot of the line that it is part of, -1 for none. Shape `[n]`.
      thresholds: the margins.
      rules: whether lines have sides.

    Returns:
      The cuts.
    """
    t = _numbers(thresholds)
    slots = np.flatnonzero(lines.valid)
    if not len(slots) or len(sweep.r) < 2:
        return {}
    old = lines.take(slots)
    label = found.line_of_beam[sweep.beam]
    slot_of_beam = np.where(label >= 0, np.append(own, -1)[label], -1)

    # Where each beam would meet each line. A beam along a line meets it nowhere.
    apex = sweep.p + sweep.laser
    across = old.normal @ sweep.u.T  # [J, n]
    crossing = np.abs(across) >= PARALLEL
    far = np.where(
        crossing, (old.offset - dot(old.normal, apex - old.anchor))[:, None] / np.where(crossing, across, 1), -1.0
    )
    s = dot(old.tangent, apex - old.anchor)[:, None] + far * (old.tangent @ sweep.u.T)
    meets = (far > 0) & (old.extent[:, :1] < s) & (s < old.extent[:, 1:]) & (slot_of_beam != slots[:, None])

    # The rest only for the pairs that do meet, of which there are few.
    j, i = np.nonzero(meets)
    den, r_line, along = across[j, i], far[j, i], s[j, i]
    normal, tangent, u, cov = old.normal[j], old.tangent[j], sweep.u[i], old.cov[j]
    row = (normal[:, None] @ jac_point_pose(sweep.laser + r_line[:, None] * u))[:, 0]
    var_line = cov[:, 0, 0] - 2 * along * cov[:, 0, 1] + along**2 * cov[:, 1, 1]
    var = var_line + dot(row @ sweep.cov_pose, row) + r_line**2 * sweep.sa**2 * dot(tangent, u) ** 2
    margin = np.maximum(t.wipe_sigmas * np.sqrt(sweep.sr**2 + var / den**2), t.match_distance / np.abs(den))
    # A beam that ended on an extracted line reaches a little behind that line, to what was seen no more often.
    times = np.where(targets >= 0, lines.times_detected[targets], 0)
    dares = np.append(times, 0)[label[i]] >= old.times_detected[j]
    dares &= (den > 0) | (not rules.tell_sides)
    height = np.abs(dot(found.lines.normal, apex - found.lines.anchor) - found.lines.offset)
    stretch = np.where(height < EDGE_ON, 0.0, 1 + t.wipe_extension / np.maximum(height, EDGE_ON))
    through, reached = np.zeros(meets.shape, bool), np.zeros(meets.shape, bool)
    through[j, i] = r_line < sweep.r[i] - margin
    reached[j, i] = through[j, i] | (dares & (r_line < sweep.r[i] * np.append(stretch, 0.0)[label[i]]))

    neighbours = np.abs(np.diff(sweep.bearing)) < t.gap_beams * sweep.spacing
    # Between two beams that met different lines nothing is known to be behind either.
    neighbours = neighbours & (through[:, :-1] | through[:, 1:] | (slot_of_beam[:-1] == slot_of_beam[1:]))
    cuts: Cuts = {}
    for j, i in np.argwhere(reached[:, :-1] & reached[:, 1:] & neighbours):
        a, b = sorted((float(s[j, i]), float(s[j, i + 1])))
        cuts.setdefault(int(slots[j]), []).append((a, b))
    return cuts


def wipe_triangle(line: Lines, apex: np.ndarray, *, thresholds: Any) -> np.ndarray | None:
    """The triangle of s6.2 over one line (of length 1), counter-clockwise; None if it is seen edge on. `[3, 2]`."""
    height = abs(float(dot(line.normal[0], apex - line.anchor[0]) - line.offset[0]))
    if height < EDGE_ON:
        return None
    stretch = 1 + float(thresholds.wipe_extension) / height
    a, b = (apex + stretch * (end[0] - apex) for end in (line.begin, line.end))
    return np.stack([apex, a, b] if perp(a - apex) @ (b - apex) > 0 else [apex, b, a])


def triangle_cuts(lines: Lines, triangle: np.ndarray, spare: int) -> Cuts:
    """The part of each line that lies inside the open triangle, but for the line in the slot `spare`."""
    slots = np.flatnonzero(lines.valid)
    slots = slots[slots != spare]
    old = lines.take(slots)
    foot, tangent = old.point_at(np.zeros(len(slots))), old.tangent
    lo, hi = old.extent.T.copy()
    for k in range(3):
        # Inside of an edge: at + rate * s > 0, along the line.
        inward = perp(triangle[(k + 1) % 3] - triangle[k])
        at, rate = (foot - triangle[k]) @ inward, tangent @ inward
        bound = -at / np.where(rate == 0, 1.0, rate)
        lo = np.where(rate > 0, np.maximum(lo, bound), lo)
        hi = np.where(rate < 0, np.minimum(hi, bound), hi)
        hi = np.where((rate == 0) & (at <= 0), lo, hi)
    return {int(slots[j]): [(float(lo[j]), float(hi[j]))] for j in np.flatnonzero(hi > lo)}


def remaining(extent: np.ndarray, cuts: list[tuple[float, float]], shortest: float) -> list[tuple[float, float]]:
    """The pieces of an interval that the cuts leave and that are not too short, in ascending order."""
    pieces = []
    start = float(extent[0])
    for a, b in sorted(cuts):
        pieces.append((start, a))
        start = max(start, b)
    pieces.append((start, float(extent[1])))
    return [(a, b) for a, b in pieces if b > a and b - a >= shortest]


def _cut(lines: Lines, cuts: Cuts, sweep: Sweep, report: Report, *, thresholds: Any, rules: Any) -> list[int]:
    """Delete, trim and split lines, s6.3. Returns the slots of the deleted ones."""
    deleted = []
    for slot in sorted(cuts):
        old = lines.take(slot)
        pieces = remaining(old.extent[0], cuts[slot], float(thresholds.min_length))
        _free(lines, slot)
        if not pieces:
            report.deleted += 1
            deleted.append(slot)
        elif len(pieces) == 1:
            report.trimmed += 1
        else:
            report.split += 1
        for k, (a, b) in enumerate(pieces):
            free = slot if k == 0 else _lowest_free(lines)
            if free is None:
                report.status |= Status.MAP_LINES_FULL
                break
            # Merged again, the pieces must not know more than the line did: each has its part of the information.
            weight = (b - a) / sum(q - p for p, q in pieces) if rules.merge else 1.0
            var_ends = [
                var_of_cut(old, end, sweep) if end != old.extent[0, side] else old.var_extent[0, side]
                for side, end in enumerate((a, b))
            ]
            _put(lines, free, **_piece(old, a, b, np.array(var_ends), weight))
    return deleted


def var_of_cut(line: Lines, along: float, sweep: Sweep) -> float:
    """How well a beam tells where along a line (of length 1) it crossed it, and one beam more, evenly spread."""
    place = line.point_at(np.array([along]))[0] - sweep.p
    beam = place - sweep.laser
    distance = float(np.linalg.norm(beam))
    on_line = distance / max(abs(float(line.normal[0] @ beam)) / max(distance, EDGE_ON), GRAZING)
    row = line.tangent[0] @ jac_point_pose(place)
    return float(row @ sweep.cov_pose @ row + on_line**2 * (sweep.sa**2 + sweep.spacing**2 / 12))


def _piece(line: Lines, a: float, b: float, var_ends: np.ndarray, weight: float) -> dict[str, Any]:
    """The part of a line (of length 1) from `a` to `b` along it, anchored in its middle."""
    anchor = line.point_at(np.array([(a + b) / 2]))[0]
    normal, tangent = line.normal[0], line.tangent[0]
    shift = line.anchor[0] - anchor
    return {
        "anchor": anchor,
        "offset": line.offset[0] + normal @ shift,
        "angle": line.angle[0],
        "cov_independent": symmetric(sandwich(lever_matrix(tangent @ shift), line.cov_independent[0])) / weight,
        "sqrt_persistent": lever_matrix(tangent @ shift) @ line.sqrt_persistent[0],
        "first_angle": line.first_angle[0],
        "extent": np.array([a, b]) + tangent @ shift,
        "var_extent": var_ends,
        "times_detected": line.times_detected[0],
        "times_contradicted": line.times_contradicted[0],
        "valid": True,
    }


# ---------------------------------------------------------------------------------------------------------------------
# Circles of the map


def _circle_state(circles: Circles, i: int) -> np.ndarray:
    """(x, y, radius) of one circle."""
    return np.array([*circles.center[i], circles.radius[i]])


def match_circle(
    circles: Circles, found: Circles, i: int, *, thresholds: Any, rules: Any, pose_error: PoseError
) -> tuple[Match, float]:
    """The circle of the map that new circle `i` is, s5.2.1, and how far apart their centres are.

    `suspect` is the nearest circle where the distance would do, but the covariances forbid it.
    """
    t = _numbers(thresholds)
    distance = np.where(circles.valid, np.hypot(*(found.center[i] - circles.center).T), math.inf)
    j = int(np.argmin(distance))
    if not distance[j] < t.circle_match_distance:
        return Match(-1, -1, 0.0, 0), math.inf
    if not (found.fitted[i] and circles.fitted[j]):
        return Match(j, -1, 0.0, 0), float(distance[j])
    d = _circle_state(found, i) - _circle_state(circles, j)
    cov = found.cov_independent[i] + circles.cov_independent[j]
    cov += cov_shared(found.sqrt_persistent[i], circles.sqrt_persistent[j], pose_error)
    nis = float(d @ np.linalg.solve(cov, d))
    if rules.weigh_circles and not nis < t.circle_match_nis:
        return Match(-1, j, nis, 3), math.inf
    return Match(j, -1, nis, 3), float(distance[j])


def _wiped_by_beams(
    circles: Circles, slot: int, sweep: Sweep, found: Lines, measured: np.ndarray, *, thresholds: Any
) -> bool:
    """Whether beams have passed through the place of a circle, and none has ended at it or before it.

    Wherever it may stand, a beam must have met it: it is pushed from one end of its window to the other. A beam that
    has ended on a line of the map has passed what stood between the scanner and that line.

    Args:
      circles: of the map.
      slot: the circle.
      sweep: the valid beams.
      found: the lines of the scan.
      measured: which of them each beam measures, -1 for none, or for one that is not in the map. Shape `[n]`.
      thresholds: the margins.
    """
    sigmas = float(thresholds.wipe_sigmas)
    radius = circles.radius[slot]
    o = circles.center[slot] - sweep.p
    c = o - sweep.laser
    rc = math.hypot(*c)
    along, across = sweep.u @ c, sweep.u[:, 0] * c[1] - sweep.u[:, 1] * c[0]
    if rc == 0.0:
        return False
    u = c / rc
    cov = sandwich(jac_point_pose(o), sweep.cov_pose)
    width = radius + sigmas * math.sqrt(perp(u) @ cov @ perp(u) + rc**2 * sweep.sa**2)
    depth = radius + sigmas * math.sqrt(sweep.sr**2 + u @ cov @ u)
    evidence = (np.abs(across) < width) & (along > 0)
    passed = sweep.r > along + depth
    ahead = dot(found.normal, found.anchor - sweep.p - sweep.laser) + found.offset
    for k in set(measured.tolist()) - {-1}:
        before = math.copysign(1, ahead[k]) * ((sweep.o - o) @ found.normal[k])
        passed |= (measured == k) & (before > depth - radius)
    if evidence.sum() < 2 or not passed[evidence].all():
        return False
    # What a beam is off by itself: nearer to the rim than that it may have passed.
    sure = radius - sigmas * rc * sweep.sa
    seen, shift = np.sort(across[evidence]), width - radius
    left = np.concatenate([[-np.inf], seen, [np.inf]])  # the free room between neighbouring beams
    room = (left[:-1] + sure, left[1:] - sure)  # for centres
    return not bool(np.any((room[0] < room[1]) & (room[0] < shift) & (room[1] > -shift)))


def _inside(point: np.ndarray, triangle: np.ndarray) -> bool:
    return all(perp(triangle[(k + 1) % 3] - triangle[k]) @ (point - triangle[k]) > 0 for k in range(3))


def _fuse_circle(
    circles: Circles, slot: int, found: Circles, members: list[int], *, rules: Any, pose_error: PoseError
) -> None:
    """Improve a circle by the new ones that are it; `members` are in order of distance. Eqs. (24)-(25) or better."""
    old = _circle_state(circles, slot)
    mean = np.mean([_circle_state(found, i) for i in members], axis=0)
    fitted = [i for i in members if found.fitted[i]]
    state, error, is_fitted = old, _error_of(circles, slot), bool(circles.fitted[slot])
    if not rules.weigh_circles:
        state = (mean + old) / 2
    elif fitted and is_fitted:
        new, seen = _error_of(found, fitted[0]), _circle_state(found, fitted[0])
        gain, error = combine(error, _at_radius(new, seen[2], old[2]), pose_error)
        state = old + gain @ (seen - old)
        error = _at_radius(error, old[2], state[2])
    elif fitted:
        state, error, is_fitted = _circle_state(found, fitted[0]), _error_of(found, fitted[0]), True
    elif not is_fitted:
        state = old + (mean - old) / (circles.times_detected[slot] + 1)
    _put(circles, slot, center=state[:2], radius=state[2], fitted=is_fitted)
    _put(circles, slot, cov_independent=error.c, sqrt_persistent=error.a)
    circles.times_detected[slot] += 1


def _at_radius(error: Error, radius: float, other: float) -> Error:
    """The error of a fitted circle if its radius were another one: the variance of the curvature stays as it is."""
    c = error.c
    if not (radius > 0 and other > 0 and c[2, 2] > 0):
        return error
    return error._replace(c=c + ((other / radius) ** 4 - 1) * np.outer(c[:, 2], c[2]) / c[2, 2])


def _update_circles(
    new_map: OracleMap,
    found: Extraction,
    sweep: Sweep,
    targets: np.ndarray,
    measured: np.ndarray,
    triangles: list[np.ndarray],
    balance: float,
    report: Report,
    *,
    thresholds: Any,
    rules: Any,
    pose_error: PoseError,
    share: float,
) -> None:
    """The circles of the scan into the map, after its lines; `balance` as `_balance` has it of these."""
    lines, circles, new = new_map.lines, new_map.circles, forget(found.circles, share)
    reach = float(thresholds.circle_line_distance)

    members: dict[int, list[tuple[float, int]]] = {}
    added = []
    against, suspected = set(), []
    for i in range(len(new.radius)):
        match, distance = match_circle(circles, new, i, thresholds=thresholds, rules=rules, pose_error=pose_error)
        report.circle_nis[i], report.circle_dof[i] = match.nis, match.dof
        if match.slot >= 0:
            report.circle_slot[i] = match.slot
            members.setdefault(match.slot, []).append((distance, i))
        elif match.suspect < 0 or not rules.leave_out_ambiguous:
            added.append(i)
        else:
            suspected.append((match.suspect, i))
            step = new.center[i] - circles.center[match.suspect]
            if math.hypot(*step) < new.radius[i] + circles.radius[match.suspect]:
                against.add(match.suspect)

    balance += _balance(circles, 2 * circles.radius, set(members), {slot for slot, _ in suspected})

    # What is about to be fused was seen, and is spared.
    for slot in np.flatnonzero(circles.valid).tolist():
        if slot in members:
            continue
        if rules.wipe_by_beams:
            gone = _wiped_by_beams(circles, slot, sweep, found.lines, measured, thresholds=thresholds)
        else:
            gone = any(_inside(circles.center[slot], triangle) for triangle in triangles)
        if gone:
            _free(circles, slot)
            report.deleted += 1
            against.discard(slot)

    if rules.give_way:
        gone = _give_way(circles, against if balance > 0 else set(), set(members), thresholds)
        added = sorted([*added, *(i for slot, i in suspected if slot in gone)])
        report.deleted += len(gone)
    for slot, assigned in members.items():
        _fuse_circle(circles, slot, new, [i for _, i in sorted(assigned)], rules=rules, pose_error=pose_error)
        report.fused += 1

    on_map = lines.take(np.flatnonzero(lines.valid))
    for i in added:
        if (distance_to_segments(new.center[i], on_map) < reach + new.radius[i] * new.fitted[i]).any():
            continue
        slot = _lowest_free(circles)
        if slot is None:
            report.status |= Status.MAP_CIRCLES_FULL
            continue
        state = {name: getattr(new, name)[i] for name in ("center", "radius", "fitted")}
        # What is visible of a pole moves with the viewpoint: in a map it has no covariance.
        errors = {name: getattr(new, name)[i] * new.fitted[i] for name in ("cov_independent", "sqrt_persistent")}
        _put(circles, slot, times_detected=1, valid=True, **state, **errors)
        report.circle_slot[i] = NEW
        report.added += 1

    seen = lines.take([slot for slot in set(targets.tolist()) if slot >= 0 and lines.valid[slot]])
    for slot in np.flatnonzero(circles.valid).tolist():
        rim = circles.radius[slot] * circles.fitted[slot]
        counts = (seen.times_detected >= circles.times_detected[slot]) | (not rules.weigh_circles)
        if (counts & (distance_to_segments(circles.center[slot], seen) < reach + rim)).any():
            _free(circles, slot)
            report.deleted += 1


# ---------------------------------------------------------------------------------------------------------------------
# The update


def update(
    line_map: OracleMap,
    scan: tuple[np.ndarray, np.ndarray, np.ndarray, float],
    pose_mean: np.ndarray,
    pose_cov: np.ndarray,
    *,
    thresholds: Any,
    noise: Any,
    mount: Any,
    rules: Any,
    covariance: Literal["exact", "printed"],
    scan_capacity: Any,
    pose_error: PoseError = "unknown",
    persistence: Any = None,
    mode: Literal["simultaneous", "sequential"] = "simultaneous",
) -> tuple[OracleMap, Report]:
    """One scan into the map.

    Args:
      line_map: the map so far; it is left as it is.
      scan: ranges, bearings, valid, spacing, as for `extract`.
      pose_mean: pose of the robot in the world. Shape `[3]`.
      pose_cov: its covariance. Shape `[3, 3]`.
      thresholds: a `settings.Thresholds`.
      noise: a `settings.SensorNoise`.
      mount: a `settings.Mount`.
      rules: a `settings.Rules`.
      covariance: `exact`, or Eq. (12) as `printed`.
      scan_capacity: a `settings.Capacity`: how much of one scan is kept.
      pose_error: what is known of how the errors of the poses of several scans hang together.
      persistence: a `settings.Persistence`, for `persistent`.
      mode: `simultaneous`: all lines of the scan are held against the map as it stood. `sequential`, the order of the
        paper: line by line, each against what the one before has left.

    Returns:
      The new map and the report.
    """
    found = extract(
        *scan,
        pose_mean,
        pose_cov,
        thresholds=thresholds,
        noise=noise,
        mount=mount,
        rules=rules,
        covariance=covariance,
        capacity=scan_capacity,
    )
    n, m = len(found.lines.offset), len(found.circles.radius)
    report = Report(
        line_slot=np.full(n, LEFT_OUT),
        line_nis=np.zeros(n),
        line_dof=np.zeros(n, int),
        circle_slot=np.full(m, LEFT_OUT),
        circle_nis=np.zeros(m),
        circle_dof=np.zeros(m, int),
        status=found.status,
    )
    new_map = OracleMap(lines=_copy(line_map.lines), circles=_copy(line_map.circles))
    if found.status & Status.POSE_NOT_FINITE:
        return new_map, report
    sweep = sweep_of(*scan, pose_mean, pose_cov, noise=noise, mount=mount)
    apex = sweep.p + sweep.laser
    share = {"independent": 0.0, "unknown": 1.0}.get(pose_error)
    if share is None:
        share = float(persistence.share)
        if len(sweep.r):
            drifted = float(persistence.correlation) ** 2
            new_map = OracleMap(lines=forget(new_map.lines, drifted), circles=forget(new_map.circles, drifted))
    lines = new_map.lines
    if not rules.share_pose:
        found = dataclasses.replace(found, lines=forget(found.lines, 0.0))
    pairs = pairs_of(found.lines, thresholds=thresholds)

    into = _lines_one_by_one if mode == "sequential" else _lines_at_once
    ties = Margin()
    targets, suspects, triangles, balance = into(
        lines,
        found,
        pairs,
        sweep,
        report,
        thresholds=thresholds,
        rules=rules,
        pose_error=pose_error,
        share=share,
        ties=ties,
    )

    if rules.merge:
        freed = _merge(lines, targets, pairs, thresholds=thresholds, rules=rules, pose_error=pose_error, ties=ties)
        report.merged += len(freed)
        for slots in (targets, suspects, report.line_slot):
            slots[:] = [freed.get(slot, slot) for slot in slots.tolist()]

    own = np.where(targets >= 0, targets, suspects)
    label = found.line_of_beam[sweep.beam]
    measured = np.where(np.append(own, -1)[label] >= 0, label, -1)
    if rules.wipe_by_beams:
        cuts = beam_cuts(lines, sweep, found, own, targets, thresholds=thresholds, rules=rules)
        _cut(lines, cuts, sweep, report, thresholds=thresholds, rules=rules)
    elif mode == "simultaneous":
        cuts = {}
        for slot in sorted({slot for slot in targets.tolist() if slot >= 0}):
            triangle = wipe_triangle(lines.take(slot), apex, thresholds=thresholds)
            if triangle is None:
                continue
            triangles.append(triangle)
            for j, intervals in triangle_cuts(lines, triangle, spare=slot).items():
                cuts.setdefault(j, []).extend(intervals)
        _cut(lines, cuts, sweep, report, thresholds=thresholds, rules=rules)

    _update_circles(
        new_map,
        found,
        sweep,
        targets,
        measured,
        triangles,
        balance,
        report,
        thresholds=thresholds,
        rules=rules,
        pose_error=pose_error,
        share=share,
    )
    report.status = int(report.status)
    report.tie_margin = ties.smallest
    return new_map, report


def _lines_at_once(
    lines: Lines,
    found: Extraction,
    pairs: list[Gates],
    sweep: Sweep,
    report: Report,
    *,
    thresholds: Any,
    rules: Any,
    pose_error: PoseError,
    share: float,
    ties: Margin,
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], float]:
    """Match all new lines against the map as it stood, then fuse and add.

    Returns:
      For each new line the slot that it went into and the slot that it was suspected to be (-1: none), and no
      triangles: they are drawn later; and the balance of the scan.
    """
    n, view = len(found.lines.offset), Viewpoint(sweep.p, sweep.cov_pose)
    new, slots = forget(found.lines, share), np.flatnonzero(lines.valid)
    matching = {"thresholds": thresholds, "rules": rules, "pose_error": pose_error, "ties": ties}
    matches = [match_line(new.take(i), lines, slots, **matching) for i in range(n)]
    if rules.share_pose:
        matches = part(matches, pairs)

    balance = 0.0
    if rules.give_way:
        borne_out = {match.slot for match in matches} - {-1}
        against = _contradicted(new, lines, thresholds=thresholds, rules=rules, pose_error=pose_error)
        suspected = {match.suspect for match in matches} - {-1} if rules.leave_out_ambiguous else set()
        balance = _balance(lines, lines.length, borne_out, against | suspected)
        gone = _give_way(lines, against if balance > 0 else set(), borne_out, thresholds)
        matches = [match._replace(suspect=-1) if match.suspect in gone else match for match in matches]
        report.deleted += len(gone)

    targets, suspects = np.full(n, -1), np.full(n, -1)
    pieces: dict[int, list[int]] = {}
    unmatched = []
    for i, match in enumerate(matches):
        report.line_nis[i], report.line_dof[i] = match.nis, match.dof
        if match.slot >= 0:
            targets[i] = report.line_slot[i] = match.slot
            pieces.setdefault(match.slot, []).append(i)
        elif match.suspect >= 0 and rules.leave_out_ambiguous:
            suspects[i] = match.suspect
        else:
            unmatched.append(i)

    groups = group_new(pairs, unmatched, ties)
    for slot, index in pieces.items():
        options = {"pose_error": pose_error, "share": share, "estimate_ends": rules.estimate_ends, "view": view}
        _fuse_into(lines, slot, found.lines.take(index), thresholds=thresholds, **options)
        report.fused += 1
    for index in groups.values():
        slot = _lowest_free(lines)
        if slot is None:
            report.status |= Status.MAP_LINES_FULL
            continue
        first_view = view if pose_error == "persistent" else None
        _add(lines, slot, found.lines.take(index), share=share, thresholds=thresholds, view=first_view)
        targets[index], report.line_slot[index] = slot, NEW
        report.added += 1
    return targets, suspects, [], balance


def _lines_one_by_one(
    lines: Lines,
    found: Extraction,
    pairs: list[Gates],
    sweep: Sweep,
    report: Report,
    *,
    thresholds: Any,
    rules: Any,
    pose_error: PoseError,
    share: float,
    ties: Margin,
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], float]:
    """The order of the paper: each new line is matched, fused or added, and wipes, before the next one.

    With `share_pose` a line that the scan has seen beside a line before it is not held against what that one went into.
    A line of the map that rests on this scan alone has its pose error: there nothing is unknown.

    Returns:
      For each new line the slot that it went into and the slot that it was suspected to be (-1: none, or that line is
      gone again), the triangles that have wiped, and no balance: nothing gives way.
    """
    n, view = len(found.lines.offset), Viewpoint(sweep.p, sweep.cov_pose)
    new = forget(found.lines, share)
    targets, suspects = np.full(n, -1), np.full(n, -1)
    triangles: list[np.ndarray] = []
    added: set[int] = set()
    known: PoseError = "persistent" if pose_error == "unknown" else pose_error
    for i in range(n):
        beside = {int(k) for k, c in zip(targets, pairs[i].collinear, strict=True) if not c and rules.share_pose}
        slots = [k for k in np.flatnonzero(lines.valid).tolist() if k not in beside]
        of_map, of_scan = (np.array([k for k in slots if (k in added) == fresh], int) for fresh in (False, True))
        matching = {"thresholds": thresholds, "rules": rules, "ties": ties}
        match = match_line(new.take(i), lines, of_map, pose_error=pose_error, **matching)
        other = match_line(new.take(i), lines, of_scan, pose_error=known, **matching)
        if other.dof and (not match.dof or other.nis < match.nis):
            match = other
        report.line_nis[i], report.line_dof[i] = match.nis, match.dof
        if match.slot >= 0:
            error_model = known if match.slot in added else pose_error
            options = {"pose_error": error_model, "share": share, "estimate_ends": rules.estimate_ends, "view": view}
            _fuse_into(lines, match.slot, found.lines.take(i), thresholds=thresholds, **options)
            targets[i] = report.line_slot[i] = match.slot
            report.fused += 1
        elif match.suspect >= 0 and rules.leave_out_ambiguous:
            suspects[i] = match.suspect
            continue
        else:
            slot = _lowest_free(lines)
            if slot is None:
                report.status |= Status.MAP_LINES_FULL
                continue
            _add(lines, slot, found.lines.take(i), share=share, thresholds=thresholds, view=None)
            added.add(slot)
            targets[i], report.line_slot[i] = slot, NEW
            report.added += 1
        if rules.wipe_by_beams:
            continue
        triangle = wipe_triangle(lines.take(targets[i]), sweep.p + sweep.laser, thresholds=thresholds)
        if triangle is None:
            continue
        triangles.append(triangle)
        cuts = triangle_cuts(lines, triangle, spare=int(targets[i]))
        for slot in _cut(lines, cuts, sweep, report, thresholds=thresholds, rules=rules):
            # Its slot may go to another line, which these new lines never were.
            targets[targets == slot] = -1
            suspects[suspects == slot] = -1
            added.discard(slot)
    return targets, suspects, triangles, 0.0
