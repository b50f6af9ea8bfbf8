"""Exact ranges: where a beam meets a world first. No grid; every beam is held against every segment and pole."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from linemap_jax.core.frames import dot, perp
from linemap_jax.core.state import pytree
from linemap_jax.lab.world import Poles, Segments, Time, World, there

NOTHING = -1
"""In `Hits`: the beam meets nothing."""


@pytree
class Hits:
    """What beams meet."""

    ranges: Float[Array, " N"]  # m, infinity where a beam meets nothing
    thing: Int[Array, " N"]  # segment `i` is `i`, pole `j` is `S + j`, nothing is `NOTHING`


def cast(world: World, origin: Float[Array, "2"], directions: Float[Array, "N 2"], *, scan_index: Time = 0) -> Hits:
    """The exact range along each beam, and what it meets.

    A beam meets a segment if the end points lie on different sides of it; one that lies on it counts for the left. No
    beam slips through where two segments share an end point, and none meets a segment that it runs along.

    Args:
      world: `S` segments and `C` poles.
      origin: where the beams start, m.
      directions: unit vectors. Shape `[N, 2]`.
      scan_index: when.
    """
    to_segment, segment = _nearest(_to_segments(world.segments, origin, directions, scan_index))
    to_pole, pole = _nearest(_to_poles(world.poles, origin, directions, scan_index))
    ranges = jnp.minimum(to_segment, to_pole)
    thing = jnp.where(to_pole < to_segment, world.segments.valid.shape[0] + pole, segment)
    return Hits(ranges=ranges, thing=jnp.where(jnp.isfinite(ranges), thing, NOTHING))


def _nearest(ranges: Float[Array, "N K"]) -> tuple[Float[Array, " N"], Int[Array, " N"]]:
    """The shortest range of each beam, and to which of the things."""
    if ranges.shape[-1] == 0:
        return jnp.full(ranges.shape[:1], jnp.inf, ranges.dtype), jnp.zeros(ranges.shape[:1], jnp.int32)
    return jnp.min(ranges, -1), jnp.argmin(ranges, -1).astype(jnp.int32)


def _to_segments(
    segments: Segments, origin: Float[Array, "2"], directions: Float[Array, "N 2"], scan_index: Time
) -> Float[Array, "N S"]:
    """The range along each beam to each segment, infinity where they do not meet."""
    begin, end = segments.ends[:, 0] - origin[None], segments.ends[:, 1] - origin[None]
    # How far to the left of each beam the two end points lie, m. Of shared end points both are equal to the last bit.
    left = perp(directions)[:, None]
    left_begin, left_end = dot(left, begin[None]), dot(left, end[None])
    meets = ((left_begin >= 0) != (left_end >= 0)) & there(segments, scan_index)[None]
    share = left_begin / jnp.where(meets, left_begin - left_end, 1)
    ahead = dot(directions[:, None], begin[None])
    ranges = ahead + share * (dot(directions[:, None], end[None]) - ahead)
    return jnp.where(meets & (ranges > 0), ranges, jnp.inf)


def _to_poles(
    poles: Poles, origin: Float[Array, "2"], directions: Float[Array, "N 2"], scan_index: Time
) -> Float[Array, "N C"]:
    """The range along each beam to each pole, infinity where they do not meet; from inside, to its rim."""
    center = (poles.center - origin[None])[None]
    across = dot(perp(directions)[:, None], center)
    ahead = dot(directions[:, None], center)
    radius = poles.radius[None]
    square = (radius - across) * (radius + across)  # of half the chord; written so that large numbers do not cancel
    meets = (square > 0) & there(poles, scan_index)[None]
    half_chord = jnp.sqrt(jnp.where(meets, square, 1))
    ranges = jnp.where(ahead > half_chord, ahead - half_chord, ahead + half_chord)
    return jnp.where(meets & (ranges > 0), ranges, jnp.inf)
