"""A whole log into a map: the same as scan by scan, whatever the chunks and capacities, and compiled once."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax import Capacity, LineMap, Report, build, build_chunks, empty_map, update
from linemap_jax.build import _run
from linemap_jax.core.state import LEFT_OUT, NEW, Pose, Scan, Status

T, CHUNK = 10, 4
MAP, SCAN = Capacity(32, 16), Capacity(16, 8)
BEARINGS = np.radians(np.arange(-90, 91, 2.0))
BOX = np.array([[-2.0, -1.5], [3.0, -1.5], [3.0, 2.0], [1.0, 2.0], [1.0, 1.2], [-2.0, 1.2]])
POLE = np.array([1.8, -0.6, 0.15])


def ranges_in_the_room(pose: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Beams into the walls of a room with a corner in it, and a pole."""
    direction = np.stack([np.cos(pose[2] + BEARINGS), np.sin(pose[2] + BEARINGS)], -1)
    nearest = np.full(len(BEARINGS), np.inf)
    for a, b in zip(BOX, np.roll(BOX, -1, 0), strict=True):
        along, start = b - a, a - pose[:2]
        det = direction[:, 0] * along[1] - direction[:, 1] * along[0]
        det = np.where(np.abs(det) < 1e-12, 1e-12, det)
        distance = (start[0] * along[1] - start[1] * along[0]) / det
        where = (start[0] * direction[:, 1] - start[1] * direction[:, 0]) / det
        hit = (distance > 0) & (where >= 0) & (where <= 1)
        nearest = np.where(hit, np.minimum(nearest, distance), nearest)
    towards = direction @ (POLE[:2] - pose[:2])
    inside = POLE[2] ** 2 - (np.sum((POLE[:2] - pose[:2]) ** 2) - towards**2)
    pole = np.where((inside > 0) & (towards > 0), towards - np.sqrt(np.maximum(inside, 0)), np.inf)
    return np.minimum(nearest, pole) + noise


def log(count: int = T, seed: int = 0) -> tuple[Scan, Pose]:
    """A drive through the room; one pose is not finite."""
    random = np.random.default_rng(seed)
    poses = np.stack([np.linspace(-1, 0.8, count), np.linspace(0, 0.4, count), np.linspace(-0.8, 1.2, count)], -1)
    scans = [
        Scan.from_ranges(ranges_in_the_room(pose, 0.01 * random.standard_normal(len(BEARINGS))), BEARINGS)
        for pose in poses
    ]
    poses = poses + random.standard_normal((count, 3)) * [0.01, 0.01, 0.003]
    poses[min(3, count - 1), 0] = np.nan
    cov = np.broadcast_to(np.diag([0.01, 0.01, 0.003]) ** 2, (count, 3, 3))
    return jax.tree.map(lambda *x: jnp.stack(x), *scans), Pose(mean=jnp.asarray(poses), cov=jnp.asarray(cov))


def at(stacked: Any, t: Any) -> Any:
    return jax.tree.map(lambda x: x[t], stacked)


def assert_close(a: Any, b: Any) -> None:
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-11), a, b)


update_one = jax.jit(partial(update, capacity=SCAN))


@pytest.fixture(scope="module")
def drive() -> tuple[Scan, Pose]:
    return log()


@pytest.fixture(scope="module")
def built(drive: tuple[Scan, Pose]) -> tuple[LineMap, Report]:
    return build(*drive, map_capacity=MAP, capacity=SCAN, chunk=CHUNK)


@pytest.fixture(scope="module")
def by_loop(drive: tuple[Scan, Pose]) -> tuple[list[LineMap], list[Report]]:
    maps, reports = [empty_map(MAP)], []
    for t in range(T):
        line_map, report = update_one(maps[-1], at(drive[0], t), at(drive[1], t))
        maps.append(line_map)
        reports.append(report)
    return maps, reports


def test_build_is_a_loop_over_update(built: Any, by_loop: Any) -> None:
    line_map, reports = built
    assert T % CHUNK != 0
    assert_close(line_map, by_loop[0][-1])
    assert_close(reports, jax.tree.map(lambda *x: jnp.stack(x), *by_loop[1]))
    # It is a log in which something happens.
    assert int(line_map.lines.valid.sum()) >= 5
    assert int(reports.fused.sum()) > 20
    assert reports.status.tolist() == [int(Status.POSE_NOT_FINITE) if t == 3 else 0 for t in range(T)]


