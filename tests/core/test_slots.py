"""Slots: what is computed in a loop of two steps is what would be computed at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax.core.slots import computed_once, directed
from linemap_jax.core.state import empty_lines


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
