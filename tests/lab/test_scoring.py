"""Maps with known answers, and lengths held against shapely."""

import dataclasses
import itertools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from linemap_jax.core.settings import Mount
from linemap_jax.core.slots import resize
from linemap_jax.core.state import Circles, LineMap, Lines, empty_circles, empty_lines
from linemap_jax.lab.generators import free_room, room
from linemap_jax.lab.scanners import Scanner, simulate_scan, simulate_scans, sweep
from linemap_jax.lab.scoring import (
    Gates,
    Score,
    Seen,
    beams_on_objects,
    evaluate,
    expected,
    held,
    look,
    scans_until,
    seen_everything,
    seen_nothing,
    survey,
    times_of_objects,
)
from linemap_jax.lab.world import Kind, World, box, join, pad, poles, polygon

FINE = Gates(cell=0.005)
FINE_CELLS = 2000  # of half a centimetre: up to 10 m


def lines_of(*ends: Any) -> Lines:
    """Lines from begin to end, anchored in their middle, with a covariance of (1 cm)^2 and (0.01 rad)^2."""
    points = np.asarray(ends, float).reshape(-1, 2, 2)
    x, y = (points[:, 1] - points[:, 0]).T
    half = np.hypot(x, y) / 2
    return dataclasses.replace(
        empty_lines(len(points)),
        anchor=jnp.asarray(points.mean(1)),
        angle=jnp.asarray(np.arctan2(y, x) - np.pi / 2),
        extent=jnp.asarray(np.stack([-half, half], -1)),
        cov_independent=jnp.asarray(np.tile(np.eye(2) * 1e-4, (len(points), 1, 1))),
        valid=jnp.asarray(np.ones(len(points), bool)),
    )


def circles_of(*circles: Any) -> Circles:
    """Fitted circles, with a covariance of (1 cm)^2."""
    numbers = np.asarray(circles, float).reshape(-1, 3)
    return dataclasses.replace(
        empty_circles(len(numbers)),
        center=jnp.asarray(numbers[:, :2]),
        radius=jnp.asarray(numbers[:, 2]),
        cov_independent=jnp.asarray(np.tile(np.eye(3) * 1e-4, (len(numbers), 1, 1))),
        fitted=jnp.asarray(np.ones(len(numbers), bool)),
        valid=jnp.asarray(np.ones(len(numbers), bool)),
    )


# One shape for nearly all of what follows, so that it shares one compilation.
SEGMENTS, POLES, LINES, CIRCLES = 18, 4, 35, 5


def world_of(world: World) -> World:
    return pad(dataclasses.replace(world, path=jnp.zeros((0, 2))), segments=SEGMENTS, poles=POLES, path=0)


def map_of(lines: Lines, circles: Circles) -> LineMap:
    return LineMap(lines=resize(lines, LINES), circles=resize(circles, CIRCLES))


# South 0, east 1, north 2, west 3; 6 m by 4 m around the origin. A pole of 10 cm that nobody maps, and one of 20 cm.
ROOM = world_of(join(room(6.0, 4.0), poles(jnp.array([[-1.0, 0.0], [1.0, 1.0]]), jnp.array([0.1, 0.2]))))
MAP = map_of(
    lines=lines_of(
        [(-3, -2.02), (3, -2.02)],  # 2 cm behind the south wall
        [(3, -2), (3, 0.5)],  # the east wall twice over 1 m
        [(3, 2), (3, -0.5)],
        [(-3, 2), (-0.5, 2)],  # the north wall with a gap of 1 m
        [(0.5, 2), (3, 2)],
        [(0, 0), (1, 0)],  # nothing is there
        [(0, 1.5), (0, 2.5)],  # across the north wall
        [(-3.5, 2), (-4.5, 2)],  # on the north wall's prolongation
    ),
    circles=circles_of(
        (1.03, 1.0, 0.22),  # the second pole
        (-2.5, 1.98, 0.05),  # on the north wall
        (0.0, -1.0, 0.1),  # nothing is there
    ),
)


