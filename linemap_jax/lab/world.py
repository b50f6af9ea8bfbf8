"""Simulated worlds: what the beams meet, and when it is there.

A world is one pytree of padded arrays, so that a batch of worlds is one pytree too. It is put together from pieces,
each a small world by itself (`wall`, `polygon`, `box`, `pole`), by `join`. A thing that moves is one that vanishes and
another one that appears. Units are metres and radians; times are scan indices.
"""

import dataclasses
import enum
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.frames import perp, unit
from linemap_jax.core.settings import Number
from linemap_jax.core.state import pytree

NEVER = np.iinfo(np.int32).max
"""The scan index at which a thing vanishes that stays."""

Time = int | Int[Array, ""]
"""A scan index."""


class Kind(enum.IntEnum):
    """What the segments of one body enclose."""

    WALL = 0
    """Nothing: an open chain, both sides are free."""
    ROOM = 1
    """Free space: the robot drives inside."""
    OBSTACLE = 2
    """Solid matter: the robot stays outside."""


@pytree
class Segments:
    """Straight pieces of surface. Those of one body stand one behind the other and form a chain."""

    ends: Float[Array, "S 2 2"]
    """Begin and end of each, m."""
    body: Int[Array, " S"]
    """Which thing they belong to, from 0 on."""
    kind: Int[Array, " S"]
    """What that thing is, a `Kind`."""
    appears: Int[Array, " S"]
    """First scan in which it is there."""
    vanishes: Int[Array, " S"]
    """First scan in which it is gone."""
    valid: Bool[Array, " S"]
    """Which slots are in use."""


@pytree
class Poles:
    """Round things, solid."""

    center: Float[Array, "C 2"]
    """Centres, m."""
    radius: Float[Array, " C"]
    """Radii, m."""
    appears: Int[Array, " C"]
    """First scan in which it is there."""
    vanishes: Int[Array, " C"]
    """First scan in which it is gone."""
    valid: Bool[Array, " C"]
    """Which slots are in use."""


@pytree
class World:
    """Segments, poles, and a path on which a robot can drive.

    The path is a row of way points in free space; it may be empty. A shorter one in a batch repeats its last point.
    """

    segments: Segments
    """Straight pieces of surface."""
    poles: Poles
    """Round things."""
    path: Float[Array, "W 2"]
    """Way points, m."""

    @property
    def dtype(self) -> Any:
        """Of its lengths."""
        return self.segments.ends.dtype


def there(things: Segments | Poles, scan_index: Time) -> Bool[Array, " K"]:
    """Which of the `things`, segments or poles, are there at the scan `scan_index`. Shape `[K]`."""
    return things.valid & (things.appears <= scan_index) & (scan_index < things.vanishes)


def polygon(
    corners: Float[Array, "K 2"], kind: Kind = Kind.OBSTACLE, *, appears: Time = 0, vanishes: Time = NEVER
) -> World:
    """A closed body with the given corners, or with `Kind.WALL` an open chain through them.

    Args:
      corners: in metres, in either sense. Shape `[K, 2]`.
      kind: what it encloses. A wall has `K - 1` segments, the others `K`.
      appears: first scan in which it is there.
      vanishes: first scan in which it is gone.

    Returns:
      A world of one body, without a path.
    """
    ends = jnp.stack([corners, jnp.roll(corners, -1, 0)], 1)
    ends = ends[:-1] if kind == Kind.WALL else ends
    count = ends.shape[0]
    return World(
        segments=Segments(
            ends=ends,
            body=jnp.zeros(count, jnp.int32),
            kind=jnp.full(count, int(kind), jnp.int32),
            appears=jnp.full(count, appears, jnp.int32),
            vanishes=jnp.full(count, vanishes, jnp.int32),
            valid=jnp.ones(count, bool),
        ),
        poles=poles(jnp.zeros((0, 2), corners.dtype), 0.0).poles,
        path=jnp.zeros((0, 2), corners.dtype),
    )


def box(
    center: Float[Array, "2"],
    width: Number,
    depth: Number,
    angle: Number = 0.0,
    *,
    kind: Kind = Kind.OBSTACLE,
    appears: Time = 0,
    vanishes: Time = NEVER,
) -> World:
    """A rectangle, turned by an angle about its centre.

    Args:
      center: in metres.
      width: along its own x axis, m.
      depth: along its own y axis, m.
      angle: of that x axis, rad.
      kind: what it encloses.
      appears: first scan in which it is there.
      vanishes: first scan in which it is gone.

    Returns:
      A world of one body, without a path.
    """
    return polygon(rectangle(center, width, depth, angle), kind, appears=appears, vanishes=vanishes)


