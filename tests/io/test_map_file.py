"""The map file: lossless, readable, and strict about what it takes in."""

import copy
import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from maps import random_map

from linemap_jax.core.settings import Capacity, preset
from linemap_jax.core.state import LineMap, empty_circles, empty_lines
from linemap_jax.io.map_file import MapFileError, read_map, write_map

SETTINGS: dict[str, Any] = {"preset": "default", "pose_sigma": [0.05, 0.05, 0.0175], "every": 1, "strict": False}


def assert_same_content(slots: Any, others: Any) -> None:
    """Equal to the last bit, in dtype too, slot by slot of those that are used."""
    for field in dataclasses.fields(slots):
        a, b = np.asarray(getattr(slots, field.name)), np.asarray(getattr(others, field.name))
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a[np.asarray(slots.valid)], b[np.asarray(others.valid)])


@pytest.fixture
def x64() -> Any:
    """Both dtypes are at hand."""
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_round_trip_is_lossless(tmp_path: Path, dtype: str) -> None:
    line_map = random_map(dtype)
    write_map(tmp_path / "map.json", line_map, SETTINGS)
    again, settings = read_map(tmp_path / "map.json")
    assert settings == SETTINGS
    assert_same_content(line_map.lines, again.lines)
    assert_same_content(line_map.circles, again.circles)
    assert again.lines.valid.shape == (8,)
    assert again.circles.valid.shape == (4,)
    # and the file of what was read is the file
    write_map(tmp_path / "again.json", again, settings)
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "map.json").read_bytes()


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_geojson_is_lossless_too(tmp_path: Path, dtype: str) -> None:
    line_map = random_map(dtype)
    write_map(tmp_path / "map.geojson", line_map, SETTINGS, geojson=True)
    again, settings = read_map(tmp_path / "map.geojson")
    assert settings == SETTINGS
    assert_same_content(line_map.lines, again.lines)
    assert_same_content(line_map.circles, again.circles)
    # both forms of what was read are the same files again
    for name, geojson in (("map.json", False), ("again.geojson", True)):
        write_map(tmp_path / name, again, settings, geojson=geojson)
    assert (tmp_path / "again.geojson").read_bytes() == (tmp_path / "map.geojson").read_bytes()
    write_map(tmp_path / "direct.json", line_map, SETTINGS)
    assert (tmp_path / "map.json").read_bytes() == (tmp_path / "direct.json").read_bytes()


def test_geojson_as_other_programs_see_it(tmp_path: Path) -> None:
    line_map = random_map("float32")
    write_map(tmp_path / "map.geojson", line_map, {}, geojson=True)
    features = json.loads((tmp_path / "map.geojson").read_text())["features"]
    shapes = [shapely.geometry.shape(feature["geometry"]) for feature in features]
    assert [shape.geom_type for shape in shapes] == ["LineString"] * 5 + ["Point"] * 4
    lengths = np.asarray(line_map.lines.length)[np.asarray(line_map.lines.valid)]
    np.testing.assert_allclose([shape.length for shape in shapes[:5]], lengths, atol=1e-4)
    centers = np.asarray(line_map.circles.center)[np.asarray(line_map.circles.valid)]
    np.testing.assert_allclose([shape.coords[0] for shape in shapes[5:]], centers, atol=1e-5)
    assert {feature["properties"]["kind"] for feature in features[:5]} == {"line"}
    assert {"rho", "theta", "cov", "times_detected"} <= features[0]["properties"].keys()


