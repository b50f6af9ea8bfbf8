"""The map as a page to explore, in one file that needs no network: plotly, its program inside.

Whatever the pointer rests on says what it is; a click in the legend hides or shows a layer; and where the map is given
at several moments, a slider leads through them. The size is bounded: some moments and raw points are left out.
"""

import html
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from plotly import graph_objects as go
from plotly import io as plotly_io

from linemap_jax.core.state import LineMap
from linemap_jax.io.atomic import atomic_write
from linemap_jax.io.map_file import Columns, columns_of_circles, columns_of_lines
from linemap_jax.io.shapes import LEVEL, Floats, outlines, shapes_of_map, sound

MOST_POINTS = 8_000
"""Raw points on the page."""
MOST_NUMBERS = 1_100_000
"""Numbers of all moments together: five bytes each, beside the five megabytes of the program."""

_BAND_STEPS, _CIRCLE_STEPS = 5, 20
_HOVER_STEP, _MOST_HOVER = 0.5, 16  # m between the places of a line that answer to the pointer; how many at most
_MOST_PLACES = 1_000  # of the path
_NO_BUTTONS = ["sendChartToCloud", "select2d", "lasso2d"]
_INK, _SOFT, _GRID = "#262626", "#6B6B6B", "#E6E6E6"


class Moment(NamedTuple):
    """A map on the way."""

    line_map: LineMap
    scans: int  # that it was built from


def write_html(
    path: str | os.PathLike[str],
    moments: Sequence[Moment],
    trajectory: ArrayLike | None = None,
    points: ArrayLike | None = None,
    *,
    title: str,
    level: float = LEVEL,
    overwrite: bool = False,
) -> None:
    """Write a map as a page to explore.

    Args:
      path: of the file.
      moments: the map at several moments, the last of which is the map itself.
      trajectory: positions of the robot in metres, one for each scan, shape `[T, 2]`, or None.
      points: raw points in metres, shape `[P, 2]`, or None.
      title: stands above the map.
      level: probability of the confidence bands and ellipses, in (0, 1).
      overwrite: whether an older file may be replaced.

    Raises:
      OutputError: if the file exists and `overwrite` is false, or cannot be written.
    """
    figure = figure_of_moments(moments, trajectory, points, title=title, level=level)
    body = plotly_io.to_html(
        figure,
        config={
            "scrollZoom": True,
            "displaylogo": False,
            "modeBarButtonsToRemove": _NO_BUTTONS,
            "toImageButtonOptions": {"format": "svg"},
        },
        include_plotlyjs=True,
        full_html=False,
        auto_play=False,
        default_height="100vh",
        div_id="map",
    )
    page = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(title)}</title><style>body{{margin:0}}</style></head>\n<body>{body}</body></html>\n"
    )
    with atomic_write(path, overwrite=overwrite) as temporary:
        temporary.write_text(page, encoding="utf-8", newline="\n")


