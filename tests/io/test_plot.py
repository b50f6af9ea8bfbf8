"""The picture: to scale, finite, and no trace left in matplotlib."""

import dataclasses
import struct
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from linemap_jax.core.state import Circles, LineMap, Lines, empty_circles, empty_lines
from linemap_jax.io.atomic import OutputError
from linemap_jax.io.plot import STYLE, draw_map, plot_map
from linemap_jax.io.shapes import ellipses, line_bands


def number(x: object) -> jnp.ndarray:
    return jnp.asarray(np.asarray(x), jnp.float32)


def some_map(lines: int = 6, circles: int = 4, size: float = 10.0) -> LineMap:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(lines, 2, 2)) * [[0.02], [0.01]]
    fitted = np.arange(circles) % 2 == 0
    return LineMap(
        lines=Lines(
            anchor=number(rng.uniform(0, size, (lines, 2))),
            offset=number(rng.normal(size=lines) * 0.1),
            angle=number(rng.uniform(-3, 3, lines)),
            cov_independent=number(root @ np.swapaxes(root, -1, -2) + np.eye(2) * 1e-5),
            sqrt_persistent=number(rng.normal(size=(lines, 2, 3)) * [[0.02], [0.01]]),
            first_angle=number(np.zeros(lines)),
            extent=number(np.sort(rng.uniform(-2, 2, (lines, 2)))),
            var_extent=number(np.full((lines, 2), 1e-4)),
            times_detected=jnp.asarray(rng.integers(1, 40, lines), jnp.int32),
            times_contradicted=jnp.zeros(lines, jnp.int32),
            valid=jnp.ones(lines, bool),
        ),
        circles=Circles(
            center=number(rng.uniform(0, size, (circles, 2))),
            radius=number(rng.uniform(0.03, 0.2, circles)),
            cov_independent=number(np.eye(3) * 1e-4 * fitted[:, None, None]),
            sqrt_persistent=number(np.diag([0.02, 0.01, 0.0]) * fitted[:, None, None]),
            fitted=jnp.asarray(fitted),
            times_detected=jnp.asarray(rng.integers(1, 40, circles), jnp.int32),
            times_contradicted=jnp.zeros(circles, jnp.int32),
            valid=jnp.ones(circles, bool),
        ),
    )


def box(width: float, height: float) -> LineMap:
    """Four walls around (0, 0) to (width, height)."""
    half = np.array([height, width, height, width]) / 2
    lines = dataclasses.replace(
        empty_lines(4, jnp.float32),
        anchor=number([[width, height / 2], [width / 2, height], [0, height / 2], [width / 2, 0]]),
        angle=number(np.arange(4) * np.pi / 2),
        cov_independent=number(np.broadcast_to(np.eye(2) * 1e-6, (4, 2, 2))),
        extent=number(np.stack([-half, half], -1)),
        times_detected=jnp.full(4, 3),
        valid=jnp.ones(4, bool),
    )
    return LineMap(lines=lines, circles=empty_circles(1, jnp.float32))


def pixels(path: Path) -> tuple[int, int]:
    """Width and height as the PNG's header states them."""
    head = path.read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">II", head[16:24])


def drawn(figure: Figure) -> list[np.ndarray]:
    """All corners of all polygons and lines of the map."""
    kinds = (PolyCollection, LineCollection)
    collections = [c for c in figure.axes[0].collections if isinstance(c, kinds)]
    return [np.asarray(path.vertices) for c in collections for path in c.get_paths()]


def words(figure: Figure) -> list[str]:
    legends = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return legends + [text.get_text() for text in figure.axes[0].texts]


def test_writes_a_png(tmp_path: Path) -> None:
    path = tmp_path / "map.png"
    plot_map(path, some_map(), np.cumsum(np.ones((20, 2)) * 0.3, 0), title="a map")
    width, height = pixels(path)
    assert 1000 < width < 2300
    assert 1000 < height < 2300
    with pytest.raises(OutputError, match="--overwrite"):
        plot_map(path, some_map(), title="another map")
    plot_map(path, some_map(), title="another map", overwrite=True)


