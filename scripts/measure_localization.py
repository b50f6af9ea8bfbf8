"""How well a robot is found in a map: the table in README, measured.

Usage: python scripts/measure_localization.py [--write]

Of each corrected CARMEN log in $LINEMAP_DATA (default ../shared/data) the map is built from every second scan, and the
robot is followed through the other ones by `linemap localize`, from raw odometry. The errors are against the corrected
poses of these scans, which took no part. With --write the table goes into README, between its markers.

The corrected logs hold the raw odometry still: after each scan it goes on from the corrected pose, so that the last
`ODOM` line before a scan, seen from the pose of the scan before, is what the wheels have counted in between.
"""

import contextlib
import gzip
import io
import json
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from readme import write_part

from linemap_jax.cli import main as linemap
from linemap_jax.io.carmen import assumed_sweep
from linemap_jax.io.carmen_writer import write_carmen
from linemap_jax.io.log import open_log
from linemap_jax.io.reading import RANGE_MAX

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("LINEMAP_DATA", ROOT / "../shared/data"))
LOGS = {"intel": "Intel", "freiburg-079": "FR079", "aces": "ACES", "fhw": "FHW"}
STARTS = ((0.35, -0.35, 0.17), (-0.5, 0.0, -0.17))
"""What the start is wrong by, m m rad: half a metre and 10 degrees."""

Floats = NDArray[np.float64]


def main() -> int:
    """Print the table, and write it where that is asked for."""
    columns = ("log", "start off by", "scans", "position: median", "95 %", "most", "heading: median", "95 %")
    columns += ("lost", "off by 0.5 m, not told", "time a scan", "times real time")
    table = [f"| {' | '.join(columns)} |", "| --- | --- |" + " ---: |" * (len(columns) - 2)]
    print("\n".join(table))
    for name, title in LOGS.items():
        path = DATA / "carmen" / f"{name}-corrected.log.gz"
        if not path.exists():
            print(f"{path} is not there: left out", file=sys.stderr)
            continue
        with tempfile.TemporaryDirectory() as folder:
            corrected = prepare(path, Path(folder))
            run(["build", f"{folder}/even.log", "-o", f"{folder}/map"])
            for off in STARTS:
                table.append(f"| {title} | {told(off)} | " + " | ".join(measure(Path(folder), corrected, off)) + " |")
                print(table[-1], flush=True)
    if "--write" in sys.argv[1:] and len(table) > 2:
        write_part("localization", "\n".join(table))
    return 0


def prepare(path: Path, folder: Path) -> Floats:
    """Write the even scans with corrected poses, and the odd ones with raw odometry alone.

    Returns:
      The corrected poses of the odd scans. Shape `[T, 3]`.
    """
    readings = list(open_log(path))
    poses = np.stack([reading.pose for reading in readings])  # pyright: ignore[reportCallIssue, reportArgumentType]
    counted = raw_odometry(path)
    ranges = np.stack([reading.ranges for reading in readings])
    stamps = np.array([reading.timestamp for reading in readings])
    beams = ranges.shape[1]
    first, step = assumed_sweep(beams)
    for name, which, stated in (("even", np.s_[::2], poses), ("odd", np.s_[1::2], counted)):
        write_carmen(
            folder / f"{name}.log",
            ranges=ranges[which],
            bearings=first + step * np.arange(beams),
            range_max=RANGE_MAX,
            poses=stated[which],
            odometry=stated[which],
            timestamps=stamps[which],
        )
    return poses[1::2]


def raw_odometry(path: Path) -> Floats:
    """Odometry's poses of all scans, in a frame of its own. Shape `[T, 3]`."""
    chained, before, last = [], None, None
    with gzip.open(path, "rt") as lines:
        for fields in map(str.split, lines):
            if fields[:1] == ["ODOM"]:
                last = np.array(fields[1:4], float)
            elif fields[:1] == ["FLASER"]:
                here = np.array(fields[int(fields[1]) + 2 :][:3], float)
                if before is None or last is None:
                    chained.append(np.zeros(3))
                else:
                    move = complex(*(last - before)[:2]) * np.exp(1j * (chained[-1][2] - before[2]))
                    chained.append(chained[-1] + [move.real, move.imag, wrapped(last[2] - before[2])])
                before = last = here
    return np.array(chained)


def measure(folder: Path, corrected: Floats, off: tuple[float, float, float]) -> list[str]:
    """The figures of one log and start, from the third column on."""
    start = [str(x) for x in corrected[0] + off]
    out = str(folder / "way.tum")
    args = ["localize", f"{folder}/map/map.json", f"{folder}/odd.log", "-o", out, "--start", *start, "--overwrite"]
    run(args)  # compiles
    summary = json.loads(run([*args, "--json"]))
    table = np.genfromtxt(folder / "way.csv", delimiter=",", names=True)
    distance = np.hypot(table["x"] - corrected[:, 0], table["y"] - corrected[:, 1])
    turn = np.degrees(np.abs(wrapped(table["theta"] - corrected[:, 2])))
    sigma = np.sqrt(np.maximum(table["cov_xx"], table["cov_yy"]))
    untold = np.sum((distance > 0.5) & (table["lost"] == 0) & (distance > 3 * sigma))
    return [
        str(summary["scans"]),
        *(f"{100 * x:.1f} cm" for x in np.percentile(distance, [50, 95, 100])),
        *(f"{x:.2f} deg" for x in np.percentile(turn, [50, 95])),
        str(summary["lost"]),
        str(untold),
        f"{summary['us_per_scan'] / 1000:.1f} ms",
        f"{summary['times_real_time']:.0f}",
    ]


def run(args: list[str]) -> str:
    """What a command prints."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        status = linemap(args)
    if status:
        raise SystemExit(f"linemap {' '.join(args)} gave {status}")
    return printed.getvalue()


def wrapped(angle: Floats) -> Floats:
    """In [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def told(off: tuple[float, float, float]) -> str:
    """In words."""
    return f"{np.hypot(*off[:2]):.1f} m, {np.degrees(off[2]):+.0f} deg"


if __name__ == "__main__":
    sys.exit(main())
