"""Decisions that a batch makes together."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int


@jax.custom_batching.custom_vmap
def largest_of_batch(choice: Int[Array, ""]) -> Int[Array, ""]:
    """The number itself; under `vmap`, the largest of the batch, for all of it.

    `vmap` turns a `lax.switch` into all of its branches, since each item may go its own way. Where a later branch does
    all that an earlier one does, and more, the items may go one way together, and the others are left out.

    Args:
      choice: which branch an item of the batch needs, the later ones doing more.

    Returns:
      The same number, or that of the whole batch.
    """
    return choice


@largest_of_batch.def_vmap
def _(size: int, batched: list[bool], choice: Int[Array, " B"]) -> tuple[Int[Array, ""], bool]:
    del size, batched
    return largest_of_batch(jnp.max(choice)), False
