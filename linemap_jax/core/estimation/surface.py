"""The surface that a scan has seen: its points, and where they make up a piece of wall, the direction of the wall."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from linemap_jax.core.frames import dot, perp, unit
from linemap_jax.core.propagation import safe_sqrt
from linemap_jax.core.state import Scan, pytree

POINTS = 181
"""Points of a scan that registration uses at most: a degree apart, if it sees half of what is around. More say little
more of the pose."""

_NEIGHBOURS = 3  # on either side
_FEWEST = 4  # points that a direction is taken from
_FLATNESS = 0.1  # largest ratio of the two principal variances of a piece of wall


@pytree
class Surface:
    """Points of a surface, in some frame."""

    position: Float[Array, "M 2"]
    """Points, m."""
    normal: Float[Array, "M 2"]
    """Unit vector, towards the scanner; of no meaning unless flat."""
    flat: Bool[Array, " M"]
    """Whether the neighbours of the point lie on one line with it."""
    valid: Bool[Array, " M"]
    """Which slots are in use."""


def surface_of_scan(scan: Scan, points: int = POINTS) -> Surface:
    """The surface that a scan has seen, in the frame of the scanner.

    The direction at a point is the principal axis of the points beside it, as far as they are near.

    Args:
      scan: `N` beams.
      points: slots for points; as many beams are used at most, evenly spread.

    Returns:
      The surface, with as many slots as beams are used.
    """
    thinned = slice(None, None, -(-scan.ranges.shape[0] // points))
    empty = (0, points - scan.ranges[thinned].shape[0])
    ranges, bearings, valid = (jnp.pad(x[thinned], empty) for x in (scan.ranges, scan.bearings, scan.valid))
    position = jnp.where(valid[:, None], ranges[:, None] * unit(bearings), 0)
    near = (0.1 + 0.05 * ranges) ** 2
    steps = []
    for k in range(-_NEIGHBOURS, _NEIGHBOURS + 1):
        step = jnp.roll(position, k, 0) - position
        beside = valid & jnp.roll(valid, k) & (dot(step, step) < near)
        steps.append((step, beside))
    step = jnp.stack([step for step, _ in steps])
    beside = jnp.stack([beside for _, beside in steps])
    count = jnp.sum(beside, 0)
    share = beside / jnp.maximum(count, 1).astype(ranges.dtype)[None]
    mean = jnp.sum(share[..., None] * step, 0)
    x, y = jnp.moveaxis(step - mean[None], -1, 0)
    xx, xy, yy = (jnp.sum(share * product, 0) for product in (x * x, x * y, y * y))
    middle, half = (xx + yy) / 2, safe_sqrt((xx - yy) ** 2 / 4 + xy**2)
    normal = perp(unit(jnp.arctan2(2 * xy, xx - yy) / 2))
    return Surface(
        position=position,
        normal=jnp.where(dot(normal, position)[:, None] > 0, -normal, normal),
        flat=valid & (count >= _FEWEST) & (middle - half < _FLATNESS * (middle + half)),
        valid=valid,
    )


def seen_from(surface: Surface, pose: Float[Array, "3"]) -> Surface:
    """The `surface` in the frame of `pose`, as it is in the frame in which the pose is given. m, m, rad."""
    turned = jnp.stack([unit(pose[2]), perp(unit(pose[2]))], -1)
    return dataclasses.replace(
        surface, position=pose[None, :2] + surface.position @ turned.T, normal=surface.normal @ turned.T
    )


def middle_of(surface: Surface, reach: float = 10.0) -> Float[Array, "2"]:
    """The mean of the points of a `surface` within `reach` metres of the scanner, m: what the scan looks at.

    Zero if there is none.
    """
    near = surface.valid & (dot(surface.position, surface.position) < reach**2)
    return jnp.sum(jnp.where(near[:, None], surface.position, 0), 0) / jnp.maximum(jnp.sum(near), 1)