def test_geojson_that_somebody_has_edited(tmp_path: Path) -> None:
    write_map(tmp_path / "map.geojson", random_map("float32"), {}, geojson=True)
    document = json.loads((tmp_path / "map.geojson").read_text())

    def read(change: Callable[[Any], None]) -> None:
        edited = copy.deepcopy(document)
        change(edited)
        (tmp_path / "edited.geojson").write_text(json.dumps(edited))
        read_map(tmp_path / "edited.geojson")

    read(lambda d: [place.append(0.0) for place in d["features"][0]["geometry"]["coordinates"]])  # a height
    for change, cause in (
        (_set("features", 1, "geometry", "coordinates", 0, 0, 3.0), "lines[1].begin is not where anchor, offset,"),
        (_set("features", 1, "geometry", "coordinates", []), "features[1], a line, must have two positions"),
        (_set("features", 5, "geometry", "type", "Polygon"), "features[5], a circle, must be a Point"),
        (_set("features", 0, "properties", "kind", "tree"), 'must have the kind "line" or "circle", not "tree"'),
        (_set("features", 0, "properties", "kind", ["line"]), 'must have the kind "line" or "circle", not ["line"]'),
        (_drop("features", 0, "properties"), "features[0] must have properties and a geometry"),
        (_drop("features", 0, "properties", "angle"), 'lines[0] has no "angle"'),
        (_drop("features"), '"features" must be a list'),
        (_set("format", "linemap-world"), "is not a map"),
    ):
        with pytest.raises(MapFileError, match=re.escape(cause)):
            read(change)


def test_float32_has_short_decimals_that_are_exact(tmp_path: Path) -> None:
    """The decimal form goes through Python's float64 and must still meet the same float32."""
    rng = np.random.default_rng(2)
    bits = rng.integers(0, 2**32, 4000, dtype=np.uint32).view(np.float32)
    offset = np.concatenate([bits[np.isfinite(bits) & (np.abs(bits) < 1e30)], np.array([0.1, -0.0, 1e-45], np.float32)])
    many = empty_lines(offset.size, jnp.float32)
    lines = dataclasses.replace(many, offset=jnp.asarray(offset), valid=jnp.ones(offset.size, bool))
    write_map(tmp_path / "map.json", LineMap(lines=lines, circles=empty_circles(1, jnp.float32)), {})
    again, _ = read_map(tmp_path / "map.json")
    got = np.asarray(again.lines.offset)[: offset.size]
    np.testing.assert_array_equal(got.view(np.uint32), offset.view(np.uint32))
    assert '"offset": 0.1,' in (tmp_path / "map.json").read_text()


def test_the_file_as_other_tools_see_it(tmp_path: Path) -> None:
    """x = 2 from y = -1 to y = 3, a fitted pole and a cluster; the numbers by hand."""
    lines = dataclasses.replace(
        empty_lines(2, jnp.float32),
        anchor=jnp.array([[0, 0], [2, 1]], jnp.float32),
        cov_independent=jnp.array([[[1, 0], [0, 1]], [[4e-4, 1e-5], [1e-5, 1e-6]]], jnp.float32),
        sqrt_persistent=jnp.array([np.zeros((2, 3)), [[0.02, 0, 0], [0, 0, 0]]], jnp.float32),
        first_angle=jnp.array([0, 0.25], jnp.float32),
        extent=jnp.array([[0, 0], [-2, 2]], jnp.float32),
        times_detected=jnp.array([0, 7]),
        valid=jnp.array([False, True]),
    )
    circles = dataclasses.replace(
        empty_circles(2, jnp.float32),
        center=jnp.array([[1, 2], [3, 4]], jnp.float32),
        radius=jnp.array([0.25, 0.5], jnp.float32),
        cov_independent=jnp.array([np.eye(3), np.zeros((3, 3))], jnp.float32),
        sqrt_persistent=jnp.array([2 * np.eye(3), np.zeros((3, 3))], jnp.float32),
        fitted=jnp.array([True, False]),
        times_detected=jnp.array([1, 2]),
        valid=jnp.array([True, True]),
    )
    write_map(tmp_path / "map.json", LineMap(lines=lines, circles=circles), SETTINGS)
    text = (tmp_path / "map.json").read_text()
    found = json.loads(text)
    assert list(found) == ["format", "version", "dtype", "settings", "lines", "circles"]
    assert (found["format"], found["version"], found["dtype"]) == ("linemap", 1, "float32")
    (line,) = found["lines"]
    assert (line["rho"], line["theta"], line["begin"], line["end"]) == (2.0, 0.0, [2.0, -1.0], [2.0, 3.0])
    # d rho = d offset + (tangent . anchor) d theta, and the tangent's share of the anchor is 1 m
    expected = [[8e-4 + 2 * 1e-5 + 1e-6, 1e-5 + 1e-6], [1e-5 + 1e-6, 1e-6]]
    np.testing.assert_allclose(line["cov"], expected, rtol=1e-6)
    assert (line["times_detected"], line["anchor"], line["offset"], line["angle"]) == (7, [2.0, 1.0], 0.0, 0.0)
    assert (line["cov_local"], line["extent"]) == ([[0.0008, 1e-05], [1e-05, 1e-06]], [-2.0, 2.0])
    assert line["cov_independent"] == [[0.0004, 1e-05], [1e-05, 1e-06]]
    assert (line["sqrt_persistent"], line["first_angle"]) == ([[0.02, 0, 0], [0, 0, 0]], 0.25)
    pole, cluster = found["circles"]
    covariances = {"cov": 5 * np.eye(3), "cov_independent": np.eye(3), "sqrt_persistent": 2 * np.eye(3)}
    assert pole == {"center": [1, 2], "radius": 0.25, "times_detected": 1, "times_contradicted": 0} | {
        name: matrix.tolist() for name, matrix in covariances.items()
    }
    assert cluster == {"center": [3, 4], "radius": 0.5, "times_detected": 2, "times_contradicted": 0}
    # one line of text for each primitive
    assert sum('"rho"' in row for row in text.splitlines()) == 1
    assert sum('"center"' in row for row in text.splitlines()) == 2


