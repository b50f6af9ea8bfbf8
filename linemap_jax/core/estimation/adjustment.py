"""Poses and lines together: what fits best of everything that the keyframes have seen.

Lines that were seen from one pose share its error, and a line that was seen from many poses ties them together. Both
are kept when poses and lines are unknowns of one system: the steps of the pose graph, and one sighting of a line from a
keyframe with the covariance of its measurement alone. The inverse of the system holds the covariances of all poses and
lines, with what correlates them.

What a line errs by with the poses is its `sqrt_persistent`: it does not average away, and a later drive that is
localised in the map takes it over. The rest is the noise of its own sightings.
"""

import dataclasses
from typing import Any, NamedTuple, Unpack

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.estimation.pose_graph import PoseGraph
from linemap_jax.core.extract import extract
from linemap_jax.core.fields import documented
from linemap_jax.core.frames import between, dot, perp, rotate, unit, wrap_angle
from linemap_jax.core.matching import best_line, match_circles, with_sign
from linemap_jax.core.propagation import apply, inverse, propagate, quadratic, square_root, symmetric
from linemap_jax.core.settings import SCAN_CAPACITY, Capacity, Method, Number, Rules, SensorNoise, Thresholds
from linemap_jax.core.state import Circles, LineMap, Lines, Pose, Scan, SlotsT, pytree, squared

WIDENING = (100.0, 10.0, 1.0, 1.0, 1.0)
"""Of the gate, in each iteration of Gauss and Newton: the graph is some centimetres off where sightings are good to
millimetres."""
GATE = 13.8
"""Squared residual, in sigmas, from which a sighting is none of that line: 99.9 % of chi-square with 2 degrees of
freedom. Not a kernel that falls: it would take weight from what is right, too, and the covariance would not hold."""
CIRCLE_GATE = 16.3
"""The same for circles, with 3 degrees of freedom."""
_HELD = 1e12  # information on what is not moved


@pytree
class LineSightings:
    """Lines of the map, each as a keyframe has seen it, in the frame of the scanner."""

    keyframe: Int[Array, " O"]
    """Number of the keyframe from which the line was seen."""
    line: Int[Array, " O"]
    """Slot of the line in the map."""
    anchor: Float[Array, "O 2"]
    """A point of the line as it was seen, in the frame of the scanner, m."""
    angle: Float[Array, " O"]
    """Direction of the normal, which points as that of the line in the map, rad."""
    cov: Float[Array, "O 2 2"]
    """Covariance of (offset, angle) at the anchor, by the scanner's noise alone: m^2, m rad, rad^2."""
    valid: Bool[Array, " O"]
    """Which slots are in use."""


@pytree
class CircleSightings:
    """Fitted circles of the map, each as a keyframe has seen it, in the frame of the scanner."""

    keyframe: Int[Array, " O"]
    """Number of the keyframe from which the circle was seen."""
    circle: Int[Array, " O"]
    """Slot of the circle in the map."""
    at: Float[Array, "O 3"]
    """x and y of the centre in the frame of the scanner, and radius, m."""
    cov: Float[Array, "O 3 3"]
    """Covariance of these, by the scanner's noise alone, m^2."""
    valid: Bool[Array, " O"]
    """Which slots are in use."""


@documented
class Adjusted(NamedTuple):
    """Poses and lines that fit best."""

    poses: Float[Array, "N 3"]
    """Poses of the scanner at the keyframes. m, m, rad."""
    cov_poses: Float[Array, "N 3 3"]
    """Covariances of these: m^2, m rad, rad^2."""
    lines: Lines
    """Lines of the map; offset, angle and covariance are those of the adjustment where `seen`."""
    seen: Bool[Array, " K"]
    """Which lines have a sighting that fits."""
    unit_variance: Float[Array, ""]
    """Variance of the sightings' residuals: 1 where they err as they say."""


