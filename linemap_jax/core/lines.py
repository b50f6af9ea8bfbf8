"""Sections 4.2.2 to 4.2.5: from runs of points to lines with covariance and end points, Eqs. (5)-(17).

The estimate is the paper's regression, in the axes of the world (turned axes would give another line, by some tenths of
a sigma), with sums from the run's first point. It is expressed as (offset, angle) at an anchor on the segment; (rho,
theta) of Eqs. (9)-(10) is the same line seen from the origin of the world, `rho_theta`.

Every point belongs to one run, so that the Jacobians of all lines of a scan follow from two reverse passes: one of the
sum of all offsets, one of the sum of all angles.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core import likelihood
from linemap_jax.core.frames import dot, perp, shift_matrix, wrap_angle
from linemap_jax.core.propagation import product, propagate, quadratic, square_root, symmetric
from linemap_jax.core.runs import Runs
from linemap_jax.core.segmentation.incremental import Run, gap_gate
from linemap_jax.core.sensor import Points, cov_point
from linemap_jax.core.settings import Covariance, Jacobians, Number, Rules, SensorNoise, Thresholds
from linemap_jax.core.slots import bounded, computed_once, earliest_true, latest_true, neutral_where_free
from linemap_jax.core.state import Lines, Pose, pytree, squared

MIN_POINTS = 3
"""At least three points are necessary to define a line (s4.3.1)."""
UNSURE_SIGMAS = 3.0
"""Noise may have decided what is closer than this to a gate, or to the line beside its own."""
LEAST_SHARE = 1 / 3
"""Of the points of a run must be left for the fit. A line through few of them, chosen by the line through all, would
err by far more than it says."""
WIDENED = 1.5
"""Gate of criterion 2 at the end of a run of a few points, by that of a long one: what their line is uncertain by adds
to the noise of the point, four times its variance over their number, and points that passed have turned it."""
INWARD = 4
"""So many points of a run are asked from either end whether they may end the line."""
GRAZING = 0.01
"""Least cosine of an incidence that is reckoned with."""


@pytree
class Regression:
    """The regression of each run, Eqs. (5)-(8), in coordinates from the run's first point.

    With `steep` false the line is y = slope x + intercept, (m, q) of Eq. (7); with `steep` true it is
    x = slope y + intercept, (s, t) of Eq. (8).
    """

    count: Float[Array, " K"]
    """Number of points."""
    origin: Float[Array, "K 2"]
    """The first point, m."""
    centroid: Float[Array, "K 2"]
    """Mean of the points, from the first point, m."""
    steep: Bool[Array, " K"]
    """Whether x was regressed on y, (s, t), else y on x, (m, q)."""
    width: Float[Array, " K"]
    """N_1 or N_2 of Eq. (6), m^2."""
    slope: Float[Array, " K"]
    """m of Eq. (7), or s of Eq. (8)."""
    direction: Float[Array, "K 2"]
    """Along the line, from the first point towards the last; not normalised."""


def regress(position: Float[Array, "N 2"], runs: Runs) -> Regression:
    """Eqs. (5)-(8) for all runs: the choice between (m, q) and (s, t), and the slope.

    The intercept is not formed: the line passes through the centroid.

    Args:
      position: the points, in metres. Shape `[N, 2]`.
      runs: which points belong together.

    Returns:
      A fit for each run; of a free slot it means nothing, and is finite.
    """
    # The origin is a constant of the sums, not a variable of the estimate: shifting all sums changes no line.
    origin = jax.lax.stop_gradient(position[runs.first])
    x, y = jnp.moveaxis(position - runs.spread(origin), -1, 0)
    # Eq. (5)
    sums = runs.sum(jnp.stack([jnp.ones_like(x), x, y, x * x, y * y, x * y], -1))
    n, rx, ry, rxx, ryy, rxy = jnp.moveaxis(sums, -1, 0)
    n = jnp.maximum(n, 1)
    # Eq. (6)
    n1, n2 = rxx * n - rx * rx, ryy * n - ry * ry
    t = rxy * n - rx * ry
    steep = n1 < n2
    width = jnp.where(steep, n2, n1)
    # Eqs. (7)-(8); the width is zero where all points are equal, and then the slope is taken as zero.
    slope = t / jnp.where(width > 0, width, 1)
    one = jnp.ones_like(slope)
    direction = jnp.where(steep[:, None], jnp.stack([slope, one], -1), jnp.stack([one, slope], -1))
    ahead = dot(direction, position[runs.last] - position[runs.first]) >= 0
    return Regression(
        count=n,
        origin=origin,
        centroid=jnp.stack([rx, ry], -1) / n[:, None],
        steep=steep,
        width=width,
        slope=slope,
        direction=jnp.where(ahead, 1, -1)[:, None] * direction,
    )


def line_from_regression(fit: Regression, anchor: Float[Array, "K 2"]) -> Float[Array, "2 K"]:
    """Offset and angle of each line at an anchor: Eqs. (9)-(10) with the anchor for an origin.

    These are the functions of the regression that Eqs. (13)-(14) mean.

    Departures from the paper: no absolute value in Eq. (9), since the offset is signed; the four-quadrant arctangent
    for Eq. (10), which is undefined as printed for a line through the origin.

    Args:
      fit: the regressions.
      anchor: in the coordinates of the points. Shape `[K, 2]`.

    Returns:
      Offsets in metres and angles of the normals in radians, shape `[2, K]`. The direction from the first point to the
      last one lies 90 degrees to the left of the normal; the paper's, with rho >= 0, is the opposite one where the
      offset from the origin is negative.
    """
    tangent = fit.direction / jnp.sqrt(dot(fit.direction, fit.direction))[:, None]
    normal = -perp(tangent)
    angle = jnp.arctan2(tangent[:, 1], tangent[:, 0]) - jnp.pi / 2
    return jnp.stack([dot(normal, fit.origin + fit.centroid - anchor), wrap_angle(angle)])


def jac_line_points(
    position: Float[Array, "N 2"], runs: Runs, anchor: Float[Array, "K 2"], *, jacobians: Jacobians
) -> Float[Array, "N 2 2"]:
    """d(offset, angle) of each point's line / d(x, y) of the point; zero for points of no line.

    The line is that function of its points of which Eq. (11) speaks.

    Args:
      position: the points, in metres. Shape `[N, 2]`.
      runs: the lines that they belong to.
      anchor: of each line, held fixed. Shape `[K, 2]`.
      jacobians: "autodiff": two reverse passes through the estimate; "analytic": H J by the paper's way.

    Returns:
      H J, without unit, and rad/m. Shape `[N, 2, 2]`.

    Raises:
      ValueError: at trace time, if `jacobians` is neither.
    """
    if jacobians == "autodiff":
        _, pull_back = jax.vjp(lambda x: line_from_regression(regress(x, runs), anchor), position)
        seeds = jnp.eye(2, dtype=position.dtype)[:, :, None] * jnp.ones_like(anchor[None, None, :, 0])
        offset, angle = (pull_back(seed)[0] for seed in seeds)
        return jnp.stack([offset, angle], 1)
    if jacobians == "analytic":
        fit = regress(position, runs)
        jac = jac_regression_points(position, runs, fit, anchor)
        in_run = (runs.of_point >= 0)[:, None, None]
        return jnp.where(in_run, product(runs.spread(jac_line_regression(fit, anchor)), jac), 0)
    raise ValueError(f"jacobians must be 'autodiff' or 'analytic', not {jacobians!r}")


def jac_regression_points(
    position: Float[Array, "N 2"], runs: Runs, fit: Regression, anchor: Float[Array, "K 2"]
) -> Float[Array, "N 2 2"]:
    """J of Eq. (12), derived by hand: d(m, q) / d(x, y), or d(s, t) / d(x, y), with the intercept at the anchor.

    Args:
      position: the points, in metres. Shape `[N, 2]`.
      runs: the lines that they belong to.
      fit: `regress` of both.
      anchor: of each line, held fixed, m. Shape `[K, 2]`.

    Returns:
      J of each point's line; 1/m, and without unit. Shape `[N, 2, 2]`.
    """
    centre = fit.origin + fit.centroid
    columns = [x[:, None] for x in (fit.count, fit.width, fit.slope, fit.steep.astype(anchor.dtype))]
    mine = runs.spread(jnp.concatenate([*columns, centre, centre - anchor], -1))
    n, width, slope, steep = mine[:, 0], mine[:, 1], mine[:, 2], mine[:, 3] > 0
    mean, lever = mine[:, 4:6], mine[:, 6:8]
    from_mean = n[:, None] * (position - mean)
    # (u, w): regressor and response; (x, y) for (m, q), (y, x) for (s, t)
    u, w = _regressor_first(from_mean, steep)
    u_mean, _ = _regressor_first(lever, steep)
    width = jnp.where(width > 0, width, 1)
    slope_w = u / width
    slope_u = (w - 2 * slope * u) / width
    intercept_w = 1 / n - u_mean * slope_w
    intercept_u = -slope / n - u_mean * slope_u
    by_u = jnp.stack([slope_u, intercept_u], -1)
    by_w = jnp.stack([slope_w, intercept_w], -1)
    by_x = jnp.where(steep[:, None], by_w, by_u)
    by_y = jnp.where(steep[:, None], by_u, by_w)
    return jnp.stack([by_x, by_y], -1)


def jac_line_regression(fit: Regression, anchor: Float[Array, "K 2"]) -> Float[Array, "K 2 2"]:
    """H of Eqs. (15)-(17), derived by hand: d(offset, angle) / d(m, q) or / d(s, t), intercept at the anchor.

    Departures from the paper, whose print is wrong: the labels of the off-diagonal elements of H are swapped in
    (16)-(17); the sign that |.| of Eq. (9) takes away is kept; the (s, t) case has its own H, with
    d(angle)/ds = -1/(1 + s^2).

    Args:
      fit: the regressions.
      anchor: of each line, held fixed, m. Shape `[K, 2]`.

    Returns:
      H of each line; m, without unit, and rad, rad/m. Shape `[K, 2, 2]`. The offset has the sign that
      `line_from_regression` says: for rho the first row is multiplied by that sign.
    """
    a = fit.slope
    norm2 = 1 + a * a
    u_mean, w_mean = _regressor_first(fit.origin + fit.centroid - anchor, fit.steep)
    intercept = w_mean - a * u_mean
    # The normal is (m, -1) / sqrt(1 + m^2) for y = m x + q, (1, -s) / sqrt(1 + s^2) for x = s y + t, and is turned by
    # 180 degrees where the direction was.
    forward = jnp.where(fit.steep, fit.direction[:, 1], fit.direction[:, 0])
    sign = jnp.where(fit.steep, 1, -1) * jnp.sign(forward)
    offset_slope = -sign * intercept * a / norm2**1.5
    offset_intercept = sign / jnp.sqrt(norm2)
    angle_slope = jnp.where(fit.steep, -1, 1) / norm2
    zero = jnp.zeros_like(a)
    return jnp.stack([jnp.stack([offset_slope, offset_intercept], -1), jnp.stack([angle_slope, zero], -1)], -2)


def measure_lines(
    points: Points,
    pose: Pose,
    runs: Runs,
    noise: SensorNoise,
    *,
    maximum_likelihood: bool,
    covariance: Covariance,
    jacobians: Jacobians,
    min_length: Number = 0.0,
) -> tuple[Lines, Float[Array, "K 2 3"], Float[Array, "K 2 2"]]:
    """The line of each run, with its covariance: sections 4.2.2 to 4.2.5.

    "exact": Eq. (12) sums the points as if they were independent, but all points of a scan share one pose error, which
    Eq. (4) put into each of them. To first order the covariance is M + P C_pose P^T with M = sum J G C_s G^T J^T and
    P = sum J F. "printed" is Eq. (12) to the letter; there the pose error counts as noise of the points, so that all of
    it stands in M, and P is zero.

    Args:
      points: the points of the scan.
      pose: of the robot.
      runs: the runs that are lines; free slots give free lines.
      noise: of the sensor.
      maximum_likelihood: go on from the regression by a step of `likelihood`.
      covariance: "exact" or "printed".
      jacobians: "autodiff" or "analytic".
      min_length: a line that comes out shorter is none, m.

    Returns:
      The lines in the world; P, shape `[K, 2, 3]`; M, shape `[K, 2, 2]`, both for (offset, angle).

    Raises:
      ValueError: at trace time, for a `covariance` or `jacobians` that does not exist.
    """
    fit = regress(points.position, runs)
    robot = pose.mean[None, :2]
    anchor_world = robot + (fit.origin + fit.centroid)
    # Rounding has moved the anchor by up to half a digit of the world's coordinates; the offset makes up for it.
    anchor = anchor_world - robot
    line = line_from_regression(fit, anchor)
    if maximum_likelihood:
        at = likelihood.linearise(points, runs, anchor, line, noise)
        jac = likelihood.jac_step_points(points.position, runs, line, at, jacobians=jacobians)
        line = likelihood.step(points.position, runs, line, at)
    else:
        jac = jac_line_points(points.position, runs, anchor, jacobians=jacobians)
    offset, angle = line
    ends = _ends(points, runs, anchor, line, noise)
    extent = line_extent(points.position, ends, anchor, angle)

    sigma = jnp.stack([noise.range_sigma, noise.bearing_sigma])
    from_noise = product(jac, points.jac_measurement) * sigma[None, None]
    from_pose = product(jac, points.jac_pose)
    spread = product(from_noise, jnp.swapaxes(from_noise, -1, -2))
    if covariance == "printed":
        # By a square root, as rounding must not make it indefinite where the pose is sure of a direction.
        spread, from_pose = spread + squared(product(from_pose, square_root(pose.cov)[None])), jnp.zeros_like(from_pose)
    elif covariance != "exact":
        raise ValueError(f"covariance must be 'exact' or 'printed', not {covariance!r}")
    sums = runs.sum(jnp.concatenate([spread, from_pose], -1))
    cov_measurement, jac_line_pose = symmetric(sums[..., :2]), sums[..., 2:]

    lines = Lines(
        anchor=anchor_world,
        offset=offset,
        angle=angle,
        cov_independent=cov_measurement,
        sqrt_persistent=product(jac_line_pose, square_root(pose.cov)[None]),
        first_angle=angle,
        extent=extent,
        var_extent=_var_extent(points, pose, ends, angle, noise),
        times_detected=jnp.ones_like(runs.first),
        times_contradicted=jnp.zeros_like(runs.first),
        valid=runs.valid & (extent[:, 1] - extent[:, 0] >= min_length),
    )
    lines = dataclasses.replace(lines, valid=lines.valid & bounded(lines))
    measured = lines.valid[:, None, None]
    return neutral_where_free(lines), jnp.where(measured, jac_line_pose, 0), jnp.where(measured, cov_measurement, 0)


def _ends(
    points: Points, runs: Runs, anchor: Float[Array, "K 2"], line: Float[Array, "2 K"], noise: SensorNoise
) -> Int[Array, "K 2"]:
    """Which points end each line: the outermost of the fit, or one farther out that was left out and lies on the line.

    Far away a run may go on round a corner. The points there are left out of the fit, and the last of them may lie
    decimetres beside the line. From either end of the run `INWARD` points are looked at; what is on the line by
    `UNSURE_SIGMAS` may end it.
    """
    offset, angle = line
    normal = jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)[:, None, None]
    of_fit, count = runs.of_point >= 0, runs.of_point.shape[0]
    first = jnp.minimum(earliest_true(of_fit)[runs.first], count - 1)
    last = jnp.maximum(latest_true(of_fit)[runs.last], 0)
    inward = jnp.arange(INWARD, dtype=jnp.int32)[None]
    farther = jnp.stack([runs.first[:, None] + inward, runs.last[:, None] - inward], 1)  # [K, 2, INWARD]
    farther = jnp.clip(farther, 0, count - 1)
    across = dot(normal, points.position[farther] - anchor[:, None, None]) - offset[:, None, None]
    variance = _var_across(dot(normal, points.beam[farther]) ** 2, points.range[farther], noise)
    on_line = across**2 <= UNSURE_SIGMAS**2 * variance
    outside = jnp.stack([farther[:, 0] < first[:, None], farther[:, 1] > last[:, None]], 1)
    ends = jnp.stack([first, last], -1)
    for i in reversed(range(INWARD)):
        ends = jnp.where(on_line[..., i] & outside[..., i], farther[..., i], ends)
    return ends


def line_extent(
    position: Float[Array, "N 2"], ends: Int[Array, "K 2"], anchor: Float[Array, "K 2"], angle: Float[Array, " K"]
) -> Float[Array, "K 2"]:
    """Section 4.2.4: the first and the last point of each line, projected on it; metres from the anchor.

    Args:
      position: the points, in metres. Shape `[N, 2]`.
      ends: which of them are the first and the last one of each line. Shape `[K, 2]`.
      anchor: of each line, in the coordinates of the points, m. Shape `[K, 2]`.
      angle: of each line's normal, rad. Shape `[K]`.

    Returns:
      Begin and end along the tangent, m. Shape `[K, 2]`.
    """
    tangent = jnp.stack([-jnp.sin(angle), jnp.cos(angle)], -1)
    return dot(tangent[:, None], position[ends] - anchor[:, None])


def choose_points(
    points: Points, runs: Runs, thresholds: Thresholds, noise: SensorNoise, rules: Rules
) -> tuple[Runs, Runs]:
    """Which runs are lines, and which of their points the fit should use: the rules `leave_out_...` and `check_ends`.

    A choice that depends on the noise of the points it makes biases what is fitted to them. So it is made by where the
    line of the run, and the lines beside it, say that the points are; or by a gate that noise alone hardly ever passes.

    Args:
      points: the points of the scan.
      runs: the runs that may be lines, in the order of the sweep.
      thresholds: criteria 1 and 2, and `cluster_distance`.
      noise: of the sensor.
      rules: which points are left out.

    Returns:
      The runs without those that the circles should have, in the same slots; and the points of them for the fit, not
      valid where less than a third, or fewer than three, are left.
    """
    if not (
        rules.leave_out_arcs
        or rules.leave_out_corners
        or rules.leave_out_sparse
        or rules.check_ends
        or rules.leave_out_ends
    ):
        return runs, runs
    fit = regress(points.position, runs)
    length2 = jnp.maximum(dot(fit.direction, fit.direction), 1)
    normal = perp(fit.direction) / jnp.sqrt(length2)[:, None]
    if rules.leave_out_arcs:
        bent = _bent(points, runs, fit, normal, thresholds, noise)
        of_point = jnp.where(runs.spread(bent), -1, runs.of_point)
        runs = dataclasses.replace(runs, of_point=of_point, valid=runs.valid & ~bent)
    kept = runs.of_point >= 0
    if rules.leave_out_corners:
        kept &= ~_at_corners(points, runs, normal, fit.origin + fit.centroid, fit.count, noise)
    if rules.leave_out_sparse:
        kept &= ~_sparse(points, runs.spread(normal), thresholds, noise)
    if rules.check_ends:
        kept &= ~_strange_ends(points, runs, fit, normal, thresholds, noise)
    if rules.leave_out_ends:
        kept &= ~_near_ends(points, runs, fit.count, thresholds, noise)
    kept = computed_once(lambda x: x, kept)  # many kernels read it
    count = runs.sum(kept.astype(fit.count.dtype))
    valid = runs.valid & _enough(count, fit.count)
    return runs, dataclasses.replace(runs, of_point=jnp.where(kept, runs.of_point, -1), valid=valid)


def _bent(
    points: Points, runs: Runs, fit: Regression, normal: Float[Array, "K 2"], thresholds: Thresholds, noise: SensorNoise
) -> Bool[Array, " K"]:
    """The runs that bend as a pole does.

    The gate of criterion 2 is five sigma wide. With noise of 2 cm the front of a pole of 20 cm passes it, point by
    point; all points together tell. A run bends if the parabola through it bulges towards the scanner, surely so, and
    is no flatter than a circle of twice the largest radius that is fitted. What is told by residuals from the line has
    no part in the line, so that walls that go by mistake do not bias those that stay.
    """
    middle = fit.origin + fit.centroid
    away = jnp.where(dot(normal, middle - points.laser[None]) > 0, 1, -1)[:, None] * normal
    mine = runs.spread(jnp.concatenate([away, middle], -1))
    from_middle = points.position - mine[:, 2:]
    along, depth = dot(perp(mine[:, :2]), from_middle), dot(mine[:, :2], from_middle)
    square = along * along
    columns = [square, square * along, square * square, along * depth, square * depth]
    s2, s3, s4, along_depth, square_depth = jnp.moveaxis(runs.sum(jnp.stack(columns, -1)), -1, 0)
    # The square of the distance along the line, less the line through that, regressed on the depth
    skew = s3 / jnp.where(s2 > 0, s2, 1)
    spread = s4 - s2 * s2 / fit.count - s3 * skew
    bulge = square_depth - skew * along_depth
    halfway = (runs.first + runs.last) // 2
    variance = _var_across(dot(away, points.beam[halfway]) ** 2, points.range[halfway], noise)
    surely = (bulge > 0) & (bulge * bulge > UNSURE_SIGMAS**2 * variance * spread)
    return runs.valid & surely & (4 * thresholds.cluster_distance * bulge > spread)


def _at_corners(
    points: Points,
    runs: Runs,
    normal: Float[Array, "K 2"],
    middle: Float[Array, "K 2"],
    size: Float[Array, " K"],
    noise: SensorNoise,
) -> Bool[Array, " N"]:
    """The points at the ends of the runs that may belong to the line beside them.

    Just past a corner, points of the next wall still pass criterion 2. At an end of a run, a point that lies within
    `UNSURE_SIGMAS` of the line next to it in the sweep is left out of the fit, with all points beyond it; unless less
    than a third would be left, as where two pieces of one wall follow each other, or fewer than three. A run that began
    before a corner may hold many points of the wall that ended there: on a short wall they are half of it.
    """
    index = jnp.arange(runs.of_point.shape[0], dtype=jnp.int32)
    count = runs.valid.shape[0]
    most = size - jnp.maximum(size / 3, MIN_POINTS)
    left_out = jnp.zeros(index.shape, bool)
    for side in (-1, 1):
        # The line beside each run, in front of its first point or behind its last one
        beside = jnp.clip(jnp.arange(count) + side, 0, count - 1)
        exists = runs.valid & runs.valid[beside] & (beside != jnp.arange(count))
        there = runs.spread(jnp.concatenate([normal[beside], middle[beside]], -1))
        across = dot(there[:, :2], points.position - there[:, 2:])
        variance = _var_across(dot(there[:, :2], points.beam) ** 2, points.range, noise)
        own = (runs.of_point >= 0) & (across**2 > UNSURE_SIGMAS**2 * variance)
        # How many points of the run come beyond the outermost one that is surely its own
        if side > 0:
            beyond, from_end = runs.last - latest_true(own)[runs.last], runs.last[runs.of_point] - index
        else:
            beyond, from_end = earliest_true(own)[runs.first] - runs.first, index - runs.first[runs.of_point]
        trimmed = jnp.where(exists & (beyond <= most), beyond, 0)[runs.of_point]
        left_out |= from_end < trimmed
    return left_out


def _sparse(
    points: Points, normal: Float[Array, "N 2"], thresholds: Thresholds, noise: SensorNoise
) -> Bool[Array, " N"]:
    """The points that may be too far from their neighbours for criterion 1, by `UNSURE_SIGMAS` of that distance.

    Where a beam meets the line at an incidence i, the next point is r spacing / cos(i) away. That distance errs by the
    noise of two ranges, and by two bearings' noise, which moves where beams meet the line.
    """
    cosine2 = jnp.maximum(dot(normal, points.beam) ** 2, GRAZING**2)
    arc = points.range * points.spacing
    sway = (points.range * noise.bearing_sigma) ** 2 * (1 - cosine2) / cosine2
    unsure = UNSURE_SIGMAS * jnp.sqrt(2 * (noise.range_sigma**2 + sway))
    return arc / jnp.sqrt(cosine2) + unsure >= gap_gate(arc, thresholds, noise)


def _strange_ends(
    points: Points,
    runs: Runs,
    fit: Regression,
    normal: Float[Array, "K 2"],
    thresholds: Thresholds,
    noise: SensorNoise,
) -> Bool[Array, " N"]:
    """The first and last points of the runs that do not lie on the line of the other points.

    The first three points of a run join it unseen, and the gate of criterion 2 is wide while a line is short: a point
    of another thing may begin it. Here criterion 2 holds it against all the others. The distance d of a point of
    leverage h becomes d / (1 - h) if the line does without that point, and its variance the noise's by 1 / (1 - h).
    """
    strange = jnp.zeros(runs.of_point.shape, bool)
    for at in (runs.first, runs.last):
        from_middle = points.position[at] - fit.origin - fit.centroid
        u, _ = _regressor_first(from_middle, fit.steep)
        rest = jnp.maximum(1 - 1 / fit.count - fit.count * u * u / jnp.where(fit.width > 0, fit.width, 1), 0)
        variance = _var_across(dot(normal, points.beam[at]) ** 2, points.range[at], noise)
        gate = jnp.maximum(thresholds.line_distance**2 * rest**2, thresholds.line_sigmas**2 * variance * rest)
        out = runs.valid & (dot(normal, from_middle) ** 2 > gate)
        strange = strange.at[jnp.where(out, at, strange.shape[0])].set(True, mode="drop")
    return strange


def _near_ends(
    points: Points, runs: Runs, size: Float[Array, " K"], thresholds: Thresholds, noise: SensorNoise
) -> Bool[Array, " N"]:
    """The points nearest to the ends of the runs: the first and the last one, and more where enough are left.

    Past an end of a wall criterion 2 lets points of what stands across it pass, until they are as far away as it
    reaches. One scan hardly shows it, but fifty scans from one side all err alike. So whoever they are, what is as near
    as that to the first or last point of a run is left out, while enough are left; and the first and the last one
    always: one point of what stands across turns a line of three or four beams, and does not show. Who decides by
    residuals keeps those that noise has moved to the line.
    """
    index = jnp.arange(runs.of_point.shape[0], dtype=jnp.int32)
    ends = runs.spread(jnp.concatenate([points.position[runs.first], points.position[runs.last]], -1))
    from_end = jnp.minimum(index - runs.first[runs.of_point], runs.last[runs.of_point] - index)
    reach2 = thresholds.line_sigmas**2 * (noise.range_sigma**2 + (points.range * noise.bearing_sigma) ** 2)
    reach2 = WIDENED**2 * jnp.maximum(reach2, thresholds.line_distance**2)
    steps = points.position - ends[:, :2], points.position - ends[:, 2:]
    near = (dot(steps[0], steps[0]) <= reach2) | (dot(steps[1], steps[1]) <= reach2)
    spare = jnp.maximum((size - jnp.maximum(jnp.ceil(LEAST_SHARE * size), MIN_POINTS)) // 2, 1)
    return (runs.of_point >= 0) & near & (from_end < runs.spread(spare))


def _enough(count: Float[Array, " K"], size: Float[Array, " K"]) -> Bool[Array, " K"]:
    """Whether so many of the points of runs of some size make a line."""
    return (count >= MIN_POINTS) & (count >= LEAST_SHARE * size)


def _var_across(cosine2: Float[Array, "*s"], range_: Float[Array, "*s"], noise: SensorNoise) -> Float[Array, "*s"]:
    """Variance of points across a line that their beams meet at an incidence of this squared cosine, m^2."""
    return noise.range_sigma**2 * cosine2 + (range_ * noise.bearing_sigma) ** 2 * (1 - cosine2)


def length_of_run(run: Run, position: Float[Array, "N 2"]) -> Float[Array, " N"]:
    """The length of the segment that a run would give, for the rule of s4.3.1.

    Args:
      run: the runs as they stood at each point.
      position: that point, their last one. Shape `[N, 2]`.

    Returns:
      Lengths in metres. Shape `[N]`.
    """
    n1, n2 = run.rxx * run.n - run.rx * run.rx, run.ryy * run.n - run.ry * run.ry
    t = run.rxy * run.n - run.rx * run.ry
    steep = n1 < n2
    width = jnp.where(steep, n2, n1)
    slope = t / jnp.where(width > 0, width, 1)
    x, y = position[:, 0] - run.x0, position[:, 1] - run.y0
    along = jnp.where(steep, y + slope * x, x + slope * y)
    return jnp.abs(along) / jnp.sqrt(1 + slope * slope)


def _var_extent(
    points: Points, pose: Pose, ends: Int[Array, "K 2"], angle: Float[Array, " K"], noise: SensorNoise
) -> Float[Array, "K 2"]:
    """Variance of the end points along the line, m^2.

    That of the outermost point, and that of a uniform distribution between it and the next beam, where the surface may
    have ended. Not in the paper, whose end points have no uncertainty.
    """
    tangent = jnp.stack([-jnp.sin(angle), jnp.cos(angle)], -1)[:, None]
    cov = cov_point(points.jac_pose[ends], points.jac_measurement[ends], pose.cov, noise)
    # A grazing beam says nothing about the end; 0.1 is 6 degrees.
    step = points.spacing * points.range[ends] / jnp.maximum(jnp.abs(dot(-perp(tangent), points.beam[ends])), 0.1)
    return jnp.maximum(quadratic(tangent, cov), 0) + step**2 / 12  # rounding may leave less than nothing


def rho_theta(lines: Lines) -> tuple[Float[Array, " K"], Float[Array, " K"], Float[Array, "K 2 2"]]:
    """The paper's view of a line, Eq. (1): the normal form with respect to the origin of the world.

    For display and export. Near the origin rho >= 0 turns theta by pi, and far from it the covariance of the view
    fails, in float64 too (mean NEES 2.3 at 100 m, 29 at 1 km): compare and fuse lines at an anchor, not here.

    Args:
      lines: `K` lines.

    Returns:
      rho >= 0 in metres, shape `[K]`; theta in radians in (-pi, pi], shape `[K]`; the covariance of (rho, theta), shape
      `[K, 2, 2]`.
    """
    rho = lines.offset + dot(lines.normal, lines.anchor)
    cov = propagate(shift_matrix(dot(lines.tangent, lines.anchor)), lines.cov)
    behind = rho < 0
    # -rho with theta + pi is the same line; the covariance of (-rho, theta) has its off-diagonal turned.
    sign = jnp.where(behind, -1, 1).astype(cov.dtype)
    flip = jnp.stack([jnp.stack([sign * sign, sign], -1), jnp.stack([sign, sign * sign], -1)], -2)
    return jnp.abs(rho), wrap_angle(jnp.where(behind, lines.angle + jnp.pi, lines.angle)), cov * flip


def _regressor_first(vector: Float[Array, "M 2"], steep: Bool[Array, " M"]) -> tuple[Array, Array]:
    x, y = vector[:, 0], vector[:, 1]
    return jnp.where(steep, y, x), jnp.where(steep, x, y)
