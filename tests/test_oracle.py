"""The pipeline against the plain NumPy reading in `oracle.py`, on real logs."""

import dataclasses
from functools import partial
from typing import Any

import jax
import numpy as np
import oracle
import pytest
from compiling import as_built
from real_logs import LOGS, one, scans_of

from linemap_jax import Capacity, Mount, SensorNoise, empty_map, extract, preset, update
from linemap_jax.core.settings import Persistence
from linemap_jax.core.state import LEFT_OUT, Pose, Scan

SCAN = Capacity(64, 96)
MAP = Capacity(512, 512)
EVERY = {"intel": 8, "aces": 8, "fhw": 8, "freiburg-079": 48}
"""Every n-th scan is compared: the oracle takes 5 ms for one."""


BEAMS = 361
"""Scans are filled up to so many beams, so that one compilation serves all logs."""


def filled(log: str, which: slice) -> tuple[Scan, Pose]:
    """Scans of a log with masked beams behind their own, and poses."""
    scans, poses = scans_of(log, which)
    pad = [(0, 0), (0, BEAMS - scans.ranges.shape[1])]
    beams = {name: np.pad(np.asarray(getattr(scans, name)), pad) for name in ("ranges", "bearings", "valid")}
    return dataclasses.replace(scans, **beams), poses


def oracle_options(options: dict[str, Any]) -> dict[str, Any]:
    """The options of `update` as the oracle takes them."""
    return options | {"noise": SensorNoise(), "mount": Mount()}


def fields(scan: Any) -> tuple[Any, ...]:
    """A scan as the oracle takes it."""
    return scan.ranges, scan.bearings, scan.valid, float(scan.spacing)


@partial(as_built, static_argnames="name")
def extract_one(scan: Any, pose: Any, name: Any) -> Any:
    return extract(scan, pose, capacity=SCAN, **preset(name))


@pytest.mark.parametrize("name", ["default", "paper"])
@pytest.mark.parametrize("log", LOGS)
def test_extraction_is_that_of_the_oracle(log: str, name: str) -> None:
    options = preset(name)
    scans, poses = filled(log, slice(None, None, EVERY[log]))
    options = oracle_options(options)
    for t in range(len(scans.ranges)):
        scan, pose = one(scans, t), one(poses, t)
        mine = jax.tree.map(np.asarray, extract_one(scan, pose, name))
        theirs = oracle.extract(*fields(scan), pose.mean, pose.cov, capacity=SCAN, **options)
        if theirs.deciding_margin < 1e-9:
            continue
        np.testing.assert_array_equal(oracle.compact(mine.line_of_beam, mine.lines.valid), theirs.line_of_beam)
        np.testing.assert_array_equal(oracle.compact(mine.circle_of_beam, mine.circles.valid), theirs.circle_of_beam)
        assert {key: int(getattr(mine.rejected, key)) for key in theirs.rejected} == theirs.rejected
        assert mine.status == theirs.status

        keep = mine.lines.valid
        estimate, cov = oracle.differences(mine.lines, theirs.lines, keep)
        np.testing.assert_array_less(estimate, 1e-9)
        np.testing.assert_array_less(cov, 1e-9)
        np.testing.assert_allclose(mine.lines.begin[keep], theirs.lines.begin, atol=1e-9)
        np.testing.assert_allclose(mine.lines.end[keep], theirs.lines.end, atol=1e-9)
        np.testing.assert_allclose(mine.lines.var_extent[keep], theirs.lines.var_extent, rtol=1e-8)
        np.testing.assert_allclose(mine.jac_line_pose[keep], theirs.jac_line_pose, atol=1e-7)
        scale = np.linalg.norm(theirs.cov_measurement, axis=(1, 2), keepdims=True)
        np.testing.assert_allclose(mine.cov_measurement[keep] / scale, theirs.cov_measurement / scale, atol=1e-9)

        kept = mine.circles.valid
        np.testing.assert_array_equal(mine.circles.fitted[kept], theirs.circles.fitted)
        np.testing.assert_allclose(mine.circles.center[kept], theirs.circles.center, atol=1e-8)
        np.testing.assert_allclose(mine.circles.radius[kept], theirs.circles.radius, atol=1e-8)
        np.testing.assert_allclose(mine.circles.cov_independent[kept], theirs.circles.cov_independent, atol=1e-8)
        np.testing.assert_allclose(mine.circles.sqrt_persistent[kept], theirs.circles.sqrt_persistent, atol=1e-8)


