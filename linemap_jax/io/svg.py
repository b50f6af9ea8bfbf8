"""The map as SVG, to scale: one metre is one user unit, and on paper a hundredth of a metre.

Each kind of thing is a layer (as Inkscape has them: a group with a label) that can be hidden: bands, lines, circles,
ellipses, path, scale. All but the scale bar stand in the coordinates of the map, in a group that turns y upwards.
"""

import os
import xml.etree.ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike

from linemap_jax.core.state import LineMap
from linemap_jax.io.atomic import atomic_write
from linemap_jax.io.shapes import LEVEL, Floats, finite_path, shapes_of_map

SCALE = 100
"""One to so many, on paper."""

_SVG = "http://www.w3.org/2000/svg"
_INKSCAPE = "http://www.inkscape.org/namespaces/inkscape"
_MARGIN = 1.0  # m
_LINE = 0.02  # m, width of a drawn line: 0.2 mm on paper
_STYLES = {
    "bands": {"fill": "#E69F00", "fill-opacity": "0.5", "stroke": "none"},
    "path": {"stroke": "#8A8A8A", "stroke-width": f"{_LINE}", "stroke-dasharray": "0.12 0.06"},
    "circles": {"stroke": "#2171B5", "stroke-width": f"{_LINE}"},
    "lines": {"stroke": "#08306B", "stroke-width": f"{2 * _LINE}", "stroke-linecap": "round"},
    "ellipses": {"fill": "#E69F00", "fill-opacity": "0.35", "stroke": "#E69F00", "stroke-width": f"{_LINE / 2}"},
}


def write_svg(
    path: str | os.PathLike[str],
    line_map: LineMap,
    trajectory: ArrayLike | None = None,
    *,
    title: str,
    level: float = LEVEL,
    overwrite: bool = False,
) -> None:
    """Write a map as SVG.

    Args:
      path: of the file.
      line_map: the map.
      trajectory: positions of the robot in metres, shape `[T, 2]`, or None.
      title: of the document.
      level: probability of the confidence bands and ellipses, in (0, 1).
      overwrite: whether an older file may be replaced.

    Raises:
      OutputError: if the file exists and `overwrite` is false, or cannot be written.
    """
    shapes = shapes_of_map(line_map, level)
    driven = finite_path(trajectory)
    reach = shapes.radius[:, None]
    parts = (shapes.segments, shapes.bands, shapes.center - reach, shapes.center + reach, driven)
    points = np.concatenate([np.zeros((0, 2)), *(part.reshape(-1, 2) for part in parts)])
    low, high = (points.min(0), points.max(0)) if len(points) else (np.zeros(2), np.zeros(2))
    low, high = low - _MARGIN, high + _MARGIN
    width, height = high - low

    ET.register_namespace("", _SVG)
    ET.register_namespace("inkscape", _INKSCAPE)
    millimetres = 1000 / SCALE
    root = ET.Element(
        f"{{{_SVG}}}svg",
        width=f"{_number(width * millimetres)}mm",
        height=f"{_number(height * millimetres)}mm",
        viewBox=" ".join(map(_number, (low[0], -high[1], width, height))),
    )
    _child(root, "title").text = title
    world = _child(root, "g", transform="scale(1 -1)", fill="none")
    layers = {name: _layer(world, name, style) for name, style in _STYLES.items()}
    for name, polygons in (("bands", shapes.bands), ("ellipses", shapes.ellipses)):
        for polygon in polygons:
            _child(layers[name], "polygon", points=_places(polygon))
    for ends, times in zip(shapes.segments, shapes.line_times, strict=True):
        (x1, y1), (x2, y2) = (map(_number, end) for end in ends)
        _told(_child(layers["lines"], "line", x1=x1, y1=y1, x2=x2, y2=y2), int(times))
    for center, radius, times in zip(shapes.center, shapes.radius, shapes.circle_times, strict=True):
        cx, cy, r = map(_number, (*center, radius))
        _told(_child(layers["circles"], "circle", cx=cx, cy=cy, r=r), int(times))
    if len(driven):
        _child(layers["path"], "polyline", points=_places(driven))

    bar = _layer(root, "scale", {"fill": "#262626", "font-family": "sans-serif", "font-size": "0.3"})
    x, y = low[0] + 0.3, -low[1] - 0.3
    _child(bar, "rect", x=_number(x), y=_number(y - 0.05), width="1", height="0.05")
    _child(bar, "text", x=_number(x), y=_number(y - 0.12)).text = f"1 m  (1 : {SCALE})"
    with atomic_write(path, overwrite=overwrite) as temporary:
        ET.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)


def _layer(parent: ET.Element, name: str, style: dict[str, str]) -> ET.Element:
    layer = _child(parent, "g", id=name, **style)
    layer.set(f"{{{_INKSCAPE}}}groupmode", "layer")
    layer.set(f"{{{_INKSCAPE}}}label", name)
    return layer


def _child(parent: ET.Element, tag: str, /, **attributes: str) -> ET.Element:
    return ET.SubElement(parent, f"{{{_SVG}}}{tag}", attributes)


def _told(element: ET.Element, times: int) -> None:
    """What a browser shows where the pointer rests."""
    _child(element, "title").text = f"detected {times} times"


def _places(points: Floats) -> str:
    return " ".join(f"{_number(x)},{_number(y)}" for x, y in points)


def _number(x: float) -> str:
    """A length to a tenth of a millimetre."""
    return f"{round(float(x), 4) + 0.0:.10g}"
