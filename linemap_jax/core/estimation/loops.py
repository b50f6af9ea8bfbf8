"""Whether a keyframe sees what older ones have seen, and from where: what closes a loop.

Where the path between them is short, registration finds the pose by itself. Where the drift may be metres, a
correlative search (Olson 2009) goes over all poses that it leaves possible: the older surface is drawn into a grid, and
the points of the newer one are counted on it. The best of them are registered, and the one in which most points agree
is believed if no other place agrees nearly as well: corridors look alike wherever one stands.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from linemap_jax.core.estimation.registration import RegistrationSettings, register
from linemap_jax.core.estimation.surface import Surface, seen_from
from linemap_jax.core.fields import documented
from linemap_jax.core.frames import wrap_angle
from linemap_jax.core.settings import Number
from linemap_jax.core.state import pytree

CELL = 0.3
"""m, of the grid."""
REACH = 34
"""Cells that the search goes in each direction: 10 m."""
SPAN = 100
"""Cells from the middle of the grid to its edge: 30 m."""
TURN = 0.0436
"""rad, from one direction of the search to the next: 2.5 degrees, half a cell at 3.4 m."""
TURNS = 12
"""Directions to either side: 30 degrees."""
THINNING = 3
"""Every n-th point takes part in the search."""
HYPOTHESES = 10
"""Poses that are registered."""
FARTHEST = 9.0
"""Squared distance from the guess, in sigmas, up to which poses are looked at."""
PREFERENCE = 0.02
"""Share of the points that such a squared sigma is worth: of two poses that count alike, the nearer one."""
ONE_PEAK = 3, 2
"""Cells and directions about a pose that belong to the same peak of the count."""
LEAST_COUNT = 0.3
"""Share of the points that must fall on the surface for a pose to be a hypothesis."""
HARDLY_ANYTHING = 0.04, 0.04, 1.0
"""1/m^2, 1/m^2, 1/rad^2. Information of a guess of 5 m and a radian: the points are to say where they lie."""
WEIGHT_OF_DRIFT = 1e-3
"""Of the information that drift leaves, beside the points, which err alike where they are neighbours."""


@pytree
class LoopSettings:
    """When a loop is believed to be closed."""

    drift_per_metre: Number = 0.04
    """How uncertain the step between two keyframes is, for each metre of the shortest path between them."""
    least_drift: Number = 0.05
    """The same where the path has no length, m."""
    turn_drift_per_metre: Number = 0.005
    """How uncertain its direction is, for each metre, rad / m."""
    least_turn_drift: Number = 0.05
    """The same where the path has no length, rad."""
    search_from: Number = 0.3
    """Uncertainty from which the pose is searched for, m."""
    share_near: Number = 0.6
    """Least share of the points that must agree, where the pose is known well."""
    share_far: Number = 0.7
    """The same where it had to be searched for."""
    runner_up: Number = 0.85
    """Largest share that may agree in another place, relative to the best."""
    apart: Number = 0.4
    """What is another place, m."""
    turned_apart: Number = 0.1
    """What is another direction, rad."""


@documented
class Closure(NamedTuple):
    """What a keyframe says of an older one."""

    step: Float[Array, "3"]
    """Pose of the newer one, seen from the older. m, m, rad."""
    information: Float[Array, "3 3"]
    """Information on the step, as if the points' errors were independent."""
    share: Float[Array, ""]
    """Share of the points that agree."""
    believed: Bool[Array, ""]
    """Whether the two keyframes are taken to see one place."""


def joined(surfaces: Surface, poses: Float[Array, "S 3"], valid: Bool[Array, " S"]) -> Surface:
    """Several surfaces in one frame, that in which the poses are given. `[S, M]` in, `[S * M]` out.

    Args:
      surfaces: `S` of them, stacked, of `M` points each.
      poses: of their frames. m, m, rad. Shape `[S, 3]`.
      valid: which of them there are. Shape `[S]`.

    Returns:
      One surface of `S * M` points.
    """

    def moved(surface: Surface, pose: Array, is_there: Array) -> Surface:
        surface = seen_from(surface, pose)
        return dataclasses.replace(surface, valid=surface.valid & is_there)

    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), jax.vmap(moved)(surfaces, poses, valid))