def sightings_of_scan(
    scan: Scan,
    pose: Pose,
    line_map: LineMap,
    keyframe: Int[Array, ""],
    cov_sweep: Float[Array, "3 3"],
    *,
    thresholds: Thresholds,
    noise: SensorNoise,
    capacity: Capacity = SCAN_CAPACITY,
    **method: Unpack[Method],
) -> tuple[LineSightings, CircleSightings]:
    """The lines and fitted circles of the map that a keyframe has seen, padded to the capacity of a scan.

    Args:
      scan: of the keyframe.
      pose: of the scanner, with what its neighbours tell of its error; the gates of matching widen by it.
      line_map: made from the scans at the poses of the trajectory.
      keyframe: its number.
      cov_sweep: what the scanner's pose in its own frame errs by from one line to another, since it moved while it
        swept; zero for a scan of one instant. m^2, m rad, rad^2.
      thresholds: of extraction and matching.
      noise: of the scanner.
      capacity: slots for what one scan holds.
      **method: as for `extract`.

    Returns:
      The sightings; those of what matches nothing in the map are not valid.
    """
    lines, rules = line_map.lines, method.get("rules", Rules())
    found = extract(scan, pose, thresholds=thresholds, noise=noise, capacity=capacity, **method)
    slot, nis = best_line(found.lines, lines, thresholds, "independent", same_side=rules.tell_sides)
    reverse = jnp.abs(wrap_angle(found.lines.angle - lines.angle[slot])) > jnp.pi / 2
    foot = found.lines.anchor + found.lines.offset[:, None] * found.lines.normal - pose.mean[None, :2]
    turn = jnp.where(reverse, jnp.pi, 0).astype(foot.dtype) - pose.mean[2]
    sign = jnp.where(reverse, -1, 1).astype(foot.dtype)
    anchor, angle = rotate(-pose.mean[2], foot), wrap_angle(found.lines.angle + turn)

    def from_sweep(anchor: Array, angle: Array) -> Array:
        here = jnp.zeros(3, anchor.dtype)
        by_pose = jax.jacfwd(residual_of_sighting)(here, jnp.stack([here[0], angle]), anchor, anchor, angle)
        return propagate(by_pose, cov_sweep)

    of_lines = LineSightings(
        keyframe=jnp.broadcast_to(keyframe, slot.shape),
        line=slot,
        anchor=anchor,
        angle=angle,
        cov=with_sign(found.cov_measurement, sign) + jax.vmap(from_sweep)(anchor, angle),
        valid=found.lines.valid & (nis < thresholds.match_nis),
    )

    circles, match = found.circles, match_circles(found.circles, line_map.circles, thresholds, rules, "independent")
    center = rotate(-pose.mean[2], circles.center - pose.mean[None, :2])
    turned = jnp.broadcast_to(_turned(-pose.mean[2]), circles.cov_independent.shape)
    of_circles = CircleSightings(
        keyframe=jnp.broadcast_to(keyframe, match.slot.shape),
        circle=jnp.maximum(match.slot, 0),
        at=jnp.concatenate([center, circles.radius[:, None]], -1),
        cov=propagate(turned, circles.cov_independent) + propagate(jax.vmap(_jac_circle_pose)(center), cov_sweep[None]),
        valid=circles.valid & circles.fitted & (match.slot >= 0) & line_map.circles.fitted[match.slot],
    )
    return of_lines, of_circles


