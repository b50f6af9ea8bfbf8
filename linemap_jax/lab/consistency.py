"""Whether covariances can be believed: the errors of simulated runs, measured by their own covariances.

The NEES (normalised estimation error squared) e^T C^-1 e of an estimate of n numbers whose covariance is right is
chi-square with n degrees of freedom: its mean is n, and 95 % of it lies below the 95 % quantile. The NIS is the same of
an innovation. One line is taken from each run, since the lines of one scan share its pose.

Four experiments, each a function of a key that makes one run; map them over keys:

- `known_points`: the fit alone. The points of a wall are known; nothing is selected.
- `pipeline`: what `extract` makes of a scan.
- `rho_errors`: how accurate its lines are, beside other fits of the same points.
- `fused`: a line of the map after many scans, association known, with pose errors that may persist.
"""

import dataclasses
import enum
import itertools
import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.extract import extract
from linemap_jax.core.fields import documented
from linemap_jax.core.frames import dot, unit, wrap_angle
from linemap_jax.core.fusion import at_first_angle, forget, fuse_lines
from linemap_jax.core.lines import MIN_POINTS, measure_lines
from linemap_jax.core.matching import LineComparison, compare_lines
from linemap_jax.core.propagation import inverse, quadratic
from linemap_jax.core.runs import Runs
from linemap_jax.core.sensor import points_from_scan
from linemap_jax.core.settings import (
    Method,
    Mount,
    Number,
    Persistence,
    PoseError,
    Rules,
    SensorNoise,
    Thresholds,
    persistence_of,
)
from linemap_jax.core.state import Lines, Pose, Scan, empty_lines, pytree
from linemap_jax.lab.generators import room
from linemap_jax.lab.raycast import cast
from linemap_jax.lab.robot import estimate_pose, estimate_poses
from linemap_jax.lab.scanners import Scanner, noise_of, simulate_scan, sweep
from linemap_jax.lab.world import Kind, World, polygon

CHI2_95 = {2: -2 * math.log(0.05), 3: 7.814727903251179}
"""95 % quantile of chi-square, by its degrees of freedom."""
CHI2_MEDIAN = 2 * math.log(2)
"""Median of chi-square with 2 degrees of freedom."""
SEEN_BEAMS = 10
"""Fewest nominal beams on a wall that an experiment may choose."""


@pytree
class Walls:
    """Straight walls, the truth that lines are held against."""

    point: Float[Array, "W 2"]
    """A point on each wall, m."""
    angle: Float[Array, " W"]
    """Direction of its normal, rad."""


def walls_of(world: World) -> Walls:
    """The segments of a `world` as boundless lines."""
    step = world.segments.ends[:, 1] - world.segments.ends[:, 0]
    return Walls(point=world.segments.ends.mean(1), angle=jnp.arctan2(step[:, 1], step[:, 0]) - jnp.pi / 2)


def line_error(lines: Lines, wall: Walls) -> Float[Array, "*s 2"]:
    """The error of (offset, angle) of `lines` that are a `wall`, at their anchors. m, rad.

    A line may lie either way round.
    """
    turn = wrap_angle(lines.angle - wall.angle)
    reverse = jnp.abs(turn) > jnp.pi / 2
    turn = jnp.where(reverse, turn - jnp.sign(turn) * jnp.pi, turn)
    sign = jnp.where(reverse, -1, 1)
    offset = lines.offset - sign * dot(unit(wall.angle), wall.point - lines.anchor)
    return jnp.stack([offset, turn], -1)


def nees(error: Float[Array, "*s n"], cov: Float[Array, "*s n n"]) -> Float[Array, "*s"]:
    """Normalised estimation error squared, e^T C^-1 e, of e = `error` and C = `cov`, for n of 2 or 3."""
    return quadratic(error, inverse(cov))


@documented
class Sample(NamedTuple):
    """What one run has to say."""

    nees: Any
    """Squared error of the estimate in units of its covariance."""
    error: Any
    """The estimate less the truth, in axes of the experiment, shape `[n]`."""
    counts: Any
    """False where nothing was found."""


class Fit(enum.Enum):
    """An estimate of a line with a covariance."""

    DEFAULT = "default"
    """The most likely line, with the exact covariance."""
    REGRESSION = "regression"
    """The paper's regression, with the exact covariance."""
    PRINTED = "printed"
    """The paper's regression, with the covariance of Eq. (12)."""


