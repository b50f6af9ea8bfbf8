"""Surfaces, registration, loops, the pose graph and the adjustment: against NumPy, and in rooms that are known."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from maps import lines_between, poles_at

from linemap_jax.core.estimation.adjustment import (
    Adjusted,
    CircleSightings,
    LineSightings,
    adjust,
    circles_from_sightings,
    residual_of_sighting,
    sightings_of_scan,
    with_error_of_first,
    with_error_of_poses,
)
from linemap_jax.core.estimation.loops import LoopSettings, close_loop
from linemap_jax.core.estimation.odometry import OdometryNoise
from linemap_jax.core.estimation.pose_graph import Closures, PoseGraph, cov_of_registration, optimise
from linemap_jax.core.estimation.registration import nearest, register
from linemap_jax.core.estimation.surface import Surface, middle_of, seen_from, surface_of_scan
from linemap_jax.core.estimation.tracking import TrackingSettings, _cov_guess, begin_track, track
from linemap_jax.core.settings import SensorNoise, Thresholds
from linemap_jax.core.state import LineMap, Lines, Pose, Scan, empty_lines, squared
from linemap_jax.slam import slam

adjusted, optimised = jax.jit(adjust), jax.jit(optimise)

BEARINGS = np.deg2rad(np.arange(180) - 89.5)
ROOM = np.array([[-4.0, -3.0], [5.0, -3.0], [5.0, 1.0], [3.0, 1.0], [3.0, 3.0], [-4.0, 3.0]])
CORRIDOR = np.array([[-40.0, -1.0], [40.0, -1.0], [40.0, 1.0], [-40.0, 1.0]])


def ranges_in(corners: np.ndarray, pose: Any) -> np.ndarray:
    """What a scanner measures inside of a polygon."""
    x, y, theta = pose
    begin, end = corners, np.roll(corners, -1, 0)
    direction = np.stack([np.cos(theta + BEARINGS), np.sin(theta + BEARINGS)], -1)
    along = end - begin
    det = direction[:, None, 0] * along[None, :, 1] - direction[:, None, 1] * along[None, :, 0]
    off = begin - [x, y]
    reach = (off[None, :, 0] * along[None, :, 1] - off[None, :, 1] * along[None, :, 0]) / det
    share = (off[None, :, 0] * direction[:, None, 1] - off[None, :, 1] * direction[:, None, 0]) / det
    hit = (reach > 0) & (share >= 0) & (share <= 1)
    return np.where(hit, reach, np.inf).min(1)


def surface_in(corners: np.ndarray, pose: Any, noise: np.random.Generator | None = None) -> Surface:
    ranges = ranges_in(corners, pose)
    if noise is not None:
        ranges = ranges + noise.normal(0, 0.01, ranges.shape)
    return SURFACE(Scan.from_ranges(jnp.asarray(ranges, "float32"), jnp.asarray(BEARINGS, "float32"), range_max=30.0))


SURFACE = jax.jit(surface_of_scan)
REGISTER = jax.jit(register)
CLOSE = jax.jit(close_loop)
TRACK = jax.jit(track)


def test_the_surface_of_a_room() -> None:
    """Normals are those of the walls, and point to the scanner; a lone point is not flat."""
    surface = surface_in(ROOM, (0.0, 0.0, 0.0))
    bottom = np.asarray(surface.flat) & (np.abs(surface.position[:, 1] + 3) < 1e-3)
    assert bottom.sum() > 20
    off = np.abs(np.asarray(surface.normal)[bottom] - [0.0, 1.0]).max(1)
    assert (off[2:-2] < 1e-3).all()  # those beside the corners have neighbours on the next wall
    ranges = np.full(180, 5.0)
    ranges[90] = 1.0
    alone = SURFACE(Scan.from_ranges(jnp.asarray(ranges, "float32"), jnp.asarray(BEARINGS, "float32"), range_max=30.0))
    assert not alone.flat[90]
    assert alone.valid[90]


@pytest.mark.parametrize("count", [5, 64, 300])
def test_nearest_neighbours(count: int) -> None:
    random = np.random.default_rng(count)
    points, others = random.uniform(-20, 20, (2, 300, 2))[:, :, :]
    others, valid = others[:count], random.random(count) < 0.8
    found = np.asarray(nearest(jnp.asarray(points), jnp.asarray(others), jnp.asarray(valid)))
    distance = np.where(valid, np.hypot(*(points[:, None] - others[None]).transpose(2, 0, 1)), np.inf)
    assert valid[found].all()
    np.testing.assert_allclose(distance[np.arange(300), found], distance.min(1), rtol=1e-4)


def test_registration_finds_the_pose() -> None:
    random = np.random.default_rng(0)
    first, truth = (0.0, 0.0, 0.0), np.array([0.3, -0.2, 0.15])
    old, new = surface_in(ROOM, first, random), surface_in(ROOM, truth, random)
    prior = jnp.eye(3, dtype="float32")
    found = REGISTER(new, old, jnp.zeros(3, "float32"), prior)
    assert (np.abs(found.pose - truth) < [0.01, 0.01, 0.003]).all()
    assert found.share > 0.9
    # Elsewhere in the plane the same is known of it: a turn is one of the scanner about itself.
    there = jnp.asarray([4.0, -3.0, 0.0], "float32")
    moved = REGISTER(new, seen_from(old, there), there, prior)
    np.testing.assert_allclose(moved.pose, found.pose + there, atol=1e-3)
    np.testing.assert_allclose(moved.information, found.information, rtol=0.02, atol=0.005 * found.information.max())


def test_the_back_of_a_partition_is_not_seen() -> None:
    """A surface of both faces of a wall 6 cm thick: a scan of one is laid onto that one, however near the other is."""
    y = jnp.linspace(-2.0, 2.0, 81, dtype="float32")

    def face(x: float, normal: float) -> Surface:
        return Surface(
            position=jnp.stack([jnp.full_like(y, x), y], -1),
            normal=jnp.stack([jnp.full_like(y, normal), jnp.zeros_like(y)], -1),
            flat=jnp.ones(81, bool),
            valid=jnp.ones(81, bool),
        )

    near, back = face(2.0, -1.0), face(2.06, 1.0)
    both = jax.tree.map(lambda *x: jnp.concatenate(x), near, back)
    # Seen from the origin, 4 cm too far away: nearer to the back than to its own face.
    guess = jnp.asarray([0.04, 0.0, 0.0], "float32")
    found = REGISTER(near, both, guess, 1e-2 * jnp.eye(3, dtype="float32"))
    assert abs(float(found.pose[0])) < 0.002
    assert found.share > 0.9
    # Behind the partition it is the other way round.
    behind = face(-1.94, 1.0)
    found = REGISTER(behind, both, jnp.asarray([3.97, 0.0, 0.0], "float32"), 1e-2 * jnp.eye(3, dtype="float32"))
    assert abs(float(found.pose[0]) - 4.0) < 0.002


def test_along_a_corridor_registration_holds_to_the_guess() -> None:
    """And its information says that it knows nothing of that direction."""
    random = np.random.default_rng(1)
    old, new = surface_in(CORRIDOR, (0.0, 0.0, 0.0), random), surface_in(CORRIDOR, (1.0, 0.1, 0.0), random)
    guess = jnp.asarray([0.7, 0.0, 0.02], "float32")
    found = REGISTER(new, old, guess, jnp.diag(jnp.asarray([100.0, 100.0, 100.0], "float32")))
    assert abs(found.pose[0] - 0.7) < 0.1
    assert abs(found.pose[1] - 0.1) < 0.01
    assert found.information[0, 0] < 0.02 * found.information[1, 1]


def around(surface: Surface) -> tuple[Surface, jax.Array, jax.Array]:
    """One older keyframe, and room for others beside it."""
    stacked = jax.tree.map(lambda x: jnp.stack([x] * 3), surface)
    return stacked, jnp.zeros((3, 3), "float32"), jnp.asarray([False, True, False])


def test_a_loop_is_found_metres_away() -> None:
    random = np.random.default_rng(2)
    truth = np.array([0.5, 0.4, -0.2])
    old, new = surface_in(ROOM, (0.0, 0.0, 0.0), random), surface_in(ROOM, truth, random)
    guess, path = jnp.asarray([2.6, -1.8, 0.1], "float32"), jnp.asarray(60.0, "float32")
    found = CLOSE(new, *around(old), guess, path)
    assert found.believed
    assert (np.abs(found.step - truth) < [0.02, 0.02, 0.005]).all()


def test_a_corridor_closes_no_loop() -> None:
    """Every place along it looks alike: where the drift is large, nothing is believed."""
    random = np.random.default_rng(3)
    old, new = surface_in(CORRIDOR, (0.0, 0.0, 0.0), random), surface_in(CORRIDOR, (3.0, 0.0, 0.0), random)
    found = CLOSE(new, *around(old), jnp.zeros(3, "float32"), jnp.asarray(60.0, "float32"))
    assert found.share > LoopSettings().share_far  # it fits well
    assert not found.believed


def compose(a: Any, b: Any) -> np.ndarray:
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]])


def between(a: Any, b: Any) -> np.ndarray:
    c, s = np.cos(a[2]), np.sin(a[2])
    dx, dy, turn = np.subtract(b, a)
    return np.array([c * dx + s * dy, -s * dx + c * dy, np.arctan2(np.sin(turn), np.cos(turn))])


def square_drive(random: np.random.Generator) -> tuple[np.ndarray, PoseGraph]:
    """Two laps of a square, with noise on the steps, true closures between the laps, a wrong one, and padding."""
    truth = [np.zeros(3)]
    for i in range(39):
        truth.append(compose(truth[-1], [1.0, 0.0, np.pi / 2 if i % 5 == 4 else 0.0]))
    sigma = np.array([0.02, 0.02, 0.01])
    noisy = [between(a, b) + random.normal(0, sigma) for a, b in zip(truth[:-1], truth[1:], strict=True)]
    start = [np.zeros(3)]
    for step in noisy:
        start.append(compose(start[-1], step))
    pairs = [(i, i + 20) for i in range(0, 20, 2)]
    steps = [between(truth[i], truth[j]) + random.normal(0, sigma / 4) for i, j in pairs]
    pairs.append((3, 30))
    steps.append(between(truth[3], truth[30]) + [1.5, -1.0, 0.3])
    n, e = 48, 16

    def filled(values: Any, size: int, pad: Any) -> jax.Array:
        return jnp.asarray(list(values) + [pad] * (size - len(values)))

    garbage, identity = np.full(3, 7.0), np.eye(3)
    closures = Closures(
        begin=filled([i for i, _ in pairs], e, 5),
        end=filled([j for _, j in pairs], e, 2),
        step=filled(steps, e, garbage),
        cov=filled([np.diag((sigma / 4) ** 2)] * len(pairs), e, identity),
        weight=jnp.ones(e),
        valid=filled([True] * len(pairs), e, False),
    )
    graph = PoseGraph(
        poses=filled(start, n, garbage),
        step=filled([np.zeros(3), *noisy], n, garbage),
        cov_step=filled([np.diag(sigma**2)] * 40, n, identity),
        valid=filled([True] * 40, n, False),
        closures=closures,
    )
    return np.array(truth), graph


def numpy_optimum(graph: PoseGraph, count: int, closures: int) -> np.ndarray:
    """Gauss and Newton with dense matrices and numerical derivatives."""
    poses = np.asarray(graph.poses)[:count].copy()
    c = jax.tree.map(np.asarray, graph.closures)
    edges = [(i - 1, i, np.asarray(graph.step[i]), np.asarray(graph.cov_step[i])) for i in range(1, count)]
    edges += [(c.begin[k], c.end[k], c.step[k], c.cov[k]) for k in range(closures)]

    def residuals(flat: np.ndarray) -> np.ndarray:
        at = np.concatenate([poses[:1], flat.reshape(-1, 3)])
        off = []
        for i, j, step, cov in edges:
            e = between(at[i], at[j]) - step
            e[2] = np.arctan2(np.sin(e[2]), np.cos(e[2]))
            off.append(np.linalg.solve(np.linalg.cholesky(cov), e))
        return np.concatenate(off)

    flat = poses[1:].ravel()
    for _ in range(4):
        r = residuals(flat)
        jac = np.stack([(residuals(flat + h) - r) / 1e-7 for h in 1e-7 * np.eye(flat.size)], -1)
        flat = flat - np.linalg.lstsq(jac, r, rcond=None)[0]
    return np.concatenate([poses[:1], flat.reshape(-1, 3)])


def test_the_graph_settles_where_dense_least_squares_does() -> None:
    """The wrong closure loses its weight, and the true ones keep nearly all of theirs."""
    truth, graph = square_drive(np.random.default_rng(4))
    done = optimised(graph)
    weight = np.asarray(done.closures.weight)
    assert weight[10] < 1e-3
    assert (weight[:10] > 0.2).all()
    assert (weight[11:] == 0).all()
    poses = np.asarray(done.poses)[:40]
    assert np.abs(poses - truth)[:, :2].max() < 0.5 * np.abs(np.asarray(graph.poses)[:40] - truth)[:, :2].max()
    # With the weights that the closures have in the end, it is a plain least squares problem.
    kept = np.asarray(graph.closures.cov)[:10] / weight[:10, None, None]
    plain = Closures(
        begin=graph.closures.begin,
        end=graph.closures.end,
        step=graph.closures.step,
        cov=graph.closures.cov.at[:10].set(kept),
        weight=graph.closures.weight,
        valid=graph.closures.valid,
    )
    same = PoseGraph(poses=graph.poses, step=graph.step, cov_step=graph.cov_step, valid=graph.valid, closures=plain)
    np.testing.assert_allclose(poses, numpy_optimum(same, 40, 10), atol=2e-4)


def test_a_doubtful_registration_says_little() -> None:
    information, prior = 1e5 * jnp.eye(3), jnp.eye(3)
    sure, none = (cov_of_registration(information, jnp.asarray(share), prior) for share in (0.9, 0.3))
    assert sure[0, 0] < 4e-4
    np.testing.assert_allclose(np.diag(none), [1, 1, 1], rtol=1e-3)


WALLS = [(np.array([8.0, 2.0]), 0.02), (np.array([2.0, 9.0]), 1.55), (np.array([-3.0, 2.0]), 3.1)]
SIGMA_OF_WALL = np.array([0.005, 0.002])


def sightings_from(poses: np.ndarray, random: np.random.Generator) -> tuple[Lines, LineSightings]:
    """Three walls, each seen with noise from each of the poses; and room for two more sightings."""
    lines = empty_lines(4, "float64")
    lines = dataclasses.replace(
        lines,
        anchor=lines.anchor.at[:3].set(jnp.asarray([point for point, _ in WALLS])),
        angle=lines.angle.at[:3].set(jnp.asarray([angle for _, angle in WALLS])),
        valid=lines.valid.at[:3].set(True),
    )
    anchors, angles = [], []
    for pose in poses:
        for point, angle in WALLS:
            offset, turn = random.normal(0, SIGMA_OF_WALL)
            normal = np.array([np.cos(angle - pose[2]), np.sin(angle - pose[2])])
            anchors.append(between(pose, [*point, 0.0])[:2] + offset * normal)
            angles.append(angle - pose[2] + turn)
    n = len(poses)
    sightings = LineSightings(
        keyframe=jnp.asarray([*np.repeat(np.arange(n), 3), 0, 0]),
        line=jnp.asarray([*np.tile(np.arange(3), n), 3, 3]),
        anchor=jnp.asarray([*anchors, np.zeros(2), np.zeros(2)]),
        angle=jnp.asarray([*angles, 0.0, 0.0]),
        cov=jnp.asarray([np.diag(SIGMA_OF_WALL**2)] * (3 * n) + [np.eye(2)] * 2),
        valid=jnp.arange(3 * n + 2) < 3 * n,
    )
    return lines, sightings


@pytest.mark.parametrize("walls", [1, 2, 3])
def test_sightings_that_err_as_they_say_have_unit_variance(walls: int) -> None:
    """However few they are: what they do not determine of the poses, the steps do."""
    found = []
    for seed in range(8):
        random = np.random.default_rng(seed)
        truth, graph = square_drive(random)
        lines, sightings = sightings_from(truth, random)
        sightings = dataclasses.replace(sightings, valid=sightings.valid & (sightings.line < walls))
        found.append(adjusted(optimised(graph), lines, sightings).unit_variance)
    # About 40 redundant ones of one wall in each drive, 120 of two, 200 of three
    assert np.mean(found) == pytest.approx(1, abs=3 * np.sqrt(2 / (8 * (40, 120, 200)[walls - 1])))


def test_poses_and_lines_adjusted_together() -> None:
    """Against dense least squares in NumPy, estimates and covariances; a sighting of another line is left out."""
    random = np.random.default_rng(5)
    _, graph = square_drive(random)
    graph = optimised(graph)
    count, poses = 40, np.asarray(graph.poses)
    lines, sightings = sightings_from(poses[:count], random)
    # One more, of another wall
    sightings = dataclasses.replace(
        sightings,
        keyframe=sightings.keyframe.at[-2].set(7),
        line=sightings.line.at[-2].set(1),
        anchor=sightings.anchor.at[-2].set(sightings.anchor[0]),
        angle=sightings.angle.at[-2].set(sightings.angle[0]),
        cov=sightings.cov.at[-2].set(sightings.cov[0]),
        valid=sightings.valid.at[-2].set(True),
    )
    done = adjusted(graph, lines, sightings)
    assert done.seen.tolist() == [True, True, True, False]
    assert 0.8 < done.unit_variance < 1.2

    weight = np.asarray(graph.closures.weight)
    c = jax.tree.map(np.asarray, graph.closures)
    steps = [(i - 1, i, np.asarray(graph.step[i]), np.asarray(graph.cov_step[i])) for i in range(1, count)]
    steps += [(c.begin[k], c.end[k], c.step[k], c.cov[k] / max(weight[k], 1e-12)) for k in range(11)]
    residual = jax.jit(jax.vmap(residual_of_sighting))
    seen = jax.tree.map(lambda x: np.asarray(x)[: 3 * count], sightings)
    places = np.array([point for point, _ in WALLS])

    def residuals(flat: np.ndarray) -> np.ndarray:
        at = np.concatenate([poses[:1], flat[: 3 * (count - 1)].reshape(-1, 3)])
        state = flat[3 * (count - 1) :].reshape(-1, 2)
        off = []
        for i, j, step, cov in steps:
            e = between(at[i], at[j]) - step
            e[2] = np.arctan2(np.sin(e[2]), np.cos(e[2]))
            off.append(np.linalg.solve(np.linalg.cholesky(cov), e))
        e = residual(at[seen.keyframe], state[seen.line], places[seen.line], seen.anchor, seen.angle)
        return np.concatenate([*off, np.ravel(np.asarray(e) / SIGMA_OF_WALL)])

    flat = np.concatenate([poses[1:count].ravel(), np.ravel([[0.0, angle] for _, angle in WALLS])])
    for _ in range(2):
        r = residuals(flat)
        jac = np.stack([(residuals(flat + h) - r) / 1e-7 for h in 1e-7 * np.eye(flat.size)], -1)
        flat = flat - np.linalg.lstsq(jac, r, rcond=None)[0]
    np.testing.assert_allclose(np.asarray(done.poses)[1:count].ravel(), flat[: 3 * (count - 1)], atol=2e-5)
    np.testing.assert_allclose(np.stack([done.lines.offset, done.lines.angle], -1)[:3].ravel(), flat[-6:], atol=2e-5)
    cov = np.linalg.inv(jac.T @ jac) * max(float(done.unit_variance), 1)
    np.testing.assert_allclose(done.lines.cov[2], cov[-2:, -2:], rtol=1e-3)
    # At poses that are known, the line would err by the noise of its own sightings alone.
    own = np.linalg.inv(jac[:, -2:].T @ jac[:, -2:]) * max(float(done.unit_variance), 1)
    np.testing.assert_allclose(done.lines.cov_independent[2], own, rtol=1e-3, atol=1e-12)
    assert float(squared(done.lines.sqrt_persistent)[2, 0, 0]) > own[0, 0]
    np.testing.assert_allclose(done.cov_poses[count - 1], cov[114:117, 114:117], rtol=1e-3, atol=1e-9)

    # Sightings that fit better than they say make nothing better known than they say.
    modest = adjusted(graph, lines, dataclasses.replace(sightings, cov=4 * sightings.cov))
    assert modest.unit_variance < 0.4
    for less, more in ((modest.cov_poses[39], done.cov_poses[39]), (modest.lines.cov[2], done.lines.cov[2])):
        assert np.all(np.diag(less) > np.diag(more))


def test_seen_from_a_pose() -> None:
    surface = Surface(
        position=jnp.asarray([[1.0, 0.0]]),
        normal=jnp.asarray([[-1.0, 0.0]]),
        flat=jnp.ones(1, bool),
        valid=jnp.ones(1, bool),
    )
    moved = seen_from(surface, jnp.asarray([2.0, 3.0, np.pi / 2]))
    np.testing.assert_allclose(moved.position, [[2.0, 4.0]], atol=1e-15)
    np.testing.assert_allclose(moved.normal, [[0.0, -1.0]], atol=1e-15)


def test_what_no_keyframe_has_seen_is_as_uncertain_as_the_nearest_one() -> None:
    """It moves rigidly with that keyframe; derivatives are numerical. What was seen, and free slots, stay."""
    root = np.array([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [-0.004, 0.006, 0.01]])
    poses = np.array([[2.0, 1.0, 0.5], [40.0, 0.0, 0.0]])
    cov_poses = np.stack([root @ root.T, np.eye(3)])
    line_map = LineMap(
        lines=lines_between([[[3.0, 4.0], [5.0, 4.5]], [[3.0, 0.0], [5.0, 0.0]]], room=3),
        circles=poles_at([[4.0, -2.0, 0.1]], room=2),
    )
    seen = jnp.asarray([False, True, False])
    after = with_error_of_poses(line_map, seen, jnp.asarray(poses), jnp.asarray(cov_poses))
    lines, circles = line_map.lines, line_map.circles
    anchor, normal = np.asarray(lines.anchor)[0], np.asarray(lines.normal)[0]

    def moved(error: np.ndarray, point: np.ndarray) -> np.ndarray:
        """A point that was measured from the nearest keyframe, if that stands elsewhere."""
        return compose(poses[0] + error, between(poses[0], [*point, 0.0]))[:2]

    def line(error: np.ndarray) -> np.ndarray:
        place, ahead = moved(error, anchor), moved(error, anchor + normal)
        turned = ahead - place
        return np.array([turned @ (place - anchor), np.arctan2(*turned[::-1])])

    def circle(error: np.ndarray) -> np.ndarray:
        return np.append(moved(error, np.asarray(circles.center)[0]), 0.1)

    for function, before, now in (
        (line, lines, after.lines),
        (circle, circles, after.circles),
    ):
        jac = np.stack([(function(h) - function(-h)) / 2e-6 for h in 1e-6 * np.eye(3)], -1)
        np.testing.assert_allclose(squared(now.sqrt_persistent)[0], jac @ cov_poses[0] @ jac.T, atol=1e-10)
        np.testing.assert_array_equal(now.cov_independent, before.cov_independent)
        np.testing.assert_array_equal(now.sqrt_persistent[1:], before.sqrt_persistent[1:])


def test_where_the_first_pose_errs_all_turns_and_moves_with_it() -> None:
    """As a rigid body; derivatives are numerical. Lines without a sighting stay."""
    root = np.array([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [-0.004, 0.006, 0.01]])
    cov = root @ root.T
    poses = np.array([[1.0, -2.0, 0.5], [4.0, 0.0, 2.0], [6.0, 3.0, -1.0]])
    lines = lines_between([[[3.0, 4.0], [5.0, 4.5]], [[3.0, 0.0], [5.0, 0.0]]], room=3)
    before = Adjusted(
        jnp.asarray(poses),
        jnp.asarray(np.tile(0.1 * np.eye(3), (3, 1, 1))),
        lines,
        jnp.asarray([True, False, False]),
        1.0,
    )
    after = with_error_of_first(before, jnp.asarray(cov))
    anchor, normal = np.asarray(lines.anchor)[0], np.asarray(lines.normal)[0]

    def moved(error: np.ndarray, pose: np.ndarray) -> np.ndarray:
        return compose(poses[0] + error, between(poses[0], pose))

    def line(error: np.ndarray) -> np.ndarray:
        place, ahead = (moved(error, [*point, 0.0])[:2] for point in (anchor, anchor + normal))
        turned = ahead - place
        return np.array([turned @ (place - anchor), np.arctan2(*turned[::-1])])

    def derivative(function: Any) -> np.ndarray:
        return np.stack([(function(h) - function(-h)) / 2e-6 for h in 1e-6 * np.eye(3)], -1)

    for k, pose in enumerate(poses):
        jac = derivative(lambda error, pose=pose: moved(error, pose))
        np.testing.assert_allclose(after.cov_poses[k], 0.1 * np.eye(3) + jac @ cov @ jac.T, atol=1e-9)
    jac = derivative(line)
    np.testing.assert_allclose(squared(after.lines.sqrt_persistent)[0], jac @ cov @ jac.T, atol=1e-9)
    np.testing.assert_array_equal(after.lines.cov_independent, lines.cov_independent)
    np.testing.assert_array_equal(after.lines.sqrt_persistent[1:], lines.sqrt_persistent[1:])


def test_what_was_seen_in_a_sweep_errs_with_it() -> None:
    """A scanner that was elsewhere when it saw a line: derivatives by moving it, in its own frame."""
    pose = np.array([1.0, -0.5, 0.4])
    scan = Scan.from_ranges(jnp.asarray(ranges_in(ROOM, pose)), jnp.asarray(BEARINGS), range_max=30.0)
    begin, end = ROOM, np.roll(ROOM, -1, 0)
    lines = lines_between(np.stack([begin, end], 1).tolist(), room=8)
    root = np.array([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [-0.004, 0.006, 0.01]])
    here = Pose(mean=jnp.asarray(pose), cov=jnp.diag(jnp.asarray([0.02, 0.02, 0.005]) ** 2))
    see = jax.jit(partial(sightings_of_scan, thresholds=Thresholds(), noise=SensorNoise()))
    known = LineMap(lines=lines, circles=poles_at([], room=2))
    still, moving = (see(scan, here, known, 7, jnp.asarray(cov))[0] for cov in (np.zeros((3, 3)), root @ root.T))
    assert still.valid.sum() >= 3
    for i in np.flatnonzero(still.valid):
        anchor, angle = np.asarray(still.anchor[i]), float(still.angle[i])
        normal = np.array([np.cos(angle), np.sin(angle)])

        def seen(error: np.ndarray, anchor: np.ndarray = anchor, normal: np.ndarray = normal) -> np.ndarray:
            """The line, through its anchor, as seen from the place in error: (offset there, angle)."""
            place, ahead = (between(error, [*point, 0.0])[:2] for point in (anchor, anchor + normal))
            turned = ahead - place
            return np.array([turned @ (place - anchor), np.arctan2(*turned[::-1])])

        jac = np.stack([(seen(h) - seen(-h)) / 2e-6 for h in 1e-6 * np.eye(3)], -1)
        added = np.asarray(moving.cov[i] - still.cov[i])
        np.testing.assert_allclose(added, jac @ root @ root.T @ jac.T, atol=1e-9)


def test_circles_are_seen_where_they_are() -> None:
    """The sightings of a pole, in the scanner's own frame; and what a sweep adds, by moving it."""
    pose, pole = np.array([1.0, -0.5, 0.4]), np.array([2.0, 0.2, 0.12])
    direction = np.stack([np.cos(pose[2] + BEARINGS), np.sin(pose[2] + BEARINGS)], -1)
    ahead, aside = direction @ (pole[:2] - pose[:2]), direction @ (np.array([[0, -1], [1, 0]]) @ (pole[:2] - pose[:2]))
    reach = ahead - np.sqrt(np.maximum(pole[2] ** 2 - aside**2, 0))
    ranges = np.where((np.abs(aside) < pole[2]) & (ahead > 0), reach, ranges_in(ROOM, pose))
    scan = Scan.from_ranges(jnp.asarray(ranges), jnp.asarray(BEARINGS), range_max=30.0)
    here = Pose(mean=jnp.asarray(pose), cov=jnp.diag(jnp.asarray([0.02, 0.02, 0.005]) ** 2))
    known = LineMap(lines=lines_between([], room=8), circles=poles_at([[9, 9, 0.1], [2.01, 0.21, 0.11]], room=4))
    root = np.array([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [-0.004, 0.006, 0.01]])
    see = jax.jit(partial(sightings_of_scan, thresholds=Thresholds(), noise=SensorNoise()))
    still, moving = (see(scan, here, known, 7, jnp.asarray(cov))[1] for cov in (np.zeros((3, 3)), root @ root.T))
    (i,) = np.flatnonzero(still.valid)
    assert (int(still.keyframe[i]), int(still.circle[i])) == (7, 1)
    expected = between(pose, [*pole[:2], 0.0])[:2]
    np.testing.assert_allclose(still.at[i], [*expected, 0.12], atol=0.004)

    def seen(error: np.ndarray) -> np.ndarray:
        return np.append(compose(error, [*np.asarray(still.at[i, :2]), 0.0])[:2], 0.12)

    jac = np.stack([(seen(h) - seen(-h)) / 2e-6 for h in 1e-6 * np.eye(3)], -1)
    np.testing.assert_allclose(moving.cov[i] - still.cov[i], jac @ root @ root.T @ jac.T, atol=1e-9)
    # The scanner's noise alone: what the pose errs by turns with the keyframe and is not counted here.
    sure = see(scan, dataclasses.replace(here, cov=here.cov / 100), known, 7, jnp.zeros((3, 3)))[1]
    np.testing.assert_allclose(sure.cov[i], still.cov[i], rtol=1e-6)


