"""The paper's formulas once more, in plain NumPy and float64: the estimates, and their derivatives as derived by hand.

Typed from the paper, not from `core`, and without jax, so that a mistake would have to be made twice to stay unseen.
Lines are given as (m, q) of y = m x + q where `steep` is false, as (s, t) of x = s y + t where it is true, with the
intercept at an anchor. `forward` tells which of its two directions a line has: along the regressor, or against it.
"""

import numpy as np
from jaxtyping import Bool, Float

Two = Float[np.ndarray, "2"]
Three = Float[np.ndarray, "3"]
Rows = Float[np.ndarray, "N 2"]
Matrix = Float[np.ndarray, "2 2"]
Flag = bool | Bool[np.ndarray, ""]


def point(pose: Three, measurement: Float[np.ndarray, "2 *s"], mount: Three) -> Float[np.ndarray, "2 *s"]:
    """Eq. (2) for one beam or many, with the turn of the scanner on the robot added to the bearing."""
    x, y, theta = pose
    r, alpha = measurement
    dx, dy, turn = mount
    xp = x + dx * np.cos(theta) - dy * np.sin(theta) + r * np.cos(alpha + turn + theta)
    yp = y + dx * np.sin(theta) + dy * np.cos(theta) + r * np.sin(alpha + turn + theta)
    return np.array([xp, yp])


def f_of_equation_4(pose: Three, measurement: Two, mount: Three) -> Float[np.ndarray, "2 3"]:
    """F of Eq. (4), d(xp, yp) / d(x, y, theta): each turned part of the point is turned by 90 degrees more."""
    xp, yp = point(pose, measurement, mount) - pose[:2]
    return np.array([[1, 0, -yp], [0, 1, xp]])


def g_of_equation_4(pose: Three, measurement: Two, mount: Three) -> Matrix:
    """G of Eq. (4), d(xp, yp) / d(r, alpha)."""
    r, beam = measurement[0], measurement[1] + mount[2] + pose[2]
    return np.array([[np.cos(beam), -r * np.sin(beam)], [np.sin(beam), r * np.cos(beam)]])


def regression(points: Rows, anchor: Two, steep: Flag) -> Two:
    """Eqs. (5)-(8): slope and intercept at the anchor. The sums are from the first point, and no line minds."""
    n, _, _, width, t, (ru, rv) = _sums(points, steep)
    slope = t / width
    level = (rv - slope * ru) / n
    u0, v0 = _regressor_first(anchor - points[0], steep)
    return np.array([slope, level + slope * u0 - v0])


def j_of_equation_12(points: Rows, anchor: Two, steep: Flag) -> Float[np.ndarray, "2 n"]:
    """J of Eq. (12) for all points: d(m, q) / d(x_1, y_1, x_2, ...), or d(s, t) / d(x_1, y_1, x_2, ...).

    From T = n R_uv - R_u R_v and N = n R_uu - R_u^2, by the quotient rule. The first point, from which the sums are,
    counts as a fixed place.
    """
    n, u, v, width, t, (ru, rv) = _sums(points, steep)
    slope = t / width
    t_u, t_v = n * v - rv, n * u - ru
    width_u = 2 * (n * u - ru)
    slope_u, slope_v = (t_u * width - t * width_u) / width**2, t_v / width
    level_u, level_v = -(slope + ru * slope_u) / n, (1 - ru * slope_v) / n
    u0, _ = _regressor_first(anchor - points[0], steep)
    intercept_u, intercept_v = level_u + slope_u * u0, level_v + slope_v * u0
    by_u, by_v = np.stack([slope_u, intercept_u]), np.stack([slope_v, intercept_v])
    return np.stack([by_v, by_u] if steep else [by_u, by_v], -1).reshape(2, -1)


def line(slope_intercept: Two, steep: Flag, forward: Flag) -> Two:
    """Eqs. (9)-(10) with the sign kept: offset and angle of the normal, which has the line's direction on its left."""
    a, b = slope_intercept
    ahead = 1 if forward else -1
    if steep:  # the normal is (1, -s), ahead
        return np.array([ahead * b / np.sqrt(a**2 + 1), -np.arctan(a) + (0 if forward else np.pi)])
    return np.array([-ahead * b / np.sqrt(a**2 + 1), np.arctan(a) - ahead * np.pi / 2])


def h_of_equations_15_to_17(slope_intercept: Two, steep: Flag, forward: Flag) -> Matrix:
    """H of Eq. (15), d(offset, angle) / d(m, q) or d(s, t): each element where it belongs, with its sign."""
    a, b = slope_intercept
    sign = (1 if forward else -1) * (1 if steep else -1)
    turn = -1 if steep else 1
    return np.array([[-sign * b * a / (a**2 + 1) ** 1.5, sign / np.sqrt(a**2 + 1)], [turn / (1 + a**2), 0]])