@pytest.mark.parametrize("log", LOGS)
def test_float32_extraction_is_that_of_the_oracle(log: str) -> None:
    scans, poses = filled(log, slice(None, None, 4 * EVERY[log]))
    lower = jax.tree.map(lambda x: x.astype("float32") if x.dtype == np.float64 else x, (scans, poses))
    options = oracle_options(preset("default"))
    same = total = 0
    for t in range(len(scans.ranges)):
        scan, pose = one(lower[0], t), one(lower[1], t)
        mine = jax.tree.map(np.asarray, extract_one(scan, pose, "default"))
        scan, pose = jax.tree.map(lambda x: x.astype("float64") if x.dtype == np.float32 else x, (scan, pose))
        theirs = oracle.extract(*fields(scan), pose.mean, pose.cov, capacity=SCAN, **options)
        total += 1
        if not np.array_equal(oracle.compact(mine.line_of_beam, mine.lines.valid), theirs.line_of_beam):
            continue
        same += 1
        moved = oracle.seen_from(mine.lines, theirs.lines.anchor, mine.lines.valid)
        sigma = np.sqrt(np.diagonal(theirs.lines.cov, axis1=1, axis2=2))
        np.testing.assert_array_less(np.abs(moved.offset - theirs.lines.offset), 0.01 * sigma[:, 0])
        np.testing.assert_array_less(np.abs(moved.angle - theirs.lines.angle), 0.01 * sigma[:, 1])
        cov = np.linalg.norm(moved.cov - theirs.lines.cov, axis=(1, 2)) / np.linalg.norm(theirs.lines.cov, axis=(1, 2))
        np.testing.assert_array_less(cov, 1e-3)
    assert same >= 0.99 * total


PERSISTENCE = Persistence(share=0.7, correlation=0.95)


@pytest.mark.parametrize("name", ["default", "paper"])
def test_a_log_is_mapped_alike_by_either_derivatives(name: Any) -> None:
    """By those derived by hand and those by autodiff: the same slots, fused alike, but for rounding."""
    scans, poses = filled("intel", slice(100))
    maps = [empty_map(MAP, np.float64)] * 2
    for t in range(100):
        scan, pose = one(scans, t), one(poses, t)
        both = zip(maps, ("analytic", "autodiff"), strict=True)
        maps = [update_one(line_map, scan, pose, name, "unknown", how)[0] for line_map, how in both]
    # Rounding of covariances comes back in estimates over many fusions.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9), *maps)


@partial(as_built, static_argnames=("name", "pose_error", "jacobians"))
def update_one(line_map: Any, scan: Any, pose: Any, name: Any, pose_error: Any, jacobians: Any) -> Any:
    options = {**preset(name), "pose_error": pose_error, "persistence": PERSISTENCE}
    return update(line_map, scan, pose, capacity=SCAN, jacobians=jacobians, **options)