def test_circles_are_where_their_sightings_say() -> None:
    """Against a weighted mean in NumPy: two poles, one of them with a sighting that is of something else."""
    random = np.random.default_rng(6)
    truth = np.array([[2.0, 1.0, 0.1], [-3.0, 4.0, 0.2]])
    poses = np.array([[0.0, 0.0, 0.0], [1.0, -1.0, 0.7], [-2.0, 1.0, 2.5], [3.0, 3.0, -2.0]])
    cov_poses = np.stack([np.diag([1e-4, 2e-4, 1e-5]) * k for k in (1, 2, 3, 4)])
    root = 0.01 * random.standard_normal((8, 3, 3))
    cov = root @ root.swapaxes(-1, -2) + 1e-5 * np.eye(3)
    number, circle = np.tile(np.arange(4), 2), np.repeat([0, 2], 4)
    at, informations, pulls = [], np.zeros((2, 3, 3)), np.zeros((2, 3))
    for k in range(8):
        pose, i = poses[number[k]], k // 4
        c, s = np.cos(pose[2]), np.sin(pose[2])
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        place = turn.T @ (truth[i] - [*pose[:2], 0]) + random.multivariate_normal(np.zeros(3), cov[k])
        place[:2] += 5.0 if k == 6 else 0.0
        at.append(place)
        lever = turn[:2, :2] @ place[:2]
        moves = np.array([[1, 0, -lever[1]], [0, 1, lever[0]], [0, 0, 0]])
        if k != 6:
            weight = np.linalg.inv(turn @ cov[k] @ turn.T + moves @ cov_poses[number[k]] @ moves.T)
            informations[i] += weight
            pulls[i] += weight @ (turn @ place + [*pose[:2], 0])
    begin = poles_at([[2.03, 0.98, 0.12], [9.0, 9.0, 0.1], [-3.02, 4.02, 0.18]], room=5)
    sightings = CircleSightings(
        keyframe=jnp.asarray(np.append(number, 0)),
        circle=jnp.asarray(np.append(circle, 0)),
        at=jnp.asarray(np.concatenate([at, np.zeros((1, 3))])),
        cov=jnp.asarray(np.concatenate([cov, np.eye(3)[None]])),
        valid=jnp.asarray(np.append(np.ones(8, bool), False)),
    )
    after = jax.jit(circles_from_sightings)(begin, jnp.asarray(poses), jnp.asarray(cov_poses), sightings)
    for slot, information, pull in zip((0, 2), informations, pulls, strict=True):
        found = np.append(after.center[slot], after.radius[slot])
        np.testing.assert_allclose(found, np.linalg.solve(information, pull), atol=1e-9)
        np.testing.assert_allclose(after.cov[slot], np.linalg.inv(information), rtol=1e-8, atol=1e-14)
    np.testing.assert_array_equal(after.center[1], begin.center[1])
    np.testing.assert_array_equal(after.cov[1], begin.cov[1])