def close_loop(
    new: Surface,
    surfaces: Surface,
    poses: Float[Array, "S 3"],
    valid: Bool[Array, " S"],
    guess: Float[Array, "3"],
    path: Float[Array, ""],
    settings: LoopSettings = LoopSettings(),
    registration: RegistrationSettings = RegistrationSettings(),
) -> Closure:
    """Lay a keyframe onto the surfaces of older ones.

    Args:
      new: surface of the keyframe.
      surfaces: of an older keyframe and those before and after it. `[S, M]`.
      poses: of these, seen from the older one. m, m, rad.
      valid: which of these there are.
      guess: pose of the newer keyframe, seen from the older one.
      path: shortest path between the two, m.
      settings: what is believed.
      registration: of the keyframe.

    Returns:
      The step from the older keyframe to the new one, and whether it is believed.
    """
    surface = joined(surfaces, poses, valid)
    drift = settings.least_drift + settings.drift_per_metre * path
    turn_drift = settings.least_turn_drift + settings.turn_drift_per_metre * path

    def near(_: None) -> Closure:
        prior = jnp.diag(jnp.asarray(HARDLY_ANYTHING, guess.dtype))
        found = register(new, surface, guess, prior, registration, iterations=15)
        return Closure(*found, believed=found.share >= settings.share_near)

    def far(_: None) -> Closure:
        prior = jnp.diag(jnp.stack([1 / drift**2, 1 / drift**2, 1 / turn_drift**2])) * WEIGHT_OF_DRIFT
        few = jax.tree.map(lambda x: x[::THINNING], new)
        starts, score = correlate(few, surface, guess, drift, turn_drift)
        found = jax.vmap(lambda start: register(few, surface, start, prior, registration))(starts)
        share = jnp.where(score > LEAST_COUNT, found.share, 0)
        best = jnp.argmax(share)
        off = found.pose - found.pose[best][None]
        other = jnp.abs(wrap_angle(off[:, 2])) > settings.turned_apart
        other = other | (jnp.sum(off[:, :2] ** 2, -1) > settings.apart**2)
        runner_up = jnp.max(jnp.where(other, share, 0))
        at = register(new, surface, found.pose[best], prior, registration)
        believed = (at.share >= settings.share_far) & (runner_up <= settings.runner_up * share[best])
        return Closure(*at, believed=believed)

    return jax.lax.cond(drift > settings.search_from, far, near, None)


def correlate(
    new: Surface,
    surface: Surface,
    guess: Float[Array, "3"],
    drift: Float[Array, ""],
    turn_drift: Float[Array, ""],
) -> tuple[Float[Array, "H 3"], Float[Array, " H"]]:
    """The poses about a guess in which most points of one surface fall on another.

    Args:
      new: the one, in its own frame.
      surface: the other, in the frame of the pose; drawn within 30 m of the origin.
      guess: the pose. m, m, rad.
      drift: standard deviation of its position, m; what is farther than `FARTHEST` is left out.
      turn_drift: of its direction, rad.

    Returns:
      `HYPOTHESES` poses, the best first, and the share of the points that falls on the surface.
    """
    grid = _drawn(surface)
    window = jnp.arange(-REACH, REACH + 1)
    turns = TURN * jnp.arange(-TURNS, TURNS + 1).astype(guess.dtype)
    moves = CELL * window.astype(guess.dtype)
    margin = SPAN + 2 * REACH
    padded = jnp.pad(grid, margin)

    def count(turn: Array) -> Array:
        points = seen_from(new, guess.at[2].add(turn)).position
        cell = jnp.clip(jnp.floor(points / CELL).astype(jnp.int32), -SPAN - REACH, SPAN + REACH)
        corner = cell + SPAN + margin - REACH
        seen = jax.vmap(lambda c: jax.lax.dynamic_slice(padded, (c[0], c[1]), (window.size, window.size)))(corner)
        return jnp.sum(jnp.where(new.valid[:, None, None], seen, 0), 0)

    score = jax.lax.map(count, turns) / jnp.maximum(jnp.sum(new.valid), 1).astype(guess.dtype)
    far = (moves[None, :, None] ** 2 + moves[None, None] ** 2) / drift**2 + (turns[:, None, None] / turn_drift) ** 2
    near: Array = score - PREFERENCE * far
    liked = jnp.where(far > FARTHEST, jnp.full_like(near, -1), near)  # of two that count alike, the nearer one

    def pick(liked: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        best = jnp.unravel_index(jnp.argmax(liked), liked.shape)
        pose = guess + jnp.stack([moves[best[1]], moves[best[2]], turns[best[0]]])
        away = (jnp.abs(window - window[best[1]])[:, None] > ONE_PEAK[0]) | (
            jnp.abs(window - window[best[2]])[None] > ONE_PEAK[0]
        )
        away = away[None] | (jnp.abs(jnp.arange(turns.size) - best[0]) > ONE_PEAK[1])[:, None, None]
        return jnp.where(away, liked, -2), (pose, score[best])

    return jax.lax.scan(pick, liked, None, length=HYPOTHESES)[1]


def _drawn(surface: Surface) -> Float[Array, "G G"]:
    """A grid in which cells with a point count 1, those beside them a half."""
    cell = jnp.floor(surface.position / CELL).astype(jnp.int32) + SPAN
    cell = jnp.where(surface.valid[:, None] & jnp.all((cell >= 0) & (cell < 2 * SPAN), -1)[:, None], cell, 2 * SPAN)
    dtype = surface.position.dtype
    grid = jnp.zeros((2 * SPAN, 2 * SPAN), dtype).at[cell[:, 0], cell[:, 1]].set(1, mode="drop")
    beside = jax.lax.reduce_window(grid, jnp.zeros((), dtype), jax.lax.max, (3, 3), (1, 1), "SAME")
    return (grid + beside) / 2
