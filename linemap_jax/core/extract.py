"""Section 4 as a whole: one scan into lines and circles."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core import circles as circles_
from linemap_jax.core.lines import MIN_POINTS, choose_points, length_of_run, measure_lines
from linemap_jax.core.runs import select_runs
from linemap_jax.core.segmentation import incremental, optimal
from linemap_jax.core.sensor import Points, points_from_scan
from linemap_jax.core.settings import (
    LEAST_SIGMA,
    SCAN_CAPACITY,
    Capacity,
    Covariance,
    Jacobians,
    Mount,
    Rules,
    Segmentation,
    SensorNoise,
    Thresholds,
)
from linemap_jax.core.slots import LARGEST, neutral_where_free
from linemap_jax.core.state import Extraction, Pose, Rejected, Scan, Status

ONE_AND_ROUNDING = 1.001
"""The square of the largest correlation that is taken for one."""


@partial(jax.jit, static_argnames=("capacity", "rules", "segmentation", "max_vertices", "covariance", "jacobians"))
def extract(
    scan: Scan,
    pose: Pose,
    *,
    thresholds: Thresholds | None = None,
    noise: SensorNoise | None = None,
    mount: Mount | None = None,
    capacity: Capacity = SCAN_CAPACITY,
    rules: Rules = Rules(),
    segmentation: Segmentation = "incremental",
    max_vertices: int | None = None,
    covariance: Covariance = "exact",
    jacobians: Jacobians = "analytic",
) -> Extraction:
    """Lines and circles of one scan, in the frame of the world, with covariances.

    `vmap` it for batches; on a CPU `jax.lax.map` is faster, which takes one scan after the other. The dtype is that of
    the scan.

    Args:
      scan: `N` beams.
      pose: of the robot; a pose of zeros with a covariance of zeros gives the sensor's frame and measurement noise
        alone. A pose that is not finite gives no primitives and `Status.POSE_NOT_FINITE`.
      thresholds: criteria of the extraction; `Thresholds()` unless given.
      noise: of the sensor; `SensorNoise()` unless given.
      mount: of the scanner on the robot; at its centre, looking ahead, unless given.
      capacity: slots for lines and circles. What does not fit is left out, in beam order, and the status tells.
      rules: which reading of the method.
      segmentation: "incremental", the paper's criteria, or "optimal", the runs that explain the points best.
      max_vertices: of "optimal": a budget of end points for the scan, 2 or more; a corner that two lines share counts
        once. The lines are then those of polylines, down to two points each, and have slots for all of the budget.
        Their derivatives are taken forward (`jax.jacfwd`); all others in either direction.
      covariance: "exact", to first order with the pose error that all points share, or "printed", Eq. (12).
      jacobians: "analytic", the hand-derived ones, or "autodiff" through the estimate; the results are the same.

    Returns:
      The primitives in `capacity` slots, in beam order. Between circles there may be free slots.

    Raises:
      TypeError: if the pose is no `Pose`.
      ValueError: at trace time, for an option that does not exist.
    """
    _, _, found = observe(
        scan,
        pose,
        *with_defaults(thresholds, noise, mount, scan.ranges.dtype),
        capacity=capacity,
        rules=rules,
        segmentation=segmentation,
        max_vertices=max_vertices,
        covariance=covariance,
        jacobians=jacobians,
    )
    return found


def observe(
    scan: Scan,
    pose: Pose,
    thresholds: Thresholds,
    noise: SensorNoise,
    mount: Mount,
    *,
    capacity: Capacity,
    rules: Rules,
    segmentation: Segmentation,
    covariance: Covariance,
    jacobians: Jacobians,
    max_vertices: int | None = None,
) -> tuple[Points, Pose, Extraction]:
    """`extract`, with all that a map is updated by.

    Args:
      scan: `N` beams.
      pose: of the robot.
      thresholds: criteria of the extraction, as arrays of the dtype of the scan; see `with_defaults`.
      noise: of the sensor, likewise.
      mount: of the scanner on the robot, likewise.
      capacity: as for `extract`, and so are the others.
      rules: which reading of the method.
      segmentation: how points are divided into lines.
      covariance: "exact" or "printed".
      jacobians: "autodiff" or "analytic".
      max_vertices: of "optimal".

    Returns:
      The points; the pose, made finite; and what the points hold.

    Raises:
      TypeError: if the pose is no `Pose`.
      ValueError: at trace time, for an option that does not exist.
    """
    if not isinstance(pose, Pose):
        raise TypeError("pose must be a Pose, with mean and covariance, not an array alone")
    scan, pose, finite = usable(scan, as_dtype(pose, scan.ranges.dtype))
    points = points_from_scan(scan, pose, mount, jacobians=jacobians)
    found = extract_points(
        points,
        pose,
        thresholds,
        noise,
        capacity=capacity,
        rules=rules,
        segmentation=segmentation,
        max_vertices=max_vertices,
        covariance=covariance,
        jacobians=jacobians,
    )
    status = found.status | jnp.where(finite, 0, int(Status.POSE_NOT_FINITE)).astype(jnp.int32)
    return points, pose, dataclasses.replace(found, status=status)


def usable(scan: Scan, pose: Pose) -> tuple[Scan, Pose, Bool[Array, ""]]:
    """A scan and a pose without anything that is not finite, and whether the pose was finite.

    What stands in a masked beam may be anything; a scan with a pose that is not finite loses all its beams. What is
    beyond `LARGEST` counts as infinite, and so does the pose where its covariance is none: variances are not negative,
    and correlations, up to rounding, not beyond one. No heading is less known than to half a turn.

    Args:
      scan: `N` beams.
      pose: of the robot.

    Returns:
      The scan, the pose, and whether the pose was finite.

    Raises:
      ValueError: at trace time, for a pose of another shape, or for several scans.
    """
    if scan.ranges.ndim != 1:
        raise ValueError(f"one scan has ranges [N], not {list(scan.ranges.shape)}: jax.vmap or jax.lax.map takes many")
    for name, shape in (("mean", (3,)), ("cov", (3, 3))):
        if getattr(pose, name).shape != shape:
            raise ValueError(f"pose.{name} must have shape {shape}, not {getattr(pose, name).shape}")
    variance = jnp.diagonal(pose.cov)
    finite = jnp.all(jnp.abs(pose.mean) <= LARGEST) & jnp.all((variance >= 0) & (variance <= LARGEST))
    finite &= jnp.all(pose.cov**2 <= ONE_AND_ROUNDING * variance[:, None] * variance[None])
    valid = scan.valid & finite & (scan.ranges <= LARGEST) & (jnp.abs(scan.bearings) <= LARGEST)
    ranges, bearings = (jnp.where(valid, x, 0) for x in (scan.ranges, scan.bearings))
    # A sigma of many turns says no more than one of half a turn, and float32 would lose all else beside it.
    heading = jnp.where(variance[2] > jnp.pi**2, jnp.pi * jax.lax.rsqrt(jnp.maximum(variance[2], 1)), 1)
    known = jnp.ones_like(variance).at[2].set(heading)
    pose = dataclasses.replace(pose, cov=pose.cov * known[:, None] * known[None])
    pose = jax.tree.map(lambda x: jnp.where(finite, x, 0), pose)
    return dataclasses.replace(scan, ranges=ranges, bearings=bearings, valid=valid), pose, finite


def extract_points(
    points: Points,
    pose: Pose,
    thresholds: Thresholds,
    noise: SensorNoise,
    *,
    capacity: Capacity,
    rules: Rules,
    segmentation: Segmentation,
    max_vertices: int | None,
    covariance: Covariance,
    jacobians: Jacobians,
) -> Extraction:
    """`extract`, from the points of the scan on.

    Args:
      points: the points of the scan.
      pose: of the robot, finite.
      thresholds: criteria of the extraction, as arrays of the dtype of the scan.
      noise: of the sensor, likewise.
      capacity: as for `extract`, and so are the others.
      rules: which reading of the method.
      segmentation: how points are divided into lines.
      max_vertices: of "optimal".
      covariance: "exact" or "printed".
      jacobians: "autodiff" or "analytic".

    Returns:
      What the points hold, in the frame of the world.

    Raises:
      ValueError: at trace time, for an option that does not exist.
    """
    segmented, chosen = None, points.valid
    if segmentation == "optimal":
        segmented = optimal.segment(points, thresholds, noise, max_vertices=max_vertices)
        points, ends, run, breaks = segmented.points, segmented.ends, segmented.run, segmented.breaks
        chosen = segmented.on_line
    elif max_vertices is not None:
        raise ValueError("max_vertices is for segmentation='optimal'")
    elif segmentation == "incremental":
        ends, run, breaks = incremental.segment(points, thresholds, noise, rules)
    else:
        raise ValueError(f"segmentation must be 'incremental' or 'optimal', not {segmentation!r}")
    few = run.n < MIN_POINTS
    short = length_of_run(run, points.position) <= thresholds.min_length
    if max_vertices is not None:
        few, short = ~chosen, jnp.zeros_like(chosen)
    slots = max(capacity.lines, max_vertices or 0)
    runs, lines_full = select_runs(run.n, ends & chosen & ~few & ~short, slots)
    fitted = runs
    if max_vertices is None:
        runs, fitted = choose_points(points, runs, thresholds, noise, rules)
    lines, jac_line_pose, cov_measurement = measure_lines(
        points,
        pose,
        fitted,
        noise,
        maximum_likelihood=rules.maximum_likelihood,
        covariance=covariance,
        jacobians=jacobians,
        min_length=thresholds.min_length if max_vertices is None else 0.0,
    )
    if segmented is not None and max_vertices is not None:
        lines = optimal.lines_of_polyline(lines, segmented, pose)
    elif segmented is not None:
        lines = optimal.join_corners(lines, runs, segmented, pose)

    cluster_ends, size = circles_.cluster(points, points.valid & (runs.of_point < 0), thresholds)
    lone = size < 2
    clusters, circles_full = select_runs(size, cluster_ends & ~lone, capacity.circles)
    circles = circles_.measure_circles(
        points, pose, clusters, thresholds, noise, fit=rules.fit_circles, jacobians=jacobians
    )
    near = circles_.near_lines(circles, lines, thresholds, rules)
    circles = dataclasses.replace(circles, valid=circles.valid & ~near)

    def points_of(count: Float[Array, " N"], ends: Bool[Array, " N"]) -> Int[Array, ""]:
        return jnp.sum(jnp.where(ends, count, 0)).astype(jnp.int32)

    status = jnp.where(lines_full, int(Status.SCAN_LINES_FULL), 0)
    status |= jnp.where(circles_full, int(Status.SCAN_CIRCLES_FULL), 0)
    in_run = runs.of_point >= 0
    on_line, left = in_run & lines.valid[runs.of_point], in_run & ~fitted.valid[runs.of_point]
    in_cluster = clusters.of_point >= 0
    modelled = circles.valid[clusters.of_point]
    return Extraction(
        lines=lines,
        circles=neutral_where_free(circles),
        jac_line_pose=jac_line_pose,
        cov_measurement=cov_measurement,
        line_of_beam=points.per_beam(jnp.where(on_line, runs.of_point, -1)),
        circle_of_beam=points.per_beam(jnp.where(in_cluster & modelled, clusters.of_point, -1)),
        rejected=Rejected(
            invalid=jnp.sum(~points.valid, dtype=jnp.int32),
            gap=breaks[0],
            distance=breaks[1],
            bearing=breaks[2],
            too_few=points_of(run.n, ends & few) + jnp.sum(left, dtype=jnp.int32),
            too_short=points_of(run.n, ends & ~few & short) + jnp.sum(in_run & ~on_line & ~left, dtype=jnp.int32),
            lone=points_of(size, cluster_ends & lone),
            near_line=jnp.sum(in_cluster & ~modelled, dtype=jnp.int32),
        ),
        status=status.astype(jnp.int32),
    )


def with_defaults(
    thresholds: Thresholds | None, noise: SensorNoise | None, mount: Mount | None, dtype: Any
) -> tuple[Thresholds, SensorNoise, Mount]:
    """The settings as arrays of one dtype, the defaults where none are given.

    Args:
      thresholds: `Thresholds()` unless given.
      noise: `SensorNoise()` unless given.
      mount: `Mount()` unless given.
      dtype: of the scan.

    Returns:
      All three, as arrays of that dtype.
    """
    settings = thresholds or Thresholds(), noise or SensorNoise(), mount or Mount()
    criteria, errors, place = as_dtype(settings, dtype)
    errors = dataclasses.replace(errors, range_sigma=jnp.maximum(errors.range_sigma, LEAST_SIGMA))
    return criteria, errors, place


def as_dtype(tree: Any, dtype: Any) -> Any:
    """The pytree `tree` with all its numbers as arrays of the float type `dtype`."""
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), tree)