def tracked(corners: list[np.ndarray], poses: np.ndarray, odometry: np.ndarray) -> list[Any]:
    """What tracking says of scans from some poses, each among walls of its own."""
    scans = [
        Scan.from_ranges(
            jnp.asarray(ranges_in(walls, pose), "float32"), jnp.asarray(BEARINGS, "float32"), range_max=30.0
        )
        for walls, pose in zip(corners, poses, strict=True)
    ]
    told = jnp.asarray(odometry, "float32")
    state, said = begin_track(told[0], scans[0]), []
    for scan, pose in zip(scans, told, strict=True):
        state, one = TRACK(state, scan, pose)
        said.append(one)
    return said


def test_what_tracking_knows_of_a_step_is_seen_from_the_keyframe() -> None:
    """Along a corridor nothing is known, which from a robot that looks aslant is ahead and to the right."""
    start = np.array([0.0, 0.0, 0.5])
    poses = np.stack([start, compose(start, [0.3, 0.0, 0.0])])
    first, second = tracked([CORRIDOR] * 2, poses, poses)
    assert first.is_keyframe
    assert not second.is_keyframe
    np.testing.assert_allclose(second.step, [0.3, 0.0, 0.0], atol=0.03)
    along, across = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    information = np.asarray(second.information)[:2, :2]
    assert along @ information @ along < 0.05 * (across @ information @ across)
    assert abs(along @ information @ across) < 0.1 * (across @ information @ across)


