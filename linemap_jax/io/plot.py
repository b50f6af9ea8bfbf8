"""The picture of a map: lines, circles, what is known of their accuracy, and where the robot drove.

Blue is the map, the darker the more often a line or circle was detected; orange is uncertainty and nothing else; grey
is the robot. The pair of blue and orange survives every kind of colour-blindness, the order of the blues a copier too.
Everything is to scale: bands, ellipses and circles are drawn in metres and never enlarged.
"""

import math
import os
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import ListedColormap, LogNorm, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, MultipleLocator, NullLocator
from numpy.typing import ArrayLike

from linemap_jax.core.state import Circles, LineMap, Lines
from linemap_jax.io.atomic import atomic_write
from linemap_jax.io.shapes import Floats, ellipses, finite_path, line_bands, outlines, segments, used

DPI = 200
LARGEST = np.array([9.0, 7.0])
"""Largest size of the map itself, width and height, in inches."""
SMALLEST = np.array([4.9, 1.6])
"""Smallest size, so that the legend fits below a narrow map; the rest is empty space."""

INK = "#262626"
SOFT = "#6B6B6B"
GRID = "#E6E6E6"
UNCERTAIN = "#E69F00"  # the orange of Okabe and Ito
ROBOT = "#8A8A8A"
LOST = "#D55E00"  # their vermilion
BLUES = ListedColormap(mpl.colormaps["Blues"](np.linspace(0.45, 1.0, 256)))
STYLE = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#BDBDBD",
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "figure.constrained_layout.use": True,
    "figure.dpi": 90,
    "font.size": 9,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "xtick.color": SOFT,
    "xtick.major.size": 0,
    "ytick.color": SOFT,
    "ytick.major.size": 0,
}
"""Diagrams that go with the maps, in notebooks: `plt.style.use(STYLE)`."""


def plot_map(
    path: str | os.PathLike[str],
    line_map: LineMap,
    trajectory: ArrayLike | None = None,
    *,
    lost: ArrayLike | None = None,
    title: str,
    level: float = 0.95,
    overwrite: bool = False,
) -> None:
    """Write the picture of a map as a PNG file.

    Args:
      path: of the picture.
      line_map: the map.
      trajectory: positions of the robot in metres, shape `[T, 2]`, or None. Rows that are not finite are left out.
      lost: those of them where it did not know where it was, shape `[M, 2]`, or None.
      title: stands above the map, as it is.
      level: probability of the confidence bands and ellipses, in (0, 1).
      overwrite: whether an older file may be replaced.

    Raises:
      OutputError: if the file exists and `overwrite` is false, or cannot be written.
      ValueError: if the level is not in (0, 1) or the trajectory is not of shape `[T, 2]`.
    """
    with atomic_write(path, overwrite=overwrite) as temporary:
        draw_map(line_map, trajectory, lost=lost, title=title, level=level).savefig(temporary, format="png", dpi=DPI)


