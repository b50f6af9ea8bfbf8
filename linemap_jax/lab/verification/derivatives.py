"""The registry of the paper's derivatives, and what holds them against one another.

Each entry joins an estimate of the pipeline, the derivative that the pipeline uses with `jacobians="analytic"`, and
both once more in plain NumPy. They are held against forward and reverse mode through the estimate, and against central
differences of the NumPy estimate. No two of these share code for the derivative.
"""

import dataclasses
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core import circles, fusion, likelihood, lines, sensor
from linemap_jax.core.estimation import pose_filter
from linemap_jax.core.fields import documented
from linemap_jax.core.frames import compose, jac_compose_pose, jac_compose_step
from linemap_jax.core.matching import CircleMatches
from linemap_jax.core.propagation import product
from linemap_jax.core.runs import Runs
from linemap_jax.core.sensor import Points
from linemap_jax.core.settings import PAPER_RULES, Jacobians, Mount, SensorNoise, Thresholds
from linemap_jax.core.state import Lines, Pose, Scan, empty_circles, empty_lines
from linemap_jax.lab.verification import cases, literals
from linemap_jax.lab.verification.cases import Case

COLUMNS = 12
"""Central differences with respect to more variables than these are taken in so many of them, evenly spread."""
STEP = 2e-4
"""Of central differences of fourth order, m or rad: it is small beside a line, and large beside rounding at 10 km."""


@documented
@dataclasses.dataclass(frozen=True, kw_only=True)
class Derivative:
    """A derivative of the paper. Each function takes the `x` of a case and what else the case gives."""

    name: str
    """What the entry is called."""
    estimate: Callable[..., Array]
    """The estimate of the pipeline."""
    analytic: Callable[..., Array] | None = None
    """Its derivative as the pipeline uses it; None where it needs no derivative."""
    autodiff: Callable[..., Array] | None = None
    """Likewise, with jacobians="autodiff"."""
    branch: Callable[..., tuple[Array, ...]] | None = None
    """What the pipeline chose; goes on to NumPy."""
    model: Callable[..., np.ndarray]
    """The estimate in NumPy, with the branch held fixed."""
    literal: Callable[..., np.ndarray]
    """The derivative in NumPy."""
    angle: int | None = None
    """Which number of the estimate is an angle."""
    split: int = 0
    """Variables before and from here on are compared apart: one kind must not hide in the other's norm."""
    cases: Callable[[np.random.Generator], Iterator[Case]]
    """The inputs it is checked on."""
    applies: Callable[..., bool] = lambda *_: True
    """Whether it is meant for the branch of a case."""


@documented
@dataclasses.dataclass(frozen=True, kw_only=True)
class Agreement:
    """What one case has shown: largest differences, relative to the norm of the row of the Jacobian."""

    name: str
    """Name of the derivative."""
    case: str
    """Name of the input."""
    finite: bool
    """Whether no derivative holds a NaN or an infinity."""
    estimate: float = 0.0
    """Difference of the pipeline's estimate from NumPy's, relative to the larger of it and 1 (m, rad)."""
    analytic: float | None = None
    """Difference of the pipeline's hand-derived derivative from forward and from reverse mode."""
    autodiff: float | None = None
    """Difference of the pipeline's autodiff from forward mode."""
    literal: float = 0.0
    """Difference of the one typed in NumPy from forward mode and from the pipeline's hand-derived one."""
    reverse: float = 0.0
    """Difference of forward from reverse mode."""
    central: float = 0.0
    """Difference of central differences from forward mode."""


def check_derivatives(seed: int = 0) -> list[Agreement]:
    """Hold every derivative of the registry against the others, in float64, on random and on nasty inputs.

    Args:
      seed: of the random inputs.

    Returns:
      How far each derivative is from the others, for each case.
    """
    with jax.enable_x64(True):
        return [found for entry in DERIVATIVES for found in check(entry, np.random.default_rng(seed))]


