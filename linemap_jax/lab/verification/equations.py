"""The paper equation by equation: whether it is exact, where its print is wrong, and what it assumes.

An erratum is shown, not told: the formula as printed is evaluated and must disagree with autodiff or with the
estimate, and the corrected one must agree. An assumption is shown by a case in which it does not hold.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from linemap_jax.core import circles, fusion, likelihood, lines, matching, runs, sensor
from linemap_jax.core.estimation import pose_filter
from linemap_jax.core.segmentation import incremental
from linemap_jax.core.settings import PAPER_RULES, PAPER_THRESHOLDS, SensorNoise, Thresholds
from linemap_jax.lab.verification import cases, derivatives, literals, sections
from linemap_jax.lab.verification.derivatives import Agreement
from linemap_jax.lab.verification.rows import CENTRAL, EXACT, Check, Row, most, turn
from linemap_jax.lab.verification.sample import COV_MEASUREMENT, COV_POSE, MOUNT, POSE, SIZE, WALLS, Sample, draw


def verify(found: Sequence[Agreement] | None = None, *, seed: int = 0) -> tuple[Row, ...]:
    """Check the paper, equation by equation, in float64 whatever jax is set to.

    Args:
      found: what `check_derivatives` has found; it is called unless this is given.
      seed: of the random inputs.

    Returns:
      A row for each of the equations (1)-(25), and behind them one for each section that says in words what is
      computed, or has an erratum that stands in no equation.
    """
    with jax.enable_x64(True):
        found = derivatives.check_derivatives(seed) if found is None else found
        sample = draw(np.random.default_rng(seed))
        rows = (
            *_points(found, sample),
            *_regression(sample),
            *_transition(sample),
            *_covariance(found, sample),
            *_circles(found),
            *_matching(sample),
            *_fusion(found, sample),
            *_pose_filter(found),
            *_beside_the_equations(),
            *sections.rows(sample),
        )
    return tuple(sorted(rows, key=_in_order))


def _in_order(row: Row) -> tuple[bool, int, bool, str]:
    """Equations by their numbers, then sections, then the table."""
    is_number = row.equation.isdigit()
    return not is_number, int(row.equation) if is_number else 0, row.equation[0] != "s", row.equation


def of_derivatives(found: Sequence[Agreement], *names: str) -> tuple[Check, ...]:
    """What the registry says of some of its derivatives."""
    mine = [agreement for agreement in found if agreement.name in names]
    assert {agreement.name for agreement in mine} == set(names)

    def worst(what: str, field: str, limit: float = EXACT) -> Iterator[Check]:
        values = [value for agreement in mine if (value := getattr(agreement, field)) is not None]
        if values:
            yield Check(what, float(np.max(values)), limit)

    return (
        *worst("hand-derived derivative against autodiff", "analytic"),
        *worst("derivative typed in NumPy against both", "literal"),
        *worst("the pipeline's own autodiff against forward mode", "autodiff"),
        *worst("forward against reverse mode", "reverse"),
        *worst("central differences against autodiff", "central", CENTRAL),
        *worst("estimate against NumPy", "estimate"),
        Check("inputs with a derivative that is not finite", sum(not agreement.finite for agreement in mine), 0),
    )


def _points(found: Sequence[Agreement], sample: Sample) -> tuple[Row, ...]:
    """Eqs. (1)-(4)."""
    rho, theta = np.asarray(sample.rho), np.asarray(sample.theta)
    ends = np.stack([sample.begin, sample.end])
    residual = ends[..., 1] * np.sin(theta) + ends[..., 0] * np.cos(theta) - rho
    shifted = _propagate(sample.jac_rho_theta, sample.cov)
    by_numpy = literals.points_of_scan(POSE, np.asarray(sample.measurements), MOUNT)
    f, g = (
        np.stack([jac(POSE, s, MOUNT) for s in sample.measurements])
        for jac in (literals.f_of_equation_4, literals.g_of_equation_4)
    )
    return (
        Row(
            equation="1",
            title="a line by rho and theta",
            where=(lines.rho_theta,),
            verdict="exact",
            sentence="A view for display: the state is (offset, angle) at an anchor on the segment, since theta flips "
            "near the origin and its first order fails far from it.",
            checks=(
                Check("the view's covariance against autodiff", _cov_difference(sample.cov_rho_theta, shifted)),
                Check("end points put into (1), m", most(residual)),
                Check("lines with a negative rho", int(np.sum(rho < 0)), 0),
            ),
        ),
        Row(
            equation="2",
            title="a measured point",
            where=(sensor.point_from_measurement,),
            verdict="exact",
            sentence="With one more angle, the turn of the scanner on the robot.",
            checks=tuple(check for check in of_derivatives(found, "F", "G") if check.what == "estimate against NumPy"),
        ),
        Row(
            equation="3",
            title="the point as a function of pose and measurement",
            where=(sensor.points_from_scan,),
            verdict="exact",
            sentence="Held without the robot's position, which adds nothing to the derivatives and costs the points "
            "digits.",
            checks=(Check("points of a scan against NumPy, m", most(sample.points.position - by_numpy)),),
        ),
        Row(
            equation="4",
            title="C_p, the covariance of a point",
            where=(sensor.jac_point_pose, sensor.jac_point_measurement, sensor.cov_point),
            verdict="exact",
            sentence="To first order; but all points of a scan share the error of its pose, see (12).",
            checks=(
                *of_derivatives(found, "F", "G"),
                Check(
                    "C_p against NumPy",
                    _cov_difference(sample.cov_point, _propagate(f, COV_POSE) + _propagate(g, COV_MEASUREMENT)),
                ),
            ),
        ),
    )


def _regression(sample: Sample) -> tuple[Row, ...]:
    """Eqs. (5)-(8)."""
    x, y = np.moveaxis(_per_wall(sample.points.position), -1, 0)
    x, y = x - x[:, :1], y - y[:, :1]
    sums = np.stack([np.full(WALLS, float(SIZE)), *(np.sum(z, 1) for z in (x, y, x * x, y * y, x * y))], -1)
    spread = SIZE**2 * np.stack([np.var(x, 1), np.var(y, 1)], -1)
    steep = np.asarray(sample.fit.steep)
    slope, intercept, _ = _polyfit(sample)
    mean = np.asarray(sample.exact.anchor)
    u, w = np.where(steep, mean[:, ::-1].T, mean.T)
    own = np.stack([sample.fit.slope, w - sample.fit.slope * u], -1)
    by_numpy = np.stack([slope, intercept], -1)
    change = np.abs(own - by_numpy) / np.maximum(1, np.abs(by_numpy))
    share = np.abs(sample.sums - sums) / np.max(np.abs(sums), 0)
    return (
        Row(
            equation="5",
            title="the sums over the points of a line",
            where=(runs.Runs.sum, lines.regress),
            verdict="exact",
            sentence="Taken from the line's first point: in coordinates of the world they lose everything in float32.",
            checks=(Check("sums against NumPy", most(share)),),
        ),
        Row(
            equation="6",
            title="N_1 and N_2, which choose between (m, q) and (s, t)",
            where=(lines.regress,),
            verdict="exact",
            sentence="n^2 times the variances of x and y. Where they are equal, which the paper leaves open, it is "
            "(m, q).",
            checks=(
                Check("the larger one against n^2 times the variance", most(sample.fit.width / np.max(spread, 1) - 1)),
                Check("lines with the other choice", int(np.sum(steep != (spread[:, 0] < spread[:, 1]))), 0),
            ),
        ),
        Row(
            equation="7",
            title="slope m and intercept q",
            where=(lines.regress,),
            verdict="exact",
            sentence="Least squares in y; the pipeline holds a point of the line in place of the intercept.",
            checks=(Check("m and q against numpy.polyfit", most(change[~steep])),),
        ),
        Row(
            equation="8",
            title="slope s and intercept t",
            where=(lines.regress,),
            verdict="exact",
            sentence="Least squares in x.",
            checks=(Check("s and t against numpy.polyfit", most(change[steep])),),
        ),
    )


def _transition(sample: Sample) -> tuple[Row, ...]:
    """Eqs. (9)-(10) and (13)-(14), and the H that they have."""
    slope, intercept, other = _polyfit(sample)
    steep = np.asarray(sample.fit.steep)
    rho, theta = np.asarray(sample.rho), np.asarray(sample.theta)
    by_9 = np.abs(intercept / np.sqrt(slope**2 + 1))
    # (10), the numerator and the denominator
    up, along = np.where(steep, -intercept * slope, intercept), np.where(steep, intercept, -intercept * slope)
    with np.errstate(invalid="ignore"):
        through_origin = np.arctan(np.divide(0.0, -0.0 * 0.5))
    magnitude = Check("rho by (9) against the pipeline's, m", most(by_9 - rho))
    direction = Check("theta by arctan2 against the pipeline's, rad", most(turn(np.arctan2(up, along), theta)))
    unsigned = np.stack([-intercept * slope / (slope**2 + 1) ** 1.5, 1 / np.sqrt(slope**2 + 1)], -1)
    by_autodiff = jax.jit(jax.vmap(jax.grad(lambda v: jnp.abs(v[1] / jnp.sqrt(v[0] ** 2 + 1)))))
    truth = np.asarray(by_autodiff(np.stack([slope, intercept], -1)))
    signed = np.sign(intercept)[:, None] * unsigned
    return (
        Row(
            equation="9",
            title="rho",
            where=(lines.line_from_regression, lines.rho_theta),
            verdict="exact",
            sentence="Its absolute value has a derivative: drho/dm and drho/dq take sign(q), which (16)-(17) leave "
            "out. The pipeline's offset has a sign instead.",
            checks=(
                magnitude,
                Check("drho/d(m, q) with sign(q) against autodiff", derivatives.difference(signed, truth)),
            ),
        ),
        Row(
            equation="10",
            title="theta",
            where=(lines.line_from_regression, lines.rho_theta),
            verdict="erratum",
            sentence="Needs the four-quadrant arctangent, and with it the sign of q: without, half of the lines are "
            "turned by pi. For a line through the origin it is 0/0.",
            checks=(
                direction,
                Check("theta as printed, rad", most(turn(np.arctan(up / along), theta)), 0.1, differs=True),
                Check("as printed, through the origin: not a number", float(np.isnan(through_origin)), 0, differs=True),
            ),
        ),
        Row(
            equation="13",
            title="rho as a function of (m, q)",
            where=(lines.line_from_regression,),
            verdict="erratum",
            sentence="Said to be (8) written anew; it is (9).",
            checks=(magnitude, Check("t of (8) in place of rho, m", most(other[:, 1] - rho), 0.1, differs=True)),
        ),
        Row(
            equation="14",
            title="theta as a function of m",
            where=(lines.line_from_regression,),
            verdict="erratum",
            sentence="Said to be (8) written anew; it is (10), and depends on the sign of q too.",
            checks=(
                direction,
                Check("s of (8) in place of theta, rad", most(turn(other[:, 0], theta)), 0.1, differs=True),
            ),
        ),
    )


def _covariance(found: Sequence[Agreement], sample: Sample) -> tuple[Row, ...]:
    """Eqs. (11)-(12) and (15)-(17)."""
    dense, printed, own, by_steps, lever = (
        np.stack(x) for x in zip(*map(_by_numpy(sample), range(WALLS)), strict=True)
    )
    slope, intercept, _ = _polyfit(sample)
    flat = ~np.asarray(sample.fit.steep)
    m, q = slope[flat], intercept[flat]
    h = np.asarray(jax.jit(jax.vmap(jax.jacfwd(_rho_theta_of_m_q)))(np.stack([m, q], -1)))
    h11, h21, h12 = -q * m / (m**2 + 1) ** 1.5, 1 / np.sqrt(m**2 + 1), 1 / (1 + m**2)
    diagonal, sides = np.stack([h[:, 0, 0], h[:, 1, 1]], -1), np.stack([h[:, 0, 1], h[:, 1, 0]], -1)
    zero, sign = np.zeros_like(m), np.sign(q)
    ahead = q > 0

    s = slope[~flat]
    by_s = np.asarray(jax.jit(jax.vmap(jax.grad(lambda s: jnp.arctan2(-s, 1.0))))(s))
    return (
        Row(
            equation="11",
            title="a line as a function of its points",
            where=(lines.jac_line_points, likelihood.jac_step_points),
            verdict="exact",
            sentence="Every point belongs to one line, so that two reverse passes give the derivatives of all lines. "
            "The default adds a step of likelihood, whose derivative is exact where there is no noise.",
            checks=of_derivatives(found, "line by points", "most likely line by pose and beams"),
        ),
        Row(
            equation="12",
            title="C_V, the covariance from the points",
            where=(lines.jac_regression_points, lines.measure_lines),
            verdict="erratum",
            sentence="Sums the points as if independent, but they share one pose error, which (4) puts into each. To "
            "first order C_l is M + P C_Xr P', M = sum H J G C_S G' J' H', P = sum H J F.",
            checks=(
                *of_derivatives(found, "J (m, q)", "J (s, t)", "line by pose and beams"),
                Check("P, by hand and by autodiff, against NumPy", most(sample.jac_line_pose - lever[None])),
                Check("M + P C P' against the joint covariance of all points", _cov_difference(sample.cov, dense)),
                Check('covariance="printed" against (12) in NumPy', _cov_difference(sample.cov_printed, printed)),
                Check("mean NEES as printed, over 2, minus 1", _too_sure(sample.cov_printed, dense), 0.1, differs=True),
            ),
        ),
        Row(
            equation="15",
            title="C_l = H C_V H'",
            where=(lines.jac_line_regression,),
            verdict="exact",
            sentence="To first order, with the H of the branch that was taken; see (16), (17) and s4.2.5.",
            checks=(
                *of_derivatives(found, "H (m, q)", "H (s, t)"),
                Check(
                    "M, by hand and by autodiff, against H C_V H' in NumPy",
                    _cov_difference(sample.cov_measurement, by_steps[None]),
                ),
                Check(
                    "M against the joint covariance of all points", _cov_difference(sample.cov_measurement, own[None])
                ),
            ),
        ),
        Row(
            equation="16",
            title="h11 = drho/dm and h22 = dtheta/dq",
            where=(lines.jac_line_regression,),
            verdict="erratum",
            sentence="Without the sign(q) that the absolute value of (9) brings in.",
            checks=(
                *of_derivatives(found, "H (m, q)"),
                Check(
                    "with sign(q) against autodiff of (9)-(10)",
                    derivatives.difference(np.stack([sign * h11, zero], -1), diagonal),
                ),
                Check(
                    "as printed",
                    derivatives.difference(np.stack([h11, zero], -1), diagonal),
                    0.1,
                    differs=True,
                ),
            ),
        ),
        Row(
            equation="17",
            title="h12 and h21",
            where=(lines.jac_line_regression,),
            verdict="erratum",
            sentence="The labels are swapped: drho/dq is h12, dtheta/dm is h21. And drho/dq takes sign(q) too.",
            checks=(
                *of_derivatives(found, "H (m, q)"),
                Check(
                    "swapped back, with sign(q), against autodiff of (9)-(10)",
                    derivatives.difference(np.stack([sign * h21, h12], -1), sides),
                ),
                Check(
                    "as printed, where q > 0",
                    derivatives.difference(np.stack([h12, h21], -1)[ahead], sides[ahead]),
                    0.1,
                    differs=True,
                ),
            ),
        ),
        Row(
            equation="s4.2.5",
            title="the analogue of H for (s, t)",
            where=(lines.jac_line_regression,),
            verdict="erratum",
            sentence="It is not the same H with other letters: dtheta/ds = -1/(1 + s^2).",
            checks=(
                *of_derivatives(found, "H (s, t)"),
                Check("dtheta/ds against autodiff of (10)", most(-1 / (1 + s**2) / by_s - 1)),
                Check("1/(1 + s^2) by analogy", most(1 / (1 + s**2) / by_s - 1), 0.1, differs=True),
            ),
        ),
    )


def _circles(found: Sequence[Agreement]) -> tuple[Row, ...]:
    """Eqs. (18)-(20)."""
    # A pole of 10 cm, 3 m ahead, seen by 30 beams without noise
    radius, distance = 0.1, 3.0
    beam = np.linspace(-1, 1, cases.FEW) * np.arcsin(0.999 * radius / distance)
    reach = distance * np.cos(beam) - np.sqrt(radius**2 - (distance * np.sin(beam)) ** 2)
    points = reach[:, None] * np.stack([np.cos(beam), np.sin(beam)], -1)
    (x, y, r), _ = derivatives.estimate_and_jacobian("circle by points", points.ravel(), np.array(len(points)))
    agreement = of_derivatives(found, "circle by points")
    (value,) = (check for check in agreement if check.what == "estimate against NumPy")
    return (
        Row(
            equation="18",
            title="centre of a circle",
            where=(circles.arcs_from_points,),
            verdict="assumption",
            sentence="The centroid of the visible points, exactly. It lies some 0.8 radii before the centre of a pole, "
            "and moves with the viewpoint.",
            checks=(
                *agreement,
                Check(
                    "from the centre of a pole, in radii", float(np.hypot(x - distance, y)) / radius, 0.1, differs=True
                ),
            ),
        ),
        Row(
            equation="19",
            title="radius of a circle",
            where=(circles.arcs_from_points,),
            verdict="assumption",
            sentence="The spread of the visible points, exactly; about 0.6 of the radius of a pole.",
            checks=(*agreement, Check("from the radius of a pole, in radii", abs(r / radius - 1), 0.1, differs=True)),
        ),
        Row(
            equation="20",
            title="variances of the points of a circle",
            where=(circles.arcs_from_points,),
            verdict="exact",
            sentence="From running sums that start at the cluster's first point.",
            checks=(value,),
        ),
    )


def _matching(sample: Sample) -> tuple[Row, ...]:
    """Eqs. (21)-(22)."""
    new = sample.exact
    random = np.random.default_rng(1)
    # The same walls as the map might hold them: a little off, and at another anchor
    model = dataclasses.replace(
        new,
        anchor=new.anchor + random.uniform(-0.5, 0.5, (WALLS, 2)),
        offset=random.uniform(-0.3, 0.3, WALLS),
        angle=new.angle + random.normal(0, 0.02, WALLS),
    )
    nis = jax.jit(jax.vmap(lambda a, b: matching.compare_lines(a, b, Thresholds(), "independent").nis))(new, model)
    step = model.anchor - new.anchor
    normal, tangent = (np.stack([np.cos(a), np.sin(a)], -1) for a in (model.angle, model.angle + np.pi / 2))
    change = np.stack([new.offset - (model.offset + np.sum(normal * step, -1)), turn(new.angle, model.angle)], -1)
    shift = np.zeros((WALLS, 2, 2)) + np.eye(2)
    shift[:, 0, 1] = np.sum(tangent * step, -1)
    cov = sample.cov + _propagate(shift, sample.cov)
    by_numpy = np.sum(change * np.linalg.solve(cov, change[..., None])[..., 0], -1)
    once = 2 * sample.cov_measurement[0]  # of two views from one pose: its error cancels
    return (
        Row(
            equation="21",
            title="normalised distance of two lines",
            where=(matching.compare_lines, matching.best_line),
            verdict="assumption",
            sentence="Takes both lines for independent: under a pose error that both share, true matches come out too "
            "near. Evaluated at an anchor on the segment, with angles wrapped.",
            checks=(
                Check("against NumPy", most(nis / by_numpy - 1)),
                Check(
                    "mean NIS of matches from one pose, over 2, minus 1",
                    abs(_too_sure(2 * sample.cov, once)),
                    0.1,
                    differs=True,
                ),
            ),
        ),
        Row(
            equation="22",
            title="gate of 5 for a significance of 90 %",
            where=(matching.match_lines, matching.best_line),
            verdict="erratum",
            sentence="5 is 91.8 % of chi-square with 2 degrees of freedom; 90 % is 4.605. The default is 9.21, 99 %.",
            checks=(
                Check("chi-square below -2 log(0.1), minus 90 %", abs(_chi_square(-2 * np.log(0.1)) - 0.9)),
                Check("chi-square below 5, minus 90 %", abs(_chi_square(5.0) - 0.9), 0.01, differs=True),
                Check("the gate of `paper`, minus 5", abs(float(PAPER_THRESHOLDS.match_nis) - 5), 0),
                Check(
                    "chi-square below the default, minus 99 %",
                    abs(_chi_square(float(Thresholds().match_nis)) - 0.99),
                    1e-4,
                ),
            ),
        ),
    )


def _fusion(found: Sequence[Agreement], sample: Sample) -> tuple[Row, ...]:
    """Eqs. (23)-(25)."""
    pairs = [(old, new) for _, old, new in cases.covariances(np.random.default_rng(2))]
    _, own = jax.jit(jax.vmap(derivatives.gain_and_cov))(*(np.stack(x) for x in zip(*pairs, strict=True)))
    by_numpy = np.stack([old - literals.gain_of_equation_23(old, new) @ old for old, new in pairs])
    # Two views of one wall from one pose: what is averaged is the measurement alone.
    claimed = sample.cov / 2
    true = sample.cov - sample.cov_measurement[0] / 2

    of_circles = of_derivatives(found, "fused circle")
    variance = 1.0
    for _ in range(50):
        variance = (variance + 1) / 4
    old, new = np.array([1.0, 2.0, 0.1]), np.array([1.1, 2.1, 0.12])
    mean, jac = derivatives.estimate_and_jacobian("fused circle", np.concatenate([old, new]))
    as_printed = np.array([0, 1])  # of (y_cn + y_cn)/2
    twice_x = np.array([new[0], new[0], new[2]])
    return (
        Row(
            equation="23",
            title="fused line",
            where=(fusion.combine, fusion.fuse_lines),
            verdict="assumption",
            sentence="Takes scans for independent: what persists of the pose error does not average away, and is kept "
            "apart. C_r = C_l - K C_l loses definiteness in float32; the pipeline sums squares.",
            checks=(
                *of_derivatives(found, "fused line"),
                Check("C_r against C_l - K C_l in NumPy", _cov_difference(own, by_numpy)),
                Check(
                    "mean NEES of two scans from one pose, over 2, minus 1", _too_sure(claimed, true), 0.1, differs=True
                ),
            ),
        ),
        Row(
            equation="24",
            title="fused centre of a circle",
            where=(fusion.fuse_circles,),
            verdict="erratum",
            sentence="Prints y_cn twice, so that the old y counts for nothing; it means (y_cn + y_cm)/2.",
            checks=(
                *of_circles,
                Check("d(y_cr)/d(y_cm, y_cn) as printed", most(as_printed - jac[1, [1, 4]]), 0.1, differs=True),
            ),
        ),
        Row(
            equation="25",
            title="fused radius of a circle",
            where=(fusion.fuse_circles,),
            verdict="assumption",
            sentence="The newest circle weighs as much as all before it: the variance stays above 1/3 of that of one.",
            checks=(*of_circles, Check("variance after 50 scans, of that of one", variance, 0.1, differs=True)),
        ),
        Row(
            equation="s5.2.2",
            title="the new circle",
            where=(fusion.fuse_circles,),
            verdict="erratum",
            sentence="Printed as (x_cn, x_cn, R_n); it means (x_cn, y_cn, R_n).",
            checks=(
                Check("mean of old and new, m", most(mean - (old + new) / 2)),
                Check("with x_cn twice, m", most(mean - (old + twice_x) / 2), 0.1, differs=True),
            ),
        ),
    )


def _pose_filter(found: Sequence[Agreement]) -> tuple[Row, ...]:
    """Section 3."""
    return (
        Row(
            equation="s3",
            title="the Kalman filter of the pose",
            where=(pose_filter.predict, pose_filter.update_by_beacons),
            verdict="exact",
            sentence="Cited, not printed. Here: the extended Kalman filter of (x, y, theta), predicted by odometry, "
            "updated by range and bearing of beacons.",
            checks=of_derivatives(found, "pose by pose and step", "beacon by pose"),
        ),
    )


def _beside_the_equations() -> tuple[Row, ...]:
    """Section 4.3.1 and Table I."""
    # A wall without noise, straight ahead
    bearing = np.linspace(-0.2, 0.2, SIZE)
    wall = np.stack([2 / np.cos(bearing), bearing], -1)
    longest = int(_longest_run(wall))
    points = literals.points_of_scan(np.zeros(3), wall, np.zeros(3))
    literal = _longest_run_to_the_letter(points, float(PAPER_THRESHOLDS.line_distance))

    rho, var_rho, var_theta = TABLE_I[:, 0] / 100, TABLE_I[:, 1], TABLE_I[:, 2]
    as_sigma = var_rho / 100 / np.radians(var_theta)
    as_variance = np.sqrt(var_rho) / 100 / np.radians(np.sqrt(var_theta))
    return (
        Row(
            equation="s4.3.1",
            title="criterion 2 for the first points of a line",
            where=(incremental.segment,),
            verdict="erratum",
            sentence='With fewer than three points it "must not be fulfilled"; it need not be. To the letter, points '
            "in line would never become a line.",
            checks=(
                Check("points of a wall that the line lacks", abs(SIZE - longest), 0),
                Check("to the letter, as a share of all", 1 - literal / SIZE, 0.1, differs=True),
            ),
        ),
        Row(
            equation="Table I",
            title="sigma_rho and sigma_theta",
            where=(lines.rho_theta,),
            verdict="erratum",
            sentence="As variances (cm^2, deg^2) the columns give lever arms of 6-9 m, all shorter than rho; as "
            "sigmas, as their headings have it, of 59-141 m.",
            checks=(
                Check("lines whose lever arm is longer than rho, as variances", int(np.sum(as_variance > rho)), 0),
                Check("shortest lever arm over rho, as sigmas", float(np.min(as_sigma / rho)), 2, differs=True),
            ),
        ),
    )


TABLE_I = np.array(
    [
        [1155, 99, 0.64],
        [762, 41, 0.35],
        [1613, 1109, 4.5],
        [1654, 9, 0.08],
        [1714, 28, 0.27],
        [1953, 33, 0.17],
    ]
)
"""rho (cm), and the columns sigma_rho (cm) and sigma_theta (deg)."""


def _rho_theta_of_m_q(m_q: Float[Array, "2"]) -> Float[Array, "2"]:
    """Eqs. (9)-(10), corrected."""
    m, q = m_q
    return jnp.stack([jnp.abs(q / jnp.sqrt(m**2 + 1)), jnp.arctan2(q, -q * m)])


@jax.jit
def _longest_run(measurements: Float[Array, "N 2"]) -> Float[Array, ""]:
    """Points of the longest run that the pipeline finds, with the paper's criteria."""
    zero, count = jnp.zeros(3), jnp.array(measurements.shape[0])
    points = derivatives.points_of_beams(zero, measurements, count, zero, "analytic")
    _, run, _ = incremental.segment(points, PAPER_THRESHOLDS, SensorNoise(), PAPER_RULES)
    return jnp.max(run.n)