def draw_map(
    line_map: LineMap,
    trajectory: ArrayLike | None = None,
    *,
    lost: ArrayLike | None = None,
    title: str,
    level: float = 0.95,
) -> Figure:
    """The picture of `plot_map` as a figure, to show or to save otherwise; pyplot does not know of it.

    Raises:
      ValueError: if `level` does not lie between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"level must be between 0 and 1, not {level}")
    path = finite_path(trajectory)

    lines, circles = used(line_map.lines), used(line_map.circles)
    ends = segments(lines)
    reach = circles.radius[:, None]
    frame = _frame(np.concatenate([ends.reshape(-1, 2), circles.center - reach, circles.center + reach, path]))
    times = np.concatenate([lines.times_detected, circles.times_detected])
    most = max(2, int(times.max(initial=1)))
    colour = ScalarMappable(LogNorm(1, most), BLUES)

    figure = Figure(facecolor="white")
    figure.set_layout_engine("none")  # laid out below, whatever the style asks for
    FigureCanvasAgg(figure)
    axes = _draw_frame(figure, frame)
    legend: list[list[Any]] = []
    if lines.valid.size:
        legend.append(_draw_lines(axes, lines, ends, colour, level))
    if circles.valid.size:
        legend.append(_draw_circles(axes, circles, colour, level))
    if len(path):
        legend.append(_draw_path(axes, path, finite_path(lost)))
    beside = _lay_out(figure, axes, frame, legend)
    if times.size:
        _draw_colour_bar(figure, beside, colour, most)
    else:
        beside.remove()
    _draw_head(axes, frame, title, f"{lines.valid.size} lines, {circles.valid.size} circles")
    return figure


class _Frame(NamedTuple):
    """The part of the plane that is shown."""

    low: Floats  # [2], m
    high: Floats  # [2], m
    inches: Floats  # [2], its size on paper
    step: float  # m, between the lines of the grid


def _frame(points: Floats) -> _Frame:
    """The frame of a map that holds these points: a margin, the shape of the map, and the size that paper allows."""
    low, high = (points.min(0), points.max(0)) if len(points) else (np.full(2, -2.5), np.full(2, 2.5))
    size = np.maximum(high - low, 1.0)
    size = size + 0.08 * size.max()
    inches_per_metre = (LARGEST / size).min()
    inches = np.maximum(size * inches_per_metre, SMALLEST)
    center, size = (low + high) / 2, inches / inches_per_metre
    # About one line of the grid an inch.
    return _Frame(center - size / 2, center + size / 2, inches, _round_number(1 / inches_per_metre))


def _round_number(x: float) -> float:
    """The largest of ..., 1, 2, 5, 10, ... that is not larger than `x`, give or take a tenth."""
    power = 10.0 ** math.floor(math.log10(x * 1.1))
    return max(m * power for m in (1, 2, 5) if m * power <= x * 1.1)


def _decimal(x: float, step: float) -> str:
    """A multiple of `step` with the decimals that it needs, and a true minus sign."""
    decimals = max(0, -math.floor(math.log10(step)))
    return f"{round(x, decimals) + 0.0:.{decimals}f}".replace("-", "\N{MINUS SIGN}")


def _draw_frame(figure: Figure, frame: _Frame) -> Axes:
    """Equal axes in metres, with a light grid."""
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(frame.low[0], frame.high[0])
    axes.set_ylim(frame.low[1], frame.high[1])

    def number(x: float, _: int | None = None) -> str:
        return _decimal(x, frame.step)

    for axis, name in ((axes.xaxis, "x (m)"), (axes.yaxis, "y (m)")):
        axis.set_major_locator(MultipleLocator(frame.step))
        axis.set_major_formatter(FuncFormatter(number))
        axis.set_label_text(name, fontsize=9, color=INK)
    axes.tick_params(length=0, labelsize=8, labelcolor=SOFT, pad=4)
    axes.grid(color=GRID, linewidth=0.5)
    axes.set_axisbelow(True)
    axes.set_facecolor("white")
    for spine in axes.spines.values():
        spine.set(color="#BDBDBD", linewidth=0.6)
    return axes


def _draw_lines(axes: Axes, lines: Lines, ends: Floats, colour: ScalarMappable, level: float) -> list[Any]:
    """Lines and their bands; returns what the legend shows."""
    bands = line_bands(lines, level)
    colours = colour.to_rgba(np.asarray(lines.times_detected))
    axes.add_collection(PolyCollection(list(bands), facecolors=UNCERTAIN, alpha=0.5, linewidths=0, zorder=2))
    axes.add_collection(LineCollection(list(ends), colors=colours, linewidths=1.3, zorder=4))
    return [
        Line2D([], [], color=BLUES(0.7), linewidth=1.6, label="line"),
        Patch(facecolor=UNCERTAIN, alpha=0.5, linewidth=0, label=f"{level * 100:g} % confidence band"),
    ]


def _draw_circles(axes: Axes, circles: Circles, colour: ScalarMappable, level: float) -> list[Any]:
    """Circles, and the ellipses of those that have a covariance; returns what the legend shows."""
    center, radius, fitted = (np.asarray(x) for x in (circles.center, circles.radius, circles.fitted))
    edges = np.asarray(colour.to_rgba(np.asarray(circles.times_detected)))
    faces = edges * np.where(fitted[:, None], [1, 1, 1, 0.35], [1, 1, 1, 0])
    axes.add_collection(
        PolyCollection(list(outlines(center, radius)), facecolors=faces, edgecolors=edges, linewidths=0.9, zorder=4)
    )

    handles: list[Any] = []
    if not fitted.all():
        handles.append(_round_handle("none", BLUES(0.7), "cluster of points"))
    if fitted.any():
        handles.append(_round_handle(BLUES(0.7, alpha=0.35), BLUES(0.7), "fitted circle"))
        polygons = ellipses(center[fitted], circles.cov[fitted, :2, :2], level)
        face = to_rgba(UNCERTAIN, 0.35)
        axes.add_collection(
            PolyCollection(list(polygons), facecolors=face, edgecolors=UNCERTAIN, linewidths=0.7, zorder=5)
        )
        handles.append(_round_handle(face, UNCERTAIN, f"{level * 100:g} % confidence ellipse"))
    return handles


def _round_handle(face: Any, edge: Any, label: str) -> Line2D:
    return Line2D([], [], linestyle="none", marker="o", markersize=7, mfc=face, mec=edge, mew=0.9, label=label)


def _draw_path(axes: Axes, path: Floats, lost: Floats) -> list[Any]:
    """Where the robot drove, and was lost; returns what the legend shows."""
    (driven,) = axes.plot(
        *path.T, color=ROBOT, linewidth=0.9, linestyle=(0, (4, 1.5)), label="path of the robot", zorder=3
    )
    style = {"linestyle": "none", "markersize": 6, "markeredgecolor": INK, "markeredgewidth": 1.0, "zorder": 6}
    (start,) = axes.plot(*path[0], marker="o", markerfacecolor="white", label="start", **style)
    (end,) = axes.plot(*path[-1], marker="s", markerfacecolor=INK, label="end", **style)
    if not len(lost):
        return [driven, start, end]
    (astray,) = axes.plot(*lost.T, color=LOST, linestyle="none", marker=".", markersize=3, label="robot lost", zorder=4)
    return [driven, astray, start, end]


def _lay_out(figure: Figure, axes: Axes, frame: _Frame, legend: list[list[Any]]) -> Axes:
    """Place the map and the legend below it, a column for each group; the size of the figure follows.

    Returns:
      Axes for the colour bar.
    """
    width, height = frame.inches
    digits = max(len(_decimal(y, frame.step)) for y in (frame.low[1], frame.high[1]))
    rows = max(map(len, legend), default=0)
    left, right, top, bottom = 0.4 + 0.07 * digits, 0.95, 0.7, 0.6 + 0.2 * rows
    total = np.array([left + width + right, bottom + height + top])
    figure.set_size_inches(*total)

    def inches(x: float, y: float, w: float, h: float) -> tuple[float, float, float, float]:
        return x / total[0], y / total[1], w / total[0], h / total[1]

    axes.set_position(inches(left, bottom, width, height))
    for column, handles in enumerate(legend):
        figure.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=inches(left + 1.85 * column, 0.1 + 0.2 * rows, 0, 0)[:2],
            fontsize=8,
            labelcolor=INK,
            frameon=False,
            borderpad=0,
            borderaxespad=0,
            handlelength=1.8,
        )
    tall = min(height, 3.0)
    return figure.add_axes(inches(left + width + 0.15, bottom + height - tall, 0.11, tall))


def _draw_colour_bar(figure: Figure, beside: Axes, colour: ScalarMappable, most: int) -> None:
    """The scale of the blues."""
    bar = figure.colorbar(colour, cax=beside)
    below = [m * 10**p for p in range(10) for m in (1, 2, 5) if m * 10**p < 0.8 * most]
    bar.locator, bar.minorlocator = FixedLocator([*below, most]), NullLocator()
    bar.formatter = FuncFormatter(lambda x, _: f"{x:.0f}")
    bar.update_ticks()
    bar.outline.set_visible(False)
    beside.tick_params(length=2, width=0.5, labelsize=8, labelcolor=SOFT, color=SOFT)
    bar.set_label("times detected", fontsize=9, color=INK)


def _draw_head(axes: Axes, frame: _Frame, title: str, counts: str) -> None:
    """Above the map: its title, what it holds, and the scale."""

    def at(inches: float) -> float:
        return 1 + inches / frame.inches[1]

    text = {"transform": axes.transAxes, "clip_on": False, "parse_math": False}
    size = min(12.0, 115 * frame.inches[0] / max(len(title), 1))  # a bold letter is about 0.1 inch wide in 12 point
    axes.text(0, at(0.36), title, fontsize=size, fontweight="bold", color=INK, **text)
    axes.text(0, at(0.11), counts, fontsize=9, color=SOFT, **text)

    span = frame.high[0] - frame.low[0]
    length = _round_number(1.5 * span / frame.inches[0])  # about an inch and a half
    share = length / span
    axes.add_artist(
        Line2D(
            [1 - share, 1 - share, 1, 1],
            [at(0.15), at(0.1), at(0.1), at(0.15)],
            transform=axes.transAxes,
            color=INK,
            linewidth=1.2,
            solid_capstyle="butt",
            solid_joinstyle="miter",
            clip_on=False,
        )
    )
    axes.text(1 - share / 2, at(0.17), f"{length:g} m", fontsize=9, color=INK, ha="center", **text)