def check(entry: Derivative, random: np.random.Generator) -> Iterator[Agreement]:
    """Hold one derivative against the others, case by case."""
    program = _program_of(entry)
    for case in entry.cases(random):
        y, forward, reverse, analytic, autodiff, branch = jax.tree.map(np.asarray, program(case.x, *case.given))
        if not entry.applies(*branch):
            continue
        named = partial(Agreement, name=entry.name, case=case.name)
        given = [x for x in (forward, reverse, analytic, autodiff) if x is not None]
        finite = all(bool(np.all(np.isfinite(x))) for x in given)
        if not case.regular:
            yield named(finite=finite)
            continue
        args = (*case.given, *branch)
        literal = entry.literal(case.x, *args)
        columns, central = _central(lambda x, args=args: entry.model(x, *args), case.x, entry.angle)
        change = _change(entry.model(case.x, *args), y, entry.angle)
        apart = partial(difference, split=entry.split)
        yield named(
            finite=finite,
            estimate=float(np.max(np.abs(change) / np.maximum(1, np.abs(y)))),
            analytic=None if analytic is None else max(apart(analytic, x) for x in (forward, reverse)),
            autodiff=None if autodiff is None else apart(autodiff, forward),
            literal=max(apart(literal, x) for x in (forward, analytic) if x is not None),
            reverse=apart(forward, reverse),
            central=apart(central, forward[:, columns]),
        )


def estimate_and_jacobian(name: str, x: Any, *given: Any) -> tuple[np.ndarray, np.ndarray]:
    """An estimate of the registry, and its Jacobian by autodiff."""
    (entry,) = (entry for entry in DERIVATIVES if entry.name == name)
    y, forward, *_ = _program_of(entry)(x, *given)
    return np.asarray(y), np.asarray(forward)


def difference(a: Float[np.ndarray, "m n"], b: Float[np.ndarray, "m n"], *, split: int = 0) -> float:
    """The largest norm of a row of a - b, relative to the norm of that row of b.

    Each row by itself, for metres must not hide radians. The first `split` columns are likewise apart from the others.
    """
    norms = [
        np.linalg.norm(m, axis=1)
        for part in (np.s_[:split], np.s_[split:])
        for m in (a[:, part] - b[:, part], b[:, part])
    ]
    return max(float(np.max(d / np.where(n > 0, n, 1))) for d, n in (norms[:2], norms[2:]))


def _program_of(entry: Derivative) -> Callable[..., Any]:
    return _program(entry.estimate, entry.analytic, entry.autodiff, entry.branch)


@lru_cache
def _program(
    estimate: Callable[..., Array],
    analytic: Callable[..., Array] | None,
    autodiff: Callable[..., Array] | None,
    branch: Callable[..., tuple[Array, ...]] | None,
) -> Callable[..., Any]:
    """All that jax computes of one case, as one program. Entries that have the same functions share it."""

    def program(x: Array, *given: Array) -> tuple[Any, ...]:
        def of_x(x: Array) -> Array:
            return estimate(x, *given)

        return (
            of_x(x),
            _forward(of_x, x),
            jax.jacrev(of_x)(x),
            None if analytic is None else analytic(x, *given),
            None if autodiff is None else autodiff(x, *given),
            () if branch is None else branch(x, *given),
        )

    # XLA's older loop emitters compile this in two thirds of the time. Other devices than CPUs do not look at it.
    return jax.jit(program, compiler_options={"xla_cpu_use_fusion_emitters": False})


def _forward(function: Callable[[Array], Array], x: Float[Array, " n"]) -> Float[Array, "m n"]:
    """`jax.jacfwd`; for many variables some at a time, for the sake of memory."""
    if x.size <= 2 * cases.FEW:
        return jax.jacfwd(function)(x)
    columns = jax.lax.map(
        lambda i: jax.jvp(function, (x,), (jax.nn.one_hot(i, x.size, dtype=x.dtype),))[1],
        jnp.arange(x.size),
        batch_size=50,
    )
    return columns.T