def line_of_points(points: Rows, anchor: Two, steep: Flag, forward: Flag) -> Two:
    """Eqs. (5)-(10): offset and angle of the line through some points."""
    return line(regression(points, anchor, steep), steep, forward)


def jac_line_points(points: Rows, anchor: Two, steep: Flag, forward: Flag) -> Float[np.ndarray, "2 n"]:
    """H J: d(offset, angle) / d(x_1, y_1, x_2, ...)."""
    h = h_of_equations_15_to_17(regression(points, anchor, steep), steep, forward)
    return h @ j_of_equation_12(points, anchor, steep)


def points_of_scan(pose: Three, measurements: Rows, mount: Three) -> Rows:
    """Eq. (2) for all beams, from the robot's position: it takes digits from the points and adds nothing to a line."""
    here = np.array([0, 0, pose[2]])
    return point(here, measurements.T, mount).T


def line_of_scan(pose: Three, measurements: Rows, mount: Three, anchor: Two, steep: Flag, forward: Flag) -> Two:
    """Eqs. (2)-(10): offset and angle of the line through the points of some beams, at an anchor in the world."""
    return line_of_points(points_of_scan(pose, measurements, mount), anchor - pose[:2], steep, forward)


def jac_line_pose(
    pose: Three, measurements: Rows, mount: Three, anchor: Two, steep: Flag, forward: Flag
) -> Float[np.ndarray, "2 3"]:
    """P, the sum of H J F over all points: d(offset, angle) / d(x, y, theta)."""
    jac = jac_line_points(points_of_scan(pose, measurements, mount), anchor - pose[:2], steep, forward)
    return jac @ np.concatenate([f_of_equation_4(pose, s, mount) for s in measurements])


def jac_line_measurements(
    pose: Three, measurements: Rows, mount: Three, anchor: Two, steep: Flag, forward: Flag
) -> Float[np.ndarray, "2 n"]:
    """H J G of each point: d(offset, angle) / d(r_1, alpha_1, r_2, ...)."""
    jac = jac_line_points(points_of_scan(pose, measurements, mount), anchor - pose[:2], steep, forward)
    parts = [jac[:, 2 * i : 2 * i + 2] @ g_of_equation_4(pose, s, mount) for i, s in enumerate(measurements)]
    return np.concatenate(parts, 1)


def most_likely_line(
    pose: Three, measurements: Rows, mount: Three, sigma: Two, anchor: Two, steep: Flag, forward: Flag
) -> Two:
    """The line of a scan after one Gauss-Newton step from the regression: residuals along the beams, weighted."""
    start = line_of_scan(pose, measurements, mount, anchor, steep, forward)
    solve, normal = _likelihood(pose, measurements, mount, sigma, anchor, start)
    residual = (points_of_scan(pose, measurements, mount) - (anchor - pose[:2])) @ normal - start[0]
    return start + solve @ residual


def jac_most_likely_line(
    pose: Three, measurements: Rows, mount: Three, sigma: Two, anchor: Two, steep: Flag, forward: Flag
) -> Float[np.ndarray, "2 n"]:
    """d(offset, angle) / d(x, y, theta, r_1, alpha_1, r_2, ...), where all residuals are zero.

    There a change of the start, or of the weights, changes nothing, and a point counts by its step along the normal.
    """
    start = line_of_scan(pose, measurements, mount, anchor, steep, forward)
    solve, normal = _likelihood(pose, measurements, mount, sigma, anchor, start)
    by_pose = solve @ np.stack([normal @ f_of_equation_4(pose, s, mount) for s in measurements])
    by_beam = np.stack([normal @ g_of_equation_4(pose, s, mount) for s in measurements])
    return np.concatenate([by_pose, (solve[:, :, None] * by_beam).reshape(2, -1)], 1)


def _likelihood(
    pose: Three, measurements: Rows, mount: Three, sigma: Two, anchor: Two, line: Two
) -> tuple[Float[np.ndarray, "2 N"], Two]:
    """(A' W A)^-1 A' W, which makes a change of the line of the residuals; and the normal of the line."""
    offset, angle = line
    normal, tangent = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    here = np.array([0, 0, pose[2]])
    laser = point(here, np.zeros(2), mount) - (anchor - pose[:2])
    beam = measurements[:, 1] + mount[2] + pose[2]
    rays = np.stack([np.cos(beam), np.sin(beam)], -1)
    cosine = rays @ normal
    reach = (offset - laser @ normal) / cosine
    along = (laser + reach[:, None] * rays) @ tangent
    weight = 1 / ((cosine * sigma[0]) ** 2 + (reach * sigma[1]) ** 2 * (1 - cosine**2))
    a = np.stack([np.ones_like(along), -along])
    return np.linalg.solve((a * weight) @ a.T, a * weight), normal


def circle(points: Rows) -> Three:
    """Eqs. (18)-(20): centre and radius of a cluster."""
    center = points[0] + np.mean(points - points[0], 0)
    return np.array([*center, np.sqrt(np.sum(np.var(points - points[0], 0, ddof=1)))])


