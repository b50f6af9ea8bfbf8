"""The package against the plain NumPy reading of the method in tests/oracle.py, on whole logs: the table in README.

Usage: python scripts/compare_with_oracle.py [--every N] [--scans N] [--map-scans N] [--write]

Reads the corrected CARMEN logs in $LINEMAP_DATA (default ../shared/data); leaves out what is not there. In float64.
Progress goes to stderr, the table to stdout; with --write it goes into README too, between its markers. The columns:

- scans: those whose extraction is compared.
- lines equal: lines for which package and oracle have the same beams, of all lines of either.
- unequal scans: scans in which some beam is in another line; in brackets those of them in which a decision of the
  oracle was closer to its threshold than 1e-9 m or rad.
- estimate, covariance: largest difference of (offset, angle) of an equal line, in m and rad, and of a part of its
  covariance, relative to the whole of it.
- map: for how many of the first scans (--map-scans) report and map are equal to the oracle's, slot by slot.
- only sequential, only simultaneous: the package takes all lines of a scan at once, the paper one after the other; the
  oracle can do both. The share of the lines of either map that have no counterpart in the other: no single line of the
  other map that runs along at least half of them, nowhere more than 5 cm away.
"""

import argparse
import importlib
import os
import sys
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from readme import write_part
from tqdm import tqdm

from linemap_jax import Capacity, Mount, SensorNoise, empty_map, extract, preset, update
from linemap_jax.core.state import LEFT_OUT
from linemap_jax.io.log import open_log
from linemap_jax.io.scans import chunks_of_readings

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
oracle: Any = importlib.import_module("oracle")

DATA = Path(os.environ.get("LINEMAP_DATA", ROOT / "../shared/data"))
LOGS = {"intel": "Intel", "aces": "ACES", "fhw": "FHW", "freiburg-079": "FR079"}
PRESETS: tuple[Literal["default", "paper"], ...] = ("default", "paper")
COV_POSE = np.diag([0.05, 0.05, 0.01]) ** 2
SCAN, MAP = Capacity(64, 96), Capacity(512, 512)
CHUNK = 256
COLUMNS = ("log", "preset", "scans", "lines equal", "unequal scans", "estimate", "covariance", "map")
COLUMNS += ("only sequential", "only simultaneous")


def main() -> int:
    """Print the table, and write it where that is asked for."""
    parser = argparse.ArgumentParser(description="The package against the NumPy oracle, on whole logs.")
    parser.add_argument("--every", type=int, default=1, help="compare the extraction of every N-th scan")
    parser.add_argument("--scans", type=int, default=None, help="and of the first N of these only")
    parser.add_argument("--map-scans", type=int, default=200, help="build the maps of the first N scans")
    parser.add_argument("--write", action="store_true", help="write the table into README")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)

    rows = []
    for name, title in LOGS.items():
        path = DATA / "carmen" / f"{name}-corrected.log.gz"
        if not path.exists():
            print(f"{path} is not there: left out", file=sys.stderr)
            continue
        (chunk,) = chunks_of_readings(open_log(path), 10**6, cov_pose=COV_POSE, dtype="float64")
        log = jax.tree.map(np.asarray, (chunk.scans, chunk.poses))
        for choice in PRESETS:
            some = at(log, slice(None, None, options.every))
            cells = [*compare_extraction(at(some, slice(options.scans)), choice)]
            cells += compare_maps(at(log, slice(options.map_scans)), choice)
            rows.append(f"| {title} | {choice} | {' | '.join(cells)} |")
            print(rows[-1], file=sys.stderr)
    table = "\n".join([f"| {' | '.join(COLUMNS)} |", "| --- | --- " + "| ---: " * (len(COLUMNS) - 2) + "|", *rows])
    print(table)
    if options.write and rows:
        write_part("oracle", table)
    return 0


@partial(jax.jit, static_argnames="name")
def extract_all(scans: Any, poses: Any, name: str) -> Any:
    """Extraction of a stack of scans with a preset."""
    one_scan = partial(extract, capacity=SCAN, **preset("paper" if name == "paper" else "default"))
    return jax.lax.map(lambda x: one_scan(*x), (scans, poses))


# As in `build`: these options compile in half the time.
@partial(jax.jit, static_argnames="name", compiler_options={"xla_cpu_use_fusion_emitters": False})
def update_all(line_map: Any, scans: Any, poses: Any, name: str) -> Any:
    """The map after each scan, and the reports."""

    def step(line_map: Any, x: Any) -> Any:
        line_map, report = update(line_map, *x, capacity=SCAN, **preset("paper" if name == "paper" else "default"))
        return line_map, (line_map, report)

    return jax.lax.scan(step, line_map, (scans, poses))[1]