def _central(
    model: Callable[[np.ndarray], np.ndarray], x: Float[np.ndarray, " n"], angle: int | None
) -> tuple[Int[np.ndarray, " c"], Float[np.ndarray, "m c"]]:
    """Central differences with respect to some of the variables: which, and the derivatives."""
    columns = np.unique(np.linspace(0, x.size - 1, min(x.size, COLUMNS)).astype(int))
    columns = np.union1d(columns, np.arange(min(x.size, 3)))  # the pose
    found = []
    for i in columns:
        slopes = []
        for step in (STEP, 2 * STEP):
            above, below = x.copy(), x.copy()
            above[i], below[i] = x[i] + step, x[i] - step
            # Divided by the step that was really taken: far from zero, it is not quite the one that was meant.
            slopes.append(_change(model(above), model(below), angle) / (above[i] - below[i]))
        found.append((4 * slopes[0] - slopes[1]) / 3)
    return columns, np.stack(found, -1)


def _change(a: Float[np.ndarray, " m"], b: Float[np.ndarray, " m"], angle: int | None) -> Float[np.ndarray, " m"]:
    """The difference a - b, with a difference of angles in [-pi, pi)."""
    change = a - b
    if angle is not None:
        change[angle] = (change[angle] + np.pi) % (2 * np.pi) - np.pi
    return change


# --- Eq. (4): points ------------------------------------------------------------------------------------------------


def _point_by_pose(
    pose: Float[Array, "3"], measurement: Float[Array, "2"], mount: Float[Array, "3"], *, jacobians: Jacobians
) -> Float[Array, "2 3"]:
    return points_of_beams(pose, measurement[None], jnp.array(1), mount, jacobians).jac_pose[0]


def _point_by_measurement(
    measurement: Float[Array, "2"], pose: Float[Array, "3"], mount: Float[Array, "3"], *, jacobians: Jacobians
) -> Float[Array, "2 2"]:
    return points_of_beams(pose, measurement[None], jnp.array(1), mount, jacobians).jac_measurement[0]


def _measured_point(measurement: Array, pose: Array, mount: Array) -> Array:
    return sensor.point_from_measurement(pose, measurement, mount)


def _cases_of_points(random: np.random.Generator) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    for place, position in {**cases.PLACES, "random": tuple(random.uniform(-30, 30, 2))}.items():
        for heading in (0.0, np.pi / 4, np.pi / 2, np.pi, random.uniform(-np.pi, np.pi)):
            for reach in (0.05, 1.0, 50.0):
                mount = random.uniform(-1, 1, 3) if random.random() < 0.5 else np.zeros(3)
                measurement = np.array([reach, random.choice([0.0, -np.pi / 2, np.pi / 4, random.uniform(-3, 3)])])
                yield f"{place}, {heading:.2f} rad, {reach:g} m", np.array([*position, heading]), measurement, mount


def _point_by_pose_cases(random: np.random.Generator) -> Iterator[Case]:
    for name, pose, measurement, mount in _cases_of_points(random):
        yield Case(name=name, x=pose, given=(measurement, mount))


def _point_by_measurement_cases(random: np.random.Generator) -> Iterator[Case]:
    for name, pose, measurement, mount in _cases_of_points(random):
        yield Case(name=name, x=measurement, given=(pose, mount))


# --- Eqs. (11)-(17): lines ------------------------------------------------------------------------------------------


def _run(count: Int[Array, ""], size: int) -> Runs:
    """One run of the first points."""
    of_point = jnp.where(jnp.arange(size) < count, 0, -1).astype(jnp.int32)
    return Runs(first=jnp.zeros(1, jnp.int32), last=(count - 1)[None], valid=jnp.ones(1, bool), of_point=of_point)


def _regression_of_points(x: Float[Array, " n"], count: Int[Array, ""], anchor: Float[Array, "2"]) -> Float[Array, "2"]:
    """(m, q) or (s, t), the intercept at the anchor; the pipeline has a point of the line in its place."""
    position = x.reshape(-1, 2)
    fit = lines.regress(position, _run(count, position.shape[0]))
    slope, lever = fit.slope[0], fit.origin[0] + fit.centroid[0] - anchor
    u, v = jnp.where(fit.steep[0], lever[::-1], lever)
    return jnp.stack([slope, v - slope * u])


def _regression_by_points(
    x: Float[Array, " n"], count: Int[Array, ""], anchor: Float[Array, "2"]
) -> Float[Array, "2 n"]:
    position = x.reshape(-1, 2)
    runs = _run(count, position.shape[0])
    jac = lines.jac_regression_points(position, runs, lines.regress(position, runs), anchor[None])
    return _per_variable(jnp.where(runs.of_point[:, None, None] >= 0, jac, 0))


