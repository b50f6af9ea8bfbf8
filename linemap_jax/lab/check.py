"""Whether a world, and a drive through it, is possible. On the host, in NumPy and float64, for one world at a time."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from linemap_jax.lab.world import Kind, Poles, Segments, World

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_CHUNK = 1 << 20  # pairs of a place and a surface looked at together


class WorldError(ValueError):
    """A world, or a drive through it, is not possible. The message is one sentence."""


def check(world: World, poses: ArrayLike | None = None, *, clearance: float = 0.0) -> None:
    """Refuse what cannot be: outlines that cross themselves, a robot inside of things.

    Bodies may touch and overlap one another, as a cupboard and a wall do.

    Args:
      world: only what is valid in it counts.
      poses: of the robot, the first one at scan index 0. Shape `[T, 3]`. The first point of the path unless given,
        since a path does not say when the robot is where.
      clearance: how near the robot may come to a surface, m.

    Raises:
      WorldError: if a number is not finite, a segment has no length, a pole no radius, or a thing vanishes before it
        appears; if the segments of a body are not of one kind and time, are no chain, or, for a room or an obstacle, no
        closed one that does not meet itself; if the robot stands in an obstacle or a pole, outside of all rooms
        where there are any, too near to a surface, or drives through one.
    """
    segments = _valid(world.segments)
    poles = _valid(world.poles)
    for which in np.unique(segments["body"]):
        _check_body({name: column[segments["body"] == which] for name, column in segments.items()})
    _check_poles(poles)
    path = np.asarray(world.path, float)
    places = path[:1] if poses is None else np.asarray(poses, float)
    if not (np.isfinite(path).all() and np.isfinite(places).all()):
        raise WorldError("a way point or pose holds a number that is not finite")
    step = max(_CHUNK // (len(segments["body"]) + len(poles["radius"]) + 1), 2)
    for first in range(0, len(places), step - 1):  # each piece begins where the one before ended
        _check_drive(segments, poles, places[first : first + step, :2], first, clearance)


def _valid(things: Segments | Poles) -> dict[str, NDArray[Any]]:
    """The columns of what is valid; lengths in float64."""
    columns = {name: np.asarray(column) for name, column in vars(things).items()}
    valid = columns.pop("valid")
    return {name: x[valid].astype(float) if x.dtype.kind == "f" else x[valid] for name, x in columns.items()}


def _name(segments: dict[str, NDArray[Any]], i: Any) -> str:
    return f"the {Kind(int(segments['kind'][i])).name.lower()} that is body {int(segments['body'][i])}"


def _check_body(body: dict[str, NDArray[Any]]) -> None:
    """Refuse a body whose segments do not make one."""
    name, ends = _name(body, 0), body["ends"]
    for column, said in (("kind", "kinds"), ("appears", "times"), ("vanishes", "times")):
        if (body[column] != body[column][0]).any():
            raise WorldError(f"{name} has segments of different {said}")
    if not np.isfinite(ends).all():
        raise WorldError(f"{name} holds a number that is not finite")
    if body["appears"][0] >= body["vanishes"][0]:
        raise WorldError(f"{name} vanishes before it appears")
    if (ends[:, 0] == ends[:, 1]).all(-1).any():
        raise WorldError(f"{name} has a side without a length")
    if (ends[:-1, 1] != ends[1:, 0]).any():
        raise WorldError(f"{name} is not one chain of segments")
    if body["kind"][0] == Kind.WALL:
        return
    if len(ends) < 3 or (ends[-1, 1] != ends[0, 0]).any():
        raise WorldError(f"{name} is not closed")
    meets = _meet(ends[:, None], ends[None])
    # Neighbours share a corner; they must not fold back on one another.
    along, following = ends[:, 1] - ends[:, 0], np.roll(ends[:, 1] - ends[:, 0], -1, 0)
    folds = (_cross(along, following) == 0) & ((along * following).sum(-1) < 0)
    apart = np.abs(np.subtract.outer(np.arange(len(ends)), np.arange(len(ends))))
    meets &= (apart > 1) & (apart < len(ends) - 1)
    if meets.any() or folds.any():
        raise WorldError(f"the outline of {name} meets itself")


def _check_poles(poles: dict[str, NDArray[Any]]) -> None:
    numbers = np.concatenate([poles["center"], poles["radius"][:, None]], 1)
    for bad, said in (
        (~np.isfinite(numbers).all(1), "holds a number that is not finite"),
        (poles["radius"] <= 0, "has no radius"),
        (poles["appears"] >= poles["vanishes"], "vanishes before it appears"),
    ):
        if bad.any():
            raise WorldError(f"pole {int(np.argmax(bad))} {said}")


def _check_drive(
    segments: dict[str, NDArray[Any]], poles: dict[str, NDArray[Any]], places: Floats, first: int, clearance: float
) -> None:
    """Refuse places `[T, 2]`, the first of them at scan index `first`, that a robot cannot be at or drive between."""
    index = first + np.arange(len(places))[:, None]
    shown = (segments["appears"] <= index) & (index < segments["vanishes"])  # [T, S]
    poles_shown = (poles["appears"] <= index) & (index < poles["vanishes"])  # [T, C]

    in_room, any_room = np.zeros(len(places), bool), np.zeros(len(places), bool)
    for which in np.unique(segments["body"][segments["kind"] != Kind.WALL]):
        mine = np.flatnonzero(segments["body"] == which)
        inside, there = _inside(places, segments["ends"][mine]), shown[:, mine[0]]
        if segments["kind"][mine[0]] == Kind.ROOM:
            in_room |= inside & there
            any_room |= there
        else:
            _refuse(inside & there, first, lambda _, i=mine[0]: f"stands inside {_name(segments, i)}")
    _refuse(any_room & ~in_room, first, lambda _: "stands outside of all rooms")

    to_pole = np.linalg.norm(places[:, None] - poles["center"][None], axis=-1) - poles["radius"][None]
    _refuse(poles_shown & (to_pole <= 0), first, lambda j: f"stands inside pole {j}")
    moves = np.stack([places[:-1], places[1:]], 1)
    through = _meet(moves[:, None], segments["ends"][None]) & shown[:-1] & shown[1:]
    _refuse(through, first + 1, lambda i: f"has driven through {_name(segments, i)}")
    past = _distance(poles["center"][None], moves[:, None]) <= poles["radius"][None]
    _refuse(past & poles_shown[:-1] & poles_shown[1:], first + 1, lambda j: f"has driven through pole {j}")

    if clearance > 0:
        to_segment = _distance(places[:, None], segments["ends"][None])
        near = f"comes nearer than {clearance:g} m to"
        _refuse(shown & (to_segment < clearance), first, lambda i: f"{near} {_name(segments, i)}")
        _refuse(poles_shown & (to_pole < clearance), first, lambda j: f"{near} pole {j}")


def _refuse(bad: Bools, first: int, said: Any) -> None:
    """Raise for the first row that is bad, `said` of the first column that is."""
    if bad.any():
        at, *which = np.argwhere(bad)[0].tolist()
        raise WorldError(f"at scan {first + at} the robot {said(*which or [0])}")


def _cross(a: Floats, b: Floats) -> Floats:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _inside(points: Floats, ends: Floats) -> Bools:
    """Which points lie inside a closed chain: a ray to the east meets it an odd number of times. Shape `[T]`."""
    begin, end = ends[None, :, 0] - points[:, None], ends[None, :, 1] - points[:, None]
    spans = (begin[..., 1] >= 0) != (end[..., 1] >= 0)
    upwards = end[..., 1] > begin[..., 1]
    return (spans & ((_cross(begin, end) > 0) == upwards)).sum(1) % 2 == 1


def _meet(a: Floats, b: Floats) -> Bools:
    """Which segments, `[..., 2, 2]`, have a point in common."""

    def sides(of: Floats, points: Floats) -> NDArray[Any]:
        line = (of[..., 1, :] - of[..., 0, :])[..., None, :]
        return np.sign(_cross(line, points - of[..., None, 0, :]))

    ab, ba = sides(a, b), sides(b, a)
    boxes = ((a.max(-2) >= b.min(-2)) & (b.max(-2) >= a.min(-2))).all(-1)
    return boxes & (ab[..., 0] * ab[..., 1] <= 0) & (ba[..., 0] * ba[..., 1] <= 0)


def _distance(points: Floats, ends: Floats) -> Floats:
    """From points `[..., 2]` to segments `[..., 2, 2]`."""
    along, to = ends[..., 1, :] - ends[..., 0, :], points - ends[..., 0, :]
    square = (along * along).sum(-1)
    share = np.clip((to * along).sum(-1) / np.where(square > 0, square, 1), 0, 1)
    return np.linalg.norm(to - share[..., None] * along, axis=-1)
