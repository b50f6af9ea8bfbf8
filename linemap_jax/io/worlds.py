"""Worlds as GeoJSON: a FeatureCollection that other tools draw and edit, read back without loss.

Each feature is one thing. Its geometry and the property "kind" say what it is:

    LineString  "wall"      an open chain, both sides are free; the kind may be left out
    Polygon     "room"      the robot drives inside
    Polygon     "obstacle"  solid; the kind may be left out
    Point       "pole"      solid and round, with the property "radius", m; the kind may be left out
    LineString  "path"      way points of the robot; at most one
    Point       "path"      the same, where there is one way point only

The properties "appears" and "vanishes" are the first scan in which a thing is there, and the first in which it is gone;
without them it is there from the first scan on, and for good. Other properties are left alone. Coordinates are metres
in the plane, not degrees of longitude and latitude, in which the file departs from RFC 7946; heights are passed over.

Worlds are plain arrays here, under the names of the fields of `linemap_jax.lab.world.World`:
`world_from_arrays(read_world(path))`, `write_world(path, arrays_from_world(world))`. Whether a world is possible is
another question, `linemap_jax.lab.check.check`.
"""

import itertools
import json
import os
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from linemap_jax.io.atomic import OutputError, atomic_write
from linemap_jax.io.json_file import JsonError, read_json

Columns = dict[str, NDArray[Any]]

FORMAT = "linemap-world"
VERSION = 1

_KINDS = ("wall", "room", "obstacle")  # by the number that the arrays have for them
_NEVER = int(np.iinfo(np.int32).max)  # what vanishes then stays
_DEFAULT_KIND = {"LineString": "wall", "Polygon": "obstacle", "Point": "pole"}


class WorldFileError(ValueError):
    """A world file could not be read or written. The message is one sentence that names the file and the cause."""


class _Fault(ValueError):
    """What is wrong with the content; the file's name is put before it."""


def read_world(path: str | os.PathLike[str], *, dtype: Literal["float32", "float64"] | None = None) -> dict[str, Any]:
    """Read a world.

    Args:
      path: of the file.
      dtype: of the lengths; that of the file unless given, float64 if it does not say.

    Returns:
      "segments": `ends` `[S, 2, 2]`, `body`, `kind`, `appears`, `vanishes`, `valid` `[S]`; "poles": `center` `[C, 2]`,
      `radius`, `appears`, `vanishes`, `valid` `[C]`; "path" `[W, 2]`. Things stand in the order of the file; bodies
      are numbered from 0, poles and path left out.

    Raises:
      WorldFileError: if the file cannot be read, is no GeoJSON of this kind, or a feature is not one of the above; it
        is named by its number, from 0.
    """
    try:
        document = _load(path)
        dtype = dtype or document.get("dtype", "float64")
        if dtype not in ("float32", "float64"):
            raise _Fault('"dtype" must be "float32" or "float64"')
        bodies: list[Columns] = []
        poles: list[tuple[list[float], float, int, int]] = []
        way_points: NDArray[Any] | None = None
        for i, feature in enumerate(document["features"]):
            where = f"features[{i}]"
            kind, points, properties = _read_feature(feature, where, dtype)
            times = _time(properties, "appears", 0, where), _time(properties, "vanishes", _NEVER, where)
            if kind == "pole":
                poles.append((points[0].tolist(), _radius(properties, where, dtype), *times))
            elif kind == "path":
                if way_points is not None:
                    raise _Fault(f"{where} is a second path")
                way_points = points
            else:
                ends = np.stack([points[:-1], points[1:]], 1)
                numbers = (len(bodies), _KINDS.index(kind), *times)
                fixed = zip(("body", "kind", "appears", "vanishes"), numbers, strict=True)
                bodies.append({"ends": ends} | {name: np.full(len(ends), n, np.int32) for name, n in fixed})
    except _Fault as fault:
        raise WorldFileError(f"{os.fspath(path)}: {fault}") from None
    return {
        "segments": _segments(bodies, dtype),
        "poles": {
            "center": np.array([pole[0] for pole in poles], dtype).reshape(-1, 2),
            "radius": np.array([pole[1] for pole in poles], dtype),
            "appears": np.array([pole[2] for pole in poles], np.int32),
            "vanishes": np.array([pole[3] for pole in poles], np.int32),
            "valid": np.ones(len(poles), bool),
        },
        "path": np.zeros((0, 2), dtype) if way_points is None else way_points,
    }