def figure_of_moments(
    moments: Sequence[Moment],
    trajectory: ArrayLike | None = None,
    points: ArrayLike | None = None,
    *,
    title: str,
    level: float = LEVEL,
) -> go.Figure:
    """The page of `write_html` as a figure of plotly, to show in a notebook."""
    path = np.zeros((0, 2)) if trajectory is None else np.asarray(trajectory, float)
    raw = np.zeros((0, 2)) if points is None else np.asarray(points, float)
    raw = raw[:: max(1, -(-len(raw) // MOST_POINTS))]
    shown = [_traces(moment, path, level) for moment in moments]
    kept = _affordable([sum(_size(trace) for trace in traces) for traces in shown])
    behind = go.Scatter(
        x=_small(raw[:, 0]),
        y=_small(raw[:, 1]),
        mode="markers",
        marker={"size": 3, "color": "#9A9A9A"},
        name="raw points",
        hoverinfo="skip",
        visible=True if len(raw) else "legendonly",
        showlegend=len(raw) > 0,
    )
    figure = go.Figure(data=[behind, *shown[-1]])
    changing = list(range(1, 1 + len(shown[-1])))
    figure.frames = [
        go.Frame(
            name=str(moments[i].scans),
            traces=changing,
            data=[
                {name: trace[name] for name in ("x", "y", "customdata", "text") if trace[name] is not None}
                for trace in shown[i]
            ],
        )
        for i in (kept if len(kept) > 1 else [])
    ]
    last = moments[-1].line_map
    counts = f"{int(np.asarray(last.lines.valid).sum())} lines, {int(np.asarray(last.circles.valid).sum())} circles"
    # The view is that of the whole map, and stays where it is put: moments and layers do not move it.
    traces: list[Any] = [behind, *shown[-1]]
    places = np.concatenate([np.stack([trace.x, trace.y], -1) for trace in traces])
    places = places[np.isfinite(places).all(-1)] if len(places) else places
    low, high = (places.min(0), places.max(0)) if len(places) else (np.full(2, -2.5), np.full(2, 2.5))
    margin = 0.04 * (high - low).max() + 0.1
    ranges = np.stack([low - margin, high + margin], -1).tolist()
    axis = {"gridcolor": _GRID, "zeroline": False, "ticksuffix": " m", "tickfont": {"color": _SOFT}}
    figure.update_layout(
        title={"text": f"<b>{html.escape(title)}</b><br><sup>{counts}</sup>", "font": {"color": _INK}, "x": 0.01},
        font={"family": "sans-serif", "size": 13, "color": _INK},
        xaxis=axis | {"range": ranges[0]},
        yaxis=axis | {"range": ranges[1], "scaleanchor": "x"},
        plot_bgcolor="white",
        hovermode="closest",
        hoverlabel={"align": "left"},
        dragmode="pan",
        margin={"l": 60, "r": 20, "t": 70, "b": 20},
        legend={"itemsizing": "constant", "tracegroupgap": 0},
        sliders=[_slider(figure.frames)] if figure.frames else [],
    )
    return figure


def _slider(frames: Sequence[go.Frame]) -> dict[str, Any]:
    at_once: dict[str, Any] = {
        "mode": "immediate",
        "frame": {"duration": 0, "redraw": False},
        "transition": {"duration": 0},
    }
    return {
        "active": len(frames) - 1,
        "currentvalue": {"prefix": "the map after scan "},
        "pad": {"t": 30, "b": 10},
        "steps": [{"label": frame.name, "method": "animate", "args": [[frame.name], at_once]} for frame in frames],
    }


def _traces(moment: Moment, path: Floats, level: float) -> list[go.Scatter]:
    """The layers of one moment, the lowest first."""
    shapes = shapes_of_map(moment.line_map, level, band_steps=_BAND_STEPS, circle_steps=_CIRCLE_STEPS)
    lines, circles = sound(moment.line_map.lines), sound(moment.line_map.circles)
    lines, circles = columns_of_lines(lines), columns_of_circles(circles)
    percent = f"{level * 100:g} %"
    orange: dict[str, Any] = {
        "fill": "toself",
        "fillcolor": "rgba(230, 159, 0, 0.5)",
        "mode": "lines",
        "hoverinfo": "skip",
    }
    driven = path[: moment.scans]
    driven = np.concatenate([driven[:: max(1, -(-len(path) // _MOST_PLACES))], driven[-1:]])
    at, told_of_line = _places_of_lines(shapes.segments, lines)
    return [
        _trace(_closed(shapes.bands), f"{percent} confidence bands", line={"width": 0}, **orange),
        _trace(
            driven,
            "path of the robot",
            mode="lines",
            line={"color": "#8A8A8A", "width": 1.2},
            hoverinfo="skip",
        ),
        _trace(
            at,
            "lines",
            mode="lines",
            line={"color": "#08306B", "width": 2.5},
            customdata=told_of_line,
            hovertemplate="<b>line</b><br>rho %{customdata[0]:.3f} ± %{customdata[2]:.3f} m<br>"
            "theta %{customdata[1]:.2f} ± %{customdata[3]:.2f}°<br>length %{customdata[4]:.2f} m<br>"
            "detected %{customdata[5]:.0f} times<extra></extra>",
        ),
        _trace(
            _closed(outlines(shapes.center, shapes.radius, _CIRCLE_STEPS)),
            "circles",
            mode="lines",
            line={"color": "#2171B5", "width": 1.5},
            legendgroup="circles",
            hoverinfo="skip",
        ),
        # What answers to the pointer: nothing to be seen, at the centres
        _trace(
            shapes.center,
            "circles",
            mode="markers",
            marker={"opacity": 0, "size": 8, "color": "#2171B5"},
            legendgroup="circles",
            showlegend=False,
            text=_told_of_circles(circles),
            hovertemplate="%{text}<extra></extra>",
        ),
        _trace(
            _closed(shapes.ellipses), f"{percent} confidence ellipses", line={"width": 1, "color": "#E69F00"}, **orange
        ),
    ]


def _trace(places: Floats, name: str, *, customdata: Floats | None = None, **style: Any) -> go.Scatter:
    told = None if customdata is None else _small(customdata)
    return go.Scatter(x=_small(places[:, 0]), y=_small(places[:, 1]), name=name, customdata=told, **style)


def _size(trace: go.Scatter) -> int:
    """About how many numbers a trace is; a letter, with what protects it in the page, is a third of one."""
    numbers: list[Any] = [trace[name] for name in ("x", "y", "customdata")]
    return sum(np.size(x) for x in numbers if x is not None) + sum(map(len, trace["text"] or ())) // 3


def _small(numbers: Floats) -> NDArray[np.float32]:
    """As they are sent: 5 bytes a number in the page, and a resolution of 0.1 mm at 1 km."""
    return numbers.astype(np.float32)


def _closed(polygons: Floats) -> Floats:
    """Polygons `[P, S, 2]` one after the other, each closed, a gap after each. Shape `[P (S + 2), 2]`."""
    gap = np.full_like(polygons[:, :1], np.nan)
    return np.concatenate([polygons, polygons[:, :1], gap], 1).reshape(-1, 2)


def _places_of_lines(segments: Floats, columns: Columns) -> tuple[Floats, Floats]:
    """Places along each line, a gap after each line; and for each place what the line is."""
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=-1)
    count = np.clip(np.ceil(length / _HOVER_STEP), 1, _MOST_HOVER).astype(int) + 1
    line, step = _ragged(count + 1)
    share = np.where(step < count[line], step / np.maximum(count[line] - 1, 1), np.nan)[:, None]
    sigma = np.sqrt(np.diagonal(columns["cov"], axis1=1, axis2=2))
    degrees = np.rad2deg(np.stack([columns["theta"], sigma[:, 1]], -1))
    told = [columns["rho"], degrees[:, 0], sigma[:, 0], degrees[:, 1], length, columns["times_detected"]]
    return (1 - share) * segments[line, 0] + share * segments[line, 1], np.stack(told, -1).astype(float)[line]


def _told_of_circles(columns: Columns) -> list[str]:
    """What each circle is; its accuracy only where it is known."""
    sigma = np.sqrt(np.diagonal(columns["cov"], axis1=1, axis2=2))
    names = ("center", "radius", "times_detected", "fitted")
    return [
        f"<b>{'fitted circle' if fitted else 'cluster of points'}</b><br>at ({x:.3f}, {y:.3f}) m<br>"
        f"radius {radius:.3f} m<br>"
        + ("sigma of x, y, radius: {:.3f}, {:.3f}, {:.3f} m<br>".format(*each) if fitted else "")
        + f"detected {times} times"
        for (x, y), radius, times, fitted, each in zip(*(columns[name].tolist() for name in names), sigma, strict=True)
    ]


def _ragged(count: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Rows of different lengths, one after the other: for each place its row, and its number in the row."""
    row = np.repeat(np.arange(count.size), count)
    return row, np.arange(row.size) - np.repeat(np.cumsum(count) - count, count)


def _affordable(sizes: Sequence[int]) -> list[int]:
    """Which moments there is room for: the last, and as many before it as fit, evenly spread."""
    last = len(sizes) - 1
    for count in range(len(sizes), 1, -1):
        kept = np.rint(np.linspace(0, last, count)).astype(int).tolist()
        if sum(sizes[i] for i in kept) <= MOST_NUMBERS:
            return kept
    return [last]
