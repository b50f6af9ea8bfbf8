"""Padded slots: finding, taking and putting what stands in them.

jax's `cumsum`, `argmin` and `nonzero` are many kernels each, or slow ones, on a CPU (40 to 80 us for 361 numbers where
1 to 5 do). The forms below are one or two kernels each, in time that is linear in the number of slots.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.frames import unit
from linemap_jax.core.state import DirectedLines, LineMap, Lines, SlotsT, empty_circles, empty_lines


def first_true(which: Bool[Array, " K"]) -> Int[Array, ""]:
    """Index of the first true one of `which`; `K` if there is none."""
    k = which.shape[0]
    return jnp.min(jnp.where(which, jnp.arange(k, dtype=jnp.int32), k))


def first_of_group(together: Bool[Array, "L L"]) -> Bool[Array, " L"]:
    """Which items are the first of all that go `together` with them; false for an item whose row is empty."""
    return jax.vmap(first_true)(together) == jnp.arange(together.shape[0])


def all_true(which: Bool[Array, " N"], size: int) -> Int[Array, " M"]:
    """Indices of the first `size` true ones of `which`, in order; `N` where there are no more."""
    n = which.shape[0]
    place = jnp.where(which, rank_of_true(which), size)
    return jnp.full(size, n, jnp.int32).at[place].set(jnp.arange(n, dtype=jnp.int32), mode="drop")


def rank_of_true(which: Bool[Array, " N"]) -> Int[Array, " N"]:
    """How many of `which` are true before each."""

    def step(count: Array, one: Array) -> tuple[Array, Array]:
        return count + one, count

    return jax.lax.scan(step, jnp.zeros((), jnp.int32), which.astype(jnp.int32))[1]


def latest_true(which: Bool[Array, " N"]) -> Int[Array, " N"]:
    """Index of the last true one of `which` up to each; -1 where there is none."""

    def step(latest: Array, x: tuple[Array, Array]) -> tuple[Array, Array]:
        index, one = x
        latest = jnp.where(one, index, latest)
        return latest, latest

    index = jnp.arange(which.shape[0], dtype=jnp.int32)
    return jax.lax.scan(step, jnp.full((), -1, jnp.int32), (index, which))[1]


def earliest_true(which: Bool[Array, " N"]) -> Int[Array, " N"]:
    """Index of the first true one of `which` from each on; `N` where there is none."""
    return which.shape[0] - 1 - latest_true(which[::-1])[::-1]


def least(score: Float[Array, "L K"], axis: int = 1) -> tuple[Int[Array, " M"], Float[Array, " M"]]:
    """Where in each row of `score` the least number stands, the first of equal ones, and that number.

    With `axis` 0 in each column: faster than in each row of the transposed, since cells that lie side by side are then
    taken at once.
    """
    value = jnp.min(score, axis, keepdims=True)
    index = jax.lax.broadcasted_iota(jnp.int32, score.shape, axis)
    return jnp.min(jnp.where(score == value, index, score.shape[axis] - 1), axis), jnp.squeeze(value, axis)


def free_slots(wanted: Bool[Array, " M"], taken: Bool[Array, " K"]) -> tuple[Int[Array, " M"], Bool[Array, ""]]:
    """A slot not `taken` for each that is `wanted`, lowest first, -1 where there is none; and whether that happened."""
    k = taken.shape[0]
    slot = all_true(~taken, wanted.shape[0])[rank_of_true(wanted)]
    fits = wanted & (slot < k)
    return jnp.where(fits, slot, -1).astype(jnp.int32), jnp.any(wanted & ~fits)


TreeT = TypeVar("TreeT")


def computed_once(function: Callable[[TreeT], Any], rows: TreeT) -> Any:
    """A function of each row, or of all rows at once, computed before anybody reads it.

    XLA computes a number anew in each kernel that reads it, and in each cell of a kernel that holds all against all: of
    512 lines and 360 beams, 180 000 cosines instead of 872. It looks through `optimization_barrier`, but not into a
    loop. This one has two steps, since a loop of one would be none.

    Args:
      function: of one row, or of any number of them.
      rows: a pytree of arrays, stacked.

    Returns:
      What the function gives for all rows.
    """
    count = jax.tree.leaves(rows)[0].shape[0]
    half = -(-count // 2)

    def step(i: Array, done: Any) -> Any:
        begin = jnp.minimum(i * half, count - half)
        part = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, begin, half), rows)
        put = partial(jax.lax.dynamic_update_slice_in_dim, start_index=begin, axis=0)
        return jax.tree.map(put, done, function(part))

    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(function, rows))
    return jax.lax.fori_loop(0, 2, step, nothing)


def directed(lines: Lines) -> DirectedLines:
    """The `lines` with their normals computed, once."""
    fields = {field.name: getattr(lines, field.name) for field in dataclasses.fields(Lines)}
    return DirectedLines(**fields, unit_normal=computed_once(unit, lines.angle))


def neutral_where_free(slots: SlotsT) -> SlotsT:
    """The same `slots` of lines or circles with neutral values in the free ones: nothing non-finite lurks there."""
    return choose(slots.valid, slots, _empty_like(slots, slots.valid.shape[0]))


def detected_often(line_map: LineMap, times: int) -> LineMap:
    """What of a map was detected often.

    Args:
      line_map: the map.
      times: in so many scans, at least.

    Returns:
      The map without the rest, in the same slots.
    """
    lines, circles = line_map.lines, line_map.circles
    lines = dataclasses.replace(lines, valid=lines.valid & (lines.times_detected >= times))
    circles = dataclasses.replace(circles, valid=circles.valid & (circles.times_detected >= times))
    return LineMap(lines=neutral_where_free(lines), circles=neutral_where_free(circles))


LARGEST = 1e9
"""Of the numbers of a primitive or pose, in m, rad and their squares: products of four such are finite in float32."""


def bounded(slots: SlotsT) -> Bool[Array, " K"]:
    """Which of the lines or circles in `slots` hold finite numbers alone, and none beyond `LARGEST`."""
    return jnp.all(jnp.abs(_packed(slots)[0]) <= LARGEST, 0)


def choose(first: Bool[Array, " K"], a: TreeT, b: TreeT) -> TreeT:
    """The items of `a` where `first` holds, of `b` elsewhere."""
    return jax.tree.map(lambda x, y: jnp.where(first.reshape(first.shape + (1,) * (x.ndim - 1)), x, y), a, b)


def take(slots: SlotsT, index: Int[Array, "*s"]) -> SlotsT:
    """The lines or circles of `slots` at `index`; an index of -1 gives something finite that means nothing."""
    columns, back = _packed(slots)
    return back(columns[:, index], slots, lambda x: x[index])


def put(slots: SlotsT, index: Int[Array, " M"], rows: SlotsT) -> SlotsT:
    """`slots` with lines or circles, `rows`, written at `index`; -1 writes nothing. No index but -1 may occur twice."""
    into = jnp.where(index < 0, slots.valid.shape[0], index)
    columns, back = _packed(slots)
    columns = columns.at[:, into].set(_packed(rows)[0], mode="drop")
    discrete = {name: getattr(slots, name).at[into].set(getattr(rows, name), mode="drop") for name in _discrete(slots)}
    return dataclasses.replace(back(columns, slots, lambda x: x), **discrete)


def _discrete(slots: SlotsT) -> list[str]:
    """The fields that are not floats."""
    discrete = ("times_detected", "times_contradicted", "fitted", "valid")
    return [field.name for field in dataclasses.fields(slots) if field.name in discrete]


def _packed(slots: SlotsT) -> tuple[Float[Array, "P K"], Callable[..., SlotsT]]:
    """All floats of the slots in one array, and the way back.

    One gather or scatter then serves all fields: what costs time, and most of all compile time, is the number of
    kernels. The slots are on the minor axis, so that each number of them is contiguous for whoever reads it next.
    """
    k = slots.valid.shape[0]
    discrete = _discrete(slots)
    names = [field.name for field in dataclasses.fields(slots) if field.name not in discrete]
    shapes = [getattr(slots, name).shape[1:] for name in names]
    ends = list(itertools.accumulate(math.prod(shape) for shape in shapes))
    columns = jnp.concatenate([getattr(slots, name).reshape(k, -1).T for name in names])

    def back(columns: Array, others: SlotsT, select: Callable[[Array], Array]) -> SlotsT:
        parts = jnp.split(columns, ends[:-1])
        floats = {
            name: jnp.moveaxis(part, 0, -1).reshape(*columns.shape[1:], *shape)
            for name, part, shape in zip(names, parts, shapes, strict=True)
        }
        return dataclasses.replace(others, **floats, **{name: select(getattr(others, name)) for name in discrete})

    return columns, back


def resize(slots: SlotsT, capacity: int) -> SlotsT:
    """The same lines or circles with room for `capacity` of them; added slots are free.

    Args:
      slots: lines or circles.
      capacity: slots that there shall be.

    Returns:
      The larger ones.

    Raises:
      ValueError: if `capacity` is smaller than the present one: primitives would be lost.
    """
    have = slots.valid.shape[0]
    if capacity < have:
        raise ValueError(f"cannot shrink {have} slots to {capacity}")
    more = _empty_like(slots, capacity - have)
    # On the host: jax would compile a program for each field.
    return jax.tree.map(lambda a, b: jnp.asarray(np.concatenate([a, b])), slots, more)


def _empty_like(slots: SlotsT, capacity: int) -> SlotsT:
    empty: Any = empty_lines if isinstance(slots, Lines) else empty_circles
    return empty(capacity, slots.cov_independent.dtype)