def same(found: Any, first: Any, rest: Any = 0, **tolerance: Any) -> None:
    """The first items are these, and the free slots behind them hold `rest`."""
    found, first = np.asarray(found), np.asarray(first)
    np.testing.assert_allclose(found[: len(first)], first, **tolerance)
    np.testing.assert_array_equal(found[len(first) :], rest)


def seen_all(world: World) -> Seen:
    return seen_everything(world, cells=FINE_CELLS)


def scored(line_map: LineMap, world: World, seen: Seen | None = None, *, scan_index: int = 0, scans: int = 1) -> Score:
    gates = dataclasses.replace(FINE, scans=scans)
    return evaluate(line_map, world, seen or seen_all(world), scan_index=scan_index, gates=gates)


@pytest.fixture(scope="module")
def score() -> Score:
    return scored(MAP, ROOM)


def test_lengths(score: Score) -> None:
    cell = 0.006  # m
    assert score.line_length == pytest.approx(6 + 2 * 2.5 + 2 * 2.5 + 3)
    assert score.line_length_on_walls == pytest.approx(16, abs=5 * cell)
    assert score.precision == pytest.approx(16 / 19, abs=2e-3)
    same(score.wall_seen, [6, 4, 6, 4])
    same(score.wall_held, [6, 4, 5.1, 0], atol=2 * cell)  # around ends too it is within 5 cm
    assert score.recall == pytest.approx(15.1 / 20, abs=2e-3)
    same(score.line_share, [1, 1, 1, 1, 1, 0, 0, 0], atol=2e-3)


def test_lines_of_walls(score: Score) -> None:
    same(score.wall_of_line, [0, 1, 1, 2, 2, -1, -1, -1], -1)
    same(score.phantom_line, [0, 0, 0, 0, 0, 1, 1, 1])
    # The normal of the first line looks south.
    same(score.line_error, [[0.02, 0], *[[0, 0]] * 7], atol=1e-12)
    same(score.line_nees, [4, 0, 0, 0, 0, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(score.error, [0.02 / np.sqrt(5), 0], atol=1e-12)
    assert score.nees == pytest.approx(4 / 5)


def test_walls_held_twice_and_in_pieces(score: Score) -> None:
    same(score.wall_twice, [0, 1, 0, 0], atol=0.012)
    same(score.held_twice, [False, True, False, False])
    same(score.wall_pieces, [1, 1, 2, 0])
    assert (int(score.duplicates), int(score.fragments)) == (1, 1)


def test_circles(score: Score) -> None:
    same(score.circles_of_pole, [0, 1])
    same(score.missed_pole, [True, False])
    same(score.pole_of_circle, [1, -1, -1], -1)
    same(score.phantom_circle, [False, False, True])
    same(score.circle_error, [[0.03, 0, 0.02], [0, 0, 0], [0, 0, 0]], atol=1e-12)
    same(score.circle_nees, [9 + 4, 0, 0], atol=1e-9)


def test_only_what_was_seen_can_be_missed(score: Score) -> None:
    assert int(score.missed_pole.sum()) == 1
    # Not the north wall from x = 0 to 0.5, half of its gap; the west wall and the first pole in one scan only.
    cells = np.array(seen_all(ROOM).cells)
    middle = 3 - (np.arange(FINE_CELLS) + 0.5) * 6 / 1200
    cells[2, (middle > 0) & (middle < 0.5)] = 0
    cells[3] = 1
    seen = Seen(cells=jnp.asarray(cells), poles=seen_all(ROOM).poles.at[0].set(1))
    twice_seen = scored(MAP, ROOM, seen, scans=2)
    same(twice_seen.wall_seen, [6, 4, 5.5, 0], atol=1e-9)
    same(twice_seen.wall_held, [6, 4, 5.05, 0], atol=0.012)
    same(twice_seen.wall_pieces, [1, 1, 1, 0])  # nobody knows whether the gap is one
    assert not np.any(twice_seen.missed_pole)


@pytest.mark.parametrize(
    ("second", "pieces", "twice"),
    [((2.0, 4.0), 2, 0.0), ((2.04, 4.0), 2, 0.0), ((1.9, 4.0), 1, 0.1), ((1.5, 1.9), 1, 0.4)],
)
def test_two_lines_of_one_wall(second: tuple[float, float], pieces: int, twice: float) -> None:
    line_map = map_of(lines_of([(-3, -2), (-1, -2)], [(x - 3, -2) for x in second]), circles_of())
    score = scored(line_map, ROOM)
    assert int(score.wall_pieces[0]) == pieces
    assert float(score.wall_twice[0]) == pytest.approx(twice, abs=0.006)
    assert bool(score.held_twice[0]) == (twice > 0.3)


@pytest.mark.parametrize("kind", list(Kind))
def test_a_chain_has_two_faces(kind: Kind) -> None:
    square = jnp.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]])
    world = world_of(polygon(square, kind))
    there, back, again = [(-1, -2), (1, -2)], [(1, -2.01), (-1, -2.01)], [(-1, -1.99), (1, -1.99)]
    both = scored(map_of(lines_of(there, back), circles_of()), world)
    assert bool(both.held_twice[0]) == (kind != Kind.WALL)
    assert float(both.wall_held[0]) == pytest.approx(2.1, abs=0.012)
    assert int(both.wall_pieces[0]) == 1
    one_face = scored(map_of(lines_of(there, again), circles_of()), world)
    assert bool(one_face.held_twice[0])


