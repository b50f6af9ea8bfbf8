"""How long a scan takes, beside a scalar C++ extractor of section 4 and a plain NumPy one in the same run.

Usage: python scripts/bench.py [--quick] [--json FILE] [--write]

Rows:

- extract: one scan, or a batch of them, into lines and circles. On a CPU the scans of a batch are taken one after the
  other in a compiled loop (`lax.map`), which is faster there than side by side (`vmap`); elsewhere side by side.
- map_step: the lines and circles of a scan (at most 20 and 9) into a map that holds 100 of each, inside `lax.scan`.
- scan_to_map: both, over a whole log, inside `lax.scan`.

Scans are the real ones of $LINEMAP_DATA/ple/scans.npz (default ../shared/data), and for scan_to_map those of the Intel
log; where these are not there, simulated ones. The C++ extractor is compiled from $LINEMAP_BASELINE (default
../shared/tools/baseline), where it and g++ are there, and timed on the same scans on one core after each row; the
ratio is the time of the row over that. The NumPy one is tests/oracle.py. On a CPU everything runs on one core, but for
the rows with more devices. With --write the table goes into README, between its markers. With --json each row is an
object: name, preset, scans ("real" or "simulated"), batch, dtype, devices, capacity, us_per_scan (the median), spread
(the range of the middle half), cpu_us_per_scan (of the process), ratio_to_cpp, ratio_to_numpy, compile_s, cached_s
(compiled code from the cache on the disk), peak_mb (of the process so far).
"""

import argparse
import importlib
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
from typing import Any, Literal, NamedTuple

CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
ALL_CORES = "--all-cores"
"""Given to the process that measures the rows with several devices. Threads of jax that share one core would wait for
each other: a process is on one core, or on all, before jax counts them."""
if hasattr(os, "sched_setaffinity"):
    if ALL_CORES in sys.argv:  # begun by a process that is on one
        CORES = [int(core) for core in sys.argv[-1].split(",")]
        os.sched_setaffinity(0, CORES)
    else:
        os.sched_setaffinity(0, CORES[:1])

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", len(CORES) if ALL_CORES in sys.argv else 1)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jax.sharding import Mesh, NamedSharding, PartitionSpec  # noqa: E402
from readme import write_part  # noqa: E402

from linemap_jax import Capacity, Mount, Pose, Scan, SensorNoise, empty_map, extract, preset, update  # noqa: E402
from linemap_jax.build import COMPILER_OPTIONS  # noqa: E402
from linemap_jax.core.extract import observe, with_defaults  # noqa: E402
from linemap_jax.core.mapping import integrate  # noqa: E402
from linemap_jax.core.settings import SCAN_CAPACITY, persistence_of  # noqa: E402
from linemap_jax.core.slots import resize  # noqa: E402
from linemap_jax.core.state import Extraction, LineMap  # noqa: E402
from linemap_jax.io.log import open_log  # noqa: E402
from linemap_jax.io.scans import chunks_of_readings  # noqa: E402
from linemap_jax.lab import generators, scanners, simulate  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
oracle: Any = importlib.import_module("oracle")
DATA = Path(os.environ.get("LINEMAP_DATA", ROOT / "../shared/data"))
BASELINE = Path(os.environ.get("LINEMAP_BASELINE", ROOT / "../shared/tools/baseline"))
SIDE_BY_SIDE = None if jax.default_backend() == "cpu" else 4096
"""Scans of a batch that are worked on at once; one after the other on a CPU."""
SIGMAS = (0.05, 0.05, 0.0175)
"""Of the pose, m m rad."""
SEED = 3

Preset = Literal["default", "paper"]
Row = dict[str, Any]


