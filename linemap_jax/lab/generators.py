"""Worlds to test in, each a pure function of numbers or of a PRNG key; sizes are static, so that they can be mapped.

Each comes with a path inside its free space, `World.path`: how it is laid stands with each of them.
"""

import dataclasses

import jax.numpy as jnp

from linemap_jax.core.settings import Number
from linemap_jax.lab.world import Kind, World, box


def room(width: Number, depth: Number, angle: Number = 0.0) -> World:
    """A plain room, width by depth, turned about its centre, which is the origin; the path is the centre alone.

    Args:
      width: along its own x axis, m.
      depth: along its own y axis, m.
      angle: of that x axis, rad.
    """
    dtype = jnp.result_type(float, *(x for x in (width, depth, angle) if not isinstance(x, float | int)))
    center = jnp.zeros(2, dtype)
    return dataclasses.replace(box(center, width, depth, angle, Kind.ROOM), path=center[None])
