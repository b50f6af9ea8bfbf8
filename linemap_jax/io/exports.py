"""The formats that a map can be written in, in one table: what each is called, what it needs, and who writes it."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from numpy.typing import ArrayLike

from linemap_jax.core.state import LineMap

LOG_NEEDED = frozenset({"nav2", "tum"})
"""Formats that cannot be made from a map alone."""


@dataclass(frozen=True, kw_only=True)
class Content:
    """What there is to write: a map, and what a log adds to it."""

    line_map: LineMap
    settings: Mapping[str, Any]
    title: str
    timestamps: ArrayLike | None = None  # [T] s
    poses: ArrayLike | None = None  # [T, 3] x, y, theta: m, m, rad
    pose_frame: Literal["laser", "robot"] = "robot"  # whose poses they are
    points: ArrayLike | None = None  # [P, 2] m, raw points
    grid: tuple[ArrayLike, ArrayLike, float] | None = None  # cells [H, W], origin [2] m, resolution m

    @property
    def positions(self) -> Any:
        """Of the robot, `[T, 2]`, or None."""
        import numpy as np

        return None if self.poses is None else np.asarray(self.poses)[:, :2]


Write = Callable[[Path, Content, bool], None]


class Format(NamedTuple):
    """A format to write."""

    ending: str
    write: Write


# The libraries behind the formats are loaded when they are used.


def _json(path: Path, content: Content, overwrite: bool) -> None:
    from linemap_jax.io.map_file import write_map

    write_map(path, content.line_map, content.settings, overwrite=overwrite)


def _geojson(path: Path, content: Content, overwrite: bool) -> None:
    from linemap_jax.io.map_file import write_map

    write_map(path, content.line_map, content.settings, geojson=True, overwrite=overwrite)


def _svg(path: Path, content: Content, overwrite: bool) -> None:
    from linemap_jax.io.svg import write_svg

    write_svg(path, content.line_map, content.positions, title=content.title, overwrite=overwrite)


def _dxf(path: Path, content: Content, overwrite: bool) -> None:
    from linemap_jax.io.dxf import write_dxf

    write_dxf(path, content.line_map, content.positions, overwrite=overwrite)


def _nav2(path: Path, content: Content, overwrite: bool) -> None:
    from linemap_jax.io.nav2 import write_nav2

    assert content.grid is not None
    write_nav2(path, *content.grid, overwrite=overwrite)


def _mcap(path: Path, content: Content, overwrite: bool) -> None:
    from linemap_jax.io.mcap import write_mcap

    write_mcap(path, content.line_map, content.timestamps, content.poses, overwrite=overwrite)


def _tum(path: Path, content: Content, overwrite: bool) -> None:
    from linemap_jax.io.tum import write_tum

    assert content.timestamps is not None
    assert content.poses is not None
    write_tum(path, content.timestamps, content.poses, pose_frame=content.pose_frame, overwrite=overwrite)


def _png(path: Path, content: Content, overwrite: bool) -> None:
    from linemap_jax.io.plot import plot_map

    plot_map(path, content.line_map, content.positions, title=content.title, overwrite=overwrite)


def _html(path: Path, content: Content, overwrite: bool) -> None:
    from linemap_jax.io.html import Moment, write_html

    scans = 0 if content.positions is None else len(content.positions)
    moments = [Moment(content.line_map, scans)]
    write_html(path, moments, content.positions, content.points, title=content.title, overwrite=overwrite)


FORMATS: dict[str, Format] = {
    "json": Format(".json", _json),
    "geojson": Format(".geojson", _geojson),
    "svg": Format(".svg", _svg),
    "dxf": Format(".dxf", _dxf),
    "nav2": Format(".yaml", _nav2),
    "mcap": Format(".mcap", _mcap),
    "tum": Format(".tum", _tum),
    "png": Format(".png", _png),
    "html": Format(".html", _html),
}
"""All formats, by name."""


def files_of(name: str, path: str | os.PathLike[str]) -> list[Path]:
    """The files that a format writes for a path."""
    from linemap_jax.io.nav2 import files_of_nav2

    return list(files_of_nav2(path)) if name == "nav2" else [Path(path)]


def format_of(path: str | os.PathLike[str]) -> str | None:
    """The format that the ending of a file's name stands for, or None."""
    ending = Path(path).suffix.lower()
    return next((name for name, format in FORMATS.items() if format.ending == ending), None)
