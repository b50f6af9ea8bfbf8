"""Generated worlds are possible, lie in one piece, and differ; their paths can be driven."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from linemap_jax.core.frames import unit
from linemap_jax.lab.check import check
from linemap_jax.lab.generators import changing_room, corridor, free_room, laboratory, rectilinear_room, room
from linemap_jax.lab.raycast import cast
from linemap_jax.lab.robot import drive
from linemap_jax.lab.world import NEVER, World

KEYS = jax.random.split(jax.random.key(0), 12)
SCANS = 300

RANDOM: dict[str, tuple[Callable[..., World], int, int]] = {  # generator, segments, poles
    "triangle": (lambda key, **o: free_room(key, vertices=3, **o), 3, 0),
    "free": (lambda key, **o: free_room(key, vertices=11, **o), 11, 0),
    "wavy": (lambda key, **o: free_room(key, vertices=180, **o), 180, 0),
    "rectangle": (lambda key, **o: rectilinear_room(key, vertices=4, **o), 4, 0),
    "hall": (lambda key, **o: rectilinear_room(key, vertices=22, **o), 22, 0),
    "long hall": (lambda key, **o: rectilinear_room(key, vertices=180, **o), 180, 0),
    "corridor": (lambda key, **o: corridor(key, rooms=3, **o), 52, 0),
    "changing": (lambda key, **o: changing_room(key, scans=SCANS, **o), 24, 1),
    "laboratory": (lambda key, **o: laboratory(key, scans=SCANS, **o), 73, 24),
}


@pytest.fixture(scope="module")
def batch() -> Callable[[str], tuple[World, Any]]:
    """Worlds of all keys at once, and drives along their paths; each kind is made once."""
    made: dict[str, Any] = {}

    def get(name: str) -> tuple[World, Any]:
        if name not in made:
            generate = RANDOM[name][0]

            @jax.jit
            @jax.vmap
            def one(key: jax.Array) -> Any:
                world = generate(key)
                return world, drive(world.path, count=SCANS, turns="smooth")

            made[name] = one(KEYS)
        return made[name]

    return get


def item(tree: Any, i: int) -> Any:
    return jax.tree.map(lambda x: x[i], tree)


def along(path: np.ndarray) -> np.ndarray:
    """Places at equal distances on the path itself, as poses."""
    length = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    at = np.linspace(0, length[-1], SCANS)
    return np.stack([np.interp(at, length, path[:, 0]), np.interp(at, length, path[:, 1]), 0 * at], -1)


@pytest.mark.parametrize("name", RANDOM)
def test_worlds_are_possible_and_their_paths_free(name: str, batch: Any) -> None:
    worlds, drives = batch(name)
    _, segments, poles = RANDOM[name]
    assert worlds.segments.valid.shape == (len(KEYS), segments)
    assert worlds.poles.valid.shape == (len(KEYS), poles)
    for i in range(len(KEYS)):
        world = item(worlds, i)
        for poses in (drives[i], along(np.asarray(world.path))):
            check(world, poses, clearance=0.25 if name != "triangle" else 0.05)


@pytest.mark.parametrize("name", RANDOM)
def test_worlds_of_different_keys_differ(name: str, batch: Any) -> None:
    ends = np.asarray(batch(name)[0].segments.ends).reshape(len(KEYS), -1)
    assert len({row.tobytes() for row in ends}) == len(KEYS)


@pytest.mark.parametrize("name", [name for name in RANDOM if name != "laboratory"])
def test_no_beam_leaves_a_room(name: str, batch: Any) -> None:
    worlds, drives = batch(name)
    beams = unit(jnp.linspace(-3.0, 3.0, 50))

    def ranges(world: World, poses: jax.Array) -> jax.Array:
        return jax.vmap(lambda pose: cast(world, pose[:2], beams).ranges)(poses)

    assert np.all(np.isfinite(jax.jit(jax.vmap(ranges))(worlds, drives[:, ::20])))


@pytest.mark.parametrize("name", RANDOM)
def test_the_dtype_is_the_one_asked_for(name: str) -> None:
    shape = jax.eval_shape(lambda key: RANDOM[name][0](key, dtype=jnp.float32), KEYS[0])
    assert {x.dtype for x in jax.tree.leaves(shape)} == {jnp.dtype(t) for t in ("float32", "int32", "bool")}


def test_a_plain_room() -> None:
    world = room(6.0, 4.0, np.pi / 6)
    corners = np.asarray(world.segments.ends[:, 0])
    area = shapely.Polygon(corners)
    assert area.area == pytest.approx(24)
    assert area.exterior.is_ccw
    assert area.centroid.coords[0] == pytest.approx((0, 0), abs=1e-12)
    np.testing.assert_allclose((corners[1] - corners[0]) / 6, [np.sqrt(3) / 2, 0.5], atol=1e-12)
    np.testing.assert_array_equal(world.path, [[0, 0]])
    assert jax.vmap(room, (0, None))(jnp.arange(3.0, 6.0), 4.0).segments.ends.shape == (3, 4, 2, 2)
    assert room(jnp.float32(6), 4.0).dtype == jnp.float32


def test_all_of_a_free_room_is_seen_from_the_origin(batch: Any) -> None:
    worlds, _ = batch("free")
    for i in range(len(KEYS)):
        corners = np.asarray(worlds.segments.ends[i, :, 0])
        following = np.roll(corners, -1, 0)
        assert np.all(corners[:, 0] * following[:, 1] > corners[:, 1] * following[:, 0])


@pytest.mark.parametrize("name", ["rectangle", "hall", "long hall", "corridor"])
def test_right_angles(name: str, batch: Any) -> None:
    ends = np.asarray(batch(name)[0].segments.ends)
    side = ends[:, :, 1] - ends[:, :, 0]
    following = np.roll(side, -1, 1)
    cosine = (side * following).sum(-1) / np.linalg.norm(side, axis=-1) / np.linalg.norm(following, axis=-1)
    np.testing.assert_allclose(cosine, 0, atol=1e-9)
    assert np.linalg.norm(side, axis=-1).min() > 0.1


def test_the_path_of_a_corridor_goes_into_every_room(batch: Any) -> None:
    _, drives = batch("corridor")
    poses = np.asarray(drives)
    aside = np.abs(poses[..., 1]) > 1.6  # beyond the wall of the widest corridor
    entries = (aside[:, 1:] & ~aside[:, :-1]).sum(1)
    np.testing.assert_array_equal(entries, 6)


def test_sizes_that_cannot_be() -> None:
    for make, sizes in ((free_room, (0, 2)), (rectilinear_room, (0, 2, 5))):
        for vertices in sizes:
            with pytest.raises(ValueError, match=str(vertices)):
                make(KEYS[0], vertices=vertices)


def test_things_change_in_a_changing_room(batch: Any) -> None:
    worlds, _ = batch("changing")
    segments = item(worlds, 0).segments
    appears, vanishes = (np.asarray(x).reshape(6, 4)[:, 0] for x in (segments.appears, segments.vanishes))
    np.testing.assert_array_equal(appears[[0, 1, 3, 5]], 0)
    np.testing.assert_array_equal(vanishes[[0, 1, 2, 4]], NEVER)
    assert vanishes[3] == appears[4]  # it moves
    for time in (appears[2], vanishes[3], vanishes[5]):
        assert SCANS // 4 <= time < SCANS * 3 // 4


@pytest.mark.parametrize("scans", [1, 60, 301, 1000])
def test_a_laboratory_can_be_driven_through_in_any_number_of_scans(scans: int) -> None:
    world = laboratory(KEYS[0], scans=scans)
    check(world, drive(world.path, count=scans, turns="smooth"), clearance=0.25)


def test_a_laboratory_changes_within_the_drive() -> None:
    segments = laboratory(KEYS[0], scans=601).segments
    vanishes = np.asarray(segments.vanishes)
    assert sorted(set(vanishes.tolist())) == [301, NEVER]
    assert (vanishes == 301).sum() == 5  # the box and the shut door
    np.testing.assert_array_equal(np.flatnonzero(segments.appears), np.flatnonzero(segments.appears == 301))
    with pytest.raises(ValueError, match="a drive has one scan at least, not 0"):
        laboratory(KEYS[0], scans=0)


def test_a_laboratory_without_jitter_is_as_drawn() -> None:
    worlds = [laboratory(key, scans=SCANS, jitter=0.0) for key in KEYS[:2]]
    jax.tree.map(np.testing.assert_array_equal, *worlds)
    moved = laboratory(KEYS[0], scans=SCANS, jitter=0.1)
    off = np.abs(np.asarray(moved.poles.center - worlds[0].poles.center))
    assert 0.02 < off.max() < 0.2
    for field in dataclasses.fields(moved.segments):
        if field.name != "ends":
            np.testing.assert_array_equal(getattr(moved.segments, field.name), getattr(worlds[0].segments, field.name))
