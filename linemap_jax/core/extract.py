"""Section 4 as a whole: one scan into lines and circles."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from linemap_jax.core import circles as circles_
from linemap_jax.core import lines as lines_
from linemap_jax.core.sensor import points_from_scan
from linemap_jax.core.segmentation import incremental
from linemap_jax.core.settings import (
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
from linemap_jax.core.state import Circles, Extraction, Pose, Rejected, Scan, Status, empty_circles


@partial(jax.jit, static_argnames=("capacity", "rules", "segmentation", "covariance", "jacobians"))
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
    covariance: Covariance = "exact",
    jacobians: Jacobians = "autodiff",
) -> Extraction:
    """Lines and circles of one scan, in the frame of the world, with covariances.

    `vmap` it for batches. The dtype is that of the scan.

    Args:
      scan: `N` beams.
      pose: of the robot; a pose of zeros with a covariance of zeros gives the sensor's frame and measurement noise
        alone. A pose that is not finite gives no primitives and `Status.POSE_NOT_FINITE`.
      thresholds: criteria of the extraction; `Thresholds()` unless given.
      noise: of the sensor; `SensorNoise()` unless given.
      mount: of the scanner on the robot; at its centre, looking ahead, unless given.
      capacity: slots for lines and circles. What does not fit is left out, in beam order, and the status tells.
      rules: which reading of the method.
      segmentation: "incremental", the paper's criteria.
      covariance: "exact", to first order with the pose error that all points share, or "printed", Eq. (12).
      jacobians: "autodiff" through the estimate, or "analytic", the hand-derived ones.

    Returns:
      The primitives in `capacity` slots, in beam order.

    Raises:
      ValueError: at trace time, for an option that does not exist.
    """
    dtype = scan.ranges.dtype
    thresholds, noise, mount, pose = as_dtype((thresholds or Thresholds(), noise or SensorNoise(), mount or Mount(), pose), dtype)
    if segmentation != "incremental":
        raise ValueError(f"segmentation must be 'incremental', not {segmentation!r}")

    finite = jnp.all(jnp.isfinite(pose.mean)) & jnp.all(jnp.isfinite(pose.cov))
    scan = dataclasses.replace(scan, valid=scan.valid & finite)
    pose = jax.tree.map(lambda x: jnp.where(finite, x, 0), pose)
    points = points_from_scan(scan, pose, mount, jacobians=jacobians)
    n = scan.ranges.shape[0]

    run, breaks = incremental.segment(points, scan, thresholds, noise, rules)
    runs = lines_.runs_from_labels(run, n)
    enough = runs.count >= lines_.MIN_POINTS
    is_line = enough & lines_.long_enough(points, runs, thresholds)
    in_line = (run >= 0) & is_line[run]
    slot, lines_full = slots_in_order(is_line, capacity.lines)
    of_beam = jnp.where(in_line, slot[run], -1)
    lines, jac_line_pose, cov_measurement = lines_.measure_lines(
        points,
        scan,
        pose,
        lines_.runs_from_labels(of_beam, capacity.lines),
        noise,
        covariance=covariance,
        jacobians=jacobians,
    )

    clusters = circles_.cluster(points.position, scan.valid, scan.valid & ~in_line, thresholds)
    found = circles_.measure_circles(points, scan, pose, clusters, thresholds, noise, fit=rules.fit_circles)
    near = circles_.near_lines(found, lines, thresholds)
    is_circle = found.valid & ~near
    circle_slot, circles_full = slots_in_order(is_circle, capacity.circles)

    def points_in(runs: lines_.Runs, which: Bool[Array, " K"]) -> Int[Array, ""]:
        return jnp.sum(jnp.where(which, runs.count, 0))

    status = (
        jnp.where(finite, 0, int(Status.POSE_NOT_FINITE))
        | jnp.where(lines_full, int(Status.SCAN_LINES_FULL), 0)
        | jnp.where(circles_full, int(Status.SCAN_CIRCLES_FULL), 0)
    )
    return Extraction(
        lines=lines,
        circles=_compact(found, circle_slot, capacity.circles),
        jac_line_pose=jac_line_pose,
        cov_measurement=cov_measurement,
        line_of_beam=of_beam,
        circle_of_beam=jnp.where(clusters.of_beam >= 0, circle_slot[clusters.of_beam], -1),
        rejected=Rejected(
            invalid=jnp.sum(~scan.valid, dtype=jnp.int32),
            gap=breaks[0],
            distance=breaks[1],
            bearing=breaks[2],
            too_few=points_in(runs, ~enough),
            too_short=points_in(runs, enough & ~is_line),
            lone=points_in(clusters, clusters.count == 1),
            near_line=points_in(clusters, near),
        ),
        status=status.astype(jnp.int32),
    )


def as_dtype(tree: Any, dtype: Any) -> Any:
    """All numbers of a tree as arrays of one dtype: that of the scan, never a hidden default."""
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), tree)


def slots_in_order(which: Bool[Array, " M"], capacity: int) -> tuple[Int[Array, " M"], Bool[Array, ""]]:
    """Slots 0, 1, ... for the chosen items in their order, -1 for the others and for those past the capacity.

    Returns:
      The slots, shape `[M]`, and whether something was left out.
    """
    slot = jnp.cumsum(which) - 1
    fits = which & (slot < capacity)
    return jnp.where(fits, slot, -1).astype(jnp.int32), jnp.any(which & ~fits)


def _compact(found: Circles, slot: Int[Array, " M"], capacity: int) -> Circles:
    into = jnp.where(slot < 0, capacity, slot)
    free = empty_circles(capacity, found.radius.dtype)
    return jax.tree.map(lambda a, b: a.at[into].set(b, mode="drop"), free, found)