def write_world(path: str | os.PathLike[str], world: Mapping[str, Any], *, overwrite: bool = False) -> None:
    """Write a world, as `read_world` gives it. What cannot be read back is not written.

    Args:
      path: of the file.
      world: its arrays; only what is valid is written, walls, rooms and obstacles first, then poles, then the path.
      overwrite: whether an older file may be replaced.

    Raises:
      WorldFileError: if the file exists and `overwrite` is false, if it cannot be written, or if the world holds
        numbers that are not finite, a body that is no chain of segments of one kind and time, or a pole without a
        radius.
    """
    try:
        features = [*_body_features(world["segments"]), *_pole_features(world["poles"])]
        way_points = np.asarray(world["path"])
        if len(way_points):
            points = _numbers(way_points, "the path")
            line = ("LineString", points) if len(points) > 1 else ("Point", points[0])
            features.append(_feature(*line, {"kind": "path"}))
    except _Fault as fault:
        raise WorldFileError(f"cannot write {os.fspath(path)}: {fault}") from None
    head = {"type": "FeatureCollection", "format": FORMAT, "version": VERSION, "dtype": str(way_points.dtype)}
    text = json.dumps(head, allow_nan=False)[:-1] + ', "features": [\n  '
    text += ",\n  ".join(json.dumps(feature, allow_nan=False) for feature in features) + "\n]}\n"
    try:
        with atomic_write(path, overwrite=overwrite) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
    except OutputError as error:
        raise WorldFileError(str(error)) from error


# --- Reading ---------------------------------------------------------------------------------------------------------


