"""Keyframes and what is known of the steps between them: the poses that fit all of it best.

A chain of steps, from each keyframe to the next, and closures, between keyframes that have seen the same place. The
sum of squares is made small by Gauss and Newton's method. Unknowns are the changes from keyframe to keyframe, not the
poses: then the chain alone has a nearly diagonal system, which is what conjugate gradients are preconditioned with, and
they need about as many iterations as there are loops (Olson, Leonard and Teller 2006 give the parameters, not the
solver).

A closure may be wrong. Its weight falls with its squared residual (Geman and McClure), with a kernel that is wide at
first where a new closure is far off, and narrows (graduated non-convexity: Yang, Antonante, Tzoumas and Carlone 2020),
so that a true closure far off is not given up before the graph has followed it.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.frames import between, perp, unit
from linemap_jax.core.propagation import apply, inverse, propagate, square_root
from linemap_jax.core.settings import Number
from linemap_jax.core.state import pytree

KERNEL = 9.0
"""Squared residual, in sigmas, at which a closure has lost three quarters of its weight."""
WIDEST_KERNEL = 1000.0
"""The same in the first iteration, at most."""
NARROWING = 0.4
"""Of the kernel, from one iteration to the next."""
SURE = 0.5
"""A closure of more weight than this is believed."""


@pytree
class RegistrationError:
    """How far a registration errs, beyond what its points say when their errors are taken for independent."""

    point_weight: Number = 0.1
    """Of a point's information: neighbouring points share the faults of the surface and of their association."""
    no_trust: Number = 0.4
    """Where no more of the scan's points than this share agree, they say nothing."""
    full_trust: Number = 0.7
    """From this share on they say what they can."""
    distance_sigma: Number = 0.015
    """Of every step, m: faults that more points do not average away."""
    turn_sigma: Number = 0.005
    """The same for the turn, rad."""


@pytree
class Closures:
    """Steps between keyframes that do not follow one another."""

    begin: Int[Array, " E"]
    """The older keyframe."""
    end: Int[Array, " E"]
    """The newer."""
    step: Float[Array, "E 3"]
    """Pose of the newer, seen from the older. m, m, rad."""
    cov: Float[Array, "E 3 3"]
    """Covariance of the step: m^2, m rad, rad^2."""
    weight: Float[Array, " E"]
    """Weight, from 0, not believed, to 1, which new ones begin with."""
    valid: Bool[Array, " E"]
    """Which slots are in use."""


@pytree
class PoseGraph:
    """Keyframes in the order in which they were passed. The first one is held where it is."""

    poses: Float[Array, "N 3"]
    """Poses of the keyframes. m, m, rad."""
    step: Float[Array, "N 3"]
    """Step from the keyframe before, m, m, rad; of the first, of no meaning."""
    cov_step: Float[Array, "N 3 3"]
    """Covariance of the step: m^2, m rad, rad^2."""
    valid: Bool[Array, " N"]
    """Which slots are in use."""
    closures: Closures
    """Steps between keyframes that do not follow each other."""


def cov_of_registration(
    information: Float[Array, "*s 3 3"],
    share: Float[Array, "*s"],
    prior: Float[Array, "*s 3 3"],
    error: RegistrationError = RegistrationError(),
) -> Float[Array, "*s 3 3"]:
    """Covariance of a step (x, y, theta) that registration has found: m^2, m rad, rad^2.

    Args:
      information: of its points, as if their errors were independent: 1/m^2, 1/(m rad), 1/rad^2.
      share: of the scan's points, those that agree.
      prior: what is known of the step without them, as information, likewise.
      error: how far they are believed.

    Returns:
      The covariance. Shape `[*s, 3, 3]`.
    """
    trust = jnp.clip((share - error.no_trust) / (error.full_trust - error.no_trust), 0, 1)
    weight = (error.point_weight * trust)[..., None, None]
    floor = jnp.stack([jnp.asarray(error.distance_sigma)] * 2 + [jnp.asarray(error.turn_sigma)]) ** 2
    return inverse(weight * information + prior) + jnp.broadcast_to(
        jnp.diag(floor).astype(information.dtype), information.shape
    )