def test_a_map_can_be_gone_on_from(drive: Any, built: Any) -> None:
    first, before = build(at(drive[0], slice(8)), at(drive[1], slice(8)), map_capacity=MAP, capacity=SCAN, chunk=CHUNK)
    rest = (at(drive[0], slice(8, T)), at(drive[1], slice(8, T)))
    second, after = build(*rest, line_map=first, capacity=SCAN, chunk=CHUNK)
    assert_close(second, built[0])
    assert_close(jax.tree.map(lambda a, b: jnp.concatenate([a, b]), before, after), built[1])


def test_nothing_is_compiled_twice(drive: Any, built: Any) -> None:
    compiled = _run._cache_size()
    build(*drive, map_capacity=MAP, capacity=SCAN, chunk=CHUNK)
    other = log(7, seed=1)
    build(*other, map_capacity=MAP, capacity=SCAN, chunk=CHUNK)
    assert _run._cache_size() == compiled
    update_one(built[0], at(drive[0], 1), at(drive[1], 1))
    assert update_one._cache_size() == 1


def test_capacities_grow_and_nothing_is_lost(drive: Any, built: Any) -> None:
    line_map, reports = build(*drive, map_capacity=Capacity(8, 1), capacity=Capacity(4, 8), chunk=CHUNK)
    large, expected = built
    k, c = line_map.lines.valid.shape[0], line_map.circles.valid.shape[0]
    assert 8 < k <= 32
    assert c <= 16
    assert not large.lines.valid[k:].any()
    assert not large.circles.valid[c:].any()
    assert_close(line_map.lines, at(large.lines, slice(k)))
    assert_close(line_map.circles, at(large.circles, slice(c)))
    width = reports.line_slot.shape[1]
    assert 4 < width <= 16
    np.testing.assert_array_equal(reports.line_slot, expected.line_slot[:, :width])
    assert np.all(np.asarray(expected.line_slot[:, width:]) == LEFT_OUT)
    for count in ("added", "fused", "merged", "trimmed", "split", "deleted", "status"):
        np.testing.assert_array_equal(getattr(reports, count), getattr(expected, count))


def test_a_full_map_says_so(drive: Any) -> None:
    full = empty_map(MAP)
    far = jnp.arange(32.0)[:, None] * 10 + 1000
    lines = dataclasses.replace(full.lines, anchor=far * jnp.ones((1, 2)), valid=jnp.arange(32) != 7)
    after, report = update_one(dataclasses.replace(full, lines=lines), at(drive[0], 0), at(drive[1], 0))
    assert Status(int(report.status)) == Status.MAP_LINES_FULL
    assert after.lines.valid.all()
    assert np.linalg.norm(after.lines.anchor[7]) < 10
    assert np.sum(np.asarray(report.line_slot) == NEW) == 1


def test_vmap_over_maps_and_scans_is_each_alone(drive: Any, by_loop: Any) -> None:
    which = (2, 5, 8)
    maps = jax.tree.map(lambda *x: jnp.stack(x), *(by_loop[0][t] for t in which))
    scans, poses = at(drive[0], jnp.array(which)), at(drive[1], jnp.array(which))
    together, reports = jax.jit(jax.vmap(partial(update, capacity=SCAN)))(maps, scans, poses)
    for i, t in enumerate(which):
        assert_close(at(together, i), by_loop[0][t + 1])
        assert_close(at(reports, i), by_loop[1][t])


def test_an_empty_stack_is_refused(drive: Any) -> None:
    with pytest.raises(ValueError, match="no scan"):
        build(at(drive[0], slice(0)), at(drive[1], slice(0)), map_capacity=MAP)
    assert list(build_chunks([], map_capacity=MAP)) == []


def test_what_does_not_belong_together_is_refused(drive: Any) -> None:
    scans, poses = drive
    with pytest.raises(ValueError, match="10 scans and 9 poses"):
        build(scans, at(poses, slice(9)))
    with pytest.raises(ValueError, match="longer than the chunk"):
        next(build_chunks([drive], chunk=CHUNK))
    with pytest.raises(ValueError, match="float32"):
        update(empty_map(MAP, jnp.float32), at(scans, 0), at(poses, 0), capacity=SCAN)