def _line_of_points(x: Float[Array, " n"], count: Int[Array, ""], anchor: Float[Array, "2"]) -> Float[Array, "2"]:
    position = x.reshape(-1, 2)
    fit = lines.regress(position, _run(count, position.shape[0]))
    return lines.line_from_regression(fit, anchor[None])[:, 0]


def _line_by_points(
    x: Float[Array, " n"], count: Int[Array, ""], anchor: Float[Array, "2"], *, jacobians: Jacobians
) -> Float[Array, "2 n"]:
    position = x.reshape(-1, 2)
    runs = _run(count, position.shape[0])
    return _per_variable(lines.jac_line_points(position, runs, anchor[None], jacobians=jacobians))


def _branch_of_points(
    x: Float[Array, " n"], count: Int[Array, ""], anchor: Float[Array, "2"]
) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether y is the regressor, and whether the line runs along its regressor or against it."""
    position = x.reshape(-1, 2)
    return _branch(lines.regress(position, _run(count, position.shape[0])))


def _branch(fit: lines.Regression) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    steep = fit.steep[0]
    return steep, jnp.where(steep, fit.direction[0, 1], fit.direction[0, 0]) > 0


def _per_variable(jac: Float[Array, "N 2 2"]) -> Float[Array, "2 n"]:
    """The derivatives by the numbers of each point, one after the other."""
    return jnp.moveaxis(jac, 0, 1).reshape(2, -1)


def _rows(x: Float[np.ndarray, " n"], count: np.ndarray) -> Float[np.ndarray, "c 2"]:
    return x.reshape(-1, 2)[: int(count)]


def _wide(jac: Float[np.ndarray, "m c"], x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "m n"]:
    """Zeros for the points that belong to no run."""
    return np.concatenate([jac, np.zeros((jac.shape[0], x.size - jac.shape[1]))], 1)


def _run_cases(random: np.random.Generator) -> Iterator[Case]:
    for run in cases.runs(random):
        middle = np.mean(run.points, 0)
        at_origin = random.random() < 0.5
        anchor = np.zeros(2) if at_origin else middle + random.uniform(-0.2, 0.2, 2)
        name = f"{run.name}, anchor {'at the origin' if at_origin else 'on the line'}"
        yield Case(name=name, x=run.padded.ravel(), given=(run.count, anchor), regular=run.regular)


def _line_of_regression(x: Float[Array, "2"], steep: Array, forward: Array) -> Float[Array, "2"]:
    fit, anchor = _fit(x, steep, forward)
    return lines.line_from_regression(fit, anchor)[:, 0]


def _line_by_regression(x: Float[Array, "2"], steep: Array, forward: Array) -> Float[Array, "2 2"]:
    return lines.jac_line_regression(*_fit(x, steep, forward))[0]


def _fit(x: Float[Array, "2"], steep: Array, forward: Array) -> tuple[lines.Regression, Float[Array, "1 2"]]:
    """A regression with some slope and intercept, the intercept at the anchor; and that anchor."""
    slope, intercept = x
    anchor = jnp.array([[0.2, -0.1]])
    centroid, direction = (
        jnp.where(steep, uv[::-1], uv)
        for uv in (jnp.stack([0.7, 0.7 * slope + intercept]), jnp.stack([jnp.ones_like(slope), slope]))
    )
    fit = lines.Regression(
        count=jnp.array([9.0]),
        origin=anchor,
        centroid=centroid[None],
        steep=steep[None],
        width=jnp.ones(1),
        slope=slope[None],
        direction=jnp.where(forward, 1, -1) * direction[None],
    )
    return fit, anchor


def _slope_cases(random: np.random.Generator, *, steep: bool) -> Iterator[Case]:
    for name, slope_intercept in cases.slopes(random):
        for forward in (True, False):
            given = (np.array(steep), np.array(forward))
            yield Case(name=f"{name}{'' if forward else ', reversed'}", x=slope_intercept, given=given)


# --- Eqs. (2)-(17): from the pose and the beams of a scan to a line -------------------------------------------------


def points_of_beams(
    pose: Float[Array, "3"],
    measurements: Float[Array, "N 2"],
    count: Int[Array, ""],
    mount: Float[Array, "3"],
    jacobians: Jacobians,
) -> Points:
    """The points of the first beams of a scan."""
    scan = Scan(
        ranges=measurements[:, 0],
        bearings=measurements[:, 1],
        valid=jnp.arange(measurements.shape[0]) < count,
        spacing=jnp.array(0.01),
        first=jnp.array(0),
    )
    at = Mount(x=mount[0], y=mount[1], theta=mount[2])
    return sensor.points_from_scan(scan, Pose(mean=pose, cov=jnp.zeros((3, 3))), at, jacobians=jacobians)


def _line_of_beams(x: Float[Array, " n"], count: Int[Array, ""], mount: Float[Array, "3"]) -> Float[Array, "2"]:
    """Of the pose and the measurements, one after the other; at the line's own anchor, which is held fixed."""
    fit = _fit_of_beams(x, count, mount)
    return lines.line_from_regression(fit, _anchor(x, fit) - x[None, :2])[:, 0]


