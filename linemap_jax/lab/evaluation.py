"""What a map is worth, without a truth to hold it against."""

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.frames import dot
from linemap_jax.core.sensor import points_from_scan
from linemap_jax.core.settings import Jacobians, Mount
from linemap_jax.core.state import LineMap, Lines, Pose, Scan, SlotsT, pad_stack


@partial(jax.jit, static_argnames="jacobians")
def explained(
    line_map: LineMap,
    scans: Scan,
    poses: Pose,
    mount: Mount | None = None,
    *,
    within: float | Array = 0.1,
    closer_than: float | Array = 20.0,
    jacobians: Jacobians = "analytic",
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """How many returns lie on a primitive of the map.

    A return is explained if a line segment, or the rim of a circle, is no farther away than `within`.

    Args:
      line_map: the map.
      scans: stacked scans, `[T, N]`.
      poses: stacked poses of the robot, `[T]`.
      mount: of the scanner on the robot.
      within: m.
      closer_than: only returns nearer than this count, m.
      jacobians: of no consequence to the result.

    Returns:
      The number of explained returns, and of all that count.
    """
    dtype = scans.ranges.dtype
    placed = jax.tree.map(lambda x: jnp.asarray(x, dtype), mount or Mount())

    def one(scan_pose: tuple[Scan, Pose]) -> tuple[Array, Array]:
        scan, pose = scan_pose
        finite = jnp.all(jnp.isfinite(pose.mean))
        points = points_from_scan(scan, pose, placed, jacobians=jacobians)
        counts = scan.valid & (scan.ranges < closer_than) & finite
        near = jax.vmap(lambda p: _distance(line_map, p, pose.mean[:2]) < within)(points.position)
        return jnp.sum(near & counts), jnp.sum(counts)

    hits, total = jax.lax.map(one, (scans, poses))
    return jnp.sum(hits), jnp.sum(total)


def explained_share(
    line_map: LineMap, chunks: Iterable[tuple[Scan, Pose]], mount: Mount | None = None, *, chunk: int, **options: Any
) -> float:
    """The share of returns that lie on a primitive of the map, over a log that comes piece by piece.

    Args:
      line_map: the map.
      chunks: stacked scans and poses, at most `chunk` of them each time.
      mount: of the scanner on the robot.
      chunk: size to which pieces are filled up.
      **options: of `explained`.

    Returns:
      A number in [0, 1]; 0 where no return counts.
    """
    line_map = LineMap(lines=_crowded(line_map.lines), circles=_crowded(line_map.circles))
    hits = total = 0
    for scans, poses in chunks:
        active = np.arange(chunk) < scans.ranges.shape[0]
        scans, poses = pad_stack(scans, chunk), pad_stack(poses, chunk)
        scans = dataclasses.replace(scans, valid=jnp.asarray(np.asarray(scans.valid) & active[:, None]))
        h, t = explained(line_map, scans, poses, mount, **options)
        hits, total = hits + int(h), total + int(t)
    return hits / total if total else 0.0


def _crowded(slots: SlotsT) -> SlotsT:
    """The same lines or circles with hardly a free slot; every point is held against every slot."""
    valid = np.asarray(slots.valid)
    order = np.argsort(~valid, kind="stable")[: max(64, -(-int(valid.sum()) // 64) * 64)]
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[order]), slots)


def _distance(line_map: LineMap, point: Float[Array, "2"], robot: Float[Array, "2"]) -> Float[Array, ""]:
    """Distance of a point (from the robot) to the nearest primitive, m."""
    lines, circles = line_map.lines, line_map.circles
    step = point[None] - (lines.anchor - robot[None])
    along = dot(lines.tangent, step)
    across = dot(lines.normal, step) - lines.offset
    beyond = along - jnp.clip(along, lines.extent[:, 0], lines.extent[:, 1])
    to_line = jnp.where(lines.valid, across**2 + beyond**2, jnp.inf)
    step = point[None] - (circles.center - robot[None])
    to_rim = jnp.where(circles.valid, (jnp.sqrt(dot(step, step)) - circles.radius) ** 2, jnp.inf)
    return jnp.sqrt(jnp.minimum(jnp.min(to_line), jnp.min(to_rim)))


@jax.jit
def duplicates(
    lines: Lines, *, within: float | Array = 0.1, angle: float | Array = 0.087, overlap: float | Array = 0.5
) -> Bool[Array, " K"]:
    """Lines that the map holds once more: a longer one runs along them.

    Args:
      lines: `K` lines of a map.
      within: largest distance of both end points from the longer line, m.
      angle: largest difference of direction, rad (5 degrees).
      overlap: the share of the shorter line, at least, that lies beside the longer one.

    Returns:
      True for the shorter one of each such pair. Shape `[K]`.
    """
    normal, tangent = lines.normal, lines.tangent
    length = lines.length

    def beside(i: Int[Array, ""], j: Int[Array, ""]) -> Bool[Array, ""]:
        ends = jnp.stack([lines.begin[i], lines.end[i]]) - lines.anchor[j][None]
        across = jnp.abs(dot(ends, normal[j][None]) - lines.offset[j])
        along = dot(ends, tangent[j][None])
        shared = jnp.minimum(jnp.max(along), lines.extent[j, 1]) - jnp.maximum(jnp.min(along), lines.extent[j, 0])
        parallel = jnp.abs(dot(tangent[i], normal[j])) < jnp.sin(angle)
        shorter = (length[i] < length[j]) | ((length[i] == length[j]) & (i > j))
        near = jnp.all(across < within) & parallel & (shared > overlap * length[i])
        return lines.valid[i] & lines.valid[j] & shorter & near

    index = jnp.arange(lines.valid.shape[0])
    return jnp.any(jax.vmap(jax.vmap(beside, (None, 0)), (0, None))(index, index), -1)
