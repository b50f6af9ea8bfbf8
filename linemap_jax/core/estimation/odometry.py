"""Section 3, dead reckoning: how far the robot has gone since the last scan, by its wheels and its gyroscope.

An increment is the pose of the robot seen from the one before it. It comes from two poses of the robot's own odometry,
or from what its wheels have run; a gyroscope may say more of the turn. Nothing here is in the paper, which cites [11].
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from linemap_jax.core.frames import between, perp, rotate, unit
from linemap_jax.core.propagation import jacobian, propagate, safe_sqrt, symmetric
from linemap_jax.core.settings import Jacobians, Number
from linemap_jax.core.state import pytree


@pytree
class OdometryNoise:
    """How well wheels count, of a robot with a differential drive.

    Errors of distance, turn and side slip are independent and new in every step. Their variances grow with what was
    driven, so that the error of a whole drive does not depend on the number of steps that it is counted in: variance of
    the distance = sigma_distance_distance^2 |distance| + sigma_distance_turn^2 |turn|, and so for the others.

    The defaults are those of a robot indoors that nobody has calibrated: a wheel or a wheel base that is a little off
    errs in proportion to what was driven, which over some metres they cover. They are generous, since a filter that
    corrects its pose at every scan loses little by it, and one that trusts its wheels too much gets lost.
    """

    sigma_distance_distance: Number = 0.05
    """Error of the distance after one metre, m / sqrt(m)."""
    sigma_distance_turn: Number = 0.03
    """Error of the distance after a turn of one radian, m / sqrt(rad)."""
    sigma_side_distance: Number = 0.03
    """Slip to the side after one metre, m / sqrt(m)."""
    sigma_side_turn: Number = 0.03
    """Slip to the side after a turn of one radian, m / sqrt(rad)."""
    sigma_turn_distance: Number = 0.05
    """Error of the turn after one metre, rad / sqrt(m)."""
    sigma_turn_turn: Number = 0.1
    """Error of the turn after a turn of one radian, rad / sqrt(rad)."""


@pytree
class GyroscopeNoise:
    """How well a gyroscope measures a turn. The bias is taken for known up to an error that is new in every step."""

    sigma_rate: Number = 0.002
    """Angle random walk: error of the turn after one second, rad / sqrt(s)."""
    sigma_bias: Number = 0.001
    """Of what is left of the bias, rad / s."""


@pytree
class Increment:
    """A step of the robot: its pose seen from the one before it, and the covariance."""

    mean: Float[Array, "3"]
    """x ahead, y to the left, turn. m, m, rad."""
    cov: Float[Array, "3 3"]
    """Covariance of these: m^2, m rad, rad^2."""


def increment_from_poses(
    before: Float[Array, "3"],
    after: Float[Array, "3"],
    noise: OdometryNoise,
    *,
    jacobians: Jacobians = "analytic",
) -> Increment:
    """The step between two poses of the robot's odometry, which may be in any frame, since it drops out.

    Args:
      before: x, y, theta of the earlier one. m, m, rad.
      after: of the later one.
      noise: of the wheels.
      jacobians: "autodiff" or "analytic".

    Returns:
      The step, seen from the earlier pose, and its covariance.
    """
    step = between(before, after)
    return Increment(mean=step, cov=cov_step(step, noise, jacobians=jacobians))


def increment_from_wheels(
    left: Float[Array, ""],
    right: Float[Array, ""],
    base: Number,
    noise: OdometryNoise,
    *,
    jacobians: Jacobians = "analytic",
) -> Increment:
    """The step of a differential drive: an arc, on which the wheels keep their speeds.

    Args:
      left: what the left wheel has run, m.
      right: what the right wheel has run, m.
      base: distance of the wheels, m.
      noise: of the wheels.
      jacobians: "autodiff" or "analytic".

    Returns:
      The step, seen from where it began, and its covariance.
    """
    step = step_from_wheels(left, right, base)
    return Increment(mean=step, cov=cov_step(step, noise, jacobians=jacobians))


def step_from_wheels(left: Float[Array, ""], right: Float[Array, ""], base: Number) -> Float[Array, "3"]:
    """The end of the arc: its chord has half the direction of the turn. m, m, rad.

    Args:
      left: what the left wheel has run, m.
      right: what the right wheel has run, m.
      base: distance of the wheels, m.

    Returns:
      x ahead, y to the left, turn. m, m, rad; the turn is not wrapped. Shape `[3]`.
    """
    distance, turn = (left + right) / 2, (right - left) / base
    chord = distance * jnp.sinc(turn / (2 * jnp.pi))  # distance sin(turn / 2) / (turn / 2)
    return jnp.concatenate([chord * unit(turn / 2), turn[None]])


def with_gyroscope(
    increment: Increment, turn: Float[Array, ""], seconds: Float[Array, ""], noise: GyroscopeNoise
) -> Increment:
    """The increment, improved by what a gyroscope says of its turn.

    The error of the turn goes with one across the step, which improves alike.

    Args:
      increment: by the wheels.
      turn: the angle that the gyroscope has turned through, its bias taken off, rad. Not wrapped: as the wheels' turn.
      seconds: how long the step took.
      noise: of the gyroscope.

    Returns:
      The increment, with a smaller covariance.
    """
    variance = noise.sigma_rate**2 * seconds + (noise.sigma_bias * seconds) ** 2
    of_turn = increment.cov[:, 2]
    total = of_turn[2] + variance
    gain = of_turn / jnp.where(total > 0, total, 1)
    innovation = turn - increment.mean[2]
    innovation = innovation - 2 * jnp.pi * jnp.round(innovation / (2 * jnp.pi))
    kept = jnp.eye(3, dtype=gain.dtype).at[:, 2].add(-gain)
    return Increment(
        mean=increment.mean + gain * innovation,
        # Joseph's form, which stays positive semidefinite under rounding.
        cov=propagate(kept, increment.cov) + variance * symmetric(gain[:, None] * gain[None]),
    )


def step_with_errors(step: Float[Array, "3"], errors: Float[Array, "3"]) -> Float[Array, "3"]:
    """What was counted as `step`, if it erred: by a distance along it, a slip across it, a turn on the way.

    The turn goes wrong evenly along the way, so that the direction of the step errs by half of it.

    Args:
      step: x, y, turn. m, m, rad.
      errors: along, across, turn. m, m, rad.

    Returns:
      The step that was made. m, m, rad. Shape `[3]`.
    """
    along = _direction(step)
    moved = step[:2] + errors[0] * along + errors[1] * perp(along)
    return jnp.concatenate([rotate(errors[2] / 2, moved), step[2:] + errors[2:]])


def jac_step_errors(step: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The derivative of `step_with_errors` by errors of zero, derived by hand.

    Args:
      step: x, y, turn, as counted. m, m, rad. Shape `[3]`.

    Returns:
      d(x, y, turn) / d(along, across, turn). Shape `[3, 3]`.
    """
    along = _direction(step)
    move = jnp.stack([along, perp(along), perp(step[:2]) / 2], -1)
    return jnp.concatenate([move, jnp.eye(3, dtype=step.dtype)[2:]])


