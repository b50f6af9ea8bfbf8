"""Does this release of jax compute right? Some on the CPU do not, and say nothing.

jax 0.10.2: a jitted vmap of (shared small matrix) @ vector followed by a reduction is wrong past a certain number of
rows (16385 in float64, 32769 in float32); that is why pyproject.toml pins jax. Each form below stands in the package,
or is a near relative of one that does.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import AS_USERS

from linemap_jax.core.propagation import apply, product, propagate, quadratic

ROWS = 40_000  # past the point where releases known to be wrong begin to be

# Of one row and what the rows share; the operands, and the same for all rows at once in NumPy's notation. `v` and `w`
# are vectors, `j` a Jacobian, `m` and `c` the shared matrices, `c` symmetric.
FORMS: dict[str, tuple[Callable[..., jax.Array], str, str]] = {
    "sum of squares": (lambda v, w, j, m, c: jnp.sum((m @ v) ** 2), "mvmv", "ab,nb,ad,nd->n"),
    "sum": (lambda v, w, j, m, c: jnp.sum(m @ v), "mv", "ab,nb->n"),
    "scalar product": (lambda v, w, j, m, c: jnp.dot(w, m @ v), "wmv", "na,ab,nb->n"),
    "sum of a product": (lambda v, w, j, m, c: jnp.sum(w * (m @ v)), "wmv", "na,ab,nb->n"),
    "vector first": (lambda v, w, j, m, c: jnp.sum((v @ m) * w), "vmw", "na,ab,nb->n"),
    "quadratic form": (lambda v, w, j, m, c: v @ c @ v, "vcv", "na,ab,nb->n"),
    "J C J^T": (lambda v, w, j, m, c: jnp.sum(j @ c @ j.T), "jcj", "nia,ab,nkb->n"),
    "quadratic": (lambda v, w, j, m, c: quadratic(v, c), "vcv", "na,ab,nb->n"),
    "apply": (lambda v, w, j, m, c: jnp.sum(apply(m, v)), "mv", "ab,nb->n"),
    "product": (lambda v, w, j, m, c: jnp.sum(product(j, m)), "jm", "nia,ab->n"),
    "propagate": (lambda v, w, j, m, c: jnp.sum(propagate(j, c)), "jcj", "nia,ab,nkb->n"),
}


@pytest.mark.parametrize("size", [2, 3])
@pytest.mark.parametrize("emitters", [True, False])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("form", FORMS)
def test_jit_agrees_with_numpy(form: str, dtype: str, emitters: bool, size: int):
    rng = np.random.default_rng(7)
    # Positive numbers, so that no sum is small by cancellation and the tolerance can be tight.
    given = {
        "v": rng.uniform(1, 2, (ROWS, size)),
        "w": rng.uniform(1, 2, (ROWS, size)),
        "j": rng.uniform(1, 2, (ROWS, 2, size)),
        "m": rng.uniform(1, 2, (size, size)),
        "c": (lambda a: a + a.T)(rng.uniform(1, 2, (size, size))),
    }
    given = {name: x.astype(dtype) for name, x in given.items()}
    function, operands, subscripts = FORMS[form]
    want = np.einsum(subscripts, *(given[name].astype(np.float64) for name in operands), optimize=True)

    options = AS_USERS | {"xla_cpu_use_fusion_emitters": emitters}  # the package uses both
    compiled = jax.jit(jax.vmap(function, (0, 0, 0, None, None)), compiler_options=options)
    got = compiled(*(given[name] for name in "vwjmc"))

    assert got.dtype == dtype
    np.testing.assert_allclose(got, want, rtol=20 * np.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_jit_agrees_with_numpy_reduced_over_all_rows(dtype: str):
    # Rows that hold whole numbers, each sum exact in either precision.
    v = (np.arange(ROWS * 3).reshape(ROWS, 3) % 7).astype(dtype)
    m = np.array([[1, 2, 0], [0, 1, 1], [2, 0, 1]], dtype)

    @partial(jax.jit, compiler_options=AS_USERS)
    def total(m, v):
        return jnp.sum(jax.vmap(lambda row: jnp.sum(m @ row))(v))

    assert float(total(m, v)) == np.sum(v.astype(np.float64) @ m.T)
