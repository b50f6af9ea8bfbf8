"""Noise of the sensor and of the poses, from scans: the numbers by which covariances are believed.

Both are maximum-likelihood estimates with an interval, by optax, over functions that differentiate through the geometry
of beams and lines:

- `sensor_noise`: from the residuals of beams about the lines that they lie on. Two numbers of each line are fitted to
  its own points; the restricted likelihood (Patterson and Thompson 1971) accounts for that.
- `pose_noise`: from the joint innovation of two scans that see the same lines. What has to hold between their poses
  alone, no map comes into it. Errors that both poses share leave no trace: what is estimated is the part that is new
  within the lag.

Little is selected by the noise that is to be estimated: lines are cut short of their ends, and associated by gates of
fixed width. `OUTLIER` and `MISFIT` do select, far out, and take a little from the sigmas.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.extract import extract
from linemap_jax.core.fields import documented
from linemap_jax.core.frames import dot, perp, reanchor, unit, wrap_angle
from linemap_jax.core.propagation import square_root
from linemap_jax.core.settings import SCAN_CAPACITY, Capacity, Mount, SensorNoise
from linemap_jax.core.slots import take
from linemap_jax.core.state import Extraction, Lines, Pose, Scan, pytree

LEAST_POINTS = 12
"""Fewest points of a run that tells of the noise."""
CUT = 0.15
"""Share of its points that is cut off at either end of a run: they may be another wall's, or between two things."""
STEEPEST = 0.34
"""Least cosine of the incidence of a beam that is taken (70 degrees): grazing lines are seldom one surface."""
OUTLIER = 6.0
"""Residuals beyond so many median absolute deviations of all residuals of their line are no noise of the sensor."""
CORRELATED = 2.0
"""Lines whose successive residuals are correlated by so many sigmas more than noise would be are not one surface. That
does not depend on how large the noise is, so that nothing is selected by it."""
MISFIT = 3.0
"""Lines whose misfit exceeds its expectation by so many sigmas are not one surface."""
SAME_ANGLE = 0.1
"""Lines of two scans are taken for one wall if they differ by less, rad,"""
SAME_OFFSET = 0.25
"""and by less across, m."""
SAME_WALL = (0.03, 0.02)
"""How far lines of one pair of scans may disagree on the motion between them, m and rad: half weight. Those that are
off by twice as much are left out."""
STEPS = 20
"""Of the optimiser, at most."""
SMALLEST = 1e-6
"""No sigma is less, m or rad."""


@documented
class Estimate(NamedTuple):
    """Maximum-likelihood estimates of standard deviations."""

    sigma: np.ndarray
    """Standard deviations."""
    interval: np.ndarray
    """Their intervals of 95 %, from the curvature of the log-likelihood in log(sigma)."""
    used: int
    """Number of residuals or innovations that were used."""


@pytree
class Residuals:
    """Beams about the lines that they lie on; `K` lines of `N` beams, of which each has some."""

    along: Float[Array, "*t N"]
    """Range less the range at which the beam meets the line, m."""
    by_line: Float[Array, "*t N 2"]
    """Derivative of the latter by offset (per unit) and angle (m)."""
    sway: Float[Array, "*t N"]
    """Derivative by the bearing, m / rad."""
    line: Int[Array, "*t N"]
    """Slot of its line, -1 for beams that are not used."""