def optimise(graph: PoseGraph, *, iterations: int = 25, tolerance: float = 1e-4) -> PoseGraph:
    """The most likely poses.

    Args:
      graph: with poses to begin from. In float64, where there are more than some hundred keyframes.
      iterations: of Gauss and Newton, at most. Static.
      tolerance: ends them when no pose moves by more, m and rad.

    Returns:
      The graph with these poses, whose angles are not wrapped, and with the weights that its closures have there.
    """
    closures = graph.closures
    far = jnp.where(closures.valid & (closures.weight > SURE), _squared_residuals(graph, graph.poses), 0)
    widest = jnp.where(jnp.max(far) > KERNEL, WIDEST_KERNEL, KERNEL).astype(graph.poses.dtype)

    def kernel_at(i: Array) -> Array:
        return jnp.maximum(KERNEL, widest * NARROWING ** i.astype(widest.dtype))

    def iterate(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        i, poses, _ = state
        move = _newton_step(graph, poses, _weights(graph, poses, kernel_at(i)))
        return i + 1, poses + move, jnp.max(jnp.abs(move))

    def goes_on(state: tuple[Array, Array, Array]) -> Array:
        i, _, moved = state
        return (i < iterations) & ~((kernel_at(i) <= KERNEL) & (moved < tolerance))

    begin = (jnp.zeros((), jnp.int32), graph.poses, jnp.full((), jnp.inf, graph.poses.dtype))
    _, poses, _ = jax.lax.while_loop(goes_on, iterate, begin)
    weight = _weights(graph, poses, jnp.asarray(KERNEL, poses.dtype))
    return dataclasses.replace(graph, poses=poses, closures=dataclasses.replace(closures, weight=weight))


def _residuals(graph: PoseGraph, poses: Float[Array, "N 3"]) -> tuple[Float[Array, "N 3"], Float[Array, "E 3"]]:
    """What the poses lack of each step of the chain and of each closure, in units of their sigmas."""
    closures = graph.closures
    before = jnp.concatenate([poses[:1], poses[:-1]])
    linked = graph.valid & (jnp.arange(poses.shape[0]) > 0)

    def lacking(begin: Array, end: Array, step: Array, cov: Array, valid: Array) -> Array:
        off = jax.vmap(between)(begin, end) - step
        off = off.at[:, 2].add(-2 * jnp.pi * jnp.round(jax.lax.stop_gradient(off[:, 2]) / (2 * jnp.pi)))
        white = apply(jnp.swapaxes(square_root(inverse(cov)), -1, -2), off)
        return jnp.where(valid[:, None], white, 0)

    return (
        lacking(before, poses, graph.step, graph.cov_step, linked),
        lacking(poses[closures.begin], poses[closures.end], closures.step, closures.cov, closures.valid),
    )


def _weights(graph: PoseGraph, poses: Float[Array, "N 3"], kernel: Float[Array, ""]) -> Float[Array, " E"]:
    return jnp.where(graph.closures.valid, (kernel / (kernel + _squared_residuals(graph, poses))) ** 2, 0)


def _squared_residuals(graph: PoseGraph, poses: Float[Array, "N 3"]) -> Float[Array, " E"]:
    return jnp.sum(_residuals(graph, poses)[1] ** 2, -1)


def _newton_step(graph: PoseGraph, poses: Float[Array, "N 3"], weight: Float[Array, " E"]) -> Float[Array, "N 3"]:
    """By how much the poses have to move."""
    root = jnp.sqrt(weight)[:, None]

    def moved(change: Array) -> tuple[Array, Array]:
        # A sum from keyframe to keyframe: what turns one leaves the directions of the steps after it as they are.
        chain, closing = _residuals(graph, poses + jnp.cumsum(change, 0))
        return chain, root * closing

    zero = jnp.zeros_like(poses)
    residuals, forward = jax.linearize(moved, zero)
    backward = jax.linear_transpose(forward, zero)

    def system(change: Array) -> Array:
        return backward(forward(change))[0]

    ahead = unit(jnp.concatenate([poses[:1], poses[:-1]])[:, 2])
    turned = jnp.zeros((*poses.shape, 3), poses.dtype).at[:, 2, 2].set(1)
    turned = turned.at[:, :2, 0].set(ahead).at[:, :2, 1].set(perp(ahead))
    cov = propagate(turned, graph.cov_step)
    first = (jnp.arange(poses.shape[0]) == 0)[:, None]

    pull: Array = backward(residuals)[0]
    right = jnp.where(first, zero, -pull)

    def held(x: Array) -> Array:
        free: Array = jnp.where(first, zero, x)
        return jnp.where(first, x, system(free))

    change: Array = cg(
        held,
        right,
        tol=1e-5,
        maxiter=300,
        M=partial(_preconditioned, cov, first),
    )[0]
    moves: Array = jnp.where(first, zero, change)
    return jnp.cumsum(moves, 0)


def _preconditioned(
    cov: Float[Array, "N 3 3"], first: Bool[Array, "N 1"], residual: Float[Array, "N 3"]
) -> Float[Array, "N 3"]:
    return jnp.where(first, residual, apply(cov, residual))
