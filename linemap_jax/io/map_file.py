"""The map as a JSON file that other tools read, and from which the map comes back without loss.

A line is given twice: as the paper's view, `rho`, `theta`, `cov` of both, `begin`, `end`; and as its state, `anchor`,
`offset`, `angle`, `cov_independent`, `sqrt_persistent`, `first_angle`, `extent`, `var_extent` (the fields of `Lines`),
which alone is read back; `cov_local` is the covariance of offset and angle. A circle has a `cov`, of (x, y, radius),
and its two parts, only if it was fitted. Metres, radians, counter-clockwise. Each line and each circle stands on one
line of the file. The same content can stand there as GeoJSON, see `linemap_jax.io.geojson`.
"""

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from linemap_jax.core.lines import rho_theta
from linemap_jax.core.settings import Capacity
from linemap_jax.core.state import Circles, LineMap, Lines, SlotsT, empty_circles, empty_lines
from linemap_jax.io.atomic import OutputError, atomic_write
from linemap_jax.io.geojson import TYPE, document_from_features, features_from_document
from linemap_jax.io.json_file import JsonError, read_json

Columns = dict[str, NDArray[Any]]
"""Field -> its values of all lines or circles; the first axis counts them, there are no free slots."""

FORMAT = "linemap"
VERSION = 1

_LINE_STATE = {
    "anchor": (2,),
    "offset": (),
    "angle": (),
    "cov_independent": (2, 2),
    "sqrt_persistent": (2, 3),
    "first_angle": (),
    "extent": (2,),
    "var_extent": (2,),
}
_LINE_VIEW = {"rho": (), "theta": (), "cov": (2, 2), "begin": (2,), "end": (2,), "cov_local": (2, 2)}
_CIRCLE = {"center": (2,), "radius": ()}
_FIT_STATE = {"cov_independent": (3, 3), "sqrt_persistent": (3, 3)}
_FIT_VIEW = {"cov": (3, 3)}
_COUNTS = ("times_detected", "times_contradicted")

_ROUNDING = 1e-5
"""How far rounding to float32 may carry a correlation, or the view's, from what it should be; no unit."""


class MapFileError(ValueError):
    """A map file could not be read or written. The message is one sentence that names the file and the cause."""


class _Fault(ValueError):
    """What is wrong with the content; the file's name is put before it."""


def write_map(
    path: str | os.PathLike[str],
    line_map: LineMap,
    settings: Mapping[str, Any],
    *,
    geojson: bool = False,
    overwrite: bool = False,
) -> None:
    """Write a map as JSON. What cannot be read back is not written.

    Args:
      path: of the file.
      line_map: the map; only its valid slots are written.
      settings: what the map was built with. May hold numbers, strings, lists, arrays, mappings, and dataclasses such
        as `Thresholds`.
      geojson: whether it is to be GeoJSON.
      overwrite: whether an older file may be replaced.

    Raises:
      MapFileError: if the file exists and `overwrite` is false, if it cannot be written, or if the map holds numbers
        that are not finite or covariances that are not positive definite.
    """
    try:
        document = {
            "format": FORMAT,
            "version": VERSION,
            "dtype": str(line_map.lines.offset.dtype),
            "settings": plain_settings(settings),
            "lines": _entries_of_lines(line_map.lines),
            "circles": _entries_of_circles(line_map.circles),
        }
        _read_lines(document)
        _read_circles(document)
        if geojson:
            document = features_from_document(document)
    except _Fault as fault:
        raise MapFileError(f"cannot write {os.fspath(path)}: {fault}") from None
    try:
        with atomic_write(path, overwrite=overwrite) as temporary:
            temporary.write_text(_text(document), encoding="utf-8", newline="\n")
    except OutputError as error:
        raise MapFileError(str(error)) from error