@partial(jax.jit, static_argnames="capacity")
def residuals_of(scan: Scan, noise: SensorNoise, *, capacity: Capacity = SCAN_CAPACITY) -> Residuals:
    """The residuals of one scan, in the frame of the laser.

    Args:
      scan: `N` beams.
      noise: what is believed until now; decides with the thresholds what is a line.
      capacity: slots for lines.

    Returns:
      The residuals of the beams that lie on a line; zeros for the others.
    """
    here = Pose(mean=jnp.zeros(3, scan.ranges.dtype), cov=jnp.zeros((3, 3), scan.ranges.dtype))
    found = extract(scan, here, noise=noise, capacity=capacity, jacobians="analytic")
    lines, label = found.lines, found.line_of_beam
    member = label[:, None] == jnp.arange(capacity.lines)[None]
    rank = jnp.take_along_axis(jnp.cumsum(member, 0) - 1, jnp.maximum(label, 0)[:, None], 1)[:, 0]
    size = jnp.sum(member, 0)[label]
    inside = (rank >= CUT * size) & (rank < (1 - CUT) * size) & (size >= LEAST_POINTS) & (label >= 0)

    beam, mine = unit(scan.bearings), take(lines, label)
    cosine = dot(mine.normal, beam)
    steep = jnp.abs(cosine) < STEEPEST
    cosine = jnp.where(steep, 1, cosine)
    reach = (mine.offset + dot(mine.normal, mine.anchor)) / cosine
    along = scan.ranges - reach
    tangent = dot(perp(mine.normal), beam)
    # By (offset, angle) at the origin: d(normal . beam) / d(angle) = tangent . beam.
    by_line = jnp.stack([1 / cosine, -reach * tangent / cosine], -1)
    used = inside & ~steep & scan.valid
    spread = jax.vmap(_median_deviation, (None, 1))(along, member & used[:, None])
    used &= jnp.abs(along) <= OUTLIER * spread[label]

    sway = -reach * tangent / cosine
    sigma = jnp.sqrt(noise.range_sigma**2 + jnp.square(sway * noise.bearing_sigma))
    z = used * along / jnp.where(sigma > 0, sigma, 1)
    following = jnp.concatenate([z[1:], jnp.zeros_like(z[:1])])
    member &= used[:, None]
    inner = member[:-1] & member[1:]
    together = jnp.sum(inner * (z * following)[:-1, None], 0)
    square = jnp.sum(member * jnp.square(z)[:, None], 0)
    white = together <= CORRELATED * square / jnp.sqrt(jnp.maximum(jnp.sum(member, 0), 1))
    used &= white[label]
    return Residuals(
        along=along * used,
        by_line=jnp.where(used[:, None], by_line, 0),
        sway=sway * used,
        line=jnp.asarray(jnp.where(used, label, -1)),
    )


