"""Runs: who gets a slot, and which points they hold."""

import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax.core.runs import select_runs


@pytest.mark.parametrize("capacity", [1, 2, 3])
def test_runs_get_slots_in_order_and_what_finds_none_is_told(capacity: int) -> None:
    """Of ten points, 1 to 3 are a run and 5 to 8 another; the points between and behind them are in none."""
    count, chosen = np.zeros(10), np.zeros(10, bool)
    count[[3, 8]], chosen[[3, 8]] = (3, 4), True
    runs, full = select_runs(jnp.asarray(count), jnp.asarray(chosen), capacity)
    held = min(capacity, 2)
    assert bool(full) == (capacity < 2)
    assert runs.valid.tolist() == [True] * held + [False] * (capacity - held)
    assert list(zip(runs.first.tolist(), runs.last.tolist(), strict=True))[:held] == [(1, 3), (5, 8)][:held]
    expected = np.array([-1, 0, 0, 0, -1, 1, 1, 1, 1, -1])
    np.testing.assert_array_equal(runs.of_point, np.where(expected < held, expected, -1))
