"""The worlds of the commands: made by name, or read from a file."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from jax import Array

    from linemap_jax.lab.world import World

WorldKind = Literal["laboratory", "corridor", "room", "free_room", "rectilinear_room", "changing_room"]
"""What `--kind` offers."""


def made_world(kind: WorldKind, key: "Array", *, scans: int) -> "World":
    """A world of this kind. Where things change, they do so within a drive of so many scans."""
    import jax.numpy as jnp

    from linemap_jax.lab import generators

    if kind == "laboratory":
        return generators.laboratory(key, scans=scans)
    if kind == "changing_room":
        return generators.changing_room(key, scans=scans)
    if kind == "corridor":
        return generators.corridor(key)
    if kind == "free_room":
        return generators.free_room(key, vertices=12)
    if kind == "rectilinear_room":
        return generators.rectilinear_room(key, vertices=24)
    around = jnp.asarray([[-2.0, -1.0], [2.0, -1.0], [2.0, 1.0], [-2.0, 1.0], [-2.0, -1.0]])
    return dataclasses.replace(generators.room(8.0, 6.0), path=around)


def world_from_file(path: Path) -> "World":
    """The world of a GeoJSON file, in float64."""
    from linemap_jax.io.worlds import read_world
    from linemap_jax.lab.world import world_from_arrays

    return world_from_arrays(read_world(path, dtype="float64"))
