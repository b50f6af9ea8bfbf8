"""Batches: the same numbers in chunks, on eight devices, and on two hosts."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax.lab.batch import mesh_of_devices, run_batch, run_chunks

WORKER = Path(__file__).with_name("batch_worker.py")


def work(*args: str) -> subprocess.Popen:
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(WORKER.parents[2]), "JAX_ENABLE_X64": "0"}
    return subprocess.Popen(
        [sys.executable, str(WORKER), *args],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(*processes: subprocess.Popen) -> None:
    said = [process.communicate(timeout=240)[0] for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), "\n".join(said)


@pytest.fixture(scope="module")
def on_one_device(tmp_path_factory) -> dict[str, np.ndarray]:
    output = tmp_path_factory.mktemp("batch") / "one.npz"
    finish(work(str(output), "1"))
    return dict(np.load(output))


def test_eight_devices_give_the_same_numbers(on_one_device, tmp_path):
    finish(work(str(tmp_path / "eight.npz"), "8"))
    for name, value in np.load(tmp_path / "eight.npz").items():
        np.testing.assert_array_equal(value, on_one_device[name])
    assert on_one_device["found"].shape == (50, 32)
    assert np.unique(on_one_device["nees"]).size == 50  # each run has its own noise


@pytest.fixture
def address() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


def test_two_hosts_give_the_same_numbers(on_one_device, address, tmp_path):
    output = str(tmp_path / "two.npz")
    finish(*(work(output, "2", address, "2", str(number)) for number in range(2)))
    for name, value in np.load(output).items():
        np.testing.assert_array_equal(value, on_one_device[name])


LOST = """
import os, sys
import jax, jax.numpy as jnp
jax.config.update("jax_cpu_collectives_implementation", "gloo")
jax.distributed.initialize(sys.argv[1], 2, int(sys.argv[2]))
from linemap_jax.lab.batch import LostProcess, mesh_of_devices, run_chunks
try:
    for first, squares in run_chunks(jnp.square, jnp.arange(100.0), mesh=mesh_of_devices(), batch=5):
        if sys.argv[2] == "1" and first == 20:
            os._exit(1)
except LostProcess as error:
    print(f"{first}: {error}", flush=True)
    os._exit(0)
"""


def test_a_host_that_is_lost_is_told_of(address):
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(WORKER.parents[2])}
    stays, goes = [
        subprocess.Popen([sys.executable, "-c", LOST, address, i], env=environment, stdout=subprocess.PIPE, text=True)
        for i in "01"
    ]
    said, _ = stays.communicate(timeout=120)
    goes.communicate(timeout=120)
    assert (stays.returncode, goes.returncode) == (0, 1)
    assert "20: another process of the run has ended or failed (" in said


def square(run: tuple[jax.Array, jax.Array]) -> dict[str, jax.Array]:
    key, x = run
    return {"square": x * x, "noise": jax.random.normal(key, (3,))}


RUNS = jax.random.split(jax.random.key(0), 23), jnp.arange(23.0)


def test_chunks_are_those_of_one_batch_and_one_may_go_on_later():
    whole = run_batch(square, RUNS, batch=32)
    np.testing.assert_array_equal(whole["square"], np.arange(23.0) ** 2)
    np.testing.assert_array_equal(whole["noise"], jax.vmap(lambda key: jax.random.normal(key, (3,)))(RUNS[0]))
    chunks = list(run_chunks(square, RUNS, batch=2, batches=2))
    assert [begin for begin, _ in chunks] == [0, 4, 8, 12, 16, 20]
    assert [chunk["square"].size for _, chunk in chunks] == [4, 4, 4, 4, 4, 3]
    np.testing.assert_array_equal(np.concatenate([chunk["noise"] for _, chunk in chunks]), whole["noise"])
    (later, rest), *_ = run_chunks(square, RUNS, batch=2, batches=2, start=20)
    assert later == 20
    np.testing.assert_array_equal(rest["square"], whole["square"][20:])


def test_one_program_serves_all_chunks():
    traces = []

    def counted(x: jax.Array) -> jax.Array:
        traces.append(x)
        return x + 1

    np.testing.assert_array_equal(run_batch(counted, jnp.arange(40.0), batch=3), np.arange(1, 41.0))
    assert len(traces) == 1


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: mesh_of_devices(10_000), "a mesh of 10000 devices was asked for, and there are"),
        (lambda: next(run_chunks(square, (RUNS[0], RUNS[1][:5]))), r"the same size, not \[5, 23\]"),
        (lambda: next(run_chunks(square, (RUNS[0][:0], RUNS[1][:0]))), r"there is no run"),
        (lambda: next(run_chunks(square, RUNS, batch=4, start=3)), "start must be a multiple of the chunk of 4 runs"),
    ],
)
def test_what_cannot_be_is_refused(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call()
