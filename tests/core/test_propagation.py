"""Small symmetric matrices, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax.core.propagation import inverse, propagate, square_root


def definite(n: int, count: int = 200) -> np.ndarray:
    half = np.random.default_rng(n).standard_normal((count, n, n)) * 10 ** np.linspace(-3, 1, count)[:, None, None]
    return half @ half.transpose(0, 2, 1) + 1e-9 * np.eye(n)


@pytest.mark.parametrize("n", [2, 3])
def test_inverse_and_square_root_of_definite_matrices(n: int) -> None:
    matrix = definite(n)
    np.testing.assert_allclose(
        inverse(jnp.asarray(matrix)) @ matrix, np.broadcast_to(np.eye(n), matrix.shape), atol=1e-4
    )
    np.testing.assert_allclose(square_root(jnp.asarray(matrix)), np.linalg.cholesky(matrix), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    "diagonal", [(0, 0, 0), (0, 1, 4), (1, 0, 4), (1, 4, 0), (0, 0, 4)], ids=lambda d: "".join(map(str, d))
)
def test_square_root_where_some_direction_has_no_variance(diagonal: tuple[float, ...]) -> None:
    """As of a pose whose heading is known: a column of zeros, and a gradient that is finite."""
    matrix = jnp.diag(jnp.array(diagonal, float))
    np.testing.assert_allclose(square_root(matrix), np.sqrt(matrix), atol=1e-15)
    gradient = jax.grad(lambda a: jnp.sum(square_root(a)))(matrix)
    assert np.isfinite(gradient).all()
    # Of sqrt(4): 1/4
    if 4 in diagonal:
        where = diagonal.index(4)
        np.testing.assert_allclose(gradient[where, where], 0.25)


def test_square_root_of_a_matrix_of_rank_one() -> None:
    vector = np.array([2.0, -1.0, 0.5])
    root = np.asarray(square_root(jnp.outer(vector, vector)))
    np.testing.assert_allclose(root @ root.T, np.outer(vector, vector), atol=1e-14)


def test_propagate_is_symmetric_and_right() -> None:
    random = np.random.default_rng(0)
    jac, cov = random.standard_normal((50, 2, 3)), definite(3, 50)
    found = np.asarray(propagate(jnp.asarray(jac), jnp.asarray(cov)))
    np.testing.assert_array_equal(found, found.transpose(0, 2, 1))
    np.testing.assert_allclose(found, np.einsum("kij,kjl,kml->kim", jac, cov, jac), rtol=1e-9)