def main() -> int:
    """Measure, print the table, and write the rows where that is asked for."""
    parser = argparse.ArgumentParser(description="How long a scan takes, beside a C++ extractor.")
    parser.add_argument("--quick", action="store_true", help="four rows, in about a minute")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--write", action="store_true", help="write the table into README")
    parser.add_argument(ALL_CORES, nargs=3, metavar=("DTYPE", "PRESET", "CORES"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.all_cores:
        dtype, choice, _ = options.all_cores
        scans = still_scans()
        assert scans is not None, "asked for where real scans are there"
        print(json.dumps(extraction(scans, 4096, dtype, choice, devices=len(CORES))))
        return 0
    with tempfile.TemporaryDirectory() as folder:
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        rows = list(measure(options.quick, Cpp.compiled(Path(folder))))
    table = as_table(rows)
    print(as_summary(rows), table, sep="\n\n")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    if options.write:
        whole = f"<details><summary>All rows</summary>\n\n{table}\n\n</details>"
        write_part("speed", f"{as_summary(rows)}\n\n{whole}")
    return 0


def measure(quick: bool, cpp: "Cpp | None") -> Any:
    """The rows, one after the other; each is said on stderr."""
    drive = simulated_drive(130, "float64")
    real, log = still_scans(), driven_scans()
    stills = {"real": real} if real is not None else {}
    if not quick or not stills:
        stills["simulated"] = drive[0]
    cpp_stills = {kind: cpp and cpp.of(scans) for kind, scans in stills.items()}
    cpp_drive, cpp_log = cpp and cpp.of(drive[0]), cpp and log and cpp.of(log[0])
    presets: tuple[Preset, ...] = ("paper",) if quick else ("paper", "default")
    for kind, scans in stills.items():
        for choice in presets:
            numpy = numpy_extractor(scans, choice)
            for dtype in ("float32",) if quick else ("float32", "float64"):
                batches = (1, 256) if quick else (1, 64, 256, 1024, 4096) if kind == "real" else (1, 1024)
                for batch in batches:
                    row = extraction(scans, batch, dtype, choice, quick=quick) | {"scans": kind}
                    yield told(row, cpp_stills[kind], numpy)
                if not quick and len(CORES) > 1 and kind == "real":
                    yield told(on_all_cores(dtype, choice) | {"scans": kind}, cpp_stills[kind], numpy)
    for dtype in ("float32",) if quick else ("float32", "float64"):
        for capacity in (128,) if quick else (64, 128, 256, 512, 1024, 2048):
            yield told(map_step(drive, capacity, dtype, quick=quick) | {"scans": "simulated"}, cpp_drive)
        for choice in presets:
            given, kind, beside = (log, "real", cpp_log) if log else (drive, "simulated", cpp_drive)
            yield told(scan_to_map(given, dtype, choice, quick=quick) | {"scans": kind}, beside)


def extraction(scans: Scan, batch: int, dtype: str, choice: Preset, devices: int = 1, *, quick: bool = False) -> Row:
    """A row of `extract`."""
    some = cast(jax.tree.map(lambda x: x[np.arange(batch) % x.shape[0]], scans), dtype)
    here = pose_at(dtype)
    one = partial(extract, **preset(choice))

    def several(scans: Scan) -> Any:
        return jax.lax.map(lambda scan: one(scan, here), scans, batch_size=SIDE_BY_SIDE)

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
    return row | timed(run, given, dtype=dtype, scans=batch, quick=quick)


def on_all_cores(dtype: str, choice: Preset) -> Row:
    """A row of `extract` with as many devices as there are cores, from a process of its own."""
    command = [sys.executable, __file__, ALL_CORES, dtype, choice, ",".join(map(str, CORES))]
    said = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(said.stdout)


def map_step(drive: tuple[Scan, Pose], capacity: int, dtype: str, *, quick: bool) -> Row:
    """A row of `map_step`: a simulated scan, again and again, into a map of what it sees and of more like that."""
    scan, pose = cast(jax.tree.map(lambda x: x[30], drive), dtype)
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
    line_map = jax.tree.map(jnp.asarray, filled(found, min(100, capacity)))
    line_map = LineMap(lines=resize(line_map.lines, capacity), circles=resize(line_map.circles, capacity))
    lasting = jax.tree.map(partial(jnp.asarray, dtype=dtype), persistence_of("unknown", None))

    def several(line_map: Any, found: Any) -> Any:
        def step(line_map: Any, _: Any) -> Any:
            after, report = integrate(
                line_map, points, pose, found, thresholds, noise, lasting, pose_error="unknown", rules=rules
            )
            return after, report.status

        return jax.lax.scan(step, line_map, None, length=64)

    row = {"name": "map_step", "preset": "default", "batch": 1, "dtype": dtype, "devices": 1, "capacity": capacity}
    return row | timed(several, line_map, found, dtype=dtype, scans=64, options=COMPILER_OPTIONS, quick=quick)


def scan_to_map(log: tuple[Scan, Pose], dtype: str, choice: Preset, *, quick: bool) -> Row:
    """A row of `scan_to_map`."""
    scans, poses = cast(log, dtype)
    count = scans.ranges.shape[0]

    def several(line_map: Any, scans: Scan, poses: Pose) -> Any:
        def step(line_map: Any, x: Any) -> Any:
            after, report = update(line_map, *x, **preset(choice))
            return after, report.status

        return jax.lax.scan(step, line_map, (scans, poses))

    capacity = Capacity(512, 512)
    row = {"name": "scan_to_map", "preset": choice, "batch": 1, "dtype": dtype, "devices": 1, "capacity": 512}
    given = empty_map(capacity, np.dtype(dtype)), scans, poses
    return row | timed(several, *given, dtype=dtype, scans=count, options=COMPILER_OPTIONS, quick=quick)


def timed(
    function: Callable[..., Any], *given: Any, dtype: str, scans: int, options: Any = None, quick: bool = False
) -> Row:
    """Compile, once more from the cache unless it has to be quick, and run for a second or so."""
    with jax.enable_x64(dtype == "float64"):  # who works in float32 leaves it off, and has indices of 32 bits
        return _timed(function, *given, scans=scans, options=options, quick=quick)


def _timed(function: Callable[..., Any], *given: Any, scans: int, options: Any, quick: bool) -> Row:
    # Called as users call it: what `compile` gives has no quick way from Python.
    jitted = jax.jit(function, compiler_options=options)

    def compiled_in() -> float:
        jax.clear_caches()
        begin = time.perf_counter()
        jitted.lower(*given).compile()
        return time.perf_counter() - begin

    cold = compiled_in()
    warm = None if quick else compiled_in()
    spans, used = [], []
    jax.block_until_ready(jitted(*given))
    while len(spans) < 7 or (sum(spans) < 1.0 and len(spans) < 1000):
        begin, process = time.perf_counter(), time.process_time()
        jax.block_until_ready(jitted(*given))
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


def told(row: Row, cpp: Callable[[], float] | None, numpy: float | None = None) -> Row:
    """The row with its ratio to the C++ extractor, which is timed once more, and to the NumPy one, in us a scan."""
    row["ratio_to_cpp"] = row["us_per_scan"] / cpp() if cpp else None
    row["ratio_to_numpy"] = row["us_per_scan"] / numpy if numpy else None
    print(json.dumps(row), file=sys.stderr, flush=True)
    return row


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
            said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            return float(said.split("median=")[1].split()[0])

        return time_it


def numpy_extractor(scans: Scan, choice: Preset) -> float:
    """What the plain NumPy extractor takes a scan, us; the median of ten scans."""
    pose, options = pose_at("float64"), preset(choice)
    spans = []
    for i in range(0, 100, 10):
        ranges, bearings, valid = (np.asarray(x[i]) for x in (scans.ranges, scans.bearings, scans.valid))
        begin = time.perf_counter()
        oracle.extract(
            ranges,
            bearings,
            valid,
            float(scans.spacing[i]),
            np.asarray(pose.mean),
            np.asarray(pose.cov),
            thresholds=options["thresholds"],
            noise=SensorNoise(),
            mount=Mount(),
            rules=options["rules"],
            covariance=options["covariance"],
            capacity=SCAN_CAPACITY,
        )
        spans.append(time.perf_counter() - begin)
    return 1e6 * statistics.median(spans)


def still_scans() -> Scan | None:
    """Real scans of many places, if they are there."""
    path = DATA / "ple/scans.npz"
    if not path.exists():
        return None
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


def driven_scans() -> tuple[Scan, Pose] | None:
    """A log with poses, Intel's, if it is there."""
    path = DATA / "carmen/intel-corrected.log.gz"
    if not path.exists():
        return None
    cov = np.diag(np.square(SIGMAS))
    (chunk,) = chunks_of_readings(open_log(path), 10**6, cov_pose=cov, dtype="float64")
    return chunk.scans, chunk.poses


def simulated_drive(count: int, dtype: str) -> tuple[Scan, Pose]:
    """Scans of the paper's instrument along a path through the laboratory."""
    of_world, of_drive = jax.random.split(jax.random.key(SEED))
    log = simulate.simulate(
        of_drive,
        generators.laboratory(of_world, scans=count),
        scanners.pls(),
        count=count,
        cov_pose=jnp.diag(jnp.square(jnp.asarray((0.01, 0.01, 0.002)))),
    )
    return cast((log.scans, log.poses), dtype)


def pose_at(dtype: str) -> Pose:
    """The origin, with the covariance of a pose."""
    return cast(Pose(mean=jnp.zeros(3), cov=jnp.diag(jnp.square(jnp.asarray(SIGMAS)))), dtype)


def cast(tree: Any, dtype: str) -> Any:
    """The floats of a tree in one dtype, and its integers in 32 bits."""

    def one(x: Any) -> Any:
        if jnp.issubdtype(x.dtype, jnp.floating):
            return x.astype(dtype)
        return x.astype(jnp.int32) if jnp.issubdtype(x.dtype, jnp.integer) else x

    return jax.tree.map(one, tree)


def filled(found: Extraction, count: int) -> LineMap:
    """A map with so many lines and circles: those of a scan, over and over, each time 40 m farther away."""

    def slots(held: Any, place: str) -> Any:
        valid = np.flatnonzero(np.asarray(held.valid))
        index = valid[np.arange(count) % len(valid)]
        taken = jax.tree.map(lambda x: np.asarray(x)[index], held)
        away = 40.0 * (np.arange(count) // len(valid))[:, None]
        return taken.replace(**{place: (getattr(taken, place) + away).astype(getattr(taken, place).dtype)})

    return LineMap(lines=slots(found.lines, "anchor"), circles=slots(found.circles, "center"))


class Aim(NamedTuple):
    """What some rows are meant to reach: a multiple of the C++ extractor's time."""

    what: str
    name: str
    rows: dict[str, Any]
    times: dict[str, float]  # by dtype


AIMS = (
    Aim("a scan alone", "extract", {"batch": 1, "devices": 1, "scans": "real"}, {"float32": 9, "float64": 14}),
    Aim("a scan of a batch, one core", "extract", {"batch": 4096, "devices": 1, "scans": "real"}, {"float32": 2}),
    Aim("a scan of a batch, two cores", "extract", {"batch": 4096, "devices": 2, "scans": "real"}, {"float32": 1.1}),
    Aim("a scan's lines into a map of 100 + 100", "map_step", {"capacity": 128}, {"float32": 17}),
    Aim("a scan to the map", "scan_to_map", {"scans": "real"}, {"float32": 25}),
)


def as_summary(rows: list[Row]) -> str:
    """The rows for which there are aims, as Markdown."""
    lines = ["|  | preset | dtype | us | times C++ | aim |", "| --- | --- | --- | ---: | ---: | ---: |"]
    for aim in AIMS:
        for row in rows:
            meant = row["name"] == aim.name and all(row[key] == value for key, value in aim.rows.items())
            if meant and row["dtype"] in aim.times and row["ratio_to_cpp"] is not None:
                cells = [aim.what, row["preset"], row["dtype"], f"{row['us_per_scan']:.0f}"]
                cells += [f"{row['ratio_to_cpp']:.1f}", f"{aim.times[row['dtype']]:g}"]
                lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def as_table(rows: list[Row]) -> str:
    """The rows as Markdown."""
    columns = ("", "preset", "scans", "batch", "cores", "capacity", "dtype", "us a scan", "middle half", "times C++")
    columns += ("times NumPy", "CPU us", "compiled in, s", "from cache, s", "peak MB")
    lines = [f"{processor()}, {len(CORES)} cores, {jax.devices()[0].device_kind}, jax {jax.__version__}.", ""]
    lines += [f"| {' | '.join(columns)} |", "| --- | --- | --- " + "| ---: " * (len(columns) - 3) + "|"]

    def number(x: float | None, digits: int) -> str:
        return "" if x is None else f"{x:.{digits}f}"

    for row in rows:
        low, high = row["spread"]
        cells = [row["name"], row["preset"], row["scans"], row["batch"], row["devices"], row["capacity"] or ""]
        cells += [row["dtype"], number(row["us_per_scan"], 1), f"{low:.1f} to {high:.1f}"]
        cells += [number(row["ratio_to_cpp"], 1), number(row["ratio_to_numpy"], 4), number(row["cpu_us_per_scan"], 1)]
        cells += [number(row["compile_s"], 1), number(row["cached_s"], 1), number(row["peak_mb"], 0)]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def processor() -> str:
    """What the machine calls its processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


if __name__ == "__main__":
    sys.exit(main())