def read_map(
    path: str | os.PathLike[str],
    *,
    capacity: Capacity | None = None,
    dtype: Literal["float32", "float64"] | None = None,
) -> tuple[LineMap, dict[str, Any]]:
    """Read a map that `write_map` wrote, in either form.

    Args:
      path: of the file, or of a folder with a `map.json` in it.
      capacity: slots of the map; the next power of two unless given.
      dtype: of the map; that of the file unless given.

    Returns:
      The map, its lines and circles in the order of the file, and the settings.

    Raises:
      MapFileError: if the file cannot be read, is no map or not of this version, lacks a field, holds a wrong one, a
        number that is not finite or a covariance that is not symmetric and positive definite; if it does not fit into
        `capacity`; or if it holds float64 and jax is not set to it.
    """
    try:
        document = _load(path)
        if dtype is not None:
            document["dtype"] = dtype
        lines, circles = _read_lines(document), _read_circles(document)
        if jax.dtypes.canonicalize_dtype(document["dtype"]) != document["dtype"]:
            raise _Fault("holds float64 numbers, and jax is not set to them (set JAX_ENABLE_X64=1, or read as float32)")
        if capacity is None:
            capacity = Capacity(*(_power_of_two(columns["valid"].size) for columns in (lines, circles)))
        line_map = LineMap(
            lines=_fill(empty_lines(capacity.lines, document["dtype"]), lines, "lines"),
            circles=_fill(empty_circles(capacity.circles, document["dtype"]), circles, "circles"),
        )
    except _Fault as fault:
        raise MapFileError(f"{os.fspath(path)}: {fault}") from None
    return line_map, document["settings"]


def columns_of_lines(lines: Lines) -> Columns:
    """What a map file says of each line, field by field: `rho`, `theta`, `cov` of both, `begin`, `end`, and the rest.

    Args:
      lines: of a map; free slots are left out.
    """
    view = dict(zip(_LINE_VIEW, _view(lines), strict=True))
    state = {name: getattr(lines, name) for name in _LINE_STATE}
    counts = {name: getattr(lines, name) for name in _COUNTS}
    return _used({**view, **counts, **state}, lines.valid)


def columns_of_circles(circles: Circles) -> Columns:
    """What a map file says of each circle, field by field, and `fitted`: only of those that are does `cov` count."""
    names = (*_CIRCLE, *_COUNTS, *_FIT_VIEW, *_FIT_STATE, "fitted")
    return _used({name: getattr(circles, name) for name in names}, circles.valid)


@jax.jit  # step by step, each operation would be compiled by itself: a second for the first file
def _view(lines: Lines) -> tuple[jax.Array, ...]:
    """The fields of `_LINE_VIEW`."""
    return *rho_theta(lines), lines.begin, lines.end, lines.cov


def _entries_of_lines(lines: Lines) -> list[dict[str, Any]]:
    return _entries(columns_of_lines(lines))


def _entries_of_circles(circles: Circles) -> list[dict[str, Any]]:
    columns = columns_of_circles(circles)
    fitted = columns.pop("fitted")
    entries = _entries(columns)
    for entry, has_cov in zip(entries, fitted, strict=True):
        if not has_cov:
            for name in (*_FIT_VIEW, *_FIT_STATE):
                del entry[name]
    return entries


def _used(columns: dict[str, Any], valid: Any) -> Columns:
    keep = np.asarray(valid)
    return {name: np.asarray(column)[keep] for name, column in columns.items()}


def _entries(columns: Columns) -> list[dict[str, Any]]:
    """One mapping for each row."""
    plain = [_plain_numbers(column) for column in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*plain, strict=True)]


def _plain_numbers(array: NDArray[Any]) -> Any:
    """Python numbers whose shortest decimal form gives the array back: 0.1, not 0.10000000149011612, for float32."""
    if array.dtype == np.float32:
        array = array.astype(str).astype(np.float64)
    return array.tolist()


def plain_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as a map file holds them: in numbers, strings, lists and mappings alone."""
    return _plain(settings, "settings")


def _plain(value: Any, where: str) -> Any:
    """The value in JSON's own types."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    elif isinstance(value, tuple) and (as_dict := getattr(value, "_asdict", None)):  # a NamedTuple
        value = as_dict()
    elif isinstance(value, np.generic | np.ndarray | jax.Array):
        value = _plain_numbers(np.asarray(value))

    if isinstance(value, Mapping):
        return {str(name): _plain(item, f"{where}.{name}") for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, float) and not np.isfinite(value):
        raise _Fault(f"{where} is not finite")
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise TypeError(f"{where}: a {type(value).__name__} has no place in JSON")


