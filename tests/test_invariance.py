"""What must not matter: where the world's origin lies, padding, capacities, and the order of the map's slots."""

import dataclasses
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from real_logs import scans_of

from linemap_jax import Capacity, LineMap, Mount, Pose, Scan, SensorNoise, empty_map, extract, preset, update

SCAN, MAP = Capacity(32, 64), Capacity(256, 128)
N = 91


def synthetic() -> tuple[Scan, Pose]:
    """Twelve scans of a rectangular room with a box in it, from poses on an arc."""
    random = np.random.default_rng(0)
    bearings = np.radians(np.linspace(-90, 90, N))
    scans, poses = [], []
    for t in range(12):
        x, y, theta = 0.2 * t - 1, 0.1 * np.sin(t), 0.37 * t + 0.1
        c, s = np.cos(theta + bearings), np.sin(theta + bearings)
        walls = [(w - p) / d for w, p, d in ((4.0, x, c), (-3.0, x, c), (2.5, y, s), (-2.0, y, s))]
        ranges = np.min([np.where(r > 0, r, np.inf) for r in walls], 0)
        ranges = np.where((np.arange(N) > 40) & (np.arange(N) < 50), 0.6 * ranges, ranges)
        scans.append(Scan.from_ranges(ranges + 0.01 * random.standard_normal(N), bearings))
        poses.append([x, y, theta])
    cov = np.broadcast_to(np.diag([0.05, 0.05, 0.01]) ** 2, (12, 3, 3))
    return jax.tree.map(lambda *x: jnp.stack(x), *scans), Pose(mean=jnp.asarray(poses), cov=jnp.asarray(cov))


def stacked(log: str) -> tuple[Scan, Pose]:
    if log == "synthetic":
        return synthetic()
    return jax.tree.map(jnp.asarray, scans_of(log, slice(0, 200, 4)))


@partial(jax.jit, static_argnames=("capacity", "name"))
def extract_all(
    scans: Scan, poses: Pose, capacity: Capacity = SCAN, name: Literal["default", "paper"] = "default"
) -> Any:
    return jax.lax.map(lambda x: extract(*x, capacity=capacity, **preset(name)), (scans, poses))


def item(stacked: Any, t: int) -> Any:
    return jax.tree.map(lambda x: x[t], stacked)


def in_numpy(tree: Any) -> Any:
    return jax.tree.map(np.asarray, tree)


def same(a: Any, b: Any) -> None:
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-11), a, b)


def by_beam(found: Any) -> np.ndarray:
    """End points of the line of each beam, [T, N, 2, 2]; zeros for none."""
    ends = np.stack([found.lines.begin, found.lines.end], 2)
    of_beam = np.take_along_axis(ends, np.maximum(found.line_of_beam, 0)[:, :, None, None], 1)
    return np.where((found.line_of_beam >= 0)[:, :, None, None], of_beam, 0)


@pytest.mark.parametrize("log", ["synthetic", "intel"])
def test_the_worlds_origin_does_not_matter(log: str) -> None:
    scans, poses = stacked(log)
    here = in_numpy(extract_all(scans, poses))
    mine = by_beam(here)
    on_line = here.line_of_beam >= 0
    assert on_line.mean() > 0.3
    for quarter, distance in ((0, 1.0), (0, 1e3), (0, 1e4), (1, 0.0), (1, 1e4), (3, 1e3)):
        c, s = round(np.cos(quarter * np.pi / 2)), round(np.sin(quarter * np.pi / 2))
        turn = np.array([[c, -s], [s, c]])
        shift = distance * np.array([1.0, -0.7])
        mean = np.asarray(poses.mean)
        mean = np.concatenate([mean[:, :2] @ turn.T + shift, mean[:, 2:] + quarter * np.pi / 2], 1)
        full = np.eye(3)
        full[:2, :2] = turn
        there = in_numpy(extract_all(scans, Pose(mean=jnp.asarray(mean), cov=full @ poses.cov @ full.T)))
        np.testing.assert_array_equal(there.line_of_beam, here.line_of_beam, err_msg=f"{quarter} {distance}")
        back = (by_beam(there) - shift) @ turn
        np.testing.assert_allclose(back[on_line], mine[on_line], atol=1e-6)
        # The covariance is that of the line, not of the frame.
        keep = here.lines.valid
        np.testing.assert_allclose(there.lines.cov[keep], here.lines.cov[keep], rtol=1e-5, atol=1e-12)