def test_an_empty_map() -> None:
    empty = scored(map_of(lines_of(), circles_of()), ROOM)
    assert float(empty.recall) == 0
    assert np.isnan(empty.precision)
    assert np.isnan(empty.error).all()
    assert not np.any(empty.phantom_line)
    assert int(empty.missed_pole.sum()) == 2


def test_worlds_without_walls_or_poles() -> None:
    for segments, count in ((0, 2), (3, 0)):
        world = pad(join(poles(jnp.zeros((0, 2)), 0.0)), segments=segments, poles=count, path=0)
        shapes = jax.eval_shape(evaluate, MAP, world)
        assert (shapes.wall_held.shape, shapes.missed_pole.shape) == ((segments,), (count,))
        assert shapes.object_held.shape == (segments + count,)


# --- Against shapely -------------------------------------------------------------------------------------------------


def random_map(world: World, rng: np.random.Generator) -> LineMap:
    """Pieces of walls, more or less off, some of them beside one another; and a few lines anywhere."""
    ends = np.asarray(world.segments.ends)
    found = []
    for _ in range(30):
        begin, end = ends[rng.integers(len(ends))]
        first, last = np.sort(rng.uniform(-0.1, 1.1, 2))
        piece = begin + np.outer([first, last], end - begin) + rng.normal(0, 0.03, 2) + rng.normal(0, 0.01, (2, 2))
        found.append(piece[:: rng.choice([-1, 1])])
    found += list(rng.uniform(-4, 4, (5, 2, 2)))
    return map_of(lines_of(*found), circles_of())


def is_parallel(a: np.ndarray, b: np.ndarray) -> bool:
    u, v = a[1] - a[0], b[1] - b[0]
    return abs(u[0] * v[1] - u[1] * v[0]) <= np.sin(0.087) * np.hypot(*u) * np.hypot(*v)


def near(a: np.ndarray, others: list[np.ndarray], cap: Literal["round", "flat"]) -> list[Any]:
    """What lies near each of the others that are parallel to a piece."""
    return [shapely.LineString(b).buffer(0.05, quad_segs=64, cap_style=cap) for b in others if is_parallel(a, b)]


def length_in(a: np.ndarray, areas: list[Any]) -> float:
    # The areas first: a union of pieces of one straight line counts some of it twice.
    return shapely.LineString(a).intersection(shapely.union_all(areas)).length