def _longest_run_to_the_letter(position: Float[np.ndarray, "N 2"], distance: float) -> int:
    """Section 4.3.1 for criterion 2 alone, where it "must not be fulfilled" while there are fewer than three points."""
    longest, run = 0, []
    for point in position:
        if len(run) >= 2:
            (x, y), (dx, dy) = run[0], run[-1] - run[0]
            near = abs((point[0] - x) * dy - (point[1] - y) * dx) / np.hypot(dx, dy) < distance
            if near != (len(run) >= 3):
                run = []
        run.append(point)
        longest = max(longest, len(run))
    return longest


def _by_numpy(sample: Sample) -> Callable[[int], tuple[np.ndarray, ...]]:
    """For one wall, in NumPy alone: its covariance from the joint one of all points, (12), M twice, and P."""
    measurements = _per_wall(sample.measurements)
    anchor = np.asarray(sample.exact.anchor) - POSE[:2]
    direction, steep = np.asarray(sample.fit.direction), np.asarray(sample.fit.steep)
    forward = np.where(steep, direction[:, 1], direction[:, 0]) > 0

    def of_wall(k: int) -> tuple[np.ndarray, ...]:
        branch = bool(steep[k]), bool(forward[k])
        points = literals.points_of_scan(POSE, measurements[k], MOUNT)
        f = np.concatenate([literals.f_of_equation_4(POSE, s, MOUNT) for s in measurements[k]])
        g = [literals.g_of_equation_4(POSE, s, MOUNT) for s in measurements[k]]
        noise = np.zeros((2 * SIZE, 2 * SIZE))
        for i, own in enumerate(g):
            noise[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = own @ COV_MEASUREMENT @ own.T
        each = np.kron(np.eye(SIZE), np.ones((2, 2)))  # one where both belong to one point
        shared = f @ COV_POSE @ f.T
        jac = literals.jac_line_points(points, anchor[k], *branch)
        v = literals.regression(points, anchor[k], branch[0])
        j = literals.j_of_equation_12(points, anchor[k], branch[0])
        h = literals.h_of_equations_15_to_17(v, *branch)
        return (
            jac @ (noise + shared) @ jac.T,
            jac @ (noise + shared * each) @ jac.T,
            jac @ noise @ jac.T,
            h @ (j @ noise @ j.T) @ h.T,
            jac @ f,
        )

    return of_wall


def _polyfit(sample: Sample) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slope and intercept of each wall in the world by `numpy.polyfit`, shape `[K]`; and (s, t) of all, `[K, 2]`."""
    steep = np.asarray(sample.fit.steep)
    found = []
    for points in _per_wall(sample.points.position) + POSE[:2]:
        mean = np.mean(points, 0)
        x, y = (points - mean).T
        for u, w, u_mean, w_mean in ((x, y, *mean), (y, x, *mean[::-1])):
            slope, level = np.polyfit(u, w, 1)
            found.append((slope, level + w_mean - slope * u_mean))
    both = np.array(found).reshape(WALLS, 2, 2)
    slope, intercept = np.where(steep[:, None], both[:, 1], both[:, 0]).T
    return slope, intercept, both[:, 1]


def _per_wall(of_points: Any) -> Float[np.ndarray, "K N s"]:
    return np.asarray(of_points).reshape(WALLS, SIZE, -1)


def _chi_square(x: float) -> float:
    """The probability of less than x, for 2 degrees of freedom, by Gauss's quadrature of the density exp(-x/2) / 2."""
    at, weight = np.polynomial.legendre.leggauss(40)
    return float(np.sum(weight * np.exp(-(at + 1) * x / 4)) * x / 4)


def _propagate(jac: Any, cov: Any) -> np.ndarray:
    """J C J^T."""
    return np.asarray(jac) @ np.asarray(cov) @ np.swapaxes(np.asarray(jac), -1, -2)


def _cov_difference(a: Any, b: Any) -> float:
    """The largest difference of two covariances, in units of the standard deviations of b."""
    sigma = np.sqrt(np.diagonal(np.asarray(b), axis1=-2, axis2=-1))
    return most((np.asarray(a) - np.asarray(b)) / (sigma[..., :, None] * sigma[..., None, :]))


def _too_sure(claimed: Any, true: Any) -> float:
    """The mean of e^T C^-1 e over 2, minus 1, for a claimed C and errors e with the true one: zero if it is right."""
    ratio = np.linalg.solve(np.asarray(claimed), np.asarray(true))
    return float(np.mean(np.trace(ratio, axis1=-2, axis2=-1)) / 2 - 1)