def known_points(
    key: Array, world: World, pose: Float[Array, "3"], scanner: Scanner, cov_pose: Float[Array, "3 3"]
) -> dict[str, Sample]:
    """The NEES of each `Fit` to the known points of one wall.

    Of the walls that the scanner sees one is chosen by chance. Its points are the beams whose nominal direction meets
    it; they are measured on the boundless wall, so that no noise decides which points take part.

    Args:
      key: of the noise, of the pose's error, and of the choice.
      world: walls.
      pose: the true one.
      scanner: its noise is what the fit believes.
      cov_pose: of the pose's error.

    Returns:
      One sample for each kind of fit.
    """
    of_wall, of_scan, of_pose = jax.random.split(key, 3)
    which, _ = _visible_wall(of_wall, world, pose, scanner)
    wall = jax.tree.map(lambda x: x[which], walls_of(world))
    on_wall = cast(world, pose[:2], unit(pose[2] + scanner.bearings)).thing == which
    scan = _scan_of_wall(of_scan, wall, on_wall, pose, scanner)
    estimate = estimate_pose(of_pose, pose, cov_pose)
    lines = {kind.value: _fit(scan, estimate, noise_of(scanner), kind) for kind in Fit}
    return {name: _sample(line, wall, jnp.asarray(True)) for name, line in lines.items()}


def pipeline(
    key: Array,
    world: World,
    pose: Float[Array, "3"],
    scanner: Scanner,
    cov_pose: Float[Array, "3 3"],
    *,
    thresholds: Thresholds = Thresholds(),
    **method: Unpack[Method],
) -> tuple[Sample, Sample]:
    """The NEES of what `extract` finds: of the longest line of one wall, and of all lines.

    A line belongs to the wall that most of its beams have met.

    Args:
      key: of the noise, of the pose's error, and of the choice of the wall.
      world: walls.
      pose: the true one.
      scanner: its noise is what the extraction believes.
      cov_pose: of the pose's error.
      thresholds: of `extract`.
      **method: of `extract`.

    Returns:
      The sample of the longest line, and those of all lines, `[K]`.
    """
    of_wall, of_scan, of_pose = jax.random.split(key, 3)
    which, seen = _visible_wall(of_wall, world, pose, scanner)
    scan, truth = simulate_scan(of_scan, world, pose, scanner)
    found = extract(
        scan, estimate_pose(of_pose, pose, cov_pose), thresholds=thresholds, noise=noise_of(scanner), **method
    )
    lines, count = found.lines, seen.shape[0]
    beams = (found.line_of_beam[:, None] == jnp.arange(lines.valid.shape[0])[None]).astype(jnp.float32)
    met = (truth.thing[:, None] == jnp.arange(count)[None]).astype(jnp.float32)
    of_line = jnp.argmax(jnp.einsum("nl,nw->lw", beams, met), -1)
    wall = jax.tree.map(lambda x: x[of_line], walls_of(world))
    every = _sample(lines, wall, lines.valid)
    length = jnp.asarray(jnp.where(lines.valid & (of_line == which), lines.length, 0))
    longest = jnp.argmax(length)
    return jax.tree.map(lambda x: x[longest], every)._replace(counts=length[longest] > 0), every


def rho_errors(
    key: Array, world: World, pose: Float[Array, "3"], scanner: Scanner, **method: Unpack[Method]
) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    """Errors of the distance to a wall, by the longest line that `extract` finds of it and by other fits of its points.

    Args:
      key: of the noise and of the choice of the wall.
      world: walls.
      pose: of the robot, known.
      scanner: its noise is what the fits believe.
      **method: of `extract`.

    Returns:
      Errors of rho, m: of the line; of orthogonal regression; and of orthogonal regression with each point weighted by
      its noise across the line (Pfister, Roumeliotis, Burdick: *Weighted line fitting algorithms for mobile robot map
      building*, ICRA 2003), which is what laser_line_extraction does. And whether there was such a line.
    """
    of_wall, of_scan = jax.random.split(key)
    which, _ = _visible_wall(of_wall, world, pose, scanner)
    scan, truth = simulate_scan(of_scan, world, pose, scanner)
    here = Pose(mean=jnp.zeros(3, pose.dtype), cov=jnp.zeros((3, 3), pose.dtype))
    found = extract(scan, here, noise=noise_of(scanner), **method)
    lines = found.lines
    on_wall = jnp.zeros(lines.valid.shape[0] + 1).at[found.line_of_beam].add(truth.thing == which)[:-1]
    line = jnp.argmax(jnp.where(lines.valid, on_wall, -1))
    of_line = found.line_of_beam == line
    beam = unit(scan.bearings)
    point = jnp.where(of_line, scan.ranges, 0)[:, None] * beam

    def regressed(weight: Array) -> tuple[Array, Array]:
        """Normal and rho of the line with the least weighted squares of distances."""
        weight = jnp.where(of_line, weight, 0) / jnp.sum(jnp.where(of_line, weight, 0))
        centre = weight @ point
        off = point - centre[None]
        (xx, xy), (_, yy) = off.T @ (weight[:, None] * off)
        normal = unit(jnp.arctan2(-2 * xy, yy - xx) / 2)
        return normal, dot(normal, centre)

    def reweighted(_: Any, line: tuple[Array, Array]) -> tuple[Array, Array]:
        along = jnp.square(beam @ line[0])
        across = jnp.square(scanner.bearing_sigma * scan.ranges) * (1 - along)
        return regressed(1 / (jnp.square(scanner.range_sigma) * along + across))

    plain = regressed(jnp.ones_like(scan.ranges))
    weighted = jax.lax.fori_loop(0, 5, reweighted, plain)
    of_extract = dot(lines.normal[line], lines.anchor[line]) + lines.offset[line]
    wall = jax.tree.map(lambda x: x[which], walls_of(world))
    rho = jnp.abs(dot(unit(wall.angle), wall.point - pose[:2]))
    errors = jnp.stack([jnp.abs(x) - rho for x in (of_extract, plain[1], weighted[1])])
    return errors, on_wall[line] >= MIN_POINTS


