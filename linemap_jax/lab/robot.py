"""The robot: how it drives, what its wheels count, and what it believes of its pose."""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from linemap_jax.core.frames import between, unit, wrap_angle
from linemap_jax.core.propagation import square_root
from linemap_jax.core.settings import Number
from linemap_jax.core.state import Pose, pytree

ARC = 16
"""Straight pieces of a rounded corner."""


def drive(
    path: Float[Array, "W 2"],
    *,
    count: int,
    turns: Literal["spot", "smooth"] = "spot",
    turn_cost: Number = 0.3,
    corner: Number = 0.5,
) -> Float[Array, "T 3"]:
    """Poses along a path, at equal steps.

    Where the robot turns on the spot, a step is one of distance or one of turn, weighed by `turn_cost`; the one in
    which it goes over from one to the other has some of both. Where it drives smoothly, all steps are of one length,
    and the heading is that of the path; a corner is cut by a parabola from `corner` before it to `corner` behind it.
    The path is followed exactly between corners, and a parabola stays inside the triangle that its corner makes.

    Args:
      path: way points in metres; equal successive ones count once. Shape `[W, 2]`.
      count: of the poses, the first way point and the last one included.
      turns: "spot" or "smooth".
      turn_cost: the distance that takes as long as a turn of one radian on the spot, m.
      corner: how far before and behind a way point a smooth turn reaches, m; half a leg at most.

    Returns:
      x, y in metres, theta in radians in (-pi, pi]. Shape `[count, 3]`.

    Raises:
      ValueError: if the path is empty, or `turns` is neither.
    """
    if not path.shape[0]:
        raise ValueError("a path needs a way point at least")
    if turns not in ("spot", "smooth"):
        raise ValueError(f"turns must be 'spot' or 'smooth', not {turns!r}")
    if path.shape[0] == 1:
        path = jnp.concatenate([path, path])
    begin, end = path[:-1], path[1:]
    length, heading = _legs(begin, end)
    turn = wrap_angle(jnp.diff(heading))
    if turns == "spot":
        # Knots: both ends of each leg.
        knots = jnp.stack([begin, end], 1).reshape(-1, 2)
        headings = jnp.repeat(jnp.concatenate([heading[:1], heading[0] + jnp.cumsum(turn)]), 2)
        rest = jnp.concatenate([jnp.abs(turn) * turn_cost, jnp.zeros(1, path.dtype)])
        cost = jnp.stack([length, rest], 1).reshape(-1)[:-1]
    else:
        knots, headings = _rounded(path, length, heading, turn, corner)
        step = jnp.diff(knots, axis=0)
        cost = jnp.sqrt(jnp.sum(step * step, -1))
    spent = jnp.concatenate([jnp.zeros(1, path.dtype), jnp.cumsum(cost)])
    at = jnp.linspace(0.0, 1.0, count, dtype=path.dtype) * spent[-1]
    x, y, theta = (jnp.interp(at, spent, column) for column in (knots[:, 0], knots[:, 1], headings))
    return jnp.stack([x, y, wrap_angle(theta)], -1)


def _legs(begin: Float[Array, "L 2"], end: Float[Array, "L 2"]) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
    """Length and heading of each leg; one without a length has the heading of the last one before that has."""
    step = end - begin
    length = jnp.sqrt(jnp.sum(step * step, -1))
    count = length.shape[0]
    # Where the first legs have no length, they look along the first one that has.
    first = jnp.argmax(length > 0)
    last = jax.lax.cummax(jnp.where(length > 0, jnp.arange(count), first))
    return length, jnp.arctan2(step[:, 1], step[:, 0])[last]


def _rounded(
    path: Float[Array, "W 2"],
    length: Float[Array, " L"],
    heading: Float[Array, " L"],
    turn: Float[Array, " V"],
    corner: Number,
) -> tuple[Float[Array, "M 2"], Float[Array, " M"]]:
    """The path with its corners cut: knots and headings.

    The parabola through p - d u, p, p + d v (control points; u, v the directions of the legs) has the tangent
    (1 - t) u + t v.
    """
    reach = jnp.minimum(jnp.minimum(length[:-1], length[1:]) / 2, corner)[:, None, None]
    u, v = unit(heading[:-1])[:, None], unit(heading[1:])[:, None]
    t = jnp.linspace(0.0, 1.0, ARC + 1, dtype=path.dtype)[None]
    arcs = path[1:-1][:, None] + reach * (t[..., None] ** 2 * v - (1 - t[..., None]) ** 2 * u)
    bend = turn[:, None]
    of_arcs = (
        heading[0] + (jnp.cumsum(turn) - turn)[:, None] + jnp.arctan2(t * jnp.sin(bend), 1 - t + t * jnp.cos(bend))
    )
    knots = jnp.concatenate([path[:1], arcs.reshape(-1, 2), path[-1:]])
    return knots, jnp.concatenate([heading[:1], of_arcs.reshape(-1), heading[:1] + jnp.sum(turn)])


@pytree
class Odometry:
    """How well wheels count. Errors of distance and of turn are independent, and new in every step.

    Their variances grow with what was driven, so that the error of a whole drive does not depend on how many steps it
    is counted in: variance of the distance = (sigma_distance_distance^2 |distance| + sigma_distance_turn^2 |turn|), and
    so for the turn. The scales are what stays the same in all steps.
    """

    sigma_distance_distance: Number = 0.02
    """Error of the distance after one metre, m / sqrt(m)."""
    sigma_distance_turn: Number = 0.01
    """Error of the distance after a turn of one radian, m / sqrt(rad)."""
    sigma_turn_distance: Number = 0.01
    """Error of the turn after one metre, rad / sqrt(m)."""
    sigma_turn_turn: Number = 0.02
    """Error of the turn after a turn of one radian, rad / sqrt(rad)."""
    distance_scale: Number = 1.0
    """Counted distance by true distance: wheels that are smaller than believed count too much."""
    turn_scale: Number = 1.0
    """Counted turn by true turn: a wheel base that is smaller than believed counts too much."""


