"""What cannot be is refused, in one sentence that says what and where; what can be is not."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from linemap_jax.lab.check import WorldError, check
from linemap_jax.lab.generators import room
from linemap_jax.lab.world import Kind, World, box, join, pad, poles, polygon

ORIGIN = jnp.zeros(2)
BOX = box(jnp.array([2.0, 0.0]), 1.0, 1.0)
HALL = room(8.0, 6.0)


def outline(*corners: tuple[float, float], kind: Kind = Kind.OBSTACLE, **times: Any) -> World:
    return polygon(jnp.array(corners, float), kind, **times)


def ends(world: World, value: Any) -> World:
    return dataclasses.replace(world, segments=dataclasses.replace(world.segments, ends=value))


IMPOSSIBLE = {
    "crosses": (outline((0, 0), (2, 2), (2, 0), (0, 2)), "the outline of the obstacle that is body 0 meets itself"),
    "touches": (outline((0, 0), (4, 0), (4, 2), (2, 0), (0, 2), kind=Kind.ROOM), "the room that is body 0 meets"),
    "folds": (outline((0, 0), (4, 0), (2, 0), (2, 3)), "meets itself"),
    "doubles": (outline((0, 0), (4, 0), (4, 2), (0, 0), (4, 0), (4, 2)), "meets itself"),
    "two corners": (outline((0, 0), (4, 0)), "the obstacle that is body 0 is not closed"),
    "no length": (outline((0, 0), (4, 0), (4, 0), (2, 3)), "has a side without a length"),
    "torn": (ends(BOX, BOX.segments.ends.at[2, 0, 0].add(1e-3)), "is not one chain of segments"),
    "NaN": (ends(BOX, BOX.segments.ends.at[2, 0, 0].set(jnp.nan)), "holds a number that is not finite"),
    "open": (join(HALL, ends(BOX, BOX.segments.ends.at[3, 1, 0].add(1e-3))), "the obstacle that is body 1 is not cl"),
    "time": (box(jnp.ones(2), 1, 1, appears=4, vanishes=4), "body 0 vanishes before it appears"),
    "radius": (poles(jnp.ones((2, 2)), jnp.array([0.1, 0.0])), "pole 1 has no radius"),
    "pole nowhere": (poles(jnp.array([[1.0, jnp.inf]]), 0.1), "pole 0 holds a number that is not finite"),
    "pole in no time": (poles(jnp.ones((1, 2)), 0.1, appears=3, vanishes=2), "pole 0 vanishes before it appears"),
    "path": (dataclasses.replace(HALL, path=jnp.array([[jnp.nan, 0.0]])), "not finite"),
    "start in box": (join(HALL, box(ORIGIN, 1, 1)), "at scan 0 the robot stands inside the obstacle that is body 1"),
    "start in pole": (join(HALL, poles(jnp.zeros((1, 2)), 0.1)), "at scan 0 the robot stands inside pole 0"),
    "start outside": (dataclasses.replace(HALL, path=jnp.array([[9.0, 0.0]])), "stands outside of all rooms"),
}


@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_what_cannot_be(what: str) -> None:
    world, said = IMPOSSIBLE[what]
    with pytest.raises(WorldError) as caught:
        check(world)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_body_is_of_one_kind_and_time() -> None:
    for field, said in (("kind", "kinds"), ("appears", "times"), ("vanishes", "times")):
        column = getattr(BOX.segments, field).at[1].set(1)
        world = dataclasses.replace(BOX, segments=dataclasses.replace(BOX.segments, **{field: column}))
        with pytest.raises(WorldError, match=f"segments of different {said}"):
            check(world)


def test_what_can_be() -> None:
    check(join(HALL, BOX, box(jnp.array([2.2, 0.3]), 1.0, 1.0), box(jnp.array([4.0, 0.0]), 1.0, 1.0)))
    check(outline((0, 0), (2, 2), (2, 0), (0, 2), kind=Kind.WALL))  # a wall may cross itself
    check(pad(HALL, segments=9, poles=3, path=2))
    check(poles(jnp.zeros((0, 2)), 1.0))


def drive(*places: tuple[float, float]) -> np.ndarray:
    return np.column_stack([np.array(places, float), np.zeros(len(places))])


def test_a_drive_through_things() -> None:
    thin = outline((1, -1), (1, 1), kind=Kind.WALL)
    for thing, said in (
        (thin, "at scan 2 the robot has driven through the wall that is body 1"),
        (box(jnp.array([1.0, 0.0]), 0.2, 0.2), "at scan 2 the robot has driven through the obstacle that is body 1"),
        (poles(jnp.array([[1.0, 0.0]]), 0.1), "at scan 2 the robot has driven through pole 0"),
    ):
        with pytest.raises(WorldError, match=said):
            check(join(HALL, thing), drive((0, 0), (0.5, 0), (1.5, 0)))
        check(join(HALL, thing), drive((0, 0), (0.5, 1.5), (1.5, 1.5)))
    with pytest.raises(WorldError, match="at scan 1 the robot stands outside"):
        check(HALL, drive((0, 0), (9, 0)))


def test_what_is_not_there_is_in_nobodys_way() -> None:
    def world(**times: Any) -> World:
        return join(HALL, box(ORIGIN, 1, 1, **times))

    poses = drive((-2, 0), (-1, 0), (0, 0), (1, 0), (2, 0))
    check(world(appears=4), poses)
    check(world(vanishes=2), poses)
    for times in ({"appears": 1, "vanishes": 3}, {"appears": 2}, {}):
        with pytest.raises(WorldError, match="at scan 2 the robot stands inside the obstacle"):
            check(world(**times), poses)


def test_clearance() -> None:
    world = join(HALL, poles(jnp.array([[0.0, 1.0]]), 0.1))
    check(world, drive((0, 0), (3.5, 0)), clearance=0.45)
    with pytest.raises(WorldError, match=r"at scan 1 the robot comes nearer than 0\.55 m to the room that is body 0"):
        check(world, drive((0, 0), (3.5, 0)), clearance=0.55)
    with pytest.raises(WorldError, match=r"at scan 0 the robot comes nearer than 0\.95 m to pole 0"):
        check(world, drive((0, 0)), clearance=0.95)


def test_long_drives_are_looked_at_to_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("linemap_jax.lab.check._CHUNK", 20)
    world = join(HALL, box(jnp.array([1.0, 0.0]), 0.2, 0.2))
    poses = drive(*((-1, 0) for _ in range(50)), (2, 0))
    check(world, poses[:50])
    with pytest.raises(WorldError, match="at scan 50 the robot has driven through"):
        check(world, poses)


def test_outlines_are_judged_as_by_shapely() -> None:
    random = np.random.default_rng(0)
    verdicts = []
    for _ in range(300):
        # Whole numbers: corners on sides, sides on sides.
        corners = random.integers(0, 6, (int(random.integers(3, 7)), 2)).astype(float)
        if (corners == np.roll(corners, 1, 0)).all(1).any():
            continue
        simple = shapely.Polygon(corners).is_valid
        verdicts.append(simple)
        try:
            check(dataclasses.replace(POLYGON[len(corners)], segments=segments(corners)))
        except WorldError:
            assert not simple, corners
        else:
            assert simple, corners
    assert 30 < sum(verdicts) < len(verdicts) - 30


POLYGON = {n: polygon(jnp.zeros((n, 2))) for n in range(3, 7)}


def segments(corners: np.ndarray) -> Any:
    """In NumPy, since each number of corners would be compiled anew."""
    return dataclasses.replace(
        POLYGON[len(corners)].segments, ends=jnp.asarray(np.stack([corners, np.roll(corners, -1, 0)], 1))
    )


def test_inside_is_as_by_shapely() -> None:
    random = np.random.default_rng(1)
    angle = np.sort(random.uniform(-np.pi, np.pi, 12))
    corners = random.uniform(1, 4, (12, 1)) * np.stack([np.cos(angle), np.sin(angle)], -1)
    world, area = polygon(jnp.asarray(corners), Kind.ROOM), shapely.Polygon(corners)
    inside = 0
    for place in random.uniform(-4, 4, (200, 2)):
        if area.contains(shapely.Point(place)):
            check(world, drive(tuple(place)))
            inside += 1
        else:
            with pytest.raises(WorldError, match="outside of all rooms"):
                check(world, drive(tuple(place)))
    assert 20 < inside < 180