def test_the_picture_shows_where_the_robot_was_lost() -> None:
    path = np.cumsum(np.ones((20, 2)) * 0.3, 0)
    for lost, told in ((path[5:9], True), (path[:0], False), (None, False)):
        figure = draw_map(some_map(), path, lost=lost, title="a map")
        assert ("robot lost" in words(figure)) == told
        shown = [line for line in figure.axes[0].lines if line.get_label() == "robot lost"]
        assert len(shown) == told
        for line in shown:
            np.testing.assert_array_equal(np.stack(line.get_data(), -1), lost)


@pytest.mark.parametrize(("width", "height"), [(5, 3), (3, 5), (100, 70), (100, 2), (2, 100), (0.2, 0.2)])
def test_equal_axes_in_a_figure_of_the_shape_of_the_map(width: float, height: float) -> None:
    figure = draw_map(box(width, height), title="a box")
    axes = figure.axes[0]
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    place = axes.get_position()
    paper_width, paper_height = figure.get_size_inches()
    scale_x = place.width * paper_width / (right - left)
    scale_y = place.height * paper_height / (high - low)
    assert scale_x == pytest.approx(scale_y)
    assert left < 0 < width < right
    assert low < 0 < height < high
    assert 4.5 < paper_width < 11
    assert 2.5 < paper_height < 9
    for other in figure.axes:  # nothing lies outside of the paper
        place = other.get_position()
        assert min(place.x0, place.y0) >= 0
        assert max(place.x1, place.y1) <= 1


def test_lines_and_circles_are_where_they_are() -> None:
    figure = draw_map(box(4, 3), title="a box")
    (lines,) = (c for c in figure.axes[0].collections if isinstance(c, LineCollection))
    ends = np.array([segment for segment in lines.get_segments()])
    expected = [[[4, 0], [4, 3]], [[4, 3], [0, 3]], [[0, 3], [0, 0]], [[0, 0], [4, 0]]]
    np.testing.assert_allclose(ends, expected, atol=1e-6)

    pole = dataclasses.replace(
        empty_circles(1, jnp.float32), center=number([[1, 2]]), radius=number([0.25]), valid=jnp.ones(1, bool)
    )
    figure = draw_map(LineMap(lines=empty_lines(1), circles=pole), title="a pole")
    (outline,) = drawn(figure)
    np.testing.assert_allclose(np.hypot(*(outline - [1, 2]).T), 0.25, rtol=1e-6)


def test_band_is_the_spread_of_the_line_along_its_normal() -> None:
    """By another route: cut the moved line with the normal, and differentiate by differences."""
    lines = some_map().lines
    anchor, offset, angle, cov, extent = (
        np.asarray(x, float) for x in (lines.anchor, lines.offset, lines.angle, lines.cov, lines.extent)
    )
    normal = np.stack([np.cos(angle), np.sin(angle)], -1)
    tangent = np.stack([-np.sin(angle), np.cos(angle)], -1)
    bands = line_bands(lines, 0.95, steps=5)
    for i, share in enumerate(np.linspace(0, 1, 5)):
        s = extent[:, 0] + share * (extent[:, 1] - extent[:, 0])
        at = offset[:, None] * normal + s[:, None] * tangent  # from the anchor

        def cut(step: float, at: np.ndarray = at) -> np.ndarray:
            """How far along the old normal the line with another offset, and with another angle, is met. `[2, K]`."""
            turned = np.stack([np.cos(angle + step), np.sin(angle + step)], -1)
            by_angle = (offset - np.sum(turned * at, -1)) / np.sum(turned * normal, -1)
            return np.stack([offset + step - np.sum(normal * at, -1), by_angle])

        jac = (cut(1e-4) - cut(-1e-4)) / 2e-4
        half = 1.959963985 * np.sqrt(np.einsum("ik,kij,jk->k", jac, cov, jac))[:, None]
        np.testing.assert_allclose(bands[:, i], anchor + at + half * normal, atol=1e-6)
        np.testing.assert_allclose(bands[:, -1 - i], anchor + at - half * normal, atol=1e-6)