def _line_by_beams(x: Float[Array, " n"], count: Int[Array, ""], mount: Float[Array, "3"]) -> Float[Array, "2 n"]:
    """P of `measure_lines`, and what it makes M of."""
    points = points_of_beams(x[:3], x[3:].reshape(-1, 2), count, mount, "analytic")
    runs = _run(count, points.range.shape[0])
    at = Pose(mean=x[:3], cov=jnp.zeros((3, 3)))
    found, by_pose, _ = lines.measure_lines(
        points, at, runs, SensorNoise(), maximum_likelihood=False, covariance="exact", jacobians="analytic"
    )
    jac = lines.jac_line_points(points.position, runs, found.anchor - x[None, :2], jacobians="analytic")
    return jnp.concatenate([by_pose[0], _per_variable(product(jac, points.jac_measurement))], 1)


def _likely_line_of_beams(
    x: Float[Array, " n"], count: Int[Array, ""], mount: Float[Array, "3"], sigma: Float[Array, "2"]
) -> Float[Array, "2"]:
    """The line of the default: a step of likelihood from the regression."""
    points = points_of_beams(x[:3], x[3:].reshape(-1, 2), count, mount, "analytic")
    runs = _run(count, points.range.shape[0])
    fit = lines.regress(points.position, runs)
    anchor = _anchor(x, fit) - x[None, :2]
    start = lines.line_from_regression(fit, anchor)
    at = likelihood.linearise(points, runs, anchor, start, _noise(sigma))
    return likelihood.step(points.position, runs, start, at)[:, 0]


def _likely_line_by_beams(
    x: Float[Array, " n"], count: Int[Array, ""], mount: Float[Array, "3"], sigma: Float[Array, "2"]
) -> Float[Array, "2 n"]:
    """P of `measure_lines`, and what it makes M of."""
    points = points_of_beams(x[:3], x[3:].reshape(-1, 2), count, mount, "analytic")
    runs = _run(count, points.range.shape[0])
    pose = Pose(mean=x[:3], cov=jnp.zeros((3, 3)))
    _, by_pose, _ = lines.measure_lines(
        points, pose, runs, _noise(sigma), maximum_likelihood=True, covariance="exact", jacobians="analytic"
    )
    fit = lines.regress(points.position, runs)
    anchor = _anchor(x, fit) - x[None, :2]
    start = lines.line_from_regression(fit, anchor)
    at = likelihood.linearise(points, runs, anchor, start, _noise(sigma))
    jac = likelihood.jac_step_points(points.position, runs, start, at, jacobians="analytic")
    return jnp.concatenate([by_pose[0], _per_variable(product(jac, points.jac_measurement))], 1)


def _noise(sigma: Float[Array, "2"]) -> SensorNoise:
    return SensorNoise(range_sigma=sigma[0], bearing_sigma=sigma[1])


