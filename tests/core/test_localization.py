"""Localisation: its update against a joint Kalman filter in NumPy, its sightings against the truth."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from maps import lines_between, poles_at

from linemap_jax.core.estimation.likelihood_field import distances, field_of_map, field_size, search, thinned
from linemap_jax.core.estimation.localization import (
    Belief,
    LocalizationSettings,
    Seen,
    Sightings,
    innovation_cov,
    jac_line_pose,
    place,
    predict,
    sight_circles,
    sight_lines,
    sight_points,
    update,
    update_with_consistent,
)
from linemap_jax.core.estimation.odometry import OdometryNoise, cov_step
from linemap_jax.core.frames import jac_compose_pose, jac_compose_step
from linemap_jax.core.settings import Rules, SensorNoise, Thresholds
from linemap_jax.core.state import LineMap

SLOTS, COUNT = 5, 4
UPDATE, PREDICT = jax.jit(update), jax.jit(predict)


def belief(random: np.random.Generator, *, by_map: float = 0.02) -> Belief:
    root = random.standard_normal((3, 3)) * 0.05
    return Belief(
        mean=jnp.array([1.0, 2.0, 0.3]),
        cov_own=jnp.asarray(root @ root.T + 1e-4 * np.eye(3)),
        by_map=jnp.asarray(by_map * random.standard_normal((3, SLOTS, 2))),
        fit=jnp.asarray(0.9),
        lost=jnp.asarray(False),
    )


def sightings(random: np.random.Generator, slots: list[int]) -> Sightings:
    n = len(slots)
    root = 0.02 * random.standard_normal((n, 2, 2))
    return Sightings(
        slot=jnp.asarray(slots, jnp.int32),
        innovation=jnp.asarray(0.05 * random.standard_normal((n, 2))),
        jac_pose=jnp.asarray(random.standard_normal((n, 2, 3))),
        by_map=jnp.asarray(0.03 * random.standard_normal((n, 2, 2))),
        cov=jnp.asarray(root @ np.swapaxes(root, -1, -2) + 1e-4 * np.eye(2)),
        valid=jnp.ones(n, bool),
    )


def joint_filter(
    before: Belief, seen: Sightings, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, np.ndarray, np.ndarray]:
    """Schmidt's filter by its definition: pose and all errors of the map in one state, the gain of the map struck out.

    Gives the mean, the covariance of the pose, its covariance with the errors of the map, the NIS, the covariance of
    each innovation by itself, and the NIS of each, given all others.
    """
    b = np.asarray(before.by_map).reshape(3, -1)
    m = b.shape[1]
    cov = np.block([[np.asarray(before.cov_own) + b @ b.T, b], [b.T, np.eye(m)]])
    n = len(seen.slot)
    h = np.zeros((2 * n, 3 + m))
    for i, slot in enumerate(np.asarray(seen.slot)):
        rows = slice(2 * i, 2 * i + 2)
        h[rows, :3] = seen.jac_pose[i]
        h[rows, 3 + 2 * slot : 5 + 2 * slot] = seen.by_map[i]
    noise = np.zeros((2 * n, 2 * n))
    for i in range(n):
        noise[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = seen.cov[i]
    y = np.asarray(seen.innovation).ravel() - h[:, :3] @ (at - np.asarray(before.mean))
    s = h @ cov @ h.T + noise
    gain = cov @ h.T @ np.linalg.inv(s)
    gain[3:] = 0
    left = np.eye(3 + m) - gain @ h
    after = left @ cov @ left.T + gain @ noise @ gain.T
    nis, of_each = float(y @ np.linalg.solve(s, y)), s.reshape(n, 2, n, 2)[range(n), :, range(n)]
    given_others = []
    for i in range(n):
        own, others = [2 * i, 2 * i + 1], [k for k in range(2 * n) if k // 2 != i]
        by_others = s[np.ix_(own, others)] @ np.linalg.inv(s[np.ix_(others, others)])
        rest = y[own] - by_others @ y[others]
        left_open = s[np.ix_(own, own)] - by_others @ s[np.ix_(others, own)]
        given_others.append(rest @ np.linalg.solve(left_open, rest))
    mean = np.asarray(before.mean) - (gain @ y)[:3]
    return mean, after[:3, :3], after[:3, 3:], nis, of_each, np.array(given_others)


def test_an_update_is_that_of_a_joint_filter_that_leaves_the_map_alone() -> None:
    """One line seen twice in a scan, and again in the next one; linearised beside the mean."""
    random = np.random.default_rng(3)
    now = belief(random)
    for slots in ([0, 2, 2, 4], [2, 0, 1, 1]):
        seen, at = sightings(random, slots), np.asarray(now.mean) + [0.03, -0.02, 0.01]
        mean, cov, with_map, nis, of_each, given_others = joint_filter(now, seen, at)
        np.testing.assert_allclose(innovation_cov(now, seen), of_each, atol=1e-14)
        now, found_nis, found_given_others = UPDATE(now, jnp.asarray(at), seen)
        np.testing.assert_allclose(now.mean, mean, atol=1e-12)
        np.testing.assert_allclose(now.cov, cov, atol=1e-14)
        np.testing.assert_allclose(now.by_map.reshape(3, -1), with_map, atol=1e-14)
        np.testing.assert_allclose(found_nis, nis, rtol=1e-10)
        np.testing.assert_allclose(found_given_others, given_others, rtol=1e-8)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("unsure", [(0.02, 0.04), (100.0, 3.0)])
def test_what_has_moved_pulls_no_pose_away(unsure: tuple[float, float], dtype: Any) -> None:
    """Eight walls stand, the ninth is 13 cm off, which the heading may explain as far as the prediction knows it."""
    n, moved = 9, 4
    angles = np.linspace(0, 2 * np.pi, n, endpoint=False)
    lever = 2 + 0.3 * np.arange(n)
    rows = np.stack([np.cos(angles), np.sin(angles), lever * np.cos(3 * angles)], -1)
    noise = np.broadcast_to(np.diag([0.01, 0.02]) ** 2, (n, 2, 2))
    walls = Sightings(
        slot=jnp.arange(n, dtype=jnp.int32),
        innovation=jnp.zeros((n, 2), dtype).at[moved, 0].set(0.13),
        jac_pose=jnp.asarray(np.stack([rows, np.broadcast_to([0.0, 0.0, 1.0], (n, 3))], 1), dtype),
        by_map=jnp.asarray(np.broadcast_to(np.diag([0.003, 0.001]), (n, 2, 2)), dtype),
        cov=jnp.asarray(noise, dtype),
        valid=jnp.ones(n, bool),
    )
    before = Belief(
        mean=jnp.zeros(3, dtype),
        cov_own=jnp.diag(jnp.asarray([unsure[0], unsure[0], unsure[1]], dtype)) ** 2,
        by_map=jnp.zeros((3, n, 2), dtype),
        fit=jnp.asarray(0.9, dtype),
        lost=jnp.asarray(False),
    )
    gate = LocalizationSettings().consistent_nis
    pulled = UPDATE(before, before.mean, walls)[0]
    assert float(jnp.max(jnp.abs(pulled.mean))) > 0.01
    after, left, nis = jax.jit(update_with_consistent)(before, before.mean, walls, gate)
    assert left.valid.tolist() == [i != moved for i in range(n)]
    np.testing.assert_allclose(after.mean, 0, atol=1e-5)
    assert float(nis) < 0.01
    stand = dataclasses.replace(walls, innovation=jnp.zeros((n, 2), dtype))
    after, left, _ = jax.jit(update_with_consistent)(before, before.mean, stand, gate)
    assert left.valid.all()
    expected = UPDATE(before, before.mean, stand)[0]
    np.testing.assert_allclose(after.cov, expected.cov, rtol=1e-5, atol=1e-9)


def test_a_wall_seen_a_thousand_times_is_no_better_known_than_the_map_knows_it() -> None:
    """The robot stands: its pose ends with the error of the map, not with less; float32 stands it too."""
    random = np.random.default_rng(4)
    for dtype, slack in ((jnp.float64, 1e-6), (jnp.float32, 1e-3)):
        now, seen = belief(random, by_map=0.0), sightings(random, [0, 1, 2, 3])
        now = dataclasses.replace(now, cov_own=jnp.eye(3))
        walls = dataclasses.replace(
            seen,
            innovation=jnp.zeros((4, 2)),
            jac_pose=jnp.tile(jnp.array([[[1.0, 0, 0], [0, 0, 1.0]], [[0, 1.0, 0], [0, 0, 1.0]]]), (2, 1, 1)),
            by_map=jnp.tile(jnp.diag(jnp.array([0.05, 0.01]))[None], (4, 1, 1)),
        )
        now, walls = jax.tree.map(
            lambda x, to=dtype: x.astype(to) if jnp.issubdtype(x.dtype, jnp.floating) else x, (now, walls)
        )
        after = jax.jit(
            lambda b, s: jax.lax.fori_loop(0, 1000, lambda _, b: update(b, b.mean, s)[0], b), donate_argnums=()
        )(now, walls)
        sigma = np.sqrt(np.diag(np.asarray(after.cov, float)))
        # Two walls for either direction, four for the heading.
        np.testing.assert_allclose(sigma, [0.05 / np.sqrt(2), 0.05 / np.sqrt(2), 0.01 / 2], rtol=0.02 + slack)
        assert np.linalg.eigvalsh(np.asarray(after.cov_own, float)).min() > -1e-12


def test_a_prediction_moves_what_the_map_has_done() -> None:
    random = np.random.default_rng(5)
    before, step = belief(random), jnp.array([0.4, 0.1, -0.2])
    after = PREDICT(before, step, jnp.array([1e-3, 0.0, 0.0]), OdometryNoise())
    f, g = (np.asarray(jac(before.mean, step)) for jac in (jac_compose_pose, jac_compose_step))
    noise = np.asarray(cov_step(step, OdometryNoise())) + np.diag([1e-3, 0, 0])
    np.testing.assert_allclose(after.cov, f @ np.asarray(before.cov) @ f.T + g @ noise @ g.T, atol=1e-15)


def test_how_the_pose_moves_a_line_that_is_fixed_to_the_robot() -> None:
    """The hand-derived Jacobian against autodiff through the offset and angle at an anchor that stays."""
    lines = lines_between([[[1.0, 2.0], [3.0, 2.5]], [[-2.0, 0.5], [-1.0, -3.0]]], room=2)
    lines = dataclasses.replace(lines, offset=jnp.array([0.02, -0.03]))
    pose, zero = jnp.array([4.0, -1.0, 2.0]), jnp.zeros((3, 3))
    placed, jac = jax.jit(place)(lines, pose, zero)

    def seen(pose: Any) -> Any:
        there, _ = place(lines, pose, zero)
        offset = there.offset + jnp.sum(there.normal * (there.anchor - jax.lax.stop_gradient(placed.anchor)), -1)
        return jnp.stack([offset, there.angle], -1)

    np.testing.assert_allclose(jac, jax.jit(jax.jacfwd(seen))(pose), atol=1e-13)
    np.testing.assert_allclose(jac, jac_line_pose(placed, placed.anchor - pose[None, :2]), atol=1e-15)


ROOM = LineMap(
    lines=lines_between([[[0, 0], [6, 0]], [[6, 0], [6, 4]], [[6, 4], [0, 4]], [[0, 4], [0, 0]]]),
    circles=poles_at([[2.0, 1.0, 0.1]]),
)


def test_the_field_holds_distances_and_the_search_finds_the_pose() -> None:
    field = jax.jit(field_of_map, static_argnums=1)(ROOM, 256)
    points = jnp.array([[3.0, 1.5], [5.9, 2.0], [2.0, 1.3], [-0.5, 2.0], [90.0, 2.0], [2.0, 1.0]])
    np.testing.assert_allclose(distances(field, points), [0.98, 0.1, 0.2, 0.5, 1.0, 0.1], atol=float(field.cell))

    truth = np.array([2.5, 2.2, 0.4])
    angle = np.linspace(-np.pi, np.pi, 64, endpoint=False) + 0.01
    c, s = np.cos(angle), np.sin(angle)
    reach = np.minimum(np.where(c > 0, 6 - truth[0], -truth[0]) / c, np.where(s > 0, 4 - truth[1], -truth[1]) / s)
    ends = reach[:, None] * np.stack([c, s], -1)
    turn = np.array([[np.cos(truth[2]), np.sin(truth[2])], [-np.sin(truth[2]), np.cos(truth[2])]])
    seen = jnp.asarray(ends @ turn.T)
    root = jnp.diag(jnp.array([0.3, 0.3, 0.1]))
    find = jax.jit(search, static_argnames="counts")
    counts = ((13, 25), (7, 9), (7, 9))
    start = jnp.asarray(truth + [0.35, -0.3, 0.17])
    found = np.asarray(find(field, seen, jnp.ones(64, bool), start, root, counts=counts))
    assert np.all(np.abs(found - truth) < [0.05, 0.05, 0.02])
    # Where nothing was seen, nothing is known better.
    nothing = find(field, seen, jnp.zeros(64, bool), start, root, counts=counts)
    np.testing.assert_allclose(nothing, start, atol=1e-9)


def seen_in_room(truth: np.ndarray) -> Seen:
    """Of the room from a pose, without noise: its first two walls, its pole, and points of the lower wall."""
    x, y, theta = truth
    turn = np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])
    walls = np.array([[[1, 0], [4, 0]], [[6, 3.5], [6, 1]]])  # the second one begins where the map's ends
    points = (np.stack([np.linspace(4.2, 5.8, 9), np.zeros(9)], -1) - truth[:2]) @ turn.T
    ranges = np.hypot(*points.T)
    return Seen(
        lines=lines_between((walls - truth[:2]) @ turn.T, room=3),
        circles=poles_at([[*(np.array([2.0, 1.0]) - truth[:2]) @ turn.T, 0.1]], room=2),
        collinear=jnp.eye(3, dtype=bool),
        points=jnp.asarray(points),
        beams=jnp.asarray(points / ranges[:, None]),
        ranges=jnp.asarray(ranges),
        returned=jnp.ones(9, bool),
        alone=jnp.ones(9, bool),
        laser=jnp.zeros(2),
    )


def test_sightings_are_what_pose_and_map_err_by() -> None:
    """y = H error + A e: of a pose that is off, and of a map whose primitives are, each by known amounts.

    Lines, a circle, and points in no line; the covariances of the map are correlated, and a wall is seen far from its
    anchor, so that an error of its direction moves what is seen of its offset.
    """
    truth = np.array([3.0, 2.2, 0.4])
    seen, root = seen_in_room(truth), jnp.array([[0.02, 0.0], [0.005, 0.006]])
    cov, noise, settings = jnp.diag(jnp.array([0.02, 0.02, 0.01]) ** 2), SensorNoise(), LocalizationSettings()

    @jax.jit
    def sight(pose: Any, errors: Any) -> Any:
        """What is seen of a map whose primitives err by so many sigmas."""
        moved = errors @ root.T
        lines = dataclasses.replace(
            ROOM.lines,
            offset=ROOM.lines.offset + moved[0],
            angle=ROOM.lines.angle + moved[1],
            cov_independent=jnp.broadcast_to(root @ root.T, ROOM.lines.cov_independent.shape),
        )
        # A circle's errors are those of its centre.
        of_center = jnp.zeros((3, 3)).at[:2, :2].set(root @ root.T)
        poles = dataclasses.replace(
            ROOM.circles,
            center=ROOM.circles.center + moved[None],
            cov_independent=jnp.broadcast_to(of_center, ROOM.circles.cov_independent.shape),
        )
        return (
            sight_lines(seen, pose, cov, lines, Thresholds(), Rules(tell_sides=False), settings),
            sight_circles(seen, pose, cov, poles, 8, settings),
            sight_points(seen, pose, seen.alone, lines, noise, Rules(tell_sides=False), settings),
        )

    for off, e in (([0.0, 0.0, 0.0], [0.3, -0.4]), ([0.004, -0.006, 0.003], [0.0, 0.0])):
        off, e = np.array(off), np.array(e)
        found = sight(jnp.asarray(truth + off), jnp.asarray(e))
        for sightings, slots in zip(found, ([0, 1], [8], [0]), strict=True):
            used = np.asarray(sightings.valid)
            assert np.asarray(sightings.slot)[used].tolist() == slots
            expected = np.asarray(sightings.jac_pose)[used] @ off + np.asarray(sightings.by_map)[used] @ e
            np.testing.assert_allclose(np.asarray(sightings.innovation)[used], expected, atol=1e-4)


def test_a_wall_is_known_by_the_side_on_which_the_robot_is() -> None:
    """Lines and points are held against what has been seen from their side, in a map that tells."""
    truth = np.array([3.0, 2.2, 0.4])
    seen, lines = seen_in_room(truth), ROOM.lines
    cov, noise, settings = jnp.diag(jnp.array([0.02, 0.02, 0.01]) ** 2), SensorNoise(), LocalizationSettings()
    away = jnp.sum((lines.anchor - truth[None, :2]) * lines.normal, -1) + lines.offset > 0

    @partial(jax.jit, static_argnames="rules")
    def sight(turned: Any, rules: Rules) -> Any:
        faced = dataclasses.replace(
            lines,
            angle=lines.angle + jnp.where(turned, jnp.pi, 0),
            offset=jnp.where(turned, -lines.offset, lines.offset),
            extent=jnp.where(turned[:, None], -lines.extent[:, ::-1], lines.extent),
        )
        pose = jnp.asarray(truth)
        return (
            sight_lines(seen, pose, cov, faced, Thresholds(), rules, settings),
            sight_points(seen, pose, seen.alone, faced, noise, rules, settings),
        )

    def slots(sightings: Any) -> list[int]:
        return np.asarray(sightings.slot)[np.asarray(sightings.valid)].tolist()

    # The second wall runs as if it were seen from outside.
    for turned, rules, of_lines, of_points in (
        (~away, Rules(tell_sides=False), [0, 1], [0]),
        (~away, Rules(), [0], [0]),
        (away, Rules(), [1], []),
    ):
        lines_seen, points_seen = sight(turned, rules)
        assert (slots(lines_seen), slots(points_seen)) == (of_lines, of_points)


def test_the_field_of_a_map_has_cells_of_at_most_ten_centimetres() -> None:
    """A power of two: for a room of 6 m with a metre around it 80 at least; for a town as many as there may be."""
    assert field_size(ROOM) == 128
    assert field_size(LineMap(lines=lines_between([[[0, 0], [900, 0]]]), circles=poles_at([]))) == 1024
    assert field_size(LineMap(lines=lines_between([]), circles=poles_at([]))) == 64


def test_beams_are_thinned_evenly() -> None:
    points = jnp.arange(254.0).reshape(127, 2)
    few, valid = thinned(points, jnp.arange(127) < 64)
    np.testing.assert_array_equal(few, points[::2])
    assert int(valid.sum()) == 32
