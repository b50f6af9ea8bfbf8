"""What a map is worth, without a truth to hold it against: by itself, and against a log."""

import dataclasses
import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.fields import documented
from linemap_jax.core.frames import dot
from linemap_jax.core.sensor import points_from_scan
from linemap_jax.core.settings import Mount, Number
from linemap_jax.core.state import Circles, LineMap, Lines, Pose, Scan, SlotsT, pad_stack
from linemap_jax.lab.scoring import Seen, expected, seen_nothing, survey
from linemap_jax.lab.world import NEVER, Kind, Poles, Segments, World


@jax.jit
def explained(
    line_map: LineMap,
    scans: Scan,
    poses: Pose,
    mount: Mount | None = None,
    *,
    within: float | Array = 0.1,
    closer_than: float | Array = 20.0,
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

    Returns:
      The number of explained returns, and of all that count.
    """
    dtype = scans.ranges.dtype
    placed = jax.tree.map(lambda x: jnp.asarray(x, dtype), mount or Mount())

    def one(scan_pose: tuple[Scan, Pose]) -> tuple[Array, Array]:
        scan, pose = scan_pose
        finite = jnp.all(jnp.isfinite(pose.mean))
        points = points_from_scan(scan, pose, placed, jacobians="analytic")  # none is used
        counts = points.valid & (points.range < closer_than) & finite
        near = jax.vmap(lambda p: _distance(line_map, p, pose.mean[:2]) < within)(points.position)
        return jnp.sum(near & counts), jnp.sum(counts)

    hits, total = jax.lax.map(one, (scans, poses))
    return jnp.sum(hits), jnp.sum(total)


def explained_share(
    line_map: LineMap,
    chunks: Iterable[tuple[Scan, Pose]],
    mount: Mount | None = None,
    *,
    chunk: int,
) -> float:
    """The share of returns that lie on a primitive of the map, over a log that comes piece by piece.

    Args:
      line_map: the map.
      chunks: stacked scans and poses, at most `chunk` of them each time.
      mount: of the scanner on the robot.
      chunk: size to which pieces are filled up.

    Returns:
      A number in [0, 1]; 0 where no return counts.
    """
    line_map = _without_free_slots(line_map)
    hits = total = 0
    for scans, poses in _filled(chunks, chunk):
        h, t = explained(line_map, scans, poses, mount)
        hits, total = hits + int(h), total + int(t)
    return hits / total if total else 0.0


def _filled(chunks: Iterable[tuple[Scan, Pose]], size: int) -> Iterator[tuple[Scan, Pose]]:
    """The chunks, filled up with scans that hold nothing."""
    for scans, poses in chunks:
        active = np.arange(size) < scans.ranges.shape[0]
        scans, poses = pad_stack(scans, size), pad_stack(poses, size)
        yield dataclasses.replace(scans, valid=jnp.asarray(np.asarray(scans.valid) & active[:, None])), poses


def _without_free_slots(line_map: LineMap) -> LineMap:
    return LineMap(lines=_crowded(line_map.lines), circles=_crowded(line_map.circles))


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
    """Lines that the map holds once more: a longer one runs along them, seen from the same side.

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
        parallel = dot(tangent[i], tangent[j]) > jnp.cos(angle)
        shorter = (length[i] < length[j]) | ((length[i] == length[j]) & (i > j))
        near = jnp.all(across < within) & parallel & (shared > overlap * length[i])
        return lines.valid[i] & lines.valid[j] & shorter & near

    index = jnp.arange(lines.valid.shape[0])
    return jnp.any(jax.vmap(jax.vmap(beside, (None, 0)), (0, None))(index, index), -1)


@jax.jit
def beam_residuals(
    line_map: LineMap, scans: Scan, poses: Pose, mount: Mount | None = None, *, closer_than: Number = 20.0
) -> tuple[Float[Array, "T N"], Bool[Array, "T N"]]:
    """Measured range less the range at which the beam meets the map first.

    Args:
      line_map: the map; its lines are taken as walls, its circles as poles.
      scans: stacked scans, `[T, N]`.
      poses: stacked poses of the robot, `[T]`.
      mount: of the scanner on the robot.
      closer_than: only returns nearer than this count, m.

    Returns:
      The residuals, m, and which of them there are: those of returns whose beam meets the map. Both `[T, N]`.
    """
    world = world_of_map(line_map)

    def one(scan_pose: tuple[Scan, Pose]) -> tuple[Array, Array]:
        scan, pose = scan_pose
        told = expected(world, scan, pose.mean, mount).ranges
        counts = scan.valid & (scan.ranges < closer_than) & jnp.isfinite(told)
        return jnp.where(counts, scan.ranges - told, 0), counts

    return jax.lax.map(one, (scans, poses))


@documented
class LogScore(NamedTuple):
    """A map against a log, without a truth; NaN where there is nothing to tell of."""

    returns: int
    """Returns nearer than 20 m."""
    explained: float
    """Share of them that lie within 10 cm of a line or of the rim of a circle."""
    met: float
    """Share of them whose beam meets the map."""
    residual_median: float
    """Median of the absolute residuals along those beams, m."""
    residual_90: float
    """What 90 % of them are less than, m."""


def evaluate_log(
    line_map: LineMap, chunks: Iterable[tuple[Scan, Pose]], mount: Mount | None = None, *, chunk: int
) -> LogScore:
    """What a log, which comes piece by piece, says of a map. One absolute residual a return is held in memory.

    Args:
      line_map: the map.
      chunks: stacked scans and poses, at most `chunk` of them each time.
      mount: of the scanner on the robot.
      chunk: size to which pieces are filled up.

    Returns:
      Shares and residuals; NaN where there is nothing to judge by.
    """
    line_map = _without_free_slots(line_map)
    hits = total = 0
    residuals = [np.zeros(0)]
    for scans, poses in _filled(chunks, chunk):
        h, t = explained(line_map, scans, poses, mount)
        hits, total = hits + int(h), total + int(t)
        residual, counts = beam_residuals(line_map, scans, poses, mount)
        residuals.append(np.abs(np.asarray(residual, float)[np.asarray(counts)]))
    residual = np.concatenate(residuals)
    median, most = np.quantile(residual, (0.5, 0.9)).tolist() if residual.size else (math.nan, math.nan)
    share, met = (hits / total, residual.size / total) if total else (math.nan, math.nan)
    return LogScore(total, share, met, median, most)


def seen_in_log(
    world: World, chunks: Iterable[tuple[Scan, Pose]], mount: Mount | None = None, *, chunk: int
) -> tuple[Seen, int]:
    """What the beams of a log, which comes piece by piece, have seen of a world; as `scoring.survey`.

    Args:
      world: the truth.
      chunks: stacked scans and poses, at most `chunk` of them each time.
      mount: of the scanner on the robot.
      chunk: size to which pieces are filled up.

    Returns:
      What has been seen, and the number of scans.
    """
    seen, count = seen_nothing(world), 0
    for scans, poses in chunks:
        [(padded, places)] = _filled([(scans, poses)], chunk)
        seen = survey(seen, world, padded, places.mean, mount, first=jnp.asarray(count, jnp.int32))
        count += scans.ranges.shape[0]
    return seen, count


def world_of_map(line_map: LineMap) -> World:
    """The world that `line_map` describes: each line a wall, each circle a pole."""
    lines, circles = line_map.lines, line_map.circles
    index = jnp.arange(lines.valid.shape[0], dtype=jnp.int32)

    def all_alike(slots: Lines | Circles, value: int) -> Int[Array, " K"]:
        return jnp.full(slots.valid.shape, value, jnp.int32)

    return World(
        segments=Segments(
            ends=jnp.stack([lines.begin, lines.end], -2),
            body=index,
            kind=all_alike(lines, Kind.WALL),
            appears=all_alike(lines, 0),
            vanishes=all_alike(lines, NEVER),
            valid=lines.valid,
        ),
        poles=Poles(
            center=circles.center,
            radius=circles.radius,
            appears=all_alike(circles, 0),
            vanishes=all_alike(circles, NEVER),
            valid=circles.valid,
        ),
        path=jnp.zeros((0, 2), lines.offset.dtype),
    )
