"""Maps against logs whose answers are known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax.core.mapping import empty_map
from linemap_jax.core.settings import Capacity, Mount
from linemap_jax.core.state import LineMap, Pose, Scan
from linemap_jax.lab.evaluation import duplicates, evaluate_log, explained, world_of_map

BEARINGS = np.radians(np.arange(-60.0, 61.0, 2.0))
BEAMS = BEARINGS.size
X = np.array([1.0, 2.0, 3.0])  # m: where the robot stands, looking east
CHUNK = 2


def wall_and_pole() -> LineMap:
    """A wall at x = 8 from y = -4 to 4, a pole of 20 cm at (5, 1); slots 1 and 2, the others are free."""
    empty = empty_map(Capacity(4, 4))
    lines = dataclasses.replace(
        empty.lines,
        anchor=empty.lines.anchor.at[1].set(jnp.array([7.9, 1.0])),
        offset=empty.lines.offset.at[1].set(0.1),
        extent=empty.lines.extent.at[1].set(jnp.array([-5.0, 3.0])),
        valid=empty.lines.valid.at[1].set(True),
    )
    circles = dataclasses.replace(
        empty.circles,
        center=empty.circles.center.at[2].set(jnp.array([5.0, 1.0])),
        radius=empty.circles.radius.at[2].set(0.2),
        valid=empty.circles.valid.at[2].set(True),
    )
    return LineMap(lines=lines, circles=circles)


def ranges(x: float) -> np.ndarray:
    """What a scanner at (x, 0) sees of them; infinity beyond."""
    to_wall = (8 - x) / np.cos(BEARINGS)
    to_wall[np.abs(to_wall * np.sin(BEARINGS)) > 4] = np.inf
    ahead = (5 - x) * np.cos(BEARINGS) + np.sin(BEARINGS)
    square = 0.2**2 - ((5 - x) * np.sin(BEARINGS) - np.cos(BEARINGS)) ** 2
    return np.where(square > 0, ahead - np.sqrt(np.maximum(square, 0)), to_wall)


def log(off: np.ndarray, turn: float = 0.0) -> list[tuple[Scan, Pose]]:
    """Three scans in two chunks; `off` is added to the ranges, beams that meet nothing read 30 m.

    The robot looks to the right of the east by `turn`.
    """
    readings = np.stack([ranges(x) for x in X])
    readings = np.where(np.isfinite(readings), readings + off, 30.0)
    scans = jax.vmap(lambda r: Scan.from_ranges(r, jnp.asarray(BEARINGS)))(jnp.asarray(readings))
    poses = Pose(
        mean=jnp.asarray(np.stack([X, np.zeros(3), np.full(3, -turn)], -1)),
        cov=jnp.zeros((3, 3, 3)),
    )
    return [jax.tree.map(lambda x, i=i: x[i : i + CHUNK], (scans, poses)) for i in (0, CHUNK)]


def test_the_world_of_a_map() -> None:
    world = world_of_map(wall_and_pole())
    np.testing.assert_array_equal(np.flatnonzero(world.segments.valid), [1])
    np.testing.assert_allclose(world.segments.ends[1], [[8, -4], [8, 4]], atol=1e-12)
    np.testing.assert_array_equal(np.flatnonzero(world.poles.valid), [2])
    np.testing.assert_allclose(world.poles.center[2], [5, 1])


def test_a_log_that_is_off() -> None:
    met = np.isfinite(np.stack([ranges(x) for x in X]))
    assert 0.5 < met.mean() < 0.9
    # Every fourth return of those that meet the map lies 30 cm before it, the others 1 cm behind.
    number = np.cumsum(met).reshape(met.shape)
    off = np.where(number % 4 == 0, -0.3, 0.01)
    score = evaluate_log(wall_and_pole(), log(off), chunk=CHUNK)
    assert score.returns == met.sum()
    assert score.met == 1
    assert score.explained == pytest.approx(np.mean(off[met] > 0), abs=0.02)  # at a slant 30 cm may come near the rim
    assert score.residual_median == pytest.approx(0.01)
    assert score.residual_90 == pytest.approx(0.3)

    # The same where the robot looks elsewhere, and the mount turns the scanner back to the east.
    turned = evaluate_log(wall_and_pole(), log(off, turn=0.4), Mount(theta=0.4), chunk=CHUNK)
    np.testing.assert_allclose(turned, score, atol=1e-9)


@pytest.mark.parametrize("hidden", [slice(None, BEAMS // 2), slice(None, None, 2)])
def test_beams_that_do_not_return_do_not_count(hidden: slice) -> None:
    (scans, poses), *_ = log(np.zeros((3, BEAMS)))
    scans = dataclasses.replace(scans, valid=scans.valid.at[:, hidden].set(False))
    near = dataclasses.replace(scans, valid=scans.valid & (scans.ranges < 20))
    hits, total = explained(wall_and_pole(), scans, poses)
    assert hits == total == near.valid.sum() > 20


def test_returns_without_a_map() -> None:
    score = evaluate_log(empty_map(Capacity(4, 4)), log(np.zeros((3, BEAMS))), chunk=CHUNK)
    assert (score.explained, score.met) == (0, 0)
    assert np.isnan([score.residual_median, score.residual_90]).all()
    assert score.returns > 0
    nothing = evaluate_log(empty_map(Capacity(4, 4)), [], chunk=CHUNK)
    assert nothing.returns == 0
    assert np.isnan(nothing.explained)


def test_duplicates_are_the_shorter_ones_of_two() -> None:
    lines = wall_and_pole().lines

    def beside(slot: int, off: float, begin: float, end: float, turn: float = 0.0) -> None:
        nonlocal lines
        lines = dataclasses.replace(
            lines,
            anchor=lines.anchor.at[slot].set(jnp.array([8.0 + off, 0.0])),
            angle=lines.angle.at[slot].set(turn),
            extent=lines.extent.at[slot].set(jnp.array([begin, end])),
            valid=lines.valid.at[slot].set(True),
        )

    beside(0, 0.08, -1.0, 2.0)
    beside(2, -0.12, -1.0, 2.0)  # too far away
    beside(3, 0.0, -0.4, 0.4, turn=0.1)  # too far turned
    np.testing.assert_array_equal(duplicates(lines), [True, False, False, False])
    beside(2, 0.08, -6.0, -3.5)  # for the most part behind the end
    np.testing.assert_array_equal(duplicates(lines), [True, False, False, False])
    beside(0, 0.08, -1.0, 2.0, turn=np.pi)  # the other face
    np.testing.assert_array_equal(duplicates(lines), [False, False, False, False])