@pytest.mark.parametrize(
    ("log", "name", "pose_error", "count"),
    [
        # Of 200 scans each scripts/compare_with_oracle.py tells.
        ("intel", "default", "unknown", 100),
        ("intel", "paper", "unknown", 100),
        ("freiburg-079", "default", "unknown", 200),
        ("freiburg-079", "paper", "unknown", 100),
        ("intel", "default", "independent", 60),
        ("intel", "default", "persistent", 60),
    ],
)
def test_map_is_that_of_the_oracle_slot_by_slot(log: str, name: str, pose_error: str, count: int) -> None:
    scans, poses = filled(log, slice(count))
    line_map = empty_map(MAP, np.float64)
    options = oracle_options(preset(name)) | {"pose_error": pose_error, "persistence": PERSISTENCE}
    theirs = oracle.empty_map(MAP)
    for t in range(count):
        scan, pose = one(scans, t), one(poses, t)
        theirs, report = oracle.update(theirs, fields(scan), pose.mean, pose.cov, scan_capacity=SCAN, **options)
        line_map, said = update_one(line_map, scan, pose, name, pose_error, "analytic")
        mine, said = jax.tree.map(np.asarray, (line_map, said))
        for name_of_count in ("added", "fused", "merged", "trimmed", "split", "deleted", "status"):
            assert getattr(said, name_of_count) == getattr(report, name_of_count), f"{name_of_count}, scan {t}"
        # What a scan holds may have free slots between.
        here, there = ((x.line_slot != LEFT_OUT) | (x.line_dof > 0) for x in (said, report))
        np.testing.assert_array_equal(said.line_slot[here], report.line_slot[there], err_msg=f"scan {t}")
        np.testing.assert_array_equal(said.line_dof[here], report.line_dof[there], err_msg=f"scan {t}")
        np.testing.assert_allclose(said.line_nis[here], report.line_nis[there], rtol=1e-4, atol=1e-6)
        here, there = (x.circle_slot != LEFT_OUT for x in (said, report))
        np.testing.assert_array_equal(said.circle_slot[here], report.circle_slot[there])
        np.testing.assert_array_equal(mine.lines.valid, theirs.lines.valid)
        np.testing.assert_array_equal(mine.circles.valid, theirs.circles.valid)
    keep = theirs.lines.valid
    estimate, cov = oracle.differences(mine.lines, theirs.lines.take(np.flatnonzero(keep)), keep)
    np.testing.assert_array_less(estimate, 1e-8)
    np.testing.assert_array_less(cov, 1e-6)
    np.testing.assert_allclose(mine.lines.extent[keep], theirs.lines.extent[keep], atol=1e-7)
    np.testing.assert_array_equal(mine.lines.times_detected[keep], theirs.lines.times_detected[keep])
    kept = theirs.circles.valid
    np.testing.assert_allclose(mine.circles.center[kept], theirs.circles.center[kept], atol=1e-7)
    np.testing.assert_allclose(mine.circles.radius[kept], theirs.circles.radius[kept], atol=1e-7)
    np.testing.assert_allclose(mine.circles.cov[kept], theirs.circles.cov[kept], atol=1e-8)
    np.testing.assert_array_equal(mine.circles.fitted[kept], theirs.circles.fitted[kept])
    np.testing.assert_array_equal(mine.circles.times_detected[kept], theirs.circles.times_detected[kept])


@pytest.mark.parametrize("name", ["default", "paper"])
def test_line_by_line_the_map_is_nearly_the_same(name: str) -> None:
    """The paper takes the lines of a scan one after the other; that is told from scripts/compare_with_oracle.py."""
    scans, poses = filled("intel", slice(30))
    options = oracle_options(preset(name)) | {"pose_error": "unknown", "persistence": PERSISTENCE}
    at_once, one_by_one = oracle.empty_map(MAP), oracle.empty_map(MAP)
    for t in range(30):
        scan, pose = one(scans, t), one(poses, t)
        seen = fields(scan), pose.mean, pose.cov
        at_once, _ = oracle.update(at_once, *seen, scan_capacity=SCAN, **options)
        one_by_one, _ = oracle.update(one_by_one, *seen, scan_capacity=SCAN, mode="sequential", **options)
    counts = [int(line_map.lines.valid.sum()) for line_map in (at_once, one_by_one)]
    assert min(counts) > 10
    assert counts[0] == pytest.approx(counts[1], rel=0.2)