def _text(document: dict[str, Any]) -> str:
    """The document as JSON, each entry of a list on a line of its own."""

    def dump(value: Any, indent: int | None = None) -> str:
        return json.dumps(value, allow_nan=False, indent=indent)

    parts: list[str] = []
    for name, value in document.items():
        if isinstance(value, list):
            body = ",\n    ".join(map(dump, value))
            text = f"[\n    {body}\n  ]" if value else "[]"
        else:
            text = dump(value, indent=2).replace("\n", "\n  ")  # no string holds a bare line feed in JSON
        parts.append(f"  {dump(name)}: {text}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def map_in(path: str | os.PathLike[str]) -> Path:
    """The file that is meant: of a folder, as `linemap build` writes it, the `map.json` in it."""
    path = Path(path)
    return path / "map.json" if path.is_dir() else path


def _load(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The document, its head checked."""
    try:
        document = read_json(map_in(path))
    except OSError as error:
        raise MapFileError(f"cannot read {map_in(path)}: {error.strerror or error}") from error
    except JsonError as error:
        raise _Fault(str(error)) from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise _Fault(f'is not a map: "format" must be "{FORMAT}"')
    if document.get("type") == TYPE:
        try:
            document = document_from_features(document)
        except ValueError as error:
            raise _Fault(str(error)) from None
    version = document.get("version")
    if type(version) is not int or version != VERSION:
        raise _Fault(f"has version {json.dumps(version)}; this program reads version {VERSION}")
    if document.get("dtype") not in ("float32", "float64"):
        raise _Fault('"dtype" must be "float32" or "float64"')
    if not isinstance(document.get("settings"), dict):
        raise _Fault('"settings" must be an object')
    document["settings"] = plain_settings(document["settings"])
    return document


def _read_lines(document: dict[str, Any]) -> Columns:
    """The lines of a document, by the fields of `Lines`."""
    entries = _list_of_objects(document, "lines")
    columns = {
        name: _column(entries, "lines", name, shape, document["dtype"])
        for name, shape in (_LINE_VIEW | _LINE_STATE).items()
    }
    for name in ("cov", "cov_local"):
        _check_cov(columns[name], "lines", name, slack=_ROUNDING)
    _check_cov(columns["cov_independent"], "lines", "cov_independent")
    _check_parts(columns, "lines", "cov_local")
    _check(columns["extent"][:, 0] <= columns["extent"][:, 1], "lines", "extent", "runs backwards")
    _check(columns["var_extent"].min(1) >= 0, "lines", "var_extent", "is negative")
    for name, along in zip(("begin", "end"), columns["extent"].T, strict=True):
        _check_on_line(columns, name, along)
    return {name: columns[name] for name in _LINE_STATE} | _counts(entries, "lines")


def _read_circles(document: dict[str, Any]) -> Columns:
    """The circles of a document, by the fields of `Circles`."""
    entries = _list_of_objects(document, "circles")
    dtype = document["dtype"]
    columns = {name: _column(entries, "circles", name, shape, dtype) for name, shape in _CIRCLE.items()}
    _check(columns["radius"] >= 0, "circles", "radius", "is negative")
    fitted = np.array(["cov" in entry for entry in entries], bool)
    shapes = _FIT_STATE | _FIT_VIEW
    none = {name: np.zeros(shape).tolist() for name, shape in shapes.items()}
    entries = [entry if has_cov else none | entry for entry, has_cov in zip(entries, fitted, strict=True)]
    fits = {name: _column(entries, "circles", name, shape, dtype) for name, shape in shapes.items()}
    _check_cov(fits["cov"], "circles", "cov", exempt=~fitted, slack=_ROUNDING)
    _check_cov(fits["cov_independent"], "circles", "cov_independent", exempt=~fitted)
    _check_parts(fits, "circles", "cov")
    state = {name: fits[name] for name in _FIT_STATE}
    return columns | state | {"fitted": fitted} | _counts(entries, "circles")


def _list_of_objects(document: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    entries = document.get(kind)
    if not isinstance(entries, list):
        raise _Fault(f'"{kind}" must be a list')
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise _Fault(f"{kind}[{i}] must be an object")
    return entries


def _column(entries: list[dict[str, Any]], kind: str, name: str, shape: tuple[int, ...], dtype: str) -> NDArray[Any]:
    """One field of all entries, as an array `[len(entries), *shape]`."""
    column = np.zeros((len(entries), *shape), dtype)
    largest = float(np.finfo(column.dtype).max)
    for i, entry in enumerate(entries):
        if name not in entry:
            raise _Fault(f'{kind}[{i}] has no "{name}"')
        value = np.array(entry[name], dtype=object)
        if value.shape != shape or not all(type(x) in (int, float) for x in value.flat):
            wanted = " by ".join(map(str, shape)) + " numbers" if shape else "a number"
            raise _Fault(f"{kind}[{i}].{name} must be {wanted}")
        if not all(-largest <= x <= largest for x in value.flat):
            raise _Fault(f"{kind}[{i}].{name} is not finite in {dtype}")
        column[i] = value.astype(np.float64)
    return column


def _counts(entries: list[dict[str, Any]], kind: str) -> Columns:
    counts = {"valid": np.ones(len(entries), bool)}
    for name in _COUNTS:
        for i, entry in enumerate(entries):
            times = entry.get(name)
            if type(times) is not int or not 0 <= times <= np.iinfo(np.int32).max:
                raise _Fault(f"{kind}[{i}].{name} must be a whole number, 0 or more")
        counts[name] = np.array([entry[name] for entry in entries], np.int32)
    return counts


def _check_cov(
    cov: NDArray[Any], kind: str, name: str, *, exempt: NDArray[np.bool_] | bool = False, slack: float = 0.0
) -> None:
    """Refuse covariances that are not symmetric positive definite.

    Judged on the correlations, in float64: the units differ within one matrix. `slack` lets eigenvalues of the
    correlations be as small as `-slack`, for a covariance that was derived from a sound one in float32.
    """
    cov = cov.astype(np.float64)
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    sigma = np.sqrt(np.where(variance > 0, variance, 1))
    correlation = cov / (sigma[:, :, None] * sigma[:, None, :])
    symmetric = np.abs(correlation - np.swapaxes(correlation, -1, -2)).max((-2, -1), initial=0) <= _ROUNDING
    definite = (variance > 0).all(-1) & (np.linalg.eigvalsh(correlation).min(-1, initial=1) > -slack)
    _check(symmetric & definite | exempt, kind, name, "is not symmetric positive definite")


def _check_parts(columns: Columns, kind: str, name: str) -> None:
    """Refuse a covariance that is not the sum of its two parts: they alone are read, and somebody has changed them."""
    stated, independent, root = (columns[f].astype(np.float64) for f in (name, "cov_independent", "sqrt_persistent"))
    both = independent + root @ np.swapaxes(root, -1, -2)
    sigma = np.sqrt(np.maximum(np.diagonal(both, axis1=-2, axis2=-1), 0))
    excess = np.abs(stated - both) - _ROUNDING * sigma[:, :, None] * sigma[:, None, :]
    _check(
        excess.max((-2, -1), initial=-np.inf) <= 0,
        kind,
        name,
        "is not the sum of its two parts",
    )


def _check_on_line(columns: Columns, name: str, along: NDArray[Any]) -> None:
    """Refuse an end point that is not where the state has it: the state alone is read, and somebody has moved it."""
    anchor, offset, angle = (columns[field].astype(np.float64) for field in ("anchor", "offset", "angle"))
    normal = np.stack([np.cos(angle), np.sin(angle)], -1)
    tangent = np.stack([-normal[:, 1], normal[:, 0]], -1)
    state = anchor + offset[:, None] * normal + along[:, None] * tangent
    reach = np.abs(anchor).max(-1, initial=0) + np.abs(offset) + np.abs(along)
    near = np.abs(columns[name] - state).max(-1, initial=0) <= 1e-3 + _ROUNDING * reach
    _check(near, "lines", name, "is not where anchor, offset, angle and extent have it")


def _check(good: NDArray[Any], kind: str, name: str, fault: str) -> None:
    if not good.all():
        raise _Fault(f"{kind}[{int(np.argmin(good))}].{name} {fault}")


def _fill(empty: SlotsT, columns: Columns, kind: str) -> SlotsT:
    """The slots of `empty`, the first ones filled."""
    count, capacity = columns["valid"].size, empty.valid.size
    if count > capacity:
        raise _Fault(f"holds {count} {kind}, more than the {capacity} slots asked for")
    filled = {
        name: jnp.asarray(np.concatenate([column, np.asarray(getattr(empty, name))[count:]]))
        for name, column in columns.items()
    }
    return dataclasses.replace(empty, **filled)


def _power_of_two(count: int) -> int:
    return 1 << max(count - 1, 0).bit_length()