def test_lengths_of_random_maps_are_those_of_shapely() -> None:
    def worlds(key: jax.Array) -> World:
        return join(free_room(key, vertices=14), box(jnp.array([1.0, 0.5]), 1.0, 0.7, 0.4))

    stacked = jax.jit(jax.vmap(worlds))(jax.random.split(jax.random.key(3), 4))
    for i in range(4):
        world = world_of(jax.tree.map(lambda x, i=i: x[i], stacked))
        line_map = random_map(world, np.random.default_rng(i))
        score = scored(line_map, world)
        walls = list(np.asarray(world.segments.ends))
        lines = list(np.stack([line_map.lines.begin, line_map.lines.end], 1))
        on_walls = sum(length_in(line, near(line, walls, "round")) for line in lines)
        held_length = [length_in(wall, near(wall, lines, "round")) for wall in walls]
        pairs = [itertools.combinations(near(wall, lines, "flat"), 2) for wall in walls]
        twice = [length_in(wall, [a & b for a, b in of_wall]) for wall, of_wall in zip(walls, pairs, strict=True)]
        assert float(score.line_length_on_walls) == pytest.approx(on_walls, rel=2e-3)
        np.testing.assert_allclose(score.wall_held, held_length, atol=0.025)
        np.testing.assert_allclose(score.wall_twice, twice, atol=0.025)
        assert max(twice) > 0.3
        assert 0.2 < float(score.precision) < 0.9
        assert 0.2 < float(score.recall) < 0.9


def test_padding_and_batches_change_nothing(score: Score) -> None:
    other = dataclasses.replace(MAP, lines=jax.tree.map(lambda x: x[::-1], MAP.lines))
    maps = [LineMap(lines=resize(m.lines, LINES + 2), circles=resize(m.circles, CIRCLES + 1)) for m in (MAP, other)]
    wide = pad(ROOM, segments=SEGMENTS + 1, poles=POLES + 1, path=0)
    batch = jax.tree.map(lambda *x: jnp.stack(x), *((m, wide, seen_all(wide)) for m in maps))
    many = jax.vmap(lambda *x: evaluate(*x, gates=FINE))(*batch)
    for name in ("precision", "recall", "nees", "duplicates", "fragments"):
        np.testing.assert_allclose(getattr(many, name), [getattr(score, name)] * 2, rtol=1e-12)
    np.testing.assert_array_equal(many.wall_of_line[0, :LINES], score.wall_of_line)
    np.testing.assert_array_equal(many.wall_of_line[1, :LINES], score.wall_of_line[::-1])
    for missed in many.missed_pole:
        same(missed, [True, False])


# --- What the beams have seen ----------------------------------------------------------------------------------------


def test_cells_are_those_that_the_beams_met() -> None:
    scanner = Scanner(bearings=sweep(-np.pi / 2, np.pi / 2, 91), bearing_sigma=0.01)
    pose, mount = jnp.array([0.3, -0.2, 0.4]), Mount(0.2, 0.1, 0.3)
    scan, truth = jax.jit(simulate_scan)(jax.random.key(0), ROOM, pose, scanner, mount)
    lost = dataclasses.replace(scan, valid=scan.valid & (jnp.arange(91) != 40))
    gates = Gates(cell=0.25)
    jitted = jax.jit(look)
    seen = jitted(seen_nothing(ROOM, cells=32), ROOM, lost, truth, pose, mount, gates=gates)

    c, s = np.cos(0.4), np.sin(0.4)
    place = np.array([0.3 + c * 0.2 - s * 0.1, -0.2 + s * 0.2 + c * 0.1])
    cells, returns = np.zeros((SEGMENTS, 32), int), np.zeros(POLES, int)
    for beam in np.flatnonzero(np.arange(91) != 40):
        thing, angle = int(truth.thing[beam]), 0.7 + float(truth.bearings[beam])
        if thing < SEGMENTS:
            at = place + float(truth.ranges[beam]) * np.array([np.cos(angle), np.sin(angle)])
            wall = shapely.LineString(np.asarray(ROOM.segments.ends[thing]))
            assert wall.distance(shapely.Point(at)) < 1e-9
            cells[thing, int(wall.project(shapely.Point(at)) / 0.25)] = 1
        else:
            returns[thing - SEGMENTS] += 1
    np.testing.assert_array_equal(seen.cells, cells)
    np.testing.assert_array_equal(seen.poles, returns >= 3)
    assert 15 < cells.sum() < 60
    assert returns.max() >= 3

    again = jitted(seen, ROOM, scan, truth, pose, mount, gates=gates)
    assert int(again.cells.max()) == 2


