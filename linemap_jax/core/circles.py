"""Section 4.3 (circles): from the points that no line took to circles, Eqs. (18)-(20), and to fitted poles.

The paper numbers 4.3 and 4.3.1 twice, for the extraction of lines and for that of circles.

Eqs. (18)-(20) describe the visible arc of a pole: the centroid lies before its centre, the radius is about 0.6 of the
pole's, and both move with the viewpoint. Where there are points enough the default takes the most likely circle
instead, for noise along and across the beams.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.special
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.branching import largest_of_batch
from linemap_jax.core.frames import dot, perp
from linemap_jax.core.propagation import apply, inverse, product, safe_sqrt, square_root, symmetric
from linemap_jax.core.runs import Runs
from linemap_jax.core.sensor import Points
from linemap_jax.core.settings import Jacobians, Rules, SensorNoise, Thresholds
from linemap_jax.core.slots import bounded, directed, neutral_where_free
from linemap_jax.core.state import Circles, Lines, Pose, squared

MIN_FIT_POINTS = 5
"""A circle has three unknowns; with fewer than five points its residuals say nothing about the fit."""
GAUSS_NEWTON_STEPS = 5
"""Without noise of the bearing the estimate has then converged to 0.001 sigma, from the algebraic start. Beams near the
rim converge slowly: with 0.1 degree of noise 0.15 sigma are left, which costs nothing in the measured consistency."""
FEW = 4
"""Where no more than this part of the points may lie on poles, only these are looked at."""
RIM = 0.5
"""How near to the rim, in sigmas of range and sway, a beam is taken to meet a pole at least. At the rim itself it would
have all the weight, and where the rim is we do not know that well."""


class _Cluster(NamedTuple):
    """The cluster under extraction, as it stands at some point; sums are from its first point."""

    n: Array  # number of points
    x0: Array  # first point
    y0: Array
    x: Array  # sums of Eq. (18)
    y: Array


def cluster(
    points: Points, free: Bool[Array, " N"], thresholds: Thresholds
) -> tuple[Bool[Array, " N"], Float[Array, " N"]]:
    """Section 4.3.1 (circles): consecutive points that no line took, each near the centre of those before it.

    Args:
      points: the points of the scan.
      free: the ones that no line took.
      thresholds: `cluster_distance`.

    Returns:
      Which points are the last of their cluster; how many points it had when it stood at each point. Shapes `[N]`.
    """

    def body(carry: Array, row: Array) -> tuple[Array, Array]:
        c = _Cluster(*carry)
        px, py, is_free = row
        n = jnp.maximum(c.n, 1)
        x, y = px - c.x0, py - c.y0
        dx, dy = n * x - c.x, n * y - c.y
        near = dx * dx + dy * dy < (n * thresholds.cluster_distance) ** 2
        joins = (c.n > 0) & near
        x0, y0 = jnp.where(joins, c.x0, px), jnp.where(joins, c.y0, py)
        x, y = px - x0, py - y0
        old = jnp.where(joins, 1, 0).astype(carry.dtype)
        joined = [c.n * old + 1, x0, y0, c.x * old + x, c.y * old + y]
        carry = jnp.stack(joined) * is_free  # a point of a line ends the cluster
        return carry, carry[0]

    start = jnp.zeros(len(_Cluster._fields), points.range.dtype)
    rows = jnp.concatenate([points.position, free.astype(start.dtype)[:, None]], -1)
    _, count = jax.lax.scan(body, start, rows)
    goes_on = jnp.concatenate([count[1:] > 1, jnp.zeros(1, bool)])
    return free & ~goes_on, count


def arcs_from_points(position: Float[Array, "N 2"], clusters: Runs) -> Float[Array, "3 K"]:
    """Eqs. (18)-(20): centroid and spread of the points of each cluster.

    Args:
      position: the points, in metres. Shape `[N, 2]`.
      clusters: which points belong together, at least two in each.

    Returns:
      x, y and radius of each, in the coordinates of the points. Shape `[3, K]`.
    """
    # As in the regression of lines, the sums start at the first point, which is a constant of them.
    origin = jax.lax.stop_gradient(position[clusters.first])
    z = position - clusters.spread(origin)
    sums = clusters.sum(jnp.concatenate([z, dot(z, z)[:, None]], -1))
    n = _count(clusters).astype(sums.dtype)
    centroid = sums[:, :2] / n[:, None]
    radius = safe_sqrt((sums[:, 2] - n * dot(centroid, centroid)) / (n - 1))
    return jnp.concatenate([(origin + centroid).T, radius[None]])


def jac_arc_points(position: Float[Array, "N 2"], clusters: Runs, *, jacobians: Jacobians) -> Float[Array, "N 3 2"]:
    """d(x, y, radius) of each point's circle after Eqs. (18)-(20) / d(x, y) of the point; zero for points of none.

    Args:
      position: the points, in metres. Shape `[N, 2]`.
      clusters: which points belong together, at least two in each.
      jacobians: "autodiff": three reverse passes through the estimate; "analytic": derived by hand.

    Returns:
      Derivatives without unit. Shape `[N, 3, 2]`.

    Raises:
      ValueError: at trace time, if `jacobians` is neither.
    """
    if jacobians == "autodiff":
        arcs, pull_back = jax.vjp(lambda x: arcs_from_points(x, clusters), position)
        seeds = jnp.eye(3, dtype=position.dtype)[:, :, None] * jnp.ones_like(arcs[:1])[None]
        return jnp.stack([pull_back(seed)[0] for seed in seeds], 1)
    if jacobians == "analytic":
        arcs = arcs_from_points(position, clusters)
        n = _count(clusters).astype(position.dtype)
        scale = jnp.where(arcs[2] > 0, 1 / ((n - 1) * jnp.where(arcs[2] > 0, arcs[2], 1)), 0)
        mine = clusters.spread(jnp.concatenate([arcs[:2].T, scale[:, None], 1 / n[:, None]], -1))
        by_center = mine[:, 3, None, None] * jnp.eye(2, dtype=position.dtype)[None]
        by_radius = mine[:, 2, None] * (position - mine[:, :2])
        in_cluster = (clusters.of_point >= 0)[:, None, None]
        return jnp.where(in_cluster, jnp.concatenate([by_center, by_radius[:, None]], 1), 0)
    raise ValueError(f"jacobians must be 'autodiff' or 'analytic', not {jacobians!r}")


def _count(clusters: Runs) -> Int[Array, " K"]:
    """How many points each cluster has; two for a free slot, which divides by nothing."""
    return jnp.where(clusters.valid, clusters.last - clusters.first + 1, 2)


def measure_circles(
    points: Points,
    pose: Pose,
    clusters: Runs,
    thresholds: Thresholds,
    noise: SensorNoise,
    *,
    fit: bool,
    jacobians: Jacobians,
) -> Circles:
    """The circle of each cluster, with its covariance.

    Eqs. (18)-(20) have no covariance in the paper. Here they have that of first order, as lines have, which says how
    far the circle is from the one that the same beams would give without noise. Noise widens the spread of points,
    though: on average the radius is too large by (tr - var) / (2 radius), with tr the mean variance of a point and var
    that of the radius. With many points that is most of the error, and its square is part of the variance.

    The covariance of a fitted circle says how far it is from the pole.

    Args:
      points: the points of the scan.
      pose: of the robot.
      clusters: which points belong together, at least two in each.
      thresholds: `cluster_distance` bounds a fitted radius.
      noise: of the sensor.
      fit: fit a circle where there are points enough; otherwise Eqs. (18)-(20) throughout.
      jacobians: "autodiff" or "analytic", for Eqs. (18)-(20).

    Returns:
      One circle a cluster, in the world.
    """
    arcs = arcs_from_points(points.position, clusters)
    center, radius = arcs[:2].T, arcs[2]
    sigma = jnp.stack([noise.range_sigma, noise.bearing_sigma])
    jac = jac_arc_points(points.position, clusters, jacobians=jacobians)
    from_noise = product(jac, points.jac_measurement) * sigma[None, None]
    of_point = jnp.sum((points.jac_measurement * sigma[None, None]) ** 2, (-1, -2))
    sums = clusters.sum(jnp.concatenate([squared(from_noise).reshape(-1, 9), of_point[:, None]], -1))
    cov = symmetric(sums[:, :9].reshape(-1, 3, 3))
    excess = jnp.maximum(sums[:, 9] / _count(clusters) - cov[:, 2, 2], 0)
    bias = jnp.where(radius > 0, excess / jnp.where(radius > 0, 2 * radius, 1), 0)
    cov = cov.at[:, 2, 2].add(bias**2)
    fitted = jnp.zeros_like(clusters.valid)
    if fit:
        shift, fit_radius, fit_cov, fitted = _fit_circles(points, clusters, center, thresholds, noise)
        center = center + jnp.where(fitted[:, None], shift, 0)
        radius = jnp.where(fitted, fit_radius, radius)
        cov = jnp.where(fitted[:, None, None], fit_cov, cov)
    # The centre moves with the pose as every point does; the radius does not.
    one, zero = jnp.ones_like(radius), jnp.zeros_like(radius)
    turn = perp(center)
    rows = [[one, zero, turn[:, 0]], [zero, one, turn[:, 1]], [zero, zero, zero]]
    jac_circle_pose = jnp.stack([jnp.stack(row, -1) for row in rows], -2)
    circles = Circles(
        center=pose.mean[None, :2] + center,
        radius=radius,
        cov_independent=cov,
        sqrt_persistent=product(jac_circle_pose, square_root(pose.cov)[None]),
        fitted=fitted,
        times_detected=jnp.ones_like(clusters.last),
        times_contradicted=jnp.zeros_like(clusters.last),
        valid=clusters.valid,
    )
    return neutral_where_free(dataclasses.replace(circles, valid=circles.valid & bounded(circles)))


def _fit_circles(
    points: Points,
    clusters: Runs,
    middle: Float[Array, "K 2"],
    thresholds: Thresholds,
    noise: SensorNoise,
) -> tuple[Float[Array, "K 2"], Float[Array, " K"], Float[Array, "K 3 3"], Bool[Array, " K"]]:
    """The most likely circle of each cluster, by Gauss-Newton from the algebraic one of Kasa (1976).

    Args:
      points: the points of the scan.
      clusters: which points belong together.
      middle: the centroids, from the robot. Shape `[K, 2]`.
      thresholds: `cluster_distance`, the largest radius.
      noise: of the sensor.

    Returns:
      The centres from the centroids, the radii, the covariances of (x, y, radius) from the sensor's noise, and which
      fits are to be believed.
    """
    n = _count(clusters)
    z = points.position - clusters.spread(middle)
    w = dot(z, z)
    x, y = z[:, 0], z[:, 1]
    sums = clusters.sum(jnp.stack([x * x, x * y, y * y, x * w / 2, y * w / 2, w], -1))
    sxx, sxy, syy, bx, by, sw = jnp.moveaxis(sums, -1, 0)
    det = sxx * syy - sxy * sxy
    solvable = (n >= MIN_FIT_POINTS) & (det > 1e-6 * (sxx + syy) ** 2)
    safe = jnp.where(solvable, det, 1)
    a, b = (bx * syy - by * sxy) / safe, (by * sxx - bx * sxy) / safe
    circle = jnp.stack([a, b, safe_sqrt(sw / n + a * a + b * b)], -1)
    circle = jnp.where(solvable[:, None], circle, jnp.ones_like(circle))
    laser = points.laser[None] - middle

    # Most scans have few points that may lie on a pole, and the fit is a third of the work on a scan: only these are
    # looked at where there is room for them.
    worth = (clusters.of_point >= 0) & clusters.spread(solvable)
    count, room = jnp.sum(worth), -(-worth.shape[0] // FEW)

    def few(circle: Array) -> _Fit:
        index, some = clusters.only(worth, room)
        return _most_likely(circle, z[index], points.beam[index], some, laser, noise)

    def all_(circle: Array) -> _Fit:
        return _most_likely(circle, z, points.beam, clusters, laser, noise)

    choice = largest_of_batch((count > 0).astype(jnp.int32) + (count > room).astype(jnp.int32))
    fit: _Fit = jax.lax.switch(choice, [_no_fit, few, all_], circle)
    circle, cov, misfit = fit

    center, radius = circle[:, :2], circle[:, 2]
    dof = jnp.maximum(n - 3, 1)
    variances = jnp.diagonal(cov, axis1=-2, axis2=-1)
    var_radius = variances[:, 2]
    believed = (
        solvable
        & jnp.all(jnp.isfinite(circle), -1)
        & jnp.all(jnp.isfinite(cov), (-1, -2))
        & jnp.all(variances > 0, -1)  # rounding has the last word where the beams say nothing of a direction
        # Smaller ones are lost in the noise. Held against the estimate itself, poles of just this radius would be kept
        # if they seem too large and turned away if they seem too small, and come out too large. So with larger ones.
        & (radius + 3 * safe_sqrt(var_radius) >= 5 * noise.range_sigma)
        & (radius - 3 * safe_sqrt(var_radius) < thresholds.cluster_distance)
        & (dot(-laser, center) > 0)  # we see the near side of a pole, never its inside
        & (misfit <= dof + 3 * jnp.sqrt(2 * dof))  # 3 sigma of chi-square
        & (var_radius < (radius / 3) ** 2)
    )
    return center, radius, jnp.where(believed[:, None, None], cov, 0), believed


class _Fit(NamedTuple):
    """Circles fitted to some points."""

    circle: Array  # x, y, radius of each, m
    cov: Array  # of these
    misfit: Array  # chi-square


def _most_likely(
    circle: Float[Array, "K 3"],
    z: Float[Array, "N 2"],
    beam: Float[Array, "N 2"],
    clusters: Runs,
    laser: Float[Array, "K 2"],
    noise: SensorNoise,
) -> _Fit:
    """Gauss-Newton steps from given circles."""

    def normal_equations(circle: Array) -> tuple[Array, Array, Array]:
        """Information, its inverse times the gradient, and chi-square of the misfit."""
        mine = clusters.spread(jnp.concatenate([circle, laser], -1))
        beams = _linearise(z, beam, mine[:, :3], mine[:, 3:], noise)
        weighted = beams.row * beams.weight[:, None]
        # Few columns: the sums are most of the time. The information stands in them as its upper triangle.
        per_point = [
            weighted[:, :1] * beams.row,
            weighted[:, 1:2] * beams.row[:, 1:],
            weighted[:, 2:] * beams.row[:, 2:],
            weighted * beams.residual[:, None],
            (beams.weight * beams.residual**2)[:, None],
        ]
        sums = clusters.sum(jnp.concatenate(per_point, -1))
        cov = inverse(sums[:, jnp.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])])
        return cov, apply(cov, sums[:, 6:9]), sums[:, 9]

    def step(i: Array, fit: _Fit) -> _Fit:
        cov, change, misfit = normal_equations(fit.circle)
        improved = fit.circle + change
        # The last step moves nothing: it says what the others have come to.
        sound = (i < GAUSS_NEWTON_STEPS) & jnp.all(jnp.isfinite(improved), -1) & (improved[:, 2] > 0)
        return _Fit(jnp.where(sound[:, None], improved, fit.circle), cov, misfit)

    return jax.lax.fori_loop(0, GAUSS_NEWTON_STEPS + 1, step, _no_fit(circle))


def _no_fit(circle: Float[Array, "K 3"]) -> _Fit:
    """Circles as they are, of which nothing is known."""
    return _Fit(circle, jnp.zeros((*circle.shape, 3), circle.dtype), jnp.zeros_like(circle[:, 0]))


class _Beams(NamedTuple):
    """The likelihood of a circle around a guess, one row a beam."""

    residual: Array  # u less its expectation, m
    row: Array  # - d(residual) / d(x, y, radius)
    weight: Array  # inverse variance of u, 1/m^2


def _linearise(
    z: Float[Array, "N 2"],
    beam: Float[Array, "N 2"],
    circle: Float[Array, "N 3"],
    laser: Float[Array, "N 2"],
    noise: SensorNoise,
) -> _Beams:
    """The likelihood of each beam of a pole, given that it has met the pole.

    Where a beam meets the circle (center c, radius R) at a range rho and an incidence i, the residual of the measured
    point is u = |p - c| - R. Its noise is -cos(i) e_r + sin(i) w to first order, with w = rho e_alpha the sway of the
    beam at the pole. Second order gives it a mean of (sin^2 sigma_r^2 - (1 + sin^2) sigma_w^2) / (2 R), which would
    make all radii too large.

    A beam that passes the rim within its sway is known to have met the pole, so that its w is normal, cut off at the
    rim: with m the distance to the rim inside of the pole, m + w > 0. Mean and variance of w are then those of a
    truncated normal distribution; they depend on the circle, which takes from what the beam says of it.

    All of this is taken where the beam should meet the circle, not at the noisy point, which would bias the estimate.
    """
    c, radius = circle[:, :2], circle[:, 2]
    to_center = c - laser
    ahead, aside = dot(beam, to_center), -dot(perp(beam), to_center)
    sway = jnp.abs(ahead) * noise.bearing_sigma
    inward, spread = _truncated(radius - jnp.abs(aside), sway)
    sine = jnp.clip((jnp.abs(aside) - inward) / radius, 0, 1)
    least = jnp.minimum(2 * RIM * (noise.range_sigma + sway) / radius, 1)
    cosine2 = jnp.maximum(1 - sine**2, least)
    cosine, sine = safe_sqrt(cosine2), safe_sqrt(1 - cosine2)
    normal = -cosine[:, None] * beam + (jnp.sign(aside) * sine)[:, None] * perp(beam)

    var_range = noise.range_sigma**2
    var_sway = ((ahead - radius * cosine) * noise.bearing_sigma) ** 2
    mean = sine * inward + ((1 - cosine2) * var_range - (2 - cosine2) * var_sway) / (2 * radius)
    variance = cosine2 * var_range + (1 - cosine2) * spread * var_sway
    row = jnp.concatenate([normal, jnp.ones_like(normal[:, :1])], -1) * (1 - sine * (1 - spread))[:, None]
    to_point = z - c
    return _Beams(
        residual=safe_sqrt(dot(to_point, to_point)) - radius - mean,
        row=row,
        weight=1 / jnp.where(variance > 0, variance, 1),
    )


def _truncated(margin: Float[Array, " N"], sigma: Float[Array, " N"]) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """Mean of a centred normal number known to exceed -margin, and its variance over sigma^2."""
    noisy = sigma > 0
    # Beyond four sigma a beam is an outlier, and numbers get lost.
    t = jnp.maximum(jnp.where(noisy, margin / jnp.where(noisy, sigma, 1), 9), -4)
    mills = jnp.exp(-t * t / 2) * math.sqrt(2 / math.pi) / jax.scipy.special.erfc(-t * math.sqrt(0.5))
    return sigma * mills, 1 - mills * (t + mills)


def near_lines(circles: Circles, lines: Lines, thresholds: Thresholds, rules: Rules) -> Bool[Array, " C"]:
    """Section 4.3.1 (circles): which of them lie too close to a line to be modelled; they are probably its noise.

    A fitted circle is a body, and is held against the line with its rim: the bent end of a wall has a centre behind it.
    With `rules.weigh_circles` only lines count that were detected as often as the circle. A departure: three returns of
    a pole far away pass for a line, and that outweighs no pole that was seen a hundred times.

    Args:
      circles: `C` circles.
      lines: `K` lines.
      thresholds: `circle_line_distance`.
      rules: `weigh_circles`.

    Returns:
      Which circles are too close; false for free slots. Shape `[C]`.
    """

    def distance2(center: Float[Array, "2"], line: Lines) -> Float[Array, ""]:
        step = center - line.anchor
        across = dot(line.normal, step) - line.offset
        along = dot(line.tangent, step)
        beyond = along - jnp.clip(along, line.extent[0], line.extent[1])
        return across**2 + beyond**2

    every = jax.vmap(jax.vmap(distance2, (None, 0)), (0, None))(circles.center, directed(lines))
    reach = thresholds.circle_line_distance + jnp.where(circles.fitted, circles.radius, 0)
    counts = lines.valid[None] & (every < reach[:, None] ** 2)
    if rules.weigh_circles:
        counts = counts & (lines.times_detected[None] >= circles.times_detected[:, None])
    return circles.valid & jnp.any(counts, -1)
