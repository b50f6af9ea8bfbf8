"""Wiping: what is left of a line, by intervals, by triangles and by beams."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from linemap_jax import Capacity, LineMap, Rules, Thresholds, empty_map, update
from linemap_jax.core.frames import reanchor
from linemap_jax.core.mapping import merge_lines
from linemap_jax.core.sensor import points_from_scan
from linemap_jax.core.settings import Mount, SensorNoise
from linemap_jax.core.state import Circles, Lines, Pose, Scan, empty_circles, empty_lines
from linemap_jax.core.wiping import (
    Triangles,
    _two_sums,
    circles_inside_triangles,
    inside_triangles,
    may_have_passed,
    passed_circles,
    passed_through,
    remaining,
    swath_of_scan,
    wipe_lines,
)

remaining_jit = jax.jit(remaining)
swath_jit = jax.jit(swath_of_scan)
passed_jit = jax.jit(passed_through, static_argnames="rules")
NUMBER = st.integers(-40, 40).map(lambda i: i / 8)


def subtract(extent: tuple[float, float], holes: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """One hole after the other out of a list of intervals."""
    left = [extent]
    for low, high in holes:
        cut = []
        for a, b in left:
            if high <= a or low >= b:
                cut.append((a, b))
            else:
                cut += [part for part in ((a, low), (high, b)) if part[1] > part[0]]
        left = cut
    return left


@settings(max_examples=300, deadline=None)
@given(
    st.tuples(NUMBER, st.integers(0, 60)),
    st.lists(st.tuples(NUMBER, st.integers(1, 30), st.booleans()), min_size=6, max_size=6),
)
def test_remaining_is_interval_subtraction(extent: tuple[float, int], holes: list[tuple[float, int, bool]]) -> None:
    begin, length = extent
    end = begin + length / 8
    low = np.array([hole[0] for hole in holes])
    high = low + np.array([hole[1] / 8 for hole in holes])
    counts = np.array([hole[2] for hole in holes])
    gone = (jnp.asarray(low), jnp.asarray(high), jnp.asarray(counts))
    begins, ends, keep = (np.asarray(x) for x in remaining_jit(jnp.array([begin, end]), gone, 0.3))
    found = [(a, b) for a, b, k in zip(begins, ends, keep, strict=True) if k]
    expected = subtract((begin, end), [(a, b) for a, b, c in zip(low, high, counts, strict=True) if c])
    # Holes that touch leave no fragment; eighths of a metre are exact, and none is 0.3
    assert found == [(a, b) for a, b in sorted(expected) if b - a >= 0.3]
    assert np.all(ends >= begins)


BESIDE = 0.07
"""m. So far beside their lines stand the anchors of `lines_of`: what holds for one at the line is not enough."""


def lines_of(*segments: Any, capacity: int = 6) -> Lines:
    """Lines between pairs of points."""
    lines = empty_lines(capacity)
    for i, (begin, end) in enumerate(segments):
        begin, end = np.asarray(begin, float), np.asarray(end, float)
        tangent = (end - begin) / np.linalg.norm(end - begin)
        half = np.linalg.norm(end - begin) / 2
        normal = np.array([tangent[1], -tangent[0]])
        lines = dataclasses.replace(
            lines,
            anchor=lines.anchor.at[i].set((begin + end) / 2 - BESIDE * normal),
            offset=lines.offset.at[i].set(BESIDE),
            angle=lines.angle.at[i].set(np.arctan2(tangent[1], tangent[0]) - np.pi / 2),
            cov_independent=lines.cov_independent.at[i].set(jnp.diag(jnp.array([1e-5, 1e-5]))),
            extent=lines.extent.at[i].set(jnp.array([-half, half])),
            var_extent=lines.var_extent.at[i].set(1e-4),
            times_detected=lines.times_detected.at[i].set(1),
            valid=lines.valid.at[i].set(True),
        )
    return lines


def segments_of(lines: Lines) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(np.asarray(lines.begin[i]), np.asarray(lines.end[i])) for i in np.flatnonzero(lines.valid)]


CORNERS = np.array([[0.5, -1.0], [3.0, -2.5], [3.5, 2.0]])
"""A triangle in the world: the scanner at (0.5, -1), and the base seen from it, counter-clockwise."""


@jax.jit
def wipe_by(lines: Lines, corners: jax.Array) -> Any:
    robot = jnp.array([0.3, -1.1])
    apex = corners[0] - robot
    triangles = Triangles(
        first=(corners[1] - corners[0])[None],
        second=(corners[2] - corners[0])[None],
        own=jnp.array([5]),
        valid=jnp.ones(1, bool),
        apex=apex,
        robot=robot,
    )
    stretches = partial(inside_triangles, triangles=triangles)
    affected = jax.vmap(lambda line, slot: jnp.any(stretches(line, slot)[2]))(lines, jnp.arange(lines.valid.shape[0]))
    return wipe_lines(lines, affected, stretches, one_centimetre, Thresholds(), share_information=True)


def one_centimetre(line: Lines, along: jax.Array) -> jax.Array:
    return jnp.full_like(along, 1e-4)


@pytest.mark.parametrize(
    ("segment", "counts"),
    [
        (([1.5, -1.2], [2.2, -0.6]), (0, 0, 1)),  # inside: deleted
        (([2.5, -0.5], [4.5, -0.4]), (1, 0, 0)),  # one end inside: shortened
        (([2.0, -4.0], [2.2, 3.0]), (0, 1, 0)),  # through two sides: divided
        (([4.5, -1.0], [4.6, 1.0]), (0, 0, 0)),  # outside: kept
        (([4.5, -0.4], [2.5, -0.5]), (1, 0, 0)),  # the other end inside
        (([2.9, -1.0], [3.3, -0.95]), (0, 0, 1)),  # a rest of less than 30 cm goes with it
    ],
)
def test_cases_of_section_6_3_against_shapely(segment: Any, counts: tuple[int, int, int]) -> None:
    before = lines_of(segment)
    lines, wiped = wipe_by(before, jnp.asarray(CORNERS))
    assert (int(wiped.trimmed), int(wiped.split), int(wiped.deleted)) == counts
    assert not wiped.overflow
    rest = shapely.LineString(segment).difference(shapely.Polygon(CORNERS))
    parts = [part for part in getattr(rest, "geoms", [rest]) if part.length >= 0.3]
    found = segments_of(lines)
    assert len(found) == len(parts)
    for part, (begin, end) in zip(
        sorted(parts, key=lambda p: p.project(shapely.Point(segment[0]))), found, strict=True
    ):
        expected = np.array(part.coords)
        np.testing.assert_allclose([begin, end], expected, atol=1e-9)
    for i in np.flatnonzero(lines.valid) if sum(counts) else []:
        # Anchored at its own middle
        np.testing.assert_allclose([lines.extent[i].sum(), lines.offset[i]], 0, atol=1e-9)


def test_random_lines_and_triangles_against_shapely() -> None:
    random = np.random.default_rng(0)
    touched = 0
    for _ in range(60):
        corners, segment = random.uniform(-3, 3, (3, 2)), random.uniform(-3, 3, (2, 2))
        (x, y), (u, v) = corners[1] - corners[0], corners[2] - corners[0]
        corners = corners if x * v - y * u > 0 else corners[[0, 2, 1]]
        lines, wiped = wipe_by(lines_of(segment), jnp.asarray(corners))
        rest = shapely.LineString(segment).difference(shapely.Polygon(corners))
        parts = [part.length for part in getattr(rest, "geoms", [rest])]
        if any(abs(length - 0.3) < 1e-6 for length in parts):
            continue
        cut = int(wiped.trimmed + wiped.split + wiped.deleted)
        touched += cut
        expected = sorted(length for length in parts if length >= 0.3 or not cut)
        np.testing.assert_allclose(sorted(np.asarray(lines.length)[np.asarray(lines.valid)]), expected, atol=1e-9)
    assert touched > 10


def test_a_split_without_a_free_slot_says_so() -> None:
    segment = ([2.0, -4.0], [2.2, 3.0])
    full = lines_of(segment, *[([20.0 + i, 0.0], [20.0 + i, 1.0]) for i in range(5)])
    lines, wiped = wipe_by(full, jnp.asarray(CORNERS))
    assert wiped.overflow
    assert int(lines.valid.sum()) == 6


def circle_at(x: float, y: float, radius: float = 0.1) -> Circles:
    return dataclasses.replace(
        empty_circles(1), center=jnp.array([[x, y]]), radius=jnp.array([radius]), valid=jnp.ones(1, bool)
    )


@pytest.mark.parametrize(("x", "y", "inside"), [(2.0, -1.0, True), (4.0, 0.0, False), (0.4, -1.0, False), (3, 1, True)])
def test_circles_inside_triangles(x: float, y: float, inside: bool) -> None:
    assert shapely.Polygon(CORNERS).contains(shapely.Point(x, y)) == inside
    first, second = CORNERS[1:] - CORNERS[0]
    triangles = Triangles(
        first=jnp.array([first]),
        second=jnp.array([second]),
        own=jnp.array([0]),
        valid=jnp.ones(1, bool),
        apex=jnp.zeros(2),
        robot=jnp.asarray(CORNERS[0]),
    )
    assert bool(circles_inside_triangles(circle_at(x, y), triangles)[0]) == inside
    nothing = dataclasses.replace(triangles, valid=jnp.zeros(1, bool))
    assert not circles_inside_triangles(circle_at(x, y), nothing)[0]


# By beams: a wall at 3 m across +-45 degrees, one beam a degree.
BEARINGS = np.radians(np.arange(-45, 46))
WALL = 3 / np.cos(BEARINGS)
HERE = Pose(mean=jnp.zeros(3), cov=jnp.diag(jnp.array([0.01, 0.01, 0.002])) ** 2)
SCAN_CAPACITY = Capacity(8, 8)


def updated(lines: Lines, ranges: np.ndarray, circles: Circles | None = None) -> tuple[LineMap, Any]:
    line_map = empty_map(Capacity(6, 1))
    line_map = dataclasses.replace(line_map, lines=lines, circles=circles or line_map.circles)
    return update(line_map, Scan.from_ranges(ranges, BEARINGS), HERE, capacity=SCAN_CAPACITY, rules=Rules())


def test_a_line_before_a_seen_wall_vanishes() -> None:
    after, report = updated(lines_of(([2.0, -0.8], [2.0, 0.8])), WALL)
    assert (int(report.deleted), int(report.added)) == (1, 1)
    ((begin, end),) = segments_of(after.lines)
    np.testing.assert_allclose([begin, end], [[3, -3], [3, 3]], atol=1e-6)


def test_a_line_behind_a_seen_wall_stays() -> None:
    after, report = updated(lines_of(([4.0, -0.8], [4.0, 0.8])), WALL)
    assert (int(report.deleted), int(report.trimmed), int(report.split)) == (0, 0, 0)
    assert int(after.lines.valid.sum()) == 2


def test_what_no_beam_passed_stays() -> None:
    # The beams that would have passed it returned nothing.
    after, report = updated(lines_of(([2.0, -0.8], [2.0, 0.8])), np.where(np.abs(BEARINGS) < 0.5, np.nan, WALL))
    assert int(report.deleted) == 0
    assert any(np.allclose(begin, [2.0, -0.8]) for begin, _ in segments_of(after.lines))


def test_an_open_door_is_cut_out_of_a_line() -> None:
    y = 3 * np.tan(BEARINGS)
    ranges = np.where(np.abs(y) < 0.5, 2 * WALL, WALL)
    after, report = updated(lines_of(([3.0, -3.0], [3.0, 3.0])), ranges)
    assert (int(report.split), int(report.deleted)) == (1, 0)
    pieces = sorted((sorted([begin[1], end[1]]) for begin, end in segments_of(after.lines) if abs(begin[0] - 3) < 0.05))
    assert len(pieces) == 2
    # The door's beams stand within one spacing of its posts.
    np.testing.assert_allclose([pieces[0][1], pieces[1][0]], [-0.5, 0.5], atol=3 * np.radians(1.1))
    np.testing.assert_allclose([pieces[0][0], pieces[1][1]], [-3, 3], atol=0.05)


@pytest.mark.parametrize("pose_error", ["independent", "persistent", "unknown"])
def test_a_door_that_opens_and_closes_does_not_make_its_wall_better_known(pose_error: Any) -> None:
    before = lines_of(([3.0, -3.0], [3.0, 3.0]))

    def door(line: Lines, slot: jax.Array) -> Any:
        return jnp.array([-0.5]), jnp.array([1.5]), jnp.array([True])

    wipe = jax.jit(lambda x: wipe_lines(x, x.valid, door, one_centimetre, Thresholds(), share_information=True))
    pieces, _ = wipe(before)
    assert pieces.valid.sum() == 2
    np.testing.assert_allclose(1 / pieces.cov_independent[:2, 1, 1], 1e5 * np.array([2.5, 1.5]) / 4, rtol=1e-6)
    # One of them grows over the other, and they are one again.
    grown = dataclasses.replace(pieces, extent=pieces.extent.at[0, 1].add(4.0))
    touched, alone = jax.tree.map(lambda x: x[:1], grown), jnp.zeros((1, 6), bool)
    merge = jax.jit(merge_lines, static_argnames=("rules", "pose_error"))
    slot = jnp.zeros(1, jnp.int32)
    after, _, merged = merge(grown, touched, slot, alone, Thresholds(), rules=Rules(), pose_error=pose_error)
    assert merged == 1
    again = jax.tree.map(lambda x: x[0], after)
    np.testing.assert_allclose(
        reanchor(again, before.anchor[0]).cov_independent, before.cov_independent[0], rtol=1e-5, atol=1e-11
    )


def test_an_end_that_was_cut_is_as_uncertain_as_the_beams_that_cut_it() -> None:
    y = 3 * np.tan(BEARINGS)
    after, _ = updated(lines_of(([3.0, -3.0], [3.0, 3.0])), np.where(np.abs(y) < 0.5, 2 * WALL, WALL))
    valid = after.lines.valid
    ends = jnp.stack([after.lines.begin, after.lines.end], 1)[valid]
    at_door = jnp.abs(jnp.abs(ends[..., 1]) - 0.5) < 0.1
    assert at_door.sum() == 2
    per_radian = (3**2 + 0.5**2) / 3  # m along the wall
    by_beam = per_radian**2 * (0.001**2 + (BEARINGS[1] - BEARINGS[0]) ** 2 / 12)
    by_pose = 0.01**2 + (3 * 0.002) ** 2
    np.testing.assert_allclose(after.lines.var_extent[valid][at_door], by_beam + by_pose, rtol=0.03)


def test_short_fragments_go_too() -> None:
    # The object's lower 20 cm were out of sight behind nothing at all: no beam there.
    ranges = np.where(BEARINGS < np.arctan(-0.6 / 2), np.nan, WALL)
    after, report = updated(lines_of(([2.0, -0.8], [2.0, 0.8])), ranges)
    assert int(report.deleted) == 1
    assert all(begin[0] > 2.9 for begin, _ in segments_of(after.lines))
    ranges = np.where(BEARINGS < np.arctan(-0.4 / 2), np.nan, WALL)
    after, report = updated(lines_of(([2.0, -0.8], [2.0, 0.8])), ranges)
    assert (int(report.deleted), int(report.trimmed)) == (0, 1)


def test_a_thing_that_was_seen_anew_is_not_gone_though_beams_passed_where_it_was() -> None:
    ranges = np.where(np.abs(BEARINGS) < np.radians(1.5), 2.25, WALL)
    seen = dataclasses.replace(circle_at(2.0, 0.0), times_detected=jnp.ones(1, jnp.int32))
    after, report = updated(lines_of(([9.0, -0.8], [9.0, 0.8])), ranges, seen)
    assert (int(report.deleted), bool(after.circles.valid[0]), int(after.circles.times_detected[0])) == (0, True, 2)
    np.testing.assert_allclose(after.circles.center[0], [2.125, 0.0], atol=1e-3)
    # Nothing is there any more.
    after, report = updated(lines_of(([9.0, -0.8], [9.0, 0.8])), WALL, seen)
    assert (int(report.deleted), bool(after.circles.valid[0])) == (1, False)


@pytest.mark.parametrize(("own", "gone"), [(0, False), (1, True), (-1, True)])
def test_beams_never_wipe_the_line_that_they_measure(own: int, gone: bool) -> None:
    found = lines_of(([3.0, -3.0], [3.0, 3.0]), capacity=1)
    points = points_from_scan(Scan.from_ranges(WALL, BEARINGS), HERE, Mount(), jacobians="analytic")
    swath = swath_jit(points, HERE, jnp.zeros(91, jnp.int32), found, jnp.array([own]), jnp.array([1]), Thresholds())
    line = jax.tree.map(lambda x: x[0], lines_of(([2.8, -1.0], [2.8, 1.0])))
    _, _, which = passed_jit(line, jnp.array(0), swath, HERE.cov, Thresholds(), SensorNoise(), Rules())
    assert bool(which.any()) == gone


def test_a_wall_does_not_wipe_its_own_back() -> None:
    """Beams reach a little behind what they measure, but only what is seen from this side is gone there."""
    found = lines_of(([3.0, -3.0], [3.0, 3.0]), capacity=1)
    points = points_from_scan(Scan.from_ranges(WALL, BEARINGS), HERE, Mount(), jacobians="analytic")
    swath = swath_jit(points, HERE, jnp.zeros(91, jnp.int32), found, jnp.array([1]), jnp.array([1]), Thresholds())

    def wiped(begin: list[float], end: list[float], **rules: bool) -> bool:
        line = jax.tree.map(lambda x: x[0], lines_of((begin, end)))
        which = passed_jit(line, jnp.array(0), swath, HERE.cov, Thresholds(), SensorNoise(), Rules(**rules))[2]
        looked_at = may_have_passed(line, jnp.array(0), swath, Thresholds(), Rules(**rules))
        assert bool(looked_at) == bool(which.any())
        return bool(looked_at)

    near, far, before = (([x, -1.0], [x, 1.0]) for x in (3.03, 3.3, 2.7))
    assert (wiped(*near), wiped(*near[::-1]), wiped(*near[::-1], tell_sides=False)) == (True, False, True)
    assert not wiped(*far)
    # What a beam has seen through is gone, from whatever side it was seen.
    assert wiped(*before)
    assert wiped(*before[::-1])


@pytest.mark.parametrize(
    ("own", "second_range", "gone"),
    [((1, 1), 3.0, True), ((1, 2), 3.0, False), ((1, 2), 3.3, True), ((-1, 2), 3.0, False)],
)
def test_between_two_beams_that_met_different_lines_nothing_is_behind_either(
    own: tuple[int, int], second_range: float, gone: bool
) -> None:
    """Of a wall that is seen edge-on two beams may meet no more than the walls at its corners."""
    found = lines_of(([3.0, -3.0], [3.0, 0.0]), ([3.0, 0.0], [3.0, 3.0]), capacity=2)
    ahead = 45  # the beam at 0 degrees; the one before is at -1
    ranges = np.where(np.arange(91) == ahead, second_range, WALL)
    points = points_from_scan(Scan.from_ranges(ranges, BEARINGS), HERE, Mount(), jacobians="analytic")
    labels = jnp.where(points.index < ahead, 0, 1)
    swath = swath_jit(points, HERE, labels, found, jnp.array(own), jnp.array([1, 1]), Thresholds())
    line = jax.tree.map(lambda x: x[0], lines_of(([3.03, -0.08], [3.03, 0.03])))  # met by these two alone
    which = passed_jit(line, jnp.array(0), swath, HERE.cov, Thresholds(), SensorNoise(), Rules())[2]
    np.testing.assert_array_equal(points.index[:-1][which], [ahead - 1] if gone else [])


@pytest.mark.parametrize(
    ("x", "radius", "gone"),
    # Beams are 3.5 cm apart at 2 m: a pole of 5 cm cannot stand between two of them, one of 1 cm can. One of 4 cm
    # cannot either, but beams that are off by 3 mrad each may have gone past it: 4 - 2 * 0.6 cm is less than 3.5.
    [
        (2.0, 0.1, True),
        (2.95, 0.1, False),
        (4.0, 0.1, False),
        (2.0, 0.025, True),
        (2.0, 0.02, False),
        (2.0, 0.005, False),
    ],
)
def test_circles_that_beams_passed(x: float, radius: float, gone: bool) -> None:
    found = lines_of(([3.0, -3.0], [3.0, 3.0]), capacity=1)
    points = points_from_scan(Scan.from_ranges(WALL, BEARINGS), HERE, Mount(), jacobians="analytic")
    swath = swath_jit(points, HERE, jnp.zeros(91, jnp.int32), found, jnp.array([0]), jnp.array([1]), Thresholds())
    circles = circle_at(x, 0.2, radius)
    assert bool(passed_circles(circles, swath, HERE.cov, Thresholds(), SensorNoise())[0]) == gone


@pytest.mark.parametrize(
    ("x", "known", "gone"),
    [
        (2.92, True, True),  # 8 cm before the wall, and depth is known to 6 cm
        (2.92, False, False),  # what the beams measure may be the thing itself
        (2.95, True, False),  # too near to the wall
        (3.05, True, False),  # behind the wall
    ],
)
def test_a_circle_by_a_wall_is_gone_where_beams_measure_the_wall_behind_it(x: float, known: bool, gone: bool) -> None:
    """Of a circle of 15 cm no beam ends beyond the rim, since the wall stands in it."""
    for ends in (([3.0, -3.0], [3.0, 3.0]), ([3.0, 3.0], [3.0, -3.0])):
        found = lines_of(ends, capacity=1)
        points = points_from_scan(Scan.from_ranges(WALL, BEARINGS), HERE, Mount(), jacobians="analytic")
        own, times = jnp.array([0 if known else -1]), jnp.array([1])
        swath = swath_jit(points, HERE, jnp.zeros(91, jnp.int32), found, own, times, Thresholds())
        circles = circle_at(x, 0.2, 0.15)
        assert bool(passed_circles(circles, swath, HERE.cov, Thresholds(), SensorNoise())[0]) == gone


@pytest.mark.parametrize("n", [1000, (1 << 15) - 1, 1 << 15])
def test_two_counts_in_one_sum(n: int) -> None:
    index = jnp.arange(n)
    for a, b in ((index < 0, index >= 0), (index >= 0, index < 0), (index >= 0, index >= 0), (index < 7, index < 9)):
        assert [int(x) for x in _two_sums(a, b)] == [int(a.sum()), int(b.sum())]


def test_a_circle_stays_where_it_may_stand_between_beams_or_beside_them() -> None:
    """Not gone while it can hide: at the rim of the view, or where beams came back with nothing."""
    pole = circle_at(2.0, 0.0, 0.1)
    for low, high, without, gone in (
        (-45, 46, (), True),
        (1, 46, (), True),
        (2, 46, (), False),  # may be to the right of the first beam
        (-45, -1, (), False),
        (-45, 46, (0, 1, 2), True),  # 14 cm between the beams beside: less than its width
        (-45, 46, (-2, -1, 0, 1, 2), False),
    ):
        degrees = np.arange(low, high)
        ranges = np.where(np.isin(degrees, without), np.nan, 3 / np.cos(np.radians(degrees)))
        for turn in (slice(None), slice(None, None, -1)):
            scan = Scan.from_ranges(ranges[turn], np.radians(degrees)[turn])
            points = points_from_scan(scan, HERE, Mount(), jacobians="analytic")
            n, none = len(degrees), jnp.array([-1])
            swath = swath_jit(points, HERE, jnp.full(n, -1), lines_of(capacity=1), none, none, Thresholds())
            found = passed_circles(pole, swath, HERE.cov, Thresholds(), SensorNoise())
            assert bool(found[0]) == gone, (low, high, without)
    # Behind the robot, where the sweep of a scanner all around begins and ends.
    bearings = np.radians(np.arange(-180, 180))
    points = points_from_scan(Scan.from_ranges(np.full(360, 3.0), bearings), HERE, Mount(), jacobians="analytic")
    swath = swath_jit(points, HERE, jnp.full(360, -1), lines_of(capacity=1), none, none, Thresholds())
    behind = circle_at(-2.0, 0.0, 0.1)
    assert bool(passed_circles(behind, swath, HERE.cov, Thresholds(), SensorNoise())[0])


def test_a_beam_passed_if_it_ended_beyond_the_line_by_the_spread_of_that() -> None:
    """The spread is that of where the point would lie across the line if the beam had ended on it.

    It comes from range, bearing, pose and line; each derivative is numerical. A beam must pass just below that many
    sigmas and must not just above.
    """
    pose, mount, bearing = np.array([0.4, -0.3, 0.2]), np.array([0.3, -0.5, 0.1]), np.array([0.15, 0.2])
    root = np.array([[0.02, 0.0, 0.0], [-0.012, 0.015, 0.0], [0.009, -0.011, 0.006]])
    noise, cov_pose = SensorNoise(range_sigma=0.02, bearing_sigma=0.004), root @ root.T
    line = jax.tree.map(lambda x: x[0], lines_of(([2.5, -3.0], [3.2, 4.0])))
    line = dataclasses.replace(line, cov_independent=jnp.array([[4e-4, 1e-4], [1e-4, 1e-4]]))
    turn = float(line.angle)

    def across(x: np.ndarray) -> np.ndarray:
        """Of the points of both beams; x: pose, range, bearing and line, each with its error."""
        c, s = np.cos(x[2]), np.sin(x[2])
        laser = x[:2] + np.array([[c, -s], [s, c]]) @ mount[:2]
        angle = x[2] + mount[2] + bearing + x[5]
        points = laser + (reach + x[3])[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        return (
            (points - np.asarray(line.anchor)) @ [np.cos(turn + x[7]), np.sin(turn + x[7])] - float(line.offset) - x[6]
        )

    at, reach = np.concatenate([pose, np.zeros(5)]), np.zeros(2)
    here = across(at)
    reach = np.ones(2)
    reach = here / (here - across(at))  # where the beams meet the line
    np.testing.assert_allclose(across(at), 0, atol=1e-12)
    jac = np.stack([(across(at + h) - across(at - h)) / 2e-6 for h in 1e-6 * np.eye(8)], -1)[:, [0, 1, 2, 3, 5, 6, 7]]
    cov = np.zeros((7, 7))
    cov[:3, :3], cov[3, 3], cov[4, 4], cov[5:, 5:] = cov_pose, 0.02**2, 0.004**2, line.cov_independent
    spread = np.sqrt(np.einsum("ki,ij,kj->k", jac, cov, jac))

    beyond = 0.3
    scan = Scan.from_ranges(reach + beyond / np.abs(jac[:, 3]), bearing)
    where = Pose(mean=jnp.asarray(pose), cov=jnp.asarray(cov_pose))
    points = points_from_scan(scan, where, Mount(*mount), jacobians="analytic")
    none = jnp.array([-1])
    swath = swath_jit(points, where, jnp.full(2, -1), lines_of(capacity=1), none, none, Thresholds())
    for sigmas, gone in ((0.999, True), (1.001, False)):
        # Of the two beams the one with the larger spread decides.
        gates = Thresholds(wipe_sigmas=sigmas * beyond / spread.max(), match_distance=0.0)
        assert bool(passed_jit(line, jnp.array(0), swath, where.cov, gates, noise, Rules())[2][0]) == gone


def test_a_line_that_two_beams_passed_is_looked_at() -> None:
    """What is cheap to tell may not say no where something is gone: two beams are enough, one is not."""
    points = points_from_scan(Scan.from_ranges(WALL, BEARINGS), HERE, Mount(), jacobians="analytic")
    none = jnp.array([-1])
    swath = swath_jit(points, HERE, jnp.full(91, -1), lines_of(capacity=1), none, none, Thresholds())
    for end, two in ((0.045, True), (0.025, False)):  # beams at y = 0 and 0.035
        line = jax.tree.map(lambda x: x[0], lines_of(([2.0, -0.01], [2.0, end])))
        gone = passed_jit(line, jnp.array(0), swath, HERE.cov, Thresholds(), SensorNoise(), Rules())[2]
        assert bool(gone.any()) == two
        assert bool(may_have_passed(line, jnp.array(0), swath, Thresholds(), Rules())) == two
