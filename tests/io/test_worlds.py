"""World files: lossless, drawn by hand or by the program, and strict about what they take in."""

import copy
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax.io.worlds import WorldFileError, read_world, write_world
from linemap_jax.lab.generators import changing_room, laboratory, room
from linemap_jax.lab.world import NEVER, Kind, World, arrays_from_world, box, join, pad, poles, world_from_arrays

KEY = jax.random.key(0)
WORLDS: dict[str, Callable[[Any], World]] = {
    "room": lambda dtype: room(jnp.asarray(6.1, dtype), 4.2, 0.3),
    "changing": lambda dtype: changing_room(KEY, scans=100, dtype=dtype),
    "laboratory": lambda dtype: laboratory(KEY, scans=300, dtype=dtype),
    "nothing": lambda dtype: poles(jnp.zeros((0, 2), dtype), 1.0),
}


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", WORLDS)
def test_round_trip_is_lossless(tmp_path: Path, name: str, dtype: str) -> None:
    world, path = WORLDS[name](dtype), tmp_path / "world.geojson"
    write_world(path, arrays_from_world(world))
    back = world_from_arrays(read_world(path))
    for a, b in zip(jax.tree.leaves(world), jax.tree.leaves(back), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    write_world(tmp_path / "again.geojson", arrays_from_world(back))
    assert (tmp_path / "again.geojson").read_bytes() == path.read_bytes()


def test_free_slots_are_left_out_and_bodies_numbered_anew(tmp_path: Path) -> None:
    world = pad(join(room(6.0, 4.0), box(jnp.ones(2), 1, 1)), segments=16, poles=3, path=1)
    broken = dataclasses.replace(
        world.segments,
        ends=jnp.where(world.segments.valid[:, None, None], world.segments.ends, jnp.nan),
        body=world.segments.body * 5 + 2,
    )
    write_world(tmp_path / "world.geojson", arrays_from_world(dataclasses.replace(world, segments=broken)))
    back = read_world(tmp_path / "world.geojson")
    assert back["poles"]["center"].shape == (0, 2)
    np.testing.assert_array_equal(back["segments"]["ends"], world.segments.ends[:8])
    np.testing.assert_array_equal(back["segments"]["body"], [0] * 4 + [1] * 4)


BY_HAND = """
{"type": "FeatureCollection", "name": "drawn in a GIS", "features": [
  {"type": "Feature", "properties": null,
   "geometry": {"type": "LineString", "coordinates": [[0, 0], [4, 0, 7.5], [4, 3]]}},
  {"type": "Feature", "properties": {"radius": 0.1, "appears": 3},
   "geometry": {"type": "Point", "coordinates": [1, 2]}},
  {"type": "Feature", "properties": {"vanishes": 9, "appears": null, "colour": "red"},
   "geometry": {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [0, 1], [0, 0]]]}},
  {"type": "Feature", "properties": {"kind": "path"}, "geometry": {"type": "Point", "coordinates": [-1, -1]}},
  {"type": "Feature", "properties": {"kind": "room"},
   "geometry": {"type": "Polygon", "coordinates": [[[-9, -9], [9, -9], [0, 9], [-9, -9]]]}}
]}
"""


def test_a_file_made_by_hand(tmp_path: Path) -> None:
    (tmp_path / "hand.geojson").write_text(BY_HAND)
    world = read_world(tmp_path / "hand.geojson")
    segments = world["segments"]
    np.testing.assert_array_equal(segments["ends"][:2], [[[0, 0], [4, 0]], [[4, 0], [4, 3]]])
    np.testing.assert_array_equal(segments["ends"][2:5], [[[0, 0], [1, 0]], [[1, 0], [0, 1]], [[0, 1], [0, 0]]])
    np.testing.assert_array_equal(segments["kind"], [Kind.WALL] * 2 + [Kind.OBSTACLE] * 3 + [Kind.ROOM] * 3)
    np.testing.assert_array_equal(segments["body"], [0] * 2 + [1] * 3 + [2] * 3)
    np.testing.assert_array_equal(segments["vanishes"], [NEVER] * 2 + [9] * 3 + [NEVER] * 3)
    np.testing.assert_array_equal(segments["appears"], 0)
    np.testing.assert_array_equal(world["poles"]["center"], [[1, 2]])
    assert (world["poles"]["radius"], world["poles"]["appears"]) == (0.1, 3)
    np.testing.assert_array_equal(world["path"], [[-1, -1]])
    assert segments["ends"].dtype == np.float64
    assert read_world(tmp_path / "hand.geojson", dtype="float32")["path"].dtype == np.float32


def change(*keys: Any, to: Any) -> Callable[[dict[str, Any]], None]:
    def apply(document: dict[str, Any]) -> None:
        inside: Any = document
        for key in keys[:-1]:
            inside = inside[key]
        inside[keys[-1]] = to

    return apply


def shape(i: int, *keys: Any, to: Any) -> Callable[[dict[str, Any]], None]:
    return change("features", i, "geometry", *keys, to=to)


DAMAGES = {
    "type": (change("type", to="Feature"), 'is not a world: its "type"'),
    "format": (change("format", to="other"), 'has format and version ["other", 1]'),
    "version": (change("version", to=2), 'has format and version ["linemap-world", 2]'),
    "dtype": (change("dtype", to="float16"), '"dtype" must be'),
    "features": (change("features", to={}), '"features" must be a list'),
    "feature": (change("features", 1, to=[1]), "features[1] must be an object"),
    "no geometry": (change("features", 2, "geometry", to=None), "features[2] must have a geometry"),
    "geometry": (shape(0, "type", to="MultiPoint"), 'features[0] is a "MultiPoint"; it must be'),
    "no name": (shape(0, "type", to=["Point"]), 'features[0] is a ["Point"]; it must be'),
    "kind": (change("features", 2, "properties", "kind", to="wall"), 'features[2], a Polygon, has the kind "wall"'),
    "hole": (
        shape(2, "coordinates", to=[[[0, 0], [1, 0], [0, 1], [0, 0]]] * 2),
        "features[2] must have one outline",
    ),
    "open": (shape(2, "coordinates", 0, 3, to=[0, 0.1]), "features[2] is not closed"),
    "few": (shape(2, "coordinates", 0, to=[[0, 0], [1, 0], [0, 0]]), "features[2], a Polygon, must have 4"),
    "one": (shape(0, "coordinates", to=[[0, 0]]), "features[0], a LineString, must have 2 positions"),
    "flat": (shape(0, "coordinates", to=[0, 0]), "features[0] has a position that is not a list of two numbers"),
    "text": (shape(1, "coordinates", 0, to="1"), "features[1] has a position that is not"),
    "truth": (shape(1, "coordinates", 0, to=True), "features[1] has a position that is not"),
    "none": (shape(0, "coordinates", to=None), "features[0] has no coordinates"),
    "huge": (shape(1, "coordinates", 0, to=10**400), "features[1] holds a number that is not finite in float64"),
    "radius": (change("features", 1, "properties", "radius", to=0), "features[1], a pole, must have a radius"),
    "no radius": (change("features", 1, "properties", to=None), "features[1], a pole, must have a radius"),
    "time": (change("features", 1, "properties", "appears", to=1.5), "features[1].properties.appears must be a whole"),
    "early": (change("features", 2, "properties", "vanishes", to=-1), "features[2].properties.vanishes must be"),
    "two paths": (change("features", 1, "properties", "kind", to="path"), "features[3] is a second path"),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_names_the_file_and_what_is_wrong(tmp_path: Path, what: str) -> None:
    damage, cause = DAMAGES[what]
    document = copy.deepcopy(json.loads(BY_HAND))
    damage(document)
    path = tmp_path / "world.geojson"
    path.write_text(json.dumps(document))
    with pytest.raises(WorldFileError) as caught:
        read_world(path)
    assert str(caught.value).startswith(f"{path}: {cause}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "cause"),
    [
        (b"", "line 1 is not JSON"),
        (b'{"type":\n', "line 2 is not JSON"),
        (b"\xff\xfe", "is not JSON"),
        (b"[" * 100_000, "is not JSON"),
        (b'{"type": "FeatureCollection", "features": [NaN]}', "holds NaN"),
        (b'{"type": "FeatureCollection", "version": ' + b"9" * 5000 + b"}", "has format and version"),
        (b"[]", "is not a world"),
    ],
)
def test_what_is_no_geojson(tmp_path: Path, content: bytes, cause: str) -> None:
    path = tmp_path / "world.geojson"
    path.write_bytes(content)
    with pytest.raises(WorldFileError) as caught:
        read_world(path)
    assert str(caught.value).startswith(f"{path}: {cause}")


def spoilt(part: str, name: str, at: Any, to: Any) -> dict[str, Any]:
    world = join(box(jnp.ones(2), 1, 1), poles(jnp.zeros((2, 2)), 0.1))
    arrays = jax.tree.map(np.array, arrays_from_world(world))
    arrays[part][name][at] = to
    return arrays


@pytest.mark.parametrize(
    ("arrays", "cause"),
    [
        (spoilt("segments", "ends", (1, 1), np.nan), "body 0 holds a number that is not finite"),
        (spoilt("segments", "ends", (1, 1), 3), "body 0 is not one chain"),
        (spoilt("segments", "ends", (3, 1), 3), "body 0 is not closed"),
        (spoilt("segments", "kind", 1, 0), 'the segments of body 0 differ in "kind"'),
        (spoilt("segments", "body", 1, 7), "the segments of a body do not stand one after the other"),
        (spoilt("segments", "appears", slice(None), -1), "a thing comes or goes before the first scan"),
        (spoilt("poles", "radius", 1, 0), "pole 1 has no radius"),
        (spoilt("poles", "center", 1, np.inf), "a pole holds a number that is not finite"),
    ],
)
def test_what_cannot_be_read_back_is_not_written(tmp_path: Path, arrays: dict[str, Any], cause: str) -> None:
    path = tmp_path / "world.geojson"
    with pytest.raises(WorldFileError) as caught:
        write_world(path, arrays)

    assert str(caught.value).startswith(f"cannot write {path}: {cause}")
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(WorldFileError, match=r"^cannot read .*none\.geojson: No such file or directory$"):
        read_world(tmp_path / "none.geojson")
    arrays = arrays_from_world(room(6.0, 4.0))
    with pytest.raises(WorldFileError, match=r"^cannot write .*: the folder .* does not exist$"):
        write_world(tmp_path / "nowhere" / "world.geojson", arrays)
    path = tmp_path / "world.geojson"
    path.write_text("mine")
    with pytest.raises(WorldFileError, match=r"exists already; use --overwrite"):
        write_world(path, arrays)
    assert path.read_text() == "mine"
    write_world(path, arrays, overwrite=True)
    assert read_world(path)["segments"]["ends"].shape == (4, 2, 2)