def _branch_of_beams(
    x: Float[Array, " n"], count: Int[Array, ""], mount: Float[Array, "3"], *_: Float[Array, "2"]
) -> tuple[Float[Array, "2"], Bool[Array, ""], Bool[Array, ""]]:
    """The anchor in the world, and the branch as in `_branch_of_points`."""
    fit = _fit_of_beams(x, count, mount)
    return _anchor(x, fit)[0], *_branch(fit)


def _fit_of_beams(x: Float[Array, " n"], count: Int[Array, ""], mount: Float[Array, "3"]) -> lines.Regression:
    points = points_of_beams(x[:3], x[3:].reshape(-1, 2), count, mount, "analytic")
    return lines.regress(points.position, _run(count, points.range.shape[0]))


def _anchor(x: Float[Array, " n"], fit: lines.Regression) -> Float[Array, "1 2"]:
    return jax.lax.stop_gradient(x[None, :2] + fit.origin + fit.centroid)


def _beam_cases(random: np.random.Generator) -> Iterator[Case]:
    for run, pose, measurements, mount in cases.beams(random):
        x = np.concatenate([pose, measurements.ravel()])
        yield Case(name=run.name, x=x, given=(run.count, mount), regular=run.regular)


def _exact_beam_cases(random: np.random.Generator) -> Iterator[Case]:
    """Points without noise: there the derivative of the likelihood is exact, elsewhere of first order."""
    for case in _beam_cases(random):
        if "exact" in case.name:
            yield dataclasses.replace(case, given=(*case.given, np.array([0.02, 0.002])))


# --- Eqs. (18)-(20): circles ----------------------------------------------------------------------------------------


def _circle_of_points(x: Float[Array, " n"], count: Int[Array, ""]) -> Float[Array, "3"]:
    position = x.reshape(-1, 2)
    n = position.shape[0]
    valid = jnp.arange(n) < count
    points = Points(
        position=position,
        beam=jnp.zeros((n, 2)),
        range=jnp.ones(n),
        turn=jnp.zeros(n),
        valid=valid,
        index=jnp.arange(n),
        jac_pose=jnp.zeros((n, 2, 3)),
        jac_measurement=jnp.zeros((n, 2, 2)),
        laser=jnp.zeros(2),
        spacing=jnp.array(0.01),
    )
    all_join = Thresholds(cluster_distance=1e6)
    at = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))
    run = _run(count, n)
    found = circles.measure_circles(points, at, run, all_join, SensorNoise(), fit=False, jacobians="analytic")
    return jnp.concatenate([found.center[0], found.radius])


def _circle_cases(random: np.random.Generator) -> Iterator[Case]:
    for run in cases.arcs(random):
        yield Case(name=run.name, x=run.padded.ravel(), given=(run.count,), regular=run.regular)


# --- Eqs. (23)-(25): fusion -----------------------------------------------------------------------------------------


def _one_line(estimate: Float[Array, "2"], cov: Float[Array, "2 2"]) -> Lines:
    """A line without a pose error, at an anchor that is always the same."""
    return dataclasses.replace(
        empty_lines(1),
        anchor=jnp.array([[5.0, -3.0]]),
        offset=estimate[:1],
        angle=estimate[1:],
        cov_independent=cov[None],
        extent=jnp.array([[-1.0, 1.0]]),
        times_detected=jnp.ones(1, jnp.int32),
        valid=jnp.ones(1, bool),
    )


def _fused_line(x: Float[Array, "4"], cov_l: Float[Array, "2 2"], cov_m: Float[Array, "2 2"]) -> Float[Array, "2"]:
    """The line of the map, x_l, after a line x_m was fused into it."""
    yes = jnp.ones(1, bool)
    old, new = _one_line(x[:2], cov_l), _one_line(x[2:], cov_m)
    line = fusion.fuse_lines(old, yes, new, yes[None], Thresholds(), PAPER_RULES, "independent")
    return jnp.stack([line.offset[0], line.angle[0]])


def _fused_line_by_both(
    x: Float[Array, "4"], cov_l: Float[Array, "2 2"], cov_m: Float[Array, "2 2"]
) -> Float[Array, "2 4"]:
    gain, _ = gain_and_cov(cov_l, cov_m)
    return jnp.concatenate([jnp.eye(2) - gain, gain], 1)


