"""How long a scan takes, beside a scalar C++ extractor of section 4 in the same run.

Usage: python scripts/bench.py [--quick] [--json FILE]

Rows:

- extract: one scan, or a batch of them (`vmap` in pieces of 256), into lines and circles.
- map_step: the lines and circles of a scan (at most 20 and 9) into a map that holds 100 of each, inside `lax.scan`.
- scan_to_map: both, over a whole log, inside `lax.scan`.

Scans are the real ones of $LINEMAP_DATA/ple/scans.npz (default ../shared/data), and for scan_to_map those of the Intel
log; where these are not there, simulated ones. The C++ extractor is compiled from $LINEMAP_BASELINE (default
../shared/tools/baseline), where it and g++ are there, and timed on the same scans on one core after each row; the
ratio is the time of the row over that. On a CPU everything runs on one core, but for the rows with more devices.
With --json each row is an object: name, preset, batch, dtype, devices, capacity, us_per_scan (the median), spread (the
range of the middle half), cpu_us_per_scan (of the process), ratio_to_cpp, compile_s, cached_s (compiled code from the
cache on the disk), peak_mb (of the process so far).
"""

import argparse
import json
import os
import platform
import resource
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", len(CORES))

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jax.sharding import Mesh, NamedSharding, PartitionSpec  # noqa: E402

from linemap_jax import Capacity, Pose, Scan, empty_map, extract, preset, update  # noqa: E402
from linemap_jax.build import COMPILER_OPTIONS  # noqa: E402
from linemap_jax.core.extract import observe, with_defaults  # noqa: E402
from linemap_jax.core.mapping import integrate  # noqa: E402
from linemap_jax.core.settings import persistence_of  # noqa: E402
from linemap_jax.core.slots import resize  # noqa: E402
from linemap_jax.io.log import open_log  # noqa: E402
from linemap_jax.io.scans import chunks_of_readings  # noqa: E402
from linemap_jax.lab import generators, scanners, simulate  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("LINEMAP_DATA", ROOT / "../shared/data"))
BASELINE = Path(os.environ.get("LINEMAP_BASELINE", ROOT / "../shared/tools/baseline"))
PIECE = 256
"""Scans that are worked on side by side."""
SIGMAS = (0.05, 0.05, 0.0175)
"""Of the pose, m m rad."""
SEED = 3

Preset = Literal["default", "paper"]
Row = dict[str, Any]


def main() -> int:
    """Measure, print the table, and write the rows where that is asked for."""
    parser = argparse.ArgumentParser(description="How long a scan takes, beside a C++ extractor.")
    parser.add_argument("--quick", action="store_true", help="three rows, within a minute")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        rows = list(measure(options.quick, Cpp.compiled(Path(folder))))
    print(as_table(rows))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0


def measure(quick: bool, cpp: "Cpp | None") -> Any:
    """The rows, one after the other; each is said on stderr."""
    stills, log = still_scans(), driven_scans()
    beside = {"stills": cpp and cpp.of(stills), "log": cpp and cpp.of(log[0])}
    types = ("float32",) if quick else ("float32", "float64")
    presets: tuple[Preset, ...] = ("default",) if quick else ("default", "paper")
    for dtype in types:
        for choice in presets:
            for batch in (1, 256) if quick else (1, 64, 256, 1024, 4096):
                yield told(extraction(stills, batch, dtype, choice), beside["stills"])
        if not quick and len(CORES) > 1:
            yield told(extraction(stills, 4096, dtype, "default", devices=len(CORES)), beside["stills"])
        for capacity in (128,) if quick else (64, 128, 256, 512, 1024, 2048):
            yield told(map_step(capacity, dtype), beside["stills"])
        for choice in presets:
            yield told(scan_to_map(log, dtype, choice), beside["log"])


def extraction(scans: Scan, batch: int, dtype: str, choice: Preset, devices: int = 1) -> Row:
    """A row of `extract`."""
    some = cast(jax.tree.map(lambda x: x[np.arange(batch) % x.shape[0]], scans), dtype)
    here = pose_at(dtype)
    one = partial(extract, jacobians="analytic", **preset(choice))

    def several(scans: Scan) -> Any:
        return jax.lax.map(lambda scan: one(scan, here), scans, batch_size=min(batch, PIECE))

    if batch == 1:
        run, given = (lambda scan: one(scan, here)), jax.tree.map(lambda x: x[0], some)
    elif devices == 1:
        run, given = several, some
    else:
        mesh = Mesh(np.asarray(jax.devices()[:devices]), ("scans",))
        split = PartitionSpec("scans")
        run = jax.shard_map(several, mesh=mesh, in_specs=split, out_specs=split, check_vma=False)
        given = jax.device_put(some, NamedSharding(mesh, split))
    row = {"name": "extract", "preset": choice, "batch": batch, "dtype": dtype, "devices": devices, "capacity": None}
    return row | timed(run, given, scans=batch, cores=devices)


