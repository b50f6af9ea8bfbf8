"""Exact ranges: against shapely, at corners, under rigid motion, with garbage in the padding, in both precisions."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from linemap_jax.core.frames import unit
from linemap_jax.lab.generators import room
from linemap_jax.lab.raycast import NOTHING, cast
from linemap_jax.lab.world import Kind, World, join, moved, pad, poles, polygon

N = 180
CAST = jax.jit(cast)


def scattered(seed: int, walls: int = 30, columns: int = 12) -> World:
    """Loose walls and poles, none of them at the origin."""
    random = np.random.default_rng(seed)
    ends = random.uniform(-10, 10, (walls, 2, 2))
    angle = random.uniform(-np.pi, np.pi, columns)
    center = random.uniform(2, 6, (columns, 1)) * np.stack([np.cos(angle), np.sin(angle)], -1)
    loose = [polygon(jnp.asarray(end), Kind.WALL) for end in ends]
    return join(*loose, poles(jnp.asarray(center), jnp.asarray(random.uniform(0.02, 1.5, columns))))


def directions(angle: float = 0.0, count: int = N) -> jax.Array:
    # The odd offset keeps beams away from the axes, and so from running along walls.
    return unit(jnp.asarray(0.0137 + angle + np.linspace(-np.pi, np.pi, count, endpoint=False)))


def by_shapely(world: World, origin: np.ndarray, beams: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ranges, and the things that are met: segments by shapely, poles by the roots of a quadratic polynomial."""
    walls = np.asarray(shapely.linestrings(np.asarray(world.segments.ends)))
    rays = np.asarray(shapely.linestrings(np.stack([np.broadcast_to(origin, beams.shape), origin + 100 * beams], 1)))
    found = shapely.intersection(rays[:, None], walls[None])
    of_walls = np.where(shapely.is_empty(found), np.inf, shapely.distance(shapely.points(origin), found))
    of_poles = np.full((len(beams), world.poles.radius.size), np.inf)
    for j, (center, radius) in enumerate(zip(np.asarray(world.poles.center), world.poles.radius, strict=True)):
        to = center - origin
        for i, beam in enumerate(beams):
            roots = np.roots([1.0, -2 * beam @ to, to @ to - float(radius) ** 2])
            ahead = roots[np.isreal(roots) & (roots.real > 0)].real
            of_poles[i, j] = ahead.min() if ahead.size else np.inf
    ranges = np.concatenate([of_walls, of_poles], 1)
    nearest = ranges.min(1)
    return nearest, np.where(np.isfinite(nearest), ranges.argmin(1), NOTHING)


@pytest.mark.parametrize("seed", range(3))
def test_ranges_are_those_of_shapely(seed: int) -> None:
    world, origin = scattered(seed), np.array([0.3, -0.2])
    hits = CAST(world, jnp.asarray(origin), directions())
    assert {-1, 1} == {*np.sign(np.asarray(hits.thing) - 29.5)}  # walls and poles
    ranges, thing = by_shapely(world, origin, np.asarray(directions()))
    np.testing.assert_array_equal(hits.thing, thing)
    np.testing.assert_allclose(hits.ranges, ranges, rtol=0, atol=1e-9)


def test_what_is_not_met() -> None:
    world = join(polygon(jnp.array([[1.0, -1.0], [1.0, 1.0]]), Kind.WALL), poles(jnp.array([[0.0, 3.0]]), 0.5))
    beams = jnp.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    hits = CAST(world, jnp.zeros(2), beams)
    np.testing.assert_array_equal(hits.ranges, [1, np.inf, 2.5, np.inf])
    np.testing.assert_array_equal(hits.thing, [0, NOTHING, 1, NOTHING])
    assert hits.thing.dtype == jnp.int32


def test_from_inside_a_pole_to_its_rim() -> None:
    hits = cast(poles(jnp.array([[0.1, 0.0]]), 0.5), jnp.zeros(2), jnp.array([[1.0, 0.0], [-1.0, 0.0]]))
    np.testing.assert_allclose(hits.ranges, [0.6, 0.4], rtol=1e-15)


def test_a_world_of_nothing() -> None:
    hits = cast(poles(jnp.zeros((0, 2)), 1.0), jnp.zeros(2), directions())
    assert np.all(np.isinf(hits.ranges))
    assert np.all(np.asarray(hits.thing) == NOTHING)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("star", [True, False])
def test_no_beam_slips_through_a_corner(star: bool, dtype: Any) -> None:
    random = np.random.default_rng(0)
    angle = np.sort(random.uniform(-np.pi, np.pi, 180))
    distance = random.uniform(1, 8, (180, 1)) if star else 3.0
    corners = jnp.asarray(distance * np.stack([np.cos(angle), np.sin(angle)], -1), dtype)
    origins = jnp.asarray(random.uniform(-0.1, 0.1, (200, 2)), dtype)

    @jax.jit
    @jax.vmap
    def aimed(origin: jax.Array) -> jax.Array:
        to = corners - origin[None]
        return cast(polygon(corners, Kind.ROOM), origin, to / jnp.linalg.norm(to, axis=1)[:, None]).ranges

    ranges = np.asarray(aimed(origins))
    assert ranges.dtype == dtype
    assert np.all(np.isfinite(ranges) & (ranges > 0))
    if not star:  # no wall hides another one, so that it is the corner itself
        to_corners = np.linalg.norm(np.asarray(corners)[None] - np.asarray(origins)[:, None], axis=-1)
        np.testing.assert_allclose(ranges, to_corners, rtol=30 * np.finfo(dtype).eps)