def gain_and_cov(
    cov_l: Float[Array, "2 2"], cov_m: Float[Array, "2 2"]
) -> tuple[Float[Array, "2 2"], Float[Array, "2 2"]]:
    """K and C_r of the pipeline, for a line of the map and a new one that share no error."""
    old, new = (
        fusion.Errors(cov_independent=cov, sqrt_persistent=jnp.zeros((2, 3)), times_detected=jnp.array(1))
        for cov in (cov_l, cov_m)
    )
    gain, errors = fusion.combine(old, new, "independent")
    return gain, errors.cov_independent


def _fusion_cases(random: np.random.Generator) -> Iterator[Case]:
    for name, cov_l, cov_m in cases.covariances(random):
        for angle in (0.0, np.pi / 4, np.pi / 2, 3.14, -3.14, random.uniform(-3, 3)):
            old = np.array([random.uniform(-0.1, 0.1), angle])
            new = old + random.uniform(-0.02, 0.02, 2)
            yield Case(name=f"{name}, {angle:.2f} rad", x=np.concatenate([old, new]), given=(cov_l, cov_m))


def _fused_circle(x: Float[Array, "6"]) -> Float[Array, "3"]:
    old, new = (
        dataclasses.replace(
            empty_circles(1),
            center=c[None, :2],
            radius=c[2:],
            times_detected=jnp.array([7], jnp.int32),
            valid=jnp.ones(1, bool),
        )
        for c in (x[:3], x[3:])
    )
    slot = jnp.zeros(1, jnp.int32)
    zero = jnp.zeros(1)
    none = jnp.full(1, -1, jnp.int32)
    match = CircleMatches(slot=slot, distance=zero, nis=zero, dof=slot, suspect=none)
    found = fusion.fuse_circles(old, new, match, PAPER_RULES, "independent")
    return jnp.concatenate([found.center[0], found.radius])


def _circle_fusion_cases(random: np.random.Generator) -> Iterator[Case]:
    for place, middle in cases.PLACES.items():
        for i in range(3):
            old = np.array([*middle, 0.1]) + random.uniform(-0.05, 0.05, 3)
            yield Case(name=f"{place}, {i}", x=np.concatenate([old, old + random.uniform(-0.1, 0.1, 3)]), given=())


# --- Section 3: the pose filter -------------------------------------------------------------------------------------


def _step_taken(x: Float[Array, "6"]) -> Float[Array, "3"]:
    """Of a pose and a step, one after the other."""
    return compose(x[:3], x[3:])


def _step_by_both(x: Float[Array, "6"]) -> Float[Array, "3 6"]:
    return jnp.concatenate([jac_compose_pose(x[:3], x[3:]), jac_compose_step(x[:3], x[3:])], 1)


def _step_cases(random: np.random.Generator) -> Iterator[Case]:
    for name, pose, measurement, mount in _cases_of_points(random):
        reach, turn = measurement
        step = np.array([reach, mount[1], turn])
        yield Case(name=name, x=np.concatenate([pose, step]), given=())


def _beacon_cases(random: np.random.Generator) -> Iterator[Case]:
    """The places that beams of some length end at: near the robot, far from it, all around it."""
    for name, pose, measurement, mount in _cases_of_points(random):
        yield Case(name=name, x=pose, given=(literals.point(pose, measurement, mount), mount))


# --- The registry ---------------------------------------------------------------------------------------------------

_of_points: dict[str, Any] = {
    "estimate": _regression_of_points,
    "analytic": _regression_by_points,
    "branch": _branch_of_points,
    "model": lambda x, n, anchor, steep, _: literals.regression(_rows(x, n), anchor, steep),
    "literal": lambda x, n, anchor, steep, _: _wide(literals.j_of_equation_12(_rows(x, n), anchor, steep), x),
    "cases": _run_cases,
}

_of_regression: dict[str, Any] = {
    "estimate": _line_of_regression,
    "analytic": _line_by_regression,
    "model": literals.line,
    "literal": literals.h_of_equations_15_to_17,
    "angle": 1,
}