@documented
class Model(NamedTuple):
    """What a map believes of the pose's error."""

    pose_error: PoseError
    """How the errors of the poses hang together."""
    persistence: Persistence | None = None
    """How they go on, where `pose_error` is "persistent"."""


def fused(
    key: Array,
    world: World,
    path: Float[Array, "T 3"],
    scanner: Scanner,
    cov_pose: Float[Array, "3 3"],
    correlation: Number,
    models: Sequence[Model],
) -> tuple[Sample, Float[Array, "M T"]]:
    """The NEES of one wall in the map after each scan, and the NIS of each scan's line before it is fused.

    The fit is that of `known_points`; it is known which line is which.

    Args:
      key: of the noise, of the pose's error, and of the choice of the wall.
      world: walls.
      path: the true poses.
      scanner: its noise is what the fit believes.
      cov_pose: of the pose's error.
      correlation: of the pose's error from one scan to the next; see `robot.pose_errors`.
      models: what `M` maps believe of that.

    Returns:
      Samples, `[M, T]`; and NIS, which is zero where there is none: for the first scan, and where the wall is out of
      sight.
    """
    of_wall, of_scans, of_poses = jax.random.split(key, 3)
    which, _ = _visible_wall(of_wall, world, path[0], scanner)
    wall = jax.tree.map(lambda x: x[which], walls_of(world))

    def step(held: list[Lines], x: tuple[Array, Array, Pose, Array]) -> tuple[list[Lines], tuple[list[Sample], Array]]:
        of_scan, pose, estimate, is_first = x
        on_wall = cast(world, pose[:2], unit(pose[2] + scanner.bearings)).thing == which
        scan = _scan_of_wall(of_scan, wall, on_wall, pose, scanner)
        line = _fit(scan, estimate, noise_of(scanner), Fit.DEFAULT)
        seen = jnp.sum(on_wall) >= MIN_POINTS
        improved = [
            _improve(line, estimate, before, ~is_first, seen, model) for before, model in zip(held, models, strict=True)
        ]
        held = [after for after, _ in improved]
        samples = [_sample(after, wall, jnp.asarray(True)) for after in held]
        return held, (samples, jnp.stack([nis for _, nis in improved]))

    count = path.shape[0]
    estimates = estimate_poses(of_poses, path, cov_pose, correlation=correlation)
    nothing = jax.tree.map(lambda x: x[0], empty_lines(1, path.dtype))
    scans = (jax.random.split(of_scans, count), path, estimates, jnp.arange(count) == 0)
    _, (samples, nis) = jax.lax.scan(step, [nothing for _ in models], scans)
    return jax.tree.map(lambda *x: jnp.stack(x), *samples), nis.T