def compare_extraction(log: Any, choice: Literal["default", "paper"]) -> list[str]:
    """The cells from `scans` to `covariance`."""
    options = {**preset(choice), "noise": SensorNoise(), "mount": Mount(), "capacity": SCAN}
    count = len(log[0].ranges)
    equal = other = unequal = undecided = 0
    estimate = covariance = 0.0
    progress = tqdm(total=count, desc=f"extraction, {choice}", leave=False)
    for begin in range(0, count, CHUNK):
        # Filled up with scans that are done already: the last piece is of the same size.
        index = np.minimum(np.arange(begin, begin + CHUNK), count - 1)
        found = jax.tree.map(np.asarray, extract_all(*at(log, index), choice))
        for t in range(min(CHUNK, count - begin)):
            scan, pose, mine = at(log[0], begin + t), at(log[1], begin + t), at(found, t)
            theirs = oracle.extract(*fields(scan), pose.mean, pose.cov, **options)
            pairs = same_beams(mine.line_of_beam, theirs.line_of_beam)
            equal += len(pairs)
            other += max(int(mine.lines.valid.sum()), len(theirs.lines.offset)) - len(pairs)
            if not np.array_equal(oracle.compact(mine.line_of_beam, mine.lines.valid), theirs.line_of_beam):
                unequal += 1
                undecided += theirs.deciding_margin < 1e-9
            if pairs:
                of_mine, of_theirs = np.array(pairs).T
                differences = oracle.differences(mine.lines, theirs.lines.take(of_theirs), of_mine)
                estimate = max(estimate, differences[0].max())
                covariance = max(covariance, differences[1].max())
            progress.update()
    progress.close()
    unequal_scans = f"{unequal} ({undecided})" if unequal else "0"
    return [str(count), f"{equal} / {equal + other}", unequal_scans, f"{estimate:.0e}", f"{covariance:.0e}"]


def same_beams(mine: np.ndarray, theirs: np.ndarray) -> list[tuple[int, int]]:
    """The lines that hold the same beams: slots of the package and of the oracle."""
    pairs = []
    for k in range(theirs.max(initial=-1) + 1):
        beams = theirs == k
        slot = int(mine[beams][0])
        if slot >= 0 and np.array_equal(mine == slot, beams):
            pairs.append((slot, k))
    return pairs


def compare_maps(log: Any, choice: Literal["default", "paper"]) -> list[str]:
    """The cells from `map` on."""
    options = {**preset(choice), "noise": SensorNoise(), "mount": Mount(), "scan_capacity": SCAN}
    maps, reports = jax.tree.map(np.asarray, update_all(empty_map(MAP, np.float64), *log, choice))
    count = len(log[0].ranges)
    theirs, one_by_one = oracle.empty_map(MAP), oracle.empty_map(MAP)
    until = count
    for t in tqdm(range(count), desc=f"maps, {choice}", leave=False):
        scan, pose = at(log[0], t), at(log[1], t)
        theirs, report = oracle.update(theirs, fields(scan), pose.mean, pose.cov, **options)
        if until == count and not same_map(at(maps, t), at(reports, t), theirs, report):
            until = t
        one_by_one, _ = oracle.update(one_by_one, fields(scan), pose.mean, pose.cov, mode="sequential", **options)
    alone = (
        oracle.without_counterpart(one_by_one.lines, theirs.lines),
        oracle.without_counterpart(theirs.lines, one_by_one.lines),
    )
    return [f"{until} of {count}", *(f"{lines.sum()} of {len(lines)} ({lines.mean():.1%})" for lines in alone)]


def same_map(mine: Any, said: Any, theirs: Any, report: Any) -> bool:
    """Whether a map and a report are those of the oracle: slots, and lines to 1e-6 m or rad."""
    counts = ("added", "fused", "merged", "trimmed", "split", "deleted", "status")
    slots = np.array_equal(said.line_slot[said.line_slot != LEFT_OUT], report.line_slot[report.line_slot != LEFT_OUT])
    valid = np.array_equal(mine.lines.valid, theirs.lines.valid)
    valid &= np.array_equal(mine.circles.valid, theirs.circles.valid)
    if not (slots and valid and all(getattr(said, name) == getattr(report, name) for name in counts)):
        return False
    keep = np.flatnonzero(theirs.lines.valid)
    estimate, _ = oracle.differences(mine.lines, theirs.lines.take(keep), keep)
    return bool(estimate.max(initial=0) < 1e-6)


def at(tree: Any, index: Any) -> Any:
    """Some items of a stack."""
    return jax.tree.map(lambda x: x[index], tree)


def fields(scan: Any) -> tuple[Any, ...]:
    """A scan as the oracle takes it."""
    return scan.ranges, scan.bearings, scan.valid, float(scan.spacing)


if __name__ == "__main__":
    sys.exit(main())