DERIVATIVES: tuple[Derivative, ...] = (
    Derivative(
        name="F",
        estimate=sensor.point_from_measurement,
        analytic=partial(_point_by_pose, jacobians="analytic"),
        autodiff=partial(_point_by_pose, jacobians="autodiff"),
        model=literals.point,
        literal=literals.f_of_equation_4,
        cases=_point_by_pose_cases,
    ),
    Derivative(
        name="G",
        estimate=_measured_point,
        analytic=partial(_point_by_measurement, jacobians="analytic"),
        autodiff=partial(_point_by_measurement, jacobians="autodiff"),
        model=lambda s, pose, mount: literals.point(pose, s, mount),
        literal=lambda s, pose, mount: literals.g_of_equation_4(pose, s, mount),
        cases=_point_by_measurement_cases,
    ),
    Derivative(name="J (m, q)", applies=lambda steep, _: not steep, **_of_points),
    Derivative(name="J (s, t)", applies=lambda steep, _: bool(steep), **_of_points),
    Derivative(name="H (m, q)", cases=partial(_slope_cases, steep=False), **_of_regression),
    Derivative(name="H (s, t)", cases=partial(_slope_cases, steep=True), **_of_regression),
    Derivative(
        name="line by points",
        estimate=_line_of_points,
        analytic=partial(_line_by_points, jacobians="analytic"),
        autodiff=partial(_line_by_points, jacobians="autodiff"),
        branch=_branch_of_points,
        model=lambda x, n, *others: literals.line_of_points(_rows(x, n), *others),
        literal=lambda x, n, *others: _wide(literals.jac_line_points(_rows(x, n), *others), x),
        angle=1,
        cases=_run_cases,
    ),
    Derivative(
        name="line by pose and beams",
        estimate=_line_of_beams,
        analytic=_line_by_beams,
        branch=_branch_of_beams,
        model=lambda x, n, mount, *others: literals.line_of_scan(x[:3], _rows(x[3:], n), mount, *others),
        literal=lambda x, n, mount, *others: _wide(
            np.concatenate(
                [
                    f(x[:3], _rows(x[3:], n), mount, *others)
                    for f in (literals.jac_line_pose, literals.jac_line_measurements)
                ],
                1,
            ),
            x,
        ),
        angle=1,
        split=3,
        cases=_beam_cases,
    ),
    Derivative(
        name="most likely line by pose and beams",
        estimate=_likely_line_of_beams,
        analytic=_likely_line_by_beams,
        branch=_branch_of_beams,
        model=lambda x, n, *others: literals.most_likely_line(x[:3], _rows(x[3:], n), *others),
        literal=lambda x, n, *others: _wide(literals.jac_most_likely_line(x[:3], _rows(x[3:], n), *others), x),
        angle=1,
        split=3,
        cases=_exact_beam_cases,
    ),
    Derivative(
        name="circle by points",
        estimate=_circle_of_points,
        model=lambda x, n: literals.circle(_rows(x, n)),
        literal=lambda x, n: _wide(literals.jac_circle_points(_rows(x, n)), x),
        cases=_circle_cases,
    ),
    Derivative(
        name="fused line",
        estimate=_fused_line,
        analytic=_fused_line_by_both,
        model=literals.fused_line,
        literal=literals.jac_fused_line,
        angle=1,
        cases=_fusion_cases,
    ),
    Derivative(
        name="fused circle",
        estimate=_fused_circle,
        model=literals.fused_circle,
        literal=literals.jac_fused_circle,
        cases=_circle_fusion_cases,
    ),
    Derivative(
        name="pose by pose and step",
        estimate=_step_taken,
        analytic=_step_by_both,
        autodiff=jax.jacfwd(_step_taken),
        model=lambda x: literals.step_taken(x[:3], x[3:]),
        literal=lambda x: literals.step_by_pose_and_step(x[:3], x[3:]),
        angle=2,
        cases=_step_cases,
    ),
    Derivative(
        name="beacon by pose",
        estimate=pose_filter.beacon_from_pose,
        analytic=pose_filter.jac_beacon_pose,
        autodiff=jax.jacfwd(pose_filter.beacon_from_pose),
        model=literals.beacon,
        literal=literals.beacon_by_pose,
        angle=1,
        cases=_beacon_cases,
    ),
)
