"""Section 4.3: from the points that no line took to circles, Eqs. (18)-(20), and to fitted poles.

Eqs. (18)-(20) describe the visible arc of a pole: the centroid lies before its centre, the radius is about 0.6 of the
pole's, and both move with the viewpoint. Where there are points enough the default fits a circle instead.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.frames import dot, perp
from linemap_jax.core.lines import Runs, runs_from_labels
from linemap_jax.core.propagation import apply, inverse, propagate
from linemap_jax.core.sensor import Points
from linemap_jax.core.settings import SensorNoise, Thresholds
from linemap_jax.core.state import Circles, Lines, Pose, Scan

MIN_FIT_POINTS = 5
"""A circle has three unknowns; with fewer than five points its residuals say nothing about the fit."""
GAUSS_NEWTON_STEPS = 5
"""From the algebraic start the geometric fit has converged to rounding after four steps on poles seen in practice."""


class _Cluster(NamedTuple):
    """The cluster under extraction; packed into one array as in the segmentation."""

    n: Array
    x0: Array  # first point
    y0: Array
    x: Array  # sums of Eq. (18), from the first point
    y: Array


def cluster(
    position: Float[Array, "N 2"], valid: Bool[Array, " N"], free: Bool[Array, " N"], thresholds: Thresholds
) -> Runs:
    """Section 4.3.1: consecutive points that no line took, each near the centre of those before it.

    Args:
      position: the points. Shape `[N, 2]`.
      valid: beams that have a point.
      free: of these, the ones that no line took.
      thresholds: `cluster_distance`.

    Returns:
      The clusters, with room for all that `N` beams can hold; clusters of one point among them.
    """

    def step(carry: Array, beam: tuple[Array, ...]) -> tuple[Array, Array]:
        c = _Cluster(*carry)
        px, py, is_valid, is_free = beam
        n = jnp.maximum(c.n, 1)
        x, y = px - c.x0, py - c.y0
        near = (x - c.x / n) ** 2 + (y - c.y / n) ** 2 < thresholds.cluster_distance**2
        joins = (c.n > 0) & near
        keep = joins.astype(carry.dtype)
        joined = jnp.stack(
            [
                c.n * keep + 1,
                jnp.where(joins, c.x0, px),
                jnp.where(joins, c.y0, py),
                (c.x + x) * keep,
                (c.y + y) * keep,
            ]
        )
        # A point of a line ends the cluster; a beam without a return does not.
        after = jnp.where(is_free, joined, jnp.zeros_like(carry))
        return jnp.where(is_valid, after, carry), is_free & ~joins

    start = jnp.zeros(len(_Cluster._fields), position.dtype)
    _, starts = jax.lax.scan(step, start, (position[:, 0], position[:, 1], valid, free))
    label = jnp.cumsum(starts) - 1
    return runs_from_labels(jnp.where(free, label, -1).astype(jnp.int32), position.shape[0])


def measure_circles(
    points: Points,
    scan: Scan,
    pose: Pose,
    clusters: Runs,
    thresholds: Thresholds,
    noise: SensorNoise,
    *,
    fit: bool,
) -> Circles:
    """The circle of each cluster.

    Args:
      points: the points of the scan.
      scan: the scan.
      pose: of the robot.
      clusters: which points belong together.
      thresholds: `cluster_distance` bounds a fitted radius.
      noise: of the sensor.
      fit: fit a circle where there are points enough; otherwise Eqs. (18)-(20) throughout.

    Returns:
      One circle a cluster, in the world; valid where there are at least two points.
    """
    n = clusters.count
    count = jnp.maximum(n, 1).astype(points.position.dtype)
    # Eq. (18), from the first point of the cluster
    origin = points.position[clusters.first]
    offset = points.position - clusters.spread(origin)
    centroid = clusters.sum(offset) / count[:, None]
    # Eqs. (19)-(20)
    z = offset - clusters.spread(centroid)
    variance = clusters.sum(dot(z, z)) / jnp.maximum(count - 1, 1)
    positive = variance > 0
    radius = jnp.where(positive, jnp.sqrt(jnp.where(positive, variance, 1)), 0)
    middle = origin + centroid

    k = n.shape[0]
    cov = jnp.zeros((k, 3, 3), radius.dtype)
    fitted = jnp.zeros(k, bool)
    center = middle
    if fit:
        shift, fit_radius, cov_fit, fitted = _fit_circles(points, scan, clusters, z, middle, thresholds, noise)
        center = middle + jnp.where(fitted[:, None], shift, 0)
        radius = jnp.where(fitted, fit_radius, radius)
        # The centre moves with the pose as every point does; the radius does not.
        one, zero = jnp.ones_like(radius), jnp.zeros_like(radius)
        turn = perp(center)
        rows = [[one, zero, turn[:, 0]], [zero, one, turn[:, 1]], [zero, zero, zero]]
        jac_circle_pose = jnp.stack([jnp.stack(row, -1) for row in rows], -2)
        cov = jnp.where(fitted[:, None, None], cov_fit + propagate(jac_circle_pose, pose.cov), 0)
    return Circles(
        center=pose.mean[None, :2] + center,
        radius=radius,
        cov=cov,
        fitted=fitted,
        times_detected=jnp.ones_like(n),
        valid=n >= 2,
    )


def _fit_circles(
    points: Points,
    scan: Scan,
    clusters: Runs,
    z: Float[Array, "N 2"],
    middle: Float[Array, "K 2"],
    thresholds: Thresholds,
    noise: SensorNoise,
) -> tuple[Float[Array, "K 2"], Float[Array, " K"], Float[Array, "K 3 3"], Bool[Array, " K"]]:
    """Least-squares circles through the points of each cluster, by Gauss-Newton on their distances.

    Starts from the algebraic circle of Kasa (1976), which underestimates the radius of a short arc.

    Args:
      points: the points of the scan.
      scan: the scan.
      clusters: which points belong together.
      z: the points, from the centroid of their cluster. Shape `[N, 2]`.
      middle: the centroids, from the robot. Shape `[K, 2]`.
      thresholds: `cluster_distance`, the largest radius.
      noise: of the sensor.

    Returns:
      The centres from the centroids, the radii, the covariances of (x, y, radius) from the sensor's noise, and which
      fits are to be believed.
    """
    n = clusters.count
    count = jnp.maximum(n, 1).astype(z.dtype)
    w = dot(z, z)
    x, y = z[:, 0], z[:, 1]
    sums = clusters.sum(jnp.stack([x * x, x * y, y * y, x * w / 2, y * w / 2, w], -1))
    sxx, sxy, syy, bx, by, sw = jnp.moveaxis(sums, -1, 0)
    det = sxx * syy - sxy * sxy
    solvable = (n >= MIN_FIT_POINTS) & (det > 1e-6 * (sxx + syy) ** 2)
    safe = jnp.where(solvable, det, 1)
    a, b = (bx * syy - by * sxy) / safe, (by * sxx - bx * sxy) / safe
    circle = jnp.stack([a, b, jnp.sqrt(sw / count + a * a + b * b)], -1)
    circle = jnp.where(solvable[:, None], circle, jnp.ones_like(circle))

    def linearise(circle: Array) -> tuple[Array, Array, Array, Array]:
        """Residuals f, directions e from the centre, and A^T A of the rows A = [-e, -1]."""
        to_point = z - clusters.spread(circle[:, :2])
        distance = jnp.sqrt(dot(to_point, to_point))
        e = to_point / jnp.where(distance > 0, distance, 1)[:, None]
        rows = jnp.concatenate([-e, -jnp.ones_like(e[:, :1])], -1)
        return distance - clusters.spread(circle[:, 2]), e, rows, clusters.sum(rows[:, :, None] * rows[:, None, :])

    def step(_: int, circle: Array) -> Array:
        residual, _, rows, normal_matrix = linearise(circle)
        gradient = clusters.sum(rows * residual[:, None])
        return circle - apply(inverse(normal_matrix), gradient)

    circle = jax.lax.fori_loop(0, GAUSS_NEWTON_STEPS, step, circle)
    residual, e, rows, normal_matrix = linearise(circle)
    along = dot(e, points.beam) ** 2
    variance = noise.range_sigma**2 * along + (scan.ranges * noise.bearing_sigma) ** 2 * (1 - along)
    cov = propagate(inverse(normal_matrix), clusters.sum(rows[:, :, None] * rows[:, None, :] * variance[:, None, None]))

    center, radius = circle[:, :2], circle[:, 2]
    misfit = clusters.sum(residual**2 / jnp.where(variance > 0, variance, 1))
    believed = (
        solvable
        & jnp.all(jnp.isfinite(circle), -1)
        & (radius >= 5 * noise.range_sigma)  # smaller ones are lost in the noise
        & (radius < thresholds.cluster_distance)
        & (dot(middle - points.laser[None], center) > 0)  # we see the near side of a pole, never its inside
        & (misfit <= count + 3 * jnp.sqrt(2 * count))  # 3 sigma of chi-square
        & (cov[:, 2, 2] < (radius / 3) ** 2)
    )
    finite = jnp.all(jnp.isfinite(circle), -1) & jnp.all(jnp.isfinite(cov), (-1, -2))
    keep = believed & finite
    return center, radius, jnp.where(keep[:, None, None], cov, 0), keep


def near_lines(circles: Circles, lines: Lines, thresholds: Thresholds) -> Bool[Array, " C"]:
    """Section 4.3.1: which circles lie too close to a line to be modelled; they are probably its noise."""

    def distance2(center: Float[Array, "2"], line: Lines) -> Float[Array, ""]:
        step = center - line.anchor
        across = dot(line.normal, step) - line.offset
        along = dot(line.tangent, step)
        beyond = along - jnp.clip(along, line.extent[0], line.extent[1])
        return across**2 + beyond**2

    every = jax.vmap(jax.vmap(distance2, (None, 0)), (0, None))(circles.center, lines)
    return circles.valid & jnp.any(lines.valid[None] & (every < thresholds.circle_line_distance**2), -1)