def test_a_wall_seen_edge_on_is_not_met() -> None:
    along, across = ([[1.0, 0.0], [2.0, 0.0]], [[3.0, -1.0], [3.0, 1.0]])
    world = join(polygon(jnp.array(along), Kind.WALL), polygon(jnp.array(across), Kind.WALL))
    hits = CAST(world, jnp.zeros(2), jnp.array([[1.0, 0.0]]))
    assert hits.thing[0] == 1
    assert hits.ranges[0] == 3


@settings(max_examples=30, deadline=None)
@given(st.floats(-100, 100), st.floats(-100, 100), st.floats(-np.pi, np.pi))
def test_a_rigid_motion_of_world_and_robot_changes_nothing(x: float, y: float, theta: float) -> None:
    world, pose = scattered(0), jnp.array([x, y, theta])
    before = CAST(world, jnp.zeros(2), directions())
    after = CAST(moved(world, pose), pose[:2], directions(theta))
    np.testing.assert_allclose(after.ranges, before.ranges, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(after.thing, before.thing)


def test_padding_and_its_garbage_change_nothing() -> None:
    world = scattered(1)
    padded = pad(world, segments=64, poles=32, path=0)
    assert (padded.segments.ends.shape, padded.poles.center.shape) == ((64, 2, 2), (32, 2))
    spoilt = dataclasses.replace(
        padded,
        segments=dataclasses.replace(
            padded.segments, ends=jnp.where(padded.segments.valid[:, None, None], padded.segments.ends, jnp.nan)
        ),
        poles=dataclasses.replace(padded.poles, radius=jnp.where(padded.poles.valid, padded.poles.radius, jnp.inf)),
    )
    plain, full = CAST(world, jnp.zeros(2), directions()), CAST(spoilt, jnp.zeros(2), directions())
    np.testing.assert_array_equal(full.ranges, plain.ranges)
    is_pole = np.asarray(plain.thing) >= 30
    np.testing.assert_array_equal(full.thing, np.where(is_pole, plain.thing + 34, plain.thing))


def test_things_come_and_go() -> None:
    wall = np.array([[1.0, -1.0], [1.0, 1.0]])
    world = join(
        polygon(jnp.asarray(wall), Kind.WALL, appears=2, vanishes=4),
        polygon(jnp.asarray(3 * wall), Kind.WALL, vanishes=5),
        poles(jnp.array([[6.0, 0.0]]), 1.0, appears=3),
    )
    ahead = jnp.array([[1.0, 0.0]])
    ranges = [float(CAST(world, jnp.zeros(2), ahead, scan_index=k).ranges[0]) for k in range(7)]
    assert ranges == [3, 3, 1, 1, 3, 5, 5]


def test_worlds_and_scans_in_batches() -> None:
    def one(width: jax.Array, index: jax.Array) -> Any:
        return cast(room(width, 4.0), jnp.zeros(2), directions(), scan_index=index)

    widths = jnp.linspace(3.0, 6.0, 5)
    hits = jax.jit(jax.vmap(one))(widths, jnp.arange(5))
    for i in range(5):
        alone = one(widths[i], jnp.array(i))
        np.testing.assert_allclose(hits.ranges[i], alone.ranges, rtol=1e-14)


def test_float32_stays_and_is_as_good_as_it_can_be() -> None:
    world = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, scattered(2))
    hits = cast(world, jnp.zeros(2, jnp.float32), directions().astype(jnp.float32))
    assert hits.ranges.dtype == jnp.float32
    exact = np.asarray(CAST(scattered(2), jnp.zeros(2), directions()).ranges)
    error = np.abs(np.asarray(hits.ranges) - exact)[np.isfinite(exact)]
    assert np.median(error) < 1e-6
    # At grazing incidence the direction of the beam, rounded to 6e-8, decides.
    assert np.quantile(error, 0.98) < 1e-4


def test_a_world_far_away_is_seen_as_well_in_float32_if_it_is_given_in_float64() -> None:
    far = jnp.array([3e6, -2e6, 0.0])
    beams = directions().astype(jnp.float32)
    there, here = CAST(moved(scattered(2), far), far[:2], beams), CAST(scattered(2), jnp.zeros(2), beams)
    assert there.ranges.dtype == jnp.float32
    np.testing.assert_array_equal(there.thing, here.thing)
    np.testing.assert_allclose(there.ranges, here.ranges, rtol=1e-4)


def test_the_gradient_is_finite_and_right() -> None:
    world = scattered(0)

    def total(origin: jax.Array) -> jax.Array:
        ranges = cast(world, origin, directions()).ranges
        return jnp.sum(jnp.where(jnp.isfinite(ranges), ranges, 0))

    gradient = jax.jit(jax.grad(total))(jnp.zeros(2))
    steps = 1e-7 * np.eye(2)
    numeric = [(total(jnp.asarray(step)) - total(jnp.asarray(-step))) / 2e-7 for step in steps]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5)
