"""Covariance of f(x) from the covariance of x, and the small symmetric matrices that this takes."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from linemap_jax.core.settings import Jacobians


def jacobian(
    function: Callable[[Float[Array, " n"]], Float[Array, " m"]],
    derivative: Callable[[Float[Array, " n"]], Float[Array, "m n"]],
    jacobians: Jacobians,
) -> Callable[[Float[Array, " n"]], Float[Array, "m n"]]:
    """The Jacobian of a function: `autodiff` through the function, or `analytic`, the hand-derived one beside it.

    Args:
      function: of one vector.
      derivative: its Jacobian, derived by hand.
      jacobians: which of the two.

    Returns:
      The Jacobian, as a function of the vector.

    Raises:
      ValueError: if `jacobians` is neither.
    """
    if jacobians == "autodiff":
        return jax.jacfwd(function)
    if jacobians == "analytic":
        return derivative
    raise ValueError(f"jacobians must be 'autodiff' or 'analytic', not {jacobians!r}")


def propagate(jac: Float[Array, "*s m n"], cov: Float[Array, "*#s n n"]) -> Float[Array, "*s m m"]:
    """Covariance J C J^T of y = f(x) to first order, from J = `jac` = dy/dx and C = `cov`, that of x."""
    cov = jnp.broadcast_to(cov, (*jac.shape[:-2], *cov.shape[-2:]))
    return symmetric(product(product(jac, cov), jnp.swapaxes(jac, -1, -2)))


def product(a: Float[Array, "*#s l m"], b: Float[Array, "*#s m n"]) -> Float[Array, "*s l n"]:
    """Matrix product of many small matrices.

    Written as a sum, which XLA fuses with what stands around it; its batched matrix product is a kernel of its own.

    Args:
      a: `[*s, l, m]`, or one for all.
      b: `[*s, m, n]`, or one for all.

    Returns:
      a b. Shape `[*s, l, n]`.
    """
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], -2)


def apply(matrix: Float[Array, "*#s m n"], vector: Float[Array, "*#s n"]) -> Float[Array, "*s m"]:
    """`matrix` times `vector` for many small matrices."""
    return jnp.sum(matrix * vector[..., None, :], -1)


def symmetric(matrix: Float[Array, "*s n n"]) -> Float[Array, "*s n n"]:
    """The symmetric part of `matrix`: rounding makes J C J^T a little asymmetric, and it would grow over fusions."""
    return (matrix + jnp.swapaxes(matrix, -1, -2)) / 2


def inverse(matrix: Float[Array, "*s n n"]) -> Float[Array, "*s n n"]:
    """Inverse of symmetric positive definite matrices of order 2 or 3, in closed form.

    A library solver costs a call per matrix, which under `vmap` over pairs of lines is most of the time. A matrix that
    is not positive definite (a free slot) gives finite nonsense instead of NaN.

    Args:
      matrix: symmetric, of which the upper triangle is read. Shape `[*s, n, n]`, n of 2 or 3.

    Returns:
      The inverse. Shape `[*s, n, n]`.
    """
    if matrix.shape[-1] == 2:
        a, b, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
        det = a * d - b * b
        scale = 1 / jnp.where(det > 0, det, 1)
        return _from_rows([[d * scale, -b * scale], [-b * scale, a * scale]])
    a, b, c = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2]
    d, e, f = matrix[..., 1, 1], matrix[..., 1, 2], matrix[..., 2, 2]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    c11, c12, c22 = a * f - c * c, b * c - a * e, a * d - b * b
    det = a * c00 + b * c01 + c * c02
    scale = 1 / jnp.where(det > 0, det, 1)
    rows = [[c00, c01, c02], [c01, c11, c12], [c02, c12, c22]]
    return _from_rows(rows) * scale[..., None, None]


def square_root(matrix: Float[Array, "*s n n"]) -> Float[Array, "*s n n"]:
    """The lower triangular L of A = L L^T for positive semidefinite matrices of a small order (Cholesky).

    A direction without variance gives a column of zeros; its gradient is zero too.

    Args:
      matrix: symmetric, of which the lower triangle is read. Shape `[*s, n, n]`.

    Returns:
      L. Shape `[*s, n, n]`.
    """
    n = matrix.shape[-1]
    lower = [[jnp.zeros_like(matrix[..., 0, 0])] * n for _ in range(n)]
    for j in range(n):
        left = matrix[..., j, j] - sum(lower[j][k] ** 2 for k in range(j))
        lower[j][j] = safe_sqrt(left)
        scale = jnp.where(left > 0, 1 / jnp.where(left > 0, lower[j][j], 1), 0)
        for i in range(j + 1, n):
            lower[i][j] = (matrix[..., i, j] - sum(lower[i][k] * lower[j][k] for k in range(j))) * scale
    return _from_rows(lower)


def safe_sqrt(x: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """The square root of `x`; of what is not positive it is zero, with a gradient of zero."""
    positive = x > 0
    # Twice, so that the gradient of the branch not taken is finite.
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def quadratic(vector: Float[Array, "*#s n"], matrix: Float[Array, "*#s n n"]) -> Float[Array, "*s"]:
    """x^T A x, of x = `vector` and A = `matrix`."""
    return jnp.sum(vector * apply(matrix, vector), -1)


def _from_rows(rows: list[list[Array]]) -> Array:
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)
