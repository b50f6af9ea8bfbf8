"""Where a scan was taken, from the surface that it shares with others.

Points against points with their walls' directions (Chen and Medioni 1991), nearest neighbours anew in every iteration,
with a kernel that forgets what lies far off (Geman and McClure). The result starts from a guess and holds to it in the
directions that the surface leaves open, such as along a corridor.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.estimation.surface import Surface, seen_from
from linemap_jax.core.fields import documented
from linemap_jax.core.frames import dot, perp, wrap_angle
from linemap_jax.core.propagation import apply, inverse
from linemap_jax.core.settings import Number
from linemap_jax.core.state import pytree


@pytree
class RegistrationSettings:
    """How a scan is laid onto a surface. The same for all scanners and places, unless there is a reason."""

    first_gate: Number = 0.8
    """Largest distance of a point from its neighbour in the first iteration, m."""
    last_gate: Number = 0.15
    """The same in the last ones, m."""
    narrowing: Number = 0.6
    """Of the gate, from one iteration to the next."""
    sigma: Number = 0.03
    """Spread of points about the surface that they belong to, m: noise of the range, and roughness."""
    flat_angle: Number = 0.8
    """Largest angle between the walls of two points that are neighbours, rad."""
    weight_of_lone: Number = 0.1
    """Of a point that is on no piece of wall, which holds the scan in every direction, against one that is."""
    agreement: Number = 0.1
    """Points nearer than this to the surface agree with it, m."""


@documented
class Registration(NamedTuple):
    """A scan laid onto a surface."""

    pose: Float[Array, "3"]
    """Pose of the scan in the frame of the surface. m, m, rad."""
    information: Float[Array, "3 3"]
    """Information on the pose from the points alone, as if their errors were independent."""
    share: Float[Array, ""]
    """Share of the scan's points that agree with the surface."""


def register(
    new: Surface,
    surface: Surface,
    guess: Float[Array, "3"],
    prior: Float[Array, "3 3"],
    settings: RegistrationSettings = RegistrationSettings(),
    *,
    iterations: int = 12,
) -> Registration:
    """The pose from which `new` was seen.

    Args:
      new: what the scan has seen, in the frame of the scanner.
      surface: what it is laid onto, in the frame of the pose. Near the origin, where float32 is dense.
      guess: the pose to begin with. m, m, rad.
      prior: information on the guess: the inverse of its covariance.
      settings: gates and weights.
      iterations: at most. Static.

    Returns:
      The pose that is most likely by points and prior.
    """

    def iterate(state: tuple[Array, Registration, Array]) -> tuple[Array, Registration, Array]:
        i, at, _ = state
        gate = jnp.maximum(settings.first_gate * settings.narrowing ** i.astype(guess.dtype), settings.last_gate)
        information, pull, share = _pull(new, surface, at.pose, gate, settings)
        off = guess - at.pose
        off = off.at[2].set(wrap_angle(off[2]))
        step = apply(inverse(information + prior), pull + apply(prior, off))
        return i + 1, Registration(at.pose + step, information, share), jnp.max(jnp.abs(step))

    def goes_on(state: tuple[Array, Registration, Array]) -> Array:
        i, _, step = state
        return (i < iterations) & ((i < 4) | (step > 5e-4))

    zero = jnp.zeros((), guess.dtype)
    begin = Registration(guess, jnp.zeros((3, 3), guess.dtype), zero)
    _, done, _ = jax.lax.while_loop(goes_on, iterate, (jnp.zeros((), jnp.int32), begin, zero))
    return done


def _pull(
    new: Surface, surface: Surface, pose: Float[Array, "3"], gate: Float[Array, ""], settings: RegistrationSettings
) -> tuple[Float[Array, "3 3"], Float[Array, "3"], Float[Array, ""]]:
    """The normal equations of one Gauss-Newton step: information, right-hand side; and the share that agrees."""
    here = seen_from(new, pose)
    # The back of a wall is not seen, and may be nearer than its front.
    in_front = dot(surface.normal, pose[None, :2] - surface.position) > 0
    visible = surface.valid & (in_front | ~surface.flat)
    neighbour = nearest(here.position, surface.position, visible)
    normal, flat = surface.normal[neighbour], surface.flat[neighbour]
    off = here.position - surface.position[neighbour]
    one_wall = dot(here.normal, normal) > jnp.cos(settings.flat_angle)
    used = new.valid & visible[neighbour] & (dot(off, off) < gate**2) & (one_wall | ~(flat & new.flat))

    lever = perp(here.position - pose[None, :2])
    information, pull, distance = jnp.zeros((3, 3), pose.dtype), jnp.zeros(3, pose.dtype), []
    for direction, weight in (
        (normal, jnp.where(flat, 1, settings.weight_of_lone)),
        (perp(normal), jnp.where(flat, 0, settings.weight_of_lone)),
    ):
        residual = dot(direction, off)
        kernel = 1 / (1 + (residual / (2 * settings.sigma)) ** 2) ** 2
        weight = jnp.where(used, weight * kernel, 0) / settings.sigma**2
        jac = jnp.concatenate([direction, dot(direction, lever)[:, None]], -1)
        information = information + (jac * weight[:, None]).T @ jac
        pull = pull - jac.T @ (weight * residual)
        distance.append(jnp.abs(residual))
    agrees = used & (distance[0] < settings.agreement)
    return information, pull, jnp.sum(agrees) / jnp.maximum(jnp.sum(new.valid), 1).astype(pose.dtype)


def nearest(points: Float[Array, "M 2"], others: Float[Array, "K 2"], valid: Bool[Array, " K"]) -> Int[Array, " M"]:
    """The nearest of the others for each point; any, where none is valid.

    In float32, where the squared distances of two are equal but for their last bits, either of them. The bits of a
    positive number rise with it, so that index and distance fit into one integer, whose minimum is one kernel; an
    `argmin` goes number by number.

    Args:
      points: m. Shape `[M, 2]`.
      others: m. Shape `[K, 2]`.
      valid: which of the others count. Shape `[K]`.

    Returns:
      For each point the index of the nearest of the others. Shape `[M]`.
    """
    bits = (others.shape[0] - 1).bit_length()
    square = (points[None, :, 0] - others[:, None, 0]) ** 2 + (points[None, :, 1] - others[:, None, 1]) ** 2
    key = jax.lax.bitcast_convert_type(square.astype(jnp.float32), jnp.int32) >> bits << bits
    key = jnp.where(valid[:, None], key, jnp.iinfo(jnp.int32).max >> bits << bits)
    key = key | jnp.arange(others.shape[0], dtype=jnp.int32)[:, None]
    return jnp.min(key, 0) & ((1 << bits) - 1)
