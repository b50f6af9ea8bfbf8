"""Many simulated runs: side by side on one device, spread over all devices of a mesh, and over hosts.

An experiment is a function of what one run differs by (a key, a world, thresholds, anything that is a pytree of
arrays). The runs come stacked and go through the devices in chunks of one size: one compilation serves them all, memory
does not grow with their number, and what a chunk gave can be put away before the next one begins. Every run gets its
own key, so that neither the chunks nor the number of devices change what comes out.

Over hosts, `jax.distributed` does the work: each process calls `jax.distributed.initialize` and then the same functions
with the same arguments, and gets all results.
"""

from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

Experiment = Callable[..., Any]
"""From what one run differs by, and what all have in common, to what it gives; all are pytrees of arrays."""


class LostProcess(Exception):
    """Another process of the run has ended or failed: one sentence, with what jax says of it."""


AXIS = "runs"
"""The axis of a mesh over which runs are spread."""
BATCH = 128
"""Runs that one device works on side by side: as many as its cache holds."""


def mesh_of_devices(count: int | None = None) -> Mesh:
    """The devices in a row.

    Args:
      count: how many of them; all, of all hosts, unless given.

    Returns:
      A mesh of one axis.

    Raises:
      ValueError: if there are not so many.
    """
    devices = jax.devices()
    if count is not None and not 1 <= count <= len(devices):
        raise ValueError(f"a mesh of {count} devices was asked for, and there are {len(devices)}")
    return Mesh(np.asarray(devices[:count]), (AXIS,))


def run_chunks(
    experiment: Experiment,
    runs: Any,
    *common: Any,
    mesh: Mesh | None = None,
    batch: int = BATCH,
    batches: int = 1,
    start: int = 0,
) -> Iterator[tuple[int, Any]]:
    """The results of many runs, chunk by chunk.

    Args:
      experiment: what is done with each run. Compiled once for each function object: define it once, or use
        `functools.partial` with the same arguments.
      runs: what the runs differ by; stacked, each leaf with a leading axis `[R]`.
      *common: what they have in common; further arguments of the experiment.
      mesh: the devices; one of the first device alone unless given.
      batch: runs that one device works on side by side.
      batches: how many such batches a device has in each chunk.
      start: the first run to do, to go on where an earlier call stopped; a multiple of the size of a chunk.

    Yields:
      The index of the first run of the chunk, and the results of its runs on the host, stacked `[C]`. All chunks hold
      `batch * batches` runs for each device, but the last one, which may hold fewer.

    Raises:
      ValueError: if there is no run, if leaves differ in their number, or if `start` lies within a chunk.
      LostProcess: if another process has ended or failed. Where it was the first one, jax itself ends this one.
    """
    sizes = {np.shape(leaf)[0] if np.ndim(leaf) else 0 for leaf in jax.tree.leaves(runs)}
    if sizes == {0}:
        raise ValueError("there is no run: the runs need a leading axis, of at least one")
    if len(sizes) != 1:
        raise ValueError(f"all leaves of the runs need a leading axis of the same size, not {sorted(sizes)}")
    count = sizes.pop()
    mesh = mesh or mesh_of_devices(1)
    size = mesh.size * batch * batches
    if start % size:
        raise ValueError(f"start must be a multiple of the chunk of {size} runs, not {start}")
    sharding = NamedSharding(mesh, PartitionSpec(AXIS))
    run = many = _many(experiment, mesh, batch)
    for begin in range(start, count, size):
        # The last chunk is filled up with its last run, so that it fits the compiled program.
        index = np.minimum(np.arange(begin, begin + size), count - 1)
        chunk = jax.tree.map(partial(_spread, index=index, sharding=sharding), runs)
        if jax.process_count() > 1 and begin == start:
            # To connect, gloo gives the processes half a minute; some may compile for longer than others.
            run = many.lower((chunk, common)).compile()
            multihost_utils.sync_global_devices("compiled")
        results = _here(run((chunk, common)))
        yield begin, jax.tree.map(partial(_first, count=count - begin), results)


def told_by_the_first(number: int) -> int:
    """`number` as the first process has it, in all processes."""
    return int(multihost_utils.broadcast_one_to_all(np.int32(number)))


def _first(leaf: Any, count: int) -> np.ndarray:
    return np.asarray(leaf)[:count]


def _here(results: Any) -> Any:
    """The results, all of them in this process; over several hosts each computes its share."""
    if all(x.is_fully_addressable for x in jax.tree.leaves(results)):
        return results
    try:
        return multihost_utils.process_allgather(results, tiled=True)
    except (jax.errors.JaxRuntimeError, ValueError) as error:
        raise LostProcess(f"another process of the run has ended or failed ({str(error).splitlines()[0]})") from error


def run_batch(experiment: Experiment, runs: Any, *common: Any, **options: Any) -> Any:
    """The results of many runs at once, stacked `[R]` on the host.

    Args:
      experiment: what is done with each run.
      runs: what the runs differ by; stacked `[R]`.
      *common: what they have in common.
      **options: of `run_chunks`.

    Returns:
      The results, as NumPy arrays.
    """
    chunks = [chunk for _, chunk in run_chunks(experiment, runs, *common, **options)]
    return jax.tree.map(lambda *x: np.concatenate(x), *chunks)


@lru_cache(maxsize=64)
def _many(experiment: Experiment, mesh: Mesh, batch: int) -> jax.stages.Wrapped:
    """The compiled program for one chunk. Kept, since a new closure would be compiled anew."""

    def on_one_device(given: tuple[Any, tuple[Any, ...]]) -> Any:
        runs, common = given
        return jax.lax.map(lambda run: experiment(run, *common), runs, batch_size=batch)

    split, whole = PartitionSpec(AXIS), PartitionSpec()
    specs = ((split, whole),)
    return jax.jit(jax.shard_map(on_one_device, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False))


def _spread(leaf: Array, *, index: np.ndarray, sharding: NamedSharding) -> Array:
    """Some of the runs, each on its device; every process holds all of them, and takes its own."""
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        data = _spread(jax.random.key_data(leaf), index=index, sharding=sharding)
        return jax.random.wrap_key_data(data, impl=jax.random.key_impl(leaf))
    rows = np.asarray(leaf)[index]
    return jax.make_array_from_callback(rows.shape, sharding, lambda where: rows[where])
