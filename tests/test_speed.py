"""What the speed hangs on: loops over the beams that are one kernel each, and what a scan costs beside such a loop.

How long things take is measured by scripts/bench.py.
"""

import re
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import AS_USERS

from linemap_jax import Pose, Scan, SensorNoise, Thresholds, extract, preset
from linemap_jax.build import COMPILER_OPTIONS
from linemap_jax.core import circles, slots
from linemap_jax.core.extract import as_dtype
from linemap_jax.core.runs import Runs
from linemap_jax.core.segmentation import incremental
from linemap_jax.core.sensor import points_from_scan
from linemap_jax.core.settings import Mount, Rules

BEAMS = 361
"""Of the paper's instrument."""


def scan_of(dtype: Any, *stack: int) -> Scan:
    """A room, seen from its middle."""
    bearings = np.linspace(-np.pi / 2, np.pi / 2, BEAMS)
    ranges = 3 / np.maximum(np.abs(np.cos(bearings)), np.abs(np.sin(bearings)))
    return jax.tree.map(
        lambda x: jnp.broadcast_to(x, (*stack, *jnp.shape(x))),
        Scan(
            ranges=jnp.asarray(ranges, dtype),
            bearings=jnp.asarray(bearings, dtype),
            valid=jnp.ones(BEAMS, bool),
            spacing=jnp.asarray(np.pi / (BEAMS - 1), dtype),
            first=jnp.zeros((), jnp.int32),
        ),
    )


def pose_of(dtype: Any) -> Pose:
    return Pose(mean=jnp.zeros(3, dtype), cov=jnp.zeros((3, 3), dtype))


def loops(text: str) -> tuple[int, int]:
    """How many loops of a compiled program are one kernel, and how many are run by the host, kernel by kernel."""
    inside = set(re.findall(r" call\(.*to_apply=%([\w.\-]+).*xla_cpu_small_call", text))
    kernels = others = 0
    computation = ""
    for line in text.splitlines():
        if begin := re.match(r"(?:ENTRY )?%([\w.\-]+) \(.*\{$", line):
            computation = begin[1]
        if " while(" in line:
            kernels, others = kernels + (computation in inside), others + (computation not in inside)
    return kernels, others


def hot_loops(dtype: Any) -> dict[str, tuple[Callable[..., Any], Any]]:
    """The loops over the beams, and what they are given."""
    points = points_from_scan(scan_of(dtype), pose_of(dtype), as_dtype(Mount(), dtype), jacobians="analytic")
    thresholds, noise = as_dtype((Thresholds(), SensorNoise()), dtype)
    which = jnp.ones(BEAMS, bool)
    index = jnp.zeros(32, jnp.int32)
    runs = Runs(first=index, last=index, valid=index == 0, of_point=jnp.zeros(BEAMS, jnp.int32))
    return {
        "segmentation": (lambda points: incremental.segment(points, thresholds, noise, Rules()), points),
        "clusters": (lambda points: circles.cluster(points, points.valid, thresholds), points),
        "sums over runs": (runs.sum, jnp.zeros((BEAMS, 10), dtype)),
        "ranks": (slots.rank_of_true, which),
        "the last before each": (slots.latest_true, which),
    }


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", ["segmentation", "clusters", "ranks", "the last before each"])
def test_a_loop_over_the_beams_is_one_kernel(name: str, dtype: str) -> None:
    function, given = hot_loops(np.dtype(dtype))[name]
    text = jax.jit(function, compiler_options=AS_USERS).lower(given).compile().as_text()
    kernels, others = loops(text)
    assert kernels >= 1
    assert others == 0, "XLA runs this loop kernel by kernel, which takes thirty times as long: is its body too large?"


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_sums_over_runs_are_a_scatter_and_no_loop(dtype: str) -> None:
    function, given = hot_loops(np.dtype(dtype))["sums over runs"]
    text = jax.jit(function, compiler_options=AS_USERS).lower(given).compile().as_text()
    assert " scatter(" in text
    assert loops(text) == (0, 0)


def test_a_map_step_is_compiled_without_reductions_in_pieces() -> None:
    """Which XLA makes of the least of many slots unless told not to; each would be kernels of its own."""
    scores = jnp.zeros((32, 512), "float32")
    texts = [
        jax.jit(slots.least, compiler_options=options).lower(scores).compile().as_text()
        for options in (AS_USERS, AS_USERS | COMPILER_OPTIONS)
    ]
    assert [" reduce-window(" in text for text in texts] == [True, False]


def test_a_loop_that_is_too_large_is_told_from_one_that_is_not() -> None:
    def function(rows: Any) -> Any:
        return jax.lax.scan(lambda total, row: (total + row, total), jnp.zeros_like(rows[0]), rows)

    def compiled(columns: int) -> str:
        given = jnp.zeros((BEAMS, columns))
        return jax.jit(function, compiler_options=AS_USERS).lower(given).compile().as_text()

    assert loops(compiled(4)) == (1, 0)
    assert loops(compiled(4096)) == (0, 1)


def test_a_scan_costs_no_more_than_some_loops_over_its_beams() -> None:
    """One loop that falls apart costs as much as everything else; then the ratio more than doubles."""
    count = 8
    scans, here = scan_of("float32", count), pose_of("float32")
    one = partial(extract, pose=here, jacobians="analytic", **preset("paper"))
    programs = {
        "extract": (lambda scans: jax.lax.map(one, scans), scans),
        "rank": (lambda which: jax.lax.map(slots.rank_of_true, which), jnp.ones((64 * count, BEAMS), bool)),
    }
    ready = {name: jax.jit(f, compiler_options=AS_USERS).lower(x).compile() for name, (f, x) in programs.items()}
    spans: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(10):
        for name, (_, given) in programs.items():
            begin = time.perf_counter()
            jax.block_until_ready(ready[name](given))
            spans[name].append(time.perf_counter() - begin)
    ratio = 64 * min(spans["extract"]) / min(spans["rank"])
    assert 20 < ratio < 300, f"an extraction takes {ratio:.0f} times as long as one loop over the beams"
