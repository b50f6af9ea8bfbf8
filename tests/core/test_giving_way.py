"""What scans contradict again and again leaves the map; what moved by centimetres stands where it is now."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from maps import lines_between, poles_at

from linemap_jax import Capacity, LineMap, Pose, Report, Rules, Scan, SensorNoise, Thresholds, empty_map, update
from linemap_jax.core.mapping import _give_way
from linemap_jax.core.matching import contradicted

BEARINGS = np.radians(np.arange(-90, 90.25, 0.5))
NOISE = SensorNoise(range_sigma=0.005, bearing_sigma=0.0005)
SIGMAS = np.array([0.003, 0.003, 0.001])
TABLE = np.array([[2.0, -0.4], [2.0, 0.4]])
POLE = np.array([1.0, 1.5, 0.1])
SCANS = 30
RULES = Rules()


def ranges(pose: np.ndarray, table: np.ndarray, pole: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """To a wall at x = 4, one at y = 3, the side of a table and a pole."""
    u = np.stack([np.cos(BEARINGS + pose[2]), np.sin(BEARINGS + pose[2])], -1)

    def to_segment(begin: Any, end: Any) -> np.ndarray:
        a, e = np.asarray(begin) - pose[:2], np.asarray(end) - np.asarray(begin)
        den = u[:, 0] * e[1] - u[:, 1] * e[0]
        with np.errstate(all="ignore"):
            r = (a[0] * e[1] - a[1] * e[0]) / den
            along = (a[0] * u[:, 1] - a[1] * u[:, 0]) / den
        return np.where((r > 0) & (along > 0) & (along < 1), r, np.inf)

    center = pole[:2] - pose[:2]
    ahead, aside = u @ center, u[:, 1] * center[0] - u[:, 0] * center[1]
    with np.errstate(invalid="ignore"):
        to_pole = np.where((np.abs(aside) < pole[2]) & (ahead > 0), ahead - np.sqrt(pole[2] ** 2 - aside**2), np.inf)
    walls = [((4.0, -8.0), (4.0, 3.0)), ((-8.0, 3.0), (4.0, 3.0)), table]
    nearest = np.min([*(to_segment(*wall) for wall in walls), to_pole], 0)
    return nearest + float(NOISE.range_sigma) * random.standard_normal(len(BEARINGS))


def drive(table: np.ndarray, pole: np.ndarray, seed: int, off: np.ndarray | None = None) -> tuple[Scan, Pose]:
    """Scans on the way past table and pole; the poses that are told err by their sigmas, and are `off` as a whole."""
    random = np.random.default_rng(seed)
    t = np.linspace(-1, 1, SCANS)
    true = np.stack([0.3 * np.cos(3 * t), 0.8 * t, 0.2 * t], -1)
    scans = [Scan.from_ranges(ranges(pose, table, pole, random), BEARINGS) for pose in true]
    told = true + SIGMAS * random.standard_normal(true.shape) + (np.zeros(3) if off is None else off)
    cov = np.broadcast_to(np.diag(SIGMAS) ** 2, (SCANS, 3, 3))
    return jax.tree.map(lambda *x: jnp.stack(x), *scans), Pose(mean=jnp.asarray(told), cov=jnp.asarray(cov))


@partial(jax.jit, static_argnames="rules")
def map_of(line_map: LineMap, scans: Scan, poses: Pose, rules: Rules = RULES) -> tuple[LineMap, Report]:
    def step(line_map: LineMap, x: tuple[Scan, Pose]) -> Any:
        return update(line_map, *x, noise=NOISE, capacity=Capacity(8, 8), rules=rules)

    return jax.lax.scan(step, line_map, (scans, poses))


@pytest.fixture(scope="module")
def before() -> LineMap:
    """The map of a first drive."""
    line_map, _ = map_of(empty_map(Capacity(16, 8)), *drive(TABLE, POLE, 1))
    assert (int(line_map.lines.valid.sum()), int(line_map.circles.valid.sum())) == (3, 1)
    return line_map


def sides_of_table(line_map: LineMap) -> list[tuple[float, float, float]]:
    """x at y = 0, direction of the normal, and sigma of the offset, of the lines where the table stands."""
    lines = jax.tree.map(np.asarray, line_map.lines)
    here = lines.valid & (np.abs(np.asarray(lines.anchor[:, 0]) - 2) < 0.5) & (np.asarray(lines.anchor[:, 1]) < 1)
    foot, normal = lines.anchor + lines.offset[:, None] * np.asarray(line_map.lines.normal), line_map.lines.normal
    x = np.sum(foot * normal, -1) / np.asarray(normal)[:, 0]
    turn = np.arctan(np.asarray(normal)[:, 1] / np.asarray(normal)[:, 0])
    return [(x[k], turn[k], np.sqrt(line_map.lines.cov[k, 0, 0])) for k in np.flatnonzero(here)]


def some(scans: tuple[Scan, Pose]) -> tuple[Scan, Pose]:
    """Fewer than have seen the table before: wiping spares behind a line what was seen more often."""
    return jax.tree.map(lambda x: x[:20], scans)


def turned(angle: float, shift: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    middle = TABLE.mean(0)
    return (TABLE - middle) @ np.array([[c, s], [-s, c]]) + middle + [shift, 0.0]


@pytest.mark.parametrize(("turn", "shift"), [(0.0, -0.04), (0.0, 0.04), (0.07, 0.0)])
def test_what_has_moved_by_a_little_stands_where_it_is(before: LineMap, turn: float, shift: float) -> None:
    """Nearer, farther, and turned past the gate of directions, where it would stand beside itself."""
    table = turned(turn, shift)
    scans = drive(table, POLE + [0.04, 0.0, 0.0], 2)
    after, reports = map_of(before, *scans)
    ((x, angle, sigma),) = sides_of_table(after)
    assert abs(x - 2 - shift) < 4 * sigma
    assert abs(angle - turn) < 0.015
    if shift > 0:  # what has taken its place was left out till then, as the pole was
        assert int(reports.added.sum()) == 2
        np.testing.assert_array_equal(reports.added, reports.deleted)
    stays = map_of(before, *some(scans), rules=Rules(give_way=False))[0]
    assert any(abs(x - 2) < 0.01 and abs(angle) < 0.01 for x, angle, _ in sides_of_table(stays))


def test_a_pole_that_has_moved_by_a_little_stands_where_it_is(before: LineMap) -> None:
    scans = drive(TABLE, POLE + [0.04, 0.0, 0.0], 2)
    rules = Rules(give_way=False)
    after, stays = map_of(before, *scans)[0].circles, map_of(before, *some(scans), rules=rules)[0].circles
    (k,) = np.flatnonzero(after.valid)
    off = np.array([*after.center[k], after.radius[k]]) - POLE - [0.04, 0.0, 0.0]
    assert off @ np.linalg.solve(after.cov[k], off) < 16.3
    (k,) = np.flatnonzero(stays.valid)
    np.testing.assert_allclose(stays.center[k], POLE[:2], atol=0.01)


def test_what_stands_still_stays(before: LineMap) -> None:
    after, reports = map_of(before, *drive(TABLE, POLE, 3))
    assert int(np.sum(reports.deleted)) == 0
    for kind in ("lines", "circles"):
        was, now = getattr(before, kind), getattr(after, kind)
        np.testing.assert_array_equal(was.valid, now.valid)
        assert (np.asarray(now.times_contradicted) <= 1).all()


def test_scans_at_a_wrong_pose_contradict_nothing(before: LineMap) -> None:
    """What they deny together, and what they have added themselves, does not outweigh what was seen so often."""
    after, _ = map_of(before, *some(drive(TABLE, POLE, 4, off=np.array([0.04, 0.03, 0.0]))))
    for kind in ("lines", "circles"):
        was, now = getattr(before, kind), getattr(after, kind)
        assert np.asarray(now.valid)[np.asarray(was.valid)].all()
        assert not np.any(now.times_contradicted)
    assert abs(sides_of_table(after)[0][0] - 2) < 0.01
    (k,) = np.flatnonzero(after.circles.valid)
    np.testing.assert_allclose(after.circles.center[k], POLE[:2], atol=0.01)


def test_pages_test() -> None:
    """Ten more against than for, or more than there ever were for; what is borne out counts down, not below zero."""
    model = dataclasses.replace(
        lines_between(np.array([[[0, y], [1, y]] for y in range(4)]), room=5),
        times_detected=jnp.array([100, 100, 2, 1, 0]),
        times_contradicted=jnp.array([9, 8, 2, 1, 0]),
    )
    denied = jnp.array([True, True, True, True, False])
    after, gone = _give_way(model, denied, jnp.array([-1, -1]), Thresholds())
    assert int(gone) == 3
    assert after.valid.tolist() == [False, True, False, False, False]
    after, gone = _give_way(model, denied, jnp.array([0, 2, 4]), Thresholds())
    assert after.times_contradicted.tolist() == [8, 9, 1, 2, 0]
    assert after.valid.tolist() == [True, True, True, False, False]
    after, gone = _give_way(model, denied, jnp.array([-1, -1]), Thresholds(contradictions=9))
    assert after.valid.tolist() == [False, False, False, False, False]


def test_another_line_in_the_place_of_one() -> None:
    """It covers half of it, ends no farther from it than the gate has it, and is surely another one; from one side."""
    model = lines_between([[[0, 0], [2, 0]], [[0, 5], [2, 5]]], sigma=(0.002, 0.001), room=3)
    cases = {
        "beside": ([[0, 0.03], [2, 0.03]], [True, False, False]),
        "turned by 4 degrees": ([[0.4, -0.04], [1.6, 0.04]], [True, False, False]),
        "along less than half": ([[1.05, 0.03], [3, 0.03]], [False] * 3),
        "along a little more": ([[0.95, 0.03], [3, 0.03]], [True, False, False]),
        "the same": ([[0, 0.004], [2, 0.004]], [False] * 3),
        "too far": ([[0, 0.06], [2, 0.06]], [False] * 3),
        "from behind": ([[2, 0.03], [0, 0.03]], [False] * 3),
        "far along": ([[5, 0.03], [9, 0.03]], [False] * 3),
    }
    look = jax.jit(contradicted, static_argnames=("rules", "pose_error"))
    for name, (ends, expected) in cases.items():
        new = lines_between([ends], sigma=(0.002, 0.001), room=2)
        found = look(new, model, Thresholds(), rules=Rules(), pose_error="unknown")
        assert found.tolist() == expected, name
    both = lines_between([[[0, 0.03], [2, 0.03]], [[0.9, 0.004], [3, 0.004]]], sigma=(0.002, 0.001), room=2)
    assert not look(both, model, Thresholds(), rules=Rules(), pose_error="unknown").any()  # the nearer one decides
    behind = lines_between([cases["from behind"][0]], sigma=(0.002, 0.001), room=2)
    found = look(behind, model, Thresholds(), rules=Rules(tell_sides=False), pose_error="unknown")
    assert found.tolist() == [True, False, False]


def test_a_pole_beside_another_one_is_not_contradicted(before: LineMap) -> None:
    """Of two poles 25 cm apart one hides the other: the gate of centres takes them for one, but not for one place."""
    hidden = jax.tree.map(jnp.asarray, poles_at([[1.1, 1.73, 0.1]], sigma=0.003, times=30, room=8))
    after, _ = map_of(dataclasses.replace(before, circles=hidden), *drive(TABLE, POLE, 5))
    (k,) = np.flatnonzero(after.circles.valid)
    np.testing.assert_allclose(after.circles.center[k], [1.1, 1.73], atol=1e-9)
    assert int(after.circles.times_contradicted[k]) == 0
