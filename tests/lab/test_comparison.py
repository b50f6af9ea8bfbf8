"""What has changed from one map to another."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from maps import lines_between, poles_at
from scipy import stats

from linemap_jax.core.state import LineMap, Pose, Scan
from linemap_jax.lab.comparison import Change, Comparison, agreement, compare_maps, holm, looked_through, without_moved

SIGMA = 0.01, 0.003
ROOM = [(-5, -4), (5, -4), (5, 4), (-5, 4)]


def outline(corners: Any) -> np.ndarray:
    corners = np.asarray(corners, float)
    return np.stack([corners, np.roll(corners, -1, 0)], 1)


def box(x: float, y: float, size: float = 1.0) -> np.ndarray:
    return outline([(x, y), (x + size, y), (x + size, y + size), (x, y + size)])


def seen(*parts: np.ndarray, seed: int = 0, poles: Any = (), times: int = 10) -> LineMap:
    """A map of walls, each line with an error that its covariance tells of."""
    ends = np.concatenate([outline(ROOM), *parts])
    rng = np.random.default_rng(seed)
    step = ends[:, 1] - ends[:, 0]
    half = np.linalg.norm(step, axis=-1, keepdims=True) / 2
    tangent = step / (2 * half)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], -1)
    offset, turn = (rng.normal(0, sigma, (len(ends), 1)) for sigma in SIGMA)
    ends = ends + np.stack([offset * normal - turn * half * normal, offset * normal + turn * half * normal], 1)
    ends = ends[:, ::-1] if seed % 2 else ends  # the other way round
    centers = np.reshape(poles, (-1, 3)) + rng.normal(0, 0.01, (len(poles), 1)) * [1, 1, 0]
    circles = poles_at(centers)
    return LineMap(lines=lines_between(ends, sigma=SIGMA, times=times, room=32), circles=circles)


def told(found: Comparison, what: str, kind: str = "line") -> list[Change]:
    return [change for change in found.changes if (change.what, change.kind) == (what, kind)]


def test_one_box_moved_and_one_vanished() -> None:
    poles = [(4, 3, 0.15), (-4, 3, 0.15), (-4, -3, 0.15)]
    before = seen(box(-2, 0), box(1, 0), poles=poles, seed=0)
    after = seen(box(-1.7, 0), poles=[poles[0], (-4, 3.2, 0.15)], seed=1)
    found = compare_maps(before, after)

    moved = told(found, "moved")
    assert len(moved) == 4
    for change in moved:
        assert change.shift == pytest.approx((0.3, 0.0), abs=0.05)
        assert change.p is not None
        assert change.p < 1e-6
        assert change.sigma == pytest.approx(math.sqrt(2) * SIGMA[0], rel=0.1)
        assert change.slot_a in range(4, 8)
    # two of them across their direction, two along it
    assert sum(abs(change.begin[0] - change.end[0]) < 0.1 for change in moved) == 2
    gone = told(found, "vanished")
    assert {change.slot_a for change in gone} == {8, 9, 10, 11}
    assert all(math.dist(change.begin, change.end) == pytest.approx(1, abs=0.01) for change in gone)
    assert told(found, "appeared") == []
    assert found.same_lines == 4
    (pole,) = told(found, "moved", "circle")
    assert pole.shift == pytest.approx((0, 0.2), abs=0.05)
    (pole,) = told(found, "vanished", "circle")
    assert pole.begin == pytest.approx((-4, -3), abs=0.05)
    assert found.same_circles == 1

    back = compare_maps(after, before)
    assert [len(told(back, what)) for what in ("moved", "vanished", "appeared")] == [4, 0, 4]
    assert all(change.shift == pytest.approx((-0.3, 0.0), abs=0.05) for change in told(back, "moved"))


def test_a_box_that_was_turned() -> None:
    def turned(angle: float) -> np.ndarray:
        rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        return outline((rotation @ np.array([(-1, -0.5), (1, -0.5), (1, 0.5), (-1, 0.5)]).T).T)

    found = compare_maps(seen(turned(0.1)), seen(turned(0.5), seed=1))
    assert [change.what for change in found.changes] == 4 * ["moved"]
    for change in found.changes:
        assert change.turn == pytest.approx(0.4, abs=0.02)
        assert change.shift == pytest.approx((0, 0), abs=0.1)
        assert change.slot_a == change.slot_b
    # Farther than that it is another one.
    found = compare_maps(seen(turned(0.0)), seen(turned(0.7), seed=1))
    assert [len(told(found, what)) for what in ("moved", "vanished", "appeared")] == [0, 4, 4]


def test_a_door_that_was_opened_and_a_line_that_was_seen_farther() -> None:
    def wall(*spans: tuple[float, float]) -> np.ndarray:
        return np.array([[(low, 1.0), (high, 1.0)] for low, high in spans])

    found = compare_maps(seen(wall((-4, 4))), seen(wall((-4, -1), (0, 4)), seed=1))
    (gap,) = told(found, "vanished")
    assert sorted((gap.begin[0], gap.end[0])) == pytest.approx([-1, 0], abs=0.01)
    assert len(found.changes) == 1

    found = compare_maps(seen(wall((-4, 0))), seen(wall((-4, 3)), seed=1))
    (more,) = found.changes
    assert (more.what, sorted((more.begin[0], more.end[0]))) == ("appeared", pytest.approx([0, 3], abs=0.01))


def test_a_piece_of_a_wall_that_is_held_once_more_has_not_moved() -> None:
    """It turns away from the wall, as such pieces do, by much more than its sigmas."""
    piece = np.array([[(1.0, -3.98), (1.7, -3.93)]])
    before, after = seen(piece), seen(seed=1)
    assert compare_maps(before, after).changes == []
    assert compare_maps(after, before).changes == []
    assert compare_maps(before, after).same_lines == 5
    # Where the wall itself is gone, so is its piece.
    gone = dataclasses.replace(after.lines, valid=after.lines.valid & (jnp.arange(32) != 0))
    assert len(told(compare_maps(before, dataclasses.replace(after, lines=gone)), "vanished")) == 2


def test_the_most_likely_partner_is_tested() -> None:
    """A line between two: the nearer one is known far too well to be it."""
    there, near, far = ([[(-1.0, y), (1.0, y)]] for y in (0.0, 0.2, 0.3))
    exact, loose = (lines_between(near, sigma=(0.002, 0.001)), lines_between(far, sigma=(0.06, 0.02)))
    both = jax.tree.map(lambda x, y: jnp.concatenate([x[:1], y[:1]]), exact, loose)
    maps = [LineMap(lines=x, circles=poles_at([])) for x in (lines_between(there, sigma=(0.002, 0.001)), both)]
    (moved,) = told(compare_maps(*maps), "moved")
    assert moved.slot_b == 1
    assert math.hypot(*moved.shift or ()) == pytest.approx(0.3)


def test_maps_that_are_not_in_one_frame_agree_by_chance_alone() -> None:
    before, after = seen(box(0, 0)), seen(box(2, 0), seed=1)
    alike = agreement(before, after)
    assert alike == pytest.approx(agreement(after, before))
    # The outline is 36 m long; of the 4 m of a box one side is a metre from the other.
    assert alike.agreeing == pytest.approx(36, abs=0.5)
    assert 36 < alike.overlap < 40
    ends = np.concatenate([outline(ROOM), box(0, 0)]) @ [[0.8, 0.6], [-0.6, 0.8]] + [2.0, 1.0]
    turned = LineMap(lines=lines_between(ends, room=32), circles=poles_at([]))
    assert agreement(before, turned).agreeing < 0.05 * agreement(before, turned).overlap
    assert agreement(before, LineMap(lines=lines_between([]), circles=poles_at([]))) == (0, 0)


def test_where_nothing_has_changed_hardly_anything_is_told() -> None:
    """Eighty pairs of maps of one room: some movement is told of in one per cent of them."""
    alarms = 0
    for seed in range(0, 160, 2):
        found = compare_maps(seen(box(0, 0), seed=seed), seen(box(0, 0), seed=seed + 1), alpha=0.01)
        alarms += bool(found.changes)
        assert found.pairs == 8
    assert alarms <= stats.binom.isf(1e-3, 80, 0.01)  # 0.8 are expected


def test_p_values_are_uniform_where_nothing_has_changed() -> None:
    """Each alone, by way of a family of one."""
    rng = np.random.default_rng(5)
    p = []
    for _ in range(60):
        offset, turn = rng.normal(0, SIGMA)
        lines = lines_between([[(-1, offset - turn), (1, offset + turn)]], sigma=SIGMA, room=32)
        exact = lines_between([[(-1, 0), (1, 0)]], sigma=(1e-6, 1e-6), room=32)
        maps = [LineMap(lines=x, circles=poles_at([])) for x in (lines, exact)]
        found = compare_maps(*maps, alpha=1 - 1e-12)
        p += [change.p for change in found.changes if change.what == "moved"]
    assert len(p) == 60
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_what_was_seen_once_is_passed_over() -> None:
    before, after = seen(box(0, 0), times=2), seen(seed=1)
    assert len(told(compare_maps(before, after), "vanished")) == 4
    assert compare_maps(before, after, at_least=3).changes == []
    # It takes no partner away either: a line seen once, nearer to where a wall was than where the wall is now.
    wall, now, stray = (lines_between([[(-1.0, y), (1.0, y)]], times=n) for y, n in ((0.0, 9), (0.3, 9), (0.2, 1)))
    both = jax.tree.map(lambda x, y: jnp.concatenate([x[:1], y[:1]]), now, stray)
    before, after = (LineMap(lines=x, circles=poles_at([])) for x in (wall, both))
    for at_least, slot in ((1, 1), (2, 0)):
        (moved,) = told(compare_maps(before, after, at_least=at_least), "moved")
        assert moved.slot_b == slot


@pytest.mark.parametrize(("apart", "radius", "same"), [(0.19, 0.05, True), (0.21, 0.05, False), (0.31, 0.2, False)])
def test_circles_without_a_covariance_are_the_same_if_their_discs_are_near(
    apart: float, radius: float, same: bool
) -> None:
    maps = []
    for x in (0.0, apart):
        circles = poles_at([(x, 0.0, radius)])
        circles = dataclasses.replace(circles, fitted=jnp.zeros_like(circles.fitted))
        maps.append(LineMap(lines=lines_between([]), circles=circles))
    found = compare_maps(*maps)
    assert found.same_circles == same
    assert [change.what for change in found.changes] == ([] if same else ["vanished", "appeared"])


def test_what_is_elsewhere_leaves_the_first_map_whether_it_is_told_or_not() -> None:
    """Of forty walls one has moved by 3.5 sigma, which is too little to tell of among so many; so has a pole."""
    at = 3.0 * np.arange(40)
    walls = np.stack([np.stack([at, np.zeros(40)], -1), np.stack([at, np.full(40, 2.0)], -1)], 1)
    later = walls.copy()
    later[7, :, 0] += 3.5 * 0.01 * math.sqrt(2)
    later[11, :, 0] += 0.3
    poles = np.stack([at[:3] + 1.5, np.ones(3), np.full(3, 0.1)], -1)
    shift = [[0.0, 0.0, 0.0], [3.8 * 0.01 * math.sqrt(2), 0.0, 0.0], [0.0, 0.0, 0.0]]
    a = LineMap(lines=lines_between(walls, room=40), circles=poles_at(poles))
    b = LineMap(lines=lines_between(later, room=40), circles=poles_at(poles + shift))
    changes = compare_maps(a, b).changes
    assert [change.slot_a for change in changes if change.kind == "line"] == [11]
    assert not told(Comparison(changes, 0, 0, 0), "moved", "circle")
    left = without_moved(a, b, changes)
    gone = set(range(40)) - set(np.flatnonzero(left.lines.valid).tolist())
    assert gone == {7, 11}
    assert np.flatnonzero(left.circles.valid).tolist() == [0, 2]


def test_holm() -> None:
    """By hand: 4 x 0.005, 3 x 0.01, 2 x 0.03, 0.04 raised to what stands before it."""
    np.testing.assert_allclose(holm(np.array([0.03, 0.005, 0.04, 0.01])), [0.06, 0.02, 0.06, 0.03])
    assert holm(np.zeros(0)).size == 0


def test_beams_tell_what_has_vanished_from_what_was_not_looked_at() -> None:
    """The scanner looks along x from the origin: through one box, not towards the other."""
    before, after = seen(box(2, -0.5), box(-3, -0.5), poles=[(1, 0, 0.1)]), seen(seed=1)
    changes = compare_maps(before, after).changes
    bearings = np.deg2rad(np.arange(-80.0, 80.5, 1.0))
    ranges = np.minimum(5 / np.cos(bearings), 4 / np.maximum(np.abs(np.sin(bearings)), 1e-9))
    scan = Scan.from_ranges(ranges, bearings)
    scans = jax.tree.map(lambda x: x[None], scan)
    poses = Pose(mean=jnp.zeros((1, 3)), cov=jnp.zeros((1, 3, 3)))
    asked = looked_through(changes, [(scans, poses), (scans, poses)], "after", chunk=2)
    assert [change.slot_a for change in asked] == [change.slot_a for change in changes]

    def beams(change: Change) -> tuple[int | None, int | None]:
        return change.passed, change.met

    (pole,) = told(Comparison(asked, 0, 0, 0), "vanished", "circle")
    at_pole = np.abs(bearings - math.atan2(*pole.begin[::-1])) < math.asin(0.1 / math.hypot(*pole.begin))
    assert beams(pole) == (2 * at_pole.sum(), 0)
    assert at_pole.sum() in (11, 12)  # 10 cm at 1 m are 11.5 degrees, in both scans
    by_slot = {change.slot_a: beams(change) for change in asked if change.kind == "line"}
    (near_side,) = (change for change in asked if change.slot_a == 7)  # at x = 2, from y = -0.5 to 0.5, behind the pole
    low, high = sorted(math.atan2(y, x) for x, y in (near_side.begin, near_side.end))
    at_side = (low < bearings) & (bearings < high) & ~at_pole
    assert by_slot[7] == (2 * at_side.sum(), 0)
    assert at_side.sum() in range(15, 20)
    assert [by_slot[slot] for slot in (8, 9, 10, 11)] == [(0, 0)] * 4

    # A scan of a room in which the near side is still there
    there = np.where(np.abs(np.tan(bearings)) < 0.25, 2 / np.cos(bearings), ranges)
    scans = dataclasses.replace(scans, ranges=jnp.asarray(there)[None])
    asked = looked_through(changes, [(scans, poses)], "after", chunk=2)
    assert next(beams(change) for change in asked if change.slot_a == 7 and change.kind == "line") == (0, at_side.sum())
    # Of the drive before these are its own beams.
    own = looked_through(changes, [(scans, poses)], "before", chunk=2)
    for mine, others in zip(own, asked, strict=True):
        assert (mine.passed_own, mine.met_own) == beams(others)
        assert (mine.passed, mine.met, others.passed_own, others.met_own) == (None,) * 4
    # And the other way round: the boxes are what has appeared.
    back = compare_maps(after, before).changes
    for drive, name in (("before", "met"), ("after", "met_own")):
        counted = looked_through(back, [(scans, poses)], drive, chunk=2)
        (near_side,) = (change for change in counted if change.slot_b == 7 and change.kind == "line")
        assert getattr(near_side, name) == at_side.sum()