def test_ellipse_holds_its_level() -> None:
    cov = np.array([[[4e-4, 1e-4], [1e-4, 1e-4]]])
    (polygon,) = ellipses([[3.0, -1.0]], cov, 0.95)
    d = polygon - [3.0, -1.0]
    distance2 = np.einsum("si,ij,sj->s", d, np.linalg.inv(cov[0]), d)
    np.testing.assert_allclose(distance2, 5.991464547)  # 95 % of chi-square with 2 degrees of freedom


def test_names_the_level_and_counts() -> None:
    figure = draw_map(some_map(6, 4), [[0, 0], [1, 1]], title="cost: $5, gain: $6", level=0.99)
    said = words(figure)
    for text in (
        "99 % confidence band",
        "99 % confidence ellipse",
        "fitted circle",
        "cluster of points",
        "start",
        "end",
    ):
        assert text in said
    assert "cost: $5, gain: $6" in said
    assert "6 lines, 4 circles" in said
    assert sum(text.endswith(" m") for text in said) == 1  # the scale
    assert (figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()) == ("x (m)", "y (m)")


def test_empty_map(tmp_path: Path) -> None:
    plot_map(tmp_path / "map.png", LineMap(lines=empty_lines(4), circles=empty_circles(4)), title="nothing")
    assert pixels(tmp_path / "map.png") > (500, 500)


def test_free_slots_and_what_is_not_finite_leave_no_trace() -> None:
    good = some_map(6, 4)
    lines = dataclasses.replace(
        good.lines,
        anchor=good.lines.anchor.at[1].set(1e6).at[2].set(jnp.nan),
        cov_independent=good.lines.cov_independent.at[3].set(jnp.inf),
        valid=good.lines.valid.at[1].set(False),
    )
    circles = dataclasses.replace(good.circles, radius=good.circles.radius.at[0].set(jnp.nan))
    figure = draw_map(LineMap(lines=lines, circles=circles), [[0, 0], [np.nan, 1], [1, 1]], title="damaged")
    assert "3 lines, 3 circles" in words(figure)
    assert all(np.isfinite(corners).all() for corners in drawn(figure))
    assert np.isfinite([figure.axes[0].get_xlim(), figure.axes[0].get_ylim()]).all()
    assert max(map(abs, figure.axes[0].get_xlim())) < 100


def test_the_number_of_artists_does_not_grow_with_the_map() -> None:
    small, large = draw_map(some_map(6, 4), title=""), draw_map(some_map(2000, 500, 100.0), title="")
    assert len(small.axes[0].get_children()) == len(large.axes[0].get_children())


@pytest.mark.parametrize("level", [0.0, 1.0, -1.0, float("nan")])
def test_refuses_a_level_that_is_no_probability(level: float) -> None:
    with pytest.raises(ValueError, match="level must be between 0 and 1"):
        draw_map(some_map(), title="", level=level)


def test_refuses_a_trajectory_of_another_shape(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"trajectory must be of shape \[T, 2\]"):
        plot_map(tmp_path / "map.png", some_map(), np.zeros((4, 3)), title="")
    assert list(tmp_path.iterdir()) == []


def test_leaves_the_settings_of_matplotlib_alone() -> None:
    before = dict(mpl.rcParams)
    draw_map(some_map(), title="a map")
    assert dict(mpl.rcParams) == before


def test_a_map_is_laid_out_alike_within_the_style_of_diagrams() -> None:
    with mpl.rc_context(STYLE):
        within = draw_map(some_map(), title="a map")
        within.draw_without_rendering()  # a layout engine would place the axes now
    plain = draw_map(some_map(), title="a map")
    np.testing.assert_array_equal(within.get_size_inches(), plain.get_size_inches())
    for mine, other in zip(within.axes, plain.axes, strict=True):
        np.testing.assert_array_equal(mine.get_position().bounds, other.get_position().bounds)


def test_pyplot_is_not_loaded_and_the_package_loads_no_matplotlib() -> None:
    code = """
import sys
import linemap_jax, linemap_jax.io.map_file
assert "matplotlib" not in sys.modules
from linemap_jax.core.state import LineMap, empty_circles, empty_lines
from linemap_jax.io.plot import draw_map
draw_map(LineMap(lines=empty_lines(1), circles=empty_circles(1)), title="")
assert "matplotlib.pyplot" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