def test_what_odometry_leaves_open_turns_with_the_robot() -> None:
    """After a straight metre: most along the way, where only the distance errs, and nothing in common with across."""
    noise = OdometryNoise(sigma_distance_distance=0.2)
    cov = _cov_guess(jnp.array([1.0, 0.0, 0.0]), jnp.array([7.0, 8.0, 0.5]), noise, TrackingSettings())
    along = np.array([np.cos(0.5), np.sin(0.5), 0.0])
    np.testing.assert_allclose(along @ np.asarray(cov), ((5 * 0.2) ** 2 + 0.1**2) * along, atol=1e-12)


def test_wheels_that_count_backwards_are_found_out_and_others_believed() -> None:
    """In a room a step back counted as one ahead is told by the scan; where another says no more, odometry stands."""
    backwards = np.array([[0.0, 0.0, 0.2], [-0.392, -0.0795, 0.2]])
    counted = np.array([[0.0, 0.0, 0.2], [0.392, 0.0795, 0.2]])
    _, said = tracked([ROOM] * 2, backwards, counted)
    np.testing.assert_allclose(said.pose, backwards[1], atol=0.01)
    # A cabinet in a corridor, new in the second scan: few points agree, however far the robot has gone along it.
    cabinet = np.array([[-40.0, -1.0], [40.0, -1.0], [40.0, 1.0], [2.5, 1.0], [2.5, -0.5], [0.6, -0.5], [0.6, 1.0]])
    cabinet = np.concatenate([cabinet, [[-40.0, 1.0]]])
    ahead = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
    _, said = tracked([CORRIDOR, cabinet], ahead, ahead)
    assert said.share < 0.8
    np.testing.assert_allclose(said.pose, ahead[1], atol=0.1)


def test_what_a_scan_looks_at_is_the_middle_of_what_is_near() -> None:
    position = jnp.array([[1.0, 0.0], [3.0, 2.0], [0.0, 11.0], [5.0, 5.0]])
    valid = jnp.array([True, True, True, False])
    surface = Surface(position=position, normal=position, flat=valid, valid=valid)
    np.testing.assert_allclose(middle_of(surface), [2.0, 1.0])
    np.testing.assert_allclose(middle_of(surface, reach=0.5), [0.0, 0.0])


def test_odometry_of_another_length_is_refused() -> None:
    scans = jax.vmap(lambda r: Scan.from_ranges(r, jnp.asarray(BEARINGS)))(jnp.ones((3, BEARINGS.size)))
    with pytest.raises(ValueError, match=r"one pose for each scan, shape \(3, 3\), not \(2, 3\)"):
        slam(scans, np.zeros((2, 3)))