def _improve(
    line: Lines, pose: Pose, before: Lines, has_prior: Bool[Array, ""], seen: Bool[Array, ""], model: Model
) -> tuple[Lines, Float[Array, ""]]:
    """A line of the map after one more scan, and the NIS before; without a prior it is the line of the scan.

    Where the scan did not see it the line only ages, and there is no NIS.
    """
    persistence = persistence_of(model.pose_error, model.persistence)
    before = forget(before, jnp.square(persistence.correlation))
    before = jax.tree.map(lambda x, y: jnp.where(has_prior, x, y), before, line)
    pair: LineComparison = compare_lines(forget(line, persistence.share), before, Thresholds(), model.pose_error)
    before, line = jax.tree.map(lambda x: x[None], (before, line))
    after = fuse_lines(
        before,
        has_prior[None],
        at_first_angle(line, before, pose) if model.pose_error == "persistent" else line,
        jnp.ones((1, 1), bool),
        Thresholds(),
        Rules(),
        model.pose_error,
        persistence.share,
    )
    after = jax.tree.map(lambda x, y: jnp.where(seen, x, y)[0], after, before)
    return after, jnp.where(has_prior & seen, pair.nis, 0)


def _visible_wall(
    key: Array, world: World, pose: Float[Array, "3"], scanner: Scanner
) -> tuple[Int[Array, ""], Int[Array, " S"]]:
    """One of the walls that are seen, by chance, and how many nominal beams meet each."""
    nominal = cast(world, pose[:2], unit(pose[2] + scanner.bearings)).thing
    count = world.segments.valid.shape[0]
    beams = jnp.sum(nominal[:, None] == jnp.arange(count)[None], 0, dtype=jnp.int32)
    which = jax.random.categorical(key, jnp.where(beams >= SEEN_BEAMS, 0.0, -jnp.inf))
    return which.astype(jnp.int32), beams


def _scan_of_wall(
    key: Array, wall: Walls, on_wall: Bool[Array, " N"], pose: Float[Array, "3"], scanner: Scanner
) -> Scan:
    """The beams on a wall, measured on the boundless wall; the others are masked."""
    of_bearing, of_range = jax.random.split(key)
    shape, dtype = scanner.bearings.shape, pose.dtype
    beam = unit(pose[2] + scanner.bearings + scanner.bearing_sigma * jax.random.normal(of_bearing, shape, dtype))
    normal = unit(wall.angle)
    ranges = dot(normal, wall.point - pose[:2]) / dot(beam, normal[None])
    ranges = ranges + scanner.range_sigma * jax.random.normal(of_range, shape, dtype)
    scan = Scan.from_ranges(ranges, scanner.bearings)
    return dataclasses.replace(scan, valid=scan.valid & on_wall)


def _fit(scan: Scan, pose: Pose, noise: SensorNoise, kind: Fit) -> Lines:
    """The line through all returns of a scan. No batch axis."""
    mount = jax.tree.map(lambda x: jnp.asarray(x, pose.mean.dtype), Mount())
    points = points_from_scan(scan, pose, mount, jacobians="analytic")
    count = jnp.sum(points.valid, dtype=jnp.int32)
    runs = Runs(
        first=jnp.zeros(1, jnp.int32),
        last=(count - 1)[None],
        valid=jnp.ones(1, bool),
        of_point=jnp.where(points.valid, 0, -1),
    )
    lines, _, _ = measure_lines(
        points,
        pose,
        runs,
        noise,
        maximum_likelihood=kind is Fit.DEFAULT,
        covariance="printed" if kind is Fit.PRINTED else "exact",
        jacobians="analytic",
    )
    return jax.tree.map(lambda x: x[0], lines)


def _sample(lines: Lines, wall: Walls, counts: Bool[Array, "*s"]) -> Sample:
    """The errors of lines."""
    error = line_error(lines, wall)
    return Sample(nees(error, lines.cov), error, counts)


@pytree
class Cell:
    """One configuration of a table."""

    world: World
    """What the scanner is in."""
    path: Float[Array, "T 3"]
    """True poses; the first one is where single scans are taken."""
    scanner: Scanner
    """The instrument."""
    cov_pose: Float[Array, "3 3"]
    """Covariance of the poses' errors: m^2, m rad, rad^2."""


