"""The map as DXF, in metres, for CAD programs: a layer for each kind of thing."""

import os

import ezdxf
import numpy as np
from ezdxf import units
from numpy.typing import ArrayLike

from linemap_jax.core.state import LineMap
from linemap_jax.io.atomic import atomic_write
from linemap_jax.io.shapes import LEVEL, finite_path, half_axes, shapes_of_map, used

LAYERS = {"LINES": 5, "BANDS": 30, "CIRCLES": 4, "ELLIPSES": 40, "PATH": 8}
"""Names of the layers, and their colours: numbers of AutoCAD's table."""

_THINNEST = 1e-6  # ratio of the half axes, below which DXF allows no ellipse


def write_dxf(
    path: str | os.PathLike[str],
    line_map: LineMap,
    trajectory: ArrayLike | None = None,
    *,
    level: float = LEVEL,
    overwrite: bool = False,
) -> None:
    """Write a map as DXF: LINE, CIRCLE, ELLIPSE of fitted circles, LWPOLYLINE of confidence bands and of the path.

    Args:
      path: of the file.
      line_map: the map.
      trajectory: positions of the robot in metres, shape `[T, 2]`, or None.
      level: probability of the confidence bands and ellipses, in (0, 1).
      overwrite: whether an older file may be replaced.

    Raises:
      OutputError: if the file exists and `overwrite` is false, or cannot be written.
    """
    document = ezdxf.new("R2010", units=units.M)  # pyright: ignore[reportPrivateImportUsage]
    for name, colour in LAYERS.items():
        document.layers.add(name, color=colour)
    space = document.modelspace()
    shapes = shapes_of_map(line_map, level)
    for band in shapes.bands:
        space.add_lwpolyline(band.tolist(), close=True, dxfattribs={"layer": "BANDS"})
    for begin, end in shapes.segments.tolist():
        space.add_line(begin, end, dxfattribs={"layer": "LINES"})
    for center, radius in zip(shapes.center.tolist(), shapes.radius.tolist(), strict=True):
        space.add_circle(center, radius, dxfattribs={"layer": "CIRCLES"})
    circles = used(line_map.circles)
    axes = half_axes(np.asarray(circles.cov)[circles.fitted, :2, :2], level)
    for center, (minor, major) in zip(circles.center[circles.fitted].tolist(), axes.swapaxes(1, 2), strict=True):
        ratio = float(np.linalg.norm(minor) / np.linalg.norm(major))
        space.add_ellipse(center, major.tolist(), max(ratio, _THINNEST), dxfattribs={"layer": "ELLIPSES"})
    if len(driven := finite_path(trajectory)):
        space.add_lwpolyline(driven.tolist(), dxfattribs={"layer": "PATH"})
    with atomic_write(path, overwrite=overwrite) as temporary:
        document.saveas(temporary)