def map_step(capacity: int, dtype: str) -> Row:
    """A row of `map_step`: a map of a simulated drive, thinned out, and a scan of it, again and again."""
    scans, poses = simulated_drive(60, dtype)
    line_map = empty_map(Capacity(256, 256), np.dtype(dtype))
    step = jax.jit(partial(update, jacobians="analytic"))
    for t in range(60):
        line_map, _ = step(line_map, *jax.tree.map(lambda x, t=t: x[t], (scans, poses)))
    held = min(100, capacity)
    line_map = jax.tree.map(jnp.asarray, filled(line_map, held))
    line_map = type(line_map)(lines=resize(line_map.lines, capacity), circles=resize(line_map.circles, capacity))
    scan, pose = jax.tree.map(lambda x: x[30], (scans, poses))
    thresholds, noise, mount = with_defaults(None, None, None, np.dtype(dtype))
    rules = preset("default")["rules"]
    look = partial(
        observe,
        capacity=Capacity(20, 9),
        rules=rules,
        segmentation="incremental",
        covariance="exact",
        jacobians="analytic",
    )
    points, pose, found = jax.jit(look)(scan, pose, thresholds, noise, mount)
    lasting = jax.tree.map(partial(jnp.asarray, dtype=dtype), persistence_of("unknown", None))

    def several(line_map: Any, found: Any) -> Any:
        def step(line_map: Any, _: Any) -> Any:
            after, report = integrate(
                line_map, points, pose, found, thresholds, noise, lasting, pose_error="unknown", rules=rules
            )
            return after, report.status

        return jax.lax.scan(step, line_map, None, length=64)

    row = {"name": "map_step", "preset": "default", "batch": 1, "dtype": dtype, "devices": 1, "capacity": capacity}
    return row | timed(several, line_map, found, scans=64, options=COMPILER_OPTIONS)


def scan_to_map(log: tuple[Scan, Pose], dtype: str, choice: Preset) -> Row:
    """A row of `scan_to_map`."""
    scans, poses = cast(log, dtype)
    count = scans.ranges.shape[0]

    def several(line_map: Any, scans: Scan, poses: Pose) -> Any:
        def step(line_map: Any, x: Any) -> Any:
            after, report = update(line_map, *x, jacobians="analytic", **preset(choice))
            return after, report.status

        return jax.lax.scan(step, line_map, (scans, poses))

    capacity = Capacity(512, 512)
    row = {"name": "scan_to_map", "preset": choice, "batch": 1, "dtype": dtype, "devices": 1, "capacity": 512}
    given = empty_map(capacity, np.dtype(dtype)), scans, poses
    return row | timed(several, *given, scans=count, options=COMPILER_OPTIONS)


