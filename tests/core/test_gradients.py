"""Gradients through the whole of it are finite: of what is extracted and of the map, by all that goes in."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import A_LITTLE

from linemap_jax import Capacity, LineMap, Mount, Pose, Scan, SensorNoise, empty_map, extract, preset, update
from linemap_jax.core.settings import Thresholds

N = 91
BEARINGS = np.radians(np.linspace(-90, 90, N))
SCAN, MAP = Capacity(8, 8), Capacity(12, 8)
COV_POSE = np.diag([0.05, 0.05, 0.01]) ** 2


def room() -> np.ndarray:
    """Ranges in a room with a pole, an object before a wall, and noise."""
    c, s = np.cos(BEARINGS), np.sin(BEARINGS)
    walls = [np.where(d != 0, w / np.where(d != 0, d, 1), -1) for w, d in ((4.0, c), (2.5, s), (-2.0, s))]
    ranges = np.min([np.where(r > 0, r, np.inf) for r in walls], 0)
    along, across = 2 * c + 0.8 * s, 2 * s - 0.8 * c
    ranges = np.where(
        (np.abs(across) < 0.14) & (along > 0), along - np.sqrt(np.maximum(0.14**2 - across**2, 0)), ranges
    )
    ranges[20:32] *= 0.6
    return ranges + 0.01 * np.random.default_rng(0).standard_normal(N)


def scans() -> dict[str, np.ndarray]:
    """Scans by name."""
    full = room()
    some = np.where(np.arange(N) % 7 == 0, np.nan, full)
    lone = np.full(N, np.nan)
    lone[[10, 50]] = full[[10, 50]]
    return {
        "room": full,
        "with gaps": some,
        "no returns": np.full(N, np.nan),
        "two returns": lone,
        "a round wall": np.full(N, 3.0),
        "head on": 2 / np.maximum(np.cos(BEARINGS), 0.3),
    }


def moments(tree: Any) -> jax.Array:
    """One number that depends on every float of a tree."""
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    return sum(jnp.sum(x * jnp.cos(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape)) for x in leaves)


def inputs(ranges: np.ndarray, cov: np.ndarray) -> tuple[Any, ...]:
    """What is differentiated by: ranges, pose, noise, mount, thresholds."""
    numbers = partial(jax.tree.map, lambda x: jnp.asarray(x, float))
    pose = Pose(mean=jnp.array([0.1, -0.2, 0.05]), cov=jnp.asarray(cov))
    return jnp.asarray(np.nan_to_num(ranges)), pose, *numbers((SensorNoise(), Mount(0.1, 0.0, 0.0), Thresholds()))


def of_extraction(
    ranges: jax.Array, pose: Pose, noise: Any, mount: Any, thresholds: Any, scan: Scan, name: str, jacobians: str
) -> jax.Array:
    options = {**preset(name), "thresholds": thresholds, "noise": noise, "mount": mount, "capacity": SCAN}
    found = extract(dataclasses.replace(scan, ranges=ranges), pose, jacobians=jacobians, **options)
    return moments(found)


def of_map(
    steps: jax.Array, given: tuple[Any, ...], scan: Scan, line_map: LineMap, name: str
) -> tuple[jax.Array, LineMap]:
    """After a step of each input, all of its numbers alike; and the map itself."""
    given = [jax.tree.map(lambda x, step=step: x + step, x) for x, step in zip(given, steps, strict=True)]
    ranges, pose, noise, mount, thresholds = given
    options = {**preset(name), "thresholds": thresholds, "noise": noise, "mount": mount, "capacity": SCAN}
    scan = dataclasses.replace(scan, ranges=ranges)
    line_map, _ = update(line_map, scan, pose, jacobians="analytic", **options)
    return moments(line_map), line_map


def assert_finite(gradient: Any) -> None:
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


@pytest.mark.parametrize(
    ("name", "jacobians"), [("default", "autodiff"), ("default", "analytic"), ("paper", "analytic")]
)
def test_gradients_of_an_extraction_are_finite(name: str, jacobians: str) -> None:
    gradient = jax.jit(jax.grad(of_extraction, range(5)), static_argnames=("name", "jacobians"))
    for which, ranges in scans().items():
        scan = Scan.from_ranges(ranges, BEARINGS)
        for cov in (COV_POSE, np.zeros((3, 3))):
            found = gradient(*inputs(ranges, cov), scan, name=name, jacobians=jacobians)
            assert_finite(found)
            # By ranges, and by the pose, as far as anything was seen
            seen = which not in ("no returns", "two returns")
            assert np.any(found[0] != 0) == seen, which
            assert np.any(found[1].mean != 0) == seen, which


@pytest.mark.parametrize("name", ["default", "paper"])  # which wipe by beams, and by triangles
def test_gradients_of_a_map_are_finite(name: str) -> None:
    """In forward mode: wiping loops over as many lines as are cut, which has no reverse."""
    # Not optimised at all, XLA (jax 0.8.3) reads one number of this program twice, and the second time as NaN.
    gradient = jax.jit(jax.jacfwd(of_map, has_aux=True), static_argnames="name", compiler_options=A_LITTLE)
    full = scans()["room"]
    # The map of another view, so that lines and circles are fused, added and wiped
    other = Pose(mean=jnp.array([0.12, -0.22, 0.06]), cov=jnp.asarray(COV_POSE))
    moved = np.where((np.arange(N) > 60) & (np.arange(N) < 70), 0.5 * full, full)
    ranges, _, noise, *_ = inputs(moved, COV_POSE)
    mount, thresholds = jax.tree.map(lambda x: jnp.asarray(x, float), (Mount(), preset(name)["thresholds"]))
    given = ranges, other, noise, mount, thresholds
    found, line_map = gradient(jnp.zeros(5), given, Scan.from_ranges(moved, BEARINGS), empty_map(MAP), name=name)
    assert np.isfinite(found).all()
    assert line_map.lines.valid.sum() > 2
    for ranges in scans().values():
        scan = Scan.from_ranges(ranges, BEARINGS)
        for before in (line_map, empty_map(MAP)):
            found, _ = gradient(jnp.zeros(5), inputs(ranges, COV_POSE), scan, before, name=name)
            assert np.isfinite(found).all()
            assert (found[0] != 0) == (np.isfinite(ranges).sum() > 2)