def increments(poses: Float[Array, "T 3"]) -> Float[Array, "T-1 3"]:
    """Each of the `poses` but the first, seen from the one before it: x ahead, y to the left, turn. m, m, rad."""
    return jax.vmap(between)(poses[:-1], poses[1:])


def read_odometry(key: Array, poses: Float[Array, "T 3"], odometry: Odometry) -> Float[Array, "T-1 3"]:
    """The increments as the wheels of a differential drive count them.

    Distance and turn are counted with their errors; the direction of the step within the frame that it starts from is
    half of the turn, as on an arc, and errs by half of the error of the turn.

    Args:
      key: of the noise.
      poses: the true ones. Shape `[T, 3]`.
      odometry: how well is counted.

    Returns:
      The counted increments, as of `increments`. Shape `[T - 1, 3]`.
    """
    odometry = jax.tree.map(lambda x: jnp.asarray(x, poses.dtype), odometry)
    x, y, turn = jnp.moveaxis(increments(poses), -1, 0)
    distance, direction = jnp.hypot(x, y), jnp.arctan2(y, x)
    noise = jax.random.normal(key, (2, *turn.shape), poses.dtype)
    driven, turned = distance, jnp.abs(turn)

    def sigma(by_distance: Number, by_turn: Number) -> Float[Array, " S"]:
        return jnp.sqrt(jnp.square(by_distance) * driven + jnp.square(by_turn) * turned)

    counted = odometry.distance_scale * distance + noise[0] * sigma(
        odometry.sigma_distance_distance, odometry.sigma_distance_turn
    )
    counted_turn = odometry.turn_scale * turn + noise[1] * sigma(odometry.sigma_turn_distance, odometry.sigma_turn_turn)
    step = counted[:, None] * unit(direction + (counted_turn - turn) / 2)
    return jnp.concatenate([step, counted_turn[:, None]], -1)


def dead_reckoning(start: Float[Array, "3"], steps: Float[Array, "S 3"]) -> Float[Array, "S+1 3"]:
    """The poses that follow from a start and increments. Shape `[S + 1, 3]`; the inverse of `increments`.

    Args:
      start: x, y, theta. m, m, rad.
      steps: increments, each in the frame of the pose before it. Shape `[S, 3]`.

    Returns:
      x, y, theta in (-pi, pi]. m, m, rad.
    """
    theta = start[2] + jnp.concatenate([jnp.zeros(1, start.dtype), jnp.cumsum(steps[:, 2])])
    c, s = jnp.cos(theta[:-1]), jnp.sin(theta[:-1])
    moves = jnp.stack([c * steps[:, 0] - s * steps[:, 1], s * steps[:, 0] + c * steps[:, 1]], -1)
    places = jnp.concatenate([start[None, :2], start[None, :2] + jnp.cumsum(moves, 0)])
    return jnp.concatenate([places, wrap_angle(theta)[:, None]], -1)


def pose_errors(key: Array, cov: Float[Array, "3 3"], *, count: int, correlation: Number = 0.0) -> Float[Array, "T 3"]:
    """Errors of successive poses, each of the same covariance: p[k+1] = a p[k] + sqrt(1 - a^2) C^(1/2) w.

    a = 0: independent; a = 1: one error that all share; between them it drifts, and is forgotten over 1 / (1 - a)
    scans.

    Args:
      key: of the noise.
      cov: C, of x, y, theta in the axes of the world; may be singular. m^2, m rad, rad^2.
      count: of the poses.
      correlation: a, from one scan to the next, from 0 to 1.

    Returns:
      Errors of x, y, theta in the axes of the world. m, m, rad. Shape `[count, 3]`.
    """
    root = square_root(cov)
    new = jax.random.normal(key, (count, 3), cov.dtype)
    a = jnp.asarray(correlation, cov.dtype)

    def step(u: Float[Array, "3"], w: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        u = a * u + jnp.sqrt(1 - a * a) * w
        return u, u

    _, later = jax.lax.scan(step, new[0], new[1:])
    return jnp.sum(jnp.concatenate([new[:1], later])[:, None] * root[None], -1)


def estimate_pose(key: Array, pose: Float[Array, "3"], cov: Float[Array, "3 3"]) -> Pose:
    """What the robot believes of one pose; as `estimate_poses`.

    Args:
      key: of the error.
      pose: the true one. m, m, rad. Shape `[3]`.
      cov: of the error, in the axes of the world: m^2, m rad, rad^2. Shape `[3, 3]`.

    Returns:
      The pose with its error, and its covariance.
    """
    return jax.tree.map(lambda x: x[0], estimate_poses(key, pose[None], cov))


def estimate_poses(
    key: Array, poses: Float[Array, "T 3"], cov: Float[Array, "3 3"], *, correlation: Number = 0.0
) -> Pose:
    """What the robot believes of its poses: the truth with the errors of `pose_errors`, and their covariance.

    Args:
      key: of the noise.
      poses: the true ones. Shape `[T, 3]`.
      cov: of each of them. m^2, m rad, rad^2.
      correlation: of the errors, from one scan to the next, from 0 to 1.

    Returns:
      Stacked poses, `[T, 3]` and `[T, 3, 3]`.
    """
    mean = poses + pose_errors(key, cov, count=poses.shape[0], correlation=correlation)
    return Pose(
        mean=mean.at[:, 2].set(wrap_angle(mean[:, 2])),
        cov=jnp.broadcast_to(cov, (poses.shape[0], 3, 3)),
    )
