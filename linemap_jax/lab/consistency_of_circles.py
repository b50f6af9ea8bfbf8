"""Whether the covariances of circles can be believed; as `consistency` asks of lines, and judged by its `judge`.

Of a fitted circle the truth is the pole, of a circle after Eqs. (18)-(20) the one that the same beams would give
without noise. The NEES of (x, y, radius) is chi-square with 3 degrees of freedom where the covariance is right. Each
experiment is a function of a key that makes one run; map it over keys:

- `known_points`: both circles, from all returns of a pole.
- `pipeline`: what `extract` makes of the scan.
- `fused`: a fitted circle of the map after many scans, association known, with pose errors that may persist.
"""

import dataclasses
from collections.abc import Sequence
from typing import Unpack

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from linemap_jax.core.circles import measure_circles
from linemap_jax.core.extract import extract
from linemap_jax.core.frames import dot, perp
from linemap_jax.core.fusion import forget, fuse_circles
from linemap_jax.core.matching import match_circles
from linemap_jax.core.runs import Runs
from linemap_jax.core.sensor import points_from_scan
from linemap_jax.core.settings import Method, Mount, Number, Rules, Thresholds, persistence_of
from linemap_jax.core.slots import choose
from linemap_jax.core.state import Circles, Pose, Scan, empty_circles
from linemap_jax.lab.consistency import Model, Sample, nees
from linemap_jax.lab.robot import estimate_pose, estimate_poses
from linemap_jax.lab.scanners import Scanner, Truth, noise_of, simulate_scan
from linemap_jax.lab.world import poles

ARC_POINTS = 6
"""Fewest points of an arc whose covariance is said to hold."""
ARC_SIGMAS = 3.0
"""Least spread of such an arc, in sigmas of the range: a smaller radius is made of noise."""


def known_points(
    key: Array,
    center: Float[Array, "2"],
    radius: Float[Array, ""],
    pose: Float[Array, "3"],
    scanner: Scanner,
    cov_pose: Float[Array, "3 3"],
) -> dict[str, Sample]:
    """The circles from all returns of one pole: "fit", where it is believed, and "arc", after Eqs. (18)-(20).

    The arc counts if it has `ARC_POINTS` and a spread of `ARC_SIGMAS`, both without noise.

    Args:
      key: of the noise, of the pose's error, and of a turn of the robot by less than the spacing of the beams, so that
        the pole does not always lie alike between them.
      center: of the pole, m.
      radius: of the pole, m.
      pose: the true one.
      scanner: its noise is what the fit believes.
      cov_pose: of the pose's error.

    Returns:
      The two samples by their names.
    """
    scan, truth, pose, estimate = _look(key, center, radius, pose, scanner, cov_pose)
    fit, arc = (_measure(scan, estimate, scanner, fit=which) for which in (True, False))
    exact = dataclasses.replace(scan, ranges=jnp.where(scan.valid, truth.ranges, 0), bearings=truth.bearings)
    clean = _measure(exact, Pose(mean=pose, cov=jnp.zeros_like(cov_pose)), scanner, fit=False)
    many = (jnp.sum(scan.valid) >= ARC_POINTS) & (clean.radius >= ARC_SIGMAS * scanner.range_sigma)
    return {
        "fit": _sample(fit, center, radius, pose, fit.fitted),
        "arc": _sample(arc, clean.center, clean.radius, pose, many),
    }


def pipeline(
    key: Array,
    center: Float[Array, "2"],
    radius: Float[Array, ""],
    pose: Float[Array, "3"],
    scanner: Scanner,
    cov_pose: Float[Array, "3 3"],
    *,
    thresholds: Thresholds = Thresholds(),
    **method: Unpack[Method],
) -> Sample:
    """The fitted circle that `extract` finds, the nearest to the pole; arguments as of `known_points`.

    Args:
      key: as above.
      center: as above.
      radius: as above.
      pose: as above.
      scanner: as above.
      cov_pose: as above.
      thresholds: of `extract`.
      **method: of `extract`.

    Returns:
      The sample; it does not count where there is no fitted circle.
    """
    scan, _, pose, estimate = _look(key, center, radius, pose, scanner, cov_pose)
    circles = extract(scan, estimate, thresholds=thresholds, noise=noise_of(scanner), **method).circles
    step = circles.center - center[None]
    distance = jnp.where(circles.valid & circles.fitted, dot(step, step), jnp.inf)
    circle = jax.tree.map(lambda x: x[jnp.argmin(distance)], circles)
    return _sample(circle, center, radius, pose, circle.valid & circle.fitted)


