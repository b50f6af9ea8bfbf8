"""What the maps of real logs are worth: the table in README, measured.

Usage: python scripts/measure_logs.py [--write]

Reads the corrected CARMEN logs in $LINEMAP_DATA (default ../shared/data); leaves out what is not there. With --write
the table goes into README, between its markers.
"""

import os
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from readme import write_part

from linemap_jax import Capacity, build, preset
from linemap_jax.core.settings import UpdateOptions
from linemap_jax.io.log import open_log
from linemap_jax.io.scans import chunks_of_readings
from linemap_jax.lab.evaluation import duplicates, explained_share

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("LINEMAP_DATA", ROOT / "../shared/data"))
LOGS = {"intel": "Intel", "aces": "ACES", "fhw": "FHW", "freiburg-079": "FR079"}
COV_POSE = np.diag([0.05, 0.05, 0.01]) ** 2
CHUNK = 64
WAYS: dict[str, UpdateOptions] = {
    "default": {**preset("default")},
    "default, `optimal`": {**preset("default"), "segmentation": "optimal"},
    "paper": {**preset("paper")},
}
"""Presets, and one with the other segmentation."""


def main() -> int:
    """Print the table, and write it where that is asked for."""
    rows = []
    for name, title in LOGS.items():
        path = DATA / "carmen" / f"{name}-corrected.log.gz"
        if not path.exists():
            print(f"{path} is not there: left out", file=sys.stderr)
            continue
        (chunk,) = chunks_of_readings(open_log(path), 10**6, cov_pose=COV_POSE)
        for way, options in WAYS.items():
            rows.append(f"| {title} | {way} | " + " | ".join(measure((chunk.scans, chunk.poses), options)) + " |")
            print(rows[-1], flush=True)
    columns = ("log", "preset", "scans", "lines", "circles", "explained", "held out", "median line", "seen 3 times")
    columns += ("duplicates", "time a scan")
    table = "\n".join([f"| {' | '.join(columns)} |", "| --- | --- " + "| ---: " * 9 + "|", *rows])
    if "--write" in sys.argv[1:] and rows:
        write_part("measured", table)
    return 0


def measure(log: tuple[Any, Any], way: UpdateOptions) -> list[str]:
    """The figures of one log, mapped in some way, from the third column on."""
    run = partial(build, map_capacity=Capacity(512, 256), chunk=CHUNK, **way)
    run(*log)  # compiles, at each size that the map grows to
    started = time.perf_counter()
    line_map, _ = run(*log)
    jax.block_until_ready(line_map)
    seconds = time.perf_counter() - started
    count = log[0].ranges.shape[0]
    even, _ = run(*every(log, slice(0, None, 2)))

    lines = line_map.lines
    length = np.asarray(lines.length)
    valid, often = np.asarray(lines.valid), np.asarray(lines.times_detected) >= 3
    return [
        str(count),
        str(valid.sum()),
        str(int(line_map.circles.valid.sum())),
        f"{explained_share(line_map, pieces(log), chunk=CHUNK):.1%}",
        f"{explained_share(even, pieces(every(log, slice(1, None, 2))), chunk=CHUNK):.1%}",
        f"{np.median(length[valid]):.2f} m",
        f"{np.median(length[valid & often]):.2f} m",
        str(int(duplicates(lines).sum())),
        f"{1e3 * seconds / count:.1f} ms",
    ]


def every(log: tuple[Any, Any], which: slice) -> tuple[Any, Any]:
    """Some of the scans, with their poses."""
    return jax.tree.map(lambda x: x[which], log)


def pieces(log: tuple[Any, Any]) -> Any:
    """The log cut into chunks."""
    count = log[0].ranges.shape[0]
    return (every(log, slice(i, i + CHUNK)) for i in range(0, count, CHUNK))


if __name__ == "__main__":
    sys.exit(main())