def test_a_survey_is_one_look_after_the_other() -> None:
    world = join(room(6.0, 4.0), poles(jnp.array([[1.0, 0.0]]), 0.2, appears=6))
    poses = jnp.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.5], [0.2, 0.0, 1.5]])
    scans, truth = jax.jit(simulate_scans)(jax.random.key(0), world, poses, Scanner(bearings=sweep(-1.0, 1.0, 41)))
    early = survey(seen_nothing(world), world, scans, poses, first=0)
    late = survey(seen_nothing(world), world, scans, poses, first=5)
    seen, jitted = seen_nothing(world), jax.jit(look)
    for i in range(3):
        scan, met = jax.tree.map(lambda x, i=i: x[i], (scans, truth))
        seen = jitted(seen, world, scan, met, poses[i])
    np.testing.assert_array_equal(early.cells, seen.cells)
    np.testing.assert_array_equal(early.poles, [0])
    np.testing.assert_array_equal(late.poles, [1])  # from the second scan on, and not in the third


# --- Over time -------------------------------------------------------------------------------------------------------

# A wall with a door in it that is opened, a cupboard that replaces a shelf, poles one of which goes.
CHANGING = world_of(
    join(
        polygon(jnp.array([[0.0, 0.0], [2.0, 0.0]]), Kind.WALL),
        polygon(jnp.array([[2.0, 0.0], [3.0, 0.0]]), Kind.WALL, vanishes=5),
        polygon(jnp.array([[3.0, 0.0], [5.0, 0.0], [5.0, 1.0]]), Kind.WALL),
        polygon(jnp.array([[0.0, 3.0], [2.0, 3.0]]), Kind.WALL, vanishes=5),
        polygon(jnp.array([[0.5, 3.02], [4.0, 3.02]]), Kind.WALL, appears=5),
        polygon(jnp.array([[-9.0, 6.0], [9.0, 6.0]]), Kind.WALL),
        poles(jnp.array([[7.0, 0.0]]), 0.1),
        poles(jnp.array([[7.2, 0.0], [8.0, 0.0]]), 0.1, vanishes=5),
    )
)
DOOR, SHELF, CUPBOARD = 1, 3, 4
STALE = map_of(lines_of([(0, 0), (5, 0)], [(0, 3), (2, 3)]), circles_of((7.1, 0, 0.1), (8, 0.02, 0.1)))


def test_what_is_held_of_each_object() -> None:
    seen = seen_all(CHANGING)
    before = np.asarray(held(STALE, CHANGING, seen, scan_index=4, gates=FINE))
    # The corner is within 5 cm, but not parallel.
    same(before[:SEGMENTS], [1, 1, 2 / 3, 1, 0, 0], atol=0.005)
    same(before[SEGMENTS:], [1, 1, 1])
    after = np.asarray(held(STALE, CHANGING, seen, scan_index=5, gates=FINE))
    assert after[DOOR] == 1  # though most of the line lies on walls that stay
    # Where the cupboard now stands the line is the cupboard's; beside it, it is a trace of the shelf.
    assert after[SHELF] == 1
    assert after[CUPBOARD] == pytest.approx(1.5 / 3.5, abs=0.005)
    same(after[SEGMENTS:], [1, 0, 1])  # the circle between two poles is that of the one that stays

    opened = map_of(lines_of([(0, 0), (2.04, 0)], [(0.6, 3), (2, 3)]), STALE.circles)
    gone = np.asarray(held(opened, CHANGING, seen, scan_index=5, gates=FINE))
    np.testing.assert_array_equal(gone[[DOOR, SHELF]], 0)
    np.testing.assert_array_equal(scored(opened, CHANGING, seen, scan_index=5).object_held, gone)
    unseen = held(STALE, CHANGING, seen_nothing(CHANGING, cells=FINE_CELLS), scan_index=5, gates=FINE)
    np.testing.assert_array_equal(unseen, 0)