def _load(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The document, its head checked."""
    try:
        document = read_json(path)
    except OSError as error:
        raise WorldFileError(f"cannot read {os.fspath(path)}: {error.strerror or error}") from error
    except JsonError as error:
        raise _Fault(str(error)) from None
    if not isinstance(document, dict) or document.get("type") != "FeatureCollection":
        raise _Fault('is not a world: its "type" must be "FeatureCollection"')
    if document.get("format", FORMAT) != FORMAT or document.get("version", VERSION) != VERSION:
        said = json.dumps([document.get("format", FORMAT), document.get("version", VERSION)])
        raise _Fault(f'has format and version {said}; this program reads ["{FORMAT}", {VERSION}]')
    if not isinstance(document.get("features"), list):
        raise _Fault('"features" must be a list')
    return document


def _read_feature(feature: Any, where: str, dtype: str) -> tuple[str, NDArray[Any], Mapping[str, Any]]:
    """Kind, points `[P, 2]` and properties of a feature; the last point of a closed outline is its first one again."""
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        raise _Fault(f'{where} must be an object of the type "Feature"')
    geometry, properties = feature.get("geometry"), feature.get("properties") or {}
    if not isinstance(geometry, dict) or not isinstance(properties, dict):
        raise _Fault(f"{where} must have a geometry, and properties that are an object")
    shape = geometry.get("type")
    if not isinstance(shape, str) or shape not in _DEFAULT_KIND:
        raise _Fault(f"{where} is a {json.dumps(shape)}; it must be a LineString, a Polygon or a Point")
    kind = properties.get("kind", _DEFAULT_KIND[shape])
    allowed = {"LineString": ("wall", "path"), "Polygon": ("room", "obstacle"), "Point": ("pole", "path")}[shape]
    if kind not in allowed:
        raise _Fault(f"{where}, a {shape}, has the kind {json.dumps(kind)}; it must be {' or '.join(allowed)}")
    coordinates = geometry.get("coordinates")
    if shape == "Polygon":
        if not isinstance(coordinates, list) or len(coordinates) != 1:
            raise _Fault(f"{where} must have one outline; what stands in a room is a feature of its own")
        coordinates = coordinates[0]
    elif shape == "Point":
        coordinates = [coordinates]
    points = _points(coordinates, where, dtype)
    fewest = {"LineString": 2, "Polygon": 4, "Point": 1}[shape]
    if len(points) < fewest:
        raise _Fault(f"{where}, a {shape}, must have {fewest} positions at least")
    if shape == "Polygon" and (points[0] != points[-1]).any():
        raise _Fault(f"{where} is not closed: its last position must be its first one")
    return kind, points, properties


def _points(coordinates: Any, where: str, dtype: str) -> NDArray[Any]:
    if not isinstance(coordinates, list):
        raise _Fault(f"{where} has no coordinates")
    for position in coordinates:
        if not isinstance(position, list) or len(position) < 2 or not all(type(x) in (int, float) for x in position):
            raise _Fault(f"{where} has a position that is not a list of two numbers")
    points = np.array([[_finite(x, where, dtype) for x in position[:2]] for position in coordinates], dtype)
    return points.reshape(-1, 2)


def _finite(number: float, where: str, dtype: str) -> float:
    if not abs(number) <= float(np.finfo(dtype).max):
        raise _Fault(f"{where} holds a number that is not finite in {dtype}")
    return float(number)


def _time(properties: Mapping[str, Any], name: str, default: int, where: str) -> int:
    value = properties.get(name)
    if value is None:
        return default
    if type(value) is not int or not 0 <= value <= _NEVER:
        raise _Fault(f"{where}.properties.{name} must be a whole number, from 0 on, or null")
    return value


def _radius(properties: Mapping[str, Any], where: str, dtype: str) -> float:
    value: Any = properties.get("radius")
    if type(value) not in (int, float) or not _finite(value, where, dtype) > 0:
        raise _Fault(f"{where}, a pole, must have a radius that is a positive number")
    return float(value)


def _segments(bodies: list[Columns], dtype: str) -> Columns:
    none = {name: np.zeros(0, np.int32) for name in ("body", "kind", "appears", "vanishes")}
    parts = [{"ends": np.zeros((0, 2, 2), dtype)} | none, *bodies]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return columns | {"valid": np.ones(len(columns["body"]), bool)}


# --- Writing ---------------------------------------------------------------------------------------------------------


def _valid(columns: Mapping[str, Any]) -> Columns:
    valid = np.asarray(columns["valid"])
    return {name: np.asarray(column)[valid] for name, column in columns.items()}


def _body_features(segments: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    columns = _valid(segments)
    bodies = columns["body"]
    starts = np.flatnonzero(np.diff(bodies, prepend=bodies[:1] - 1))
    if len(np.unique(bodies)) != len(starts):
        raise _Fault("the segments of a body do not stand one after the other")
    for first, last in itertools.pairwise([*starts, len(bodies)]):
        said = f"body {bodies[first]}"
        for name in ("kind", "appears", "vanishes"):
            if (columns[name][first:last] != columns[name][first]).any():
                raise _Fault(f'the segments of {said} differ in "{name}"')
        ends, kind = columns["ends"][first:last], _KINDS[columns["kind"][first]]
        points = _numbers(np.concatenate([ends[:1, 0], ends[:, 1]]), said)
        if (ends[:-1, 1] != ends[1:, 0]).any():
            raise _Fault(f"{said} is not one chain of segments")
        if kind != "wall" and (len(ends) < 3 or points[0] != points[-1]):
            raise _Fault(f"{said} is not closed")
        properties = {"kind": kind, **_times(columns, first)}
        yield _feature(*(("LineString", points) if kind == "wall" else ("Polygon", [points])), properties)


def _pole_features(poles: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    columns = _valid(poles)
    radius = _numbers(columns["radius"], "a pole")
    for i, center in enumerate(_numbers(columns["center"], "a pole")):
        if not radius[i] > 0:
            raise _Fault(f"pole {i} has no radius")
        yield _feature("Point", center, {"kind": "pole", "radius": radius[i], **_times(columns, i)})


def _times(columns: Columns, i: Any) -> dict[str, int]:
    """Only what differs from the default."""
    times = {name: int(columns[name][i]) for name in ("appears", "vanishes")}
    if min(times.values()) < 0:
        raise _Fault("a thing comes or goes before the first scan")
    return {name: time for name, time in times.items() if time != {"appears": 0, "vanishes": _NEVER}[name]}


def _feature(shape: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": shape, "coordinates": coordinates}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def _numbers(array: NDArray[Any], what: str) -> Any:
    """Python numbers whose shortest decimal form gives the array back: 0.1, not 0.10000000149011612, for float32."""
    if not np.isfinite(array).all():
        raise _Fault(f"{what} holds a number that is not finite")
    return (array.astype(str).astype(float) if array.dtype == np.float32 else array).tolist()