def test_empty_map(tmp_path: Path) -> None:
    write_map(tmp_path / "map.json", LineMap(lines=empty_lines(4), circles=empty_circles(4)), {})
    line_map, settings = read_map(tmp_path / "map.json")
    assert settings == {}
    assert line_map.lines.valid.tolist() == [False]
    assert line_map.circles.valid.tolist() == [False]


def test_free_slots_are_those_of_an_empty_map(tmp_path: Path) -> None:
    write_map(tmp_path / "map.json", random_map("float32", lines=3, circles=1), {})
    line_map, _ = read_map(tmp_path / "map.json", capacity=Capacity(lines=10, circles=6))
    for slots, empty, used in ((line_map.lines, empty_lines(10), 3), (line_map.circles, empty_circles(6), 1)):
        for field in dataclasses.fields(slots):
            np.testing.assert_array_equal(getattr(slots, field.name)[used:], getattr(empty, field.name)[used:])
    with pytest.raises(MapFileError, match="holds 3 lines, more than the 2 slots asked for"):
        read_map(tmp_path / "map.json", capacity=Capacity(lines=2, circles=6))


def test_settings_may_be_the_presets_themselves(tmp_path: Path) -> None:
    settings = {**preset("default"), "capacity": Capacity(8, 4), "range_sigma": jnp.float32(0.1), "mount": np.zeros(3)}
    write_map(tmp_path / "map.json", random_map("float32"), settings)
    _, found = read_map(tmp_path / "map.json")
    assert found["thresholds"]["match_nis"] == 9.21
    assert found["rules"]["merge"] is True
    assert (found["capacity"], found["range_sigma"]) == ({"lines": 8, "circles": 4}, 0.1)
    assert found["mount"] == [0.0, 0.0, 0.0]
    with pytest.raises(TypeError, match=r"settings\.log: a PosixPath has no place in JSON"):
        write_map(tmp_path / "other.json", random_map("float32"), {"log": Path("a")})


