"""Slots: finding them, against NumPy; what is computed in a loop of two steps is what would be computed at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax.core.slots import (
    all_true,
    computed_once,
    directed,
    earliest_true,
    first_true,
    free_slots,
    latest_true,
    least,
    rank_of_true,
    resize,
)
from linemap_jax.core.state import empty_lines


@pytest.mark.parametrize("pattern", ["......", "######", ".#..#.", "#....#"])
def test_the_true_ones_are_found(pattern: str) -> None:
    which = np.array([c == "#" for c in pattern])
    n, there = len(which), np.flatnonzero(which)
    asked = jnp.asarray(which)
    assert first_true(asked) == (there[0] if len(there) else n)
    for size in (2, 6):
        assert all_true(asked, size).tolist() == [*there, *[n] * n][:size]
    assert rank_of_true(asked).tolist() == [int(np.sum(there < i)) for i in range(n)]
    assert latest_true(asked).tolist() == [max([-1, *there[there <= i]]) for i in range(n)]
    assert earliest_true(asked).tolist() == [min([n, *there[there >= i]]) for i in range(n)]


def test_free_slots_go_to_those_that_want_one_in_order() -> None:
    wanted = jnp.array([True, False, True, True])
    for taken, slots, lacking in (("#.#..", [1, -1, 3, 4], False), ("#.##.", [1, -1, 4, -1], True)):
        found, lacks = free_slots(wanted, jnp.array([c == "#" for c in taken]))
        assert found.tolist() == slots
        assert bool(lacks) == lacking


@pytest.mark.parametrize("axis", [0, 1])
def test_the_least_of_each_row_or_column_is_the_first_of_equal_ones(axis: int) -> None:
    score = jnp.array([[3.0, 1.0, 1.0, 4.0], [jnp.inf] * 4, [2.0, 5.0, 0.5, 0.5]])
    where, value = least(score if axis == 1 else score.T, axis)
    assert where.tolist() == [1, 0, 2]
    assert value.tolist() == [1.0, jnp.inf, 0.5]


def test_slots_may_be_added_but_not_taken() -> None:
    lines = empty_lines(3)
    assert resize(lines, 3).valid.shape == (3,)
    assert resize(lines, 5).sqrt_persistent.shape == (5, 2, 3)
    with pytest.raises(ValueError, match="cannot shrink 3 slots to 2"):
        resize(lines, 2)


@pytest.mark.parametrize("count", [1, 2, 5, 8])
def test_computed_once_is_the_function_of_all_rows(count: int) -> None:
    rows = {"a": jnp.arange(1.0, count + 1), "b": jnp.arange(2.0 * count).reshape(count, 2)}

    def function(x: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return jnp.sqrt(x["a"]), x["b"] * x["a"][:, None]

    for found, expected in zip(jax.jit(lambda x: computed_once(function, x))(rows), function(rows), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-14)
    of_sum = jax.grad(lambda a: jnp.sum(computed_once(function, rows | {"a": a})[0]))(rows["a"])
    np.testing.assert_allclose(of_sum, 0.5 / np.sqrt(rows["a"]), rtol=1e-14)


def test_directed_lines_have_the_normals_and_tangents_of_their_angles() -> None:
    angle = jnp.asarray([0.3, -2.0, np.pi])
    found = directed(empty_lines(3).replace(angle=angle))
    np.testing.assert_allclose(found.normal, np.stack([np.cos(angle), np.sin(angle)], -1), atol=1e-15)
    np.testing.assert_allclose(found.tangent, np.stack([-np.sin(angle), np.cos(angle)], -1), atol=1e-15)
