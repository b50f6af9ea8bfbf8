"""Runs of consecutive points: which points belong to which, and sums over them."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from linemap_jax.core.slots import all_true, rank_of_true
from linemap_jax.core.state import pytree


@pytree
class Runs:
    """Runs of consecutive points, one after the other in `K` slots."""

    first: Int[Array, " K"]
    """The first point of each run, 0 for a free slot."""
    last: Int[Array, " K"]
    """The last point of each run, 0 for a free slot."""
    valid: Bool[Array, " K"]
    """Which slots are in use."""
    of_point: Int[Array, " N"]
    """Slot of each point's run, -1 for none."""

    def sum(self, per_point: Float[Array, "N *s"]) -> Float[Array, "K *s"]:
        """Sum of `per_point` over the points of each run, one after the other; zero for free slots."""
        n, k = self.of_point.shape[0], self.valid.shape[0]
        place = jnp.where(self.of_point < 0, k, self.of_point)
        rows = per_point.reshape(n, -1)
        total = jnp.zeros((k, rows.shape[1]), rows.dtype).at[place].add(rows, mode="drop")
        return jnp.where(self.valid[:, None], total, 0).reshape(k, *per_point.shape[1:])

    def only(self, which: Bool[Array, " N"], size: int) -> tuple[Int[Array, " M"], "Runs"]:
        """Some of the points, moved together in `M = size` places, and the runs that they belong to.

        Whole runs must be chosen, and no more than `size` points.

        Args:
          which: the points of the chosen runs. Shape `[N]`.
          size: places for them.

        Returns:
          The index of each point, of any where there is none; the runs, in the same slots, those not chosen free.
        """
        n = which.shape[0]
        index = all_true(which, size)
        rank = rank_of_true(which)
        place = jnp.minimum(index, n - 1)
        chosen = self.valid & which[self.first]
        some = Runs(
            first=jnp.where(chosen, rank[self.first], 0),
            last=jnp.where(chosen, rank[self.last], 0),
            valid=chosen,
            of_point=jnp.where(index < n, self.of_point[place], -1),
        )
        return place, some

    def spread(self, per_run: Shaped[Array, "K *s"]) -> Shaped[Array, "N *s"]:
        """The value of each point's run, out of `per_run`; something finite for points of no run."""
        return per_run[self.of_point]


def select_runs(count: Float[Array, " N"], chosen: Bool[Array, " N"], capacity: int) -> tuple[Runs, Bool[Array, ""]]:
    """Give slots to some runs, in order.

    Args:
      count: at the last point of a run, of how many points it consists.
      chosen: at the last point of a run, whether it gets a slot; false at all other points.
      capacity: number of slots `K`.

    Returns:
      The runs, and whether one found no slot.
    """
    n = chosen.shape[0]
    last = all_true(chosen, capacity)
    valid = last < n
    last = jnp.where(valid, last, 0)
    first = jnp.where(valid, last - count[last].astype(jnp.int32) + 1, 0)
    # The run that a point may lie in is the next one to end.
    slot = rank_of_true(chosen)
    inside = (slot < jnp.sum(valid)) & (first[slot] <= jnp.arange(n))
    of_point = jnp.where(inside, slot, -1)
    return Runs(first=first, last=last, valid=valid, of_point=of_point), jnp.sum(chosen) > capacity