def test_refuses_an_older_file(tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    write_map(path, random_map("float32"), {"n": 1})
    with pytest.raises(MapFileError, match=r"map\.json exists already; use --overwrite"):
        write_map(path, random_map("float32"), {"n": 2})
    assert read_map(path)[1] == {"n": 1}
    write_map(path, random_map("float32"), {"n": 2}, overwrite=True)
    assert read_map(path)[1] == {"n": 2}


def test_writes_nothing_that_could_not_be_read(tmp_path: Path) -> None:
    good = random_map("float32", free=0)
    nan = dataclasses.replace(good.lines, offset=good.lines.offset.at[2].set(jnp.nan))
    singular = dataclasses.replace(good.lines, cov_independent=good.lines.cov_independent.at[1].set(0))
    causes = (r"lines\[2\]\.rho is not finite", r"lines\[1\]\.cov_independent is not symmetric pos")
    for lines, cause in zip((nan, singular), causes, strict=True):
        with pytest.raises(MapFileError, match=rf"^cannot write .*map\.json: {cause}"):
            write_map(tmp_path / "map.json", LineMap(lines=lines, circles=good.circles), {})
    with pytest.raises(MapFileError, match=r"settings\.noise\.sigma\[1\] is not finite"):
        write_map(tmp_path / "map.json", good, {"noise": {"sigma": [1.0, float("inf")]}})
    assert list(tmp_path.iterdir()) == []


def test_float64_is_not_silently_rounded(tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    write_map(path, random_map("float32"), {})
    path.write_text(path.read_text().replace('"float32"', '"float64"'))
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(MapFileError, match="holds float64 numbers"):
            read_map(path)
        assert read_map(path, dtype="float32")[0].lines.cov.dtype == jnp.float32
    finally:
        jax.config.update("jax_enable_x64", before)


def _set(*keys: Any) -> Callable[[Any], None]:
    """A damage: the last of `keys` is the value put where the others lead."""

    def apply(document: Any) -> None:
        *way, last, value = keys
        for key in way:
            document = document[key]
        document[last] = value

    return apply


def _drop(*keys: Any) -> Callable[[Any], None]:
    def apply(document: Any) -> None:
        *way, last = keys
        for key in way:
            document = document[key]
        del document[last]

    return apply


NOT_POSITIVE = [[1.0, 2.0], [2.0, 1.0]]
NOT_SYMMETRIC = [[1.0, 0.1], [0.2, 1.0]]
DAMAGES = [
    (_set("format", "geojson"), 'is not a map: "format" must be "linemap"'),
    (_drop("format"), "is not a map"),
    (_set("version", 2), "has version 2; this program reads version 1"),
    (_set("version", True), "has version true"),
    (_drop("version"), "has version null"),
    (_set("dtype", "float16"), '"dtype" must be'),
    (_drop("settings"), '"settings" must be an object'),
    (_drop("lines"), '"lines" must be a list'),
    (_set("circles", {}), '"circles" must be a list'),
    (_set("lines", 1, 7), "lines[1] must be an object"),
    (_drop("lines", 1, "angle"), 'lines[1] has no "angle"'),
    (_drop("lines", 0, "rho"), 'lines[0] has no "rho"'),
    (_drop("circles", 1, "radius"), 'circles[1] has no "radius"'),
    (_set("lines", 0, "anchor", [1.0]), "lines[0].anchor must be 2 numbers"),
    (_set("lines", 0, "anchor", [1.0, "2"]), "lines[0].anchor must be 2 numbers"),
    (_set("lines", 0, "offset", [1.0]), "lines[0].offset must be a number"),
    (_set("lines", 0, "offset", True), "lines[0].offset must be a number"),
    (_set("lines", 0, "offset", None), "lines[0].offset must be a number"),
    (_set("lines", 0, "cov_local", [[1.0, 0.0], [0.0]]), "lines[0].cov_local must be 2 by 2 numbers"),
    (_set("lines", 0, "sqrt_persistent", [[1.0, 0.0], [0.0, 1.0]]), "lines[0].sqrt_persistent must be 2 by 3 numbers"),
    (_drop("lines", 0, "cov_independent"), 'lines[0] has no "cov_independent"'),
    (_set("lines", 2, "cov_independent", NOT_POSITIVE), "lines[2].cov_independent is not symmetric positive definite"),
    (_set("lines", 2, "cov_independent", NOT_SYMMETRIC), "lines[2].cov_independent is not symmetric positive definite"),
    (_set("lines", 0, "offset", 1e39), "lines[0].offset is not finite in float32"),
    (_set("lines", 0, "offset", 10**400), "lines[0].offset is not finite in float32"),
    (_set("lines", 2, "cov_local", NOT_POSITIVE), "lines[2].cov_local is not symmetric positive definite"),
    (_set("lines", 2, "cov_local", NOT_SYMMETRIC), "lines[2].cov_local is not symmetric positive definite"),
    (_set("lines", 2, "cov_local", [[0.0, 0.0], [0.0, 1.0]]), "lines[2].cov_local is not symmetric positive definite"),
    (_drop("circles", 0, "sqrt_persistent"), 'circles[0] has no "sqrt_persistent"'),
    (
        _set("circles", 0, "cov_independent", np.zeros((3, 3)).tolist()),
        "circles[0].cov_independent is not symmetric pos",
    ),
    (_set("lines", 2, "cov", NOT_POSITIVE), "lines[2].cov is not symmetric positive definite"),
    (_set("circles", 0, "cov", np.diag([1.0, 1.0, -1.0]).tolist()), "circles[0].cov is not symmetric positive"),
    (_set("circles", 0, "cov", np.zeros((3, 3)).tolist()), "circles[0].cov is not symmetric positive definite"),
    (
        _set("lines", 2, "sqrt_persistent", np.full((2, 3), 1e30).tolist()),
        "lines[2].cov_local is not the sum of its two",
    ),
    (_set("circles", 0, "sqrt_persistent", np.eye(3).tolist()), "circles[0].cov is not the sum of its two parts"),
    (_set("circles", 0, "radius", -0.1), "circles[0].radius is negative"),
    (_set("lines", 0, "extent", [1.0, 0.0]), "lines[0].extent runs backwards"),
    (_set("lines", 0, "var_extent", [1.0, -1.0]), "lines[0].var_extent is negative"),
    (_set("lines", 0, "times_detected", 1.5), "lines[0].times_detected must be a whole number"),
    (_set("lines", 0, "times_contradicted", -1), "lines[0].times_contradicted must be a whole number"),
    (_set("lines", 0, "times_detected", -1), "lines[0].times_detected must be a whole number"),
    (_drop("circles", 0, "times_detected"), "circles[0].times_detected must be a whole number"),
]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("sound") / "map.json"
    write_map(path, random_map("float32", free=0), SETTINGS)
    return json.loads(path.read_text())


@pytest.mark.parametrize(("damage", "cause"), DAMAGES)
def test_names_the_file_and_what_is_wrong(
    tmp_path: Path, sound: dict[str, Any], damage: Callable[[Any], None], cause: str
) -> None:
    document = copy.deepcopy(sound)
    damage(document)
    path = tmp_path / "map.json"
    path.write_text(json.dumps(document))
    with pytest.raises(MapFileError) as caught:
        read_map(path)
    assert str(caught.value).startswith(f"{path}: {cause}")
    assert "\n" not in str(caught.value)


def test_the_sound_file_is_taken(tmp_path: Path, sound: dict[str, Any]) -> None:
    path = tmp_path / "map.json"
    path.write_text(json.dumps(sound | {"remark": "fields that it does not know are left alone"}))
    assert int(read_map(path)[0].lines.valid.sum()) == 5


@pytest.mark.parametrize(
    ("content", "cause"),
    [
        (b"{]", "line 1 is not JSON"),
        (b'{"format": "linemap",\n"version"', "line 2 is not JSON"),
        (b"", "line 1 is not JSON"),
        (b"\xff\xfe", "is not JSON"),
        (b"[" * 100_000, "is not JSON"),
        (b"[1, 2]", "is not a map"),
        (b'{"format": "linemap", "version": ' + b"9" * 5000 + b"}", "has version Infinity"),
        (b'{"format": "linemap", "version": NaN}', "holds NaN, a number that is not finite"),
        (b'{"format": "linemap", "version": -Infinity}', "holds -Infinity, a number that is not finite"),
    ],
)
def test_what_is_no_json(tmp_path: Path, content: bytes, cause: str) -> None:
    path = tmp_path / "map.json"
    path.write_bytes(content)
    with pytest.raises(MapFileError) as caught:
        read_map(path)
    assert str(caught.value).startswith(f"{path}: {cause}")


def test_settings_from_a_file_are_finite_too(tmp_path: Path, sound: dict[str, Any]) -> None:
    path = tmp_path / "map.json"
    path.write_text(json.dumps(sound).replace('"every": 1', '"every": 1e999'))
    with pytest.raises(MapFileError, match=r"settings\.every is not finite"):
        read_map(path)


def test_what_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match=r"^cannot read .*none\.json: No such file or directory$"):
        read_map(tmp_path / "none.json")
    with pytest.raises(MapFileError, match=r"^cannot read .*map\.json: No such file or directory$"):
        read_map(tmp_path)  # of a folder, the map in it
    with pytest.raises(MapFileError, match=r"^cannot write .*map\.json: the folder .* does not exist$"):
        write_map(tmp_path / "nowhere" / "map.json", random_map("float32"), {})
