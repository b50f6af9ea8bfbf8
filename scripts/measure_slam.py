"""What `linemap slam` makes of the Freiburg benchmark: the table in README, measured.

Usage: python scripts/measure_slam.py [--write] [FOLDER]

Reads the bags and relations in $LINEMAP_DATA (default ../shared/data) and scores with $LINEMAP_TOOLS (default
../shared/tools); leaves out what is not there. Maps and trajectories stay in FOLDER, if one is given. With --write the
table goes into README, between its markers.
"""

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from readme import write_part

from linemap_jax.io.log import open_log

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("LINEMAP_DATA", ROOT / "../shared/data"))
TOOLS = Path(os.environ.get("LINEMAP_TOOLS", ROOT / "../shared/tools"))
LOGS = {"aces": ("ACES", 0.060, 0.044), "fr079": ("FR079", 0.061, 0.056)}
"""Bags, their titles, and what GMapping and graph mapping reach (Kuemmerle et al. 2009), m."""


def main() -> int:
    """Print the table, and write it where that is asked for."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    folders = [argument for argument in sys.argv[1:] if argument != "--write"]
    if not (TOOLS / "relations.py").exists():
        print(f"{TOOLS / 'relations.py'} is not there: nothing can be scored", file=sys.stderr)
        return 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(folders[0] if folders else temporary)
        rows = [row for name in LOGS if (row := measure(name, folder)) is not None]
    columns = ("log", "raw odometry", "laser", "base", "median", "GMapping", "graph mapping", "relations", "keyframes")
    columns += ("loops", "lines", "explained", "time of one core", "times as fast as recorded")
    table = "\n".join([f"| {' | '.join(columns)} |", "| --- " + "| ---: " * (len(columns) - 1) + "|", *rows])
    print(table)
    if "--write" in sys.argv[1:] and rows:
        write_part("slam", table)
    return 0


def measure(name: str, folder: Path) -> str | None:
    """The row of one log; None where it is not there."""
    bag, relations = (DATA / "freiburg" / f"{name}.{ending}" for ending in ("sort.bag", "relations"))
    if not bag.exists() or not relations.exists():
        print(f"{bag} or its relations are not there: left out", file=sys.stderr)
        return None
    raw = open_log(bag)
    stamps, poses = zip(*((reading.timestamp, reading.pose) for reading in raw), strict=True)
    told, errors = {}, {}
    for frame in ("laser", "base"):
        started = time.perf_counter()
        output = folder / f"{name}-{frame}"
        command = [
            sys.executable,
            "-m",
            "linemap_jax.cli",
            "slam",
            str(bag),
            "-o",
            str(output),
            "--json",
            "--overwrite",
        ]
        said = subprocess.run([*command, "--trajectory-frame", frame], check=True, capture_output=True, text=True)
        told[frame] = json.loads(said.stdout) | {"seconds": time.perf_counter() - started}
        errors[frame] = error_of(np.loadtxt(output / "trajectory.tum"), relations)
    x, y, theta = np.array(poses).T
    zero = np.zeros(len(x))
    odometry = error_of(
        np.column_stack([stamps, x, y, zero, zero, zero, np.sin(theta / 2), np.cos(theta / 2)]), relations
    )
    summary, (share, error) = told["base"], errors["laser"]  # the second run finds its programs compiled
    title, gmapping, graph = LOGS[name]
    pace = (max(stamps) - min(stamps)) / summary["seconds"]
    return (
        f"| {title} | {odometry[1].mean():.3f} m | **{error.mean():.3f} m** | {errors['base'][1].mean():.3f} m "
        f"| {np.median(error):.3f} m | {gmapping:.3f} m | {graph:.3f} m | {share:.0%} | {summary['keyframes']} "
        f"| {summary['loops']} | {summary['lines']} | {summary['explained']:.1%} | {summary['seconds']:.0f} s "
        f"| {pace:.0f} |"
    )


def error_of(trajectory: np.ndarray, relations: Path) -> tuple[float, np.ndarray]:
    """The share of the relations that is scored, and the translational errors, m."""
    spec = importlib.util.spec_from_file_location("relations", TOOLS / "relations.py")
    assert spec is not None
    assert spec.loader is not None
    tool: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    share, translation, _ = tool.evaluate(trajectory, np.loadtxt(relations, comments="#", usecols=range(8)))
    return share, translation


if __name__ == "__main__":
    sys.exit(main())
