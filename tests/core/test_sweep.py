"""Sweeps that close on themselves: a wall across the seam is one wall."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax import Capacity, Pose, Scan, extract
from linemap_jax.core.state import Extraction
from linemap_jax.core.sweep import close_sweep

HERE = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))
N = 360


def room(begin: float, *, sign: int = 1, extra: int = 0, gap: bool = False, seed: int = 0) -> tuple[np.ndarray, ...]:
    """A rectangular room of 6 m by 4 m, from a place off its middle; `gap` opens a door in the east."""
    bearings = begin + sign * np.arange(N + extra) * 2 * np.pi / N
    c, s = np.cos(bearings), np.sin(bearings)
    with np.errstate(divide="ignore"):
        walls = [np.where(d > 0, w / d, np.inf) for w, d in ((2.3, c), (3.7, -c), (2.3, s), (1.7, -s))]
    ranges = np.min(walls, 0) + 0.01 * np.random.default_rng(seed).standard_normal(N + extra)
    if gap:
        ranges = np.where(np.abs(np.arctan2(s, c)) < 0.2, np.inf, ranges)
    return ranges, bearings


def close(ranges: np.ndarray, bearings: np.ndarray) -> tuple[np.ndarray, int]:
    spacing = np.median(np.abs(np.diff(bearings)))
    valid, first = close_sweep(np.nan_to_num(ranges, posinf=0.0), bearings, np.isfinite(ranges), spacing)
    return valid, int(first)


@jax.jit
def found_in(ranges: jax.Array, bearings: jax.Array) -> Extraction:
    return extract(Scan.from_ranges(ranges, bearings), HERE, capacity=Capacity(8, 8))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_closed_room_has_four_walls_wherever_the_driver_begins(sign):
    # One beam more than a turn, so that the first direction is measured twice.
    for i, begin in enumerate(np.linspace(-np.pi, np.pi, 24)):
        lines = found_in(*room(begin, sign=sign, extra=1, seed=i)).lines
        assert lines.valid.sum() == 4, f"begun at {begin}"
        # In the corners the points are up to 17 cm apart.
        np.testing.assert_allclose(np.sort(lines.length[lines.valid]), [4, 4, 6, 6], atol=0.35)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("extra", [0, 1, 2])
def test_the_sweep_begins_at_a_corner_and_drops_what_came_twice(sign, extra):
    corners = [np.arctan2(y, x) for x in (2.3, -3.7) for y in (2.3, -1.7)]
    for begin in np.linspace(-3, 3, 10):
        ranges, bearings = room(begin, sign=sign, extra=extra)
        valid, first = close(ranges, bearings)
        off = np.angle(np.exp(1j * (bearings[first] - np.array(corners))))
        assert np.abs(off).min() < np.radians(2.5)
        assert valid.sum() == N
        assert valid[:N].all()


def test_the_sweep_begins_after_beams_without_a_return_and_else_at_a_jump():
    ranges, bearings = room(2.0, gap=True)
    _, first = close(ranges, bearings)
    assert np.isfinite(ranges[first])
    assert not np.isfinite(ranges[first - 1])
    ranges, bearings = room(2.0)
    ranges[40:60] = 0.8  # a box before the wall
    assert close(ranges, bearings)[1] in (40, 60)


def test_lost_beams_do_not_make_it_begin_within_a_wall():
    ranges, bearings = room(2.0)
    corner = close(ranges, bearings)[1]
    ranges[::7] = np.nan
    ranges[corner] = 0.8 * room(2.0)[0][corner]
    assert abs(close(ranges, bearings)[1] - corner) <= 1


@pytest.mark.parametrize("turn", [np.pi, 1.5 * np.pi, 2 * np.pi - 0.1, 4 * np.pi])
def test_a_sweep_that_does_not_close_is_left_as_it_is(turn):
    bearings = np.linspace(-turn / 2, turn / 2, N)[: N - 3]
    ranges = np.full(N - 3, 2.0)
    ranges[100:] = 5.0
    valid, first = close(ranges, bearings)
    if turn < 2 * np.pi:
        assert valid.all()
        assert first == 0
    else:  # twice around: the second time is dropped
        assert valid.sum() == pytest.approx(N / 2, abs=1)


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_few_beams(n):
    valid, first = close_sweep(np.ones(n), np.arange(float(n)), np.ones(n, bool), np.array(1.0))
    assert (valid.all(), int(first)) == (True, 0)
    np.testing.assert_array_equal(Scan.from_ranges(np.ones(n), np.arange(float(n))).valid, valid)


def test_beams_keep_their_numbers():
    # The seam lies within the western wall; the last beam is the first once more.
    of_beam = np.asarray(found_in(*room(-np.pi, extra=1)).line_of_beam)
    assert of_beam[0] == of_beam[5] == of_beam[-5] >= 0
    assert of_beam[-1] == -1


def test_many_sweeps_at_once_are_as_one_by_one():
    ranges, bearings = room(2.0)
    for some in ([bearings], [bearings, bearings / 2], [bearings / 2, bearings / 3]):
        b = np.stack(some)
        r, spacing = np.broadcast_to(ranges, b.shape), np.median(np.abs(np.diff(b)), -1)
        valid = np.isfinite(r)
        together = close_sweep(np.where(valid, r, 0), b, valid, spacing)
        for i in range(len(some)):
            alone = close_sweep(np.where(valid[i], r[i], 0), b[i], valid[i], spacing[i])
            np.testing.assert_array_equal(together[0][i], alone[0])
            assert together[1][i] == alone[1]
