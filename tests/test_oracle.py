"""The pipeline against the plain NumPy reading in `oracle.py`, on real logs."""

from functools import partial
from typing import Any

import jax
import numpy as np
import oracle
import pytest
from real_logs import LOGS, one, scans_of

from linemap_jax import Capacity, Mount, SensorNoise, empty_map, extract, preset, update
from linemap_jax.core.settings import Persistence
from linemap_jax.core.state import LEFT_OUT

SCAN = Capacity(64, 96)
MAP = Capacity(512, 512)
EVERY = {"intel": 3, "aces": 3, "fhw": 3, "freiburg-079": 24}
"""Every n-th scan is compared: the oracle takes 5 ms for one."""


def oracle_options(options: dict[str, Any]) -> dict[str, Any]:
    """The options of `update` as the oracle takes them."""
    return options | {"noise": SensorNoise(), "mount": Mount()}


def fields(scan: Any) -> tuple[Any, ...]:
    """A scan as the oracle takes it."""
    return scan.ranges, scan.bearings, scan.valid, float(scan.spacing)


@partial(jax.jit, static_argnames=("name", "jacobians"))
def extract_all(scans: Any, poses: Any, name: str, jacobians: str = "autodiff") -> Any:
    """Extraction of a stack of scans with a preset."""
    one_scan = partial(extract, capacity=SCAN, jacobians=jacobians, **preset(name))
    return jax.lax.map(lambda x: one_scan(*x), (scans, poses))


@pytest.mark.parametrize("name", ["default", "paper"])
@pytest.mark.parametrize("log", LOGS)
def test_extraction_is_that_of_the_oracle(log: str, name: str) -> None:
    options = preset(name)
    scans, poses = scans_of(log, slice(None, None, EVERY[log]))
    found = jax.tree.map(np.asarray, extract_all(scans, poses, name))
    options = oracle_options(options)
    for t in range(len(found.status)):
        scan, pose, mine = one(scans, t), one(poses, t), one(found, t)
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
    scans, poses = scans_of(log, slice(None, None, 4 * EVERY[log]))
    lower = jax.tree.map(lambda x: x.astype("float32") if x.dtype == np.float64 else x, (scans, poses))
    found = jax.tree.map(np.asarray, extract_all(*lower, "default"))
    options = oracle_options(preset("default"))
    same = total = 0
    for t in range(len(found.status)):
        scan, pose, mine = one(lower[0], t), one(lower[1], t), one(found, t)
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


# As in `build`: these options compile in half the time.
@partial(jax.jit, static_argnames=("name", "pose_error"), compiler_options={"xla_cpu_use_fusion_emitters": False})
def update_all(line_map: Any, scans: Any, poses: Any, name: str, pose_error: str) -> Any:
    """The map after each scan, and the reports."""
    options = preset(name) | {"pose_error": pose_error, "persistence": PERSISTENCE}

    def step(line_map: Any, x: Any) -> Any:
        line_map, report = update(line_map, *x, capacity=SCAN, **options)
        return line_map, (line_map, report)

    return jax.lax.scan(step, line_map, (scans, poses))[1]


@pytest.mark.parametrize(
    ("log", "name", "pose_error", "count"),
    [
        ("intel", "default", "unknown", 200),
        ("intel", "paper", "unknown", 200),
        ("freiburg-079", "default", "unknown", 200),
        ("freiburg-079", "paper", "unknown", 200),
        ("intel", "default", "independent", 60),
        ("intel", "default", "persistent", 60),
    ],
)
def test_map_is_that_of_the_oracle_slot_by_slot(log: str, name: str, pose_error: str, count: int) -> None:
    scans, poses = scans_of(log, slice(count))
    maps, reports = jax.tree.map(np.asarray, update_all(empty_map(MAP, np.float64), scans, poses, name, pose_error))
    options = oracle_options(preset(name)) | {"pose_error": pose_error, "persistence": PERSISTENCE}
    theirs = oracle.empty_map(MAP)
    for t in range(count):
        scan, pose = one(scans, t), one(poses, t)
        theirs, report = oracle.update(theirs, fields(scan), pose.mean, pose.cov, scan_capacity=SCAN, **options)
        mine, said = one(maps, t), one(reports, t)
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
