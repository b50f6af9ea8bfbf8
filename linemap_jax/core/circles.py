"""Section 4.3: from the points that no line took to circles, Eqs. (18)-(20), and to fitted poles.

Eqs. (18)-(20) describe the visible arc of a pole: the centroid lies before its centre, the radius is about 0.6 of the
pole's, and both move with the viewpoint. Where there are points enough the default fits a circle instead.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from linemap_jax.core.frames import dot, perp
from linemap_jax.core.propagation import apply, inverse, product, propagate, square_root
from linemap_jax.core.runs import Runs
from linemap_jax.core.sensor import Points
from linemap_jax.core.settings import SensorNoise, Thresholds
from linemap_jax.core.slots import neutral_where_free
from linemap_jax.core.state import Circles, Lines, Pose

MIN_FIT_POINTS = 5
"""A circle has three unknowns; with fewer than five points its residuals say nothing about the fit."""
GAUSS_NEWTON_STEPS = 5
"""From the algebraic start the geometric fit has converged to rounding after four steps on poles seen in practice."""


class Cluster(NamedTuple):
    """The cluster under extraction, as it stands at some point; sums are from its first point."""

    n: Array  # number of points
    x0: Array  # first point
    y0: Array
    x: Array  # sums of Eq. (18)
    y: Array
    xxyy: Array  # sum of x^2 + y^2, for Eq. (20)


def cluster(points: Points, free: Bool[Array, " N"], thresholds: Thresholds) -> tuple[Bool[Array, " N"], Cluster]:
    """Section 4.3.1: consecutive points that no line took, each near the centre of those before it.

    Args:
      points: the points of the scan.
      free: the ones that no line took.
      thresholds: `cluster_distance`.

    Returns:
      Which points are the last of their cluster, shape `[N]`; the cluster as it stood at each point, each field `[N]`.
    """

    def body(carry: Array, row: Array) -> tuple[Array, Array]:
        c = Cluster(*carry)
        px, py, is_free = row
        n = jnp.maximum(c.n, 1)
        x, y = px - c.x0, py - c.y0
        dx, dy = n * x - c.x, n * y - c.y
        near = dx * dx + dy * dy < (n * thresholds.cluster_distance) ** 2
        joins = (c.n > 0) & near
        x0, y0 = jnp.where(joins, c.x0, px), jnp.where(joins, c.y0, py)
        x, y = px - x0, py - y0
        old = jnp.where(joins, 1, 0).astype(carry.dtype)
        joined = [c.n * old + 1, x0, y0, c.x * old + x, c.y * old + y, c.xxyy * old + (x * x + y * y)]
        carry = jnp.stack(joined) * is_free  # a point of a line ends the cluster
        return carry, carry

    start = jnp.zeros(len(Cluster._fields), points.range.dtype)
    rows = jnp.concatenate([points.position, free.astype(start.dtype)[:, None]], -1)
    _, running = jax.lax.scan(body, start, rows)
    running = Cluster(*jnp.moveaxis(running, -1, 0))
    goes_on = jnp.concatenate([running.n[1:] > 1, jnp.zeros(1, bool)])
    return free & ~goes_on, running


def measure_circles(
    points: Points,
    pose: Pose,
    clusters: Runs,
    running: Cluster,
    thresholds: Thresholds,
    noise: SensorNoise,
    *,
    fit: bool,
) -> Circles:
    """The circle of each cluster.

    Args:
      points: the points of the scan.
      pose: of the robot.
      clusters: which points belong together, at least two in each.
      running: the cluster as it stood at each point.
      thresholds: `cluster_distance` bounds a fitted radius.
      noise: of the sensor.
      fit: fit a circle where there are points enough; otherwise Eqs. (18)-(20) throughout.

    Returns:
      One circle a cluster, in the world.
    """
    whole = Cluster(*(x[clusters.last] for x in running))
    n = jnp.maximum(whole.n, 2)
    # Eq. (18), from the first point of the cluster
    centroid = jnp.stack([whole.x, whole.y], -1) / n[:, None]
    # Eqs. (19)-(20)
    variance = (whole.xxyy - n * dot(centroid, centroid)) / (n - 1)
    positive = variance > 0
    radius = jnp.where(positive, jnp.sqrt(jnp.where(positive, variance, 1)), 0)
    center = jnp.stack([whole.x0, whole.y0], -1) + centroid

    k = n.shape[0]
    cov = sqrt_persistent = jnp.zeros((k, 3, 3), radius.dtype)
    fitted = jnp.zeros(k, bool)
    if fit:
        shift, fit_radius, cov, fitted = _fit_circles(points, clusters, n, center, thresholds, noise)
        center = center + jnp.where(fitted[:, None], shift, 0)
        radius = jnp.where(fitted, fit_radius, radius)
        # The centre moves with the pose as every point does; the radius does not.
        one, zero = jnp.ones_like(radius), jnp.zeros_like(radius)
        turn = perp(center)
        rows = [[one, zero, turn[:, 0]], [zero, one, turn[:, 1]], [zero, zero, zero]]
        jac_circle_pose = jnp.stack([jnp.stack(row, -1) for row in rows], -2)
        by_pose = product(jac_circle_pose, square_root(pose.cov)[None])
        sqrt_persistent = jnp.where(fitted[:, None, None], by_pose, 0)
    circles = Circles(
        center=pose.mean[None, :2] + center,
        radius=radius,
        cov_independent=cov,
        sqrt_persistent=sqrt_persistent,
        fitted=fitted,
        times_detected=jnp.ones_like(clusters.last),
        valid=clusters.valid,
    )
    return neutral_where_free(circles)


def _fit_circles(
    points: Points,
    clusters: Runs,
    n: Float[Array, " K"],
    middle: Float[Array, "K 2"],
    thresholds: Thresholds,
    noise: SensorNoise,
) -> tuple[Float[Array, "K 2"], Float[Array, " K"], Float[Array, "K 3 3"], Bool[Array, " K"]]:
    """Least-squares circles through the points of each cluster, by Gauss-Newton on their distances.

    Starts from the algebraic circle of Kasa (1976), which underestimates the radius of a short arc.

    Args:
      points: the points of the scan.
      clusters: which points belong together.
      n: how many they are. Shape `[K]`.
      middle: the centroids, from the robot. Shape `[K, 2]`.
      thresholds: `cluster_distance`, the largest radius.
      noise: of the sensor.

    Returns:
      The centres from the centroids, the radii, the covariances of (x, y, radius) from the sensor's noise, and which
      fits are to be believed.
    """
    z = points.position - clusters.spread(middle)
    w = dot(z, z)
    x, y = z[:, 0], z[:, 1]
    sums = clusters.sum(jnp.stack([x * x, x * y, y * y, x * w / 2, y * w / 2, w], -1))
    sxx, sxy, syy, bx, by, sw = jnp.moveaxis(sums, -1, 0)
    det = sxx * syy - sxy * sxy
    solvable = (n >= MIN_FIT_POINTS) & (det > 1e-6 * (sxx + syy) ** 2)
    safe = jnp.where(solvable, det, 1)
    a, b = (bx * syy - by * sxy) / safe, (by * sxx - bx * sxy) / safe
    circle = jnp.stack([a, b, jnp.sqrt(sw / n + a * a + b * b)], -1)
    circle = jnp.where(solvable[:, None], circle, jnp.ones_like(circle))

    def linearise(circle: Array) -> tuple[Array, Array, Array]:
        """Residuals f, directions e from the centre, and the rows A = [-e, -1] of their Jacobian."""
        mine = clusters.spread(circle)
        to_point = z - mine[:, :2]
        distance = jnp.sqrt(dot(to_point, to_point))
        e = to_point / jnp.where(distance > 0, distance, 1)[:, None]
        return distance - mine[:, 2], e, jnp.concatenate([-e, -jnp.ones_like(e[:, :1])], -1)

    def step(_: Array, circle: Array) -> Array:
        residual, _, rows = linearise(circle)
        # A^T A and A^T f in one sum
        sums = clusters.sum(rows[:, :, None] * jnp.concatenate([rows, residual[:, None]], -1)[:, None, :])
        return circle - apply(inverse(sums[..., :3]), sums[..., 3])

    circle = jax.lax.fori_loop(0, GAUSS_NEWTON_STEPS, step, circle)
    residual, e, rows = linearise(circle)
    along = dot(e, points.beam) ** 2
    variance = noise.range_sigma**2 * along + (points.range * noise.bearing_sigma) ** 2 * (1 - along)
    square = rows[:, :, None] * rows[:, None, :]
    chi2 = residual**2 / jnp.where(variance > 0, variance, 1)
    columns = [square.reshape(-1, 9), (square * variance[:, None, None]).reshape(-1, 9), chi2[:, None]]
    sums = clusters.sum(jnp.concatenate(columns, -1))
    misfit = sums[:, 18]
    cov = propagate(inverse(sums[:, :9].reshape(-1, 3, 3)), sums[:, 9:18].reshape(-1, 3, 3))

    center, radius = circle[:, :2], circle[:, 2]
    dof = jnp.maximum(n - 3, 1)
    believed = (
        solvable
        & jnp.all(jnp.isfinite(circle), -1)
        & jnp.all(jnp.isfinite(cov), (-1, -2))
        & (radius >= 5 * noise.range_sigma)  # smaller ones are lost in the noise
        & (radius < thresholds.cluster_distance)
        & (dot(middle - points.laser[None], center) > 0)  # we see the near side of a pole, never its inside
        & (misfit <= dof + 3 * jnp.sqrt(2 * dof))  # 3 sigma of chi-square
        & (cov[:, 2, 2] < (radius / 3) ** 2)
    )
    return center, radius, jnp.where(believed[:, None, None], cov, 0), believed


def near_lines(circles: Circles, lines: Lines, thresholds: Thresholds) -> Bool[Array, " C"]:
    """Section 4.3.1: which circles lie too close to a line to be modelled; they are probably its noise.

    A fitted circle is a body, and is held against the line with its rim: the bent end of a wall has a centre behind it.
    """

    def distance2(center: Float[Array, "2"], line: Lines) -> Float[Array, ""]:
        step = center - line.anchor
        across = dot(line.normal, step) - line.offset
        along = dot(line.tangent, step)
        beyond = along - jnp.clip(along, line.extent[0], line.extent[1])
        return across**2 + beyond**2

    every = jax.vmap(jax.vmap(distance2, (None, 0)), (0, None))(circles.center, lines)
    reach = thresholds.circle_line_distance + jnp.where(circles.fitted, circles.radius, 0)
    return circles.valid & jnp.any(lines.valid[None] & (every < reach[:, None] ** 2), -1)
