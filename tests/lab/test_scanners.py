"""Scanner models: exact without noise, and with it of the stated size; seeded, inside bands of six sigma."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax.core.settings import Mount
from linemap_jax.lab.generators import room
from linemap_jax.lab.raycast import NOTHING
from linemap_jax.lab.scanners import PRESETS, Scanner, lms200, noise_of, pls, simulate_scan, simulate_scans, sweep
from linemap_jax.lab.world import Kind, World, join, moved, poles, polygon

SIMULATE = jax.jit(simulate_scan)
BEARINGS = sweep(-np.pi / 2, np.pi / 2, 361)
EXACT = Scanner(bearings=BEARINGS)
HERE = jnp.array([0.2, -0.3, 0.4])
KEY = jax.random.key(7)
SIGMAS = 6
MANY = jax.jit(jax.vmap(simulate_scan, (0, None, None, None)))  # one program for all worlds of the same size


def many(world: World, scanner: Scanner, pose: jax.Array = HERE, runs: int = 50) -> Any:
    """Scans from one place."""
    return jax.tree.map(np.asarray, MANY(jax.random.split(KEY, runs), world, pose, scanner))


def assert_sigma(sample: np.ndarray, sigma: float, mean: float = 0.0) -> None:
    """Mean and standard deviation are within six sigma of what they should be; the sample is normal."""
    n = sample.size
    assert abs(sample.mean() - mean) < SIGMAS * sigma / np.sqrt(n)
    assert abs(sample.std() / sigma - 1) < SIGMAS / np.sqrt(2 * n)


def test_without_noise_it_is_the_wall() -> None:
    # A wall ahead, at x = 2 in the world, seen from (0.2, -0.3) under a heading of 0.4.
    scan, truth = SIMULATE(KEY, polygon(jnp.array([[2.0, -50.0], [2.0, 50.0]]), Kind.WALL), HERE, EXACT)
    cos = np.cos(0.4 + np.asarray(BEARINGS))
    ahead = cos > 0.05
    np.testing.assert_allclose(np.asarray(scan.ranges)[ahead], 1.8 / cos[ahead], rtol=1e-12)
    assert not np.asarray(scan.valid)[cos <= 0].any()
    np.testing.assert_array_equal(scan.bearings, BEARINGS)
    np.testing.assert_array_equal(truth.bearings, BEARINGS)
    np.testing.assert_array_equal(truth.thing, np.where(scan.valid, 0, NOTHING))
    np.testing.assert_array_equal(np.isinf(truth.ranges), ~np.asarray(scan.valid))
    assert scan.spacing == pytest.approx(np.radians(0.5))
    assert not truth.mixed.any()


def test_the_mount_is_one_more_frame() -> None:
    world = room(6.0, 4.0, 0.3)
    mount = Mount(x=0.3, y=-0.2, theta=0.5)
    place = jnp.array([0.3, -0.2, 0.5])
    scan, _ = SIMULATE(KEY, world, HERE, EXACT, mount)
    # The robot at rest at the origin, and the world moved instead: into the frame of the robot, then of the scanner.
    for frame in (HERE, place):
        back = jnp.concatenate([jnp.zeros(2), -frame[2:]])
        world = moved(moved(world, jnp.concatenate([-frame[:2], jnp.zeros(1)])), back)
    at_rest, _ = SIMULATE(KEY, world, jnp.zeros(3), EXACT)
    np.testing.assert_allclose(scan.ranges, at_rest.ranges, rtol=1e-12)


def test_noise_of_the_range() -> None:
    scan, truth = many(room(6.0, 4.0), dataclasses.replace(EXACT, range_sigma=0.03))
    assert_sigma(scan.ranges - truth.ranges, 0.03)
    np.testing.assert_array_equal(truth.ranges, np.broadcast_to(truth.ranges[0], truth.ranges.shape))


def test_noise_that_grows_with_the_range() -> None:
    scan, truth = many(room(6.0, 4.0), dataclasses.replace(EXACT, range_sigma=0.01, relative_sigma=0.02))
    assert_sigma((scan.ranges - truth.ranges) / np.sqrt(0.01**2 + (0.02 * truth.ranges) ** 2), 1.0)


def test_noise_of_the_bearing_moves_the_beam_and_not_its_label() -> None:
    wall = polygon(jnp.array([[2.0, -50.0], [2.0, 50.0]]), Kind.WALL)
    scanner = Scanner(bearings=jnp.linspace(-1.0, 1.0, 100), bearing_sigma=0.005)
    scan, truth = many(wall, scanner, jnp.zeros(3))
    np.testing.assert_array_equal(scan.bearings, np.broadcast_to(scanner.bearings, scan.bearings.shape))
    np.testing.assert_allclose(scan.ranges, 2 / np.cos(truth.bearings), rtol=1e-12)
    assert_sigma(truth.bearings - scan.bearings, 0.005)


def test_noise_differs_between_beams_scans_and_keys() -> None:
    scanner = Scanner(bearings=jnp.zeros(100), range_sigma=0.1, bearing_sigma=0.01)
    scan, truth = many(polygon(jnp.array([[2.0, -9.0], [2.0, 9.0]]), Kind.WALL), scanner, jnp.zeros(3))
    of_range, of_bearing = scan.ranges - truth.ranges, truth.bearings
    for noise in (of_range, of_bearing):
        assert np.unique(noise).size == noise.size
        for shifted in (noise[1:] * noise[:-1], noise[:, 1:] * noise[:, :-1]):
            assert abs(shifted.mean()) < SIGMAS * noise.var() / np.sqrt(shifted.size)
    assert abs((of_range * of_bearing).mean()) < SIGMAS * of_range.std() * of_bearing.std() / np.sqrt(of_range.size)


def test_rounding() -> None:
    scan, truth = many(room(6.0, 4.0), dataclasses.replace(EXACT, range_sigma=0.03, step=0.01))
    np.testing.assert_allclose(scan.ranges * 100, np.round(scan.ranges * 100), atol=1e-9)
    assert_sigma(scan.ranges - truth.ranges, np.sqrt(0.03**2 + 0.01**2 / 12))
    assert np.any(scan.ranges != scan.ranges[0])


def test_lost_beams() -> None:
    scan, truth = many(room(6.0, 4.0), dataclasses.replace(EXACT, dropout=0.1))
    n = scan.valid.size
    assert abs((~scan.valid).mean() - 0.1) < SIGMAS * np.sqrt(0.1 * 0.9 / n)
    np.testing.assert_allclose(scan.ranges[scan.valid], truth.ranges[scan.valid])
    assert np.all(np.isfinite(truth.ranges))


def test_out_of_range_is_no_return() -> None:
    scan, truth = SIMULATE(KEY, room(6.0, 4.0), HERE, dataclasses.replace(EXACT, range_min=2.0, range_max=3.0))
    np.testing.assert_array_equal(scan.valid, (truth.ranges >= 2) & (truth.ranges < 3))
    assert 0 < int(scan.valid.sum()) < 361


def test_mixed_readings_lie_between_near_and_far() -> None:
    # A pole at 2 m with a radius of 0.5 m before a wall at 5 m: a wide beam past its rim meets both.
    world = join(poles(jnp.array([[2.0, 0.0]]), 0.5), polygon(jnp.array([[5.0, -50.0], [5.0, 50.0]]), Kind.WALL))
    bearings = jnp.linspace(-0.5, 0.5, 201)
    scan, truth = many(world, Scanner(bearings=bearings, beam_width=0.01), jnp.zeros(3), 200)
    rim = np.arcsin(0.5 / 2)
    at_rim = np.abs(np.abs(np.asarray(bearings)) - rim) < 0.005
    np.testing.assert_array_equal(truth.mixed, np.broadcast_to(at_rim, truth.mixed.shape))
    assert at_rim.sum() == 4
    mixed, clear = scan.ranges[truth.mixed], ~truth.mixed
    assert 1.8 < mixed.min() < 2.1
    assert 4.9 < mixed.max() < 5.3
    assert abs(mixed.mean() - (np.sqrt(4 - 0.25) + 5 / np.cos(rim)) / 2) < 0.1 + SIGMAS * 3.2 / np.sqrt(12 * mixed.size)
    assert np.all(truth.thing[truth.mixed] == NOTHING)
    assert {*truth.thing[clear]} == {0, 1}
    pencil, _ = SIMULATE(KEY, world, jnp.zeros(3), Scanner(bearings=bearings))
    np.testing.assert_allclose(scan.ranges[0][clear[0]], pencil.ranges[clear[0]], rtol=1e-14)


def test_a_beam_half_in_the_void_reads_the_other_half() -> None:
    world = poles(jnp.array([[2.0, 0.0]]), 0.5)
    scan, truth = SIMULATE(KEY, world, jnp.zeros(3), Scanner(bearings=jnp.linspace(-0.5, 0.5, 201), beam_width=0.01))
    assert not truth.mixed.any()
    assert np.all(np.asarray(scan.ranges) <= 2)


def test_a_sweep_over_a_number_is_a_vmap() -> None:
    def spread(sigma: jax.Array) -> jax.Array:
        scan, truth = simulate_scan(KEY, room(6.0, 4.0), HERE, dataclasses.replace(EXACT, range_sigma=sigma))
        return jnp.std(scan.ranges - truth.ranges)

    spreads = jax.jit(jax.vmap(spread))(jnp.array([0.0, 0.01, 0.1]))
    assert spreads[0] == 0
    assert spreads[2] / spreads[1] == pytest.approx(10)


def test_scans_along_a_path_see_what_is_there() -> None:
    world = join(room(6.0, 4.0), poles(jnp.array([[1.5, 0.0]]), 0.1, appears=2, vanishes=4))
    poses = jnp.zeros((6, 3))
    _, truth = jax.jit(simulate_scans)(KEY, world, poses, EXACT)
    assert truth.ranges.shape == (6, 361)
    np.testing.assert_array_equal((np.asarray(truth.thing) == 4).any(1), [False, False, True, True, False, False])


@pytest.mark.parametrize(("name", "dtype"), [*((name, jnp.float32) for name in PRESETS), ("pls", jnp.float64)])
def test_presets(name: str, dtype: Any) -> None:
    scanner = PRESETS[name]()
    scan, truth = SIMULATE(KEY, room(jnp.asarray(6.0, dtype), 4.0), jnp.zeros(3, dtype), scanner)
    assert {x.dtype for x in (scan.ranges, scan.bearings, scan.spacing, truth.ranges)} == {jnp.dtype(dtype)}
    assert np.asarray(scan.valid).mean() > 0.9
    error = np.asarray(scan.ranges - truth.ranges)[np.asarray(scan.valid)]
    assert np.abs(error).max() < 0.1
    assert np.all(np.diff(scanner.bearings) > 0)


def test_layouts_of_the_presets() -> None:
    layouts = {name: np.degrees(np.asarray(make().bearings)) for name, make in PRESETS.items()}
    expected = {"pls": (361, -90, 0.5), "lms200": (361, -90, 0.5), "utm30lx": (1081, -135, 0.25)}
    for name, (count, first, step) in {**expected, "rplidar_a1": (360, -180, 1)}.items():
        np.testing.assert_allclose(layouts[name], first + step * np.arange(count), atol=1e-9)


def test_what_a_builder_should_believe() -> None:
    assert noise_of(lms200()).range_sigma == pytest.approx(np.sqrt(0.005**2 + 0.01**2 / 12))
    assert noise_of(pls()).bearing_sigma == 0.001
    scanner = Scanner(bearings=BEARINGS, range_sigma=0.03, relative_sigma=0.01)
    assert noise_of(scanner, at=4.0).range_sigma == pytest.approx(0.05)
