"""Two maps made one."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from maps import lines_between, poles_at

from linemap_jax.core.merging import merge_maps
from linemap_jax.core.settings import Rules
from linemap_jax.core.state import LineMap

NO_POLE: list[Any] = []


def map_of(ends: Any, poles: Any = NO_POLE, **options: Any) -> LineMap:
    return LineMap(lines=lines_between(ends, **options), circles=poles_at(poles, times=options.get("times", 10)))


def walls(line_map: LineMap) -> np.ndarray:
    """Begin and end of each line, in the order of the slots."""
    lines = line_map.lines
    return np.stack([lines.begin, lines.end], 1)[np.asarray(lines.valid)]


def with_root(line_map: LineMap, root: float) -> LineMap:
    """The same map, whose error is one that other scans may share, but for a part of it."""
    lines = line_map.lines
    roots = jnp.zeros_like(lines.sqrt_persistent).at[:, 0, 0].set(root)
    return dataclasses.replace(line_map, lines=dataclasses.replace(lines, sqrt_persistent=roots))


def test_nothing_changes_a_map_nor_is_changed() -> None:
    here = map_of([[(0, 0), (4, 0)], [(0, 0.2), (4, 0.2)]], [(2, 2, 0.1)])
    nothing = map_of([])
    for merged, first in ((merge_maps(here, nothing)[0], 0), (merge_maps(nothing, here)[0], 8)):
        lines, circles = merged.lines, merged.circles
        assert lines.valid.shape == (16,)
        assert circles.valid.shape == (8,)
        for slots, own, at in ((lines, here.lines, first), (circles, here.circles, first // 2)):
            for x, y in zip(jax.tree.leaves(slots), jax.tree.leaves(own), strict=True):
                keep = np.asarray(own.valid)
                np.testing.assert_array_equal(np.asarray(x)[at : at + len(y)][keep], np.asarray(y)[keep])
        assert int(lines.valid.sum()) == 2


def test_two_views_of_one_wall_become_one() -> None:
    """Seen 2 cm apart, the second one in the other direction: they are averaged, and the wall is as long as both."""
    a, b = map_of([[(0, 0), (4, 0)]], times=30), map_of([[(7, 0.02), (3, 0.02)]], times=10)
    merged, report = merge_maps(a, b, rules=Rules(tell_sides=False), pose_error="independent")
    ((begin, end),) = walls(merged)
    np.testing.assert_allclose([begin[0], end[0]], [0, 7], atol=1e-4)
    assert int(report.lines_joined) == 1
    assert int(merged.lines.times_detected[0]) == 40
    # Eq. (23) in another form: the information of both adds up, at one anchor. Levers of 0 and 3 m along the line.
    cov = np.diag([0.01, 0.003]) ** 2
    shift = np.array([[1.0, 3.0], [0.0, 1.0]])
    information = np.linalg.inv(cov) + np.linalg.inv(shift @ cov @ shift.T)
    np.testing.assert_allclose(merged.lines.cov[0], np.linalg.inv(information), rtol=1e-6)


def test_two_faces_of_one_partition_stay_two() -> None:
    """What was seen from both sides, as near as it may be; the second map's other line continues the first."""
    a, b = map_of([[(0, 0), (4, 0)]]), map_of([[(4, 0.02), (0, 0.02)], [(3, 0.01), (7, 0.01)]])
    merged, report = merge_maps(a, b)
    np.testing.assert_allclose(walls(merged)[:, :, 0], [[0, 7], [4, 0]], atol=1e-4)
    assert int(report.lines_joined) == 1


def test_covariances_hold_whatever_the_two_have_in_common() -> None:
    """With nothing known of it, two views that share all of their error are no better than one of them."""
    a, b = (with_root(map_of([[(0, 0), (4, 0)]], sigma=(1e-4, 1e-4)), 0.05) for _ in range(2))
    merged, report = merge_maps(a, b)
    assert int(report.lines_joined) == 1
    assert float(jnp.sqrt(merged.lines.cov[0, 0, 0])) == pytest.approx(0.05, rel=0.01)


def test_a_long_line_bridges_the_pieces_of_another_map() -> None:
    pieces = [[(0, 0), (2, 0)], [(3, 0), (5, 0)], [(6, 0), (8, 0)], [(0, 3), (2, 3)]]
    merged, report = merge_maps(map_of(pieces), map_of([[(1, 0.01), (7, 0.01)]]))
    found = walls(merged)
    assert len(found) == 2
    np.testing.assert_allclose(found[:, :, 0], [[0, 8], [0, 2]], atol=1e-4)
    assert int(report.lines_joined) == 3
    assert np.asarray(merged.lines.times_detected)[np.asarray(merged.lines.valid)].tolist() == [40, 10]


def test_walls_that_differ_stay_apart() -> None:
    """Another wall, one that has moved by 8 sigma, and two of one map that lie side by side."""
    a = map_of([[(0, 0), (4, 0)], [(0, 0.03), (4, 0.03)]])
    b = map_of([[(0, 0.15), (4, 0.15)], [(5, 0), (9, 0)], [(0, -2), (0, 2)]])
    merged, report = merge_maps(a, b)
    assert len(walls(merged)) == 5
    assert int(report.lines_joined) == 0


def test_poles() -> None:
    """One in both maps, weighed by how often it was seen; one in each; one in a wall of the other map."""
    a = map_of([[(0, 0), (4, 0)]], [(1, 2, 0.1), (3, 2, 0.1)], times=30)
    b = map_of([[(6, 0), (9, 0)]], [(1.02, 2, 0.1), (2, 0.05, 0.1), (7, 2, 0.1)], times=10)
    merged, report = merge_maps(a, b)
    circles = merged.circles
    centers = np.asarray(circles.center)[np.asarray(circles.valid)]
    np.testing.assert_allclose(centers, [[1.01, 2], [3, 2], [7, 2]], atol=0.006)
    assert (int(report.circles_joined), int(report.circles_left_out)) == (1, 1)
    assert np.asarray(circles.times_detected)[np.asarray(circles.valid)].tolist() == [40, 30, 10]


def test_what_it_refuses() -> None:
    a = map_of([[(0, 0), (4, 0)]])
    with pytest.raises(ValueError, match="pose_error must be 'independent' or 'unknown'"):
        merge_maps(a, a, pose_error="persistent")
    single = jax.tree.map(lambda x: x.astype("float32") if x.dtype == "float64" else x, a)
    with pytest.raises(ValueError, match="one map is float64 and the other float32"):
        merge_maps(a, single)
