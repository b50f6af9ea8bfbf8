"""The map file as GeoJSON, which tools for geographic data draw: the same content, each primitive a feature.

A line is a LineString from `begin` to `end` with the property "kind": "line", a circle a Point at its `center` with
"kind": "circle". What else a map file says of it stands in the properties; format, version, dtype and settings stand
beside the features. Coordinates are metres in the plane, not degrees of longitude and latitude, in which the file
departs from RFC 7946.

`linemap_jax.io.map_file` writes and reads both forms; here one becomes the other.
"""

import json
from typing import Any

TYPE = "FeatureCollection"

_GEOMETRY = {"line": "LineString", "circle": "Point"}
_LIST = {"line": "lines", "circle": "circles"}


def features_from_document(document: dict[str, Any]) -> dict[str, Any]:
    """The document of a map file, its lists of lines and circles as features: lines first."""
    features = []
    for kind, entries in ((kind, document[name]) for kind, name in _LIST.items()):
        for entry in entries:
            places = [entry["begin"], entry["end"]] if kind == "line" else entry["center"]
            rest = {name: value for name, value in entry.items() if name not in ("begin", "end", "center")}
            features.append(
                {
                    "type": "Feature",
                    "properties": {"kind": kind, **rest},
                    "geometry": {"type": _GEOMETRY[kind], "coordinates": places},
                }
            )
    head = {name: value for name, value in document.items() if name not in _LIST.values()}
    return {"type": TYPE, **head, "features": features}


def document_from_features(document: dict[str, Any]) -> dict[str, Any]:
    """The way back. Positions may have a height, which is passed over, as other programs add one.

    Raises:
      ValueError: if a feature is neither a line nor a circle; it is named by its number, from 0.
    """
    features = document.get("features")
    if not isinstance(features, list):
        raise ValueError('"features" must be a list')
    lists: dict[str, list[dict[str, Any]]] = {name: [] for name in _LIST.values()}
    for i, feature in enumerate(features):
        properties, geometry = (
            (feature.get(name) if isinstance(feature, dict) else None) for name in ("properties", "geometry")
        )
        if not isinstance(properties, dict) or not isinstance(geometry, dict):
            raise ValueError(f"features[{i}] must have properties and a geometry")
        kind = properties.get("kind")
        if not isinstance(kind, str) or kind not in _LIST:
            raise ValueError(f'features[{i}] must have the kind "line" or "circle", not {json.dumps(kind)}')
        places = geometry.get("coordinates")
        if geometry.get("type") != _GEOMETRY[kind] or not isinstance(places, list):
            raise ValueError(f"features[{i}], a {kind}, must be a {_GEOMETRY[kind]}")
        if kind == "line":
            if len(places) != 2 or not all(isinstance(place, list) for place in places):
                raise ValueError(f"features[{i}], a line, must have two positions")
            where = {"begin": places[0][:2], "end": places[1][:2]}
        else:
            where = {"center": places[:2]}
        rest = {name: value for name, value in properties.items() if name != "kind"}
        lists[_LIST[kind]].append(where | rest)
    head = {name: value for name, value in document.items() if name not in ("type", "features")}
    return head | lists