def test_the_truth_is_that_of_the_scan() -> None:
    before, after = (scored(STALE, CHANGING, scan_index=i) for i in (4, 5))
    same(before.wall_held, [2, 1, 2, 0, 2, 0, 0], atol=0.01)
    same(after.wall_held, [2, 0, 2, 0, 0, 1.546, 0], atol=0.01)
    assert not np.any(after.missed_pole)
    same(before.pole_of_circle, [0, 2], -1)
    same(after.pole_of_circle, [0, -1], -1)


def test_objects_and_their_times() -> None:
    appears, vanishes, exists = times_of_objects(CHANGING)
    np.testing.assert_array_equal(np.flatnonzero(exists), [0, 1, 2, 3, 4, 5, SEGMENTS, SEGMENTS + 1, SEGMENTS + 2])
    same(appears[:SEGMENTS], [0, 0, 0, 0, 5])
    np.testing.assert_array_equal(np.flatnonzero(np.asarray(vanishes) == 5), [1, 3, SEGMENTS + 1, SEGMENTS + 2])


def test_beams_that_tell_of_objects() -> None:
    bearings = sweep(-1.0, 1.0, 201)
    pose = jnp.array([2.5, -1.0, np.pi / 2])

    @jax.jit
    def at(index: jax.Array) -> Any:
        scan, truth = simulate_scan(jax.random.key(1), CHANGING, pose, Scanner(bearings=bearings), scan_index=index)
        lost = dataclasses.replace(scan, valid=scan.valid & (jnp.arange(201) != 100))
        return (
            truth,
            expected(CHANGING, scan, pose, scan_index=index),
            beams_on_objects(CHANGING, lost, truth, pose, scan_index=index),
        )

    x = -np.tan(np.asarray(bearings))  # how far off the door's middle a beam goes through it
    through_door = np.sum((np.abs(x) < 0.5) & (np.arange(201) != 100))
    truth, told, (met, passed) = at(jnp.asarray(4))
    np.testing.assert_allclose(told.ranges, truth.ranges)
    np.testing.assert_array_equal(told.thing, truth.thing)
    assert met[DOOR] == through_door
    assert not np.any(passed)
    truth, told, (met, passed) = at(jnp.asarray(5))
    np.testing.assert_array_equal(told.thing, truth.thing)
    assert met[DOOR] == 0
    assert passed[DOOR] == through_door
    assert passed.sum() == through_door  # what stands behind the door's place tells nothing of it
    assert met[CUPBOARD] == np.sum((4.02 * x + 2.5 < 4.0) & (np.abs(x) < 0.5) & (np.arange(201) != 100))


def test_scans_until() -> None:
    done = jnp.array([[0, 1, 0, 0], [0, 1, 0, 1], [0, 0, 0, 0], [1, 0, 0, 1], [0, 1, 0, 1]], bool)
    counts = jnp.array([[1, 1, 1, 0], [1, 0, 1, 0], [1, 1, 0, 0], [1, 1, 1, 0], [1, 1, 1, 1]], bool)
    number, ever = scans_until(done, counts, jnp.array([1, 2, 1, 2]))
    # From scan 1 on in 1, 2, 3; from 2 on in 2, 3, 4; never, though 1, 3, 4 counted; in 3, before any counted.
    np.testing.assert_array_equal(number, [3, 3, 3, 0])
    np.testing.assert_array_equal(ever, [True, True, False, True])
