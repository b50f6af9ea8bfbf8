"""Worlds to test in, each a pure function of numbers or of a PRNG key; sizes are static, so that they can be mapped.

Each comes with a path inside its free space, `World.path`; how it is laid stands with each of them. All are held
against `world.check` in the tests.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from linemap_jax.core.frames import unit
from linemap_jax.core.settings import Number
from linemap_jax.lab.world import Kind, World, box, join, moved, poles, polygon, rectangle

_BUMPS = 4  # waves around a free room: it looks neither round nor torn
_WALL = 0.12  # m, thickness of inner walls


def room(width: Number, depth: Number, angle: Number = 0.0, *, dtype: Any = None) -> World:
    """A plain room, turned about its centre, which is the origin; the path is the centre alone.

    Args:
      width: along its own x axis, m.
      depth: along its own y axis, m.
      angle: of that x axis, rad.
      dtype: of the world; unless given that of the numbers, or jax's default.

    Returns:
      A world of four segments.
    """
    if dtype is None:
        dtype = jnp.result_type(float, *(x for x in (width, depth, angle) if not isinstance(x, float | int)))
    center = jnp.zeros(2, dtype)
    return dataclasses.replace(box(center, width, depth, angle, kind=Kind.ROOM), path=center[None])


def free_room(key: Array, *, vertices: int, size: Number = 5.0, dtype: Any = None) -> World:
    """A room with walls in any direction: a simple polygon, since all of it is seen from the origin.

    Its corners stand at growing angles around the origin, never half a turn apart. The path is a hexagon around the
    origin, half as far away as the nearest wall.

    Args:
      key: decides everything.
      vertices: number of corners and of walls, 3 or more. Few give corners of all kinds, many a wavy wall.
      size: typical distance of the walls from the origin, m.
      dtype: of the world; jax's default unless given.

    Returns:
      A world of as many segments.

    Raises:
      ValueError: if `vertices` is less than 3.
    """
    if vertices < 3:
        raise ValueError(f"a room has three corners at least, not {vertices}")
    dtype = _float(dtype)
    draws = jax.random.uniform(key, (2 * (vertices + _BUMPS),), dtype, -1.0, 1.0)
    off, rough, height, phase = jnp.split(draws, np.cumsum([vertices, vertices, _BUMPS]))
    angle = 2 * jnp.pi / vertices * (jnp.arange(vertices) + 0.15 * off)
    waves = jnp.arange(2, 2 + _BUMPS)[:, None] * angle[None] + jnp.pi * phase[:, None]
    # With many corners, single ones stick out less: else every wall would point at the origin.
    log_size = jnp.sum(0.15 * height[:, None] * jnp.cos(waves), 0) + 0.3 * min(1.0, 12 / vertices) * rough
    corners = (size * jnp.exp(log_size))[:, None] * unit(angle)
    reach = _distance_to_origin(corners) / 2
    return dataclasses.replace(polygon(corners, Kind.ROOM), path=reach * unit(jnp.arange(7, dtype=dtype) * jnp.pi / 3))


def rectilinear_room(
    key: Array, *, vertices: int, column: Number = 1.5, angle: Number | None = None, dtype: Any = None
) -> World:
    """A room with walls in two directions only: a hall with niches and buttresses on both long sides.

    Both sides are steps over one axis, at least 0.8 m above it or below it, so that the outline never meets itself. No
    step is smaller than 0.25 m. The path runs along the axis, from 0.4 m after one end to 0.4 m before the other.

    Args:
      key: decides everything else.
      vertices: number of corners and of walls, an even number from 4 on.
      column: typical length of a wall along the axis, m.
      angle: of the axis, rad; any one unless given.
      dtype: of the world; jax's default unless given.

    Returns:
      A world of as many segments.

    Raises:
      ValueError: if `vertices` is odd or less than 4.
    """
    if vertices < 4 or vertices % 2:
        raise ValueError(f"a room of right angles has an even number of corners from 4 on, not {vertices}")
    dtype = _float(dtype)
    above = (vertices + 2) // 4
    columns = (above, vertices // 2 - above)
    length = column * above
    draws = jax.random.uniform(key, (2 * sum(columns) + 1,), dtype)

    def side(draws: Float[Array, " D"]) -> Float[Array, "K 2"]:
        """The two ends of each wall along the axis, in the sense of the axis; height as distance from it."""
        width, step = jnp.split(draws, 2)
        at = jnp.concatenate([jnp.zeros(1, dtype), jnp.cumsum(0.5 + width)])
        at = at / at[-1] * length
        # Steps around a ring of 1.6 m, never nearer than 0.25 m to where they came from.
        height = 0.8 + jnp.cumsum(0.25 + 1.1 * step) % 1.6
        return jnp.stack([jnp.stack([at[:-1], height], -1), jnp.stack([at[1:], height], -1)], 1).reshape(-1, 2)

    upper, lower = side(draws[: 2 * columns[0]]), side(draws[2 * columns[0] : -1])
    corners = jnp.concatenate([lower * jnp.asarray([[1, -1]], dtype), upper[::-1]])
    ends = jnp.stack([jnp.asarray(x, dtype) for x in (0.4, length - 0.4)])
    path = jnp.stack([ends, jnp.zeros_like(ends)], -1)
    world = dataclasses.replace(polygon(corners, Kind.ROOM), path=path)
    turn = 2 * jnp.pi * draws[-1] if angle is None else jnp.asarray(angle, dtype)
    return moved(world, jnp.zeros(3, dtype).at[2].set(turn))


def corridor(key: Array, *, rooms: int = 3, dtype: Any = None) -> World:
    """A corridor with rooms on both sides, each behind a door opening; all of it is one outline.

    The corridor runs along the x axis, from 0 on. The path goes through the doors on the left, one after the other,
    turns around in each room, and comes back through those on the right.

    Args:
      key: decides the width of the corridor, and size, door and place of each room.
      rooms: on each side.
      dtype: of the world; jax's default unless given.

    Returns:
      The world.
    """
    dtype = _float(dtype)
    length = 4.5 * rooms
    draws = jax.random.uniform(key, (8 * rooms + 1,), dtype)
    half = 0.9 + 0.5 * draws[-1]

    def side(draws: Float[Array, "4 R"]) -> tuple[Float[Array, "K 2"], Float[Array, "V 2"]]:
        """Outline and way points of the rooms of one side, in the sense of the axis, as seen with that side up."""
        share = 0.7 + 0.6 * draws[0]
        share = share / jnp.sum(share) * (length - (rooms - 1) * _WALL)
        left = jnp.cumsum(share + _WALL) - share - _WALL
        right = left + share
        depth = 3.0 + 2.0 * draws[1]
        opening = 0.9 + 0.3 * draws[2]
        door = left + 0.2 + opening / 2 + draws[3] * (share - opening - 0.4)
        axis, near, inner = (jnp.full_like(door, y) for y in (0.0, half, half + _WALL))
        far = inner + depth
        first, second = door - opening / 2, door + opening / 2
        outline = [(first, near), (first, inner), (left, inner), (left, far)]
        outline += [(right, far), (right, inner), (second, inner), (second, near)]
        entry, back = inner + 0.2 * depth, inner + 0.65 * depth
        turn = [(left + 0.3 * share, back), (left + 0.7 * share, back)]
        path = [(door, axis), (door, entry), *turn, (door, entry), (door, axis)]
        in_order = [jnp.stack([jnp.stack(p, -1) for p in points], 1).reshape(-1, 2) for points in (outline, path)]
        return in_order[0], in_order[1]

    (upper, up), (lower, down) = (side(of_side) for of_side in draws[:-1].reshape(2, 4, rooms))
    mirror = jnp.asarray([[1, -1]], dtype)
    aside = jnp.stack([jnp.zeros_like(half), half])[None] * jnp.asarray([[1, -1], [1, 1]], dtype)
    end = aside + jnp.asarray([[length, 0.0]], dtype)
    corners = jnp.concatenate([lower * mirror, end, upper[::-1], aside[::-1]])
    gates = jnp.asarray([[0.5, 0.0], [length - 0.5, 0.0], [0.5, 0.0]], dtype)
    path = jnp.concatenate([gates[:1], up, gates[1:2], down[::-1] * mirror, gates[2:]])
    return dataclasses.replace(polygon(corners, Kind.ROOM), path=path)


def ring(key: Array, *, boxes: int = 14, dtype: Any = None) -> World:
    """A corridor that closes on itself around a block, 4 m wide, with boxes along its walls.

    The path goes round anticlockwise, a lap and two thirds: 100 m.

    Args:
      key: decides the places, sizes and directions of the boxes.
      boxes: how many.
      dtype: of the world; jax's default unless given.

    Returns:
      The world.
    """
    dtype = _float(dtype)
    outer, inner = jnp.asarray([24.0, 14.0], dtype), jnp.asarray([16.0, 6.0], dtype)
    center = jnp.zeros(2, dtype)
    walls = [box(center, *outer, kind=Kind.ROOM), box(center, *inner)]
    of_place, of_size = jax.random.split(key)
    along = jax.random.uniform(of_place, (boxes,), dtype, -0.4, 0.4)
    sizes = jax.random.uniform(of_size, (boxes, 3), dtype)
    for i in range(boxes):
        long = i % 2 == 0
        side = 1 if i % 4 < 2 else -1
        # Within a metre of the outer wall, clear of the path, which is two metres from it.
        place = jnp.stack([along[i] * outer[0], side * (outer[1] / 2 - 0.6)])
        if not long:
            place = jnp.stack([side * (outer[0] / 2 - 0.6), along[i] * inner[1]])
        width, depth = 0.4 + 0.5 * sizes[i, 0], 0.4 + 0.5 * sizes[i, 1]
        walls.append(box(place, width, depth, sizes[i, 2] - 0.5))
    way = jnp.asarray([[0, -5], [10, -5], [10, 5], [-10, 5], [-10, -5], [10, -5], [10, 5], [-10, 5]], dtype)
    return dataclasses.replace(join(*walls), path=way)


def changing_room(key: Array, *, scans: int, dtype: Any = None) -> World:
    """A room of 8 m by 6 m in which things come and go: the time is counted for a drive of so many scans.

    One box stays, one appears, one moves, and one vanishes, each at some time between a quarter and three quarters of
    the drive; a pole stands where it is. The path goes once around the middle of the room, which stays free.

    Args:
      key: decides places, sizes and times.
      scans: of the drive.
      dtype: of the world; jax's default unless given.

    Returns:
      The world.
    """
    dtype = _float(dtype)
    of_order, of_rest = jax.random.split(key)
    cells = jnp.asarray([[x, y] for y in (-2.1, 2.1) for x in (-2.7, 0.0, 2.7)], dtype)
    draws = jax.random.uniform(of_rest, (28,), dtype)
    shift, size, angle, when = jnp.split(draws, np.cumsum([12, 8, 5]))
    center = jax.random.permutation(of_order, cells) + (2 * shift.reshape(6, 2) - 1) * jnp.asarray([[0.35, 0.2]], dtype)
    size = 0.4 + 0.5 * size.reshape(4, 2)
    angle = 2 * jnp.pi * angle
    when = (scans * (0.25 + 0.5 * when)).astype(jnp.int32)

    def put(cell: int, which: int, **times: Any) -> World:
        return box(center[cell], size[which, 0], size[which, 1], angle[cell], **times)

    hall = dataclasses.replace(
        polygon(rectangle(jnp.zeros(2, dtype), 8.0, 6.0), Kind.ROOM),
        path=jnp.asarray([[-2.0, -0.7], [2.0, -0.7], [2.0, 0.7], [-2.0, 0.7], [-2.0, -0.7]], dtype),
    )
    things = [put(0, 0), put(1, 1, appears=when[0]), put(2, 2, vanishes=when[1]), put(3, 2, appears=when[1])]
    return join(hall, *things, put(4, 3, vanishes=when[2]), poles(center[5:], 0.1))


def laboratory(key: Array, *, scans: int, jitter: Number = 0.1, dtype: Any = None) -> World:
    """A cluttered laboratory of 18 m by 12 m and its corridor: the kind of world of the paper's figure 6.

    73 segments and 24 poles: walls, a partition, two doors, cupboards, benches, desks, the legs of tables, stools and
    columns. Halfway through a drive of so many scans, a box that stood in the way is carried off, and the west door,
    closed until then, is opened. (0, 0) is the south-west corner of the laboratory; x points east. The path goes all
    around, out of one door and, at three quarters of it, back in by the other and over the place of the box: without
    the change it would not be free.

    Args:
      key: of where exactly the furniture stands.
      scans: of the drive; of one scan, the first, box and door are as they were before.
      jitter: furniture is off its place by up to this, m, and turned by up to half as many radians; up to 0.1 the path
        stays free. 0: all of it stands where it is drawn below.
      dtype: of the world; jax's default unless given.

    Returns:
      The world.

    Raises:
      ValueError: if there is no scan.
    """
    if scans < 1:
        raise ValueError(f"a drive has one scan at least, not {scans}")
    change = (scans + 1) // 2  # never before the first scan: what vanishes must have been there
    dtype = _float(dtype)
    furniture = len(_BOXES) + len(_DESKS) + len(_TABLES) + len(_COLUMNS) + 1
    off = jitter * jax.random.uniform(key, (furniture, 3), dtype, -1.0, 1.0)
    off = iter(jnp.concatenate([off[:, :2], off[:, 2:] / 2], -1))

    def placed(points: Any) -> Float[Array, "K 2"]:
        """The points of one piece of furniture, turned and shifted a little."""
        points, here = jnp.asarray(points, dtype), next(off)
        middle = jnp.mean(points, 0, keepdims=True)
        c, s = jnp.cos(here[2]), jnp.sin(here[2])
        x, y = jnp.moveaxis(points - middle, -1, 0)
        return middle + here[None, :2] + jnp.stack([c * x - s * y, s * x + c * y], -1)

    def four(x: float, y: float, width: float, depth: float, degrees: float) -> Float[Array, "4 2"]:
        return placed(rectangle(jnp.asarray([x, y], dtype), width, depth, np.radians(degrees)))

    hinge = np.array(_DOOR_HINGE)
    shut, open_ = (
        jnp.asarray(np.stack([hinge, hinge + _DOOR_WIDTH * np.array([np.cos(a), np.sin(a)])]), dtype)
        for a in np.radians(_DOOR_DEGREES)
    )
    legs = [four(*table) for table in _TABLES]
    columns = [placed([column[:2]]) for column in _COLUMNS]
    radius = [_LEG] * 4 * len(_TABLES) + [column[2] for column in _COLUMNS]
    return join(
        dataclasses.replace(
            polygon(jnp.asarray(_OUTLINE, dtype), Kind.WALL),
            path=jnp.asarray(_WAY_POINTS, dtype),
        ),
        polygon(jnp.asarray(_BETWEEN_DOORS, dtype)),
        polygon(jnp.asarray(_EAST_DOOR, dtype), Kind.WALL),
        polygon(shut, Kind.WALL, vanishes=change),
        polygon(open_, Kind.WALL, appears=change),
        *(polygon(four(*box)) for box in _BOXES),
        *(polygon(placed(corners)) for corners in _DESKS),
        polygon(four(*_BOX_IN_THE_WAY), vanishes=change),
        poles(jnp.concatenate([*legs, *columns]), jnp.asarray(radius, dtype)),
    )


_OUTLINE = (  # from the east end of the corridor, which is a glass door that no beam sees, all around
    *((21.0, -0.12), (15.1, -0.12), (15.1, 0.0), (18.0, 0.0), (18.0, 12.0)),
    *((9.06, 12.0), (9.06, 8.4), (8.94, 8.4), (8.94, 12.0)),  # a partition that juts out
    *((0.0, 12.0), (0.0, 0.0), (2.5, 0.0), (2.5, -0.12), (-3.0, -0.12), (-3.0, -2.52)),
    *((5.4, -2.52), (5.4, -2.97), (6.9, -2.97), (6.9, -2.52), (21.0, -2.52)),  # a niche in the corridor
)
_BETWEEN_DOORS = ((3.6, -0.12), (14.0, -0.12), (14.0, 0.0), (3.6, 0.0))
_EAST_DOOR = ((15.1, 0.0), (15.12, 1.04))  # it stands open
_DOOR_HINGE, _DOOR_WIDTH, _DOOR_DEGREES = (2.5, -0.06), 1.1, (0.0, 100.0)  # west; opens into the laboratory
_BOXES = (  # x y of the centre, width, depth, degrees
    (0.3, 4.2, 0.6, 2.2, 0.0),  # cupboard at the west wall
    (6.4, 11.75, 2.0, 0.5, 0.0),  # shelves at the north wall
    (4.0, 11.8, 0.5, 0.4, 0.0),  # pillar
    (13.6, 11.8, 0.5, 0.4, 0.0),  # pillar
    (17.6, 6.0, 0.8, 3.6, 0.0),  # bench at the east wall
    (5.3, 4.6, 1.7, 0.8, 12.0),  # desk
    (15.2, 9.4, 1.4, 0.6, 32.0),  # cabinet
    (10.5, -2.3, 1.4, 0.44, 0.0),  # locker in the corridor
)
_BOX_IN_THE_WAY = (9.3, 4.3, 0.9, 0.6, -20.0)
_DESKS = (
    ((11.6, 4.0), (13.4, 3.9), (14.0, 5.2), (12.9, 6.3), (11.5, 5.6)),  # machine
    ((2.9, 7.6), (4.7, 8.0), (4.6, 8.6), (3.4, 8.35), (3.15, 9.4), (2.55, 9.3)),  # desk with a return
)
_TABLES = (  # x y of the centre, width, depth between the legs, degrees; the scanner sees four legs
    (6.6, 6.8, 1.5, 0.8, -8.0),
    (12.0, 9.2, 1.6, 0.9, 0.0),
    (16.4, 2.4, 0.9, 1.6, 4.0),
    (7.6, 1.2, 1.5, 0.8, 3.0),
)
_LEG = 0.03  # m, radius
_COLUMNS = (  # x, y, radius
    *((6.0, 9.2, 0.10), (11.2, 7.9, 0.10), (9.6, 1.0, 0.10)),  # columns
    *((2.0, 6.2, 0.05), (4.2, 2.9, 0.05), (10.6, 8.8, 0.04), (14.9, 6.6, 0.06)),  # stools and stands
    (0.6, -0.5, 0.06),  # hat stand in the corridor
)
_WAY_POINTS = (
    *((1.4, 1.2), (1.5, 3.0), (1.3, 6.4), (1.4, 10.4), (4.6, 10.4), (7.6, 10.2), (8.2, 7.4), (10.0, 7.4)),
    *((10.2, 10.6), (13.6, 10.5), (16.8, 10.9), (16.5, 8.4), (15.4, 7.6), (13.2, 7.6), (10.4, 6.2), (7.9, 5.2)),
    *((8.2, 2.6), (11.0, 2.4), (14.6, 2.6), (14.5, -1.3), (17.4, -0.75), (18.5, -1.32), (17.4, -1.9), (14.0, -1.5)),
    *((9.5, -1.1), (6.0, -1.6), (3.0, -1.4), (3.1, 1.8), (6.4, 2.6), (9.8, 4.4), (10.2, 6.6), (8.8, 7.5)),
    *((8.1, 5.8), (6.2, 5.8), (2.4, 5.6)),
)


def _float(dtype: Any) -> Any:
    return jnp.asarray(0.0).dtype if dtype is None else jax.dtypes.canonicalize_dtype(dtype)


def _distance_to_origin(corners: Float[Array, "K 2"]) -> Float[Array, ""]:
    """Distance from the origin to the nearest side of a polygon, m."""
    step = jnp.roll(corners, -1, 0) - corners
    share = jnp.clip(-jnp.sum(corners * step, -1) / jnp.sum(step * step, -1), 0, 1)[:, None]
    foot = corners + share * step
    return jnp.min(jnp.sqrt(jnp.sum(foot * foot, -1)))