def rectangle(center: Float[Array, "2"], width: Number, depth: Number, angle: Number = 0.0) -> Float[Array, "4 2"]:
    """The corners of a turned rectangle, counter-clockwise.

    Args:
      center: in metres.
      width: along its own x axis, m.
      depth: along its own y axis, m.
      angle: of that x axis, rad.

    Returns:
      In metres. Shape `[4, 2]`.
    """
    x = unit(jnp.asarray(angle, center.dtype))
    across, along = (jnp.asarray(size, center.dtype) / 2 for size in (width, depth))
    return jnp.stack([center + i * across * x + j * along * perp(x) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))])


def poles(
    center: Float[Array, "K 2"], radius: Number | Float[Array, " K"], *, appears: Time = 0, vanishes: Time = NEVER
) -> World:
    """Poles, which come and go together.

    Args:
      center: in metres. Shape `[K, 2]`.
      radius: of all, or of each, m.
      appears: first scan in which they are there.
      vanishes: first scan in which they are gone.

    Returns:
      A world without segments and path.
    """
    count, dtype = center.shape[0], center.dtype
    return World(
        segments=Segments(
            ends=jnp.zeros((0, 2, 2), dtype),
            body=jnp.zeros(0, jnp.int32),
            kind=jnp.zeros(0, jnp.int32),
            appears=jnp.zeros(0, jnp.int32),
            vanishes=jnp.zeros(0, jnp.int32),
            valid=jnp.zeros(0, bool),
        ),
        poles=Poles(
            center=center,
            radius=jnp.broadcast_to(jnp.asarray(radius, dtype), (count,)),
            appears=jnp.full(count, appears, jnp.int32),
            vanishes=jnp.full(count, vanishes, jnp.int32),
            valid=jnp.ones(count, bool),
        ),
        path=jnp.zeros((0, 2), dtype),
    )


def join(*parts: World) -> World:
    """One world of all the parts, in their order; bodies are numbered through, paths follow one another.

    Args:
      *parts: worlds.

    Returns:
      The world.
    """
    first_body = 0
    numbered = []
    for part in parts:
        numbered.append(dataclasses.replace(part.segments, body=part.segments.body + first_body))
        first_body = first_body + jnp.max(part.segments.body, initial=-1) + 1
    return World(
        segments=jax.tree.map(lambda *x: jnp.concatenate(x), *numbered),
        poles=jax.tree.map(lambda *x: jnp.concatenate(x), *(part.poles for part in parts)),
        path=jnp.concatenate([part.path for part in parts]),
    )


def moved(world: World, pose: Float[Array, "3"]) -> World:
    """The whole world turned about the origin, then shifted.

    Args:
      world: what was the world becomes a frame, whose pose is given.
      pose: x, y, theta. m, m, rad.

    Returns:
      The world in the frame in which the pose is given.
    """

    def move(points: Float[Array, "*s 2"]) -> Float[Array, "*s 2"]:
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        x, y = points[..., 0], points[..., 1]
        return jnp.stack([pose[0] + c * x - s * y, pose[1] + s * x + c * y], -1)

    return World(
        segments=dataclasses.replace(world.segments, ends=move(world.segments.ends)),
        poles=dataclasses.replace(world.poles, center=move(world.poles.center)),
        path=move(world.path),
    )


def pad(world: World, *, segments: int, poles: int, path: int) -> World:
    """The same world with more slots, so that worlds of several sizes can be stacked.

    Args:
      world: smaller than what is asked for.
      segments: slots for segments.
      poles: slots for poles.
      path: number of way points; the last one is repeated.

    Returns:
      The world; the slots that were added are free.

    Raises:
      ValueError: if the world does not fit.
    """
    sizes = world.segments.valid.shape[0], world.poles.valid.shape[0], world.path.shape[0]
    more = [wanted - size for wanted, size in zip((segments, poles, path), sizes, strict=True)]
    if min(more) < 0 or (path and not sizes[2]):
        raise ValueError(f"a world of {sizes} segments, poles and way points cannot have {(segments, poles, path)}")

    def longer(count: int) -> Any:
        return lambda x: jnp.pad(x, [(0, count)] + [(0, 0)] * (x.ndim - 1))

    return World(
        segments=jax.tree.map(longer(more[0]), world.segments),
        poles=jax.tree.map(longer(more[1]), world.poles),
        path=jnp.pad(world.path, [(0, more[2]), (0, 0)], mode="edge") if path else world.path,
    )


def world_from_arrays(arrays: Mapping[str, Any]) -> World:
    """A world from the `arrays` of its fields, such as `linemap_jax.io.worlds.read_world` gives them."""
    fields = jax.tree.map(jnp.asarray, dict(arrays))
    return World(segments=Segments(**fields["segments"]), poles=Poles(**fields["poles"]), path=fields["path"])


def arrays_from_world(world: World) -> dict[str, Any]:
    """The arrays of a `world`, by field: the inverse of `world_from_arrays`, on the host."""
    return jax.tree.map(np.asarray, dataclasses.asdict(world))