TURN = np.radians(37)


def turned(poses: Pose) -> Pose:
    """The same poses in a world that is turned by 37 degrees."""
    c, s = np.cos(TURN), np.sin(TURN)
    full = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    mean = np.asarray(poses.mean) @ full.T + [0, 0, TURN]
    return Pose(mean=jnp.asarray(mean), cov=jnp.asarray(full @ np.asarray(poses.cov) @ full.T))


def runs_of(line_of_beam: np.ndarray) -> dict[bytes, int]:
    """The slot of each line, by the beams that it has."""
    return {(line_of_beam == k).tobytes(): int(k) for k in np.unique(line_of_beam[line_of_beam >= 0])}


@pytest.mark.parametrize(("log", "name"), [("intel", "default"), ("intel", "paper"), ("freiburg-079", "default")])
def test_a_turn_of_the_world_does_no_more_than_in_the_oracle(log: str, name: Literal["default", "paper"]) -> None:
    """Regression of y on x depends on the axes: some runs end elsewhere, and lines move a little."""
    scans, poses = stacked(log)
    both = [in_numpy(extract_all(scans, p, name=name)) for p in (poses, turned(poses))]
    options = {**preset(name), "noise": SensorNoise(), "mount": Mount(), "capacity": SCAN}
    lost = {"mine": 0, "theirs": 0}
    back = np.array([[np.cos(TURN), np.sin(TURN)], [-np.sin(TURN), np.cos(TURN)]])
    moved = []
    for t in range(scans.valid.shape[0]):
        here, there = (item(found, t) for found in both)
        runs, others = runs_of(here.line_of_beam), runs_of(there.line_of_beam)
        lost["mine"] += len(runs.keys() - others.keys())
        scan = [np.asarray(x[t]) for x in (scans.ranges, scans.bearings, scans.valid)]
        of_oracle = [
            runs_of(oracle.extract(*scan, float(scans.spacing[t]), p.mean[t], p.cov[t], **options).line_of_beam)
            for p in in_numpy((poses, turned(poses)))
        ]
        lost["theirs"] += len(of_oracle[0].keys() - of_oracle[1].keys())

        for beams in runs.keys() & others.keys():
            i, j = runs[beams], others[beams]
            if here.lines.extent[i, 1] - here.lines.extent[i, 0] < 2:
                continue
            angle = here.lines.angle[i]
            step = here.lines.anchor[i] - back @ there.lines.anchor[j]
            normal, tangent = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
            turn = np.remainder(there.lines.angle[j] - TURN - angle + np.pi, 2 * np.pi) - np.pi
            # The turned line, at the anchor of the other one
            offset = there.lines.offset[j] - here.lines.offset[i] - normal @ step - turn * (tangent @ step)
            moved.append(np.abs([offset, turn]) / np.sqrt(np.diag(here.cov_measurement[i])))
    assert lost["mine"] == lost["theirs"]
    assert len(moved) > 20
    np.testing.assert_array_less(np.median(moved, 0), 0.1)


@pytest.mark.parametrize("log", ["synthetic", "intel"])
@pytest.mark.parametrize("distance", [1.0, 1e3, 1e4])
def test_the_worlds_origin_does_not_matter_in_float32(log: str, distance: float) -> None:
    lower = partial(jax.tree.map, lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x)
    scans, poses = stacked(log)
    shifted = dataclasses.replace(poses, mean=poses.mean + jnp.array([[distance, -0.7 * distance, 0.0]]))
    scans, poses, shifted = lower((scans, poses, shifted))
    here, there = in_numpy(extract_all(scans, poses)), in_numpy(extract_all(scans, shifted))
    assert there.lines.cov.dtype == np.float32
    equal = np.all(here.line_of_beam == there.line_of_beam, 1)
    assert np.mean(equal) >= 0.99
    robots = [np.asarray(p.mean, float)[:, None, None, :2] for p in (poses, shifted)]
    mine, theirs = (by_beam(f).astype(float) - robot for f, robot in zip((here, there), robots, strict=True))
    on_line = (here.line_of_beam >= 0) & equal[:, None]
    np.testing.assert_allclose(theirs[on_line], mine[on_line], atol=3e-3)


