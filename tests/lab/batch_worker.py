"""What tests/lab/test_batch.py runs in processes of its own: a batch on several devices, or on several hosts.

Usage: python batch_worker.py OUTPUT.npz DEVICES [ADDRESS PROCESSES ID]
"""

import os
import sys

output, devices, *host = sys.argv[1:]
# Without those of the tests: compiled with no optimisation, programs for one device and for several round differently.
os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={devices} --xla_cpu_use_fusion_emitters=false"

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

if host:
    address, processes, number = host
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(address, int(processes), int(number))

from linemap_jax.lab import batch, consistency  # noqa: E402

RUNS, BATCH = 50, 4
NAME = "room turned by 20 degrees, from aside; 0.01 m, 0.1 degree; pose 5 cm, 1 degree"


def experiment(run: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    """The NEES of what the pipeline finds, for a noise of the range that differs from run to run."""
    key, sigma = run
    cell = consistency.cells()[NAME]
    scanner = cell.scanner.replace(range_sigma=sigma)
    longest, every = consistency.pipeline(key, cell.world, cell.path[0], scanner, cell.cov_pose)
    return longest.nees, every.counts


def main() -> None:
    """Run the batch; the first process writes the results."""
    runs = jax.random.split(jax.random.key(5), RUNS), jnp.linspace(0.01, 0.03, RUNS)
    mesh = batch.mesh_of_devices()
    assert mesh.size == int(devices) * (int(host[1]) if host else 1)
    nees, found = batch.run_batch(experiment, runs, mesh=mesh, batch=BATCH)
    if not host or host[2] == "0":
        np.savez(output, nees=nees, found=found)


main()