def cov_step(
    step: Float[Array, "3"], noise: OdometryNoise, *, jacobians: Jacobians = "analytic"
) -> Float[Array, "3 3"]:
    """Covariance of a counted step.

    Where the turn errs at random along the way, its error at the end tells half of what it moves the step across; the
    other part is independent, of the variance distance^2 var_turn / 12 (the area under a Brownian bridge). With it, the
    covariance of a straight drive is the same whether it is counted in one step or in a thousand.

    Args:
      step: x, y, turn. m, m, rad.
      noise: of the wheels.
      jacobians: "autodiff" or "analytic".

    Returns:
      Of (x, y, turn): m^2, m rad, rad^2. Shape `[3, 3]`.
    """
    distance, turn = safe_sqrt(step[0] ** 2 + step[1] ** 2), jnp.abs(step[2])
    along = noise.sigma_distance_distance**2 * distance + noise.sigma_distance_turn**2 * turn
    across = noise.sigma_side_distance**2 * distance + noise.sigma_side_turn**2 * turn
    turned = noise.sigma_turn_distance**2 * distance + noise.sigma_turn_turn**2 * turn
    across = across + distance**2 * turned / 12
    jac = jacobian(lambda errors: step_with_errors(step, errors), lambda _: jac_step_errors(step), jacobians)
    return propagate(jac(jnp.zeros_like(step)), jnp.diag(jnp.stack([along, across, turned])).astype(step.dtype))


def _direction(step: Float[Array, "3"]) -> Float[Array, "2"]:
    """Unit vector along a step; straight ahead where it only turns."""
    distance = safe_sqrt(step[0] ** 2 + step[1] ** 2)
    moves = distance > 0
    ahead = jnp.asarray([1.0, 0.0], step.dtype)
    return jnp.where(moves, step[:2] / jnp.where(moves, distance, 1), ahead)
