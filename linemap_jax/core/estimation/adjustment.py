"""Poses and lines together: what fits best of everything that the keyframes have seen.

Lines that were seen from one pose share its error, and a line that was seen from many poses ties them together. Both
are kept when poses and lines are unknowns of one system: the steps of the pose graph, and one sighting of a line from a
keyframe with the covariance of its measurement alone. The inverse of the system holds the covariances of all poses and
lines, with what correlates them.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.estimation.pose_graph import PoseGraph
from linemap_jax.core.extract import extract
from linemap_jax.core.frames import between, dot, perp, rotate, unit, wrap_angle
from linemap_jax.core.matching import best_line, with_sign
from linemap_jax.core.propagation import inverse, propagate, square_root, symmetric
from linemap_jax.core.settings import Number, SensorNoise, Thresholds
from linemap_jax.core.state import LineMap, Lines, Pose, Scan, pytree

WIDENING = (100.0, 10.0, 1.0, 1.0, 1.0)
"""Of the gate, in each iteration of Gauss and Newton: the graph is some centimetres off where sightings are good to
millimetres."""
GATE = 13.8
"""Squared residual, in sigmas, from which a sighting is none of that line: 99.9 % of chi-square with 2 degrees of
freedom. Not a kernel that falls: it would take weight from what is right, too, and the covariance would not hold."""
_HELD = 1e12  # information on what is not moved


@pytree
class Sightings:
    """Lines of the map, each as a keyframe has seen it, in the frame of the scanner."""

    keyframe: Int[Array, " O"]
    line: Int[Array, " O"]  # slot in the map
    anchor: Float[Array, "O 2"]  # m; a point of the line as it was seen
    angle: Float[Array, " O"]  # rad, of the normal, which points as that of the line in the map
    cov: Float[Array, "O 2 2"]  # of (offset, angle) at the anchor, by the scanner's noise alone
    valid: Bool[Array, " O"]


class Adjusted(NamedTuple):
    """Poses and lines that fit best."""

    poses: Float[Array, "N 3"]  # of the scanner at the keyframes. m, m, rad
    cov_poses: Float[Array, "N 3 3"]
    lines: Lines  # offset, angle and covariance are those of the adjustment where `seen`
    seen: Bool[Array, " K"]  # lines of which there is a sighting that fits
    unit_variance: Float[Array, ""]  # of the sightings' residuals: 1 where they err as they say


def sightings_of_scan(
    scan: Scan, pose: Pose, lines: Lines, keyframe: Int[Array, ""], *, thresholds: Thresholds, noise: SensorNoise
) -> Sightings:
    """The lines of the map that a keyframe has seen: `SCAN_CAPACITY.lines` of them, padded.

    Args:
      scan: of the keyframe.
      pose: of the scanner, with what its neighbours tell of its error; the gates of matching widen by it.
      lines: of the map.
      keyframe: its number.
      thresholds: of extraction and matching.
      noise: of the scanner.
    """
    found = extract(scan, pose, thresholds=thresholds, noise=noise)
    slot, nis = best_line(found.lines, lines, thresholds, "independent")
    reverse = jnp.abs(wrap_angle(found.lines.angle - lines.angle[slot])) > jnp.pi / 2
    foot = found.lines.anchor + found.lines.offset[:, None] * found.lines.normal - pose.mean[None, :2]
    turn = jnp.where(reverse, jnp.pi, 0).astype(foot.dtype) - pose.mean[2]
    sign = jnp.where(reverse, -1, 1).astype(foot.dtype)
    return Sightings(
        keyframe=jnp.broadcast_to(keyframe, slot.shape),
        line=slot,
        anchor=jax.vmap(lambda at: rotate(-pose.mean[2], at))(foot),
        angle=wrap_angle(found.lines.angle + turn),
        cov=with_sign(found.cov_measurement, sign),
        valid=found.lines.valid & (nis < thresholds.match_nis),
    )


def residual_of_sighting(
    pose: Float[Array, "3"], line: Float[Array, "2"], at: Float[Array, "2"], anchor: Float[Array, "2"], angle: Array
) -> Float[Array, "2"]:
    """What a line of the map lacks of having been seen as it was: (offset at the sighting's anchor, angle). m, rad.

    Args:
      pose: of the scanner.
      line: (offset, angle) of the line in the map.
      at: anchor of the line in the map.
      anchor: of the sighting, in the frame of the scanner.
      angle: of the sighting's normal, likewise.
    """
    seen = pose[:2] + rotate(pose[2], anchor)
    offset = line[0] + dot(unit(line[1]), at - seen)
    return jnp.stack([offset, wrap_angle(line[1] - pose[2] - angle)])


def adjust(graph: PoseGraph, lines: Lines, sightings: Sightings) -> Adjusted:
    """Poses and lines from steps and sightings.

    A dense system of order 3 N + 2 K: time grows with its cube. Sightings that do not fit are left out; the closures
    keep the weights that they have in the graph. Where the sightings that are left fit less well than their covariances
    have it, all covariances are as much larger (the variance of unit weight a posteriori, of adjustment computation).
    In float64.

    Args:
      graph: keyframes, optimised. The first one is held.
      lines: of the map, near where the graph has them.
      sightings: of these lines from these keyframes.
    """
    n, k = graph.poses.shape[0], lines.offset.shape[0]
    root = jnp.swapaxes(square_root(inverse(sightings.cov)), -1, -2)
    closures = graph.closures
    before = jnp.maximum(jnp.arange(n) - 1, 0)
    begin = jnp.concatenate([before, closures.begin])
    end = jnp.concatenate([jnp.arange(n), closures.end])
    step = jnp.concatenate([graph.step, closures.step])
    linked = graph.valid & (jnp.arange(n) > 0)
    weight_of_step = jnp.concatenate([linked.astype(step.dtype), closures.weight * closures.valid])
    root_of_step = jnp.swapaxes(square_root(inverse(jnp.concatenate([graph.cov_step, closures.cov]))), -1, -2)

    def of_steps(a: Array, b: Array, step: Array, root: Array) -> Array:
        off = between(a, b) - step
        return root @ off.at[2].set(wrap_angle(off[2]))

    def of_sightings(pose: Array, line: Array, at: Array, anchor: Array, angle: Array, root: Array) -> Array:
        return root @ residual_of_sighting(pose, line, at, anchor, angle)

    def system(poses: Array, state: Array, widening: Number) -> tuple[Array, Array, Array, Array]:
        """The normal matrix, the right-hand side, which lines are seen, and the variance of unit weight."""
        matrix = jnp.zeros((3 * n + 2 * k,) * 2, poses.dtype)
        right = jnp.zeros(3 * n + 2 * k, poses.dtype)

        args = (poses[begin], poses[end], step, root_of_step)
        matrix, right = _add(
            matrix,
            right,
            (_places(begin, 3, 0), _places(end, 3, 0)),
            jax.vmap(jax.jacfwd(of_steps, (0, 1)))(*args),
            jax.vmap(of_steps)(*args),
            weight_of_step,
        )
        args = (
            poses[sightings.keyframe],
            state[sightings.line],
            lines.anchor[sightings.line],
            sightings.anchor,
            sightings.angle,
            root,
        )
        off = jax.vmap(of_sightings)(*args)
        square = jnp.sum(off**2, -1)
        weight = (sightings.valid & (square < widening * GATE)).astype(poses.dtype)
        matrix, right = _add(
            matrix,
            right,
            (_places(sightings.keyframe, 3, 0), _places(sightings.line, 2, 3 * n)),
            jax.vmap(jax.jacfwd(of_sightings, (0, 1)))(*args),
            off,
            weight,
        )
        seen = jnp.zeros(k, bool).at[sightings.line].max(weight > 0)
        held = jnp.concatenate([jnp.repeat((jnp.arange(n) == 0) | ~graph.valid, 3), jnp.repeat(~seen, 2)])
        redundancy = 2 * jnp.sum(weight) - 3 * jnp.sum(linked) - 2 * jnp.sum(seen)
        unit_variance = jnp.sum(weight * square) / jnp.maximum(redundancy, 1)
        return matrix + jnp.diag(jnp.where(held, _HELD, 0)), right, seen, unit_variance

    def iterate(at: tuple[Array, Array], widening: Array) -> tuple[tuple[Array, Array], None]:
        poses, state = at
        matrix, right, *_ = system(poses, state, widening)
        move = cho_solve(cho_factor(matrix, lower=True), right)
        return (poses + move[: 3 * n].reshape(n, 3), state + move[3 * n :].reshape(k, 2)), None

    begin_at = (graph.poses, jnp.stack([lines.offset, lines.angle], -1))
    (poses, state), _ = jax.lax.scan(iterate, begin_at, jnp.asarray(WIDENING, graph.poses.dtype))
    matrix, _, seen, unit_variance = system(poses, state, 1.0)
    cov = cho_solve(cho_factor(matrix, lower=True), jnp.eye(matrix.shape[0], dtype=matrix.dtype))
    cov = cov * jnp.maximum(unit_variance, 1)
    cov_poses = jnp.moveaxis(jnp.diagonal(cov[: 3 * n, : 3 * n].reshape(n, 3, n, 3), axis1=0, axis2=2), -1, 0)
    cov_lines = jnp.moveaxis(jnp.diagonal(cov[3 * n :, 3 * n :].reshape(k, 2, k, 2), axis1=0, axis2=2), -1, 0)
    moved = dataclasses.replace(
        lines,
        offset=state[:, 0],
        angle=wrap_angle(state[:, 1]),
        cov_independent=jnp.where(seen[:, None, None], symmetric(cov_lines), lines.cov_independent),
        sqrt_persistent=jnp.where(seen[:, None, None], 0, lines.sqrt_persistent),
    )
    return Adjusted(poses, symmetric(cov_poses), moved, seen, unit_variance)


def with_error_of_poses(
    line_map: LineMap, seen: Bool[Array, " K"], poses: Float[Array, "N 3"], cov_poses: Float[Array, "N 3 3"]
) -> LineMap:
    """A map in which lines that no keyframe has seen, and circles, are as uncertain as the keyframe nearest to them.

    Their own covariances tell how they lie against the scans that saw them; that scan's error comes on top.

    Args:
      line_map: the map.
      seen: lines of which the covariance holds the poses' errors already.
      poses: of the keyframes. m, m, rad.
      cov_poses: of these.
    """

    def nearest_pose(place: Float[Array, "2"]) -> tuple[Array, Array]:
        off = place[None] - poses[:, :2]
        best = jnp.argmin(dot(off, off))
        return perp(off[best]), cov_poses[best]

    def of_line(anchor: Array, normal: Array) -> Array:
        lever, cov = nearest_pose(anchor)
        jac = jnp.zeros((2, 3), cov.dtype).at[0].set(jnp.append(normal, dot(normal, lever))).at[1, 2].set(1)
        return propagate(jac, cov)

    def of_circle(center: Array) -> Array:
        lever, cov = nearest_pose(center)
        return propagate(jnp.zeros((3, 3), cov.dtype).at[:2, :2].set(jnp.eye(2)).at[:2, 2].set(lever), cov)

    lines, circles = line_map.lines, line_map.circles
    dtype = lines.offset.dtype
    more = jax.vmap(of_line)(lines.anchor, lines.normal).astype(dtype)
    more = jnp.where((seen | ~lines.valid)[:, None, None], 0, more)
    around = jax.vmap(of_circle)(circles.center).astype(dtype)
    around = jnp.where((circles.valid & circles.fitted)[:, None, None], around, 0)
    return LineMap(
        lines=dataclasses.replace(lines, cov_independent=lines.cov_independent + more),
        circles=dataclasses.replace(circles, cov_independent=circles.cov_independent + around),
    )


def _places(index: Int[Array, " F"], size: int, offset: int) -> Int[Array, "F size"]:
    """Where the unknowns of some poses or lines stand."""
    return offset + size * index[:, None] + jnp.arange(size)[None]


def _add(
    matrix: Array,
    right: Array,
    places: tuple[Array, Array],
    jacs: tuple[Array, Array],
    residual: Float[Array, "F m"],
    weight: Float[Array, " F"],
) -> tuple[Array, Array]:
    """Put what some residuals add into the normal equations."""
    at = jnp.concatenate(places, -1)
    jac = jnp.concatenate(jacs, -1)
    block = jnp.einsum("fmi,f,fmj->fij", jac, weight, jac)
    pull = -jnp.einsum("fmi,f,fm->fi", jac, weight, residual)
    return matrix.at[at[:, :, None], at[:, None, :]].add(block), right.at[at].add(pull)