def cells() -> dict[str, Cell]:
    """The 264 configurations that covariances are judged by, by name.

    Walls of 8 m and 2 m ahead of the scanner at 2, 5 and 10 m, with normals at 0, 30 and 60 degrees; a room of 12 m by
    12 m, straight and turned by 20 degrees, from its middle and from aside; 1 and 3 cm of noise in range; none and 0.1
    degree in bearing; a pose that is exact, and one that is uncertain by 1 cm and 0.2 degree, or 5 cm and 1 degree. On
    the path the robot moves by half a metre and turns by 15 degrees. 361 beams over 180 degrees.
    """
    t = np.linspace(0, 1, 50)
    path = np.stack([0.5 * np.sin(4 * t), 0.3 * np.sin(6 * t), 0.25 * np.sin(5 * t)], -1)
    scenes: dict[str, tuple[World, tuple[float, float]]] = {}
    for distance, degrees, length in itertools.product((2, 5, 10), (0, 30, 60), (8, 2)):
        along = length / 2 * np.array([-math.sin(math.radians(degrees)), math.cos(math.radians(degrees))])
        ends = np.array([[distance, 0.0]]) + np.array([[-1.0], [1.0]]) * along
        name = f"wall of {length} m at {distance} m, {degrees} degrees"
        scenes[name] = polygon(jnp.asarray(ends), Kind.WALL), (0.0, 0.0)
    for degrees, (where, offset) in itertools.product((0, 20), {"middle": (0.0, 0.0), "aside": (3.0, 2.0)}.items()):
        scenes[f"room turned by {degrees} degrees, from {where}"] = room(12.0, 12.0, math.radians(degrees)), offset
    poses = {
        "exact pose": (0.0, 0.0),
        "pose 1 cm, 0.2 degree": (0.01, math.radians(0.2)),
        "pose 5 cm, 1 degree": (0.05, math.radians(1)),
    }
    return {
        f"{scene}; {sigma_r} m, {degrees} degree; {pose}": Cell(
            world=world,
            path=jnp.asarray(path + np.array([*offset, 0.0])),
            scanner=Scanner(
                bearings=sweep(-math.pi / 2, math.pi / 2, 361),
                range_sigma=jnp.asarray(sigma_r),
                bearing_sigma=jnp.asarray(math.radians(degrees)),
            ),
            cov_pose=jnp.diag(jnp.asarray([position, position, heading]) ** 2),
        )
        for (scene, (world, offset)), sigma_r, degrees, (pose, (position, heading)) in itertools.product(
            scenes.items(), (0.01, 0.03), (0.0, 0.1), poses.items()
        )
    }


@documented
class Verdict(NamedTuple):
    """What many runs say of one configuration."""

    runs: int
    """Number of runs."""
    found: float
    """Share of runs in which there was something to judge."""
    mean: float
    """Mean of the NEES."""
    median: float
    """Median of the NEES."""
    inside: float
    """Share inside the 95 % ellipse."""
    bias: tuple[float, ...]
    """Mean of each number's error over its spread."""


def judge(sample: Sample) -> Verdict:
    """Mean and median of the NEES, the share of estimates inside the 95 % ellipse, and the bias in sigmas.

    Args:
      sample: stacked, of two numbers (lines) or three (circles).

    Returns:
      What the runs say together.

    Raises:
      ValueError: if there are fewer than two runs that count.
    """
    values, error = np.asarray(sample.nees), np.asarray(sample.error)
    counts = np.broadcast_to(np.asarray(sample.counts), values.shape)
    values, error = values[counts], error[counts]
    if len(values) < 2:
        raise ValueError("hardly a run has found anything")
    return Verdict(
        runs=len(values),
        found=float(np.mean(counts)),
        mean=float(np.mean(values)),
        median=float(np.median(values)),
        inside=float(np.mean(values < CHI2_95[error.shape[-1]])),
        bias=tuple((np.mean(error, 0) / np.std(error, 0)).tolist()),
    )


@documented
class Bands(NamedTuple):
    """Where mean and coverage lie, with a given probability for all cells of a table together."""

    mean: tuple[float, float]
    """Least and largest mean of the NEES."""
    inside: tuple[float, float]
    """Least and largest share inside the 95 % ellipse."""


def bands(runs: int, cells: int = 1, *, error: float = 0.001, dof: int = 2) -> Bands:
    """The bands of the mean NEES and of the share inside the 95 % ellipse, if covariances are right.

    Args:
      runs: of each cell, independent.
      cells: of the whole table, which is judged together (Bonferroni).
      error: the probability that any of the cells leaves a band though all is right.
      dof: degrees of freedom of the NEES.

    Returns:
      The bands. Chi-square after Wilson and Hilferty (1931), the share by the normal approximation.
    """
    z = NormalDist().inv_cdf(1 - error / cells / 2)
    k = runs * dof
    low, high = (k * (1 - 2 / (9 * k) + s * z * math.sqrt(2 / (9 * k))) ** 3 / runs for s in (-1, 1))
    spread = z * math.sqrt(0.05 * 0.95 / runs)
    return Bands((low, high), (0.95 - spread, min(0.95 + spread, 1.0)))


def holds(verdict: Verdict, band: Bands) -> bool:
    """Whether mean and coverage of a `verdict` lie in their `band`."""
    in_mean = band.mean[0] <= verdict.mean <= band.mean[1]
    return in_mean and band.inside[0] <= verdict.inside <= band.inside[1]