def _median_deviation(values: Float[Array, " N"], which: Bool[Array, " N"]) -> Float[Array, ""]:
    """Median absolute value of some numbers, scaled to the sigma of a normal distribution."""
    ordered = jnp.sort(jnp.where(which, jnp.abs(values), jnp.inf))
    middle = ordered[jnp.maximum(jnp.sum(which) - 1, 0) // 2]
    return 1.4826 * jnp.where(jnp.isfinite(middle), middle, 0)


class _Fits(NamedTuple):
    """The lines of a scan, each fitted to its residuals by weighted least squares."""

    points: Array  # [K] number of them
    misfit: Array  # [K] chi-square with two degrees of freedom less
    log_det: Array  # [K] of the covariance of the residuals, and of the information


def _fit(log_sigma: Float[Array, "2"], residuals: Residuals, capacity: int) -> _Fits:
    used = residuals.line >= 0
    var_range, var_bearing = jnp.exp(2 * log_sigma)
    variance = jnp.asarray(jnp.where(used, var_range + var_bearing * jnp.square(residuals.sway), 1))
    member = (residuals.line[None] == jnp.arange(capacity)[:, None]).astype(variance.dtype)
    x, y = residuals.by_line, residuals.along
    # Few columns: the sums are most of the time.
    columns = [x[:, 0] ** 2, x[:, 0] * x[:, 1], x[:, 1] ** 2, x[:, 0] * y, x[:, 1] * y, y**2]
    columns = [column / variance for column in columns] + [jnp.log(variance), used.astype(variance.dtype)]
    sums = jnp.matmul(member, jnp.stack(columns, -1), precision=jax.lax.Precision.HIGHEST)
    a, b, d, p, q, square, log_variance, count = jnp.moveaxis(sums, -1, 0)
    enough = count > 2
    a, b, d = (jnp.asarray(jnp.where(enough, x, free)) for x, free in ((a, 1), (b, 0), (d, 1)))
    det = a * d - b * b
    explained = (d * p * p - 2 * b * p * q + a * q * q) / det
    return _Fits(points=count * enough, misfit=square - explained, log_det=log_variance + jnp.log(det))


def restricted_likelihood(log_sigma: Float[Array, "2"], residuals: Residuals, capacity: int) -> Float[Array, ""]:
    """Logarithm of the restricted likelihood of the residuals of one scan, but for a constant.

    Each line is fitted anew by weighted least squares, once, about the line that was extracted.

    Args:
      log_sigma: logarithms of the sigmas of a range (m) and of a bearing (rad).
      residuals: of `N` beams.
      capacity: slots of the lines.

    Returns:
      The logarithm.
    """
    fits = _fit(log_sigma, residuals, capacity)
    return -jnp.sum(jnp.where(fits.points > 0, fits.log_det + fits.misfit, 0)) / 2


def single_surfaces(log_sigma: Float[Array, "2"], residuals: Residuals, capacity: int) -> Residuals:
    """The residuals without those of lines that fit too badly to be one surface, by `MISFIT`.

    Args:
      log_sigma: logarithms of the sigmas of a range (m) and of a bearing (rad).
      residuals: of `N` beams.
      capacity: slots of the lines.

    Returns:
      The residuals, with fewer lines.
    """
    fits = _fit(log_sigma, residuals, capacity)
    dof = jnp.maximum(fits.points - 2, 1)
    bad = fits.misfit > dof + MISFIT * jnp.sqrt(2 * dof)
    out = (residuals.line < 0) | bad[residuals.line]
    return Residuals(
        along=jnp.where(out, 0, residuals.along),
        by_line=jnp.where(out[:, None], 0, residuals.by_line),
        sway=jnp.where(out, 0, residuals.sway),
        line=jnp.where(out, -1, residuals.line),
    )


def sensor_noise(
    scans: Scan, start: SensorNoise | None = None, *, capacity: Capacity = SCAN_CAPACITY, rounds: int = 4
) -> Estimate:
    """Sigmas of a range (m) and of a bearing (rad) from stacked scans.

    What a line is depends on the noise that is believed; the estimate is repeated with its own result.

    Args:
      scans: `[T, N]`.
      start: what is believed at first.
      capacity: slots for the lines of a scan.
      rounds: how often is estimated.

    Returns:
      Two sigmas, m and rad, and their 95 % intervals.

    Raises:
      ValueError: if hardly a line was found.
    """
    believed = start or SensorNoise()
    measure = jax.jit(jax.vmap(partial(residuals_of, capacity=capacity), (0, None)))
    choose = jax.jit(jax.vmap(partial(single_surfaces, capacity=capacity.lines), (None, 0)))

    def negative(log_sigma: Array, residuals: Residuals) -> Array:
        of_scans = jax.vmap(lambda r: restricted_likelihood(log_sigma, r, capacity.lines))(residuals)
        return -jnp.sum(of_scans)

    estimate = None
    for _ in range(rounds):
        residuals = measure(scans, believed)
        if estimate is not None:
            residuals = choose(jnp.log(jnp.asarray(estimate.sigma, scans.ranges.dtype)), residuals)
        used = int(jnp.sum(residuals.line >= 0))
        if used < 100:
            raise ValueError(f"only {used} beams lie inside of lines: too few to tell the noise of the sensor")
        estimate = maximise(negative, jnp.log(jnp.asarray([0.01, 0.001], scans.ranges.dtype)), residuals, used)
        believed = SensorNoise(range_sigma=estimate.sigma[0], bearing_sigma=estimate.sigma[1])
    assert estimate is not None
    return estimate


@pytree
class Innovations:
    """Lines of one scan against those of another, `L` pairs; free slots are zero, with a variance of one."""

    change: Float[Array, "*t L 2"]
    """Offset and angle, the second less the first, at the anchor of the first. m, rad."""
    cov: Float[Array, "*t L 2 2"]
    """Covariance of that from the sensor's noise."""
    by_first: Float[Array, "*t L 2 3"]
    """Derivative by the pose of the first scan."""
    by_second: Float[Array, "*t L 2 3"]
    """Derivative by the pose of the second scan."""
    valid: Bool[Array, "*t L"]
    """Which slots are in use."""


@partial(jax.jit, static_argnames="capacity")
def innovations_of(
    scans: Scan, poses: Float[Array, "2 3"], noise: SensorNoise, mount: Mount, *, capacity: Capacity = SCAN_CAPACITY
) -> Innovations:
    """The innovation of two scans, `[2, N]`, at the poses that are believed.

    Args:
      scans: two, stacked.
      poses: of the robot at both, as believed. m, m, rad. Shape `[2, 3]`.
      noise: of the sensor.
      mount: of the scanner on the robot.
      capacity: slots for the lines of a scan.

    Returns:
      For each line of the first scan by how much its view in the second differs; not valid where it has none.
    """
    nothing = jnp.zeros((3, 3), poses.dtype)

    def found_at(t: int) -> Extraction:
        scan = jax.tree.map(lambda x: x[t], scans)
        pose = Pose(mean=poses[t], cov=nothing)
        return extract(scan, pose, noise=noise, mount=mount, capacity=capacity, jacobians="analytic")

    first, second = found_at(0), found_at(1)

    def compare(a: Lines, b: Lines) -> Float[Array, ""]:
        """How far apart two lines are, m; infinite if they are not the same wall."""
        turn = wrap_angle(b.angle - a.angle)
        ends = jnp.stack([b.begin, b.end]) - a.anchor[None]
        along, across = dot(ends, a.tangent[None]), dot(ends, a.normal[None]) - a.offset
        overlap = jnp.minimum(jnp.max(along), a.extent[1]) - jnp.maximum(jnp.min(along), a.extent[0])
        close = jnp.max(jnp.abs(across)) < SAME_OFFSET
        same = a.valid & b.valid & close & (jnp.abs(turn) < SAME_ANGLE)
        return jnp.where(same & (overlap > 0.5 * jnp.minimum(a.length, b.length)), jnp.mean(jnp.abs(across)), jnp.inf)

    apart = jax.vmap(jax.vmap(compare, (None, 0)), (0, None))(first.lines, second.lines)
    index = jnp.arange(apart.shape[0])
    best = jnp.argmin(apart, 1)
    mutual = jnp.argmin(apart, 0)[best] == index
    valid = jnp.isfinite(jnp.min(apart, 1)) & mutual

    # Jacobians move to the common anchor as errors of a line do.
    moved = dataclasses.replace(
        take(second.lines, best),
        sqrt_persistent=second.jac_line_pose[best],
        cov_independent=second.cov_measurement[best],
    )
    moved = jax.vmap(reanchor)(moved, first.lines.anchor)
    change = jnp.stack([moved.offset - first.lines.offset, wrap_angle(moved.angle - first.lines.angle)], -1)
    valid &= _agrees(change, moved.sqrt_persistent, valid)
    one = valid[:, None, None]
    return Innovations(
        change=jnp.where(valid[:, None], change, 0),
        cov=jnp.where(one, first.cov_measurement + moved.cov_independent, jnp.eye(2, dtype=poses.dtype)[None]),
        by_first=jnp.where(one, first.jac_line_pose, 0),
        by_second=jnp.where(one, moved.sqrt_persistent, 0),
        valid=valid,
    )


def _agrees(change: Float[Array, "L 2"], by_pose: Float[Array, "L 2 3"], valid: Bool[Array, " L"]) -> Bool[Array, " L"]:
    """Which lines agree on one motion of the robot, by least squares with weights that fall off (Cauchy).

    The motion is free, so that no noise of the poses makes a line disagree.
    """
    scale = jnp.asarray(SAME_WALL, change.dtype)
    x, y = by_pose / scale[None, :, None], change / scale[None]

    def residual(motion: Float[Array, "3"]) -> Float[Array, " L"]:
        return jnp.sum(jnp.square(y - jnp.sum(x * motion[None, None], -1)), -1)

    def step(_: Array, motion: Float[Array, "3"]) -> Float[Array, "3"]:
        weight = valid / (1 + residual(motion))
        information = jnp.einsum("l,lai,laj->ij", weight, x, x) + jnp.eye(3, dtype=x.dtype)
        return jnp.linalg.solve(information, jnp.einsum("l,lai,la->i", weight, x, y))

    motion = jax.lax.fori_loop(0, 10, step, jnp.zeros(3, x.dtype))
    return residual(motion) < 4


def innovation_likelihood(log_sigma: Float[Array, "5"], innovations: Innovations) -> Float[Array, ""]:
    """Logarithm of the likelihood of the joint innovation of two scans, but for a constant.

    All lines of a scan share the error of its pose, so that their innovations are one vector, whose covariance is
    M + W + A C A^T + B C B^T: M of the sensor's noise; C of each pose; and W of each line, since real walls are not
    straight to a millimetre, and another part of them is seen from another place.

    Args:
      log_sigma: logarithms of the sigmas of x, y (m) and theta (rad), and of W: offset (m) and angle (rad).
      innovations: `L` pairs of lines.

    Returns:
      The logarithm.
    """
    scale, walls = jnp.exp(log_sigma[:3]), jnp.exp(2 * log_sigma[3:])
    count = innovations.valid.shape[0]
    cov = innovations.cov + jnp.diag(walls)[None] * innovations.valid[:, None, None]
    by_poses = jnp.concatenate([innovations.by_first, innovations.by_second], -1) * jnp.tile(scale, 2)[None, None]
    # Whitened line by line, the determinant and the form of I + U U^T follow from a matrix of order 6.
    root = square_root(cov)
    white = _solve_lower(root, innovations.change[..., None]).reshape(2 * count)
    mixed = _solve_lower(root, by_poses).reshape(2 * count, 6)
    inner = jnp.eye(6, dtype=white.dtype) + mixed.T @ mixed
    factor = jnp.linalg.cholesky(inner)
    projected = jax.scipy.linalg.solve_triangular(factor, mixed.T @ white, lower=True)
    log_det = jnp.sum(jnp.log(jnp.diagonal(factor))) + jnp.sum(jnp.log(root[:, 0, 0]) + jnp.log(root[:, 1, 1]))
    return -log_det - (white @ white - projected @ projected) / 2


def _solve_lower(root: Float[Array, "L 2 2"], rows: Float[Array, "L 2 n"]) -> Float[Array, "L 2 n"]:
    """The inverse of lower triangular matrices times some columns."""
    first = rows[:, 0] / root[:, 0, 0, None]
    return jnp.stack([first, (rows[:, 1] - root[:, 1, 0, None] * first) / root[:, 1, 1, None]], 1)


def pose_noise(
    scans: Scan,
    poses: Float[Array, "T 3"],
    noise: SensorNoise,
    mount: Mount | None = None,
    *,
    lag: int = 1,
    capacity: Capacity = SCAN_CAPACITY,
) -> Estimate:
    """Sigmas of x, y (m) and theta (rad) of each pose, from pairs of scans that have no scan in common.

    Two more follow: what the offset (m) and the angle (rad) of a wall differ by between two views of it.

    Args:
      scans: `[T, N]`.
      poses: of the robot, as believed. Shape `[T, 3]`.
      noise: of the sensor.
      mount: of the scanner on the robot.
      lag: from one scan of a pair to the other; errors that last longer are not seen.
      capacity: slots for the lines of a scan.

    Returns:
      Five sigmas: m, m, rad; m, rad; and their 95 % intervals.

    Raises:
      ValueError: if there is no pair, or hardly any line is seen by both scans of a pair.
    """
    count = poses.shape[0]
    if count <= lag:
        raise ValueError(f"a pair of scans is {lag} apart, and there are {count} scans")
    first = np.asarray([t for t in range(count - lag) if (t // lag) % 2 == 0])
    pairs = np.stack([first, first + lag], -1)
    mount = jax.tree.map(lambda x: jnp.asarray(x, poses.dtype), mount or Mount())
    measure = jax.jit(jax.vmap(partial(innovations_of, capacity=capacity), (0, 0, None, None)))
    innovations = measure(jax.tree.map(lambda x: x[pairs], scans), jnp.asarray(poses)[pairs], noise, mount)
    used = int(jnp.sum(innovations.valid))
    if used < 20:
        raise ValueError(f"only {used} lines are seen by both scans of a pair: too few to tell the noise of the poses")

    def negative(log_sigma: Array, innovations: Innovations) -> Array:
        return -jnp.sum(jax.vmap(partial(innovation_likelihood, log_sigma))(innovations))

    return maximise(negative, jnp.log(jnp.asarray([0.02, 0.02, 0.005, 0.002, 0.002], poses.dtype)), innovations, used)


def maximise(negative: Callable[[Array, Any], Array], start: Float[Array, " n"], data: Any, used: int) -> Estimate:
    """Minimise a negative log-likelihood of log(sigma) by L-BFGS, and tell how sure the result is.

    Args:
      negative: of log(sigma) and the data.
      start: log(sigma) at first.
      data: a pytree of arrays.
      used: how many numbers the data holds, for the record.

    Returns:
      The sigmas, with intervals from the curvature at the maximum.
    """
    optimiser = optax.lbfgs()

    @jax.jit
    def run(start: Array, data: Any) -> tuple[Array, Array]:
        def value(x: Array) -> Array:
            return negative(jnp.maximum(x, jnp.log(SMALLEST)), data)

        value_and_grad = optax.value_and_grad_from_state(value)

        def step(carry: tuple[Array, Any], _: None) -> tuple[tuple[Array, Any], None]:
            x, state = carry
            now, gradient = value_and_grad(x, state=state)
            updates, state = optimiser.update(gradient, state, x, value=now, grad=gradient, value_fn=value)
            return (jnp.asarray(optax.apply_updates(x, updates)), state), None

        (x, _), _ = jax.lax.scan(step, (start, optimiser.init(start)), None, length=STEPS)
        return jnp.maximum(x, jnp.log(SMALLEST)), jax.hessian(value)(x)

    log_sigma, curvature = (np.asarray(x, float) for x in run(start, data))
    # A direction without curvature: the data says nothing of it.
    values, vectors = np.linalg.eigh(curvature)
    spread = np.sqrt(np.sum(vectors**2 / np.maximum(values, 1e-12)[None], -1))
    interval = np.exp(log_sigma[:, None] + np.minimum(1.96 * spread, 50)[:, None] * np.array([[-1.0, 1.0]]))
    return Estimate(sigma=np.exp(log_sigma), interval=interval, used=used)