def _turned(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """What turns (x, y) by an angle, and leaves the third as it is."""
    return jnp.eye(3, dtype=angle.dtype).at[:2, :2].set(rotate(angle, jnp.eye(2, dtype=angle.dtype)).T)


def _jac_circle_pose(center: Float[Array, "2"]) -> Float[Array, "3 3"]:
    """d(x, y, radius) of a circle / d(x, y, theta) of the pose that it moves with, seen from there."""
    identity = jnp.eye(2, dtype=center.dtype)
    return jnp.zeros((3, 3), center.dtype).at[:2, :2].set(identity).at[:2, 2].set(perp(center))


def circles_from_sightings(
    circles: Circles, poses: Float[Array, "N 3"], cov_poses: Float[Array, "N 3 3"], sightings: CircleSightings
) -> Circles:
    """Fitted circles where the keyframes that have seen them say that they are: the weighted mean of the sightings.

    The errors of the poses count in the weights as if they were independent; what they have in common is left to
    `with_error_of_poses`. Sightings that do not fit are left out, as in `adjust`.

    Args:
      circles: of the map.
      poses: of the keyframes. m, m, rad.
      cov_poses: of these: m^2, m rad, rad^2.
      sightings: of these circles from these keyframes.

    Returns:
      The circles; those without a sighting that fits stay as they are.
    """
    pose, k = poses[sightings.keyframe], circles.valid.shape[0]
    center = jax.vmap(rotate)(pose[:, 2], sightings.at[:, :2])
    turned = jax.vmap(_turned)(pose[:, 2])
    of_poses = propagate(jax.vmap(_jac_circle_pose)(center), cov_poses[sightings.keyframe])
    information = inverse(propagate(turned, sightings.cov) + of_poses)
    seen = jnp.concatenate([pose[:, :2] + center, sightings.at[:, 2:]], -1)

    def iterate(at: Array, widening: Array) -> tuple[Array, Array]:
        off = seen - at[sightings.circle]
        fits = sightings.valid & (quadratic(off, information) < widening * CIRCLE_GATE)
        weight = jnp.where(fits[:, None, None], information, 0)
        total = jnp.zeros((k, 3, 3), at.dtype).at[sightings.circle].add(weight)
        pull = jnp.zeros((k, 3), at.dtype).at[sightings.circle].add(apply(weight, seen))
        moved = jnp.linalg.det(total) > 0
        return jnp.where(moved[:, None], apply(inverse(total), pull), at), total

    begin = jnp.concatenate([circles.center, circles.radius[:, None]], -1)
    at, total = jax.lax.scan(iterate, begin, jnp.asarray(WIDENING, begin.dtype))
    total = total[-1]
    moved = (circles.valid & circles.fitted & (jnp.linalg.det(total) > 0))[:, None]
    cov = jnp.where(moved[..., None], inverse(total), circles.cov_independent)
    return dataclasses.replace(
        circles,
        center=jnp.where(moved, at[:, :2], circles.center),
        radius=jnp.where(moved[:, 0], at[:, 2], circles.radius),
        cov_independent=cov,
        sqrt_persistent=jnp.where(moved[..., None], 0, circles.sqrt_persistent),
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

    Returns:
      Offset in metres and angle in radians; zeros for a line seen where it is. Shape `[2]`.
    """
    seen = pose[:2] + rotate(pose[2], anchor)
    offset = line[0] + dot(unit(line[1]), at - seen)
    return jnp.stack([offset, wrap_angle(line[1] - pose[2] - angle)])


def adjust(graph: PoseGraph, lines: Lines, sightings: LineSightings) -> Adjusted:
    """Poses and lines from steps and sightings.

    The lines are eliminated; what is left is dense, of order 3 N, and time grows with its cube. Sightings that do not
    fit are left out; the closures keep the weights that they have in the graph. Where the sightings that are left fit
    less well than their covariances have it, all covariances are as much larger (the variance of unit weight a
    posteriori, of adjustment computation). Their residuals are held against their redundancy: their number, less the
    part of the unknowns that they determine; steps and closures determine the rest. In float64.

    Args:
      graph: keyframes, optimised. The first one is held.
      lines: of the map, near where the graph has them.
      sightings: of these lines from these keyframes.

    Returns:
      Poses, lines, and the covariances of both.
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

    def system(poses: Array, state: Array, widening: Number) -> _System:
        args = (poses[begin], poses[end], step, root_of_step)
        jac = jnp.concatenate(jax.vmap(jax.jacfwd(of_steps, (0, 1)))(*args), -1)
        weighted = weight_of_step[:, None, None] * jac
        places = jnp.concatenate([_places(begin, 3), _places(end, 3)], -1)
        of_poses = (
            jnp.zeros((3 * n, 3 * n), poses.dtype).at[places[:, :, None], places[:, None]].add(_mt(weighted) @ jac)
        )
        pull_poses = jnp.zeros(3 * n, poses.dtype).at[places].add(-_mtv(weighted, jax.vmap(of_steps)(*args)))

        at = (poses[sightings.keyframe], state[sightings.line], lines.anchor[sightings.line])
        args = (*at, sightings.anchor, sightings.angle, root)
        off = jax.vmap(of_sightings)(*args)
        by_pose, by_line = jax.vmap(jax.jacfwd(of_sightings, (0, 1)))(*args)
        square = jnp.sum(off**2, -1)
        weight = (sightings.valid & (square < widening * GATE)).astype(poses.dtype)
        of_pose, of_line = (weight[:, None, None] * jac for jac in (by_pose, by_line))
        seen = jnp.zeros(k, bool).at[sightings.line].max(weight > 0)

        place, slot = _places(sightings.keyframe, 3), sightings.line
        of_steps_alone = of_poses
        of_poses = of_poses.at[place[:, :, None], place[:, None]].add(_mt(of_pose) @ by_pose)
        held = jnp.repeat((jnp.arange(n) == 0) | ~graph.valid, 3)
        unseen = jnp.where(seen[:, None, None], 0, _HELD * jnp.eye(2, dtype=poses.dtype)[None])
        return _System(
            of_steps=jnp.where(held[:, None] | held[None], 0, of_steps_alone),
            of_poses=of_poses + jnp.diag(jnp.where(held, _HELD, 0)),
            of_lines=unseen + jnp.zeros((k, 2, 2), poses.dtype).at[slot].add(_mt(of_line) @ by_line),
            of_both=jnp.zeros((3 * n, k, 2), poses.dtype).at[place, slot[:, None]].add(_mt(of_pose) @ by_line),
            pull_poses=pull_poses.at[place].add(-_mtv(of_pose, off)),
            pull_lines=jnp.zeros((k, 2), poses.dtype).at[slot].add(-_mtv(of_line, off)),
            seen=seen,
            misfit=jnp.sum(weight * square),
            residuals=2 * jnp.sum(weight),
        )

    def iterate(at: tuple[Array, Array], widening: Array) -> tuple[tuple[Array, Array], None]:
        poses, state = at
        now = system(poses, state, widening)
        factor, through = _eliminated(now)
        move = cho_solve(factor, now.pull_poses - jnp.einsum("pki,ki->p", through, now.pull_lines))
        rest = now.pull_lines - jnp.einsum("pki,p->ki", now.of_both, move)
        return (poses + move.reshape(n, 3), state + apply(inverse(now.of_lines), rest)), None

    begin_at = (graph.poses, jnp.stack([lines.offset, lines.angle], -1))
    (poses, state), _ = jax.lax.scan(iterate, begin_at, jnp.asarray(WIDENING, graph.poses.dtype))
    now = system(poses, state, 1.0)
    factor, through = _eliminated(now)
    cov = cho_solve(factor, jnp.eye(3 * n, dtype=poses.dtype))
    unknowns = 3 * jnp.sum(linked) + 2 * jnp.sum(now.seen)
    redundancy = now.residuals - unknowns + jnp.sum(cov * now.of_steps)
    unit_variance = now.misfit / jnp.maximum(redundancy, 1)
    scale = jnp.maximum(unit_variance, 1)
    cov = scale * cov
    cov_poses = jnp.moveaxis(jnp.diagonal(cov.reshape(n, 3, n, 3), axis1=0, axis2=2), -1, 0)
    spread = (cov @ through.reshape(3 * n, 2 * k)).reshape(3 * n, k, 2)
    with_poses = jnp.einsum("pki,pkj->kij", through, spread)
    seen = now.seen
    moved = dataclasses.replace(
        lines,
        offset=state[:, 0],
        angle=wrap_angle(state[:, 1]),
        cov_independent=jnp.where(seen[:, None, None], scale * inverse(now.of_lines), lines.cov_independent),
        sqrt_persistent=jnp.where(seen[:, None, None], 0, lines.sqrt_persistent),
    )
    moved = _with_persistent(moved, jnp.where(seen[:, None, None], symmetric(with_poses), 0))
    return Adjusted(poses, symmetric(cov_poses), moved, seen, unit_variance)


def _with_persistent(slots: SlotsT, cov: Float[Array, "K n n"]) -> SlotsT:
    """Lines or circles that err by more than they did, by what does not average away."""
    root = square_root(squared(slots.sqrt_persistent) + cov)
    wide = jnp.zeros_like(slots.sqrt_persistent).at[..., : root.shape[-1]].set(root)
    some = jnp.any(cov != 0, (-2, -1))
    return dataclasses.replace(slots, sqrt_persistent=jnp.where(some[:, None, None], wide, slots.sqrt_persistent))


def with_error_of_first(adjusted: Adjusted, cov: Float[Array, "3 3"]) -> Adjusted:
    """The same where the first pose, which is held, errs: all turns and moves with it.

    Args:
      adjusted: poses and lines, with the first pose held.
      cov: of that pose, in the axes of the world: m^2, m rad, rad^2. Shape `[3, 3]`.

    Returns:
      The same estimates with larger covariances.
    """
    first = adjusted.poses[0, :2]

    def of_pose(pose: Float[Array, "3"]) -> Array:
        return propagate(jnp.eye(3, dtype=cov.dtype).at[:2, 2].set(perp(pose[:2] - first)), cov)

    lines = adjusted.lines
    of_lines = jax.vmap(_line_moved, (0, 0, None))(perp(lines.anchor - first[None]), lines.normal, cov)
    of_lines = jnp.where(adjusted.seen[:, None, None], of_lines, 0)
    return adjusted._replace(
        cov_poses=adjusted.cov_poses + jax.vmap(of_pose)(adjusted.poses),
        lines=_with_persistent(lines, of_lines),
    )


def _line_moved(lever: Float[Array, "2"], normal: Float[Array, "2"], cov: Float[Array, "3 3"]) -> Float[Array, "2 2"]:
    """Covariance of (offset, angle) of a line that moves with a pose, `lever` away and turned by +90 degrees."""
    jac = jnp.zeros((2, 3), cov.dtype).at[0].set(jnp.append(normal, dot(normal, lever))).at[1, 2].set(1)
    return propagate(jac, cov)


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

    Returns:
      The map with larger covariances; its estimates do not change.
    """

    def nearest_pose(place: Float[Array, "2"]) -> tuple[Array, Array]:
        off = place[None] - poses[:, :2]
        best = jnp.argmin(dot(off, off))
        return perp(off[best]), cov_poses[best]

    def of_line(anchor: Array, normal: Array) -> Array:
        lever, cov = nearest_pose(anchor)
        return _line_moved(lever, normal, cov)

    def of_circle(center: Array) -> Array:
        lever, cov = nearest_pose(center)
        return propagate(_jac_circle_pose(-perp(lever)), cov)

    lines, circles = line_map.lines, line_map.circles
    dtype = lines.offset.dtype
    more = jax.vmap(of_line)(lines.anchor, lines.normal).astype(dtype)
    more = jnp.where((seen | ~lines.valid)[:, None, None], 0, more)
    around = jax.vmap(of_circle)(circles.center).astype(dtype)
    around = jnp.where((circles.valid & circles.fitted)[:, None, None], around, 0)
    return LineMap(lines=_with_persistent(lines, more), circles=_with_persistent(circles, around))


class _System(NamedTuple):
    """Normal equations, in blocks: poses, lines, and what couples them."""

    of_steps: Float[Array, "P P"]  # P = 3 N; of steps and closures alone, zero for what is held
    of_poses: Float[Array, "P P"]
    of_lines: Float[Array, "K 2 2"]
    of_both: Float[Array, "P K 2"]
    pull_poses: Float[Array, " P"]
    pull_lines: Float[Array, "K 2"]
    seen: Bool[Array, " K"]
    misfit: Float[Array, ""]  # chi-square of the sightings
    residuals: Float[Array, ""]  # how many


def _eliminated(system: _System) -> tuple[Any, Float[Array, "P K 2"]]:
    """The factor of what is left for the poses when each line follows them (Schur), and how it follows."""
    through = jnp.einsum("pki,kij->pkj", system.of_both, inverse(system.of_lines))
    p = system.of_poses.shape[0]
    left = system.of_poses - through.reshape(p, -1) @ system.of_both.reshape(p, -1).T
    return cho_factor(left, lower=True), through


def _places(index: Int[Array, " F"], size: int) -> Int[Array, "F size"]:
    """Where the unknowns of some poses stand."""
    return size * index[:, None] + jnp.arange(size)[None]


def _mt(matrix: Float[Array, "F m n"]) -> Float[Array, "F n m"]:
    return jnp.swapaxes(matrix, -1, -2)


def _mtv(matrix: Float[Array, "F m n"], vector: Float[Array, "F m"]) -> Float[Array, "F n"]:
    return jnp.sum(matrix * vector[..., None], -2)