def fused(
    key: Array,
    center: Float[Array, "2"],
    radius: Float[Array, ""],
    path: Float[Array, "T 3"],
    scanner: Scanner,
    cov_pose: Float[Array, "3 3"],
    correlation: Number,
    models: Sequence[Model],
) -> tuple[Sample, Float[Array, "M T"]]:
    """The NEES of a pole in the map after each scan, and the NIS of each scan's circle before it is fused.

    It is known which circle is which; no gate keeps one out.

    Args:
      key: of the noise, and of the poses' errors.
      center: of the pole, m.
      radius: of the pole, m.
      path: the true poses.
      scanner: its noise is what the fit believes.
      cov_pose: of the pose's error.
      correlation: of the pose's error from one scan to the next, as in `consistency.fused`.
      models: what `M` maps believe of that.

    Returns:
      Samples, `[M, T]`, that count from the first fit on; and NIS, which is zero where there is none.
    """
    of_scans, of_poses = jax.random.split(key)
    open_gates = Thresholds(circle_match_distance=jnp.inf, circle_match_nis=jnp.inf)

    def improve(new: Circles, before: Circles, model: Model) -> tuple[Circles, Array]:
        persistence = persistence_of(model.pose_error, model.persistence)
        before = forget(before, jnp.square(persistence.correlation))
        new = forget(new, persistence.share)
        match = match_circles(new, before, open_gates, Rules(), model.pose_error)
        after = fuse_circles(before, new, match, Rules(), model.pose_error)
        return choose(before.valid, after, choose(new.valid, new, before)), match.nis[0]

    def step(held: list[Circles], x: tuple[Array, Array, Pose]) -> tuple[list[Circles], tuple[list[Sample], Array]]:
        of_scan, pose, estimate = x
        scan, _ = simulate_scan(of_scan, poles(center[None], radius), pose, scanner)
        new = _measure(scan, estimate, scanner, fit=True)
        new = jax.tree.map(lambda x: x[None], new)
        new = choose(new.fitted, new, empty_circles(1, path.dtype))
        improved = [improve(new, before, model) for before, model in zip(held, models, strict=True)]
        held = [after for after, _ in improved]
        samples = [_sample(jax.tree.map(lambda x: x[0], x), center, radius, pose, x.valid[0]) for x in held]
        return held, (samples, jnp.stack([nis for _, nis in improved]))

    estimates = estimate_poses(of_poses, path, cov_pose, correlation=correlation)
    scans = (jax.random.split(of_scans, path.shape[0]), path, estimates)
    _, (samples, nis) = jax.lax.scan(step, [empty_circles(1, path.dtype) for _ in models], scans)
    return jax.tree.map(lambda *x: jnp.stack(x), *samples), nis.T


def _look(
    key: Array,
    center: Float[Array, "2"],
    radius: Float[Array, ""],
    pose: Float[Array, "3"],
    scanner: Scanner,
    cov_pose: Float[Array, "3 3"],
) -> tuple[Scan, Truth, Float[Array, "3"], Pose]:
    """A scan of the pole alone, what its beams did, the true pose and what the robot believes."""
    of_turn, of_scan, of_pose = jax.random.split(key, 3)
    spacing = scanner.bearings[1] - scanner.bearings[0]
    pose = pose.at[2].add(spacing * (jax.random.uniform(of_turn, dtype=pose.dtype) - 0.5))
    scan, truth = simulate_scan(of_scan, poles(center[None], radius), pose, scanner)
    return scan, truth, pose, estimate_pose(of_pose, pose, cov_pose)


def _measure(scan: Scan, pose: Pose, scanner: Scanner, *, fit: bool) -> Circles:
    """The circle of all returns of a scan. No batch axis."""
    mount = jax.tree.map(lambda x: jnp.asarray(x, pose.mean.dtype), Mount())
    points = points_from_scan(scan, pose, mount, jacobians="analytic")
    count = jnp.sum(points.valid, dtype=jnp.int32)
    runs = Runs(
        first=jnp.zeros(1, jnp.int32),
        last=jnp.maximum(count - 1, 1)[None],
        valid=(count >= 2)[None],
        of_point=jnp.where(points.valid, 0, -1),
    )
    found = measure_circles(points, pose, runs, Thresholds(), noise_of(scanner), fit=fit, jacobians="analytic")
    return jax.tree.map(lambda x: x[0], found)


def _sample(
    circle: Circles, center: Float[Array, "2"], radius: Float[Array, ""], pose: Float[Array, "3"], counts: Array
) -> Sample:
    """The error of one circle: away from the scanner, to the left, of the radius. m."""
    step = circle.center - center
    error = jnp.concatenate([step, (circle.radius - radius)[None]])
    away = (center - pose[:2]) / jnp.sqrt(dot(center - pose[:2], center - pose[:2]))
    local = jnp.stack([dot(away, step), dot(perp(away), step), error[2]])
    return Sample(nees(error, circle.cov), local, counts)