def test_padding_and_capacity_do_not_matter() -> None:
    scans, poses = synthetic()
    expected = in_numpy(extract_all(scans, poses))
    pad = ((0, 0), (0, 30))
    padded = dataclasses.replace(
        scans,
        ranges=jnp.pad(scans.ranges, pad, constant_values=7.0),
        bearings=jnp.pad(scans.bearings, pad, constant_values=jnp.nan),
        valid=jnp.pad(scans.valid, pad),
    )
    found = in_numpy(extract_all(padded, poses))
    same(found.lines, expected.lines)
    same(found.circles, expected.circles)
    np.testing.assert_array_equal(found.line_of_beam[:, :N], expected.line_of_beam)
    assert np.all(found.line_of_beam[:, N:] == -1)
    np.testing.assert_array_equal(found.rejected.invalid, expected.rejected.invalid + 30)

    large = in_numpy(extract_all(scans, poses, Capacity(64, 64)))
    same(jax.tree.map(lambda x: x[:, :32], large.lines), expected.lines)
    assert not large.lines.valid[:, 32:].any()
    same(
        (large.circles, large.line_of_beam, large.rejected),
        (expected.circles, expected.line_of_beam, expected.rejected),
    )


@jax.jit
def map_of(line_map: LineMap, scans: Scan, poses: Pose) -> tuple[LineMap, Any]:
    return jax.lax.scan(lambda m, x: update(m, *x, capacity=SCAN), line_map, (scans, poses))


def test_the_maps_capacity_does_not_matter() -> None:
    scans, poses = stacked("intel")
    small, reports = in_numpy(map_of(empty_map(MAP), scans, poses))
    large, others = in_numpy(map_of(empty_map(Capacity(512, 256)), scans, poses))
    assert not reports.status.any()
    same(small.lines, jax.tree.map(lambda x: x[:256], large.lines))
    same(small.circles, jax.tree.map(lambda x: x[:128], large.circles))
    assert not large.lines.valid[256:].any()
    same(reports, others)
    assert small.lines.valid.sum() > 20


def test_the_order_of_the_slots_does_not_matter() -> None:
    scans, poses = stacked("intel")
    line_map, _ = map_of(empty_map(MAP), scans, poses)
    count = int(jnp.max(jnp.where(line_map.lines.valid, jnp.arange(256), 0))) + 1
    order = np.arange(256)
    order[:count] = np.random.default_rng(0).permutation(count)
    again = LineMap(lines=jax.tree.map(lambda x: x[order], line_map.lines), circles=line_map.circles)
    # The last scan alone, in a stack of the same shape
    alone = jnp.arange(scans.valid.shape[0]) == scans.valid.shape[0] - 1
    last = (dataclasses.replace(scans, valid=scans.valid & alone[:, None]), poses)
    mine, one = in_numpy(map_of(line_map, *last))
    theirs, other = in_numpy(map_of(again, *last))
    for name in ("added", "fused", "merged", "trimmed", "split", "deleted", "status", "line_nis"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-9, atol=1e-9)
    assert one.fused.sum() > 2

    def ordered(lines: Any) -> tuple[np.ndarray, ...]:
        keep = np.asarray(lines.valid)
        columns = np.concatenate([lines.begin[keep], lines.end[keep], lines.times_detected[keep, None]], 1)
        rank = np.lexsort(np.round(columns, 6).T)
        return columns[rank], np.asarray(lines.cov)[keep][rank]

    same(ordered(mine.lines), ordered(theirs.lines))
    if not one.merged.any():
        slots, others = (np.ravel(r.line_slot) for r in (one, other))
        np.testing.assert_array_equal(slots, np.where(others >= 0, order[np.maximum(others, 0)], others))