def jac_circle_points(points: Rows) -> Float[np.ndarray, "3 n"]:
    """d(xc, yc, R) / d(x_1, y_1, x_2, ...): R^2 (n - 1) is the sum of the squares of the steps from the centre."""
    n = len(points)
    steps = (points - points[0]) - np.mean(points - points[0], 0)
    radius = np.sqrt(np.sum(steps**2) / (n - 1))
    center = np.tile(np.eye(2) / n, n)
    return np.concatenate([center, (steps / ((n - 1) * radius)).reshape(1, -1)])


def fused_line(both: Float[np.ndarray, "4"], cov_l: Matrix, cov_m: Matrix) -> Two:
    """Eq. (23) from information, the mean of two estimates by their weights: x_r of (x_l, x_m)."""
    w_l, w_m = np.linalg.inv(cov_l), np.linalg.inv(cov_m)
    return np.linalg.solve(w_l + w_m, w_l @ both[:2] + w_m @ both[2:])


def gain_of_equation_23(cov_l: Matrix, cov_m: Matrix) -> Matrix:
    """K of Eq. (23)."""
    return cov_l @ np.linalg.inv(cov_l + cov_m)


def jac_fused_line(both: Float[np.ndarray, "4"], cov_l: Matrix, cov_m: Matrix) -> Float[np.ndarray, "2 4"]:
    """d(x_r) / d(x_l, x_m) of Eq. (23): I - K and K."""
    gain = gain_of_equation_23(cov_l, cov_m)
    return np.concatenate([np.eye(2) - gain, gain], 1)


def fused_circle(both: Float[np.ndarray, "6"]) -> Three:
    """Eqs. (24)-(25) as meant: the mean of the old and the new (xc, yc, R)."""
    return np.mean(both.reshape(2, 3), 0)


def jac_fused_circle(both: Float[np.ndarray, "6"]) -> Float[np.ndarray, "3 6"]:
    """d(xc, yc, R) / d(old, new) of Eqs. (24)-(25): one half of each."""
    return np.tile(np.eye(3) / 2, 2)


def _sums(
    points: Rows, steep: Flag
) -> tuple[int, Float[np.ndarray, " N"], Float[np.ndarray, " N"], float, float, tuple[float, float]]:
    """n, regressor, response, N of Eq. (6), T, and the first two sums of Eq. (5), in that order."""
    u, v = _regressor_first(np.moveaxis(points - points[0], -1, 0), steep)
    n, ru, rv = len(points), np.sum(u), np.sum(v)
    return n, u, v, n * np.sum(u * u) - ru**2, n * np.sum(u * v) - ru * rv, (ru, rv)


def _regressor_first(xy: Float[np.ndarray, "2 ..."], steep: Flag) -> Float[np.ndarray, "2 ..."]:
    return xy[::-1] if steep else xy


def step_taken(pose: Three, step: Three) -> Three:
    """Section 3: the pose after a step seen from a pose."""
    x, y, theta = pose
    dx, dy, turn = step
    c, s = np.cos(theta), np.sin(theta)
    return np.array([x + c * dx - s * dy, y + s * dx + c * dy, theta + turn])


def step_by_pose_and_step(pose: Three, step: Three) -> Float[np.ndarray, "3 6"]:
    """Its derivative by the pose, and beside it that by the step."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    lever = [-s * step[0] - c * step[1], c * step[0] - s * step[1]]
    return np.array([[1, 0, lever[0], c, -s, 0], [0, 1, lever[1], s, c, 0], [0, 0, 1, 0, 0, 1]])


def beacon(pose: Three, place: Two, mount: Three) -> Two:
    """Section 3: range and bearing of a beacon from a sensor on the robot."""
    x, y, theta = pose
    c, s = np.cos(theta), np.sin(theta)
    dx, dy = place[0] - x - c * mount[0] + s * mount[1], place[1] - y - s * mount[0] - c * mount[1]
    bearing = np.arctan2(dy, dx) - theta - mount[2]
    return np.array([np.hypot(dx, dy), (bearing + np.pi) % (2 * np.pi) - np.pi])


def beacon_by_pose(pose: Three, place: Two, mount: Three) -> Float[np.ndarray, "2 3"]:
    """Its derivative by the pose: that of the quotient and of the root, by the chain rule from dx and dy."""
    x, y, theta = pose
    c, s = np.cos(theta), np.sin(theta)
    dx, dy = place[0] - x - c * mount[0] + s * mount[1], place[1] - y - s * mount[0] - c * mount[1]
    by_theta = np.array([s * mount[0] + c * mount[1], -c * mount[0] + s * mount[1]])
    ray = np.array([[-1, 0, by_theta[0]], [0, -1, by_theta[1]]])
    square = dx * dx + dy * dy
    outer = np.array([[dx / np.sqrt(square), dy / np.sqrt(square)], [-dy / square, dx / square]])
    return outer @ ray - np.array([[0, 0, 0], [0, 0, 1]])