def timed(function: Callable[..., Any], *given: Any, scans: int, cores: int = 1, options: Any = None) -> Row:
    """Compile twice, the second time from the cache, and run for a second or so."""

    def compiled_in() -> tuple[Callable[..., Any], float]:
        jax.clear_caches()
        begin = time.perf_counter()
        compiled = jax.jit(function, compiler_options=options).lower(*given).compile()
        return compiled, time.perf_counter() - begin

    on_cores(len(CORES))
    (_, cold), (compiled, warm) = compiled_in(), compiled_in()
    on_cores(cores)
    spans, used = [], []
    jax.block_until_ready(compiled(*given))
    while len(spans) < 7 or (sum(spans) < 1.0 and len(spans) < 1000):
        begin, process = time.perf_counter(), time.process_time()
        jax.block_until_ready(compiled(*given))
        spans.append(time.perf_counter() - begin)
        used.append(time.process_time() - process)
    low, median, high = (1e6 * x / scans for x in statistics.quantiles(spans, n=4))
    return {
        "us_per_scan": median,
        "spread": [low, high],
        "cpu_us_per_scan": 1e6 * statistics.median(used) / scans,
        "compile_s": cold,
        "cached_s": warm,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def told(row: Row, cpp: Callable[[], float] | None) -> Row:
    """The row with its ratio to the C++ extractor, which is timed once more."""
    row["ratio_to_cpp"] = row["us_per_scan"] / cpp() if cpp else None
    print(json.dumps(row), file=sys.stderr, flush=True)
    return row


def on_cores(count: int) -> None:
    """All threads of the process on so many cores."""
    if hasattr(os, "sched_setaffinity"):
        for thread in os.listdir("/proc/self/task"):
            os.sched_setaffinity(int(thread), CORES[:count])


class Cpp:
    """The C++ extractor."""

    def __init__(self, program: Path) -> None:
        """With the compiled program."""
        self.program = program

    @staticmethod
    def compiled(folder: Path) -> "Cpp | None":
        """Compile it, if it and a compiler are there."""
        program = folder / "paper"
        flags = ["-O3", "-march=native", "-DNDEBUG", "-std=c++17"]
        try:
            subprocess.run(["g++", *flags, BASELINE / "paper.cpp", "-o", program], check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError):
            print("no C++ extractor, or no compiler: no ratios", file=sys.stderr)
            return None
        return Cpp(program)

    def of(self, scans: Scan) -> Callable[[], float]:
        """A function that times it on these scans: us a scan, the median of fifteen runs."""
        file = self.program.with_name(f"scans-{id(scans)}.bin")
        valid, ranges, bearings = (np.asarray(x) for x in (scans.valid, scans.ranges, scans.bearings))
        with file.open("wb") as out:
            out.write(struct.pack("i", len(ranges)))
            for r, b, v in zip(ranges, bearings, valid, strict=True):
                out.write(struct.pack("i", len(r)) + struct.pack("d", 1e6))
                out.write(b.astype("<f8").tobytes() + np.where(v, r, 0).astype("<f8").tobytes())

        def time_it() -> float:
            command = [self.program, file, "runs=15", "rep=20", "dl=0.05", "cov=1"]
            on_cores(1)
            said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            return float(said.split("median=")[1].split()[0])

        return time_it


def still_scans() -> Scan:
    """Real scans of many places; simulated ones where they are not there."""
    path = DATA / "ple/scans.npz"
    if not path.exists():
        return simulated_drive(130, "float64")[0]
    data = np.load(path)
    bearings, ranges, limits = (data[f"real_{name}"] for name in ("azimuth", "range", "rlim"))
    valid = (ranges >= limits[:, :1]) & (ranges <= limits[:, 1:])  # beams that pad a scan are NaN
    return Scan(
        ranges=jnp.asarray(np.where(valid, ranges, 0)),
        bearings=jnp.asarray(np.nan_to_num(bearings)),
        valid=jnp.asarray(valid),
        spacing=jnp.asarray(np.nanmedian(np.abs(np.diff(bearings, axis=1)), axis=1)),
        first=jnp.zeros(len(ranges), jnp.int32),
    )


def driven_scans() -> tuple[Scan, Pose]:
    """A log with poses: Intel's, or a simulated one where it is not there."""
    path = DATA / "carmen/intel-corrected.log.gz"
    if not path.exists():
        return simulated_drive(300, "float64")
    cov = np.diag(np.square(SIGMAS))
    (chunk,) = chunks_of_readings(open_log(path), 10**6, cov_pose=cov, dtype="float64")
    return chunk.scans, chunk.poses


def simulated_drive(count: int, dtype: str) -> tuple[Scan, Pose]:
    """Scans of the paper's instrument along a path through the laboratory."""
    of_world, of_drive = jax.random.split(jax.random.key(SEED))
    log = simulate.simulate(
        of_drive,
        generators.laboratory(of_world, change=count),
        scanners.pls(),
        count=count,
        cov_pose=jnp.diag(jnp.square(jnp.asarray((0.01, 0.01, 0.002)))),
    )
    return cast((log.scans, log.poses), dtype)


def pose_at(dtype: str) -> Pose:
    """The origin, with the covariance of a pose."""
    return cast(Pose(mean=jnp.zeros(3), cov=jnp.diag(jnp.square(jnp.asarray(SIGMAS)))), dtype)


def cast(tree: Any, dtype: str) -> Any:
    """The floats of a tree in one dtype."""
    return jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


def filled(line_map: Any, count: int) -> Any:
    """A map with so many lines and circles: those that it holds, over and over, each time 40 m farther away."""

    def slots(held: Any, place: str) -> Any:
        valid = np.flatnonzero(np.asarray(held.valid))
        index = valid[np.arange(count) % len(valid)]
        taken = jax.tree.map(lambda x: np.asarray(x)[index], held)
        away = 40.0 * (np.arange(count) // len(valid))[:, None]
        return taken.replace(**{place: (getattr(taken, place) + away).astype(getattr(taken, place).dtype)})

    return type(line_map)(lines=slots(line_map.lines, "anchor"), circles=slots(line_map.circles, "center"))


def as_table(rows: list[Row]) -> str:
    """The rows as Markdown."""
    columns = ("", "preset", "batch", "devices", "capacity", "dtype", "us a scan", "middle half", "times C++")
    columns += ("CPU us", "compiled in, s", "from cache, s")
    lines = [f"{platform.machine()}, {len(CORES)} cores, {jax.devices()[0].device_kind}, jax {jax.__version__}.", ""]
    lines += [f"| {' | '.join(columns)} |", "| --- | --- " + "| ---: " * (len(columns) - 2) + "|"]
    for row in rows:
        low, high = row["spread"]
        cells = [row["name"], row["preset"], row["batch"], row["devices"], row["capacity"] or "", row["dtype"]]
        cells += [f"{row['us_per_scan']:.1f}", f"{low:.1f} to {high:.1f}"]
        cells += ["" if row["ratio_to_cpp"] is None else f"{row['ratio_to_cpp']:.1f}"]
        cells += [f"{row['cpu_us_per_scan']:.1f}", f"{row['compile_s']:.1f}", f"{row['cached_s']:.1f}"]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
